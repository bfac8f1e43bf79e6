#!/usr/bin/env python3
"""Extend scenes to all sides: by a block each (the paper: four sides in one batch, then four corners), or to any extent.

    jobs/outpaint_scenes.py                                       the first generated town scene
    jobs/outpaint_scenes.py --extent-m 512 512 --actors 8         half a kilometre by half a kilometre of it
    jobs/outpaint_scenes.py --ahead 9 --behind 0 --left 0 --right 0     on along its street
    jobs/outpaint_scenes.py --input DIR --source town --split test --limit 8 --actors 2
    jobs/outpaint_scenes.py --guided                                          quick, and joins well

Writes the same tables, source=generated-<run>, one scene and one GLB for each scene, and block_tables/ with what is known
of each block. Blocks are made as soon as those they must know are there, the same ones whatever the number of actors.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import TYPE_CHECKING, Literal

from jobs.support.cli import absolute, home, require_positive, run, start_ray
from jobs.support.options import Repainting, pipeline_directory, require_model_labels

if TYPE_CHECKING:
    import pyarrow as pa

BLOCK_M = 64.0  # of every dataset's scenes (paper, Sec. 3.1)


@dataclass(frozen=True)
class Config(Repainting):
    output: str = ""
    """Dataset directory (default: $PRITTI_HOME/outpainted)."""
    run: str = "outpainted"
    """Name of the run: scenes get source=generated-<run>."""
    extent_m: tuple[float, float] | None = None
    """Length (ahead) and width of the whole in metres, the scene in its middle; instead of the four numbers below."""
    ahead: int = 1
    """Blocks ahead of the scene; likewise behind, to the left and to the right of it."""
    behind: int = 1
    left: int = 1
    right: int = 1
    overlap: float = 0.5
    """Of neighbouring blocks."""
    order: Literal["outward", "colours"] = "outward"
    """Which blocks know which: from the scene outward (the paper), or in four colours, most of them at once; needs an
    overlap below 0.5."""
    mode: Literal["reencode", "copy"] = "reencode"
    """How a block knows its neighbours: encoded anew in its own frame, or the shifted latent (the paper)."""
    batch_size: int = 4
    """Blocks of a scene to make at once; part of what decides their last digits."""

    def output_directory(self) -> str:
        return absolute(self.output) if self.output else home("outpainted")


def last_blocks(config: Config) -> tuple[int, int, int, int]:
    """Blocks ahead, behind, left and right of the scene. Raises ValueError for fewer than none."""
    if config.extent_m is None:
        last = config.ahead, config.behind, config.left, config.right
    else:
        step_m = BLOCK_M * (1 - config.overlap)
        if not 0 < step_m <= BLOCK_M or min(config.extent_m) < BLOCK_M:
            raise ValueError(
                f"--extent-m is {config.extent_m}, --overlap {config.overlap}: expected {BLOCK_M} m or more, and 0 to 1"
            )
        sides = [ceil((extent - BLOCK_M) / 2 / step_m - 1e-9) for extent in config.extent_m]
        last = sides[0], sides[0], sides[1], sides[1]
    if min(last) < 0 or not any(last):
        raise ValueError(f"blocks ahead, behind, left and right are {last}: expected 0 or more, and one at least")
    return last


def outpaint(config: Config) -> pa.Table:
    """Extend, write, and return what is known of each block."""
    require_positive(config, "actors", "batch_size")
    last = last_blocks(config)
    model = pipeline_directory(config.model)
    require_model_labels(model, [config.label] if config.label else [])
    from rich.progress import MofNCompleteColumn, Progress

    from pipelines.generation.outpaint import OutpaintRequest, outpaint_scenes

    selection = config.selection()
    count = sum(len(rows) for _, rows in selection.shards())
    request = OutpaintRequest(
        model=model,
        output=config.output_directory(),
        run=config.run,
        label=config.label or None,
        seed=config.seed,
        overlap=config.overlap,
        mode=config.mode,
        resampling=config.resampling(),
        guidance_scale=config.guidance,
        last=last,
        order=config.order,
        batch_size=config.batch_size,
    )
    start_ray()
    ahead, behind, left, right = last
    with Progress(*Progress.get_default_columns(), MofNCompleteColumn()) as bar:
        shown = bar.add_task("outpaint, blocks", total=count * ((ahead + behind + 1) * (left + right + 1) - 1))
        return outpaint_scenes(request, selection, config.actors, lambda blocks: bar.advance(shown, blocks))


def main(config: Config) -> None:
    import pyarrow.compute as pc

    from pipelines.generation.outpaint import HARDLY_KNOWN

    blocks, output = outpaint(config), config.output_directory()
    print(f"outpainted scenes, source generated-{config.run}, and GLB files in {output}")
    if bare := pc.sum(pc.less(blocks["known_ground"], HARDLY_KNOWN)).as_py():
        print(
            f"{bare} of {len(blocks)} blocks knew next to no ground beforehand, where outpainting fails (the paper says so): "
            f"known_ground below {HARDLY_KNOWN} in {output}/block_tables/{config.run}/*.parquet"
        )


if __name__ == "__main__":
    run(main, Config, description=__doc__)
