"""Presets of SemCity: `smoke` for tests, `town` for two CPU cores, and `paper` with the published sizes."""

from __future__ import annotations

from models.baselines.base import Stage
from models.baselines.semcity.autoencoder import TriplaneAutoencoder
from models.baselines.semcity.losses import make_autoencoder_loss, make_diffusion_loss
from models.baselines.semcity.unet import TriplaneUNet
from models.training import OptimizerConfig
from models.voxel_grids import FINE, FINE_SHAPE, NUM_CLASSES, Factor, coarsen_shape


def make_stages(
    factor: Factor,
    autoencoder: dict,
    unet: dict,
    queries: int,
    batch_sizes: tuple[int, int],
    optimizers: tuple[OptimizerConfig, OptimizerConfig],
    class_order: bool = False,
) -> tuple[Stage, ...]:
    """Return the stages of a preset.

    Args:
        factor: Size of the voxels.
        autoencoder: Options of the autoencoder, without shape and number of classes.
        unet: Options of the UNet, without the shape of its triplanes.
        queries: Number of voxels per scene at which the decoder is trained.
        batch_sizes: Samples per step of both stages.
        optimizers: Options of the optimisers of both stages.
        class_order: Whether queries are listed by class (`queries.select_queries`).

    Returns:
        Stages `autoencoder` and `diffusion`.
    """
    shape = coarsen_shape(FINE_SHAPE, factor)
    rows, cols, levels = shape
    options = {"shape": shape, "num_classes": NUM_CLASSES, **autoencoder}
    sizes = {"sizes": (rows // 2, cols // 2, levels), "channels": autoencoder["channels"]}
    return (
        Stage(
            "autoencoder",
            TriplaneAutoencoder,
            options,
            (factor,),
            batch_sizes[0],
            optimizers[0],
            make_autoencoder_loss(factor, queries, class_order),
        ),
        Stage(
            "diffusion",
            TriplaneUNet,
            sizes | unet,
            (factor,),
            batch_sizes[1],
            optimizers[1],
            make_diffusion_loss(factor),
            needs=("autoencoder",),
        ),
    )


EPOCH = 61_913 // 4  # Steps of an epoch of the paper's training split.
PAPER_OPTIMIZERS = (
    OptimizerConfig(50 * EPOCH, 1e-3, 0.0, milestones=((30 * EPOCH, 0.5), (40 * EPOCH, 0.5)), grad_clip=1.0),
    OptimizerConfig(50_000, 5e-4, 0.0, final_learning_rate=0.0, decay="linear", ema_decay=0.9999),
)
TOWN_OPTIMIZERS = (
    OptimizerConfig(2_000, 1e-3, 0.0, final_learning_rate=1e-4, grad_clip=1.0, warmup_steps=20),
    OptimizerConfig(6_000, 5e-4, 0.0, final_learning_rate=5e-5, decay="linear", ema_decay=0.999, grad_clip=1.0),
)
SMOKE_OPTIMIZERS = (OptimizerConfig(8, 1e-3, 0.0), OptimizerConfig(8, 5e-4, 0.0, ema_decay=0.9))
PAPER = {"channels": 16, "kernel": (5, 5, 3), "plane_channels": 64, "plane_kernel": 5, "width": 256, "layers": 4}
TOWN = {"channels": 8, "kernel": (3, 3, 3), "plane_channels": 32, "plane_kernel": 3, "width": 128, "layers": 4}
SMOKE = {"channels": 4, "kernel": (3, 3, 3), "plane_channels": 8, "plane_kernel": 3, "width": 16, "layers": 2}

PRESETS: dict[str, tuple[Stage, ...]] = {
    "smoke": make_stages(
        (8, 8, 8), SMOKE, {"width": 8, "multipliers": (1, 2), "num_timesteps": 10}, 500, (2, 2), SMOKE_OPTIMIZERS
    ),
    # 128 x 128 x 16 voxels, one of the resolutions of the paper's table.
    "town": make_stages((2, 2, 2), TOWN, {"width": 32}, 50_000, (4, 8), TOWN_OPTIMIZERS),
    "paper": make_stages(FINE, PAPER, {"width": 64}, 1_000_000, (4, 4), PAPER_OPTIMIZERS),
    # The setting of the authors, which the paper compares with 1,000,000 queries.
    "paper-400k": make_stages(FINE, PAPER, {"width": 64}, 400_000, (4, 4), PAPER_OPTIMIZERS, class_order=True),
}
