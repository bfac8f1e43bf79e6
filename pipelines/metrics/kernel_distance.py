"""Compute the kernel distance: the unbiased squared MMD with a cubic kernel (Binkowski et al. 2018).

Only the kernel distance of Inception's pool3 features may be called KID.
"""

from __future__ import annotations

import numpy as np

from pipelines.metrics.intervals import Estimate, compute_weights, make_estimate
from pipelines.metrics.neighbours import require_comparable

GROUP_SAMPLES = 1000  # Samples per group; published KIDs usually use subsets of this size.


def compute_kernel_distance(real: np.ndarray, generated: np.ndarray) -> Estimate:
    """Estimate the squared MMD with kernel (x . y / d + 1)^3, averaged over groups of about 1000 samples per side.

    Each sample belongs to one group. The common estimate uses 50 or 100 random subsets of 1000 samples. Both estimates
    have the same expectation. Bootstrap draws are made within groups. A sample that is drawn twice is not paired with
    itself, because such a pair would bias the estimate.

    Args:
        real: (n, d) features, n >= 2.
        generated: (m, d) features, m >= 2.

    Returns:
        Distance with its 95 % interval.

    Raises:
        ValueError: The features have different dimensions, fewer than 2 samples or numbers that are not finite.
    """
    real, generated = require_comparable(real, generated, at_least=2)
    groups = max(1, min(len(real), len(generated)) // GROUP_SAMPLES)
    scores = []
    for group in range(groups):
        # Neighbouring samples of a drive fall into different groups, because the stride is `groups`.
        x, y = (side[group::groups].astype(np.float64) for side in (real, generated))
        drawn = [compute_weights(len(z), key=2 * group + k) for k, z in enumerate((x, y))]
        within = [sum_pairs(w, compute_kernel(z, z)) for w, z in zip(drawn, (x, y), strict=True)]
        across = ((drawn[0] @ compute_kernel(x, y)) * drawn[1]).sum(axis=1)
        scores.append(within[0] + within[1] - 2 * across)
    return make_estimate(np.mean(scores, axis=0))


def compute_kernel(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Compute the cubic kernel for all pairs of samples.

    Args:
        x: (n, d) features.
        y: (m, d) features.

    Returns:
        (n, m) kernel matrix.
    """
    return (x @ y.T / x.shape[1] + 1) ** 3


def sum_pairs(weights: np.ndarray, gram: np.ndarray) -> np.ndarray:
    """Compute the weighted mean of a kernel matrix over pairs of different samples.

    Args:
        weights: (b, n) weights of the samples, one row per draw.
        gram: (n, n) kernel matrix.

    Returns:
        (b,) means. If a draw holds only one distinct sample, the mean is NaN.
    """
    own = np.square(weights)
    total = ((weights @ gram) * weights).sum(axis=1) - own @ np.diag(gram)
    share = 1 - own.sum(axis=1)
    return np.divide(total, share, out=np.full_like(total, np.nan), where=share > 0)
