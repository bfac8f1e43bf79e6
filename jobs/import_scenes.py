#!/usr/bin/env python3
"""Bring another method's scenes: meshes -> scene tables, voxel grids -> pictures from above, both for evaluate_scenes.

    jobs/import_scenes.py DIR --name theirs                     meshes in class colours, as the paper's authors publish
    jobs/import_scenes.py 'DIR/night-*.glb' --name night --axes y+ z+ x+
    jobs/import_scenes.py DIR --format npz --name semcity       voxel grids of 256 x 256 x 32, 128 x 128 x 16, 64 x 64 x 8

GLB meshes become source=imported-<name>: score them by evaluate_scenes --generated OUTPUT. Voxel grids become
OUTPUT/<name>.npz, uint8 pictures as arr_0: evaluate_scenes --generated OUTPUT/<name>.npz. Files that cannot be read are
listed with the reason in OUTPUT/rejects. docs/imports.md says what files must hold. Run it again with the same options
to go on after an interruption, or to read repaired files.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from jobs.support.cli import absolute, home, run, start_ray


@dataclass(frozen=True)
class Config:
    files: Annotated[str, tyro.conf.Positional]
    """Directory, searched with its subdirectories, or a quoted pattern such as 'DIR/*.glb'."""
    name: str = "scenes"
    """Name of the import: scenes get source=imported-<name>."""
    format: Literal["glb", "npz"] = "glb"
    """glb: semantic meshes. npz: voxel grids of class ids."""
    axes: tuple[str, str, str] | None = None
    """Where the files' three axes point: x forward, y left, z up, + or the other way (default: x+ y- z- for meshes, the
    authors' frame; x- y- z+ for voxels). Our own GLB files know theirs."""
    output: str = ""
    """Dataset directory (default: $PRITTI_HOME/imported/<name>)."""


def import_scenes(config: Config) -> tuple[str, dict]:
    """Import and return what to give to evaluate_scenes --generated, and the content of imported-<name>.json."""
    from rich.progress import Progress

    from pipelines.io.mesh_import import AUTHORS_AXES
    from pipelines.io.voxel_import import VOXEL_AXES
    from pipelines.preprocess.import_external import ImportRequest, find_files, import_files
    from pipelines.schema.axis_convention import scene_from_axes

    if not config.name or set(config.name) & set("/=\\"):
        raise ValueError(f"--name is {config.name!r}, expected a word without slashes")
    axes = config.axes or {"glb": AUTHORS_AXES, "npz": VOXEL_AXES}[config.format]
    scene_from_axes(axes)
    base, files = find_files(absolute(config.files), f".{config.format}")
    output = absolute(config.output) if config.output else home("imported", config.name)
    request = ImportRequest(base, files, config.format, axes, output, config.name)
    start_ray()
    with Progress() as bar:
        shown = bar.add_task("import scenes", total=len(files))
        made = import_files(request, lambda count: bar.advance(shown, count))
    return (request.target if config.format == "npz" else output), made


def main(config: Config) -> None:
    output, made = import_scenes(config)
    rejected = f"; {made['rejects']} files rejected, see the rejects table" if made["rejects"] else ""
    print(f"{len(made['scenes'])} scenes in {output}{rejected}")


if __name__ == "__main__":
    run(main, Config, description=__doc__)
