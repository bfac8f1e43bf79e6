"""Convert the rotation and size of a box to six Cholesky parameters and back (paper, Sec. 3.1, supplement B.1).

The scatter matrix is S = R diag(l, w, h) R^T. The full extents l, w and h are not squared. The Cholesky factor L of S
fulfils S = L L^T. The six parameters c are the lower-triangular entries of L. Entries of L have the unit sqrt(metres);
off-diagonal entries may be negative.

The paper does not specify the order and the bounds of the entries. This module uses the row-major order (L00, L10, L11,
L20, L21, L22). Bounds come from the training split.

The functions use numpy, because no gradients are needed. The functions accept any leading batch shape.
"""

from __future__ import annotations

import numpy as np

TRIL = np.tril_indices(3)
MIN_EXTENT_M = 0.01


def compute_scatter_matrix(rotation: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """Compute the scatter matrices of boxes (supplement Eq. 1).

    Args:
        rotation: (..., 3, 3) matrices; their columns are the axes of the boxes.
        size_m: (..., 3) full extents along these axes (metres).

    Returns:
        S (..., 3, 3) in metres.
    """
    return np.einsum("...ij,...j,...kj->...ik", rotation, size_m, rotation)


def compute_cholesky_parameters(rotation: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """Compute the Cholesky parameters of boxes (supplement Eq. 2).

    Args:
        rotation: (..., 3, 3) matrices; their columns are the axes of the boxes.
        size_m: (..., 3) full extents along these axes (metres). Extents below 1 cm count as 1 cm.

    Returns:
        c (..., 6), float64, in sqrt(metres).
    """
    size_m = np.maximum(np.asarray(size_m, np.float64), MIN_EXTENT_M)
    lower = np.linalg.cholesky(compute_scatter_matrix(np.asarray(rotation, np.float64), size_m))
    return lower[..., TRIL[0], TRIL[1]]


def decode_cholesky_boxes(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Decode Cholesky parameters to boxes (supplement, Reconstruction).

    Any six finite numbers decode to a box, because S = L L^T is positive semi-definite for every L. If the eigenvectors
    are left-handed, one axis is flipped. Extents below 1 cm are clamped to 1 cm.

    Args:
        parameters: c (..., 6) in sqrt(metres).

    Returns:
        rotation (..., 3, 3), right-handed, and size_m (..., 3) in ascending order; `scene.canonicalize_boxes` reorders
        the axes.
    """
    parameters = np.asarray(parameters, np.float64)
    lower = np.zeros((*parameters.shape[:-1], 3, 3))
    lower[..., TRIL[0], TRIL[1]] = parameters
    extents, axes = np.linalg.eigh(lower @ np.swapaxes(lower, -1, -2))
    handed = np.where(np.linalg.det(axes) < 0, -1.0, 1.0)
    axes[..., :, 0] *= handed[..., None]
    return axes, np.maximum(extents, MIN_EXTENT_M)
