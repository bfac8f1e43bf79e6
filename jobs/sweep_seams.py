#!/usr/bin/env python3
"""Compare settings of outpainting by the visibility of seams.

    jobs/sweep_seams.py --max-scenes 50                                     50 generated scenes, 200 seams per setting
    jobs/sweep_seams.py --max-scenes 50 --settings 250 10 10 0 1 50 1 1 1 0      two settings of five numbers
    jobs/sweep_seams.py --max-scenes 50 --settings 50 1 1 1 0.3 --trained-steps 20     against a trained network

A setting of RePaint has five numbers: denoising steps, jump length, resamplings, weight of pseudoinverse guidance, and
eta (share of DDPM's noise). The paper's is 250 10 10 0 1, which needs 2,410 network evaluations per block. The last two
rows are lines across the street in real scenes (the ceiling) and joined halves of unrelated real scenes (the control).

The job writes the scenes (source=generated-<the five numbers> or generated-trained-<steps>), sweep.json, sweep.parquet
and sweep.html. Run the same command again to resume after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jobs.support.cli import run
from jobs.support.options import GenerationOptions, IfBusyOption, LogFormatOption


@dataclass(frozen=True)
class Config(GenerationOptions):
    settings: tuple[tuple[int, int, int, float, float], ...] = (
        (250, 10, 10, 0, 1), (250, 5, 5, 0, 1), (250, 1, 1, 0, 1), (50, 10, 10, 0, 1), (50, 5, 5, 0, 1),
        (50, 1, 1, 0, 1), (50, 1, 1, 1, 1), (50, 1, 1, 1, 0),
    )  # fmt: skip
    """Settings of RePaint: steps, jump length, resamplings, weight of pseudoinverse guidance, eta."""
    trained_steps: tuple[int, ...] = ()
    """Numbers of denoising steps without RePaint, for a model of train_dit.py --inpainting (default: none)."""
    overlap: float = 0.5
    """Overlap of neighbouring blocks, as a share of the block size."""
    neighbour_latents: tuple[Literal["reencode", "copy", "paper"], ...] = ("reencode",)
    """How a block uses its neighbours (see outpaint_scenes.py); every setting is measured in each of these ways."""
    real: str = ""
    """Dataset directory of the real scenes (default: $PRITTI_HOME/datasets/town)."""
    real_split: str = "test"
    """Split of the real scenes."""
    real_rows_m: tuple[float, ...] = (16.0, 32.0, 48.0)
    """Lines across the street in real scenes, as distances from the far edge of a scene in metres."""
    max_real_scenes: int | None = 240
    """Maximum number of real scenes, selected evenly."""
    output: str = ""
    """Directory to write to (default: $PRITTI_HOME/evaluations/sweep-seams)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    batch_size: int = 4
    """Number of blocks of a scene per batch; the batch size changes the result only by rounding."""


if __name__ == "__main__":
    run("sweep_seams")
