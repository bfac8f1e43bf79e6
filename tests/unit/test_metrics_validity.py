"""Tests of validity measures on scenes with known values, and comparison of road connectivity with a flood fill."""

from dataclasses import replace

import numpy as np
import pytest

from models.scene import CATEGORY_INDEX, KITTI_GROUND_CLASSES, Grid, Scene, make_yaw_rotation
from pipelines.metrics.validity import (
    LABEL_MEASURES,
    MEASURES,
    OBJECT_MEASURES,
    compute_category_validity,
    compute_label_fidelity,
    compute_scene_validity,
    compute_validity_rates,
    sum_validity,
)
from pipelines.schema.density_labels import DensityThresholds

GRID = Grid(front_m=16.0, left_m=8.0, resolution_m=1.0, rows=16, cols=16)
CAR, POLE, HOUSE, TREE, HUMAN, SIGN = (
    CATEGORY_INDEX[name]
    for name in ("vehicle_small", "pole", "construction_big", "vegetation_cuboid", "human", "traffic_control")
)
SLAB_M = 0.3
ROAD, SIDEWALK, PARKING = 0, 1, 2


def make_town_scene(primitives=(), road=None, heights_m=1.0, **labels) -> Scene:
    """Return a scene with road on the left half (y > 0) and sidewalk on the right half.

    The last row has no ground. All primitives are cubes of 2 m, except houses, which are cubes of 4 m.

    Args:
        primitives: For each primitive: category, x, y, and height of its bottom above the surface (m).
        road: Mask of the road. If it is given, the scene has no other ground. None: road and sidewalk as above.
        heights_m: Height of the surface below the ground slabs.
        labels: Density labels of the scene.
    """
    occupied = np.zeros((5, 16, 16), bool)
    occupied[ROAD, :, :8] = True
    occupied[SIDEWALK, :, 8:] = True
    occupied[PARKING, :2, 8:] = True
    occupied[:, 15] = False
    if road is not None:
        occupied[:] = False
        occupied[ROAD] = road
    n = len(primitives)
    category = np.array([p[0] for p in primitives], np.int8)
    size_m = np.where(category == HOUSE, 4.0, 2.0).astype(np.float32)[:, None] * np.ones(3, np.float32)
    center_m = np.array([[p[1], p[2], heights_m + p[3]] for p in primitives], np.float32).reshape(n, 3)
    center_m[:, 2] += size_m[:, 2] / 2
    return Scene(
        "a", "town", "0", 0, "test", category=category, center_m=center_m,
        rotation=np.tile(np.eye(3, dtype=np.float32), (n, 1, 1)), size_m=size_m,
        ground_classes=KITTI_GROUND_CLASSES, grid=GRID, occupied=occupied,
        height_m=np.where(occupied, np.float32(heights_m + SLAB_M), np.float32(0)), **labels,
    )  # fmt: skip


def measure(name: str, scene: Scene) -> tuple[float, float]:
    return tuple(compute_scene_validity(scene, SLAB_M)[MEASURES.index(name)])


def test_validity_overlap_counts_both_solid_objects_of_a_pair():
    apart, near = (CAR, 3.0, 4.0, 0), (CAR, 4.9, 4.0, 0)  # the IoU3D is 0.1 / 3.9 = 0.026
    name = "overlapping_iou3d"
    assert measure(name, make_town_scene([apart, near])) == (0, 2)
    assert measure(name, make_town_scene([apart, (CAR, 4.5, 4.0, 0)])) == (2, 2)  # 0.5 / 3.5 = 0.14
    assert measure(name, make_town_scene([apart, (TREE, 3.0, 4.0, 0)])) == (0, 1)
    assert measure(name, make_town_scene([apart, (HUMAN, 3.0, 4.0, 0), (POLE, 12.0, -4.0, 0)])) == (2, 3)
    assert measure(name, make_town_scene()) == (0, 0)


def test_validity_overlap_notices_small_object_in_large_one():
    """A cube of 2 m in the corner of a house of 4 m: IoU3D = 8 / 64, or less for a smaller cube; containment = 1."""
    scene = make_town_scene([(HOUSE, 9.0, -4.0, 0), (CAR, 9.5, -4.0, 0)])
    small = scene.size_m * np.array([[1], [0.5]], np.float32)
    scene = replace(scene, size_m=small)  # a cube of 1 m: IoU3D = 1 / 64 = 0.016
    assert measure("overlapping_iou3d", scene) == (0, 2) and measure("overlapping", scene) == (2, 2)
    for shift_m, share in ((1.4, 0.3), (1.6, 0.2)):  # 30 % and 20 % of the car lie in the other car
        pair = make_town_scene([(CAR, 3.0, 4.0, 0), (CAR, 3.0 + shift_m, 4.0, 0)])
        assert measure("overlapping", pair) == (2 * (share > 0.25), 2)
    assert measure("overlapping", make_town_scene([(CAR, 3.0, 4.0, 0), (TREE, 3.0, 4.0, 0)])) == (0, 1)


