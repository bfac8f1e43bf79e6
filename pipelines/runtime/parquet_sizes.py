"""Measure the columns of a Parquet file before a library decodes them.

The metadata of a Parquet file only state sizes; the headers of the pages determine how much memory a reader allocates.
A page of a few hundred bytes can hold two billion values. Some damaged metadata also make pyarrow end the process
(`RowGroupMetaData.column` cannot report errors). This module therefore parses footer and page headers in Python. They
are structures in Thrift's compact protocol (github.com/apache/parquet-format).
"""

from __future__ import annotations

import struct
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

MAX_FOOTER_BYTES = 2**24
ITEM_BYTES = 8  # Upper bound of the size of a number and of an index into a dictionary.
MAX_DEPTH = 16  # Structures of the format are nested at most about 8 deep.
SHORT_BYTES, LONG_BYTES = 2**10, 2**20  # Bytes to read for a page header.
DATA_PAGES, DICTIONARY_PAGE = (0, 3), 2
PAGES, ENCODINGS = frozenset(range(4)), frozenset(range(10)) - {1}  # Numbers that exist; the encoding 1 was never used.

Struct = dict[int, Any]


@dataclass(frozen=True)
class ColumnSize:
    """Sizes of a leaf column over all row groups, from the headers of its pages.

    Attributes:
        path: Names from the root to the leaf.
        values: Number of values, including nulls and the values of dictionaries.
        bytes: Bytes of the pages after decompression.
        has_dictionary: Whether values may refer to a dictionary, so that few bytes state many long texts.
    """

    path: tuple[str, ...]
    values: int
    bytes: int
    has_dictionary: bool


def _parse_struct(data: bytes, at: int, depth: int = 0) -> tuple[Struct, int]:
    """Parse a structure of Thrift's compact protocol: its fields by number, and the position after it.

    The function is long because it parses thousands of small fields per file; a call per field would triple the time.
    """
    if depth > MAX_DEPTH:
        raise ValueError("the structures are nested too deeply")
    fields: Struct = {}
    name = 0
    while head := data[at]:
        at += 1
        kind = head & 15
        if head >> 4:
            name += head >> 4
        else:
            name, at = _parse_varint(data, at)
            name = (name >> 1) ^ -(name & 1)
        if kind <= 2:
            fields[name] = kind == 1
        elif kind <= 6:
            if kind == 3:
                fields[name], at = data[at], at + 1
            else:
                value = data[at]
                at += 1
                if value > 127:
                    value, at = _parse_varint(data, at - 1)
                fields[name] = (value >> 1) ^ -(value & 1)
        else:
            fields[name], at = _parse_value(data, at, kind, depth)
    return fields, at + 1


def _parse_varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
        shift += 7
        if shift > 63:
            raise ValueError("an integer has more than 64 bits")


def _parse_value(data: bytes, at: int, kind: int, depth: int) -> tuple[Any, int]:
    if kind == 8 or kind == 7:
        size, at = _parse_varint(data, at) if kind == 8 else (8, at)
        if size > len(data) - at:
            raise IndexError
        return data[at : at + size], at + size
    if kind == 12:
        return _parse_struct(data, at, depth + 1)
    if kind in (9, 10):
        head, at = data[at], at + 1
        count, entry = head >> 4, head & 15
        if count == 15:
            count, at = _parse_varint(data, at)
        if count > len(data) - at:  # An entry has at least one byte.
            raise IndexError
        found = []
        for _ in range(count):
            value, at = _parse_entry(data, at, entry, depth + 1)
            found.append(value)
        return found, at
    raise ValueError(f"the type {kind} is not part of the format")


def _parse_entry(data: bytes, at: int, kind: int, depth: int) -> tuple[Any, int]:
    """Parse an entry of a list; truth values have one byte there."""
    if kind in (1, 2, 3):
        return data[at], at + 1
    if kind in (4, 5, 6):
        value, at = _parse_varint(data, at)
        return (value >> 1) ^ -(value & 1), at
    return _parse_value(data, at, kind, depth)


def measure_columns(file: Any, columns: Collection[str] | None = None) -> tuple[int, list[ColumnSize]]:
    """Measure the columns of a Parquet file. No page is decompressed.

    Args:
        file: Open binary file with `seek`, `tell` and `read`. If it has the method `prefetch` (`RemoteFile`), the
            measured columns are read into memory.
        columns: Names of the columns to measure (default: all columns).

    Returns:
        Number of rows that the metadata state, and the size of each leaf column that is measured.

    Raises:
        ValueError: The file is no Parquet file, is encrypted, or its metadata or page headers are damaged.
    """
    try:
        return _measure(file, columns)
    except (IndexError, KeyError, TypeError, AttributeError, struct.error) as error:
        raise ValueError("the metadata or a page header is damaged") from error


