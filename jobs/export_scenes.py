#!/usr/bin/env python3
"""Scenes as files for other programs: meshes, voxels, roads.

    jobs/export_scenes.py --input DIR --formats glb xodr
    jobs/export_scenes.py --limit 10 --formats ply npz --output DIR

glb: glTF 2.0, a named node per primitive with class, instance and exact parameters in its extras. ply: one mesh with colours,
class ids and primitive numbers per vertex. npz: 256 x 256 x 32 voxels of class ids, as import_scenes and evaluate_voxels
read them. xodr: the roads as OpenDRIVE 1.7 with lanes, elevation and junctions, for simulators. Files go to
OUTPUT/<format>/<scene_id>.<format>; those that are there already stay.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jobs.support.cli import absolute, home, run, start_ray


@dataclass(frozen=True)
class Config:
    input: str = ""
    """Dataset directory with the scenes (default: $PRITTI_HOME/generated)."""
    source: str = ""
    """Source of the scenes (default: whatever is there)."""
    split: str = ""
    """Split of the scenes (default: whatever is there)."""
    limit: int | None = None
    """So many scenes, from the first on (default: all)."""
    formats: tuple[Literal["glb", "ply", "npz", "xodr"], ...] = ("glb",)
    """What to write."""
    output: str = ""
    """Where the files go (default: the input directory's export/)."""
    overwrite: bool = False
    """Write files anew that are there already."""


def export(config: Config) -> tuple[str, dict[str, int], dict[str, str]]:
    """Write and return the output directory, the number of files per format, and why which were not written."""
    from pipelines.runtime import storage
    from pipelines.schema.scene_subset import Selection

    if not config.formats:
        raise ValueError("--formats is empty, expected some of glb, ply, npz, xodr")
    directory = absolute(config.input) if config.input else home("generated")
    output = absolute(config.output) if config.output else storage.join(directory, "export")
    selection = Selection(directory, config.source or None, config.split or None, config.limit, "first")
    total = sum(len(rows) for _, rows in selection.shards())
    from rich.progress import Progress

    from pipelines.io.export import export_scenes

    start_ray()
    with Progress() as bar:
        shown = bar.add_task("export scenes", total=total)
        made = export_scenes(
            selection, config.formats, output, config.overwrite, lambda count: bar.advance(shown, count)
        )
    return output, *made


def main(config: Config) -> None:
    output, counts, refused = export(config)
    print(f"{', '.join(f'{count} {kind}' for kind, count in counts.items())} files in {output}")
    for scene_id, reason in list(refused.items())[:5]:
        print(f"  not written: {scene_id}, {reason}")
    if len(refused) > 5:
        print(f"  and {len(refused) - 5} more, see {output}/rejects")


if __name__ == "__main__":
    run(main, Config, description=__doc__)
