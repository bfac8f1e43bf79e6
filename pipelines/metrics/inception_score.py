"""Compute the Inception score from logits (paper, Sec. 4.1) with its confidence interval."""

from __future__ import annotations

import numpy as np

from pipelines.metrics.frechet import check_features
from pipelines.metrics.intervals import Estimate, compute_weights, make_estimate

SPLIT_SAMPLES = 5000  # Samples per split, as in ADM's evaluator.


def compute_inception_score(logits: np.ndarray) -> Estimate:
    """Compute the exponential of the mean KL(p(y|x) || p(y)), averaged over consecutive splits of 5000 samples (ADM).

    The mean divergence is the entropy of the mean distribution minus the mean entropy. Let w be the weights of a
    resample. The score of the resample therefore needs only two products: w with p, and w with the entropies.

    Args:
        logits: (n, classes) logits pool3 @ W **without bias**, as in ADM.

    Returns:
        Score with its 95 % interval.

    Raises:
        ValueError: The logits are empty, are not 2-d or are not finite.
    """
    logits = check_features(logits, "logit", at_least=1).astype(np.float64)
    logits -= logits.max(axis=1, keepdims=True)
    log_p = logits - np.log(np.exp(logits).sum(axis=1, keepdims=True))
    scores = []
    for start in range(0, len(log_p), SPLIT_SAMPLES):
        part = log_p[start : start + SPLIT_SAMPLES]
        p = np.exp(part)
        drawn = compute_weights(len(p), key=start)
        scores.append(np.exp(compute_entropy(drawn @ p) - drawn @ compute_entropy(p)))
    return make_estimate(np.mean(scores, axis=0))


def compute_entropy(p: np.ndarray) -> np.ndarray:
    """Compute the entropy of distributions over the last axis; 0 log 0 counts as 0.

    Args:
        p: (..., classes) distributions.

    Returns:
        (...) entropies in nats.
    """
    return -(p * np.log(np.where(p > 0, p, 1.0))).sum(axis=-1)
