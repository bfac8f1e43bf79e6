"""Tests of scene geometry: canonical boxes, the grid, crops and merges."""

import numpy as np
import pytest
from helpers import random_rotations, random_scene

from models.geometry.cholesky import compute_cholesky_parameters, compute_scatter_matrix, decode_cholesky_boxes
from models.scene import Grid, canonicalize_boxes, compute_yaw, merge_scenes


def have_same_corners(a, b):
    """Return True if each corner of `a` is within 1e-6 m of a corner of `b`."""
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) / 2
    first = np.einsum("nij,nkj->nki", a[0], signs[None] * a[1][:, None])
    second = np.einsum("nij,nkj->nki", b[0], signs[None] * b[1][:, None])
    distance = np.linalg.norm(first[:, :, None] - second[:, None], axis=-1)
    return distance.min(axis=2).max() < 1e-6


def test_canonical_boxes_keep_corners():
    rng = np.random.default_rng(0)
    rotation, size = random_rotations(rng, 500), rng.uniform(0.1, 9, (500, 3))
    rotation[::3, :, 0] *= -1  # axes of mirrored boxes
    canonical, lwh = canonicalize_boxes(rotation, size)
    assert have_same_corners((rotation, size), (canonical, lwh))
    assert np.allclose(np.linalg.det(canonical), 1)
    assert (lwh[:, 0] >= lwh[:, 1]).all()
    assert (np.abs(canonical[:, 2, 2]) >= np.abs(canonical[:, 2, :2]).max(axis=1) - 1e-12).all()
    yaw = compute_yaw(canonical)
    assert (yaw >= -np.pi / 2).all() and (yaw < np.pi / 2).all()
    again = canonicalize_boxes(canonical, lwh)
    assert np.allclose(again[0], canonical) and np.allclose(again[1], lwh)


def test_yaw_of_quarter_turns_is_in_range():
    for quarter in range(4):
        angle = quarter * np.pi / 2
        rotation = np.round([[[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]])
        yaw = compute_yaw(canonicalize_boxes(rotation, np.array([[4.0, 2.0, 1.0]]))[0])
        assert -np.pi / 2 <= yaw[0] < np.pi / 2


def test_scatter_matrix_round_trips():
    rng = np.random.default_rng(1)
    rotation, size = random_rotations(rng, 1000), rng.uniform(0.05, 30, (1000, 3))
    parameters = compute_cholesky_parameters(rotation, size)
    assert parameters.shape == (1000, 6)
    back_rotation, back_size = decode_cholesky_boxes(parameters)
    assert np.allclose(
        compute_scatter_matrix(back_rotation, back_size), compute_scatter_matrix(rotation, size), atol=1e-9
    )
    assert np.allclose(np.linalg.det(back_rotation), 1)
    # All choices of axes for a box have the same scatter matrix, but different quaternions.
    assert np.allclose(compute_cholesky_parameters(rotation * [-1, -1, 1], size), parameters)


def test_cholesky_decodes_any_six_numbers():
    rotation, size = decode_cholesky_boxes(np.array([[0.0] * 6, [-1, 2, 0, 3, -4, 1e-9], [1, 0, 1, 0, 0, 1]]))
    assert np.isfinite(rotation).all() and (size >= 0.01).all()
    assert np.allclose(np.linalg.det(rotation), 1)


def test_grid_pixels_and_centers_agree():
    grid = Grid()
    assert grid.x_m()[0] == 63.875 and grid.y_m()[0] == 31.875 and grid.x_m()[-1] == 0.125
    row, col = grid.pixel(grid.x_m(), grid.y_m())
    assert (row == np.arange(256)).all() and (col == np.arange(256)).all()
    assert grid.contains(np.array([64.0, 0.0, 32.0]), np.array([32.0, 0.0, -32.0])).tolist() == [True, False, False]


def test_surface_is_highest_class():
    scene = random_scene(3)
    height, winner = scene.surface()
    for row, col in ((0, 0), (100, 37), (200, 200)):
        classes = np.flatnonzero(scene.occupied[:, row, col])
        if len(classes) == 0:
            assert winner[row, col] == -1 and height[row, col] == 0
        else:
            best = classes[scene.height_m[classes, row, col].argmax()]
            assert winner[row, col] == best and height[row, col] == scene.height_m[best, row, col]


def test_move_and_crop_are_inverse():
    scene = random_scene(4)
    there = Grid(front_m=96.0, left_m=32.0)
    ahead = scene.crop(there)
    assert ahead.occupied[:, :128].sum() == 0
    assert np.array_equal(ahead.occupied[:, 128:], scene.occupied[:, :128])
    assert (ahead.center_m[:, 0] > 32).all() and len(ahead) == (scene.center_m[:, 0] > 32).sum()
    moved = ahead.translate(-32, 0, 1.5)
    assert moved.grid == Grid() and np.allclose(moved.center_m + [32, 0, -1.5], ahead.center_m)
    with pytest.raises(ValueError, match="differ by whole pixels"):
        scene.crop(Grid(front_m=64.1))


def test_merge_assigns_one_owner_per_pixel_and_primitive():
    a, b = random_scene(5), random_scene(6)
    left = np.zeros((256, 256), bool)
    left[:, :128] = True
    joined = merge_scenes([a, b], [left, ~left], a)
    assert np.array_equal(joined.occupied[:, :, :128], a.occupied[:, :, :128])
    assert np.array_equal(joined.height_m[:, :, 128:], b.height_m[:, :, 128:])
    assert len(joined) == (a.center_m[:, 1] > 0).sum() + (b.center_m[:, 1] <= 0).sum()


def test_enlarged_cells_cover_grid_in_blocks():
    grid = Grid(8.0, 3.0, 1.0, 8, 6)
    large = grid.upsample_cells(np.array([[1, 2, 3], [4, 5, 6]]))
    assert large.shape == (8, 6) and (large[:4, 2:4] == 2).all() and (large[4:, :2] == 4).all()
    assert np.array_equal(np.unique(large, return_counts=True)[1], [8] * 6)
