"""Edits: exact on the parameters, the same on every replay, and over a whole table."""

import json
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from scenes import random_scene

from models.geometry.iou3d import boxes_of, iou3d_matrix
from models.scene import CATEGORIES, CATEGORY_INDEX, ELLIPSOID, PER_PRIMITIVE, Scene, canonical_boxes
from pipelines.editing import edit
from pipelines.editing.edit import Select, edits_from_json, edits_to_json, replayed
from pipelines.io.mesh_export import scene_triangles
from pipelines.metrics.validity import SLAB_OFFSET_M, faults, scene_validity, validity_rates
from pipelines.preprocess.sources.town.generator import town_drive
from pipelines.schema.tables import Shard, read_scenes

CAR = CATEGORY_INDEX["vehicle_small"]
SIGNS = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T
ALL = Select(where="true")


@pytest.fixture
def scene() -> Scene:
    heading = np.linspace(-3, 3, 60).astype(np.float32)
    heading[::4] = np.nan
    return random_scene(5, 60, heading_rad=heading, instance_id=np.arange(60, dtype=np.int64) // 2)


@pytest.fixture(scope="module")
def town_scenes() -> list[Scene]:
    drive = town_drive(3)
    return [drive.scene(k, split) for k, split in ((0, "train"), (20, "train"), (40, "test"), (60, "test"))]


def corner_sets(scene: Scene) -> np.ndarray:
    """(n, 8, 3) float64, each box's corners in a fixed order."""
    corners = (SIGNS * scene.size_m[:, None].astype(float)) @ np.swapaxes(scene.rotation, 1, 2) + scene.center_m[
        :, None
    ]
    return np.stack([box[np.lexsort(np.round(box, 3).T)] for box in corners])


def assert_canonical(scene: Scene) -> None:
    rotation, size_m = canonical_boxes(scene.rotation, scene.size_m)
    assert np.array_equal(size_m, scene.size_m)
    assert np.allclose(rotation, scene.rotation, atol=1e-6)
    assert np.allclose(np.linalg.det(scene.rotation.astype(float)), 1, atol=1e-5)


def assert_same(got: Scene, want: Scene, but: tuple[str, ...] = ()) -> None:
    for name in set(PER_PRIMITIVE) - set(but):
        assert np.array_equal(getattr(got, name), getattr(want, name), equal_nan=name == "heading_rad"), name


# ------------------------------------------------------------------------------------------------------ selection


def test_a_selection_fits_all_that_it_names(scene):
    x, y = scene.center_m[:, :2].T
    square = (10.0, -20.0, 50.0, -20.0, 50.0, 15.0, 10.0, 15.0)
    inside = (x > 10) & (x < 50) & (y > -20) & (y < 15)
    long = scene.size_m[:, 0] > 3
    trees = np.isin(scene.category, [0, 1])
    for select, expected in (
        (Select(category=("vegetation_cuboid", "vegetation_ellipsoid")), trees),
        (Select(primitives=(3, 17)), np.isin(np.arange(60), [3, 17])),
        (Select(instances=(4, 9)), np.isin(scene.instance_id, [4, 9])),
        (Select(polygon_m=square), inside),
        (Select(where="length_m > 3"), long),
        (
            Select(where="kind = 'ellipsoid' or heading_rad is null"),
            (scene.category == ELLIPSOID) | np.isnan(scene.heading_rad),
        ),
        (Select(category=CATEGORIES[:2], polygon_m=square, where="length_m > 3"), trees & inside & long),
    ):
        assert expected.any() and not expected.all()
        assert np.array_equal(select.chosen(scene), expected), select
    assert ALL.chosen(scene).all() and len(ALL.chosen(scene.select(np.zeros(0, int)))) == 0


@pytest.mark.parametrize(
    "select, message",
    [
        (Select(), "no primitives are chosen: give category"),
        (Select(category=("car",)), "category 'car' is unknown"),
        (Select(polygon_m=(0, 1, 2)), "3 numbers: expected x y"),
        (Select(where="speed > 3"), "speed.*docs/tables.md"),
        (Select(where="length_m >"), "where 'length_m >'"),
        (Select(where="true; drop table x"), "where 'true; drop"),
        (Select(where="x_m > (select count(*) from read_csv('/etc/passwd'))"), "where .*disabled"),
    ],
)
def test_a_wrong_selection_is_refused(scene, select, message):
    with pytest.raises(ValueError, match=message):
        select.check()
    with pytest.raises(ValueError, match=message):
        select.chosen(scene)


def test_primitives_that_a_scene_does_not_have(scene):
    with pytest.raises(ValueError, match=r"edit 1 \(remove\): scene test-0005 has 60 primitives, from 0 on, not 60"):
        replayed(scene, [edit.Snap(ALL), edit.Remove(Select(primitives=(60,)))])


# ---------------------------------------------------------------------------------------------------------- edits


def test_remove_and_duplicate(scene):
    cars = scene.category == CAR
    removed, (done,) = replayed(scene, [edit.Remove(Select(category=("vehicle_small",)))])
    assert done.primitive.tolist() == np.flatnonzero(cars).tolist() and cars.any() and set(done.change) == {"removed"}
    assert_same(removed, scene.select(~cars))
    doubled, (done,) = replayed(scene, [edit.Duplicate(Select(category=("vehicle_small",)), by_m=(1, -2, 2))])
    assert done.primitive.tolist() == np.flatnonzero(cars).tolist() and set(done.change) == {"copied"}
    assert np.allclose(done.moved_m, 3, atol=1e-5)
    assert_same(doubled.select(np.arange(60)), scene)
    copies = doubled.select(np.arange(60, len(doubled)))
    assert_same(copies, scene.select(cars), but=("center_m", "instance_id"))
    assert np.array_equal(copies.center_m, scene.center_m[cars] + np.array([1, -2, 2], np.float32))
    assert (copies.instance_id == -1).all()


def test_translate_along_the_scene_and_along_each_ones_own_way(scene):
    some = Select(primitives=(3, 4, 8))
    moved, (done,) = replayed(scene, [edit.Translate(some, (1.5, -2, 0.25))])
    assert done.primitive.tolist() == [3, 4, 8] and set(done.change) == {"changed"}
    assert np.allclose(done.moved_m, np.linalg.norm([1.5, -2, 0.25]), atol=1e-5)
    way_m = moved.center_m - scene.center_m
    assert np.abs(way_m[[3, 4, 8]] - [1.5, -2, 0.25]).max() < 1e-5 and not np.delete(way_m, [3, 4, 8], 0).any()
    assert_same(moved, scene, but=("center_m",))
    driven, _ = replayed(scene, [edit.Translate(ALL, (2, 0, 0), "own")])
    way_m = (driven.center_m - scene.center_m) / 2
    length = scene.rotation[:, :, 0]
    heading = np.stack([np.cos(scene.heading_rad), np.sin(scene.heading_rad)], axis=1)
    known = ~np.isnan(scene.heading_rad)
    assert np.abs(np.abs((way_m * length).sum(axis=1)) - 1).max() < 1e-4  # along the length
    assert ((way_m[:, :2] * heading).sum(axis=1)[known] >= -1e-5).all()  # ahead, where ahead is known
    assert np.abs(way_m - length)[~known].max() < 1e-4


@pytest.mark.parametrize("about_m", [None, (20.0, -5.0)])
@pytest.mark.parametrize("by_deg", [30.0, 90.0, -135.0, 180.0])
def test_rotate_turns_every_corner(scene, about_m, by_deg):
    turned, (done,) = replayed(scene, [edit.Rotate(ALL, by_deg, about_m)])
    angle = np.deg2rad(by_deg)
    matrix = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    axis = scene.center_m * [1, 1, 0] if about_m is None else np.array([*about_m, 0.0])
    for before, after, point in zip(corners(scene), corners(turned), np.broadcast_to(axis, (60, 3)), strict=True):
        expected = point + (before - point) @ matrix.T
        apart = np.linalg.norm(after[:, None] - expected[None], axis=2)
        assert apart.min(axis=0).max() < 1e-4
    assert_canonical(turned)
    known = ~np.isnan(scene.heading_rad)
    off = turned.heading_rad[known] - scene.heading_rad[known] - angle
    assert np.abs(np.sin(off / 2)).max() < 1e-5 and np.abs(turned.heading_rad[known]).max() <= np.pi
    assert np.isnan(turned.heading_rad[~known]).all()
    if by_deg == 30:  # about an upright axis: of a tilted box too, at least one axis turns by less
        assert (done.turned_rad <= np.deg2rad(30.01)).all() and (done.turned_rad > np.deg2rad(25)).all()


def corners(scene: Scene) -> np.ndarray:
    return (SIGNS * scene.size_m[:, None].astype(float)) @ np.swapaxes(scene.rotation, 1, 2) + scene.center_m[:, None]


def test_resized_is_the_largest_change_of_an_extent(scene):
    _, (done,) = replayed(scene, [edit.Scale(Select(primitives=(7, 9)), (1.2, 1.02, 0.9))])
    assert done.primitive.tolist() == [7, 9] and np.allclose(done.resized, 0.2, atol=1e-6) and not done.turned_rad.any()


@pytest.mark.parametrize("hold", ["bottom", "centre"])
def test_scale_along_own_axes(scene, hold):
    by = (0.5, 3.0, 1.25)
    scaled, (done,) = replayed(scene, [edit.Scale(ALL, by, hold)])
    assert len(done.primitive) == 60
    assert_canonical(scaled)
    assert np.allclose(scaled.volume_m3, scene.volume_m3 * np.prod(by), rtol=1e-5)
    held = (scaled.bottom_m, scene.bottom_m) if hold == "bottom" else (scaled.center_m, scene.center_m)
    assert np.abs(held[0] - held[1]).max() < 1e-5
    as_given = np.sort((scene.size_m * np.array(by, np.float32)), axis=1)
    assert np.array_equal(np.sort(scaled.size_m, axis=1), as_given)


def test_the_lowest_point_is_the_meshs(scene):
    corners_m, _, primitive = scene_triangles(scene)
    for index in range(len(scene)):
        lowest_m = corners_m[primitive == index][..., 2].min()
        assert lowest_m == pytest.approx(
            scene.bottom_m[index], abs=0.03 if scene.category[index] == ELLIPSOID else 1e-4
        )
        assert lowest_m > scene.bottom_m[index] - 1e-4


def test_relabel_changes_the_kind_too(scene):
    made, _ = replayed(scene, [edit.Relabel(Select(where="length_m > 4"), "vegetation_ellipsoid")])
    long = scene.size_m[:, 0] > 4
    assert (made.category[long] == ELLIPSOID).all() and (made.label[long] == "vegetation_ellipsoid").all()
    assert_same(made, scene, but=("category", "label"))
    assert np.array_equal(made.category[~long], scene.category[~long])
    with pytest.raises(ValueError, match="'tree' is unknown"):
        replayed(scene, [edit.Relabel(ALL, "tree")])


def test_snap_leaves_nothing_floating_or_sunken(town_scenes):
    rng = np.random.default_rng(0)
    for scene in town_scenes:
        up_m = rng.uniform(-3, 3, (len(scene), 1)) * [[0, 0, 1]]
        lifted = replace(scene, center_m=(scene.center_m + up_m).astype(np.float32))
        snapped, _ = replayed(lifted, [edit.Snap(ALL)])
        before, after = (validity_rates(scene_validity(s, SLAB_OFFSET_M)) for s in (lifted, snapped))
        assert before["floating"] > 0.2 and before["sunken"] > 0.2
        assert after["floating"] == after["sunken"] == 0
        height_m, ground_class = scene.ground_under()
        known = ground_class >= 0
        assert np.abs(snapped.bottom_m - height_m + SLAB_OFFSET_M)[known].max() < 1e-4
        assert np.array_equal(snapped.center_m[~known], lifted.center_m[~known])


def test_what_would_be_no_primitive_is_refused(scene):
    for wrong in (edit.Scale(ALL, (0, 1, 1)), edit.Scale(ALL, (1e6, 1, 1)), edit.Translate(ALL, (np.inf, 0, 0))):
        with pytest.raises(ValueError, match=rf"edit 0 \({wrong.name}\): .*thinner than 1 mm"):
            replayed(scene, [wrong])


# --------------------------------------------------------------------------------------------------------- repair


def two_boxes(gap_m: float, sizes_m=((4, 2, 1.5), (4, 2, 1.5)), **fields) -> Scene:
    """Two cars in a row on flat ground, their ends gap_m apart."""
    scene = random_scene(0, 2, tilt_rad=0)
    front, back = sizes_m
    center_m = np.array([[30, 0, 1], [30 + (front[0] + back[0]) / 2 + gap_m, 0.1, 1]], np.float32)
    return replace(
        scene,
        category=np.full(2, CAR, np.int8),
        label=None,
        center_m=center_m,
        size_m=np.array(sizes_m, np.float32),
        rotation=np.tile(np.eye(3, dtype=np.float32), (2, 1, 1)),
        **fields,
    )


def test_two_that_overlap_are_pushed_apart_by_the_shortest_way():
    scene = two_boxes(-0.4)  # 0.4 of 7.6 m: an IoU3D of 0.0495 with the offset, or 0.0526 without
    scene = replace(scene, center_m=scene.center_m * np.array([1, 0, 1], np.float32))
    mended, (done,) = replayed(scene, [edit.Repair(ALL)])
    assert overlap(scene) > 0.05 > overlap(mended) and len(mended) == 2
    assert np.allclose(mended.center_m[:, 1:], scene.center_m[:, 1:]) and (done.moved_m <= 0.05).all()
    assert not done.turned_rad.any() and not done.resized.any()


def overlap(scene: Scene) -> float:
    boxes = boxes_of(scene)
    return float(iou3d_matrix(boxes, boxes)[0, 1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"push_m": -1.0}, "push_m is -1.0"),
        ({"push_m": np.nan}, "push_m is nan"),
        ({"shrink": 2.0}, "shrink is 2.0"),
        ({"shrink": 0.0}, "shrink is 0.0"),
    ],
)
def test_a_repair_that_no_scene_can_take_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        edit.Repair(ALL, **options).check()


