"""Tests of the classifier two-sample test against scikit-learn, simulation and known differences."""

import numpy as np
import pytest
from sklearn.metrics import roc_auc_score

from pipelines.metrics.two_sample import classify_samples, compute_auc, estimate_auc

NAMES = [f"f{k}" for k in range(12)]


def draw_sides(seed: int, count: int = 200, shift: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    real, generated = rng.normal(size=(2, count, len(NAMES)))
    generated[:, 3] += shift
    return real, generated


def test_auc_equals_scikit_learn_with_ties():
    rng = np.random.default_rng(0)
    for _ in range(5):
        real, generated = rng.integers(0, 8, 60).astype(float), rng.integers(2, 9, 40).astype(float)
        want = roc_auc_score(np.repeat([0, 1], [60, 40]), np.concatenate([real, generated]))
        assert compute_auc(real, generated) == pytest.approx(want)
        assert estimate_auc(np.concatenate([real, generated]), np.repeat([0, 1], [60, 40])).value == pytest.approx(want)


def test_interval_contains_the_true_auc_in_95_percent_of_samples():
    rng, true = np.random.default_rng(1), 0.7602499  # Phi(1 / sqrt 2), for a shift of one standard deviation
    covered = 0
    for _ in range(400):
        found = estimate_auc(rng.normal(size=140) + np.repeat([0, 1], [80, 60]), np.repeat([0, 1], [80, 60]))
        covered += found.low <= true <= found.high
    assert 0.92 <= covered / 400 <= 0.98


def test_interval_of_grouped_scenes_contains_the_true_auc():
    """Scenes of a drive are alike; an interval that took them as independent would be far too narrow."""
    rng, side = np.random.default_rng(2), np.repeat([0, 1], [200, 200])
    groups, covered = np.repeat(np.arange(40), 10), np.zeros(2)
    for _ in range(300):
        score = rng.normal(size=40)[groups] + 0.3 * rng.normal(size=400)
        for k, found in enumerate((estimate_auc(score, side, groups), estimate_auc(score, side))):
            covered[k] += found.low <= 0.5 <= found.high
    assert 0.9 <= covered[0] / 300 <= 0.98 and covered[1] / 300 < 0.7


def test_scores_are_compared_only_within_a_fold():
    side, fold = np.array([0, 1, 0, 1]), np.array([0, 0, 1, 1])
    assert estimate_auc(np.array([0.1, 0.2, 0.8, 0.9]), side, fold=fold).value == 1
    assert estimate_auc(np.array([0.1, 0.2, 0.8, 0.9]), side).value == 0.75
    with pytest.raises(ValueError, match="no fold has both"):
        estimate_auc(np.zeros(4), np.array([0, 0, 1, 1]), fold=fold)


def test_equal_sides_are_not_told_apart_and_a_shift_is_named():
    same = classify_samples(*draw_sides(0), NAMES)
    assert same.auc.low < 0.5 < same.auc.high
    apart = classify_samples(*draw_sides(0, shift=1.5), NAMES)
    assert apart.auc.low > 0.7 and next(iter(apart.features)) == "f3" and apart.features["f3"] > 0.8
    assert apart == classify_samples(*draw_sides(0, shift=1.5), NAMES)  # seeded


def test_missing_values_give_a_side_away():
    real, generated = draw_sides(2)
    generated[::2, 5] = np.nan
    assert classify_samples(real, generated, NAMES).auc.low > 0.55
    real[::2, 5] = np.nan
    again = classify_samples(real, generated, NAMES)
    assert again.auc.low < 0.5 < again.auc.high


def test_scenes_of_a_place_stay_in_one_fold():
    """Each place has its own look. If a place were split, the classifier would recognise it."""
    rng = np.random.default_rng(3)
    looks = rng.normal(scale=5, size=(20, len(NAMES)))
    place = np.repeat(np.arange(20), 20)
    features = looks[place] + rng.normal(size=(400, len(NAMES)))
    sides, places = (features[place < 10], features[place >= 10]), (place[place < 10], place[place >= 10])
    assert classify_samples(*sides, NAMES).auc.value > 0.95
    assert classify_samples(*sides, NAMES, places).auc.value < 0.8


def test_too_few_scenes_or_places_are_an_error():
    real, generated = draw_sides(4, count=9)
    with pytest.raises(ValueError, match="at least 10 scenes per side, got 9 and 9"):
        classify_samples(real, generated, NAMES)
    real, generated = draw_sides(4, count=20)
    with pytest.raises(ValueError, match="at least 5 places per side, got 2 and 20"):
        classify_samples(real, generated, NAMES, (np.arange(20) % 2, np.arange(20) + 9))
    with pytest.raises(ValueError, match="do not match"):
        classify_samples(real, generated[:, 1:], NAMES)
