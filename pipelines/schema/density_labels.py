"""Density labels from statistics of the training split (paper, supplement A, Scene Labeling)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from models.scene import DENSITIES


@dataclass(frozen=True)
class DensityThresholds:
    """25th and 75th percentiles of a group's count and volume over the training split."""

    count_p25: float
    count_p75: float
    volume_p25_m3: float
    volume_p75_m3: float


def compute_density_thresholds(count: np.ndarray, volume_m3: np.ndarray) -> DensityThresholds:
    """Thresholds from the counts (n,) and volumes (n,) of a training split, before any truncation to slots."""
    if len(count) == 0:
        raise ValueError("density thresholds need at least one training scene; the training split is empty")
    return DensityThresholds(*np.percentile(count, [25, 75]), *np.percentile(volume_m3, [25, 75]))


def classify_density(
    count: np.ndarray | Sequence[float] | float,
    volume_m3: np.ndarray | Sequence[float] | float,
    thresholds: DensityThresholds,
) -> Any:
    """(n,) str: low if count and volume lie below their p25, high if both lie above their p75, else medium."""
    count, volume_m3 = np.asarray(count), np.asarray(volume_m3)
    low = (count < thresholds.count_p25) & (volume_m3 < thresholds.volume_p25_m3)
    high = (count > thresholds.count_p75) & (volume_m3 > thresholds.volume_p75_m3)
    return np.array(DENSITIES)[np.where(low, 0, np.where(high, 2, 1))]
