"""Tests of augmentation, which mirrors scenes or displaces the ego vehicle."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import random_scene

from models.augment import Augmentation, mirror_scene, move_vehicle
from models.geometry.cholesky import compute_scatter_matrix
from models.scene import Grid
from pipelines.preprocess.sources.town.generator import generate_town


def test_mirror_reflects_boxes_and_is_an_involution():
    scene = random_scene(0, n=50)
    seen = mirror_scene(scene)
    back = mirror_scene(seen)
    for name in ("center_m", "size_m", "height_m", "occupied"):
        assert np.array_equal(getattr(back, name), getattr(scene, name)), name
    assert np.allclose(back.rotation, scene.rotation, atol=1e-6)
    reflection = np.diag([1, -1, 1])
    want = reflection @ compute_scatter_matrix(scene.rotation, scene.size_m) @ reflection
    assert np.allclose(compute_scatter_matrix(seen.rotation, seen.size_m), want, atol=1e-4)
    assert np.allclose(np.linalg.det(seen.rotation), 1, atol=1e-5)
    x, y = np.meshgrid(scene.grid.x_m(), scene.grid.y_m(), indexing="ij")
    for points in (x, y):  # the raster and the boxes have the same motion
        mean = [(points[None] * s.occupied).sum() / s.occupied.sum() for s in (scene, seen)]
        assert np.isclose(mean[1], -mean[0] if points is y else mean[0], atol=1e-6)
    with pytest.raises(ValueError, match="not symmetric"):
        mirror_scene(scene.translate(0.0, 4.0))


def test_moved_scene_equals_scene_of_drive_at_that_pose():
    drive = generate_town(5)
    dx, dy, turn = 1.5, -0.75, 0.04
    scene = drive.scene(40)
    cos, sin = np.cos(scene.world_yaw_rad), np.sin(scene.world_yaw_rad)
    step = np.array([[cos, -sin], [sin, cos]]) @ [dx, dy]
    world = drive.world_from_imu[40].copy()
    turned = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    world[:, :3], world[:2, 3] = turned @ world[:, :3], world[:2, 3] + step
    poses = drive.world_from_imu.copy()
    poses[40] = world
    want, seen = replace(drive, world_from_imu=poses).scene(40), move_vehicle(scene, dx, dy, turn)
    inner = Grid(front_m=56.0, left_m=24.0, rows=192, cols=192)
    want, seen = want.crop(inner), seen.crop(inner)
    assert len(want) > 30 and want.instance_id.tolist() == seen.instance_id.tolist()
    assert np.allclose(seen.center_m, want.center_m, atol=1e-3)
    assert np.allclose(seen.rotation, want.rotation, atol=1e-4)
    assert (want.occupied == seen.occupied).mean() > 0.99
    both = want.occupied & seen.occupied
    assert np.abs(want.height_m - seen.height_m)[both].max() < 0.05


def test_augmentation_depends_only_on_seed_and_position():
    scene = random_scene(1, n=20)
    augment = Augmentation(flip=True, move_m=1.0, turn_rad=0.04, seed=3)
    again = Augmentation(flip=True, move_m=1.0, turn_rad=0.04, seed=3)
    flips = 0
    for place in range(20):
        first, second = augment(scene, place), again(scene, place)
        assert np.array_equal(first.center_m, second.center_m) and np.array_equal(first.occupied, second.occupied)
        flips += np.sign(first.center_m[0, 1]) != np.sign(scene.center_m[0, 1])
    assert 4 <= flips <= 16
    assert Augmentation()(scene, 0) is scene
