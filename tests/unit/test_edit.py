"""Tests of edits: exact parameters, repair and deterministic replay."""

import json
import time
from dataclasses import replace

import numpy as np
import pytest
from helpers import assert_same_primitives, random_scene

from models.geometry.iou3d import compute_iou3d_matrix, extract_boxes
from models.layout import SLAB_OFFSET_M
from models.scene import CATEGORIES, CATEGORY_INDEX, ELLIPSOID, UNSET, Scene, canonicalize_boxes
from pipelines.editing import edit
from pipelines.editing.edit import Select, parse_edits, replay_edits, serialize_edits
from pipelines.io.mesh_export import triangulate_scene
from pipelines.metrics.validity import compute_scene_validity, compute_validity_rates, find_faults

CAR = CATEGORY_INDEX["vehicle_small"]
SIGNS = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T
ALL = Select(where="true")


@pytest.fixture
def scene() -> Scene:
    heading = np.linspace(-3, 3, 60).astype(np.float32)
    heading[::4] = np.nan
    return random_scene(5, 60, heading_rad=heading, instance_id=np.arange(60, dtype=np.int64) // 2)


@pytest.fixture(scope="module")
def town_scenes(town_drive_3) -> list[Scene]:
    return [town_drive_3.scene(k, split) for k, split in ((0, "train"), (20, "train"), (40, "test"), (60, "test"))]


def assert_canonical(scene: Scene) -> None:
    rotation, size_m = canonicalize_boxes(scene.rotation, scene.size_m)
    assert np.array_equal(size_m, scene.size_m)
    assert np.allclose(rotation, scene.rotation, atol=1e-6)
    assert np.allclose(np.linalg.det(scene.rotation.astype(float)), 1, atol=1e-5)


# ------------------------------------------------------------------------------------------------------ selection


def test_selection_matches_all_its_conditions(scene):
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
        assert np.array_equal(select.select_primitives(scene), expected), select
    assert ALL.select_primitives(scene).all() and len(ALL.select_primitives(scene.select(np.zeros(0, int)))) == 0


@pytest.mark.parametrize(
    "select, message",
    [
        (Select(), "the selection has no condition; give category"),
        (Select(category=("car",)), "category 'car' is unknown"),
        (Select(polygon_m=(0, 1, 2)), "3 numbers, expected pairs x y"),
        (Select(where="speed > 3"), "speed.*docs/reference/tables.md"),
        (Select(where="length_m >"), "where condition 'length_m >'"),
        (Select(where="true; drop table x"), "where condition 'true; drop"),
        (Select(where="x_m > (select count(*) from read_csv('/etc/passwd'))"), "where .*disabled"),
    ],
)
def test_selection_rejects_wrong_values(scene, select, message):
    with pytest.raises(ValueError, match=message):
        select.check()
    with pytest.raises(ValueError, match=message):
        select.select_primitives(scene)


def test_selection_rejects_missing_primitives(scene):
    words = r"edit 1 \(remove\): scene test-0005 has 60 primitives, numbered from 0; got the numbers 60"
    with pytest.raises(ValueError, match=words):
        replay_edits(scene, [edit.Snap(ALL), edit.Remove(Select(primitives=(60,)))])


# ---------------------------------------------------------------------------------------------------------- edits


def test_edit_removes_and_duplicates_primitives(scene):
    cars = scene.category == CAR
    removed, (done,) = replay_edits(scene, [edit.Remove(Select(category=("vehicle_small",)))])
    assert done.primitive.tolist() == np.flatnonzero(cars).tolist() and cars.any() and set(done.change) == {"removed"}
    assert_same_primitives(removed, scene.select(~cars))
    doubled, (done,) = replay_edits(scene, [edit.Duplicate(Select(category=("vehicle_small",)), by_m=(1, -2, 2))])
    assert done.primitive.tolist() == np.flatnonzero(cars).tolist() and set(done.change) == {"copied"}
    assert np.allclose(done.moved_m, 3, atol=1e-5)
    assert_same_primitives(doubled.select(np.arange(60)), scene)
    copies = doubled.select(np.arange(60, len(doubled)))
    assert_same_primitives(copies, scene.select(cars), but=("center_m", "instance_id"))
    assert np.array_equal(copies.center_m, scene.center_m[cars] + np.array([1, -2, 2], np.float32))
    assert (copies.instance_id == -1).all()


def test_translate_moves_along_scene_or_own_axes(scene):
    some = Select(primitives=(3, 4, 8))
    moved, (done,) = replay_edits(scene, [edit.Translate(some, (1.5, -2, 0.25))])
    assert done.primitive.tolist() == [3, 4, 8] and set(done.change) == {"changed"}
    assert np.allclose(done.moved_m, np.linalg.norm([1.5, -2, 0.25]), atol=1e-5)
    way_m = moved.center_m - scene.center_m
    assert np.abs(way_m[[3, 4, 8]] - [1.5, -2, 0.25]).max() < 1e-5 and not np.delete(way_m, [3, 4, 8], 0).any()
    assert_same_primitives(moved, scene, but=("center_m",))
    driven, _ = replay_edits(scene, [edit.Translate(ALL, (2, 0, 0), "own")])
    way_m = (driven.center_m - scene.center_m) / 2
    length = scene.rotation[:, :, 0]
    heading = np.stack([np.cos(scene.heading_rad), np.sin(scene.heading_rad)], axis=1)
    known = ~np.isnan(scene.heading_rad)
    assert np.abs(np.abs((way_m * length).sum(axis=1)) - 1).max() < 1e-4  # Objects move along their length.
    # If the heading is known, the displacement points forward.
    assert ((way_m[:, :2] * heading).sum(axis=1)[known] >= -1e-5).all()
    assert np.abs(way_m - length)[~known].max() < 1e-4


@pytest.mark.parametrize("about_m", [None, (20.0, -5.0)])
@pytest.mark.parametrize("by_deg", [30.0, 90.0, -135.0, 180.0])
def test_rotate_turns_every_corner(scene, about_m, by_deg):
    turned, (done,) = replay_edits(scene, [edit.Rotate(ALL, by_deg, about_m)])
    angle = np.deg2rad(by_deg)
    matrix = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    axis = scene.center_m * [1, 1, 0] if about_m is None else np.array([*about_m, 0.0])
    for before, after, point in zip(
        compute_corners(scene), compute_corners(turned), np.broadcast_to(axis, (60, 3)), strict=True
    ):
        expected = point + (before - point) @ matrix.T
        apart = np.linalg.norm(after[:, None] - expected[None], axis=2)
        assert apart.min(axis=0).max() < 1e-4
    assert_canonical(turned)
    known = ~np.isnan(scene.heading_rad)
    off = turned.heading_rad[known] - scene.heading_rad[known] - angle
    assert np.abs(np.sin(off / 2)).max() < 1e-5 and np.abs(turned.heading_rad[known]).max() <= np.pi
    assert np.isnan(turned.heading_rad[~known]).all()
    if by_deg == 30:  # at least one axis of a tilted box turns by less than 30 degrees
        assert (done.turned_rad <= np.deg2rad(30.01)).all() and (done.turned_rad > np.deg2rad(25)).all()


def compute_corners(scene: Scene) -> np.ndarray:
    return (SIGNS * scene.size_m[:, None].astype(float)) @ np.swapaxes(scene.rotation, 1, 2) + scene.center_m[:, None]


def test_edit_record_contains_largest_change_of_an_extent(scene):
    _, (done,) = replay_edits(scene, [edit.Scale(Select(primitives=(7, 9)), (1.2, 1.02, 0.9))])
    assert done.primitive.tolist() == [7, 9] and np.allclose(done.resized, 0.2, atol=1e-6) and not done.turned_rad.any()


@pytest.mark.parametrize("hold", ["bottom", "centre"])
def test_scale_acts_along_own_axes(scene, hold):
    by = (0.5, 3.0, 1.25)
    scaled, (done,) = replay_edits(scene, [edit.Scale(ALL, by, hold)])
    assert len(done.primitive) == 60
    assert_canonical(scaled)
    assert np.allclose(scaled.volume_m3, scene.volume_m3 * np.prod(by), rtol=1e-5)
    held = (scaled.bottom_m, scene.bottom_m) if hold == "bottom" else (scaled.center_m, scene.center_m)
    assert np.abs(held[0] - held[1]).max() < 1e-5
    as_given = np.sort((scene.size_m * np.array(by, np.float32)), axis=1)
    assert np.array_equal(np.sort(scaled.size_m, axis=1), as_given)


def test_lowest_point_equals_that_of_mesh(scene):
    corners_m, _, primitive = triangulate_scene(scene)
    for index in range(len(scene)):
        lowest_m = corners_m[primitive == index][..., 2].min()
        assert lowest_m == pytest.approx(
            scene.bottom_m[index], abs=0.03 if scene.category[index] == ELLIPSOID else 1e-4
        )
        assert lowest_m > scene.bottom_m[index] - 1e-4


def test_relabel_changes_shape_kind(scene):
    made, _ = replay_edits(scene, [edit.Relabel(Select(where="length_m > 4"), "vegetation_ellipsoid")])
    long = scene.size_m[:, 0] > 4
    assert (made.category[long] == ELLIPSOID).all() and (made.label[long] == "vegetation_ellipsoid").all()
    assert_same_primitives(made, scene, but=("category", "label"))
    assert np.array_equal(made.category[~long], scene.category[~long])
    with pytest.raises(ValueError, match="'tree' is unknown"):
        replay_edits(scene, [edit.Relabel(ALL, "tree")])


def test_snap_leaves_nothing_floating_or_sunken(town_scenes):
    rng = np.random.default_rng(0)
    for scene in town_scenes:
        up_m = rng.uniform(-3, 3, (len(scene), 1)) * [[0, 0, 1]]
        lifted = replace(scene, center_m=(scene.center_m + up_m).astype(np.float32))
        snapped, _ = replay_edits(lifted, [edit.Snap(ALL)])
        before, after = (compute_validity_rates(compute_scene_validity(s, SLAB_OFFSET_M)) for s in (lifted, snapped))
        assert before["floating"] > 0.2 and before["sunken"] > 0.2
        assert after["floating"] == after["sunken"] == 0
        height_m, ground_class = scene.ground_under()
        known = ground_class >= 0
        assert np.abs(snapped.bottom_m - height_m + SLAB_OFFSET_M)[known].max() < 1e-4
        assert np.array_equal(snapped.center_m[~known], lifted.center_m[~known])


def test_edit_rejects_degenerate_primitive(scene):
    far, large = "would lie beyond 1,000,000 m", "size outside 1 mm to 1 km"
    for wrong, reason in (
        (edit.Scale(ALL, (0, 1, 1)), large),
        (edit.Scale(ALL, (1e6, 1, 1)), large),
        (edit.Translate(ALL, (np.inf, 0, 0)), far),
        (edit.Translate(ALL, (1e30, 0, 0)), far),  # Tables refuse such a position.
        (edit.Rotate(ALL, 90, about_m=(1e9, 0)), far),
    ):
        with pytest.raises(ValueError, match=rf"edit 0 \({wrong.name}\): .*{reason}"):
            replay_edits(scene, [wrong])
    with pytest.raises(ValueError, match="at most 1,000,000"):
        edit.Translate(ALL, (1e30, 0, 0)).check()


# --------------------------------------------------------------------------------------------------------- repair


def make_two_cars(gap_m: float, sizes_m=((4, 2, 1.5), (4, 2, 1.5)), **fields) -> Scene:
    """Return two cars in a row on flat ground, with a gap of gap_m between them."""
    scene = random_scene(0, 2, tilt_rad=0)
    front, back = sizes_m
    center_m = np.array([[30, 0, 1], [30 + (front[0] + back[0]) / 2 + gap_m, 0.1, 1]], np.float32)
    return replace(
        scene,
        category=np.full(2, CAR, np.int8),
        label=UNSET,
        center_m=center_m,
        size_m=np.array(sizes_m, np.float32),
        rotation=np.tile(np.eye(3, dtype=np.float32), (2, 1, 1)),
        **fields,
    )


def test_repair_separates_overlap_by_shortest_move():
    scene = make_two_cars(-0.4)  # the IoU3D is 0.0495; without the lateral offset, the IoU3D is 0.4 / 7.6 = 0.0526
    scene = replace(scene, center_m=scene.center_m * np.array([1, 0, 1], np.float32))
    mended, (done,) = replay_edits(scene, [edit.Repair(ALL)])
    assert compute_overlap(scene) > 0.05 > compute_overlap(mended) and len(mended) == 2
    assert np.allclose(mended.center_m[:, 1:], scene.center_m[:, 1:]) and (done.moved_m <= 0.05).all()
    assert not done.turned_rad.any() and not done.resized.any()


def compute_overlap(scene: Scene) -> float:
    boxes = extract_boxes(scene)
    return float(compute_iou3d_matrix(boxes, boxes)[0, 1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"push_m": -1.0}, "push_m is -1.0"),
        ({"push_m": np.nan}, "push_m is nan"),
        ({"shrink": 2.0}, "shrink is 2.0"),
        ({"shrink": 0.0}, "shrink is 0.0"),
    ],
)
def test_repair_rejects_impossible_options(options, message):
    with pytest.raises(ValueError, match=message):
        edit.Repair(ALL, **options).check()


