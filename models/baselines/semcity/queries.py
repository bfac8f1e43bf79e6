"""Select the voxels at which SemCity's decoder is trained."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Int, Integer
from torch import Tensor

from models.voxel_grids import EMPTY

NEAR_VOXELS = 2  # Empty voxels within this distance of a filled voxel are near, in voxels.


def find_near_empty(voxels: Integer[Tensor, "rows cols levels"]) -> Tensor:
    """Find the empty voxels within NEAR_VOXELS of a filled voxel.

    Args:
        voxels: Class ids.

    Returns:
        (rows, cols, levels) bool.
    """
    steps = torch.arange(-NEAR_VOXELS, NEAR_VOXELS + 1, device=voxels.device)
    squares = steps**2
    ball = squares[:, None, None] + squares[:, None] + squares <= NEAR_VOXELS**2
    filled = voxels != EMPTY
    near = F.conv3d(filled[None, None].float(), ball[None, None].float(), padding=NEAR_VOXELS)[0, 0] > 0.5
    return near & ~filled


def select_queries(
    voxels: Integer[Tensor, "rows cols levels"], count: int, generator: torch.Generator, class_order: bool = False
) -> Int[Tensor, " n"]:
    """Select voxels: all filled ones, all empty ones near them, and random other empty ones.

    If there are more filled and near voxels than requested, a random part of them is selected. With `class_order`, they
    are instead listed by class, the empty ones last, and the list is cut. The first public version of SemCity does
    this. In scenes with solid volumes, the late classes then have no queries; this explains why the paper's SemCity
    with 400,000 queries is worse than that with 1,000,000.

    Args:
        voxels: Class ids.
        count: Number of voxels to select.
        generator: Generator of the CPU.
        class_order: Whether to list voxels by class.

    Returns:
        (count,) int64 indices in C order. Voxels are repeated if there are too few.
    """
    labels = voxels.reshape(-1)
    near = find_near_empty(voxels).reshape(-1)
    first = torch.nonzero((labels != EMPTY) | near).squeeze(1)
    if class_order:  # Classes in ascending order, empty voxels last.
        key = torch.where(labels[first] == EMPTY, 256, labels[first].long())
        first = first[torch.sort(key, stable=True).indices]
    else:
        first = first[torch.randperm(len(first), generator=generator).to(first.device)]
    if len(first) < count:
        far = torch.nonzero((labels == EMPTY) & ~near).squeeze(1)
        far = far[torch.randperm(len(far), generator=generator).to(far.device)]
        first = torch.cat([first, far[: count - len(first)]])
        first = first.repeat(-(-count // len(first)))
    return first[:count]
