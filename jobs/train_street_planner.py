#!/usr/bin/env python3
"""Train the network that plans the streets of large scenes.

    jobs/train_street_planner.py                     the town preset, for the released weights
    jobs/train_street_planner.py smoke               seconds
    jobs/train_street_planner.py --model DIR --output DIR

The job first makes street maps of procedural towns: the table street_maps. It then trains the network, and writes a
copy of --model that plans streets: outpaint_scenes.py uses the plan for scenes beyond one block on each side. The job
logs losses and sampled plans to MLflow. Run the same command again to resume.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import tyro

from jobs.support.cli import run
from jobs.support.options import GpusOption, IfBusyOption, LogFormatOption, WaitForResourcesOption


@dataclass(frozen=True)
class Config:
    """Options of a training run; options that are not given have the values of the preset (models/presets.py)."""

    preset: tyro.conf.Positional[str] = "town"
    """Preset: smoke or town."""
    model: str = ""
    """Pipeline that gets the network; all values that --model of other jobs accepts are valid (default: like
    sample_scenes.py)."""
    dataset: str = ""
    """Directory of the table street_maps (default: $PRITTI_HOME/datasets/streets, or streets-smoke)."""
    name: str = ""
    """Name of the run; a run name is bound to its options (default: streets-<preset>)."""
    output: str = ""
    """Directory to write the pipeline to (default: $PRITTI_HOME/models/pritti-<name>)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    num_workers: int = 1
    """Number of Ray Train workers; use one per GPU."""
    min_workers: int | None = None
    """Number of workers with which training continues if nodes are lost; it grows again to --num-workers when nodes
    return (default: --num-workers)."""
    gpus: GpusOption = None
    wait_for_resources_s: WaitForResourcesOption = 0.0
    num_maps: int | None = None
    """Number of street maps for training (default: as in the preset)."""
    start_from: str = ""
    """Initialise with the street planner of this pipeline (default: random weights)."""
    steps: int | None = None
    """Number of training steps (default: as in the preset)."""
    batch_size: int | None = None
    """Global batch size over all workers (default: as in the preset)."""
    learning_rate: float | None = None
    """Peak learning rate (default: as in the preset)."""
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    """Floating-point precision; auto is bf16 on GPUs that support it, else fp32. On CPUs with AVX-512 BF16, bf16 halves
    the time."""
    checkpoint_every: int | None = None
    """Number of steps between checkpoints (default: a twentieth of the run, at least four steps)."""
    round_weights: bool = False
    """Round the weights of the result to float16, so its files need half the space."""
    seed: int = 0
    """Random seed of the training. The street maps do not depend on it."""


if __name__ == "__main__":
    run("train_street_planner")
