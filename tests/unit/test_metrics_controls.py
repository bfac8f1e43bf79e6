"""Tests of the damaged copies of scenes: each control changes what its description says and nothing else."""

from dataclasses import fields, replace

import numpy as np
import pytest
from helpers import assert_same_primitives, empty_scene, random_scene
from scipy.ndimage import distance_transform_edt

from models.scene import PER_PRIMITIVE, Grid, Scene, canonicalize_boxes
from pipelines.metrics.controls import CONTROLS, damage_scene

GROUND_CONTROLS = ("ground_shifted", "ground_roughened")
OBJECT_CONTROLS = tuple(name for name in CONTROLS if name not in GROUND_CONTROLS)
CONTENT = {*PER_PRIMITIVE, "height_m", "occupied"}


@pytest.fixture(scope="module")
def town_scenes(town_drive_3) -> list[Scene]:
    scenes = [town_drive_3.scene(k, "test") for k in (0, 20, 40)]
    return [replace(scene, vegetation_density="low", vehicle_density="high") for scene in scenes]


@pytest.fixture(scope="module")
def town_scene(town_scenes) -> Scene:
    return town_scenes[0]


def ground_at(scene: Scene, center_m: np.ndarray) -> np.ndarray:
    """Return the height (n,) of the fused surface under points; NaN where there is no ground.

    The function does not use Scene.ground_under.
    """
    heights = np.where(scene.occupied, scene.height_m, -np.inf).max(axis=0)
    row = np.floor((scene.grid.front_m - center_m[:, 0]) / scene.grid.resolution_m).astype(int)
    col = np.floor((scene.grid.left_m - center_m[:, 1]) / scene.grid.resolution_m).astype(int)
    found = heights[row, col]
    return np.where(np.isfinite(found), found, np.nan)


def assert_height_above_ground_is_kept(before: Scene, after: Scene, ground: Scene | None = None) -> None:
    """Compare the heights of objects above the ground of `ground` (default: `before`) and of `after`."""
    old_m, new_m = ground_at(ground or before, before.center_m), ground_at(after, after.center_m)
    known = np.isfinite(old_m) & np.isfinite(new_m)
    assert known.sum() > 50 and (~known).sum() > 0  # both cases occur
    above_m = before.center_m[:, 2] - old_m, after.center_m[:, 2] - new_m
    np.testing.assert_allclose(above_m[1][known], above_m[0][known], atol=1e-4)
    assert np.ptp(new_m[known] - old_m[known]) > 0.05  # without the correction of z, the line above would fail
    assert np.array_equal(after.center_m[~known, 2], before.center_m[~known, 2])


def assert_same_scene(got: Scene, want: Scene) -> None:
    assert_same_primitives(got, want)
    assert np.array_equal(got.height_m, want.height_m) and np.array_equal(got.occupied, want.occupied)


def content_differs(a: Scene, b: Scene) -> bool:
    return any(
        len(getattr(a, name)) != len(getattr(b, name))
        or not np.array_equal(getattr(a, name), getattr(b, name), equal_nan=name == "heading_rad")
        for name in CONTENT
    )


def make_bare(scene: Scene) -> Scene:
    """Return a scene without ground."""
    return replace(scene, height_m=np.zeros_like(scene.height_m), occupied=np.zeros_like(scene.occupied))


@pytest.mark.parametrize("control", CONTROLS)
def test_control_keeps_ids_labels_pose_and_grid(control, town_scenes):
    scene, _, donor = town_scenes
    damaged = damage_scene(control, scene, donor, (1, 2))
    for name in {field.name for field in fields(Scene)} - CONTENT:
        value, want = getattr(damaged, name), getattr(scene, name)
        assert np.array_equal(value, want) if isinstance(want, np.ndarray) else value == want, name
    assert donor.scene_id != scene.scene_id
    for name in CONTENT:
        assert getattr(damaged, name).dtype == getattr(scene, name).dtype, name


