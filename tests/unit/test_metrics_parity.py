"""Tests that compute scores from features and compare them with ADM's formulas in float64 and with torch-fidelity.

The tests also measure the effect of different definitions (docs/concepts/evaluation.md).
"""

import json

import numpy as np
import pytest
import scipy.linalg
import scipy.special
from golden.golden_recipe import GOLDEN, feature_sets, logits
from safetensors import safe_open

from pipelines.metrics import inception_score as inception_score_module
from pipelines.metrics.frechet import compute_frechet_distance, compute_moments
from pipelines.metrics.inception_score import compute_inception_score
from pipelines.metrics.kernel_distance import compute_kernel_distance
from pipelines.metrics.neighbours import compute_neighbourhoods


@pytest.fixture(scope="module")
def torch_fidelity() -> dict[str, float]:
    with safe_open(GOLDEN, "numpy") as golden:
        return json.loads(golden.metadata()["scores"])


def compute_fid(real: np.ndarray, generated: np.ndarray) -> float:
    return compute_frechet_distance(compute_moments(real), compute_moments(generated))


# ------------------------------------------------------------------------- ADM's formulas (evaluations/evaluator.py)


def compute_adm_frechet(real: np.ndarray, generated: np.ndarray) -> float:
    """Return |m - n|^2 + tr A + tr B - 2 tr (A B)^1/2, computed with a general matrix square root.

    The covariances A and B divide by n - 1.
    """
    mean_gap = real.mean(0) - generated.mean(0)
    a, b = np.cov(real, rowvar=False), np.cov(generated, rowvar=False)
    return float(mean_gap @ mean_gap + np.trace(a) + np.trace(b) - 2 * np.trace(scipy.linalg.sqrtm(a @ b)).real)


def compute_adm_inception_score(scores: np.ndarray, chunk: int = 5000) -> float:
    """Return the mean of exp(E KL(p(y|x) || p(y))) over consecutive chunks; p(y) is computed per chunk."""
    found = []
    for start in range(0, len(scores), chunk):
        p = scipy.special.softmax(scores[start : start + chunk], axis=1)
        found.append(np.exp(np.sum(p * (np.log(p) - np.log(p.mean(axis=0))), axis=1).mean()))
    return float(np.mean(found))


def compute_adm_precision_recall(real: np.ndarray, generated: np.ndarray, k: int) -> tuple[float, float]:
    """Compute precision and recall with full distance matrices.

    In a sorted row, entry 0 is the sample itself and entry k is its k-th neighbour.
    """

    def distances(x, y):
        return np.array([np.square(row - y).sum(axis=1) for row in x])

    real_radii = np.sort(distances(real, real), axis=1)[:, k]
    generated_radii = np.sort(distances(generated, generated), axis=1)[:, k]
    between = distances(real, generated)
    precision = (between <= real_radii[:, None]).any(axis=0).mean()
    recall = (between <= generated_radii[None]).any(axis=1).mean()
    return float(precision), float(recall)


def draw_walks(seed: int, n: int, d: int) -> np.ndarray:
    """Return correlated float32 features with different scales and offsets."""
    rng = np.random.default_rng(seed)
    return (rng.uniform(0.8, 1.2) * np.cumsum(rng.normal(size=(n, d)), axis=1) + rng.normal(size=d)).astype(np.float32)


@pytest.mark.parametrize("seed", range(4))
def test_scores_equal_adm(seed):
    real, generated = draw_walks(seed, 400, 48), draw_walks(seed + 10, 250, 48)
    exact = real.astype(np.float64), generated.astype(np.float64)
    assert compute_fid(real, generated) == pytest.approx(compute_adm_frechet(*exact), rel=1e-6)
    found = compute_neighbourhoods(real, generated, k=(1, 3, 5))
    assert [(r.precision, r.recall) for r in found] == [compute_adm_precision_recall(*exact, k) for k in (1, 3, 5)]
    assert 0 < found[1].precision < 1 and 0 < found[1].recall < 1


def test_inception_score_of_chunks_equals_adm(monkeypatch):
    rng = np.random.default_rng(4)
    scores = (
        rng.normal(0, 2, (12_000, 10)) + 3 * np.eye(10)[np.sort(rng.integers(0, 10, 12_000))]
    )  # the samples are sorted by class
    in_chunks = compute_inception_score(scores).value
    assert in_chunks == pytest.approx(compute_adm_inception_score(scores), rel=1e-6)
    # Sorted samples have a lower score in chunks than in one chunk.
    monkeypatch.setattr(inception_score_module, "SPLIT_SAMPLES", 12_000)
    assert compute_inception_score(scores).value > 1.1 * in_chunks


