"""Find duplicates of objects.

Duplicates occur at the border of a known region, and where two latent cells propose the same object.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from models.geometry.iou3d import compute_iou3d_matrix, extract_boxes
from models.geometry.suppression import DUPLICATE_IOU3D, find_redundant
from models.scene import Scene

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
    """Find the solid objects that decoding removes as duplicates.

    See `find_redundant` for the rule.

    Args:
        scene: Decoded scene.

    Returns:
        (n,) bool; True for each object to remove.
    """
    return find_redundant(extract_boxes(scene), scene.category, scene.existence)