@pytest.mark.parametrize("control", CONTROLS)
def test_control_depends_on_its_arguments_only(control, town_scenes):
    scene, _, donor = town_scenes
    before = {name: getattr(scene, name).copy() for name in CONTENT}
    damaged = [damage_scene(control, scene, donor, (7, k)) for k in range(8)]
    np.random.seed(5)
    for k, first in enumerate(damaged):
        assert_same_scene(damage_scene(control, scene, donor, [7, k]), first)
        assert content_differs(first, scene)
    for name, values in before.items():
        assert np.array_equal(getattr(scene, name), values, equal_nan=name == "heading_rad"), name
    varies = any(content_differs(damaged[0], other) for other in damaged[1:])
    assert varies == (control not in ("turned", "transplanted"))  # these two controls are not random


@pytest.mark.parametrize("control", OBJECT_CONTROLS)
def test_object_control_keeps_the_ground(control, town_scenes):
    scene, _, donor = town_scenes
    damaged = damage_scene(control, scene, donor, (3,))
    assert np.array_equal(damaged.height_m, scene.height_m) and np.array_equal(damaged.occupied, scene.occupied)
    assert not np.array_equal(scene.occupied, donor.occupied)


@pytest.mark.parametrize("control", GROUND_CONTROLS)
def test_ground_control_keeps_the_objects(control, town_scenes):
    scene, _, donor = town_scenes
    damaged = damage_scene(control, scene, donor, (3,))
    assert_same_primitives(damaged, scene)
    assert not np.array_equal(damaged.occupied, scene.occupied)


def test_moved_objects_move_up_to_4_m_in_all_directions():
    scene = random_scene(0, 4000)
    scene.center_m[:, :2] = 32 + (scene.center_m[:, :2] - [32, 0]) * 0.8 - [0, 32]  # no centre near the border
    damaged = damage_scene("moved", scene, scene, (0,))
    by_m = damaged.center_m[:, :2].astype(float) - scene.center_m[:, :2]
    distance_m = np.linalg.norm(by_m, axis=1)
    assert distance_m.max() < 4.001 and abs(distance_m.mean() - 2) < 0.1
    share = np.histogram(distance_m, bins=4, range=(0, 4))[0] / len(scene)
    np.testing.assert_allclose(share, 0.25, atol=0.03)
    directions = np.histogram(np.arctan2(by_m[:, 1], by_m[:, 0]), bins=4, range=(-np.pi, np.pi))[0] / len(scene)
    np.testing.assert_allclose(directions, 0.25, atol=0.03)
    assert_same_primitives(damaged, scene, but=("center_m",))


def test_moved_objects_keep_height_above_ground(town_scene):
    damaged = damage_scene("moved", town_scene, town_scene, (0,))
    assert_height_above_ground_is_kept(town_scene, damaged)


def test_moved_centres_remain_in_the_grid():
    scene = random_scene(0, 400)
    scene.center_m[:200, 0] = np.tile([63.9, 0.1], 100)
    scene.center_m[200:, 1] = np.tile([31.9, -31.9], 100)
    damaged = damage_scene("moved", scene, scene, (0,))
    row, col = scene.grid.pixel(damaged.center_m[:, 0], damaged.center_m[:, 1])
    assert row.min() == 0 and row.max() == 255 and col.min() == 0 and col.max() == 255
    outside = replace(scene, center_m=scene.center_m + np.float32([70, 0, 0]))
    by_m = damage_scene("moved", outside, scene, (0,)).center_m[:, :2] - outside.center_m[:, :2]
    assert np.linalg.norm(by_m, axis=1).max() < 4.001  # clipping does not pull an object back from far outside


