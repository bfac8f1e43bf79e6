"""Classifier two-sample test: how well can a classifier tell generated scenes from real scenes?

The test follows Lopez-Paz & Oquab (2017), with the area under the ROC curve (AUC) instead of the accuracy. An AUC of
0.5 means that the classifier finds no difference. The classifier and its folds are fixed by seeds, so that the same
features always give the same result. A cross-validated AUC may fall below 0.5 if there are few places: without a
difference to learn, the places in the training folds predict the opposite of those in the test fold.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import norm, rankdata
from sklearn.ensemble import ExtraTreesClassifier
from sklearn.model_selection import StratifiedGroupKFold

from pipelines.metrics.intervals import Estimate

FOLDS = 5
TREES = 200
MIN_LEAF = 3
MIN_SCENES = 2 * FOLDS
SHOWN = 5  # Number of features that are listed.
NORMAL_975 = float(norm.ppf(0.975))


class TwoSampleTest(NamedTuple):
    """Result of the test.

    Attributes:
        auc: Cross-validated AUC; 0.5 is the best value.
        features: Names of the features that differ most between the sides, with their own AUC: the probability that a
            generated scene has a larger value than a real scene. Values far from 0.5 give scenes away.
    """

    auc: Estimate
    features: dict[str, float]


def classify_samples(
    real: np.ndarray,
    generated: np.ndarray,
    names: Sequence[str],
    places: tuple[np.ndarray, np.ndarray] | None = None,
    seed: int = 0,
) -> TwoSampleTest:
    """Train and test a classifier that separates two sets of scenes.

    The classifier (extremely randomised trees) is trained on four fifths of the scenes and tested on the remaining
    fifth, for each of five folds. The scenes of a place are either all trained on or all tested on. Otherwise, the
    classifier would recognise places instead of differences between the sides. Missing values get the mean of the real
    scenes and an additional 0/1 feature.

    Args:
        real: (n, d) features of real scenes; NaN marks missing values.
        generated: (m, d) features of generated scenes.
        names: d names of the features.
        places: Place (n,) of each real scene and place (m,) of each generated scene; None: each scene is a place.
        seed: Seed of the folds and of the trees.

    Returns:
        AUC with its interval, and the features that differ most.

    Raises:
        ValueError: A side has fewer than MIN_SCENES scenes or fewer than FOLDS places, or the features do not match.
    """
    if real.shape[1] != generated.shape[1] or real.shape[1] != len(names):
        raise ValueError(f"features {real.shape} and {generated.shape} with {len(names)} names do not match")
    if min(len(real), len(generated)) < MIN_SCENES:
        raise ValueError(
            f"the two-sample test needs at least {MIN_SCENES} scenes per side, got {len(real)} and {len(generated)};"
            " give more scenes"
        )
    if places is None:
        places = np.arange(len(real)), np.arange(len(real), len(real) + len(generated))
    if min(len(np.unique(side)) for side in places) < FOLDS:
        raise ValueError(
            f"the two-sample test needs scenes of at least {FOLDS} places per side, got"
            f" {' and '.join(str(len(np.unique(side))) for side in places)}; give scenes that are farther apart"
        )
    groups = np.unique(np.concatenate([np.asarray(side, str) for side in places]), return_inverse=True)[1]
    features = fill_missing(np.concatenate([real, generated]), len(real))
    is_generated = np.repeat([0, 1], [len(real), len(generated)])
    score, fold = np.empty(len(features)), np.empty(len(features), int)
    folds = StratifiedGroupKFold(FOLDS, shuffle=True, random_state=seed)
    for number, (train, test) in enumerate(folds.split(features, is_generated, groups)):
        trees = ExtraTreesClassifier(
            TREES, min_samples_leaf=MIN_LEAF, class_weight="balanced", random_state=seed, n_jobs=1
        )
        trees.fit(features[train], is_generated[train])
        fold[test], score[test] = number, np.asarray(trees.predict_proba(features[test]))[:, 1]
    alone = {name: compute_auc(*_keep_known(real[:, k], generated[:, k])) for k, name in enumerate(names)}
    telling = sorted(alone, key=lambda name: -abs(alone[name] - 0.5))[:SHOWN]
    return TwoSampleTest(
        estimate_auc(score, is_generated, groups, fold), {name: round(alone[name], 4) for name in telling}
    )


def fill_missing(features: np.ndarray, num_real: int) -> np.ndarray:
    """Replace missing values by the mean of the real scenes, and append which values were missing.

    Args:
        features: (n, d) features; NaN marks missing values. The first `num_real` rows belong to real scenes.
        num_real: Number of real scenes.

    Returns:
        (n, d + e) float32 features; e is the number of features with missing values.
    """
    missing = np.isnan(features)
    known = ~missing[:num_real]
    sums = np.where(known, features[:num_real], 0).sum(axis=0)
    mean = sums / np.maximum(known.sum(axis=0), 1)
    filled = np.where(missing, mean, features)
    return np.concatenate([filled, missing[:, missing.any(axis=0)]], axis=1).astype(np.float32)


def _keep_known(real: np.ndarray, generated: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return real[np.isfinite(real)], generated[np.isfinite(generated)]


def compute_auc(real: np.ndarray, generated: np.ndarray) -> float:
    """Compute the probability that a generated value is larger than a real value; ties count one half.

    Args:
        real: (n,) values.
        generated: (m,) values.

    Returns:
        The AUC (Mann-Whitney U divided by n m); 0.5 if a side is empty.
    """
    n, m = len(real), len(generated)
    if not n or not m:
        return 0.5
    ranks = rankdata(np.concatenate([real, generated]))
    return float((ranks[n:].sum() - m * (m + 1) / 2) / (n * m))


def estimate_auc(
    score: np.ndarray, is_generated: np.ndarray, groups: np.ndarray | None = None, fold: np.ndarray | None = None
) -> Estimate:
    """Estimate the AUC of cross-validated scores.

    Scores are compared only within a fold, because the classifiers of different folds have different thresholds. The
    interval is that of DeLong et al. (1988) for independent samples, with the extension of Obuchowski (1997) to groups:
    scenes of one group count as dependent.

    Args:
        score: (n,) scores.
        is_generated: (n,) 0 for real scenes, 1 for generated scenes.
        groups: (n,) group of each scene; None: each scene is a group.
        fold: (n,) fold of each scene; None: one fold.

    Returns:
        AUC and its 95 % interval, clipped to [0, 1].

    Raises:
        ValueError: No fold has scenes of both sides.
    """
    groups = np.arange(len(score)) if groups is None else groups
    fold = np.zeros(len(score), int) if fold is None else fold
    placement, weight = np.zeros(len(score)), np.zeros(len(score))
    pairs = 0
    for number in np.unique(fold):
        sides = [np.flatnonzero((fold == number) & (is_generated == side)) for side in (0, 1)]
        n, m = map(len, sides)
        if not n or not m:
            continue
        ranks = rankdata(score[np.concatenate(sides)])
        # The placement is the share of pairs with the other side in which the generated scene has the larger score.
        placement[sides[0]] = 1 - (ranks[:n] - rankdata(score[sides[0]])) / m
        placement[sides[1]] = (ranks[n:] - rankdata(score[sides[1]])) / n
        weight[sides[0]], weight[sides[1]] = m, n  # Number of pairs of each scene.
        pairs += n * m
    if not pairs:
        raise ValueError("no fold has both real and generated scenes; give scenes of more places")
    value = float((weight * placement)[is_generated == 1].sum() / pairs)
    variance = 0.0
    for side in (0, 1):
        here = (is_generated == side) & (weight > 0)
        _, index = np.unique(groups[here], return_inverse=True)
        sums = np.bincount(index, (weight * (placement - value))[here]) / pairs
        variance += (sums**2).sum() * len(sums) / max(len(sums) - 1, 1)
    margin = NORMAL_975 * variance**0.5
    return Estimate(value, max(value - margin, 0.0), min(value + margin, 1.0))
