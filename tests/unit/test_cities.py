"""Tests of the measures of large scenes against streets and objects of known positions."""

import numpy as np
import pytest

from models.scene import CATEGORIES, CATEGORY_INDEX, KITTI_GROUND_CLASSES, Grid, Scene
from pipelines.metrics.cities import (
    ANGLE_EDGES_DEG,
    QUANTITIES,
    list_window_grids,
    measure_city,
    measure_city_blocks_m2,
    measure_seams_by_ring,
)

GRID = Grid(front_m=160, left_m=160, resolution_m=0.5, rows=640, cols=640)  # 320 m x 320 m around the origin.
STREETS_M, WIDTH_M = (-96.0, -32.0, 32.0, 96.0), 8.0


def make_city(streets_m=STREETS_M, slope=0.0, end_m=None) -> Scene:
    """Make a city with straight streets along x and y at given positions; streets along x end at end_m."""
    x_m, y_m = np.meshgrid(GRID.x_m(), GRID.y_m(), indexing="ij")
    along_x = np.any([np.abs(y_m - street) < WIDTH_M / 2 for street in streets_m], axis=0)
    if end_m is not None:
        along_x &= x_m < end_m
    along_y = np.any([np.abs(x_m - street) < WIDTH_M / 2 for street in streets_m], axis=0)
    road = along_x | along_y
    height = np.broadcast_to((slope * x_m).astype(np.float32), (5, *x_m.shape)).copy()
    occupied = np.zeros(height.shape, bool)
    occupied[0], occupied[3] = road, ~road
    height[~occupied] = 0
    places_m = np.array([(0.0, 0.0), (0.0, 10.0), (64.0, 0.0), (-150.0, -150.0)], np.float32)
    center_m = np.column_stack([places_m, np.zeros(len(places_m), np.float32)]).astype(np.float32)
    return Scene(
        scene_id="city",
        source="made",
        split="test",
        sequence="made",
        frame=0,
        grid=GRID,
        ground_classes=KITTI_GROUND_CLASSES,
        height_m=height,
        occupied=occupied,
        category=np.full(len(places_m), CATEGORY_INDEX["vehicle_small"], np.int8),
        center_m=center_m,
        rotation=np.broadcast_to(np.eye(3, dtype=np.float32), (len(places_m), 3, 3)).copy(),
        size_m=np.ones((len(places_m), 3), np.float32),
    )


def get_quantity(measured, name: str) -> np.ndarray:
    return measured.quantities[:, QUANTITIES.index(name)]


def test_windows_of_city_have_rings_and_directions():
    windows = measure_city(make_city()).windows
    assert len(windows) == 25 and [sum(w.ring == ring for w in windows) for ring in range(3)] == [1, 8, 16]
    found = {(w.ahead, w.left): w for w in windows}
    assert found[2, 1].direction == "ahead" and found[-1, 1].direction == "behind" and found[0, 2].direction == "left"
    assert found[0, -1].direction == "right" and found[0, 0].direction == "centre"
    scene = found[1, 0].scene
    assert (scene.grid.front_m, scene.grid.left_m, scene.grid.rows) == (64.0, 32.0, 128)
    assert scene.center_m.tolist() == [[32.0, 0.0, 0.0]]  # The car at (64, 0) of the city.


def test_windows_around_chosen_centre_stay_inside():
    places = {(i, j): grid for i, j, grid in list_window_grids(GRID, (96.0, -96.0))}
    assert set(places) == {(i, j) for i in range(-3, 1) for j in range(4)}
    assert (places[0, 0].front_m, places[0, 0].left_m) == (128.0, -64.0)
    with pytest.raises(ValueError, match="hold no window of 64 m"):
        list_window_grids(Grid(rows=100, cols=256))
    with pytest.raises(ValueError, match="no even number of pixels"):
        list_window_grids(Grid(resolution_m=0.3, rows=400, cols=400))


