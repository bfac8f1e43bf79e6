"""Validity of scenes: overlapping, floating or sunken objects, cars off the road, buildings on it, broken roads.

One record per scene: (measures, 2) float64, a numerator and a denominator per measure. Records add up; a stack of them
can be resampled for intervals. A measure is a share, the lower the better except `road_connectivity` and label
fidelity; real scenes give the level to compare with, it is not 0.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from models.geometry.iou3d import compute_iou3d_matrix, extract_boxes
from models.scene import CATEGORIES, CATEGORY_INDEX, DRIVABLE_CLASSES, ROAD_CLASSES, VEGETATION, VEHICLES, Scene
from pipelines.geometry.masks import label_parts
from pipelines.schema.density_labels import DensityThresholds, classify_density

MEASURES = (
    "overlapping",  # solid primitives with IoU3D > 0.05 with another solid one
    "floating",  # standing primitives with known ground whose lowest point is more than 0.5 m above the surface
    "sunken",  # ... more than 0.5 m below it
    "over_unknown_ground",  # standing primitives inside the grid whose centre lies over no ground at all
    "off_road_vehicles",  # vehicles with known ground whose centre lies on no drivable class
    "buildings_on_road",  # buildings with known ground whose centre lies on the road
    "road_connectivity",  # road pixels in the scene's largest 4-connected road component; mean over scenes with road
)
LABEL_MEASURES = ("vegetation_fidelity", "vehicle_fidelity", "joint_fidelity")

OVERLAP_IOU3D = 0.05
TOLERANCE_M = 0.5
SLAB_OFFSET_M = 0.3  # where ground heights are slab tops (KITTI-360, town); 0 where they are the surface (Argoverse 2)
SOLID = tuple(c for c in range(len(CATEGORIES)) if c not in VEGETATION)
# Of these, 0 % float and 7 % are sunk in a real drive of KITTI-360. Left out: signs, lamps and crowns, which hang in
# the air there too (100 % and 29 %), and hedges and walls, which are drawn into the ground (37 % and 28 %).
STANDING = tuple(
    CATEGORY_INDEX[name]
    for name in ("vehicle_big", "vehicle_small", "two_wheelers", "human", "construction_big", "pole", "object")
)
BUILDING = CATEGORY_INDEX["construction_big"]


def find_slab_offset_m(surface: str) -> float:
    """Return the height of a dataset's ground above the objects' surface, by `surface` of its LayoutSpec; metres."""
    return SLAB_OFFSET_M if surface == "top" else 0.0


def find_faults(
    scene: Scene, slab_offset_m: float, tolerance_m: float = TOLERANCE_M
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """For each of MEASURES but the last: which primitives (n,) bool are at fault, and among which it is looked for.

    slab_offset_m is how far the scene's ground heights lie above the surface that objects stand on (SLAB_OFFSET_M);
    tolerance_m how far off it a thing may be.
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
    """(7, 2) numerators and denominators of MEASURES for one scene; slab_offset_m as for `find_faults`."""
    shares = [(int(bad.sum()), int(among.sum())) for bad, among in find_faults(scene, slab_offset_m).values()]
    return np.array([*shares, _find_largest_component(_make_mask(scene, ROAD_CLASSES))], np.float64)


def compute_label_fidelity(scene: Scene, vegetation: DensityThresholds, vehicle: DensityThresholds) -> np.ndarray:
    """(3, 2) LABEL_MEASURES: whether the density computed from the scene equals its label, the requested one.

    A missing label is not judged. Raises ValueError for a scene without any label.
    """
    if scene.vegetation_density is None and scene.vehicle_density is None:
        raise ValueError(f"scene {scene.scene_id} has no density label; label fidelity needs the requested one")
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
    """Compute the share per measure over all scenes, from records (scenes, measures, 2); None if nothing was judged."""
    records = np.asarray(records, np.float64).reshape(-1, len(names), 2)
    numerator, denominator = records.sum(axis=0).T
    return {n: float(a / b) if b > 0 else None for n, a, b in zip(names, numerator, denominator, strict=True)}


def _find_overlapping(scene: Scene) -> np.ndarray:
    """(n,) bool: whether a solid primitive overlaps another solid one by more than OVERLAP_IOU3D."""
    solid = np.flatnonzero(np.isin(scene.category, SOLID))
    boxes = extract_boxes(scene).take(solid)
    iou = compute_iou3d_matrix(boxes, boxes)
    np.fill_diagonal(iou, 0)
    overlapping = np.zeros(len(scene), bool)
    overlapping[solid] = (iou > OVERLAP_IOU3D).any(axis=1)
    return overlapping


def _make_mask(scene: Scene, classes: Iterable[str]) -> np.ndarray:
    """(H, W) bool: whether any of the classes occupies the pixel (classes may overlap)."""
    index = [scene.ground_classes.index(name) for name in classes if name in scene.ground_classes]
    return np.any(scene.occupied[index], axis=0)


def _find_largest_component(mask: np.ndarray) -> tuple[float, int]:
    """Share of the mask's pixels in its largest 4-connected component, and 1; (0, 0) for an empty mask."""
    components, _ = label_parts(mask)
    sizes = np.bincount(components.ravel())[1:]
    return (float(sizes.max() / sizes.sum()), 1) if len(sizes) else (0.0, 0)