def test_what_cannot_be_pushed_far_enough_shrinks_or_goes():
    deep = two_boxes(-2, existence=np.array([0.9, 0.6], np.float32))
    mended, (done,) = replayed(deep, [edit.Repair(ALL)])
    assert len(mended) == 1 and mended.existence[0] == np.float32(0.9)
    assert done.primitive.tolist() == [1] and done.change.tolist() == ["removed"]
    kept, done = replayed(deep, [edit.Repair(ALL, drop=False)])
    assert_same(kept, deep)
    far, _ = replayed(deep, [edit.Repair(ALL, push_m=1.5)])
    assert len(far) == 2 and overlap(far) < 0.05
    other, _ = replayed(deep, [edit.Repair(Select(primitives=(0,)), push_m=3)])  # who is not chosen stays
    assert_same(other.select(np.array([1])), deep.select(np.array([1])))
    assert overlap(other) < 0.05
    small = two_boxes(-0.8)
    shrunk, (done,) = replayed(small, [edit.Repair(ALL, push_m=0.2)])
    assert len(shrunk) == 2 and overlap(shrunk) < 0.05 and (done.resized <= 0.0501).all() and done.resized.any()
    assert (done.moved_m <= 0.2001).all()


def test_faults_of_a_spoilt_town_are_mended_and_the_rest_is_left(town_scenes):
    """Every fifth thing lifted or sunk by 0.6 to 0.9 m, every fifth pushed along."""
    rng, overlapping = np.random.default_rng(1), []
    for scene in town_scenes:
        center_m = scene.center_m.copy()
        center_m[::5, 2] += rng.choice([-1, 1], len(center_m[::5])) * rng.uniform(0.6, 0.9, len(center_m[::5]))
        center_m[1::5, :2] += rng.uniform(-1, 1, (len(center_m[1::5]), 2))
        spoilt = replace(scene, center_m=center_m.astype(np.float32))
        mended, (done,) = replayed(spoilt, [edit.Repair(ALL)])
        before, after = (validity_rates(scene_validity(s, SLAB_OFFSET_M)) for s in (spoilt, mended))
        assert before["floating"] + before["sunken"] > 0.05 and after["floating"] == after["sunken"] == 0
        assert after["overlapping"] == 0
        overlapping.append(before["overlapping"])
        wrong = np.any([bad for bad, _ in list(faults(spoilt, SLAB_OFFSET_M).values())[:3]], axis=0)
        partners = (iou3d_matrix(boxes_of(spoilt), boxes_of(spoilt)) > 0.05)[wrong].any(axis=0)
        assert set(done.primitive) <= set(np.flatnonzero(wrong | partners))  # nothing that was right is touched
        assert (done.change == "removed").mean() < 0.5
    assert np.mean(overlapping) > 0.02


