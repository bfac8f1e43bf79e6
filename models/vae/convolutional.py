"""Convolutional encoder and decoder of image autoencoders (Rombach et al., 2022), for the ground branch.

Parameters have the same names, order and initial values as in the classes `Encoder` and `Decoder` of diffusers. Outputs
are bit-identical to those of diffusers (tests/unit/test_convolutional.py). This module replaces these classes, because
importing diffusers takes two to three seconds in each process.
"""

from __future__ import annotations

from itertools import pairwise

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from models.base import apply_in_float32

EPSILON = 1e-6  # Epsilon of every group normalisation.


class ResnetBlock(nn.Module):
    """Two 3 x 3 convolutions, each after a normalisation, with a skip connection.

    The skip connection is a 1 x 1 convolution if the number of channels changes.
    """

    def __init__(self, in_channels: int, out_channels: int, norm_groups: int) -> None:
        super().__init__()
        self.norm1 = nn.GroupNorm(norm_groups, in_channels, EPSILON)
        self.conv1 = nn.Conv2d(in_channels, out_channels, 3, padding=1)
        self.norm2 = nn.GroupNorm(norm_groups, out_channels, EPSILON)
        self.conv2 = nn.Conv2d(out_channels, out_channels, 3, padding=1)
        self.conv_shortcut = nn.Conv2d(in_channels, out_channels, 1) if in_channels != out_channels else None

    def forward(self, x: Float[Tensor, "batch c1 h w"]) -> Float[Tensor, "batch c2 h w"]:
        """Apply the block.

        Args:
            x: Feature map.

        Returns:
            Feature map of the same resolution.
        """
        y = self.conv1(F.silu(self.norm1(x)))
        y = self.conv2(F.silu(self.norm2(y)))
        if self.conv_shortcut is not None:
            x = self.conv_shortcut(x.contiguous() if self.training else x)  # DDP needs dense strides.
        return x + y


class CellAttention(nn.Module):
    """Single-head self-attention over all cells of a feature map, with a skip connection."""

    def __init__(self, channels: int, norm_groups: int) -> None:
        super().__init__()
        self.group_norm = nn.GroupNorm(norm_groups, channels, EPSILON)
        self.to_q = nn.Linear(channels, channels)
        self.to_k = nn.Linear(channels, channels)
        self.to_v = nn.Linear(channels, channels)
        self.to_out = nn.ModuleList([nn.Linear(channels, channels)])

    def forward(self, x: Float[Tensor, "batch c h w"]) -> Float[Tensor, "batch c h w"]:
        """Apply attention over all cells.

        Args:
            x: Feature map.

        Returns:
            Feature map of the same shape.
        """
        cells = self.group_norm(x.flatten(2)).transpose(1, 2)
        query, key, value = (layer(cells)[:, None] for layer in (self.to_q, self.to_k, self.to_v))
        attended = F.scaled_dot_product_attention(query, key, value)[:, 0]
        return self.to_out[0](attended).transpose(1, 2).reshape(x.shape) + x


class Downsample(nn.Module):
    """Halve the resolution by a 3 x 3 convolution with stride 2 and padding at the bottom and on the right."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, channels, 3, stride=2)

    def forward(self, x: Float[Tensor, "batch c h w"]) -> Float[Tensor, "batch c h2 w2"]:
        """Halve the resolution.

        Args:
            x: Feature map.

        Returns:
            Feature map of half the resolution.
        """
        return self.conv(F.pad(x, (0, 1, 0, 1)))


class Upsample(nn.Module):
    """Double the resolution by nearest-neighbour interpolation, then apply a 3 x 3 convolution."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Float[Tensor, "batch c h w"]) -> Float[Tensor, "batch c h2 w2"]:
        """Double the resolution.

        Args:
            x: Feature map.

        Returns:
            Feature map of twice the resolution.
        """
        return self.conv(F.interpolate(x, scale_factor=2.0, mode="nearest"))


class DownBlock(nn.Module):
    """One residual block, followed by a `Downsample` unless it is the last block."""

    def __init__(self, in_channels: int, out_channels: int, norm_groups: int, last: bool) -> None:
        super().__init__()
        self.resnets = nn.ModuleList([ResnetBlock(in_channels, out_channels, norm_groups)])
        self.downsamplers = nn.ModuleList([] if last else [Downsample(out_channels)])

    def forward(self, x: Float[Tensor, "batch c1 h w"]) -> Float[Tensor, "batch c2 h2 w2"]:
        """Apply the block.

        Args:
            x: Feature map.

        Returns:
            Feature map of half the resolution, or of the same resolution for the last block.
        """
        for layer in (*self.resnets, *self.downsamplers):
            x = layer(x)
        return x


