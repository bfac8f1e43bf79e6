"""Denoising network of PDD: a 3D U-Net of asymmetric residual blocks that predicts clean classes.

Features have the axes (b, channels, rows, cols, levels).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from models.base import ConfiguredModel, apply_in_float32, register_to_config
from models.baselines.discrete_diffusion import MultinomialDiffusion
from models.dit import embed_timesteps
from models.limits import require_within
from models.options import Flag, Integer, Rule, Sequential, check_entries
from models.voxel_grids import NUM_CLASSES

GROUPS = 32  # Largest number of groups of the group normalisation.
ATTENTION_SCALE = 10.0  # Factor of the cosines between queries and keys.
NUM_HALVED_LEVELS = 2  # Number of first downsamplings that also halve the number of levels.
ACROSS_COLS, ACROSS_ROWS, CUBE = (1, 3, 3), (3, 1, 3), (3, 3, 3)  # Kernels.
RULES: dict[str, Rule] = {
    "shape": Sequential(Integer(1, 4096), 3, 3),
    "block": Sequential(Integer(1, 4096), 2, 2),
    "has_coarse": Flag(),
    "strip": Integer(0, 4096),
    "widths": Sequential(Integer(2, 4096), 2, 8),
    "heads": Integer(1, 256),
    "num_classes": Integer(2, 256),
    "num_timesteps": Integer(1, 10_000),
}


def _make_norm(channels: int) -> nn.GroupNorm:
    return nn.GroupNorm(math.gcd(GROUPS, channels), channels)


def _make_conv(inputs: int, outputs: int, kernel: tuple[int, int, int]) -> nn.Conv3d:
    """Return a convolution that keeps the size of features."""
    rows, cols, levels = (side // 2 for side in kernel)
    return nn.Conv3d(inputs, outputs, kernel, padding=(rows, cols, levels), bias=False)


def _make_layer(inputs: int, outputs: int, kernel: tuple[int, int, int]) -> nn.Sequential:
    return nn.Sequential(_make_conv(inputs, outputs, kernel), nn.LeakyReLU(), _make_norm(outputs))


class _TimedNorm(nn.Module):
    """Group normalisation whose scale and shift depend on the timestep."""

    def __init__(self, channels: int, time_width: int) -> None:
        super().__init__()
        self.norm = _make_norm(channels)
        self.project = nn.Sequential(nn.SiLU(), nn.Linear(time_width, 2 * channels))

    def forward(self, x: Tensor, time: Tensor) -> Tensor:
        scale, shift = self.project(time)[:, :, None, None, None].chunk(2, dim=1)
        return self.norm(x) * (1 + scale) + shift


class _AsymmetricBlock(nn.Module):
    """Sum of two branches with the kernels 1x3x3 and 3x1x3 in both orders."""

    def __init__(self, inputs: int, outputs: int, time_width: int) -> None:
        super().__init__()
        self.norm = _TimedNorm(inputs, time_width)
        self.first, self.second = (
            nn.Sequential(_make_layer(inputs, outputs, kernels[0]), _make_layer(outputs, outputs, kernels[1]))
            for kernels in ((ACROSS_COLS, ACROSS_ROWS), (ACROSS_ROWS, ACROSS_COLS))
        )

    def forward(self, x: Tensor, time: Tensor) -> Tensor:
        x = self.norm(x, time)
        return self.first(x) + self.second(x)


class _CosineAttention(nn.Module):
    """Attention between all voxels with normalised queries and keys. As in PDD, it has no residual connection."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.to_qkv, self.to_output = nn.Linear(channels, 3 * channels), nn.Linear(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        tokens = self.to_qkv(x.flatten(2).transpose(1, 2)).unflatten(2, (3, self.heads, -1))
        query, key, value = tokens.permute(2, 0, 3, 1, 4)
        query, key = (F.normalize(part, dim=-1).to(value.dtype) for part in (query, key))
        mixed = F.scaled_dot_product_attention(query, key, value, scale=ATTENTION_SCALE)
        return self.to_output(mixed.transpose(1, 2).flatten(2)).transpose(1, 2).reshape(x.shape)


class _UpBlock(nn.Module):
    """Upsample features by `stride`, (2, 2, 1 or 2), add the features of the encoder, and transform the sum."""

    def __init__(self, inputs: int, outputs: int, stride: tuple[int, int, int], time_width: int) -> None:
        super().__init__()
        self.smooth = nn.Sequential(_make_conv(inputs, inputs, CUBE), nn.LeakyReLU())
        self.norm = _TimedNorm(inputs, time_width)
        kernel, padding = (3, 3, 2 * stride[2] - 1), (1, 1, stride[2] - 1)
        self.upsample = nn.ConvTranspose3d(inputs, inputs, kernel, stride, padding, padding, bias=False)
        kernels = (ACROSS_COLS, ACROSS_ROWS, CUBE)
        self.layers = nn.Sequential(*(_make_layer(outputs if k else inputs, outputs, kernels[k]) for k in range(3)))

    def forward(self, x: Tensor, skip: Tensor, time: Tensor) -> Tensor:
        return self.layers(self.upsample(self.norm(self.smooth(x), time)) + skip)


