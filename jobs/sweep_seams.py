#!/usr/bin/env python3
"""What does outpainting need? The same scenes extended with many and few steps and resamplings, and guided; their seams.

    jobs/sweep_seams.py --limit 50                                          50 generated scenes, 200 seams a setting
    jobs/sweep_seams.py --limit 50 --settings 250 10 10 0 1 50 1 1 1 0      steps, jump length, resamplings, guidance by
                                                                            what is known and eta, in fives

The paper's is 250 10 10 0 1: 2,410 network evaluations a block. Writes the scenes (source=generated-<the five numbers>),
sweep.json, sweep.parquet and sweep.html. Run it again with the same options to go on after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jobs.support.cli import absolute, home, print_table, require_positive, run, start_ray
from jobs.support.options import GivenScenes, pipeline_directory


@dataclass(frozen=True)
class Config(GivenScenes):
    settings: tuple[tuple[int, int, int, float, float], ...] = (
        (250, 10, 10, 0, 1), (250, 5, 5, 0, 1), (250, 1, 1, 0, 1), (50, 10, 10, 0, 1), (50, 5, 5, 0, 1), (50, 1, 1, 0, 1),
        (50, 1, 1, 1, 1), (50, 1, 1, 1, 0),
    )  # fmt: skip
    """Steps, jump length, resamplings, known guidance and eta (1: steps with DDPM's noise, 0: without), in fives."""
    overlap: float = 0.5
    """Of neighbouring blocks."""
    mode: Literal["reencode", "copy"] = "reencode"
    """How a block knows its neighbours: encoded anew in its own frame, or the shifted latent (the paper)."""
    output: str = ""
    """Where everything goes (default: $PRITTI_HOME/evaluations/sweep-seams)."""
    batch_size: int = 4
    """Blocks of a scene to make at once."""


def sweep_seams(config: Config) -> list[dict]:
    """Outpaint, measure, write and return a row per setting."""
    require_positive(config, "actors", "batch_size")
    model = pipeline_directory(config.model)
    if not config.settings:
        raise ValueError("no --settings: expected steps, jump length, resamplings, known guidance and eta, in fives")
    import pyarrow as pa
    from rich.progress import Progress

    from models.pipeline import Resampling
    from models.sampling.diffusion import Diffusion
    from pipelines.evaluation.seam_sweep import objects_per_ha, seam_row, seam_sweep_html
    from pipelines.evaluation.seams import Lines, measure, with_lines
    from pipelines.generation.outpaint import OutpaintRequest, outpaint_scenes
    from pipelines.metrics.seams import seam_ratios
    from pipelines.reporting.report import Picture
    from pipelines.runtime import storage
    from pipelines.schema.scene_subset import Selection
    from pipelines.schema.tables import read_scenes

    for setting in config.settings:
        Resampling(*setting).transitions()  # numbers that cannot be had are said before hours of the others
        Diffusion().visited(setting[0])
    output = absolute(config.output) if config.output else home("evaluations", "sweep-seams")
    selection = config.selection()
    count = sum(len(rows) for _, rows in selection.shards())
    rows, pictures = [], []
    start_ray()
    with Progress() as bar:
        for setting in config.settings:
            name = "-".join(f"{value:g}" for value in setting)
            request = OutpaintRequest(
                model=model,
                output=output,
                run=name,
                label=config.label or None,
                seed=config.seed,
                overlap=config.overlap,
                mode=config.mode,
                resampling=Resampling(*setting),
                guidance_scale=config.guidance,
                batch_size=config.batch_size,
            )
            done = bar.add_task(f"{name}, blocks", total=8 * count)
            outpaint_scenes(request, selection, config.actors, lambda blocks, task=done: bar.advance(task, blocks))
            measured = measure(Selection(output, request.source), Lines(), config.actors)
            objects = objects_per_ha(read_scenes(output, request.source))
            seams = int(measured.seams.sum())
            rows.append(seam_row(request.resampling, seams, objects, seam_ratios(measured.records)))
            first = next(read_scenes(output, request.source))
            pictures.append(Picture(first.scene_id, with_lines(first, Lines()), name))
    storage.write_json(rows, storage.join(output, "sweep.json"))
    storage.write_parquet(pa.Table.from_pylist(rows), storage.join(output, "sweep.parquet"))
    how = [f"{count} scenes of {selection.root}, overlap {config.overlap:g}, {config.mode}. Model: {model}."]
    html = seam_sweep_html(rows, pictures, how)
    storage.write_text(html, storage.join(output, "sweep.html"))
    return rows


def main(config: Config) -> None:
    from pipelines.evaluation.seam_sweep import seam_table

    print_table(seam_table(sweep_seams(config)))


if __name__ == "__main__":
    run(main, Config, description=__doc__)
