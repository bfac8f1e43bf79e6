#!/usr/bin/env python3
"""Export scenes for other programs, as meshes, voxels, roads, polygons or scenarios.

    jobs/export_scenes.py --input DIR --formats glb xodr
    jobs/export_scenes.py --max-scenes 10 --formats ply npz --output DIR
    jobs/export_scenes.py --input DIR --formats xosc animation        with the traffic of simulate_traffic.py

A GLB file (glTF 2.0) has one named node per primitive. The extras of the node contain class, instance and exact
parameters. A PLY file has one mesh with a colour, class id and primitive number per vertex. An NPZ file has 256 x 256 x
32 voxels with class ids. The jobs import_scenes and evaluate_voxels read such files. An XODR file describes the roads
for simulators, as OpenDRIVE 1.7 with lanes, elevation and junctions. A GEOJSON file has polygons of the ground and
outlines of the primitives, seen from above. A GEOPARQUET file contains the same. A USD file (extra usd) has one prim
per primitive.

Two formats need the table tracks of simulate_traffic.py: XOSC (extra openscenario) describes the traffic and the
objects of a scene as OpenSCENARIO 1.2 and refers to an XODR file, which is also written. ANIMATION is a GLB file in
which the traffic moves. The job writes OUTPUT/<format>/<scene_id>.<extension> and keeps existing files.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jobs.support.cli import run
from jobs.support.options import IfBusyOption, LogFormatOption, SceneOptions


@dataclass(frozen=True)
class Config(SceneOptions):
    formats: tuple[Literal["glb", "ply", "npz", "xodr", "geojson", "geoparquet", "usd", "animation", "xosc"], ...] = (
        "glb",
    )
    """File formats to write."""
    tracks: str = ""
    """Dataset directory with the table tracks of the scenes, for animation and xosc (default: --input)."""
    output: str = ""
    """Directory to write to (default: export/ in the input directory)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    overwrite: bool = False
    """Replace existing files."""


if __name__ == "__main__":
    run("export_scenes")
