"""Validate the tables of a shard: each table on its own, and the tables against each other.

Readers validate before they build scenes, so a damaged or hostile file cannot produce wrong scenes or use up the
memory. A table is valid in full, or an error names the row and the column, or the tables
that disagree.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as compute

from models.limits import find_limit, require_within
from models.scene import CATEGORIES, CATEGORY_INDEX, GROUND_CLASSES

pc: Any = compute  # The type checker does not know the functions that pyarrow generates.

MAX_COORDINATE_M = 1e6  # Largest accepted coordinate of a primitive and largest accepted size (m).
# Largest accepted |x|^2 - 1, |y|^2 - 1, x y and entry of x × y - z, for the columns x, y and z of a rotation.
ORTHONORMAL_TOLERANCE = 1e-3
DENSITIES = ("low", "medium", "high")
KINDS = ("cuboid", "ellipsoid")


def _refuse(table: pa.Table, name: str, bad: Any, expected: str) -> None:
    """Raise an error for the first row for which `bad` (n,) is True, if there is one."""
    if bad.any():
        row = int(np.argmax(bad))
        value = repr(table[name][row].as_py())
        shown = value if len(value) <= 80 else f"{value[:77]}..."
        raise ValueError(f"row {row}, column {name!r}: {shown}, expected {expected}")


def _require_present(table: pa.Table, name: str) -> None:
    if table[name].null_count:
        _refuse(table, name, table[name].is_null().to_numpy(), "a value")


def _require_numbers(
    table: pa.Table, name: str, low: float, high: float, expected: str, is_optional: bool = False
) -> None:
    """Require finite numbers in [low, high]; an optional column may be null."""
    column = table[name]
    if not is_optional:
        _require_present(table, name)
    elif column.null_count:
        column = column.fill_null(low if np.isfinite(low) else 0)
    values = column.to_numpy()
    if len(values) == 0:
        return
    least, most = float(values.min()), float(values.max())  # NaN if any value is NaN.
    if not (low <= least <= most <= high and math.isfinite(least) and math.isfinite(most)):
        with np.errstate(invalid="ignore"):
            _refuse(table, name, ~((values >= low) & (values <= high) & np.isfinite(values)), expected)


def encode_texts(column: pa.ChunkedArray) -> tuple[pa.Array, np.ndarray]:
    """Encode the texts of a column as indices.

    Args:
        column: (n,) texts, plain or with dictionary encoding.

    Returns:
        The different texts, and (n,) the index of the text of each row; -1 is null.
    """
    if not pa.types.is_dictionary(column.type):
        column = column.dictionary_encode()
    array: Any = column.combine_chunks()
    index = array.indices
    if index.null_count:
        index = index.fill_null(-1)
    return array.dictionary, index.to_numpy()


def _require_texts(table: pa.Table, name: str) -> None:
    _require_present(table, name)
    _require_short_texts(table, name)


def _require_optional_texts(table: pa.Table, name: str) -> None:
    if table[name].null_count < len(table):
        _require_short_texts(pa.table({name: pc.fill_null(table[name], "")}), name)


def _require_short_texts(table: pa.Table, name: str) -> None:
    texts, index = encode_texts(table[name])
    limit = find_limit("text_characters")
    if (pc.max(pc.binary_length(texts)).as_py() or 0) <= limit:  # A letter has at least one byte.
        return
    letters = pc.utf8_length(texts).to_numpy()[index]
    if letters.max() > limit:
        require_within("text_characters", int(letters.max()), f"row {int(letters.argmax())}, column {name!r}")


def _require_choice(table: pa.Table, name: str, choices: Sequence[str], is_optional: bool = False) -> None:
    texts, index = encode_texts(table[name])
    known = np.array([text in choices for text in texts.to_pylist()] + [is_optional])[index]
    if not known.all():
        _refuse(table, name, ~known, f"one of {', '.join(choices)}")


def _read_lists(table: pa.Table, name: str, width: int) -> np.ndarray:
    """Return a column of fixed-size lists as (n, width). Raises ValueError for a null list or a null entry."""
    _require_present(table, name)
    column = table[name].combine_chunks()
    if isinstance(column, pa.ChunkedArray):
        column = pa.concat_arrays(column.chunks) if column.num_chunks else pa.array([], table.schema.field(name).type)
    flat = column.flatten()
    if flat.null_count:
        bad = np.isnan(flat.to_numpy(zero_copy_only=False).reshape(-1, width)).any(axis=1)
        _refuse(table, name, bad, f"{width} numbers")
    return flat.to_numpy().reshape(-1, width)


def _validate_scene_ids(table: pa.Table, name: str) -> None:
    _require_texts(table, name)
    names, seen = table[name].to_pylist(), set()
    if "" in names:
        _refuse(table, name, np.array([n == "" for n in names]), "an id that is not empty")
    if len(set(names)) != len(names):
        _refuse(
            table, name, np.array([n in seen or seen.add(n) is not None for n in names]), "an id that no other row has"
        )


def _validate_poses(table: pa.Table, name: str) -> None:
    column = table[name]
    if column.null_count == len(column):
        return
    length = pc.fill_null(pc.list_value_length(column), 12).to_numpy()
    _refuse(table, name, length != 12, "12 numbers or null")
    flat = pc.list_flatten(column)
    values = flat.to_numpy(zero_copy_only=False).reshape(-1, 12)
    if flat.null_count or not np.isfinite(values).all():
        bad = np.zeros(len(table), bool)
        bad[column.is_valid().to_numpy()] = ~np.isfinite(values.astype(float)).all(axis=1)
        _refuse(table, name, bad, "12 finite numbers or null")


def _validate_rotations(table: pa.Table, name: str) -> None:
    entry = np.ascontiguousarray(_read_lists(table, name, 9).T)  # Long rows are several times faster than 3 x 3 blocks.
    x, y, z = (entry[[k, k + 3, k + 6]] for k in range(3))  # Columns of the matrices, (3, n) each.
    worst = np.zeros(len(table), np.float32)
    with np.errstate(invalid="ignore", over="ignore"):
        for a, b, wanted in ((x, x, 1), (y, y, 1), (x, y, 0)):
            np.maximum(worst, np.abs(a[0] * b[0] + a[1] * b[1] + a[2] * b[2] - wanted), out=worst)
        for k in range(3):  # In a right-handed system, z is the cross product of x and y.
            np.maximum(worst, np.abs(x[k - 2] * y[k - 1] - x[k - 1] * y[k - 2] - z[k]), out=worst)
        bad = ~(worst <= ORTHONORMAL_TOLERANCE)
    _refuse(table, name, bad, "an orthonormal, right-handed matrix")


def _validate_choleskys(table: pa.Table, name: str) -> None:
    values = _read_lists(table, name, 6)
    if not np.isfinite(values).all():
        _refuse(table, name, ~np.isfinite(values).all(axis=1), "6 finite numbers")


def _validate_tensors(table: pa.Table, name: str) -> None:
    _require_present(table, name)
    for row, values in enumerate(table[name].combine_chunks().to_numpy_ndarray() if len(table) else ()):
        if not np.isfinite(values).all():
            raise ValueError(f"row {row}, column {name!r}: NaN or infinite values")


def _validate_classes(table: pa.Table, name: str) -> None:
    _require_present(table, name)
    for row, classes in enumerate(table[name].to_pylist()):
        if not classes or len(set(classes)) != len(classes) or not set(classes) <= set(GROUND_CLASSES):
            names = ", ".join(GROUND_CLASSES)
            _refuse(table, name, np.arange(len(table)) == row, f"one or more distinct names out of {names}")


def _make_number_rule(low: float, high: float, expected: str, is_optional: bool = False) -> Callable:
    return lambda table, name: _require_numbers(table, name, low, high, expected, is_optional)


def _make_choice_rule(choices: Sequence[str], is_optional: bool = False) -> Callable:
    return lambda table, name: _require_choice(table, name, choices, is_optional)


_FINITE = _make_number_rule(-np.inf, np.inf, "a finite number")
_COUNT = _make_number_rule(0, np.inf, "a finite number of at least 0")
_AREA = _make_number_rule(0, np.inf, "a finite number of at least 0, or null", is_optional=True)
_NEAR = _make_number_rule(-MAX_COORDINATE_M, MAX_COORDINATE_M, f"a coordinate within {MAX_COORDINATE_M:,.0f} m")
_SIZE = _make_number_rule(
    float(np.finfo(np.float32).tiny), MAX_COORDINATE_M, f"a positive size of at most {MAX_COORDINATE_M:,.0f} m"
)
_ANGLE = _make_number_rule(-3.1416, 3.1416, "an angle in [-pi, pi]")
_HEADING = _make_number_rule(-3.1416, 3.1416, "an angle in [-pi, pi], or null", is_optional=True)
_POSITIVE = _make_number_rule(
    float(np.finfo(np.float64).tiny), MAX_COORDINATE_M, f"a positive number of at most {MAX_COORDINATE_M:,.0f}"
)

# For each table, the rule of each column.
RULES: Mapping[str, Mapping[str, Callable[[pa.Table, str], None]]] = {
    "scenes": {
        "scene_id": _validate_scene_ids,
        "sequence": _require_texts,
        "frame": _require_present,
        **dict.fromkeys(("x_m", "y_m", "z_m", "yaw_rad"), _FINITE),
        "world_from_imu": _validate_poses,
        "free_pose": _require_present,
        "attribution": _require_optional_texts,
        **dict.fromkeys(("vegetation_density", "vehicle_density"), _make_choice_rule(DENSITIES, is_optional=True)),
        **dict.fromkeys(("vegetation_volume_m3", "vehicle_volume_m3"), _COUNT),
        **dict.fromkeys(("num_primitives", *(f"num_{name}" for name in CATEGORIES), "primitive_offset"), _COUNT),
        **dict.fromkeys([f"{name}_area_m2" for name in GROUND_CLASSES], _AREA),
    },
    "primitives": {
        "scene_id": _require_present,
        "category": _make_choice_rule(CATEGORIES),
        "label": _require_texts,
        "kind": _make_choice_rule(KINDS),
        "instance_id": _require_present,
        **dict.fromkeys(("x_m", "y_m", "z_m"), _NEAR),
        **dict.fromkeys(("length_m", "width_m", "height_m"), _SIZE),
        "yaw_rad": _ANGLE,
        "heading_rad": _HEADING,
        "rotation": _validate_rotations,
        "cholesky": _validate_choleskys,
        "existence": _make_number_rule(0, 1, "a probability in [0, 1]"),
    },
    "rasters": {
        "scene_id": _require_present,
        **dict.fromkeys(("height", "occupied"), _require_present),
        **dict.fromkeys(("resolution_m", "height_step_m"), _POSITIVE),
        **dict.fromkeys(("rows", "cols"), _make_number_rule(1, np.inf, "a finite number of at least 1")),
        **dict.fromkeys(("front_m", "left_m"), _NEAR),
        "ground_classes": _validate_classes,
    },
    "voxels": {
        "scene_id": _require_present,
        **dict.fromkeys(("rows", "cols", "levels"), _make_number_rule(1, np.inf, "a finite number of at least 1")),
        **dict.fromkeys(("resolution_m", "level_m"), _POSITIVE),
        **dict.fromkeys(("front_m", "left_m", "bottom_m"), _NEAR),
        "voxels": _require_present,
    },
    "latents": {"scene_id": _require_present, "mean": _validate_tensors, "logvar": _validate_tensors},
    "street_latents": {"scene_id": _require_present, "ground": _validate_tensors},
    "street_maps": {"map_id": _require_present, "distance_m": _validate_tensors},
}


def validate_table(kind: str, table: pa.Table) -> None:
    """Validate the columns of a table that are present.

    Args:
        kind: Name of the table: scenes, primitives, rasters, voxels, latents, street_latents or street_maps; other
            tables have no rules.
        table: Rows of one file; the columns have the types of the schema.

    Raises:
        ValueError: A value is missing, not finite, out of its range or beyond a limit. The message names the row and
            the column.
    """
    rules = RULES.get(kind, {})
    for name in table.column_names:
        if name in rules:
            rules[name](table, name)
    if kind == "scenes" and "num_primitives" in table.column_names and len(table):
        most = table["num_primitives"].to_numpy()
        require_within("scene_primitives", int(most.max()), f"row {int(most.argmax())}, column 'num_primitives'")
    if kind == "voxels" and {"rows", "cols", "levels"} <= set(table.column_names) and len(table):
        voxels = np.prod([table[name].to_numpy().astype(float) for name in ("rows", "cols", "levels")], axis=0)
        require_within("scene_voxels", voxels.max(), f"row {int(voxels.argmax())}, columns 'rows', 'cols' and 'levels'")
    if kind == "rasters" and {"height", "occupied", "rows", "cols", "ground_classes"} <= set(table.column_names):
        _validate_rasters(table)


def _validate_rasters(table: pa.Table) -> None:
    """Compare the sizes of the masks and of the heights with the grid. No mask is unpacked."""
    pixels = table["rows"].to_numpy().astype(np.int64) * table["cols"].to_numpy()
    pixels = pixels * pc.list_value_length(table["ground_classes"]).to_numpy()
    if len(pixels):
        require_within("raster_pixels", int(pixels.max()), f"row {int(pixels.argmax())}, columns 'rows' and 'cols'")
    bits = pc.binary_length(table["occupied"]).to_numpy()
    _refuse_length(table, "occupied", bits, -(-pixels // 8), "one bit for each class, row and column")
    occupied, last = _count_bits(table["occupied"])
    padding = (1 << (-pixels % 8)) - 1  # Bits after the last pixel.
    _refuse(table, "occupied", last & padding != 0, "no set bits after the last pixel")
    heights = pc.binary_length(table["height"]).to_numpy()
    _refuse_length(table, "height", heights, 2 * occupied, "two bytes for each set bit of `occupied`")


def _count_bits(column: pa.ChunkedArray) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of set bits and the last byte of each row of a binary column without nulls or empty rows."""
    counts, last = [np.zeros(0, np.int64)], [np.zeros(0, np.uint8)]
    for chunk in (chunk for chunk in column.chunks if len(chunk)):
        _, positions, values = chunk.buffers()
        ends = np.frombuffer(positions, np.int32)[chunk.offset : chunk.offset + len(chunk) + 1]
        content = np.frombuffer(values, np.uint8)[ends[0] : ends[-1]]
        ends = ends - ends[0]
        words, step = (content, 1) if (ends % 8).any() else (content.view(np.uint64), 8)
        counts.append(np.add.reduceat(np.bitwise_count(words), ends[:-1] // step, dtype=np.int64))
        last.append(content[ends[1:] - 1])
    return np.concatenate(counts), np.concatenate(last)


def _refuse_length(table: pa.Table, name: str, got: np.ndarray, wanted: np.ndarray, meaning: str) -> None:
    if (bad := got != wanted).any():
        row = int(np.argmax(bad))
        raise ValueError(f"row {row}, column {name!r}: {got[row]:,} bytes, expected {wanted[row]:,} ({meaning})")


def validate_shard(scenes: pa.Table, primitives: pa.Table, rasters: pa.Table | None = None) -> None:
    """Validate that the tables of a shard hold the same scenes, and each primitive in its scene.

    Args:
        scenes: Valid rows with the columns scene_id, num_primitives and primitive_offset.
        primitives: Valid rows of the table `primitives`.
        rasters: Valid rows of the table `rasters`. None: not compared.

    Raises:
        ValueError: The tables are not aligned. The message names the table, the row and the column.
    """
    if rasters is not None:
        same = len(scenes) == len(rasters) and pc.equal(scenes["scene_id"], rasters["scene_id"]).to_numpy()
        if not np.all(same):
            row = int(np.argmin(same)) if len(scenes) == len(rasters) else min(len(scenes), len(rasters))
            names = [t["scene_id"][row].as_py() if row < len(t) else "no row" for t in (scenes, rasters)]
            raise ValueError(
                f"the tables of the shard are not aligned: in row {row}, scenes holds {names[0]} but rasters holds"
                f" {names[1]}"
            )
    counts, offsets = (scenes[name].to_numpy().astype(np.int64) for name in ("num_primitives", "primitive_offset"))
    ends = np.cumsum(counts)
    if (bad := offsets != ends - counts).any():
        row = int(np.argmax(bad))
        raise ValueError(
            f"scenes, row {row}, column 'primitive_offset': {offsets[row]}, expected {ends[row] - counts[row]}, the"
            " number of primitives of the scenes before it; this value or an earlier num_primitives is wrong"
        )
    if (total := int(ends[-1]) if len(ends) else 0) != len(primitives):
        raise ValueError(f"primitives has {len(primitives)} rows, but the scenes of the shard have {total} primitives")
    owner = np.repeat(np.arange(len(scenes)), counts)
    if "scene_id" in primitives.column_names:
        texts, index = encode_texts(primitives["scene_id"])
        place = {text: row for row, text in enumerate(scenes["scene_id"].to_pylist())}
        same = np.array([place.get(text, -1) for text in [*texts.to_pylist(), None]])[index] == owner
        if not same.all():
            row = int(np.argmin(same))
            raise ValueError(
                f"primitives, row {row}, column 'scene_id': {primitives['scene_id'][row].as_py()!r}, but this row"
                f" belongs to scene {scenes['scene_id'][int(owner[row])].as_py()!r}"
            )
    columns = set(scenes.column_names)
    named = [name for name in CATEGORIES if f"num_{name}" in columns]
    if named and "category" in primitives.column_names:
        texts, index = encode_texts(primitives["category"])
        # A dictionary may hold unknown texts that no row uses.
        category = np.array([CATEGORY_INDEX.get(text, 0) for text in [*texts.to_pylist(), None]])[index]
        found = np.bincount(owner * len(CATEGORIES) + category, minlength=len(scenes) * len(CATEGORIES))
        found = found.reshape(-1, len(CATEGORIES))[:, [CATEGORY_INDEX[name] for name in named]]
        stated = np.stack([scenes[f"num_{name}"].to_numpy() for name in named], axis=1)
        if (bad := stated != found).any():
            row, k = (int(at[0]) for at in np.nonzero(bad))
            raise ValueError(
                f"scenes, row {row}, column 'num_{named[k]}': {stated[row, k]}, but the primitives table holds"
                f" {found[row, k]} of this category"
            )
