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

import difflib
import hashlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as compute
import pyarrow.parquet as pq
import shapely
from scipy.spatial.transform import Rotation

from models.limits import LimitError, require_within
from models.scene import CATEGORIES, CATEGORY_INDEX, GROUND_CLASSES, make_yaw_rotation
from pipelines.preprocess.sources.drive import STATIC, Drive, SurfaceGround
from pipelines.preprocess.sources.files import read_json_file
from pipelines.preprocess.sources.triangulation import triangulate_polygon
from pipelines.runtime.parquet_sizes import measure_columns
from pipelines.schema.splits import TEST, TRAIN

pc: Any = compute  # The type checker does not know the functions that pyarrow generates.

SOURCE = "own"

PLACE = ("x_m", "y_m", "z_m")
SIZE = ("length_m", "width_m", "height_m")
QUATERNION = ("qw", "qx", "qy", "qz")
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
PANDAS_INDEX = "__index_level_0__"  # pandas adds this column automatically.

# Categories whose x axis is the direction of travel, unless heading_known is set.
HEADED = tuple(CATEGORY_INDEX[name] for name in ("vehicle_big", "vehicle_small", "two_wheelers", "human"))

MAX_COORDINATE_M = 1e7  # Largest valid world coordinate; UTM northings can be this large.
MAX_HEIGHT_M = 1e4
MIN_SIZE_M = 1e-3
MAX_SIZE_M = 1e3
MAX_YAW_RAD = 6.2832  # One full turn in each direction. Larger values are probably in degrees.
VALUE_BYTES = 8  # Upper bound of the size of a number and of an index into a dictionary.
MATRIX_ENTRIES = 12  # Number of entries of world_from_ego.
MAX_WHOLE = 2**63 - 1
MAX_EXACT_FLOAT = 2**53
# Minimum cosine of the angle between the z axes of ego and world frame. Real roads give larger values, and camera
# frames give smaller values.
MIN_UP = 0.5
# At least one pose must lie within this distance of the content. The farthest corner of a crop is 72 m from the
# vehicle.
SIGHT_M = 100.0


# ----------------------------------------------------------------------------------------------------- the root


def list_drives(root: str | Path) -> list[str]:
    """Return the drives.

    A drive is a folder with a name that does not begin with a dot.

    Args:
        root: Directory of all drives.

    Returns:
        Names of the drives in alphabetical order.

    Raises:
        ValueError: The directory holds no drive, or a name contains characters that a scene id cannot contain.
    """
    names = sorted(path.name for path in Path(root).glob("*/") if not path.name.startswith("."))
    if not names:
        raise ValueError(
            f"{root} holds no folder; --input must name the folder of all drives, which holds DRIVE/boxes.parquet,"
            " DRIVE/polygons.parquet and DRIVE/poses.parquet (or .json)"
        )
    for name in names:
        if not re.fullmatch(r"[A-Za-z0-9._-]+", name):
            raise ValueError(
                f"{Path(root, name)}: the name of a drive is part of file names; rename the folder with letters,"
                " digits, '.', '_' and '-'"
            )
    return names


def read_splits(root: str | Path) -> dict[str, str] | None:
    """Read the split of every drive from ROOT/splits.json.

    Args:
        root: Directory of all drives.

    Returns:
        Map from drive name to "train" or "test"; None if the file is absent.

    Raises:
        ValueError: The file is invalid, omits a drive, contains an unknown drive, or contains a split other than train
            and test.
    """
    path = Path(root, "splits.json")
    if not path.exists():
        return None
    sides = _load_json(path)
    if not isinstance(sides, dict):
        raise ValueError(f'{path} holds a {type(sides).__name__}, expected {{"drive": "train" or "test"}}')
    names = list_drives(root)
    drives = set(names)
    for name, side in sides.items():
        if name not in drives:
            raise ValueError(
                f"{path}: the folder {_show(name)} does not exist next to this file; remove the entry or add the drive"
            )
        if side not in (TRAIN, TEST):
            raise ValueError(f"{path}: {name} is {_show(side)}, expected {TRAIN!r} or {TEST!r}")
    for name in names:
        if name not in sides:
            raise ValueError(f"{path} has no entry for the folder {name}; add an entry or remove the folder")
    return sides


def read_ground_classes(root: str | Path) -> tuple[str, ...]:
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
            found |= set(_read_polygons(Path(root, name)).texts("class"))
        except ValueError as error:
            errors.append(error)
    if not found:
        raise errors[0] if errors else ValueError(f"{root}: no drive has a ground polygon; add at least the road")
    return tuple(name for name in GROUND_CLASSES if name in found)


