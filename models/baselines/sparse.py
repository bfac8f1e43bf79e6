"""Sparse convolution in plain torch: active voxels of a batch of grids, and layers on their features.

The features of n active voxels are an (n, channels) tensor. A `Sites` holds their coordinates. All layers gather rows
of features with tables of positions, so they run on all devices and are deterministic. A gather in small parts is two
to five times as fast on a CPU as an `index_add` per offset, and as fast as a dense convolution at 40 % occupancy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

OFFSETS = 27  # Voxels of a 3 x 3 x 3 neighbourhood.
CHILDREN = 8  # Voxels of the next finer grid in a voxel.
MAX_SITES = 2**31 - 1  # The index volume holds int32 values.
TABLE_ROWS = 2**18  # Rows of a table that are computed together.
GATHER_VALUES = {"cpu": 2**19, "cuda": 2**26}  # Gathered values per part; 2 MB fit into the cache of a CPU core.


@dataclass(frozen=True, eq=False)
class Sites:
    """Active voxels of a batch of grids, in ascending order of scene, row, column and level.

    Attributes:
        coords: Scene, row, column and level of each active voxel.
        shape: Number of scenes, rows, columns and levels of the grids.
    """

    coords: Int[Tensor, "n 4"]
    shape: tuple[int, int, int, int]

    @staticmethod
    def from_mask(mask: Bool[Tensor, "b rows cols levels"]) -> Sites:
        """Return the active voxels of a mask.

        Args:
            mask: True for active voxels.

        Returns:
            Active voxels.

        Raises:
            ValueError: The mask has too many voxels for 32-bit positions.
        """
        if mask.numel() > MAX_SITES:
            raise ValueError(f"{mask.numel():,} voxels, expected at most {MAX_SITES:,}; use a smaller batch")
        scenes, rows, cols, levels = mask.shape
        return Sites(mask.nonzero(), (scenes, rows, cols, levels))

    def __len__(self) -> int:
        return len(self.coords)

    @cached_property
    def index(self) -> Int[Tensor, "b rows cols levels"]:
        """int32 volume of the position of each active voxel in `coords`; `len(self)` for other voxels."""
        index = torch.full(self.shape, len(self), dtype=torch.int32, device=self.coords.device)
        index[self.coords.unbind(1)] = torch.arange(len(self), dtype=torch.int32, device=index.device)
        return index

    @property
    def mask(self) -> Bool[Tensor, "b rows cols levels"]:
        """True for active voxels."""
        return self.index < len(self)

    @property
    def scene(self) -> Int[Tensor, " n"]:
        """Scene of each active voxel."""
        return self.coords[:, 0]

    @cached_property
    def parity(self) -> Int[Tensor, " n"]:
        """Number of each active voxel among the CHILDREN of its parent."""
        return (self.coords[:, 1:] % 2) @ self.coords.new_tensor([4, 2, 1])

    @cached_property
    def neighbours(self) -> Int[Tensor, "n 27"]:
        """int32 positions of the voxels at the 27 offsets around each active voxel; `len(self)` for other voxels."""
        index = F.pad(self.index, (1, 1, 1, 1, 1, 1), value=len(self))
        strides = self.coords.new_tensor(index.stride())
        steps = torch.cartesian_prod(*[torch.arange(3, device=index.device)] * 3) @ strides[1:]
        parts = (self.coords @ strides).split(TABLE_ROWS)
        return torch.cat([index.view(-1)[part[:, None] + steps] for part in parts])

    def coarsen(self) -> Sites:
        """Return the voxels of twice the size that contain active voxels."""
        scenes, *sides = self.shape
        mask = torch.zeros(scenes, *(-(-side // 2) for side in sides), dtype=torch.bool, device=self.coords.device)
        scene, *at = self.coords.unbind(1)
        mask[scene, at[0] // 2, at[1] // 2, at[2] // 2] = True
        return Sites.from_mask(mask)

    def refine(self, keep: Bool[Tensor, "n 8"]) -> Sites:
        """Divide each active voxel into CHILDREN, and prune.

        Args:
            keep: True for children that are kept.

        Returns:
            Kept children, in a grid of twice the size.
        """
        scenes, rows, cols, levels = self.shape
        mask = torch.zeros(scenes, rows, cols, levels, CHILDREN, dtype=torch.bool, device=keep.device)
        mask[self.coords.unbind(1)] = keep
        mask = mask.view(scenes, rows, cols, levels, 2, 2, 2).permute(0, 1, 4, 2, 5, 3, 6)
        return Sites.from_mask(mask.reshape(scenes, 2 * rows, 2 * cols, 2 * levels))

    def find_children(self, fine: Sites) -> Int[Tensor, "n 8"]:
        """Find the children of each active voxel.

        Args:
            fine: Active voxels of half the size.

        Returns:
            int32 positions in `fine`; `len(fine)` for children that are not active.
        """
        index = F.pad(fine.index, [pad for side in fine.shape[:0:-1] for pad in (0, side % 2)], value=len(fine))
        scenes, rows, cols, levels = self.shape
        blocks = index.view(scenes, rows, 2, cols, 2, levels, 2).permute(0, 1, 3, 5, 2, 4, 6)
        return blocks[self.coords.unbind(1)].flatten(1)

    def find_parents(self, coarse: Sites) -> Int[Tensor, " n"]:
        """Find the parent of each active voxel.

        Args:
            coarse: Active voxels of twice the size, which contain all voxels of this object.

        Returns:
            int64 positions in `coarse`.
        """
        scene, *at = self.coords.unbind(1)
        return coarse.index[scene, at[0] // 2, at[1] // 2, at[2] // 2].long()

    def to_dense(self, values: Tensor, fill: float = 0) -> Tensor:
        """Write values of active voxels into grids.

        Args:
            values: (n, ...) values.
            fill: Value of other voxels.

        Returns:
            (b, rows, cols, levels, ...) values.
        """
        dense = values.new_full((*self.shape, *values.shape[1:]), fill)
        return dense.index_put(tuple(self.coords.unbind(1)), values)


def gather_rows(x: Float[Tensor, "n c"], table: Int[Tensor, "m k"]) -> Float[Tensor, "m kc"]:
    """Join the rows of features that a table lists.

    Args:
        x: Features.
        table: Positions of rows; n for rows of zeros.

    Returns:
        Joined features.
    """
    return _take_rows(F.pad(x, (0, 0, 0, 1)), table)


def _take_rows(padded: Tensor, table: Tensor) -> Tensor:
    """Join the rows (n + 1, c) that a table (m, k) lists; the result is (m, kc)."""
    return padded.index_select(0, table.reshape(-1)).view(len(table), table.shape[1] * padded.shape[1])


class _GatherConvolution(torch.autograd.Function):
    """Submanifold convolution. It stores no gathered features, but gathers them again for the gradient."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, table: Tensor) -> Tensor:
        ctx.save_for_backward(x, weight, table)
        return _convolve(x, weight, table)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, None]:  # pyright: ignore
        x, weight, table = ctx.saved_tensors
        (grad,) = grads
        # Voxel j is the neighbour k of voxel i if and only if i is the neighbour 26 - k of j.
        grad_x = _convolve(grad, weight.flip(0).transpose(1, 2), table)
        grad_weight = torch.zeros(weight.shape, dtype=torch.promote_types(weight.dtype, torch.float32), device=x.device)
        padded = F.pad(x, (0, 0, 0, 1))
        rows = _count_rows(x)
        for part, of_part in zip(table.split(rows), grad.split(rows), strict=True):
            grad_weight += (_take_rows(padded, part).T @ of_part).view(weight.shape)
        return grad_x, grad_weight.to(weight.dtype), None


