"""Import output files of other methods for evaluation.

One Ray Data graph runs one task per batch of files. GLB meshes become scene tables with source=imported-<name>. Voxel
grids contain no primitives. Each voxel grid therefore becomes an image seen from above. An unreadable file becomes
a row of `rejects`.
"""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from typing import Literal

import numpy as np
import pyarrow as pa

from models.uris import is_uri, split_name, split_options
from pipelines.io.mesh_import import import_glb
from pipelines.io.voxel_import import draw_voxels, read_voxels
from pipelines.metrics.adm_npz import write_npz
from pipelines.preprocess.shard_writer import join_tables
from pipelines.runtime import storage
from pipelines.runtime.npz import open_npz
from pipelines.runtime.ray_tasks import map_tasks
from pipelines.schema.axis_convention import Axes
from pipelines.schema.conversion import make_rejects_table, make_scene_tables
from pipelines.schema.tables import Shard, find_faults, require_written
from pipelines.schema.validation import validate_table

MAX_FILES_PER_SHARD = 64
WANTED_SHARDS = 8


@dataclass(frozen=True)
class ImportRequest:
    """Files to import, and the destination.

    Attributes:
        base: Directory of the files.
        files: Sorted names relative to `base`.
        kind: glb for meshes, npz for voxel grids.
        axes: Directions of the axes of the files.
        output: Output directory.
        name: Name of the import.
    """

    base: str
    files: tuple[str, ...]
    kind: Literal["glb", "npz"]
    axes: Axes
    output: str
    name: str

    def shards(self) -> list[Shard]:
        """Return the shards of the import."""
        count = -(-len(self.files) // self.files_per_shard)
        return [Shard(self.output, f"imported-{self.name}", "generated", k) for k in range(count)]

    @property
    def files_per_shard(self) -> int:
        """Return the number of files per shard; the last shard may have fewer."""
        return min(MAX_FILES_PER_SHARD, -(-len(self.files) // WANTED_SHARDS))

    def files_of(self, shard: Shard) -> Iterator[tuple[int, str, str]]:
        """Yield index, scene id and URI of each file of a shard.

        Args:
            shard: Shard of the import.

        Yields:
            Index of the file within the import, scene id, and URI.
        """
        start = shard.number * self.files_per_shard
        for index, file in enumerate(self.files[start : start + self.files_per_shard], start):
            yield index, make_scene_id(file), storage.join_uri(self.base, file)

    def pictures_path(self, shard: Shard) -> str:
        """Return the path of the images of a shard of voxel grids.

        Args:
            shard: Shard of the import.

        Returns:
            Path of an .npz file.
        """
        return storage.join_uri(self.output, f".pictures-{self.name}", f"part-{shard.number:05d}.npz")

    @property
    def target(self) -> str:
        """Return the path of the final file with the images of all voxel grids."""
        return storage.join_uri(self.output, f"{self.name}.npz")


def make_scene_id(file: str) -> str:
    """Return the scene id for a file name. For example, "night/007.glb" gives "night-007".

    Args:
        file: File name relative to the directory of the import.

    Returns:
        Scene id.
    """
    return file.rsplit(".", 1)[0].replace("/", "-")


def find_files(patterns: str | Sequence[str], suffix: str) -> tuple[str, tuple[str, ...]]:
    """Find files by any number of paths and glob patterns.

    A shell that expands a pattern gives the same result as the quoted pattern.

    Args:
        patterns: One or more paths or URIs of files or directories, or patterns such as DIR/*.glb. A directory is
            searched recursively.
        suffix: File name extension, such as .glb.

    Returns:
        The deepest directory that contains everything that was found by each pattern, and the sorted file names
        relative to this directory.

    Raises:
        ValueError: A pattern matches no file, or two files give the same scene id.
    """
    patterns = [patterns] if isinstance(patterns, str) else list(patterns)
    found = [_match_pattern(pattern, suffix) for pattern in patterns]
    base = found[0][0]
    while not all(_is_inside(one, base) for one, _ in found):
        if "/" not in split_options(base)[0].rstrip("/"):
            raise ValueError(f"{patterns[0]} and the other files have no directory in common; import them separately")
        base = split_name(base)[0]
    start = len(split_options(base)[0]) + 1
    # A file can be named by several patterns.
    files = sorted({split_options(uri)[0][start:] for _, uris in found for uri in uris})
    names = Counter(make_scene_id(file) for file in files)
    if twice := [name for name, count in names.items() if count > 1]:
        raise ValueError(f"{base}: two files give the same scene id {twice[0]!r}; rename one")
    return base, tuple(files)


def _split_pattern(pattern: str) -> tuple[str, str]:
    """Split a pattern into the part before the options of a URI and the options; options contain "=", wildcards not."""
    path, mark, options = pattern.rpartition("?") if is_uri(pattern) else ("", "", "")
    return (path, mark + options) if "=" in options else (pattern, "")


def _is_inside(uri: str, base: str) -> bool:
    (path, options), (folder, wanted) = split_options(uri), split_options(base)
    return options == wanted and f"{path}/".startswith(f"{folder}/")


def _match_pattern(pattern: str, suffix: str) -> tuple[str, list[str]]:
    """Return the directory of a pattern without wildcards, and the URIs of the matching files."""
    path, options = _split_pattern(pattern)
    has_wildcard = any(sign in path for sign in "*?[")
    if suffix and path.endswith(suffix) and not has_wildcard:
        directory, uris = split_name(pattern)[0], [pattern] if storage.exists(pattern) else []
    else:
        directory = path.rstrip("/")
        while any(sign in directory for sign in "*?["):
            directory = directory.rsplit("/", 1)[0]
        directory += options
        uris = [uri for uri in storage.list_files(directory, suffix) if not has_wildcard or fnmatch(uri, pattern)]
    if not uris:
        raise ValueError(
            f"{pattern} matches no {suffix} file; pass files, directories or patterns such as 'DIR/*{suffix}'"
        )
    return directory, uris


# --------------------------------------------------------------------------------------------------------- shards


def read_files(request: ImportRequest, shard: Shard, read: Callable[[int, str, str], object]) -> tuple[list[str], list]:
    """Read the files of a shard and write its rejects.

    Args:
        request: Import.
        shard: Shard of the import.
        read: Function that reads one file; its arguments are index, scene id and URI.

    Returns:
        Scene ids of the readable files, and the results of `read`.
    """
    names, contents, rejects = [], [], []
    for index, name, uri in request.files_of(shard):
        try:
            contents.append(read(index, name, uri))
            names.append(name)
        except Exception as error:  # One file must not end the import of the others, not even by an error in a reader.
            reason = str(error) if isinstance(error, ValueError) else f"{uri}: {type(error).__name__}: {error}"
            rejects.append({"scene_id": name, "sequence": request.name, "frame": index, "reason": reason})
    if rejects:
        storage.write_parquet(make_rejects_table(rejects), shard.path("rejects"))
    return names, contents


# The writer writes new rejects before the shard, and deletes outdated rejects after the shard. If a shard has no
# rejects, it is therefore complete, even if the writer was killed.


def write_tables(number: int, request: ImportRequest) -> dict:
    """Import the GLB files of one shard as tables.

    Args:
        number: Number of the shard.
        request: Import.

    Returns:
        Number of the shard and the scene ids.
    """
    shard = request.shards()[number]

    def tables(index: int, name: str, uri: str) -> dict[str, pa.Table]:
        scene = import_glb(uri, name, request.axes)
        about = {"source": shard.source, "split": shard.split, "sequence": request.name, "frame": index}
        made = make_scene_tables([replace(scene, **about)])
        try:
            for kind, table in made.items():
                validate_table(kind, table)
        except ValueError as error:
            raise ValueError(f"{uri}: {error}") from error
        return made

    if not shard.find_fault() and not storage.exists(shard.path("rejects")):
        return {"shard": number, "scenes": shard.read("scenes", ["scene_id"])["scene_id"].to_pylist()}
    names, parts = read_files(request, shard, tables)
    for table, content in join_tables(parts).items() if parts else ():
        storage.write_parquet(content, shard.path(table))
    if len(names) == len(list(request.files_of(shard))):
        storage.delete_file(shard.path("rejects"))
    return {"shard": number, "scenes": names}


def write_pictures(number: int, request: ImportRequest) -> dict:
    """Import the voxel grids of one shard as images.

    Args:
        number: Number of the shard.
        request: Import.

    Returns:
        Number of the shard and the scene ids.
    """
    shard = request.shards()[number]
    path = request.pictures_path(shard)
    if storage.exists(path) and not storage.exists(shard.path("rejects")):
        return {"shard": number, "scenes": _read_part(path, "names").tolist()}
    names, pictures = read_files(request, shard, lambda _, __, uri: draw_voxels(read_voxels(uri, request.axes)))
    content = io.BytesIO()
    np.savez_compressed(content, names=np.array(names, str), pictures=np.array(pictures, np.uint8))
    storage.write_whole(path, lambda stream: stream.write(content.getvalue()))
    if len(names) == len(list(request.files_of(shard))):
        storage.delete_file(shard.path("rejects"))
    return {"shard": number, "scenes": names}


def make_pictures_shard(path: str) -> np.ndarray:
    """Read the images that `write_pictures` wrote.

    Args:
        path: Path of an .npz file.

    Returns:
        (n, 256, 256, 3) uint8 images.
    """
    return _read_part(path, "pictures")


def _read_part(path: str, name: str) -> np.ndarray:
    with open_npz(path) as archive:
        return archive.read(name)


# ------------------------------------------------------------------------------------------------------------ run


def import_files(request: ImportRequest, on_shard: Callable[[int], None] | None = None) -> dict:
    """Import all files of a request.

    A second call resumes an interrupted import. The second call also reads the shards with rejects again.

    Args:
        request: Files, name and output directory.
        on_shard: Function that is called after each shard, with the number of its files.

    Returns:
        Content of imported-<name>.json: the scene ids in order, and the number of rejected files.

    Raises:
        ValueError: The output directory holds an import with the same name but different files, or no file is readable.
    """
    record = storage.join_uri(request.output, f"imported-{request.name}.json")
    options = {"base": request.base, "files": list(request.files), "kind": request.kind, "axes": list(request.axes)}
    shards = request.shards()
    if storage.exists(record):
        made = storage.read_json(record)
        if differing := [name for name in options if made.get(name) != options[name]]:
            raise ValueError(
                f"{request.output} holds an import {request.name!r} with other {' and '.join(differing)}; choose"
                " another --name or --output"
            )
        promised = {shard: len(list(request.files_of(shard))) for shard in shards}
        is_written = storage.exists(request.target) if request.kind == "npz" else not find_faults(promised)
        if made.get("rejects") == 0 and is_written:
            return made
    storage.write_json(options, record)
    write = {"glb": write_tables, "npz": write_pictures}[request.kind]

    def import_shard(number: int) -> dict:
        return write(number, request)

    found = {}
    for row in map_tasks(import_shard, range(len(shards))):
        found[row["shard"]] = list(row["scenes"])
        if on_shard:
            on_shard(len(list(request.files_of(shards[row["shard"]]))))
    scenes = [name for k in range(len(shards)) for name in found[k]]
    rejects = len(request.files) - len(scenes)
    if not scenes:
        reason = shards[0].read("rejects")["reason"][0]
        raise ValueError(f"none of the {rejects} files could be read; error of the first file: {reason}")
    if request.kind == "npz":
        parts = (make_pictures_shard(request.pictures_path(shard)) for shard in shards)
        write_npz(request.target, (part for part in parts if len(part)), len(scenes))
    else:
        require_written({shards[k]: len(names) for k, names in found.items() if names})
    made = options | {"scenes": scenes, "rejects": rejects}
    storage.write_json(made, record)
    if not rejects:
        storage.delete_directory(storage.join_uri(request.output, f".pictures-{request.name}"))
    return made
