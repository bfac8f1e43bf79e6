"""Random known regions for the training of an inpainting model (`models.dit.DiT` with `inpainting`)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

NUM_UNIFORM = 13  # Random numbers per sample that `make_training_masks` needs.
# Shares of samples without a known strip or rectangle, and with known strips. In the others, everything outside of a
# rectangle is known.
SHARE_UNKNOWN, SHARE_STRIPS = 0.35, 0.45
SIDE_PROBABILITY = 0.6  # Probability that a strip along one side is known.
SHARE_ONE_CONTENT = 0.1  # Shares of samples that also know all of the ground, and all objects.
SHARE_BAND = 0.15  # Share of samples that also know the ground of a straight band, such as a sketched road.
BAND_CELLS = 3.0, 9.0  # Width of a band.


def make_training_masks(
    uniform: Float[Tensor, "b 13"], channels: int, size: int
) -> Float[Tensor, "b channels size size"]:
    """Make masks of latents from random numbers.

    The masks are those of outpainting and inpainting: nothing is known; strips of up to half a block along one or more
    sides are known, as on a grid of blocks; or everything outside of a rectangle is known. In addition, some samples
    know all of the ground, all objects, or the ground of a band in any direction. As in
    `models.composition.inpaint.make_latent_mask`, the first half of the channels belongs to the ground.

    Args:
        uniform: Random numbers between 0 and 1, NUM_UNIFORM per sample.
        channels: Number of channels of a latent.
        size: Number of cells per side of a latent.

    Returns:
        Masks; 1 marks values to generate, 0 marks known values.
    """
    kind, sides, corners, content, line = uniform.split([1, 4, 4, 1, 3], dim=1)
    cell = torch.arange(size, device=uniform.device)
    # A number below SIDE_PROBABILITY determines the width of the strip, from 1 cell to half of the cells.
    width = torch.where(sides < SIDE_PROBABILITY, (sides / SIDE_PROBABILITY * (size // 2)).long() + 1, 0)
    first, last = cell < width[:, [0, 2], None], cell >= size - width[:, [1, 3], None]
    rows, cols = (first | last).unbind(1)
    strips = rows[:, :, None] | cols[:, None, :]
    low, high = (corners * (size + 1)).long().view(-1, 2, 2).sort(dim=2).values.unbind(2)
    inside_rows, inside_cols = ((cell >= low[:, :, None]) & (cell < high[:, :, None])).unbind(1)
    outside = ~(inside_rows[:, :, None] & inside_cols[:, None, :])
    kind = kind[:, :, None]
    known = torch.where(kind < SHARE_UNKNOWN, False, torch.where(kind < SHARE_UNKNOWN + SHARE_STRIPS, strips, outside))
    whole_ground, whole_objects = content < SHARE_ONE_CONTENT, content > 1 - SHARE_ONE_CONTENT
    direction = torch.pi * line[:, 1]
    axis = (cell + 0.5) / size - 0.5
    distance = axis[:, None] * direction.cos()[:, None, None] + axis * direction.sin()[:, None, None]
    low_cells, high_cells = BAND_CELLS  # A number below SHARE_BAND determines the width of the band.
    width_cells = low_cells + (high_cells - low_cells) * line[:, 0] / SHARE_BAND
    is_near = (distance - (line[:, 2] - 0.5)[:, None, None]).abs() * size < width_cells[:, None, None] / 2
    band = is_near & (line[:, :1, None] < SHARE_BAND)
    ground, objects = known | band | whole_ground[:, :, None], known | whole_objects[:, :, None]
    half = channels // 2
    parts = [ground[:, None].expand(-1, half, -1, -1), objects[:, None].expand(-1, channels - half, -1, -1)]
    return 1 - torch.cat(parts, dim=1).float()


NUM_STREET_UNIFORM = 8  # Random numbers per sample that `make_street_masks` needs.
# Shares of street plans without a known part, with a known scene in the middle, with a known half, with all but a
# corner known, and with known roads of a rectangle, such as sketched roads. They add up to 1.
STREET_SHARES = (0.1, 0.15, 0.2, 0.45, 0.1)
SHARE_HALF = 0.5  # Share of known halves and corners whose border is the middle, as on a grid of windows.


def make_street_masks(
    uniform: Float[Tensor, "b 8"], distance_m: Float[Tensor, "b 2 size size"], border_m: Float[Tensor, "size size"]
) -> Float[Tensor, "b 2 size size"]:
    """Make masks of street plans from random numbers.

    Either nothing is known; or a scene in the middle, with those distances that do not depend on its surroundings; or
    the plan up to a row or a column; or all of the plan but a corner; or the roads of a rectangle.

    Args:
        uniform: Random numbers between 0 and 1, NUM_STREET_UNIFORM per sample.
        distance_m: Signed distances of the street plans (m).
        border_m: Distances of the pixels inside of a scene in the middle to its border; 0 outside (m).

    Returns:
        Masks; 1 marks values to generate, 0 marks known values.
    """
    size = distance_m.shape[-1]
    kind, ends, corners, turns = uniform.split([1, 2, 4, 1], dim=1)
    shares = torch.tensor(STREET_SHARES, device=uniform.device).cumsum(0)
    kind = (kind > shares[:-1]).sum(1)[:, None, None]
    cell, turn = torch.arange(size, device=uniform.device), (turns[:, 0] * 8).long()
    # A number below SHARE_HALF gives the middle, others any row or column.
    end = torch.where(ends < SHARE_HALF, size // 2, 1 + ((ends - SHARE_HALF) / (1 - SHARE_HALF) * (size - 1)).long())
    place = torch.stack([torch.where((turn & bit > 0)[:, None], size - 1 - cell, cell) for bit in (1, 2)], dim=1)
    rows, cols = (place < end[:, :, None]).unbind(1)
    half = torch.where((turn & 4 > 0)[:, None, None], rows[:, :, None], cols[:, None, :])
    corner = rows[:, :, None] | cols[:, None, :]
    scene = ((border_m > 0) & (distance_m.abs() <= border_m)).all(1)
    low, high = (corners * (size + 1)).long().view(-1, 2, 2).sort(dim=2).values.unbind(2)
    in_rows, in_cols = ((cell >= low[:, :, None]) & (cell < high[:, :, None])).unbind(1)
    roads = in_rows[:, :, None] & in_cols[:, None, :] & (distance_m[:, 0] >= 0)
    known = torch.zeros_like(scene)
    for number, region in enumerate((scene, half, corner, roads), start=1):
        known = torch.where(kind == number, region, known)
    return (~known).to(distance_m)[:, None].expand_as(distance_m)
