"""Tests of generation scores against definitions in float64, and of the coverage of confidence intervals."""

import warnings

import numpy as np
import pytest
import scipy.linalg

from pipelines.metrics import inception_score as inception_score_module
from pipelines.metrics import kernel_distance as kernel_distance_module
from pipelines.metrics import neighbours
from pipelines.metrics.frechet import (
    Moments,
    compute_frechet_distance,
    compute_frechet_influence,
    compute_influence_maps,
    compute_moments,
    compute_transport,
)
from pipelines.metrics.inception_score import compute_inception_score
from pipelines.metrics.intervals import estimate_from_influence, estimate_mean, estimate_ratios
from pipelines.metrics.kernel_distance import compute_kernel_distance
from pipelines.metrics.neighbours import (
    compute_ball_radii,
    compute_neighbourhoods,
    compute_principal_axes,
    find_nearest,
    prepare_features,
    project_to_axes,
)

# ------------------------------------------------------------------------------------------ Frechet distance


def compute_literal_fid(x: np.ndarray, y: np.ndarray) -> float:
    """Return the FID of Heusel et al. 2017, computed with a general matrix square root."""
    a, b = np.cov(x, rowvar=False), np.cov(y, rowvar=False)
    root = scipy.linalg.sqrtm(a @ b)
    return float(np.square(x.mean(0) - y.mean(0)).sum() + np.trace(a + b - 2 * np.real(root)))


def draw_feature_sets(rng, n=400, m=300, d=32):
    mix_x, mix_y = rng.normal(size=(2, d, d)) / np.sqrt(d)
    return rng.normal(size=(n, d)) @ mix_x, rng.normal(size=(m, d)) @ mix_y + 0.3


def test_frechet_distance_equals_literal_version():
    for seed in range(5):
        x, y = draw_feature_sets(np.random.default_rng(seed))
        assert compute_frechet_distance(compute_moments(x), compute_moments(y)) == pytest.approx(
            compute_literal_fid(x, y), rel=1e-6
        )
        assert compute_frechet_distance(compute_moments(x), compute_moments(y)) == pytest.approx(
            compute_frechet_distance(compute_moments(y), compute_moments(x))
        )


def test_frechet_distance_equals_closed_form():
    """For diagonal covariances, the distance is sum((m1 - m2)^2 + (s1 - s2)^2) with means m and standard deviations
    s."""
    rng = np.random.default_rng(0)
    mean, other_mean = rng.normal(size=(2, 6))
    deviation, other_deviation = rng.uniform(0, 3, (2, 6))
    deviation[0] = other_deviation[1] = 0  # each side has one constant feature
    a = Moments(11, mean, np.diag(deviation**2) * 10)
    b = Moments(21, other_mean, np.diag(other_deviation**2) * 20)
    expected = np.square(mean - other_mean).sum() + np.square(deviation - other_deviation).sum()
    assert compute_frechet_distance(a, b) == pytest.approx(expected, rel=1e-12)


def test_frechet_distance_handles_constant_and_few_samples():
    rng = np.random.default_rng(1)
    x, _ = draw_feature_sets(rng)
    assert compute_frechet_distance(compute_moments(x), compute_moments(x)) == pytest.approx(0, abs=1e-6)
    assert compute_frechet_distance(compute_moments(x), compute_moments(x + 1)) == pytest.approx(32, rel=1e-6)
    constant = np.ones((10, 4))
    assert compute_frechet_distance(compute_moments(constant), compute_moments(constant + 2)) == pytest.approx(16)
    few, many = rng.normal(size=(5, 32)), rng.normal(size=(500, 32))  # the covariance of five samples has rank 4 of 32
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert compute_frechet_distance(compute_moments(few), compute_moments(many)) == pytest.approx(
            compute_literal_fid(few, many), rel=1e-4
        )


def test_moments_add_up_exactly_in_any_grouping():
    rng = np.random.default_rng(2)
    x = rng.normal(1000, 1, size=(500, 8))  # sums of squares lose digits because the mean is far from 0
    parts = [compute_moments(part) for part in np.split(x, [1, 40, 300])]
    for total in (parts[0] + parts[1] + parts[2] + parts[3], (parts[3] + parts[1]) + (parts[0] + parts[2])):
        assert total.count == 500
        np.testing.assert_allclose(total.mean, x.mean(0), rtol=1e-13)
        np.testing.assert_allclose(total.covariance, np.cov(x, rowvar=False), rtol=1e-9, atol=1e-12)


