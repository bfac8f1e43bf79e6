"""Tests of jobs/edit_scenes.py on Ray."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from helpers import assert_same_primitives

from models.scene import Scene
from pipelines.schema.tables import Shard, read_scenes


@pytest.fixture(scope="module")
def town_scenes(town_drive_3) -> list[Scene]:
    return [town_drive_3.scene(k, split) for k, split in ((0, "train"), (20, "train"), (40, "test"), (60, "test"))]


@pytest.fixture(scope="module")
def table(town_scenes, tmp_path_factory) -> str:
    root = str(tmp_path_factory.mktemp("town"))
    Shard(root, "town", "train", 0).write(town_scenes[:2])
    Shard(root, "town", "test", 0).write(town_scenes[2:])
    return root


def test_edit_job_edits_table_and_replays(table, town_scenes, tmp_path, cluster):
    from jobs.edit_scenes import Remove, Replay
    from jobs.implementation.edit_scenes import edit_scenes

    options = {"input": table, "output": str(tmp_path / "out"), "run": "bare"}
    trees = Remove(category=("vegetation_ellipsoid", "vegetation_cuboid"), **options)
    made = edit_scenes(trees)
    edited = {scene.scene_id: scene for scene in read_scenes(options["output"], "edited-bare")}
    assert (made.scenes, made.rejects, len(edited)) == (4, 0, 4)
    gone = 0
    for scene in town_scenes:
        keep = ~np.isin(scene.category, [0, 1])
        gone += (~keep).sum()
        got = edited[scene.scene_id]
        assert_same_primitives(got, scene.select(keep))
        assert got.split == scene.split and np.array_equal(got.occupied, scene.occupied)
    assert gone and made.table.rows == [(0, "remove", "removed", 4, gone, 0, 0, 0)]
    assert "data:image/png" in (tmp_path / "out" / "bare.html").read_text()
    rows = pq.read_table(str(tmp_path / "out" / "edits"), partitioning=None).to_pylist()
    assert len(rows) == gone and {(row["edit"], row["change"]) for row in rows} == {("remove", "removed")}

    part = next((tmp_path / "out" / "scenes" / "source=edited-bare" / "split=test").glob("*.parquet"))
    written = part.stat().st_mtime_ns
    assert edit_scenes(trees) == made and part.stat().st_mtime_ns == written  # a second run writes no file
    for table_name in ("primitives", "rasters"):  # It writes a damaged shard again.
        lost = Path(str(part).replace("/out/scenes/", f"/out/{table_name}/"))
        whole = pq.read_table(lost, partitioning=None)
        lost.write_bytes(lost.read_bytes()[:-50])
        assert edit_scenes(trees) == made and pq.read_table(lost, partitioning=None).equals(whole)
    with pytest.raises(ValueError, match="holds a run 'bare' with other edits; choose another --run"):
        edit_scenes(Remove(category=("pole",), **options))

    record = str(tmp_path / "out" / "edited-bare.json")
    again = edit_scenes(Replay(edits=record, **options | {"output": str(tmp_path / "again"), "num_examples": 0}))
    assert again.table.rows == made.table.rows
    for scene in read_scenes(str(tmp_path / "again"), "edited-bare"):
        assert_same_primitives(scene, edited[scene.scene_id])


def test_edit_job_rejects_bad_scene_and_edits_other_scenes(table, town_scenes, tmp_path, cluster):
    from jobs.edit_scenes import Remove
    from jobs.implementation.edit_scenes import edit_scenes

    last = max(len(scene) for scene in town_scenes) - 1
    fits = sum(len(scene) > last for scene in town_scenes)
    assert 0 < fits < len(town_scenes)
    made = edit_scenes(Remove(primitives=(last,), input=table, output=str(tmp_path), num_examples=0))
    assert (made.scenes, made.rejects) == (fits, 4 - fits)
    rejects = pq.read_table(str(tmp_path / "rejects"), partitioning=None).to_pylist()
    assert {row["scene_id"] for row in rejects} == {s.scene_id for s in town_scenes if len(s) <= last}
    assert all("primitives, numbered from 0; got" in row["reason"] for row in rejects)
    with pytest.raises(ValueError, match="all 4 scenes were rejected; the first: edit 0"):
        edit_scenes(Remove(primitives=(9999,), input=table, output=str(tmp_path), run="none"))
    with pytest.raises(ValueError, match="no primitive in 4 scene"):
        edit_scenes(Remove(where="length_m > 900", input=table, output=str(tmp_path), run="nothing"))
