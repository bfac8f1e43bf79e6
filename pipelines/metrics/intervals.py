"""Compute 95 % confidence intervals by the bootstrap: resample scenes with replacement and recompute the score.

A draw counts how often each scene is sampled, so a score that is a sum over scenes is one matrix product for all draws.
Row 0 is the original sample. Its score is the value; the other rows give the interval. The same number of scenes gives
the same draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

DRAWS = 500
LEVEL = 0.95


class Estimate(NamedTuple):
    """A score with the ends of its 95 % interval."""

    value: float
    low: float
    high: float


def draw_resamples(count: int, key: int = 0) -> np.ndarray:
    """(1 + DRAWS, count) float64 counts of each scene: ones in row 0, then the draws.

    Each side of a comparison has its `key`, so that the draws of both sides are independent.
    """
    random = np.random.default_rng([count, key])
    picked = random.integers(count, size=(DRAWS, count), dtype=np.int64)
    picked += count * np.arange(DRAWS)[:, None]
    drawn = np.bincount(picked.ravel(), minlength=DRAWS * count).reshape(DRAWS, count)
    return np.vstack([np.ones((1, count)), drawn])


def compute_weights(count: int, key: int = 0) -> np.ndarray:
    """Return `draw_resamples` in rows of sum 1."""
    return draw_resamples(count, key) / count


def make_estimate(scores: np.ndarray) -> Estimate:
    """Make an estimate from the scores (1 + DRAWS,) of all rows of draws. Draws whose score is NaN do not count."""
    value, drawn = float(scores[0]), scores[1:]
    low, high = np.quantile(drawn[np.isfinite(drawn)], [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Estimate(value, float(low), float(high))


def estimate_mean(values: np.ndarray, key: int = 0) -> Estimate:
    """Estimate the mean of values (n,), one per scene."""
    return make_estimate(draw_resamples(len(values), key) @ np.asarray(values, np.float64) / len(values))


def estimate_ratios(numerators: np.ndarray, denominators: np.ndarray, key: int = 0) -> list[Estimate | None]:
    """Estimate the ratio of sums of each column of (n, m) and (n, m), with a row per scene; None if the latter is 0.

    Covers shares of objects (bad ones over all) and means over the scenes that have a value (values over ones).
    """
    drawn = draw_resamples(len(numerators), key)
    above, below = (drawn @ np.asarray(part, np.float64) for part in (numerators, denominators))
    scores = np.divide(above, below, out=np.full_like(above, np.nan), where=below > 0)
    return [make_estimate(scores[:, m]) if below[0, m] > 0 else None for m in range(scores.shape[1])]


def estimate_from_influence(value: float, influences: Sequence[np.ndarray]) -> Estimate:
    """Estimate a score whose first-order change is the mean influence (n,) of each side's samples."""
    shifts = sum(compute_weights(len(part), key) @ part for key, part in enumerate(influences))
    return make_estimate(np.asarray(value + shifts))