# ------------------------------------------------------------------------------------------ Inception score


def test_inception_score_equals_literal_version(monkeypatch):
    monkeypatch.setattr(inception_score_module, "SPLIT_SAMPLES", 500)
    logits = np.random.default_rng(3).normal(0, 2, (1300, 20))
    scores = []
    for start in range(0, 1300, 500):
        p = np.array([np.exp(row) / np.exp(row).sum() for row in logits[start : start + 500]])
        scores.append(np.exp(np.mean([(row * (np.log(row) - np.log(p.mean(0)))).sum() for row in p])))
    assert compute_inception_score(logits).value == pytest.approx(np.mean(scores), rel=1e-9)


def test_inception_score_of_certain_and_equal_predictions():
    assert compute_inception_score(np.eye(7).repeat(3, axis=0) * 1e4).value == pytest.approx(7)
    assert compute_inception_score(np.ones((9, 7))).value == pytest.approx(1)
    assert compute_inception_score(np.array([[1e4, 0.0], [1e4, 0.0]])).value == pytest.approx(
        1
    )  # the second class never occurs


# ------------------------------------------------------------------------------------------ neighbourhoods


def compute_by_brute_force(real: np.ndarray, generated: np.ndarray, k: int) -> tuple[float, float, float, float]:
    """Compute precision, recall, density and coverage with loops over sorted float64 distances."""
    real, generated = real.astype(np.float64), generated.astype(np.float64)

    def distances(x, y):
        return np.array([[np.square(p - q).sum() for q in y] for p in x])

    def radii(x):
        every = distances(x, x)
        return np.array([sorted(np.delete(row, i))[k - 1] for i, row in enumerate(every)])

    between, radii_real, radii_generated = distances(real, generated), radii(real), radii(generated)
    precision = np.mean([(between[:, j] <= radii_real).any() for j in range(len(generated))])
    recall = np.mean([(between[i] <= radii_generated).any() for i in range(len(real))])
    density = np.mean([(between[:, j] <= radii_real).sum() for j in range(len(generated))]) / k
    coverage = np.mean([(between[i] <= radii_real[i]).any() for i in range(len(real))])
    return precision, recall, density, coverage


def compute_scores(real, generated, k) -> list[tuple]:
    found = compute_neighbourhoods(real, generated, k)
    return [(one.precision, one.recall, one.density, one.coverage) for one in found]


def draw_clustered_features(rng, n: int, d: int, shift: float) -> np.ndarray:
    """Return features with few strong and many weak directions, like real features.

    For such features, the filter of nearest neighbours decides most pairs, but not all pairs.
    """
    strength = 0.85 ** np.arange(d)
    return (shift + rng.normal(size=(n, d)) + rng.integers(0, 3, (n, 1))) * strength


@pytest.mark.parametrize("seed", range(9))
def test_neighborhood_scores_equal_brute_force(seed, monkeypatch):
    monkeypatch.setattr(neighbours, "BLOCK_ROWS", 32)
    rng = np.random.default_rng(seed)
    if seed % 3 == 1:
        real, generated = rng.normal(size=(90, 6)), rng.normal(0.5, 0.8, size=(70, 6))
    elif seed % 3 == 2:  # the filter uses all features because there are no dominant axes
        monkeypatch.setattr(neighbours, "BASIS_SAMPLES", 20)
        real, generated = rng.normal(size=(90, 50)), rng.normal(0.05, 0.98, size=(70, 50))
        assert not prepare_features(real, generated, (3,))[0].rest.any()
    else:
        real, generated = (
            draw_clustered_features(rng, 90, 60, 0).astype(np.float32),
            draw_clustered_features(rng, 130, 60, 0.3).astype(np.float32),
        )
        assert len(compute_principal_axes(real, generated).axes) < 30
    for k, got in zip((1, 3, 5), compute_scores(real, generated, (1, 3, 5)), strict=True):
        assert got == compute_by_brute_force(real, generated, k)
        assert 0 < got[0] <= 1 and 0 < got[1] <= 1