def read_drive(root: str | Path, name: str, classes: tuple[str, ...] | None = None) -> Drive:
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
    folder = Path(root, name)
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


# ----------------------------------------------------------------------------------------------------- a table


@dataclass(frozen=True)
class _Table:
    """The columns of a file as Python values. The methods check every value."""

    path: Path
    rows: int
    columns: dict[str, list | pa.ChunkedArray]  # Columns with at least one value.

    def numbers(self, names: Sequence[str], low: float, high: float, unit: str = "") -> np.ndarray:
        """Return float64 values (rows, len(names)) in [low, high]."""
        found = np.empty((self.rows, len(names)))
        for k, name in enumerate(names):
            column: Any = self.columns[name]
            if not isinstance(column, list) and not column.null_count and _is_number(column.type):
                values = column.to_numpy()
                bad = ~((values >= low) & (values <= high))
                if not bad.any():
                    found[:, k] = values
                    continue
            for row, value in enumerate(self.iterate(name)):
                if type(value) not in (int, float) or not low <= value <= high:
                    raise ValueError(
                        f"{self.path}: {name} of row {row} is {_show(value)}, expected a number of"
                        f" {low:g}..{high:g}{unit}; fix or drop the row"
                    )
                found[row, k] = value
        return found

    def frames(self, missing: int | None = None) -> np.ndarray:
        """Return frame numbers (rows,) int64 >= 0.

        An absent frame becomes `missing`. If `missing` is None, an absent frame raises an error.
        """
        values = self._optional("frame")
        for row, value in enumerate(values):
            if value is None and missing is not None:
                continue
            if not _is_whole(value):
                static = "" if missing is None else "; null means that a box is static"
                raise ValueError(
                    f"{self.path}: frame of row {row} is {_show(value)}, expected a whole number of 0 or more{static}"
                )
            if type(value) is float and value >= MAX_EXACT_FLOAT:
                raise ValueError(
                    f"{self.path}: frame of row {row} is {value!r}, a float that cannot hold all digits; write"
                    " whole numbers (in pandas: astype('Int64'))"
                )
        return np.array([missing if value is None else int(value) for value in values], np.int64)

    def texts(self, name: str, allowed: Sequence[str] = (), optional: bool = False) -> list:
        """Return `rows` texts.

        If `allowed` is not empty, it must contain each text. With `optional`, absent values become None.
        """
        values = self._optional(name)
        for row, value in enumerate(values):
            if value is None and optional:
                continue
            if not _is_text(value):
                raise ValueError(f"{self.path}: {name} of row {row} is {_show(value)}, expected a text")
            if allowed and value not in allowed:
                raise ValueError(
                    f"{self.path}: {name} of row {row} is {_show(value)}, expected one of {', '.join(allowed)};"
                    " map your labels to these"
                )
        return values

    def flags(self, name: str) -> list:
        """Return `rows` values, each True, False or None."""
        values = self._optional(name)
        for row, value in enumerate(values):
            if value is not None and type(value) is not bool:
                raise ValueError(f"{self.path}: {name} of row {row} is {_show(value)}, expected true, false or null")
        return values

    def rotations(self) -> np.ndarray:
        """Return rotations (rows, 3, 3) from the column yaw_rad or, if the file lacks it, from quaternions."""
        given = [form for form in (("yaw_rad",), QUATERNION) if any(name in self.columns for name in form)]
        if self.rows and len(given) != 1:
            raise ValueError(
                f"{self.path}: {'both yaw_rad and a quaternion' if given else 'no orientation'}; give either"
                " yaw_rad or qw, qx, qy, qz in every row"
            )
        if not self.rows:
            return np.zeros((0, 3, 3))
        self.require(given[0])
        if given[0] == ("yaw_rad",):
            yaw_rad = self.numbers(("yaw_rad",), -MAX_YAW_RAD, MAX_YAW_RAD, " (radians)")
            return make_yaw_rotation(yaw_rad[:, 0])
        quaternion = self.numbers(QUATERNION, -2, 2)
        norm = np.linalg.norm(quaternion, axis=1)
        bad = np.flatnonzero(np.abs(norm - 1) > 1e-3)
        if len(bad):
            raise ValueError(
                f"{self.path}: quaternion of row {bad[0]} has norm {norm[bad[0]]:g}, expected 1; normalise it"
            )
        return Rotation.from_quat(quaternion, scalar_first=True).as_matrix().reshape(-1, 3, 3)

    def places(self) -> np.ndarray:
        """Return points (rows, 3) in the world frame."""
        xy_m = self.numbers(PLACE[:2], -MAX_COORDINATE_M, MAX_COORDINATE_M, " m")
        return np.hstack([xy_m, self.numbers(PLACE[2:], -MAX_HEIGHT_M, MAX_HEIGHT_M, " m (z up)")])

    def require(self, names: Sequence[str]) -> None:
        for name in names:
            if name not in self.columns and self.rows:
                raise ValueError(f"{self.path}: column {name} is missing or all null; see docs/how_to/own_drives.md")

    def iterate(self, name: str) -> Iterator[Any]:
        """Yield the Python values of a column; of a Parquet file, only some values are in memory at the same time."""
        column = self.columns[name] if name in self.columns else [None] * self.rows
        if isinstance(column, list):
            yield from column
        elif pa.types.is_dictionary(column.type):
            for chunk in column.chunks:
                texts = chunk.dictionary.to_pylist()  # A text that occurs in many rows is one object.
                for index in chunk.indices.to_pylist():
                    yield None if index is None else texts[index]
        else:
            step = 1_000 if column.type.num_fields == 0 else 16
            for start in range(0, len(column), step):
                yield from column.slice(start, step).to_pylist()

    def _optional(self, name: str) -> list:
        return list(self.iterate(name))


