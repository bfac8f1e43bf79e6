"""Implementation of jobs/sweep_references.py."""

from __future__ import annotations

import pyarrow as pa
from rich.progress import Progress

from jobs.support.cli import absolute, home
from jobs.support.ray_session import start_ray
from jobs.support.terminal import print_table
from jobs.sweep_references import Config
from pipelines.evaluation.features import Looks, describe
from pipelines.evaluation.reference_sweep import references, sweep, sweep_charts, sweep_html, sweep_table
from pipelines.reporting.chart import standalone_svg
from pipelines.runtime import storage
from pipelines.schema.dataset import Dataset
from pipelines.schema.scene_subset import Selection, described_columns, label_pairs, poses


def sweep_references(config: Config) -> list[dict]:
    """Score all reference sets, write all files, and return a row per reference set and k."""
    dataset = Dataset.open(absolute(config.real) if config.real else home("datasets", "town"))
    output = absolute(config.output) if config.output else home("evaluations", "sweep")
    source = f"generated-{config.run}" if config.run else None
    sides = {
        "real": Selection(dataset.root, dataset.source, config.real_split),
        "generated": Selection(absolute(config.generated) if config.generated else home("generated"), source),
    }
    parts = {name: side.shards() for name, side in sides.items()}
    looks = Looks(config.supersample, config.inception and absolute(config.inception))
    start_ray()
    features = {}
    with Progress() as bar:
        for name, side in sides.items():
            task = bar.add_task(f"describe {name}", total=sum(len(rows) for _, rows in parts[name]))
            directory = storage.join(output, "described", name)
            described = describe(
                side, dataset, looks, directory, config.num_actors, lambda n, task=task: bar.advance(task, n)
            )
            features[name] = described["pool3" if config.inception else "random"]
        places = poses(*described_columns(parts["real"]))
        labels = label_pairs(described_columns(parts["generated"])[0])
        least, most = max(config.k) + 1, len(features["generated"])
        chosen = list(references(*places, config.reference_sizes, config.min_distances_m, least, most))
        task = bar.add_task("compare", total=len(chosen))
        rows = sweep(features["real"], features["generated"], labels, chosen, config.k, lambda: bar.advance(task))
    storage.write_json(rows, storage.join(output, "sweep.json"))
    storage.write_parquet(pa.Table.from_pylist(rows), storage.join(output, "sweep.parquet"))
    how = [
        f"Real: {dataset.root}, split {config.real_split}. "
        f"Generated: {sides['generated'].root}, labels in equal parts.",
        "Features: Inception pool3." if config.inception else "Features: a fixed untrained network's; no Inception.",
        "In brackets: 95 % intervals over the judged scenes, neighbourhoods held fixed.",
    ]
    texts = {"sweep.html": sweep_html(rows, how)}
    for name, chart in zip(("apart", "farthest"), sweep_charts(rows), strict=True):
        texts[f"sweep-{name}.svg"] = standalone_svg(chart)
    for name, text in texts.items():
        storage.write_text(text, storage.join(output, name))
    return rows


def main(config: Config) -> None:
    print_table(sweep_table(sweep_references(config)))
