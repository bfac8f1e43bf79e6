"""Tests of table validation: damaged values, misaligned tables, limits, page checksums and decompression bombs."""

import re
import subprocess
import sys
import textwrap

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from helpers import random_scene

from pipelines.runtime import storage
from pipelines.schema.conversion import make_scene_tables
from pipelines.schema.tables import Shard, find_shards
from pipelines.schema.validation import validate_shard, validate_table

TABLES = ("scenes", "primitives", "rasters")


@pytest.fixture(scope="module")
def tables() -> dict[str, pa.Table]:
    return make_scene_tables([random_scene(k, n=20) for k in range(3)])


def write_tables(root, tables) -> Shard:
    shard = Shard(str(root), "town", "train", 0)
    for name in TABLES:
        storage.write_parquet(tables[name], shard.path(name))
    return shard


def replace_value(table: pa.Table, column: str, row: int, value) -> pa.Table:
    values = table[column].to_pylist()
    values[row] = value(values[row]) if callable(value) else value
    index = table.schema.get_field_index(column)
    return table.set_column(index, table.schema.field(column), pa.array(values, table.schema.field(column).type))


FLIPPED = [1.0, 0, 0, 0, 1, 0, 0, 0, -1]
DAMAGES = [
    ("scenes", "scene_id", 1, None, "expected a value"),
    ("scenes", "scene_id", 1, "", "expected an id that is not empty"),
    ("scenes", "scene_id", 1, "x" * 2000, "at most 1,000 are accepted"),
    ("scenes", "frame", 0, None, "expected a value"),
    ("scenes", "x_m", 2, float("nan"), "nan, expected a finite number"),
    ("scenes", "yaw_rad", 2, float("inf"), "inf, expected a finite number"),
    ("scenes", "world_from_imu", 2, [1.0] * 11, "expected 12 numbers or null"),
    ("scenes", "world_from_imu", 2, [1.0] * 11 + [float("inf")], "expected 12 finite numbers or null"),
    ("scenes", "world_from_imu", 2, [1.0] * 11 + [None], "expected 12 finite numbers or null"),
    ("scenes", "vegetation_density", 1, "dense", "expected one of low, medium, high"),
    ("scenes", "road_area_m2", 1, -1.0, "expected a finite number of at least 0, or null"),
    ("scenes", "num_primitives", 1, -1, "expected a finite number of at least 0"),
    ("scenes", "num_primitives", 1, 300_000, "300,000 primitives of a scene; at most 200,000"),
    ("scenes", "num_pole", 1, lambda count: count + 1, "but the primitives table holds"),
    ("scenes", "primitive_offset", 2, 41, "41, expected 40"),
    ("scenes", "primitive_offset", 2, 10**12, "expected 40"),
    ("primitives", "scene_id", 20, None, "expected a value"),
    ("primitives", "scene_id", 20, "another", "but this row belongs to scene"),
    ("primitives", "category", 7, "unicorn", "'unicorn', expected one of"),
    ("primitives", "category", 7, None, "expected one of"),
    ("primitives", "kind", 7, "sphere", "expected one of cuboid, ellipsoid"),
    ("primitives", "label", 7, None, "expected a value"),
    ("primitives", "x_m", 59, float("nan"), "within 1,000,000 m"),
    ("primitives", "z_m", 59, 1e9, "within 1,000,000 m"),
    ("primitives", "width_m", 59, 0.0, "a positive size"),
    ("primitives", "width_m", 59, -2.0, "a positive size"),
    ("primitives", "heading_rad", 3, 7.0, "an angle"),
    ("primitives", "rotation", 3, [1.0] * 9, "orthonormal"),
    ("primitives", "rotation", 3, FLIPPED, "right-handed"),
    ("primitives", "rotation", 3, [1.0] * 8 + [None], "expected 9 numbers"),
    ("primitives", "cholesky", 3, [float("nan")] * 6, "6 finite numbers"),
    ("primitives", "existence", 3, 1.5, "probability"),
    ("primitives", "existence", 3, None, "expected a value"),
    ("rasters", "scene_id", 1, "another", "are not aligned"),
    ("rasters", "rows", 0, 0, "at least 1"),
    ("rasters", "rows", 0, 60_000, "at most 67,108,864"),
    ("rasters", "cols", 0, lambda cols: cols - 8, "one bit for each class"),
    ("rasters", "resolution_m", 0, 0.0, "positive"),
    ("rasters", "resolution_m", 0, float("nan"), "positive"),
    ("rasters", "height_step_m", 0, float("inf"), "positive"),
    ("rasters", "occupied", 2, b"", "0 bytes, expected"),
    ("rasters", "occupied", 2, lambda mask: mask[:-1], "bytes, expected"),
    ("rasters", "occupied", 2, lambda mask: bytes([mask[0] ^ 1]) + mask[1:], "two bytes for each set bit"),
    ("rasters", "height", 2, lambda height: height[:-2], "two bytes for each set bit"),
    ("rasters", "ground_classes", 2, ["road"] * 5, "one or more distinct names"),
    ("rasters", "ground_classes", 2, ["lava"], "one or more distinct names"),
]


