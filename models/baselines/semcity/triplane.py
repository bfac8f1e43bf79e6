"""Triplanes: three feature planes of a scene, as one tensor.

The planes are xy (rows, cols), xz (rows, levels) and yz (cols, levels). A triplane is a tensor (b, channels, 1, cells),
whose cells are those of the three planes, one plane after another. The samplers of models/sampling/diffusion.py accept
it like a latent.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class Planes(NamedTuple):
    """The planes of a triplane."""

    xy: Tensor  # (b, channels, rows, cols)
    xz: Tensor  # (b, channels, rows, levels)
    yz: Tensor  # (b, channels, cols, levels)


class PlaneSizes(NamedTuple):
    """Number of cells of the planes along rows, columns and levels."""

    rows: int
    cols: int
    levels: int

    @property
    def shapes(self) -> tuple[tuple[int, int], ...]:
        """Shapes of the planes xy, xz and yz."""
        return (self.rows, self.cols), (self.rows, self.levels), (self.cols, self.levels)

    @property
    def num_cells(self) -> int:
        """Number of cells of all planes."""
        return sum(height * width for height, width in self.shapes)


def join_planes(planes: Sequence[Tensor]) -> Tensor:
    """Return planes as one tensor.

    Args:
        planes: Planes xy, xz and yz.

    Returns:
        (b, channels, 1, cells).
    """
    return torch.cat([plane.flatten(2) for plane in planes], dim=2).unsqueeze(2)


def split_planes(triplane: Tensor, sizes: PlaneSizes) -> Planes:
    """Return the planes of a tensor of `join_planes`.

    Args:
        triplane: (b, channels, 1, cells).
        sizes: Sizes of the planes.

    Returns:
        Planes.
    """
    parts = triplane.squeeze(2).split([height * width for height, width in sizes.shapes], dim=2)
    return Planes(*(part.unflatten(2, shape) for part, shape in zip(parts, sizes.shapes, strict=True)))


def project_unknown(unknown: Tensor, sizes: PlaneSizes) -> Tensor:
    """Find the cells of a triplane that depend on unknown columns of a scene.

    A cell of the plane xy depends on the columns that it covers; a cell of xz or yz on all columns of its rows or
    columns.

    Args:
        unknown: (b, rows, cols) bool: unknown columns of voxels.
        sizes: Sizes of the planes.

    Returns:
        (b, 1, 1, cells) float: 1 for unknown cells, else 0.
    """
    pooled = torch.nn.functional.adaptive_max_pool2d(unknown[:, None].float(), (sizes.rows, sizes.cols))
    rows = pooled.amax(dim=3, keepdim=True).expand(-1, -1, -1, sizes.levels)
    cols = pooled.amax(dim=2).unsqueeze(3).expand(-1, -1, -1, sizes.levels)
    return join_planes((pooled, rows, cols))
