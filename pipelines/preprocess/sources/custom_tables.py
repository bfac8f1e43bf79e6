"""Read a table of an own drive (boxes, polygons or poses) from JSON or Parquet, and check its values.

Errors name file, column, row and value. Memory is limited before values are decoded (models/limits.py).
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as compute
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from models.limits import LimitError, require_within
from models.scene import make_yaw_rotation
from pipelines.preprocess.sources.files import read_json_file
from pipelines.preprocess.sources.input_paths import InputPath, find_local_file
from pipelines.runtime.parquet_sizes import ITEM_BYTES, measure_columns

pc: Any = compute  # The type checker does not know the functions that pyarrow generates.

PLACE = ("x_m", "y_m", "z_m")
QUATERNION = ("qw", "qx", "qy", "qz")
PANDAS_INDEX = "__index_level_0__"  # pandas adds this column automatically.
MAX_COORDINATE_M = 1e7  # Largest valid world coordinate; UTM northings can be this large.
MAX_HEIGHT_M = 1e4
MAX_YAW_RAD = 6.2832  # One full turn in each direction. Larger values are probably in degrees.
MATRIX_ENTRIES = 12  # Number of entries of world_from_ego.
MAX_WHOLE = 2**63 - 1
MAX_EXACT_FLOAT = 2**53
AGAIN = "write it again"


@dataclass(frozen=True)
class DriveTable:
    """The columns of a file as Python values. The methods check every value."""

    path: InputPath
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
                        f"{self.path}: {name} of row {row} is {show_value(value)}, expected a number of"
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
            if not is_whole(value):
                static = "" if missing is None else "; null means that a box is static"
                raise ValueError(
                    f"{self.path}: frame of row {row} is {show_value(value)}, expected a whole number of 0 or more"
                    f"{static}"
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
            if not is_text(value):
                raise ValueError(f"{self.path}: {name} of row {row} is {show_value(value)}, expected a text")
            if allowed and value not in allowed:
                raise ValueError(
                    f"{self.path}: {name} of row {row} is {show_value(value)}, expected one of {', '.join(allowed)};"
                    " map your labels to these"
                )
        return values

    def flags(self, name: str) -> list:
        """Return `rows` values, each True, False or None."""
        values = self._optional(name)
        for row, value in enumerate(values):
            if value is not None and type(value) is not bool:
                raise ValueError(
                    f"{self.path}: {name} of row {row} is {show_value(value)}, expected true, false or null"
                )
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


def read_table(folder: InputPath, name: str, known: Sequence[str], required: Sequence[str]) -> DriveTable:
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
    table = DriveTable(path, rows, filled if rows else {name: [] for name in known})
    table.require(required)
    return table


def _has_values(column: list | pa.ChunkedArray) -> bool:
    if isinstance(column, list):
        return any(value is not None for value in column)
    return column.null_count < len(column)


def _check_names(path: InputPath, names: Sequence[str], known: Sequence[str]) -> None:
    """Raise ValueError if a column is unknown or occurs twice."""
    for name in names:
        if name not in known and name != PANDAS_INDEX:
            meant = difflib.get_close_matches(name[:40], known, 1)
            raise ValueError(
                f"{path}: column {show_value(name)} is unknown{f' (meant {meant[0]}?)' if meant else ''}; drop it,"
                f" or rename it to one of {', '.join(known)}"
            )
    if twice := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"{path}: column {show_value(twice[0])} occurs twice; drop one of them")


def _load_parquet(path: InputPath, known: Sequence[str]) -> tuple[int, dict[str, list | pa.ChunkedArray]]:
    """Read a Parquet file after a check of its columns and of the memory that they need.

    Texts are read as dictionaries, which hold each different text once. The schema and the sizes are those that the
    file states.
    """
    local = find_local_file(path)
    try:
        with open(local, "rb") as stream:
            rows, sizes = measure_columns(stream)
        schema = pq.read_schema(local)
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
    require_within("table_bytes", sum(size.bytes + ITEM_BYTES * size.values for size in sizes), str(path))
    texts = [field.name for field in schema if _is_text_kind(field.type)]
    try:
        with pq.ParquetFile(local, read_dictionary=texts) as file:
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


def _make_parquet_error(path: InputPath, error: Exception) -> ValueError:
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


def _check_column_sizes(path: InputPath, name: str, column: pa.ChunkedArray) -> None:
    """Raise LimitError if a text, a list or all lists of a column are too long for Python objects."""
    for chunk in column.chunks:
        if pa.types.is_dictionary(chunk.type) and len(chunk.dictionary):
            longest = pc.max(pc.utf8_length(chunk.dictionary)).as_py() or 0
            require_within("text_characters", longest, f"{path}: a text in column {name}")
        elif _is_list(chunk.type):
            lengths = pc.list_value_length(chunk)
            longest = pc.max(lengths).as_py() or 0
            require_within(
                "polygon_points", longest, f"{path}: row {pc.index(lengths, longest).as_py()}, column {name}"
            )
            require_within("table_rows", len(chunk.flatten()), f"{path}: column {name}")
            if _is_list(chunk.type.value_type):
                longest = pc.max(pc.list_value_length(chunk.flatten())).as_py() or 0
                if longest > MATRIX_ENTRIES:
                    raise ValueError(f"column {name} has a point of {longest} numbers")


def _load_records(path: InputPath, known: Sequence[str]) -> tuple[int, dict[str, list | pa.ChunkedArray]]:
    records = read_json_file(path, AGAIN)
    if not isinstance(records, list):
        raise ValueError(f"{path} holds a {type(records).__name__}, expected a list of objects, one per row")
    require_within("table_rows", len(records), str(path))
    for row, record in enumerate(records):
        if not isinstance(record, dict):
            raise ValueError(f"{path}: row {row} is {show_value(record)}, expected an object of columns")
    names = list(dict.fromkeys(name for record in records for name in record))
    _check_names(path, names, known)
    return len(records), {name: [record.get(name) for record in records] for name in names}


def show_value(value: object) -> str:
    """Return a value as text for an error message, at most 40 characters."""
    if value is None:
        return "null"
    # Python cannot convert an integer with thousands of digits to text.
    try:
        shown = repr(value) if type(value) is not int or abs(value) < 10**40 else "an integer of more than 40 digits"
    except (ValueError, RecursionError):  # A nested integer has too many digits, or the nesting is too deep.
        return f"a {type(value).__name__}"
    return shown if len(shown) <= 40 else f"{shown[:37]}..."


def is_text(value: object) -> bool:
    """Return whether a value is a str that files can store.

    JSON escapes can produce a single half of a surrogate pair. Files cannot store such a half.
    """
    return type(value) is str and (value.isascii() or not any("\ud800" <= letter <= "\udfff" for letter in value))


def is_whole(value: object) -> bool:
    """Return whether a value is an integer of at least 0.

    Floats such as 3.0 count as integers, because pandas stores the integers of a column with nulls as floats.
    """
    return (type(value) is int or type(value) is float) and 0 <= value <= MAX_WHOLE and value == value // 1
