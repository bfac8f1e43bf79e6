"""A direct implementation of the paper's training objective of the layout VAE, used as a baseline by benchmarks.

Matching pads the true primitives to the number of proposals and fills whole cost tensors. The losses are computed in
Python loops over samples and categories. The object encoder also computes padded slots. The results equal the results
of this project, but the computation takes more time.
"""

from __future__ import annotations

import contextlib

import numpy as np
import torch
import torch.nn.functional as F
from scipy.optimize import linear_sum_assignment

from models.layout import LayoutSpec
from models.vae import losses
from models.vae.objects import ObjectEncoder


def compute_square_cost(features, logit, truth, real, weights) -> torch.Tensor:
    """Compute the (n, n) matching costs of one sample and category (supplement Eq. "match").

    The true primitives are padded to n rows.
    """
    n, missing = len(features), len(features) - len(truth)
    truth = F.pad(truth, (0, 0, 0, missing))
    real = F.pad(real, (0, missing))
    existence = F.binary_cross_entropy_with_logits(
        logit[None, :].expand(n, n), real.float()[:, None].expand(n, n), reduction="none"
    )
    distance = (truth[:, None, :] - features[None, :, :]).abs() * real[:, None, None]
    return (
        weights.existence * existence
        + weights.center * distance[..., :3].sum(-1)
        + weights.cholesky * distance[..., 3:].sum(-1)
    )


@torch.no_grad()
def match_primitives(features, logit, truth, real, slots, proposals, weights) -> torch.Tensor:
    """Match primitives like models.vae.matching.match_primitives."""
    assignment = torch.full(logit.shape, -1, dtype=torch.long)
    for sample in range(len(features)):
        slot = proposal = 0
        for capacity, offered in zip(slots, proposals, strict=True):
            mine, theirs = slice(proposal, proposal + offered), slice(slot, slot + capacity)
            flags = real[sample, theirs]
            cost = compute_square_cost(
                features[sample, mine], logit[sample, mine], truth[sample, theirs], flags, weights
            )
            rows, cols = linear_sum_assignment(cost.numpy())
            for row, col in zip(rows, cols, strict=True):
                if row < capacity and flags[row]:
                    assignment[sample, proposal + col] = slot + row
            slot, proposal = theirs.stop, mine.stop
    return assignment


def compute_object_losses(features, logit, truth, real, assignment, spec: LayoutSpec, proposals):
    """Compute the same losses as models.vae.losses.compute_object_losses."""
    totals = [features.new_zeros(()) for _ in range(3)]
    batch = len(features)
    for sample in range(batch):
        slot = proposal = 0
        for name, capacity, offered in zip(spec.categories, spec.slots, proposals, strict=True):
            weights = losses.OBJECT_WEIGHTS[name]
            count = max(int(real[sample, slot : slot + capacity].sum()), 1)
            chosen = assignment[sample, proposal : proposal + offered]
            target = (chosen >= 0).float()
            existence = F.binary_cross_entropy_with_logits(
                logit[sample, proposal : proposal + offered], target, reduction="sum"
            )
            totals[0] = totals[0] + weights[0] * existence / count / batch
            matched = torch.nonzero(chosen >= 0).flatten()
            if len(matched):
                error = (features[sample, proposal + matched] - truth[sample, chosen[matched]]).abs()
                totals[1] = totals[1] + weights[1] * error[:, :3].sum() / count / batch
                totals[2] = totals[2] + weights[2] * error[:, 3:].sum() / count / batch
            slot, proposal = slot + capacity, proposal + offered
    return tuple(totals)


@contextlib.contextmanager
def replace_ours():
    """Replace the objective and the object encoder with the plain versions inside a context."""
    kept = losses.match_primitives, losses.compute_object_losses, ObjectEncoder.without_padding
    losses.match_primitives, losses.compute_object_losses = match_primitives, compute_object_losses
    ObjectEncoder.without_padding = lambda self, features, real: (
        features,
        real,
        self.slot_category.expand(len(features), -1),
    )
    try:
        yield
    finally:
        losses.match_primitives, losses.compute_object_losses, ObjectEncoder.without_padding = kept


def sum_cost(features, logit, truth, real, assignment, slots, proposals, weights) -> float:
    """Sum the cost of an assignment in float64 over all samples and categories, including padding."""
    total = 0.0
    for sample in range(len(features)):
        slot = proposal = 0
        for capacity, offered in zip(slots, proposals, strict=True):
            mine, theirs = slice(proposal, proposal + offered), slice(slot, slot + capacity)
            cost = compute_square_cost(
                features[sample, mine].double(),
                logit[sample, mine].double(),
                truth[sample, theirs].double(),
                real[sample, theirs],
                weights,
            ).numpy()
            chosen = assignment[sample, mine].numpy()
            cols = np.flatnonzero(chosen >= 0)
            total += cost[chosen[cols] - slot, cols].sum()
            # All padded rows have equal costs, so their order does not change the sum.
            padding = int(real[sample, theirs].sum())
            rest = np.flatnonzero(chosen < 0)
            total += cost[padding:, :][:1, rest].sum() if len(rest) else 0.0
            slot, proposal = theirs.stop, mine.stop
    return float(total)
