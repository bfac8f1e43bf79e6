"""Tests of rendered pictures; some tests compare with rays of trimesh."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from helpers import empty_scene, example_scene, random_scene

from models.scene import CATEGORY_INDEX, ELLIPSOID, Grid, Scene
from pipelines.geometry.orthographic import cast_ellipsoids, find_ellipsoids_over, make_oblique_camera, make_top_camera
from pipelines.io.mesh_export import compute_placements, triangulate_cuboids, triangulate_scene
from pipelines.rendering.render import arrange_contact_sheet, render_3d, render_bev
from pipelines.schema.palette import CATEGORY_IDS, CLASS_COLORS, EMPTY, list_ground_ids


def render_literally(scene: Scene, view: Grid) -> np.ndarray:
    """Return class ids (H, W) from intersections of all primitives with vertical lines through the pixel centres.

    If heights are equal, the ground has the highest priority, followed by the last box and by ellipsoids.
    """
    x, y = np.meshgrid(view.x_m(), view.y_m(), indexing="ij")
    height, winner = scene.surface()
    below = scene.grid.pixel(x, y)
    class_id = list_ground_ids(scene)[winner[below]]
    top = np.where(class_id == EMPTY, -np.inf, height[below])
    for k in sorted(range(len(scene)), key=lambda k: (scene.category[k] == ELLIPSOID, -k)):
        center, rotation, size = (part[k].astype(float) for part in (scene.center_m, scene.rotation, scene.size_m))
        # In units of the half extents, the line has the points foot + (z - center[2]) * along.
        foot = 2 * ((x - center[0])[..., None] * rotation[0] + (y - center[1])[..., None] * rotation[1]) / size
        along = 2 * rotation[2] / size
        with np.errstate(divide="ignore", invalid="ignore"):
            if scene.category[k] == ELLIPSOID:
                a, b, c = along @ along, foot @ along, (foot**2).sum(axis=-1) - 1
                z, inside = (np.sqrt(b**2 - a * c) - b) / a, b**2 >= a * c
            else:
                ends = np.stack([(-1 - foot) / along, (1 - foot) / along])
                z = ends.max(axis=0).min(axis=-1)
                inside = z >= ends.min(axis=0).max(axis=-1)
        higher = inside & (center[2] + z > top)
        top[higher], class_id[higher] = center[2] + z[higher], CATEGORY_IDS[scene.category[k]]
    return class_id


@pytest.mark.parametrize("tilt_rad", [0.0, 0.05, np.pi])
@pytest.mark.parametrize("rows, cols, size_px", [(32, 32, 32), (32, 32, 50), (24, 48, 30), (37, 25, 37)])
def test_bev_equals_brute_force(tilt_rad, rows, cols, size_px):
    for seed in range(4):
        grid = Grid(front_m=40, left_m=10, resolution_m=0.5, rows=rows, cols=cols)
        low, high = [grid.back_m, grid.right_m, -2], [grid.front_m, grid.left_m, 3]
        center_m = np.random.default_rng(seed).uniform(low, high, (60, 3)).astype(np.float32)
        scene = random_scene(seed, 60, grid, tilt_rad, center_m=center_m)
        step_m = max(rows, cols) * 0.5 / size_px
        view = Grid(40, 10, step_m, round(rows * 0.5 / step_m), round(cols * 0.5 / step_m))
        np.testing.assert_array_equal(render_bev(scene, size_px), CLASS_COLORS[render_literally(scene, view)])
        fine = Grid(40, 10, step_m / 2, 2 * view.rows, 2 * view.cols)
        blocks = CLASS_COLORS[render_literally(scene, fine)].reshape(view.rows, 2, view.cols, 2, 3)
        np.testing.assert_array_equal(render_bev(scene, size_px, supersample=2), np.round(blocks.mean(axis=(1, 3))))


def test_bev_breaks_ties_by_ground_then_last_box():
    grid = Grid(front_m=4, left_m=4, resolution_m=0.5, rows=16, cols=16)
    car, bus, pole = (CATEGORY_INDEX[name] for name in ("vehicle_small", "vehicle_big", "pole"))
    upright = replace(random_scene(0, 5, grid), rotation=np.tile(np.eye(3, dtype=np.float32), (5, 1, 1)))
    scene = replace(
        upright,
        occupied=np.ones_like(upright.occupied),
        height_m=np.full_like(upright.height_m, 1.0),
        category=np.array([car, bus, ELLIPSOID, car, pole], np.int8),
        center_m=np.array([[0, 0, 1], [1, 0, 1], [0.25, 0.25, 1], [-2, -2, 0.5], [3.25, 3.25, 1]], np.float32),
        size_m=np.array([[2, 2, 2], [2, 2, 2], [3, 3, 2], [2, 2, 1], [0.3, 0.3, 0.1]], np.float32),
    )
    picture = render_bev(scene, 16)
    np.testing.assert_array_equal(picture, CLASS_COLORS[render_literally(scene, grid)])

    def get_color(x_m: float, y_m: float) -> list[int]:
        row, col = grid.pixel(x_m, y_m)
        return picture[row, col].tolist()

    ground = CLASS_COLORS[list_ground_ids(scene)[-2]].tolist()
    assert (
        get_color(-2, -2) == ground and get_color(-3.9, 3.9) == ground
    )  # the ground is visible because the car has the same height
    assert get_color(0.25, 0.25) == get_color(1.25, 0.25) == CLASS_COLORS[CATEGORY_IDS[bus]].tolist()
    assert (
        get_color(-0.75, 0.25) == CLASS_COLORS[CATEGORY_IDS[car]].tolist()
    )  # the car is visible because the ellipsoid is not higher
    assert get_color(3.25, 3.25) == CLASS_COLORS[CATEGORY_IDS[pole]].tolist()
    assert get_color(0.25, 1.5) == CLASS_COLORS[CATEGORY_IDS[ELLIPSOID]].tolist()


@pytest.mark.parametrize("elevation_deg", [90, 38])
def test_bev_shows_ellipsoids_above_surface(elevation_deg):
    scene = random_scene(0, 300, tilt_rad=np.pi)
    camera = make_oblique_camera(scene.grid, 200, 150, 30, elevation_deg)
    depth, _ = cast_ellipsoids(scene, camera)
    rng = np.random.default_rng(0)
    for surface in (np.full(depth.shape, -np.inf), depth, depth + rng.uniform(-1, 1, depth.shape), depth + 20):
        over = np.zeros(depth.shape, bool)
        over.reshape(-1)[find_ellipsoids_over(scene, camera, surface)] = True
        np.testing.assert_array_equal(over, depth > surface)


def test_bev_equals_vertical_rays():
    scene = example_scene(80)
    corners, class_id, _ = triangulate_scene(scene)
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)
    x, y = np.meshgrid(scene.grid.x_m()[1::3], scene.grid.y_m()[1::3], indexing="ij")
    origins = np.stack([x, y, np.full_like(x, 100)], axis=-1).reshape(-1, 3)
    hit = mesh.ray.intersects_first(origins, np.tile([0.0, 0, -1], (len(origins), 1)))
    expected = np.append(class_id, 0)[hit].reshape(x.shape)
    picture = render_bev(scene)[1::3, 1::3]
    same = (picture == CLASS_COLORS[expected]).all(axis=-1)
    # Borders of the ground may differ: its mesh ends at pixel centres, and each triangle has one class.
    assert same.mean() > 0.98
    objects = expected >= 6
    objects &= expected < 17
    assert same[objects].mean() > 0.998


def test_bev_of_bare_ground_is_fused_raster():
    scene = example_scene(0)
    _, winner = scene.surface()
    assert np.array_equal(render_bev(scene), CLASS_COLORS[list_ground_ids(scene)[winner]])


def test_bev_is_deterministic_and_white_where_empty():
    scene = example_scene()
    assert np.array_equal(render_bev(scene), render_bev(scene))
    assert (render_bev(empty_scene()) == 255).all()


@pytest.mark.parametrize("rows, cols, shape", [(256, 256, (256, 256)), (512, 256, (256, 128)), (384, 512, (192, 256))])
def test_bev_fills_picture_for_any_grid(rows, cols, shape):
    grid = Grid(front_m=64 + 32, left_m=32 + 8, rows=rows, cols=cols)
    picture = render_bev(example_scene(150, grid))
    assert picture.shape == (*shape, 3) and picture.dtype == np.uint8
    assert (picture[[0, -1]] < 255).any(axis=(1, 2)).all()


def test_bev_supersampling_keeps_mean_color():
    scene = example_scene()
    fine, coarse = render_bev(scene, 512), render_bev(scene, 256, supersample=2)
    assert coarse.shape == (256, 256, 3)
    assert np.abs(fine.mean(axis=(0, 1)) - coarse.mean(axis=(0, 1))).max() < 0.5


def test_cast_ellipsoids_is_exact():
    scene = example_scene(220)
    scene = scene.select(scene.category == ELLIPSOID)
    grid = Grid(resolution_m=0.5, rows=128, cols=128)
    height, index = cast_ellipsoids(scene, make_top_camera(grid))
    assert np.array_equal(index >= 0, np.isfinite(height))
    row, col = np.nonzero(index >= 0)
    points = np.stack([grid.x_m()[row], grid.y_m()[col], height[row, col]], axis=-1)

    unit_from_scene = np.linalg.inv(compute_placements(scene))
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    radius = np.linalg.norm((unit_from_scene[:, None, :3, :] @ homogeneous[..., None])[..., 0], axis=-1)
    own = radius[index[row, col], np.arange(len(points))]
    assert np.allclose(own, 0.5, atol=1e-6)  # the point is on the surface of the ellipsoid that the ray hits
    homogeneous[:, 2] += 1e-3
    radius = np.linalg.norm((unit_from_scene[:, None, :3, :] @ homogeneous[..., None])[..., 0], axis=-1)
    assert (radius > 0.5 - 1e-6).all()  # no ellipsoid contains a point directly above


def test_cast_ellipsoids_accepts_none():
    scene = empty_scene()
    height, index = cast_ellipsoids(scene, make_top_camera(scene.grid))
    assert not np.isfinite(height).any() and (index == -1).all()
    assert len(triangulate_cuboids(scene).corners_m) == 0


def test_camera_does_not_mirror_and_frames_grid():
    grid = Grid()
    above = make_oblique_camera(grid, 640, 480, azimuth_deg=0, elevation_deg=90)
    assert np.allclose(above.camera_from_scene, np.eye(3), atol=1e-12)
    for azimuth, elevation in ((30, 38), (-120, 20), (90, 75)):
        camera = make_oblique_camera(grid, 640, 480, azimuth, elevation)
        assert np.isclose(np.linalg.det(camera.camera_from_scene), 1)
        corners = [[x, y, z] for x in (0, 64) for y in (-32, 32) for z in (-2, 11)]
        x, y, _ = camera.turn(np.array(corners)).T
        assert camera.view.contains(x, y).all()
    with pytest.raises(ValueError, match="elevation_deg is 0"):
        make_oblique_camera(grid, 640, 480, 30, 0)


def test_oblique_view_ellipsoids_match_their_meshes():
    scene = example_scene(60)
    scene = scene.select(scene.category == ELLIPSOID)
    camera = make_oblique_camera(scene.grid, 200, 150, 30, 38)
    _, hit = cast_ellipsoids(scene, camera)
    corners, _, primitive = triangulate_scene(scene)
    corners, primitive = corners[primitive >= 0], primitive[primitive >= 0]
    turned = camera.turn(corners)
    mesh = trimesh.Trimesh(turned.reshape(-1, 3), np.arange(3 * len(turned)).reshape(-1, 3), process=False)
    x, y = np.meshgrid(camera.view.x_m(), camera.view.y_m(), indexing="ij")
    origins = np.stack([x, y, np.full_like(x, 500)], axis=-1).reshape(-1, 3)
    first = mesh.ray.intersects_first(origins, np.tile([0.0, 0, -1], (len(origins), 1)))
    assert (np.append(primitive, -1)[first].reshape(hit.shape) == hit).mean() > 0.998


def test_picture_3d_has_soft_light_and_is_deterministic():
    scene = example_scene(40)
    picture = render_3d(scene, 240, 180)
    assert picture.shape == (180, 240, 3) and picture.dtype == np.uint8
    assert np.array_equal(picture, render_3d(scene, 240, 180))
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 1000


def test_picture_3d_sunlit_level_ground_has_palette_color():
    picture = render_3d(example_scene(0), 240, 180).reshape(-1, 3).astype(int)
    for name in ("road", "sidewalk", "terrain"):
        color = CLASS_COLORS[{"road": 5, "sidewalk": 3, "terrain": 2}[name]].astype(int)
        assert (np.abs(picture - color).max(axis=1) <= 8).sum() > 100


@pytest.mark.parametrize("rows, cols", [(256, 256), (384, 512)])
def test_picture_3d_accepts_empty_and_stitched_scenes(rows, cols):
    grid = Grid(front_m=96, left_m=cols / 8, rows=rows, cols=cols)
    for n in (0, 30):
        assert render_3d(example_scene(n, grid), 160, 120).std() > 5
    assert render_3d(empty_scene(), 160, 120).shape == (120, 160, 3)


def test_contact_sheet_arranges_pictures():
    pictures = [np.full((40, 60, 3), value, np.uint8) for value in (0, 80, 160)]
    sheet = arrange_contact_sheet(pictures, 2)
    assert sheet.shape == (2 * 40 + 3 * 12, 2 * 60 + 3 * 12, 3)
    assert (sheet[12:52, 12:72] == 0).all() and (sheet[12:52, 84:144] == 80).all()
    assert (sheet[64:104, 84:144] == 255).all()
    assert arrange_contact_sheet(pictures, 5, ["a", "b", "c"]).shape[1] == 3 * 60 + 4 * 12
    with pytest.raises(ValueError, match="3 pictures and 1 captions"):
        arrange_contact_sheet(pictures, 2, ["a"])
