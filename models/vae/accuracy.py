"""Accuracy of decoded primitives, measured on pairs of a true primitive and a proposal.

AP3D remains near zero as long as proposals lie metres from the primitives. These scores also change in that range, so
they show whether a decoder learns at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.batch import LayoutBatch
from models.geometry.cholesky import decode_cholesky_boxes
from models.geometry.iou3d import compute_iou3d_pairs, make_boxes
from models.layout import LayoutSpec
from models.tensors import EXISTENCE_THRESHOLD
from models.vae.matching import MatchWeights, match_primitives
from models.vae.outputs import LayoutOutput

NEAR_M = 1.0  # Maximum centre distance of a detected primitive (m).


@dataclass(frozen=True)
class PrimitivePairs:
    """Pairs of a true primitive and a proposal of one or more scenes.

    Attributes:
        distance_m: (p,) distance of the centres (m).
        iou3d: (p,) IoU3D.
        above_threshold: (p,) bool, True if the existence probability of the proposal exceeds the existence threshold.
        num_above_threshold: Number of all proposals whose existence probability exceeds the threshold.
    """

    distance_m: np.ndarray
    iou3d: np.ndarray
    above_threshold: np.ndarray
    num_above_threshold: int


def pair_primitives(output: LayoutOutput, batch: LayoutBatch, spec: LayoutSpec) -> PrimitivePairs:
    """Match true primitives with proposals.

    The matching is one to one within a category. It minimises the paper's matching cost without the term of existence,
    that is, the distances of the normalised centres and Cholesky parameters, regardless of the unit in training.

    Args:
        output: Decoded scenes.
        batch: True scenes.
        spec: Layout of both.

    Returns:
        Pairs of all scenes.
    """
    output = output.float()
    found = match_primitives(
        output.features,
        output.existence_logit,
        batch.features,
        batch.real,
        spec.slots,
        output.proposals,
        MatchWeights(existence=0.0),
    )
    sample, proposal = (found >= 0).nonzero(as_tuple=True)
    boxes = []
    for features in (output.features[sample, proposal], batch.features[sample, found[sample, proposal]]):
        values = features.double().cpu().numpy()
        center_m = spec.center_bounds_m.restore(values[:, :3])
        boxes.append(make_boxes(center_m, *decode_cholesky_boxes(spec.cholesky_bounds.restore(values[:, 3:]))))
    above_threshold = output.existence_logit.sigmoid() > EXISTENCE_THRESHOLD
    return PrimitivePairs(
        np.linalg.norm(boxes[0].center_m - boxes[1].center_m, axis=1),
        compute_iou3d_pairs(*boxes),
        above_threshold[sample, proposal].cpu().numpy(),
        int(above_threshold.sum()),
    )


def join_pairs(parts: Sequence[PrimitivePairs]) -> PrimitivePairs:
    """Join the pairs of several batches.

    Args:
        parts: Pairs per batch.

    Returns:
        Pairs of all batches.
    """
    names = ("distance_m", "iou3d", "above_threshold")
    joined = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
    return PrimitivePairs(*joined, num_above_threshold=sum(part.num_above_threshold for part in parts))


@dataclass(frozen=True)
class Accuracy:
    """Accuracy of the pairs. All scores are NaN if there is no true primitive.

    Attributes:
        median_center_error_m: Median distance of the centres (m).
        recall_1m: Share of the true primitives that are detected: the matched proposal is above the existence
            threshold, and its centre lies within NEAR_M.
        precision_1m: Share of the proposals above the threshold that detect a primitive; 0 without such proposals.
        mean_iou3d: Mean IoU3D.
    """

    median_center_error_m: float
    recall_1m: float
    precision_1m: float
    mean_iou3d: float


def compute_accuracy(pairs: PrimitivePairs) -> Accuracy:
    """Summarise pairs.

    Args:
        pairs: Pairs of one or more scenes.

    Returns:
        The scores.
    """
    if len(pairs.distance_m) == 0:
        return Accuracy(*[float("nan")] * 4)
    detected = (pairs.distance_m < NEAR_M) & pairs.above_threshold
    return Accuracy(
        float(np.median(pairs.distance_m)),
        float(detected.mean()),
        float(detected.sum() / max(pairs.num_above_threshold, 1)),
        float(pairs.iou3d.mean()),
    )
