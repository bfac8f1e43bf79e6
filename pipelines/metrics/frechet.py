"""Compute the Frechet distance of two sets of features from their moments (paper, Sec. 4.1).

The moments of parts of a set can be added. All numbers are float64. Any features may be used, but only the distance of
Inception's pool3 features may be called FID.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple

import numpy as np

BLOCK_ROWS = 4096
NEGLIGIBLE = 1e-6  # Singular values below this fraction of the largest one count as 0.


def check_features(features: np.ndarray, name: str, at_least: int) -> np.ndarray:
    """Check features and convert them to floats; float32 features are not converted.

    Args:
        features: (n, d) features.
        name: Name of the features for the error message.
        at_least: Minimum number of samples.

    Returns:
        (n, d) features, float32 or float64.

    Raises:
        ValueError: The features are not 2-d, have fewer than `at_least` rows, or are not finite.
    """
    features = np.asarray(features)
    features = features if features.dtype == np.float32 else features.astype(np.float64)
    if features.ndim != 2:
        raise ValueError(f"{name} features must be (samples, dimensions), got shape {features.shape}")
    if len(features) < at_least:
        raise ValueError(f"{name} features hold {len(features)} samples, at least {at_least} are needed")
    bad = np.flatnonzero(~np.isfinite(features).all(axis=1))
    if len(bad):
        raise ValueError(f"{name} features hold NaN or infinite numbers in {len(bad)} samples, first {bad[0]}")
    return features


class StoredGaussian(NamedTuple):
    """Mean and covariance of a set of features, read from a file.

    Attributes:
        mean: (d,) float64.
        covariance: (d, d) float64.
    """

    mean: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class Moments:
    """Count, mean and scatter of a set of features. Moments can be added; the sum describes the union of the sets.

    Attributes:
        count: Number of samples.
        mean: (d,) mean.
        scatter: (d, d) sum of (x - mean)(x - mean)^T.
    """

    count: int
    mean: np.ndarray
    scatter: np.ndarray

    @property
    def covariance(self) -> np.ndarray:
        """Return the unbiased covariance (d, d): the scatter divided by count - 1.

        Raises:
            ValueError: There are fewer than 2 samples.
        """
        if self.count < 2:
            raise ValueError(f"a covariance needs at least 2 samples, got {self.count}")
        return self.scatter / (self.count - 1)

    def __add__(self, other: Moments) -> Moments:
        if self.mean.shape != other.mean.shape:
            raise ValueError(f"cannot add moments with different dimensions: {len(self.mean)} and {len(other.mean)}")
        count = self.count + other.count
        step = other.mean - self.mean
        mean = self.mean + step * (other.count / count)
        between = np.outer(step, step) * (self.count * other.count / count)
        return Moments(count, mean, self.scatter + other.scatter + between)


Gaussian = Moments | StoredGaussian  # Both types hold a mean (d,) and a covariance (d, d).


def compute_moments(features: np.ndarray) -> Moments:
    """Compute the moments of features in blocks, without a float64 copy of all features.

    Args:
        features: (n, d) features, n >= 1.

    Returns:
        Moments of all samples.

    Raises:
        ValueError: The features are empty, are not 2-d or are not finite.
    """
    features = check_features(features, "moment", at_least=1)
    starts = range(0, len(features), BLOCK_ROWS)
    return reduce(operator.add, (compute_block_moments(features[start : start + BLOCK_ROWS]) for start in starts))


def compute_block_moments(features: np.ndarray) -> Moments:
    """Compute the moments of one block of features.

    Args:
        features: (n, d) features, n >= 1.

    Returns:
        Moments of the block.
    """
    mean = features.mean(axis=0, dtype=np.float64)
    centred = features - mean
    return Moments(len(features), mean, centred.T @ centred)


@dataclass(frozen=True, eq=False)
class Transport:
    """Decomposition from which the distance of two Gaussians with covariances A and B is computed.

    Let A = F F^T. Then AB has the same eigenvalues s^2 as the symmetric matrix F^T B F = U s^2 U^T. Two symmetric
    eigenproblems replace a general matrix square root, whose result may be complex. Rank-deficient covariances are
    allowed.

    Attributes:
        roots: (r,) s.
        factor: (d, r) matrix product F U.
    """

    roots: np.ndarray
    factor: np.ndarray


def compute_transport(a: Gaussian, b: Gaussian, samples: np.ndarray | None = None) -> Transport:
    """Decompose the product of two covariances for their Frechet distance.

    Args:
        a: Gaussian with covariance A.
        b: Gaussian with covariance B.
        samples: (n, d) features with covariance A. If n < d, the eigenproblem then has n instead of d dimensions,
            because F is the matrix of the centred samples, divided by the root of n - 1.

    Returns:
        Decomposition, as defined in `Transport`.

    Raises:
        ValueError: The dimensions differ, or a set has fewer than 2 samples.
    """
    if a.mean.shape != b.mean.shape:
        raise ValueError(f"features have {len(a.mean)} and {len(b.mean)} dimensions; both sides need the same")
    covariance_b = b.covariance
    if samples is not None and len(samples) < len(a.mean):
        factor = (samples - a.mean).T / np.sqrt(len(samples) - 1)
    else:
        values, vectors = np.linalg.eigh(a.covariance)
        factor = vectors * np.sqrt(np.maximum(values, 0))
    squares, rotation = np.linalg.eigh(factor.T @ covariance_b @ factor)
    return Transport(np.sqrt(np.maximum(squares, 0)), factor @ rotation)


def compute_frechet_distance(a: Gaussian, b: Gaussian, between: Transport | None = None) -> float:
    """Compute the squared Frechet distance of two Gaussians: |mean_a - mean_b|^2 + tr(A + B - 2 (AB)^1/2).

    Args:
        a: Gaussian with covariance A.
        b: Gaussian with covariance B.
        between: Decomposition of A and B. None: the decomposition is computed.

    Returns:
        Squared distance, at least 0.
    """
    between = between or compute_transport(a, b)
    traces = np.trace(a.covariance) + np.trace(b.covariance)
    return float(max(np.square(a.mean - b.mean).sum() + traces - 2 * between.roots.sum(), 0.0))


def compute_influence_maps(b: Moments, between: Transport) -> tuple[np.ndarray, np.ndarray]:
    """Return a matrix W (d, r) for each of the two sets. Sample influences are computed from this matrix.

    The derivative of the squared distance with respect to the covariance of a set is I - W W^T. Let U s^2 U^T be the
    eigendecomposition of M = F^T B F. For the set with covariance A, the matrix W W^T equals (B F U) s^-3 (B F U)^T.
    For the set with covariance B, the matrix W W^T equals (F U) s^-1 (F U)^T. The latter equals A^1/2 (A^1/2 B
    A^1/2)^-1/2 A^1/2.

    Args:
        b: Moments with covariance B.
        between: Decomposition of A and B.

    Returns:
        Two matrices W (d, r) of rank r, for the sets with covariances A and B.
    """
    kept = between.roots > NEGLIGIBLE * between.roots.max()
    roots, factor = between.roots[kept], between.factor[:, kept]
    return (b.covariance @ factor) / roots**1.5, factor / np.sqrt(roots)


def compute_frechet_influence(
    features: np.ndarray, own: Moments, other_mean: np.ndarray, through: np.ndarray
) -> np.ndarray:
    """Compute the first-order influence of each sample of one set on the Frechet distance.

    The mean influence over a resample is an unbiased estimate of the change of the distance. A Frechet distance that is
    computed from the resample itself is biased upwards, as for any small set of samples.

    Args:
        features: (n, d) features of the set.
        own: Moments of the set.
        other_mean: (d,) mean of the other set.
        through: (d, r) matrix W of the set, from `compute_influence_maps`.

    Returns:
        (n,) influences with mean 0.
    """
    values = compute_uncentred_influence(features, own, other_mean, through)
    return values - values.mean()


def compute_uncentred_influence(
    features: np.ndarray, own: Moments, other_mean: np.ndarray, through: np.ndarray
) -> np.ndarray:
    """Compute the influences of `compute_frechet_influence` plus a constant, for a part of a set.

    Args:
        features: (n, d) features of a part of the set.
        own: Moments of the whole set.
        other_mean: (d,) mean of the other set.
        through: (d, r) matrix W of the set, from `compute_influence_maps`.

    Returns:
        (n,) influences. Over the whole set, subtract their mean.
    """
    values = np.empty(len(features))
    for start in range(0, len(features), BLOCK_ROWS):
        rows = slice(start, start + BLOCK_ROWS)
        centred = features[rows] - own.mean
        values[rows] = np.square(centred).sum(axis=1) - np.square(centred @ through).sum(axis=1)
        values[rows] += 2 * centred @ (own.mean - other_mean)
    return values
