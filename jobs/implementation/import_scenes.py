"""Implementation of jobs/import_scenes.py."""

from __future__ import annotations

from jobs.import_scenes import Config
from jobs.support.cli import make_absolute, resolve_path
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from pipelines.io.mesh_import import AUTHORS_AXES
from pipelines.io.voxel_import import VOXEL_AXES
from pipelines.preprocess.import_external import ImportRequest, find_files, import_files
from pipelines.schema.axis_convention import compute_scene_from_axes


def import_scenes(config: Config) -> tuple[str, dict]:
    """Import files.

    Returns:
        The value for evaluate_scenes --generated, and the content of imported-<name>.json.
    """
    if not config.name or set(config.name) & set("/=\\"):
        raise ValueError(f"--name is {config.name!r}, expected a word without slashes")
    axes = config.axes or {"glb": AUTHORS_AXES, "npz": VOXEL_AXES}[config.format]
    compute_scene_from_axes(axes)
    if not config.files:
        raise ValueError("no file is given; pass files, directories or patterns")
    base, files = find_files([make_absolute(path) for path in config.files], f".{config.format}")
    output = resolve_path(config.output, "imported", config.name)
    request = ImportRequest(base, files, config.format, axes, output, config.name)
    with hold_output(output, f"imported-{config.name}", config):
        with JobProgress() as bar:
            shown = bar.add_task("import scenes", total=len(files))
            made = import_files(request, lambda count: bar.advance(shown, count))
        return (request.target if config.format == "npz" else output), made


def main(config: Config) -> None:
    output, made = import_scenes(config)
    rejected = f"; {made['rejects']} files rejected, see the rejects table" if made["rejects"] else ""
    print(f"{len(made['scenes'])} scenes in {output}{rejected}")