def test_adm_half_precision_shifts_precision_recall_below_0_01():
    """ADM multiplies matrices in float16, but PrITTI on Ray compares distances exactly.

    The test models the rounding of ADM and bounds its effect.
    """

    def distances(x, y):
        x, y = x.astype(np.float16), y.astype(np.float16)
        product = (x.astype(np.float32) @ y.astype(np.float32).T).astype(np.float16)
        norms = [np.square(side.astype(np.float32)).sum(axis=1).astype(np.float16) for side in (x, y)]
        return np.maximum(norms[0][:, None] - np.float16(2) * product + norms[1][None], np.float16(0))

    moved = []
    for seed in (7, 8, 9):
        real, generated = (np.abs(draw_walks(s, 500, 256)) / 10 for s in (seed, seed + 50))
        exact = compute_neighbourhoods(real, generated, k=[3])[0]
        between = distances(real, generated)
        real_radii, generated_radii = (np.sort(distances(side, side), axis=1)[:, 3] for side in (real, generated))
        moved.append((between <= real_radii[:, None]).any(axis=0).mean() - exact.precision)
        moved.append((between <= generated_radii[None]).any(axis=1).mean() - exact.recall)
    assert 0 < np.abs(moved).max() < 0.01


# ------------------------------------------------------------------------------------------------ torch-fidelity


def test_frechet_distance_equals_torch_fidelity(torch_fidelity):
    """One case has fewer samples than dimensions: 20 samples in 32 dimensions."""
    real, generated = feature_sets()
    for name, samples in (("fid", generated), ("fid_few", generated[:20])):
        theirs = torch_fidelity[f"{name}.frechet_inception_distance"]
        assert compute_fid(real, samples) == pytest.approx(theirs, rel=1e-6)


def test_inception_score_equals_torch_fidelity_on_same_splits(torch_fidelity, monkeypatch):
    """With one split, the score equals ADM's score for up to 5000 samples.

    For these 300 samples, torch-fidelity's default of ten shuffled splits gives a score that is 5 % lower.
    """
    one, ten = (torch_fidelity[f"isc_{splits}.inception_score_mean"] for splits in (1, 10))
    assert compute_inception_score(logits()).value == pytest.approx(one, rel=1e-6)
    shuffled = logits()[np.random.RandomState(2020).permutation(300)]
    monkeypatch.setattr(inception_score_module, "SPLIT_SAMPLES", 30)
    assert compute_inception_score(shuffled).value == pytest.approx(ten, rel=1e-6)
    assert ten == pytest.approx(0.95 * one, rel=0.01)


def test_precision_and_recall_equal_torch_fidelity(torch_fidelity):
    real, generated = feature_sets()
    for name, samples in (("prc_{}", generated), ("prc_{}_few", generated[:20])):
        for found in compute_neighbourhoods(real, samples, k=(1, 3, 5)):
            theirs = {key: torch_fidelity[f"{name.format(found.k)}.{key}"] for key in ("precision", "recall")}
            # torch-fidelity computes averages in float32.
            assert found.precision == pytest.approx(theirs["precision"], rel=1e-6)
            assert found.recall == pytest.approx(theirs["recall"], rel=1e-6)
            assert theirs["precision"] != theirs["recall"]


def compute_polynomial_kid(x: np.ndarray, y: np.ndarray) -> float:
    """Return the unbiased squared MMD of Binkowski et al. 2018 with the kernel (x.y / d + 1)^3.

    Both sides have the same number n of samples.
    """
    n, d = x.shape

    def kernel(a, b):
        return (a.astype(np.float64) @ b.T.astype(np.float64) / d + 1) ** 3

    within = sum(k.sum() - np.trace(k) for k in (kernel(x, x), kernel(y, y))) / (n * (n - 1))
    return float(within - 2 * kernel(x, y).mean())


def test_kid_of_all_samples_equals_torch_fidelity(torch_fidelity):
    """For one group, both scores are equal.

    With several groups, torch-fidelity draws random subsets, but PrITTI on Ray uses each sample once.
    """
    real, generated = feature_sets()
    whole = torch_fidelity["kid_all.kernel_inception_distance_mean"]
    assert compute_kernel_distance(real, generated).value == pytest.approx(whole, rel=1e-5)
    random = np.random.RandomState(2020)
    subsets = [
        compute_polynomial_kid(
            generated[random.choice(300, 100, replace=False)], real[random.choice(300, 100, replace=False)]
        )
        for _ in range(10)
    ]
    mean, deviation = (torch_fidelity[f"kid_subsets.kernel_inception_distance_{name}"] for name in ("mean", "std"))
    assert (np.mean(subsets), np.std(subsets)) == pytest.approx((mean, deviation), rel=1e-5)
    assert whole == pytest.approx(mean, abs=2 * deviation)
