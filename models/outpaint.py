"""A growing scene: what a new block knows of its neighbours, and what is taken from it (paper, supplement B.3)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from models.layout import LayoutSpec
from models.scene import Grid, Scene, merge

Encode = Callable[[Sequence[Scene]], Tensor]  # scenes on the model's grid -> latents (b, c, h, w)

# Block offsets in steps (forward, left): first the four sides, then the four corners.
SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1))
CORNERS = ((1, 1), (1, -1), (-1, 1), (-1, -1))


@dataclass(frozen=True, eq=False)
class OutpaintBlock:
    """What a block to be generated knows: latent (c, h, w), unknown (c, h, w) = 1 to generate, height datum."""

    latent: Tensor
    unknown: Tensor
    datum_m: float


class OutpaintCanvas:
    """A growing scene and its latents on a cell grid around one first block.

    Offsets are (forward, left) in block steps; a step is (1 - overlap) of a block.
    """

    def __init__(self, scene: Scene, latent: Tensor, owned: np.ndarray, block: Grid, encode: Encode, step: int) -> None:
        self.scene, self.latent, self.owned = scene, latent, owned
        self.block_grid, self.encode, self.step = block, encode, step
        self.size = latent.shape[-1] - 2 * step  # cells of a block
        self.pixels_per_cell = block.rows // self.size
        self.origin_height_m = self.height_near(0.0, 0.0)

    @classmethod
    def around(cls, scene: Scene, spec: LayoutSpec, encode: Encode, overlap: float) -> OutpaintCanvas:
        """A canvas with `scene` in its middle and room for one step to every side.

        Raises ValueError for a scene that is not on the model's grid, or an overlap between two cells.
        """
        grid = spec.grid
        if scene.grid != grid:
            raise ValueError(f"scene {scene.scene_id} has grid {scene.grid}, the model needs {grid}")
        known = encode([scene])[0]
        channels, size, _ = known.shape
        step = round(size * (1 - overlap))
        if not 0 < step < size or abs(step - size * (1 - overlap)) > 1e-6:
            raise ValueError(f"overlap {overlap} is not a whole number of the {size} latent cells between 0 and 1")
        margin = step * grid.rows // size  # pixels
        large = replace(
            grid,
            front_m=grid.front_m + margin * grid.resolution_m,
            left_m=grid.left_m + margin * grid.resolution_m,
            rows=grid.rows + 2 * margin,
            cols=grid.cols + 2 * margin,
        )
        middle = slice(step, step + size)
        latent = known.new_zeros(channels, size + 2 * step, size + 2 * step)
        latent[:, middle, middle] = known
        owned = np.zeros(latent.shape[1:], bool)
        owned[middle, middle] = True
        return cls(scene.cropped(large), latent, owned, grid, encode, step)

    def cells(self, offset: tuple[int, int]) -> tuple[slice, slice]:
        """Rows and columns of the canvas that a block covers."""
        forward, left = offset
        row, col = self.step * (1 - forward), self.step * (1 - left)
        return slice(row, row + self.size), slice(col, col + self.size)

    def shift_m(self, offset: tuple[int, int]) -> tuple[float, float]:
        """Position of a block's origin in the canvas frame."""
        meters = self.step * self.pixels_per_cell * self.scene.grid.resolution_m
        return offset[0] * meters, offset[1] * meters

    def height_near(self, x_m: float, y_m: float) -> float:
        """Height of the known fused surface at the occupied pixel nearest to a point; 0 if there is none."""
        height, ground_class = self.scene.surface()
        row, col = np.nonzero(ground_class >= 0)
        if len(row) == 0:
            return 0.0
        x, y = self.scene.grid.x_m()[row], self.scene.grid.y_m()[col]
        nearest = ((x - x_m) ** 2 + (y - y_m) ** 2).argmin()
        return float(height[row[nearest], col[nearest]])

    def block(self, offset: tuple[int, int], mode: str) -> OutpaintBlock:
        """What is known of a block before it is generated."""
        rows, cols = self.cells(offset)
        latent = self.latent[:, rows, cols]
        unknown = torch.from_numpy(~self.owned[rows, cols]).to(latent).expand_as(latent)
        if mode == "copy":
            return OutpaintBlock(latent, unknown, 0.0)
        x, y = self.shift_m(offset)
        datum = self.height_near(x, y) - self.origin_height_m
        grid = self.block_grid
        there = replace(grid, front_m=grid.front_m + x, left_m=grid.left_m + y)
        scene = replace(self.scene.cropped(there).moved(-x, -y, -datum), grid=grid)
        return OutpaintBlock(self.encode([scene])[0], unknown, datum)

    def paste(self, offset: tuple[int, int], latent: Tensor, generated: Scene, datum_m: float) -> None:
        """Take from a generated block what nobody owns yet."""
        rows, cols = self.cells(offset)
        new = np.zeros_like(self.owned)
        new[rows, cols] = ~self.owned[rows, cols]
        mask = torch.from_numpy(new[rows, cols]).to(latent.device)
        self.latent[:, rows, cols] = torch.where(mask, latent, self.latent[:, rows, cols])
        x, y = self.shift_m(offset)
        moved = generated.moved(x, y, datum_m).cropped(self.scene.grid)
        self.owned |= new

        def pixels(cells: np.ndarray) -> np.ndarray:
            return cells.repeat(self.pixels_per_cell, axis=0).repeat(self.pixels_per_cell, axis=1)

        self.scene = merge([self.scene, moved], [pixels(self.owned & ~new), pixels(new)], self.scene)
