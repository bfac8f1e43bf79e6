#!/usr/bin/env python3
"""Regenerate part of scenes: inside a polygon, beyond a line, or around objects.

    jobs/inpaint_scenes.py --polygon-m 10 -20 50 -20 50 5 10 5           a rectangle: corners x y, x ahead, y left
    jobs/inpaint_scenes.py --half-plane 1 0 32 --num-variants 4          everything at least 32 m ahead, four variants
    jobs/inpaint_scenes.py --primitives 3 17 --contents objects          objects around primitives 3 and 17, same ground
    jobs/inpaint_scenes.py --half-plane 1 0 -99 --contents objects       new objects on the same ground
    jobs/inpaint_scenes.py --half-plane 1 0 -99 --contents objects --keep-categories construction_big
                                                                         the same between the given buildings
    jobs/inpaint_scenes.py --polygon-m ... --inpainting repaint          as in the paper, slowly

Regions are enlarged to whole latent cells. The job writes scene tables with source=generated-<run>, one GLB file per
scene, and <run>.html.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jobs.support.cli import resolve_path, run
from jobs.support.options import IfBusyOption, LogFormatOption, RePaintOptions


@dataclass(frozen=True)
class Config(RePaintOptions):
    polygon_m: tuple[float, ...] = ()
    """Corners of the region as x y x y ... in metres in the scene frame, x to the front, y to the left (default:
    none)."""
    half_plane: tuple[float, ...] = ()
    """Region beyond a line, given by a direction x y and the distance in metres at which the region begins (default:
    none)."""
    primitives: tuple[int, ...] = ()
    """Regenerate the surroundings of the primitives with these indices; the first index of a scene is 0 (default:
    none)."""
    margin_m: float = 1.0
    """Margin around --primitives in metres."""
    invert_region: bool = False
    """Regenerate the area outside the region instead of the area inside it."""
    contents: Literal["both", "ground", "objects"] = "both"
    """Content to regenerate in the region."""
    keep_categories: tuple[str, ...] = ()
    """Categories whose objects are kept in the region, such as construction_big for buildings. The model adds no
    objects of these categories, and none inside of kept objects. Not for --contents ground (default: none)."""
    num_variants: int = 1
    """Number of different results per scene."""
    output: str = ""
    """Dataset directory to write (default: $PRITTI_HOME/inpainted)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    run: str = "inpainted"
    """Name of the run: scenes get source=generated-<run>."""
    num_examples: int = 8
    """Number of scenes that the page shows."""

    def output_directory(self) -> str:
        return resolve_path(self.output, "inpainted")


if __name__ == "__main__":
    run("inpaint_scenes")