def _measure(file: Any, columns: Collection[str] | None) -> tuple[int, list[ColumnSize]]:
    footer, end = _read_footer(file)
    leaves = [element for element in footer[2] if not element.get(5)]
    sizes: dict[int, list] = {}

    def is_wanted(column: Struct) -> bool:
        return columns is None or column[3][0].decode("utf-8") in columns

    if hasattr(file, "prefetch"):
        chunks = [chunk[3] for group in footer.get(4, []) for chunk in group[1]]
        file.prefetch([_find_chunk(column) for column in chunks if is_wanted(column)])
    for group in footer.get(4, []):
        if len(group[1]) != len(leaves):
            raise ValueError(f"a row group has {len(group[1])} columns, but the schema has {len(leaves)}")
        for k, chunk in enumerate(group[1]):
            if 8 in chunk or 9 in chunk or 1 in chunk:
                raise ValueError("a column is encrypted or lies in another file")
            column = chunk[3]
            if not _is_known(column):
                raise ValueError("a column names an encoding or a type of page that the format does not have")
            values, size, has_dictionary = _measure_pages(file, column, end) if is_wanted(column) else (0, 0, False)
            path = tuple(name.decode("utf-8") for name in column[3])
            known = sizes.setdefault(k, [path, 0, 0, False])
            if known[0] != path or path[-1:] != (leaves[k][4].decode("utf-8"),):
                raise ValueError(f"the path of column {k} differs from the schema")
            sizes[k] = [path, known[1] + values, known[2] + size, known[3] or has_dictionary]
    found = [ColumnSize(*entry) for entry in sizes.values()]
    return _require_count(footer[3]), [size for size in found if columns is None or size.path[0] in columns]


def _is_known(column: Struct) -> bool:
    """Return whether the listed encodings and types of pages exist; some readers refuse unknown ones, some do not."""
    pages = column.get(13, [])
    encodings = {*column[2], *(page[2] for page in pages)}
    return encodings <= ENCODINGS and {page[1] for page in pages} <= PAGES


def _require_count(value: Any) -> int:
    if type(value) is not int or not 0 <= value < 2**62:
        raise ValueError("a size is negative or too large")
    return value


def _read_footer(file: Any) -> tuple[Struct, int]:
    """Return the metadata of a file, and the position at which they begin."""
    file.seek(0)
    first = bytes(file.read(4))
    total = file.seek(0, 2)
    total = file.tell() if total is None else total
    if total < 12 or first != b"PAR1":
        raise ValueError("not a Parquet file")
    file.seek(total - 8)
    size, magic = struct.unpack("<I4s", bytes(file.read(8)))
    if magic != b"PAR1" or not 0 < size <= min(total - 12, MAX_FOOTER_BYTES):
        raise ValueError(f"the file has no valid footer ({size:,} bytes)")
    file.seek(total - 8 - size)
    return _parse_struct(bytes(file.read(size)), 0)[0], total - 8 - size


def _find_chunk(column: Struct) -> tuple[int, int]:
    """Return the positions of the first byte of a column chunk and of the byte after it; (0, 0) for an empty one."""
    starts = [_require_count(column[key]) for key in (9, 11) if column.get(key)]
    return (min(starts), min(starts) + _require_count(column[7])) if starts else (0, 0)


def _measure_pages(file: Any, column: Struct, end: int) -> tuple[int, int, bool]:
    """Return the number of values and the decompressed bytes of a column chunk, and whether it has a dictionary."""
    wanted = _require_count(column[5])
    place, last = _find_chunk(column)
    if not place and not wanted:
        return 0, 0, False  # A table without rows.
    if not place:
        raise ValueError("a column has values but states no position")
    if place < 4 or last > end:
        raise ValueError("a column lies outside the file")
    seen = values = size = 0
    has_dictionary = False
    while seen < wanted and place < last:
        header, length = _read_page_header(file, place, end)
        unpacked, packed = _require_count(header[2]), _require_count(header[3])
        place += length + packed
        if place > last:
            raise ValueError("a page is longer than its column")
        kind = header[1]
        if kind in DATA_PAGES:
            count = _require_count(header[5 if kind == 0 else 8][1])
            seen += count
        elif kind == DICTIONARY_PAGE:
            count, has_dictionary = _require_count(header[7][1]), True
        else:
            count = 0
        values, size = values + count, size + unpacked + length
    if seen != wanted:
        raise ValueError(f"a column has {seen:,} values, but the metadata state {wanted:,}")
    return values, size, has_dictionary


def _read_page_header(file: Any, place: int, end: int) -> tuple[Struct, int]:
    """Return the header of the page at a position, and its number of bytes."""
    file.seek(place)
    try:
        return _parse_struct(bytes(file.read(min(SHORT_BYTES, end - place))), 0)
    except IndexError:  # Statistics of long texts make a header long.
        file.seek(place)
        return _parse_struct(bytes(file.read(min(LONG_BYTES, end - place))), 0)
