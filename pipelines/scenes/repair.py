"""Repair of a scene's faults by as little as it takes: onto the ground, apart, and only what neither helps is taken out.

What a fault is says metrics/validity.py. A repair never makes another fault of the same kind worse: a push that would put
a primitive into a third one is not made.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from typing import Literal

import numpy as np

from models.iou3d import Boxes, boxes_of, iou3d_matrix, iou3d_pairs
from models.scene import Scene
from pipelines.metrics.validity import OVERLAP_IOU3D, SOLID, faults

GOAL_IOU3D = 0.98 * OVERLAP_IOU3D  # what is pushed apart stays apart when it is stored
ROUNDS = 4
DIRECTIONS = 24
STEPS = 20  # lengths of a push that are tried
CANDIDATES = 6  # shortest pushes that are tried against everything around


GroundFaults = Literal["both", "floating", "sunken", "none"]


def onto_ground(scene: Scene, chosen: np.ndarray, slab_offset_m: float, which: GroundFaults = "both") -> Scene:
    """Chosen (n,) primitives that float or are sunken, with their lowest point on the surface."""
    found = faults(scene, slab_offset_m)
    wrong = np.zeros(len(scene), bool)
    for name in ("floating", "sunken"):
        wrong |= chosen & found[name][0] & (which in ("both", name))
    height_m, _ = scene.ground_under()
    center_m = scene.center_m.astype(float)
    center_m[wrong, 2] += (height_m - slab_offset_m - scene.bottom_m)[wrong]
    return replace(scene, center_m=center_m.astype(np.float32))


def overlapping_pairs(boxes: Boxes, solid: np.ndarray) -> np.ndarray:
    """(p, 2) indices i < j of solid boxes that overlap by more than validity allows, the least overlap first."""
    index = np.flatnonzero(solid)
    part = boxes.take(index)
    iou = np.triu(iou3d_matrix(part, part), 1)
    i, j = np.nonzero(iou > OVERLAP_IOU3D)
    order = np.argsort(iou[i, j], kind="stable")
    return np.stack([index[i], index[j]], axis=1)[order]


def apart(scene: Scene, chosen: np.ndarray, most_m: float, shrink: float) -> Scene:
    """Chosen (n,) solid primitives that overlap, pushed apart sideways by at most most_m each.

    Of all ways to part two the shortest that puts neither into a third; the smaller one goes farther. Where that is not
    enough both shrink about their centres, to no less than `shrink` of their size.
    """
    parting = _Parting(scene, chosen, most_m, shrink)
    for _ in range(ROUNDS):
        for pair in overlapping_pairs(parting.now, parting.solid):
            parting.part(pair)
    center_m, _, size_m = parting.now
    return replace(scene, center_m=center_m.astype(np.float32), size_m=size_m.astype(np.float32))


class _Parting:
    """Boxes being pushed: where they are now, where they were given, and who may be moved."""

    def __init__(self, scene: Scene, chosen: np.ndarray, most_m: float, shrink: float) -> None:
        self.given, self.now = boxes_of(scene), boxes_of(scene)
        self.chosen, self.solid = chosen, np.isin(scene.category, SOLID)
        self.most_m, self.shrink = most_m, shrink

    def part(self, pair: np.ndarray) -> None:
        """Part two boxes if they can be; else nothing changes."""
        for scale in (1.0, self.shrink):
            for after in islice(self.ways(pair, scale), CANDIDATES):
                if not self.hits_others(pair, after):
                    self.now.center_m[pair], self.now.size_m[pair] = after.center_m, after.size_m
                    return

    def ways(self, pair: np.ndarray, scale: float) -> Iterator[Boxes]:
        """The two boxes (2,) where they do not overlap, the shortest way first, within what they may move in all."""
        start, may_move = self.now.take(pair), self.chosen[pair]
        share = may_move * start.volume_m3[::-1]
        if not share.any():
            return
        least_m = self.shrink * self.given.size_m[pair]
        size_m = np.where(may_move[:, None], np.maximum(scale * start.size_m, least_m), start.size_m)
        angle = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
        directions = np.stack([np.cos(angle), np.sin(angle), np.zeros(DIRECTIONS)], axis=1)
        length_m = np.arange(1, STEPS + 1) * (self.most_m / STEPS)
        pushes_m = (length_m[:, None, None] * directions).reshape(-1, 1, 3)
        center_m = start.center_m + (share / share.max() * [-1, 1])[:, None] * pushes_m  # (k, 2, 3)
        moved_m = np.linalg.norm((center_m - self.given.center_m[pair])[..., :2], axis=2)
        center_m = center_m[(moved_m <= self.most_m).all(axis=1)]
        sides = [
            Boxes(
                center_m[:, k], *(np.broadcast_to(v[k], (len(center_m), *v[k].shape)) for v in (start.rotation, size_m))
            )
            for k in (0, 1)
        ]
        for k in np.flatnonzero(iou3d_pairs(*sides) < GOAL_IOU3D):
            yield Boxes(center_m[k], start.rotation, size_m)

    def hits_others(self, pair: np.ndarray, after: Boxes) -> bool:
        """Would one of two boxes overlap with a third too much, and more than now?"""
        others = self.solid.copy()
        others[pair] = False
        around = self.now.take(others)
        then = iou3d_matrix(after, around)
        hit = then > GOAL_IOU3D
        return bool(hit.any() and (hit & (then > iou3d_matrix(self.now.take(pair), around))).any())


def superfluous(scene: Scene, chosen: np.ndarray) -> np.ndarray:
    """(n,) bool: as few chosen primitives as parting all overlaps takes; of two, the less certain, then the smaller."""
    gone = np.zeros(len(scene), bool)
    pairs = overlapping_pairs(boxes_of(scene), np.isin(scene.category, SOLID))
    while len(pairs := pairs[(chosen[pairs] & ~gone[pairs]).any(axis=1) & ~gone[pairs].any(axis=1)]):
        often = np.bincount(pairs.ravel(), minlength=len(scene))
        candidates = np.flatnonzero(chosen & (often == often[chosen].max()))
        gone[candidates[np.lexsort((scene.volume_m3[candidates], scene.existence[candidates]))[0]]] = True
    return gone
