"""Compute relation statistics: where objects stand relative to the road, to each other and to what supports them.

Layout statistics (statistics.py) hold numbers and sizes, but no positions. Relation statistics hold positions,
distances and directions. They therefore change if objects are moved, turned or put on another ground. Each scene gives
one vector (RELATIONS) and counts over the bins of RELATION_HISTOGRAMS.

All relations are measured on the fused ground (`Scene.surface`). The edge of the road is the set of road pixels that
have a neighbour of another class. The border of the scene is not an edge.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, cast

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]
from skimage.measure import label as label_regions

from models.geometry.iou3d import Boxes, extract_boxes, find_intersecting_pairs, find_overlapping_bounds
from models.scene import (
    CATEGORIES,
    GROUND_CLASSES,
    ROAD_CLASSES,
    SUPPORT_M,
    SUPPORTERS,
    VEGETATION,
    Scene,
)
from pipelines.metrics.distributions import NO_GROUND, Histogram

EDGE_LIMIT_M = 15.0  # Larger distances from the edge of the road count as this distance.
NEAR_EDGE_M = 1.0
NEIGHBOUR_RANGE_M = (0.1, 60.0)  # Distances between neighbours are clipped to this range before the logarithm.
TOUCHING_M = 0.5  # Objects of one category whose centres are closer than this distance are probably duplicates.
EDGE_PIXELS = 12  # The direction of the edge is that of the line through this number of edge pixels.
SUPPORT_RANGE_M = 3.0  # Larger gaps between an object and the ground count as this gap.
FOOTPRINT_POINTS = 5  # Number of points along each side of a footprint.
SMALL_PART_M2 = 1.0
MIN_WIDTH_M, MAX_WIDTH_M = 2.0, 40.0  # Range of plausible road widths.

IS_ROAD = np.array([*(name in ROAD_CLASSES for name in GROUND_CLASSES), False])  # The last entry: no ground.
SIDEWALK = GROUND_CLASSES.index("sidewalk")

GROUPS = {
    "vegetation": ("vegetation_cuboid", "vegetation_ellipsoid"),
    "vehicles": ("vehicle_big", "vehicle_small"),
    "people": ("two_wheelers", "human"),
    "constructions": ("construction_big", "construction_small"),
    "furniture": ("pole", "traffic_control", "object"),
}
GROUP_OF = np.array([next(k for k, names in enumerate(GROUPS.values()) if name in names) for name in CATEGORIES])
SUPPORTS = ("ground", "pole, wall or building", "nothing")
UNSUPPORTED = len(SUPPORTS) - 1

PER_CATEGORY = (
    "road_edge_m",  # Mean signed distance of the centre from the nearest edge of the road; negative on the road.
    "near_road_edge",  # Share of objects within NEAR_EDGE_M of the edge.
    "along_edge",  # Mean of cos 2a, where a is the angle between length axis and edge: 1 along, -1 across the edge.
    "square_to_edge",  # Mean of cos 4a: 1 along or across the edge, -1 at 45 degrees.
    "neighbour_log_m",  # Mean log10 of the distance to the nearest object of the category.
    "touching",  # Share of objects whose nearest object of the category is closer than TOUCHING_M.
    "along_neighbour",  # Mean of cos 2a, where a is the angle between the object and the nearest one of the category.
    "other_log_m",  # Mean log10 of the distance to the nearest object of another category, without vegetation.
    "on_road",  # Share of objects whose centre lies on road.
    "on_sidewalk",  # Share of objects whose centre lies on sidewalk.
    "road_below",  # Mean share of the footprint that lies on road.
    "gap_m",  # Mean height of the lowest point above the ground under the centre.
    "supported",  # Share of objects that touch the ground, a pole, a wall or a building.
)
PER_CLASS = ("perimeter_per_m", "small_parts")  # Border length per area (1/m), and number of parts below SMALL_PART_M2.
RELATIONS = (
    *(f"{category}.{name}" for category in CATEGORIES for name in PER_CATEGORY),
    *(f"{name}.{measure}" for name in GROUND_CLASSES for measure in PER_CLASS),
    "road_width_m",
    "road_width_std_m",
)

EDGE_EDGES_M = np.linspace(-EDGE_LIMIT_M, EDGE_LIMIT_M, 61)
ANGLE_EDGES_DEG = np.linspace(0, 90, 31)
NEIGHBOUR_EDGES_M = np.geomspace(*NEIGHBOUR_RANGE_M, 41)
ROUGHNESS_EDGES = np.geomspace(0.02, 8, 41)


def _list_histograms() -> Iterator[Histogram]:
    for category in CATEGORIES:
        yield Histogram(f"{category}.road_edge_m", EDGE_EDGES_M)
        yield Histogram(f"{category}.road_edge_deg", ANGLE_EDGES_DEG, length_unit="deg")
        yield Histogram(f"{category}.neighbour_m", NEIGHBOUR_EDGES_M)
        yield Histogram(f"{category}.neighbour_deg", ANGLE_EDGES_DEG, length_unit="deg")
        yield Histogram(f"{category}.footprint", bins=(*GROUND_CLASSES, NO_GROUND))
        yield Histogram(f"{category}.support", bins=SUPPORTS)
    for first in GROUPS:
        for second in GROUPS:
            yield Histogram(f"{first}.nearest_{second}_m", NEIGHBOUR_EDGES_M)
    for name in GROUND_CLASSES:
        yield Histogram(f"{name}.perimeter_per_m", ROUGHNESS_EDGES, length_unit="1/m")


RELATION_HISTOGRAMS = tuple(_list_histograms())


class SceneRelations(NamedTuple):
    """Relations of one scene.

    Attributes:
        vector: Values of RELATIONS; NaN where a value is undefined, for example if a category has no object.
        histograms: Counts over the bins of RELATION_HISTOGRAMS, one histogram after the other.
    """

    vector: np.ndarray  # (157,) float64
    histograms: np.ndarray  # (bins,) uint32


class ObjectRelations(NamedTuple):
    """Relations of the n objects of a scene; NaN or -1 where a relation is undefined.

    Attributes:
        edge_m: Signed distance of the centre from the nearest edge of the road (m); negative on the road.
        edge_angle_rad: Angle between the length axis and the edge, in [0, pi / 2] (radians).
        neighbour_m: Horizontal distance to the nearest object of the same category (m).
        neighbour_angle_rad: Angle to the length axis of that object, in [0, pi / 2] (radians).
        group_m: Horizontal distance to the nearest other object of each group of GROUPS (m).
        other_m: Horizontal distance to the nearest object of another category, without vegetation (m).
        class_below: Ground class under the centre, an index into GROUND_CLASSES.
        footprint: Number of footprint points on each class of GROUND_CLASSES, then on no ground.
        gap_m: Height of the lowest point above the surface on which objects stand, under the centre (m).
        support: Index into SUPPORTS.
    """

    edge_m: np.ndarray  # (n,)
    edge_angle_rad: np.ndarray  # (n,)
    neighbour_m: np.ndarray  # (n,)
    neighbour_angle_rad: np.ndarray  # (n,)
    group_m: np.ndarray  # (n, 5)
    other_m: np.ndarray  # (n,)
    class_below: np.ndarray  # (n,) int
    footprint: np.ndarray  # (n, 7) int
    gap_m: np.ndarray  # (n,)
    support: np.ndarray  # (n,) int


def compute_scene_relations(scene: Scene, slab_offset_m: float) -> SceneRelations:
    """Compute the relation statistics of one scene.

    Args:
        scene: Scene.
        slab_offset_m: Height of the ground raster above the surface on which objects stand (m).

    Returns:
        Vector and histograms.
    """
    height_m, classes = fuse_ground(scene)
    return summarise_relations(scene, measure_objects(scene, slab_offset_m, height_m, classes), classes)


def summarise_relations(scene: Scene, objects: ObjectRelations, classes: np.ndarray) -> SceneRelations:
    """Compute the relation statistics of one scene from the relations of its objects.

    Args:
        scene: Scene.
        objects: Relations of the objects, as `measure_objects` returns them.
        classes: (H, W) class of the fused ground, an index into GROUND_CLASSES; -1: no ground.

    Returns:
        Vector and histograms.
    """
    perimeter, small_parts = measure_borders(classes, scene.grid.resolution_m)
    widths_m = measure_edge_widths(classes, scene.grid.resolution_m)
    spread = [widths_m.mean(), widths_m.std()] if len(widths_m) else [np.nan, np.nan]
    ground = np.stack([perimeter, small_parts], axis=1).ravel()
    vector = np.concatenate([_average_by_category(scene.category, objects).ravel(), ground, spread])
    return SceneRelations(vector, _count_histograms(scene.category, objects, perimeter))


def fuse_ground(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Fuse the ground classes of a scene (`Scene.surface`).

    Args:
        scene: Scene.

    Returns:
        Height (H, W) in metres, and class (H, W) int8 as an index into GROUND_CLASSES; -1: no ground.
    """
    height_m, winner = scene.surface()
    index = np.array([*(GROUND_CLASSES.index(name) for name in scene.ground_classes), -1], np.int8)
    return height_m, index[winner]