def test_repair_shrinks_or_removes_unmovable_primitives():
    deep = make_two_cars(-2, existence=np.array([0.9, 0.6], np.float32))
    mended, (done,) = replay_edits(deep, [edit.Repair(ALL)])
    assert len(mended) == 1 and mended.existence[0] == np.float32(0.9)
    assert done.primitive.tolist() == [1] and done.change.tolist() == ["removed"]
    kept, done = replay_edits(deep, [edit.Repair(ALL, drop=False)])
    assert_same_primitives(kept, deep)
    far, _ = replay_edits(deep, [edit.Repair(ALL, push_m=1.5)])
    assert len(far) == 2 and compute_overlap(far) < 0.05
    other, _ = replay_edits(
        deep, [edit.Repair(Select(primitives=(0,)), push_m=3)]
    )  # the edit changes only selected primitives
    assert_same_primitives(other.select(np.array([1])), deep.select(np.array([1])))
    assert compute_overlap(other) < 0.05
    small = make_two_cars(-0.8)
    shrunk, (done,) = replay_edits(small, [edit.Repair(ALL, push_m=0.2)])
    assert len(shrunk) == 2 and compute_overlap(shrunk) < 0.05 and (done.resized <= 0.0501).all() and done.resized.any()
    assert (done.moved_m <= 0.2001).all()


