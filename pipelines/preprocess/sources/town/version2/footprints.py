"""Keep buildings apart from roads, sidewalks and each other, and remove objects that lie inside buildings.

A town is designed on a board (land.py), but boxes stay rectangular when the board is bent. Buildings may then overlap
by a few decimetres. The functions work on footprints in the world frame.
"""

from __future__ import annotations

import numpy as np

CLEARANCE_M = 0.02
GAP_M = 0.8  # Distance between houses that overlapped and do not belong to a row of joined houses.
JOINED_RAD = 0.1  # Joined houses differ by at most this angle.
ROUNDS = 4
MIN_SIDE_M = 3.0  # Buildings that become smaller are removed.


def compute_corners(center_m: np.ndarray, axis: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """Return the corners (n, 4, 2) of footprints, counter-clockwise.

    Args:
        center_m: (n, 2) centres (m).
        axis: (n, 2) unit directions of the length axes.
        size_m: (n, 2) length and width (m).
    """
    side = np.stack([-axis[:, 1], axis[:, 0]], axis=1)
    long, wide = axis * size_m[:, :1] / 2, side * size_m[:, 1:] / 2
    return center_m[:, None] + np.stack([-long - wide, long - wide, long + wide, wide - long], axis=1)


def measure_penetration(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how deep pairs of convex polygons overlap, and the direction that moves the first polygon out.

    Args:
        first: (p, a, 2) polygons (m), counter-clockwise or clockwise.
        second: (p, b, 2) polygons (m).

    Returns:
        (p,) depth (m), at most 0 for polygons that are apart; and (p, 2) unit directions.
    """
    edges = np.concatenate([np.roll(part, -1, axis=1) - part for part in (first, second)], axis=1)
    axes = np.stack([-edges[..., 1], edges[..., 0]], axis=-1)
    axes /= np.maximum(np.linalg.norm(axes, axis=-1, keepdims=True), 1e-12)  # (p, k, 2)
    a, b = (np.einsum("pki,pni->pkn", axes, part) for part in (first, second))
    ahead, behind = b.max(axis=2) - a.min(axis=2), a.max(axis=2) - b.min(axis=2)
    depth = np.minimum(ahead, behind)
    least = depth.argmin(axis=1)
    at = np.arange(len(first))
    sign = np.where(ahead[at, least] <= behind[at, least], 1.0, -1.0)
    return depth[at, least], axes[at, least] * sign[:, None]


def _find_pairs(low_a: np.ndarray, high_a: np.ndarray, low_b: np.ndarray, high_b: np.ndarray) -> tuple:
    """Return the pairs of bounding boxes that intersect."""
    meets = (low_a[:, None, 0] < high_b[None, :, 0]) & (high_a[:, None, 0] > low_b[None, :, 0])
    meets &= (low_a[:, None, 1] < high_b[None, :, 1]) & (high_a[:, None, 1] > low_b[None, :, 1])
    return np.nonzero(meets)


def separate_buildings(
    center_m: np.ndarray, axis: np.ndarray, size_m: np.ndarray, street_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Move buildings off the streets, then shorten buildings that overlap each other.

    Args:
        center_m: (n, 2) centres of the footprints (m).
        axis: (n, 2) unit directions of their length axes.
        size_m: (n, 2) length and width (m).
        street_m: (t, 3, 2) triangles of roads and sidewalks (m).

    Returns:
        Centres, sizes and mask (n,) of the buildings to keep. These overlap neither streets nor each other.
    """
    center_m, size_m, keep = center_m.copy(), size_m.copy(), np.ones(len(center_m), bool)
    for _ in range(ROUNDS):
        depth, out, which = _measure_street_overlap(compute_corners(center_m, axis, size_m), street_m)
        if not len(which):
            break
        center_m[which] += out * (depth + CLEARANCE_M)[:, None]
    for _ in range(ROUNDS):
        if not _shorten_overlapping(center_m, axis, size_m, keep):
            break
    keep &= size_m.min(axis=1) >= MIN_SIDE_M
    corners = compute_corners(center_m, axis, size_m)
    keep[_measure_street_overlap(corners, street_m)[2]] = False
    i, j = _find_overlapping(corners, keep)
    area = size_m.prod(axis=1)
    for a, b in zip(i.tolist(), j.tolist(), strict=True):
        if keep[a] and keep[b]:
            keep[a if area[a] < area[b] else b] = False
    return center_m, size_m, keep


def _measure_street_overlap(corners: np.ndarray, street_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the largest overlap of each building with a street triangle: depth, direction and building."""
    bounds = corners.min(axis=1), corners.max(axis=1), street_m.min(axis=1), street_m.max(axis=1)
    i, j = _find_pairs(*bounds)
    depth, out = measure_penetration(corners[i], street_m[j])
    hit = depth > CLEARANCE_M / 2
    i, depth, out = i[hit], depth[hit], out[hit]
    order = np.lexsort([-depth, i])
    which, first = np.unique(i[order], return_index=True)
    return depth[order][first], out[order][first], which


def _find_overlapping(corners: np.ndarray, keep: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    low, high = corners.min(axis=1), corners.max(axis=1)
    i, j = _find_pairs(low, high, low, high)
    both = (i < j) & keep[i] & keep[j]
    i, j = i[both], j[both]
    hit = measure_penetration(corners[i], corners[j])[0] > CLEARANCE_M / 2
    return i[hit], j[hit]


def _shorten_overlapping(center_m: np.ndarray, axis: np.ndarray, size_m: np.ndarray, keep: np.ndarray) -> bool:
    """Shorten the larger building of each overlapping pair in place. Return whether a pair overlaps."""
    i, j = _find_overlapping(compute_corners(center_m, axis, size_m), keep)
    for a, b in zip(i.tolist(), j.tolist(), strict=True):
        first, second = (compute_corners(center_m[[k]], axis[[k]], size_m[[k]]) for k in (a, b))
        depth, out = measure_penetration(first, second)
        if depth[0] <= 0:
            continue
        chosen, away = (a, out[0]) if size_m[a].prod() >= size_m[b].prod() else (b, -out[0])
        along = abs(away @ axis[chosen])
        side = np.array([-axis[chosen, 1], axis[chosen, 0]])
        across = abs(away @ side)
        direction, extent = (axis[chosen], 0) if along >= across else (side, 1)
        turn = abs(axis[a, 0] * axis[b, 1] - axis[a, 1] * axis[b, 0])
        joined = min(turn, np.sqrt(max(0.0, 1 - turn**2))) < JOINED_RAD and depth[0] < GAP_M
        by = (depth[0] + (CLEARANCE_M if joined else GAP_M)) / max(along, across)
        size_m[chosen, extent] -= by
        center_m[chosen] += np.sign(away @ direction) * direction * by / 2
        if size_m[chosen, extent] < MIN_SIDE_M:
            keep[chosen] = False
    return bool(len(i))


def find_covered(
    points_m: np.ndarray, center_m: np.ndarray, axis: np.ndarray, size_m: np.ndarray, margin_m: float = 0.0
) -> np.ndarray:
    """Return whether each point lies inside a footprint.

    Args:
        points_m: (m, 2) points (m).
        center_m: (n, 2) centres of the footprints (m).
        axis: (n, 2) unit directions of their length axes.
        size_m: (n, 2) length and width (m).
        margin_m: Distance by which the footprints are enlarged on each side (m).

    Returns:
        (m,) mask.
    """
    order = np.argsort(points_m[:, 0])
    x, covered = points_m[order, 0], np.zeros(len(points_m), bool)
    reach = np.linalg.norm(size_m, axis=1) / 2 + margin_m
    low, high = np.searchsorted(x, center_m[:, 0] - reach), np.searchsorted(x, center_m[:, 0] + reach)
    for k in range(len(center_m)):
        near = order[low[k] : high[k]]
        offset = points_m[near] - center_m[k]
        along, across = np.abs(offset @ axis[k]), np.abs(offset @ np.array([-axis[k, 1], axis[k, 0]]))
        inside = (along < size_m[k, 0] / 2 + margin_m) & (across < size_m[k, 1] / 2 + margin_m)
        covered[near[inside]] = True
    return covered
