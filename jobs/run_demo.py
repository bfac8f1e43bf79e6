#!/usr/bin/env python3
"""Run the whole pipeline on the built-in town and write report.html.

    jobs/run_demo.py                        15 minutes on two cores, all files under runs/demo
    jobs/run_demo.py --lvae-steps 20000 --dit-steps 50000 --output DIR       longer training, better scenes

The demo first generates scenes with the released model. Then it preprocesses the town, trains the layout VAE, encodes
latents and trains the diffusion transformer. Finally, it samples scenes, outpaints a scene and evaluates the results.
The demo needs no data, no GPU and no network. Run the same command again to resume after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import run


@dataclass(frozen=True)
class Config:
    output: str = "runs/demo"
    """Directory to write all files to: data, runs, models, MLflow, report.html."""
    preset: str = "demo"
    """Model preset; with smoke, the demo takes two minutes."""
    num_train: int = 1200
    """Number of training scenes of the town."""
    num_test: int = 200
    """Number of test scenes of the town."""
    lvae_steps: int = 500
    """Number of training steps of the layout VAE."""
    lvae_batch_size: int = 8
    """Batch size of the layout VAE."""
    dit_steps: int = 1700
    """Number of training steps of the diffusion transformer."""
    dit_batch_size: int = 8
    """Batch size of the diffusion transformer; small batches with many steps give recognisable scenes sooner."""
    num_released_scenes: int = 12
    """Number of scenes to generate with the released model before training."""
    num_scenes: int = 48
    """Number of scenes to generate with the trained model."""
    num_inference_steps: int = 100
    """Number of denoising steps for sampling (paper: 250)."""
    outpaint_inference_steps: int = 50
    """Number of denoising steps of outpainting with --inpainting guided (paper: 250, each repeated ten times)."""
    num_actors: int = 2
    """Number of models that run in parallel during encoding, sampling and evaluation."""
    seed: int = 0
    """Random seed."""


if __name__ == "__main__":
    run("run_demo")
