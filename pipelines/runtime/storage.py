"""Read and write files atomically, on a local disk or in object storage (s3://, gs://, abfss://).

On a disk, a file is written under a temporary name and then renamed. In object storage, one request writes a whole
object, so there are no temporary names. Directories do not exist there, and listings replace questions about each file.
"""

from __future__ import annotations

import io
import json
import os
import secrets
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any, TypeVar

import pyarrow as pa
import pyarrow.compute as compute
import pyarrow.fs as pafs
import pyarrow.parquet as pq

from models.limits import LimitError, find_limit, require_within
from models.strict_json import parse_json
from models.uris import OBJECT_STORES, connect_fsspec, is_uri, join_uri, resolve_uri, split_name
from pipelines.runtime.machines import identify_machine, is_process_alive
from pipelines.runtime.parquet_sizes import ITEM_BYTES, measure_columns
from pipelines.runtime.remote_file import RemoteFile

T = TypeVar("T")
pc: Any = compute  # The type checker does not know the functions that pyarrow generates.

NUM_THREADS = 16  # Threads that read footers.
MISSING = "no such file"  # End of the description of a missing file.
TEMPORARY = ".tmp-"
ABANDONED_S = 3600.0  # A temporary file of another machine is abandoned after this time without a change (s).
DEFAULT = b"default"  # Metadata of a field: value (JSON) of a column that earlier versions did not write.
# A text column that can exceed this size (bytes) is read with dictionary encoding until its total length is known.
TEXT_BYTES = 2**28


def exists(uri: str) -> bool:
    """Return whether a file or directory exists."""
    fs, path = resolve_uri(uri)
    return fs.get_file_info(path).type != pafs.FileType.NotFound


def is_file(uri: str) -> bool:
    """Return whether a file exists."""
    fs, path = resolve_uri(uri)
    return fs.get_file_info(path).is_file


def fingerprint_file(uri: str) -> list[str | int]:
    """Return the path, size (bytes) and modification time of a file.

    If the file is rewritten, this fingerprint changes.
    """
    fs, path = resolve_uri(uri)
    return _make_fingerprint(fs.get_file_info(path))


def fingerprint_files(uris: Sequence[str]) -> list[list[str | int]]:
    """Return the fingerprint of each file; each of their directories is listed once.

    Raises:
        ValueError: A file is missing.
    """
    listed: dict[str, dict[str, list[str | int]]] = {}
    for directory in {split_name(uri)[0] for uri in uris}:
        fs, path = resolve_uri(directory)
        found = fs.get_file_info(pafs.FileSelector(path, allow_not_found=True))
        listed[directory] = {info.base_name: _make_fingerprint(info) for info in found if info.is_file}
    prints = []
    for uri in uris:
        directory, name = split_name(uri)
        if name not in listed[directory]:
            raise ValueError(f"{uri}: no such file; run the job that wrote it again")
        prints.append(listed[directory][name])
    return prints


def _make_fingerprint(info: pafs.FileInfo) -> list[str | int]:
    return [info.path, info.size, str(info.mtime)]


def list_files(uri: str, suffix: str) -> list[str]:
    """Return the sorted URIs of all visible files under a directory, or [] if the directory does not exist.

    Raises:
        ValueError: The directory cannot be listed.
    """
    fs, path = resolve_uri(uri)
    try:
        found = fs.get_file_info(pafs.FileSelector(path, recursive=True, allow_not_found=True))
    except OSError as error:
        raise ValueError(f"{uri}: cannot be listed ({error}); check the path, permissions and connection") from error
    inside = [info.path[len(path) :].lstrip("/") for info in found if info.is_file]
    shown = [name for name in inside if name.endswith(suffix) and not any(p.startswith(".") for p in name.split("/"))]
    return [join_uri(uri, name) for name in sorted(shown)]


