#!/usr/bin/env python3
"""Sweep RePaint settings of outpainting and compare the visibility of seams.

    jobs/sweep_seams.py --max-scenes 50                                     50 generated scenes, 200 seams per setting
    jobs/sweep_seams.py --max-scenes 50 --settings 250 10 10 0 1 50 1 1 1 0      two settings of five numbers

A setting is denoising steps, jump length, resamplings, pseudoinverse guidance and eta. The paper's is 250 10 10 0 1: 2,410
network evaluations per block. Writes the scenes (source=generated-<the five numbers>), sweep.json, sweep.parquet and
sweep.html. Run the same command again to resume after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jobs.support.cli import run
from jobs.support.options import GenerationOptions


@dataclass(frozen=True)
class Config(GenerationOptions):
    settings: tuple[tuple[int, int, int, float, float], ...] = (
        (250, 10, 10, 0, 1), (250, 5, 5, 0, 1), (250, 1, 1, 0, 1), (50, 10, 10, 0, 1), (50, 5, 5, 0, 1), (50, 1, 1, 0, 1),
        (50, 1, 1, 1, 1), (50, 1, 1, 1, 0),
    )  # fmt: skip
    """Settings to compare, five numbers each: denoising steps, jump length, resamplings, pseudoinverse guidance and eta, the
    share of DDPM's noise (default: eight settings, from 250 10 10 0 1 to 50 1 1 1 0)."""
    overlap: float = 0.5
    """Overlap of neighbouring blocks, as a share of a block (default: 0.5)."""
    neighbour_latents: Literal["reencode", "copy"] = "reencode"
    """Source of the known latents of a block: its neighbours, re-encoded in the block's frame, or the shifted latents of its
    neighbours (the paper) (default: reencode)."""
    output: str = ""
    """Directory to write to (default: $PRITTI_HOME/evaluations/sweep-seams)."""
    batch_size: int = 4
    """Blocks of a scene per batch; changes blocks only by rounding (default: 4)."""


if __name__ == "__main__":
    run("sweep_seams")
