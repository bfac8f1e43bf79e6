"""Tests of layout statistics against hand-computed values, and of the layout Frechet distance."""

import numpy as np
import pytest

from models.scene import CATEGORIES, CATEGORY_INDEX, Grid, Scene
from pipelines.metrics.frechet import compute_frechet_distance, compute_moments
from pipelines.metrics.statistics import (
    compute_layout_statistics,
    list_statistic_names,
    standardize_statistics,
)

CAR, POLE = CATEGORY_INDEX["vehicle_small"], CATEGORY_INDEX["pole"]


def make_scene(category, size_m) -> Scene:
    n = len(category)
    occupied = np.zeros((2, 4, 4), bool)
    occupied[0, :2] = True
    return Scene(
        "a", "town", "0", 0, "test",
        category=np.asarray(category, np.int8), center_m=np.zeros((n, 3), np.float32),
        rotation=np.tile(np.eye(3, dtype=np.float32), (n, 1, 1)),
        size_m=np.asarray(size_m, np.float32).reshape(n, 3),
        ground_classes=("road", "terrain"), height_m=np.zeros((2, 4, 4), np.float32), occupied=occupied,
        grid=Grid(2.0, 1.0, 0.5, 4, 4),
    )  # fmt: skip


def test_layout_statistics_equal_hand_computed():
    names = list_statistic_names(("road", "terrain"))
    got = dict(
        zip(
            names,
            compute_layout_statistics(make_scene([CAR, POLE, CAR], [[4, 2, 1], [1, 1, 6], [5, 2, 2]])),
            strict=True,
        )
    )
    assert got["num_vehicle_small"] == 2 and got["num_pole"] == 1 and got["num_human"] == 0
    assert got["vehicle_small_length_m"] == 4.5 and got["vehicle_small_height_m"] == 1.5
    assert got["pole_height_m"] == 6
    assert np.isnan(got["human_length_m"])
    assert got["road_share"] == 0.5 and got["terrain_share"] == 0


def test_layout_statistics_of_empty_scene():
    got = compute_layout_statistics(make_scene([], []))
    assert (got[: len(CATEGORIES)] == 0).all() and got[-2] == 0.5


def compute_layout_frechet(reference, other) -> float:
    return compute_frechet_distance(*map(compute_moments, standardize_statistics(reference, other)))


def test_layout_frechet_is_in_reference_deviations():
    rng = np.random.default_rng(0)
    reference = rng.normal(5, [0.1, 10, 3], (4000, 3))
    assert compute_layout_frechet(reference, reference) == pytest.approx(0, abs=1e-9)
    shifted = reference + reference.std(axis=0) * [1, 2, 0]
    assert compute_layout_frechet(reference, shifted) == pytest.approx(1 + 4, rel=1e-9)
    centre = reference.mean(axis=0)
    n = len(reference)
    assert compute_layout_frechet(reference, centre + 2 * (reference - centre)) == pytest.approx(
        3 * n / (n - 1), rel=1e-9
    )


def test_layout_frechet_is_independent_of_units():
    rng = np.random.default_rng(1)
    a, b, unit = rng.normal(size=(50, 4)), rng.normal(1, 2, size=(40, 4)), np.array([1, 100, 0.01, 7])
    assert compute_layout_frechet(a, b) == pytest.approx(compute_layout_frechet(a * unit, b * unit), rel=1e-6)


def test_layout_frechet_is_finite_for_constant_columns():
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(30, 3)), rng.normal(size=(30, 3))
    a[:, 0], b[:, 0] = 2, 5  # the column is constant in each source, and the constants differ by 3 units
    a[::2, 1] = np.nan
    b[:, 2] = np.nan  # the other source lacks this column
    assert compute_layout_frechet(a, b) > 9 and np.isfinite(compute_layout_frechet(a, b))
    filled = np.where(np.isnan(b), a.mean(axis=0), b)
    assert compute_layout_frechet(a[:, [0, 2]], b[:, [0, 2]]) == pytest.approx(
        compute_layout_frechet(a[:, [0, 2]], filled[:, [0, 2]])
    )
    a[:, 1] = np.nan  # the reference lacks this column
    assert np.isfinite(compute_layout_frechet(a, b))
    with pytest.raises(ValueError, match="at least 2 scenes"):
        compute_layout_frechet(a, b[:1])
    with pytest.raises(ValueError, match="equal columns"):
        compute_layout_frechet(a, b[:, :2])
