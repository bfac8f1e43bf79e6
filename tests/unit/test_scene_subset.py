"""Tests of subsets of scenes: comparison with brute force, special cases, and several worlds."""

import numpy as np
import pyarrow as pa
import pytest
from helpers import random_scene

from pipelines.schema.scene_subset import (
    SceneSubset,
    read_poses,
    select_apart,
    select_balanced,
    select_evenly,
    select_farthest,
    split_halves,
)
from pipelines.schema.tables import Shard


def test_farthest_poses_equal_brute_force():
    rng = np.random.default_rng(0)
    xy, world = rng.uniform(0, 100, (80, 2)), rng.integers(0, 2, 80)
    every = np.where(world[:, None] == world, np.linalg.norm(xy[:, None] - xy, axis=2), np.inf)
    expected = [0]
    while len(expected) < 80:
        nearest = every[expected].min(axis=0)
        nearest[expected] = -1
        expected.append(int(nearest.argmax()))
    assert select_farthest(xy, world, 80).tolist() == expected
    assert select_farthest(xy, world, 7).tolist() == expected[:7]
    assert sorted(select_farthest(np.zeros((5, 2)), np.zeros(5, int), 5)) == [
        0,
        1,
        2,
        3,
        4,
    ]  # all poses have the same position


@pytest.mark.parametrize("apart_m", [0.5, 3.0, 40.0, 1e6])
def test_poses_apart_equal_brute_force(apart_m):
    rng = np.random.default_rng(1)
    xy, world = rng.normal(0, 20, (300, 2)), rng.integers(0, 3, 300)
    expected = []
    for i in range(300):
        if all(world[i] != world[j] or np.hypot(*(xy[i] - xy[j])) >= apart_m for j in expected):
            expected.append(i)
    assert select_apart(xy, world, apart_m).tolist() == expected


@pytest.mark.parametrize("count", range(1, 16))
def test_balanced_subset_has_equal_labels_where_possible(count):
    labels = np.array(["low"] * 2 + ["medium"] * 8 + ["high"] * 5)
    chosen = select_balanced(labels, count)
    assert len(set(chosen.tolist())) == count
    taken = {name: int((labels[chosen] == name).sum()) for name in ("low", "medium", "high")}
    full = {name for name in taken if taken[name] == (labels == name).sum()}
    others = [taken[name] for name in taken if name not in full]
    assert not others or max(taken.values()) - min(others) <= 1


def test_evenly_spreads_indices_over_range():
    assert select_evenly(10, 10).tolist() == list(range(10))
    assert select_evenly(10, 2).tolist() == [2, 7]
    assert len(select_evenly(5, 0)) == 0


def test_worlds_are_shared_by_kitti360_drives_only():
    table = pa.table({"sequence": ["a", "b"], "x_m": [0.0, 1.0], "y_m": [0.0, 0.0]})
    assert len(set(read_poses(table, np.array(["kitti360", "kitti360"]))[1])) == 1
    assert len(set(read_poses(table, np.array(["town", "town"]))[1])) == 2


def test_selection_reads_two_shards(tmp_path):
    scenes = [random_scene(seed) for seed in range(9)]
    Shard(str(tmp_path), "town", "train", 0).write(scenes[:4])
    Shard(str(tmp_path), "town", "train", 1).write(scenes[4:])

    def select_rows(**options) -> list[list[int]]:
        return [r for _, r in SceneSubset(str(tmp_path), "town", "train", **options).shards()]

    assert select_rows() == [[0, 1, 2, 3], [0, 1, 2, 3, 4]]
    assert select_rows(limit=3, pick="first") == [[0, 1, 2]]
    assert sum(map(len, select_rows(limit=3))) == 3
    assert sum(map(len, select_rows(limit=5, pick="farthest"))) == 5
    assert sum(map(len, select_rows(limit=5, pick="balanced"))) == 5
    assert sum(map(len, select_rows(pick="apart", apart_m=1e9))) <= 9
    ids = (scenes[7].scene_id, scenes[1].scene_id, scenes[5].scene_id)
    assert select_rows(ids=ids) == [[1], [1, 3]]
    assert select_rows(ids=ids, limit=1, pick="first") == [[1]]
    with pytest.raises(ValueError, match="no scene 'nobody' among 9 scenes; existing scenes include test-0001, test-"):
        select_rows(ids=(ids[0], "nobody"))
    assert "ids" not in SceneSubset("here").to_record()
    assert SceneSubset("here", ids=ids).to_record()["ids"] == ids


@pytest.mark.parametrize(
    ("options", "message"),
    [({"limit": 0}, "limit is 0"), ({"pick": "all"}, "pick is 'all'"), ({"pick": "apart"}, "apart_m is 0")],
)
def test_selection_rejects_wrong_options(options, message):
    with pytest.raises(ValueError, match=message):
        SceneSubset("nowhere", **options)


def test_halves_show_different_places():
    rng = np.random.default_rng(0)
    drive = np.stack([np.linspace(0, 150, 300), rng.normal(size=300)], axis=1)  # one drive of 150 m
    first, second = split_halves(drive, np.zeros(300, int))
    gaps = np.hypot(*(drive[first][:, None] - drive[second][None]).T)
    assert gaps.min() >= 64 and min(len(first), len(second)) > 70 and not set(first) & set(second)
    first, second = split_halves(drive[:100], np.zeros(100, int))  # 50 m: no place is 64 m away
    assert len(second) == 0 and len(first) > 0
    worlds = np.repeat(np.arange(4), 25)  # four drives in separate worlds: two drives per half
    first, second = split_halves(drive[:100], worlds)
    assert set(worlds[first]) == {0, 1} and set(worlds[second]) == {2, 3} and len(first) == len(second) == 50
