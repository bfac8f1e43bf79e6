"""Export scenes and their traffic to files of other programs, with one Ray task per shard."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import pyarrow as pa

from models.scene import Scene
from pipelines.io.animation import export_animation
from pipelines.io.geojson import export_geojson
from pipelines.io.geoparquet import export_geoparquet
from pipelines.io.mesh_export import export_glb, export_ply
from pipelines.io.opendrive import export_opendrive
from pipelines.io.openscenario import export_openscenario
from pipelines.io.usd import export_usd
from pipelines.io.voxel_import import export_voxels_npz
from pipelines.runtime import storage
from pipelines.runtime.ray_tasks import map_tasks
from pipelines.schema.conversion import make_rejects_table
from pipelines.schema.file_names import make_file_name
from pipelines.schema.run_guard import guard_options
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import Shard, find_shards
from pipelines.schema.tracks import read_tracks, select_tracks

Format = Literal["glb", "ply", "npz", "xodr", "geojson", "geoparquet", "usd", "animation", "xosc"]
NOTICE = "NOTICE.txt"  # Licence notices of all exported scenes.
WRITERS: dict[str, Callable[[Scene], bytes]] = {
    "glb": export_glb,
    "ply": export_ply,
    "npz": export_voxels_npz,
    "xodr": export_opendrive,
    "geojson": export_geojson,
    "geoparquet": export_geoparquet,
    "usd": export_usd,
}
EXTENSIONS = {"animation": "glb"}  # Extensions that differ from the name of the format.


def export_scenario(scene: Scene, tracks: pa.Table) -> bytes:
    """Export a scene and its traffic as OpenSCENARIO, with the roads of the format xodr in the same output.

    Args:
        scene: Scene.
        tracks: Rows of the table tracks of the scene.

    Returns:
        Content of the .xosc file.
    """
    return export_openscenario(scene, tracks, f"../xodr/{make_file_name(scene.scene_id)}.xodr")


TRAFFIC_WRITERS: dict[str, Callable[[Scene, pa.Table], bytes]] = {
    "animation": export_animation,
    "xosc": export_scenario,
}


def export_scenes(
    selection: SceneSubset,
    formats: Sequence[Format],
    output: str,
    overwrite: bool = False,
    on_scene: Callable[[int], None] | None = None,
    tracks: str = "",
) -> tuple[dict[Format, int], dict[str, str]]:
    """Export each scene to output/<format>/<scene_id>.<extension>; `make_file_name` replaces unsafe letters.

    A format may be unable to represent a scene; for example, OpenDRIVE needs roads. If a scene cannot be represented,
    the table `rejects` of the output lists the scene, and the export continues. NOTICE.txt in the output states the
    licence notices of the scenes. Formats that have a place for it repeat the notice in each file. Files of the format
    xosc refer to files of the format xodr, which are therefore also written.

    Args:
        selection: Scenes.
        formats: File formats.
        output: Output directory.
        overwrite: Whether to replace existing files.
        on_scene: Function that is called after each shard, with the number of its scenes.
        tracks: Dataset directory with the table tracks for the formats animation and xosc (default: that of the
            scenes).

    Returns:
        Number of files per format, and the reason for each scene that was not written.
    """
    formats = list(dict.fromkeys([*(["xodr"] if "xosc" in formats else []), *formats]))
    parts = selection.shards()
    there = set() if overwrite else list_exported_files(output, formats)
    if uses_traffic(formats):
        guard_tracks(selection, formats, output, tracks, overwrite)

    def export_shard(number: int) -> dict:
        shard, rows = parts[number]
        written, rejects, paths = [], [], []
        notices: set[str] = set()
        traffic = read_tracks(replace(shard, root=tracks or shard.root)) if uses_traffic(formats) else None
        for scene in shard.scenes(rows):
            failed: set[str] = set()
            for kind in formats:
                path = storage.join_uri(output, kind, f"{make_file_name(scene.scene_id)}.{find_extension(kind)}")
                try:
                    if kind == "xosc" and "xodr" in failed:
                        raise ValueError("the scene has no OpenDRIVE file, to which the scenario would refer")
                    if path not in there:
                        if traffic is not None and kind in TRAFFIC_WRITERS:
                            content = TRAFFIC_WRITERS[kind](scene, select_tracks(traffic, scene.scene_id))
                        else:
                            content = WRITERS[kind](scene)
                        storage.write_whole(path, lambda stream, content=content: stream.write(content))
                    notices |= {scene.attribution} if scene.attribution else set()
                    written.append(kind)
                    paths.append(path)
                except ValueError as error:
                    failed.add(kind)
                    about = {"scene_id": scene.scene_id, "sequence": scene.sequence, "frame": scene.frame}
                    rejects.append(about | {"reason": f"{kind}: {error}"})
        if rejects:
            target = Shard(output, shard.source, shard.split, shard.number)
            storage.write_parquet(make_rejects_table(rejects), target.path("rejects"))
        refused = [(r["scene_id"], r["reason"]) for r in rejects]
        return {"scenes": len(rows), "written": written, "paths": paths, "rejects": refused, "notices": sorted(notices)}

    counts: dict[Format, int] = dict.fromkeys(formats, 0)
    refused: dict[str, str] = {}
    promised: list[str] = []
    notices: set[str] = set()
    for row in map_tasks(export_shard, range(len(parts))):
        for kind in row["written"]:
            counts[kind] += 1
        promised += row["paths"]
        notices.update(row["notices"])
        for scene_id, reason in row["rejects"]:
            refused[scene_id] = f"{refused[scene_id]}; {reason}" if scene_id in refused else reason
        if on_scene:
            on_scene(row["scenes"])
    if notices:
        text = "".join(f"{notice}\n" for notice in sorted(notices)).encode()
        storage.write_whole(storage.join_uri(output, NOTICE), lambda stream: stream.write(text))
    there = list_exported_files(output, formats)
    storage.raise_faults({path: f"{path}: no such file" for path in promised if path not in there}, len(promised))
    return counts, refused


def uses_traffic(formats: Sequence[str]) -> bool:
    """Return whether some formats need the table tracks.

    Args:
        formats: File formats.

    Returns:
        True if one of the formats needs the table.
    """
    return not TRAFFIC_WRITERS.keys().isdisjoint(formats)


def guard_tracks(selection: SceneSubset, formats: Sequence[Format], output: str, tracks: str, overwrite: bool) -> None:
    """Record which tracks the files of an output directory show.

    Args:
        selection: Scenes.
        formats: File formats.
        output: Output directory.
        tracks: Dataset directory with the table tracks (default: that of the scenes).
        overwrite: Whether existing files are replaced.

    Raises:
        ValueError: Existing files show other tracks.
    """
    shards = find_shards(tracks or selection.root, "tracks")
    files = storage.fingerprint_files([shard.path("tracks") for shard in shards])
    kept: list[Format] = [] if overwrite else [kind for kind in formats if kind in TRAFFIC_WRITERS]
    guard_options(
        storage.join_uri(output, "tracks.json"),
        {"tracks": files},
        is_in_use=lambda: bool(list_exported_files(output, kept)),
        discard=lambda: None,
        describe=lambda difference: (
            f"{output} holds files that show other tracks; add --overwrite or choose another --output"
        ),
    )


def list_exported_files(output: str, formats: Sequence[Format]) -> set[str]:
    """List the files of some formats in an output directory.

    Args:
        output: Output directory.
        formats: File formats.

    Returns:
        Paths of the files.
    """
    return {
        path
        for kind in formats
        for path in storage.list_files(storage.join_uri(output, kind), f".{find_extension(kind)}")
    }


def find_extension(kind: str) -> str:
    """Return the extension of the files of a format.

    Args:
        kind: Format.

    Returns:
        Extension without a dot.
    """
    return EXTENSIONS.get(kind, kind)
