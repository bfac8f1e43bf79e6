"""Non-maximum suppression of boxes of the same category."""

from __future__ import annotations

import numpy as np

from models.geometry.iou3d import Boxes, compute_iou3d_matrix
from models.scene import CATEGORY_INDEX, VEGETATION, VEHICLES

# NMS threshold per category: two objects of the same category are duplicates if their IoU3D is higher. In the town's
# 1,000 held-out scenes, the IoU3D is at most 0.04 for two vehicles and at most 0.1 for two buildings. In these scenes,
# the thresholds would remove 4.6 % of fences, 3.4 % of signs, 2.2 % of poles and 0.8 % of other objects.
DUPLICATE_IOU3D = np.full(len(CATEGORY_INDEX), 0.15)
DUPLICATE_IOU3D[list(VEGETATION)] = 0.3  # Tree crowns overlap. The value applies only at borders of known regions.
DUPLICATE_IOU3D[list(VEHICLES)] = 0.05


def find_suppressed(boxes: Boxes, category: np.ndarray, existence: np.ndarray) -> np.ndarray:
    """Find the boxes that non-maximum suppression removes.

    Two boxes are duplicates if their IoU3D exceeds DUPLICATE_IOU3D of their category. The box with the higher existence
    probability is kept. Vegetation is never a duplicate, because tree crowns overlap in reality.

    Args:
        boxes: n boxes.
        category: (n,) categories.
        existence: (n,) existence probabilities, or other values that order the boxes.

    Returns:
        (n,) bool; True for each box to remove.
    """
    solid = np.flatnonzero(~np.isin(category, VEGETATION))
    order = solid[np.argsort(-existence[solid], kind="stable")]  # highest confidence first
    boxes, ordered = boxes.take(order), category[order]
    later = np.triu(ordered[:, None] == ordered[None], 1)
    overlaps = compute_iou3d_matrix(boxes, boxes, later) > DUPLICATE_IOU3D[ordered, None]
    suppressed = np.zeros(len(order), bool)
    for k in np.flatnonzero(overlaps.any(axis=1)):
        if not suppressed[k]:
            suppressed |= overlaps[k]
    mask = np.zeros(len(category), bool)
    mask[order[suppressed]] = True
    return mask
