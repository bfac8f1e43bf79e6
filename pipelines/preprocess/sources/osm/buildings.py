"""Cover the footprint of a building with a few oriented rectangles.

The rectangles are parallel to the main direction of the footprint's walls and do not overlap. Their sides lie on the
coordinates of the corners of the footprint. Rectangles are chosen greedily by area until they cover the share COVERED
of the footprint.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import shapely

COVERED = 0.95  # Share of the footprint after which no more rectangles are added.
MAX_RECTANGLES = 12
MIN_SHARE = 0.02  # Smallest share of the footprint that a rectangle adds.
MIN_AREA_M2 = 2.0
MERGE_M = 0.4  # Corner coordinates that are closer than this are merged.
MAX_LINES = 48  # Largest number of different coordinates per axis.
DIRECTION_BINS = 90


class Cover(NamedTuple):
    """Rectangles that cover a footprint.

    Attributes:
        center_m: Centres (m).
        size_m: Length and width along the axis and across it (m).
        yaw_rad: Angle from x to the axis of all rectangles.
        iou: Area of the intersection of rectangles and footprint, divided by the area of their union.
    """

    center_m: np.ndarray  # (n, 2)
    size_m: np.ndarray  # (n, 2)
    yaw_rad: float
    iou: float


def find_direction(footprint: Any) -> float:
    """Return the direction of most of the walls in [0, pi/2), weighted by length.

    Args:
        footprint: Polygon or multipolygon.

    Returns:
        Angle (rad).
    """
    walls = [np.diff(shapely.get_coordinates(ring), axis=0) for ring in _list_rings(footprint)]
    wall = np.concatenate(walls)
    length = np.linalg.norm(wall, axis=1)
    angle = np.arctan2(wall[:, 1], wall[:, 0]) % (np.pi / 2)
    bins = np.bincount((angle / (np.pi / 2) * DIRECTION_BINS).astype(int) % DIRECTION_BINS, length, DIRECTION_BINS)
    best = int((bins + np.roll(bins, 1) + np.roll(bins, -1)).argmax())
    middle = (best + 0.5) / DIRECTION_BINS * np.pi / 2
    offset = (angle - middle + np.pi / 4) % (np.pi / 2) - np.pi / 4
    near = np.abs(offset) <= 1.5 / DIRECTION_BINS * np.pi / 2
    return float((middle + np.average(offset[near], weights=np.maximum(length[near], 1e-9))) % (np.pi / 2))


def _list_rings(footprint: Any) -> list[Any]:
    polygons = shapely.get_parts(footprint)
    return [ring for polygon in polygons for ring in (polygon.exterior, *polygon.interiors)]


def cover_footprint(footprint: Any) -> Cover:
    """Cover a footprint with rectangles.

    Args:
        footprint: Valid polygon or multipolygon with an area, possibly with holes (m).

    Returns:
        At least one rectangle.
    """
    yaw = find_direction(footprint)
    cos, sin = np.cos(yaw), np.sin(yaw)
    turn = np.array([[cos, -sin], [sin, cos]])  # From the frame of the walls to the frame of the footprint.
    middle = shapely.get_coordinates(footprint.centroid)[0]
    turned = shapely.transform(footprint, lambda points: (points - middle) @ turn)
    low, high = np.array(turned.bounds).reshape(2, 2)
    is_rectangle = turned.area >= COVERED * (high - low).prod()
    boxes = np.array([[*low, *high]]) if is_rectangle else _choose_boxes(turned)
    sides = boxes[:, 2:] - boxes[:, :2]
    union = shapely.union_all(shapely.box(*boxes.T))
    iou = shapely.intersection(union, turned).area / shapely.union(union, turned).area
    return Cover((boxes[:, :2] + boxes[:, 2:]) / 2 @ turn.T + middle, sides, yaw, float(iou))


def _choose_boxes(footprint: Any) -> np.ndarray:
    """Return (n, 4) boxes (x0, y0, x1, y1) that are chosen greedily on the grid of the footprint's coordinates."""
    points = shapely.get_coordinates(footprint)
    x, y = _merge(points[:, 0]), _merge(points[:, 1])
    cells = shapely.box(x[:-1, None], y[None, :-1], x[1:, None], y[None, 1:])
    area = shapely.area(cells)
    shapely.prepare(footprint)
    free = shapely.area(shapely.intersection(cells, footprint)) >= 0.5 * area
    chosen, left = [], footprint.area * (1 - COVERED)
    smallest = max(MIN_AREA_M2, MIN_SHARE * footprint.area)
    while free.any() and len(chosen) < MAX_RECTANGLES:
        i0, i1, j0, j1, gained = _find_largest(free, area)
        if chosen and (gained < smallest or area[free].sum() < left):
            break
        chosen.append([x[i0], y[j0], x[i1], y[j1]])
        free[i0:i1, j0:j1] = False
    if not chosen:  # Footprints that are thinner than MERGE_M, or diagonal.
        return np.array([footprint.bounds])
    return np.array(chosen)


