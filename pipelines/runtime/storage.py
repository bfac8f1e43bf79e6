"""Read and write files atomically, on a local disk or on any file system of pyarrow (s3://, gs://, ...)."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import pyarrow as pa
import pyarrow.compute as compute
import pyarrow.fs as pafs
import pyarrow.parquet as pq

from models.limits import LimitError, find_limit, require_within
from models.strict_json import parse_json
from pipelines.runtime.parquet_sizes import ITEM_BYTES, measure_columns

pc: Any = compute  # The type checker does not know the functions that pyarrow generates.

TEMPORARY = ".tmp-"
# A text column that can exceed this size (bytes) is read with dictionary encoding until its total length is known.
TEXT_BYTES = 2**28


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
    # Nobody can guess the random part, so nobody can plant a link under this name in a shared directory.
    temporary = f"{parent}/{TEMPORARY}{name}-{secrets.token_hex(8)}"
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
    """Write a table as a Parquet file, with zstd compression, dictionary-encoded string columns and page checksums."""
    dictionaries = _list_dictionary_columns(table)
    options: Any = {"compression": "zstd", "use_dictionary": dictionaries, "write_page_checksum": True}
    write_whole(uri, lambda stream: pq.write_table(table, stream, **options))


def _list_dictionary_columns(table: pa.Table) -> list[str]:
    return [f.name for f in table.schema if pa.types.is_string(f.type)]


def read_parquet(
    uri: str, columns: list[str] | None = None, schema: pa.Schema | None = None, encoded: Sequence[str] = ()
) -> pa.Table:
    """Read a Parquet file of any origin, and verify its page checksums if it has them.

    Args:
        uri: File.
        columns: Names of the columns to read (default: all columns).
        schema: Types that the columns must have (default: no check).
        encoded: Names of text columns to return with dictionary encoding (default: plain texts).

    Returns:
        Table.

    Raises:
        ValueError: The file is missing, is damaged, has another schema or exceeds a limit (models/limits.py). The
            message names the file.
    """
    fs, path = resolve_uri(uri)
    try:
        opened = fs.open_input_file(path)
    except OSError as error:
        raise ValueError(f"{uri}: cannot be opened ({error}); check the path, permissions and connection") from error
    try:
        with opened as stream:
            table = _read_checked(stream, columns, schema, encoded)
    except (LimitError, SchemaError) as error:
        raise ValueError(f"{uri}: {error}") from error
    except Exception as error:  # A damaged file makes pyarrow raise errors of many types.
        raise ValueError(
            f"{uri}: cannot be read as Parquet ({error}); restore the file from a copy, or delete it and run the job"
            " that wrote it again"
        ) from error
    return table


class SchemaError(ValueError):
    """Raised if a readable file has another schema."""


def _read_checked(stream: Any, columns: list[str] | None, schema: pa.Schema | None, encoded: Sequence[str]) -> pa.Table:
    """Read columns from a stream after checks of types and sizes; the names of columns may not repeat."""
    metadata = pq.read_metadata(stream)
    found = metadata.schema.to_arrow_schema()
    wanted = columns if columns is not None else schema.names if schema is not None else found.names
    for name in wanted:
        kind = found.field(name).type if len(found.get_all_field_indices(name)) == 1 else None
        if kind is None or (schema is not None and kind != schema.field(name).type):
            expected = "" if schema is None else f" or not of type {schema.field(name).type}"
            raise SchemaError(
                f"column {name!r} is missing or occurs twice{expected}; run the job that writes the table again with"
                " this version"
            )
    num_rows, texts = _check_sizes(stream, found, wanted)
    options: Any = {"read_dictionary": [*texts, *encoded], "page_checksum_verification": True}
    with pq.ParquetFile(stream, metadata=metadata, **options) as file:
        table = file.read(columns=wanted).select(wanted)
    if len(table) != num_rows:
        raise pa.ArrowInvalid(f"{len(table)} rows can be read, but the file states {num_rows}")
    return _decode_texts(table, encoded)


def _check_sizes(stream: Any, schema: pa.Schema, columns: Sequence[str]) -> tuple[int, list[str]]:
    """Check the rows and bytes that a file states; return the rows and the columns to read as dictionaries.

    A dictionary stores each text once, so few bytes can state many long texts. A column whose texts could exceed
    TEXT_BYTES is decoded only after their total length is known (`_decode_texts`).
    """
    num_rows, sizes = measure_columns(stream)
    require_within("table_rows", num_rows)
    kinds = {name: schema.field(name).type for name in columns}
    total, texts = 0, dict.fromkeys((name for name, kind in kinds.items() if _is_text(kind)), 0)
    for column in sizes:
        name = column.path[0]
        if (kind := kinds.get(name)) is None:
            continue
        # A text in a list can be repeated, so the bound of such a column is coarse.
        is_repeated = len(column.path) > 1 and _holds_texts(kind)
        total += column.bytes + column.values * (column.bytes if is_repeated else ITEM_BYTES)
        if name in texts and column.has_dictionary:
            texts[name] += column.bytes * column.values
    require_within("table_bytes", total)
    return num_rows, [name for name, size in texts.items() if size > TEXT_BYTES]


def _is_text(kind: pa.DataType) -> bool:
    return pa.types.is_string(kind) or pa.types.is_binary(kind)


def _holds_texts(kind: pa.DataType) -> bool:
    inner = [kind.field(k).type for k in range(kind.num_fields)]
    return any(_is_text(part) or _holds_texts(part) for part in inner)


def _decode_texts(table: pa.Table, encoded: Sequence[str]) -> pa.Table:
    """Replace dictionaries by texts, except in the columns `encoded`, after a check of their total length."""
    if not any(pa.types.is_dictionary(f.type) and f.name not in encoded for f in table.schema):
        return table
    total, fields = 0, []
    for field in table.schema:
        if pa.types.is_dictionary(field.type) and field.name not in encoded:
            for chunk in table[field.name].chunks:
                lengths = pc.take(pc.binary_length(chunk.dictionary), chunk.indices)
                total += pc.sum(pc.cast(lengths, pa.int64())).as_py() or 0
            field = field.with_type(field.type.value_type)
        fields.append(field)
    require_within("table_bytes", total)
    return table.cast(pa.schema(fields, table.schema.metadata))


def read_bytes(uri: str, limit: str = "") -> bytes:
    """Read a whole file.

    Args:
        uri: File.
        limit: Limit of the number of bytes (a key of LIMITS in models/limits.py); "" means no limit.

    Returns:
        Content of the file.

    Raises:
        ValueError: The file cannot be read or exceeds the limit. The message names the file.
    """
    fs, path = resolve_uri(uri)
    try:
        with fs.open_input_stream(path, compression=None) as stream:
            # The stated size of a file may be wrong, so the limit does not rely on it.
            content = stream.read(find_limit(limit) + 1) if limit else stream.read()
    except OSError as error:
        raise ValueError(f"{uri}: cannot be read ({error})") from error
    if limit:
        require_within(limit, len(content), uri, is_partial=True)
    return content


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
    """Read a JSON file.

    Raises:
        ValueError: The file is missing, is too large or is not JSON; NaN, Infinity and a repeated key are not JSON. The
            message names the file.
    """
    content = read_bytes(uri, "json_bytes")
    try:
        return parse_json(content)
    except ValueError as error:
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