def _read_table(folder: Path, name: str, known: Sequence[str], required: Sequence[str]) -> _Table:
    """Read FOLDER/NAME.parquet or .json as a map from name to column, and check the names."""
    paths = [folder / f"{name}.parquet", folder / f"{name}.json"]
    found = [path for path in paths if path.is_file()]
    if not found:
        empty = "; if the drive has none, write [] into the .json" if name != "poses" else ""
        raise ValueError(f"{paths[0]} and {paths[1].name} are missing; see docs/how_to/own_drives.md{empty}")
    if len(found) > 1:
        raise ValueError(f"{paths[0]} and {paths[1].name} both exist; keep one of the two")
    path = found[0]
    rows, columns = (_load_parquet if path.suffix == ".parquet" else _load_records)(path, known)
    filled = {name: values for name, values in columns.items() if _has_values(values)}
    table = _Table(path, rows, filled if rows else {name: [] for name in known})
    table.require(required)
    return table


def _has_values(column: list | pa.ChunkedArray) -> bool:
    if isinstance(column, list):
        return any(value is not None for value in column)
    return column.null_count < len(column)


def _check_names(path: Path, names: Sequence[str], known: Sequence[str]) -> None:
    """Raise ValueError if a column is unknown or occurs twice."""
    for name in names:
        if name not in known and name != PANDAS_INDEX:
            meant = difflib.get_close_matches(name[:40], known, 1)
            raise ValueError(
                f"{path}: column {_show(name)} is unknown{f' (meant {meant[0]}?)' if meant else ''}; drop it,"
                f" or rename it to one of {', '.join(known)}"
            )
    if twice := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"{path}: column {_show(twice[0])} occurs twice; drop one of them")


def _load_parquet(path: Path, known: Sequence[str]) -> tuple[int, dict[str, list | pa.ChunkedArray]]:
    """Read a Parquet file after a check of its columns and of the memory that they need.

    Texts are read as dictionaries, which hold each different text once. The schema and the sizes are those that the
    file states.
    """
    try:
        with open(path, "rb") as stream:
            rows, sizes = measure_columns(stream)
        schema = pq.read_schema(path)
    except Exception as error:  # A damaged file makes pyarrow raise errors of many types.
        raise _make_parquet_error(path, error) from error
    _check_names(path, schema.names, known)
    for field in schema:
        if not _is_plain(field.type):
            raise ValueError(
                f"{path}: column {field.name} has the type {str(field.type)[:40]}, expected numbers, texts or lists of"
                " numbers; write plain values"
            )
    require_within("table_rows", rows, str(path))
    require_within("table_bytes", sum(size.bytes + VALUE_BYTES * size.values for size in sizes), str(path))
    texts = [field.name for field in schema if _is_text_kind(field.type)]
    try:
        with pq.ParquetFile(path, read_dictionary=texts) as file:
            table = file.read()
        table.validate(full=True)
        if len(table) != rows:
            raise pa.ArrowInvalid(f"{len(table)} rows can be read, but the file states {rows}")
        for name in table.column_names:
            _check_column_sizes(path, name, table[name])
    except LimitError:
        raise
    except Exception as error:
        raise _make_parquet_error(path, error) from error
    return len(table), dict(zip(table.column_names, table.columns, strict=True))