def test_neighborhood_scores_count_ties_as_within():
    """Integer points far from the origin have many equal distances. A matrix product does not compute these distances
    exactly."""
    rng = np.random.default_rng(5)
    real, generated = rng.integers(0, 4, (2, 60, 3)).astype(float) + 1e6
    for k, got in zip((1, 2, 3), compute_scores(real, generated, (1, 2, 3)), strict=True):
        assert got == compute_by_brute_force(real, generated, k)


def test_neighborhood_scores_include_border_of_ball():
    """generated[0] equals real[1]. Therefore generated[0] lies on the border of each ball whose radius is the distance
    to real[1]."""
    rng = np.random.default_rng(6)
    base = rng.normal(size=(40, 512))
    generated = rng.normal(50, 1, size=(40, 512))
    generated[0] = base[1]
    got = compute_scores(base, generated, [1])[0]
    assert got[0] == 1 / 40
    assert got == compute_by_brute_force(base, generated, 1)


def test_neighborhood_of_duplicates_contains_copies():
    rng = np.random.default_rng(7)
    real = np.repeat(
        rng.normal(size=(5, 16)) * 1e3, 4, axis=0
    )  # each sample occurs four times, so the radius for k = 3 is 0
    side = project_to_axes(real, compute_principal_axes(real, real))
    np.testing.assert_array_equal(compute_ball_radii(side, range(20), [3]), 0)
    assert compute_scores(real, real[::4].repeat(4, axis=0), [3])[0][:2] == (1, 1)
    assert compute_scores(real, real + 1e-3, [3])[0] == (0, 0, 0, 0)


def test_neighborhood_of_constant_features_requires_equality():
    constant = np.full((6, 3), 0.1)
    assert compute_scores(constant, constant, [3])[0] == (1, 1, 2, 1)
    assert compute_scores(constant, constant + 1e-9, [3])[0] == (0, 0, 0, 0)


def test_nearest_returns_neighbors_in_order(monkeypatch):
    rng = np.random.default_rng(9)
    a, b = draw_clustered_features(rng, 50, 40, 0), draw_clustered_features(rng, 80, 40, 0)
    b[30] = b[60]  # if two distances are equal, the lower index is first
    basis = compute_principal_axes(a, b)
    squared, index = find_nearest(project_to_axes(a, basis), project_to_axes(b, basis), range(10, 50), 4)
    every = np.array([[np.square(p - q).sum() for q in b] for p in a[10:]])
    assert np.array_equal(index, np.argsort(every, axis=1, kind="stable")[:, :4])
    np.testing.assert_allclose(squared, np.sort(every, axis=1)[:, :4], rtol=1e-12)


# ------------------------------------------------------------------------------------------ kernel distance


def compute_literal_kernel_distance(x: np.ndarray, y: np.ndarray) -> float:
    """Compute the kernel distance of Binkowski et al. 2018 with loops."""

    def k(a, b):
        return (a @ b / len(a) + 1) ** 3

    n, m = len(x), len(y)
    own = sum(k(x[i], x[j]) for i in range(n) for j in range(n) if i != j) / (n * (n - 1))
    other = sum(k(y[i], y[j]) for i in range(m) for j in range(m) if i != j) / (m * (m - 1))
    return own + other - 2 * np.mean([[k(a, b) for b in y] for a in x])


def test_kernel_distance_equals_literal_version(monkeypatch):
    rng = np.random.default_rng(10)
    x, y = rng.normal(size=(40, 8)), rng.normal(0.4, 1.2, size=(50, 8))
    got = compute_kernel_distance(x, y)
    assert got.value == pytest.approx(compute_literal_kernel_distance(x, y), rel=1e-9)
    assert got.low < got.value < got.high
    monkeypatch.setattr(kernel_distance_module, "GROUP_SAMPLES", 20)
    halves = [compute_literal_kernel_distance(x[k::2], y[k::2]) for k in range(2)]
    assert compute_kernel_distance(x, y).value == pytest.approx(np.mean(halves), rel=1e-9)


def test_kernel_distance_of_equal_sources_contains_zero():
    rng = np.random.default_rng(11)
    got = compute_kernel_distance(*rng.normal(size=(2, 300, 16)))
    assert got.low < 0 < got.high


# ------------------------------------------------------------------------------------------ intervals