# ------------------------------------------------------------------------------------------------------------ objects


def measure_objects(scene: Scene, slab_offset_m: float, height_m: np.ndarray, classes: np.ndarray) -> ObjectRelations:
    """Measure the relations of each object.

    Args:
        scene: Scene with n objects.
        slab_offset_m: Height of the ground raster above the surface on which objects stand (m).
        height_m: (H, W) height of the fused ground (m).
        classes: (H, W) class of the fused ground, an index into GROUND_CLASSES; -1: no ground.

    Returns:
        Relations of the objects.
    """
    xy_m, yaw_rad = scene.center_m[:, :2].astype(np.float64), scene.yaw_rad.astype(np.float64)
    pixel, inside = _find_pixels(scene, xy_m)
    below = np.where(inside, classes[pixel], -1)
    gap_m = np.where(below >= 0, scene.bottom_m - (height_m[pixel] - slab_offset_m), np.nan)
    edge_m, edge_angle_rad = measure_edge_relations(scene, classes)
    neighbour_m, neighbour_angle_rad, group_m, other_m = _measure_neighbours(scene.category, xy_m, yaw_rad)
    return ObjectRelations(
        edge_m,
        edge_angle_rad,
        neighbour_m,
        neighbour_angle_rad,
        group_m,
        other_m,
        below,
        _count_footprint_classes(scene, classes),
        gap_m,
        find_support(scene, gap_m),
    )


