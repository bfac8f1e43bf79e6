"""Triplane autoencoder of SemCity: 3D convolutions, means over the axes, and an implicit decoder of class logits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from jaxtyping import Integer as AnyInteger
from torch import Tensor, nn

from models.base import ConfiguredModel, register_to_config
from models.baselines.semcity.triplane import Planes, PlaneSizes, join_planes, split_planes
from models.options import Integer, Rule, Sequential, check_entries

NUM_FREQUENCIES = 6  # Of the sines and cosines of a position: 36 features.
QUERIES_AT_ONCE = 2**17  # Number of positions that are decoded together.
RULES: dict[str, Rule] = {
    "shape": Sequential(Integer(2, 4096), 3, 3),
    "num_classes": Integer(2, 256),
    "channels": Integer(1, 1024),
    "kernel": Sequential(Integer(1, 15), 3, 3),
    "plane_channels": Integer(1, 4096),
    "plane_kernel": Integer(1, 15),
    "width": Integer(1, 2**14),
    "layers": Integer(2, 64),
}


class TriplaneAutoencoder(ConfiguredModel):
    """Encode voxels to a triplane, and decode class logits at any position.

    Args:
        shape: Rows, columns and levels of the voxel grids. Rows and columns are even.
        num_classes: Number of classes, with that of empty voxels.
        channels: Channels of the embedding, of the 3D convolutions and of the triplane.
        kernel: Sizes of the 3D convolutions along rows, columns and levels, odd numbers.
        plane_channels: Channels of the planes in the decoder.
        plane_kernel: Size of the 2D convolutions of the decoder, odd.
        width: Width of the decoder's perceptron.
        layers: Number of hidden layers of the perceptron, even. The input enters again in the middle.
    """

    @register_to_config
    def __init__(
        self,
        shape: Sequence[int],
        num_classes: int,
        channels: int = 16,
        kernel: Sequence[int] = (5, 5, 3),
        plane_channels: int = 64,
        plane_kernel: int = 5,
        width: int = 256,
        layers: int = 4,
    ) -> None:
        super().__init__()
        rows, cols, levels = shape
        self.sizes = PlaneSizes(rows // 2, cols // 2, levels)

        def conv() -> nn.Conv3d:
            padding = kernel[0] // 2, kernel[1] // 2, kernel[2] // 2
            size = kernel[0], kernel[1], kernel[2]
            return nn.Conv3d(channels, channels, size, padding=padding, padding_mode="replicate")

        def block() -> nn.Sequential:
            return nn.Sequential(
                conv(), nn.InstanceNorm3d(channels), nn.LeakyReLU(0.1), conv(), nn.InstanceNorm3d(channels)
            )

        self.embedding = nn.Embedding(num_classes, channels)
        self.first, self.fine, self.coarse = conv(), block(), block()
        self.halve = nn.Sequential(nn.Conv3d(channels, channels, (2, 2, 1), (2, 2, 1)), nn.InstanceNorm3d(channels))
        self.plane_blocks = nn.ModuleList(PlaneBlock(channels, plane_channels, plane_kernel) for _ in range(3))
        inputs = plane_channels + 6 * NUM_FREQUENCIES
        half = layers // 2
        self.before = make_perceptron([inputs] + [width] * (half + 1))
        self.after = make_perceptron([inputs + width] + [width] * half)
        self.logits = nn.Linear(width, num_classes)

    @classmethod
    def parse_config(cls, config: dict[str, Any]) -> dict[str, Any]:
        """Check the entries of a config.

        Args:
            config: Value of every constructor argument.

        Returns:
            Keyword arguments of the constructor.

        Raises:
            ValueError: An entry has an invalid value.
        """
        check_entries(config, RULES)
        if config["shape"][0] % 2 or config["shape"][1] % 2 or config["layers"] % 2:
            raise ValueError(f"shape is {config['shape']}, layers {config['layers']}; expected even numbers")
        if not all(size % 2 for size in (*config["kernel"], config["plane_kernel"])):
            raise ValueError(f"kernel is {config['kernel']}, plane_kernel {config['plane_kernel']}; expected odd sizes")
        return config

    @property
    def latent_shape(self) -> tuple[int, int, int]:
        """Shape (channels, 1, cells) of a triplane."""
        return self.config.channels, 1, self.sizes.num_cells

    def encode(self, voxels: AnyInteger[Tensor, "b rows cols levels"]) -> Float[Tensor, "b c 1 cells"]:
        """Encode voxels.

        Args:
            voxels: Class ids.

        Returns:
            Triplanes with values between -1 and 1.
        """
        x = self.first(self.embedding(voxels.long()).movedim(4, 1))
        x = self.halve(x + self.fine(x))
        x = x + self.coarse(x)
        return join_planes([torch.tanh(0.5 * F.instance_norm(x.mean(axis))) for axis in (4, 3, 2)])

    def decode(
        self, triplane: Float[Tensor, "b c 1 cells"], position: Float[Tensor, "b n 3"]
    ) -> Float[Tensor, "b n classes"]:
        """Decode class logits at positions.

        Args:
            triplane: Triplanes.
            position: Positions along rows, columns and levels. The grid reaches from -1 to 1.

        Returns:
            Logits.
        """
        return self._decode_planes(self._widen_planes(triplane), position)

    def _widen_planes(self, triplane: Tensor) -> Planes:
        planes = split_planes(triplane, self.sizes)
        return Planes(*(block(plane) for block, plane in zip(self.plane_blocks, planes, strict=True)))

    def _decode_planes(self, planes: Planes, position: Tensor) -> Tensor:
        features = torch.zeros((), device=position.device)
        for plane, axes in zip(planes, ((0, 1), (0, 2), (1, 2)), strict=True):
            at = position[:, None, :, axes].flip(-1)  # grid_sample expects the last axis first.
            features = features + F.grid_sample(plane, at, padding_mode="border", align_corners=False)[:, :, 0]
        angles = torch.cat([position * 2.0**k for k in range(NUM_FREQUENCIES)], dim=2)
        inputs = torch.cat([features.transpose(1, 2), angles.sin(), angles.cos()], dim=2)
        return self.logits(self.after(torch.cat([inputs, self.before(inputs)], dim=2)))

    def forward(
        self, voxels: AnyInteger[Tensor, "b rows cols levels"], position: Float[Tensor, "b n 3"]
    ) -> Float[Tensor, "b n classes"]:
        """Encode voxels, and decode class logits at positions.

        Args:
            voxels: Class ids.
            position: Positions (`decode`).

        Returns:
            Logits.
        """
        return self.decode(self.encode(voxels), position)

    @torch.no_grad()
    def decode_voxels(self, triplane: Float[Tensor, "b c 1 cells"]) -> AnyInteger[Tensor, "b rows cols levels"]:
        """Decode the most probable class of each voxel.

        Args:
            triplane: Triplanes.

        Returns:
            (b, rows, cols, levels) uint8 class ids.
        """
        shape = self.config.shape
        count = math.prod(shape)
        planes = self._widen_planes(triplane)
        parts = []
        for start in range(0, count, QUERIES_AT_ONCE):
            index = torch.arange(start, min(start + QUERIES_AT_ONCE, count), device=triplane.device)
            position = find_positions(index.expand(len(triplane), -1), shape)
            parts.append(self._decode_planes(planes, position).argmax(dim=2).to(torch.uint8))
        return torch.cat(parts, dim=1).unflatten(1, tuple(shape))


class PlaneBlock(nn.Module):
    """Residual block that widens a plane. It starts as a linear map of each cell, because the last layer is zero."""

    def __init__(self, channels: int, out_channels: int, kernel: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, out_channels, kernel, padding=kernel // 2)
        self.norm = nn.InstanceNorm2d(out_channels, eps=1e-6, affine=True)
        self.second = nn.Conv2d(out_channels, out_channels, kernel, padding=kernel // 2)
        self.shortcut = nn.Conv2d(channels, out_channels, 1)
        for parameter in self.second.parameters():
            nn.init.zeros_(parameter)

    def forward(self, plane: Tensor) -> Tensor:
        """Apply the block.

        Args:
            plane: (b, channels, height, width).

        Returns:
            (b, out_channels, height, width).
        """
        return self.shortcut(plane) + self.second(F.silu(self.norm(self.first(plane))))


def make_perceptron(widths: Sequence[int]) -> nn.Sequential:
    """Return linear layers, each followed by ReLU.

    Args:
        widths: Number of inputs, then the width of each layer.

    Returns:
        The layers.
    """
    layers = [
        layer
        for inputs, outputs in zip(widths, widths[1:], strict=False)
        for layer in (nn.Linear(inputs, outputs), nn.ReLU())
    ]
    return nn.Sequential(*layers)


def find_positions(index: Int[Tensor, "b n"], shape: Sequence[int]) -> Float[Tensor, "b n 3"]:
    """Return the centres of voxels.

    Args:
        index: Indices of voxels in C order.
        shape: Rows, columns and levels of the grid.

    Returns:
        Positions along rows, columns and levels. The grid reaches from -1 to 1.
    """
    rows, cols, levels = shape
    place = torch.stack([index // (cols * levels), index // levels % cols, index % levels], dim=-1)
    return (2 * place + 1) / torch.tensor([rows, cols, levels], device=index.device) - 1
