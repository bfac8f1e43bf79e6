"""Implementation of jobs/evaluate_seams.py."""

from __future__ import annotations

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from jobs.evaluate_seams import Config
from jobs.support.cli import absolute, home
from jobs.support.ray_session import start_ray
from jobs.support.scores import publish_scores
from pipelines.evaluation.evaluate import plain
from pipelines.evaluation.seams import Lines, join_sides, measure, seams_html, seams_table, shown_rows
from pipelines.runtime import storage
from pipelines.schema.scene_subset import Selection

ENOUGH_SEAMS = 200
SHOWN = 6


def evaluate_seams(config: Config) -> dict:
    """Measure seams, write all files, and return the ratios of both sides."""
    output = absolute(config.output) if config.output else home("evaluations", "seams")
    source = f"generated-{config.run}" if config.run else None
    sides = {
        "generated": (
            Selection(
                absolute(config.generated) if config.generated else home("outpainted"), source, None, config.max_scenes
            ),
            Lines(config.rows_m, config.cols_m),
        ),
        "real": (
            Selection(
                absolute(config.real) if config.real else home("datasets", "town"),
                None,
                config.real_split,
                config.max_scenes,
            ),
            Lines(config.real_rows_m, ()),
        ),
    }
    for selection, _ in sides.values():
        selection.shards()  # raises for missing scenes before Ray starts
    start_ray()
    with Progress() as bar:
        measured = {}
        for name, (selection, lines) in sides.items():
            task = bar.add_task(f"measure {name}", total=sum(len(rows) for _, rows in selection.shards()))
            measured[name] = measure(selection, lines, config.num_actors, lambda task=task: bar.advance(task))
    scores = join_sides(measured)
    storage.write_parquet(seams_table(measured), storage.join(output, "seams.parquet"))
    html = seams_html(plain(scores), *sides["generated"], SHOWN)
    storage.write_text(html, storage.join(output, "seams.html"))
    tags = {name: selection.root for name, (selection, _) in sides.items()}
    return publish_scores(output, scores, tags, ["seams.html"])


def main(config: Config) -> None:
    scores = evaluate_seams(config)
    lines = Table("seams / nearby lines", "generated", "real")
    for row in shown_rows(scores):
        lines.add_row(*row)
    Console().print(lines)
    if (count := scores["seams"]["generated"]) < ENOUGH_SEAMS:
        print(f"only {count} seams: a result needs at least {ENOUGH_SEAMS}; outpaint more scenes")