def _count_rows(x: Tensor) -> int:
    """Return the number of voxels whose neighbours are gathered together."""
    return max(1, GATHER_VALUES.get(x.device.type, 2**24) // (OFFSETS * x.shape[1]))


def _convolve(x: Tensor, weight: Tensor, table: Tensor) -> Tensor:
    """Return the sum over k of x[table[:, k]] @ weight[k]."""
    padded, matrix = F.pad(x, (0, 0, 0, 1)), weight.reshape(-1, weight.shape[2])
    result, rows = x.new_empty(len(table), weight.shape[2]), _count_rows(x)
    for part, out in zip(table.split(rows), result.split(rows), strict=True):
        torch.mm(_take_rows(padded, part), matrix, out=out)
    return result


class SparseConvolution(nn.Module):
    """Submanifold convolution 3 x 3 x 3: outputs at active voxels only; other voxels count as zero.

    Args:
        inputs: Number of input channels.
        outputs: Number of output channels.
        zero: Whether the initial weights are zero.
    """

    def __init__(self, inputs: int, outputs: int, zero: bool = False) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(OFFSETS, inputs, outputs))
        self.bias = nn.Parameter(torch.empty(outputs))
        nn.init.zeros_(self.bias)
        bound = 0.0 if zero else math.sqrt(3 / (OFFSETS * inputs))  # Variance 1 / (27 inputs).
        nn.init.uniform_(self.weight, -bound, bound)

    def forward(self, x: Float[Tensor, "n inputs"], sites: Sites) -> Float[Tensor, "n outputs"]:
        """Convolve features.

        Args:
            x: Features.
            sites: Active voxels.

        Returns:
            Features of the same voxels.
        """
        weight = self.weight
        if torch.is_autocast_enabled(x.device.type):
            dtype = torch.get_autocast_dtype(x.device.type)
            x, weight = x.to(dtype), weight.to(dtype)
        result: Tensor = _GatherConvolution.apply(x, weight, sites.neighbours)  # pyright: ignore[reportAssignmentType]
        return result + self.bias


class SparseDownsample(nn.Module):
    """Convolution 2 x 2 x 2 with stride 2.

    Args:
        inputs: Number of input channels.
        outputs: Number of output channels.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(CHILDREN * inputs, outputs)

    def forward(self, x: Float[Tensor, "n inputs"], fine: Sites, coarse: Sites) -> Float[Tensor, "m outputs"]:
        """Merge the features of children.

        Args:
            x: Features of `fine`.
            fine: Active voxels.
            coarse: Active voxels of twice the size. Children that are not active count as zero.

        Returns:
            Features of `coarse`.
        """
        return self.linear(gather_rows(x, coarse.find_children(fine)))


class SparseUpsample(nn.Module):
    """Transposed convolution 2 x 2 x 2 with stride 2, at given children.

    Args:
        inputs: Number of input channels.
        outputs: Number of output channels.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, CHILDREN * outputs)

    def forward(self, x: Float[Tensor, "m inputs"], coarse: Sites, fine: Sites) -> Float[Tensor, "n outputs"]:
        """Compute features of children from those of their parents.

        Args:
            x: Features of `coarse`.
            coarse: Active voxels, which contain `fine`.
            fine: Active voxels of half the size, such as those of `Sites.refine`.

        Returns:
            Features of `fine`.
        """
        children = self.linear(x).view(len(coarse) * CHILDREN, self.linear.out_features // CHILDREN)
        return children[fine.find_parents(coarse) * CHILDREN + fine.parity]
