"""The same object twice: at the border of what is known already, and where two latent cells both claim it."""

from __future__ import annotations

import numpy as np

from models.iou3d import boxes_of, iou3d_matrix
from models.scene import VEGETATION, Scene

SAME_IOU3D = 0.3  # objects of a category that overlap by more are one object


def doubles(made: Scene, known: Scene) -> np.ndarray:
    """(n,) bool: objects of `made` that overlap one of `known`, of their category, by more than SAME_IOU3D (boxes)."""
    if not len(made) or not len(known):
        return np.zeros(len(made), bool)
    same = made.category[:, None] == known.category[None]
    return (iou3d_matrix(boxes_of(made), boxes_of(known), same) > SAME_IOU3D).any(axis=1)


def repeated(scene: Scene) -> np.ndarray:
    """(n,) bool: solid objects that overlap a surer one of their category, which stays, by more than SAME_IOU3D.

    Crowns grow into each other, so vegetation is never counted as repeated.
    """
    solid = np.flatnonzero(~np.isin(scene.category, VEGETATION))
    order = solid[np.argsort(-scene.existence[solid], kind="stable")]  # the surest first
    boxes, category = boxes_of(scene).take(order), scene.category[order]
    later = np.triu(category[:, None] == category[None], 1)
    overlaps = iou3d_matrix(boxes, boxes, later) > SAME_IOU3D
    dropped = np.zeros(len(order), bool)
    for k in np.flatnonzero(overlaps.any(axis=1)):
        if not dropped[k]:
            dropped |= overlaps[k]
    mask = np.zeros(len(scene), bool)
    mask[order[dropped]] = True
    return mask