def list_names(uri: str, suffix: str = "", directories: bool = False) -> list[str]:
    """Return the sorted names of the visible files, or of the visible subdirectories, directly in a directory.

    The list is empty if the directory does not exist.
    """
    fs, path = resolve_uri(uri)
    found = fs.get_file_info(pafs.FileSelector(path, allow_not_found=True))
    kind = pafs.FileType.Directory if directories else pafs.FileType.File
    names = sorted(info.base_name for info in found if info.type == kind and not info.base_name.startswith("."))
    return [name for name in names if name.endswith(suffix)]


def write_whole(uri: str, write: Callable[[Any], None]) -> None:
    """Create or replace a file; `write(stream)` writes its content.

    Readers see either the old or the new file, never an incomplete file. If earlier writers of the same file were
    killed, their temporary files are deleted.

    Raises:
        OSError: The file cannot be written. The message names the file and the remedy.
    """
    fs, path = resolve_uri(uri)
    try:
        if fs.type_name in OBJECT_STORES:
            _put_object(fs, path, write)
        else:
            _write_and_rename(fs, path, write)
    except OSError as error:
        raise _make_write_error(uri, error) from error


def _put_object(fs: pafs.FileSystem, path: str, write: Callable[[Any], None]) -> None:
    """Write an object as a whole: if `write` fails, nothing is sent."""
    content = io.BytesIO()
    write(content)
    with fs.open_output_stream(path) as stream:
        stream.write(content.getbuffer())


def _write_and_rename(fs: pafs.FileSystem, path: str, write: Callable[[Any], None]) -> None:
    """Write a file under a temporary name, and rename it."""
    parent, name = path.rsplit("/", 1)
    # The temporary file has another suffix, because *.parquet patterns of DuckDB also match hidden files.
    temporary = f"{parent}/{make_temporary_name(name)}"
    try:
        fs.create_dir(parent, recursive=True)
        with fs.open_output_stream(temporary) as stream:
            write(stream)
        fs.move(temporary, path)
    except BaseException:
        if fs.get_file_info(temporary).is_file:
            fs.delete_file(temporary)
        raise
    _delete_abandoned(fs, pafs.FileSelector(parent), f"{TEMPORARY}{name}-")


def make_temporary_name(name: str) -> str:
    """Return a temporary name that states the machine and the process of the writer.

    Nobody can guess the random part, so nobody can plant a link under this name in a shared directory.
    """
    return f"{TEMPORARY}{name}-{identify_machine()}-{os.getpid()}-{secrets.token_hex(8)}"


def _is_abandoned(info: pafs.FileInfo, now_ns: int) -> bool:
    """Return whether the writer of a temporary file has ended.

    The processes of another machine are not visible here. Its files are abandoned after ABANDONED_S seconds without a
    change.
    """
    machine, process, _ = info.base_name.rsplit("-", 3)[1:] if info.base_name.count("-") >= 3 else ("", "", "")
    if machine == identify_machine() and process.isdecimal():
        return not is_process_alive(int(process))
    return now_ns - (info.mtime_ns or 0) > ABANDONED_S * 10**9


def create_file(uri: str, content: bytes) -> bool:
    """Create a small file unless it exists. If several processes call this function concurrently, one succeeds.

    Object storage needs a conditional request, which pyarrow lacks; fsspec sends it (s3fs, gcsfs or adlfs).

    Args:
        uri: File.
        content: Content of the file.

    Returns:
        Whether this call created the file.

    Raises:
        OSError: The file cannot be written. The message names the file and the remedy.
        ValueError: The package for this kind of object storage is missing.
    """
    fs, path = resolve_uri(uri)
    try:
        if fs.type_name in OBJECT_STORES:
            connect_fsspec(uri).pipe_file(path, content, mode="create")
        else:
            fs.create_dir(path.rsplit("/", 1)[0], recursive=True)
            with open(path, "xb") as file:
                file.write(content)
    except FileExistsError:
        return False
    except OSError as error:
        raise _make_write_error(uri, error) from error
    return True


