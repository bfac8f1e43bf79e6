"""Compute the Inception score from logits (paper, Sec. 4.1) with its confidence interval."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from pipelines.metrics.frechet import check_features
from pipelines.metrics.intervals import Estimate, compute_weights, make_estimate

SPLIT_SAMPLES = 5000  # Samples per split, as in ADM's evaluator.


def compute_inception_score(logits: np.ndarray) -> Estimate:
    """Compute the exponential of the mean KL(p(y|x) || p(y)), averaged over consecutive splits of 5000 samples.

    The splits follow ADM's evaluator, which the paper uses: Evaluator.compute_inception_score in
    evaluations/evaluator.py of openai/guided-diffusion (commit 22e0df8), with split_size=5000. The last split may be
    shorter and has the same weight.

    Args:
        logits: (n, classes) logits pool3 @ W **without bias**, as in ADM.

    Returns:
        Score with its 95 % interval.

    Raises:
        ValueError: The logits are empty, are not 2-d or are not finite.
    """
    logits = check_features(logits, "logit", at_least=1)
    return compute_streamed_inception_score([logits])


def compute_streamed_inception_score(parts: Iterable[np.ndarray]) -> Estimate:
    """Compute the Inception score of logits that arrive in parts, with one split of 5000 samples in memory.

    Args:
        parts: Logits (n, classes) of consecutive samples; the sizes of the parts do not change the score.

    Returns:
        Score with its 95 % interval.

    Raises:
        ValueError: There are no logits, or they are not 2-d or not finite.
    """
    scores, waiting, count = [], [], 0
    for part in parts:
        part = check_features(part, "logit", at_least=0)
        while len(part):
            taken, part = np.split(part, [SPLIT_SAMPLES - count])
            waiting, count = [*waiting, taken], count + len(taken)
            if count == SPLIT_SAMPLES:
                scores.append(_score_split(np.concatenate(waiting), len(scores) * SPLIT_SAMPLES))
                waiting, count = [], 0
    if waiting:
        scores.append(_score_split(np.concatenate(waiting), len(scores) * SPLIT_SAMPLES))
    if not scores:
        raise ValueError("logit features hold 0 samples, at least 1 are needed")
    return make_estimate(np.mean(scores, axis=0))


def _score_split(logits: np.ndarray, key: int) -> np.ndarray:
    """Return the score of one split and of its resamples.

    The mean divergence is the entropy of the mean distribution minus the mean entropy. Let w be the weights of a
    resample. The score of the resample therefore needs only two products: w with p, and w with the entropies.
    """
    logits = logits.astype(np.float64)
    logits -= logits.max(axis=1, keepdims=True)
    p = np.exp(logits - np.log(np.exp(logits).sum(axis=1, keepdims=True)))
    drawn = compute_weights(len(p), key)
    return np.exp(compute_entropy(drawn @ p) - drawn @ compute_entropy(p))


def compute_entropy(p: np.ndarray) -> np.ndarray:
    """Compute the entropy of distributions over the last axis; 0 log 0 counts as 0.

    Args:
        p: (..., classes) distributions.

    Returns:
        (...) entropies in nats.
    """
    return -(p * np.log(np.where(p > 0, p, 1.0))).sum(axis=-1)