def test_turned_objects_turn_by_45_degrees():
    scene = random_scene(0, 300, heading_rad=np.linspace(-3.1, 3.1, 300).astype(np.float32))
    scene.heading_rad[::3] = np.nan
    damaged = damage_scene("turned", scene, scene, (0,))
    turn_rad = (damaged.yaw_rad - scene.yaw_rad) % np.pi  # an axis has no sign
    np.testing.assert_allclose(turn_rad, np.pi / 4, atol=1e-5)
    known = np.isfinite(scene.heading_rad)
    assert np.array_equal(np.isfinite(damaged.heading_rad), known)
    turn_rad = (damaged.heading_rad - scene.heading_rad)[known] % (2 * np.pi)
    np.testing.assert_allclose(turn_rad, np.pi / 4, atol=1e-5)
    assert np.abs(damaged.heading_rad[known]).max() <= np.float32(np.pi)
    np.testing.assert_array_equal(damaged.size_m, scene.size_m)
    np.testing.assert_allclose(damaged.bottom_m, scene.bottom_m, atol=1e-5)  # the axis of the turn is vertical
    assert_same_primitives(damaged, scene, but=("rotation", "heading_rad"))
    rotation, size_m = canonicalize_boxes(damaged.rotation, damaged.size_m)
    np.testing.assert_allclose(rotation, damaged.rotation, atol=1e-5)
    np.testing.assert_array_equal(size_m, damaged.size_m)


def test_permuted_objects_swap_positions(town_scene):
    damaged = damage_scene("permuted", town_scene, town_scene, (0,))
    positions = [sorted(map(tuple, scene.center_m[:, :2].tolist())) for scene in (town_scene, damaged)]
    assert positions[0] == positions[1]
    assert (damaged.center_m[:, :2] != town_scene.center_m[:, :2]).any(axis=1).mean() > 0.9
    assert_height_above_ground_is_kept(town_scene, damaged)
    assert_same_primitives(damaged, town_scene, but=("center_m",))


def test_transplanted_objects_stand_on_the_new_ground(town_scenes):
    scene, donor, _ = town_scenes
    damaged = damage_scene("transplanted", scene, donor, (0,))
    assert_same_primitives(damaged, donor, but=("center_m",))
    assert np.array_equal(damaged.center_m[:, :2], donor.center_m[:, :2])
    assert len(damaged) != len(scene)
    assert_height_above_ground_is_kept(donor, damaged)
    assert_same_scene(damage_scene("transplanted", scene, scene, (0,)), scene)


@pytest.mark.parametrize(("n", "dropped"), [(1, 1), (2, 1), (9, 3), (10, 3), (12, 4), (250, 75)])
def test_dropped_removes_30_percent(n, dropped):
    scene = random_scene(0, n, instance_id=np.arange(n))
    damaged = [damage_scene("dropped", scene, scene, (k,)) for k in range(100)]
    assert {len(rest) for rest in damaged} == {n - dropped}
    for rest in damaged:
        assert_same_primitives(rest, scene.select(rest.instance_id))
    kept = np.bincount(np.concatenate([rest.instance_id for rest in damaged]), minlength=n)
    assert kept.max() - kept.min() < 60  # each object has the same chance


@pytest.mark.parametrize(("n", "added"), [(1, 1), (4, 1), (16, 2), (250, 25)])
def test_duplicated_adds_10_percent_at_a_quarter_metre(n, added):
    scene = random_scene(0, n, instance_id=n - 1 - np.arange(n))
    damaged = damage_scene("duplicated", scene, scene, (0,))
    assert len(damaged) == n + added
    assert_same_primitives(damaged.select(slice(n)), scene)
    copies = damaged.select(slice(n, None))
    distance_m = np.linalg.norm(copies.center_m[:, None] - scene.center_m, axis=2)
    origin = distance_m.argmin(axis=1)
    assert len(set(origin)) == added
    np.testing.assert_allclose(distance_m.min(axis=1), 0.25, atol=1e-4)
    assert np.array_equal(copies.center_m[:, 2], scene.center_m[origin, 2])
    assert_same_primitives(copies, scene.select(origin), but=("center_m", "instance_id"))
    assert len(set(damaged.instance_id)) == n + added


