"""Random Scenes for tests: no structure, every category, any rotation."""

import numpy as np
import torch

from models.dit import DiT
from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.pipeline import PrITTIPipeline, scheduler
from models.presets import LVAE_PRESETS
from models.scene import CATEGORIES, KITTI_GROUND_CLASSES, Grid, Scene, canonical_boxes, yaw_rotation


def random_rotations(rng: np.random.Generator, n: int, tilt_rad: float = np.pi) -> np.ndarray:
    """(n, 3, 3): yaw anywhere, then pitch up to tilt_rad."""
    yaw, pitch = rng.uniform(-np.pi, np.pi, n), rng.uniform(-tilt_rad, tilt_rad, n)
    cos, sin, zero, one = np.cos(pitch), np.sin(pitch), np.zeros(n), np.ones(n)
    tilt = np.stack([np.stack(r, -1) for r in ([cos, zero, sin], [zero, one, zero], [-sin, zero, cos])], -2)
    return yaw_rotation(yaw) @ tilt


def random_scene(seed: int = 0, n: int = 40, grid: Grid | None = None, tilt_rad: float = 0.2, **fields) -> Scene:
    """n primitives of random categories on half planes of ground."""
    rng = np.random.default_rng(seed)
    grid = grid or Grid()
    size = rng.uniform(0.3, 5.0, (n, 3))
    rotation, size = canonical_boxes(random_rotations(rng, n, tilt_rad), size)
    classes = KITTI_GROUND_CLASSES
    angle, offset = rng.uniform(-np.pi, np.pi, (2, len(classes), 1, 1)) * [[[[1]]], [[[5]]]]
    occupied = np.cos(angle) * (grid.x_m()[:, None] - 32) + np.sin(angle) * grid.y_m() > offset  # half planes
    slope = 0.01 * grid.x_m()[:, None] - 0.02 * grid.y_m()[None, :]
    height = np.where(occupied, slope[None] - 0.6 + 0.1 * np.arange(len(classes))[:, None, None], 0)
    defaults = {
        "scene_id": f"test-{seed:04d}",
        "source": "town",
        "sequence": "00000",
        "frame": seed,
        "split": "train",
        "category": rng.integers(0, len(CATEGORIES), n).astype(np.int8),
        "center_m": rng.uniform([0, -32, -2], [64, 32, 6], (n, 3)).astype(np.float32),
        "rotation": rotation.astype(np.float32),
        "size_m": size.astype(np.float32),
        "ground_classes": classes,
        "height_m": height.astype(np.float32),
        "occupied": occupied,
        "grid": grid,
    }
    return Scene(**(defaults | fields))


def small_spec(pixels: int = 32, slots: int = 6) -> LayoutSpec:
    return LayoutSpec(slots=(slots,) * len(CATEGORIES)).with_resolution(pixels)


def tiny_pipeline(spec: LayoutSpec) -> PrITTIPipeline:
    """Random weights: a smoke LVAE and a DiT of one block."""
    torch.manual_seed(0)
    lvae = LayoutVAE(layout=spec.to_dict(), **LVAE_PRESETS["smoke"].architecture())
    channels, size, _ = lvae.latent_shape
    dit = DiT(channels=channels, size=size, width=32, depth=1, heads=2, layout=spec.to_dict())
    for parameter in dit.parameters():
        torch.nn.init.normal_(parameter, std=0.05)
    made = PrITTIPipeline(lvae, dit, scheduler())
    made.set_progress_bar_config(disable=True)
    return made
