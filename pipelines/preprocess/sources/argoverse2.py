"""Read a log of Argoverse 2's sensor dataset as a Drive.

Each annotated sweep (10 Hz) is one pose and yields one Scene.

    ROOT/{train,val}/LOG/annotations.feather              boxes in the ego frame of their sweep
    ROOT/{train,val}/LOG/city_SE3_egovehicle.feather      city from ego, 200 Hz
    ROOT/{train,val}/LOG/map/                             polygons (city frame) and a raster of ground heights

In the ego frame, x points forward, y left and z up. The origin lies on the rear axle. The world frame is the city
frame. An invalid log raises ValueError; the message names file, value and remedy.
"""

from __future__ import annotations

import hashlib
from os import PathLike
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as compute
import pyarrow.feather
from scipy.spatial.transform import Rotation

from models.limits import require_within
from models.scene import CATEGORY_INDEX
from pipelines.preprocess.sources.drive import Drive, MapGround
from pipelines.preprocess.sources.files import are_all_numbers, read_file, read_json_file
from pipelines.preprocess.sources.input_paths import InputPath, find_local_file, make_input_path
from pipelines.runtime.feather_sizes import measure_feather

pc: Any = compute  # The type checker does not know the functions that pyarrow generates.
AGAIN = "download the log again"

SOURCE = "av2"
SPLITS = ("train", "val")
GROUND_CLASSES = ("road", "crossing")

# The paper names only the seven groups. The paper does not state which of the 30 categories belong to each group.
CATEGORY_LABELS = {
    "vehicle_big": (
        "BUS",
        "SCHOOL_BUS",
        "ARTICULATED_BUS",
        "TRUCK",
        "BOX_TRUCK",
        "TRUCK_CAB",
        "LARGE_VEHICLE",
        "RAILED_VEHICLE",
    ),
    "vehicle_small": ("REGULAR_VEHICLE", "VEHICULAR_TRAILER"),
    "two_wheelers": ("BICYCLE", "MOTORCYCLE", "WHEELED_DEVICE"),
    "human": ("PEDESTRIAN", "BICYCLIST", "MOTORCYCLIST", "WHEELED_RIDER", "OFFICIAL_SIGNALER"),
    "pole": ("BOLLARD",),
    "traffic_control": (
        "SIGN",
        "STOP_SIGN",
        "MOBILE_PEDESTRIAN_CROSSING_SIGN",
        "TRAFFIC_LIGHT_TRAILER",
        "MESSAGE_BOARD_TRAILER",
    ),
    "object": ("CONSTRUCTION_CONE", "CONSTRUCTION_BARREL", "STROLLER", "WHEELCHAIR", "ANIMAL", "DOG"),
}
CATEGORY_OF = {label: CATEGORY_INDEX[name] for name, labels in CATEGORY_LABELS.items() for label in labels}
EGO_LABEL = "EGO_VEHICLE"  # Some logs contain a box for the recording car itself.

QUATERNION = ("qw", "qx", "qy", "qz")
TRANSLATION = ("tx_m", "ty_m", "tz_m")
SIZE = ("length_m", "width_m", "height_m")
MAX_BOX_DISTANCE_M = 1e3  # Largest valid distance from the ego vehicle to a box; real boxes lie up to 220 m away.
MAX_BOX_SIZE_M = 1e2
MIN_BOX_SIZE_M = 1e-3
MAX_COORDINATE_M = 1e6
MAX_HEIGHT_M = 1e4


def list_logs(root: str | PathLike) -> list[tuple[str, str]]:
    """Return the annotated logs: first train, then val.

    The test split has no annotations.

    Args:
        root: Directory of the sensor dataset.

    Returns:
        (split, log id) of each log.

    Raises:
        ValueError: The directory holds no annotated log.
    """
    found = [
        (split, folder.name)
        for split in SPLITS
        for folder in sorted(make_input_path(root, split).glob("*/"))
        if not folder.name.startswith(".")
    ]
    if not found:
        raise ValueError(
            f"{root} holds no train/LOG or val/LOG folder (the test split has no annotations); --input must"
            " name the folder that holds Argoverse 2's sensor logs by split"
        )
    return found