def test_repair_fixes_disturbed_town_and_keeps_valid_objects(town_scenes):
    """The test moves one fifth of the objects up or down by 0.6 to 0.9 m. It moves another fifth sideways by at most 1
    m."""
    rng, overlapping = np.random.default_rng(1), []
    for scene in town_scenes:
        center_m = scene.center_m.copy()
        center_m[::5, 2] += rng.choice([-1, 1], len(center_m[::5])) * rng.uniform(0.6, 0.9, len(center_m[::5]))
        center_m[1::5, :2] += rng.uniform(-1, 1, (len(center_m[1::5]), 2))
        disturbed = replace(scene, center_m=center_m.astype(np.float32))
        mended, (done,) = replay_edits(disturbed, [edit.Repair(ALL)])
        before, after = (compute_validity_rates(compute_scene_validity(s, SLAB_OFFSET_M)) for s in (disturbed, mended))
        assert before["floating"] + before["sunken"] > 0.05 and after["floating"] == after["sunken"] == 0
        assert after["overlapping_iou3d"] == 0
        # Repair does not optimise this measure: objects inside others may remain.
        overlapping.append((before["overlapping"], after["overlapping"]))
        faults = ("overlapping_iou3d", "floating", "sunken")
        wrong = np.any([bad for bad, _ in find_faults(disturbed, SLAB_OFFSET_M, names=faults).values()], axis=0)
        partners = (compute_iou3d_matrix(extract_boxes(disturbed), extract_boxes(disturbed)) > 0.05)[wrong].any(axis=0)
        assert set(done.primitive) <= set(
            np.flatnonzero(wrong | partners)
        )  # repair changes only faulty primitives and their partners
        assert (done.change == "removed").mean() < 0.5
    before, after = np.mean(overlapping, axis=0)
    assert 0.02 < after < before


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


