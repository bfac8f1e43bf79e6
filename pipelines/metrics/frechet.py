"""Frechet distance of two sets of features (paper, Sec. 4.1), from moments that add up exactly over parts.

float64 throughout. Features come from anywhere; only distances of Inception's pool3 features may be called FID.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple

import numpy as np

BLOCK_ROWS = 4096
NEGLIGIBLE = 1e-6  # of the largest singular value: what is below carries rounding and no influence


def check_features(features: np.ndarray, name: str, at_least: int) -> np.ndarray:
    """features (n, d) as floats, float32 kept; ValueError if not 2-d, of fewer than `at_least` rows, or not finite."""
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
    """Mean and covariance of a set of features, for `frechet.compute_frechet_distance`."""

    mean: np.ndarray  # (d,) float64
    covariance: np.ndarray  # (d, d) float64


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


Gaussian = Moments | StoredGaussian  # mean (d,) and covariance (d, d) of features


def compute_moments(features: np.ndarray) -> Moments:
    """Moments of features (n, d), n >= 1; block by block, so that no copy in float64 is held."""
    features = check_features(features, "moment", at_least=1)
    starts = range(0, len(features), BLOCK_ROWS)
    return reduce(operator.add, (compute_block_moments(features[start : start + BLOCK_ROWS]) for start in starts))


def compute_block_moments(features: np.ndarray) -> Moments:
    mean = features.mean(axis=0, dtype=np.float64)
    centred = features - mean
    return Moments(len(features), mean, centred.T @ centred)


@dataclass(frozen=True, eq=False)
class Transport:
    """The decomposition behind the distance of two Gaussians of covariances A and B.

    With A = F F^T, AB has the eigenvalues s^2 of the symmetric F^T B F = U s^2 U^T. Two symmetric eigenproblems replace
    a general sqrtm, whose result may be complex. Rank-deficient covariances are allowed.
    """

    roots: np.ndarray  # (d,) s
    factor: np.ndarray  # (d, d) F U


def compute_transport(a: Gaussian, b: Gaussian) -> Transport:
    """Raises ValueError for unequal dimensions and for fewer than 2 samples."""
    if a.mean.shape != b.mean.shape:
        raise ValueError(f"features have {len(a.mean)} and {len(b.mean)} dimensions; both sides need the same")
    covariance_b = b.covariance
    values, vectors = np.linalg.eigh(a.covariance)
    factor = vectors * np.sqrt(np.maximum(values, 0))
    squares, rotation = np.linalg.eigh(factor.T @ covariance_b @ factor)
    return Transport(np.sqrt(np.maximum(squares, 0)), factor @ rotation)


def compute_frechet_distance(a: Gaussian, b: Gaussian, between: Transport | None = None) -> float:
    """Squared Frechet distance of the two Gaussians: |mean_a - mean_b|^2 + tr(A + B - 2 (AB)^1/2)."""
    between = between or compute_transport(a, b)
    traces = np.trace(a.covariance) + np.trace(b.covariance)
    return float(max(np.square(a.mean - b.mean).sum() + traces - 2 * between.roots.sum(), 0.0))


def compute_influence_maps(b: Moments, between: Transport) -> tuple[np.ndarray, np.ndarray]:
    """W (d, r) of either side, with the distance's derivative by its covariance I - W W^T.

    With M = F^T B F = U s^2 U^T, W W^T is (B F U) s^-3 (B F U)^T by A,
    and (F U) s^-1 (F U)^T = A^1/2 (A^1/2 B A^1/2)^-1/2 A^1/2 by B.
    """
    kept = between.roots > NEGLIGIBLE * between.roots.max()
    roots, factor = between.roots[kept], between.factor[:, kept]
    return (b.covariance @ factor) / roots**1.5, factor / np.sqrt(roots)


def compute_frechet_influence(
    features: np.ndarray, own: Moments, other_mean: np.ndarray, through: np.ndarray
) -> np.ndarray:
    """(n,) first-order influence of each sample of a side on the distance, with mean zero; `through` is its W.

    The mean influence over a resample is the change of the distance. It is unbiased, whereas the Frechet distance of a
    resample is biased upwards, like every Frechet distance of few samples.
    """
    values = np.empty(len(features))
    for start in range(0, len(features), BLOCK_ROWS):
        rows = slice(start, start + BLOCK_ROWS)
        centred = features[rows] - own.mean
        values[rows] = np.square(centred).sum(axis=1) - np.square(centred @ through).sum(axis=1)
        values[rows] += 2 * centred @ (own.mean - other_mean)
    return values - values.mean()