def test_duplicated_objects_have_ids_and_remain_in_the_grid():
    scene = random_scene(0, 400)  # all objects have instance_id -1
    scene.center_m[:, 0] = np.tile([63.9, 0.1], 200)
    copies = damage_scene("duplicated", scene, scene, (0,)).select(slice(400, None))
    assert copies.instance_id.min() >= 0 and len(set(copies.instance_id)) == 40
    assert scene.grid.contains(copies.center_m[:, 0], copies.center_m[:, 1]).all()
    angle = np.sort(np.arctan2(*(copies.center_m[:, :2] - scene.center_m[0, :2]).T))
    assert len(np.unique(angle.round(3))) > 10  # the direction is random


@pytest.mark.parametrize("resolution_m", [0.25, 0.5, 2.0])
def test_ground_shifted_moves_the_rasters_by_4_m(resolution_m):
    grid = Grid(resolution_m=resolution_m, rows=round(64 / resolution_m), cols=round(64 / resolution_m))
    scene, pixels = random_scene(4, 5, grid), round(4 / resolution_m)
    # Slices of the result and of its source, for each direction, and of the strip and the line that fills it.
    inner = {"+x": np.s_[:, :-pixels], "-x": np.s_[:, pixels:], "+y": np.s_[:, :, :-pixels], "-y": np.s_[:, :, pixels:]}
    source = {"+x": inner["-x"], "-x": inner["+x"], "+y": inner["-y"], "-y": inner["+y"]}
    strip = {"+x": np.s_[:, -pixels:], "-x": np.s_[:, :pixels], "+y": np.s_[:, :, -pixels:], "-y": np.s_[:, :, :pixels]}
    line = {"+x": np.s_[:, -1:], "-x": np.s_[:, :1], "+y": np.s_[:, :, -1:], "-y": np.s_[:, :, :1]}
    seen = set()
    for k in range(40):
        damaged = damage_scene("ground_shifted", scene, scene, (k,))
        matching = [
            way
            for way in inner
            if all(
                np.array_equal(getattr(damaged, name)[inner[way]], getattr(scene, name)[source[way]])
                and (getattr(damaged, name)[strip[way]] == getattr(scene, name)[line[way]]).all()
                for name in ("height_m", "occupied")
            )
        ]
        assert len(matching) == 1
        seen.add(matching[0])
    assert seen == {"+x", "-x", "+y", "-y"}


def test_ground_shifted_is_measured_in_metres(town_scene):
    """A road whose centre line lies at y = 0 lies at x or y = +-4 m, measured in the scene frame."""
    occupied = np.zeros_like(town_scene.occupied)
    occupied[0] = (np.abs(town_scene.grid.y_m()) < 3)[None] & (np.abs(town_scene.grid.x_m() - 32) < 3)[:, None]
    square = replace(town_scene, occupied=occupied, height_m=np.where(occupied, np.float32(1), np.float32(0)))
    row, col = np.nonzero(damage_scene("ground_shifted", square, square, (0,)).occupied[0])
    by_m = np.array([square.grid.x_m()[row].mean() - 32, square.grid.y_m()[col].mean()])
    np.testing.assert_allclose(np.sort(np.abs(by_m)), [0, 4], atol=1e-6)


@pytest.mark.parametrize("resolution_m", [0.125, 0.25, 0.5])
def test_ground_roughened_changes_pixels_near_borders_only(resolution_m, town_scene):
    grid = Grid(resolution_m=resolution_m, rows=round(64 / resolution_m), cols=round(64 / resolution_m))
    row, col = town_scene.grid.pixel(grid.x_m(), grid.y_m())
    rasters = {name: getattr(town_scene, name)[:, row][:, :, col] for name in ("height_m", "occupied")}
    scene = replace(town_scene, grid=grid, **rasters)
    changed_shares = []
    for k in range(5):
        damaged = damage_scene("ground_roughened", scene, scene, (k,))
        for before, after in zip(scene.occupied, damaged.occupied, strict=True):
            if before.all() or not before.any():
                assert np.array_equal(before, after)
                continue
            border_m = resolution_m * np.where(before, distance_transform_edt(before), distance_transform_edt(~before))
            changed = before != after
            changed_shares.append(changed[border_m <= 0.5].mean())
            assert border_m[changed].max() <= np.hypot(0.5, 0.5) + resolution_m
        assert not damaged.height_m[~damaged.occupied].any()
        assert np.isin(damaged.height_m, scene.height_m).all()
    assert min(changed_shares) > 0.05 and max(changed_shares) < 0.9


