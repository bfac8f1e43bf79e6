#!/usr/bin/env python3
"""Compare samplers, numbers of steps and guidance scales against the same real scenes.

    jobs/sweep_samplers.py                                             256 town scenes each, 10 to 250 steps
    jobs/sweep_samplers.py --samplers ddpm dpm++ --num-inference-steps 10 250 --num-scenes 64
    jobs/sweep_samplers.py --samplers dpm++ --num-inference-steps 20 --noise-scalings 1 1.005 1.01      for a new model
    jobs/sweep_samplers.py --samplers dpm++ --num-inference-steps 20 --guidance-scale 1 2 4    labels and diversity

The last two rows are other real scenes (the ceiling) and a damaged copy of them (the control), scored in the same way.

The job writes the scenes (source=generated-<setting>), samplers.json, samplers.parquet, figures (SVG) and
samplers.html. Run the same command again to resume after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import run
from jobs.support.options import (
    ConstraintsOption,
    GpusOption,
    IfBusyOption,
    LogFormatOption,
    ModelOption,
    PagScaleOption,
    WaitForResourcesOption,
)


@dataclass(frozen=True)
class Config:
    model: ModelOption = ""
    real: str = ""
    """Dataset directory of the real scenes (default: $PRITTI_HOME/datasets/town)."""
    real_split: str = "test"
    """Split of the real scenes."""
    ceiling_split: str = ""
    """Split of the other real scenes, the ceiling (default: test for the real split train, otherwise train)."""
    samplers: tuple[str, ...] = ("ddpm", "ddim", "dpm++")
    """Samplers to compare: ddpm, ddim, dpm++ or sde-dpm++."""
    num_inference_steps: tuple[int, ...] = (10, 20, 50, 100, 250)
    """Numbers of denoising steps to compare."""
    noise_scalings: tuple[float, ...] = ()
    """Divisors of the predicted noise to compare (default: published value; 1 with ddpm)."""
    num_scenes: int = 256
    """Number of generated scenes per setting, which is also the number of real scenes."""
    seed: int = 0
    """Random seed."""
    guidance_scale: tuple[float, ...] = (1.0,)
    """Classifier-free guidance scales to compare; 1 switches guidance off."""
    pag_scale: PagScaleOption = None
    constraints: ConstraintsOption = None
    batch_size: int = 8
    """Number of scenes per batch and pipeline; the batch size changes scenes only by rounding, except in
    rare cases with --constraints."""
    num_examples: int = 4
    """Number of scenes per setting that the page shows."""
    output: str = ""
    """Directory to write to (default: $PRITTI_HOME/evaluations/samplers)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    num_actors: int = 1
    """Number of pipelines that run in parallel; use one per GPU."""
    gpus: GpusOption = None
    wait_for_resources_s: WaitForResourcesOption = 0.0


if __name__ == "__main__":
    run("sweep_samplers")
