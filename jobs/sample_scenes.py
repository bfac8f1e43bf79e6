#!/usr/bin/env python3
"""Generate scenes with a trained pipeline.

    jobs/sample_scenes.py                                           64 town scenes, labels in equal parts
    jobs/sample_scenes.py --num-scenes 1000 --labels low-any --seed 7 --num-actors 2
    jobs/sample_scenes.py --num-scenes 4 --num-glb 4                with GLB files of the first four
    jobs/sample_scenes.py --sampler ddpm                            the paper's sampler with 250 steps

The job writes the same Parquet tables as preprocessing, with source=generated-<run>. Scene i depends only on --seed, i
and its label. The number of actors and the batch size have no effect. Run the same command again to resume after an
interruption.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

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
    output: str = ""
    """Dataset directory to write (default: $PRITTI_HOME/generated)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    run: str = "samples"
    """Name of the run: scenes get source=generated-<run>."""
    num_scenes: int = 64
    """Number of scenes to generate."""
    labels: tuple[str, ...] = ()
    """Density labels, assigned to the scenes in turn. For the town, low-medium means low density of vegetation and
    medium density of vehicles; see the glossary (default: all labels that specify each density)."""
    seed: int = 0
    """Random seed."""
    sampler: Literal["ddpm", "ddim", "dpm++", "sde-dpm++"] | None = None
    """Sampler: DDPM (the paper), DDIM, DPM-Solver++, or the SDE variant of DPM-Solver++ (default: published value,
    ddpm for models of train_dit.py)."""
    num_inference_steps: int | None = None
    """Number of denoising steps (default: published value; with another --sampler, 250 for ddpm and ddim and 20 for
    the others)."""
    guidance_scale: float = 1.0
    """Classifier-free guidance scale; 1 switches guidance off. Paper: 1 for the metrics, 4 for the pictures."""
    noise_scaling: float | None = None
    """Divisor of the predicted noise; values above 1 preserve small objects (default: published value; 1 with ddpm)."""
    existence_threshold: float | None = None
    """Keep primitives with a higher existence probability (default: published value; paper: 0.3)."""
    pag_scale: PagScaleOption = None
    constraints: ConstraintsOption = None
    repair: bool = False
    """Repair floating, sunken and overlapping objects, as jobs/edit_scenes.py repair --no-drop does."""
    num_actors: int = 1
    """Number of pipelines that run in parallel; use one per GPU."""
    gpus: GpusOption = None
    wait_for_resources_s: WaitForResourcesOption = 0.0
    batch_size: int = 8
    """Number of scenes per batch and pipeline; the batch size changes scenes only by rounding, except in
    rare cases with --constraints."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """Precision of the transformer. bf16 is faster on GPUs and changes scenes by rounding."""
    cuda_graphs: bool = False
    """Replay each denoising step as one CUDA graph; faster for small batches, and ignored without a GPU."""
    compile: bool = False
    """Compile the transformer's block with torch.compile, which takes some seconds; useful on GPUs."""
    decode_batch_size: int = 1
    """Number of latents decoded together; more than 1 is faster on GPUs and changes scenes by rounding."""
    num_glb: int = 0
    """Number of scenes, from the first, to export as GLB to <output>/glb/<run>."""


if __name__ == "__main__":
    run("sample_scenes")
