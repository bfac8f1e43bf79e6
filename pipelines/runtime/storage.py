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
    """Return the file system and the path of a URI or of a local path, which becomes absolute."""
    uri = os.fspath(uri)
    if "://" in uri:
        return pafs.FileSystem.from_uri(uri)
    return pafs.LocalFileSystem(), os.path.abspath(os.path.expanduser(uri))


def join_uri(uri: str | os.PathLike, *parts: str) -> str:
    return "/".join([os.fspath(uri).rstrip("/"), *parts])


def exists(uri: str) -> bool:
    fs, path = resolve_uri(uri)
    return fs.get_file_info(path).type != pafs.FileType.NotFound


def fingerprint_file(uri: str) -> list[str | int]:
    """Return path, size in bytes and modification time of a file; they change when the file is rewritten."""
    fs, path = resolve_uri(uri)
    info = fs.get_file_info(path)
    return [path, info.size, str(info.mtime)]


def list_files(uri: str, suffix: str) -> list[str]:
    """Return the sorted URIs of the files under a directory, without hidden and temporary ones; [] if it is missing."""
    fs, path = resolve_uri(uri)
    found = fs.get_file_info(pafs.FileSelector(path, recursive=True, allow_not_found=True))
    inside = [(info.path[len(path) :].lstrip("/"), info) for info in found if info.is_file]
    shown = [
        name for name, _ in inside if name.endswith(suffix) and not any(p.startswith(".") for p in name.split("/"))
    ]
    return [join_uri(uri, name) for name in sorted(shown)]


def write_whole(uri: str, write: Callable[[Any], None]) -> None:
    """Create or replace a file by `write(stream)`: readers see the old file or the new one, never a part.

    Deletes the temporary files that killed writers of the same file left.

    Raises:
        OSError: The file cannot be written; the message names the file and the remedy.
    """
    fs, path = resolve_uri(uri)
    parent, name = path.rsplit("/", 1)
    # The temporary name has another suffix, because DuckDB's *.parquet patterns match hidden files too.
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
                f"{uri}: cannot be written ({reason}); make room there or give write permission, then run the same"
                " command again"
            ) from error
        raise
    _delete_files(fs, pafs.FileSelector(parent), f"{TEMPORARY}{name}-")


def write_parquet(table: pa.Table, uri: str) -> None:
    """Write a table as a Parquet file, zstd-compressed, with dictionaries for its string columns."""
    dictionaries = cast(
        Any, _list_dictionary_columns(table)
    )  # pyarrow annotates a bool; its documentation allows names
    write_whole(uri, lambda stream: pq.write_table(table, stream, compression="zstd", use_dictionary=dictionaries))


def _list_dictionary_columns(table: pa.Table) -> list[str]:
    return [f.name for f in table.schema if pa.types.is_string(f.type)]


def read_parquet(uri: str, columns: list[str] | None = None, schema: pa.Schema | None = None) -> pa.Table:
    """Read a Parquet file.

    Args:
        uri: The file.
        columns: Names of the columns to read (default: all).
        schema: Types that the columns must have (default: any).

    Raises:
        ValueError: The file is missing, truncated or has another schema; the message names it.
    """
    fs, path = resolve_uri(uri)
    no_partitioning = cast(Any, None)  # pyarrow annotates a string; its documentation allows None
    try:
        table = pq.read_table(path, filesystem=fs, columns=columns, partitioning=no_partitioning)
    except (OSError, pa.ArrowInvalid, pa.ArrowKeyError) as error:
        raise ValueError(
            f"{uri}: cannot be read as Parquet ({error}); delete it and run the job that wrote it again"
        ) from error
    if schema is not None:
        wanted = schema.names if columns is None else columns
        for name in wanted:
            if name not in table.column_names or table.schema.field(name).type != schema.field(name).type:
                raise ValueError(
                    f"{uri}: column {name!r} is missing or not {schema.field(name).type}; it was written by another"
                    " version"
                )
    return table


def read_bytes(uri: str) -> bytes:
    """Read a whole file. Raises ValueError naming it if it cannot be read."""
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
    write_whole(uri, lambda stream: stream.write(text.encode()))


def write_json(value: Any, uri: str) -> None:
    write_text(json.dumps(value, indent=1, allow_nan=False), uri)


def read_json(uri: str) -> Any:
    """Read a JSON file. Raises ValueError naming the file if it is missing or not JSON."""
    fs, path = resolve_uri(uri)
    try:
        with fs.open_input_stream(path) as stream:
            return json.loads(stream.read().decode())
    except (OSError, ValueError) as error:
        raise ValueError(f"{uri}: cannot be read as JSON ({error})") from error


def clean_temporaries(uri: str) -> int:
    """Delete the temporary files that killed writers left; return their number."""
    fs, path = resolve_uri(uri)
    return _delete_files(fs, pafs.FileSelector(path, recursive=True, allow_not_found=True), TEMPORARY)


def _delete_files(fs: pafs.FileSystem, where: pafs.FileSelector, prefix: str) -> int:
    """Delete the files whose names begin with `prefix`; return their number."""
    stale = [info.path for info in fs.get_file_info(where) if info.is_file and info.base_name.startswith(prefix)]
    for name in stale:
        with suppress(FileNotFoundError):  # its writer is alive and has just renamed it
            fs.delete_file(name)
    return len(stale)


def delete_file(uri: str) -> None:
    """Delete a file if it is there."""
    fs, path = resolve_uri(uri)
    if fs.get_file_info(path).is_file:
        fs.delete_file(path)


def delete_directory(uri: str) -> None:
    fs, path = resolve_uri(uri)
    if fs.get_file_info(path).type == pafs.FileType.Directory:
        fs.delete_dir(path)


def move_file(source: str, target: str) -> None:
    """Move one file into place, creating the directory."""
    fs, path = resolve_uri(source)
    _, to = resolve_uri(target)
    fs.create_dir(to.rsplit("/", 1)[0], recursive=True)
    fs.move(path, to)
