"""Split poses into training, test and unused poses (paper, supplement A, Dataset Construction)."""

from __future__ import annotations

import logging

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

TRAIN, TEST, UNUSED = "train", "test", "unused"

# Values from the paper, supplement A.
MAX_SEGMENTS = 100
TEST_M = 15.0
MARGIN_M = 5.0
REMOVAL_M = 5.0
# The paper defines the split only for its 73.7 km of drives. Shorter drives are cut into fewer segments. Each segment
# has at least 50 m: 25 m for test poses with margins, and 25 m for training poses.
MIN_SEGMENT_M = 50.0

# Squares of maps: all poses of a test square are test poses.
SQUARE_M = 400.0
CROP_AHEAD_M = 32.0  # Distance from a pose to the middle of its crop.
CROP_REACH_M = 2 * 32.0 * 2**0.5  # Crops whose middles are farther apart than this do not overlap.

# Argoverse 2 is split by log; its test logs have no annotations.
ARGOVERSE2_SPLIT = {"train": TRAIN, "val": TEST}

logger = logging.getLogger(__name__)


def split_poses(positions_by_sequence: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Assign the split train, test or unused to every pose of every sequence.

    The sequences are concatenated, and the total driven distance is cut into segments of equal length. The gap between
    two sequences counts as 0 m. Each segment is divided as follows:

        train ... | 5 m unused | 15 m test | 5 m unused

    Then every train pose within 5 m (BEV) of a test pose becomes unused. Every test pose within 5 m of a train pose
    also becomes unused. The paper does not define the order of these two removals. In this code, both removals use the
    splits from before the first removal. Both poses of a close pair therefore become unused.

    Args:
        positions_by_sequence: (p, 3) positions of each sequence in driving order (m), in one shared world frame. Pass
            all poses, because missing poses shorten the distance driven.

    Returns:
        (p,) str per sequence: train, test or unused.

    Raises:
        ValueError: Positions do not have shape (p, 3), or are not finite.
    """
    for sequence, position_m in positions_by_sequence.items():
        if np.ndim(position_m) != 2 or np.shape(position_m)[1] != 3:
            raise ValueError(f"sequence {sequence}: positions have shape {np.shape(position_m)}, expected (p, 3)")
        if not np.isfinite(position_m).all():
            raise ValueError(f"sequence {sequence}: some positions are not finite; fix or drop these poses first")
    if not any(len(position_m) for position_m in positions_by_sequence.values()):
        return make_no_split(positions_by_sequence)

    driven_m, total_m = _compute_distance_driven(list(positions_by_sequence.values()))
    labels = _label_by_distance(driven_m, total_m, count_segments(total_m))
    bev_m = np.concatenate([np.asarray(p, np.float64)[:, :2] for p in positions_by_sequence.values()])
    labels = _remove_close(labels, bev_m)
    ends = np.cumsum([len(position_m) for position_m in positions_by_sequence.values()])
    return dict(zip(positions_by_sequence, np.split(labels, ends[:-1]), strict=True))


def make_no_split(positions_by_sequence: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Assign the split "train" to every pose.

    Args:
        positions_by_sequence: (p, 3) positions of each sequence (m).

    Returns:
        (p,) str per sequence, all "train".
    """
    return {sequence: np.full(len(p), TRAIN, object) for sequence, p in positions_by_sequence.items()}


def split_squares(xy_m: np.ndarray, yaw_rad: np.ndarray, test_share: float) -> np.ndarray:
    """Split poses of a map by squares of SQUARE_M.

    Randomly chosen squares with at most `test_share` of the poses become test squares. Training poses whose crops may
    overlap the crop of a test pose become unused.

    Args:
        xy_m: (p, 2) positions (m).
        yaw_rad: (p,) headings.
        test_share: Largest share of poses in test squares.

    Returns:
        (p,) str: train, test or unused.
    """
    labels = np.full(len(xy_m), TRAIN, object)
    middle_m = xy_m + CROP_AHEAD_M * np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], axis=1)
    squares, owner = np.unique(np.floor(middle_m / SQUARE_M).astype(np.int64), axis=0, return_inverse=True)
    owner = owner.reshape(-1)
    count = np.bincount(owner, minlength=len(squares))
    chosen, room = [], test_share * len(xy_m)
    for square in np.random.default_rng(0).permutation(len(squares)).tolist():
        if count[square] <= room:
            chosen.append(square)
            room -= count[square]
    labels[np.isin(owner, chosen)] = TEST
    test, train = np.flatnonzero(labels == TEST), np.flatnonzero(labels == TRAIN)
    if len(test) and len(train):
        distance_m, _ = cKDTree(middle_m[test]).query(middle_m[train], distance_upper_bound=CROP_REACH_M)
        labels[train[np.isfinite(distance_m)]] = UNUSED
    return labels


def count_segments(total_m: float) -> int:
    """Return the number of split segments: min(100, floor(total_m / 50 m)), at least 1.

    The function logs a warning if the number is less than the paper's 100.

    Args:
        total_m: Driven distance, summed over all sequences (m).

    Returns:
        Number of segments.
    """
    count = max(1, min(MAX_SEGMENTS, int(total_m // MIN_SEGMENT_M)))
    if count < MAX_SEGMENTS:
        logger.warning(
            "the drives are %.0f m long; they are cut into %d segments of %.1f m instead of the paper's %d segments%s",
            total_m,
            count,
            total_m / count,
            MAX_SEGMENTS,
            "" if total_m > TEST_M + 2 * MARGIN_M else "; no training pose remains, so preprocess without a split",
        )
    return count


def _compute_distance_driven(positions_m: list[np.ndarray]) -> tuple[np.ndarray, float]:
    """Return the distance driven up to each pose of all sequences, shape (sum of p,), and the total distance (m)."""
    steps = [
        np.concatenate([[0.0], np.linalg.norm(np.diff(np.asarray(p, np.float64), axis=0), axis=1)])
        for p in positions_m
        if len(p)
    ]
    driven_m = np.cumsum(np.concatenate(steps))
    return driven_m, float(driven_m[-1])


def _label_by_distance(driven_m: np.ndarray, total_m: float, segments: int) -> np.ndarray:
    """Return the split (p,) of each pose. The position within the segment determines the split."""
    ends_m = total_m * np.arange(1, segments + 1) / segments
    segment = np.searchsorted(ends_m, driven_m, side="right").clip(max=segments - 1)
    to_end_m = ends_m[segment] - driven_m
    labels = np.full(len(driven_m), UNUSED, object)
    labels[to_end_m > TEST_M + 2 * MARGIN_M] = TRAIN
    labels[(to_end_m > MARGIN_M) & (to_end_m <= MARGIN_M + TEST_M)] = TEST
    return labels


def _remove_close(labels: np.ndarray, bev_m: np.ndarray) -> np.ndarray:
    """Return the splits (p,), in which train and test poses within 5 m (BEV) of each other are unused."""
    train, test = np.flatnonzero(labels == TRAIN), np.flatnonzero(labels == TEST)
    if len(train) == 0 or len(test) == 0:
        return labels
    labels = labels.copy()
    for side, other in ((train, test), (test, train)):
        distance_m, _ = cKDTree(bev_m[other]).query(bev_m[side])
        labels[side[distance_m <= REMOVAL_M]] = UNUSED
    return labels
