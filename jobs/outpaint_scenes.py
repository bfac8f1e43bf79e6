#!/usr/bin/env python3
"""Extend scenes by neighbouring blocks on all sides, or to a given extent.

    jobs/outpaint_scenes.py                                              the first generated town scene
    jobs/outpaint_scenes.py --extent-m 544 544 --num-actors 8            544 m x 544 m around it
    jobs/outpaint_scenes.py --blocks-ahead 9 --blocks-behind 0 --blocks-left 0 --blocks-right 0     along its street
    jobs/outpaint_scenes.py --input DIR --source town --split test --max-scenes 8 --num-actors 2
    jobs/outpaint_scenes.py --inpainting repaint                         as in the paper, slowly
    jobs/outpaint_scenes.py --extent-m 448 448 --labels-map labels.json  one label per block, 9 rows of 9
    jobs/outpaint_scenes.py --extent-m 1984 1984 --tile-m 256            a city in tiles

By default, the job adds eight blocks around a scene, as in the paper: four sides in one batch, then four corners. The
job writes scene tables with source=generated-<run> and one GLB file per scene. With --tile-m, it writes one scene and
one GLB file per tile, a 3D Tiles tileset, glb/<run>/<scene>/tileset.json, and a page that shows the city in 3D,
pages/<run>/<scene>/index.html. No process then holds a whole city.

The tables in block_tables/ contain `known_ground`, the share of the known pixels of each block that have ground. The
job generates a block as soon as all neighbours that the block depends on are complete. The result does not depend on
the number of actors. Run the same command again to resume after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jobs.support.cli import resolve_path, run
from jobs.support.options import IfBusyOption, LogFormatOption, RePaintOptions


@dataclass(frozen=True)
class Config(RePaintOptions):
    output: str = ""
    """Dataset directory to write (default: $PRITTI_HOME/outpainted)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    run: str = "outpainted"
    """Name of the run: scenes get source=generated-<run>."""
    extent_m: tuple[float, float] | None = None
    """Length (ahead) and width of the result in metres, rounded up to whole blocks on all sides; replaces the numbers
    of blocks (default: none)."""
    blocks_ahead: int = 1
    """Number of blocks ahead of the scene."""
    blocks_behind: int = 1
    """Number of blocks behind the scene."""
    blocks_left: int = 1
    """Number of blocks to the left of the scene."""
    blocks_right: int = 1
    """Number of blocks to the right of the scene."""
    overlap: float | None = None
    """Overlap of neighbouring blocks, as a share of the block size (default: 0.5 for outward, 0.25 for colours)."""
    order: Literal["outward", "colours"] | None = None
    """Order of blocks: outward from the scene, as in the paper, or colours, four groups of independent blocks, which
    need --overlap < 0.5 (default: outward with at most one block per side, else colours, because outward drifts over
    long distances)."""
    margin: float | None = None
    """Width of the outermost part of a block that its neighbours generate again, as a share of the block size. It must
    be less than half of --overlap (default: 0.0625 if all streets are known from a plan or a map, else 0)."""
    plan_streets: bool | None = None
    """Plan the streets of the whole result first, so that all blocks agree on them; the plan is written to
    street_plans/ as a map for --road-sketch (default: if the model has a street planner and there is more than one
    block on a side)."""
    labels_map: str = ""
    """JSON file with one list per row of blocks, farthest ahead first, each with one label per block, leftmost first;
    replaces --label."""
    free_blocks: Literal["none", "off-street", "all"] | None = None
    """Blocks that are sampled as crops at any place and heading, instead of views of a vehicle: those that do not lie
    ahead of or behind the given scene (off-street), or all generated blocks. Only models with labels such as
    low-medium-free distinguish both (default: none with at most one block per side, else all)."""
    road_sketch: str = ""
    """File with roads that the generated blocks contain. JSON: a list of {"points_m": [[x, y], ...], "width_m": 7,
    "sidewalk_m": 2}, in metres in the frame of the given scene, x ahead and y to the left. PNG: a map with white roads,
    grey sidewalks and black elsewhere; ahead is up, and the middle of the picture is the middle of the given scene."""
    sketch_pixel_m: float = 1.0
    """Side of a pixel of a PNG file of --road-sketch in metres."""
    tile_m: float | None = None
    """Side of the tiles in metres, at least 64 (default: each result is written as one scene)."""
    neighbour_latents: Literal["reencode", "copy", "paper"] | None = None
    """How a block uses its neighbours: reencode encodes them again in the frame of the block, copy copies and shifts
    their latents. paper does the same as copy, but without blending the ground and without removing duplicates
    (default: as the model stores; paper for the paper's presets, else reencode)."""
    batch_size: int = 4
    """Number of blocks of a scene per batch; the batch size changes the result only by rounding."""

    def output_directory(self) -> str:
        return resolve_path(self.output, "outpainted")


if __name__ == "__main__":
    run("outpaint_scenes")
