"""Wrappers of scipy.ndimage functions for masks. They add exact return types, which scipy's annotations lack."""

from __future__ import annotations

from typing import cast

import numpy as np
from scipy import ndimage


def label_parts(mask: np.ndarray, structure: np.ndarray | None = None) -> tuple[np.ndarray, int]:
    """Number the connected parts of a mask.

    Args:
        mask: (...) bool.
        structure: Neighbourhood of an element, as in `scipy.ndimage.label` (default: elements that share a face).

    Returns:
        (...) int32 part number of each element (1, 2, ... inside the mask, 0 outside), and the number of parts.
    """
    return cast("tuple[np.ndarray, int]", ndimage.label(mask, structure))


def measure_depth(mask: np.ndarray) -> np.ndarray:
    """Return the distance of each element of a mask to the nearest element outside the mask.

    Args:
        mask: (...) bool.

    Returns:
        (...) float64 Euclidean distance in elements; 0 outside the mask.
    """
    return cast(np.ndarray, ndimage.distance_transform_edt(mask))


def find_nearest_true(mask: np.ndarray) -> tuple[np.ndarray, ...]:
    """For each element, find the nearest element inside the mask.

    Args:
        mask: (...) bool with at least one True element.

    Returns:
        One index array (...) per axis.
    """
    indices = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    return tuple(cast(np.ndarray, indices))