def test_intervals_have_stated_coverage():
    """In 200 experiments with 150 scenes each, about 95 % of the intervals contain the true value (a mean or a
    share)."""
    rng = np.random.default_rng(12)
    held = np.zeros(2)
    for _ in range(200):
        objects = rng.poisson(5, 150) + 1
        bad = rng.binomial(objects, 0.2)
        mean, share = estimate_mean(rng.exponential(2, 150)), estimate_ratios(bad[:, None], objects[:, None])[0]
        held += [mean.low <= 2 <= mean.high, share.low <= 0.2 <= share.high]
    assert (np.abs(held / 200 - 0.95) < 0.045).all()


def compute_both_influences(real: np.ndarray, generated: np.ndarray) -> list[np.ndarray]:
    a, b = compute_moments(real), compute_moments(generated)
    maps = compute_influence_maps(b, compute_transport(a, b))
    return [
        compute_frechet_influence(real, a, b.mean, maps[0]),
        compute_frechet_influence(generated, b, a.mean, maps[1]),
    ]


def test_frechet_interval_matches_spread_of_distance():
    rng = np.random.default_rng(13)
    scale = 0.8 ** np.arange(24)

    def draw() -> tuple[np.ndarray, np.ndarray]:
        return rng.normal(size=(400, 24)) * scale, rng.normal(0.2, 1.2, size=(400, 24)) * scale

    repeated = [compute_frechet_distance(*map(compute_moments, draw())) for _ in range(60)]
    widths = []
    for _ in range(5):
        real, generated = draw()
        a, b = compute_moments(real), compute_moments(generated)
        between = compute_transport(a, b)
        influences = compute_both_influences(real, generated)
        got = estimate_from_influence(compute_frechet_distance(a, b, between), influences)
        assert got.low < got.value < got.high
        widths.append(got.high - got.low)
    assert np.mean(widths) == pytest.approx(2 * 1.96 * np.std(repeated), rel=0.25)


def test_influences_are_derivatives_of_frechet_distance():
    """The reference is a finite difference: the change of the score after a small shift of the moments towards one
    sample."""
    rng = np.random.default_rng(14)
    real, generated = rng.normal(size=(600, 5)), rng.normal(0.5, 1.5, size=(700, 5))
    a, b = compute_moments(real), compute_moments(generated)
    influences = compute_both_influences(real, generated)

    def move_moments(side: Moments, sample: np.ndarray, share: float) -> Moments:
        step = sample - side.mean
        covariance = (1 - share) * side.covariance + share * np.outer(step, step)
        return Moments(side.count, side.mean + share * step, covariance * (side.count - 1))

    share = 1e-6
    for i in (0, 17, 300):
        slope = (compute_frechet_distance(move_moments(a, real[i], share), b) - compute_frechet_distance(a, b)) / share
        assert slope == pytest.approx(influences[0][i], rel=1e-3, abs=0.02)
        slope = (
            compute_frechet_distance(a, move_moments(b, generated[i], share)) - compute_frechet_distance(a, b)
        ) / share
        assert slope == pytest.approx(influences[1][i], rel=1e-3, abs=0.02)


def test_scores_reject_invalid_features():
    x = np.random.default_rng(8).normal(size=(10, 4))
    broken = x.copy()
    broken[3, 1] = np.nan
    with pytest.raises(ValueError, match="hold 3 samples, at least 4"):
        compute_neighbourhoods(x[:3], x, k=[3])
    with pytest.raises(ValueError, match=r"generated features hold NaN .* first 3"):
        compute_neighbourhoods(x, broken)
    with pytest.raises(ValueError, match="real features have 4 dimensions, but generated features have 3"):
        compute_neighbourhoods(x, x[:, :3])
    with pytest.raises(ValueError, match="k must name"):
        compute_neighbourhoods(x, x, k=[0])
    with pytest.raises(ValueError, match="at least 2"):
        compute_kernel_distance(x, x[:1])
    with pytest.raises(ValueError, match="NaN"):
        compute_moments(broken)
    with pytest.raises(ValueError, match="4 and 3 dimensions"):
        compute_frechet_distance(compute_moments(x), compute_moments(x[:, :3]))
    with pytest.raises(ValueError, match="different dimensions: 4 and 3"):
        compute_moments(x) + compute_moments(x[:, :3])
    with pytest.raises(ValueError, match="at least 2 samples"):
        compute_frechet_distance(compute_moments(x), compute_moments(x[:1]))
    with pytest.raises(ValueError, match=r"\(samples, dimensions\)"):
        compute_moments(x[0])
    with pytest.raises(ValueError, match="NaN"):
        compute_inception_score(broken)
