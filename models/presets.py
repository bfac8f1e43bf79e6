"""Presets: one row per model size, the same code for all of them.

`smoke` takes seconds (tests); `demo` and `town` train on two CPU cores in half an hour (layout VAE) and three hours
(transformer); `kitti360` and `av2` are the paper's (supplement B.2 and B.3).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

from models.vae.config import GroundConfig, LayoutVAEConfig, ObjectConfig

Preset = TypeVar("Preset")


@dataclass(frozen=True)
class LVAEPreset:
    """Architecture and training of a layout VAE. `source` is the dataset it is meant for."""

    source: str
    raster_px: int  # rows = columns of the ground rasters
    model: LayoutVAEConfig
    batch_size: int
    steps: int
    learning_rate: float = 1e-4
    final_learning_rate: float = 1e-5
    weight_decay: float = 5e-4
    warmup_steps: int = 0
    grad_clip: float | None = None
    ema_decay: float | None = None
    kl_weight: float = 1e-6  # of the sum over the latent
    latent_noise: float = 0.0  # standard deviation of the noise that decoders learn to tolerate; not in the paper

    def architecture(self) -> dict:
        """Keyword arguments of `LayoutVAE` apart from the layout."""
        return {field.name: getattr(self.model, field.name) for field in fields(self.model)}


LOWER_RATE: dict[str, Any] = {"learning_rate": 1e-3}
QUICK: dict[str, Any] = {"learning_rate": 4e-3, "final_learning_rate": 1e-5, "warmup_steps": 50, "grad_clip": 1.0}

# The paper's networks (supplement B.2), and small ones that read primitives off latent cells.
PAPER = LayoutVAEConfig(32, GroundConfig((64, 128, 256, 512), 32), ObjectConfig(512, 6, 8, 1024, 1024))
SMOKE = LayoutVAEConfig(4, GroundConfig((8, 16, 16), 4), ObjectConfig(32, 1, 2, 64, 32))
SMALL_CELLS = ObjectConfig(128, 2, 4, 256, 256, decoder="cells", min_proposals_per_cell=3)
PAPER_CELLS = replace(PAPER.objects, decoder="cells", min_proposals_per_cell=3)
DEMO = LayoutVAEConfig(16, GroundConfig((32, 64), 8, 4, attention=False), SMALL_CELLS, shortcut=True)
TOWN = LayoutVAEConfig(32, GroundConfig((32,), 8, 8, attention=False), SMALL_CELLS, shortcut=True)

# fmt: off
LVAE_PRESETS: dict[str, LVAEPreset] = {
    #                        source      px   model  batch  steps
    "smoke":    LVAEPreset("town",      32,  SMOKE, 4,     8,       learning_rate=1e-3, final_learning_rate=1e-4),
    "demo":     LVAEPreset("town",      128, DEMO,  8,     5_000,   latent_noise=0.3, **QUICK),
    "town":     LVAEPreset("town",      256, TOWN,  8,     2_000,   kl_weight=1e-7, **QUICK),
    # The paper gives three days on one A100, not a number of steps.
    "kitti360": LVAEPreset("kitti360",  256, PAPER, 32,    300_000),
    "av2":      LVAEPreset("av2",       256, PAPER, 32,    300_000),
    # The paper's object encoder with the town's ground branch and cells: the same latent at a fraction of the cost.
    "kitti360-light": LVAEPreset("kitti360", 256, replace(TOWN, objects=PAPER_CELLS), 32, 300_000,
                                 **(QUICK | LOWER_RATE)),
}
# fmt: on


@dataclass(frozen=True)
class DiTConfig:
    """Architecture of a `DiT` apart from the shape and the statistics of its latents."""

    patch: int
    depth: int
    width: int
    heads: int
    prediction: str = "epsilon"  # the paper's, or "v_prediction"


@dataclass(frozen=True)
class DiTPreset:
    """Architecture and training of a diffusion transformer on the latents of the LVAE preset `lvae`."""

    lvae: str
    model: DiTConfig
    batch_size: int
    steps: int
    normalise_latents: bool = False  # the paper and SLEDGE use latents as they are
    learning_rate: float = 1e-4
    weight_decay: float = 1e-6
    grad_clip: float | None = 1.0
    ema_decay: float | None = 0.9999
    label_dropout: float = 0.1  # the paper leaves it open; DiT's value

    def architecture(self) -> dict:
        """Keyword arguments of `DiT` apart from those that follow from its latents."""
        return {field.name: getattr(self.model, field.name) for field in fields(self.model)}


SMALL_DIT = DiTConfig(2, 6, 256, 4, prediction="v_prediction")
TOWN_TRAINING: dict[str, Any] = {"normalise_latents": True, "learning_rate": 1e-3, "ema_decay": 0.999}

# fmt: off
DIT_PRESETS: dict[str, DiTPreset] = {
    #                         lvae        patch depth width heads batch  steps
    "smoke":       DiTPreset("smoke",    DiTConfig(2, 1, 32, 2),     8,   8, True, 1e-3),
    "demo":        DiTPreset("demo",     SMALL_DIT,                  16,  30_000, **TOWN_TRAINING),
    "town":        DiTPreset("town",     SMALL_DIT,                  16,  30_000, **TOWN_TRAINING),
    # The paper gives three days on four A100s, not a number of steps.
    "kitti360":    DiTPreset("kitti360", DiTConfig(2, 12, 768, 12),  256, 400_000),
    "kitti360-l":  DiTPreset("kitti360", DiTConfig(2, 24, 1024, 16), 256, 400_000),
    "kitti360-xl": DiTPreset("kitti360", DiTConfig(2, 28, 1152, 16), 256, 400_000),
    "av2":         DiTPreset("av2",      DiTConfig(2, 12, 768, 12),  256, 400_000),
}
# fmt: on


def find_preset(table: dict[str, Preset], name: str) -> Preset:
    """A preset by name.

    Raises:
        ValueError: The name is unknown; the message lists the known ones.
    """
    if name not in table:
        raise ValueError(f"unknown preset {name!r}, expected one of: {', '.join(table)}")
    return table[name]
