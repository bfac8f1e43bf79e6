"""Latent diffusion of XCube: networks that predict v, and the sampler.

With a_t = alpha_bar_t, a noisy latent is z_t = sqrt(a_t) z_0 + sqrt(1 - a_t) eps, and v = sqrt(a_t) eps - sqrt(1 - a_t)
z_0 (Salimans and Ho, 2022).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from models.base import ConfiguredModel, register_computed_buffers, register_to_config
from models.baselines.sparse import Sites, SparseConvolution, SparseDownsample, SparseUpsample
from models.baselines.unet3d import HEAD_WIDTH, TimestepEmbedding, UNet3D, make_zero
from models.baselines.xcube.vae import SparseResidualBlock
from models.diffusion_model import make_noise_shares, parse_schedule
from models.options import Integer, Number, Rule, Sequential, check_entries
from models.sampling.diffusion import Diffusion, SamplingSchedule
from models.voxel_grids import NUM_CLASSES

XCUBE_SCHEDULE = Diffusion(num_timesteps=1000, beta_start=1e-4, beta_end=0.02)
COMMON_RULES: dict[str, Rule] = {
    "channels": Integer(1, 1024),
    "width": Integer(8, 4096),
    "multipliers": Sequential(Integer(1, 64), 1, 8),
    "blocks": Integer(1, 16),
    "scale": Number(1e-6, 1e6),
    "sampling_steps": Integer(1, 100_000),
}


class LatentDiffusion(ConfiguredModel):
    """A network that predicts v in latents that are divided by their standard deviation, `scale`.

    Its config has the entries `channels`, `scale`, `schedule` and `sampling_steps`.
    """

    RULES: ClassVar[dict[str, Rule]] = COMMON_RULES
    noise_shares: Tensor
    _schedule: Diffusion

    def compute_buffers(self) -> dict[str, Tensor]:
        """Return the precomputed buffers.

        Returns:
            noise_shares: (timesteps, 2) sqrt(1 - alpha_bar) and sqrt(alpha_bar).
        """
        return {"noise_shares": make_noise_shares(self._schedule)}

    @classmethod
    def parse_config(cls, config: dict[str, Any]) -> dict[str, Any]:
        """Check all entries, and convert the noise schedule to a Diffusion.

        Args:
            config: Value of every constructor argument.

        Returns:
            Keyword arguments of the constructor.

        Raises:
            ValueError: An entry has an invalid value.
        """
        check_entries(config, cls.RULES, others=True)
        schedule = parse_schedule(config["schedule"])
        schedule.select_timesteps(config["sampling_steps"])
        return config | {"schedule": schedule}

    def make_sampling_schedule(self) -> SamplingSchedule:
        """Return the timesteps of sampling with DDIM, without noise in its steps."""
        return SamplingSchedule(self._schedule, self.config.sampling_steps, eta=0.0)

    def noise_and_velocity(self, clean: Tensor, noise: Tensor, timestep: Tensor) -> tuple[Tensor, Tensor]:
        """Add noise to latents.

        Args:
            clean: (n, ...) clean latents.
            noise: (n, ...) standard normal noise.
            timestep: (n,) timesteps.

        Returns:
            Noisy latents and v, both (n, ...).
        """
        shares = self.noise_shares[timestep].view(-1, 2, *(1,) * (clean.ndim - 1))
        of_noise, of_clean = shares.unbind(1)
        return of_clean * clean + of_noise * noise, of_clean * noise - of_noise * clean


class CoarseDiffusion(LatentDiffusion):
    """Dense U-Net on the latents of the coarse level.

    Args:
        channels: Number of channels of the latents.
        width: Number of channels of the first level of the U-Net.
        multipliers: Number of channels of each level, as a multiple of `width`.
        blocks: Number of residual blocks per level.
        attention: Indices of levels with self-attention.
        shape: Rows, columns and levels of the latents of a scene.
        scale: Standard deviation of the latents.
        schedule: Noise schedule.
        sampling_steps: Number of timesteps of sampling.
    """

    RULES: ClassVar[dict[str, Rule]] = COMMON_RULES | {
        "attention": Sequential(Integer(0, 7), 0, 8),
        "shape": Sequential(Integer(1, 4096), 3, 3),
    }

    @register_to_config
    def __init__(
        self,
        channels: int = 8,
        width: int = 192,
        multipliers: Sequence[int] = (1, 2, 4, 4),
        blocks: int = 2,
        attention: Sequence[int] = (2, 3),
        shape: Sequence[int] = (8, 8, 1),
        scale: float = 1.0,
        schedule: Diffusion = XCUBE_SCHEDULE,
        sampling_steps: int = 100,
    ) -> None:
        super().__init__()
        self.unet = UNet3D(channels, channels, width, multipliers, blocks, attention)
        self._schedule = schedule
        register_computed_buffers(self)

    @classmethod
    def parse_config(cls, config: dict[str, Any]) -> dict[str, Any]:
        """Check all entries.

        Args:
            config: Value of every constructor argument.

        Returns:
            Keyword arguments of the constructor.

        Raises:
            ValueError: An entry has an invalid value, or a level with attention does not exist or has a number of
                channels that is not a multiple of the width of a head.
        """
        config = super().parse_config(config)
        for level in config["attention"]:
            if level >= len(config["multipliers"]):
                raise ValueError(
                    f"attention contains level {level}, expected levels below {len(config['multipliers'])}"
                )
            channels = config["width"] * config["multipliers"][level]
            if channels > HEAD_WIDTH and channels % HEAD_WIDTH:
                raise ValueError(f"level {level} has {channels} channels, expected a multiple of {HEAD_WIDTH}")
        return config

    def forward(
        self, latent: Float[Tensor, "b channels r c l"], timestep: Int[Tensor, " b"]
    ) -> Float[Tensor, "b channels r c l"]:
        """Predict v.

        Args:
            latent: Noisy latents.
            timestep: Timesteps.

        Returns:
            Predicted v.
        """
        return self.unet(latent, timestep)


class FineDiffusion(LatentDiffusion):
    """Sparse U-Net on the latents of the fine level, conditioned on the classes of the coarse voxels.

    Args:
        channels: Number of channels of the latents.
        width: Number of channels of the first level of the U-Net.
        multipliers: Number of channels of each level, as a multiple of `width`.
        blocks: Number of residual blocks per level.
        condition_channels: Number of channels of the embedding of the class of a coarse voxel.
        num_classes: Number of classes, with that of empty voxels.
        scale: Standard deviation of the latents.
        schedule: Noise schedule.
        sampling_steps: Number of timesteps of sampling.
    """

    RULES: ClassVar[dict[str, Rule]] = COMMON_RULES | {
        "condition_channels": Integer(1, 1024),
        "num_classes": Integer(2, 256),
    }

    @register_to_config
    def __init__(
        self,
        channels: int = 8,
        width: int = 64,
        multipliers: Sequence[int] = (1, 2, 4, 4),
        blocks: int = 2,
        condition_channels: int = 32,
        num_classes: int = NUM_CLASSES,
        scale: float = 1.0,
        schedule: Diffusion = XCUBE_SCHEDULE,
        sampling_steps: int = 100,
    ) -> None:
        super().__init__()
        self._schedule = schedule
        widths, embedding = [width * factor for factor in multipliers], 4 * width
        self.embed, self.condition = TimestepEmbedding(embedding), nn.Embedding(num_classes, condition_channels)
        self.input = SparseConvolution(channels + condition_channels, width)

        def make_blocks(before: int, after: int) -> nn.ModuleList:
            sizes = [before, *(after,) * blocks]
            return nn.ModuleList(
                [SparseResidualBlock(*pair, embedding) for pair in zip(sizes, sizes[1:], strict=False)]
            )

        self.down = nn.ModuleList([make_blocks(*pair) for pair in zip([width, *widths], widths, strict=False)])
        self.downsample = nn.ModuleList([SparseDownsample(n, n) for n in widths[:-1]])
        self.middle = make_blocks(widths[-1], widths[-1])
        self.upsample = nn.ModuleList([SparseUpsample(b, a) for a, b in zip(widths, widths[1:], strict=False)])
        self.up = nn.ModuleList([make_blocks(2 * n, n) for n in widths[:-1]])
        self.output = nn.Sequential(nn.LayerNorm(width), nn.SiLU(), make_zero(nn.Linear(width, channels)))
        register_computed_buffers(self)

    def find_sites(self, top: Sites) -> list[Sites]:
        """Find the active voxels of all levels of the U-Net.

        Args:
            top: Coarse voxels that are not empty.

        Returns:
            Active voxels of each level, from fine to coarse.
        """
        sites = [top]
        for _ in self.upsample:
            sites.append(sites[-1].coarsen())
        return sites

    def forward(
        self,
        latent: Float[Tensor, "n channels"],
        timestep: Int[Tensor, " b"],
        classes: Int[Tensor, " n"],
        sites: list[Sites],
    ) -> Float[Tensor, "n channels"]:
        """Predict v.

        Args:
            latent: Noisy latents of the coarse voxels that are not empty.
            timestep: Timestep of each scene.
            classes: Class ids of the coarse voxels.
            sites: Active voxels, of `find_sites`.

        Returns:
            Predicted v.
        """
        embedding = self.embed(timestep)

        def apply(blocks: Any, h: Tensor, level: int) -> Tensor:
            for block in blocks:
                h = block(h, sites[level], embedding)
            return h

        h, skips = self.input(torch.cat([latent, self.condition(classes)], dim=1), sites[0]), []
        for level, blocks in enumerate(self.down):
            if level:
                h = self.downsample[level - 1](h, sites[level - 1], sites[level])
            h = apply(blocks, h, level)
            skips.append(h)
        h = apply(self.middle, h, len(sites) - 1)
        for level in reversed(range(len(self.up))):
            h = self.upsample[level](h, sites[level + 1], sites[level])
            h = apply(self.up[level], torch.cat([h, skips[level]], dim=1), level)
        return self.output(h)


@torch.no_grad()
def sample_latents(
    predict_velocity: Callable[[Tensor, int], Tensor],
    schedule: SamplingSchedule,
    draw_noise: Callable[[], Tensor],
    known: Tensor | None = None,
    unknown: Tensor | None = None,
) -> Tensor:
    """Sample latents, with known parts as in RePaint, but without resampling.

    Args:
        predict_velocity: Function of noisy latents and a timestep that returns v.
        schedule: Timesteps.
        draw_noise: Function that returns standard normal noise of the shape of the latents.
        known: Clean latents of the known part; None: there is none.
        unknown: Boolean mask of latents to generate, which is broadcast.

    Returns:
        Clean latents, equal to `known` outside of `unknown`.
    """
    latent = draw_noise()
    for state, to in schedule.descending_transitions():
        alpha_bar = float(schedule.alpha_bar[state])
        velocity = predict_velocity(latent, int(schedule.timesteps[state])).float()
        noise = alpha_bar**0.5 * velocity + (1 - alpha_bar) ** 0.5 * latent
        step_noise = draw_noise() if schedule.eta and to >= 0 else torch.zeros_like(latent)
        latent = schedule.step_down(latent, noise, step_noise, state)
        if known is not None and unknown is not None:
            kept = schedule.noise_to_state(known, draw_noise() if to >= 0 else known, to)
            latent = torch.where(unknown, latent, kept)
    return latent


def velocity_error(predicted: Tensor, velocity: Tensor) -> Tensor:
    """Return the squared error of v.

    Args:
        predicted: (n, channels, ...) predicted v.
        velocity: (n, channels, ...) true v.

    Returns:
        (n,) float32 mean squared error over all other axes.
    """
    return F.mse_loss(predicted.float(), velocity, reduction="none").flatten(1).mean(1)
