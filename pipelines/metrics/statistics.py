"""Layout statistics of scenes and distances between two sources by them: no pictures, no weights, never called FID.

One vector of named numbers per scene; sources are compared as sets of such vectors.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from models.scene import CATEGORIES, Scene
from pipelines.metrics.generation import frechet_distance, moments

EXTENTS = ("length_m", "width_m", "height_m")


def statistic_names(ground_classes: Sequence[str]) -> tuple[str, ...]:
    """Columns of `layout_statistics`: num_<category>, <category>_<extent>_m, <class>_share."""
    counts = [f"num_{category}" for category in CATEGORIES]
    extents = [f"{category}_{extent}" for category in CATEGORIES for extent in EXTENTS]
    return (*counts, *extents, *(f"{name}_share" for name in ground_classes))


def layout_statistics(scene: Scene) -> np.ndarray:
    """(11 + 33 + G,) float64, columns as in `statistic_names(scene.ground_classes)`.

    Counts; mean extents in metres, NaN for an absent category; share of the scene's pixels per ground class (classes
    may overlap).
    """
    counts = scene.counts()
    totals = np.zeros((len(CATEGORIES), 3))
    np.add.at(totals, scene.category, scene.size_m.astype(np.float64))
    extents = np.divide(totals, counts[:, None], out=np.full_like(totals, np.nan), where=counts[:, None] > 0)
    shares = scene.occupied.mean(axis=(1, 2))
    return np.concatenate([counts, extents.ravel(), shares])


def layout_frechet(reference: np.ndarray, other: np.ndarray) -> float:
    """Squared Frechet distance of two sources' layout statistics (n, s) and (m, s), standardised by the reference.

    Each column is shifted and scaled by the reference's mean and deviation (a constant column only shifted: its unit
    is 1), so the number has no unit and about one column's weight in each column. A NaN, an absent category's size,
    says nothing and counts as the reference's mean. Raises ValueError for fewer than 2 scenes or unequal columns.
    """
    reference, other = np.asarray(reference, np.float64), np.asarray(other, np.float64)
    if reference.ndim != 2 or other.ndim != 2 or reference.shape[1] != other.shape[1]:
        raise ValueError(f"layout statistics must be (scenes, columns), alike: {reference.shape}, {other.shape}")
    if min(len(reference), len(other)) < 2:
        raise ValueError(f"layout_frechet needs at least 2 scenes a side, got {len(reference)} and {len(other)}")
    known = ~np.isnan(reference)
    number = np.maximum(known.sum(axis=0), 1)
    mean = np.where(known, reference, 0).sum(axis=0) / number
    deviation = np.sqrt(np.where(known, np.square(reference - mean), 0).sum(axis=0) / number)
    scale = np.where(deviation > 1e-9 * np.maximum(np.abs(mean), 1), deviation, 1.0)
    standardised = (np.where(np.isnan(part), 0.0, (part - mean) / scale) for part in (reference, other))
    return frechet_distance(*(moments(part) for part in standardised))


def jensen_shannon(p: np.ndarray, q: np.ndarray) -> float:
    """Jensen-Shannon divergence in bits, in [0, 1], of two histograms (b,) over the same bins."""
    p, q = np.asarray(p, np.float64), np.asarray(q, np.float64)
    if p.shape != q.shape or p.sum() <= 0 or q.sum() <= 0 or min(p.min(), q.min()) < 0:
        raise ValueError("Jensen-Shannon needs two histograms over the same bins, neither empty nor negative")
    p, q = p / p.sum(), q / q.sum()
    middle = (p + q) / 2
    return float(np.clip((_entropy_bits(middle) - (_entropy_bits(p) + _entropy_bits(q)) / 2), 0.0, 1.0))


def count_divergence(reference_counts: np.ndarray, other_counts: np.ndarray) -> dict[str, float]:
    """Jensen-Shannon divergence (bits) of each category's counts per scene; counts (n, 11) and (m, 11), integers.

    One bin per count. Finite samples differ from themselves: two halves of the reference give the floor to compare
    with.
    """
    divergence = {}
    for c, category in enumerate(CATEGORIES):
        sides = np.asarray(reference_counts)[:, c].astype(int), np.asarray(other_counts)[:, c].astype(int)
        bins = max(side.max(initial=0) for side in sides) + 1
        divergence[category] = jensen_shannon(*(np.bincount(side, minlength=bins) for side in sides))
    return divergence


def _entropy_bits(p: np.ndarray) -> float:
    p = p[p > 0]
    return float(-(p * np.log2(p)).sum())