class _AxisGate(nn.Module):
    """Multiply features with the sum of three gates, each from a convolution along one axis."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.gates = nn.ModuleList(
            nn.Sequential(_make_conv(channels, channels, kernel), _make_norm(channels), nn.Sigmoid())
            for kernel in ((3, 1, 1), (1, 3, 1), (1, 1, 3))
        )

    def forward(self, x: Tensor) -> Tensor:
        return x * torch.stack([gate(x) for gate in self.gates]).sum(0)


class PyramidDenoiser(ConfiguredModel):
    """Predict the logits of clean classes from noisy classes of a block, the coarse level and neighbouring blocks.

    Args:
        shape: Rows, columns and levels of the grids of this level.
        block: Rows and columns of a block. They divide those of `shape` and are multiples of the total downsampling.
        has_coarse: Whether the network sees the grid of the coarser level.
        strip: Number of rows and columns of neighbouring blocks that the network sees; 0: none.
        widths: Number of channels at full size and after each downsampling.
        heads: Number of attention heads; it divides the last width.
        num_classes: Number of classes.
        num_timesteps: Number of diffusion steps.

    Raises:
        ValueError: The sizes do not fit together.
    """

    @register_to_config
    def __init__(
        self,
        shape: Sequence[int] = (32, 32, 4),
        block: Sequence[int] = (32, 32),
        has_coarse: bool = False,
        strip: int = 0,
        widths: Sequence[int] = (32, 64, 128, 256, 512),
        heads: int = 32,
        num_classes: int = NUM_CLASSES,
        num_timesteps: int = 100,
    ) -> None:
        super().__init__()
        depth = len(widths) - 1
        strides = [(2, 2, 2 if k < NUM_HALVED_LEVELS else 1) for k in range(depth)]
        _check_sizes(shape, block, strip, widths, heads, (2**depth, 2**depth, 2 ** min(depth, NUM_HALVED_LEVELS)))
        time_width = 4 * widths[0]
        self.diffusion = MultinomialDiffusion(num_classes, num_timesteps)
        self.embedding = nn.Embedding(num_classes, widths[0])
        self.time = nn.Sequential(nn.Linear(widths[0], time_width), nn.SiLU(), nn.Linear(time_width, time_width))
        self.enter = nn.Conv3d(widths[0] + has_coarse + (strip > 0), widths[0], 1)
        self.first = _AsymmetricBlock(widths[0], widths[0], time_width)
        self.down, self.pool, self.up = nn.ModuleList(), nn.ModuleList(), nn.ModuleList()
        for k, stride in enumerate(strides):
            self.down.append(_AsymmetricBlock(widths[k], widths[k + 1], time_width))
            self.pool.append(nn.Conv3d(widths[k + 1], widths[k + 1], 3, stride, padding=1, bias=False))
            self.up.append(_UpBlock(widths[k + 1], widths[max(k, 1)], stride, time_width))
        self.before, self.after = (_AsymmetricBlock(widths[-1], widths[-1], time_width) for _ in range(2))
        self.attention = _CosineAttention(widths[-1], heads)
        self.gate = _AxisGate(widths[1])
        self.logits = nn.Conv3d(2 * widths[1], num_classes, 3, padding=1)

    @classmethod
    def parse_config(cls, config: dict[str, Any]) -> dict[str, Any]:
        """Check all entries.

        Args:
            config: Value of every constructor argument.

        Returns:
            Keyword arguments of the constructor.

        Raises:
            ValueError: An entry has an invalid value, or exceeds a limit.
        """
        check_entries(config, RULES)
        require_within("scene_voxels", math.prod(config["shape"]), "shape")
        return config

    @property
    def num_conditions(self) -> int:
        """Number of channels of the condition."""
        return self.config.has_coarse + (self.config.strip > 0)

    @property
    def block_shape(self) -> tuple[int, int, int]:
        """Rows, columns and levels of a block."""
        rows, cols = self.config.block
        return rows, cols, self.config.shape[2]

    def forward(
        self,
        noisy: Int[Tensor, "batch rows cols levels"],
        timestep: Int[Tensor, " batch"],
        condition: Int[Tensor, "batch conditions rows cols levels"],
    ) -> Float[Tensor, "batch classes rows cols levels"]:
        """Predict clean classes.

        Args:
            noisy: Noisy class ids.
            timestep: Timesteps.
            condition: Class ids of the coarse level and of neighbouring blocks, as far as the network sees them.

        Returns:
            Logits.
        """
        embedded = self.embedding(noisy).movedim(-1, 1)
        x = self.enter(torch.cat([embedded, condition.to(embedded.dtype)], dim=1))
        time = self.time(embed_timesteps(timestep, self.embedding.embedding_dim).to(embedded.dtype))
        x = self.first(x, time)
        skips = []
        for down, pool in zip(self.down, self.pool, strict=True):
            skips.append(down(x, time))
            x = pool(skips[-1])
        x = self.after(self.attention(self.before(x, time)), time)
        for up in reversed(self.up):
            x = up(x, skips.pop(), time)
        return apply_in_float32(self.logits, torch.cat([x, self.gate(x)], dim=1))


def _check_sizes(
    shape: Sequence[int],
    block: Sequence[int],
    strip: int,
    widths: Sequence[int],
    heads: int,
    strides: tuple[int, int, int],
) -> None:
    """Raise ValueError if the sizes of a `PyramidDenoiser` do not fit together."""
    place = "PyramidDenoiser:"
    for side, part, stride in zip(shape, (*block, shape[2]), strides, strict=True):
        if part % stride or side % part:
            raise ValueError(
                f"{place} shape is {tuple(shape)} and block {tuple(block)}, expected whole blocks whose rows, columns"
                f" and levels are multiples of {strides} for {len(widths)} widths"
            )
    if strip > min(block):
        raise ValueError(f"{place} strip is {strip}, expected at most the size of a block, {min(block)}")
    if widths[0] % 2 or widths[-1] % heads:
        raise ValueError(
            f"{place} widths are {tuple(widths)}, expected an even first width, and a last width that is a multiple of"
            f" heads, {heads}"
        )
