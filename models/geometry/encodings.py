"""Ways to write the shape of a box (rotation and size) as numbers that a network can regress.

`cholesky` is the paper's (Sec. 3.1), `quaternion` the baseline that it compares with, `octahedral` ours. A box is a set
of points, so its 24 descriptions (axes renamed or turned round) should have one code, different boxes different codes,
and a small change of the box should be a small change of the code:

* quaternion and size: neither. q and -q are one rotation, and turning a box by 180 degrees about an axis gives the
  same box another q. Wherever a convention picks one of them (here w >= 0), the code jumps.
* Cholesky factor of the scatter matrix: continuous, and one code per box, but not one box per code. Where two extents
  are equal their plane is isotropic and the angle in it is gone. Near that, noise d in S turns the box by
  atan(2 d / |l - w|) / 2.
* octahedral: the scatter matrix S = sum_j s_j v_j v_j^T and the frame tensor T = sum_j v_j (x) v_j (x) v_j (x) v_j.
  Both are polynomials that do not notice which axis is first or which way it points, so equal boxes have equal codes
  and the code is as smooth as the box. T is unchanged by exactly the 24 symmetries of a cube, so it gives the
  three axes whatever the extents, cubes included; S then gives the extent along each. One code per box, one box per
  code, continuous both ways: for every rotation, not for yaw alone (tests/unit/test_ablation.py).

T is symmetric; of its 15 entries the trace part never changes, since the v_j are orthonormal. What remains is
traceless and has nine entries: the spherical harmonics of degree four. They represent cross frames in hexahedral
meshing (Huang et al., Boundary aligned smooth 3D cross-frame field, 2011). For an upright box two of them turn, as
cos 4 yaw and sin 4 yaw, and seven stand still.

Plain numpy, float64, any leading batch shape, as in cholesky.py.
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

TRACE_PART = 3 / 5  # the mean over the unit sphere of sum_j (v_j . x)^4
STARTS, ROUNDS = 4, 12  # of the search for the frame: tests/unit/test_ablation.py


class Encoding(NamedTuple):
    """`encode(rotation (..., 3, 3), size_m (..., 3))` gives (..., entries); `decode` goes back, right-handed.

    Decoding takes any finite numbers. Extents below 1 cm count as 1 cm, both ways.
    """

    entries: int
    encode: Callable[[np.ndarray, np.ndarray], np.ndarray]
    decode: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


# -------------------------------------------------------------------------------------------------- quaternion


def encode_quaternions(rotation: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """(..., 7): the unit quaternion x, y, z, w >= 0 of the rotation, then the three extents in metres.

    Axes are taken as they come: a heading of yaw + 180 degrees is another code for the same box.
    """
    rotation = np.asarray(rotation, np.float64)
    quaternion = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat(canonical=True)
    size_m = np.maximum(np.asarray(size_m, np.float64), MIN_EXTENT_M)
    return np.concatenate([quaternion.reshape(*rotation.shape[:-2], 4), size_m], axis=-1)


def decode_quaternion_boxes(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """rotation (..., 3, 3) and size_m (..., 3) from (..., 7). Raises ValueError for a quaternion that is all zeros."""
    parameters = np.asarray(parameters, np.float64)
    rotation = Rotation.from_quat(parameters[..., :4].reshape(-1, 4)).as_matrix()
    return rotation.reshape(*parameters.shape[:-1], 3, 3), np.maximum(parameters[..., 4:], MIN_EXTENT_M)


# -------------------------------------------------------------------------------------------------- octahedral


@cache
def compute_harmonics() -> np.ndarray:
    """(9, 3, 3, 3, 3) orthonormal basis of the traceless symmetric tensors of rank four.

    In the order cos 4 yaw, sin 4 yaw, cos 3 yaw, ..., sin yaw, 1. Coefficients of t^k in n(t)^4 with n(t) . n(t) = 0:
    such powers are traceless, and k = 0 is (x + iy)^4.
    """
    parts = np.array([[1, 1j, 0], [0, 0, -2], [-1, 1j, 0]])  # n(t) = parts[0] + parts[1] t + parts[2] t^2
    tensors = np.zeros((9, 3, 3, 3, 3), complex)
    for power in product(range(3), repeat=4):
        tensors[sum(power)] += np.einsum("a,b,c,d->abcd", *parts[list(power)])
    basis = np.stack([part for k in range(4) for part in (tensors[k].real, tensors[k].imag)] + [tensors[4].real])
    return basis / np.sqrt((basis**2).sum(axis=(1, 2, 3, 4), keepdims=True))


@cache
def compute_isotropic_part() -> np.ndarray:
    """(3, 3, 3, 3) the symmetric tensor of |x|^4."""
    eye = np.eye(3)
    pairs = np.einsum("ab,cd->abcd", eye, eye)
    return (pairs + pairs.transpose(0, 2, 1, 3) + pairs.transpose(0, 3, 2, 1)) / 3


def encode_octahedral(rotation: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """(..., 15): the scatter matrix in metres, row-major lower triangle, then the nine harmonics of the axes."""
    rotation, size_m = np.asarray(rotation, np.float64), np.maximum(np.asarray(size_m, np.float64), MIN_EXTENT_M)
    scatter = compute_scatter_matrix(rotation, size_m)[..., TRIL[0], TRIL[1]]
    square = np.einsum("...aj,...bj->...jab", rotation, rotation)
    fourth = np.einsum("...jab,...jcd->...abcd", square, square)
    return np.concatenate([scatter, np.einsum("kabcd,...abcd->...k", compute_harmonics(), fourth)], axis=-1)


def decode_octahedral_boxes(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """rotation (..., 3, 3), right-handed, and size_m (..., 3) from (..., 15).

    Axes are those of the nearest frame tensor, extents s_j = v_j^T S v_j: linear in S, so nothing is divided by a
    difference of extents.
    """
    parameters = np.asarray(parameters, np.float64)
    scatter = np.zeros((*parameters.shape[:-1], 3, 3))
    scatter[..., TRIL[0], TRIL[1]] = scatter[..., TRIL[1], TRIL[0]] = parameters[..., :6]
    axes = find_nearest_frame(parameters[..., 6:])
    return axes, np.maximum(np.einsum("...aj,...ab,...bj->...j", axes, scatter, axes), MIN_EXTENT_M)


def find_nearest_frame(harmonic: np.ndarray) -> np.ndarray:
    """Find the right-handed axes (..., 3, 3) whose frame tensor is nearest to (..., 9).

    They maximise sum_j T(v_j, v_j, v_j, v_j).

    Monotone ascent: axes <- the orthogonal polar factor of the gradient (Zhai et al., Complete dictionary learning via
    l4-norm maximization, 2020), which triples the correct digits per round, from STARTS fixed frames.
    """
    harmonic = np.asarray(harmonic, np.float64)
    flat = harmonic.reshape(-1, 9)
    unit = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
    length = np.sqrt(3 - 5 * TRACE_PART**2)  # of the harmonics of any frame: |T|^2 = 3 less the trace part
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
    """(n, 3, 3): column j is T(v_j, v_j, v_j, .)."""
    square = np.einsum("naj,nbj->nabj", axes, axes)
    half = np.einsum("nabcd,nabj->ncdj", tensor, square)
    return np.einsum("ncdj,ncj->ndj", half, axes)


ENCODINGS = {
    "cholesky": Encoding(6, compute_cholesky_parameters, decode_cholesky_boxes),
    "quaternion": Encoding(7, encode_quaternions, decode_quaternion_boxes),
    "octahedral": Encoding(15, encode_octahedral, decode_octahedral_boxes),
}
