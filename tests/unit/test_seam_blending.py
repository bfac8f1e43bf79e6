"""Tests of ground blending: edges and heights are continuous across the seam."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import random_scene

from models.composition.seam_blending import BLEND_M, MAX_SLOPE, blend_ground, extrapolate_ground
from models.scene import KITTI_GROUND_CLASSES, Grid

GRID = Grid(rows=64, cols=64, resolution_m=0.5, front_m=32.0, left_m=16.0)
ROAD, SIDEWALK = (KITTI_GROUND_CLASSES.index(name) for name in ("road", "sidewalk"))
NEW = np.zeros((64, 64), bool)
NEW[:32] = True  # the generated region begins 16 m ahead
REACH = round(BLEND_M / GRID.resolution_m)


def make_street(left_px: int, height_m: float):
    """Return a scene with a road of 12 pixels that starts at column `left_px`.

    The sidewalk to the left of the road is 0.1 m higher. There is no ground to the right of the road.
    """
    height, occupied = np.zeros((len(KITTI_GROUND_CLASSES), 64, 64), np.float32), np.zeros((5, 64, 64), bool)
    for c, columns, up_m in ((ROAD, slice(left_px, left_px + 12), 0.0), (SIDEWALK, slice(0, left_px), 0.1)):
        occupied[c, :, columns], height[c, :, columns] = True, height_m + up_m
    scene = random_scene(0, n=12, grid=GRID)
    return replace(scene, height_m=height, occupied=occupied)


def test_blend_ground_aligns_shifted_street():
    known, made = make_street(20, 0.0), make_street(23, 0.2)
    bent = blend_ground(made, known, NEW)
    for c in (ROAD, SIDEWALK):
        assert np.array_equal(
            bent.occupied[c, 31], known.occupied[c, 32]
        )  # the road has the same columns on both sides of the seam
        assert np.abs(bent.height_m[c, 31] - known.height_m[c, 32]).max() < 0.003
    # Ahead of the seam, the road edge moves by at most one pixel per row. The height changes by at most 3 cm per row.
    left = bent.occupied[ROAD].argmax(axis=1)[:32]
    assert left[0] == 23 and left[31] == 20 and set(np.diff(left)) <= {0, -1}
    along = np.abs(np.diff(bent.height_m[ROAD, :32, 26]))
    assert along.max() < 0.03
    far = slice(0, 32 - REACH)
    assert np.array_equal(bent.occupied[:, far], made.occupied[:, far])
    assert np.array_equal(bent.height_m[:, far], made.height_m[:, far])


def test_blend_ground_removes_step_at_seam():
    known, made = make_street(20, 0.0), make_street(20, 0.0)
    made.height_m[:, :32] += 0.3 * made.occupied[:, :32]
    bent = blend_ground(made, known, NEW)
    for c, column in ((ROAD, 26), (SIDEWALK, 5)):
        assert abs(bent.height_m[c, 31, column] - known.height_m[c, 32, column]) < MAX_SLOPE * GRID.resolution_m + 0.005
        assert np.allclose(bent.height_m[c, : 32 - REACH], made.height_m[c, : 32 - REACH])


def test_blend_ground_starts_new_class_at_known_height():
    known, made = (
        make_street(64, 0.3),
        make_street(64, 0.0),
    )  # both scenes have only sidewalk: known at 0.4 m, generated at 0.1 m
    made.occupied[SIDEWALK, :32], made.occupied[ROAD, :32] = False, True
    made.height_m[SIDEWALK, :32], made.height_m[ROAD, :32] = 0, 0.1
    bent = blend_ground(made, known, NEW)
    assert not bent.occupied[SIDEWALK, :32].any() and bent.occupied[ROAD, :32].all()
    assert np.abs(bent.height_m[ROAD, 31] - 0.4).max() < 0.005
    assert np.allclose(bent.height_m[ROAD, : 32 - REACH], 0.1)


def test_blend_ground_keeps_known_and_matching_pixels():
    known, made = make_street(20, 0.0), make_street(23, 0.2)
    bent = blend_ground(made, known, NEW)
    for name in ("occupied", "height_m"):
        assert np.array_equal(getattr(bent, name)[:, ~NEW], getattr(made, name)[:, ~NEW])
    same = blend_ground(known, known, NEW)
    assert np.array_equal(same.occupied, known.occupied) and np.allclose(same.height_m, known.height_m, atol=1e-6)
    assert np.array_equal(same.center_m, known.center_m)
    known.height_m[:] += 0.2 * GRID.resolution_m * np.arange(64)[:, None] * known.occupied  # a slope of 20 %
    assert np.allclose(blend_ground(known, known, NEW).height_m, known.height_m, atol=1e-5)


@pytest.mark.parametrize("mask", [np.zeros((64, 64), bool), np.ones((64, 64), bool)])
def test_blend_ground_without_seam_changes_nothing(mask):
    made = make_street(23, 0.2)
    assert blend_ground(made, make_street(20, 0.0), mask) is made


def test_blend_ground_ends_road_gradually_at_empty_ground():
    known, made = make_street(20, 0.0), make_street(20, 0.0)
    made = replace(made, occupied=made.occupied & False, height_m=made.height_m * 0)
    bent = blend_ground(made, known, NEW)
    ahead = bent.occupied[ROAD, :32].any(axis=1)
    assert ahead[31] and not ahead[: 32 - REACH].any()
    other = blend_ground(known, made, NEW)  # the known region is empty, the generated region has a street
    assert not other.occupied[:, 31].any() and np.array_equal(other.occupied[:, 0], known.occupied[:, 0])
    for scene in (bent, other):
        assert not scene.height_m[~scene.occupied].any()


def test_blend_ground_keeps_object_height_above_ground():
    known, made = make_street(20, 0.0), make_street(20, 0.5)
    center = np.tile(np.float32([18.0, 3.0, 1.0]), (12, 1))
    center[6:, 0] = 31.0
    made = replace(made, center_m=center)
    bent = blend_ground(made, known, NEW)
    above_m = [scene.center_m[:, 2] - scene.ground_under()[0] for scene in (made, bent)]
    assert np.allclose(*above_m, atol=1e-6)
    assert (bent.center_m[:6, 2] < 0.75).all() and np.array_equal(bent.center_m[6:], made.center_m[6:])


def test_blend_ground_ignores_unknown_pixels():
    known = make_street(20, 0.0)
    half = replace(known, occupied=known.occupied & ~NEW, height_m=np.where(NEW, 0, known.height_m).astype(np.float32))
    for scene in (extrapolate_ground(half, NEW), extrapolate_ground(known, np.zeros_like(NEW))):
        assert np.array_equal(scene.occupied, known.occupied) and np.array_equal(scene.height_m, known.height_m)
    assert extrapolate_ground(half, np.ones_like(NEW)) is half
