#!/usr/bin/env python3
"""Score generated scenes against real ones, and an LVAE's reconstructions against the truth, from the tables alone.

    jobs/evaluate_scenes.py --real DIR --generated DIR
    jobs/evaluate_scenes.py --real DIR --generated DIR --inception weights-inception-2015-12-05-6726825d.pth
    jobs/evaluate_scenes.py --real DIR --lvae MODEL

Writes metrics.json and metrics.parquet. FID, IS, precision and recall need local Inception weights; without them
distances of layout statistics and of a fixed random network are given, under their own names.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.command import absolute, home, run, start_ray


@dataclass(frozen=True)
class Config:
    real: str = ""
    """Dataset directory of the real scenes (default: $PRITTI_HOME/datasets/town)."""
    real_split: str = "test"
    """Split to compare with; the paper takes train as its reference."""
    generated: str = ""
    """Dataset directory of the generated scenes (default with neither --lvae nor this: $PRITTI_HOME/generated)."""
    generated_split: str = ""
    """Only this split of them (default: whatever is there); --generated may be any dataset directory."""
    run: str = ""
    """Only source generated-<run> (default: whatever is there)."""
    lvae: str = ""
    """Also score this LVAE's reconstruction of the real scenes."""
    limit: int | None = None
    """At most so many scenes on each side, spread evenly."""
    inception: str = ""
    """Local Inception weights (pt_inception-2015-12-05) for FID, IS, precision and recall."""
    k: tuple[int, ...] = (3,)
    """Neighbourhood sizes of precision and recall."""
    output: str = ""
    """Where metrics.json and metrics.parquet go (default: $PRITTI_HOME/evaluations/<run or 'latest'>)."""
    actors: int = 2


def evaluate(config: Config) -> dict:
    """Score, write and return the nested metrics."""
    import pyarrow as pa
    from rich.progress import Progress

    from pipelines import storage
    from pipelines.dataset import Dataset
    from pipelines.evaluate import Selection, compare, describe, flattened, rebuild

    dataset = Dataset.open(absolute(config.real) if config.real else home("datasets", "town"))
    real = Selection(dataset.root, dataset.source, config.real_split, config.limit)
    wanted = config.generated or ("" if config.lvae else home("generated"))
    scores: dict = {}
    start_ray()
    with Progress() as bar:

        def described(selection: Selection, name: str) -> dict:
            shown = bar.add_task(name, total=sum(len(rows) for _, rows in selection.shards()))
            return describe(selection, dataset, config.inception or None, config.actors, lambda: bar.advance(shown))

        if config.lvae:
            shown = bar.add_task("reconstruct", total=sum(len(rows) for _, rows in real.shards()))
            scores["reconstruction"] = rebuild(
                real, absolute(config.lvae), config.actors, on_scenes=lambda n: bar.advance(shown, n)
            )
        if wanted:
            source = f"generated-{config.run}" if config.run else None
            generated = Selection(absolute(wanted), source, config.generated_split or None, config.limit)
            sides = described(real, "describe real"), described(generated, "describe generated")
            scores["generation"] = compare(*sides, dataset, config.k)
    output = absolute(config.output) if config.output else home("evaluations", config.run or "latest")
    storage.write_json(scores, storage.join(output, "metrics.json"))
    flat = flattened(scores)
    table = pa.table({"metric": list(flat), "value": list(flat.values())})
    storage.write_parquet(table, storage.join(output, "metrics.parquet"))
    return scores


def main(config: Config) -> None:
    from rich.console import Console
    from rich.table import Table

    from pipelines.evaluate import flattened

    scores = evaluate(config)
    shown = Table("metric", "value")
    for name, value in flattened(scores).items():
        if ".statistics." not in name:
            shown.add_row(name, f"{value:.4g}")
    Console().print(shown)


if __name__ == "__main__":
    run(main, Config, description=__doc__)
