"""Tests of layout histograms and their distances against hand-computed values and scipy."""

import numpy as np
import pytest
from helpers import random_scene
from scipy.spatial.distance import jensenshannon
from scipy.stats import wasserstein_distance

from models.scene import CATEGORIES, CATEGORY_INDEX, Grid, Scene
from pipelines.metrics.distributions import (
    ENDS,
    HISTOGRAMS,
    NO_GROUND,
    compute_count_distances,
    compute_histogram_distances,
    compute_jensen_shannon,
    compute_pair_distances,
    compute_scene_histograms,
    compute_wasserstein,
    measure_road_widths,
    normalize_histogram,
)

CAR = CATEGORY_INDEX["vehicle_small"]
GRID = Grid(64.0, 32.0, 0.25, 256, 256)


def make_street(width_px: int, cars_xy_m=(), tilted: bool = False) -> Scene:
    """Return a scene with a straight road, terrain on both sides of the road, and cars of 4 x 2 x 1.5 m."""
    n = len(cars_xy_m)
    occupied = np.zeros((2, 256, 256), bool)
    row, col = np.mgrid[:256, :256]
    across = (col - row) / np.sqrt(2) if tilted else col - 127.5
    occupied[0] = np.abs(across) < width_px / 2
    occupied[1] = ~occupied[0]
    center = np.zeros((n, 3), np.float32)
    if n:
        center[:, :2] = cars_xy_m
    return Scene(
        "a", "town", "0", 0, "test",
        category=np.full(n, CAR, np.int8), center_m=center, rotation=np.tile(np.eye(3, dtype=np.float32), (n, 1, 1)),
        size_m=np.tile(np.float32([4, 2, 1.5]), (n, 1)), ground_classes=("road", "terrain"),
        height_m=np.zeros((2, 256, 256), np.float32), occupied=occupied, grid=GRID,
    )  # fmt: skip


def compute_histogram(scene: Scene, name: str) -> np.ndarray:
    index = [one.name for one in HISTOGRAMS].index(name)
    return compute_scene_histograms(scene)[ENDS[index] - len(HISTOGRAMS[index]) : ENDS[index]]


def find_bin(name: str, value: float) -> int:
    one = next(one for one in HISTOGRAMS if one.name == name)
    return int(np.searchsorted(one.edges, value, side="right") - 1)


def test_histograms_equal_hand_computed():
    scene = make_street(24, [(10, 0), (10, 5), (13, 9)])  # one car is on the road (6 m), two cars are next to it
    below = compute_histogram(scene, "vehicle_small.ground_below")
    names = next(one for one in HISTOGRAMS if one.name == "vehicle_small.ground_below").bins
    assert dict(zip(names, below.tolist(), strict=True)) | {"road": 1, "terrain": 2} == dict(
        zip(names, below, strict=True)
    )
    assert below.sum() == 3 and names[-1] == NO_GROUND
    assert compute_histogram(scene, "vehicle_small.length_m")[find_bin("vehicle_small.length_m", 4.0)] == 3
    pairs = compute_histogram(scene, "vehicle_small.pair_distance_m")
    assert pairs.sum() == 3
    for distance in (5, 5, np.hypot(3, 9)):
        assert pairs[find_bin("vehicle_small.pair_distance_m", distance)] > 0
    to_road = compute_histogram(scene, "vehicle_small.to_road_m")
    assert to_road[0] == 1 and to_road[2] == 1 and to_road[6] == 1
    assert compute_histogram(scene, "pole.length_m").sum() == 0


@pytest.mark.parametrize("tilted", [False, True])
@pytest.mark.parametrize("width_px", [24, 41])
def test_road_width_of_straight_road(width_px, tilted):
    width_m, _ = measure_road_widths(make_street(width_px, tilted=tilted))
    assert len(width_m) >= 200
    assert np.median(width_m) == pytest.approx(width_px * 0.25, abs=0.5)


def test_road_widths_of_scenes_without_or_with_only_road():
    empty = make_street(0)
    assert measure_road_widths(empty)[1] is None and len(measure_road_widths(empty)[0]) == 0
    everywhere = make_street(600)
    assert len(measure_road_widths(everywhere)[0]) == 0 and (measure_road_widths(everywhere)[1] == 0).all()
    assert compute_scene_histograms(empty).sum() == 0


def test_histograms_object_beyond_grid_has_no_ground():
    scene = make_street(24, [(70, 0)])
    below = compute_histogram(scene, "vehicle_small.ground_below")
    assert below[-1] == 1 and below.sum() == 1
    assert compute_histogram(scene, "vehicle_small.to_road_m").sum() == 0


def test_pair_distances_equal_loops():
    points = np.random.default_rng(0).normal(size=(7, 2))
    expected = [np.linalg.norm(points[i] - points[j]) for i in range(7) for j in range(i + 1, 7)]
    assert np.allclose(compute_pair_distances(points), expected)
    assert len(compute_pair_distances(points[:1])) == 0


def test_distribution_distances_equal_scipy():
    rng = np.random.default_rng(1)
    edges = np.sort(rng.uniform(0, 10, 13))
    middle = (edges[1:] + edges[:-1]) / 2
    p, q = (normalize_histogram(rng.integers(0, 5, (20, 12)) + np.eye(12)[:1]) for _ in range(2))
    expected = [wasserstein_distance(middle, middle, a, b) for a, b in zip(p, q, strict=True)]
    assert np.allclose(compute_wasserstein(p, q, edges), expected)
    expected = [jensenshannon(a, b, base=2) ** 2 for a, b in zip(p, q, strict=True)]
    assert np.allclose(compute_jensen_shannon(p, q), expected, atol=1e-12)
    assert compute_jensen_shannon(np.array([[1.0, 0]]), np.array([[0, 1.0]])) == 1
    assert np.isnan(normalize_histogram(np.zeros((1, 3)))).all()


def test_size_distance_of_shift_is_in_meters():
    rng = np.random.default_rng(2)
    scenes = [random_scene(seed, n=60) for seed in range(24)]
    real = np.stack([compute_scene_histograms(scene) for scene in scenes])
    assert all(found.value == 0 for found in compute_histogram_distances(real, real).values())
    near = make_street(24, rng.uniform(5, 60, (30, 2)) - [0, 30])
    near = np.stack([compute_scene_histograms(near)] * 12)
    longer = near.copy()
    index = [one.name for one in HISTOGRAMS].index("vehicle_small.length_m")
    columns = slice(ENDS[index] - len(HISTOGRAMS[index]), ENDS[index])
    longer[:, columns] = np.roll(longer[:, columns], 3, axis=1)
    middle = (HISTOGRAMS[index].edges[1:] + HISTOGRAMS[index].edges[:-1]) / 2
    at = find_bin("vehicle_small.length_m", 4.0)
    got = compute_histogram_distances(near, longer)
    assert got["vehicle_small.length_m"].value == pytest.approx(middle[at + 3] - middle[at])
    assert all(found.value == 0 for name, found in got.items() if name != "vehicle_small.length_m")
    assert "pole.length_m" not in got  # neither source contains the category


def test_count_distance_names_differing_category():
    counts = np.random.default_rng(4).integers(0, 6, (200, len(CATEGORIES)))
    other = counts[::-1].copy()
    other[:, CAR] += 10
    got = compute_count_distances(counts, other)
    assert got["vehicle_small"].value == pytest.approx(10)
    assert got["vehicle_small"].low > 9 and got["vehicle_small"].high < 11
    assert all(got[name].value == pytest.approx(0, abs=1e-12) for name in CATEGORIES if name != "vehicle_small")
