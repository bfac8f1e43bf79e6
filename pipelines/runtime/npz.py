"""Read .npz archives of unknown origin: an array is valid in full, or an error names the file, the array and the fault.

The reader accepts arrays of integers, floats and texts that numpy.savez or numpy.savez_compressed wrote. It compares
the shape and the type that an array states with the size of its zip entry and with the limit array_bytes before it
decompresses the numbers, and it verifies the checksum. It does not read pickled objects.
"""

from __future__ import annotations

import io
import math
import os
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from models.limits import require_within
from pipelines.runtime.storage import resolve_uri

SUFFIX = ".npy"
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # numpy writes no other compression.
ENCRYPTED = 1  # Bit of the flags of a zip entry.
ZIP_STARTS = (b"PK\3\4", b"PK\5\6")  # First bytes of an archive; the latter begin an empty one.
PLAIN_KINDS = "iufU"  # Integers, floats and texts.
HEADER_BYTES = 10_000  # Maximum length of the description of an array, as in numpy.
DIRECTORY_BYTES = 2**20  # Maximum length of the zip directory, which Python reads into memory; it lists the arrays.
SHOWN = 5  # Maximum number of names in an error message.


class NpzError(ValueError):
    """Raised if an archive is missing, damaged or not acceptable. The message names the file."""


class _TypeProblem(ValueError):
    """Raised if an array is intact but has a type that is not read."""


