"""Measure a feather file (Arrow's IPC file format) before a library decompresses it.

A compressed buffer states its size in its first eight bytes. This module adds up these sizes over all batches. The
metadata are FlatBuffers (arrow.apache.org/docs/format/Columnar.html).
"""

from __future__ import annotations

import struct

MAGIC = b"ARROW1"
MAX_METADATA_BYTES = 2**24
MAX_BATCHES = 100_000


class _Table:
    """Table of a FlatBuffer."""

    def __init__(self, data: bytes, place: int) -> None:
        self.data, self.place = data, place

    def read(self, form: str, place: int) -> int:
        """Return a number at a position."""
        if place < 0:
            raise IndexError
        return struct.unpack_from(f"<{form}", self.data, place)[0]

    def find(self, index: int) -> int:
        """Return the position of a field, or 0 if it is absent."""
        fields = self.place - self.read("i", self.place)
        offset = 4 + 2 * index
        shift = self.read("H", fields + offset) if offset < self.read("H", fields) else 0
        return self.place + shift if shift else 0

    def number(self, index: int, form: str) -> int:
        """Return a number, 0 if the field is absent."""
        return self.read(form, place) if (place := self.find(index)) else 0

    def table(self, index: int) -> _Table | None:
        """Return a table, or None if the field is absent."""
        place = self.find(index)
        return _Table(self.data, place + self.read("I", place)) if place else None

    def structs(self, index: int, form: str) -> list[tuple]:
        """Return a vector of structures."""
        if not (place := self.find(index)):
            return []
        place += self.read("I", place)
        count, size = self.read("I", place), struct.calcsize(f"<{form}")
        if count * size > len(self.data) - place:
            raise IndexError
        return [struct.unpack_from(f"<{form}", self.data, place + 4 + k * size) for k in range(count)]


def read_root(data: bytes) -> _Table:
    """Return the root table of a FlatBuffer."""
    return _Table(data, struct.unpack_from("<I", data)[0])


def measure_feather(content: bytes) -> tuple[int, int]:
    """Measure a feather file. No buffer is decompressed.

    Args:
        content: The file.

    Returns:
        Number of rows, and bytes of all buffers after decompression.

    Raises:
        ValueError: The content is no feather file of version 2, or its metadata are damaged.
    """
    try:
        return _measure(content)
    except (IndexError, struct.error) as error:
        raise ValueError("the metadata are damaged") from error


def _measure(content: bytes) -> tuple[int, int]:
    if content[:6] != MAGIC or content[-6:] != MAGIC:
        raise ValueError("not a feather file of version 2")
    end = len(content) - 10
    (size,) = struct.unpack_from("<i", content, end)
    if not 0 < size <= min(end, MAX_METADATA_BYTES):
        raise ValueError("the footer is damaged")
    footer = read_root(content[end - size : end])
    blocks = [footer.structs(field, "qiiq") for field in (2, 3)]  # Dictionaries, then batches.
    if sum(map(len, blocks)) > MAX_BATCHES:
        raise ValueError(f"more than {MAX_BATCHES:,} batches")
    rows = total = 0
    for field, part in enumerate(blocks):
        for offset, length, _, body in part:
            count, used = _measure_batch(content, offset, length, body)
            rows, total = rows + count * field, total + used
    return rows, total


def _measure_batch(content: bytes, offset: int, length: int, body: int) -> tuple[int, int]:
    """Return the rows of a batch, and the bytes of its buffers."""
    if offset < 0 or not 0 < length <= MAX_METADATA_BYTES or body < 0 or offset + length + body > len(content):
        raise ValueError("a batch lies outside the file")
    (mark,) = struct.unpack_from("<i", content, offset)
    message = read_root(content[offset + (8 if mark == -1 else 4) : offset + length])
    header, kind = message.table(2), message.number(1, "B")
    if header is not None and kind == 2:  # The header of a dictionary contains a batch.
        header = header.table(1)
    if header is None or kind not in (2, 3):
        raise ValueError("a block of the footer is no batch")
    rows, buffers, compressed = header.number(0, "q"), header.structs(2, "qq"), header.find(3)
    if rows < 0:
        raise ValueError("a batch has a negative number of rows")
    total, start = 0, offset + length
    for place, size in buffers:
        if place < 0 or size < 0 or place + size > body:
            raise ValueError("a buffer lies outside its batch")
        stated = struct.unpack_from("<q", content, start + place)[0] if compressed and size >= 8 else -1
        if stated < -1:
            raise ValueError("a buffer states a negative size")
        total += size if stated == -1 else stated
    return rows, total
