#!/usr/bin/env python3
"""Paint street views as photographs: Stable Diffusion under a ControlNet for semantic images, from local weights.

    jobs/paint_streets.py --streets DIR/streets/drive --diffusion SD_DIR --controlnet CONTROLNET_DIR
    jobs/paint_streets.py ... --prompt "a quiet street in autumn, photograph" --steps 30 --actors 2

Both directories are in diffusers' layout, as safetensors; nothing is fetched. Needs the package transformers
(pip install 'pritti-on-ray[photos]') and, to be of use, a GPU. Writes photo/ beside each drive's images, photos.png and
photos.webp. Frames that are painted already stay.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import absolute, home, require_positive, run, start_ray


@dataclass(frozen=True)
class Config:
    streets: str = ""
    """Street views of jobs/render_streets.py (default: $PRITTI_HOME/generated/streets/drive)."""
    diffusion: str = ""
    """Directory of a Stable Diffusion pipeline (1.x or 2.x)."""
    controlnet: str = ""
    """Directory of a ControlNet for it, trained on semantic images in the KITTI-360 or Cityscapes palette."""
    prompt: str = "a photograph of a residential street, daylight"
    negative_prompt: str = ""
    steps: int = 30
    guidance: float = 7.5
    control: float = 1.0
    """How strongly the semantic image holds."""
    seed: int = 0
    """Of the noise, the same for every frame."""
    actors: int = 1
    """Pipelines at work at once; one per GPU."""


def paint(config: Config) -> tuple[str, int]:
    """Paint and return where, and the number of frames."""
    for name, value in (("--diffusion", config.diffusion), ("--controlnet", config.controlnet)):
        if not value:
            raise ValueError(f"{name} is missing: give a local directory in diffusers' layout")
    require_positive(config, "steps", "actors")
    from pipelines.runtime import storage

    for name, value in (("--diffusion", config.diffusion), ("--controlnet", config.controlnet)):
        if not storage.list_files(absolute(value), ".json"):
            raise ValueError(f"{name} {value}: no model here; give a local directory in diffusers' layout")
    streets = absolute(config.streets) if config.streets else home("generated", "streets", "drive")
    from rich.progress import Progress

    from pipelines.rendering.controlnet import PhotoRequest, drives, paint_streets

    directories = drives(streets)
    request = PhotoRequest(
        diffusion=absolute(config.diffusion),
        controlnet=absolute(config.controlnet),
        prompt=config.prompt,
        negative_prompt=config.negative_prompt,
        steps=config.steps,
        guidance_scale=config.guidance,
        control_scale=config.control,
        seed=config.seed,
    )
    start_ray()
    with Progress() as bar:
        shown = bar.add_task("paint streets", total=len(directories))
        return streets, paint_streets(request, directories, config.actors, lambda: bar.advance(shown))


def main(config: Config) -> None:
    streets, frames = paint(config)
    print(f"{frames} frames painted in {streets}")


if __name__ == "__main__":
    run(main, Config, description=__doc__)
