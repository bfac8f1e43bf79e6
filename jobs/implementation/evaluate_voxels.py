"""Implementation of jobs/evaluate_voxels.py."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from jobs.evaluate_voxels import Config
from jobs.support.cli import make_absolute, resolve_path
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from jobs.support.scores import publish_scores
from pipelines.evaluation.voxel_reconstruction import group_files_by_scene, list_true_scenes, pair_files, score_voxels
from pipelines.geometry.voxels import VoxelGrid
from pipelines.io.voxel_import import VOXEL_AXES
from pipelines.runtime import storage
from pipelines.schema.axis_convention import compute_scene_from_axes


def evaluate(config: Config) -> dict:
    """Evaluate, write all files, and return the nested metrics."""
    axes, truth_axes = config.axes or VOXEL_AXES, config.ground_truth_axes or VOXEL_AXES
    for words in (axes, truth_axes):
        compute_scene_from_axes(words)
    grid = VoxelGrid(bottom_m=config.voxel_range_m[0], top_m=config.voxel_range_m[1])
    truth = list_true_scenes(make_absolute(config.ground_truth), config.split)
    rebuilt = group_files_by_scene(make_absolute(config.reconstructed), ".npz")
    stored = group_files_by_scene(make_absolute(config.compressed)) if config.compressed else None
    pairs = pair_files(truth, rebuilt, stored, config.allow_missing)
    output = resolve_path(config.output, "evaluations", "voxels")
    with hold_output(output, "evaluation", config):
        with JobProgress() as bar:
            shown = bar.add_task("score voxels", total=len(pairs))
            scores, scenes = score_voxels(pairs, grid, axes, truth_axes, lambda: bar.advance(shown))
        scores["left_out"] = {"truths": len(truth) - len(pairs), "reconstructions": len(rebuilt) - len(pairs)}
        storage.write_parquet(scenes, storage.join_uri(output, "voxels.parquet"))
        tags = {
            "truth": make_absolute(config.ground_truth),
            "split": config.split,
            "rebuilt": make_absolute(config.reconstructed),
        }
        return publish_scores(output, scores, tags)


def main(config: Config) -> None:
    scores = evaluate(config)
    table = Table("score", "value")
    for name, value in (("IoU", scores["voxels"]["iou"]), ("mIoU", scores["voxels"]["miou"])):
        table.add_row(name, f"{100 * value:.2f} %")
    for name, value in scores["voxels"]["class_iou"].items():
        table.add_row(f"  {name}", f"{100 * value:.2f} %")
    for kind, name in (("rebuilt", "reconstructed"), ("stored", "compressed")):
        if sizes := scores.get(f"{kind}_bytes"):
            table.add_row(f"{name}, per scene", f"{sizes['mean'] / 2**20:.3f} ± {sizes['std'] / 2**20:.3f} MiB")
    left_out = scores["left_out"]
    table.add_row("scenes", str(scores["scenes"]))
    table.add_row("left out", f"{left_out['truths']} ground truths, {left_out['reconstructions']} reconstructions")
    Console().print(table)