# ----------------------------------------------------------------------------------------------------- edit lists

LIST = [
    edit.Remove(Select(category=("human", "pole"))),
    edit.Duplicate(Select(instances=(4,)), (1, 2, 3)),
    edit.Translate(Select(polygon_m=(0, -9, 60, -9, 60, 9)), (0, 1.1, 0), "own"),
    edit.Rotate(Select(where="length_m > 2.5"), 33.0, (10, 0)),
    edit.Scale(Select(primitives=(0, 1, 2)), (1.1, 1, 1), "centre"),
    edit.Relabel(Select(category=("object",)), "vehicle_big", "bus"),
    edit.Snap(ALL, 0.0),
    edit.Repair(ALL, 0.0, push_m=0.5),
]


def test_a_list_replays_to_the_last_bit_after_a_round_trip(scene):
    again = edits_from_json(json.loads(json.dumps(edits_to_json(LIST))))
    assert again == LIST and {e.name for e in LIST} == set(edit.EDITS)
    first, second = replayed(scene, LIST)[0], replayed(scene, again)[0]
    assert_same(first, second)
    assert len(first) != len(scene) or not np.array_equal(first.center_m, scene.center_m)


@pytest.mark.parametrize(
    "content, message",
    [
        ({}, "JSON list of objects"),
        ([{"select": {}}], "edit 0: 'edit' is null, expected one of: remove"),
        ([{"edit": "explode"}], "edit 0: 'edit' is \"explode\""),
        (
            [{"edit": "remove", "select": {"where": "true"}}, {"edit": "rotate", "by_deg": "much"}],
            r"edit 1 \(rotate\): by_deg",
        ),
        ([{"edit": "translate", "by_m": [1, 2]}], r"edit 0 \(translate\): by_m"),
        ([{"edit": "scale", "by": [1, 1, 1], "keep": "bottom"}], r"edit 0 \(scale\): keep"),
        ([{"edit": "remove", "select": {"categories": ["human"]}}], r"edit 0 \(remove\): select.categories"),
    ],
)
def test_a_wrong_list_is_refused(content, message):
    with pytest.raises(ValueError, match=message):
        edits_from_json(content)


