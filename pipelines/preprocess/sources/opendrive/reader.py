"""Read an OpenDRIVE file as a Drive: lanes, junctions, objects and signals, with poses on the driving lanes.

    drive, report = read_drive("town.xodr", OpenDriveOptions(spacing_m=5.0))

The world frame is the inertial frame of the file.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
import shapely

from models.scene import CATEGORY_INDEX, KITTI_GROUND_CLASSES, make_yaw_rotation
from pipelines.preprocess.sources.drive import HIDDEN, STATIC, Drive, LayeredGround
from pipelines.preprocess.sources.maps import MapDrive, fill_ground, make_world_from_imu, order_by_squares
from pipelines.preprocess.sources.opendrive.file import read_map
from pipelines.preprocess.sources.opendrive.lanes import LAYERS, LanePoses, make_lane_poses, triangulate_lanes
from pipelines.preprocess.sources.opendrive.objects import Box, MapObjects, make_objects

SOURCE = "opendrive"


@dataclass(frozen=True)
class OpenDriveOptions:
    """Options of the reader.

    Attributes:
        spacing_m: Distance between successive poses of a lane (m).
        unmapped_ground: Ground class of land that the file leaves open; None: no class.
    """

    spacing_m: float = 10.0
    unmapped_ground: str | None = None


def read_poses(path: str, options: OpenDriveOptions) -> tuple[str, LanePoses]:
    """Read the poses on the lanes of a file.

    Args:
        path: OpenDRIVE file.
        options: Options.

    Returns:
        Name of the map, and its poses, ordered by squares.

    Raises:
        ValueError: The file cannot be read, or it has no driving lane outside of junctions.
    """
    roads = read_map(path)
    poses = _order(make_lane_poses(roads, options.spacing_m))
    if not len(poses.yaw_rad):
        raise ValueError(f"{path}: no road outside of junctions has a driving lane; scenes need one")
    return roads.name, poses


def read_drive(path: str, options: OpenDriveOptions) -> tuple[Drive, dict]:
    """Read lanes, objects and poses of a file.

    Args:
        path: OpenDRIVE file.
        options: Options.

    Returns:
        The drive, and a report on roads, objects, and skipped elements.

    Raises:
        ValueError: The file cannot be read.
    """
    roads = read_map(path)
    skipped: Counter[str] = Counter(roads.skipped)
    found = make_objects(roads, skipped)
    poses = _order(make_lane_poses(roads, options.spacing_m))
    drive = MapDrive(
        source=SOURCE,
        sequence=roads.name,
        **_make_boxes(found.boxes),
        ground_classes=KITTI_GROUND_CLASSES,
        ground=fill_ground(make_ground(triangulate_lanes(roads), found), options.unmapped_ground),
        frame=np.arange(len(poses.yaw_rad)),
        world_from_imu=make_world_from_imu(poses.xyz_m, poses.yaw_rad),
        attribution=roads.attribution,
    )
    return drive, {
        "projection": roads.projection,
        "roads": len(roads.roads),
        "length_m": round(sum(road.line.length_m for road in roads.roads if not road.junction), 1),
        "objects": dict(Counter(box.label for box in found.boxes).most_common()),
        "buildings": len(found.iou),
        "building_iou_mean": round(float(np.mean(found.iou)), 4) if found.iou else None,
        "skipped": dict(skipped),
    }


def make_ground(lanes: tuple[np.ndarray, np.ndarray], found: MapObjects) -> LayeredGround:
    """Join the surfaces of lanes, parking spaces and buildings.

    Args:
        lanes: Triangles (t, 3, 3) and layers (t,) of lanes.
        found: Objects with parking spaces and footprints.

    Returns:
        The ground, with the classes KITTI_GROUND_CLASSES.
    """
    triangles, layers = [lanes[0]], [lanes[1]]
    spaces = [outline for outline in found.parking if len(outline) >= 3]
    shapes = [(shapely.Polygon(o[:, :2]), float(o[:, 2].mean()), "parking") for o in spaces]
    shapes += [(footprint, 0.0, "building") for footprint in found.footprints]
    for shape, z, name in shapes:
        if not shape.is_valid or shape.area < 0.1:
            continue
        pieces = shapely.get_parts(shapely.constrained_delaunay_triangles(shape))
        flat = shapely.get_coordinates(pieces).reshape(-1, 4, 2)[:, :3]
        triangles.append(np.concatenate([flat, np.full((*flat.shape[:2], 1), z)], axis=2))
        layers.append(np.full(len(flat), LAYERS.index(name)))
    classes = tuple(KITTI_GROUND_CLASSES.index(n) if n in KITTI_GROUND_CLASSES else HIDDEN for n in LAYERS)
    return LayeredGround(np.concatenate(triangles), np.concatenate(layers), classes)


def _order(poses: LanePoses) -> LanePoses:
    order = order_by_squares(poses.xyz_m[:, :2])
    return LanePoses(poses.xyz_m[order], poses.yaw_rad[order])


def _make_boxes(found: list[Box]) -> dict[str, np.ndarray]:
    """Return the per-box arrays of a Drive."""
    return {
        "category": np.array([CATEGORY_INDEX[box.category] for box in found], np.int8),
        "center_m": np.array([box.center_m for box in found]).reshape(-1, 3),
        "rotation": np.array([make_yaw_rotation(box.yaw_rad) for box in found]).reshape(-1, 3, 3),
        "size_m": np.array([box.size_m for box in found]).reshape(-1, 3),
        "heading_rad": np.full(len(found), np.nan),
        "instance_id": np.arange(len(found)),
        "label": np.array([box.label for box in found], object),
        "timestamp": np.full(len(found), STATIC, np.int64),
    }
