"""Signed distances from the edge of a mask."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor


def compute_signed_distance_px(
    inside: Bool[Tensor, "*batch rows cols"], most: int
) -> Float[Tensor, "*batch rows cols"]:
    """Compute the Euclidean distance from pixel centres to the edge of a mask, positive inside the mask.

    The edge lies halfway between the last pixel of the mask and the first pixel outside the mask. The method is that of
    Felzenszwalb & Huttenlocher (2012), restricted to a window.

    Args:
        inside: Masks.
        most: Largest distance (pixels); larger distances are clipped to this value.

    Returns:
        Signed distances in pixels.
    """
    squared = torch.stack([inside, ~inside]).float() * (most + 0.5) ** 2  # squared distances
    for axis in (-1, -2):
        padded = F.pad(squared, (most, most, 0, 0) if axis == -1 else (0, 0, most, most), value=(most + 0.5) ** 2)
        nearest = squared
        for step in range(1, most + 1):
            for start in (most - step, most + step):
                nearest = torch.minimum(nearest, padded.narrow(axis, start, squared.shape[axis]) + step**2)
        squared = nearest
    to_outside, to_inside = squared.sqrt()
    return torch.where(inside, to_outside - 0.5, 0.5 - to_inside)
