#!/usr/bin/env python3
"""Generate scenes with a trained pipeline.

    jobs/sample_scenes.py                                           64 town scenes, labels in equal parts
    jobs/sample_scenes.py --num-scenes 1000 --labels low --seed 7 --num-actors 2
    jobs/sample_scenes.py --num-scenes 4 --num-glb 4                with GLB files of the first four
    jobs/sample_scenes.py --sampler dpm++ --num-inference-steps 20  eleven times as fast

Writes the same Parquet tables as preprocessing, with source=generated-<run>. Scene i depends only on --seed, i and its
label, regardless of the number of actors and the batch size. Run the same command again to resume after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jobs.support.cli import run
from jobs.support.options import ModelOption


@dataclass(frozen=True)
class Config:
    model: ModelOption = ""
    output: str = ""
    """Dataset directory to write (default: $PRITTI_HOME/generated)."""
    run: str = "samples"
    """Name of the run: scenes get source=generated-<run> (default: samples)."""
    num_scenes: int = 64
    """Number of scenes to generate (default: 64)."""
    labels: tuple[str, ...] = ()
    """Density labels, assigned to the scenes in turn (default: all labels of the model)."""
    seed: int = 0
    """Random seed (default: 0)."""
    sampler: Literal["ddpm", "ddim", "dpm++", "sde-dpm++"] = "ddpm"
    """Sampler: DDPM as in the paper, DDIM, DPM-Solver++, which needs the fewest steps, or its SDE variant, which adds noise
    in every step (default: ddpm)."""
    num_inference_steps: int = 250
    """Denoising steps (default: 250 as in the paper)."""
    guidance_scale: float = 1.0
    """Classifier-free guidance scale: 1 switches guidance off, as for the paper's metrics; the paper's pictures use 4
    (default: 1)."""
    noise_scaling: float | None = None
    """Divisor of the predicted noise. Values a little above 1 recover small and rare objects that sampling loses (default:
    the value that the model was published with; 1 with ddpm)."""
    existence_threshold: float | None = None
    """Probability above which a primitive exists (default: the value that the model was published with; paper: 0.3)."""
    repair: bool = False
    """Put floating and sunken objects onto the ground and push overlapping objects apart; no object is removed. Same as
    jobs/edit_scenes.py repair --no-drop (default: off)."""
    num_actors: int = 1
    """Number of pipelines that run in parallel; use one per GPU (default: 1)."""
    batch_size: int = 8
    """Scenes per batch and pipeline; changes scenes only by rounding (default: 8)."""
    num_glb: int = 0
    """Number of scenes, from the first, to export as GLB to <output>/glb/<run> (default: 0)."""


if __name__ == "__main__":
    run("sample_scenes")
