"""FID, Inception score, precision and recall from features (paper, Sec. 4.1 and supplement, Evaluation).

Definitions are those of the ADM evaluator (Dhariwal & Nichol 2021), which the paper uses, in float64 throughout.
Features come from anywhere; only distances of Inception's pool3 features may be called FID.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

BLOCK_ROWS = 1024  # rows of a distance matrix held at once: 8 kB x number of columns
SPARE_NEIGHBOURS = 8  # candidates beyond the k-th that are measured exactly
ROUNDING = 1e-12  # relative error granted to |x|^2 + |y|^2 - 2 x.y; at 2048-d the worst case is 2048 x 2^-53 = 2e-13
PAIRS_PER_BLOCK = 2048  # of plainly computed distances


def checked_features(features: np.ndarray, name: str, at_least: int) -> np.ndarray:
    """features (n, d) as float64; ValueError if not 2-d, with fewer than `at_least` rows, or not finite."""
    features = np.asarray(features, np.float64)
    if features.ndim != 2:
        raise ValueError(f"{name} features must be (samples, dimensions), got shape {features.shape}")
    if len(features) < at_least:
        raise ValueError(f"{name} features hold {len(features)} samples, at least {at_least} are needed")
    bad = np.flatnonzero(~np.isfinite(features).all(axis=1))
    if len(bad):
        raise ValueError(f"{name} features hold NaN or infinite numbers in {len(bad)} samples, first {bad[0]}")
    return features


# -------------------------------------------------------------------------------------------- Frechet distance


@dataclass(frozen=True)
class Moments:
    """Count, mean (d,) and scatter (d, d) = sum of (x - mean)(x - mean)^T of a set of features. Adds exactly."""

    count: int
    mean: np.ndarray
    scatter: np.ndarray

    @property
    def covariance(self) -> np.ndarray:
        """(d, d), unbiased (divided by count - 1)."""
        if self.count < 2:
            raise ValueError(f"a covariance needs at least 2 samples, got {self.count}")
        return self.scatter / (self.count - 1)

    def __add__(self, other: Moments) -> Moments:
        if self.mean.shape != other.mean.shape:
            raise ValueError(f"moments of {len(self.mean)} and {len(other.mean)} dimensions cannot be added")
        count = self.count + other.count
        step = other.mean - self.mean
        mean = self.mean + step * (other.count / count)
        between = np.outer(step, step) * (self.count * other.count / count)
        return Moments(count, mean, self.scatter + other.scatter + between)


def moments(features: np.ndarray) -> Moments:
    """Moments of features (n, d), n >= 1."""
    features = checked_features(features, "moment", at_least=1)
    mean = features.mean(axis=0)
    centred = features - mean
    return Moments(len(features), mean, centred.T @ centred)


def frechet_distance(a: Moments, b: Moments) -> float:
    """Squared Frechet distance of the two Gaussians: |mean_a - mean_b|^2 + tr(A + B - 2 (AB)^1/2).

    With A = F F^T, AB has the eigenvalues of the symmetric F^T B F: two symmetric eigenproblems instead of a general
    sqrtm, and nothing complex to throw away. Rank-deficient covariances are fine.
    """
    if a.mean.shape != b.mean.shape:
        raise ValueError(f"features have {len(a.mean)} and {len(b.mean)} dimensions; both sides need the same")
    covariance_a, covariance_b = a.covariance, b.covariance
    values, vectors = np.linalg.eigh(covariance_a)
    factor = vectors * np.sqrt(np.maximum(values, 0))
    product_values = np.linalg.eigvalsh(factor.T @ covariance_b @ factor)
    root_trace = np.sqrt(np.maximum(product_values, 0)).sum()
    distance = np.square(a.mean - b.mean).sum() + np.trace(covariance_a) + np.trace(covariance_b) - 2 * root_trace
    return float(max(distance, 0.0))


# ------------------------------------------------------------------------------------------------ Inception score


def inception_score(logits: np.ndarray, split_size: int = 5000) -> float:
    """exp of the mean KL(p(y|x) || p(y)), averaged over splits of 5000 samples in order (ADM).

    logits (n, classes) are pool3 @ W **without the bias**, as ADM takes them.
    """
    logits = checked_features(logits, "logit", at_least=1)
    logits = logits - logits.max(axis=1, keepdims=True)
    log_p = logits - np.log(np.exp(logits).sum(axis=1, keepdims=True))
    scores = []
    for start in range(0, len(log_p), split_size):
        part = log_p[start : start + split_size]
        p = np.exp(part)
        with np.errstate(divide="ignore"):  # a class that never occurs: p = 0, and 0 * anything finite below
            log_marginal = np.maximum(np.log(p.mean(axis=0)), -1e300)
        scores.append(np.exp((p * (part - log_marginal)).sum(axis=1).mean()))
    return float(np.mean(scores))


# -------------------------------------------------------------------------------------------- precision and recall


@dataclass(frozen=True)
class PrecisionRecall:
    """Improved precision and recall (Kynkaanniemi et al. 2019) at one neighbourhood size."""

    k: int
    precision: float  # share of generated samples within the k-th neighbour's distance of some real sample
    recall: float  # share of real samples within the k-th neighbour's distance of some generated sample


def precision_recall(real: np.ndarray, generated: np.ndarray, k: Sequence[int] = (3,)) -> list[PrecisionRecall]:
    """Precision and recall for each k, from features (n, d) and (m, d) (supplement, Eqs. of precision and recall).

    Exact: each comparison that rounding could decide is made again on plainly computed distances, so equal distances
    are equal (`<=`). Memory: BLOCK_ROWS x max(n, m) float64. The paper's protocol takes n = m; other sizes work.
    """
    if not k or min(k) < 1:
        raise ValueError(f"k must name neighbourhood sizes of at least 1, got {list(k)}")
    real = checked_features(real, "real", at_least=max(k) + 1)
    generated = checked_features(generated, "generated", at_least=max(k) + 1)
    if real.shape[1] != generated.shape[1]:
        raise ValueError(f"real features have {real.shape[1]} dimensions, generated {generated.shape[1]}")
    real_radii, generated_radii = neighbour_radii(real, k), neighbour_radii(generated, k)
    generated_in_real, real_in_generated = _within(real, real_radii, generated, generated_radii)
    precision, recall = generated_in_real.mean(axis=1), real_in_generated.mean(axis=1)
    return [PrecisionRecall(size, float(precision[i]), float(recall[i])) for i, size in enumerate(k)]


def neighbour_radii(features: np.ndarray, k: Sequence[int]) -> np.ndarray:
    """(len(k), n) squared distance of each sample to its k-th nearest other sample; n > max(k)."""
    radii = np.empty((len(k), len(features)))
    wanted = min(max(k) + SPARE_NEIGHBOURS, len(features) - 1)
    for rows, squared, _ in _distance_blocks(features, features):
        squared[np.arange(len(rows)), rows] = np.inf
        nearest = np.argpartition(squared, wanted - 1, axis=1)[:, :wanted]
        exact = _plain_distances(features, rows.repeat(wanted), features, nearest.ravel()).reshape(nearest.shape)
        exact.sort(axis=1)
        radii[:, rows] = exact[:, [size - 1 for size in k]].T
    return radii


def _within(
    real: np.ndarray, real_radii: np.ndarray, generated: np.ndarray, generated_radii: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(k, m) generated sample lies in some real sample's ball; (k, n) real sample lies in some generated one's."""
    generated_in_real = np.zeros((len(real_radii), len(generated)), bool)
    real_in_generated = np.zeros((len(real_radii), len(real)), bool)
    for rows, squared, error in _distance_blocks(real, generated):
        for i in range(len(real_radii)):
            balls, other_balls = real_radii[i, rows][:, None], generated_radii[i][None]
            unsure = (np.abs(squared - balls) <= error) | (np.abs(squared - other_balls) <= error)
            row, column = np.nonzero(unsure)
            squared[row, column] = _plain_distances(real, rows[row], generated, column)
            generated_in_real[i] |= (squared <= balls).any(axis=0)
            real_in_generated[i, rows] = (squared <= other_balls).any(axis=1)
    return generated_in_real, real_in_generated


def _distance_blocks(a: np.ndarray, b: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Row indices, squared distances (rows, m) from them to all of b, and a bound (rows, 1) of their error.

    By matrix product, about the mean of b: smaller numbers lose fewer digits.
    """
    middle = b.mean(axis=0)
    a, b = a - middle, b - middle
    norms_a, norms_b = np.square(a).sum(axis=1), np.square(b).sum(axis=1)
    for start in range(0, len(a), BLOCK_ROWS):
        rows = np.arange(start, min(start + BLOCK_ROWS, len(a)))
        squared = a[rows] @ b.T
        squared *= -2
        squared += norms_a[rows, None] + norms_b
        yield rows, squared, ROUNDING * (norms_a[rows, None] + norms_b.max())


def _plain_distances(a: np.ndarray, i: np.ndarray, b: np.ndarray, j: np.ndarray) -> np.ndarray:
    """(p,) squared distances of a[i] and b[j], by differences: the same bits whichever side comes first."""
    squared = np.empty(len(i))
    for start in range(0, len(i), PAIRS_PER_BLOCK):
        block = slice(start, start + PAIRS_PER_BLOCK)
        squared[block] = np.square(a[i[block]] - b[j[block]]).sum(axis=1)
    return squared
