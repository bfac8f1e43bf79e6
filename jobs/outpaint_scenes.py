#!/usr/bin/env python3
"""Extend scenes to all sides (the paper's two passes: four sides in one batch, then four corners).

    jobs/outpaint_scenes.py                                       the first generated town scene
    jobs/outpaint_scenes.py --input DIR --source town --split test --limit 8 --actors 2
    jobs/outpaint_scenes.py --steps 50 --resamplings 2            quicker than the paper's 250 and 10

Writes the same tables, source=generated-<run>, on a grid twice as wide, and a GLB of each scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jobs.command import absolute, home, run, start_ray


@dataclass(frozen=True)
class Config:
    model: str = ""
    """Pipeline directory (default: $PRITTI_HOME/models/pritti-town)."""
    input: str = ""
    """Dataset directory with the scenes to extend (default: $PRITTI_HOME/generated)."""
    source: str = ""
    """Source of the scenes (default: whatever is there)."""
    split: str = ""
    limit: int = 1
    """How many scenes to extend, from the first on."""
    label: str = ""
    """Label of the new blocks (default: the scene's own)."""
    output: str = ""
    """Dataset directory (default: $PRITTI_HOME/outpainted)."""
    run: str = "outpainted"
    seed: int = 0
    overlap: float = 0.5
    mode: Literal["reencode", "copy"] = "reencode"
    """How a block knows its neighbours: encoded anew in its own frame, or the shifted latent (the paper)."""
    steps: int = 250
    jump_length: int = 10
    resamplings: int = 10
    guidance: float = 1.0
    actors: int = 1
    """Pipelines at work at once; one per GPU."""


def outpaint(config: Config) -> str:
    """Extend and return the dataset directory."""
    from rich.progress import Progress

    from models.pipeline import Resampling
    from pipelines import storage
    from pipelines.outpaint import OutpaintRequest, outpaint_scenes
    from pipelines.selection import Selection

    output = absolute(config.output) if config.output else home("outpainted")
    request = OutpaintRequest(
        model=absolute(config.model) if config.model else home("models", "pritti-town"),
        output=output,
        run=config.run,
        label=config.label or None,
        seed=config.seed,
        overlap=config.overlap,
        mode=config.mode,
        resampling=Resampling(config.steps, config.jump_length, config.resamplings),
        guidance_scale=config.guidance,
    )
    source = absolute(config.input) if config.input else home("generated")
    selection = Selection(source, config.source or None, config.split or None, config.limit, "first")
    selection.shards()
    if not storage.exists(storage.join(request.model, "model_index.json")):
        raise ValueError(f"{request.model}: no PrITTI pipeline here; run jobs/train_dit.py first")
    start_ray()
    with Progress() as bar:
        shown = bar.add_task("outpaint", total=config.limit)
        outpaint_scenes(request, selection, config.actors, lambda: bar.advance(shown))
    return output


def main(config: Config) -> None:
    print(f"outpainted scenes, source generated-{config.run}, and GLB files in {outpaint(config)}")


if __name__ == "__main__":
    run(main, Config, description=__doc__)
