"""Encodings of the rotation and size of a box as numbers that a network can regress.

`cholesky` is the paper's encoding (Sec. 3.1), and `quaternion` is the paper's baseline. The paper does not have
`octahedral`. Each box can be described in 24 ways, which differ in the order and the signs of the axes. An ideal
encoding has three properties: it is continuous, each box has exactly one code, and each code describes exactly one box.

* quaternion and size: This encoding has none of the three properties. The quaternions q and -q describe the same
  rotation. Rotating the box by 180 degrees about one of its axes gives the same box but a different quaternion. A
  convention such as w >= 0 makes the code discontinuous.
* Cholesky factor of the scatter matrix: This encoding is continuous, and each box has one code. However, some codes
  describe several boxes. If two extents are equal, the scatter matrix does not determine the rotation in the plane of
  these two axes. If two extents l and w are similar, an error d in S rotates the decoded box by
  atan(2 d / |l - w|) / 2.
* octahedral: The code consists of the scatter matrix S and the frame tensor T of the box. S is sum_j s_j v_j v_j^T, and
  T is sum_j v_j (x) v_j (x) v_j (x) v_j. S and T do not depend on the order and the signs of the axes. They are
  polynomials. Each box therefore has one code, and the encoding is smooth. T is invariant only under the 24 symmetries
  of a cube. T therefore determines the three axes, even if the box is a cube. S then gives the extent along each axis.
  The octahedral encoding has all three properties for every rotation (tests/unit/test_ablation.py).

T is symmetric and has 15 distinct entries. The trace part of T is constant, because the v_j are orthonormal. The
traceless part of T is described by nine numbers: its coefficients in the spherical harmonics of degree four. These
harmonics represent cross frames in hexahedral meshing (Huang et al., Boundary aligned smooth 3D cross-frame field,
2011). For an upright box, two harmonics vary as cos 4 yaw and sin 4 yaw, and seven are constant.

The functions use numpy in float64 and accept any leading batch shape.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from models.geometry.cholesky import (
    MIN_EXTENT_M,
    TRIL,
    compute_cholesky_parameters,
    compute_scatter_matrix,
    decode_cholesky_boxes,
)

TRACE_PART = 3 / 5  # Mean of sum_j (v_j . x)^4 over the unit sphere.
STARTS, ROUNDS = 4, 12  # Number of starts of the axis search, and number of iterations per start.


class Encoding(NamedTuple):
    """An encoding of boxes.

    Attributes:
        entries: Number of entries of the code of a box.
        encode: Maps rotation (..., 3, 3) and size_m (..., 3) to codes (..., entries).
        decode: Maps any finite codes to rotation (..., 3, 3), right-handed, and size_m (..., 3). Extents below 1 cm
            count as 1 cm, both in encoding and in decoding.
    """

    entries: int
    encode: Callable[[np.ndarray, np.ndarray], np.ndarray]
    decode: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


# -------------------------------------------------------------------------------------------------- quaternion


def encode_quaternions(rotation: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """Encode boxes as unit quaternions and extents.

    The axes are not reordered. A box with the opposite heading therefore has a different code.

    Args:
        rotation: (..., 3, 3) matrices; their columns are the axes of the boxes.
        size_m: (..., 3) full extents along these axes (metres).

    Returns:
        (..., 7): quaternion x, y, z, w with w >= 0, then the three extents in metres.
    """
    rotation = np.asarray(rotation, np.float64)
    quaternion = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat(canonical=True)
    size_m = np.maximum(np.asarray(size_m, np.float64), MIN_EXTENT_M)
    return np.concatenate([quaternion.reshape(*rotation.shape[:-2], 4), size_m], axis=-1)


def decode_quaternion_boxes(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Decode quaternions and extents to boxes.

    Args:
        parameters: (..., 7): quaternion x, y, z, w of any length above 0, then three extents in metres.

    Returns:
        rotation (..., 3, 3) and size_m (..., 3).

    Raises:
        ValueError: A quaternion is all zeros.
    """
    parameters = np.asarray(parameters, np.float64)
    rotation = Rotation.from_quat(parameters[..., :4].reshape(-1, 4)).as_matrix()
    return rotation.reshape(*parameters.shape[:-1], 3, 3), np.maximum(parameters[..., 4:], MIN_EXTENT_M)


# -------------------------------------------------------------------------------------------------- octahedral


@cache
def compute_harmonics() -> np.ndarray:
    """Compute an orthonormal basis (9, 3, 3, 3, 3) of the traceless symmetric tensors of rank four.

    The order of the basis tensors is cos 4 yaw, sin 4 yaw, cos 3 yaw, ..., sin yaw, 1. The basis is formed by the
    coefficients of t^k in n(t)^4, where n(t) . n(t) = 0. Because of this condition, n(t)^4 is traceless. For k = 0, the
    coefficient is (x + iy)^4.
    """
    parts = np.array([[1, 1j, 0], [0, 0, -2], [-1, 1j, 0]])  # n(t) = parts[0] + parts[1] t + parts[2] t^2
    tensors = np.zeros((9, 3, 3, 3, 3), complex)
    for power in product(range(3), repeat=4):
        tensors[sum(power)] += np.einsum("a,b,c,d->abcd", *parts[list(power)])
    basis = np.stack([part for k in range(4) for part in (tensors[k].real, tensors[k].imag)] + [tensors[4].real])
    return basis / np.sqrt((basis**2).sum(axis=(1, 2, 3, 4), keepdims=True))