class ArrayHeader(NamedTuple):
    """Description of an array.

    Attributes:
        shape: Shape.
        dtype: Type of a number.
        is_fortran: Whether the first index of the stored numbers changes fastest.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    is_fortran: bool

    @property
    def nbytes(self) -> int:
        """Return the number of bytes of the array."""
        return math.prod(self.shape) * self.dtype.itemsize


class _OpeningStream(io.RawIOBase):
    """A file of which `zipfile` can read at most DIRECTORY_BYTES per call until `is_open` is set.

    `zipfile` reads the directory of an archive in one call, and the file states the length of the directory.
    """

    def __init__(self, inner: Any) -> None:
        self.inner, self.is_open = inner, False

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self.inner.tell()

    def seek(self, offset: int, whence: int = 0) -> int:
        try:
            return self.inner.seek(offset, whence)
        except ValueError as error:  # `zipfile` expects an OSError for a position before the file.
            raise OSError(str(error)) from error

    def read(self, size: int = -1) -> bytes:
        if not self.is_open and size > DIRECTORY_BYTES:
            raise ValueError(f"its directory has {size:,} bytes; at most {DIRECTORY_BYTES:,} are accepted")
        return self.inner.read(*([size] if size >= 0 else []))


class NpzArchive:
    """An open archive.

    Attributes:
        uri: Path or URI for error messages.
        names: Names of the arrays in the order of the file, without the suffix .npy.
    """

    def __init__(self, uri: str, archive: zipfile.ZipFile) -> None:
        self.uri, self._archive = uri, archive
        entries = archive.namelist()
        if twice := [name for name, count in Counter(entries).items() if count > 1]:
            raise NpzError(f"{uri}: two arrays have the name {_shorten(twice[0])}; write the file again")
        self.names = [name.removesuffix(SUFFIX) for name in entries if name.endswith(SUFFIX)]

    def describe(self, name: str) -> ArrayHeader:
        """Read the header of an array, and compare it with the size of the zip entry.

        Args:
            name: Name of the array.

        Returns:
            Shape and type.

        Raises:
            NpzError: The array is missing, is not plain numbers, or has another size than its header states.
        """
        with self._open_entry(name) as (_, header):
            return header

    def read(self, name: str, check: Callable[[ArrayHeader], None] | None = None) -> np.ndarray:
        """Read an array and verify its checksum.

        Args:
            name: Name of the array.
            check: Function that raises an error if the header is not acceptable, before the numbers are read.

        Returns:
            A writeable array.

        Raises:
            ValueError: The array is missing, damaged, not plain numbers, or exceeds the limit array_bytes.
        """
        with self._open_entry(name) as (stream, header):
            if check:
                check(header)
            require_within("array_bytes", header.nbytes, f"{self.uri}: array {name!r}")
            array = np.empty(header.shape[::-1] if header.is_fortran else header.shape, header.dtype)
            self._fill(stream, array, name)
            return array.T if header.is_fortran else array

    def iterate(self, name: str, batch: int) -> Iterator[np.ndarray]:
        """Read an array in batches along its first axis, with one batch in memory at a time.

        Args:
            name: Name of the array, which must be in C order and must not hold empty rows.
            batch: Rows per batch, at least 1.

        Yields:
            Writeable arrays; the last array may be shorter.

        Raises:
            ValueError: As for `read`; the limit array_bytes applies to a batch. The checksum is verified after the last
                batch.
        """
        with self._open_entry(name) as (stream, header):
            rows, *inner = header.shape
            if header.is_fortran or not math.prod(inner):
                raise NpzError(
                    f"{self.uri}: array {name!r} of shape {header.shape} is in Fortran order or has empty rows; save"
                    " numpy.ascontiguousarray of it, with rows that are not empty"
                )
            row_bytes = math.prod(inner) * header.dtype.itemsize
            require_within("array_bytes", min(batch, rows) * row_bytes, f"{self.uri}: a batch of array {name!r}")
            for start in range(0, rows, batch):
                part = np.empty((min(batch, rows - start), *inner), header.dtype)
                self._fill(stream, part, name, start)
                yield part

    @contextmanager
    def _open_entry(self, name: str) -> Iterator[tuple[Any, ArrayHeader]]:
        """Yield the stream at the first number of an array, and the header of the array."""
        if name not in self.names:
            shown = ", ".join(map(_shorten, self.names[:SHOWN])) + ", ..." * (len(self.names) > SHOWN)
            raise NpzError(
                f"{self.uri}: no array {name!r}, only {shown or 'nothing'}; save the array under the name {name!r}"
            )
        place = f"array {name!r}"
        entry = self._archive.getinfo(name + SUFFIX)
        if entry.flag_bits & ENCRYPTED:
            raise NpzError(f"{self.uri}: {place} is encrypted; write the file without a password")
        if entry.compress_type not in METHODS:
            raise NpzError(
                f"{self.uri}: {place} has the compression method {entry.compress_type}; write the file with"
                " numpy.savez_compressed"
            )
        with _name_errors(self.uri, place):
            stream = self._archive.open(entry)
        with stream:
            with _name_errors(self.uri, place):
                header, length = _read_header(stream)
            held = entry.file_size - length
            if held != header.nbytes:
                raise NpzError(
                    f"{self.uri}: {place} of shape {header.shape} needs {header.nbytes:,} bytes, has {held:,}; write"
                    " the file again"
                )
            if entry.compress_type == zipfile.ZIP_STORED and entry.compress_size != entry.file_size:
                raise NpzError(f"{self.uri}: {place} states two sizes; write the file again")
            yield stream, header

    def _fill(self, stream: Any, array: np.ndarray, name: str, first_row: int = 0) -> None:
        """Fill an array from a stream. `zipfile` verifies the checksum at the last byte."""
        with _name_errors(self.uri, f"array {name!r}"):
            # Copies from `readinto` are as large as its target, so the target has the size of a cache.
            target = array.reshape(-1).view(np.uint8).data if array.nbytes else memoryview(bytearray())
            start = 0
            while start < len(target):
                count = stream.readinto(target[start : start + 2**20])
                if not count:
                    row = first_row + start * len(array) // len(target)
                    raise NpzError(f"{self.uri}: array {name!r} is cut off in row {row}; write the file again")
                start += count
            if not array.nbytes:
                stream.read(1)


@contextmanager
def open_npz(source: str | os.PathLike | bytes, name: str = "") -> Iterator[NpzArchive]:
    """Open an .npz archive.

    Args:
        source: Local path or URI of the archive, or its content.
        name: Name of the archive in error messages (default: `source`).

    Yields:
        The archive.

    Raises:
        NpzError: The archive is missing or damaged, or two arrays have the same name.
    """
    uri = name or ("npz" if isinstance(source, bytes) else os.fspath(source))
    with _name_errors(uri):
        file = io.BytesIO(source) if isinstance(source, bytes) else _open_file(uri, source)
    with file:
        guarded = _OpeningStream(file)
        with _name_errors(uri):
            # `zipfile` skips bytes before the archive, which numpy refuses.
            if (start := guarded.read(4)) not in ZIP_STARTS:
                raise NpzError(f"{uri}: begins with {start!r} and is not an .npz archive; write the file again")
            archive = zipfile.ZipFile(guarded)
            guarded.is_open = True
        with archive:
            yield NpzArchive(uri, archive)


def _open_file(uri: str, source: str | os.PathLike) -> Any:
    fs, inside = resolve_uri(source)
    try:
        return fs.open_input_file(inside)
    except FileNotFoundError as error:
        raise NpzError(f"{uri}: no such file") from error
    except OSError as error:
        raise NpzError(f"{uri}: cannot be read ({error})") from error


@contextmanager
def _name_errors(uri: str, place: str = "") -> Iterator[None]:
    """Convert every error into an NpzError.

    A damaged archive makes zipfile, zlib and numpy raise errors of many types.
    """
    try:
        yield
    except NpzError:
        raise
    except _TypeProblem as error:
        raise NpzError(f"{uri}: {place} {error}") from error
    except Exception as error:
        what = f"{place} is damaged" if place else "damaged or not an .npz archive"
        shown = str(error)[:200] or type(error).__name__
        raise NpzError(f"{uri}: {what} ({shown}); copy or write the file again") from error


def _read_header(stream: Any) -> tuple[ArrayHeader, int]:
    """Read the header of a .npy file, and return it with its length in bytes."""
    prefix = stream.read(8)
    version = tuple(prefix[6:8])
    if prefix[:6] != np.lib.format.MAGIC_PREFIX or version not in ((1, 0), (2, 0)):
        raise ValueError(f"begins with {prefix!r}, which is not a numpy array")
    sized = stream.read(2 if version == (1, 0) else 4)
    length = int.from_bytes(sized, "little")
    if length > HEADER_BYTES:
        raise ValueError(f"its header has {length:,} bytes; at most {HEADER_BYTES:,} are accepted")
    text = stream.read(length)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, is_fortran, dtype = read(io.BytesIO(sized + text))
    if any(type(size) is not int or size < 0 for size in shape):
        raise ValueError(f"its shape is {str(shape)[:80]}")
    if dtype.hasobject:
        raise _TypeProblem("holds pickled objects, which are not read; save the array as plain numbers")
    if dtype.kind not in PLAIN_KINDS or dtype.subdtype:
        raise _TypeProblem(f"has the type {str(dtype)[:80]}; convert it to integers, floats or texts and save it again")
    return ArrayHeader(shape, dtype, bool(is_fortran) and len(shape) > 1), len(prefix) + len(sized) + len(text)


def _shorten(name: str) -> str:
    return repr(name if len(name) <= 80 else f"{name[:77]}...")
