"""Read a user's own drives as a Drive: boxes, ground polygons and poses in Parquet or JSON (docs/how_to/own_drives.md).

    ROOT/DRIVE/boxes.parquet       or boxes.json: one row per box
    ROOT/DRIVE/polygons.parquet    or polygons.json: one row per ground polygon
    ROOT/DRIVE/poses.parquet       or poses.json: one row per pose, and therefore per scene
    ROOT/splits.json               optional: {"DRIVE": "train" or "test"}

Each drive has one right-handed world frame with z up. In the ego frame, x points forward, y left and z up. Units are
metres and radians. A JSON file is a list of objects with the Parquet column names as keys; a missing key means null.
Row numbers start at 0. Invalid input raises ValueError; the message names file, row, value and remedy.
"""

from __future__ import annotations

import hashlib
import re
from os import PathLike
from typing import Any

import numpy as np
import pyarrow.compute as compute
import shapely

from models.limits import require_within
from models.scene import CATEGORIES, CATEGORY_INDEX, GROUND_CLASSES
from pipelines.preprocess.sources.custom_tables import (
    AGAIN,
    MATRIX_ENTRIES,
    MAX_COORDINATE_M,
    MAX_HEIGHT_M,
    PLACE,
    QUATERNION,
    DriveTable,
    is_text,
    is_whole,
    read_table,
    show_value,
)
from pipelines.preprocess.sources.drive import STATIC, Drive, SurfaceGround
from pipelines.preprocess.sources.files import are_all_numbers, read_json_file
from pipelines.preprocess.sources.input_paths import InputPath, make_input_path
from pipelines.preprocess.sources.triangulation import triangulate_polygon
from pipelines.schema.splits import TEST, TRAIN

pc: Any = compute  # The type checker does not know the functions that pyarrow generates.

SOURCE = "own"

SIZE = ("length_m", "width_m", "height_m")
BOX_COLUMNS = (
    "category",
    *PLACE,
    *SIZE,
    "yaw_rad",
    *QUATERNION,
    "frame",
    "instance_id",
    "label",
    "heading_known",
)
POLYGON_COLUMNS = ("class", "outline")
POSE_COLUMNS = ("frame", *PLACE, "yaw_rad", *QUATERNION, "world_from_ego")

# Categories whose x axis is the direction of travel, unless heading_known is set.
HEADED = tuple(CATEGORY_INDEX[name] for name in ("vehicle_big", "vehicle_small", "two_wheelers", "human"))

MIN_SIZE_M = 1e-3
MAX_SIZE_M = 1e3
# Minimum cosine of the angle between the z axes of ego and world frame. Real roads give larger values, and camera
# frames give smaller values.
MIN_UP = 0.5
# At least one pose must lie within this distance of the content. The farthest corner of a crop is 72 m from the
# vehicle.
SIGHT_M = 100.0


# ----------------------------------------------------------------------------------------------------- the root


def list_drives(root: str | PathLike) -> list[str]:
    """Return the drives.

    A drive is a folder with a name that does not begin with a dot.

    Args:
        root: Directory of all drives.

    Returns:
        Names of the drives in alphabetical order.

    Raises:
        ValueError: The directory holds no drive, or a name contains characters that a scene id cannot contain.
    """
    names = sorted(path.name for path in make_input_path(root).glob("*/") if not path.name.startswith("."))
    if not names:
        raise ValueError(
            f"{root} holds no folder; --input must name the folder of all drives, which holds DRIVE/boxes.parquet,"
            " DRIVE/polygons.parquet and DRIVE/poses.parquet (or .json)"
        )
    for name in names:
        if not re.fullmatch(r"[A-Za-z0-9._-]+", name):
            raise ValueError(
                f"{make_input_path(root, name)}: the name of a drive is part of file names; rename the folder with"
                " letters, digits, '.', '_' and '-'"
            )
    return names


