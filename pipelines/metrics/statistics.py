"""Compute layout statistics: one vector of named numbers per scene. Sources are compared as sets of these vectors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from models.scene import CATEGORIES, Scene

EXTENTS = ("length_m", "width_m", "height_m")


def list_statistic_names(ground_classes: Sequence[str]) -> tuple[str, ...]:
    """Return the column names of `compute_layout_statistics`: num_<category>, <category>_<extent>_m and <class>_share.

    Args:
        ground_classes: Names of the ground classes.

    Returns:
        11 + 33 + G names.
    """
    counts = [f"num_{category}" for category in CATEGORIES]
    extents = [f"{category}_{extent}" for category in CATEGORIES for extent in EXTENTS]
    return (*counts, *extents, *(f"{name}_share" for name in ground_classes))


def compute_layout_statistics(scene: Scene) -> np.ndarray:
    """Compute the layout statistics of one scene: object counts, mean extents and shares of ground classes.

    The sum of the shares may exceed 1, because ground classes may overlap.

    Args:
        scene: Scene with G ground classes.

    Returns:
        (11 + 33 + G,) float64: number of objects per category, mean extents per category (m; NaN if there are no
        objects), share of pixels per ground class.
    """
    counts = scene.counts()
    totals = np.zeros((len(CATEGORIES), 3))
    np.add.at(totals, scene.category, scene.size_m.astype(np.float64))
    extents = np.divide(totals, counts[:, None], out=np.full_like(totals, np.nan), where=counts[:, None] > 0)
    shares = scene.occupied.mean(axis=(1, 2))
    return np.concatenate([counts, extents.ravel(), shares])


def standardize_statistics(reference: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shift and scale layout statistics by the mean and standard deviation of the reference.

    Afterwards, distances have no unit, and all columns have about the same weight. A constant column is only shifted.
    NaN marks the size of an absent category and is replaced by the mean of the reference.

    Args:
        reference: (n, s) statistics that define the mean and the standard deviation.
        other: (m, s) statistics.

    Returns:
        Standardised statistics of both sides.

    Raises:
        ValueError: A side has fewer than 2 scenes, or the columns differ.
    """
    reference, other = np.asarray(reference, np.float64), np.asarray(other, np.float64)
    if reference.ndim != 2 or other.ndim != 2 or reference.shape[1] != other.shape[1]:
        raise ValueError(
            f"layout statistics (scenes, columns) need equal columns, got {reference.shape} and {other.shape}"
        )
    if min(len(reference), len(other)) < 2:
        raise ValueError(f"layout statistics need at least 2 scenes per side, got {len(reference)} and {len(other)}")
    known = ~np.isnan(reference)
    number = np.maximum(known.sum(axis=0), 1)
    mean = np.where(known, reference, 0).sum(axis=0) / number
    deviation = np.sqrt(np.where(known, np.square(reference - mean), 0).sum(axis=0) / number)
    scale = np.where(deviation > 1e-9 * np.maximum(np.abs(mean), 1), deviation, 1.0)
    features, other_features = (np.where(np.isnan(part), 0.0, (part - mean) / scale) for part in (reference, other))
    return features, other_features
