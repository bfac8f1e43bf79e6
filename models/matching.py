"""Bipartite matching of predicted and true primitives, per category (paper, supplement Eqs. "permutation", "match").

Only real primitives are assigned. A padded truth costs 6 BCE(0, p_j) wherever it lands, so the padded rows add a
constant and a column cost: choosing slot j for a real primitive i changes the total by

    6 [BCE(1, p_j) - BCE(0, p_j)] + 3 |t_i - t_j| + 3 |c_i - c_j|,    BCE(1, p) - BCE(0, p) = -logit(p),

and a rectangular assignment over the n real rows is the square problem of the paper, solved exactly.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment
from torch import Tensor


class NotFiniteError(ValueError):
    """Predictions that are not numbers cannot be matched."""


class MatchWeights(NamedTuple):
    """Category-agnostic weights of the matching cost; the defaults are the paper's (supplement B.2)."""

    existence: float = 6.0
    center: float = 3.0
    cholesky: float = 3.0


PAPER_WEIGHTS = MatchWeights()


def match_cost(
    features: Float[Tensor, "batch n 9"],
    existence_logit: Float[Tensor, "batch n"],
    truth: Float[Tensor, "batch m 9"],
    weights: MatchWeights = PAPER_WEIGHTS,
) -> Float[Tensor, "batch m n"]:
    """Cost of giving slot n to real primitive m, up to a constant per sample."""
    weight = features.new_tensor([weights.center] * 3 + [weights.cholesky] * 6)
    return torch.cdist(truth * weight, features * weight, p=1) - weights.existence * existence_logit[:, None, :]


@torch.no_grad()
def match(
    features: Float[Tensor, "batch proposals 9"],
    existence_logit: Float[Tensor, "batch proposals"],
    truth: Float[Tensor, "batch slots 9"],
    real: Bool[Tensor, "batch slots"],
    slots: tuple[int, ...],
    proposals: tuple[int, ...],
    weights: MatchWeights = PAPER_WEIGHTS,
) -> Int[Tensor, "batch proposals"]:
    """For every proposal the index of the true slot it is matched with, -1 where with padding.

    Per category, `proposals[k]` >= `slots[k]`; real primitives come first in their category's slots (tensors.py).
    Raises NotFiniteError, a ValueError, for predictions that are not finite.
    """
    assignment = torch.full(existence_logit.shape, -1, dtype=torch.long)
    if not (torch.isfinite(features).all() and torch.isfinite(existence_logit).all()):
        raise NotFiniteError("predicted primitives are not finite; lower the learning rate or look at this batch")
    first_slot, first_proposal = 0, 0
    for capacity, offered in zip(slots, proposals, strict=True):
        theirs, mine = slice(first_slot, first_slot + capacity), slice(first_proposal, first_proposal + offered)
        counts = real[:, theirs].sum(dim=1).tolist()
        if most := max(counts):
            cost = match_cost(features[:, mine], existence_logit[:, mine], truth[:, theirs][:, :most], weights)
            cost = cost.double().cpu().numpy()
            for sample, count in enumerate(counts):
                if count:
                    rows, cols = linear_sum_assignment(cost[sample, :count])
                    assignment[sample, first_proposal + cols] = torch.from_numpy(first_slot + rows)
        first_slot, first_proposal = theirs.stop, mine.stop
    return assignment.to(real.device)