# ------------------------------------------------------------------------------------------------- a whole table


@pytest.fixture(scope="module")
def table(town_scenes, tmp_path_factory) -> str:
    root = str(tmp_path_factory.mktemp("town"))
    Shard(root, "town", "train", 0).write(town_scenes[:2])
    Shard(root, "town", "test", 0).write(town_scenes[2:])
    return root


def test_edits_over_a_table(table, town_scenes, tmp_path, cluster):
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
        assert_same(got, scene.select(keep))
        assert got.split == scene.split and np.array_equal(got.occupied, scene.occupied)
    assert gone and made.table.rows == [(0, "remove", "removed", 4, gone, 0, 0, 0)]
    assert "data:image/png" in (tmp_path / "out" / "bare.html").read_text()
    rows = pq.read_table(str(tmp_path / "out" / "edits"), partitioning=None).to_pylist()
    assert len(rows) == gone and {(row["edit"], row["change"]) for row in rows} == {("remove", "removed")}

    part = next((tmp_path / "out" / "scenes" / "source=edited-bare" / "split=test").glob("*.parquet"))
    written = part.stat().st_mtime_ns
    assert edit_scenes(trees) == made and part.stat().st_mtime_ns == written  # nothing is done twice
    with pytest.raises(ValueError, match="holds a run 'bare' with other edits; choose another --run"):
        edit_scenes(Remove(category=("pole",), **options))

    record = str(tmp_path / "out" / "edited-bare.json")
    again = edit_scenes(Replay(edits=record, **options | {"output": str(tmp_path / "again"), "num_examples": 0}))
    assert again.table.rows == made.table.rows
    for scene in read_scenes(str(tmp_path / "again"), "edited-bare"):
        assert_same(scene, edited[scene.scene_id])


