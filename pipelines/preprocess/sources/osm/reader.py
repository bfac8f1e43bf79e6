"""Read an extract of OpenStreetMap as a Drive.

    drive, report = read_drive("city.osm.pbf", OsmOptions(region=Region(origin_deg=(52.48, 13.43))))

The ground is flat, because OpenStreetMap has no heights of the ground. The world frame is the local metric frame of the
extract (extract.py). Objects that the extract does not contain are missing, unless furnish.py adds them.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely

from models.scene import CATEGORY_INDEX, KITTI_GROUND_CLASSES, make_yaw_rotation
from pipelines.preprocess.sources.drive import STATIC, Drive
from pipelines.preprocess.sources.maps import fill_ground, make_world_from_imu
from pipelines.preprocess.sources.osm.buildings import cover_footprint, repair_polygons
from pipelines.preprocess.sources.osm.extract import Extract, Feature, Region, read_extract
from pipelines.preprocess.sources.osm.furnish import furnish_streets
from pipelines.preprocess.sources.osm.ground import LayerPolygon, list_ground, make_ground
from pipelines.preprocess.sources.osm.objects import Box, make_objects
from pipelines.preprocess.sources.osm.roads import StreetPoses, list_roads, make_street_poses
from pipelines.preprocess.sources.osm.tags import GARAGES, find_heights, is_underground

SOURCE = "osm"
PARTS_COVER = 0.7  # If the parts of a building cover this share of it, they replace it.


@dataclass(frozen=True)
class OsmOptions:
    """Options of the reader.

    Attributes:
        region: Part of the extract.
        spacing_m: Distance between successive poses of a street (m).
        free_pose_share: Share of poses at any place and heading.
        drive_on_left: Whether vehicles drive on the left.
        furnish: Whether to add objects and ground that the extract lacks (furnish.py).
        seed: Seed of free poses and of furnished objects.
        unmapped_ground: Ground class of land that the extract leaves open; None: no class.
    """

    region: Region = field(default_factory=Region)
    spacing_m: float = 10.0
    free_pose_share: float = 0.25
    drive_on_left: bool = False
    furnish: bool = False
    seed: int = 0
    unmapped_ground: str | None = None


def read_poses(path: str, options: OsmOptions) -> tuple[str, StreetPoses]:
    """Read the poses along the streets of an extract.

    Args:
        path: Extract of OpenStreetMap.
        options: Options.

    Returns:
        Name of the extract, and its poses.

    Raises:
        ValueError: The file cannot be read, or no street lies in the region.
    """
    extract = read_extract(path, options.region, only_roads=True)
    poses = _make_street_poses(extract, options)
    if not len(poses.xy_m):
        raise ValueError(
            f"{path}: no street lies in the region; scenes need a way with highway=residential, primary or similar"
        )
    return extract.name, poses


def _make_street_poses(extract: Extract, options: OsmOptions) -> StreetPoses:
    return make_street_poses(extract, options.spacing_m, options.free_pose_share, options.drive_on_left, options.seed)


def read_drive(path: str, options: OsmOptions) -> tuple[Drive, dict]:
    """Read objects, ground and poses of an extract.

    Args:
        path: Extract of OpenStreetMap.
        options: Options.

    Returns:
        The drive, and a report on buildings, objects, and skipped features.

    Raises:
        ValueError: The file cannot be read.
    """
    extract = read_extract(path, options.region)
    roads = list_roads(extract)
    buildings, footprints, report = _make_buildings(extract)
    objects = make_objects(extract, roads)
    ground: list[LayerPolygon] = list_ground(extract, roads) + [("building", footprint) for footprint in footprints]
    boxes = _make_boxes(buildings + objects)
    if options.furnish:
        added, more_ground = furnish_streets(roads, footprints, boxes, ground, options.seed, options.drive_on_left)
        boxes = {name: np.concatenate([boxes[name], added[name]]) for name in boxes}
        ground += more_ground
    poses = _make_street_poses(extract, options)
    drive = Drive(
        source=SOURCE,
        sequence=extract.name,
        **boxes,
        ground_classes=KITTI_GROUND_CLASSES,
        ground=fill_ground(make_ground(ground), options.unmapped_ground),
        frame=np.arange(len(poses.xy_m)),
        world_from_imu=make_world_from_imu(np.pad(poses.xy_m, ((0, 0), (0, 1))), poses.yaw_rad),
        free_pose=poses.is_free,
    )
    named = Counter(box.label for box in objects)
    return drive, report | {
        "projection": extract.projection,
        "roads": len(roads),
        "roads_without_width": sum(not road.profile.has_width for road in roads),
        "objects": dict(named.most_common()),
        "furnished": len(boxes["category"]) - len(buildings) - len(objects),
        "skipped": dict(extract.skipped),
    }


def _make_boxes(found: list[Box]) -> dict[str, np.ndarray]:
    """Return the per-box arrays of a Drive."""
    size = np.array([box.size_m for box in found]).reshape(-1, 3)
    xy = np.array([box.xy_m for box in found]).reshape(-1, 2)
    bottom = np.array([box.bottom_m for box in found])
    return {
        "category": np.array([CATEGORY_INDEX[box.category] for box in found], np.int8),
        "center_m": np.column_stack([xy, bottom + size[:, 2] / 2]),
        "rotation": np.array([make_yaw_rotation(box.yaw_rad) for box in found]).reshape(-1, 3, 3),
        "size_m": size,
        "heading_rad": np.full(len(found), np.nan),
        "instance_id": np.array([box.id for box in found], np.int64),
        "label": np.array([box.label for box in found], object),
        "timestamp": np.full(len(found), STATIC, np.int64),
    }


# --------------------------------------------------------------------------------------------------- buildings


def _make_buildings(extract: Extract) -> tuple[list[Box], list[Any], dict]:
    """Return boxes of buildings, footprints, and a report."""
    whole = [area for area in extract.areas if _is_building(area, "building")]
    parts = [area for area in extract.areas if _is_building(area, "building:part") and "building" not in area.tags]
    footprints, repaired = repair_polygons([area.geometry for area in whole]) if whole else (np.array([]), 0)
    chosen = _replace_by_parts(whole, footprints, parts)
    boxes, ious, unknown, empty = [], [], 0, 0
    for area, footprint in chosen:
        if footprint.is_empty or footprint.area < 1.0:
            empty += 1
            continue
        cover, heights = cover_footprint(footprint), find_heights(area.tags)
        ious.append(cover.iou)
        unknown += not heights.is_known
        label = "garage" if area.tags.get("building") in GARAGES else "building"
        for (x, y), (along, across) in zip(cover.center_m.tolist(), cover.size_m.tolist(), strict=True):
            size = (along, across, heights.top_m - heights.bottom_m)
            boxes.append(Box("construction_big", label, (x, y), cover.yaw_rad, size, heights.bottom_m, area.id))
    return (
        boxes,
        [footprint for footprint in footprints if not footprint.is_empty],
        {
            "buildings": len(ious),
            "building_boxes": len(boxes),
            "building_iou_mean": round(float(np.mean(ious)), 4) if ious else None,
            "building_iou_p10": round(float(np.percentile(ious, 10)), 4) if ious else None,
            "buildings_without_height": unknown,
            "buildings_repaired": int(np.sum(repaired)),
            "buildings_without_area": empty,
        },
    )


def _is_building(area: Feature, key: str) -> bool:
    return area.tags.get(key, "no") != "no" and not is_underground(area.tags)


def _replace_by_parts(whole: list[Feature], footprints: np.ndarray, parts: list[Feature]) -> list[tuple[Feature, Any]]:
    """Return the features and footprints to build: parts replace the buildings that they cover."""
    if not parts:
        return list(zip(whole, footprints, strict=True))
    shapes, _ = repair_polygons([part.geometry for part in parts])
    tree = shapely.STRtree(footprints)
    inside: dict[int, list[int]] = {}
    for k, shape in enumerate(shapes):
        for owner in tree.query(shape.representative_point(), predicate="intersects"):
            inside.setdefault(int(owner), []).append(k)
    found: list[tuple[Feature, Any]] = []
    used: set[int] = set()
    for index, (area, footprint) in enumerate(zip(whole, footprints, strict=True)):
        members = inside.get(index, [])
        covered = shapely.union_all(shapes[members]).area if members else 0.0
        if not members or covered < PARTS_COVER * footprint.area:
            found.append((area, footprint))
            continue
        for k in members:
            if k not in used:
                used.add(k)
                found.append((parts[k], shapes[k]))
    return found