@pytest.mark.parametrize("axis", [0, 1])
def test_ground_roughened_border_is_a_sine_of_half_a_metre(axis):
    """A straight border becomes a wave of amplitude 0.5 m and period 2 m, in both directions."""
    grid = Grid(resolution_m=0.03125, rows=256, cols=256)  # 8 m
    straight = np.zeros((5, 256, 256), bool)
    straight[0, :128] = True
    straight = straight.swapaxes(1, 2) if axis else straight
    scene = random_scene(0, 3, grid, occupied=straight, height_m=np.zeros((5, 256, 256), np.float32))
    damaged = damage_scene("ground_roughened", scene, scene, (0,))
    wave_m = (damaged.occupied[0].sum(axis=axis) - 128) * grid.resolution_m
    assert 0.45 < wave_m.max() < 0.55 and -0.55 < wave_m.min() < -0.45
    spectrum = np.abs(np.fft.rfft(wave_m))
    assert spectrum.argmax() == 4 and spectrum[4] > 0.95 * np.linalg.norm(spectrum)  # 4 periods in 8 m


def test_ground_roughened_moves_half_metre_pixels_by_one():
    grid = Grid(resolution_m=0.5, rows=128, cols=128)
    occupied = np.zeros((5, 128, 128), bool)
    occupied[0, :64] = True
    scene = random_scene(0, 3, grid, occupied=occupied, height_m=np.zeros((5, 128, 128), np.float32))
    moved = [damage_scene("ground_roughened", scene, scene, (k,)).occupied[0].sum(axis=0) - 64 for k in range(20)]
    assert set(np.concatenate(moved)) == {-1, 0, 1}


@pytest.mark.parametrize("control", CONTROLS)
def test_control_accepts_empty_scenes_and_bare_ground(control, town_scene):
    nothing = empty_scene()
    assert_same_scene(damage_scene(control, nothing, nothing, (0,)), nothing)
    no_objects = town_scene.select(slice(0))
    damaged = damage_scene(control, no_objects, no_objects, (0,))
    assert len(damaged) == 0
    assert content_differs(damaged, no_objects) == (control in GROUND_CONTROLS)
    bare = make_bare(town_scene)
    damaged = damage_scene(control, bare, bare, (0,))
    assert not damaged.occupied.any() and not damaged.height_m.any()
    if control in ("moved", "permuted", "transplanted"):
        assert np.array_equal(damaged.center_m[:, 2], bare.center_m[:, 2])


def test_transplanted_keeps_z_without_ground(town_scenes):
    scene, donor, _ = town_scenes
    for ground, objects in ((scene, make_bare(donor)), (make_bare(scene), donor)):
        assert_same_primitives(damage_scene("transplanted", ground, objects, (0,)), objects)
    assert len(damage_scene("transplanted", scene, donor.select(slice(0)), (0,))) == 0
    assert len(damage_scene("transplanted", scene.select(slice(0)), donor, (0,))) == len(donor)


def test_unknown_control_names_the_valid_ones(town_scene):
    with pytest.raises(ValueError, match=r"'melted' is unknown, expected one of: moved, turned, .*ground_roughened"):
        damage_scene("melted", town_scene, town_scene, (0,))


def test_controls_have_descriptions_of_one_line():
    assert len(CONTROLS) == 8
    assert all(text and "\n" not in text for text in CONTROLS.values())
