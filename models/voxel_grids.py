"""Sizes of semantic voxel grids, and their coarsening.

A grid is an array [row, col, level] of class ids (pipelines/schema/palette.py). Row 0 is the farthest ahead, column 0
the leftmost and level 0 the lowest.
"""

from __future__ import annotations

import numpy as np

from models.scene import CATEGORIES, GROUND_CLASSES

Factor = tuple[int, int, int]  # Edge lengths of a coarse voxel in fine voxels, along rows, columns and levels.

EMPTY = 0
NUM_CLASSES = 1 + len(GROUND_CLASSES) + len(CATEGORIES)  # With the class of empty voxels.
CLASS_BITS = int(NUM_CLASSES - 1).bit_length()
FINE: Factor = (1, 1, 1)
FINE_SHAPE = (256, 256, 32)  # Of a scene of 64 x 64 x 8 m, as in the paper.
COARSE_FACTORS: tuple[Factor, ...] = ((1, 1, 2), (2, 2, 2), (4, 4, 4), (8, 8, 8))


def name_voxel_column(factor: Factor) -> str:
    """Return the name of the column of the table `voxels`, and of the training array, with voxels of a size.

    Args:
        factor: Edge lengths in fine voxels.

    Returns:
        "voxels", or a name such as voxels_2x2x2.
    """
    return "voxels" if factor == FINE else f"voxels_{'x'.join(map(str, factor))}"


def coarsen_shape(shape: tuple[int, ...], factor: Factor) -> tuple[int, int, int]:
    """Return the shape of a grid of coarse voxels.

    Args:
        shape: Number of rows, columns and levels of the fine grid.
        factor: Edge lengths of a coarse voxel.

    Returns:
        Number of rows, columns and levels.

    Raises:
        ValueError: A side of the grid is not a multiple of the factor.
    """
    if any(side % step for side, step in zip(shape, factor, strict=True)):
        sides, block = (" x ".join(map(str, values)) for values in (shape, factor))
        raise ValueError(f"a grid of {sides} voxels has no whole number of blocks of {block}")
    rows, cols, levels = (side // step for side, step in zip(shape, factor, strict=True))
    return rows, cols, levels


def coarsen_voxels(voxels: np.ndarray, factor: Factor) -> np.ndarray:
    """Merge blocks of voxels. A block gets its most frequent class that is not empty (as in PDD).

    Args:
        voxels: (rows, cols, levels) uint8 class ids.
        factor: Number of voxels of a block along rows, columns and levels.

    Returns:
        (rows / factor[0], cols / factor[1], levels / factor[2]) uint8 class ids. Of equally frequent classes, the
        lowest id counts. A block is EMPTY if all its voxels are.

    Raises:
        ValueError: A side of the grid is not a multiple of the factor.
    """
    shape = coarsen_shape(voxels.shape, factor)
    blocks = voxels.reshape(shape[0], factor[0], shape[1], factor[1], shape[2], factor[2])
    members = blocks.transpose(1, 3, 5, 0, 2, 4).reshape(np.prod(factor), *shape)
    best = np.zeros(shape, np.uint32)
    # The lower bits of a key hold the complement of the class id, so the maximum prefers low ids.
    last = np.uint32(2**CLASS_BITS - 1)
    present = np.flatnonzero(np.bincount(voxels.reshape(-1), minlength=NUM_CLASSES)).astype(np.uint8)
    for class_id in members if len(members) < len(present) else present:  # One id per block, or one for all blocks.
        count = (members == class_id).sum(axis=0, dtype=np.uint32)
        key = (count << CLASS_BITS) + (last - class_id)
        np.maximum(best, np.where((class_id == EMPTY) | (count == 0), 0, key), out=best)
    return np.where(best == 0, EMPTY, last - (best & last)).astype(np.uint8)


def repeat_voxels(voxels: np.ndarray, factor: Factor) -> np.ndarray:
    """Divide coarse voxels into fine voxels of the same class.

    Args:
        voxels: (..., rows, cols, levels) class ids.
        factor: Edge lengths of a coarse voxel.

    Returns:
        (..., rows factor[0], cols factor[1], levels factor[2]) class ids.
    """
    for axis, step in zip((-3, -2, -1), factor, strict=True):
        voxels = voxels.repeat(step, axis=axis)
    return voxels