def test_densities_of_windows_are_those_of_the_scene():
    measured = measure_city(make_city(slope=0.05))
    cars = get_quantity(measured, "vehicle_small_per_ha") * 0.4096
    of_place = {(w.ahead, w.left): cars[k] for k, w in enumerate(measured.windows)}
    assert of_place[0, 0] == pytest.approx(2) and of_place[1, 0] == pytest.approx(1) and cars.sum() == pytest.approx(4)
    for name in CATEGORIES:
        if name != "vehicle_small":
            assert not get_quantity(measured, f"{name}_per_ha").any()
    # Half of a street lies along each side of an inner window.
    inner = [k for k, w in enumerate(measured.windows) if w.ring < 2]
    assert get_quantity(measured, "road_share")[inner] == pytest.approx((2 * 8 * 64 - 64) / 64**2)
    assert get_quantity(measured, "annotated_share") == pytest.approx(1)
    assert get_quantity(measured, "slope") == pytest.approx(0.05, rel=0.01)
    assert get_quantity(measured, "level_m") == pytest.approx([0.05 * 64 * w.ahead for w in measured.windows], abs=0.02)


def test_streets_of_grid_have_known_junctions_and_blocks():
    measured = measure_city(make_city())
    assert get_quantity(measured, "junctions_per_ha").sum() * 0.4096 == pytest.approx(16)
    assert not get_quantity(measured, "dead_ends_per_ha").any()
    assert measured.city_blocks_m2 == pytest.approx(9 * [56.0**2])
    assert measured.connectivity == 1
    length_m = get_quantity(measured, "road_m_per_ha") * 0.4096
    assert length_m.sum() == pytest.approx(8 * 320, rel=0.02)
    total = measured.angles_m.sum(axis=0)
    along_x = total[0]  # -5 to 5 degrees.
    along_y = total[ANGLE_EDGES_DEG[:-1] == 85].sum()
    assert along_x == pytest.approx(total.sum() / 2, rel=0.02) and along_y == pytest.approx(along_x, rel=0.02)


def test_streets_that_end_are_dead_ends():
    measured = measure_city(make_city(end_m=70.0))
    ends = get_quantity(measured, "dead_ends_per_ha") * 0.4096
    assert ends.sum() == pytest.approx(4)
    assert {w.ahead for w, count in zip(measured.windows, ends, strict=True) if count} == {1}


def test_blocks_leave_out_islands_and_the_border():
    roads = np.ones((200, 200), bool)
    roads[:, :40] = False  # Touches the border.
    roads[60:120, 60:140] = False
    roads[150:155, 150:155] = False  # 25 m2.
    assert measure_city_blocks_m2(roads, 1.0).tolist() == [4800.0]
    assert len(measure_city_blocks_m2(np.zeros((10, 10), bool), 1.0)) == 0


def test_city_without_ground_has_undefined_heights():
    city = make_city()
    bare = Scene(**{**vars(city), "occupied": np.zeros_like(city.occupied), "height_m": np.zeros_like(city.height_m)})
    measured = measure_city(bare)
    assert np.isnan(measured.connectivity) and not len(measured.city_blocks_m2)
    assert np.isnan(get_quantity(measured, "slope")).all() and not get_quantity(measured, "annotated_share").any()


def test_seams_have_the_ring_of_their_place():
    city = make_city(streets_m=())
    city.height_m[3, 320:] += 0.5  # A step across x = 0.
    found = measure_seams_by_ring(city, rows=[128, 320], cols=[])
    # Pieces of 64 m: rows at x = 96 m (rings 2) and x = 0 m (rings 0 to 2).
    assert {ring: record[1, 0, 1] for ring, record in found.items()} == {0: 128, 1: 2 * 128, 2: 2 * 128 + 5 * 128}
    steps = {ring: record[1, 0, 0] / record[1, 0, 1] for ring, record in found.items()}
    assert steps[0] == steps[1] == pytest.approx(0.5) and steps[2] == pytest.approx(0.5 * 2 / 7)
    assert all(not record[1, 1, 0] for record in found.values())  # Nearby lines have no step.
    with pytest.raises(ValueError, match="seam before pixel 640, expected pixels 1 to 639"):
        measure_seams_by_ring(city, rows=[640], cols=[])


def test_other_seams_are_no_nearby_lines():
    city = make_city(streets_m=())
    city.height_m[3, 320:] += 0.5
    city.height_m[3, :310] += 1.0  # Another seam, 5 m from the first one.
    alone = measure_seams_by_ring(city, rows=[320], cols=[])
    both = measure_seams_by_ring(city, rows=[310, 320], cols=[])
    assert alone[0][1, 1, 0] > 0 and not both[0][1, 1, 0]
