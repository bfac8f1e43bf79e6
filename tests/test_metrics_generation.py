"""FID, Inception score, precision and recall against literal float64 versions of the ADM formulas."""

import warnings

import numpy as np
import pytest
import scipy.linalg

from pipelines.metrics import generation
from pipelines.metrics.generation import (
    Moments,
    frechet_distance,
    inception_score,
    moments,
    neighbour_radii,
    precision_recall,
)

# ------------------------------------------------------------------------------------------ Frechet distance


def literal_fid(x: np.ndarray, y: np.ndarray) -> float:
    """As written by Heusel et al.: a general matrix square root."""
    a, b = np.cov(x, rowvar=False), np.cov(y, rowvar=False)
    root = scipy.linalg.sqrtm(a @ b)
    return float(np.square(x.mean(0) - y.mean(0)).sum() + np.trace(a + b - 2 * np.real(root)))


def sets(rng, n=400, m=300, d=32):
    mix_x, mix_y = rng.normal(size=(2, d, d)) / np.sqrt(d)
    return rng.normal(size=(n, d)) @ mix_x, rng.normal(size=(m, d)) @ mix_y + 0.3


def test_frechet_distance_equals_the_literal_version():
    for seed in range(5):
        x, y = sets(np.random.default_rng(seed))
        assert frechet_distance(moments(x), moments(y)) == pytest.approx(literal_fid(x, y), rel=1e-6)
        assert frechet_distance(moments(x), moments(y)) == pytest.approx(frechet_distance(moments(y), moments(x)))


def test_frechet_distance_in_closed_form():
    """Diagonal covariances: the sum of (mean difference)^2 + (deviation difference)^2."""
    rng = np.random.default_rng(0)
    mean, other_mean = rng.normal(size=(2, 6))
    deviation, other_deviation = rng.uniform(0, 3, (2, 6))
    deviation[0] = other_deviation[1] = 0  # a constant feature
    a = Moments(11, mean, np.diag(deviation**2) * 10)
    b = Moments(21, other_mean, np.diag(other_deviation**2) * 20)
    expected = np.square(mean - other_mean).sum() + np.square(deviation - other_deviation).sum()
    assert frechet_distance(a, b) == pytest.approx(expected, rel=1e-12)


def test_same_constant_and_few_samples_give_the_right_distance():
    rng = np.random.default_rng(1)
    x, _ = sets(rng)
    assert frechet_distance(moments(x), moments(x)) == pytest.approx(0, abs=1e-6)
    assert frechet_distance(moments(x), moments(x + 1)) == pytest.approx(32, rel=1e-6)
    constant = np.ones((10, 4))
    assert frechet_distance(moments(constant), moments(constant + 2)) == pytest.approx(16)
    few, many = rng.normal(size=(5, 32)), rng.normal(size=(500, 32))  # rank 4 of 32
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert frechet_distance(moments(few), moments(many)) == pytest.approx(literal_fid(few, many), rel=1e-4)


def test_moments_add_up_exactly_in_any_grouping():
    rng = np.random.default_rng(2)
    x = rng.normal(1000, 1, size=(500, 8))  # a mean far from 0, where sums of squares lose digits
    parts = [moments(part) for part in np.split(x, [1, 40, 300])]
    for total in (parts[0] + parts[1] + parts[2] + parts[3], (parts[3] + parts[1]) + (parts[0] + parts[2])):
        assert total.count == 500
        np.testing.assert_allclose(total.mean, x.mean(0), rtol=1e-13)
        np.testing.assert_allclose(total.covariance, np.cov(x, rowvar=False), rtol=1e-9, atol=1e-12)


# ------------------------------------------------------------------------------------------ Inception score


def test_inception_score_equals_the_literal_version():
    logits = np.random.default_rng(3).normal(0, 2, (1300, 20))
    scores = []
    for start in range(0, 1300, 500):
        p = np.array([np.exp(row) / np.exp(row).sum() for row in logits[start : start + 500]])
        scores.append(np.exp(np.mean([(row * (np.log(row) - np.log(p.mean(0)))).sum() for row in p])))
    assert inception_score(logits, split_size=500) == pytest.approx(np.mean(scores), rel=1e-9)


def test_inception_score_of_certain_and_of_equal_predictions():
    assert inception_score(np.eye(7).repeat(3, axis=0) * 1e4) == pytest.approx(7)
    assert inception_score(np.ones((9, 7))) == pytest.approx(1)
    assert inception_score(np.array([[1e4, 0.0], [1e4, 0.0]])) == pytest.approx(1)  # a class that never occurs


