"""Read and write files atomically, on a local disk or on any file system of pyarrow (s3://, gs://, ...)."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from contextlib import suppress
from typing import Any, cast

import pyarrow as pa
import pyarrow.fs as pafs
import pyarrow.parquet as pq

TEMPORARY = ".tmp-"


def resolve_uri(uri: str | os.PathLike) -> tuple[pafs.FileSystem, str]:
    """Return the file system and the path of a URI or of a local path; local paths are made absolute."""
    uri = os.fspath(uri)
    if "://" in uri:
        return pafs.FileSystem.from_uri(uri)
    return pafs.LocalFileSystem(), os.path.abspath(os.path.expanduser(uri))


def join_uri(uri: str | os.PathLike, *parts: str) -> str:
    """Join a URI or path with further parts, using slashes."""
    return "/".join([os.fspath(uri).rstrip("/"), *parts])


def exists(uri: str) -> bool:
    """Return whether a file or directory exists."""
    fs, path = resolve_uri(uri)
    return fs.get_file_info(path).type != pafs.FileType.NotFound


def fingerprint_file(uri: str) -> list[str | int]:
    """Return the path, size (bytes) and modification time of a file.

    If the file is rewritten, this fingerprint changes.
    """
    fs, path = resolve_uri(uri)
    info = fs.get_file_info(path)
    return [path, info.size, str(info.mtime)]


def list_files(uri: str, suffix: str) -> list[str]:
    """Return the sorted URIs of all visible files under a directory, or [] if the directory does not exist."""
    fs, path = resolve_uri(uri)
    found = fs.get_file_info(pafs.FileSelector(path, recursive=True, allow_not_found=True))
    inside = [(info.path[len(path) :].lstrip("/"), info) for info in found if info.is_file]
    shown = [
        name for name, _ in inside if name.endswith(suffix) and not any(p.startswith(".") for p in name.split("/"))
    ]
    return [join_uri(uri, name) for name in sorted(shown)]


def write_whole(uri: str, write: Callable[[Any], None]) -> None:
    """Create or replace a file; `write(stream)` writes its content.

    Readers see either the old or the new file, never an incomplete file. If earlier writers of the same file were
    killed, their temporary files are deleted.

    Raises:
        OSError: The file cannot be written. The message names the file and the remedy.
    """
    fs, path = resolve_uri(uri)
    parent, name = path.rsplit("/", 1)
    # The temporary file has another suffix, because *.parquet patterns of DuckDB also match hidden files.
    temporary = f"{parent}/{TEMPORARY}{name}-{os.getpid()}"
    try:
        fs.create_dir(parent, recursive=True)
        with fs.open_output_stream(temporary) as stream:
            write(stream)
        fs.move(temporary, path)
    except BaseException as error:
        if fs.get_file_info(temporary).is_file:
            fs.delete_file(temporary)
        if isinstance(error, OSError):
            reason = os.strerror(error.errno) if error.errno else str(error)
            raise OSError(
                f"{uri}: cannot be written ({reason}); free disk space or give write permission, then run the same"
                " command again"
            ) from error
        raise
    _delete_files(fs, pafs.FileSelector(parent), f"{TEMPORARY}{name}-")


def write_parquet(table: pa.Table, uri: str) -> None:
    """Write a table as a Parquet file, with zstd compression and dictionary-encoded string columns."""
    # The type annotation of pyarrow allows only a bool, but the documentation allows names.
    dictionaries = cast(Any, _list_dictionary_columns(table))
    write_whole(uri, lambda stream: pq.write_table(table, stream, compression="zstd", use_dictionary=dictionaries))


def _list_dictionary_columns(table: pa.Table) -> list[str]:
    return [f.name for f in table.schema if pa.types.is_string(f.type)]


def read_parquet(uri: str, columns: list[str] | None = None, schema: pa.Schema | None = None) -> pa.Table:
    """Read a Parquet file.

    Args:
        uri: File.
        columns: Names of the columns to read (default: all columns).
        schema: Types that the columns must have (default: no check).

    Returns:
        Table.

    Raises:
        ValueError: The file is missing, is truncated or has another schema. The message names the file.
    """
    fs, path = resolve_uri(uri)
    # The type annotation of pyarrow allows only a string, but the documentation allows None.
    no_partitioning = cast(Any, None)
    try:
        table = pq.read_table(path, filesystem=fs, columns=columns, partitioning=no_partitioning)
    except (OSError, pa.ArrowInvalid, pa.ArrowKeyError) as error:
        raise ValueError(
            f"{uri}: cannot be read as Parquet ({error}); delete the file and run the job that wrote it again"
        ) from error
    if schema is not None:
        wanted = schema.names if columns is None else columns
        for name in wanted:
            if name not in table.column_names or table.schema.field(name).type != schema.field(name).type:
                raise ValueError(
                    f"{uri}: column {name!r} is missing or not of type {schema.field(name).type}; another"
                    " version wrote the file"
                )
    return table


def read_bytes(uri: str) -> bytes:
    """Read a whole file. Raises ValueError with the name of the file if it cannot be read."""
    fs, path = resolve_uri(uri)
    try:
        with fs.open_input_stream(path, compression=None) as stream:
            return stream.read()
    except OSError as error:
        raise ValueError(f"{uri}: cannot be read ({error})") from error


def measure_file_bytes(uri: str) -> int:
    """Return the size of a file in bytes."""
    fs, path = resolve_uri(uri)
    return fs.get_file_info(path).size


def write_text(text: str, uri: str) -> None:
    """Write a text file."""
    write_whole(uri, lambda stream: stream.write(text.encode()))


def write_json(value: Any, uri: str) -> None:
    """Write a value as a JSON file."""
    write_text(json.dumps(value, indent=1, allow_nan=False), uri)


def read_json(uri: str) -> Any:
    """Read a JSON file. Raises ValueError with the name of the file if it is missing or is not JSON."""
    fs, path = resolve_uri(uri)
    try:
        with fs.open_input_stream(path) as stream:
            return json.loads(stream.read().decode())
    except (OSError, ValueError) as error:
        raise ValueError(f"{uri}: cannot be read as JSON ({error})") from error


def clean_temporaries(uri: str) -> int:
    """Delete the temporary files of killed writers and return their number."""
    fs, path = resolve_uri(uri)
    return _delete_files(fs, pafs.FileSelector(path, recursive=True, allow_not_found=True), TEMPORARY)


def _delete_files(fs: pafs.FileSystem, where: pafs.FileSelector, prefix: str) -> int:
    """Delete the files whose names begin with `prefix` and return their number."""
    stale = [info.path for info in fs.get_file_info(where) if info.is_file and info.base_name.startswith(prefix)]
    for name in stale:
        with suppress(FileNotFoundError):  # The writer was not killed and has renamed the file.
            fs.delete_file(name)
    return len(stale)


def delete_file(uri: str) -> None:
    """Delete a file if it exists."""
    fs, path = resolve_uri(uri)
    if fs.get_file_info(path).is_file:
        fs.delete_file(path)


def delete_directory(uri: str) -> None:
    """Delete a directory if it exists."""
    fs, path = resolve_uri(uri)
    if fs.get_file_info(path).type == pafs.FileType.Directory:
        fs.delete_dir(path)


def move_file(source: str, target: str) -> None:
    """Move a file; create the target directory if necessary."""
    fs, path = resolve_uri(source)
    _, to = resolve_uri(target)
    fs.create_dir(to.rsplit("/", 1)[0], recursive=True)
    fs.move(path, to)