def _make_parquet_error(path: Path, error: Exception) -> ValueError:
    reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
    return ValueError(f"{path}: broken Parquet file ({reason}); write it again")


def _is_number(kind: pa.DataType) -> bool:
    return pa.types.is_integer(kind) or pa.types.is_floating(kind)


def _is_list(kind: pa.DataType) -> bool:
    is_fixed = pa.types.is_fixed_size_list(kind) and kind.list_size <= MATRIX_ENTRIES
    return is_fixed or pa.types.is_list(kind) or pa.types.is_large_list(kind)


def _is_text_kind(kind: pa.DataType) -> bool:
    kind = kind.value_type if pa.types.is_dictionary(kind) else kind
    return pa.types.is_string(kind) or pa.types.is_large_string(kind)


def _is_plain(kind: pa.DataType) -> bool:
    """Return whether a column has numbers, flags, texts, nulls, or lists or lists of lists of numbers."""
    for _ in range(2):
        kind = kind.value_type if _is_list(kind) else kind
    return _is_number(kind) or _is_text_kind(kind) or pa.types.is_boolean(kind) or pa.types.is_null(kind)


def _check_column_sizes(path: Path, name: str, column: pa.ChunkedArray) -> None:
    """Raise LimitError if a text, a list or all lists of a column are too long for Python objects."""
    for chunk in column.chunks:
        if pa.types.is_dictionary(chunk.type) and len(chunk.dictionary):
            longest = pc.max(pc.utf8_length(chunk.dictionary)).as_py() or 0
            require_within("text_letters", longest, f"{path}: a text in column {name}")
        elif _is_list(chunk.type):
            lengths = pc.list_value_length(chunk)
            longest = pc.max(lengths).as_py() or 0
            require_within(
                "polygon_points", longest, f"{path}: row {pc.index(lengths, longest).as_py()}, column {name}"
            )
            require_within("table_rows", len(chunk.flatten()), f"{path}: entries of the lists of column {name}")
            if _is_list(chunk.type.value_type):
                longest = pc.max(pc.list_value_length(chunk.flatten())).as_py() or 0
                if longest > MATRIX_ENTRIES:
                    raise ValueError(f"column {name} has a point of {longest} numbers")


def _load_records(path: Path, known: Sequence[str]) -> tuple[int, dict[str, list | pa.ChunkedArray]]:
    records = _load_json(path)
    if not isinstance(records, list):
        raise ValueError(f"{path} holds a {type(records).__name__}, expected a list of objects, one per row")
    require_within("table_rows", len(records), str(path))
    for row, record in enumerate(records):
        if not isinstance(record, dict):
            raise ValueError(f"{path}: row {row} is {_show(record)}, expected an object of columns")
    names = list(dict.fromkeys(name for record in records for name in record))
    _check_names(path, names, known)
    return len(records), {name: [record.get(name) for record in records] for name in names}


def _load_json(path: Path) -> Any:
    return read_json_file(path, "write it again")


def _show(value: object) -> str:
    """Return a value as text for an error message, at most 40 characters."""
    if value is None:
        return "null"
    # Python cannot convert an integer with thousands of digits to text.
    try:
        shown = repr(value) if type(value) is not int or abs(value) < 10**40 else "an integer of more than 40 digits"
    except (ValueError, RecursionError):  # A nested integer has too many digits, or the nesting is too deep.
        return f"a {type(value).__name__}"
    return shown if len(shown) <= 40 else f"{shown[:37]}..."


# ------------------------------------------------------------------------------------------------------- poses


def read_poses(root: str | Path, name: str) -> tuple[np.ndarray, np.ndarray]:
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
    table = _read_table(Path(root, name), "poses", POSE_COLUMNS, ("frame",))
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