def read_drive(root: str | PathLike, split: str, log: str) -> Drive:
    """Read the annotated sweeps of one log.

    `frame` and `timestamp` are the time of a sweep (ns). `instance_id` is a hash of the track's uuid. The hash does not
    depend on the machine. `heading_rad` is the yaw of the box's x axis.

    Args:
        root: Directory of the sensor dataset.
        split: train or val.
        log: Id of the log.

    Returns:
        The drive in the city frame (float64).

    Raises:
        ValueError: A file or value is missing or invalid; the message names the file.
    """
    folder = make_input_path(root, split, log)
    if split == "test":
        raise ValueError(f"{folder}: Argoverse 2's test split has no annotations; use train or val")
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such log; check --input and unpack the log")
    boxes = _read_annotations(folder / "annotations.feather")
    frame, box_sweep = np.unique(boxes["timestamp_ns"], return_inverse=True)
    city_from_ego = _read_poses(folder / "city_SE3_egovehicle.feather", frame)

    others = boxes["category"] != EGO_LABEL
    boxes, box_sweep = {name: column[others] for name, column in boxes.items()}, box_sweep[others]
    city_from_ego_of_box = city_from_ego[box_sweep]
    center_ego_m = _read_columns(boxes, TRANSLATION)
    rotation = city_from_ego_of_box[:, :, :3] @ _make_rotation(_read_columns(boxes, QUATERNION))
    return Drive(
        source=SOURCE,
        sequence=log,
        category=np.array([CATEGORY_OF[label] for label in boxes["category"]], np.int8),
        center_m=np.einsum("nij,nj->ni", city_from_ego_of_box[:, :, :3], center_ego_m) + city_from_ego_of_box[:, :, 3],
        rotation=rotation,
        size_m=_read_columns(boxes, SIZE),
        heading_rad=np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]),
        instance_id=_hash_ids(boxes["track_uuid"]),
        label=boxes["category"],
        timestamp=boxes["timestamp_ns"],
        ground_classes=GROUND_CLASSES,
        ground=_read_ground(folder / "map"),
        frame=frame,
        world_from_imu=city_from_ego,
    )


# ---------------------------------------------------------------------------------------------------- feather


def _read_annotations(path: InputPath) -> dict[str, np.ndarray]:
    """Return the required columns (n,) of the annotations, after all checks."""
    numbers = (*SIZE, *QUATERNION, *TRANSLATION)
    columns = _read_feather(path, integers=("timestamp_ns",), texts=("track_uuid", "category"), numbers=numbers)
    if len(columns["category"]) == 0:
        raise ValueError(f"{path} holds no box; download the log again")
    unknown = sorted(set(columns["category"]) - set(CATEGORY_OF) - {EGO_LABEL})
    if unknown:
        raise ValueError(f"{path}: unknown category {unknown[0][:40]!r}; add it to CATEGORY_LABELS of {__name__}")
    for name in SIZE:
        _check_range(path, name, columns[name], MIN_BOX_SIZE_M, MAX_BOX_SIZE_M)
    for name in TRANSLATION:
        _check_range(path, name, columns[name], -MAX_BOX_DISTANCE_M, MAX_BOX_DISTANCE_M)
    _check_quaternion(path, columns)
    return columns


def _read_poses(path: InputPath, frame: np.ndarray) -> np.ndarray:
    """Return city_from_ego (p, 3, 4), in metres, at the timestamps `frame` (p,), which are sorted."""
    columns = _read_feather(path, integers=("timestamp_ns",), texts=(), numbers=(*QUATERNION, *TRANSLATION))
    for name in TRANSLATION:
        _check_range(path, name, columns[name], -MAX_COORDINATE_M, MAX_COORDINATE_M)
    _check_quaternion(path, columns)
    time, first = np.unique(columns["timestamp_ns"], return_index=True)
    missing = np.setdiff1d(frame, time)
    if len(missing):
        raise ValueError(f"{path}: no pose at the annotated timestamp {missing[0]}; download the log again")
    row = first[np.searchsorted(time, frame)]
    rotation = _make_rotation(_read_columns(columns, QUATERNION)[row])
    return np.concatenate([rotation, _read_columns(columns, TRANSLATION)[row][:, :, None]], axis=2)