def _find_pixels(scene: Scene, xy_m: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Return the pixel of each point, clipped to the raster, and whether the point lies inside the raster."""
    row, col = scene.grid.pixel(xy_m[..., 0], xy_m[..., 1])
    inside = scene.grid.contains(xy_m[..., 0], xy_m[..., 1])
    return (row.clip(0, scene.grid.rows - 1), col.clip(0, scene.grid.cols - 1)), inside


def find_road_edge(classes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the pixels of the road's edge: road pixels with a 4-neighbour of another class inside the raster.

    Args:
        classes: (H, W) class of the fused ground, an index into GROUND_CLASSES; -1: no ground.

    Returns:
        Rows and columns of the pixels.
    """
    road = IS_ROAD[classes]
    edge = np.zeros_like(road)
    for axis in (0, 1):
        a, b = (np.swapaxes(part, 0, axis) for part in (road, edge))
        differs = a[1:] != a[:-1]
        b[1:] |= differs & a[1:]
        b[:-1] |= differs & a[:-1]
    row, col = np.nonzero(edge)
    return row, col


def measure_edge_relations(scene: Scene, classes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Measure the position and the direction of objects relative to the nearest edge of the road.

    Args:
        scene: Scene with n objects.
        classes: (H, W) class of the fused ground, an index into GROUND_CLASSES; -1: no ground.

    Returns:
        Signed distance (n,) of the centre from the edge (m), negative on the road; and angle (n,) between the length
        axis and the edge, in [0, pi / 2] (radians). Both are NaN if there is no edge.
    """
    row, col = find_road_edge(classes)
    if len(row) < EDGE_PIXELS or not len(scene):
        return np.full(len(scene), np.nan), np.full(len(scene), np.nan)
    xy_m = scene.center_m[:, :2].astype(np.float64)
    edge_m = np.stack([scene.grid.x_m()[row], scene.grid.y_m()[col]], axis=1)
    tree = cKDTree(edge_m)
    distance_m, nearest = tree.query(xy_m)
    found, place = np.unique(nearest, return_inverse=True)
    points_m = edge_m[tree.query(edge_m[found], k=EDGE_PIXELS)[1]]  # (e, k, 2)
    points_m = points_m - points_m.mean(axis=1, keepdims=True)
    xx, yy, xy = (points_m[..., i] * points_m[..., j] for i, j in ((0, 0), (1, 1), (0, 1)))
    direction_rad = 0.5 * np.arctan2(2 * xy.sum(axis=1), (xx - yy).sum(axis=1))  # Axis of the largest spread.
    pixel, inside = _find_pixels(scene, xy_m)
    on_road = inside & IS_ROAD[classes[pixel]]
    signed_m = np.where(on_road, -distance_m, distance_m).clip(-EDGE_LIMIT_M, EDGE_LIMIT_M)
    return signed_m, _fold_angle(scene.yaw_rad - direction_rad[place])


def _fold_angle(angle_rad: np.ndarray) -> np.ndarray:
    """Return the angle between two axes without direction, in [0, pi / 2]."""
    return np.abs((angle_rad + np.pi / 2) % np.pi - np.pi / 2)


def _measure_neighbours(
    category: np.ndarray, xy_m: np.ndarray, yaw_rad: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return distance and angle to the nearest object of the category, and distances to groups and other objects."""
    n = len(category)
    x_m, y_m = xy_m.T
    squared = (x_m[:, None] - x_m) ** 2 + (y_m[:, None] - y_m) ** 2
    np.fill_diagonal(squared, np.inf)
    same = category[:, None] == category[None]
    own = np.where(same, squared, np.inf)
    nearest = own.argmin(axis=1) if n else np.zeros(0, int)
    neighbour_m = np.sqrt(own[np.arange(n), nearest])
    angle_rad = np.where(np.isfinite(neighbour_m), _fold_angle(yaw_rad - yaw_rad[nearest]), np.nan)
    groups = GROUP_OF[category]
    group_m = np.full((n, len(GROUPS)), np.inf)
    for k in range(len(GROUPS)):
        members = np.flatnonzero(groups == k)
        if len(members):
            group_m[:, k] = np.sqrt(squared[:, members].min(axis=1))
    solid = np.flatnonzero(~np.isin(category, VEGETATION))
    other_m = np.full(n, np.inf)
    if len(solid):
        other_m = np.sqrt(np.where(same[:, solid], np.inf, squared[:, solid]).min(axis=1))
    for distance_m in (neighbour_m, group_m, other_m):
        distance_m[np.isinf(distance_m)] = np.nan
    return neighbour_m, angle_rad, group_m, other_m


def _count_footprint_classes(scene: Scene, classes: np.ndarray) -> np.ndarray:
    """Return the number of footprint points (n, 7) on each class of GROUND_CLASSES, then on no ground."""
    along = (np.arange(FOOTPRINT_POINTS) + 0.5) / FOOTPRINT_POINTS - 0.5
    unit = np.stack(np.meshgrid(along, along, indexing="ij"), axis=-1).reshape(-1, 2)  # (p, 2)
    axes_m = scene.rotation[:, :2, :2] * scene.size_m[:, None, :2]  # (n, 2, 2): length axis, width axis.
    points_m = scene.center_m[:, None, :2] + np.einsum("nij,pj->npi", axes_m, unit)
    pixel, inside = _find_pixels(scene, points_m)
    found = np.where(inside, classes[pixel], -1)
    found = np.where(found < 0, len(GROUND_CLASSES), found)
    return (found[..., None] == np.arange(len(GROUND_CLASSES) + 1)).sum(axis=1)


def find_support(scene: Scene, gap_m: np.ndarray) -> np.ndarray:
    """Find what supports each object.

    An object stands on the ground if the gap under its lowest point is at most SUPPORT_M. Otherwise, a pole, wall or
    building supports the object if the boxes of both, enlarged by half of SUPPORT_M on each side, intersect. Vegetation
    is only tested against the ground, because the data do not annotate trunks.

    Args:
        scene: Scene with n objects.
        gap_m: (n,) height of the lowest point above the ground under the centre (m); NaN: no ground.

    Returns:
        (n,) index into SUPPORTS.
    """
    support = np.where(gap_m <= SUPPORT_M, 0, UNSUPPORTED)
    hanging = np.flatnonzero(support.astype(bool) & ~np.isin(scene.category, VEGETATION))
    supporters = np.flatnonzero(np.isin(scene.category, SUPPORTERS))
    if len(hanging) and len(supporters):
        boxes = extract_boxes(scene)
        grown = Boxes(boxes.center_m, boxes.rotation, boxes.size_m + SUPPORT_M)
        i, j = find_overlapping_bounds(grown.take(hanging), grown.take(supporters))
        other = hanging[i] != supporters[j]
        i, j = hanging[i[other]], supporters[j[other]]
        support[i[find_intersecting_pairs(grown.take(i), grown.take(j))]] = 1
    return support


# ------------------------------------------------------------------------------------------------------------- ground


def measure_borders(classes: np.ndarray, resolution_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Measure the border of each ground class, and count its small parts.

    Args:
        classes: (H, W) class of the fused ground, an index into GROUND_CLASSES; -1: no ground.
        resolution_m: Side of a pixel (m).

    Returns:
        Border length per area (6,) of each class of GROUND_CLASSES (1/m), and number of 4-connected parts with an area
        below SMALL_PART_M2 (6,). Both are NaN for an absent class.
    """
    size = len(GROUND_CLASSES) + 1  # The last entry stands for pixels without ground.
    area = np.bincount(classes.ravel() % size, minlength=size)[:-1]
    sides = np.zeros(size)
    for first, second in ((classes[1:], classes[:-1]), (classes[:, 1:], classes[:, :-1])):
        differs = first != second
        for part in (first, second):
            sides += np.bincount(part[differs] % size, minlength=size)
    parts = cast(np.ndarray, label_regions(classes, background=-1, connectivity=1))
    pixels = np.bincount(parts.ravel())
    is_small = pixels * resolution_m**2 < SMALL_PART_M2
    is_small[0] = False
    here = is_small[parts]
    _, one_pixel = np.unique(parts[here], return_index=True)
    number = np.bincount(classes[here][one_pixel], minlength=size - 1)
    known = area > 0
    perimeter = np.divide(sides[:-1], area * resolution_m, out=np.full(size - 1, np.nan), where=known)
    return perimeter, np.where(known, number, np.nan)


def measure_edge_widths(classes: np.ndarray, resolution_m: float) -> np.ndarray:
    """Measure the width of the road along rows and columns.

    A run is a maximal sequence of road pixels in a row or in a column that does not touch the border of the raster. At
    each road pixel that belongs to two runs, the width is the length of the shorter run.

    Args:
        classes: (H, W) class of the fused ground, an index into GROUND_CLASSES; -1: no ground.
        resolution_m: Side of a pixel (m).

    Returns:
        (p,) widths between MIN_WIDTH_M and MAX_WIDTH_M (m).
    """
    road = IS_ROAD[classes]
    rows, cols = _measure_runs(road), _measure_runs(road.T).T
    widths_m = np.minimum(rows, cols)[road] * resolution_m
    return widths_m[(widths_m >= MIN_WIDTH_M) & (widths_m <= MAX_WIDTH_M)]


def _measure_runs(mask: np.ndarray) -> np.ndarray:
    """Return the length of the horizontal run (H, W) of each pixel of a mask; infinite if it touches the border."""
    padded = np.pad(mask, ((0, 0), (1, 1)))
    change = np.diff(padded.astype(np.int8), axis=1)
    start, stop = (np.nonzero(change == sign)[1] for sign in (1, -1))
    length = np.where((start == 0) | (stop == mask.shape[1]), np.inf, stop - start)
    out = np.zeros(mask.shape)
    out[mask] = np.repeat(length, stop - start)  # Runs are in the order of the pixels of the mask.
    return out


# ------------------------------------------------------------------------------------------------------------- counts


def _average_by_category(category: np.ndarray, objects: ObjectRelations) -> np.ndarray:
    """Return the mean (11, 13) of each value of PER_CATEGORY; NaN where no object has a value."""
    log_m = [np.log10(distance_m.clip(*NEIGHBOUR_RANGE_M)) for distance_m in (objects.neighbour_m, objects.other_m)]
    below = objects.class_below
    known = below >= 0
    total = objects.footprint.sum(axis=1)
    road_points = objects.footprint[:, IS_ROAD].sum(axis=1)
    values = np.stack(
        [
            objects.edge_m,
            np.where(np.isnan(objects.edge_m), np.nan, np.abs(objects.edge_m) < NEAR_EDGE_M),
            np.cos(2 * objects.edge_angle_rad),
            np.cos(4 * objects.edge_angle_rad),
            log_m[0],
            np.where(np.isnan(objects.neighbour_m), np.nan, objects.neighbour_m < TOUCHING_M),
            np.cos(2 * objects.neighbour_angle_rad),
            log_m[1],
            np.where(known, IS_ROAD[below], np.nan),
            np.where(known, below == SIDEWALK, np.nan),
            road_points / np.maximum(total, 1),
            objects.gap_m.clip(-SUPPORT_RANGE_M, SUPPORT_RANGE_M),
            objects.support != UNSUPPORTED,
        ],
        axis=1,
    ).reshape(-1, len(PER_CATEGORY))
    known_values = np.isfinite(values)
    sums, counts = np.zeros((2, len(CATEGORIES), len(PER_CATEGORY)))
    np.add.at(sums, category, np.where(known_values, values, 0))
    np.add.at(counts, category, known_values)
    return np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0)


def _count_histograms(category: np.ndarray, objects: ObjectRelations, perimeter: np.ndarray) -> np.ndarray:
    """Return the counts over the bins of RELATION_HISTOGRAMS, one histogram after the other."""
    histograms, parts = iter(RELATION_HISTOGRAMS), []

    def count(values: np.ndarray) -> None:
        parts.append(next(histograms).count(values[np.isfinite(values)]))

    for index in range(len(CATEGORIES)):
        members = category == index
        count(objects.edge_m[members])
        count(np.degrees(objects.edge_angle_rad[members]))
        count(objects.neighbour_m[members])
        count(np.degrees(objects.neighbour_angle_rad[members]))
        next(histograms)
        parts.append(objects.footprint[members].sum(axis=0))
        parts.append(next(histograms).count(objects.support[members]))
    groups = GROUP_OF[category]
    for first in range(len(GROUPS)):
        for second in range(len(GROUPS)):
            count(objects.group_m[groups == first, second])
    for value in perimeter:
        count(np.array([value]))
    return np.concatenate(parts).astype(np.uint32)
