"""Read a log of py123d as a Drive: nuScenes, nuPlan, Waymo, PandaSet, Argoverse 2, KITTI-360 and others.

py123d (version 0.7) converts these datasets to Arrow files. This module reads the files with pyarrow and does not
import py123d. Each time with box detections is one pose and yields one Scene.

    ROOT/logs/SPLIT/LOG/ego_state_se3.arrow           poses of the vehicle
    ROOT/logs/SPLIT/LOG/box_detections_se3.arrow      boxes in the world frame
    ROOT/logs/SPLIT/LOG/sync.arrow                    names of the dataset and of the map
    ROOT/logs/SPLIT/LOG/map.arrow                     map of the log, or
    ROOT/maps/DATASET/DATASET_LOCATION.arrow          map of the place

The world frame is that of the log; the origin of a scene is the IMU. A broken file raises ValueError, which names file,
value and remedy.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from os import PathLike
from typing import Any, NamedTuple

import msgpack
import numpy as np
import pyarrow as pa
import shapely
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]
from scipy.spatial.transform import Rotation

from models.limits import require_within
from models.scene import CATEGORY_INDEX
from pipelines.preprocess.sources.drive import Drive, SurfaceGround
from pipelines.preprocess.sources.files import read_file
from pipelines.preprocess.sources.input_paths import InputPath, make_input_path
from pipelines.preprocess.sources.maps import MapDrive
from pipelines.preprocess.sources.osm.buildings import repair_polygons
from pipelines.schema.attribution import find_attribution

SOURCE = "py123d"
AGAIN = "convert the log again with py123d-conversion"
GROUND_CLASSES = ("road", "sidewalk", "parking", "crossing")
# Map layers of py123d that are areas, and their ground class.
LAYERS = {0: "road", 1: "road", 2: "road", 3: "crossing", 4: "sidewalk", 5: "parking", 6: "road"}
LINES = (8, 9)  # Map layers that are lines (road edges and road lines), which have heights.
MAX_POSE_GAP_US = 60_000  # Largest difference between the times of boxes and of the pose of the vehicle.
MAX_HEIGHT_REACH_M = 30.0  # Largest distance of a line whose height an area gets; otherwise that of the trajectory.
MAX_COORDINATE_M, MAX_SIZE_M, MIN_SIZE_M = 1e7, 1e2, 1e-3
REACH_M = 200.0  # Distance from the trajectory up to which areas of a map are read.
MAX_POINTS = 2_000  # Points of an outline; others are simplified.
ATTRIBUTED = {"av2-sensor": "av2", "kitti360": "kitti360"}  # Datasets of py123d with a notice, and its source.

# Category of each label, in the order of the numbers of py123d's label classes; None: the label is left out.
_AV2 = {
    "ANIMAL": "object", "ARTICULATED_BUS": "vehicle_big", "BICYCLE": "two_wheelers", "BICYCLIST": "human",
    "BOLLARD": "pole", "BOX_TRUCK": "vehicle_big", "BUS": "vehicle_big", "CONSTRUCTION_BARREL": "object",
    "CONSTRUCTION_CONE": "object", "DOG": "object", "LARGE_VEHICLE": "vehicle_big",
    "MESSAGE_BOARD_TRAILER": "traffic_control", "MOBILE_PEDESTRIAN_CROSSING_SIGN": "traffic_control",
    "MOTORCYCLE": "two_wheelers", "MOTORCYCLIST": "human", "OFFICIAL_SIGNALER": "human", "PEDESTRIAN": "human",
    "RAILED_VEHICLE": "vehicle_big", "REGULAR_VEHICLE": "vehicle_small", "SCHOOL_BUS": "vehicle_big",
    "SIGN": "traffic_control", "STOP_SIGN": "traffic_control", "STROLLER": "object",
    "TRAFFIC_LIGHT_TRAILER": "traffic_control", "TRUCK": "vehicle_big", "TRUCK_CAB": "vehicle_big",
    "VEHICULAR_TRAILER": "vehicle_small", "WHEELCHAIR": "object", "WHEELED_DEVICE": "two_wheelers",
    "WHEELED_RIDER": "human",
}  # fmt: skip
_KITTI360 = {
    "BICYCLE": "two_wheelers", "BOX": "object", "BUS": "vehicle_big", "CAR": "vehicle_small",
    "CARAVAN": "vehicle_small", "LAMP": "traffic_control", "MOTORCYCLE": "two_wheelers", "PERSON": "human",
    "POLE": "pole", "RIDER": "human", "SMALLPOLE": "pole", "STOP": "traffic_control",
    "TRAFFIC_LIGHT": "traffic_control", "TRAFFIC_SIGN": "traffic_control", "TRAILER": "vehicle_small",
    "TRAIN": "vehicle_big", "TRASH_BIN": "object", "TRUCK": "vehicle_big", "VENDING_MACHINE": "object",
}  # fmt: skip
_NUPLAN = {
    "VEHICLE": "vehicle_small", "BICYCLE": "two_wheelers", "PEDESTRIAN": "human", "TRAFFIC_CONE": "object",
    "BARRIER": "construction_small", "CZONE_SIGN": "traffic_control", "GENERIC_OBJECT": "object",
}  # fmt: skip
_NUSCENES = {
    "VEHICLE_CAR": "vehicle_small", "VEHICLE_TRUCK": "vehicle_big", "VEHICLE_BUS_BENDY": "vehicle_big",
    "VEHICLE_BUS_RIGID": "vehicle_big", "VEHICLE_CONSTRUCTION": "vehicle_big",
    "VEHICLE_EMERGENCY_AMBULANCE": "vehicle_big", "VEHICLE_EMERGENCY_POLICE": "vehicle_small",
    "VEHICLE_TRAILER": "vehicle_small", "VEHICLE_BICYCLE": "two_wheelers", "VEHICLE_MOTORCYCLE": "two_wheelers",
    "HUMAN_PEDESTRIAN_ADULT": "human", "HUMAN_PEDESTRIAN_CHILD": "human",
    "HUMAN_PEDESTRIAN_CONSTRUCTION_WORKER": "human", "HUMAN_PEDESTRIAN_PERSONAL_MOBILITY": "human",
    "HUMAN_PEDESTRIAN_POLICE_OFFICER": "human", "HUMAN_PEDESTRIAN_STROLLER": "human",
    "HUMAN_PEDESTRIAN_WHEELCHAIR": "human", "MOVABLE_OBJECT_TRAFFICCONE": "object",
    "MOVABLE_OBJECT_BARRIER": "construction_small", "MOVABLE_OBJECT_PUSHABLE_PULLABLE": "object",
    "MOVABLE_OBJECT_DEBRIS": "object", "STATIC_OBJECT_BICYCLE_RACK": "object", "ANIMAL": "object",
}  # fmt: skip
_PANDASET = {
    "ANIMALS_BIRD": "object", "ANIMALS_OTHER": "object", "BICYCLE": "two_wheelers", "BUS": "vehicle_big",
    "CAR": "vehicle_small", "CONES": "object", "CONSTRUCTION_SIGNS": "traffic_control",
    "EMERGENCY_VEHICLE": "vehicle_big", "MEDIUM_SIZED_TRUCK": "vehicle_big", "MOTORCYCLE": "two_wheelers",
    "MOTORIZED_SCOOTER": "two_wheelers", "OTHER_VEHICLE_CONSTRUCTION_VEHICLE": "vehicle_big",
    "OTHER_VEHICLE_PEDICAB": "two_wheelers", "OTHER_VEHICLE_UNCOMMON": "vehicle_small", "PEDESTRIAN": "human",
    "PEDESTRIAN_WITH_OBJECT": "human", "PERSONAL_MOBILITY_DEVICE": "two_wheelers", "PICKUP_TRUCK": "vehicle_small",
    "PYLONS": "object", "ROAD_BARRIERS": "construction_small", "ROLLING_CONTAINERS": "object",
    "SEMI_TRUCK": "vehicle_big", "SIGNS": "traffic_control",
    "TEMPORARY_CONSTRUCTION_BARRIERS": "construction_small", "TOWED_OBJECT": "vehicle_small",
    "TRAIN": "vehicle_big", "TRAM_SUBWAY": "vehicle_big",
}  # fmt: skip
LABELS: dict[str, dict[str, str | None]] = {
    "AV2SensorBoxDetectionLabel": {**_AV2},
    "KITTI360BoxDetectionLabel": {**_KITTI360},
    "NuPlanBoxDetectionLabel": {**_NUPLAN},
    "NuScenesBoxDetectionLabel": {**_NUSCENES},
    "PandasetBoxDetectionLabel": {**_PANDASET},
    "WODPerceptionBoxDetectionLabel": {
        "TYPE_UNKNOWN": None, "TYPE_VEHICLE": "vehicle_small", "TYPE_PEDESTRIAN": "human",
        "TYPE_SIGN": "traffic_control", "TYPE_CYCLIST": "two_wheelers",
    },
    "WODMotionBoxDetectionLabel": {
        "TYPE_UNSET": None, "TYPE_VEHICLE": "vehicle_small", "TYPE_PEDESTRIAN": "human",
        "TYPE_CYCLIST": "two_wheelers", "TYPE_OTHER": "object",
    },
}  # fmt: skip
BIG_VEHICLE_M = 6.5  # Vehicles of datasets without classes of vehicles are big from this length on.
UNDIVIDED = ("VEHICLE", "TYPE_VEHICLE")


class LogName(NamedTuple):
    """Split and name of a log."""

    split: str
    log: str


def list_logs(root: str | PathLike) -> list[LogName]:
    """Return the logs with poses and boxes.

    Args:
        root: Directory that contains logs/ (PY123D_DATA_ROOT).

    Returns:
        Logs, ordered by split and name.

    Raises:
        ValueError: There is no such log.
    """
    found = []
    for split in sorted(make_input_path(root, "logs").glob("*/")):
        for folder in sorted(split.glob("*/")):
            if all((folder / f"{name}.arrow").is_file() for name in ("ego_state_se3", "box_detections_se3")):
                found.append(LogName(split.name, folder.name))
    if not found:
        raise ValueError(
            f"{root} holds no logs/SPLIT/LOG with ego_state_se3.arrow and box_detections_se3.arrow; --input must name "
            "the directory into which py123d-conversion wrote (PY123D_DATA_ROOT)"
        )
    return found


def read_drive(root: str | PathLike, split: str, log: str) -> tuple[Drive, int]:
    """Read a log.

    `frame` and `timestamp` are times (microseconds). `instance_id` is a hash of the track. `heading_rad` is the yaw of
    the box's x axis.

    Args:
        root: Directory that contains logs/ and maps/.
        split: Split of the log.
        log: Name of the log.

    Returns:
        The drive in the world frame of the log, and the number of boxes whose label has no category.

    Raises:
        ValueError: A file or value is missing or invalid; the message names the file.
    """
    folder = make_input_path(root, "logs", split, log)
    about = _read_metadata(folder / "sync.arrow", _read_arrow(folder / "sync.arrow"))
    frame, poses, ground_below_m = _read_poses(folder / "ego_state_se3.arrow")
    boxes, skipped = _read_boxes(folder / "box_detections_se3.arrow")
    times = np.unique(boxes["timestamp"])
    right = np.searchsorted(frame, times).clip(1, max(1, len(frame) - 1)).clip(0, len(frame) - 1)
    left = (right - 1).clip(0)
    nearest = np.where(times - frame[left] <= frame[right] - times, left, right)
    far = np.abs(frame[nearest] - times)
    if len(far) and far.max() > MAX_POSE_GAP_US:
        raise ValueError(
            f"{folder}: no pose within {MAX_POSE_GAP_US / 1000:g} ms of the boxes at {times[far.argmax()]}; {AGAIN}"
        )
    map_path = _find_map(root, folder, about)
    trajectory_m = poses[:, :, 3] - [0.0, 0.0, ground_below_m]
    dataset = str(about.get("dataset", ""))
    drive = MapDrive(
        source=SOURCE,
        sequence=log,
        **boxes,
        ground_classes=GROUND_CLASSES,
        ground=_read_ground(map_path, trajectory_m),
        frame=times,
        world_from_imu=poses[nearest],
        attribution=find_attribution(ATTRIBUTED.get(dataset, "")),
    )
    return drive, skipped


# ----------------------------------------------------------------------------------------------------- Arrow files


def _read_arrow(path: InputPath) -> pa.Table:
    """Return the rows of an Arrow file."""
    content = read_file(path, AGAIN)
    require_within("table_bytes", len(content), str(path))
    try:
        table = pa.ipc.open_file(pa.BufferReader(content)).read_all()
        table.validate(full=True)
    except Exception as error:  # A damaged file makes pyarrow raise errors of many types.
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise ValueError(f"{path}: broken Arrow file ({reason}); {AGAIN}") from error
    require_within("table_rows", table.num_rows, str(path))
    return table


def _read_metadata(path: InputPath, table: pa.Table) -> dict[str, Any]:
    """Return the description that py123d stores in the schema."""
    packed = (table.schema.metadata or {}).get(b"metadata", b"\x80")
    try:
        found = msgpack.unpackb(packed, strict_map_key=False)
    except Exception as error:  # msgpack raises errors of many types.
        raise ValueError(f"{path}: broken metadata ({str(error)[:80]}); {AGAIN}") from error
    if not isinstance(found, dict):
        raise ValueError(f"{path}: metadata is a {type(found).__name__}, expected a dictionary; {AGAIN}")
    return found


def _read_column(path: InputPath, table: pa.Table, name: str, kind: Any) -> pa.Array:
    """Return a column without nulls of an expected type."""
    if table.schema.get_field_index(name) < 0:
        raise ValueError(f"{path}: column {name} is missing or occurs twice; {AGAIN}")
    column = table[name].combine_chunks()
    if column.type != kind:
        raise ValueError(f"{path}: column {name} is {column.type}, expected {kind}; {AGAIN}")
    if column.null_count:
        raise ValueError(f"{path}: column {name} has {column.null_count} nulls; {AGAIN}")
    return column


def _check(path: InputPath, name: str, values: np.ndarray, low: float, high: float) -> None:
    bad = np.argwhere(~((values >= low) & (values <= high)))
    if len(bad):
        raise ValueError(
            f"{path}: {name} {values[tuple(bad[0])]:g} of entry {bad[0][0]}, expected {low:g}..{high:g}; {AGAIN}"
        )


def _make_rotations(path: InputPath, quaternions: np.ndarray) -> np.ndarray:
    """Return rotations (n, 3, 3) of quaternions (n, 4) with the scalar first."""
    _check(path, "quaternion", quaternions, -1.01, 1.01)
    norm = np.linalg.norm(quaternions, axis=1)
    _check(path, "norm of the quaternion", norm, 0.99, 1.01)
    return Rotation.from_quat(quaternions, scalar_first=True).as_matrix().reshape(-1, 3, 3)


def _read_poses(path: InputPath) -> tuple[np.ndarray, np.ndarray, float]:
    """Return times (p,), poses of the IMU (p, 3, 4), and the height of the IMU above the ground (m)."""
    table = _read_arrow(path)
    time = _read_column(path, table, "ego_state_se3.timestamp_us", pa.int64()).to_numpy()
    values = _read_column(path, table, "ego_state_se3.imu_se3", pa.list_(pa.float64(), 7)).flatten()
    pose = np.asarray(values).reshape(-1, 7)
    if not len(time):
        raise ValueError(f"{path} holds no pose; {AGAIN}")
    order = np.argsort(time, kind="stable")
    time, pose = time[order], pose[order]
    _check(path, "coordinate of a pose", pose[:, :3], -MAX_COORDINATE_M, MAX_COORDINATE_M)
    about = _read_metadata(path, table)
    center = about.get("center_to_imu_se3")
    height = about.get("height")
    below = 0.0
    if isinstance(height, float) and isinstance(center, list) and len(center) == 7:
        below = float(np.clip(height / 2 - center[2], 0.0, 3.0))
    matrix = np.concatenate([_make_rotations(path, pose[:, 3:]), pose[:, :3, None]], axis=2)
    return time, matrix, below


def _read_boxes(path: InputPath) -> tuple[dict[str, np.ndarray], int]:
    """Return the per-box arrays of a Drive, and the number of boxes without a category."""
    table = _read_arrow(path)
    name = str(_read_metadata(path, table).get("box_detection_label_class", "")).rpartition(".")[2]
    if name not in LABELS:
        raise ValueError(
            f"{path}: unknown label class {name[:60]!r}, expected one of {', '.join(LABELS)};"
            " convert the log with py123d 0.7"
        )
    time = _read_column(path, table, "box_detections_se3.timestamp_us", pa.int64()).to_numpy()
    boxes = _read_column(path, table, "box_detections_se3.bounding_box_se3", pa.list_(pa.list_(pa.float64(), 10)))
    tokens = _read_column(path, table, "box_detections_se3.track_token", pa.list_(pa.string()))
    labels = _read_column(path, table, "box_detections_se3.label", pa.list_(pa.uint16()))
    if any(column.null_count for column in (boxes.flatten(), boxes.flatten().flatten(), labels.flatten())):
        raise ValueError(f"{path}: a box or a label is null; {AGAIN}")
    count = np.diff(boxes.offsets.to_numpy())
    for other, column in (("track_token", tokens), ("label", labels)):
        if not np.array_equal(np.diff(column.offsets.to_numpy()), count):
            raise ValueError(f"{path}: column {other} has another number of boxes than bounding_box_se3; {AGAIN}")
    values = np.asarray(boxes.flatten().flatten()).reshape(-1, 10)
    number = labels.flatten().to_numpy(zero_copy_only=False).astype(np.int64)
    names = np.array(list(LABELS[name]), object)
    if len(number) and number.max() >= len(names):
        raise ValueError(f"{path}: label {number.max()} of {name}, expected less than {len(names)}; {AGAIN}")
    _check(path, "coordinate of a box", values[:, :3], -MAX_COORDINATE_M, MAX_COORDINATE_M)
    _check(path, "size of a box", values[:, 7:], MIN_SIZE_M, MAX_SIZE_M)
    label = names[number] if len(number) else np.zeros(0, object)
    category = np.array([CATEGORY_INDEX.get(LABELS[name][one] or "", -1) for one in label], np.int8)
    is_big = np.isin(label, UNDIVIDED) & (values[:, 7] >= BIG_VEHICLE_M)
    category[is_big] = CATEGORY_INDEX["vehicle_big"]
    kept = category >= 0
    rotation = _make_rotations(path, values[kept, 3:7])
    track = np.array(tokens.flatten().to_pylist(), object)[kept]
    return {
        "category": category[kept],
        "center_m": values[kept, :3],
        "rotation": rotation,
        "size_m": values[kept, 7:],
        "heading_rad": np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]),
        "instance_id": _hash_tracks(track),
        "label": label[kept],
        "timestamp": np.repeat(time, count)[kept],
    }, int((~kept).sum())


def _hash_tracks(tracks: np.ndarray) -> np.ndarray:
    """Return the first 63 bits of the BLAKE2 hash of each track (n,), as (n,) int64 >= 0."""
    hashes = {
        track: int.from_bytes(hashlib.blake2b(str(track).encode(), digest_size=8).digest(), "big") >> 1
        for track in set(tracks)
    }
    return np.array([hashes[track] for track in tracks], np.int64)


# ------------------------------------------------------------------------------------------------------------- map


def _find_map(root: str | PathLike, folder: InputPath, about: dict[str, Any]) -> InputPath | None:
    """Return the file of the map of a log; None if the dataset has no maps."""
    own = folder / "map.arrow"
    described = about.get("map_metadata")
    if own.is_file():
        return own
    if not isinstance(described, dict):
        return None
    dataset, place = (str(described.get(name, "")) for name in ("dataset", "location"))
    if not all(part and part.replace("-", "").replace("_", "").isalnum() for part in (dataset, place)):
        raise ValueError(f"{folder}: map of dataset {dataset[:40]!r} and location {place[:40]!r}; {AGAIN}")
    return make_input_path(root, "maps", dataset, f"{dataset}_{place}.arrow")


def _read_ground(path: InputPath | None, trajectory_m: np.ndarray) -> SurfaceGround:
    """Return the areas of a map as triangles. Their heights are those of near lines, or of the vehicle's trajectory."""
    if path is None:
        return SurfaceGround(np.zeros((0, 3, 3)), np.zeros(0, np.int64))
    table = _read_arrow(path)
    has_heights = bool(_read_metadata(path, table).get("map_has_z", True))
    layer = _read_column(path, table, "map_layer", pa.int8()).to_numpy()
    wkb = _read_column(path, table, "wkb", pa.binary())
    chosen = np.flatnonzero(np.isin(layer, [*LAYERS, *LINES]))
    try:
        shapes = shapely.from_wkb(np.array(wkb.take(pa.array(chosen)).to_pylist(), object))
    except shapely.errors.GEOSException as error:
        raise ValueError(f"{path}: broken geometry ({str(error)[:80]}); {AGAIN}") from error
    layer = layer[chosen]
    if not np.isfinite(shapely.get_coordinates(shapes)).all():
        raise ValueError(f"{path}: broken geometry (a coordinate is not finite); {AGAIN}")
    bounds = shapely.bounds(shapes)  # Maps of cities are much larger than the area of a log.
    low_m, high_m = trajectory_m[:, :2].min(axis=0) - REACH_M, trajectory_m[:, :2].max(axis=0) + REACH_M
    near = (bounds[:, :2] <= high_m).all(axis=1) & (bounds[:, 2:] >= low_m).all(axis=1)
    shapes, layer = shapes[near], layer[near]
    is_line = np.isin(layer, LINES)
    points = shapely.get_coordinates(shapes[is_line], include_z=True)
    points = points[np.isfinite(points).all(axis=1) & has_heights]
    triangles, classes = [np.zeros((0, 3, 2))], [np.zeros(0, np.int64)]
    for shape, name in _list_areas(shapes[~is_line], layer[~is_line]):
        pieces = shapely.get_parts(shapely.constrained_delaunay_triangles(shape))
        flat = shapely.get_coordinates(pieces).reshape(-1, 4, 2)[:, :3]
        triangles.append(flat)
        classes.append(np.full(len(flat), GROUND_CLASSES.index(name)))
    flat = np.concatenate(triangles)
    height_m = _find_heights(flat.reshape(-1, 2), points, trajectory_m).reshape(-1, 3, 1)
    return SurfaceGround(np.concatenate([flat, height_m], axis=2), np.concatenate(classes))


def _list_areas(shapes: np.ndarray, layer: np.ndarray) -> Iterator[tuple[Any, str]]:
    """Yield polygons and their ground classes."""
    if not len(shapes):
        return
    repaired, _ = repair_polygons(list(shapely.force_2d(shapes)))
    for shape, number in zip(repaired, layer, strict=True):
        for part in shapely.get_parts(shape):
            if part.geom_type == "Polygon" and not part.is_empty:
                yield part if shapely.get_num_coordinates(part) <= MAX_POINTS else part.simplify(0.1), LAYERS[number]


def _find_heights(xy_m: np.ndarray, points_m: np.ndarray, trajectory_m: np.ndarray) -> np.ndarray:
    """Return heights (n,) of points (n, 2): that of the nearest point of a line, or of the trajectory."""
    _, index = cKDTree(trajectory_m[:, :2]).query(xy_m)
    height_m = trajectory_m[index, 2]
    if len(points_m):
        distance_m, index = cKDTree(points_m[:, :2]).query(xy_m)
        height_m = np.where(distance_m <= MAX_HEIGHT_REACH_M, points_m[index, 2], height_m)
    return height_m
