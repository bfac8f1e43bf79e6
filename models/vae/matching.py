"""Bipartite matching of predicted and true primitives, per category (paper, supplement Eqs. "permutation", "match").

Only real primitives are assigned. A padded truth costs 6 BCE(0, p_j) wherever it lands, so the padded rows add a
constant and a column cost: choosing slot j for a real primitive i changes the total by

    6 [BCE(1, p_j) - BCE(0, p_j)] + 3 |t_i - t_j| + 3 |c_i - c_j|,    BCE(1, p) - BCE(0, p) = -logit(p),

and a rectangular assignment over the n real rows is the square problem of the paper, solved exactly.
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
    """Predictions that are not numbers cannot be matched."""


class MatchWeights(NamedTuple):
    """Category-agnostic weights of the matching cost; the defaults are the paper's (supplement B.2)."""

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
    """Cost of giving slot n to real primitive m, up to a constant per sample."""
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
    """For every proposal the index of the true slot it is matched with, -1 where with padding.

    Per category, `proposals[k]` >= `slots[k]`; real primitives come first in their category's slots (tensors.py).
    Costs are made on the tensors' device and leave it in one piece; samples are solved in threads, as scipy's solver
    lets go of Python's lock. Raises NotFiniteError, a ValueError, for predictions that are not finite.
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
        raise NonFiniteCostError("predicted primitives are not finite; lower the learning rate or look at this batch")

    def solve(sample: int) -> None:
        for k, most, start in blocks:
            if count := counts[k][sample]:
                first = start + sample * most * proposals[k]
                cost = flat[first : first + count * proposals[k]].reshape(count, proposals[k])
                rows, cols = linear_sum_assignment(cost)
                assignment[sample, first_proposal[k] + cols] = first_slot[k] + rows

    deque(_count_threads(torch.get_num_threads()).map(solve, range(len(assignment))), maxlen=0)
    return torch.from_numpy(assignment).to(real.device)


@cache
def _count_threads(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="matching")