def read_splits(root: str | PathLike) -> dict[str, str] | None:
    """Read the split of every drive from ROOT/splits.json.

    Args:
        root: Directory of all drives.

    Returns:
        Map from drive name to "train" or "test"; None if the file is absent.

    Raises:
        ValueError: The file is invalid, omits a drive, contains an unknown drive, or contains a split other than train
            and test.
    """
    path = make_input_path(root, "splits.json")
    if not path.exists():
        return None
    sides = read_json_file(path, AGAIN)
    if not isinstance(sides, dict):
        raise ValueError(f'{path} holds a {type(sides).__name__}, expected {{"drive": "train" or "test"}}')
    names = list_drives(root)
    drives = set(names)
    for name, side in sides.items():
        if name not in drives:
            raise ValueError(
                f"{path}: the folder {show_value(name)} does not exist next to this file; remove the entry or add the"
                " drive"
            )
        if side not in (TRAIN, TEST):
            raise ValueError(f"{path}: {name} is {show_value(side)}, expected {TRAIN!r} or {TEST!r}")
    for name in names:
        if name not in sides:
            raise ValueError(f"{path} has no entry for the folder {name}; add an entry or remove the folder")
    return sides


def read_ground_classes(root: str | PathLike) -> tuple[str, ...]:
    """Return the ground classes of all drives.

    The function ignores unreadable polygon files, because `read_drive` raises an error for them.

    Args:
        root: Directory of all drives.

    Returns:
        Ground classes that occur in at least one drive, in the order of GROUND_CLASSES.

    Raises:
        ValueError: No drive has ground.
    """
    found, errors = set(), []
    for name in list_drives(root):
        try:
            found |= set(_read_polygons(make_input_path(root, name)).texts("class"))
        except ValueError as error:
            errors.append(error)
    if not found:
        raise errors[0] if errors else ValueError(f"{root}: no drive has a ground polygon; add at least the road")
    return tuple(name for name in GROUND_CLASSES if name in found)


def read_drive(root: str | PathLike, name: str, classes: tuple[str, ...] | None = None) -> Drive:
    """Read all boxes, the ground and the poses of one drive.

    `timestamp` is the frame of a moving box, or STATIC. `instance_id` is the number in the file, or a hash of the text
    in the file. The hash does not depend on the machine. If the value is null, `instance_id` is -1. `heading_rad` is
    the yaw of the x axis if x is the direction of travel.

    Args:
        root: Directory of all drives.
        name: Name of the drive.
        classes: Ground classes of the whole dataset (default: the classes of this drive).

    Returns:
        The drive in its world frame (float64).

    Raises:
        ValueError: A value is missing or invalid; the message names file and row.
    """
    folder = make_input_path(root, name)
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such drive; the drives are {', '.join(list_drives(root))[:200]}")
    frame, world_from_ego = read_poses(root, name)
    boxes, polygons = _read_boxes(folder), _read_polygons(folder)
    classes = classes or tuple(c for c in GROUND_CLASSES if c in polygons.texts("class"))
    ground = _make_ground(polygons, classes)
    drive = Drive(
        source=SOURCE,
        sequence=name,
        **_make_boxes(boxes),
        ground_classes=classes,
        ground=ground,
        frame=frame,
        world_from_imu=world_from_ego,
    )
    _check_in_sight(boxes.path, drive.center_m, world_from_ego)
    _check_in_sight(polygons.path, ground.triangles_m.reshape(-1, 3), world_from_ego)
    moving = drive.timestamp[drive.timestamp != STATIC]
    if len(moving) and not np.isin(moving, frame).any():
        raise ValueError(
            f"{boxes.path}: the frame of no moving box, such as {moving[0]}, is a frame of the poses ({frame[0]}.."
            f"{frame[-1]}); use the same frame numbers, or write null for static boxes"
        )
    return drive


# ------------------------------------------------------------------------------------------------------- poses


