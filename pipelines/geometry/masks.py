"""Typed forms of scipy.ndimage's functions on masks, whose annotations do not give the types of their results."""

from __future__ import annotations

from typing import cast

import numpy as np
from scipy import ndimage


def label_parts(mask: np.ndarray, structure: np.ndarray | None = None) -> tuple[np.ndarray, int]:
    """Number the connected parts of a mask.

    Args:
        mask: (...) bool.
        structure: Neighbours of an element, as in `scipy.ndimage.label` (default: those that share a face).

    Returns:
        (...) int32 number of each element's part, 0 outside the mask; and the number of parts.
    """
    return cast("tuple[np.ndarray, int]", ndimage.label(mask, structure))


def measure_depth(mask: np.ndarray) -> np.ndarray:
    """(...) float64 distance of each element of a mask to the nearest element outside it; 0 outside."""
    return cast(np.ndarray, ndimage.distance_transform_edt(mask))


def find_nearest_true(mask: np.ndarray) -> tuple[np.ndarray, ...]:
    """Index arrays (...), one per axis, of the element of a mask that is nearest to each element."""
    indices = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    return tuple(cast(np.ndarray, indices))
