#!/usr/bin/env python3
"""Import meshes or voxel grids of another method for evaluation.

    jobs/import_scenes.py DIR --name theirs                     meshes in class colours, as the paper's authors publish
    jobs/import_scenes.py DIR/night-*.glb --name night --axes y+ z+ x+
    jobs/import_scenes.py DIR --format npz --name semcity       voxel grids of 256 x 256 x 32 or coarser

The job converts GLB meshes to scene tables with source=imported-<name>. The command evaluate_scenes --generated OUTPUT
scores the scenes. The job converts voxel grids to pictures from above in OUTPUT/<name>.npz (array arr_0, uint8). The
command evaluate_scenes --generated OUTPUT/<name>.npz scores the pictures. The table OUTPUT/rejects lists unreadable
files with the reason. The file formats are specified in docs/how_to/import_scenes.md. An axis is x (forward), y (left)
or z (up), with + or -. GLB files that this package exported contain their axes. Run the same command again to resume
after an interruption or to read repaired files.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from jobs.support.cli import run
from jobs.support.options import IfBusyOption, LogFormatOption


@dataclass(frozen=True)
class Config:
    files: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Files, directories to search recursively, or quoted patterns such as 'DIR/*.glb'."""
    name: str = "scenes"
    """Name of the import: scenes get source=imported-<name>."""
    format: Literal["glb", "npz"] = "glb"
    """File format: glb for semantic meshes, npz for voxel grids of class ids."""
    axes: tuple[str, str, str] | None = None
    """Directions of the axes in the files, such as x+ y- z- (default: x+ y- z- for meshes, x- y- z+ for voxels)."""
    output: str = ""
    """Dataset directory to write (default: $PRITTI_HOME/imported/<name>)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"


if __name__ == "__main__":
    run("import_scenes")
