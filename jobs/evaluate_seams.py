#!/usr/bin/env python3
"""Do the lines between pasted and generated parts show? Outpainted scenes against lines nearby, and real scenes likewise.

    jobs/evaluate_seams.py --generated DIR                               scenes of jobs/outpaint_scenes.py
    jobs/evaluate_seams.py --generated DIR --rows-m 32 96 --cols-m 32 96
    jobs/evaluate_seams.py --generated DIR --real DIR --real-rows-m 16 32 48

A ratio of 1 means that a line does not show: as many changes of class, as great steps of height, as many cut and doubled
objects as on parallel lines 4 to 16 m away. Real scenes, cut across the street, give the level to compare with. Lines
along the vehicle's own street are no fair ones there: a street has its borders at its sides.

Writes metrics.json, metrics.parquet, seams.parquet (a row per scene) and seams.html, and to MLflow. At least 200 seams make a result.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import absolute, home, run, start_ray

ENOUGH_SEAMS = 200
SHOWN = 6


@dataclass(frozen=True)
class Config:
    generated: str = ""
    """Dataset directory of the outpainted scenes (default: $PRITTI_HOME/outpainted)."""
    run: str = ""
    """Only source generated-<run> (default: whatever is there)."""
    rows_m: tuple[float, ...] = ()
    """Seams across the drive, in metres from a scene's far edge (default: where its middle 64 m begin and end)."""
    cols_m: tuple[float, ...] = ()
    """Seams along the drive, in metres from a scene's left edge (default: likewise)."""
    real: str = ""
    """Dataset directory of real scenes (default: $PRITTI_HOME/datasets/town)."""
    real_split: str = "test"
    real_rows_m: tuple[float, ...] = (16.0, 32.0, 48.0)
    """Lines across the drive at which real scenes are looked at."""
    limit: int | None = None
    """At most so many scenes on each side, spread evenly."""
    output: str = ""
    """Where everything goes (default: $PRITTI_HOME/evaluations/seams)."""
    actors: int = 2


def evaluate_seams(config: Config) -> dict:
    """Score, write and return the ratios of both sides."""
    from rich.progress import Progress

    from jobs.support.tracking import publish_scores
    from pipelines.evaluation.evaluate import plain
    from pipelines.evaluation.seams import Lines, join_sides, measure, seams_html, seams_table
    from pipelines.runtime import storage
    from pipelines.schema.scene_subset import Selection

    output = absolute(config.output) if config.output else home("evaluations", "seams")
    source = f"generated-{config.run}" if config.run else None
    sides = {
        "generated": (
            Selection(
                absolute(config.generated) if config.generated else home("outpainted"), source, None, config.limit
            ),
            Lines(config.rows_m, config.cols_m),
        ),
        "real": (
            Selection(
                absolute(config.real) if config.real else home("datasets", "town"),
                None,
                config.real_split,
                config.limit,
            ),
            Lines(config.real_rows_m, ()),
        ),
    }
    for selection, _ in sides.values():
        selection.shards()  # what is not there is said before anything starts
    start_ray()
    with Progress() as bar:
        measured = {}
        for name, (selection, lines) in sides.items():
            task = bar.add_task(f"look at {name}", total=sum(len(rows) for _, rows in selection.shards()))
            measured[name] = measure(selection, lines, config.actors, lambda task=task: bar.advance(task))
    scores = join_sides(measured)
    storage.write_parquet(seams_table(measured), storage.join(output, "seams.parquet"))
    html = seams_html(plain(scores), *sides["generated"], SHOWN)
    storage.write_text(html, storage.join(output, "seams.html"))
    tags = {name: selection.root for name, (selection, _) in sides.items()}
    return publish_scores(output, scores, tags, ["seams.html"])


def main(config: Config) -> None:
    from rich.console import Console
    from rich.table import Table

    from pipelines.evaluation.seams import shown_rows

    scores = evaluate_seams(config)
    lines = Table("across seams over nearby lines", "generated", "real")
    for row in shown_rows(scores):
        lines.add_row(*row)
    Console().print(lines)
    if (count := scores["seams"]["generated"]) < ENOUGH_SEAMS:
        print(f"only {count} seams: fewer than {ENOUGH_SEAMS} say little; outpaint more scenes")


if __name__ == "__main__":
    run(main, Config, description=__doc__)