def _read_feather(
    path: InputPath, integers: tuple[str, ...], texts: tuple[str, ...], numbers: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """Return columns of a feather file as int64, str objects or float64.

    Columns have no nulls and only finite numbers.
    """
    content = read_file(path, AGAIN)
    try:
        rows, size = measure_feather(content)
    except ValueError as error:
        raise ValueError(f"{path}: broken feather file ({error}); {AGAIN}") from error
    require_within("table_rows", rows, str(path))
    require_within("table_bytes", size, str(path))
    try:
        table = pyarrow.feather.read_table(pa.BufferReader(content), memory_map=False)
        table.validate(full=True)
    except Exception as error:  # A damaged file makes pyarrow raise errors of many types.
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise ValueError(f"{path}: broken feather file ({reason}); {AGAIN}") from error
    kinds = [
        (integers, pa.types.is_int64, "int64"),
        (texts, _is_text, "text"),
        (numbers, pa.types.is_floating, "float"),
    ]
    columns = {}
    for names, is_kind, kind in kinds:
        for name in names:
            if table.schema.get_field_index(name) < 0:
                raise ValueError(f"{path}: column {name} is missing or occurs twice; download the log again")
            column = table[name]
            if not is_kind(column.type):
                raise ValueError(f"{path}: column {name} is {column.type}, expected {kind}; download the log again")
            if column.null_count:
                raise ValueError(f"{path}: column {name} has {column.null_count} nulls; download the log again")
            if kind == "text":
                columns[name] = _read_texts(path, name, column)
            else:
                columns[name] = column.to_numpy().astype(np.int64 if kind == "int64" else np.float64)
    for name in numbers:
        bad = np.flatnonzero(~np.isfinite(columns[name]))
        if len(bad):
            raise ValueError(f"{path}: {name} of row {bad[0]} is {columns[name][bad[0]]}; fix or drop the row")
    return columns


def _read_texts(path: InputPath, name: str, column: pa.ChunkedArray) -> np.ndarray:
    """Return texts (n,); equal texts are one object."""
    values = []
    for chunk in column.chunks:
        chunk = chunk if pa.types.is_dictionary(chunk.type) else pc.dictionary_encode(chunk)
        longest = pc.max(pc.utf8_length(chunk.dictionary)).as_py() or 0
        require_within("text_characters", longest, f"{path}: a text in column {name}")
        texts = np.array([*chunk.dictionary.to_pylist(), None], object)  # None keeps numpy from making an (n, m) array.
        values.append(texts[chunk.indices.to_numpy()])
    found = np.concatenate([np.zeros(0, object), *values])
    if any(text is None for text in set(found)):
        raise ValueError(f"{path}: column {name} has a null; {AGAIN}")
    return found


def _is_text(kind: pa.DataType) -> bool:
    if pa.types.is_dictionary(kind):
        kind = kind.value_type
    return pa.types.is_string(kind) or pa.types.is_large_string(kind)


def _check_range(path: InputPath, name: str, values: np.ndarray, low: float, high: float) -> None:
    bad = np.flatnonzero((values < low) | (values > high))
    if len(bad):
        raise ValueError(
            f"{path}: {name} of row {bad[0]} is {values[bad[0]]:g}, expected {low:g}..{high:g}; fix or drop the row"
        )


def _check_quaternion(path: InputPath, columns: dict[str, np.ndarray]) -> None:
    for name in QUATERNION:
        _check_range(path, name, columns[name], -2, 2)
    norm = np.linalg.norm(_read_columns(columns, QUATERNION), axis=1)
    bad = np.flatnonzero(np.abs(norm - 1) > 1e-3)
    if len(bad):
        raise ValueError(
            f"{path}: quaternion of row {bad[0]} has norm {norm[bad[0]]:g}, expected 1; fix or drop the row"
        )


def _read_columns(columns: dict[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray:
    """(n, len(names)) float64."""
    return np.stack([columns[name] for name in names], axis=1)


def _make_rotation(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotations (n, 3, 3) of quaternions (n, 4), with the scalar first."""
    return Rotation.from_quat(quaternion, scalar_first=True).as_matrix().reshape(-1, 3, 3)


def _hash_ids(track_uuid: np.ndarray) -> np.ndarray:
    """Return the first 63 bits of the BLAKE2 hash of each uuid (n,), as (n,) int64 >= 0."""
    hashes = {
        uuid: int.from_bytes(hashlib.blake2b(uuid.encode(), digest_size=8).digest(), "big") >> 1
        for uuid in set(track_uuid)
    }
    return np.array([hashes[uuid] for uuid in track_uuid], np.int64)


# -------------------------------------------------------------------------------------------------------- map


def _read_ground(folder: InputPath) -> MapGround:
    """Return the ground: drivable areas have class road, and pedestrian crossings have class crossing.

    Heights come from the log's raster.
    """
    path = _find_only_file(folder, "log_map_archive_*.json")
    content = _read_json(path)
    areas, crossings = (_read_section(path, content, name) for name in ("drivable_areas", "pedestrian_crossings"))
    roads = [_read_points(path, area, "area_boundary", 3) for area in areas]
    quads = [_read_quad(_read_points(path, c, "edge1", 2, 2), _read_points(path, c, "edge2", 2, 2)) for c in crossings]
    return MapGround(
        polygon_class=[GROUND_CLASSES.index("road")] * len(roads) + [GROUND_CLASSES.index("crossing")] * len(quads),
        polygons_m=roads + quads,
        raster_m=_read_heights(_find_only_file(folder, "*_ground_height_surface____*.npy")),
        raster_from_world=_read_sim2(_find_only_file(folder, "*___img_Sim2_city.json")),
    )


def _find_only_file(folder: InputPath, pattern: str) -> InputPath:
    paths = sorted(folder.glob(pattern))
    if len(paths) != 1:
        raise ValueError(f"{folder / pattern}: {len(paths)} such files, expected 1; download the log again")
    return paths[0]


def _read_json(path: InputPath) -> dict:
    content = read_json_file(path, AGAIN)
    if not isinstance(content, dict):
        raise ValueError(f"{path}: holds a {type(content).__name__}, expected an object; download the log again")
    return content


def _read_section(path: InputPath, content: dict, name: str) -> list[dict]:
    """Return the entries of one section of the map file."""
    section = content.get(name)
    if not isinstance(section, dict) or not all(isinstance(entry, dict) for entry in section.values()):
        raise ValueError(f"{path}: {name} is missing or no object of objects; download the log again")
    return list(section.values())


def _read_points(path: InputPath, entry: dict, name: str, least: int, most: int | None = None) -> np.ndarray:
    """Return x and y (n, 2) of the points in entry[name], in the city frame (m)."""
    points = entry.get(name)
    if not isinstance(points, list) or len(points) < least or (most is not None and len(points) > most):
        raise ValueError(
            f"{path}: {name} of {ascii(entry.get('id'))[:40]} is no list of {least} points; download the log again"
        )
    require_within("polygon_points", len(points), f"{path}: {name} of {ascii(entry.get('id'))[:40]}")
    values = [point.get(axis) if isinstance(point, dict) else None for point in points for axis in "xy"]
    if not are_all_numbers(values, MAX_COORDINATE_M):
        raise ValueError(
            f"{path}: {name} of {ascii(entry.get('id'))[:40]} has a point without valid x, y; fix or drop it"
        )
    return np.array(values, np.float64).reshape(-1, 2)


def _read_quad(edge1_m: np.ndarray, edge2_m: np.ndarray) -> np.ndarray:
    """Return the outline (4, 2) of the area between two edges (2, 2).

    The edges may have the same or opposite directions.
    """
    if (edge1_m[1] - edge1_m[0]) @ (edge2_m[1] - edge2_m[0]) < 0:
        edge2_m = edge2_m[::-1]
    return np.concatenate([edge1_m, edge2_m[::-1]])


def _read_heights(path: InputPath) -> np.ndarray:
    """Return the heights (rows, cols) in the city frame (m). NaN marks unknown heights."""
    _check_file(path)
    try:
        # Memory mapping avoids a large allocation if the shape in the header is wrong.
        mapped = np.load(find_local_file(path), mmap_mode="r", allow_pickle=False)
    # numpy evaluates the header as Python code. A broken header can therefore raise any error.
    except Exception as error:
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise ValueError(f"{path}: broken npy file ({reason}); download the log again") from error
    if not isinstance(mapped, np.ndarray) or mapped.ndim != 2 or mapped.dtype.kind != "f":
        kind = f"{mapped.dtype} {mapped.shape}" if isinstance(mapped, np.ndarray) else type(mapped).__name__
        raise ValueError(f"{path} holds {kind}, expected a 2D float array; download the log again")
    require_within("raster_pixels", mapped.size, str(path))
    with np.errstate(over="ignore"):  # Overflow gives infinity, which the check below rejects.
        height_m = np.array(mapped, np.float32)
    known = height_m[~np.isnan(height_m)]
    if len(known) == 0 or np.abs(known).max() > MAX_HEIGHT_M:
        raise ValueError(
            f"{path} holds {len(known)} known heights, expected one or more within ±10 km; download the log again"
        )
    return height_m


def _read_sim2(path: InputPath) -> np.ndarray:
    """Return raster_from_city (3, 3), which maps a city point (x, y, 1) to (column, row, 1): p = s (R p_city + t)."""
    content = _read_json(path)
    rotation, translation, scale = content.get("R"), content.get("t"), content.get("s")
    if not (
        isinstance(rotation, list) and len(rotation) == 4 and isinstance(translation, list) and len(translation) == 2
    ):
        raise ValueError(f"{path}: R must have 4 numbers and t must have 2; download the log again")
    if scale is None or not are_all_numbers([*rotation, *translation, scale], MAX_COORDINATE_M) or scale <= 0:
        raise ValueError(f"{path}: R, t or s is no valid number; download the log again")
    matrix = np.array(rotation, np.float64).reshape(2, 2)
    if np.abs(matrix @ matrix.T - np.eye(2)).max() > 1e-3:
        raise ValueError(f"{path}: R is {rotation} and no rotation; download the log again")
    raster_from_city = np.eye(3)
    raster_from_city[:2, :2] = scale * matrix
    raster_from_city[:2, 2] = scale * np.array(translation)
    return raster_from_city


def _check_file(path: InputPath) -> None:
    if not path.is_file():
        raise ValueError(f"{path} is missing; download the log again")
