"""Tests of tables: scenes are the same after writing and reading, and DuckDB can query the files."""

import os
import time

import duckdb
import numpy as np
import pyarrow.parquet as pq
import pytest
from helpers import random_scene

from models.scene import Grid
from pipelines.runtime import storage
from pipelines.runtime.machines import identify_machine
from pipelines.schema.columns import HEIGHT_STEP_M, PRIMITIVES, SCENES
from pipelines.schema.tables import Shard, find_shards, read_scenes


def assert_same(a, b):
    assert (a.scene_id, a.source, a.split, a.sequence, a.frame) == (b.scene_id, b.source, b.split, b.sequence, b.frame)
    for name in ("category", "center_m", "rotation", "size_m", "existence", "instance_id", "label", "occupied"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    assert np.array_equal(a.heading_rad, b.heading_rad, equal_nan=True)
    assert np.abs(a.height_m - b.height_m).max() <= HEIGHT_STEP_M / 2 + 1e-5
    assert a.grid == b.grid and a.ground_classes == b.ground_classes
    assert (a.vegetation_density, a.vehicle_density) == (b.vegetation_density, b.vehicle_density)
    assert a.world_xyz_m == b.world_xyz_m and a.world_yaw_rad == b.world_yaw_rad


@pytest.fixture
def scenes():
    heading = np.where(np.arange(40) % 2, 0.5, np.nan).astype(np.float32)
    return [
        random_scene(0, heading_rad=heading, vegetation_density="low", world_xyz_m=(1e6, 2.0, 3.0)),
        random_scene(1, n=0),
        random_scene(2, n=900, category=np.full(900, 4, np.int8), world_from_imu=np.arange(12.0).reshape(3, 4)),
        random_scene(3, grid=Grid(front_m=96, left_m=64, rows=512, cols=512)),
    ]


def test_shard_round_trips_scenes(tmp_path, scenes):
    shard = Shard(str(tmp_path), "town", "train", 7)
    shard.write(scenes)
    back = list(read_scenes(str(tmp_path)))
    for a, b in zip(scenes, back, strict=True):
        assert_same(a, b)
    assert np.array_equal(back[2].world_from_imu, np.arange(12.0).reshape(3, 4)) and back[0].world_from_imu is None
    for row, scene in zip((3, 0), shard.scenes(rows=[3, 0]), strict=True):
        assert_same(scenes[row], scene)
    assert pq.read_schema(shard.path("scenes")).equals(SCENES) and pq.read_schema(shard.path("primitives")).equals(
        PRIMITIVES
    )
    assert not [p for p in tmp_path.rglob("*") if p.name.startswith(storage.TEMPORARY)]


def test_one_scene_does_not_keep_shard_in_memory(tmp_path, scenes):
    shard = Shard(str(tmp_path), "town", "train", 0)
    shard.write(scenes)
    scene = shard.scenes(rows=[0])[0]
    for array in (scene.center_m, scene.size_m, scene.rotation, scene.label, scene.instance_id, scene.existence):
        owner = array
        while isinstance(owner.base, np.ndarray):
            owner = owner.base
        held = owner.nbytes if owner.base is None else owner.base.get_total_buffer_size()
        assert held <= 2 * array.nbytes


def test_shard_round_trips_empty_scenes(tmp_path):
    shard = Shard(str(tmp_path), "town", "test", 0)
    shard.write([random_scene(0, n=0, split="test")])
    assert len(shard.scenes()[0]) == 0


def test_shard_is_queryable_by_duckdb(tmp_path, scenes):
    Shard(str(tmp_path), "town", "train", 0).write(scenes)
    query = f"select category, count(*), avg(length_m) from '{tmp_path}/primitives/**/*.parquet' group by 1"
    rows = {category: (count, length) for category, count, length in duckdb.sql(query).fetchall()}
    assert rows["two_wheelers"][0] == sum((s.category == 4).sum() for s in scenes)
    assert np.isclose(rows["two_wheelers"][1], np.concatenate([s.size_m[s.category == 4, 0] for s in scenes]).mean())
    table = f"'{tmp_path}/scenes/**/*.parquet'"
    joined = duckdb.sql(f"select distinct source, split, crossing_area_m2 from {table}").fetchall()
    assert joined == [("town", "train", None)]
    road = duckdb.sql(f"select road_area_m2 from {table} where scene_id = 'test-0000'").fetchall()[0][0]
    assert np.isclose(road, scenes[0].ground_area_m2()[0])
    canonical = duckdb.sql(
        f"select min(length_m - width_m), min(yaw_rad), max(yaw_rad) from '{tmp_path}/primitives/**/*.parquet'"
    )
    gap, low, high = canonical.fetchall()[0]
    assert gap >= 0 and low >= -np.pi / 2 - 1e-6 and high < np.pi / 2


def test_shard_names_truncated_and_missing_files(tmp_path, scenes):
    with pytest.raises(ValueError, match="scenes holds no scenes; pass a directory"):
        find_shards(str(tmp_path), source="av2")
    shard = Shard(str(tmp_path), "town", "train", 0)
    shard.write(scenes)
    with pytest.raises(ValueError, match="holds no source=av2; it holds source=town/split=train"):
        find_shards(str(tmp_path), source="av2")
    path = tmp_path / "rasters/source=town/split=train/part-00000.parquet"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"part-00000.parquet: cannot be read as Parquet"):
        shard.scenes()
    path.unlink()
    with pytest.raises(ValueError, match=r"rasters.*part-00000.parquet"):
        shard.scenes()


def test_shard_write_is_atomic(tmp_path):
    target = str(tmp_path / "a" / "b.json")

    def fail_during_write(stream):
        stream.write(b"{")
        raise RuntimeError("disk full")

    with pytest.raises(RuntimeError):
        storage.write_whole(target, fail_during_write)
    assert list((tmp_path / "a").iterdir()) == []
    storage.write_json({"a": 1}, target)
    assert storage.read_json(target) == {"a": 1}
    for process in (os.getpid(), 2**31 - 1):
        (tmp_path / "a" / f"{storage.TEMPORARY}x-{identify_machine()}-{process}-0").write_text("")
    other, old = (tmp_path / "a" / f"{storage.TEMPORARY}x-{'0' * 12}-1-{age}" for age in ("new", "old"))
    other.write_text("")
    old.write_text("")
    os.utime(old, (time.time() - 2 * storage.ABANDONED_S,) * 2)
    assert storage.clean_temporaries(str(tmp_path)) == 2  # of an ended process and the old one of another machine
    assert other.exists() and len(list((tmp_path / "a").iterdir())) == 3
    (tmp_path / "a" / "b.json").write_text("{")
    with pytest.raises(ValueError, match=r"b.json: cannot be read as JSON"):
        storage.read_json(target)


def test_writer_does_not_follow_planted_link(tmp_path):
    """Earlier versions used a temporary name that another user of a shared directory could predict."""
    victim = tmp_path / "victim"
    victim.write_text("kept")
    (tmp_path / f"{storage.TEMPORARY}a.txt-{os.getpid()}").symlink_to(victim)
    storage.write_text("new", str(tmp_path / "a.txt"))
    assert victim.read_text() == "kept" and (tmp_path / "a.txt").read_text() == "new"
    assert not (tmp_path / "a.txt").is_symlink()
