#!/usr/bin/env python3
"""Paint street views as photographs with Stable Diffusion and a ControlNet.

    jobs/paint_streets.py --streets DIR/streets/drive --diffusion SD_DIR --controlnet CONTROLNET_DIR
    jobs/paint_streets.py ... --prompt "a quiet street in autumn, photograph" --num-inference-steps 30 --num-actors 2

Both models are local directories in diffusers' layout with safetensors files. The job downloads nothing. The job needs
the package transformers (pip install 'pritti-on-ray[photos]') and, in practice, a GPU. For each drive, the job writes
photo/, photos.png and photos.webp next to the rendered images. Existing frames are kept.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import run
from jobs.support.options import GpusOption, IfBusyOption, LogFormatOption, WaitForResourcesOption


@dataclass(frozen=True)
class Config:
    streets: str = ""
    """Directory of street views that jobs/render_streets.py wrote (default: $PRITTI_HOME/generated/streets/drive)."""
    diffusion: str = ""
    """Directory of a Stable Diffusion pipeline, 1.x or 2.x (required)."""
    controlnet: str = ""
    """Directory of a ControlNet trained on semantic images in the KITTI-360 or Cityscapes palette (required)."""
    prompt: str = "a photograph of a residential street, daylight"
    """Text prompt."""
    negative_prompt: str = ""
    """Negative text prompt (default: none)."""
    num_inference_steps: int = 30
    """Denoising steps."""
    guidance_scale: float = 7.5
    """Classifier-free guidance scale; 1 switches guidance off."""
    controlnet_conditioning_scale: float = 1.0
    """Weight of the semantic image."""
    seed: int = 0
    """Random seed of the noise, which is the same for every frame."""
    num_actors: int = 1
    """Number of pipelines that run in parallel; use one per GPU."""
    gpus: GpusOption = None
    wait_for_resources_s: WaitForResourcesOption = 0.0
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"


if __name__ == "__main__":
    run("paint_streets")
