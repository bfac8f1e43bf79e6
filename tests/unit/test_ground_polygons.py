"""Tests of the smooth ground: polygons, meshes and other resolutions, compared with shapely and closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from helpers import empty_scene, example_scene

from models.scene import Grid
from pipelines.geometry.ground_polygons import build_ground_polygons, build_smooth_ground, resample_smoothly


def make_ground(occupied: np.ndarray, height_m: np.ndarray | None = None, resolution_m: float = 0.25):
    """Return a scene without objects and with these masks (5, rows, cols)."""
    rows, cols = occupied.shape[1:]
    grid = Grid(rows * resolution_m, cols * resolution_m / 2, resolution_m, rows, cols)
    height_m = np.zeros(occupied.shape) if height_m is None else height_m
    return replace(empty_scene(), grid=grid, occupied=occupied, height_m=np.float32(height_m * occupied))


def draw_disc(radius_m: float, pixels: int = 256, resolution_m: float = 0.25) -> np.ndarray:
    at = (np.arange(pixels) + 0.5 - pixels / 2) * resolution_m
    return at[:, None] ** 2 + at[None] ** 2 <= radius_m**2


def measure_areas(points: np.ndarray) -> np.ndarray:
    a, b = points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
    return (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2


def test_polygons_partition_ground_without_gaps():
    scene = example_scene()
    shapes = build_ground_polygons(scene)
    _, winner = scene.surface()
    assert len(shapes) >= 3 and all(shape.is_valid for shape in shapes.values())
    total = sum(shape.area for shape in shapes.values())
    assert shapely.union_all(list(shapes.values())).area == pytest.approx(total)
    x, y = np.meshgrid(scene.grid.x_m(), scene.grid.y_m(), indexing="ij")
    for index, name in enumerate(scene.ground_classes):
        inside = shapely.contains_xy(shapes[name], x, y) if name in shapes else np.zeros_like(winner)
        assert np.array_equal(inside, winner == index)


def test_mesh_covers_polygons():
    scene = example_scene()
    shapes, mesh = build_ground_polygons(scene), build_smooth_ground(scene)
    areas = measure_areas(mesh.vertices_m[mesh.triangles])
    assert (areas > 0).all()
    for index, name in enumerate(scene.ground_classes):
        area = shapes[name].area if name in shapes else 0
        assert areas[mesh.class_index == index].sum() == pytest.approx(area)


def test_disc_border_is_smoother_than_pixels():
    occupied = np.zeros((5, 256, 256), bool)
    occupied[1] = draw_disc(20.0)
    occupied[0] = ~occupied[1]
    shapes = build_ground_polygons(make_ground(occupied))
    assert shapes["sidewalk"].area == pytest.approx(np.pi * 400, rel=2e-3)
    assert shapes["sidewalk"].length == pytest.approx(2 * np.pi * 20, rel=0.02)  # Pixels have 8 x 20 m.
    border = shapely.get_coordinates(shapes["sidewalk"]) - [32, 0]
    assert abs(np.linalg.norm(border, axis=1) - 20).max() < 0.1
    assert shapes["road"].area + shapes["sidewalk"].area == pytest.approx(64**2)
    assert len(shapely.get_rings(shapes["road"].geoms[0])) == 2  # The disc is a hole.


def test_ground_keeps_isolated_pixels_and_corners():
    occupied = np.zeros((5, 4, 4), bool)
    occupied[0, 1, 1] = occupied[3, 3, 3] = True
    shapes = build_ground_polygons(make_ground(occupied, resolution_m=1.0))
    assert shapes["road"].contains(shapely.Point(2.5, 0.5))
    assert shapes["terrain"].contains(shapely.Point(0.5, -1.5)) and shapes["terrain"].bounds[0] == 0


def test_three_classes_meet_at_one_point():
    occupied = np.zeros((5, 8, 8), bool)
    occupied[0, :4], occupied[1, 4:, :4], occupied[3, 4:, 4:] = True, True, True
    shapes = build_ground_polygons(make_ground(occupied, resolution_m=1.0))
    assert sum(shape.area for shape in shapes.values()) == pytest.approx(64)
    common = shapely.intersection_all(list(shapes.values()))
    assert isinstance(common, shapely.Point) and common.distance(shapely.Point(4, 0)) < 0.5


def test_mesh_heights_follow_a_plane():
    occupied = np.zeros((5, 64, 64), bool)
    occupied[1] = draw_disc(5.0, 64)
    occupied[0] = ~occupied[1]
    grid = make_ground(occupied).grid
    plane = 0.1 * grid.x_m()[:, None] - 0.05 * grid.y_m()[None] + 1
    mesh = build_smooth_ground(make_ground(occupied, np.broadcast_to(plane, occupied.shape)))
    inner = (abs(mesh.vertices_m[:, 0] - 8) < 7.8) & (abs(mesh.vertices_m[:, 1]) < 7.8)
    x, y, z = mesh.vertices_m[inner].T
    assert np.allclose(z, 0.1 * x - 0.05 * y + 1, atol=1e-5)


def test_resampling_keeps_pixels_and_refines_borders():
    scene = example_scene()
    height_m, winner = scene.surface()
    same_m, same = resample_smoothly(scene, scene.grid)
    assert np.array_equal(same, winner) and np.allclose(same_m, height_m, atol=1e-5)
    occupied = np.zeros((5, 64, 64), bool)
    occupied[0] = draw_disc(5.0, 64)
    coarse = make_ground(occupied)
    fine = replace(coarse.grid, resolution_m=0.0625, rows=256, cols=256)
    truth = draw_disc(5.0, 256, 0.0625)
    error = (resample_smoothly(coarse, fine)[1] == 0) ^ truth
    nearest = occupied[0].repeat(4, axis=0).repeat(4, axis=1) ^ truth
    assert error.sum() < 0.5 * nearest.sum()


def test_simplified_polygons_still_share_borders():
    scene = example_scene()
    exact, simple = build_ground_polygons(scene), build_ground_polygons(scene, 0.2)
    count = [sum(shapely.get_num_coordinates(s) for s in shapes.values()) for shapes in (exact, simple)]
    assert count[1] < 0.5 * count[0]
    total = sum(shape.area for shape in simple.values())
    assert shapely.union_all(list(simple.values())).area == pytest.approx(total, rel=1e-6)
    with pytest.raises(ValueError, match="simplify_m is -1, expected 0 or more"):
        build_ground_polygons(scene, -1)


def test_scene_without_ground_has_no_polygons():
    assert build_ground_polygons(empty_scene()) == {} and len(build_smooth_ground(empty_scene()).triangles) == 0