def _read_matrices(table: _Table) -> np.ndarray:
    """Return the column world_from_ego as (rows, 3, 4). In the file, an entry is 12 numbers, row by row."""
    others = [name for name in (*PLACE, "yaw_rad", *QUATERNION) if name in table.columns]
    if others:
        raise ValueError(f"{table.path} has world_from_ego and {others[0]}; keep only one form of the pose")
    world_from_ego = np.empty((table.rows, 12))
    for row, matrix in enumerate(table.iterate("world_from_ego")):
        if type(matrix) is not list or len(matrix) != MATRIX_ENTRIES or not _are_all_numbers(matrix, MAX_COORDINATE_M):
            raise ValueError(
                f"{table.path}: world_from_ego of row {row} is {_show(matrix)}, expected 12 numbers (3 x 4, row by"
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


def _is_text(value: object) -> bool:
    """Return whether a value is a str that files can store.

    JSON escapes can produce a single half of a surrogate pair. Files cannot store such a half.
    """
    return type(value) is str and (value.isascii() or not any("\ud800" <= letter <= "\udfff" for letter in value))


def _is_whole(value: object) -> bool:
    """Return whether a value is an integer of at least 0.

    Floats such as 3.0 count as integers, because pandas stores the integers of a column with nulls as floats.
    """
    return (type(value) is int or type(value) is float) and 0 <= value <= MAX_WHOLE and value == value // 1


def _are_all_numbers(values: list, largest: float) -> bool:
    """Return whether all values are numbers in [-largest, largest]. NaN and true do not count as numbers."""
    return all(type(value) in (int, float) and abs(value) <= largest for value in values)


# ------------------------------------------------------------------------------------------------------- boxes


def _read_boxes(folder: Path) -> _Table:
    return _read_table(folder, "boxes", BOX_COLUMNS, ("category", *PLACE, *SIZE))


def _make_boxes(table: _Table) -> dict[str, np.ndarray]:
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


def _make_instance_ids(table: _Table) -> np.ndarray:
    """Return ids (rows,) int64.

    A number is kept, a text becomes the first 63 bits of its BLAKE2 hash, and null becomes -1.
    """
    ids = []
    for row, value in enumerate(table.iterate("instance_id")):
        if _is_text(value):
            value = int.from_bytes(hashlib.blake2b(value.encode(), digest_size=8).digest(), "big") >> 1
        elif value is not None and not _is_whole(value):
            raise ValueError(
                f"{table.path}: instance_id of row {row} is {_show(value)}, expected a whole number of 0 or more, a"
                " text or null"
            )
        ids.append(-1 if value is None else int(value))
    return np.array(ids, np.int64)


def _check_in_sight(path: Path, points_m: np.ndarray, world_from_ego: np.ndarray) -> None:
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


def _read_polygons(folder: Path) -> _Table:
    table = _read_table(folder, "polygons", POLYGON_COLUMNS, POLYGON_COLUMNS)
    table.texts("class", GROUND_CLASSES)
    return table


def _make_ground(table: _Table, classes: tuple[str, ...]) -> SurfaceGround:
    """Triangulate every outline; triangles use only the vertices of the outline."""
    of_row = [classes.index(name) for name in table.texts("class", classes)]
    parts, points = [], 0
    for row, value in enumerate(table.iterate("outline") if table.rows else ()):
        outline_m = _make_outline(table.path, row, value)
        points += len(outline_m)
        require_within("table_rows", points, f"{table.path}: points of all outlines up to row {row}")
        parts.append(_triangulate_polygon(table.path, row, outline_m))
    return SurfaceGround(
        triangles_m=np.concatenate([np.zeros((0, 3, 3)), *parts]),
        triangle_class=np.repeat(np.array(of_row, np.int64), [len(part) for part in parts]),
    )


def _triangulate_polygon(path: Path, row: int, outline_m: np.ndarray) -> np.ndarray:
    """Return the triangles (t, 3, 3) of one outline in the world frame, from a constrained Delaunay triangulation."""
    reason = shapely.is_valid_reason(shapely.Polygon(outline_m[:, :2]))
    if reason != "Valid Geometry":
        raise ValueError(
            f"{path}: outline of row {row} is no simple polygon, {reason[:80]} (x y); the outline must not cross or"
            " touch itself, and a polygon with a hole must be cut in two"
        )
    return outline_m[triangulate_polygon(outline_m[:, :2] - outline_m[0, :2])]


def _make_outline(path: Path, row: int, value: object) -> np.ndarray:
    """Return the vertices (n, 3) float64 of an open outline, without repeated successive points."""
    if type(value) is not list:
        raise ValueError(f"{path}: outline of row {row} is {_show(value)}, expected a list of points [x, y, z]")
    require_within("polygon_points", len(value), f"{path}: outline of row {row}")
    for k, point in enumerate(value):
        if type(point) is not list or len(point) != 3 or not _are_all_numbers(point, MAX_COORDINATE_M):
            raise ValueError(
                f"{path}: point {k} of the outline of row {row} is {_show(point)}, expected [x, y, z] in metres"
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