def test_a_scene_that_cannot_be_edited_is_rejected_and_the_rest_goes_on(table, town_scenes, tmp_path, cluster):
    from jobs.edit_scenes import Remove
    from jobs.implementation.edit_scenes import edit_scenes

    last = max(len(scene) for scene in town_scenes) - 1
    fits = sum(len(scene) > last for scene in town_scenes)
    assert 0 < fits < len(town_scenes)
    made = edit_scenes(Remove(primitives=(last,), input=table, output=str(tmp_path), num_examples=0))
    assert (made.scenes, made.rejects) == (fits, 4 - fits)
    rejects = pq.read_table(str(tmp_path / "rejects"), partitioning=None).to_pylist()
    assert {row["scene_id"] for row in rejects} == {s.scene_id for s in town_scenes if len(s) <= last}
    assert all("primitives, from 0 on, not" in row["reason"] for row in rejects)
    with pytest.raises(ValueError, match="none of the 4 scenes can be edited so; the first: edit 0"):
        edit_scenes(Remove(primitives=(9999,), input=table, output=str(tmp_path), run="none"))
    with pytest.raises(ValueError, match="nothing is changed: no primitive in 4 scene"):
        edit_scenes(Remove(where="length_m > 900", input=table, output=str(tmp_path), run="nothing"))