def _merge(values: np.ndarray) -> np.ndarray:
    """Return sorted coordinates, of which those within MERGE_M are replaced by their mean, and at most MAX_LINES."""
    ordered, gap = np.unique(values), MERGE_M
    while True:
        groups = np.split(ordered, np.flatnonzero(np.diff(ordered) > gap) + 1)
        # A chain of close coordinates, as of a curve, is cut into groups that are no wider than the gap.
        merged = np.concatenate([_cut_chain(group, gap) for group in groups])
        if len(merged) <= MAX_LINES:
            break
        gap *= 1.5
    merged[0], merged[-1] = ordered[0], ordered[-1]
    return merged if len(merged) > 1 else ordered[[0, -1]]


def _cut_chain(group: np.ndarray, gap: float) -> np.ndarray:
    parts = (group - group[0]) // gap if np.ptp(group) > gap else np.zeros(len(group))
    return np.array([group[parts == part].mean() for part in np.unique(parts)])


def _find_largest(free: np.ndarray, area: np.ndarray) -> tuple[int, int, int, int, float]:
    """Return the ranges (i0, i1, j0, j1) of the free rectangle with the largest area, and its area."""
    best = (0, 0, 0, 0, -1.0)
    for i0 in range(free.shape[0]):
        open_columns = np.ones(free.shape[1], bool)
        gained = np.zeros(free.shape[1])
        for i1 in range(i0 + 1, free.shape[0] + 1):
            open_columns &= free[i1 - 1]
            if not open_columns.any():
                break
            gained += area[i1 - 1]
            j0, j1, sum_of_run = _find_best_run(open_columns, gained)
            if sum_of_run > best[4]:
                best = (i0, i1, j0, j1, sum_of_run)
    return best


def _find_best_run(is_open: np.ndarray, weight: np.ndarray) -> tuple[int, int, float]:
    """Return start, end and total weight of the run of open entries with the largest weight."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_open, [False]]).astype(np.int8)))
    total = np.concatenate([[0.0], np.cumsum(weight)])
    starts, ends = edges[::2], edges[1::2]
    sums = total[ends] - total[starts]
    best = int(sums.argmax())
    return int(starts[best]), int(ends[best]), float(sums[best])


def repair_polygons(polygons: Sequence[Any]) -> tuple[np.ndarray, np.ndarray]:
    """Repair self-intersecting outlines.

    Args:
        polygons: Polygons or multipolygons.

    Returns:
        Valid polygons or multipolygons, and a mask of those that were changed. A polygon without an area becomes an
        empty polygon.
    """
    found = np.array(polygons, object)
    invalid = ~shapely.is_valid(found)
    found[invalid] = shapely.buffer(shapely.make_valid(found[invalid]), 0.0)  # Drops lines and points.
    return found, invalid
