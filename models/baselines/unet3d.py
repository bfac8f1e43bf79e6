"""Dense 3D U-Net with a timestep embedding, for diffusion on small grids."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from models.dit import embed_timesteps

TIMESTEP_FEATURES = 256  # Of `embed_timesteps`.
Layer = TypeVar("Layer", nn.Linear, nn.Conv3d)
MAX_GROUPS, GROUP_WIDTH = 32, 4
HEAD_WIDTH = 32


class TimestepEmbedding(nn.Module):
    """Map timesteps to vectors with a perceptron of two layers.

    Args:
        width: Number of channels of the vectors.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(TIMESTEP_FEATURES, width), nn.Linear(width, width)

    def forward(self, timestep: Int[Tensor, " b"]) -> Float[Tensor, "b width"]:
        """Embed timesteps.

        Args:
            timestep: Timesteps.

        Returns:
            Vectors.
        """
        features = embed_timesteps(timestep).to(self.first.weight.dtype)
        return F.silu(self.second(F.silu(self.first(features))))


def make_norm(channels: int) -> nn.GroupNorm:
    """Return a group normalisation with at most MAX_GROUPS groups of at least GROUP_WIDTH channels, if possible.

    With one channel per group, the normalised value of a grid of a single voxel would always be zero.

    Args:
        channels: Number of channels.

    Returns:
        Normalisation.
    """
    return nn.GroupNorm(math.gcd(MAX_GROUPS, channels, 2 ** int(math.log2(max(1, channels / GROUP_WIDTH)))), channels)


def make_zero(layer: Layer) -> Layer:
    """Set the weights of a layer to zero, so that a network begins as the identity or with the output zero.

    Args:
        layer: Linear layer or convolution.

    Returns:
        The same layer.
    """
    nn.init.zeros_(layer.weight)
    return layer


class ResidualBlock3D(nn.Module):
    """Two convolutions 3 x 3 x 3 with a skip connection. The embedding scales and shifts the features between them.

    Args:
        inputs: Number of input channels.
        outputs: Number of output channels.
        embedding: Number of channels of the embedding.
    """

    def __init__(self, inputs: int, outputs: int, embedding: int) -> None:
        super().__init__()
        self.norms = nn.ModuleList([make_norm(inputs), make_norm(outputs)])
        self.convolutions = nn.ModuleList(
            [nn.Conv3d(inputs, outputs, 3, padding=1), make_zero(nn.Conv3d(outputs, outputs, 3, padding=1))]
        )
        self.modulation = nn.Linear(embedding, 2 * outputs)
        self.skip = nn.Conv3d(inputs, outputs, 1) if inputs != outputs else nn.Identity()

    def forward(
        self, x: Float[Tensor, "b inputs r c l"], embedding: Float[Tensor, "b e"]
    ) -> Float[Tensor, "b outputs r c l"]:
        """Apply the block.

        Args:
            x: Features.
            embedding: Embedding of each sample.

        Returns:
            Features.
        """
        scale, shift = self.modulation(embedding)[..., None, None, None].chunk(2, dim=1)
        h = self.convolutions[0](F.silu(self.norms[0](x)))
        return self.skip(x) + self.convolutions[1](F.silu(self.norms[1](h) * (1 + scale) + shift))


class Attention3D(nn.Module):
    """Self-attention over all voxels of a grid, with a skip connection.

    Args:
        channels: Number of channels.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.heads = max(1, channels // HEAD_WIDTH)
        self.norm, self.to_qkv = make_norm(channels), nn.Linear(channels, 3 * channels)
        self.output = make_zero(nn.Linear(channels, channels))

    def forward(self, x: Float[Tensor, "b channels r c l"]) -> Float[Tensor, "b channels r c l"]:
        """Apply the layer.

        Args:
            x: Features.

        Returns:
            Features.
        """
        qkv = self.to_qkv(self.norm(x).flatten(2).mT).unflatten(2, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(*qkv.unbind(0)).transpose(1, 2).flatten(2)
        return x + self.output(mixed).mT.reshape(x.shape)


class UNet3D(nn.Module):
    """U-Net of residual blocks. Each level but the first halves all sides that are longer than 1.

    Args:
        inputs: Number of input channels.
        outputs: Number of output channels.
        width: Number of channels of the first level.
        multipliers: Number of channels of each level as a multiple of `width`.
        blocks: Number of residual blocks per level on the way down; there is one more on the way up.
        attention: Indices of levels with self-attention. The middle has self-attention if any level has.

    Raises:
        ValueError: The number of channels of a level with attention is not a multiple of the number of heads.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        width: int,
        multipliers: Sequence[int],
        blocks: int = 2,
        attention: Sequence[int] = (),
    ) -> None:
        super().__init__()
        widths, embedding = [width * factor for factor in multipliers], 4 * width
        for level in attention:
            if widths[level] % max(1, widths[level] // HEAD_WIDTH):
                raise ValueError(f"level {level} has {widths[level]} channels, expected a multiple of {HEAD_WIDTH}")
        self.embed, self.input = TimestepEmbedding(embedding), nn.Conv3d(inputs, width, 3, padding=1)

        def make_layers(before: int, after: int, level: int) -> nn.ModuleList:
            block = ResidualBlock3D(before, after, embedding)
            return nn.ModuleList([block, Attention3D(after)] if level in attention else [block])

        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        skips, now = [width], width
        for level, after in enumerate(widths):
            if level:
                self.down.append(nn.Conv3d(now, now, 3, stride=2, padding=1))
                skips.append(now)
            for _ in range(blocks):
                self.down.append(make_layers(now, after, level))
                now = after
                skips.append(now)
        last = len(widths) - 1
        self.middle = nn.ModuleList([*make_layers(now, now, last), ResidualBlock3D(now, now, embedding)])
        for level, after in reversed(list(enumerate(widths))):
            for _ in range(blocks + 1):
                self.up.append(make_layers(now + skips.pop(), after, level))
                now = after
            if level:
                self.up.append(nn.Conv3d(now, now, 3, padding=1))
        self.output = nn.Sequential(make_norm(now), nn.SiLU(), make_zero(nn.Conv3d(now, outputs, 3, padding=1)))

    def forward(
        self, x: Float[Tensor, "b inputs r c l"], timestep: Int[Tensor, " b"]
    ) -> Float[Tensor, "b outputs r c l"]:
        """Apply the network.

        Args:
            x: Noisy grids.
            timestep: Timesteps.

        Returns:
            Output of the same size.
        """
        embedding = self.embed(timestep)

        def apply(layers: nn.ModuleList, h: Tensor) -> Tensor:
            for layer in layers:
                h = layer(h, embedding) if isinstance(layer, ResidualBlock3D) else layer(h)
            return h

        h = self.input(x)
        skips = [h]
        for part in self.down:
            h = apply(part, h) if isinstance(part, nn.ModuleList) else part(h)
            skips.append(h)
        h = apply(self.middle, h)
        for part in self.up:
            if isinstance(part, nn.ModuleList):
                h = apply(part, torch.cat([h, skips.pop()], dim=1))
            else:  # The next skip connection has the size of the finer level.
                h = part(F.interpolate(h, skips[-1].shape[2:], mode="nearest"))
        return self.output(h)
