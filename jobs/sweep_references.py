#!/usr/bin/env python3
"""Precision and recall against the choice of real scenes: how many, and by which poses (the paper's figure).

    jobs/sweep_references.py --real DIR --generated DIR
    jobs/sweep_references.py --real DIR --generated DIR --sizes 1000 5000 10000 --apart-m 1 2 5 10 --k 3 5
    jobs/sweep_references.py --real DIR --generated DIR --inception weights-inception-2015-12-05-6726825d.pth

Every scene of both sides is described once; then each reference is set against as many generated scenes, labels in
equal parts. References larger than the generated side are left out. Writes sweep.json, sweep.parquet, two figures (SVG)
and sweep.html. Run it again with the same options to go on after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import absolute, home, print_table, run, start_ray


@dataclass(frozen=True)
class Config:
    real: str = ""
    """Dataset directory of the real scenes (default: $PRITTI_HOME/datasets/town)."""
    real_split: str = "train"
    generated: str = ""
    """Dataset directory of the generated scenes (default: $PRITTI_HOME/generated)."""
    run: str = ""
    """Only source generated-<run> (default: whatever is there)."""
    sizes: tuple[int, ...] = (250, 500, 1000, 2500, 5000, 10_000)
    """Numbers of scenes with poses as far apart as can be; the paper takes 1000, 5000 and 10000."""
    apart_m: tuple[float, ...] = (1, 2, 5, 10, 20, 50)
    """Least distances of poses, in metres; the paper goes from 1 to 10."""
    k: tuple[int, ...] = (3, 5)
    """Neighbourhood sizes; the paper's 3 and 5."""
    supersample: int = 1
    """Draw each pixel of a picture as the mean of so many squared."""
    inception: str = ""
    """Local Inception weights (pt_inception-2015-12-05); without them an untrained network looks."""
    output: str = ""
    """Where everything goes (default: $PRITTI_HOME/evaluations/sweep)."""
    actors: int = 2


def sweep_references(config: Config) -> list[dict]:
    """Score, write and return a row per reference and k."""
    import pyarrow as pa
    from rich.progress import Progress

    from pipelines.evaluation.features import Looks, describe
    from pipelines.evaluation.reference_sweep import references, sweep, sweep_charts, sweep_html
    from pipelines.reporting.chart import standalone_svg
    from pipelines.runtime import storage
    from pipelines.schema.dataset import Dataset
    from pipelines.schema.scene_subset import Selection, described_columns, label_pairs, poses

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
                side, dataset, looks, directory, config.actors, lambda n, task=task: bar.advance(task, n)
            )
            features[name] = described["pool3" if config.inception else "random"]
        places = poses(*described_columns(parts["real"]))
        labels = label_pairs(described_columns(parts["generated"])[0])
        least, most = max(config.k) + 1, len(features["generated"])
        chosen = list(references(*places, config.sizes, config.apart_m, least, most))
        task = bar.add_task("compare", total=len(chosen))
        rows = sweep(features["real"], features["generated"], labels, chosen, config.k, lambda: bar.advance(task))
    storage.write_json(rows, storage.join(output, "sweep.json"))
    storage.write_parquet(pa.Table.from_pylist(rows), storage.join(output, "sweep.parquet"))
    how = [
        f"Real: {dataset.root}, split {config.real_split}. Generated: {sides['generated'].root}, labels in equal parts.",
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
    from pipelines.evaluation.reference_sweep import sweep_table

    print_table(sweep_table(sweep_references(config)))


if __name__ == "__main__":
    run(main, Config, description=__doc__)
