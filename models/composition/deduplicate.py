"""Find duplicates of objects.

Duplicates occur at the border of a known region, and where two latent cells propose the same object.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from models.geometry.iou3d import compute_iou3d_matrix, extract_boxes
from models.scene import CATEGORY_INDEX, VEGETATION, VEHICLES, Scene

# NMS threshold per category: two objects of the same category are duplicates if their IoU3D is higher. In the town's
# 1,000 held-out scenes, the IoU3D is at most 0.04 for two vehicles and at most 0.1 for two buildings. In these scenes,
# the thresholds would remove 4.6 % of fences, 3.4 % of signs, 2.2 % of poles and 0.8 % of other objects.
DUPLICATE_IOU3D = np.full(len(CATEGORY_INDEX), 0.15)
DUPLICATE_IOU3D[list(VEGETATION)] = 0.3  # Tree crowns overlap. The value applies only at borders of known regions.
DUPLICATE_IOU3D[list(VEHICLES)] = 0.05
REGENERATED_IOU3D = 0.05  # The IoU3D of a known object and its displaced copy is higher.


def find_regenerated_objects(generated: Scene, known: Scene) -> np.ndarray:
    """Find generated objects that are copies of known objects.

    Each known object is matched to at most one generated object of its category. The matching maximises the sum of
    IoU3D over all pairs with an IoU3D above REGENERATED_IOU3D. In addition, an object is a copy if its IoU3D with a
    known object of the same category exceeds DUPLICATE_IOU3D.

    Args:
        generated: Scene with all decoded objects, on both sides of the border.
        known: Scene with the objects of the known region.

    Returns:
        (n,) bool; True for each generated object that is a copy.
    """
    if not len(generated) or not len(known):
        return np.zeros(len(generated), bool)
    same = generated.category[:, None] == known.category[None]
    overlap = compute_iou3d_matrix(extract_boxes(generated), extract_boxes(known), same)
    copies = np.any(overlap > DUPLICATE_IOU3D[generated.category, None], axis=1)
    overlap[overlap <= REGENERATED_IOU3D] = 0
    row, col = linear_sum_assignment(overlap, maximize=True)
    copies[row[overlap[row, col] > 0]] = True
    return copies


def find_lower_confidence_duplicates(scene: Scene) -> np.ndarray:
    """Find the solid objects that non-maximum suppression removes.

    Two objects are duplicates if their IoU3D exceeds DUPLICATE_IOU3D of their category. The object with the higher
    existence probability is kept. Vegetation is never a duplicate, because tree crowns overlap in reality.

    Args:
        scene: Decoded scene.

    Returns:
        (n,) bool; True for each object to remove.
    """
    solid = np.flatnonzero(~np.isin(scene.category, VEGETATION))
    order = solid[np.argsort(-scene.existence[solid], kind="stable")]  # highest confidence first
    boxes, category = extract_boxes(scene).take(order), scene.category[order]
    later = np.triu(category[:, None] == category[None], 1)
    overlaps = compute_iou3d_matrix(boxes, boxes, later) > DUPLICATE_IOU3D[category, None]
    suppressed = np.zeros(len(order), bool)
    for k in np.flatnonzero(overlaps.any(axis=1)):
        if not suppressed[k]:
            suppressed |= overlaps[k]
    mask = np.zeros(len(scene), bool)
    mask[order[suppressed]] = True
    return mask
