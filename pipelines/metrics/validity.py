"""Compute validity measures: shares of implausible primitives, road connectivity and label fidelity.

Each scene is summarised by a float64 record of shape (measures, 2): a numerator and a denominator per measure. Records
can be added, and a stack of records can be resampled for confidence intervals. Each measure is a share. Lower is
better, except for `road_connectivity` and label fidelity. Real scenes do not reach 0. Therefore, compare the shares
with the shares of real scenes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from models.geometry.iou3d import compute_iou3d_matrix, extract_boxes
from models.scene import CATEGORIES, CATEGORY_INDEX, DRIVABLE_CLASSES, ROAD_CLASSES, VEGETATION, VEHICLES, Scene
from pipelines.geometry.masks import label_parts
from pipelines.schema.density_labels import DensityThresholds, classify_density

# Measures that use the height or class of the ground apply only to primitives with ground under their centre.
MEASURES = (
    "overlapping",  # Solid primitives whose IoU3D with another solid primitive exceeds 0.05.
    "floating",  # Standing primitives whose lowest point is more than 0.5 m above the surface.
    "sunken",  # Standing primitives whose lowest point is more than 0.5 m below the surface.
    "over_unknown_ground",  # Standing primitives inside the grid that have no ground under their centre.
    "off_road_vehicles",  # Vehicles whose centre does not lie on a drivable class.
    "buildings_on_road",  # Buildings whose centre lies on the road.
    "road_connectivity",  # Share of road pixels in the largest 4-connected component, averaged over scenes with road.
)
LABEL_MEASURES = ("vegetation_fidelity", "vehicle_fidelity", "joint_fidelity")

OVERLAP_IOU3D = 0.05
TOLERANCE_M = 0.5
SLAB_OFFSET_M = 0.3  # Height of slab tops above the surface (KITTI-360, town). Argoverse 2 has no slabs.
SOLID = tuple(c for c in range(len(CATEGORIES)) if c not in VEGETATION)
# Categories whose primitives stand on the ground. In a real drive of KITTI-360, 0 % of the primitives in these
# categories float and 7 % are sunken. The other categories are excluded, because many of their primitives in this drive
# are not annotated on the ground: traffic_control (100 % float), vegetation_ellipsoid (29 % float), vegetation_cuboid
# (37 % sunken) and construction_small (28 % sunken).
STANDING = tuple(
    CATEGORY_INDEX[name]
    for name in ("vehicle_big", "vehicle_small", "two_wheelers", "human", "construction_big", "pole", "object")
)
BUILDING = CATEGORY_INDEX["construction_big"]


def find_slab_offset_m(surface: str) -> float:
    """Return the height of the ground raster above the surface on which the objects of a dataset stand (m).

    Args:
        surface: Attribute `surface` of the dataset's LayoutSpec.

    Returns:
        Offset (m).
    """
    return SLAB_OFFSET_M if surface == "top" else 0.0


def find_faults(
    scene: Scene, slab_offset_m: float, tolerance_m: float = TOLERANCE_M
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Find the implausible primitives, for each of MEASURES except `road_connectivity`.

    Args:
        scene: Scene with n primitives.
        slab_offset_m: Height of the scene's ground raster above the surface on which objects stand (m).
        tolerance_m: Maximum distance of an object from the surface (m).

    Returns:
        For each measure, two (n,) bool arrays: whether a primitive is implausible, and whether the measure applies to
        it.
    """
    category = scene.category
    row, col = scene.grid.pixel(scene.center_m[:, 0], scene.center_m[:, 1])
    inside = scene.grid.contains(scene.center_m[:, 0], scene.center_m[:, 1])
    pixel = row.clip(0, scene.grid.rows - 1), col.clip(0, scene.grid.cols - 1)
    height_m, ground_class = scene.ground_under()
    known = ground_class >= 0
    above_m = scene.bottom_m - (height_m - slab_offset_m)

    standing = np.isin(category, STANDING)
    vehicles, buildings = np.isin(category, VEHICLES), category == BUILDING
    drivable, road = (_make_mask(scene, classes)[pixel] for classes in (DRIVABLE_CLASSES, ROAD_CLASSES))
    looked_for = {
        "overlapping": (_find_overlapping(scene), np.isin(category, SOLID)),
        "floating": (above_m > tolerance_m, standing & known),
        "sunken": (above_m < -tolerance_m, standing & known),
        "over_unknown_ground": (~known, standing & inside),
        "off_road_vehicles": (~drivable, vehicles & known),
        "buildings_on_road": (road, buildings & known),
    }
    return {name: (bad & among, among) for name, (bad, among) in looked_for.items()}


def compute_scene_validity(scene: Scene, slab_offset_m: float) -> np.ndarray:
    """Compute the validity record of one scene.

    Args:
        scene: Scene.
        slab_offset_m: Height of the scene's ground raster above the surface on which objects stand (m).

    Returns:
        (7, 2) numerators and denominators of MEASURES.
    """
    shares = [(int(bad.sum()), int(among.sum())) for bad, among in find_faults(scene, slab_offset_m).values()]
    return np.array([*shares, _find_largest_component(_make_mask(scene, ROAD_CLASSES))], np.float64)


def compute_label_fidelity(scene: Scene, vegetation: DensityThresholds, vehicle: DensityThresholds) -> np.ndarray:
    """Compare the density of a scene with the requested density label.

    A missing label is not compared.

    Args:
        scene: Scene with at least one density label.
        vegetation: Thresholds of the vegetation density.
        vehicle: Thresholds of the vehicle density.

    Returns:
        (3, 2) numerators and denominators of LABEL_MEASURES.

    Raises:
        ValueError: The scene has no density label.
    """
    if scene.vegetation_density is None and scene.vehicle_density is None:
        raise ValueError(f"scene {scene.scene_id} has no density label; label fidelity needs the requested label")
    right = []
    for categories, thresholds, label in (
        (VEGETATION, vegetation, scene.vegetation_density),
        (VEHICLES, vehicle, scene.vehicle_density),
    ):
        members = np.isin(scene.category, categories)
        own = classify_density(members.sum(), scene.volume_m3[members].sum(), thresholds)
        right.append(None if label is None else bool(own == label))
    right.append(None if None in right else all(right))
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


def _find_overlapping(scene: Scene) -> np.ndarray:
    """Return (n,) bool: whether a solid primitive has an IoU3D above OVERLAP_IOU3D with another solid primitive."""
    solid = np.flatnonzero(np.isin(scene.category, SOLID))
    boxes = extract_boxes(scene).take(solid)
    iou = compute_iou3d_matrix(boxes, boxes)
    np.fill_diagonal(iou, 0)
    overlapping = np.zeros(len(scene), bool)
    overlapping[solid] = (iou > OVERLAP_IOU3D).any(axis=1)
    return overlapping


def _make_mask(scene: Scene, classes: Iterable[str]) -> np.ndarray:
    """Return (H, W) bool: whether a pixel is occupied by at least one of the classes. Classes may overlap."""
    index = [scene.ground_classes.index(name) for name in classes if name in scene.ground_classes]
    return np.any(scene.occupied[index], axis=0)


def _find_largest_component(mask: np.ndarray) -> tuple[float, int]:
    """Return (share of the mask's pixels in the largest 4-connected component, 1), or (0, 0) for an empty mask."""
    components, _ = label_parts(mask)
    sizes = np.bincount(components.ravel())[1:]
    return (float(sizes.max() / sizes.sum()), 1) if len(sizes) else (0.0, 0)
