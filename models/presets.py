"""Presets: options of each model size, as one row of a table. All presets use the same code.

* `smoke` trains within seconds, for tests.
* `demo` trains on two CPU cores; the layout VAE takes half an hour and the transformer three hours.
* `town` has level sets, a local frame and finer rasters. The layout VAE takes three to four hours on one CPU core and
  the transformer longer.
* `kitti360` and `av2` are the paper's models (supplement B.2 and B.3). `kitti360-mini` rehearses them on two cores.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

from models.vae.config import GroundConfig, LayoutVAEConfig, ObjectConfig

Preset = TypeVar("Preset")


@dataclass(frozen=True)
class LVAEPreset:
    """Architecture and training options of a layout VAE.

    Attributes:
        source: Name of the source for which the preset is designed.
        raster_px: Number of rows and of columns of the rasters.
        model: Architecture.
        batch_size: Samples per step.
        steps: Number of training steps.
        learning_rate: Learning rate at the start of the decay. During a warm-up, it rises to this value.
        final_learning_rate: Learning rate of the last step.
        weight_decay: Weight decay of AdamW.
        warmup_steps: Number of initial steps during which the learning rate rises linearly.
        grad_clip: Largest gradient norm; None: gradients are not clipped.
        ema_decay: Decay of the exponential moving average of the weights; None: no moving average.
        kl_weight: Weight of the KL loss, which is summed over the latent.
        latent_noise: Scale of the noise that is added to training latents. The noise makes decoders tolerate errors in
            sampled latents. The paper adds no noise.
        init_from_data: If True, training starts from the means of the data and a small posterior variance
            (`LayoutVAE.init_from_data`). If False, it starts from random weights, those of DETR in the
            decoder's transformer and those of torch elsewhere, because the paper mentions no other start.
    """

    source: str
    raster_px: int
    model: LayoutVAEConfig
    batch_size: int
    steps: int
    learning_rate: float = 1e-4
    final_learning_rate: float = 1e-5
    weight_decay: float = 5e-4
    warmup_steps: int = 0
    grad_clip: float | None = None
    ema_decay: float | None = None
    kl_weight: float = 1e-6
    latent_noise: float = 0.0
    init_from_data: bool = True

    def architecture(self) -> dict:
        """Return all keyword arguments of `LayoutVAE` except the layout."""
        return {field.name: getattr(self.model, field.name) for field in fields(self.model)}


LOWER_RATE: dict[str, Any] = {"learning_rate": 1e-3}
QUICK: dict[str, Any] = {"learning_rate": 4e-3, "final_learning_rate": 1e-5, "warmup_steps": 50, "grad_clip": 1.0}

# PAPER describes the networks of the paper (supplement B.2). SMALL_CELLS and PAPER_CELLS use the cell decoder for
# objects.
PAPER = LayoutVAEConfig(32, GroundConfig((64, 128, 256, 512), 32), ObjectConfig(512, 6, 8, 1024, 1024))
SMOKE = LayoutVAEConfig(4, GroundConfig((8, 16, 16), 4), ObjectConfig(32, 1, 2, 64, 32))
SMALL_CELLS = ObjectConfig(128, 2, 4, 256, 256, decoder="cells", min_proposals_per_cell=3, loss_unit="cells")
PAPER_CELLS = replace(PAPER.objects, decoder="cells", min_proposals_per_cell=3, loss_unit="cells")
DEMO = LayoutVAEConfig(16, GroundConfig((32, 64), 8, 4, attention=False), SMALL_CELLS, shortcut=True)
TOWN = LayoutVAEConfig(
    16,
    GroundConfig((32, 64), 8, 4, attention=False, level_sets=True),
    replace(SMALL_CELLS, order_in_cell=True),
    shortcut=True,
    local_frame=True,
)
PIXELS = LayoutVAEConfig(32, GroundConfig((32,), 8, 8, attention=False), SMALL_CELLS, shortcut=True)
MINI = LayoutVAEConfig(32, GroundConfig((8, 16, 32, 64), 4), ObjectConfig(128, 3, 4, 256, 256))

# fmt: off
LVAE_PRESETS: dict[str, LVAEPreset] = {
    #                        source      px   model  batch  steps
    "smoke":    LVAEPreset("town",      32,  SMOKE, 4,     8,       learning_rate=1e-3, final_learning_rate=1e-4),
    "demo":     LVAEPreset("town",      128, DEMO,  8,     5_000,   latent_noise=0.3, **QUICK),
    "town":     LVAEPreset("town",      256, TOWN,  8,     20_000,  latent_noise=0.3, **QUICK),
    # A ground with one logit per pixel, for the study of ground networks (docs/experiments/ground_networks.md).
    "town-pixels": LVAEPreset("town",    256, PIXELS, 8,    2_000,   kl_weight=1e-7, **QUICK),
    # The paper reports three days of training on one A100 but not the number of steps.
    "kitti360": LVAEPreset("kitti360",  256, PAPER, 32,    300_000, init_from_data=False),
    "av2":      LVAEPreset("av2",       256, PAPER, 32,    300_000, init_from_data=False),
    # The networks of `kitti360` with fewer layers and less width, for two cores. It starts from the means of the data.
    "kitti360-mini": LVAEPreset("kitti360", 256, MINI, 4, 6_000, learning_rate=5e-4),
    # This preset combines the paper's object encoder with a smaller ground branch and the cell decoder.
    # The latent has the same shape as in the paper, but training costs less.
    "kitti360-light": LVAEPreset("kitti360", 256, replace(PIXELS, objects=PAPER_CELLS), 32, 300_000,
                                 **(QUICK | LOWER_RATE)),
}
# fmt: on


@dataclass(frozen=True)
class DiTConfig:
    """Architecture of a `DiT` without the shape and the statistics of its latents.

    Attributes:
        patch: Side of a patch in latent cells.
        depth: Number of blocks.
        width: Width of the tokens.
        heads: Number of attention heads.
        prediction: Output of the network: "epsilon", as in the paper, or "v_prediction".
        inpainting: Whether the network is trained to continue known parts; the paper's is not.
    """

    patch: int
    depth: int
    width: int
    heads: int
    prediction: str = "epsilon"
    inpainting: bool = False


@dataclass(frozen=True)
class DiTPreset:
    """Architecture and training options of a diffusion transformer.

    Attributes:
        lvae: Name of the preset of the layout VAE.
        model: Architecture.
        batch_size: Samples per step.
        steps: Number of training steps.
        normalise_latents: If True, shift and scale each latent channel to zero mean and unit variance. The paper and
            SLEDGE do not normalise latents.
        learning_rate: Learning rate.
        weight_decay: Weight decay of AdamW.
        grad_clip: Largest gradient norm; None: gradients are not clipped.
        ema_decay: Decay of the exponential moving average of the weights; None: no moving average.
        label_dropout: Probability that a training sample gets the null label. The paper does not specify this
            probability; DiT uses 0.1.
        neighbour_latents: How outpainting with the trained pipeline uses neighbouring blocks by default; "paper": as in
            the paper (jobs/outpaint_scenes.py).
        attach: Whether decoding attaches signs and poles (models/composition/attachments.py). The paper does not do
            this.
        sample_posterior: Whether training latents are drawn from the posteriors of the layout VAE, as in the paper. If
            False, they are the means.
        known_streets_share: Share of training samples that know the ground of all streets, as blocks that follow a
            street plan. The latents must be encoded with streets.
    """

    lvae: str
    model: DiTConfig
    batch_size: int
    steps: int
    normalise_latents: bool = False
    learning_rate: float = 1e-4
    weight_decay: float = 1e-6
    grad_clip: float | None = 1.0
    ema_decay: float | None = 0.9999
    label_dropout: float = 0.1
    neighbour_latents: str = "reencode"
    attach: bool = True
    sample_posterior: bool = True
    known_streets_share: float = 0.0

    def architecture(self) -> dict:
        """Return all keyword arguments of `DiT` except those that depend on the latents."""
        return {field.name: getattr(self.model, field.name) for field in fields(self.model)}


@dataclass(frozen=True)
class StreetPlannerPreset:
    """Architecture and training options of a street planner (models/street_planner.py).

    Attributes:
        widths: Number of channels of each level of the U-Net.
        layers: Number of residual layers per level.
        batch_size: Samples per step.
        steps: Number of training steps.
        num_maps: Number of street maps for training.
        num_test_maps: Number of held-out street maps.
        learning_rate: Learning rate at the start of the decay.
        warmup_steps: Number of initial steps during which the learning rate rises linearly.
        weight_decay: Weight decay of AdamW.
        ema_decay: Decay of the exponential moving average of the weights.
        label_dropout: Probability that a training sample gets the null label.
    """

    widths: tuple[int, ...]
    layers: int
    batch_size: int
    steps: int
    num_maps: int
    num_test_maps: int
    learning_rate: float = 1e-3
    warmup_steps: int = 50
    weight_decay: float = 1e-6
    ema_decay: float = 0.999
    label_dropout: float = 0.1

    def architecture(self) -> dict:
        """Return the keyword arguments of `StreetPlanner` that determine its size."""
        return {"widths": list(self.widths), "layers": self.layers}


SMALL_DIT = DiTConfig(2, 6, 256, 4, prediction="v_prediction")
TOWN_DIT = DiTConfig(2, 8, 288, 6, prediction="v_prediction", inpainting=True)
PAPER_DECODING: dict[str, Any] = {"neighbour_latents": "paper", "attach": False}
QUICK_DIT: dict[str, Any] = {"normalise_latents": True, "learning_rate": 1e-3, "ema_decay": 0.999}

# fmt: off
DIT_PRESETS: dict[str, DiTPreset] = {
    #                         lvae        patch depth width heads batch  steps
    "smoke":       DiTPreset("smoke",    DiTConfig(2, 1, 32, 2),     8,   8, True, 1e-3),
    "demo":        DiTPreset("demo",     SMALL_DIT,                  16,  30_000, **QUICK_DIT),
    "town":        DiTPreset("town",     TOWN_DIT,                   16,  30_000, **QUICK_DIT, sample_posterior=False),
    "kitti360-mini": DiTPreset("kitti360-mini", DiTConfig(2, 4, 128, 4), 16, 3_000, learning_rate=1e-3,
                               ema_decay=0.999, **PAPER_DECODING),
    # The paper reports three days of training on four A100s but not the number of steps. It trains all sizes with the
    # same total compute, here the same number of floating-point operations as the 400,000 steps of DiT-B.
    "kitti360":    DiTPreset("kitti360", DiTConfig(2, 12, 768, 12),  256, 400_000, **PAPER_DECODING),
    "kitti360-l":  DiTPreset("kitti360", DiTConfig(2, 24, 1024, 16), 256, 114_300, **PAPER_DECODING),
    "kitti360-xl": DiTPreset("kitti360", DiTConfig(2, 28, 1152, 16), 256, 77_800, **PAPER_DECODING),
    "av2":         DiTPreset("av2",      DiTConfig(2, 12, 768, 12),  256, 400_000, **PAPER_DECODING),
}
# fmt: on


STREET_PLANNER_PRESETS: dict[str, StreetPlannerPreset] = {
    "smoke": StreetPlannerPreset((32, 32), 1, 4, 8, 4, 4, warmup_steps=0),
    "town": StreetPlannerPreset((64, 128, 192), 1, 16, 5_000, 8_000, 400, 6e-4),
}


def find_preset(table: dict[str, Preset], name: str) -> Preset:
    """Return a preset by name.

    Args:
        table: Presets by name.
        name: Name of the preset.

    Returns:
        The preset.

    Raises:
        ValueError: The name is unknown. The message lists the valid names.
    """
    if name not in table:
        raise ValueError(f"unknown preset {name!r}, expected one of: {', '.join(table)}")
    return table[name]
