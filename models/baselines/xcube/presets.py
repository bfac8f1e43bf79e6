"""Presets of the four stages of XCube."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from models.baselines.base import Stage
from models.baselines.xcube.diffusion import CoarseDiffusion, FineDiffusion
from models.baselines.xcube.losses import (
    COARSE,
    COARSE_DIFFUSION,
    COARSE_VAE,
    FINE_DIFFUSION,
    FINE_VAE,
    make_coarse_diffusion_loss,
    make_fine_diffusion_loss,
    make_vae_loss,
    measure_latents,
)
from models.baselines.xcube.vae import VoxelVAE
from models.training import OptimizerConfig
from models.voxel_grids import FINE

DECAY_SAMPLES, DECAY_FACTOR = 50_000, 0.7  # The learning rate of the VAEs falls by the factor per number of samples.


@dataclass(frozen=True)
class Sizes:
    """Sizes that differ between presets. Tuples with an entry per stage have the order of the stages.

    Attributes:
        coarse_widths: Numbers of channels of the coarse VAE.
        fine_widths: Numbers of channels of the fine VAE.
        coarse_diffusion: Numbers of channels and blocks of the coarse diffusion, and other options.
        fine_diffusion: The same of the fine diffusion.
        crop: Side of the training crops of the fine level in coarse voxels; 0: no crop.
        steps: Number of training steps of each stage.
        batch_sizes: Samples per step of each stage.
        learning_rates: Learning rate of the VAEs and of the diffusion networks.
    """

    coarse_widths: tuple[int, ...]
    fine_widths: tuple[int, ...]
    coarse_diffusion: dict
    fine_diffusion: dict
    crop: int
    steps: tuple[int, int, int, int]
    batch_sizes: tuple[int, int, int, int]
    learning_rates: tuple[float, float]


def make_stages(sizes: Sizes) -> tuple[Stage, ...]:
    """Return the stages of a preset.

    Args:
        sizes: Sizes.

    Returns:
        Stages in the order of their training.
    """

    def make_optimizer(stage: int) -> OptimizerConfig:
        steps, batch_size = sizes.steps[stage], sizes.batch_sizes[stage]
        if stage >= 2:
            return OptimizerConfig(steps, sizes.learning_rates[1], 0.0, ema_decay=0.9999)
        every = max(1, DECAY_SAMPLES // batch_size)
        milestones = tuple((step, DECAY_FACTOR) for step in range(every, steps, every))
        return OptimizerConfig(steps, sizes.learning_rates[0], 0.01, milestones=milestones, amsgrad=True, grad_clip=0.5)

    coarse_vae = {"widths": sizes.coarse_widths, "kl_weight": 0.03}
    fine_vae = {"widths": sizes.fine_widths, "kl_weight": 0.3, "condition_channels": 32}
    coarse, fine = (COARSE,), (COARSE, FINE)
    return (
        Stage(
            COARSE_VAE,
            VoxelVAE,
            coarse_vae,
            coarse,
            sizes.batch_sizes[0],
            make_optimizer(0),
            partial(make_vae_loss, is_fine=False),
        ),
        Stage(
            FINE_VAE,
            VoxelVAE,
            fine_vae,
            fine,
            sizes.batch_sizes[1],
            make_optimizer(1),
            partial(make_vae_loss, is_fine=True, crop=sizes.crop),
        ),
        Stage(
            COARSE_DIFFUSION,
            CoarseDiffusion,
            sizes.coarse_diffusion,
            coarse,
            sizes.batch_sizes[2],
            make_optimizer(2),
            make_coarse_diffusion_loss,
            needs=(COARSE_VAE,),
            measure=partial(measure_latents, is_fine=False),
        ),
        Stage(
            FINE_DIFFUSION,
            FineDiffusion,
            sizes.fine_diffusion,
            fine,
            sizes.batch_sizes[3],
            make_optimizer(3),
            partial(make_fine_diffusion_loss, crop=sizes.crop),
            needs=(FINE_VAE,),
            measure=partial(measure_latents, is_fine=True),
        ),
    )


PRESETS: dict[str, tuple[Stage, ...]] = {
    "smoke": make_stages(
        Sizes(
            coarse_widths=(4, 4, 8, 8),
            fine_widths=(4, 8, 8),
            coarse_diffusion={"width": 8, "multipliers": (1, 2), "blocks": 1, "attention": (1,), "sampling_steps": 4},
            fine_diffusion={"width": 8, "multipliers": (1, 2), "blocks": 1, "sampling_steps": 4},
            crop=8,
            steps=(4, 4, 4, 4),
            batch_sizes=(2, 2, 2, 2),
            learning_rates=(1e-3, 1e-3),
        )
    ),
    "town": make_stages(  # For two CPU cores.
        Sizes(
            coarse_widths=(16, 32, 64, 128),
            fine_widths=(16, 32, 64),
            coarse_diffusion={"width": 32},
            fine_diffusion={"width": 32, "blocks": 1},
            crop=16,
            steps=(2_400, 3_200, 3_000, 4_800),
            batch_sizes=(4, 2, 16, 4),
            learning_rates=(1e-3, 2e-4),
        )
    ),
    "paper": make_stages(
        Sizes(
            coarse_widths=(64, 128, 256, 512),
            fine_widths=(32, 64, 128),
            coarse_diffusion={},
            fine_diffusion={},
            crop=0,
            steps=(100_000, 200_000, 200_000, 400_000),
            batch_sizes=(32, 8, 64, 8),
            learning_rates=(1e-4, 5e-5),
        )
    ),
}
