#!/usr/bin/env python3
"""Export scenes for other programs, as meshes, voxels or OpenDRIVE roads.

    jobs/export_scenes.py --input DIR --formats glb xodr
    jobs/export_scenes.py --max-scenes 10 --formats ply npz --output DIR

glb: glTF 2.0, a named node per primitive with class, instance and exact parameters in its extras. ply: one mesh with
colours, class ids and primitive numbers per vertex. npz: 256 x 256 x 32 voxels of class ids, which import_scenes and
evaluate_voxels read. xodr: the roads as OpenDRIVE 1.7 with lanes, elevation and junctions, for simulators. Files are
written to OUTPUT/<format>/<scene_id>.<format>; existing files are kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jobs.support.cli import run
from jobs.support.options import SceneOptions


@dataclass(frozen=True)
class Config(SceneOptions):
    formats: tuple[Literal["glb", "ply", "npz", "xodr"], ...] = ("glb",)
    """File formats to write."""
    output: str = ""
    """Directory to write to (default: export/ in the input directory)."""
    overwrite: bool = False
    """Replace existing files."""


if __name__ == "__main__":
    run("export_scenes")