class UpBlock(nn.Module):
    """Two residual blocks, followed by an `Upsample` unless it is the last block."""

    def __init__(self, in_channels: int, out_channels: int, norm_groups: int, last: bool) -> None:
        super().__init__()
        self.resnets = nn.ModuleList(ResnetBlock(c, out_channels, norm_groups) for c in (in_channels, out_channels))
        self.upsamplers = nn.ModuleList([] if last else [Upsample(out_channels)])

    def forward(self, x: Float[Tensor, "batch c1 h w"]) -> Float[Tensor, "batch c2 h2 w2"]:
        """Apply the block.

        Args:
            x: Feature map.

        Returns:
            Feature map of twice the resolution, or of the same resolution for the last block.
        """
        for layer in (*self.resnets, *self.upsamplers):
            x = layer(x)
        return x


class MidBlock(nn.Module):
    """Two residual blocks with optional attention between them."""

    def __init__(self, channels: int, norm_groups: int, attention: bool) -> None:
        super().__init__()
        first = ResnetBlock(channels, channels, norm_groups)
        self.attentions = nn.ModuleList([CellAttention(channels, norm_groups)] if attention else [])
        self.resnets = nn.ModuleList([first, ResnetBlock(channels, channels, norm_groups)])

    def forward(self, x: Float[Tensor, "batch c h w"]) -> Float[Tensor, "batch c h w"]:
        """Apply the block.

        Args:
            x: Feature map.

        Returns:
            Feature map of the same shape.
        """
        first, second = self.resnets
        for layer in (first, *self.attentions, second):
            x = layer(x)
        return x


class ConvolutionalEncoder(nn.Module):
    """Encode maps (batch, in_channels, H, W). Each block except the last halves the resolution."""

    def __init__(
        self, in_channels: int, out_channels: int, channels: tuple[int, ...], norm_groups: int, attention: bool
    ) -> None:
        super().__init__()
        self.conv_in = nn.Conv2d(in_channels, channels[0], 3, padding=1)
        self.down_blocks = nn.ModuleList(
            DownBlock(before, after, norm_groups, last=k == len(channels) - 1)
            for k, (before, after) in enumerate(pairwise((channels[0], *channels)))
        )
        self.mid_block = MidBlock(channels[-1], norm_groups, attention)
        self.conv_norm_out = nn.GroupNorm(norm_groups, channels[-1], EPSILON)
        self.conv_out = nn.Conv2d(channels[-1], out_channels, 3, padding=1)

    def forward(self, maps: Float[Tensor, "batch c1 rows cols"]) -> Float[Tensor, "batch c2 h w"]:
        """Encode maps.

        Args:
            maps: Input maps.

        Returns:
            (batch, out_channels, h, w) features.
        """
        x = apply_in_float32(self.conv_in, maps)
        for block in self.down_blocks:
            x = block(x)
        return apply_in_float32(self.conv_out, F.silu(self.conv_norm_out(self.mid_block(x))))


class ConvolutionalDecoder(nn.Module):
    """Decode latents (batch, in_channels, h, w). Each block except the last doubles the resolution."""

    def __init__(
        self, in_channels: int, out_channels: int, channels: tuple[int, ...], norm_groups: int, attention: bool
    ) -> None:
        super().__init__()
        upward = tuple(reversed(channels))
        self.conv_in = nn.Conv2d(in_channels, upward[0], 3, padding=1)
        # As in diffusers, register `up_blocks` before `mid_block`, but initialise `mid_block` first.
        self.up_blocks = nn.ModuleList()
        self.mid_block = MidBlock(upward[0], norm_groups, attention)
        self.up_blocks.extend(
            UpBlock(before, after, norm_groups, last=k == len(upward) - 1)
            for k, (before, after) in enumerate(pairwise((upward[0], *upward)))
        )
        self.conv_norm_out = nn.GroupNorm(norm_groups, upward[-1], EPSILON)
        self.conv_out = nn.Conv2d(upward[-1], out_channels, 3, padding=1)

    def forward(self, latent: Float[Tensor, "batch c1 h w"]) -> Float[Tensor, "batch c2 rows cols"]:
        """Decode latents.

        Args:
            latent: Input latents.

        Returns:
            (batch, out_channels, H, W) maps.
        """
        x = self.mid_block(apply_in_float32(self.conv_in, latent))
        for block in self.up_blocks:
            x = block(x)
        return apply_in_float32(self.conv_out, F.silu(self.conv_norm_out(x)))
