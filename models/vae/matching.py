"""Bipartite matching of proposals and true primitives per category (paper, supplement, Eq. 6 and 7).

The paper assigns proposals to the padded list of primitives. This module assigns proposals only to real primitives,
with the same result. In the paper, each proposal j that is assigned to a padded slot costs 6 BCE(0, p_j). If proposal j
is instead assigned to the real primitive i, the total cost changes by

    6 [BCE(1, p_j) - BCE(0, p_j)] + 3 |t_i - t_j| + 3 |c_i - c_j|,    BCE(1, p) - BCE(0, p) = -logit(p).

Minimising the sum of these changes over the real primitives is therefore equivalent to the assignment problem of the
paper. The solution is exact.
"""

from __future__ import annotations

from collections import deque
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment
from torch import Tensor


class NonFiniteCostError(ValueError):
    """Raised when predictions are not finite and can therefore not be matched."""


class MatchWeights(NamedTuple):
    """Weights of the matching cost for all categories. The defaults are those of the paper (supplement B.2).

    Attributes:
        existence: Weight of the existence logit.
        center: Weight of the L1 distance of the centres.
        cholesky: Weight of the L1 distance of the Cholesky parameters.
    """

    existence: float = 6.0
    center: float = 3.0
    cholesky: float = 3.0


PAPER_WEIGHTS = MatchWeights()


def compute_match_cost(
    features: Float[Tensor, "batch n 9"],
    existence_logit: Float[Tensor, "batch n"],
    truth: Float[Tensor, "batch m 9"],
    weights: MatchWeights = PAPER_WEIGHTS,
) -> Float[Tensor, "batch m n"]:
    """Compute the cost of each assignment of a proposal to a real primitive, up to a constant per sample.

    Args:
        features: Features of the proposals.
        existence_logit: Existence logits of the proposals.
        truth: Features of the real primitives.
        weights: Weights of the cost.

    Returns:
        Costs; one row per real primitive and one column per proposal.
    """
    weight = features.new_tensor([weights.center] * 3 + [weights.cholesky] * 6)
    return torch.cdist(truth * weight, features * weight, p=1) - weights.existence * existence_logit[:, None, :]


@torch.no_grad()
def match_primitives(
    features: Float[Tensor, "batch proposals 9"],
    existence_logit: Float[Tensor, "batch proposals"],
    truth: Float[Tensor, "batch slots 9"],
    real: Bool[Tensor, "batch slots"],
    slots: tuple[int, ...],
    proposals: tuple[int, ...],
    weights: MatchWeights = PAPER_WEIGHTS,
) -> Int[Tensor, "batch proposals"]:
    """Assign each proposal to a true slot or to padding.

    `proposals[k]` must be at least `slots[k]` for each category k. Within a category, the slots of real primitives come
    before padded slots (tensors.py). Costs are computed on the device of the tensors and copied to the CPU in one
    transfer. Threads solve the samples in parallel, because scipy's solver releases Python's global interpreter lock.

    Args:
        features: Features of the proposals.
        existence_logit: Existence logits of the proposals.
        truth: Features of the slots.
        real: True for each slot that holds a primitive.
        slots: Number of slots per category.
        proposals: Number of proposals per category.
        weights: Weights of the cost.

    Returns:
        Index of the slot to which each proposal is assigned; -1: padding.

    Raises:
        NonFiniteCostError: A prediction is not finite.
    """
    counts = torch.stack([group.sum(dim=1) for group in real.split(slots, dim=1)]).tolist()  # [category][sample]
    first_slot, first_proposal = (np.cumsum([0, *sizes[:-1]]).tolist() for sizes in (slots, proposals))
    costs, start, blocks = [], 0, []
    for k, most in enumerate(map(max, counts)):
        if most:
            theirs, mine = (
                slice(first_slot[k], first_slot[k] + most),
                slice(first_proposal[k], first_proposal[k] + proposals[k]),
            )
            costs.append(
                compute_match_cost(features[:, mine], existence_logit[:, mine], truth[:, theirs], weights).flatten()
            )
            blocks.append((k, most, start))
            start += costs[-1].numel()
    assignment = np.full(existence_logit.shape, -1)
    if not blocks:
        return torch.from_numpy(assignment).to(real.device)
    flat = torch.cat(costs).cpu().double().numpy()
    if not np.isfinite(flat).all():
        raise NonFiniteCostError("predicted primitives are not finite; lower the learning rate or inspect this batch")

    def solve(sample: int) -> None:
        for k, most, start in blocks:
            if count := counts[k][sample]:
                first = start + sample * most * proposals[k]
                cost = flat[first : first + count * proposals[k]].reshape(count, proposals[k])
                rows, cols = linear_sum_assignment(cost)
                assignment[sample, first_proposal[k] + cols] = first_slot[k] + rows

    deque(_get_thread_pool(torch.get_num_threads()).map(solve, range(len(assignment))), maxlen=0)
    return torch.from_numpy(assignment).to(real.device)


@cache
def _get_thread_pool(num_threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(num_threads, thread_name_prefix="matching")
