#!/usr/bin/env python3
"""Encode scenes to latents with a trained layout VAE.

    jobs/encode_latents.py                                     the town dataset with the town layout VAE
    jobs/encode_latents.py --dataset DIR --lvae MODEL --num-actors 8

The job writes latents.json and the table latents/. The rows have the same order as in the table scenes/. Run the same
command again to resume after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import run
from jobs.support.options import GpusOption, IfBusyOption, LogFormatOption, WaitForResourcesOption


@dataclass(frozen=True)
class Config:
    dataset: str = ""
    """Dataset directory (default: $PRITTI_HOME/datasets/town)."""
    lvae: str = ""
    """Directory of the trained layout VAE (default: $PRITTI_HOME/models/lvae-town)."""
    output: str = ""
    """Directory to write latents/ and latents.json to (default: the dataset directory)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    num_actors: int = 1
    """Number of models that run in parallel; use one per GPU."""
    gpus: GpusOption = None
    wait_for_resources_s: WaitForResourcesOption = 0.0
    streets: bool = False
    """Encode the streets of each scene without other content, too: the table street_latents, which train_dit.py
    --known-streets-share needs."""
    batch_size: int = 16
    """Scenes per batch."""


if __name__ == "__main__":
    run("encode_latents")
