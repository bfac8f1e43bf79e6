"""Implementation of jobs/sweep_seams.py."""

from __future__ import annotations

import pyarrow as pa
from rich.progress import Progress

from jobs.support.cli import absolute, home, require_positive
from jobs.support.model_directories import pipeline_directory
from jobs.support.ray_session import start_ray
from jobs.support.scene_requests import select_scenes
from jobs.support.terminal import print_table
from jobs.sweep_seams import Config
from models.pipeline import Resampling
from models.sampling.diffusion import Diffusion
from pipelines.evaluation.seam_sweep import objects_per_ha, seam_row, seam_sweep_html, seam_table
from pipelines.evaluation.seams import Lines, measure, with_lines
from pipelines.generation.outpaint import OutpaintRequest, outpaint_scenes
from pipelines.metrics.seams import seam_ratios
from pipelines.reporting.report import Picture
from pipelines.runtime import storage
from pipelines.schema.scene_subset import Selection
from pipelines.schema.tables import read_scenes


def sweep_seams(config: Config) -> list[dict]:
    """Outpaint and measure every setting, write all files, and return a row per setting."""
    require_positive(config, "num_actors", "batch_size")
    model = pipeline_directory(config.model)
    if not config.settings:
        raise ValueError("--settings is empty: expected five numbers per setting")

    for setting in config.settings:
        Resampling(*setting).transitions()  # raises for an invalid setting before hours of valid ones
        Diffusion().visited(setting[0])
    output = absolute(config.output) if config.output else home("evaluations", "sweep-seams")
    selection = select_scenes(config)
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
                mode=config.neighbour_latents,
                resampling=Resampling(*setting),
                guidance_scale=config.guidance_scale,
                batch_size=config.batch_size,
            )
            done = bar.add_task(f"{name}, blocks", total=8 * count)
            outpaint_scenes(request, selection, config.num_actors, lambda blocks, task=done: bar.advance(task, blocks))
            measured = measure(Selection(output, request.source), Lines(), config.num_actors)
            objects = objects_per_ha(read_scenes(output, request.source))
            seams = int(measured.seams.sum())
            rows.append(seam_row(request.resampling, seams, objects, seam_ratios(measured.records)))
            first = next(read_scenes(output, request.source))
            pictures.append(Picture(first.scene_id, with_lines(first, Lines()), name))
    storage.write_json(rows, storage.join(output, "sweep.json"))
    storage.write_parquet(pa.Table.from_pylist(rows), storage.join(output, "sweep.parquet"))
    how = [
        f"{count} scenes of {selection.root}, overlap {config.overlap:g}, {config.neighbour_latents}. Model: {model}."
    ]
    html = seam_sweep_html(rows, pictures, how)
    storage.write_text(html, storage.join(output, "sweep.html"))
    return rows


def main(config: Config) -> None:
    print_table(seam_table(sweep_seams(config)))
