"""Tests of the suppression of duplicate objects, which keeps the object with higher confidence."""

from dataclasses import replace

import numpy as np
from helpers import random_scene

from models.composition.deduplicate import REGENERATED_IOU3D, find_lower_confidence_duplicates, find_regenerated_objects
from models.geometry.iou3d import compute_iou3d_matrix, extract_boxes
from models.scene import CATEGORY_INDEX, Grid

SMALL = Grid(rows=32, cols=32, resolution_m=2.0)


def make_row_of_boxes(shift_m, existence, category="construction_small"):
    """Return upright boxes of 4 x 1 x 1 m in a row along x, at distances `shift_m` from the first box."""
    n = len(shift_m)
    center = np.stack([20 + np.asarray(shift_m, np.float32), np.zeros(n), np.ones(n)], axis=1).astype(np.float32)
    return replace(
        random_scene(0, n=n, grid=SMALL),
        center_m=center,
        rotation=np.tile(np.eye(3, dtype=np.float32), (n, 1, 1)),
        size_m=np.tile(np.float32([4, 1, 1]), (n, 1)),
        category=np.full(n, CATEGORY_INDEX[category], np.int8),
        existence=np.asarray(existence, np.float32),
    )


def test_find_duplicates_finds_known_object():
    scene = random_scene(0, n=10, grid=SMALL)
    near = replace(scene, center_m=scene.center_m + np.float32(0.01))
    assert (
        find_regenerated_objects(near, scene).all()
        and not find_regenerated_objects(near, scene.select(slice(0, 0))).any()
    )
    assert not find_regenerated_objects(replace(near, category=(near.category + 1) % 11), scene).any()


def test_find_duplicates_finds_shifted_copy_but_no_neighbor():
    known = make_row_of_boxes([0], [0.9], "vegetation_cuboid")
    # The IoU of boxes at 0 m and 2.5 m is 1.5 / 6.5. The box at 2.5 m is a copy of the known box, except if another
    # generated box is closer to the known box.
    far_copy, near_copy = [2.5, 7], [0.2, 2.5]
    for shift_m, again in ((far_copy, [True, False]), (near_copy, [True, False]), ([3.9, 7], [False, False])):
        assert (
            find_regenerated_objects(make_row_of_boxes(shift_m, [0.9, 0.9], "vegetation_cuboid"), known).tolist()
            == again
        )


def test_find_duplicates_keeps_slightly_overlapping_neighbors():
    known = make_row_of_boxes([0, 7.3], [0.9, 0.9], "vegetation_cuboid")
    made = make_row_of_boxes(
        [3.6, -3.65], [0.9, 0.9], "vegetation_cuboid"
    )  # IoUs with the known boxes: 0.053 and 0.039 for the first box, 0.046 for the second box
    overlaps = compute_iou3d_matrix(extract_boxes(made), extract_boxes(known))
    assert (
        overlaps[0, 0] > REGENERATED_IOU3D > overlaps[1, 0] > 0
        and 0 < overlaps[0, 1] < REGENERATED_IOU3D < overlaps[1, 0] + overlaps[0, 1]
    )
    assert find_regenerated_objects(made, known).tolist() == [True, False]


def test_suppress_duplicates_keeps_higher_confidence():
    assert find_lower_confidence_duplicates(make_row_of_boxes([0, 1], [0.6, 0.9])).tolist() == [
        True,
        False,
    ]  # the IoU is 3 / 5
    assert find_lower_confidence_duplicates(make_row_of_boxes([0, 1], [0.7, 0.7])).tolist() == [
        False,
        True,
    ]  # the first of two boxes with equal confidence is kept
    assert find_lower_confidence_duplicates(make_row_of_boxes([0, 3], [0.6, 0.9])).tolist() == [
        False,
        False,
    ]  # adjacent parts of a fence have an IoU of 1 / 7


def test_suppress_duplicates_uses_threshold_of_category():
    for category, both_stay in (("vehicle_small", False), ("vehicle_big", False), ("construction_big", True)):
        assert find_lower_confidence_duplicates(make_row_of_boxes([0, 3], [0.9, 0.6], category)).tolist() == [
            False,
            not both_stay,
        ]  # the IoU is 1 / 7
        assert not find_lower_confidence_duplicates(
            make_row_of_boxes([0, 3.9], [0.9, 0.6], category)
        ).any()  # the IoU is 1 / 79
        assert find_lower_confidence_duplicates(make_row_of_boxes([0, 2], [0.9, 0.6], category)).tolist() == [
            False,
            True,
        ]  # the IoU is 1 / 3
        made, known = make_row_of_boxes([0, 3], [0.9, 0.9], category), make_row_of_boxes([0], [0.6], category)
        assert find_regenerated_objects(made, known).tolist() == [True, not both_stay]


def test_suppress_duplicates_ignores_suppressed_objects():
    # The middle box has an IoU of 1 / 3 with each outer box. The outer boxes do not overlap.
    def find(existence):
        return find_lower_confidence_duplicates(make_row_of_boxes([0, 2, 4], existence, "object")).tolist()

    assert find([0.9, 0.8, 0.7]) == [False, True, False]
    assert find([0.7, 0.9, 0.8]) == [True, False, True]


def test_suppress_duplicates_removes_walls_in_buildings():
    def find(centre_m, house_existence=0.5):
        """Return whether each of a building of 10 x 10 x 6 m and a wall of 4 x 1 x 1 m at a place (m) is removed."""
        scene = make_row_of_boxes([0, 0], [house_existence, 0.9])
        return find_lower_confidence_duplicates(
            replace(
                scene,
                center_m=np.float32([[20, 0, 3], centre_m]),
                size_m=np.float32([[10, 10, 6], [4, 1, 1]]),
                category=np.int8([CATEGORY_INDEX["construction_big"], CATEGORY_INDEX["construction_small"]]),
            )
        ).tolist()

    assert find((20, 0, 1)) == [False, True]  # The building stays although its existence probability is lower.
    assert find((24.9, 0, 1)) == [False, True]  # 52.5 % of the wall lie inside.
    assert find((25.1, 0, 1)) == [False, False]  # 47.5 % lie inside.
    assert find((20, 0, 6.1)) == [False, False]  # 40 % lie below the roof.


def test_suppress_duplicates_keeps_walls_without_building():
    doubled = make_row_of_boxes([0, 0, 0], [0.9, 0.8, 0.9])
    house = CATEGORY_INDEX["construction_big"]
    doubled = replace(doubled, category=np.int8([CATEGORY_INDEX["construction_small"], house, house]))
    # The building with the lower probability is a duplicate of the other one, in which the wall lies.
    assert find_lower_confidence_duplicates(doubled).tolist() == [True, True, False]
    apart = replace(doubled, center_m=doubled.center_m + np.float32([[0, 0, 0], [9, 0, 0], [9, 0, 0]]))
    assert find_lower_confidence_duplicates(apart).tolist() == [False, True, False]


def test_suppress_duplicates_keeps_plants_and_other_categories():
    assert not find_lower_confidence_duplicates(make_row_of_boxes([0, 1], [0.6, 0.9], "vegetation_cuboid")).any()
    pair = make_row_of_boxes([0, 1], [0.6, 0.9])
    mixed = replace(pair, category=np.array([pair.category[0], CATEGORY_INDEX["pole"]], np.int8))
    assert not find_lower_confidence_duplicates(mixed).any()
    assert find_lower_confidence_duplicates(pair.select(slice(0, 0))).shape == (0,)
