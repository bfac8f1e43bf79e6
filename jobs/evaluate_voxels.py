#!/usr/bin/env python3
"""Score any method's voxel reconstructions against the truth: IoU, mIoU, IoU per class, size per scene on disk.

    jobs/evaluate_voxels.py --truth TRUTH --rebuilt REBUILT                 two directories of .npz, same names
    jobs/evaluate_voxels.py --truth DATASET --split test --rebuilt REBUILT  a dataset's scenes, files named by scene_id
    jobs/evaluate_voxels.py --truth DATASET --rebuilt REBUILT --stored 'LATENTS/*.npy' --partial

Files hold 256 x 256 x 32, 128 x 128 x 16 or 64 x 64 x 8 class ids, coarse ones are repeated (docs/imports.md); every
voxel of the full grid counts, in one confusion matrix over all scenes. Writes metrics.json, metrics.parquet and
voxels.parquet, a row per scene; scores also go to MLflow.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import absolute, home, run, start_ray


@dataclass(frozen=True)
class Config:
    truth: str
    """Directory of true voxels, .npz, or a dataset directory, whose scenes are voxelised."""
    rebuilt: str
    """Directory or quoted pattern of the reconstructions, .npz."""
    stored: str = ""
    """Directory or quoted pattern of what the method keeps of each scene, as latents; any files, named by scene."""
    split: str = ""
    """Only this split of the dataset (default: all)."""
    axes: tuple[str, str, str] | None = None
    """Where the reconstructions' axes point: x forward, y left, z up, + or the other way (default: x- y- z+)."""
    truth_axes: tuple[str, str, str] | None = None
    """Where those of the true voxel files point (default: x- y- z+)."""
    voxel_range_m: tuple[float, float] = (-1.5, 6.5)
    """Lowest and highest z of a dataset's voxels; the reconstructions' must be the same."""
    partial: bool = False
    """Score the scenes that all sides have; without this, a missing counterpart is an error."""
    output: str = ""
    """Where the files go (default: $PRITTI_HOME/evaluations/voxels)."""


def evaluate(config: Config) -> dict:
    """Score, write and return the nested metrics."""
    from rich.progress import Progress

    from jobs.support.tracking import publish_scores
    from pipelines.evaluation.voxel_reconstruction import files_by_scene, paired, score_voxels, true_scenes
    from pipelines.geometry.voxels import VoxelGrid
    from pipelines.io.voxel_import import VOXEL_AXES
    from pipelines.runtime import storage
    from pipelines.schema.axis_convention import scene_from_axes

    axes, truth_axes = config.axes or VOXEL_AXES, config.truth_axes or VOXEL_AXES
    for words in (axes, truth_axes):
        scene_from_axes(words)
    grid = VoxelGrid(bottom_m=config.voxel_range_m[0], top_m=config.voxel_range_m[1])
    truth = true_scenes(absolute(config.truth), config.split)
    rebuilt = files_by_scene(absolute(config.rebuilt), ".npz")
    stored = files_by_scene(absolute(config.stored)) if config.stored else None
    pairs = paired(truth, rebuilt, stored, config.partial)
    start_ray()
    with Progress() as bar:
        shown = bar.add_task("score voxels", total=len(pairs))
        scores, scenes = score_voxels(pairs, grid, axes, truth_axes, lambda: bar.advance(shown))
    scores["left_out"] = {"truths": len(truth) - len(pairs), "reconstructions": len(rebuilt) - len(pairs)}
    output = absolute(config.output) if config.output else home("evaluations", "voxels")
    storage.write_parquet(scenes, storage.join(output, "voxels.parquet"))
    tags = {"truth": absolute(config.truth), "split": config.split, "rebuilt": absolute(config.rebuilt)}
    return publish_scores(output, scores, tags)


def main(config: Config) -> None:
    from rich.console import Console
    from rich.table import Table

    scores = evaluate(config)
    table = Table("score", "value")
    for name, value in (("IoU", scores["voxels"]["iou"]), ("mIoU", scores["voxels"]["miou"])):
        table.add_row(name, f"{100 * value:.2f} %")
    for name, value in scores["voxels"]["class_iou"].items():
        table.add_row(f"  {name}", f"{100 * value:.2f} %")
    for kind in ("rebuilt", "stored"):
        if sizes := scores.get(f"{kind}_bytes"):
            table.add_row(f"{kind}, per scene", f"{sizes['mean'] / 2**20:.3f} ± {sizes['std'] / 2**20:.3f} MiB")
    left_out = scores["left_out"]
    table.add_row("scenes", str(scores["scenes"]))
    table.add_row("left out", f"{left_out['truths']} truths, {left_out['reconstructions']} reconstructions")
    Console().print(table)


if __name__ == "__main__":
    run(main, Config, description=__doc__)
