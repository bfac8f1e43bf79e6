"""Evaluate how well a layout VAE decodes latents with small errors, because sampled latents have such errors.

    python benchmarks/latent_noise.py --lvae DIRECTORY [DIRECTORY ...] --dataset DIRECTORY

The benchmark encodes held-out scenes and adds noise. The unit of the noise level is the standard deviation of each
channel in a scene. The noisy latents are decoded and scored.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import tyro
from common import describe_machine

from models.lvae import LayoutVAE
from models.scene import CATEGORIES, Scene
from models.tensors import decode_layout, make_layout_batch
from pipelines.metrics.validity import (
    LABEL_MEASURES,
    compute_label_fidelity,
    compute_scene_validity,
    compute_validity_rates,
)
from pipelines.schema.dataset import Dataset
from pipelines.schema.scene_subset import SceneSubset
from pipelines.training.latents import load_lvae


@dataclass(frozen=True)
class Config:
    lvae: tuple[str, ...]
    """Directories of trained layout VAEs."""
    dataset: str
    split: str = "test"
    limit: int = 64
    """Scenes, evenly spread."""
    noise: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3)
    """Deviations."""
    seed: int = 0


def decode_with_noise(lvae: LayoutVAE, scenes: list[Scene], noise: float, seed: int) -> list[Scene]:
    """Add noise to the posterior means of scenes, and decode the result.

    The argument `noise` is the noise level, in standard deviations. The decoded scenes have the ids and labels of the
    given scenes.
    """
    generator = torch.Generator().manual_seed(seed)
    made = []
    for scene in scenes:
        latent = lvae.encode(make_layout_batch([scene], lvae.spec)).mean
        deviation = latent.std(dim=(2, 3), keepdim=True)
        latent = latent + noise * deviation * torch.randn(latent.shape, generator=generator)
        made.append(decode_layout(lvae.decode(latent).layouts()[0], lvae.spec, scene))
    return made


def format_counts(scenes: list[Scene], dataset: Dataset) -> str:
    """Format the mean count per category and the validity of the scenes."""
    offset_m = dataset.spec.slab_offset_m
    counts = np.mean([scene.counts() for scene in scenes], axis=0)
    found = compute_validity_rates(np.array([compute_scene_validity(scene, offset_m) for scene in scenes]))
    fidelity = np.array([compute_label_fidelity(scene, dataset.vegetation, dataset.vehicle) for scene in scenes])
    found |= {LABEL_MEASURES[0]: compute_validity_rates(fidelity, LABEL_MEASURES)[LABEL_MEASURES[0]]}
    numbers = [f"{name} {mean:.1f}" for name, mean in zip(CATEGORIES, counts, strict=True) if mean >= 1]
    return ", ".join(numbers + [f"{name} {value:.3f}" for name, value in found.items() if value is not None])


@torch.no_grad()
def main(config: Config) -> None:
    dataset = Dataset.open(config.dataset)
    selection = SceneSubset(dataset.root, dataset.source, config.split, config.limit, "spread")
    scenes = [scene for shard, rows in selection.shards() for scene in shard.scenes(rows)]
    if not scenes:
        raise SystemExit(f"{config.dataset} contains no scenes of split {config.split!r}")
    print(describe_machine(), f"{len(scenes)} scenes")
    print("as they are:", format_counts(scenes, dataset))
    for directory in config.lvae:
        lvae = load_lvae(directory)
        for noise in config.noise:
            print(
                f"{directory}, noise {noise}:",
                format_counts(decode_with_noise(lvae, scenes, noise, config.seed), dataset),
            )


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
