"""Presets: one row per model size, same code on every rung. `smoke` takes seconds (tests), `demo` and `town` are
what two CPU cores can train in half an hour (layout VAE) and three hours (transformer), `kitti360` and `av2` are the paper (supplement B.2 and B.3)."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LVAEPreset:
    """Architecture and training of a layout VAE. `source` is the dataset it is meant for."""

    source: str
    raster_px: int  # rows = columns of the ground rasters
    latent_channels: int  # per branch
    channels: tuple[int, ...]  # ground branch; all but the last halve the resolution
    norm_groups: int
    fold: int  # pixels that become channels first; 1 in the paper
    width: int
    layers: int
    heads: int
    hidden: int
    head_hidden: int
    batch_size: int
    steps: int
    decoder: str = "detr"  # the paper's, or "cells"
    least_per_cell: int = 1  # proposals of cells, per category
    attention: bool = True  # in the middle of the ground networks
    shortcut: bool = False  # ways past the ground networks and the object encoder; not in the paper
    learning_rate: float = 1e-4
    final_learning_rate: float = 1e-5
    weight_decay: float = 5e-4
    warmup_steps: int = 0
    grad_clip: float | None = None
    ema_decay: float | None = None
    kl_weight: float = 1e-6  # of the sum over the latent
    latent_noise: float = 0.0  # spread of the noise that decoders learn to bear; not in the paper

    def architecture(self) -> dict:
        """Keyword arguments of `LayoutVAE` apart from the layout."""
        training = ("source", "raster_px", "batch_size", "steps", "learning_rate", "final_learning_rate")
        training += ("weight_decay", "warmup_steps", "grad_clip", "ema_decay", "kl_weight", "latent_noise")
        return {name: value for name, value in vars(self).items() if name not in training}


QUICK = {"learning_rate": 4e-3, "final_learning_rate": 1e-5, "warmup_steps": 50, "grad_clip": 1.0}

# fmt: off
LVAE_PRESETS = {
    #                       source      px   c   channels             groups fold width layers heads hidden head batch  steps
    "smoke":    LVAEPreset("town",      32,  4,  (8, 16, 16),         4,     1,   32,   1,     2,    64,    32,  4,     8,
                           learning_rate=1e-3, final_learning_rate=1e-4),
    "demo":     LVAEPreset("town",      128, 16, (32, 64),            8,     4,   128,  2,     4,    256,   256, 8,     5_000,
                           decoder="cells", least_per_cell=3, attention=False, shortcut=True, latent_noise=0.3, **QUICK),
    "town":     LVAEPreset("town",      256, 32, (32,),               8,     8,   128,  2,     4,    256,   256, 8,     2_000,
                           decoder="cells", least_per_cell=3, attention=False, shortcut=True, kl_weight=1e-7, **QUICK),
    # The paper gives three days on one A100, not a number of steps.
    "kitti360": LVAEPreset("kitti360",  256, 32, (64, 128, 256, 512), 32,    1,   512,  6,     8,    1024,  1024, 32,   300_000),
    "av2":      LVAEPreset("av2",       256, 32, (64, 128, 256, 512), 32,    1,   512,  6,     8,    1024,  1024, 32,   300_000),
    # The paper's object encoder with the town's ground branch and cells: the same latent from a fraction of the work.
    "kitti360-light": LVAEPreset("kitti360", 256, 32, (32,),          8,     8,   512,  6,     8,    1024,  1024, 32,   300_000,
                           decoder="cells", least_per_cell=3, attention=False, shortcut=True, **QUICK | {"learning_rate": 1e-3}),
}


@dataclass(frozen=True)
class DiTPreset:
    """Architecture and training of a diffusion transformer on the latents of `lvae`."""

    lvae: str  # the LVAE preset whose latents it models
    patch: int
    depth: int
    width: int
    heads: int
    batch_size: int
    steps: int
    normalise_latents: bool = False  # the paper and SLEDGE use latents as they are
    prediction: str = "noise"  # the paper's, or "velocity"
    learning_rate: float = 1e-4
    weight_decay: float = 1e-6
    grad_clip: float | None = 1.0
    ema_decay: float | None = 0.9999
    label_dropout: float = 0.1  # the paper leaves it open; DiT's value

    def architecture(self) -> dict:
        return {name: getattr(self, name) for name in ("patch", "depth", "width", "heads", "prediction")}


DIT_PRESETS = {
    #                         lvae       patch depth width heads batch steps
    "smoke":       DiTPreset("smoke",    2,    1,    32,   2,    8,    8, normalise_latents=True, learning_rate=1e-3),
    "demo":        DiTPreset("demo",     2,    6,    256,  4,    16,   30_000, normalise_latents=True, learning_rate=1e-3, ema_decay=0.999, prediction="velocity"),
    "town":        DiTPreset("town",     2,    6,    256,  4,    16,   30_000, normalise_latents=True, learning_rate=1e-3, ema_decay=0.999, prediction="velocity"),
    # The paper gives three days on four A100s, not a number of steps.
    "kitti360":    DiTPreset("kitti360", 2,    12,   768,  12,   256,  400_000),
    "kitti360-l":  DiTPreset("kitti360", 2,    24,   1024, 16,   256,  400_000),
    "kitti360-xl": DiTPreset("kitti360", 2,    28,   1152, 16,   256,  400_000),
    "av2":         DiTPreset("av2",      2,    12,   768,  12,   256,  400_000),
}
# fmt: on


def preset(table: dict, name: str):
    """A preset by name; ValueError lists the known ones."""
    if name not in table:
        raise ValueError(f"unknown preset {name!r}, expected one of: {', '.join(table)}")
    return table[name]