# ------------------------------------------------------------------------------------------ precision and recall


def brute_force(real: np.ndarray, generated: np.ndarray, k: int) -> tuple[float, float]:
    """Sorted distances and loops; float64 differences, no matrix product."""

    def distances(x, y):
        return np.array([[np.square(p - q).sum() for q in y] for p in x])

    def radii(x):
        every = distances(x, x)
        return np.array([sorted(np.delete(row, i))[k - 1] for i, row in enumerate(every)])

    between = distances(real, generated)
    precision = np.mean(
        [(between[:, j] <= radii_real).any() for radii_real in [radii(real)] for j in range(len(generated))]
    )
    radii_generated = radii(generated)
    recall = np.mean([(between[i] <= radii_generated).any() for i in range(len(real))])
    return float(precision), float(recall)


@pytest.mark.parametrize("seed", range(3))
def test_precision_and_recall_equal_brute_force_exactly(seed, monkeypatch):
    monkeypatch.setattr(generation, "BLOCK_ROWS", 32)
    rng = np.random.default_rng(seed)
    real, generated = rng.normal(size=(90, 6)), rng.normal(0.5, 0.8, size=(70, 6))
    for result in precision_recall(real, generated, k=(1, 3, 5)):
        assert (result.precision, result.recall) == brute_force(real, generated, result.k)
        assert 0 < result.precision <= 1 and 0 < result.recall < 1


def test_distances_that_are_equal_count_as_within():
    """Integer points far from the origin: many ties, exact in differences, blurred in a matrix product."""
    rng = np.random.default_rng(5)
    real, generated = rng.integers(0, 4, (2, 60, 3)).astype(float) + 1e6
    for result in precision_recall(real, generated, k=(1, 2, 3)):
        assert (result.precision, result.recall) == brute_force(real, generated, result.k)


def test_a_memorised_sample_lies_on_the_border_of_a_ball():
    """generated[0] is real[1], the nearest neighbour of the far-away real[0]: its distance is that radius."""
    rng = np.random.default_rng(6)
    base = rng.normal(size=(40, 512))
    generated = rng.normal(50, 1, size=(40, 512))
    generated[0] = base[1]
    got = precision_recall(base, generated, k=[1])[0]
    assert got.precision == 1 / 40
    assert (got.precision, got.recall) == brute_force(base, generated, 1)


def test_duplicated_samples_have_radius_zero_and_still_contain_their_copies():
    rng = np.random.default_rng(7)
    real = np.repeat(rng.normal(size=(5, 16)) * 1e3, 4, axis=0)  # every sample four times: radius 0 at k = 3
    np.testing.assert_array_equal(neighbour_radii(real, [3]), 0)
    got = precision_recall(real, real[::4].repeat(4, axis=0), k=[3])[0]
    assert got.precision == got.recall == 1
    got = precision_recall(real, real + 1e-3, k=[3])[0]
    assert got.precision == got.recall == 0


def test_constant_features_lie_within_each_other_only_if_equal():
    constant = np.full((6, 3), 0.1)
    got = precision_recall(constant, constant, k=[3])[0]
    assert got.precision == got.recall == 1
    got = precision_recall(constant, constant + 1e-9, k=[3])[0]
    assert got.precision == got.recall == 0


def test_bad_features_are_refused():
    x = np.random.default_rng(8).normal(size=(10, 4))
    broken = x.copy()
    broken[3, 1] = np.nan
    with pytest.raises(ValueError, match="hold 3 samples, at least 4"):
        precision_recall(x[:3], x, k=[3])
    with pytest.raises(ValueError, match=r"generated features hold NaN .* first 3"):
        precision_recall(x, broken)
    with pytest.raises(ValueError, match="real features have 4 dimensions, generated 3"):
        precision_recall(x, x[:, :3])
    with pytest.raises(ValueError, match="k must name"):
        precision_recall(x, x, k=[0])
    with pytest.raises(ValueError, match="NaN"):
        moments(broken)
    with pytest.raises(ValueError, match="4 and 3 dimensions"):
        frechet_distance(moments(x), moments(x[:, :3]))
    with pytest.raises(ValueError, match="4 and 3 dimensions"):
        moments(x) + moments(x[:, :3])
    with pytest.raises(ValueError, match="at least 2 samples"):
        frechet_distance(moments(x), moments(x[:1]))
    with pytest.raises(ValueError, match=r"\(samples, dimensions\)"):
        moments(x[0])
    with pytest.raises(ValueError, match="NaN"):
        inception_score(broken)
