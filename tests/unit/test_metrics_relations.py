"""Tests of relation statistics: known scenes, plain formulas and independent programs (shapely, scipy)."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from helpers import random_scene
from scipy import ndimage

from models.scene import (
    CATEGORIES,
    CATEGORY_INDEX,
    GROUND_CLASSES,
    KITTI_GROUND_CLASSES,
    Grid,
    Scene,
    make_yaw_rotation,
)
from pipelines.metrics.relations import (
    EDGE_LIMIT_M,
    RELATION_HISTOGRAMS,
    RELATIONS,
    compute_scene_relations,
    find_road_edge,
    fuse_ground,
    measure_borders,
    measure_edge_relations,
    measure_edge_widths,
    measure_objects,
)

CAR, POLE, SIGN, WALL = (
    CATEGORY_INDEX[name] for name in ("vehicle_small", "pole", "traffic_control", "construction_small")
)
GRID = Grid()
ROAD, SIDEWALK = 0, 1


def make_street_scene(objects=(), yaw_rad: float = 0.0) -> Scene:
    """Return a scene with a road of 8 m width along x (-4 m < y < 4 m) between two sidewalks.

    Args:
        objects: For each object: category, x, y, yaw (radians), height of the bottom (m).
        yaw_rad: Direction of the road.
    """
    x, y = np.meshgrid(GRID.x_m(), GRID.y_m(), indexing="ij")
    across_m = -np.sin(yaw_rad) * (x - 32) + np.cos(yaw_rad) * y
    occupied = np.zeros((len(KITTI_GROUND_CLASSES), GRID.rows, GRID.cols), bool)
    occupied[ROAD] = np.abs(across_m) < 4
    occupied[SIDEWALK] = ~occupied[ROAD]
    n = len(objects)
    values = np.array(objects, float).reshape(n, 5)
    size_m = np.tile(np.float32([4, 2, 1]), (n, 1))
    return Scene(
        "a", "town", "0", 0, "test", category=values[:, 0].astype(np.int8),
        center_m=np.column_stack([values[:, 1:3], values[:, 4] + 0.5]).astype(np.float32),
        rotation=make_yaw_rotation(values[:, 3]).astype(np.float32), size_m=size_m,
        ground_classes=KITTI_GROUND_CLASSES, grid=GRID, occupied=occupied,
        height_m=np.zeros(occupied.shape, np.float32),
    )  # fmt: skip


def get_relation(scene: Scene, name: str, slab_offset_m: float = 0.0) -> float:
    return float(compute_scene_relations(scene, slab_offset_m).vector[RELATIONS.index(name)])


@pytest.mark.parametrize("street_rad", [0.0, 0.4, -1.1])
def test_edge_relations_equal_geometry_of_straight_road(street_rad):
    rng = np.random.default_rng(0)
    xy = rng.uniform([12, -15], [52, 15], (60, 2))
    yaw = rng.uniform(-np.pi, np.pi, 60)
    scene = make_street_scene([(CAR, *p, a, 0) for p, a in zip(xy, yaw, strict=True)], street_rad)
    edge_m, angle_rad = measure_edge_relations(scene, fuse_ground(scene)[1])
    across = -np.sin(street_rad) * (xy[:, 0] - 32) + np.cos(street_rad) * xy[:, 1]
    assert np.allclose(edge_m, (np.abs(across) - 4).clip(-EDGE_LIMIT_M, EDGE_LIMIT_M), atol=0.3)  # pixels of 0.25 m
    want = np.abs((yaw - street_rad + np.pi / 2) % np.pi - np.pi / 2)
    assert np.abs(angle_rad - want).max() < np.radians(8)


def test_road_edge_equals_erosion_and_ignores_border_of_scene():
    for seed in range(3):
        classes = fuse_ground(random_scene(seed))[1]
        road = classes == GROUND_CLASSES.index("road")
        inner = ndimage.binary_erosion(road, border_value=1)  # pixels outside the scene count as road
        assert set(zip(*map(list, find_road_edge(classes)), strict=True)) == set(
            zip(*np.nonzero(road & ~inner), strict=True)
        )


def test_neighbours_equal_brute_force():
    scene = random_scene(1, n=50)
    found = measure_objects(scene, 0.0, *fuse_ground(scene))
    xy = scene.center_m[:, :2].astype(float)
    for i in range(50):
        others = [j for j in range(50) if j != i and scene.category[j] == scene.category[i]]
        distance = [np.hypot(*(xy[i] - xy[j])) for j in others]
        assert np.isclose(found.neighbour_m[i], min(distance)) if others else np.isnan(found.neighbour_m[i])
        if others:
            j = others[int(np.argmin(distance))]
            gap = (scene.yaw_rad[i] - scene.yaw_rad[j]) % np.pi
            assert np.isclose(found.neighbour_angle_rad[i], min(gap, np.pi - gap), atol=1e-5)


def test_footprint_shares_equal_shapely():
    rng = np.random.default_rng(2)
    objects = [(WALL, *rng.uniform([8, -8], [56, 8]), rng.uniform(-3, 3), 0) for _ in range(40)]
    scene = make_street_scene(objects)
    counts = measure_objects(scene, 0.0, *fuse_ground(scene)).footprint
    road = shapely.box(0, -4, 64, 4)
    for (_, x, y, yaw, _), count in zip(objects, counts, strict=True):
        corners = np.array([[2, 1], [-2, 1], [-2, -1], [2, -1]]) @ make_yaw_rotation(yaw)[:2, :2].T + [x, y]
        share = shapely.Polygon(corners).intersection(road).area / 8
        assert abs(count[ROAD] / count.sum() - share) < 0.12  # 25 points per footprint
    assert counts.sum(axis=1).tolist() == [25] * 40


def test_support_is_ground_then_pole_or_wall_then_nothing():
    sign = (SIGN, 20, 8, 0, 2.0)
    for objects, want in (
        ([(SIGN, 20, 8, 0, 0.2)], 0),
        ([sign], 2),
        ([sign, (POLE, 24.2, 8, 0, 1.5)], 1),
        ([sign, (POLE, 24.4, 8, 0, 1.5)], 2),
        ([sign, (CAR, 20, 8, 0, 1.0)], 2),  # a car does not support a sign
    ):
        scene = make_street_scene(objects)
        assert measure_objects(scene, 0.0, *fuse_ground(scene)).support[0] == want


def test_borders_and_small_parts_equal_plain_count():
    rng = np.random.default_rng(3)
    classes = ndimage.zoom(rng.integers(-1, 6, (12, 12)), 4, order=0)
    classes[5, 5], classes[20, 30] = 0, 4
    perimeter, small = measure_borders(classes, 0.25)
    for k in range(len(GROUND_CLASSES)):
        mask = classes == k
        sides = sum((mask[1:] != mask[:-1]).sum() if axis else (mask[:, 1:] != mask[:, :-1]).sum() for axis in (0, 1))
        assert np.isclose(perimeter[k], sides * 0.25 / (mask.sum() * 0.25**2))
        parts, count = ndimage.label(mask)
        areas = np.bincount(parts.ravel())[1:] * 0.25**2
        assert small[k] == (areas < 1).sum() and count == len(areas)


def test_edge_width_of_straight_road_is_its_width():
    scene = make_street_scene()
    widths_m = measure_edge_widths(fuse_ground(scene)[1], GRID.resolution_m)
    assert np.all(widths_m == 8.0)


# ------------------------------------------------------------------------------------------------ meaning


def test_relations_notice_what_layout_statistics_do_not():
    """The audit's damages leave all layout statistics unchanged; each changes a relation as expected."""
    cars = [(CAR, 8.0 * k + 6, 3.0 if k % 2 else -3.0, 0.0, 0) for k in range(6)]
    scene = make_street_scene(cars)
    assert get_relation(scene, "vehicle_small.along_edge") > 0.98
    turned = replace(scene, rotation=make_yaw_rotation(np.full(6, np.pi / 4)).astype(np.float32))
    assert abs(get_relation(turned, "vehicle_small.along_edge")) < 0.1
    assert (
        get_relation(turned, "vehicle_small.square_to_edge")
        < -0.95
        < get_relation(scene, "vehicle_small.square_to_edge")
    )
    assert get_relation(scene, "vehicle_small.near_road_edge") == 0 or get_relation(scene, "vehicle_small.on_road") == 1
    away = replace(scene, center_m=scene.center_m + np.float32([0, 10, 0]))
    assert get_relation(away, "vehicle_small.on_road") == 0 and get_relation(away, "vehicle_small.road_edge_m") > 3
    doubled = make_street_scene([*cars, (CAR, 6.2, -3.0, 0.0, 0)])
    assert get_relation(doubled, "vehicle_small.touching") == pytest.approx(2 / 7)
    raised = replace(scene, center_m=scene.center_m + np.float32([0, 0, 1]))
    assert (
        get_relation(raised, "vehicle_small.gap_m") == pytest.approx(1)
        and get_relation(raised, "vehicle_small.supported") == 0
    )
    assert get_relation(scene, "vehicle_small.gap_m", slab_offset_m=0.3) == pytest.approx(0.3)


def test_relations_are_undefined_without_objects_or_road():
    empty = make_street_scene()
    vector, histograms = compute_scene_relations(empty, 0.0)
    assert len(vector) == len(RELATIONS) and len(histograms) == sum(map(len, RELATION_HISTOGRAMS))
    per_category = vector[: len(CATEGORIES) * 13]
    assert np.isnan(per_category).all() and np.isfinite(get_relation(empty, "road.perimeter_per_m"))
    bare = replace(make_street_scene([(CAR, 20, 0, 0, 0)]), occupied=np.zeros_like(empty.occupied))
    for name in ("vehicle_small.road_edge_m", "vehicle_small.on_road", "vehicle_small.gap_m", "road.perimeter_per_m"):
        assert np.isnan(get_relation(bare, name))
    assert get_relation(bare, "vehicle_small.supported") == 0
