"""Read and write pictures in ADM's .npz sample batches, and read the moments of its reference batches.

ADM (guided-diffusion, evaluations/) keeps N pictures as array `arr_0`, uint8 (N, height, width, 3). Its reference
batches also hold the moments of the whole dataset. `mu` and `sigma` belong to the pool3 features; `mu_s` and `sigma_s`
belong to the spatial features. ADM's evaluator can read the files that `write_npz` writes. Pictures are read and
written in batches. Only one batch is in memory at a time.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Iterator
from itertools import chain
from typing import NamedTuple

import numpy as np

from models.limits import require_within
from pipelines.metrics.frechet import StoredGaussian
from pipelines.runtime.npz import ArrayHeader, NpzArchive, open_npz
from pipelines.runtime.storage import write_whole

PICTURES = "arr_0"
FEATURES, SPATIAL_FEATURES = 2048, 2023  # Dimensions of the pool3 features and of the spatial features.
ASYMMETRY = 1e-3  # Largest accepted asymmetry of a covariance, relative to its largest entry.
LARGEST = 1e30  # Largest accepted number in moments; products of such numbers are finite.


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


def read_picture_shape(path: str) -> tuple[int, int, int, int]:
    """Return the shape of the pictures in an ADM .npz without reading the pictures.

    Args:
        path: Local path or URI of the archive.

    Returns:
        (N, height, width, 3).

    Raises:
        ValueError: The file is missing, is damaged or has another type. The message names the file.
    """
    with open_npz(path) as archive:
        shape, dtype, is_fortran = archive.describe(PICTURES)
    if dtype != np.uint8 or len(shape) != 4 or shape[3] != 3 or 0 in shape[1:]:
        raise ValueError(
            f"{path}: {PICTURES} is {dtype} {shape}; pictures are uint8 (N, height, width, 3), values 0 to 255"
        )
    if is_fortran:
        raise ValueError(f"{path}: {PICTURES} is in Fortran order; save numpy.ascontiguousarray(array)")
    count, height, width, channels = shape
    require_within("array_bytes", height * width * channels, f"{path}: a picture of {height} x {width}")
    return count, height, width, channels


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
    count, height, width, channels = read_picture_shape(path)
    batch_bytes = min(batch, count) * height * width * channels
    require_within("array_bytes", batch_bytes, f"{path}: {min(batch, count)} pictures of {height} x {width}")
    return _iterate_batches(path, batch)


def _iterate_batches(path: str, batch: int) -> Iterator[np.ndarray]:
    with open_npz(path) as archive:
        yield from archive.iterate(PICTURES, batch)


def read_reference_moments(path: str) -> ReferenceMoments | None:
    """Return the precomputed moments of an ADM reference batch as float64.

    Args:
        path: Local path or URI of the archive.

    Returns:
        Moments. None: the file holds only pictures.

    Raises:
        ValueError: The moments are incomplete, have unexpected sizes or are not finite. The message names the file.
    """
    with open_npz(path) as archive:
        held = {name for name in ("mu", "sigma", "mu_s", "sigma_s") if name in archive.names}
        if not held:
            return None
        if held not in ({"mu", "sigma"}, {"mu", "sigma", "mu_s", "sigma_s"}):
            raise ValueError(
                f"{path}: holds {sorted(held)} only; a mean (mu) and its covariance (sigma) are needed together"
            )
        pool3 = _read_moments(archive, "mu", "sigma", FEATURES)
        spatial = _read_moments(archive, "mu_s", "sigma_s", SPATIAL_FEATURES) if "mu_s" in held else None
    return ReferenceMoments(pool3, spatial)


def _read_moments(archive: NpzArchive, mean_name: str, covariance_name: str, size: int) -> StoredGaussian:
    mean = _read_numbers(archive, mean_name, (size,))
    covariance = _read_numbers(archive, covariance_name, (size, size))
    largest = np.abs(covariance).max()
    if (covariance.diagonal() < 0).any() or not np.abs(covariance - covariance.T).max() <= ASYMMETRY * largest:
        raise ValueError(
            f"{archive.uri}: {covariance_name} is no covariance matrix, because it is not symmetric or has a negative"
            " variance; write the file again"
        )
    return StoredGaussian(mean, covariance)


def _read_numbers(archive: NpzArchive, name: str, shape: tuple[int, ...]) -> np.ndarray:
    def check(header: ArrayHeader) -> None:
        if header.shape != shape or header.dtype.kind != "f":
            raise ValueError(
                f"{archive.uri}: {name} has type {header.dtype} and shape {header.shape}, expected floats of shape"
                f" {shape}"
            )

    with np.errstate(over="ignore"):  # Numbers of more than 64 bits become infinite.
        numbers = archive.read(name, check).astype(np.float64)
    if not (np.abs(numbers) <= LARGEST).all():
        raise ValueError(f"{archive.uri}: {name} holds NaN, infinite numbers or numbers beyond {LARGEST:.0e}")
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