def _make_write_error(uri: str, error: OSError) -> OSError:
    reason = os.strerror(error.errno) if error.errno else str(error)
    remedy = "free disk space or give write permission"
    if is_uri(uri):
        remedy = "check that the bucket exists, and check the keys, the region and the endpoint"
    return OSError(f"{uri}: cannot be written ({reason}); {remedy}, then run the same command again")


def find_time_ns(uri: str) -> int:
    """Return the modification time of a file by the clock of its store (ns since 1970), or 0 if there is no file."""
    fs, path = resolve_uri(uri)
    return fs.get_file_info(path).mtime_ns or 0


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
            source = stream if isinstance(fs, pafs.LocalFileSystem) else RemoteFile(stream)
            table = _read_checked(source, columns, schema, encoded)
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
    defaults = _find_defaults(wanted, found, schema)
    stored = [name for name in wanted if name not in defaults]
    for name in stored:
        kind = found.field(name).type if len(found.get_all_field_indices(name)) == 1 else None
        if kind is None or (schema is not None and kind != schema.field(name).type):
            expected = "" if schema is None else f" or not of type {schema.field(name).type}"
            raise SchemaError(
                f"column {name!r} is missing or occurs twice{expected}; run the job that writes the table again with"
                " this version"
            )
    num_rows, texts = _check_sizes(stream, found, stored)
    options: Any = {"read_dictionary": [*texts, *encoded], "page_checksum_verification": True}
    with pq.ParquetFile(stream, metadata=metadata, **options) as file:
        table = file.read(columns=stored).select(stored)
    if len(table) != num_rows:
        raise pa.ArrowInvalid(f"{len(table)} rows can be read, but the file states {num_rows}")
    table = _decode_texts(table, encoded)
    for name, value in defaults.items():
        kind = schema.field(name).type if schema is not None else None
        table = table.append_column(name, pa.array([value] * num_rows, kind))
    return table.select(wanted) if defaults else table


def _find_defaults(wanted: Sequence[str], found: pa.Schema, schema: pa.Schema | None) -> dict[str, Any]:
    """Return the values of columns that a file of an earlier version lacks, and whose field states a default."""
    absent = [schema.field(name) for name in wanted if name not in found.names] if schema is not None else []
    return {field.name: json.loads(field.metadata[DEFAULT]) for field in absent if DEFAULT in (field.metadata or {})}


def _check_sizes(stream: Any, schema: pa.Schema, columns: Sequence[str]) -> tuple[int, list[str]]:
    """Check the rows and bytes that a file states; return the rows and the columns to read as dictionaries.

    A dictionary stores each text once, so few bytes can state many long texts. A column whose texts could exceed
    TEXT_BYTES is decoded only after their total length is known (`_decode_texts`).
    """
    num_rows, sizes = measure_columns(stream, columns)
    require_within("table_rows", num_rows)
    kinds = {name: schema.field(name).type for name in columns}
    total, texts = 0, dict.fromkeys((name for name, kind in kinds.items() if _is_text(kind)), 0)
    for column in sizes:
        name, kind = column.path[0], kinds[column.path[0]]
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


def read_num_rows(uri: str) -> int:
    """Return the number of rows that the footer of a Parquet file states.

    Raises:
        ValueError: The file is missing or is not a complete Parquet file. The message names the file.
    """
    fs, path = resolve_uri(uri)
    try:
        with fs.open_input_file(path) as stream:
            return pq.read_metadata(stream).num_rows
    except FileNotFoundError:
        raise ValueError(f"{uri}: {MISSING}") from None
    except Exception as error:  # A damaged file makes pyarrow raise errors of many types.
        raise ValueError(f"{uri}: not a complete Parquet file ({error})") from error


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


