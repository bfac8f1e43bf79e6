#!/usr/bin/env python3
"""Run the ablation studies of the layout VAE (stage 1).

    jobs/ablate_lvae.py encoding            Cholesky, quaternion and octahedral encodings, on synthetic boxes
    jobs/ablate_lvae.py branches            without latent split, objects or ground, on $PRITTI_HOME/datasets/town
    jobs/ablate_lvae.py decoders            the cell decoder and the paper's DETR decoder, at equal time
    jobs/ablate_lvae.py ground              sizes of the ground branch, at equal time
    jobs/ablate_lvae.py augmentation        mirrored scenes and moved vehicles
    jobs/ablate_lvae.py branches --dataset DIR --minutes 60 --num-seeds 5

Each study writes a table (text, JSON, Parquet), figures (SVG) and a page (HTML); scores also go to MLflow. Run the
same command again to resume: finished trials are kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from jobs.support.cli import run


@dataclass(frozen=True)
class Encoding:
    """Measure how well a small object autoencoder reconstructs boxes in each encoding."""

    train_sizes: tuple[int, ...] = (1200, 2500, 5000, 10_000)
    """Training set sizes with the paper's boxes, vehicles; the sets of a seed are nested."""
    any_footprint_train_sizes: tuple[int, ...] = (5000,)
    """Training set sizes with boxes of any footprint, including square ones, whose scatter matrix has no yaw."""
    yaw_only_train_sizes: tuple[int, ...] = (1200, 2500)
    """Training set sizes with vehicles of which only the numbers that depend on yaw are regressed."""
    num_seeds: int = 5
    """Number of seeds."""
    epochs: int = 20
    """Training epochs."""
    batch_size: int = 32
    """Batch size."""
    learning_rate: float = 5e-4
    """Learning rate."""
    num_test_boxes: int = 2000
    """Number of boxes of the shared test set."""
    num_noisy_boxes: int = 1000
    """Number of boxes per footprint and noise level in the table of yaw errors."""
    max_concurrent_trials: int | None = None
    """Maximum number of concurrent trials (default: one per CPU)."""
    output: str = ""
    """Directory to write to (default: $PRITTI_HOME/ablations/encoding)."""


@dataclass(frozen=True)
class Branches:
    """Train the layout VAE whole, without latent split, without objects and without ground, for equally many steps."""

    preset: tyro.conf.Positional[str] = "town"
    """Preset: smoke, demo, town, kitti360, kitti360-light or av2."""
    dataset: str = ""
    """Dataset directory (default: $PRITTI_HOME/datasets/<the preset's source>)."""
    minutes: float = 10.0
    """Training time in minutes, converted to steps by one measurement (one per variant in equal-time studies)."""
    steps: int | None = None
    """Training steps; replaces --minutes (default: from --minutes)."""
    num_seeds: int = 3
    """Number of seeds; every variant is trained with seed 0, then every variant with seed 1, and so on."""
    only_variants: tuple[str, ...] = ()
    """Train and report only these variants, by name; others can be added later (default: all)."""
    batch_size: int | None = None
    """Global batch size over all workers (default: as in the preset)."""
    num_workers: int = 1
    """Number of Ray Train workers; use one per GPU."""
    max_scenes: int | None = None
    """Maximum number of held-out scenes to evaluate, evenly over the split (default: all)."""
    num_checkpoints: int = 4
    """Number of checkpoints and validations per training, the points of the curves."""
    name: str = "branches"
    """Name of the study and of its runs."""
    output: str = ""
    """Directory to write to (default: $PRITTI_HOME/ablations/<name>)."""


@dataclass(frozen=True)
class Decoders(Branches):
    """Compare the cell decoder with the paper's DETR decoder, with and without shortcuts, at equal time."""

    preset: tyro.conf.Positional[str] = "demo"
    """Preset: smoke, demo, town, kitti360, kitti360-light or av2."""
    num_checkpoints: int = 12
    """Number of checkpoints and validations per training, the points of the curves."""
    name: str = "decoders"
    """Name of the study and of its runs."""


@dataclass(frozen=True)
class Ground(Branches):
    """Train the ground branch alone, from the paper's networks down to a hundredth of them, at equal time."""

    num_checkpoints: int = 8
    """Number of checkpoints and validations per training, the points of the curves."""
    name: str = "ground"
    """Name of the study and of its runs."""


@dataclass(frozen=True)
class Augmentation(Branches):
    """Train with mirrored scenes, moved vehicles, or both, for equally many steps; matters most for few scenes."""

    name: str = "augmentation"
    """Name of the study and of its runs."""


Config = (
    Annotated[Encoding, tyro.conf.subcommand("encoding")]
    | Annotated[Branches, tyro.conf.subcommand("branches")]
    | Annotated[Decoders, tyro.conf.subcommand("decoders")]
    | Annotated[Ground, tyro.conf.subcommand("ground")]
    | Annotated[Augmentation, tyro.conf.subcommand("augmentation")]
)


if __name__ == "__main__":
    run("ablate_lvae")
