"""Interface of the voxel methods: the stages of their training, and their samplers.

Each method trains several networks, one after another. A `Stage` describes a network and its training. A
`VoxelPipeline` holds the trained networks and generates scenes. Each method has the module
models/baselines/<method>/, whose `PRESETS` maps names of presets to tuples of stages, and whose `Pipeline` is a
`VoxelPipeline`.

Grids are (n, rows, cols, levels) uint8 tensors of class ids, as in models/voxel_grids.py. They are named by the size
of their voxels, a `Factor`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from models.base import ConfiguredModel
from models.training import LossFunction, OptimizerConfig
from models.voxel_grids import Factor, coarsen_voxels, name_voxel_column

Networks = Mapping[str, ConfiguredModel]  # Trained networks by the name of their stage.
Grids = dict[Factor, Tensor]  # Grids of the same scenes by the size of their voxels.
MakeLoss = Callable[[ConfiguredModel, Networks, Sequence[int]], LossFunction]
Measure = Callable[[Networks, dict[str, Tensor]], dict]


@dataclass(frozen=True)
class Stage:
    """A network of a method, and the options of its training.

    Attributes:
        name: Name of the stage, such as autoencoder.
        model: Class of the network.
        architecture: Keyword arguments of the class.
        factors: Sizes of the voxels that the loss reads. Its arrays have the names of `name_voxel_column`.
        batch_size: Samples per step.
        optimizer: Options of the optimiser.
        make_loss: Function of the network, of the networks of earlier stages (in evaluation mode), and of the number of
            fine voxels of each class in the training split. It returns the loss.
        needs: Names of the stages whose networks the loss or the network needs.
        measure: Function of the networks of earlier stages, and of arrays of training samples. It returns further
            arguments of the class that follow from data, such as the scale of latents; None: there are none.
    """

    name: str
    model: type[ConfiguredModel]
    architecture: dict
    factors: tuple[Factor, ...]
    batch_size: int
    optimizer: OptimizerConfig
    make_loss: MakeLoss
    needs: tuple[str, ...] = ()
    measure: Measure | None = None


class VoxelPipeline(ABC):
    """The trained networks of a method.

    Args:
        networks: Networks by the name of their stage, those of all stages of the method.

    Attributes:
        method: Name of the method.
        factors: Sizes of the voxels of the levels that the method generates, from coarse to fine.
        overlap: Share of a block that overlaps with known blocks in outpainting.
    """

    method: ClassVar[str]
    factors: tuple[Factor, ...]
    overlap: ClassVar[float] = 0.5

    def __init__(self, networks: Networks) -> None:
        self.networks = {name: network.eval().requires_grad_(False) for name, network in networks.items()}

    @property
    def device(self) -> torch.device:
        """Device of the networks."""
        return next(iter(self.networks.values())).device

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int, int]:
        """Rows, columns and levels of the finest grid that the method generates."""

    @abstractmethod
    def sample(self, generators: Sequence[torch.Generator]) -> Grids:
        """Generate scenes.

        Args:
            generators: One generator per scene. A scene depends only on its generator.

        Returns:
            Grids of all levels, from coarse to fine.
        """

    @abstractmethod
    def inpaint(self, voxels: Tensor, unknown: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
        """Generate a part of given scenes.

        Args:
            voxels: (n, rows, cols, levels) uint8: finest grids of the scenes.
            unknown: (n, rows, cols) bool: columns to generate. Their voxels are not read.
            generators: One generator per scene.

        Returns:
            (n, rows, cols, levels) uint8: the scenes. Known columns are those of `voxels`.
        """

    def reconstruct(self, voxels: Tensor) -> Grids:
        """Encode and decode scenes.

        Args:
            voxels: (n, rows, cols, levels) uint8: finest grids of the scenes.

        Returns:
            Grids of all levels, from coarse to fine. Each level is given the true coarser level.

        Raises:
            ValueError: The method has no autoencoder.
        """
        raise ValueError(f"{self.method} has no autoencoder, so it cannot reconstruct scenes")

    def outpaint(self, voxels: Tensor, rows: int, cols: int, generators: Sequence[torch.Generator]) -> Tensor:
        """Continue scenes on all sides by inpainting windows that overlap with known ground.

        The windows are those of the paper (supplement, Scene Outpainting): first the windows next to known ground,
        nearest first, then those farther away. Each window sees the part of its ground that is known already.

        Args:
            voxels: (n, rows, cols, levels) uint8: finest grids of the scenes, each the size of a block.
            rows: Number of rows of the result in windows, odd; the given scene is in the middle.
            cols: Number of columns of the result in windows, odd.
            generators: One generator per scene.

        Returns:
            (n, rows of the result, cols of the result, levels) uint8.

        Raises:
            ValueError: A number of windows is even or below 1.
        """
        if rows < 1 or cols < 1 or not (rows % 2 and cols % 2):
            raise ValueError(f"{rows} x {cols} windows, expected odd numbers")
        height, width, levels = self.shape
        step_rows, step_cols = (round(side * (1 - self.overlap)) for side in (height, width))
        canvas = voxels.new_zeros(len(voxels), height + (rows - 1) * step_rows, width + (cols - 1) * step_cols, levels)
        known = torch.zeros(canvas.shape[1:3], dtype=torch.bool, device=voxels.device)
        middle = rows // 2, cols // 2
        windows = [(row, col) for row in range(rows) for col in range(cols)]
        windows.sort(key=lambda at: abs(at[0] - middle[0]) + abs(at[1] - middle[1]))  # Four sides, then corners, ...
        for row, col in windows:
            here = slice(row * step_rows, row * step_rows + height), slice(col * step_cols, col * step_cols + width)
            if (row, col) == middle:
                block = voxels
            else:
                unknown = ~known[here].expand(len(voxels), -1, -1)
                block = self.inpaint(canvas[:, *here], unknown, generators)
            canvas[:, *here] = block
            known[here] = True
        return canvas


def coarsen_grids(voxels: Tensor, factor: Factor) -> Tensor:
    """Merge blocks of voxels of several scenes (`models.voxel_grids.coarsen_voxels`).

    Args:
        voxels: (n, rows, cols, levels) uint8 class ids on any device.
        factor: Number of voxels of a block along rows, columns and levels.

    Returns:
        (n, rows / factor[0], cols / factor[1], levels / factor[2]) uint8 class ids on the same device.
    """
    coarse = [torch.from_numpy(coarsen_voxels(one, factor)) for one in voxels.cpu().numpy()]
    return torch.stack(coarse).to(voxels.device)


def repeat_grids(voxels: Tensor, factor: Factor) -> Tensor:
    """Divide coarse voxels into fine voxels of the same class.

    Args:
        voxels: (n, rows, cols, levels) class ids.
        factor: Edge lengths of a coarse voxel.

    Returns:
        (n, rows factor[0], cols factor[1], levels factor[2]) class ids.
    """
    for axis, step in zip((1, 2, 3), factor, strict=True):
        voxels = voxels.repeat_interleave(step, dim=axis)
    return voxels


def read_grids(arrays: Mapping[str, Tensor], factor: Factor) -> Tensor:
    """Return the grids of a size from a training batch.

    Args:
        arrays: Arrays by name.
        factor: Size of the voxels.

    Returns:
        (b, rows, cols, levels) int64 class ids.
    """
    return arrays[name_voxel_column(factor)].long()


def flip_grids(voxels: Sequence[Tensor], uniform: Tensor) -> list[Tensor]:
    """Mirror scenes along rows and along columns, each with probability 1/2, equally for all sizes of voxels.

    Args:
        voxels: Grids (b, rows, cols, levels) of the same scenes.
        uniform: (b, 2) random numbers between 0 and 1.

    Returns:
        Grids of the same shapes.
    """
    flipped = []
    for grids in voxels:
        for axis in (0, 1):
            mirror = (uniform[:, axis] < 0.5)[:, None, None, None]
            grids = torch.where(mirror, grids.flip(axis + 1), grids)
        flipped.append(grids)
    return flipped
