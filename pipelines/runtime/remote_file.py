"""Read parts of a file in object storage with few requests."""

from __future__ import annotations

import io
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

import pyarrow as pa

TAIL_BYTES = 2**17  # The end of a file is read first: the footer of a Parquet file, or the whole of a small file.
HEAD_BYTES = 16
GAP_BYTES = 2**17  # Ranges with at most this gap are read by one request.
MAX_BYTES = 2**30  # Larger requests to `prefetch` are ignored: a damaged file may state any size.
NUM_THREADS = 8


class RemoteFile(io.RawIOBase):
    """A file whose ranges can be read in advance. Other reads cause one request each.

    Args:
        file: Open file of a remote file system.
    """

    def __init__(self, file: pa.NativeFile) -> None:
        super().__init__()
        self._file, self._size, self._at = file, file.size(), 0
        self._parts: list[tuple[int, bytes]] = []
        self.prefetch([(0, HEAD_BYTES), (max(0, self._size - TAIL_BYTES), self._size)])

    def prefetch(self, ranges: Iterable[tuple[int, int]]) -> None:
        """Read ranges and keep them in memory; near ranges are read together.

        Args:
            ranges: Positions of the first byte, and of the byte after the last one. Bytes outside the file are ignored.
        """
        merged: list[tuple[int, int]] = []
        for first, last in sorted((max(0, first), min(last, self._size)) for first, last in ranges):
            if first >= last or self._find(first, last - first) is not None:
                continue
            if merged and first - merged[-1][1] <= GAP_BYTES:
                merged[-1] = merged[-1][0], max(merged[-1][1], last)
            else:
                merged.append((first, last))
        if sum(last - first for first, last in merged) > MAX_BYTES:
            return
        with ThreadPoolExecutor(NUM_THREADS) as pool:
            found = pool.map(lambda part: self._file.read_at(part[1] - part[0], part[0]), merged)
            self._parts += [(first, data) for (first, _), data in zip(merged, found, strict=True)]

    def _find(self, first: int, count: int) -> bytes | None:
        for start, data in self._parts:
            if start <= first and first + count <= start + len(data):
                return data[first - start : first - start + count]
        return None

    def read(self, size: int | None = -1, /) -> bytes:
        """Read bytes from the current position, all if `size` is negative."""
        left = max(0, self._size - self._at)
        count = left if size is None or size < 0 else min(size, left)
        data = self._find(self._at, count) if count else b""
        if data is None:
            data = self._file.read_at(count, self._at)
        self._at += len(data)
        return data

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        """Change the position; return it."""
        self._at = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence]
        return self._at

    def tell(self) -> int:
        """Return the position."""
        return self._at

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def size(self) -> int:
        """Return the size of the file (bytes)."""
        return self._size
