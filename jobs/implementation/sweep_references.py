"""Implementation of jobs/sweep_references.py."""

from __future__ import annotations

import pyarrow as pa

from jobs.support.cli import make_absolute, resolve_path
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from jobs.support.terminal import print_table
from jobs.sweep_references import Config
from pipelines.evaluation.features import FeatureConfig, compute_scene_features
from pipelines.evaluation.reference_sweep import (
    build_sweep_table,
    draw_sweep_charts,
    list_references,
    render_sweep_html,
    sweep_references,
)
from pipelines.reporting.chart import make_standalone_svg
from pipelines.runtime import storage
from pipelines.schema.dataset import Dataset
from pipelines.schema.scene_subset import SceneSubset, list_label_pairs, read_described_columns, read_poses


def run_sweep(config: Config) -> list[dict]:
    """Score all reference sets, write all files, and return one row per reference set and k."""
    dataset = Dataset.open(resolve_path(config.real, "datasets", "town"))
    output = resolve_path(config.output, "evaluations", "sweep")
    source = f"generated-{config.run}" if config.run else None
    sides = {
        "real": SceneSubset(dataset.root, dataset.source, config.real_split),
        "generated": SceneSubset(resolve_path(config.generated, "generated"), source),
    }
    parts = {name: side.shards() for name, side in sides.items()}
    looks = FeatureConfig(config.supersample, config.inception and make_absolute(config.inception))
    with hold_output(output, "evaluation", config):
        features = {}
        with JobProgress() as bar:
            for name, side in sides.items():
                task = bar.add_task(f"describe {name}", total=sum(len(rows) for _, rows in parts[name]))
                directory = storage.join_uri(output, "described", name)
                described = compute_scene_features(
                    side, dataset, looks, directory, config.num_actors, lambda n, task=task: bar.advance(task, n)
                ).read()
                features[name] = described["pool3" if config.inception else "random"]
            places = read_poses(*read_described_columns(parts["real"]))
            labels = list_label_pairs(read_described_columns(parts["generated"])[0])
            least, most = max(config.k) + 1, len(features["generated"])
            chosen = list(list_references(*places, config.reference_sizes, config.min_distances_m, least, most))
            task = bar.add_task("compare", total=len(chosen))
            rows = sweep_references(
                features["real"], features["generated"], labels, chosen, config.k, lambda: bar.advance(task)
            )
        storage.write_json(rows, storage.join_uri(output, "sweep.json"))
        storage.write_parquet(pa.Table.from_pylist(rows), storage.join_uri(output, "sweep.parquet"))
        how = [
            f"Real: {dataset.root}, split {config.real_split}. "
            f"Generated: {sides['generated'].root}, the same number of scenes per label.",
            "Features: Inception pool3."
            if config.inception
            else "Features: a fixed untrained network, without Inception weights.",
            "Brackets contain 95 % confidence intervals over scenes. The intervals keep the neighbourhoods fixed.",
        ]
        texts = {"sweep.html": render_sweep_html(rows, how)}
        for name, chart in zip(("apart", "farthest"), draw_sweep_charts(rows), strict=True):
            texts[f"sweep-{name}.svg"] = make_standalone_svg(chart)
        for name, text in texts.items():
            storage.write_text(text, storage.join_uri(output, name))
        return rows


def main(config: Config) -> None:
    print_table(build_sweep_table(run_sweep(config)))
