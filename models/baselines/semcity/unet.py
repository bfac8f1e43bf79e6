"""UNet of SemCity's diffusion: 2D convolutions of three planes, which see the means of each other."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from models.base import ConfiguredModel, register_to_config
from models.baselines.semcity.triplane import Planes, PlaneSizes, join_planes, split_planes
from models.dit import embed_timesteps
from models.options import Integer, Number, Rule, Sequential, check_entries
from models.sampling.diffusion import Diffusion

GROUPS = 32  # Largest number of groups of the group normalisation.
RULES: dict[str, Rule] = {
    "sizes": Sequential(Integer(1, 4096), 3, 3),
    "channels": Integer(1, 1024),
    "width": Integer(2, 4096),
    "multipliers": Sequential(Integer(1, 64), 1, 8),
    "num_timesteps": Integer(1, 100_000),
    "beta_start": Number(1e-9, 0.9999),
    "beta_end": Number(1e-9, 0.9999),
}


class TriplaneUNet(ConfiguredModel):
    """Predict the clean triplane from a noisy one.

    Args:
        sizes: Cells of the planes along rows, columns and levels. Levels are not downsampled.
        channels: Channels of a triplane.
        width: Channels of the first level.
        multipliers: Channels of each level as multiples of `width`.
        num_timesteps: Number of training timesteps.
        beta_start: Variance of the first timestep of the linear schedule.
        beta_end: Variance of the last timestep.
    """

    @register_to_config
    def __init__(
        self,
        sizes: Sequence[int],
        channels: int = 16,
        width: int = 64,
        multipliers: Sequence[int] = (1, 2, 4),
        num_timesteps: int = 100,
        beta_start: float = 0.001,
        beta_end: float = 0.2,
    ) -> None:
        super().__init__()
        self.sizes = PlaneSizes(*sizes)
        emb = 4 * width
        self.embed_time = nn.Sequential(nn.Linear(width, emb), nn.SiLU(), nn.Linear(emb, emb))
        widths = [width * factor for factor in multipliers]
        self.first = PlaneConv(channels, widths[0])
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        for level, (before, after) in enumerate(zip([widths[0], *widths], widths, strict=False)):
            stages = [PlaneDown(before)] if level else []
            self.down.append(
                nn.ModuleList([*stages, PlaneResBlock(before, after, emb), PlaneResBlock(after, after, emb)])
            )
        for level in reversed(range(len(widths))):
            deepest = level == len(widths) - 1
            inputs = widths[level] if deepest else widths[level + 1] + widths[level]
            blocks = [PlaneResBlock(inputs, widths[level], emb), PlaneResBlock(widths[level], widths[level], emb)]
            self.up.append(nn.ModuleList([*blocks, *([PlaneUp(widths[level])] if level else [])]))
        self.last_norm, self.last = PlaneNorm(widths[0]), PlaneConv(widths[0], channels)

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
        step = 2 ** (len(config["multipliers"]) - 1)
        if config["width"] % 2 or any(size % step for size in config["sizes"][:2]):
            raise ValueError(
                f"width is {config['width']}, sizes {config['sizes']}; expected an even width, and rows and columns"
                f" that are multiples of {step}"
            )
        if config["beta_start"] > config["beta_end"]:
            raise ValueError(f"beta_start is {config['beta_start']}, above beta_end {config['beta_end']}")
        return config

    @property
    def diffusion(self) -> Diffusion:
        """Noise schedule of the training."""
        return Diffusion(self.config.num_timesteps, self.config.beta_start, self.config.beta_end)

    def forward(self, triplane: Float[Tensor, "b c 1 cells"], timestep: Int[Tensor, " b"]) -> Tensor:
        """Predict clean triplanes.

        Args:
            triplane: Noisy triplanes.
            timestep: Timestep of each triplane.

        Returns:
            (b, c, 1, cells) clean triplanes.
        """
        emb = self.embed_time(embed_timesteps(timestep, self.config.width))
        planes, skips = self.first(split_planes(triplane, self.sizes)), []
        for stage in self.down:
            for layer in stage:  # pyright: ignore[reportGeneralTypeIssues]
                planes = layer(planes, emb)
            skips.append(planes)
        for number, stage in enumerate(self.up):
            skip = skips.pop()
            if number:
                planes = Planes(*(torch.cat(pair, dim=1) for pair in zip(planes, skip, strict=True)))
            for layer in stage:  # pyright: ignore[reportGeneralTypeIssues]
                planes = layer(planes, emb)
        return join_planes(self.last(map_planes(F.silu, self.last_norm(planes))))


def map_planes(function: Callable[[Tensor], Tensor], planes: Planes) -> Planes:
    """Apply a function to each plane.

    Args:
        function: Function of a plane.
        planes: Planes.

    Returns:
        Results.
    """
    return Planes(*map(function, planes))


class PlaneLayer(nn.Module):
    """One layer of the same kind per plane.

    Args:
        make: Function that returns the layer of a plane; it is given whether the second axis of the plane is z.
    """

    def __init__(self, make: Callable[[bool], nn.Module]) -> None:
        super().__init__()
        self.layers = nn.ModuleList(make(is_vertical) for is_vertical in (False, True, True))

    def forward(self, planes: Planes, emb: Tensor | None = None) -> Planes:
        """Apply the layers.

        Args:
            planes: Planes.
            emb: Embedding of the timestep, which these layers ignore.

        Returns:
            Planes.
        """
        return Planes(*(layer(plane) for layer, plane in zip(self.layers, planes, strict=True)))


class PlaneNorm(PlaneLayer):
    """Group normalisation of each plane."""

    def __init__(self, channels: int) -> None:
        super().__init__(lambda is_vertical: nn.GroupNorm(math.gcd(GROUPS, channels), channels))


class PlaneConv(PlaneLayer):
    """1 x 1 convolution of each plane."""

    def __init__(self, channels: int, out_channels: int) -> None:
        super().__init__(lambda is_vertical: nn.Conv2d(channels, out_channels, 1))


class PlaneDown(PlaneLayer):
    """Halve rows and columns by a strided convolution. Levels are kept."""

    def __init__(self, channels: int) -> None:
        super().__init__(
            lambda is_vertical: nn.Conv2d(
                channels, channels, 3, (2, 1) if is_vertical else 2, padding=1, padding_mode="replicate"
            )
        )


class PlaneUp(PlaneLayer):
    """Double rows and columns by a transposed convolution. Levels are kept."""

    def __init__(self, channels: int) -> None:
        super().__init__(
            lambda is_vertical: nn.ConvTranspose2d(
                channels,
                channels,
                3,
                (2, 1) if is_vertical else 2,
                padding=1,
                output_padding=(1, 0) if is_vertical else 1,
            )
        )


class RolloutConv(PlaneLayer):
    """3 x 3 convolution of each plane, together with the means of the two other planes over their other axis."""

    def __init__(self, channels: int, out_channels: int) -> None:
        super().__init__(lambda is_vertical: nn.Conv2d(3 * channels, out_channels, 3, padding=1))

    def forward(self, planes: Planes, emb: Tensor | None = None) -> Planes:
        """Apply the convolution.

        Args:
            planes: Planes.
            emb: Embedding of the timestep, which this layer ignores.

        Returns:
            Planes.
        """
        xy, xz, yz = planes
        along_x = xy.mean(3)[:, :, :, None], xz.mean(3)[:, :, :, None]  # (b, c, rows, 1)
        along_y = xy.mean(2)[:, :, :, None], yz.mean(3)[:, :, None, :]  # (b, c, cols, 1) and (b, c, 1, cols)
        along_z = xz.mean(2)[:, :, None, :], yz.mean(2)[:, :, None, :]  # (b, c, 1, levels)
        joined = Planes(
            torch.cat([xy, along_y[1].expand_as(xy), along_x[1].expand_as(xy)], dim=1),
            torch.cat([xz, along_x[0].expand_as(xz), along_z[1].expand_as(xz)], dim=1),
            torch.cat([yz, along_y[0].expand_as(yz), along_z[0].expand_as(yz)], dim=1),
        )
        return super().forward(joined)


class PlaneResBlock(nn.Module):
    """Residual block whose second normalisation is scaled and shifted by the timestep."""

    def __init__(self, channels: int, out_channels: int, emb: int) -> None:
        super().__init__()
        self.norm, self.conv = PlaneNorm(channels), RolloutConv(channels, out_channels)
        self.embed = nn.Linear(emb, 2 * out_channels)
        self.norm_after, self.conv_after = PlaneNorm(out_channels), RolloutConv(out_channels, out_channels)
        self.shortcut = PlaneConv(channels, out_channels) if channels != out_channels else None
        for layer in self.conv_after.layers:
            for parameter in layer.parameters():
                nn.init.zeros_(parameter)

    def forward(self, planes: Planes, emb: Tensor) -> Planes:
        """Apply the block.

        Args:
            planes: Planes.
            emb: (b, emb) embedding of the timestep.

        Returns:
            Planes.
        """
        x = self.conv(map_planes(F.silu, self.norm(planes)))
        scale, shift = self.embed(F.silu(emb))[:, :, None, None].chunk(2, dim=1)
        x = map_planes(lambda plane: F.silu(plane * (1 + scale) + shift), self.norm_after(x))
        kept = self.shortcut(planes) if self.shortcut else planes
        return Planes(*(a + b for a, b in zip(kept, self.conv_after(x), strict=True)))
