#!/usr/bin/env python3
"""Score generated scenes against real ones, and an LVAE's reconstructions against the truth, from the tables alone.

    jobs/evaluate_scenes.py --real DIR --generated DIR
    jobs/evaluate_scenes.py --real DIR --generated DIR --inception weights-inception-2015-12-05-6726825d.pth
    jobs/evaluate_scenes.py --real DIR --lvae MODEL

Writes metrics.json and metrics.parquet, and with --lvae also reconstruction.html, with the best and worst scenes, and
reconstruction.parquet, a row per scene; all of it goes to MLflow too. FID, IS, precision and recall need local
Inception weights; without them distances of layout statistics and of a fixed random network are given, under their own
names.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from jobs.command import absolute, home, run, start_ray

if TYPE_CHECKING:
    from rich.progress import Progress

    from pipelines.evaluate import Selection

METRICS_PER_CALL = 1000  # MLflow's limit
DETAILS = (".statistics.", "category_", "class_", "ap3d_at", ".truths.")  # in the files, not on the screen


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
    voxel_range_m: tuple[float, float] = (-1.5, 6.5)
    """Lowest and highest z of the 256 x 256 x 32 voxels."""
    pictures: int = 3
    """So many of the best and of the worst reconstructed scenes to show."""
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
    from pipelines.evaluate import Selection, compare, describe, flattened

    if config.pictures < 0:
        raise ValueError(f"--pictures is {config.pictures}, expected 0 or more")
    dataset = Dataset.open(absolute(config.real) if config.real else home("datasets", "town"))
    real = Selection(dataset.root, dataset.source, config.real_split, config.limit)
    wanted = config.generated or ("" if config.lvae else home("generated"))
    output = absolute(config.output) if config.output else home("evaluations", config.run or "latest")
    scores: dict = {}
    start_ray()
    with Progress() as bar:

        def described(selection: Selection, name: str) -> dict:
            shown = bar.add_task(name, total=sum(len(rows) for _, rows in selection.shards()))
            return describe(selection, dataset, config.inception or None, config.actors, lambda: bar.advance(shown))

        if config.lvae:
            scores["reconstruction"] = reconstruction(config, real, output, bar)
        if wanted:
            source = f"generated-{config.run}" if config.run else None
            generated = Selection(absolute(wanted), source, config.generated_split or None, config.limit)
            sides = described(real, "describe real"), described(generated, "describe generated")
            scores["generation"] = compare(*sides, dataset, config.k)
    storage.write_json(scores, storage.join(output, "metrics.json"))
    flat = flattened(scores)
    table = pa.table({"metric": list(flat), "value": list(flat.values())})
    storage.write_parquet(table, storage.join(output, "metrics.parquet"))
    tags = {
        "real": dataset.root,
        "split": config.real_split,
        "generated": wanted,
        "lvae": config.lvae and absolute(config.lvae),
    }
    track(output, tags, flat, ["metrics.json"] + (["reconstruction.html"] if config.lvae else []))
    return scores


def reconstruction(config: Config, real: Selection, output: str, bar: Progress) -> dict:
    """Scores; writes reconstruction.parquet, a row per scene, and reconstruction.html with the best and worst of them."""
    from pipelines import storage
    from pipelines.rebuild import draw, rebuild
    from pipelines.reconstruction_report import reconstruction_html

    lvae = absolute(config.lvae)
    shown = bar.add_task("reconstruct", total=sum(len(rows) for _, rows in real.shards()))
    rebuilt = rebuild(
        real, lvae, config.actors, voxel_range_m=config.voxel_range_m, on_scene=lambda: bar.advance(shown)
    )
    storage.write_parquet(rebuilt.scenes, storage.join(output, "reconstruction.parquet"))
    count = min(config.pictures, len(rebuilt.places) // 2)
    drawn = []
    if count:
        chosen = rebuilt.places[:count] + rebuilt.places[-count:]
        drawing = bar.add_task("draw best and worst", total=len(chosen))
        drawn = draw(chosen, lvae, config.actors, lambda: bar.advance(drawing))
    subtitle = f"{lvae} on {rebuilt.scores['scenes']} scenes of {real.root}, split {real.split}"
    html = reconstruction_html(rebuilt.scores, rebuilt.scenes, drawn[:count], drawn[count:][::-1], subtitle)
    storage.write_whole(storage.join(output, "reconstruction.html"), lambda stream: stream.write(html.encode()))
    return rebuilt.scores


def track(output: str, tags: dict[str, str], metrics: dict[str, float], files: list[str]) -> None:
    """Metrics, tags and files of `output` to MLflow: one run per output directory, brought up to date."""
    from jobs.tracking import Tracker
    from pipelines import storage

    name = output.rstrip("/").rsplit("/", 1)[-1]
    tracker = Tracker.start("pritti-evaluation", name, {}, storage.join(output, "mlflow.json"))
    for key, value in tags.items():
        tracker.client.set_tag(tracker.run_id, key, value)
    names = list(metrics)
    for start in range(0, len(names), METRICS_PER_CALL):
        tracker.metrics({name: metrics[name] for name in names[start : start + METRICS_PER_CALL]}, step=0)
    if "://" not in output:  # MLflow takes local files only
        for file in files:
            tracker.client.log_artifact(tracker.run_id, storage.join(output, file))
    tracker.finish("FINISHED")


def main(config: Config) -> None:
    from rich.console import Console
    from rich.table import Table

    from pipelines.evaluate import flattened

    scores = evaluate(config)
    shown = Table("metric", "value")
    for name, value in flattened(scores).items():
        if not any(part in name for part in DETAILS):
            shown.add_row(name, f"{value:.4g}")
    Console().print(shown)


if __name__ == "__main__":
    run(main, Config, description=__doc__)
