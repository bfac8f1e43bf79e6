"""Compute validity measures: shares of implausible primitives, road connectivity and label fidelity.

Each scene is summarised by a float64 record of shape (measures, 2): a numerator and a denominator per measure. Records
can be added, and a stack of records can be resampled for confidence intervals. Each measure is a share. Real scenes do
not reach 0: for example, every fifth object of a KITTI-360 drive overlaps another. The best value of a measure is
therefore the value of real scenes. A lower share is a deviation, like a higher one.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any

import numpy as np

from models.geometry.iou3d import (
    compute_intersection_volume_m3,
    extract_boxes,
    find_overlapping_bounds,
)
from models.scene import (
    CATEGORIES,
    CATEGORY_INDEX,
    DENSITIES,
    DRIVABLE_CLASSES,
    ROAD_CLASSES,
    VEGETATION,
    VEHICLES,
    Scene,
)
from pipelines.geometry.masks import label_parts
from pipelines.metrics.relations import UNSUPPORTED, ObjectRelations, fuse_ground, measure_objects
from pipelines.schema.density_labels import DensityThresholds, classify_density

# Measures that use the height or class of the ground apply only to primitives with ground under their centre.
OBJECT_MEASURES = (
    "overlapping",  # Solid primitives in a pair whose smaller primitive has 25 % of its volume in the other.
    "overlapping_iou3d",  # Solid primitives whose IoU3D with another solid primitive exceeds 0.05.
    "floating",  # Standing primitives whose lowest point is more than 0.5 m above the surface.
    "sunken",  # Standing primitives whose lowest point is more than 0.5 m below the surface.
    "over_unknown_ground",  # Standing primitives inside the grid that have no ground under their centre.
    "off_road_vehicles",  # Vehicles whose centre does not lie on a drivable class.
    "constructions_on_road",  # Buildings and walls with more than 1 m2 of their footprint on the road.
    "constructions_on_sidewalk",  # Buildings and walls with more than 1 m2 of their footprint on the sidewalk.
    "unattached",  # Signs, lamps, signals and poles more than 0.3 m from ground, poles, walls and buildings.
    "across_lane_vehicles",  # Vehicles on the road, turned by more than 45 degrees from the nearest edge of the road.
)
# The last measure is the share of road pixels in the largest 4-connected component, averaged over scenes with road.
MEASURES = (*OBJECT_MEASURES, "road_connectivity")
# Shares of scenes with the requested density: of vegetation, of vehicles and of both. The other measures cover only
# the scenes with one requested label. If most scenes have one label, the first three measures hide the others.
LABEL_MEASURES = (
    "vegetation_fidelity",
    "vehicle_fidelity",
    "joint_fidelity",
    *(f"{kind}_fidelity_{label}" for kind in ("vegetation", "vehicle") for label in DENSITIES),
)

OVERLAP_SHARE = 0.25
OVERLAP_IOU3D = 0.05
ON_GROUND_M2 = 1.0
FOOTPRINT_STEP_M = 0.5
LANE_ANGLE_RAD = np.pi / 4
TOLERANCE_M = 0.5
SOLID = tuple(c for c in range(len(CATEGORIES)) if c not in VEGETATION)
# Categories whose primitives stand on the ground. In a real drive of KITTI-360, 0 % of the primitives in these
# categories float and 7 % are sunken. The other categories are excluded, because many of their primitives in this drive
# are not annotated on the ground: traffic_control (100 % float), vegetation_ellipsoid (29 % float), vegetation_cuboid
# (37 % sunken) and construction_small (28 % sunken).
STANDING = tuple(
    CATEGORY_INDEX[name]
    for name in ("vehicle_big", "vehicle_small", "two_wheelers", "human", "construction_big", "pole", "object")
)
CONSTRUCTIONS = (CATEGORY_INDEX["construction_big"], CATEGORY_INDEX["construction_small"])
ATTACHED = (CATEGORY_INDEX["traffic_control"], CATEGORY_INDEX["pole"])


def find_faults(
    scene: Scene,
    slab_offset_m: float,
    tolerance_m: float = TOLERANCE_M,
    names: Sequence[str] = OBJECT_MEASURES,
    objects: ObjectRelations | None = None,
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Find the implausible primitives, for each of OBJECT_MEASURES.

    Args:
        scene: Scene with n primitives.
        slab_offset_m: Height of the scene's ground raster above the surface on which objects stand (m).
        tolerance_m: Maximum distance of an object from the surface (m).
        names: Measures to compute.
        objects: Relations of the primitives; None: they are measured if a measure needs them.

    Returns:
        For each measure, two (n,) bool arrays: whether a primitive is implausible, and whether the measure applies to
        it.
    """
    category = scene.category
    row, col = scene.grid.pixel(scene.center_m[:, 0], scene.center_m[:, 1])
    inside = scene.grid.contains(scene.center_m[:, 0], scene.center_m[:, 1])
    pixel = row.clip(0, scene.grid.rows - 1), col.clip(0, scene.grid.cols - 1)
    if objects:
        known, above_m = objects.class_below >= 0, objects.gap_m
    else:
        height_m, ground_class = scene.ground_under()
        known, above_m = ground_class >= 0, scene.bottom_m - (height_m - slab_offset_m)

    standing, solid = np.isin(category, STANDING), np.isin(category, SOLID)
    vehicles, constructions = np.isin(category, VEHICLES), np.isin(category, CONSTRUCTIONS)
    drivable, road = (_make_mask(scene, classes) for classes in (DRIVABLE_CLASSES, ROAD_CLASSES))
    attached = np.isin(category, ATTACHED)
    relations = cache(lambda: objects or measure_objects(scene, slab_offset_m, *fuse_ground(scene)))
    overlaps = cache(lambda: _find_overlapping(scene))
    sidewalk = _make_mask(scene, ("sidewalk",)) & ~road
    areas_m2 = cache(lambda: _measure_footprints_m2(scene, constructions, np.stack([road, sidewalk], axis=-1)))
    find = {
        "overlapping": lambda: (overlaps()[0], solid),
        "overlapping_iou3d": lambda: (overlaps()[1], solid),
        "floating": lambda: (above_m > tolerance_m, standing & known),
        "sunken": lambda: (above_m < -tolerance_m, standing & known),
        "over_unknown_ground": lambda: (~known, standing & inside),
        "off_road_vehicles": lambda: (~drivable[pixel], vehicles & known),
        "constructions_on_road": lambda: (areas_m2()[:, 0] > ON_GROUND_M2, constructions),
        "constructions_on_sidewalk": lambda: (areas_m2()[:, 1] > ON_GROUND_M2, constructions),
        "unattached": lambda: (relations().support == UNSUPPORTED, attached & inside),
        "across_lane_vehicles": lambda: (
            relations().edge_angle_rad > LANE_ANGLE_RAD,
            vehicles & road[pixel] & inside & np.isfinite(relations().edge_angle_rad),
        ),
    }
    found = {name: find[name]() for name in names}
    return {name: (bad & among, among) for name, (bad, among) in found.items()}


