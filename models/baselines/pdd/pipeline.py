"""Stages, training loss and sampler of PDD.

Level 1 is unconditional. Level 2 sees level 1. Level 3 sees level 2, and is divided into blocks that see the border of
neighbouring blocks.

Differs from PDD: blocks adjoin instead of overlapping, so they cover the scene without a gap. A block therefore sees
the voxels next to it, mirrored into the block, on all sides where they are known. Scenes are mirrored but not rotated
in the training, because streets run along the rows. Timesteps of the training are drawn with fixed probabilities
(`MultinomialDiffusion.weigh_timesteps`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor

from models.base import ConfiguredModel
from models.baselines.base import Grids, Networks, Stage, VoxelPipeline, coarsen_grids, flip_grids, read_grids
from models.baselines.pdd.network import PyramidDenoiser
from models.training import LossFunction, OptimizerConfig, copy_without_waiting, sample_uniform
from models.voxel_grids import EMPTY, FINE_SHAPE, Factor, coarsen_shape

FACTORS: tuple[Factor, ...] = ((8, 8, 8), (4, 4, 4), (1, 1, 2))  # Of levels 1 to 3.
LEVELS = ("level1", "level2", "level3")
STRIP_SHARE = 0.0625  # Share of a block that a block sees of its neighbours.
NUM_SIDES = 4
SIDE_PROBABILITY = 0.5  # Probability that a training block sees its neighbour on a side.
NUM_UNIFORM = 5 + NUM_SIDES  # Timestep, two flips, two coordinates of the block, and sides.


def upsample_classes(class_id: Tensor, shape: Sequence[int], num_classes: int) -> Tensor:
    """Interpolate the one-hot vectors of classes, and return the class of the largest value.

    Args:
        class_id: (b, rows, cols, levels) int64 class ids.
        shape: Rows, columns and levels of the result.
        num_classes: Number of classes.

    Returns:
        (b, *shape) int64 class ids.
    """
    one_hot = F.one_hot(class_id, num_classes).movedim(-1, 1).float()
    return F.interpolate(one_hot, size=tuple(shape), mode="trilinear").argmax(1)


def mirror_neighbors(
    grid: Tensor, start: tuple[int, int], block: Sequence[int], strip: int, sides: Sequence[bool] = (True,) * NUM_SIDES
) -> Tensor:
    """Return the voxels next to a block, mirrored at the borders of the block.

    Args:
        grid: (rows, cols, levels) class ids of the scene; unknown voxels are EMPTY.
        start: First row and column of the block.
        block: Number of rows and columns of the block.
        strip: Number of rows and columns next to the block.
        sides: Whether the neighbours in lower rows, in higher rows, in lower columns and in higher columns are visible.

    Returns:
        (rows of the block, cols of the block, levels) class ids. Voxels farther than `strip` from visible neighbours
        are EMPTY.
    """
    (row, col), (rows, cols) = start, block
    result = grid.new_full((rows, cols, grid.shape[2]), EMPTY)
    middle_rows, middle_cols = slice(row, row + rows), slice(col, col + cols)
    if sides[0]:
        above = grid[max(row - strip, 0) : row, middle_cols].flip(0)
        result[: len(above)] = above
    if sides[1]:
        below = grid[row + rows : row + rows + strip, middle_cols].flip(0)
        result[rows - len(below) :] = below
    if sides[2]:
        left = grid[middle_rows, max(col - strip, 0) : col].flip(1)
        result[:, : left.shape[1]] = torch.where(left == EMPTY, result[:, : left.shape[1]], left)
    if sides[3]:
        right = grid[middle_rows, col + cols : col + cols + strip].flip(1)
        place = slice(cols - right.shape[1], cols)
        result[:, place] = torch.where(right == EMPTY, result[:, place], right)
    return result


def make_condition(
    network: PyramidDenoiser,
    coarse: Tensor | None,
    grids: Tensor,
    starts: Sequence[tuple[int, int]],
    sides: Sequence[Sequence[bool]],
) -> Tensor:
    """Return what the network sees next to the noisy classes of a block.

    Args:
        network: Network of the level.
        coarse: (b, rows, cols, levels) int64 class ids of the coarser level; None for level 1.
        grids: (b, *shape) int64 class ids of the level; unknown voxels are EMPTY.
        starts: First row and column of the block of each scene.
        sides: Visible neighbours of each block (`mirror_neighbors`).

    Returns:
        (b, conditions, rows, cols, levels) int64 class ids.
    """
    config, shape = network.config, network.block_shape
    channels = []
    if config.has_coarse and coarse is not None:
        ratio = [fine // side for fine, side in zip(grids.shape[1:], coarse.shape[1:], strict=True)]
        part = [side // step for side, step in zip(config.block, ratio, strict=False)]
        places = [(row // ratio[0], col // ratio[1]) for row, col in starts]
        channels.append(upsample_classes(cut_blocks(coarse, places, part), shape, config.num_classes))
    if config.strip:
        scenes = zip(grids, starts, sides, strict=True)
        channels.append(torch.stack([mirror_neighbors(g, at, config.block, config.strip, s) for g, at, s in scenes]))
    return torch.stack(channels, 1) if channels else grids.new_zeros(len(grids), 0, *shape)


def cut_blocks(grids: Tensor, starts: Sequence[tuple[int, int]], block: Sequence[int]) -> Tensor:
    """Return a block of each scene.

    Args:
        grids: (b, rows, cols, levels) grids.
        starts: First row and column of the block of each scene.
        block: Number of rows and columns of the blocks.

    Returns:
        (b, *block, levels) grids.
    """
    (rows, cols), scenes = block, zip(grids, starts, strict=True)
    return torch.stack([grid[row : row + rows, col : col + cols] for grid, (row, col) in scenes])


def make_level_loss(
    network: ConfiguredModel, networks: Networks, counts: Sequence[int], factors: tuple[Factor, ...]
) -> LossFunction:
    """Return the training loss of a level. Each sample trains one block at a random place.

    Args:
        network: Network of the level, on its device.
        networks: Networks of earlier stages, which are not used: the training sees true coarse levels.
        counts: Number of fine voxels of each class in the training split.
        factors: Sizes of the voxels of the coarser level, if any, and of this level.

    Returns:
        Loss function.
    """
    denoiser = cast(PyramidDenoiser, network)
    diffusion, block = denoiser.diffusion, denoiser.config.block
    steps = [coarse // fine for coarse, fine in zip(factors[0], factors[-1], strict=True)]
    shares = torch.tensor([count + 1 for count in counts], dtype=torch.float64)  # No class has the share 0.
    weights = diffusion.weigh_timesteps((shares / shares.sum()).to(denoiser.device)).float()

    def loss(
        model: Callable[..., Any], arrays: dict[str, Tensor], generators: list[torch.Generator]
    ) -> dict[str, Tensor]:
        grids = [read_grids(arrays, factor) for factor in factors]
        device = grids[0].device
        drawn = sample_uniform(generators, NUM_UNIFORM, torch.device("cpu"))
        uniform, probabilities = copy_without_waiting(drawn, device), weights.to(device)
        *coarse, fine = flip_grids(grids, uniform[:, 1:3])
        places = [1 + (side - part) // step for side, part, step in zip(fine.shape[1:3], block, steps, strict=False)]
        starts = [
            (int(row * places[0]) * steps[0], int(col * places[1]) * steps[1]) for row, col in drawn[:, 3:5].tolist()
        ]
        sides = (drawn[:, 5:] < SIDE_PROBABILITY).tolist()
        condition = make_condition(denoiser, coarse[0] if coarse else None, fine, starts, sides)
        clean = cut_blocks(fine, starts, block)
        timestep = torch.searchsorted(probabilities.cumsum(0), uniform[:, 0].contiguous(), right=True)
        timestep = timestep.clamp(max=diffusion.num_timesteps - 1)
        noisy = diffusion.add_noise(clean, timestep, generators)
        logits = model(noisy, timestep, condition)
        with torch.autocast(device.type, enabled=False):
            return diffusion.compute_losses(logits, clean, noisy, timestep, probabilities[timestep])

    return loss


def make_stages(
    widths: Sequence[Sequence[int]],
    heads: int,
    block: int,
    batch_sizes: tuple[int, int, int],
    steps: tuple[int, int, int],
    optimizer: OptimizerConfig,
    num_timesteps: int = 100,
    fine_shape: tuple[int, int, int] = FINE_SHAPE,
) -> tuple[Stage, ...]:
    """Return the stages of a preset.

    Args:
        widths: Widths of the network of each level (`PyramidDenoiser`).
        heads: Number of attention heads.
        block: Number of rows and of columns of the blocks of level 3.
        batch_sizes: Samples per step of each level.
        steps: Number of training steps of each level.
        optimizer: Options of the optimiser; its number of steps is replaced.
        num_timesteps: Number of diffusion steps.
        fine_shape: Rows, columns and levels of the fine grid of the scenes.

    Returns:
        Three stages.
    """
    stages = []
    for k, (name, factor) in enumerate(zip(LEVELS, FACTORS, strict=True)):
        shape, factors = coarsen_shape(fine_shape, factor), FACTORS[max(k - 1, 0) : k + 1]
        is_last = k == len(LEVELS) - 1
        architecture = {
            "shape": shape,
            "block": (block, block) if is_last else shape[:2],
            "has_coarse": k > 0,
            "strip": round(STRIP_SHARE * block) if is_last else 0,
            "widths": tuple(widths[k]),
            "heads": heads,
            "num_timesteps": num_timesteps,
        }
        stages.append(
            Stage(
                name,
                PyramidDenoiser,
                architecture,
                factors,
                batch_sizes[k],
                replace(optimizer, steps=steps[k]),
                partial(make_level_loss, factors=factors),
            )
        )
    return tuple(stages)


PRESETS: dict[str, tuple[Stage, ...]] = {
    "smoke": make_stages(
        ((4, 8), (4, 8), (4, 8)),
        heads=4,
        block=32,
        batch_sizes=(4, 2, 2),
        steps=(8, 8, 8),
        optimizer=OptimizerConfig(8, 4e-3, 0.01, ema_decay=0.9),
        num_timesteps=2,
    ),
    # For two CPU cores. AdamW with a rate of 4e-3 learns no faster at this width. A scene needs 1,600 evaluations of
    # level 3, so its network is narrower.
    "town": make_stages(
        ((16, 32, 64, 128, 256), (16, 32, 64, 128, 256), (8, 16, 32, 64, 128)),
        heads=32,
        block=64,
        batch_sizes=(16, 4, 4),
        steps=(6_000, 4_000, 8_000),
        optimizer=OptimizerConfig(6_000, 1e-3, 0.01, warmup_steps=100, grad_clip=1.0, ema_decay=0.999),
    ),
    # The paper reports one, two and 14 days of training on four A100s but not the number of steps.
    "paper": make_stages(
        ((32, 64, 128, 256, 512),) * 3,
        heads=32,
        block=128,
        batch_sizes=(16, 16, 4),
        steps=(200_000, 200_000, 800_000),
        optimizer=OptimizerConfig(200_000, 4e-3, 0.01),
    ),
}


class Pipeline(VoxelPipeline):
    """Generate scenes level by level.

    Args:
        networks: Networks by the name of their stage.

    Raises:
        ValueError: A network is missing, or the levels have different extents.
    """

    method = "pdd"
    factors = FACTORS
    overlap = 0.1875

    def __init__(self, networks: Networks) -> None:
        super().__init__(networks)
        if missing := [name for name in LEVELS if name not in networks]:
            raise ValueError(f"PDD needs the networks {', '.join(LEVELS)}; {missing[0]} is missing")
        self.levels = [cast(PyramidDenoiser, self.networks[name]) for name in LEVELS]
        scene = tuple(side * step for side, step in zip(self.shape, FACTORS[-1], strict=True))
        for name, level, factor in zip(LEVELS, self.levels, FACTORS, strict=True):
            found, expected = tuple(level.config.shape), coarsen_shape(scene, factor)
            if found != expected:
                raise ValueError(
                    f"{name} has the shape {found}, expected {expected}, because {LEVELS[-1]} has {self.shape}"
                )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Rows, columns and levels of the finest grid that the method generates."""
        rows, cols, levels = self.levels[-1].config.shape
        return rows, cols, levels

    def sample(self, generators: Sequence[torch.Generator]) -> Grids:
        """Generate scenes.

        Args:
            generators: One generator per scene. A scene depends only on its generator.

        Returns:
            Grids of all levels, from coarse to fine.
        """
        grids: Grids = {}
        coarse = None
        for level, factor in zip(self.levels, FACTORS, strict=True):
            coarse = generate_level(level, coarse, generators)
            grids[factor] = coarse.to(torch.uint8)
        return grids

    def inpaint(self, voxels: Tensor, unknown: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
        """Generate a part of given scenes.

        All levels keep their known voxels. A coarse voxel is known if all its columns are.

        Args:
            voxels: (n, rows, cols, levels) uint8: finest grids of the scenes.
            unknown: (n, rows, cols) bool: columns to generate. Their voxels are not read.
            generators: One generator per scene.

        Returns:
            (n, rows, cols, levels) uint8: the scenes. Known columns are those of `voxels`.

        Raises:
            ValueError: The grids have another size than `shape`.
        """
        if tuple(voxels.shape[1:]) != self.shape:
            raise ValueError(f"grids of {tuple(voxels.shape[1:])} voxels, expected {self.shape}")
        voxels, unknown = voxels.to(self.device), unknown.to(self.device)
        given = voxels.masked_fill(unknown[..., None], EMPTY)
        coarse = None
        for level, factor in zip(self.levels, FACTORS, strict=True):
            rows, cols, levels = (side // step for side, step in zip(factor, FACTORS[-1], strict=True))
            known = ~F.max_pool2d(unknown[:, None].float(), (rows, cols))[:, 0].bool()
            part = coarsen_grids(given, (rows, cols, levels)).long()
            coarse = generate_level(level, coarse, generators, part, known)
        assert coarse is not None
        return torch.where(unknown[..., None], coarse.to(torch.uint8), voxels)


@torch.no_grad()
def generate_level(
    network: PyramidDenoiser,
    coarse: Tensor | None,
    generators: Sequence[torch.Generator],
    given: Tensor | None = None,
    known: Tensor | None = None,
) -> Tensor:
    """Generate the grids of a level block by block. Each block sees what lies next to it.

    Args:
        network: Network of the level.
        coarse: (n, rows, cols, levels) int64 class ids of the coarser level; None for level 1.
        generators: One generator per scene.
        given: (n, *shape) int64 class ids of known columns; None: no column is known.
        known: (n, rows, cols) bool: columns to keep.

    Returns:
        (n, *shape) int64 class ids.
    """
    shape, (height, width) = network.config.shape, network.config.block
    grids = torch.full((len(generators), *shape), EMPTY, dtype=torch.int64, device=network.device)
    todo = torch.ones(grids.shape[:3], dtype=torch.bool, device=network.device)
    if given is not None and known is not None:
        grids, todo = torch.where(known[..., None], given, grids), ~known
    for row in range(0, shape[0], height):
        for col in range(0, shape[1], width):
            rows, cols = slice(row, row + height), slice(col, col + width)
            scenes = todo[:, rows, cols].flatten(1).any(1).nonzero()[:, 0].tolist()
            if not scenes:
                continue
            starts, sides = [(row, col)] * len(scenes), [(True,) * NUM_SIDES] * len(scenes)
            condition = make_condition(
                network, None if coarse is None else coarse[scenes], grids[scenes], starts, sides
            )
            grids[scenes, rows, cols] = network.diffusion.sample(
                lambda noisy, timestep, condition=condition: network(noisy, timestep, condition),
                network.block_shape,
                [generators[k] for k in scenes],
                None if given is None else grids[scenes, rows, cols],
                None if given is None else ~todo[scenes, rows, cols, None],
            )
    return grids
