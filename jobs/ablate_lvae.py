#!/usr/bin/env python3
"""Run the ablation studies of the layout VAE (stage 1).

    jobs/ablate_lvae.py encoding            Cholesky, quaternion and octahedral encodings, on synthetic boxes
    jobs/ablate_lvae.py branches            without latent split, objects or ground, on $PRITTI_HOME/datasets/town
    jobs/ablate_lvae.py decoders            the cell decoder and the paper's DETR decoder, at equal time
    jobs/ablate_lvae.py detr --dataset DIR  changes of the DETR decoder or its training, at equal time
    jobs/ablate_lvae.py ground              sizes of the ground branch, at equal time
    jobs/ablate_lvae.py augmentation        mirrored scenes and moved vehicles
    jobs/ablate_lvae.py branches --dataset DIR --minutes 60 --num-seeds 5

Each study writes a table (text, JSON, Parquet), figures (SVG) and a page (HTML). Each study also logs its scores to
MLflow. Run the same command again to resume; finished trials are kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from jobs.support.cli import run
from jobs.support.options import GpusOption, IfBusyOption, LogFormatOption, WaitForResourcesOption


@dataclass(frozen=True)
class Encoding:
    """Measure how well a small object autoencoder reconstructs boxes in each encoding."""

    train_sizes: tuple[int, ...] = (1200, 2500, 5000, 10_000)
    """Training set sizes for vehicle boxes, as in the paper; with the same seed, larger sets contain smaller ones."""
    any_footprint_train_sizes: tuple[int, ...] = (5000,)
    """Training set sizes for boxes of any footprint; for square ones, the scatter matrix does not determine the yaw."""
    yaw_only_train_sizes: tuple[int, ...] = (1200, 2500)
    """Training set sizes for vehicle boxes; here the network regresses only the code entries that depend on yaw."""
    num_seeds: int = 5
    """Number of seeds."""
    epochs: int = 20
    """Training epochs."""
    batch_size: int = 32
    """Batch size."""
    learning_rate: float = 5e-4
    """Learning rate."""
    num_test_boxes: int = 2000
    """Number of test boxes; all trials use the same ones."""
    num_noisy_boxes: int = 1000
    """Number of boxes per footprint and noise level in the table of yaw errors."""
    max_concurrent_trials: int | None = None
    """Maximum number of concurrent trials (default: one per CPU)."""
    output: str = ""
    """Directory to write to (default: $PRITTI_HOME/ablations/encoding)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"


@dataclass(frozen=True)
class Branches:
    """Compare the layout VAE with variants that lack the latent split, the object branch or the ground branch.

    All variants train for the same number of steps.
    """

    preset: tyro.conf.Positional[str] = "town"
    """Preset: smoke, demo, town, town-pixels, kitti360, kitti360-mini, kitti360-light or av2."""
    dataset: str = ""
    """Dataset directory (default: $PRITTI_HOME/datasets/<the preset's source>)."""
    minutes: float = 10.0
    """Training time in minutes; a speed measurement converts it to steps (per variant in equal-time studies)."""
    steps: int | None = None
    """Number of training steps; this option replaces --minutes (default: computed from --minutes)."""
    num_seeds: int = 3
    """Number of seeds; every variant is trained with seed 0, then every variant with seed 1, and so on."""
    only_variants: tuple[str, ...] = ()
    """Train and report only the variants with these names; a later run can add other variants (default: all)."""
    batch_size: int | None = None
    """Global batch size over all workers (default: as in the preset)."""
    num_workers: int = 1
    """Number of Ray Train workers; use one per GPU."""
    gpus: GpusOption = None
    wait_for_resources_s: WaitForResourcesOption = 0.0
    max_scenes: int | None = None
    """Maximum number of held-out scenes to evaluate, selected evenly from the split (default: all)."""
    num_checkpoints: int = 4
    """Number of checkpoints per training run; the validation at each checkpoint gives one point of a curve."""
    name: str = "branches"
    """Name of the study and of its runs."""
    output: str = ""
    """Directory to write to (default: $PRITTI_HOME/ablations/<name>)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"


@dataclass(frozen=True)
class Decoders(Branches):
    """Compare the cell decoder with the paper's DETR decoder, with and without shortcuts, for equal training time."""

    preset: tyro.conf.Positional[str] = "demo"
    """Preset: smoke, demo, town, town-pixels, kitti360, kitti360-mini, kitti360-light or av2."""
    num_checkpoints: int = 12
    """Number of checkpoints per training run; the validation at each checkpoint gives one point of a curve."""
    name: str = "decoders"
    """Name of the study and of its runs."""


@dataclass(frozen=True)
class Detr(Branches):
    """Compare changes of the DETR decoder or its training, without the ground branch, for equal time.

    Each change is made alone. The variant `combined` has losses in metres, positions per cell, conditional attention
    and auxiliary losses. Each variant `combined, X` differs from it in one change. --minutes is converted to a number
    of steps, so the times of variants differ slightly.
    """

    preset: tyro.conf.Positional[str] = "kitti360-mini"
    """Preset with a DETR decoder: smoke, kitti360, kitti360-mini or av2."""
    minutes: float = 20.0
    """Training time in minutes; a speed measurement converts it to steps per variant."""
    num_seeds: int = 1
    """Number of seeds; every variant is trained with seed 0, then every variant with seed 1, and so on."""
    name: str = "detr"
    """Name of the study and of its runs."""


@dataclass(frozen=True)
class Ground(Branches):
    """Compare sizes of the ground branch, from 1/100 of the paper's size to the full size, for equal training time."""

    preset: tyro.conf.Positional[str] = "town-pixels"
    """Preset: smoke, demo, town, town-pixels, kitti360, kitti360-mini, kitti360-light or av2."""
    num_checkpoints: int = 8
    """Number of checkpoints per training run; the validation at each checkpoint gives one point of a curve."""
    name: str = "ground"
    """Name of the study and of its runs."""


@dataclass(frozen=True)
class Augmentation(Branches):
    """Compare augmentations (none, mirrored scenes, moved vehicles, both) for the same number of training steps."""

    name: str = "augmentation"
    """Name of the study and of its runs."""


Config = (
    Annotated[Encoding, tyro.conf.subcommand("encoding")]
    | Annotated[Branches, tyro.conf.subcommand("branches")]
    | Annotated[Decoders, tyro.conf.subcommand("decoders")]
    | Annotated[Detr, tyro.conf.subcommand("detr")]
    | Annotated[Ground, tyro.conf.subcommand("ground")]
    | Annotated[Augmentation, tyro.conf.subcommand("augmentation")]
)


if __name__ == "__main__":
    run("ablate_lvae")
