"""Non-maximum suppression of boxes of the same category."""

from __future__ import annotations

import numpy as np

from models.geometry.iou3d import Boxes, compute_iou3d_matrix
from models.scene import CATEGORY_INDEX, VEGETATION, VEHICLES

# Two objects of the same category are duplicates if their IoU3D is higher. In 1,000 held-out scenes of version 2 of the
# town, the thresholds remove 0.4 % of the cars, 0.2 % of the signs and no other objects. The IoU3D of two walls, of two
# people and of two small objects reaches 0.15 there. Errors of a decoder raise it, so a threshold of 0.15 would remove
# 8 % of the walls of reconstructions.
DUPLICATE_IOU3D = np.full(len(CATEGORY_INDEX), 0.3)  # For vegetation, it applies only at borders of known regions.
DUPLICATE_IOU3D[list(VEHICLES)] = 0.05
DUPLICATE_IOU3D[CATEGORY_INDEX["construction_big"]] = 0.15
DUPLICATE_IOU3D[CATEGORY_INDEX["construction_small"]] = 0.5  # Walls meet and continue each other.


def find_suppressed(
    boxes: Boxes, category: np.ndarray, existence: np.ndarray, limit: np.ndarray = DUPLICATE_IOU3D
) -> np.ndarray:
    """Find the boxes that non-maximum suppression removes.

    Two boxes are duplicates if their IoU3D exceeds the limit of their category. The box with the higher existence
    probability is kept. Vegetation is never a duplicate, because tree crowns overlap in reality.

    Args:
        boxes: n boxes.
        category: (n,) categories.
        existence: (n,) existence probabilities, or other values that order the boxes.
        limit: Largest IoU3D of two boxes of each category of CATEGORIES.

    Returns:
        (n,) bool; True for each box to remove.
    """
    solid = np.flatnonzero(~np.isin(category, VEGETATION))
    order = solid[np.argsort(-existence[solid], kind="stable")]  # highest confidence first
    boxes, ordered = boxes.take(order), category[order]
    later = np.triu(ordered[:, None] == ordered[None], 1)
    overlaps = compute_iou3d_matrix(boxes, boxes, later) > limit[ordered, None]
    suppressed = np.zeros(len(order), bool)
    for k in np.flatnonzero(overlaps.any(axis=1)):
        if not suppressed[k]:
            suppressed |= overlaps[k]
    mask = np.zeros(len(category), bool)
    mask[order[suppressed]] = True
    return mask
