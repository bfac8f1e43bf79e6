#!/usr/bin/env python3
"""Train a voxel method with which the paper compares: SemCity, PDD or XCube.

    jobs/train_baseline.py semcity                              all stages of the town preset, one after another
    jobs/train_baseline.py semcity --stage autoencoder          one stage
    jobs/train_baseline.py pdd --preset smoke                   seconds; generates its own data
    jobs/train_baseline.py xcube --preset paper --dataset DIR --num-workers 8

The dataset needs the table voxels: run voxelize_scenes.py first. The stages are autoencoder and diffusion (semcity),
level1, level2 and level3 (pdd), and coarse_vae, fine_vae, coarse_diffusion and fine_diffusion (xcube). The job writes
each network to $PRITTI_HOME/models/<name>/<stage>, and logs losses to MLflow. Run the same command again to resume;
finished stages are skipped.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import tyro

from jobs.support.cli import run
from jobs.support.options import GpusOption, IfBusyOption, LogFormatOption, WaitForResourcesOption


@dataclass(frozen=True)
class Config:
    """Options of a training run; options that are not given have the values of the preset."""

    method: tyro.conf.Positional[Literal["semcity", "pdd", "xcube"]]
    """Method."""
    preset: str = "town"
    """Preset: smoke, town (two CPU cores) or paper; semcity also has paper-400k."""
    stage: str = ""
    """Stage to train (default: all stages)."""
    dataset: str = ""
    """Dataset directory with the table voxels (default: $PRITTI_HOME/datasets/town)."""
    name: str = ""
    """Name of the model; a name is bound to its options (default: <method>-<preset>)."""
    output: str = ""
    """Directory to write the networks to (default: $PRITTI_HOME/models/<name>)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    num_workers: int = 1
    """Number of Ray Train workers; use one per GPU."""
    min_workers: int | None = None
    """Number of workers with which training continues if nodes are lost; it grows again to --num-workers when nodes
    return (default: --num-workers)."""
    gpus: GpusOption = None
    wait_for_resources_s: WaitForResourcesOption = 0.0
    steps: int | None = None
    """Number of training steps of each stage (default: as in the preset)."""
    batch_size: int | None = None
    """Global batch size over all workers (default: as in the preset)."""
    learning_rate: float | None = None
    """Peak learning rate (default: as in the preset)."""
    gradient_accumulation_steps: int = 1
    """Divide each worker's batch into this number of parts, which are processed in sequence to save memory."""
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    """Floating-point precision; auto is bf16 on GPUs that support it, else fp32."""
    checkpoint_every: int | None = None
    """Number of steps between checkpoints (default: a twentieth of the run, at least four steps)."""
    round_weights: bool = False
    """Round the weights of the result to float16, so its files need half the space."""
    seed: int = 0
    """Random seed."""


if __name__ == "__main__":
    run("train_baseline")
