"""Read and write pictures in ADM's .npz sample batches, and read the moments of its reference batches.

ADM (guided-diffusion, evaluations/) keeps N pictures as array `arr_0`, uint8 (N, height, width, 3). Its reference
batches also hold the moments of the whole dataset. `mu` and `sigma` belong to the pool3 features; `mu_s` and `sigma_s`
belong to the spatial features. ADM's evaluator can read the files that `write_npz` writes. Pictures are read and
written in batches. Only one batch is in memory at a time.
"""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import chain
from typing import NamedTuple, cast

import numpy as np
import pyarrow as pa

from pipelines.metrics.frechet import StoredGaussian
from pipelines.metrics.inception import FEATURES, SPATIAL_FEATURES
from pipelines.runtime.storage import resolve_uri, write_whole

PICTURES = "arr_0"


class ReferenceMoments(NamedTuple):
    """Mean and covariance of the features of an ADM reference batch.

    Attributes:
        pool3: Moments of the pool3 features (2048 dimensions).
        spatial: Moments of the spatial features (2023 dimensions). None: the file holds only `mu` and `sigma`, like the
            files of other evaluators.
    """

    pool3: StoredGaussian
    spatial: StoredGaussian | None


# -------------------------------------------------------------------------------------------------------- reading


@contextmanager
def _open_npz(path: str) -> Iterator[zipfile.ZipFile]:
    """Open an archive. If opening or a later read fails, raise a ValueError that names the path."""
    fs, inside = resolve_uri(path)
    try:
        with fs.open_input_file(inside) as file, zipfile.ZipFile(file) as archive:
            yield archive
    except FileNotFoundError as error:
        raise ValueError(f"{path}: no such file") from error
    except (zipfile.BadZipFile, zlib.error, EOFError, pa.ArrowInvalid) as error:
        raise ValueError(f"{path}: damaged or not an .npz archive ({error}); copy or write the file again") from error


@contextmanager
def _read_array(archive: zipfile.ZipFile, name: str, path: str) -> Iterator[tuple[zipfile.ZipExtFile, tuple, np.dtype]]:
    """Open a C-ordered array, and yield three values: the open stream at the first number, the shape and the type.

    Raises:
        ValueError: The array is missing, is pickled, is in Fortran order or has the wrong size.
    """
    if f"{name}.npy" not in archive.namelist():
        raise ValueError(f"{path}: no array {name!r}, only {sorted(archive.namelist())}")
    with archive.open(f"{name}.npy") as stream:
        try:
            version = np.lib.format.read_magic(stream)
            readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
            shape, fortran, dtype = readers[version](stream)
        except (ValueError, KeyError) as error:
            raise ValueError(f"{path}: {name} is not a plain numpy array ({error})") from error
        if dtype.hasobject:
            raise ValueError(
                f"{path}: {name} holds pickled objects; they are not read, so save the array as plain numbers"
            )
        if fortran and len(shape) > 1:
            raise ValueError(f"{path}: {name} is in Fortran order; save numpy.ascontiguousarray(array)")
        needed, held = math.prod(shape) * dtype.itemsize, archive.getinfo(f"{name}.npy").file_size - stream.tell()
        if held != needed:
            raise ValueError(f"{path}: {name} of shape {shape} needs {needed} bytes, has {held}; write the file again")
        yield cast(zipfile.ZipExtFile, stream), shape, dtype


def read_picture_shape(path: str) -> tuple[int, int, int, int]:
    """Return the shape of the pictures in an ADM .npz without reading the pictures.

    Args:
        path: Local path or URI of the archive.

    Returns:
        (N, height, width, 3).

    Raises:
        ValueError: The file is missing, is damaged or has another type. The message names the file.
    """
    with _open_npz(path) as archive, _read_array(archive, PICTURES, path) as (_, shape, dtype):
        if dtype != np.uint8 or len(shape) != 4 or shape[3] != 3:
            raise ValueError(
                f"{path}: {PICTURES} is {dtype} {shape}; pictures are uint8 (N, height, width, 3), values 0 to 255"
            )
    return shape


def iterate_pictures(path: str, batch: int) -> Iterator[np.ndarray]:
    """Read pictures in batches, in the order of the file, with one batch in memory at a time.

    Args:
        path: Local path or URI of the archive, which may be compressed.
        batch: Pictures per batch.

    Returns:
        Iterator of uint8 arrays (batch, height, width, 3); the last array may be shorter.

    Raises:
        ValueError: The file is missing, is truncated, has another type, is pickled or has a wrong checksum. A wrong
            checksum is found only while the file is read. The message names the file.
    """
    if batch < 1:
        raise ValueError(f"a batch must hold at least 1 picture, got {batch}")
    return _iterate_batches(path, read_picture_shape(path), batch)


