"""Compute density labels from statistics of the training split (paper, supplement A, Scene Labeling)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from models.scene import DENSITIES


@dataclass(frozen=True)
class DensityThresholds:
    """Percentiles (25th and 75th) of a group's count and total volume per training scene."""

    count_p25: float
    count_p75: float
    volume_p25_m3: float
    volume_p75_m3: float


def compute_density_thresholds(count: np.ndarray, volume_m3: np.ndarray) -> DensityThresholds:
    """Compute the thresholds of a density label from a training split.

    Args:
        count: (n,) number of the group's primitives per scene, before truncation to the slots.
        volume_m3: (n,) total volume of the group's primitives per scene (m3).

    Returns:
        25th and 75th percentiles of both quantities.

    Raises:
        ValueError: The training split is empty.
    """
    if len(count) == 0:
        raise ValueError("density thresholds need at least one training scene; the training split is empty")
    return DensityThresholds(*np.percentile(count, [25, 75]), *np.percentile(volume_m3, [25, 75]))


def classify_density(
    count: np.ndarray | Sequence[float] | float,
    volume_m3: np.ndarray | Sequence[float] | float,
    thresholds: DensityThresholds,
) -> Any:
    """Assign the density label low, medium or high to each scene.

    The label is low if count and volume lie below their 25th percentiles. The label is high if count and volume lie
    above their 75th percentiles. Otherwise, the label is medium (paper, supplement A, Scene Labeling).

    Args:
        count: Number of the group's primitives in each scene, or in a single scene.
        volume_m3: Total volume of the group's primitives (m3), same shape as `count`.
        thresholds: Percentiles of the training split.

    Returns:
        Labels (str) with the shape of `count`.
    """
    count, volume_m3 = np.asarray(count), np.asarray(volume_m3)
    low = (count < thresholds.count_p25) & (volume_m3 < thresholds.volume_p25_m3)
    high = (count > thresholds.count_p75) & (volume_m3 > thresholds.volume_p75_m3)
    return np.array(DENSITIES)[np.where(low, 0, np.where(high, 2, 1))]
