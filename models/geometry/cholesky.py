"""Rotation and size <-> scatter matrix <-> six Cholesky parameters (paper, Sec. 3.1 and supplement B.1).

S = R diag(l, w, h) R^T with full extents (not squared), S = L L^T, c = the six non-zero entries of L. Entries of L
are in sqrt(metres); those off the diagonal are signed. The paper leaves open which entry order and which bounds:
row-major (L00, L10, L11, L20, L21, L22), bounds from the training split.

Plain numpy, any leading batch shape: encoding happens on data, decoding on what a network gave, neither needs a
gradient.
"""

from __future__ import annotations

import numpy as np

TRIL = np.tril_indices(3)
MIN_EXTENT_M = 0.01


def compute_scatter_matrix(rotation: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """S (..., 3, 3) of boxes with axes rotation[..., :, j] and full extents size_m[..., j] (supplement Eq. 1)."""
    return np.einsum("...ij,...j,...kj->...ik", rotation, size_m, rotation)


def compute_cholesky_parameters(rotation: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """c (..., 6), float64, of boxes (supplement Eq. 2). Extents below 1 cm count as 1 cm."""
    size_m = np.maximum(np.asarray(size_m, np.float64), MIN_EXTENT_M)
    lower = np.linalg.cholesky(compute_scatter_matrix(np.asarray(rotation, np.float64), size_m))
    return lower[..., TRIL[0], TRIL[1]]


def decode_cholesky_boxes(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """rotation (..., 3, 3), right-handed, and size_m (..., 3) from c (..., 6) (supplement, Reconstruction).

    Any six finite numbers give a box: S = L L^T is positive semi-definite whatever L is, extents below 1 cm are
    clamped to 1 cm, and one column is flipped where the eigenvectors come out left-handed. Extents are ascending;
    `scene.canonicalize_boxes` puts them in order.
    """
    parameters = np.asarray(parameters, np.float64)
    lower = np.zeros((*parameters.shape[:-1], 3, 3))
    lower[..., TRIL[0], TRIL[1]] = parameters
    extents, axes = np.linalg.eigh(lower @ np.swapaxes(lower, -1, -2))
    handed = np.where(np.linalg.det(axes) < 0, -1.0, 1.0)
    axes[..., :, 0] *= handed[..., None]
    return axes, np.maximum(extents, MIN_EXTENT_M)
