#!/usr/bin/env python3
"""Sweep RePaint settings of outpainting and compare the visibility of seams.

    jobs/sweep_seams.py --max-scenes 50                                     50 generated scenes, 200 seams per setting
    jobs/sweep_seams.py --max-scenes 50 --settings 250 10 10 0 1 50 1 1 1 0      two settings of five numbers

A setting is denoising steps, jump length, resamplings, pseudoinverse guidance and eta, the share of DDPM's noise. The
paper's is 250 10 10 0 1: 2,410 network evaluations per block. Writes the scenes (source=generated-<the five
numbers>), sweep.json, sweep.parquet and sweep.html. Run the same command again to resume after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jobs.support.cli import run
from jobs.support.options import GenerationOptions


@dataclass(frozen=True)
class Config(GenerationOptions):
    settings: tuple[tuple[int, int, int, float, float], ...] = (
        (250, 10, 10, 0, 1), (250, 5, 5, 0, 1), (250, 1, 1, 0, 1), (50, 10, 10, 0, 1), (50, 5, 5, 0, 1),
        (50, 1, 1, 0, 1), (50, 1, 1, 1, 1), (50, 1, 1, 1, 0),
    )  # fmt: skip
    """Settings, five numbers each: steps, jump length, resamplings, pseudoinverse guidance, eta."""
    overlap: float = 0.5
    """Overlap of neighbouring blocks, as a share of a block."""
    neighbour_latents: Literal["reencode", "copy"] = "reencode"
    """Known latents of a block: its neighbours re-encoded in its frame, or their shifted latents (the paper)."""
    output: str = ""
    """Directory to write to (default: $PRITTI_HOME/evaluations/sweep-seams)."""
    batch_size: int = 4
    """Blocks of a scene per batch; changes blocks only by rounding."""


if __name__ == "__main__":
    run("sweep_seams")