def test_validity_constructions_are_judged_by_footprint_area():
    """A house of 4 m x 4 m at different distances from the road, which begins at y = 0."""
    for y_m, area_m2 in ((-3.0, 0.0), (-1.9, 0.4), (-1.5, 2.0), (4.0, 16.0)):
        scene = make_town_scene([(HOUSE, 8.0, y_m, 0)])
        assert measure("constructions_on_road", scene) == (area_m2 > 1, 1)
        assert measure("constructions_on_sidewalk", scene) == (16 - area_m2 > 1, 1)
    assert measure("constructions_on_road", make_town_scene([(CAR, 8.0, 4.0, 0)])) == (0, 0)


def test_validity_signs_and_poles_need_a_support():
    """The paper's failure (a): a sign at a height of 3 m, with and without a pole, a wall or a tree next to it."""
    sign = (SIGN, 9.0, -4.0, 3.0)
    assert measure("unattached", make_town_scene([sign])) == (1, 1)
    assert measure("unattached", make_town_scene([(SIGN, 9.0, -4.0, 0.25)])) == (0, 1)  # on the ground
    for x_m, unattached in ((11.25, 0), (11.35, 1)):  # the gap between the cubes is 0.25 m, then 0.35 m
        assert measure("unattached", make_town_scene([sign, (POLE, x_m, -4.0, 2.0)]))[0] == unattached + 1
    assert measure("unattached", make_town_scene([sign, (HOUSE, 9.0, -4.0, 0)])) == (0, 1)
    assert measure("unattached", make_town_scene([sign, (TREE, 9.0, -4.0, 0), (CAR, 9.0, -4.0, 0)])) == (1, 1)


@pytest.mark.parametrize(("turn_deg", "across"), [(0, 0), (30, 0), (60, 1), (90, 1), (180, 0)])
def test_validity_vehicles_follow_the_edge_of_the_road(turn_deg, across):
    scene = make_town_scene([(CAR, 8.0, 3.0, 0), (CAR, 8.0, -4.0, 0)])
    long = scene.size_m * np.array([2, 1, 1], np.float32)
    turned = replace(scene, size_m=long, rotation=make_yaw_rotation(np.full(2, np.radians(turn_deg), np.float32)))
    assert measure("across_lane_vehicles", turned) == (across, 1)  # the second car is not on the road


def test_validity_record_by_category_sums_to_record():
    scene = make_town_scene([(CAR, 5.0, -4.0, 3), (POLE, 9.0, -4.0, 3), (HOUSE, 9.0, 4.0, 0), (HUMAN, 5.0, -4.0, 0)])
    by_category, connectivity = compute_category_validity(scene, SLAB_M)
    np.testing.assert_array_equal(sum_validity(by_category, connectivity), compute_scene_validity(scene, SLAB_M))
    floating = by_category[OBJECT_MEASURES.index("floating")]
    assert floating[CAR].tolist() == [1, 1] and floating[POLE].tolist() == [1, 1] and floating[HUMAN].tolist() == [0, 1]


@pytest.mark.parametrize(("bottom_m", "floats", "sinks"), [(0, 0, 0), (0.45, 0, 0), (0.55, 1, 0), (-0.55, 0, 1)])
def test_validity_floating_is_measured_from_surface_below_slab(bottom_m, floats, sinks):
    scene = make_town_scene([(POLE, 5.0, -4.5, bottom_m), (TREE, 5.0, 3.0, 9)])  # tree crowns may float
    assert measure("floating", scene) == (floats, 1)
    assert measure("sunken", scene) == (sinks, 1)


def test_validity_tilted_box_stands_on_lowest_corner():
    scene = make_town_scene([(POLE, 5.0, -4.5, 0)])
    cos = np.sqrt(0.5)
    tilted = np.array(
        [[[cos, 0, cos], [0, 1, 0], [-cos, 0, cos]]], np.float32
    )  # the lowest corner is sqrt(2) m below the centre
    object.__setattr__(scene, "rotation", tilted)
    assert measure("sunken", scene) == (0, 1)  # the corner is sqrt(2) - 1 = 0.41 m below the surface
    object.__setattr__(scene, "center_m", scene.center_m - np.float32([0, 0, 0.1]))
    assert measure("sunken", scene) == (1, 1)


