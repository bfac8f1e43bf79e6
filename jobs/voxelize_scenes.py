#!/usr/bin/env python3
"""Convert scenes to semantic voxels for the voxel models of train_baseline.py.

    jobs/voxelize_scenes.py --input $PRITTI_HOME/datasets/town                all scenes of a dataset
    jobs/voxelize_scenes.py --input DIR --split test --coarse-voxels 2x2x2    fine voxels, and those of twice the size

The job writes the table voxels next to the scenes (docs/reference/tables.md): 256 x 256 x 32 voxels for a scene of 64 x
64 m, and grids of coarser voxels. PDD reads 1x1x2, 4x4x4 and 8x8x8; XCube reads the fine voxels and 4x4x4. Run the same
command again to resume after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import run
from jobs.support.options import IfBusyOption, LogFormatOption, SceneOptions


@dataclass(frozen=True)
class Config(SceneOptions):
    voxel_range_m: tuple[float, float] = (-1.5, 6.5)
    """Lowest and highest z of the voxels in the scene frame, in metres. The range has 32 levels."""
    coarse_voxels: tuple[str, ...] = ("1x1x2", "2x2x2", "4x4x4", "8x8x8")
    """Sizes of coarse voxels to write, too, in fine voxels along rows, columns and levels."""
    output: str = ""
    """Dataset directory to write (default: --input)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"


if __name__ == "__main__":
    run("voxelize_scenes")
