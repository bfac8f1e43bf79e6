"""Tests that compare voxelisation with trimesh and with a test of every voxel centre in every primitive."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from helpers import random_rotations, random_scene

import pipelines.geometry.voxels
from models.scene import CATEGORIES, CATEGORY_INDEX, ELLIPSOID, Grid, Scene
from pipelines.geometry.voxels import PRECEDENCE, VoxelGrid, count_outside, voxelize
from pipelines.io.mesh_export import compute_placements, make_unit_cuboid
from pipelines.schema.palette import CATEGORY_IDS, CLASS_ID, EMPTY

# 24 x 20 columns of 0.5 m, 16 levels of 0.5 m.
SMALL = VoxelGrid(Grid(front_m=12.0, left_m=5.0, resolution_m=0.5, rows=24, cols=20), -2.0, 6.0, 16)
CAR, HOUSE = CATEGORY_INDEX["vehicle_small"], CATEGORY_INDEX["construction_big"]


def compute_centers_m(voxels: VoxelGrid) -> np.ndarray:
    """Return the voxel centres (rows, cols, levels, 3) in m."""
    return np.stack(np.meshgrid(voxels.columns.x_m(), voxels.columns.y_m(), voxels.z_m(), indexing="ij"), axis=-1)


def draw_objects(seed: int, n: int = 40, tilt_rad: float = np.pi, voxels: VoxelGrid = SMALL) -> Scene:
    """Return a scene with primitives of any rotation in and around a voxel grid, without ground."""
    rng = np.random.default_rng(seed)
    grid = voxels.columns
    low = np.array([grid.back_m, grid.right_m, voxels.bottom_m]) - 1
    high = np.array([grid.front_m, grid.left_m, voxels.top_m]) + 1
    scene = random_scene(seed, n, grid, tilt_rad)
    center_m = rng.uniform(low, high, (n, 3)).astype(np.float32)
    return replace(scene, center_m=center_m, occupied=np.zeros_like(scene.occupied))


def place_primitive(scene: Scene, k: int, center_m, size_m, category=CAR) -> Scene:
    """Return the scene with primitive k replaced by an axis-aligned box at the given position."""
    parts = [scene.center_m.copy(), scene.size_m.copy(), scene.category.copy(), scene.rotation.copy()]
    for part, value in zip(parts, (center_m, size_m, category, np.eye(3)), strict=True):
        part[k] = value
    return replace(scene, center_m=parts[0], size_m=parts[1], category=parts[2], rotation=parts[3])


def make_one_box(center_m, size_m, category=CAR) -> Scene:
    return place_primitive(draw_objects(0, 1), 0, center_m, size_m, category)


def voxelize_literally(scene: Scene, voxels: VoxelGrid) -> np.ndarray:
    """Test every voxel centre in every primitive. Finer categories overwrite coarser categories."""
    out, at = np.zeros(voxels.shape, np.uint8), compute_centers_m(voxels)
    for name in reversed(PRECEDENCE):
        for k in np.flatnonzero(scene.category == CATEGORY_INDEX[name]):
            local = (at - scene.center_m[k].astype(float)) @ scene.rotation[k].astype(float)
            local /= scene.size_m[k].astype(float) / 2
            within = (local**2).sum(-1) <= 1 if scene.category[k] == ELLIPSOID else (np.abs(local) <= 1).all(-1)
            out[within] = CLASS_ID[name]
    return out


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("tilt_rad", [0.0, 0.05, np.pi])
def test_voxelise_equals_brute_force(seed, tilt_rad):
    scene = draw_objects(seed, tilt_rad=tilt_rad)
    got = voxelize(scene, SMALL)
    np.testing.assert_array_equal(got, voxelize_literally(scene, SMALL))
    assert got.dtype == np.uint8 and 0.05 < (got != EMPTY).mean() < 0.95


def test_voxelise_is_independent_of_chunks(monkeypatch):
    scene = draw_objects(8, n=50)
    whole = voxelize(scene, SMALL)
    monkeypatch.setattr(pipelines.geometry.voxels, "PART_COLUMNS", 100)
    np.testing.assert_array_equal(voxelize(scene, SMALL), whole)


def test_voxelise_equals_brute_force_for_extreme_shapes():
    rng = np.random.default_rng(0)
    scene = draw_objects(1, n=200)
    size_m = rng.choice([0.02, 0.3, 1.0, 14.0], (200, 3)).astype(np.float32)
    scene = replace(scene, size_m=size_m, rotation=random_rotations(rng, 200).astype(np.float32))
    np.testing.assert_array_equal(voxelize(scene, SMALL), voxelize_literally(scene, SMALL))


@pytest.mark.parametrize("seed", range(3))
def test_voxelise_boxes_equal_trimesh(seed):
    scene = draw_objects(seed, n=12).select(slice(None))
    scene = replace(scene, category=np.full(12, CAR, np.int8))
    inside = np.zeros(int(np.prod(SMALL.shape)), bool)
    for transform in compute_placements(scene):
        box = trimesh.Trimesh(*make_unit_cuboid()).apply_transform(transform)
        inside |= box.contains(compute_centers_m(SMALL).reshape(-1, 3))
    assert inside.mean() > 0.02
    np.testing.assert_array_equal((voxelize(scene, SMALL) != EMPTY).reshape(-1), inside)


def test_voxelise_ellipsoids_equal_trimesh_up_to_facets():
    scene = draw_objects(3, n=8)
    scene = replace(scene, category=np.full(8, ELLIPSOID, np.int8), size_m=scene.size_m * 1.5)
    got = (voxelize(scene, SMALL) != EMPTY).reshape(-1)
    points = compute_centers_m(SMALL).reshape(-1, 3)

    def find_points_inside(scale: float) -> np.ndarray:
        found = np.zeros(len(points), bool)
        for transform in compute_placements(scene):
            ball = trimesh.creation.icosphere(subdivisions=4, radius=0.5 * scale)
            found |= ball.apply_transform(transform).contains(points)
        return found

    certain = find_points_inside(1.0)  # the facets are inside the ellipsoid
    assert got[certain].all() and certain.sum() > 500
    assert not got[~find_points_inside(1.005)].any()


def test_voxelise_preserves_volume():
    voxels = VoxelGrid(Grid(front_m=8.0, left_m=8.0, resolution_m=0.1, rows=160, cols=160), -4.0, 4.0, 64)
    for category in (CAR, ELLIPSOID):
        scene = replace(
            draw_objects(5, 1), category=np.array([category], np.int8), center_m=np.zeros((1, 3), np.float32)
        )
        volume_m3 = (voxelize(scene, voxels) != EMPTY).sum() * 0.1 * 0.1 * voxels.step_m
        assert volume_m3 == pytest.approx(scene.volume_m3.sum(), rel=0.02)


def test_voxelise_ignores_order_and_prefers_finer_category():
    scene = draw_objects(2, n=60)
    shuffled = scene.select(np.random.default_rng(0).permutation(60))
    np.testing.assert_array_equal(voxelize(scene, SMALL), voxelize(shuffled, SMALL))
    both = place_primitive(place_primitive(draw_objects(0, 2), 0, [6, 0, 2], [2, 2, 2]), 1, [6, 0, 2], [4, 4, 4], HOUSE)
    got = voxelize(both, SMALL)
    assert (got == CLASS_ID["vehicle_small"]).sum() == 4**3
    assert (got == CLASS_ID["construction_big"]).sum() == 8**3 - 4**3


def test_voxelise_counts_center_on_face_as_inside():
    x, y, z = compute_centers_m(SMALL)[3, 5, 7]
    got = voxelize(
        make_one_box([x + 0.5, y, z], [1.0, 0.01, 0.01]), SMALL
    )  # the box reaches from the centre of row 3 to the centre of row 1
    assert np.argwhere(got).tolist() == [[1, 5, 7], [2, 5, 7], [3, 5, 7]]


def test_voxelise_index_zero_is_farthest_leftmost_lowest():
    got = voxelize(make_one_box([11.75, 4.75, -1.75], [0.2, 0.2, 0.2]), SMALL)
    assert np.argwhere(got).tolist() == [[0, 0, 0]] and got[0, 0, 0] == CATEGORY_IDS[CAR]


# ------------------------------------------------------------------------------------------------------- ground


def voxelize_ground_literally(scene: Scene, voxels: VoxelGrid) -> np.ndarray:
    out = np.zeros(voxels.shape, np.uint8)
    for i, x in enumerate(voxels.columns.x_m()):
        for j, y in enumerate(voxels.columns.y_m()):
            row, col = scene.grid.pixel(x, y)
            heights = [
                (scene.height_m[k, row, col], k)
                for k in range(len(scene.ground_classes))
                if scene.occupied[k, row, col]
            ]
            if heights:
                height_m, k = max(heights)
                level = int(np.floor((float(height_m) - voxels.bottom_m) / voxels.step_m))
                if 0 <= level < voxels.levels:
                    out[i, j, level] = CLASS_ID[scene.ground_classes[k]]
    return out


@pytest.mark.parametrize("pixels", [12, 24, 48])
def test_voxelise_ground_is_voxel_at_surface(pixels):
    """The raster pixels are larger than the voxels, equally large, or smaller."""
    grid = Grid(front_m=12.0, left_m=6.0, resolution_m=12.0 / pixels, rows=pixels, cols=pixels)
    voxels = VoxelGrid(replace(SMALL.columns, left_m=6.0, cols=24), -1.0, -0.2, 8)
    scene = random_scene(4, n=0, grid=grid)
    got = voxelize(scene, voxels)
    np.testing.assert_array_equal(got, voxelize_ground_literally(scene, voxels))
    assert (got != EMPTY).any(axis=2).mean() > 0.3 and ((got != EMPTY).sum(axis=2) <= 1).all()


def test_voxelise_primitives_override_ground():
    scene = random_scene(4, n=30, grid=SMALL.columns)
    scene = replace(scene, center_m=scene.center_m * np.float32([0.2, 0.2, 0.5]))
    bare, ground = replace(scene, occupied=np.zeros_like(scene.occupied)), scene.select([])
    primitives = voxelize(bare, SMALL)
    np.testing.assert_array_equal(
        voxelize(scene, SMALL), np.where(primitives != EMPTY, primitives, voxelize(ground, SMALL))
    )


def test_voxelise_counts_primitives_outside():
    scene = draw_objects(6, n=300)
    corners = compute_placements(scene)[:, :3, :3] @ make_unit_cuboid()[0].T + scene.center_m[:, :, None]
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.5).vertices
    points = compute_placements(scene)[:, :3, :3] @ ball.T + scene.center_m[:, :, None]
    z = [p[2] if c == ELLIPSOID else q[2] for p, q, c in zip(points, corners, scene.category, strict=True)]
    low_m, high_m = np.array([v.min() for v in z]), np.array([v.max() for v in z])
    near = np.abs(np.stack([low_m, high_m]) - np.array([[[-2.0]], [[6.0]]])).min(axis=(0, 1)) < 0.01
    scene, low_m, high_m = scene.select(~near), low_m[~near], high_m[~near]
    got = count_outside(scene, SMALL)
    for c in range(len(CATEGORIES)):
        own = scene.category == c
        partly = own & ((low_m < -2) | (high_m > 6))
        wholly = own & ((high_m < -2) | (low_m > 6))
        assert got.objects[c].tolist() == [own.sum(), partly.sum(), wholly.sum()]
    assert got.objects[:, 2].sum() > 5 and got.ground.tolist() == [0, 0]
    assert (count_outside(scene, SMALL) + got).objects.sum() == 2 * got.objects.sum()


def test_voxelise_counts_and_drops_ground_outside():
    scene = random_scene(4, n=0, grid=SMALL.columns)
    low = replace(scene, height_m=np.where(scene.occupied, np.float32(-2.01), 0))
    high = replace(scene, height_m=np.where(scene.occupied, np.float32(6.0), 0))
    known = scene.occupied.any(axis=0).sum()
    for moved in (low, high):
        assert not voxelize(moved, SMALL).any()
        assert count_outside(moved, SMALL).ground.tolist() == [known, known]
    assert count_outside(scene, SMALL).ground.tolist() == [known, 0]


@pytest.mark.parametrize("levels", [1, 7, 33, 64])
def test_voxelise_accepts_up_to_64_levels(levels):
    voxels = replace(SMALL, levels=levels)
    scene = draw_objects(7)
    np.testing.assert_array_equal(voxelize(scene, voxels), voxelize_literally(scene, voxels))


def test_voxelise_empty_scene_is_empty_with_defaults_of_paper():
    assert VoxelGrid().shape == (256, 256, 32) and VoxelGrid().step_m == 0.25
    assert not voxelize(draw_objects(0, n=0), SMALL).any()


@pytest.mark.parametrize("options", [{"levels": 0}, {"levels": 65}, {"bottom_m": 7.0}, {"top_m": np.nan}])
def test_voxel_grid_rejects_invalid_options(options):
    with pytest.raises(ValueError, match="VoxelGrid"):
        VoxelGrid(**options)
