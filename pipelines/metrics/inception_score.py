"""Inception score from logits (paper, Sec. 4.1), with its interval."""

from __future__ import annotations

import numpy as np

from pipelines.metrics.frechet import check_features
from pipelines.metrics.intervals import Estimate, compute_weights, make_estimate

SPLIT_SAMPLES = 5000  # ADM's evaluator


def compute_inception_score(logits: np.ndarray) -> Estimate:
    """exp of the mean KL(p(y|x) || p(y)), averaged over splits of 5000 samples in order (ADM).

    logits (n, classes) are pool3 @ W **without the bias**, as ADM takes them. The mean divergence is the entropy of the
    mean less the mean entropy, so a resample costs a product of its weights with p.
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
    """Of the distributions in the rows, in nats; 0 log 0 = 0."""
    return -(p * np.log(np.where(p > 0, p, 1.0))).sum(axis=-1)
