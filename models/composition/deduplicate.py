"""The same object twice: at the border of what is known already, and where two latent cells both claim it."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from models.geometry.iou3d import boxes_of, iou3d_matrix
from models.scene import CATEGORY_INDEX, VEGETATION, VEHICLES, Scene

# Objects of a category that overlap by more are one object. In the town's 1,000 held-out scenes no two vehicles overlap by
# more than 0.04 and no two buildings by more than 0.1; of its fences 4.6 % would go, signs 3.4, poles 2.2, others 0.8.
SAME_IOU3D = np.full(len(CATEGORY_INDEX), 0.15)
SAME_IOU3D[list(VEGETATION)] = 0.3  # crowns grow into each other; asked only of what is drawn beside the known
SAME_IOU3D[list(VEHICLES)] = 0.05
DRAWN_IOU3D = 0.05  # what is drawn of a known object, a little beside it, overlaps it by more


def doubles(made: Scene, known: Scene) -> np.ndarray:
    """(n,) bool: objects of `made` that are known ones drawn again. `made` is all that was drawn, on either side of the
    border, so that each known object is one of them, or none: of its category, one to one, such that they overlap most, by
    more than DRAWN_IOU3D each. What overlaps one by more than SAME_IOU3D is the same in any case.
    """
    if not len(made) or not len(known):
        return np.zeros(len(made), bool)
    same = made.category[:, None] == known.category[None]
    overlap = iou3d_matrix(boxes_of(made), boxes_of(known), same)
    again = (overlap > SAME_IOU3D[made.category, None]).any(axis=1)
    overlap[overlap <= DRAWN_IOU3D] = 0
    drawn, of = linear_sum_assignment(overlap, maximize=True)
    again[drawn[overlap[drawn, of] > 0]] = True
    return again


def repeated(scene: Scene) -> np.ndarray:
    """(n,) bool: solid objects that overlap a surer one of their category, which stays, by more than its SAME_IOU3D.

    Crowns grow into each other, so vegetation is never counted as repeated.
    """
    solid = np.flatnonzero(~np.isin(scene.category, VEGETATION))
    order = solid[np.argsort(-scene.existence[solid], kind="stable")]  # the surest first
    boxes, category = boxes_of(scene).take(order), scene.category[order]
    later = np.triu(category[:, None] == category[None], 1)
    overlaps = iou3d_matrix(boxes, boxes, later) > SAME_IOU3D[category, None]
    dropped = np.zeros(len(order), bool)
    for k in np.flatnonzero(overlaps.any(axis=1)):
        if not dropped[k]:
            dropped |= overlaps[k]
    mask = np.zeros(len(scene), bool)
    mask[order[dropped]] = True
    return mask
