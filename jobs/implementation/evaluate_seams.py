"""Implementation of jobs/evaluate_seams.py."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from jobs.evaluate_seams import Config
from jobs.support.cli import resolve_path
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from jobs.support.scores import publish_scores
from pipelines.evaluation.evaluate import convert_estimates
from pipelines.evaluation.seams import (
    COLUMNS,
    SeamLines,
    build_seams_table,
    join_scene_sets,
    measure_seams,
    render_seams_html,
    select_shown_rows,
)
from pipelines.runtime import storage
from pipelines.schema.scene_subset import SceneSubset

ENOUGH_SEAMS = 200
SHOWN = 6


def evaluate_seams(config: Config) -> dict:
    """Measure seams, write all files, and return the seam ratios, separately for generated and for real scenes."""
    output = resolve_path(config.output, "evaluations", "seams")
    source = f"generated-{config.run}" if config.run else None
    sides = {
        "generated": (
            SceneSubset(
                resolve_path(config.generated, "outpainted"),
                source,
                None,
                config.max_scenes,
            ),
            SeamLines(config.rows_m, config.cols_m),
        ),
        "real": (
            SceneSubset(
                resolve_path(config.real, "datasets", "town"),
                None,
                config.real_split,
                config.max_scenes,
            ),
            SeamLines(config.real_rows_m, ()),
        ),
    }
    for selection, _ in sides.values():
        selection.shards()  # raise an error for missing scenes before Ray starts
    with hold_output(output, "evaluation", config):
        with JobProgress() as bar:
            measured = {}
            for name, (selection, lines) in sides.items():
                task = bar.add_task(f"measure {name}", total=sum(len(rows) for _, rows in selection.shards()))
                measured[name] = measure_seams(selection, lines, config.num_actors, lambda task=task: bar.advance(task))
            real, lines = sides["real"]
            task = bar.add_task("measure unrelated halves", total=len(measured["real"].scene_ids))
            measured["joined"] = measure_seams(
                real, lines, config.num_actors, lambda: bar.advance(task), is_joined=True
            )
        scores = join_scene_sets(measured)
        storage.write_parquet(build_seams_table(measured), storage.join_uri(output, "seams.parquet"))
        html = render_seams_html(convert_estimates(scores), *sides["generated"], SHOWN)
        storage.write_text(html, storage.join_uri(output, "seams.html"))
        tags = {name: selection.root for name, (selection, _) in sides.items()}
        return publish_scores(output, scores, tags, ["seams.html"])


def main(config: Config) -> None:
    scores = evaluate_seams(config)
    lines = Table("seams / nearby lines", *(COLUMNS[side] for side in scores["scenes"]))
    for row in select_shown_rows(scores):
        lines.add_row(*row)
    Console().print(lines)
    if (count := scores["seams"]["generated"]) < ENOUGH_SEAMS:
        print(f"only {count} seams: a reliable result needs at least {ENOUGH_SEAMS}; outpaint more scenes")
