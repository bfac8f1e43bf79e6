"""Implementation of jobs/paint_streets.py."""

from __future__ import annotations

from jobs.paint_streets import Config
from jobs.support.cli import make_absolute, require_positive, resolve_path
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from pipelines.rendering.controlnet import PhotoRequest, list_drives, paint_streets
from pipelines.runtime import storage


def paint(config: Config) -> tuple[str, int]:
    """Paint frames; return the directory of street views and the number of frames."""
    for name, value in (("--diffusion", config.diffusion), ("--controlnet", config.controlnet)):
        if not value:
            raise ValueError(f"{name} is missing; specify a local directory in diffusers' layout")
    require_positive(config, "num_inference_steps", "num_actors")
    for name, value in (("--diffusion", config.diffusion), ("--controlnet", config.controlnet)):
        if not storage.list_files(make_absolute(value), ".json"):
            raise ValueError(f"{name} {value}: no model here; specify a local directory in diffusers' layout")
    streets = resolve_path(config.streets, "generated", "streets", "drive")
    directories = list_drives(streets)
    request = PhotoRequest(
        diffusion=make_absolute(config.diffusion),
        controlnet=make_absolute(config.controlnet),
        prompt=config.prompt,
        negative_prompt=config.negative_prompt,
        steps=config.num_inference_steps,
        guidance_scale=config.guidance_scale,
        control_scale=config.controlnet_conditioning_scale,
        seed=config.seed,
    )
    with hold_output(streets, "photos", config), JobProgress() as bar:
        shown = bar.add_task("paint streets", total=len(directories))
        return streets, paint_streets(request, directories, config.num_actors, lambda: bar.advance(shown))


def main(config: Config) -> None:
    streets, frames = paint(config)
    print(f"{frames} frames painted in {streets}")
