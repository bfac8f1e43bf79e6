"""Repair faults of a scene with small changes.

Objects are moved to the ground, pushed apart or, if necessary, removed. metrics/validity.py defines the faults. A
repair never worsens another fault of the same kind. For example, a displacement that would move a primitive into a
third primitive is skipped.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from models.geometry.iou3d import Boxes, compute_iou3d_matrix, compute_iou3d_pairs, extract_boxes
from models.scene import Scene
from pipelines.metrics.validity import OVERLAP_IOU3D, SOLID, TOLERANCE_M, find_faults

# These goals are slightly stricter than the fault limits. Otherwise, rounding in the tables could turn a valid result
# into a fault.
GOAL_IOU3D = 0.98 * OVERLAP_IOU3D
GOAL_TOLERANCE_M = 0.98 * TOLERANCE_M
ROUNDS = 4
DIRECTIONS = 24
STEPS = 20  # Number of displacement lengths to try.
PAIRS_AT_ONCE = 256  # Number of pairs that are processed together (50 MB).
CANDIDATES = 6  # Number of displacements per pair (the shortest) that are tested against all other primitives.


GroundFaults = Literal["both", "floating", "sunken", "none"]


def snap_to_ground(scene: Scene, chosen: np.ndarray, slab_offset_m: float, which: GroundFaults = "both") -> Scene:
    """Move floating or sunken primitives vertically until the lowest point lies on the ground.

    Args:
        scene: Scene with n primitives.
        chosen: (n,) bool; primitives that may move.
        slab_offset_m: Height of the ground raster above the real surface (m).
        which: Faults to repair.

    Returns:
        The repaired scene.
    """
    found = find_faults(scene, slab_offset_m, GOAL_TOLERANCE_M, ("floating", "sunken"))
    wrong = np.zeros(len(scene), bool)
    for name in ("floating", "sunken"):
        wrong |= chosen & found[name][0] & (which in ("both", name))
    height_m, _ = scene.ground_under()
    center_m = scene.center_m.astype(float)
    center_m[wrong, 2] += (height_m - slab_offset_m - scene.bottom_m)[wrong]
    return replace(scene, center_m=center_m.astype(np.float32))


def find_overlapping_pairs(boxes: Boxes, solid: np.ndarray) -> np.ndarray:
    """Find the pairs of solid boxes whose IoU3D exceeds the validity limit.

    Args:
        boxes: Boxes of n primitives.
        solid: (n,) bool; boxes that must not overlap.

    Returns:
        (p, 2) indices i < j, in ascending order of IoU3D.
    """
    index = np.flatnonzero(solid)
    part = boxes.take(index)
    iou = np.triu(compute_iou3d_matrix(part, part), 1)
    i, j = np.nonzero(iou > OVERLAP_IOU3D)
    order = np.argsort(iou[i, j], kind="stable")
    return np.stack([index[i], index[j]], axis=1)[order]


def separate_objects(scene: Scene, chosen: np.ndarray, most_m: float, shrink: float) -> Scene:
    """Displace overlapping solid primitives horizontally to end their overlaps.

    Each pair gets the shortest displacement that moves neither primitive into a third primitive. The smaller primitive
    moves farther. If no displacement suffices, both primitives also shrink about their centres.

    Args:
        scene: Scene with n primitives.
        chosen: (n,) bool; primitives that may change.
        most_m: Maximum displacement of each primitive (m).
        shrink: Minimum scale factor, in (0, 1].

    Returns:
        The scene after the displacements; some overlaps may remain.
    """
    parting = _Separation(scene, chosen, most_m, shrink)
    for _ in range(ROUNDS):
        if not parting.round():
            break
    center_m, _, size_m = parting.now
    return replace(scene, center_m=center_m.astype(np.float32), size_m=size_m.astype(np.float32))


class _Separation:
    """State of the separation: the original boxes, the current boxes, and a mask of the boxes that may move."""

    def __init__(self, scene: Scene, chosen: np.ndarray, most_m: float, shrink: float) -> None:
        self.given, self.now = extract_boxes(scene), extract_boxes(scene)
        self.select_primitives, self.solid = chosen, np.isin(scene.category, SOLID)
        self.most_m, self.shrink = most_m, shrink

    def round(self) -> bool:
        """Separate overlapping pairs. Move each box at most once. Return whether any box moved."""
        pairs = find_overlapping_pairs(self.now, self.solid)
        moved = np.zeros(len(self.solid), bool)
        for scale in (1.0, self.shrink):
            pairs = pairs[~moved[pairs].any(axis=1)]
            for start in range(0, len(pairs), PAIRS_AT_ONCE):
                some = pairs[start : start + PAIRS_AT_ONCE]
                for pair, ways in zip(some, self.ways(some, scale), strict=True):
                    if not moved[pair].any() and len(free := np.flatnonzero(~self.hit(pair, ways))):
                        self.now.center_m[pair], self.now.size_m[pair] = ways.center_m[free[0]], ways.size_m[free[0]]
                        moved[pair] = True
        return bool(moved.any())

    def ways(self, pairs: np.ndarray, scale: float) -> list[Boxes]:
        """For each pair of boxes, find up to CANDIDATES placements (k, 2) in which the two boxes do not overlap.

        The shortest displacement comes first. If two boxes overlap at both ends of a straight path, they overlap along
        the whole path. The reason is that their common volume is log-concave (Brunn-Minkowski). If the longest
        displacement in a direction does not separate the boxes, the direction is therefore skipped.
        """
        start = self.now.take(pairs)  # (p, 2, ...)
        share = self.select_primitives[pairs] * start.size_m.prod(axis=2)[:, ::-1]
        share /= np.maximum(share.max(axis=1, keepdims=True), 1e-300)
        least_m = self.shrink * self.given.size_m[pairs]
        size_m = np.where(
            self.select_primitives[pairs][..., None], np.maximum(scale * start.size_m, least_m), start.size_m
        )
        angle = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
        directions = np.stack([np.cos(angle), np.sin(angle), np.zeros(DIRECTIONS)], axis=1)
        pushes_m = directions[:, None] * (np.arange(1, STEPS + 1) * (self.most_m / STEPS))[:, None]
        to_m = share[:, None, None, :, None] * [[-1.0], [1.0]] * pushes_m[:, :, None]  # (p, directions, steps, 2, 3)
        center_m = start.center_m[:, None, None] + to_m
        moved_m = np.linalg.norm((center_m - self.given.center_m[pairs][:, None, None])[..., :2], axis=-1)
        within = (moved_m <= self.most_m).all(axis=-1)  # (p, directions, steps): limit of the displacement.
        within &= share.any(axis=1)[:, None, None]

        def parted(where: np.ndarray) -> np.ndarray:
            """Return a mask (p, directions, steps): whether a displacement is in `where` and separates the boxes."""
            pair, *_ = np.nonzero(where)
            a, b = (Boxes(center_m[where][:, k], start.rotation[pair, k], size_m[pair, k]) for k in (0, 1))
            found = where.copy()
            found[where] = compute_iou3d_pairs(a, b) < GOAL_IOU3D
            return found

        longest = within & (np.arange(1, STEPS + 1) == within.sum(axis=2, keepdims=True))
        found = parted(within & parted(longest).any(axis=2, keepdims=True))
        first = np.where(found.any(axis=2), found.argmax(axis=2), STEPS)  # (p, directions); STEPS if none is found.
        result = []
        for k, steps in enumerate(first):
            best = np.argsort(steps, kind="stable")[: min(CANDIDATES, int((steps < STEPS).sum()))]
            always = np.full(len(best), k)
            result.append(Boxes(center_m[k, best, steps[best]], start.rotation[always], size_m[always]))
        return result

    def hit(self, pair: np.ndarray, ways: Boxes) -> np.ndarray:
        """For each placement (k, 2) of a pair, return whether one of the two boxes would overlap a third box.

        An overlap counts only if its IoU3D exceeds two values: the limit, and the IoU3D of the same two boxes before
        the displacement.
        """
        others = self.solid.copy()
        others[pair] = False
        around = self.now.take(others)
        then = compute_iou3d_matrix(Boxes(*(part.reshape(-1, *part.shape[2:]) for part in ways)), around)
        then = then.reshape(len(ways.center_m), 2, len(around.center_m))
        over = then > GOAL_IOU3D
        if over.any():
            over &= then > compute_iou3d_matrix(self.now.take(pair), around)
        return np.any(over, axis=(1, 2))


def find_removable_objects(scene: Scene, chosen: np.ndarray) -> np.ndarray:
    """Select a small set of primitives whose removal ends the overlaps.

    Among equivalent candidates, the primitive with the lowest existence probability is removed. If these are equal, the
    smallest primitive is removed.

    Args:
        scene: Scene with n primitives.
        chosen: (n,) bool; primitives that may be removed.

    Returns:
        (n,) bool; primitives to remove.
    """
    gone = np.zeros(len(scene), bool)
    pairs = find_overlapping_pairs(extract_boxes(scene), np.isin(scene.category, SOLID))
    while len(pairs := pairs[(chosen[pairs] & ~gone[pairs]).any(axis=1) & ~gone[pairs].any(axis=1)]):
        often = np.bincount(pairs.ravel(), minlength=len(scene))
        candidates = np.flatnonzero(chosen & (often == often[chosen].max()))
        gone[candidates[np.lexsort((scene.volume_m3[candidates], scene.existence[candidates]))[0]]] = True
    return gone