def test_validity_counts_objects_over_unknown_ground_separately():
    over_nothing, behind, ahead, good = (
        (CAR, 0.5, 4.0, 7),
        (CAR, -3.0, 4.0, 7),
        (CAR, 20.0, -4.0, 7),
        (CAR, 5.0, 4.0, 0),
    )
    scene = make_town_scene([over_nothing, behind, ahead, good])
    assert measure("floating", scene) == (0, 1)
    assert measure("off_road_vehicles", scene) == (0, 1)
    assert measure("over_unknown_ground", scene) == (1, 2)


def test_validity_expects_cars_on_road():
    on_road, parked, on_sidewalk = (CAR, 5.0, 4.0, 0), (CAR, 15.5, -4.0, 0), (CAR, 5.0, -4.0, 0)
    scene = make_town_scene([on_road, parked, on_sidewalk])
    assert measure("off_road_vehicles", scene) == (1, 3)


def compute_share_by_flood_fill(mask: np.ndarray) -> float:
    """Return the share of the pixels of a mask in its largest 4-connected part."""
    left, sizes = set(zip(*np.nonzero(mask), strict=True)), []
    total = len(left)
    while left:
        stack, size = [left.pop()], 0
        while stack:
            row, col = stack.pop()
            size += 1
            for neighbour in ((row - 1, col), (row + 1, col), (row, col - 1), (row, col + 1)):
                if neighbour in left:
                    left.remove(neighbour)
                    stack.append(neighbour)
        sizes.append(size)
    return max(sizes) / total


@pytest.mark.parametrize("seed", range(4))
def test_road_connectivity_equals_flood_fill(seed):
    road = np.random.default_rng(seed).random((16, 16)) < 0.5
    assert measure("road_connectivity", make_town_scene(road=road)) == pytest.approx(
        (compute_share_by_flood_fill(road), 1)
    )


def test_road_connectivity_breaks_at_diagonal_and_skips_no_road():
    assert measure("road_connectivity", make_town_scene(road=np.eye(16, dtype=bool))) == (1 / 16, 1)
    assert measure("road_connectivity", make_town_scene(road=np.zeros((16, 16), bool))) == (0, 0)
    assert measure("road_connectivity", make_town_scene()) == (1, 1)


def test_validity_rates_pool_scenes_and_skip_absent_categories():
    good, bad = (
        make_town_scene([(CAR, 5.0, 4.0, 0)]),
        make_town_scene([(CAR, 5.0, -4.0, 0), (CAR, 9.0, -4.0, 0), (CAR, 12.0, 4.0, 3)]),
    )
    rates = compute_validity_rates([compute_scene_validity(good, SLAB_M), compute_scene_validity(bad, SLAB_M)])
    assert rates["off_road_vehicles"] == 0.5 and rates["floating"] == 0.25
    assert rates["constructions_on_road"] is None
    assert list(rates) == list(MEASURES)
    assert set(compute_validity_rates([]).values()) == {None}


def test_label_fidelity_compares_measured_and_stated_label():
    many = DensityThresholds(count_p25=1.5, count_p75=2.5, volume_p25_m3=10, volume_p75_m3=20)
    three_trees = [(TREE, 3.0 * i, 2.0, 0) for i in range(3)]  # high for 24 m3 of vegetation, low for 0 vehicles
    right = make_town_scene(three_trees, vegetation_density="high", vehicle_density="low")
    wrong = make_town_scene(three_trees, vegetation_density="high", vehicle_density="medium")
    records = [compute_label_fidelity(scene, many, many) for scene in (right, wrong)]
    np.testing.assert_array_equal(records[0][:3], [[1, 1], [1, 1], [1, 1]])
    np.testing.assert_array_equal(records[1][:3], [[1, 1], [0, 1], [0, 1]])
    rates = compute_validity_rates(records, LABEL_MEASURES)
    assert [rates[name] for name in LABEL_MEASURES[:3]] == [1, 0.5, 0.5]
    by_label = {name: rate for name, rate in rates.items() if name in LABEL_MEASURES[3:] and rate is not None}
    assert by_label == {"vegetation_fidelity_high": 1, "vehicle_fidelity_low": 1, "vehicle_fidelity_medium": 0}
    with pytest.raises(ValueError, match="no density label"):
        compute_label_fidelity(make_town_scene(three_trees), many, many)
