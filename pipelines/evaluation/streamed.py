"""Compute Frechet distances and the Inception score from files of features, with one part in memory at a time.

The files are read twice: once for the moments, and once for the influence of each scene on the distance, from which the
interval is computed. The second pass keeps one number per scene.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping
from functools import reduce
from typing import Any

import numpy as np

from pipelines.evaluation.features import FeatureParts
from pipelines.metrics.frechet import (
    Moments,
    compute_frechet_distance,
    compute_influence_maps,
    compute_moments,
    compute_transport,
    compute_uncentred_influence,
)
from pipelines.metrics.inception_score import compute_streamed_inception_score
from pipelines.metrics.intervals import Estimate, estimate_from_influence

# Score of each column of features.
STREAMED_SCORES = {"pool3": "fid", "spatial": "sfid", "lite0": "lite0_frechet", "random": "random_frechet"}


def compute_streamed_moments(parts: FeatureParts, column: str) -> Moments:
    """Compute the moments of a column, part by part.

    Raises:
        ValueError: The features are not finite. The message names the directory.
    """
    try:
        return reduce(operator.add, map(compute_moments, parts.iterate_column(column)))
    except ValueError as error:
        raise ValueError(f"{parts.directory}, column {column}: {error}") from error


def compute_streamed_influence(
    parts: FeatureParts, column: str, own: Moments, other_mean: np.ndarray, through: np.ndarray
) -> np.ndarray:
    """Compute the influence (n,) of each scene on the Frechet distance (`compute_frechet_influence`), part by part."""
    found = np.concatenate(
        [compute_uncentred_influence(part, own, other_mean, through) for part in parts.iterate_column(column)]
    )
    return found - found.mean()


def compare_streamed(real: FeatureParts, sides: Mapping[str, FeatureParts]) -> dict[str, dict[str, Estimate]]:
    """Score each side against the real scenes.

    Args:
        real: Files of the real scenes.
        sides: Files of the generated scenes and, if there are any, of the ceiling and of controls.

    Returns:
        fid, sfid and inception_score with Inception features; lite0_frechet and random_frechet with these features.
    """
    columns = real.list_columns()
    scores: dict[str, dict[str, Any]] = {side: {} for side in sides}
    for column, score in STREAMED_SCORES.items():
        if column in columns:
            a = compute_streamed_moments(real, column)
            for side, parts in sides.items():
                b = compute_streamed_moments(parts, column)
                between = compute_transport(a, b)
                by_real, by_side = compute_influence_maps(b, between)
                influences = [
                    compute_streamed_influence(real, column, a, b.mean, by_real),
                    compute_streamed_influence(parts, column, b, a.mean, by_side),
                ]
                distance = compute_frechet_distance(a, b, between)
                scores[side][score] = estimate_from_influence(distance, influences)
    if "logits" in columns:
        for side, parts in sides.items():
            scores[side]["inception_score"] = compute_streamed_inception_score(parts.iterate_column("logits"))
    return scores
