#!/usr/bin/env python3
"""Make part of scenes anew: what lies in a polygon, ahead of a line, or around some objects.

    jobs/inpaint_scenes.py --polygon-m 10 -20 50 -20 50 5 10 5          a rectangle: x y of its corners, x ahead, y left
    jobs/inpaint_scenes.py --half-plane 1 0 32 --variants 4             everything at least 32 m ahead, four times
    jobs/inpaint_scenes.py --objects 3 17 --contents objects            around primitives 3 and 17; the ground stays
    jobs/inpaint_scenes.py --half-plane 1 0 -99 --contents objects      new objects on the given ground
    jobs/inpaint_scenes.py --polygon-m ... --guided                     quick, and joins well

Regions grow to whole latent cells. Writes the same tables, source=generated-<run>, a GLB of each scene, and <run>.html.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jobs.support.cli import absolute, home, require_positive, run, start_ray
from jobs.support.options import Repainting, pipeline_directory, require_model_labels


@dataclass(frozen=True)
class Config(Repainting):
    polygon_m: tuple[float, ...] = ()
    """Corners of a polygon, x y x y ..., in metres of the scene: x ahead, y left."""
    half_plane: tuple[float, ...] = ()
    """Direction x y and the metres along it where the region begins."""
    objects: tuple[int, ...] = ()
    """Primitives of the scene by number, as in its rows of the primitives table, from 0."""
    margin_m: float = 1.0
    """Room around --objects."""
    outside: bool = False
    """All but what the options above name."""
    contents: Literal["both", "ground", "objects"] = "both"
    """What to make anew there."""
    variants: int = 1
    """Different results per scene."""
    output: str = ""
    """Dataset directory (default: $PRITTI_HOME/inpainted)."""
    run: str = "inpainted"
    """Name of the run: scenes get source=generated-<run>."""
    pictures: int = 8
    """So many scenes on the page."""

    def output_directory(self) -> str:
        return absolute(self.output) if self.output else home("inpainted")


def inpaint(config: Config) -> dict[str, float | None]:
    """Make anew, write, and return how far raw decodes drift outside the region."""
    if not (config.polygon_m or config.half_plane or config.objects):
        raise ValueError("no region: give --polygon-m, --half-plane or --objects")
    require_positive(config, "variants", "actors")
    if config.pictures < 0:
        raise ValueError(f"--pictures is {config.pictures}, expected 0 or more")
    if config.polygon_m and (len(config.polygon_m) % 2 or len(config.polygon_m) < 6):
        raise ValueError(f"--polygon-m has {len(config.polygon_m)} numbers, expected x y of three corners or more")
    model = pipeline_directory(config.model)
    require_model_labels(model, [config.label] if config.label else [])
    from rich.progress import Progress

    from pipelines.generation.inpaint import InpaintRequest, Where, inpaint_scenes

    selection = config.selection()
    total = sum(len(rows) for _, rows in selection.shards())
    request = InpaintRequest(
        model=model,
        output=config.output_directory(),
        run=config.run,
        where=Where(config.polygon_m, config.half_plane, config.objects, config.margin_m, config.outside),
        contents=config.contents,
        variants=config.variants,
        label=config.label or None,
        seed=config.seed,
        resampling=config.resampling(),
        guidance_scale=config.guidance,
    )
    start_ray()
    with Progress() as bar:
        shown = bar.add_task("inpaint", total=total)
        return inpaint_scenes(request, selection, config.actors, config.pictures, lambda: bar.advance(shown))


def main(config: Config) -> None:
    scores = inpaint(config)
    print(f"scenes, source generated-{config.run}, GLB files and {config.run}.html in {config.output_directory()}")
    said = {name: "–" if value is None else f"{value:.4g}" for name, value in scores.items()}
    print("drift outside the region:", ", ".join(f"{name} {value}" for name, value in said.items()))


if __name__ == "__main__":
    run(main, Config, description=__doc__)