@cache
def compute_isotropic_part() -> np.ndarray:
    """Compute the symmetric tensor (3, 3, 3, 3) of the polynomial |x|^4."""
    eye = np.eye(3)
    pairs = np.einsum("ab,cd->abcd", eye, eye)
    return (pairs + pairs.transpose(0, 2, 1, 3) + pairs.transpose(0, 3, 2, 1)) / 3


def encode_octahedral(rotation: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """Encode boxes as a scatter matrix and a frame tensor.

    Args:
        rotation: (..., 3, 3) matrices; their columns are the axes of the boxes.
        size_m: (..., 3) full extents along these axes (metres).

    Returns:
        (..., 15): row-major lower triangle of the scatter matrix in metres, then the nine harmonics of the frame
        tensor.
    """
    rotation, size_m = np.asarray(rotation, np.float64), np.maximum(np.asarray(size_m, np.float64), MIN_EXTENT_M)
    scatter = compute_scatter_matrix(rotation, size_m)[..., TRIL[0], TRIL[1]]
    square = np.einsum("...aj,...bj->...jab", rotation, rotation)
    fourth = np.einsum("...jab,...jcd->...abcd", square, square)
    return np.concatenate([scatter, np.einsum("kabcd,...abcd->...k", compute_harmonics(), fourth)], axis=-1)


def decode_octahedral_boxes(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Decode scatter matrices and frame tensors to boxes.

    The decoded axes are those whose frame tensor is nearest to the code. The extents are s_j = v_j^T S v_j. The extents
    are linear in S. Errors are therefore not amplified if two extents are similar.

    Args:
        parameters: (..., 15) codes in the format of `encode_octahedral`.

    Returns:
        rotation (..., 3, 3), right-handed, and size_m (..., 3) in metres.
    """
    parameters = np.asarray(parameters, np.float64)
    scatter = np.zeros((*parameters.shape[:-1], 3, 3))
    scatter[..., TRIL[0], TRIL[1]] = scatter[..., TRIL[1], TRIL[0]] = parameters[..., :6]
    axes = find_nearest_frame(parameters[..., 6:])
    return axes, np.maximum(np.einsum("...aj,...ab,...bj->...j", axes, scatter, axes), MIN_EXTENT_M)


def find_nearest_frame(harmonic: np.ndarray) -> np.ndarray:
    """Find the axes whose frame tensor is nearest to a set of harmonics.

    These axes maximise sum_j T(v_j, v_j, v_j, v_j). Each iteration replaces the axes by the orthogonal polar factor of
    the gradient. The sum never decreases. The method follows Zhai et al., Complete dictionary learning via l4-norm
    maximization, 2020. Near the maximum, each iteration triples the number of correct digits. The search starts from
    STARTS fixed frames and keeps the best result.

    Args:
        harmonic: (..., 9) coefficients of the harmonics; a common factor has no effect.

    Returns:
        (..., 3, 3) right-handed rotation matrices, whose columns are the axes.
    """
    harmonic = np.asarray(harmonic, np.float64)
    flat = harmonic.reshape(-1, 9)
    unit = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
    length = np.sqrt(3 - 5 * TRACE_PART**2)  # Norm of the traceless part of T.
    tensor = np.einsum("nk,kabcd->nabcd", unit * length, compute_harmonics()) + TRACE_PART * compute_isotropic_part()
    best, best_value = np.zeros((len(flat), 3, 3)), np.full(len(flat), -np.inf)
    for start in Rotation.random(STARTS, rng=np.random.default_rng(0)).as_matrix():
        axes = np.broadcast_to(start, (len(flat), 3, 3))
        for _ in range(ROUNDS):
            left, _, right = np.linalg.svd(_compute_gradient(tensor, axes))
            axes = left @ right
        value = np.einsum("naj,naj->n", _compute_gradient(tensor, axes), axes)
        better = value > best_value
        best[better], best_value[better] = axes[better], value[better]
    best[:, :, 0] *= np.where(np.linalg.det(best) < 0, -1.0, 1.0)[:, None]
    return best.reshape(*harmonic.shape[:-1], 3, 3)


def _compute_gradient(tensor: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return the gradient (n, 3, 3), whose column j is T(v_j, v_j, v_j, .)."""
    square = np.einsum("naj,nbj->nabj", axes, axes)
    half = np.einsum("nabcd,nabj->ncdj", tensor, square)
    return np.einsum("ncdj,ncj->ndj", half, axes)


ENCODINGS = {
    "cholesky": Encoding(6, compute_cholesky_parameters, decode_cholesky_boxes),
    "quaternion": Encoding(7, encode_quaternions, decode_quaternion_boxes),
    "octahedral": Encoding(15, encode_octahedral, decode_octahedral_boxes),
}
