"""Suppression of boxes that duplicate another box or lie inside one."""

from __future__ import annotations

import numpy as np

from models.geometry.iou3d import Boxes, compute_intersection_volume_m3, compute_iou3d_matrix, find_overlapping_bounds
from models.scene import CATEGORY_INDEX, VEGETATION, VEHICLES

# Two objects of the same category are duplicates if their IoU3D is higher. In 1,000 held-out scenes of version 2 of the
# town, the thresholds remove 0.4 % of the cars, 0.2 % of the signs and no other objects. The IoU3D of two walls, of two
# people and of two small objects reaches 0.15 there. Errors of a decoder raise it, so the thresholds remove 7 % of the
# walls of reconstructions. With perturbed-attention guidance, generated scenes have 4.1 pairs of walls above 0.15 per
# scene, because several cells propose parts of one wall.
DUPLICATE_IOU3D = np.full(len(CATEGORY_INDEX), 0.3)  # For vegetation, it applies only at borders of known regions.
DUPLICATE_IOU3D[list(VEHICLES)] = 0.05
DUPLICATE_IOU3D[[CATEGORY_INDEX["construction_big"], CATEGORY_INDEX["construction_small"]]] = 0.15

# A wall is removed if a larger share of its volume lies in a building. No wall of the same 1,000 scenes does; of the
# walls of an excerpt of KITTI-360, 3 % do.
CONTAINED_SHARE = 0.5
BUILDING, WALL = CATEGORY_INDEX["construction_big"], CATEGORY_INDEX["construction_small"]


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


def find_redundant(boxes: Boxes, category: np.ndarray, existence: np.ndarray) -> np.ndarray:
    """Find the boxes to remove from a decoded scene: duplicates, and walls that lie in a remaining building.

    A wall lies in a building if more than CONTAINED_SHARE of its volume does.

    Args:
        boxes: n boxes.
        category: (n,) categories.
        existence: (n,) existence probabilities.

    Returns:
        (n,) bool; True for each box to remove.
    """
    mask = find_suppressed(boxes, category, existence)
    walls, buildings = (np.flatnonzero((category == one) & ~mask) for one in (WALL, BUILDING))
    i, j = find_overlapping_bounds(boxes.take(walls), boxes.take(buildings))
    parts, others = boxes.take(walls[i]), boxes.take(buildings[j])
    mask[walls[i[compute_intersection_volume_m3(parts, others) > CONTAINED_SHARE * parts.volume_m3]]] = True
    return mask
