"""Implementation of jobs/sweep_seams.py."""

from __future__ import annotations

from itertools import product

import pyarrow as pa

from jobs.support.cli import require_positive, resolve_path
from jobs.support.model_directories import find_pipeline_directory, is_inpainting_model
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from jobs.support.scene_requests import select_scenes
from jobs.support.terminal import print_table
from jobs.sweep_seams import Config
from models.sampling.diffusion import Diffusion
from models.sampling.repaint import InpaintingConfig, RePaintConfig, TrainedInpainting
from pipelines.evaluation.seam_sweep import (
    build_seam_table,
    count_objects_per_ha,
    make_seam_row,
    render_seam_sweep_html,
)
from pipelines.evaluation.seams import COLUMNS, SeamLines, draw_lines, measure_seams
from pipelines.generation.outpaint import OutpaintRequest, outpaint_scenes
from pipelines.metrics.seams import estimate_seam_ratios
from pipelines.reporting.report import Picture
from pipelines.runtime import storage
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import read_scenes


def sweep_seams(config: Config) -> list[dict]:
    """Outpaint and measure every setting, write all files, and return a row per setting."""
    require_positive(config, "num_actors", "batch_size")
    model = find_pipeline_directory(config.model)
    if not (config.settings or config.trained_steps) or not config.neighbour_latents:
        raise ValueError("--settings or --neighbour-latents is empty: expected five numbers per setting, and a way")
    if config.trained_steps and not is_inpainting_model(model):
        raise ValueError(f"--trained-steps: {model} is no inpainting model")

    for setting in config.settings:
        RePaintConfig(*setting).transitions()  # raise an error for an invalid setting before hours of outpainting
        Diffusion().select_timesteps(setting[0])
    settings: dict[str, InpaintingConfig] = {
        "-".join(f"{value:g}" for value in setting): RePaintConfig(*setting) for setting in config.settings
    }
    settings |= {f"trained-{steps}": TrainedInpainting(steps) for steps in config.trained_steps}
    output = resolve_path(config.output, "evaluations", "sweep-seams")
    selection = select_scenes(config)
    count = sum(len(rows) for _, rows in selection.shards())
    real = SceneSubset(resolve_path(config.real, "datasets", "town"), None, config.real_split, config.max_real_scenes)
    real.shards()  # raise an error for missing scenes before hours of outpainting
    rows, pictures = [], []
    with hold_output(output, "evaluation", config):
        with JobProgress() as bar:
            for mode, (name, repaint) in product(config.neighbour_latents, settings.items()):
                name += "" if mode == "reencode" else f"-{mode}"
                request = OutpaintRequest(
                    model=model,
                    output=output,
                    run=name,
                    label=config.label or None,
                    seed=config.seed,
                    overlap=config.overlap,
                    mode=mode,
                    repaint=repaint,
                    guidance_scale=config.guidance_scale,
                    constraints=config.constraints,
                    batch_size=config.batch_size,
                )
                done = bar.add_task(f"{name}, blocks", total=8 * count)
                outpaint_scenes(
                    request, selection, config.num_actors, lambda blocks, task=done: bar.advance(task, blocks)
                )
                measured = measure_seams(SceneSubset(output, request.source), SeamLines(), config.num_actors)
                objects = count_objects_per_ha(read_scenes(output, request.source))
                seams = int(measured.seams.sum())
                rows.append(make_seam_row(mode, repaint, seams, objects, estimate_seam_ratios(measured.records)))
                first = next(read_scenes(output, request.source))
                pictures.append(Picture(first.scene_id, draw_lines(first, SeamLines()), name))
            objects = count_objects_per_ha(scene for shard, chosen in real.shards() for scene in shard.scenes(chosen))
            for key, name in enumerate(("real", "joined")):
                measured = measure_seams(
                    real, SeamLines(config.real_rows_m), config.num_actors, is_joined=name == "joined"
                )
                ratios = estimate_seam_ratios(measured.records, key)
                rows.append(make_seam_row(COLUMNS[name], None, int(measured.seams.sum()), objects, ratios))
        storage.write_json(rows, storage.join_uri(output, "sweep.json"))
        storage.write_parquet(pa.Table.from_pylist(rows), storage.join_uri(output, "sweep.parquet"))
        how = [f"{count} scenes of {selection.root}, overlap {config.overlap:g}. Model: {model}."]
        html = render_seam_sweep_html(rows, pictures, how)
        storage.write_text(html, storage.join_uri(output, "sweep.html"))
        return rows


def main(config: Config) -> None:
    print_table(build_seam_table(sweep_seams(config)))
