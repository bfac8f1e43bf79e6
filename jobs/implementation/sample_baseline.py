"""Implementation of jobs/sample_baseline.py."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image
from rich.progress import MofNCompleteColumn, Progress

from jobs.sample_baseline import Config
from jobs.support.cli import make_absolute, resolve_path
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from models.baselines.directory import read_index
from pipelines.generation.voxel_sample import VoxelSampleRequest, iterate_voxels, sample_voxels
from pipelines.io.voxel_import import draw_voxels
from pipelines.metrics.adm_npz import write_npz
from pipelines.rendering.render import arrange_contact_sheet
from pipelines.runtime import storage

SHEET_SCENES, SHEET_COLUMNS = 16, 4


def sample(config: Config) -> tuple[VoxelSampleRequest, dict]:
    """Run the method, and write pictures; return the request and the summary."""
    model = make_absolute(config.model)
    output = resolve_path(config.output, "generated-voxels")
    request = VoxelSampleRequest(
        model=model,
        output=output,
        run=config.run or f"{read_index(model)[0]}-{config.task}",
        task=config.task,
        num_scenes=config.num_scenes,
        seed=config.seed,
        dataset=make_absolute(config.input) if config.input else "",
        split=config.split,
        half=config.half,
        windows=config.windows,
        shard_scenes=min(32, max(1, -(-config.num_scenes // 8))),
    )
    with hold_output(output, request.source(), config):
        with JobProgress(*Progress.get_default_columns(), MofNCompleteColumn()) as bar:
            shown = bar.add_task(f"{config.task} scenes", total=config.num_scenes)
            summary = sample_voxels(
                request, config.num_actors, config.batch_size, lambda row: bar.advance(shown, row["scenes"])
            )
        write_pictures(request)
    return request, summary


def write_pictures(request: VoxelSampleRequest) -> None:
    """Write a contact sheet and an .npz of pictures seen from above."""
    pictures = [draw_voxels(voxels) for _, voxels in iterate_voxels(request.shards())]
    sheet = io.BytesIO()
    Image.fromarray(arrange_contact_sheet(pictures[:SHEET_SCENES], columns=SHEET_COLUMNS)).save(sheet, "PNG")
    storage.write_whole(
        storage.join_uri(request.output, f"{request.run}.png"), lambda stream: stream.write(sheet.getvalue())
    )
    write_npz(storage.join_uri(request.output, f"{request.run}.npz"), [np.stack(pictures)], len(pictures))


def main(config: Config) -> None:
    request, summary = sample(config)
    print(f"{config.num_scenes} scenes of source {request.source()} in {request.output}; {request.run}.png shows some")
    if summary["seconds_per_scene"] is not None:
        print(
            f"{summary['seconds_per_scene']:.2f} s per scene and actor, {summary['peak_bytes'] / 1e9:.2f} GB of memory"
        )
