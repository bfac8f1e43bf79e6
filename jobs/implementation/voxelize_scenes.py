"""Implementation of jobs/voxelize_scenes.py."""

from __future__ import annotations

import numpy as np

from jobs.support.cli import make_absolute
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from jobs.support.scene_requests import select_scenes
from jobs.voxelize_scenes import Config
from models.voxel_grids import COARSE_FACTORS, Factor, name_voxel_column
from pipelines.preprocess.voxel_tables import VoxelRequest, voxelize_dataset
from pipelines.runtime import storage

NAMES = {name_voxel_column(factor).removeprefix("voxels_"): factor for factor in COARSE_FACTORS}


def parse_factors(names: tuple[str, ...]) -> tuple[Factor, ...]:
    """Return the factors of --coarse-voxels in the order of the columns.

    Raises:
        ValueError: A name is unknown.
    """
    for name in names:
        if name not in NAMES:
            raise ValueError(f"--coarse-voxels {name}: expected some of {', '.join(NAMES)}")
    return tuple(factor for name, factor in NAMES.items() if name in names)


def main(config: Config) -> None:
    factors = parse_factors(config.coarse_voxels)
    selection = select_scenes(config)
    output = make_absolute(config.output) if config.output else selection.root
    request = VoxelRequest(output, *config.voxel_range_m, factors=factors)
    with hold_output(output, "voxels", config), JobProgress() as bar:
        shown = bar.add_task("voxelize", total=sum(len(rows) for _, rows in selection.shards()))
        shards = voxelize_dataset(request, selection, lambda count: bar.advance(shown, count))
    scenes = sum(len(rows) for _, rows in selection.shards())
    size = np.sum([storage.measure_file_bytes(shard.path("voxels")) for shard in shards]) / max(scenes, 1)
    print(f"voxels of {scenes} scenes in {output}, {size / 1e3:.1f} kB per scene")