def read_poses(root: str | PathLike, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Read the poses of one drive.

    Args:
        root: Directory of all drives.
        name: Name of the drive.

    Returns:
        frame (p,) int64, ascending; and world_from_ego (p, 3, 4) float64 (m). In the ego frame, x points forward, y
        left and z up.

    Raises:
        ValueError: The poses do not fit an upright vehicle, or they are not in driving order; the message names file
            and row.
    """
    table = read_table(make_input_path(root, name), "poses", POSE_COLUMNS, ("frame",))
    if not table.rows:
        raise ValueError(f"{table.path} holds no pose; every pose becomes a scene, so add at least one")
    frame = table.frames()
    late = np.flatnonzero(np.diff(frame) <= 0)
    if len(late):
        row = late[0] + 1
        raise ValueError(
            f"{table.path}: frame of row {row} is {frame[row]} after {frame[row - 1]}; sort the poses by frame"
            " without repeated frames"
        )
    if "world_from_ego" in table.columns:
        world_from_ego = _read_matrices(table)
    else:
        table.require(PLACE)
        world_from_ego = np.concatenate([table.rotations(), table.places()[:, :, None]], axis=2)
    fallen = np.flatnonzero(world_from_ego[:, 2, 2] < MIN_UP)
    if len(fallen):
        raise ValueError(
            f"{table.path}: the z axis of row {fallen[0]} points {_read_direction(world_from_ego[fallen[0], 2, 2])};"
            " write the pose of a vehicle frame with x forward, y left, z up (cameras and z-down IMUs have other axes)"
        )
    return frame, world_from_ego


def _read_direction(up: float) -> str:
    return "down" if up < -MIN_UP else "sideways"


def _read_matrices(table: DriveTable) -> np.ndarray:
    """Return the column world_from_ego as (rows, 3, 4). In the file, an entry is 12 numbers, row by row."""
    others = [name for name in (*PLACE, "yaw_rad", *QUATERNION) if name in table.columns]
    if others:
        raise ValueError(f"{table.path} has world_from_ego and {others[0]}; keep only one form of the pose")
    world_from_ego = np.empty((table.rows, 12))
    for row, matrix in enumerate(table.iterate("world_from_ego")):
        if type(matrix) is not list or len(matrix) != MATRIX_ENTRIES or not are_all_numbers(matrix, MAX_COORDINATE_M):
            raise ValueError(
                f"{table.path}: world_from_ego of row {row} is {show_value(matrix)}, expected 12 numbers (3 x 4, row by"
                " row), metres"
            )
        world_from_ego[row] = matrix
    world_from_ego = world_from_ego.reshape(-1, 3, 4)
    rotation = world_from_ego[:, :, :3]
    skew = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero((skew > 1e-3) | (np.linalg.det(rotation) < 0))
    if len(bad):
        raise ValueError(
            f"{table.path}: world_from_ego of row {bad[0]} holds no rotation in its first three columns; write 3 x 4"
            " matrices row by row, with right-handed axes and without transposition"
        )
    high = np.flatnonzero(np.abs(world_from_ego[:, 2, 3]) > MAX_HEIGHT_M)
    if len(high):
        raise ValueError(
            f"{table.path}: z of row {high[0]} is {world_from_ego[high[0], 2, 3]:g} m, expected"
            f" {-MAX_HEIGHT_M:g}..{MAX_HEIGHT_M:g}; use a world frame with z up"
        )
    return world_from_ego


# ------------------------------------------------------------------------------------------------------- boxes


def _read_boxes(folder: InputPath) -> DriveTable:
    return read_table(folder, "boxes", BOX_COLUMNS, ("category", *PLACE, *SIZE))


def _make_boxes(table: DriveTable) -> dict[str, np.ndarray]:
    """Return the per-box arrays of a Drive."""
    names = table.texts("category", CATEGORIES)
    category = np.array([CATEGORY_INDEX[name] for name in names], np.int8)
    rotation = table.rotations()
    known = [
        index in HEADED if flag is None else flag
        for index, flag in zip(category.tolist(), table.flags("heading_known"), strict=True)
    ]
    lies_flat = np.abs(rotation[:, 2, 0]) < np.sqrt(0.5)
    label = table.texts("label", optional=True)
    return {
        "category": category,
        "center_m": table.places(),
        "rotation": rotation,
        "size_m": table.numbers(SIZE, MIN_SIZE_M, MAX_SIZE_M, " m"),
        "heading_rad": np.where(
            np.array(known, bool) & lies_flat, np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]), np.nan
        ),
        "instance_id": _make_instance_ids(table),
        "label": np.array([own or name for own, name in zip(label, names, strict=True)], object),
        "timestamp": table.frames(missing=STATIC),
    }


def _make_instance_ids(table: DriveTable) -> np.ndarray:
    """Return ids (rows,) int64.

    A number is kept, a text becomes the first 63 bits of its BLAKE2 hash, and null becomes -1.
    """
    ids = []
    for row, value in enumerate(table.iterate("instance_id")):
        if is_text(value):
            value = int.from_bytes(hashlib.blake2b(value.encode(), digest_size=8).digest(), "big") >> 1
        elif value is not None and not is_whole(value):
            raise ValueError(
                f"{table.path}: instance_id of row {row} is {show_value(value)}, expected a whole number of 0 or more,"
                " a text or null"
            )
        ids.append(-1 if value is None else int(value))
    return np.array(ids, np.int64)


def _check_in_sight(path: InputPath, points_m: np.ndarray, world_from_ego: np.ndarray) -> None:
    """Raise ValueError if every pose is farther than SIGHT_M from the bounding box of the points (n, 3)."""
    if len(points_m) == 0:
        return
    low, high, position_m = points_m.min(axis=0), points_m.max(axis=0), world_from_ego[:, :, 3]
    if not ((position_m >= low - SIGHT_M) & (position_m <= high + SIGHT_M)).all(axis=1).any():
        raise ValueError(
            f"{path}: the content at x, y, z of {_point(low)}..{_point(high)} lies more than {SIGHT_M:g} m from every"
            f" pose; the first pose is {_point(position_m[0])}; use one world frame in all three files"
        )


def _point(point_m: np.ndarray) -> str:
    return f"({', '.join(f'{value:.1f}' for value in point_m)})"


# ------------------------------------------------------------------------------------------------------ ground


def _read_polygons(folder: InputPath) -> DriveTable:
    table = read_table(folder, "polygons", POLYGON_COLUMNS, POLYGON_COLUMNS)
    table.texts("class", GROUND_CLASSES)
    return table


def _make_ground(table: DriveTable, classes: tuple[str, ...]) -> SurfaceGround:
    """Triangulate every outline; triangles use only the vertices of the outline."""
    of_row = [classes.index(name) for name in table.texts("class", classes)]
    parts, points = [], 0
    for row, value in enumerate(table.iterate("outline") if table.rows else ()):
        outline_m = _make_outline(table.path, row, value)
        points += len(outline_m)
        require_within("table_rows", points, f"{table.path}: points of outlines", is_partial=True)
        parts.append(_triangulate_polygon(table.path, row, outline_m))
    return SurfaceGround(
        triangles_m=np.concatenate([np.zeros((0, 3, 3)), *parts]),
        triangle_class=np.repeat(np.array(of_row, np.int64), [len(part) for part in parts]),
    )


def _triangulate_polygon(path: InputPath, row: int, outline_m: np.ndarray) -> np.ndarray:
    """Return the triangles (t, 3, 3) of one outline in the world frame, from a constrained Delaunay triangulation."""
    reason = shapely.is_valid_reason(shapely.Polygon(outline_m[:, :2]))
    if reason != "Valid Geometry":
        raise ValueError(
            f"{path}: outline of row {row} is no simple polygon, {reason[:80]} (x y); the outline must not cross or"
            " touch itself, and a polygon with a hole must be cut in two"
        )
    return outline_m[triangulate_polygon(outline_m[:, :2] - outline_m[0, :2])]


def _make_outline(path: InputPath, row: int, value: object) -> np.ndarray:
    """Return the vertices (n, 3) float64 of an open outline, without repeated successive points."""
    if type(value) is not list:
        raise ValueError(f"{path}: outline of row {row} is {show_value(value)}, expected a list of points [x, y, z]")
    require_within("polygon_points", len(value), f"{path}: outline of row {row}")
    for k, point in enumerate(value):
        if type(point) is not list or len(point) != 3 or not are_all_numbers(point, MAX_COORDINATE_M):
            raise ValueError(
                f"{path}: point {k} of the outline of row {row} is {show_value(point)}, expected [x, y, z] in metres"
            )
        if abs(point[2]) > MAX_HEIGHT_M:
            raise ValueError(
                f"{path}: point {k} of the outline of row {row} is {point[2]:g} m high, expected"
                f" {-MAX_HEIGHT_M:g}..{MAX_HEIGHT_M:g}; use a world frame with z up"
            )
    outline_m = np.array(value, np.float64).reshape(-1, 3)
    following = np.roll(outline_m, -1, axis=0)
    repeated = (outline_m[:, :2] == following[:, :2]).all(axis=1)
    steps = np.flatnonzero(repeated & (outline_m[:, 2] != following[:, 2]))
    if len(steps) and len(value) > 1:
        raise ValueError(
            f"{path}: point {steps[0]} of the outline of row {row} lies directly above or below the next point; a"
            " surface must have one height per position"
        )
    outline_m = outline_m[~repeated]
    if len(outline_m) < 3:
        raise ValueError(f"{path}: outline of row {row} has {len(outline_m)} distinct points, expected at least 3")
    return outline_m