def find_faults(files: Mapping[T, Sequence[str]], check: Callable[[T], str]) -> dict[T, str]:
    """Find the parts of an output that are missing or faulty.

    Directories are listed once, and `check` runs in several threads.

    Args:
        files: Files of each part.
        check: Function that returns the fault of a part whose files exist, or "".

    Returns:
        Description of the fault of each faulty part, in order.
    """
    places = {split_name(uri)[0] for uris in files.values() for uri in uris}
    there = {path for place in places for path in list_files(place, "")}

    def find_fault(part: T) -> str:
        missing = [uri for uri in files[part] if uri not in there]
        return f"{missing[0]}: {MISSING}" if missing else check(part)

    with ThreadPoolExecutor(NUM_THREADS) as pool:
        faults = zip(files, pool.map(find_fault, files), strict=True)
    return {part: fault for part, fault in faults if fault}


def find_faulty_files(promised: Mapping[str, int]) -> dict[str, str]:
    """Find the Parquet files that are missing, damaged or have another number of rows than promised.

    Args:
        promised: Number of rows of each file.

    Returns:
        Description of the fault of each faulty file.
    """

    def check_rows(uri: str) -> str:
        try:
            rows = read_num_rows(uri)
        except ValueError as error:
            return str(error)
        return "" if rows == promised[uri] else f"{uri}: {rows:,} rows, expected {promised[uri]:,}"

    return find_faults({uri: [uri] for uri in promised}, check_rows)


def require_rows(promised: Mapping[str, int]) -> None:
    """Check that a job has written the Parquet files that it reports.

    Args:
        promised: Number of rows of each file.

    Raises:
        ValueError: A file is missing, is damaged or has another number of rows. The message names the file.
    """
    raise_faults(find_faulty_files(promised), len(promised))


def require_files(promised: Collection[str], directory: str) -> None:
    """Check that a job has written the files that it reports.

    Args:
        promised: URIs of files in the directory.
        directory: Directory, which is listed once.

    Raises:
        ValueError: A file is missing. The message names the file.
    """
    there = set(list_files(directory, "")) if promised else set()
    raise_faults({uri: f"{uri}: {MISSING}" for uri in promised if uri not in there}, len(promised))


def raise_faults(faults: Mapping[Any, str], count: int) -> None:
    """Raise an error if files of a job's output are faulty.

    Args:
        faults: Description of the fault of each faulty file or shard.
        count: Number of files or shards that were checked.

    Raises:
        ValueError: There is a fault. The message states the first fault and the remedy.
    """
    if faults:
        raise ValueError(
            f"{next(iter(faults.values()))}; {len(faults)} of {count} parts of the output are incomplete; run the same"
            " command again, and check that all nodes write to the same storage"
        )


def measure_file_bytes(uri: str) -> int:
    """Return the size of a file in bytes, or -1 if there is no file."""
    fs, path = resolve_uri(uri)
    info = fs.get_file_info(path)
    return info.size if info.is_file else -1


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
    """Delete the temporary files of killed writers and return their number. The files of live writers are kept."""
    fs, path = resolve_uri(uri)
    if fs.type_name in OBJECT_STORES:
        return 0
    return _delete_abandoned(fs, pafs.FileSelector(path, recursive=True, allow_not_found=True), TEMPORARY)


def _delete_abandoned(fs: pafs.FileSystem, where: pafs.FileSelector, prefix: str) -> int:
    """Delete the temporary files whose names begin with `prefix` and whose writers have ended; return their number."""
    now_ns = time.time_ns()
    found = [info for info in fs.get_file_info(where) if info.is_file and info.base_name.startswith(prefix)]
    stale = [info.path for info in found if _is_abandoned(info, now_ns)]
    for name in stale:
        with suppress(FileNotFoundError):  # Another process has deleted the file.
            fs.delete_file(name)
    return len(stale)


def delete_file(uri: str) -> None:
    """Delete a file if it exists."""
    fs, path = resolve_uri(uri)
    with suppress(FileNotFoundError):
        fs.delete_file(path)


def delete_directory(uri: str) -> None:
    """Delete a directory if it exists."""
    fs, path = resolve_uri(uri)
    with suppress(FileNotFoundError):
        fs.delete_dir(path)
