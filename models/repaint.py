"""RePaint in latent space: what to keep, what to generate, and in which order (paper, supplement B.3, Applications).

Latent grids lie like rasters: row 0 farthest ahead, column 0 leftmost. A mask is 1 where something is generated.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

# Paper, supplement B.3: roll-back J and resamplings R.
JUMP_LENGTH, RESAMPLINGS = 10, 10

# Block offsets of outpainting in units of (forward, left), first the four sides, then the four corners.
SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1))
CORNERS = ((1, 1), (1, -1), (-1, 1), (-1, -1))


def repaint_transitions(
    num_steps: int, jump_length: int = JUMP_LENGTH, resamplings: int = RESAMPLINGS
) -> list[tuple[int, int]]:
    """(from, to) states of RePaint: at every jump_length-th state go jump_length back up, resamplings - 1 times.

    250 steps, J = R = 10: jumps at states 0, 10, ..., 230, nine times each, 2,410 denoising steps in all.
    """
    if jump_length < 1 or resamplings < 1:
        raise ValueError(f"jump_length {jump_length} and resamplings {resamplings} must be at least 1")
    left = {state: resamplings - 1 for state in range(0, num_steps - jump_length, jump_length)}
    transitions, state = [], num_steps - 1
    while state >= 0:
        transitions.append((state, state - 1))
        state -= 1
        if left.get(state, 0) > 0:
            left[state] -= 1
            transitions += [(state + i, state + i + 1) for i in range(jump_length)]
            state += jump_length
    return transitions


def shifted(canvas: Float[Tensor, "c h w"], rows: int, cols: int, fill: float = 0.0) -> Float[Tensor, "c h w"]:
    """The same content seen from a block that lies `rows` cells further ahead and `cols` cells further left."""
    _, h, w = canvas.shape
    out = torch.full_like(canvas, fill)
    to_row, to_col = slice(max(rows, 0), min(h, h + rows)), slice(max(cols, 0), min(w, w + cols))
    from_row, from_col = slice(max(-rows, 0), min(h, h - rows)), slice(max(-cols, 0), min(w, w - cols))
    if to_row.start < to_row.stop and to_col.start < to_col.stop:
        out[:, to_row, to_col] = canvas[:, from_row, from_col]
    return out