def compute_scene_validity(scene: Scene, slab_offset_m: float) -> np.ndarray:
    """Compute the validity record of one scene.

    Args:
        scene: Scene.
        slab_offset_m: Height of the scene's ground raster above the surface on which objects stand (m).

    Returns:
        (11, 2) numerators and denominators of MEASURES.
    """
    return sum_validity(*compute_category_validity(scene, slab_offset_m))


def compute_category_validity(
    scene: Scene, slab_offset_m: float, objects: ObjectRelations | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the validity record of one scene for each category.

    Args:
        scene: Scene.
        slab_offset_m: Height of the scene's ground raster above the surface on which objects stand (m).
        objects: Relations of the primitives; None: they are measured.

    Returns:
        (10, 11, 2) numerators and denominators of OBJECT_MEASURES for each category, and (2,) numerator and denominator
        of the road connectivity.
    """
    record = np.zeros((len(OBJECT_MEASURES), len(CATEGORIES), 2))
    for k, (bad, among) in enumerate(find_faults(scene, slab_offset_m, objects=objects).values()):
        for side, mask in enumerate((bad, among)):
            record[k, :, side] = np.bincount(scene.category[mask], minlength=len(CATEGORIES))
    return record, np.array(_find_largest_component(_make_mask(scene, ROAD_CLASSES)), np.float64)


def sum_validity(by_category: np.ndarray, connectivity: np.ndarray) -> np.ndarray:
    """Sum the record of a scene over the categories.

    Args:
        by_category: (10, 11, 2) numerators and denominators of OBJECT_MEASURES.
        connectivity: (2,) numerator and denominator of the road connectivity.

    Returns:
        (11, 2) numerators and denominators of MEASURES.
    """
    return np.concatenate([by_category.sum(axis=1), connectivity[None]])


def judge_densities(scene: Scene, vegetation: DensityThresholds, vehicle: DensityThresholds) -> tuple[str, str]:
    """Return the densities of vegetation and vehicles that a scene has by the thresholds of a dataset.

    Args:
        scene: Scene.
        vegetation: Thresholds of the vegetation density.
        vehicle: Thresholds of the vehicle density.

    Returns:
        Density of the vegetation, then of the vehicles.
    """
    found = []
    for categories, thresholds in ((VEGETATION, vegetation), (VEHICLES, vehicle)):
        members = np.isin(scene.category, categories)
        found.append(str(classify_density(members.sum(), scene.volume_m3[members].sum(), thresholds)))
    return found[0], found[1]


def compute_label_fidelity(scene: Scene, vegetation: DensityThresholds, vehicle: DensityThresholds) -> np.ndarray:
    """Compare the density of a scene with the requested density label.

    A missing label is not compared.

    Args:
        scene: Scene with at least one density label.
        vegetation: Thresholds of the vegetation density.
        vehicle: Thresholds of the vehicle density.

    Returns:
        (9, 2) numerators and denominators of LABEL_MEASURES.

    Raises:
        ValueError: The scene has no density label.
    """
    if scene.vegetation_density is None and scene.vehicle_density is None:
        raise ValueError(f"scene {scene.scene_id} has no density label; label fidelity needs the requested label")
    right: list[bool | None] = []
    by_label: list[bool | None] = []
    requested = scene.vegetation_density, scene.vehicle_density
    for own, label in zip(judge_densities(scene, vegetation, vehicle), requested, strict=True):
        right.append(None if label is None else own == label)
        by_label += [right[-1] if label == one else None for one in DENSITIES]
    right.append(None if None in right else all(right))
    right += by_label
    return np.array([[bool(value), value is not None] for value in right], np.float64)


def compute_validity_rates(
    records: np.ndarray | Sequence[Any], names: Sequence[str] = MEASURES
) -> dict[str, float | None]:
    """Compute the share of each measure over all scenes.

    Args:
        records: (scenes, measures, 2) numerators and denominators.
        names: Names of the measures.

    Returns:
        Share in [0, 1], for each measure. None: the denominators of the measure sum to 0.
    """
    records = np.asarray(records, np.float64).reshape(-1, len(names), 2)
    numerator, denominator = records.sum(axis=0).T
    return {n: float(a / b) if b > 0 else None for n, a, b in zip(names, numerator, denominator, strict=True)}


def _measure_footprints_m2(scene: Scene, chosen: np.ndarray, masks: np.ndarray) -> np.ndarray:
    """Return the area (n, k) of the footprint of each chosen primitive on k masks (H, W, k); 0 for other primitives.

    The footprint is the rectangle of length and width, sampled about every FOOTPRINT_STEP_M.
    """
    some = np.flatnonzero(chosen)
    size_m = scene.size_m[some, :2].astype(float)
    counts = np.maximum(np.rint(size_m / FOOTPRINT_STEP_M).astype(int), 1)
    points = counts.prod(axis=1)
    owner = np.repeat(np.arange(len(some)), points)
    number = np.arange(points.sum()) - np.repeat(np.cumsum(points) - points, points)
    place = np.stack([number // counts[owner, 1], number % counts[owner, 1]], axis=1)
    offset_m = ((place + 0.5) / counts[owner] - 0.5) * size_m[owner]
    xy_m = scene.center_m[some, :2][owner] + np.einsum("nij,nj->ni", scene.rotation[some, :2, :2][owner], offset_m)
    row, col = scene.grid.pixel(xy_m[:, 0], xy_m[:, 1])
    inside = scene.grid.contains(xy_m[:, 0], xy_m[:, 1])
    on = masks[row.clip(0, scene.grid.rows - 1), col.clip(0, scene.grid.cols - 1)] & inside[:, None]
    areas_m2 = np.zeros((len(scene), masks.shape[-1]))
    for k in range(masks.shape[-1]):
        areas_m2[some, k] = np.bincount(owner, on[:, k], minlength=len(some)) / points * size_m.prod(axis=1)
    return areas_m2


def _find_overlapping(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return two (n,) bool arrays: whether a solid primitive belongs to a pair that overlaps, by either definition.

    First definition: the intersection has at least OVERLAP_SHARE of the volume of the smaller primitive. Unlike IoU3D,
    this share is large for a small object inside a large one. Second definition: IoU3D exceeds OVERLAP_IOU3D.
    """
    solid = np.flatnonzero(np.isin(scene.category, SOLID))
    boxes = extract_boxes(scene).take(solid)
    i, j = find_overlapping_bounds(boxes, boxes)
    i, j = i[i < j], j[i < j]
    volume_i_m3, volume_j_m3 = boxes.volume_m3[i], boxes.volume_m3[j]
    common_m3 = compute_intersection_volume_m3(boxes.take(i), boxes.take(j))
    overlaps = (
        (common_m3 > 0) & (common_m3 >= OVERLAP_SHARE * np.minimum(volume_i_m3, volume_j_m3)),
        common_m3 > OVERLAP_IOU3D * (volume_i_m3 + volume_j_m3 - common_m3),
    )
    found = np.zeros((2, len(scene)), bool)
    for k, hit in enumerate(overlaps):
        found[k, solid[np.concatenate([i[hit], j[hit]])]] = True
    return found[0], found[1]


def _make_mask(scene: Scene, classes: Iterable[str]) -> np.ndarray:
    """Return (H, W) bool: whether a pixel is occupied by at least one of the classes. Classes may overlap."""
    index = [scene.ground_classes.index(name) for name in classes if name in scene.ground_classes]
    return np.any(scene.occupied[index], axis=0)


def _find_largest_component(mask: np.ndarray) -> tuple[float, int]:
    """Return (share of the mask's pixels in the largest 4-connected component, 1), or (0, 0) for an empty mask."""
    components, _ = label_parts(mask)
    sizes = np.bincount(components.ravel())[1:]
    return (float(sizes.max() / sizes.sum()), 1) if len(sizes) else (0.0, 0)
