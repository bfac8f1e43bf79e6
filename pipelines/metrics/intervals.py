"""Compute 95 % confidence intervals by the bootstrap: resample scenes with replacement and recompute the score.

One resample is called a draw. A draw is stored as a row that counts how often each scene is sampled. If a score is a
sum over scenes, one matrix product computes the score of all draws. Row 0 is the original sample, and its score is the
value of the estimate. The interval is computed from the scores of the draws. The draws depend only on the number of
scenes and the key.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

DRAWS = 500
LEVEL = 0.95


class Estimate(NamedTuple):
    """A score with its 95 % interval.

    Attributes:
        value: Score of the original sample.
        low: Lower end of the interval.
        high: Upper end of the interval.
    """

    value: float
    low: float
    high: float


def draw_resamples(count: int, key: int = 0) -> np.ndarray:
    """Draw bootstrap resamples of scenes.

    Args:
        count: Number of scenes.
        key: Part of the random seed. The two sides of a comparison use different keys to make their draws independent.

    Returns:
        (1 + DRAWS, count) float64, how often each scene is sampled. Row 0 contains only ones. Each
        other row is one draw.
    """
    return np.stack(list(iterate_resamples(count, key)))


def iterate_resamples(count: int, key: int = 0) -> Iterator[np.ndarray]:
    """Yield the rows of `draw_resamples` one at a time, for sets of which all draws do not fit in memory.

    Args:
        count: Number of scenes.
        key: Part of the random seed.

    Yields:
        (count,) float64, how often each scene is sampled; 1 + DRAWS arrays.
    """
    random = np.random.default_rng([count, key])
    yield np.ones(count)
    for _ in range(DRAWS):
        picked = random.integers(count, size=count, dtype=np.int64)
        yield np.bincount(picked, minlength=count).astype(np.float64)


def compute_weights(count: int, key: int = 0) -> np.ndarray:
    """Return the rows of `draw_resamples`, scaled to a sum of 1.

    Args:
        count: Number of scenes.
        key: Part of the random seed.

    Returns:
        (1 + DRAWS, count) float64 weights.
    """
    return draw_resamples(count, key) / count


def make_estimate(scores: np.ndarray) -> Estimate:
    """Make an estimate from the score of the original sample and the scores of all draws.

    Args:
        scores: (1 + DRAWS,) scores. The first score belongs to the original sample. Draws whose score is NaN are
            ignored.

    Returns:
        Score with its 95 % interval.
    """
    value, drawn = float(scores[0]), scores[1:]
    low, high = np.quantile(drawn[np.isfinite(drawn)], [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Estimate(value, float(low), float(high))


def estimate_mean(values: np.ndarray, key: int = 0) -> Estimate:
    """Estimate the mean of one value per scene.

    Args:
        values: (n,) values.
        key: Part of the random seed.

    Returns:
        Mean with its 95 % interval.
    """
    return make_estimate(draw_resamples(len(values), key) @ np.asarray(values, np.float64) / len(values))


def estimate_ratios(numerators: np.ndarray, denominators: np.ndarray, key: int = 0) -> list[Estimate | None]:
    """Estimate the ratio of the column sums of two arrays that have one row per scene.

    For example, a ratio can be a share of objects: the number of faulty objects divided by the number of all objects. A
    ratio can also be the mean of a value over the scenes in which the value is defined.

    Args:
        numerators: (n, m) numerators.
        denominators: (n, m) denominators.
        key: Part of the random seed.

    Returns:
        m ratios with 95 % intervals. None: the denominators sum to 0.
    """
    drawn = draw_resamples(len(numerators), key)
    above, below = (drawn @ np.asarray(part, np.float64) for part in (numerators, denominators))
    scores = np.divide(above, below, out=np.full_like(above, np.nan), where=below > 0)
    return [make_estimate(scores[:, m]) if below[0, m] > 0 else None for m in range(scores.shape[1])]


def estimate_from_influence(value: float, influences: Sequence[np.ndarray]) -> Estimate:
    """Estimate a score from the influences of all samples on it.

    To first order, a resample changes the score by the mean influence of its samples. If both sets are resampled, the
    two means are added.

    Args:
        value: Score of the original sample.
        influences: One array per side: (n,) influence of each sample on the score.

    Returns:
        Score with its 95 % interval.
    """
    shifts = np.zeros(1 + DRAWS)
    for key, part in enumerate(influences):
        shifts += [row @ part / len(part) for row in iterate_resamples(len(part), key)]
    return make_estimate(value + shifts)