def test_edit_list_replays_exactly_after_round_trip(scene):
    again = parse_edits(json.loads(json.dumps(serialize_edits(LIST))))
    assert again == LIST and {e.name for e in LIST} == set(edit.EDITS)
    first, second = replay_edits(scene, LIST)[0], replay_edits(scene, again)[0]
    assert_same_primitives(first, second)
    assert len(first) != len(scene) or not np.array_equal(first.center_m, scene.center_m)


@pytest.mark.parametrize(
    "content, message",
    [
        ({}, "JSON list of objects"),
        ([{"select": {}}], "edit 0: 'edit' is null, expected one of: remove"),
        ([{"edit": "explode"}], "edit 0: 'edit' is \"explode\""),
        ([{"edit": ["remove"]}], "edit 0: 'edit' is \\[\"remove\"\\]"),
        (
            [{"edit": "remove", "select": {"where": "true"}}, {"edit": "rotate", "by_deg": "much"}],
            r"edit 1 \(rotate\): by_deg",
        ),
        ([{"edit": "translate", "by_m": [1, 2]}], r"edit 0 \(translate\): by_m"),
        ([{"edit": "scale", "by": [1, 1, 1], "keep": "bottom"}], r"edit 0 \(scale\): keep"),
        ([{"edit": "remove", "select": {"categories": ["human"]}}], r"edit 0 \(remove\): select.categories"),
    ],
)
def test_edit_list_rejects_wrong_values(content, message):
    with pytest.raises(ValueError, match=message):
        parse_edits(content)


@pytest.mark.parametrize(
    ("condition", "message"),
    [
        ("row < (SELECT sum(a.range * b.range) FROM range(10000000) a, range(10000000) b)", "takes more than 0.2 s"),
        ("(SELECT count(*) FROM read_csv('/etc/passwd')) > 0", "is invalid"),
        ("(SELECT count(*) FROM read_text('/etc/passwd')) > 0", "is invalid"),
    ],
)
def test_where_condition_is_limited(condition, message, monkeypatch):
    monkeypatch.setattr("pipelines.editing.edit.WHERE_S", 0.2)
    start = time.monotonic()
    with pytest.raises(ValueError, match=message):
        Select(where=condition).select_primitives(random_scene(0, n=5))
    assert time.monotonic() - start < 5