def _iterate_batches(path: str, shape: tuple[int, int, int, int], batch: int) -> Iterator[np.ndarray]:
    with _open_npz(path) as archive, _read_array(archive, PICTURES, path) as (stream, _, _):
        for start in range(0, shape[0], batch):
            pictures = np.empty((min(batch, shape[0] - start), *shape[1:]), np.uint8)
            if (read := stream.readinto(pictures.data)) != pictures.nbytes:
                raise ValueError(
                    f"{path}: picture {start + read // pictures[0].nbytes} is cut off; write the file again"
                )
            yield pictures


def read_reference_moments(path: str) -> ReferenceMoments | None:
    """Return the precomputed moments of an ADM reference batch as float64.

    Args:
        path: Local path or URI of the archive.

    Returns:
        Moments. None: the file holds only pictures.

    Raises:
        ValueError: The moments are incomplete, have unexpected sizes or are not finite. The message names the file.
    """
    with _open_npz(path) as archive:
        held = {name for name in ("mu", "sigma", "mu_s", "sigma_s") if f"{name}.npy" in archive.namelist()}
        if not held:
            return None
        if held not in ({"mu", "sigma"}, {"mu", "sigma", "mu_s", "sigma_s"}):
            raise ValueError(
                f"{path}: holds {sorted(held)} only; a mean (mu) and its covariance (sigma) are needed together"
            )
        pool3 = StoredGaussian(
            _read_numbers(archive, "mu", (FEATURES,), path), _read_numbers(archive, "sigma", (FEATURES,) * 2, path)
        )
        if "mu_s" not in held:
            return ReferenceMoments(pool3, None)
        size = SPATIAL_FEATURES
        spatial = StoredGaussian(
            _read_numbers(archive, "mu_s", (size,), path), _read_numbers(archive, "sigma_s", (size, size), path)
        )
    return ReferenceMoments(pool3, spatial)


def _read_numbers(archive: zipfile.ZipFile, name: str, shape: tuple[int, ...], path: str) -> np.ndarray:
    with _read_array(archive, name, path) as (stream, found, dtype):
        if found != shape or dtype.kind != "f":
            raise ValueError(f"{path}: {name} has type {dtype} and shape {found}, expected floats of shape {shape}")
        numbers = np.frombuffer(stream.read(), dtype).reshape(shape).astype(np.float64)
    if not np.isfinite(numbers).all():
        raise ValueError(f"{path}: {name} holds NaN or infinite numbers")
    return numbers


# -------------------------------------------------------------------------------------------------------- writing


def write_npz(path: str, batches: Iterable[np.ndarray], count: int) -> None:
    """Write an ADM sample batch, with one batch of pictures in memory at a time.

    The file appears at its path only after it is complete.

    Args:
        path: Local path or URI of the new archive.
        batches: uint8 arrays (n, height, width, 3); all pictures have the same size.
        count: Total number of pictures.

    Raises:
        ValueError: The pictures differ in size, there are no pictures, or their number is not `count`.
    """
    batches = iter(batches)
    first = next(batches, None)
    if first is None or count < 1:
        raise ValueError(f"{path}: no pictures to write")
    size = first.shape[1:]

    def write(file) -> None:
        written = 0
        # Compression reduces pictures in flat colours to a thirtieth of their size. The zip64 format is always used,
        # because the size of an entry is not known in advance and may exceed 2 GiB.
        with (
            zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive,
            archive.open(f"{PICTURES}.npy", "w", force_zip64=True) as stream,
        ):
            header = {"descr": "|u1", "fortran_order": False, "shape": (count, *size)}
            np.lib.format.write_array_header_1_0(stream, header)
            for pictures in chain([first], batches):
                if pictures.dtype != np.uint8 or pictures.shape[1:] != size or len(size) != 3 or size[2] != 3:
                    raise ValueError(
                        f"{path}: expected uint8 pictures of shape (n, height, width, 3) and equal size, got"
                        f" {pictures.dtype} {pictures.shape}; the {written} pictures before have size {size}"
                    )
                written += len(pictures)
                stream.write(np.ascontiguousarray(pictures).data)
            if written != count:
                raise ValueError(f"{path}: got {written} pictures, expected {count}")

    write_whole(path, write)
