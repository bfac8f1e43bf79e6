"""Tests that compare the rasteriser with vertical rays of trimesh (embree) and with polygons of shapely."""

import numpy as np
import shapely
import trimesh

from models.scene import Grid
from pipelines.geometry.rasterize import cast_rays_down, fill_polygon


def cast_by_rays(triangles_m: np.ndarray, grid: Grid) -> np.ndarray:
    """Return heights (H, W) from embree; a height is -inf if the ray hits nothing."""
    mesh = trimesh.Trimesh(triangles_m.reshape(-1, 3), np.arange(3 * len(triangles_m)).reshape(-1, 3), process=False)
    x, y = np.meshgrid(grid.x_m(), grid.y_m(), indexing="ij")
    origins = np.stack([x, y, np.full_like(x, 100.0)], -1).reshape(-1, 3)
    hits, rays, _ = mesh.ray.intersects_location(origins, np.tile([0.0, 0.0, -1.0], (len(origins), 1)))
    height = np.full(len(origins), -np.inf)
    np.maximum.at(height, rays, hits[:, 2])
    return height.reshape(x.shape)


def draw_triangles(rng: np.random.Generator, n: int) -> np.ndarray:
    center = rng.uniform([-5, -40, -3], [70, 40, 3], (n, 1, 3))
    return center + rng.normal(0, [6, 6, 0.5], (n, 3, 3))


def test_cast_down_equals_ray_casting():
    rng = np.random.default_rng(0)
    grid = Grid()
    triangles = draw_triangles(rng, 200)
    height, hit = cast_rays_down(triangles, grid)
    rays = cast_by_rays(triangles, grid)
    same = np.isfinite(height[0]) == np.isfinite(rays)
    assert same.mean() > 0.999
    both = np.isfinite(height[0]) & np.isfinite(rays)
    assert both.sum() > 10_000
    assert (np.abs(height[0] - rays)[both] < 0.01).mean() > 0.999
    assert ((hit[0] >= 0) == np.isfinite(height[0])).all()


def test_cast_down_prefers_last_triangle_at_equal_height():
    grid = Grid(rows=64, cols=64, resolution_m=1.0)
    level = draw_triangles(np.random.default_rng(3), 60)
    level[..., 2] = 1.5
    height, hit = cast_rays_down(level, grid)
    alone = np.stack([cast_rays_down(triangle[None], grid)[1][0] == 0 for triangle in level])
    assert (height[0][alone.any(axis=0)] == 1.5).all() and (alone.sum(axis=0) > 3).any()
    assert np.array_equal(hit[0], np.where(alone, np.arange(60)[:, None, None], -1).max(axis=0))


def test_cast_down_separates_layers():
    rng = np.random.default_rng(1)
    grid = Grid(rows=64, cols=64, resolution_m=1.0)
    triangles, layer = draw_triangles(rng, 60), rng.integers(0, 3, 60)
    together, hit = cast_rays_down(triangles, grid, layer, 4)
    for k in range(4):
        alone, _ = cast_rays_down(triangles[layer == k], grid)
        assert np.array_equal(together[k], alone[0])
        assert set(layer[hit[k][hit[k] >= 0]]) <= {k}
    assert not np.isfinite(together[3]).any()


def test_cast_down_leaves_no_crack_between_triangles():
    grid = Grid(rows=64, cols=64, resolution_m=1.0)
    corners = np.array([[0, -32, 0], [64, -32, 0], [64, 32, 0], [0, 32, 0]], float)
    for centre in ([32.5, 0.5, 0], [10.1, 3.7, 0], [31.5, -7.5, 0]):
        fan = np.array([[corners[i], corners[(i + 1) % 4], centre] for i in range(4)])
        assert np.isfinite(cast_rays_down(fan, grid)[0]).all()


def test_cast_down_accepts_no_triangles():
    grid = Grid(rows=8, cols=8, resolution_m=1.0)
    vertical = np.array([[[5, 0, 0], [5, 1, 0], [5, 0, 3]]], float)
    for triangles in (np.zeros((0, 3, 3)), vertical, vertical + 500):
        height, hit = cast_rays_down(triangles, grid)
        assert not np.isfinite(height).any() and (hit == -1).all()


def test_polygon_fill_equals_shapely():
    rng = np.random.default_rng(2)
    grid = Grid()
    x, y = np.meshgrid(grid.x_m(), grid.y_m(), indexing="ij")
    for n in (3, 4, 9, 40):
        angle = np.sort(rng.uniform(0, 2 * np.pi, n))
        radius = rng.uniform(5, 45, n)  # the polygon is star-shaped, non-convex and partly outside the grid
        outline = np.stack([32 + radius * np.cos(angle), radius * np.sin(angle)], -1)
        filled = fill_polygon(outline, grid)
        assert filled.any()
        assert np.array_equal(filled, shapely.contains_xy(shapely.Polygon(outline), x, y))