@pytest.mark.parametrize(("table", "column", "row", "value", "message"), DAMAGES)
def test_damaged_value_is_refused_with_file_row_and_column(tables, tmp_path, table, column, row, value, message):
    shard = write_tables(tmp_path, tables | {table: replace_value(tables[table], column, row, value)})
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        shard.scenes([0])
    assert re.search(rf"part-00000\.parquet: .*row {row}\b", str(caught.value))


def test_valid_shard_and_shard_without_primitives_are_accepted(tables, tmp_path):
    assert len(write_tables(tmp_path, tables).scenes()) == 3
    empty = make_scene_tables([random_scene(k, n=0) for k in range(2)])
    assert [len(scene) for scene in write_tables(tmp_path / "empty", empty).scenes()] == [0, 0]


def test_tables_with_other_numbers_of_rows_are_refused(tables, tmp_path):
    for table, message in (("rasters", "row 2, scenes holds .* rasters holds no row"), ("primitives", "59 rows, but")):
        short = tables | {table: tables[table].slice(0, len(tables[table]) - 1)}
        with pytest.raises(ValueError, match=message):
            write_tables(tmp_path / table, short).scenes()
    twice = replace_value(tables["scenes"], "scene_id", 1, tables["scenes"]["scene_id"][0].as_py())
    with pytest.raises(ValueError, match=r"row 1, column 'scene_id': .* an id that no other row has"):
        write_tables(tmp_path / "twice", tables | {"scenes": twice}).read("scenes")


def test_training_refuses_misaligned_primitives(tables, tmp_path):
    from helpers import small_spec

    from pipelines.training.data_loader import LayoutReader

    shard = write_tables(tmp_path, tables | {"scenes": replace_value(tables["scenes"], "primitive_offset", 1, 0)})
    with pytest.raises(
        ValueError, match=r"part-00000\.parquet: scenes, row 1, column 'primitive_offset': 0, expected 20"
    ):
        LayoutReader(small_spec())(shard, np.array([0]))


def test_changed_byte_in_page_is_refused(tables, tmp_path):
    """Page checksums protect values that no rule can check, such as coordinates."""
    shard = write_tables(tmp_path, tables)
    path = shard.path("primitives")
    with open(path, "rb") as stream:
        content = bytearray(stream.read())
    column = next(c for c in map(pq.read_metadata(path).row_group(0).column, range(20)) if c.path_in_schema == "x_m")
    content[column.data_page_offset + column.total_compressed_size - 3] ^= 1
    with open(path, "wb") as stream:
        stream.write(content)
    with pytest.raises(ValueError, match=r"primitives.*part-00000\.parquet: cannot be read as Parquet"):
        shard.scenes()


def test_other_files_in_dataset_directory_are_named(tables, tmp_path):
    write_tables(tmp_path, tables)
    storage.write_parquet(tables["scenes"], str(tmp_path / "scenes/x.parquet"))
    with pytest.raises(ValueError, match=r"x\.parquet: expected the name scenes/source="):
        find_shards(str(tmp_path))


def write_bomb(kind: str, path: str) -> None:
    made = {
        # One text of 1 MB in a dictionary, repeated in each row.
        "text": lambda: pa.DictionaryArray.from_arrays(np.zeros(4_000, np.int32), ["x" * 1_000_000]),
        # Equal numbers compress to almost nothing.
        "rows": lambda: pa.array(np.zeros(30_000_000, np.int8)),
        "list": lambda: pa.array([np.zeros(80_000_000, np.int8)], pa.list_(pa.int8())),
    }[kind]()
    pq.write_table(pa.table({"x": made}), path, compression="zstd", store_schema=False)


def test_small_files_cannot_use_up_memory(tmp_path):
    """A new process reads the files, because the largest memory of a process never decreases."""
    kinds = ("text", "rows", "list")
    for kind in kinds:
        write_bomb(kind, str(tmp_path / kind))
    code = """
        import resource, sys
        from pipelines.runtime import storage
        for path in sys.argv[1:]:
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            try:
                storage.read_parquet(path)
            except ValueError as error:
                print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before, error)
    """
    command = [sys.executable, "-c", textwrap.dedent(code), *(str(tmp_path / kind) for kind in kinds)]
    lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert len(lines) == len(kinds)
    for line in lines:
        kib, message = line.split(" ", 1)
        assert int(kib) < 200_000 and "PRITTI_MAX_TABLE_" in message


def test_unused_unknown_category_of_dictionary_is_accepted(tables):
    category = tables["primitives"]["category"].combine_chunks().dictionary_encode()
    larger = pa.DictionaryArray.from_arrays(
        category.indices, pa.concat_arrays([category.dictionary, pa.array(["lava"])])
    )
    place = tables["primitives"].column_names.index("category")
    primitives = tables["primitives"].set_column(place, "category", larger)
    validate_table("primitives", primitives)
    validate_shard(tables["scenes"], primitives, tables["rasters"])
