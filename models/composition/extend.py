"""Scenes of any size, block by block of the model's: grown to one side, or made anew inside a region (paper, Sec. 3.3)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from models.composition.inpaint import Contents, composited, latent_mask, whole_cells
from models.composition.outpaint import Lattice, height_near
from models.composition.seam_blending import new_part, spread
from models.pipeline import PrITTIPipeline, Resampling, StepCallback
from models.sampling.diffusion import OUTPAINT, Known
from models.scene import Grid, Scene, merge
from models.tensors import new_scene

Side = Literal["ahead", "behind", "left", "right"]


def grown(grid: Grid, side: Side, pixels: int) -> Grid:
    """The grid with so many more pixels on a side. ValueError for a side that is none."""
    if side not in get_args(Side):
        raise ValueError(f"side {side!r}, expected one of: {', '.join(get_args(Side))}")
    more_m = pixels * grid.resolution_m
    if side in ("ahead", "behind"):
        front_m = grid.front_m + (more_m if side == "ahead" else 0)
        return replace(grid, front_m=front_m, rows=grid.rows + pixels)
    return replace(grid, left_m=grid.left_m + (more_m if side == "left" else 0), cols=grid.cols + pixels)


def windows(grid: Grid, side: Side, small: Grid, step_px: int) -> Iterator[Grid]:
    """Blocks of the model's size along a side of a grid, every step_px, the last one flush with its end."""
    along = grid.cols if side in ("ahead", "behind") else grid.rows
    size = small.cols if side in ("ahead", "behind") else small.rows
    for start in [*range(0, along - size, step_px), along - size]:
        row = {"ahead": 0, "behind": grid.rows - small.rows}.get(side, start)
        col = {"left": 0, "right": grid.cols - small.cols}.get(side, start)
        front_m, left_m = grid.front_m - row * grid.resolution_m, grid.left_m - col * grid.resolution_m
        yield replace(small, front_m=front_m, left_m=left_m)


def covering(grid: Grid, region: np.ndarray, small: Grid, cell_px: int) -> list[Grid]:
    """Blocks of the model's size, on whole cells of a grid, that hold all pixels of a region between them.

    One in the middle of a region that fits into a block; else one every half a block.
    """

    def starts(found: np.ndarray, along: int, size: int) -> list[int]:
        first, last = found[0] // cell_px * cell_px, -(-(found[-1] + 1) // cell_px) * cell_px
        if last - first > size:
            wanted = [*range(first, last - size, size // 2), last - size]
        else:
            wanted = [(first + last - size) // 2 // cell_px * cell_px]
        return [min(max(start, 0), along - size) for start in wanted]

    rows, cols = (np.flatnonzero(region.any(axis=axis)) for axis in (1, 0))
    return [
        replace(small, front_m=grid.front_m - row * grid.resolution_m, left_m=grid.left_m - col * grid.resolution_m)
        for row in starts(rows, grid.rows, small.rows)
        for col in starts(cols, grid.cols, small.cols)
    ]


def in_block(canvas: Scene, window: Grid, small: Grid, level_m: float) -> tuple[Scene, tuple[float, float, float]]:
    """What a window of a scene holds, in the model's frame and at the height `level_m` there; the way back, x, y, z in metres."""
    dx_m, dy_m = small.front_m - window.front_m, small.left_m - window.left_m
    known = canvas.cropped(window).moved(dx_m, dy_m)
    datum_m = height_near(known, 0.0, 0.0) - level_m
    return known.moved(0, 0, -datum_m), (-dx_m, -dy_m, datum_m)


def require_blocks(scene: Scene, pipeline: PrITTIPipeline) -> None:
    """Raises ValueError for a scene of another resolution or of other ground classes than the model's, or smaller than a block."""
    spec, small = pipeline.spec, pipeline.spec.grid
    if scene.grid.resolution_m != small.resolution_m or scene.ground_classes != spec.ground_classes:
        raise ValueError(f"{scene}: the model needs {small.resolution_m} m and {', '.join(spec.ground_classes)}")
    if scene.grid.rows < small.rows or scene.grid.cols < small.cols:
        raise ValueError(f"{scene} is smaller than a block of {small.rows} x {small.cols}")


def region_blocks(pipeline: PrITTIPipeline, scene: Scene, region: np.ndarray) -> list[tuple[Grid, np.ndarray]]:
    """Blocks with the part (rows, cols) of a region that each makes anew, in whole cells, no cell twice.

    Raises ValueError as `require_blocks`.
    """
    require_blocks(scene, pipeline)
    small, size = pipeline.spec.grid, pipeline.lvae.latent_shape[-1]
    left, parts = region.copy(), []
    for window in covering(scene.grid, region, small, small.rows // size) if region.any() else []:
        here = scene.grid.shared(window)[0]
        if left[here].any():
            parts.append((window, whole_cells(left[here], small, size)))
            left[here] &= ~parts[-1][1]
    return parts


@dataclass(frozen=True)
class Step:
    """A block made anew in several variants of a scene: `made` what decoders said, `canvases` the scenes with it in them.

    `known`, `made` and `region` (rows, cols; whole cells) are the block's own; `canvases` are as large as the scene.
    """

    known: list[Scene]
    made: list[Scene]
    region: np.ndarray
    canvases: list[Scene]


def inpainting(
    pipeline: PrITTIPipeline,
    scene: Scene,
    region: np.ndarray,
    label: str,
    contents: Contents = "both",
    seed: int = 0,
    indices: Sequence[int] = (0,),
    resampling: Resampling | None = None,
    guidance_scale: float = 1.0,
    callback_on_step_end: StepCallback | None = None,
) -> Iterator[Step]:
    """A scene of any size made anew, once per index, inside a region (rows, cols) of its pixels; the last step has all of it.

    `PrITTIPipeline.inpaint` on a scene of the model's size; on a larger one block by block, each knowing what is there.
    Regions grow to whole cells, the rest stays bit for bit. Raises ValueError for an empty one, and as `require_blocks`.
    """
    if not region.any():
        raise ValueError(f"{scene}: the region holds no pixel of it")
    canvases, level_m = [scene] * len(indices), height_near(scene, 0.0, 0.0)
    for number, (window, part) in enumerate(region_blocks(pipeline, scene, region)):
        blocks = [in_block(canvas, window, pipeline.spec.grid, level_m) for canvas in canvases]
        known = [block for block, _ in blocks]
        made = pipeline.inpaint(
            known,
            [part] * len(known),
            [label] * len(known),
            contents,
            seed,
            [(index, number) if number else index for index in indices],
            resampling,
            guidance_scale,
            callback_on_step_end=callback_on_step_end,
            composite=False,
        )
        inside = np.zeros_like(region)
        inside[scene.grid.shared(window)[0]] = part
        canvases = [
            composited(canvas, one.moved(*offset_m).cropped(scene.grid), inside, contents)
            for canvas, one, (_, offset_m) in zip(canvases, made, blocks, strict=True)
        ]
        yield Step(known, made, part, canvases)


def extended(
    pipeline: PrITTIPipeline,
    scene: Scene,
    side: Side,
    label: str,
    seed: int = 0,
    overlap: float = 0.5,
    resampling: Resampling | None = None,
    guidance_scale: float = 1.0,
    callback_on_step_end: StepCallback | None = None,
) -> Scene:
    """The scene with (1 - overlap) of a block more on one side; what was there stays as it is.

    Each block knows what lies in it already, encoded anew in its own frame and height. Raises ValueError for a scene of
    another resolution or of other ground classes than the model's, smaller than a block, or for an overlap between cells.
    """
    spec, small = pipeline.spec, pipeline.spec.grid
    require_blocks(scene, pipeline)
    size = pipeline.lvae.latent_shape[-1]
    step_px = Lattice.of(size, overlap).step * (small.rows // size)
    grid = grown(scene.grid, side, step_px)
    canvas, level_m = scene.cropped(grid), height_near(scene, 0.0, 0.0)
    made = np.zeros((grid.rows, grid.cols), bool)
    made[grid.shared(scene.grid)[0]] = True
    empty = new_scene(scene.scene_id, scene.source, scene.sequence, scene.frame, spec)
    for number, window in enumerate(windows(grid, side, small, step_px)):
        here = grid.shared(window)[0]
        unknown = ~made[here]
        known, offset_m = in_block(canvas, window, small, level_m)
        latent = pipeline.encode([spread(known, unknown)])
        mask = latent_mask([unknown], latent.shape[1:], "both").to(latent.device)
        latent = pipeline.complete(
            Known(latent, mask),
            [label],
            seed,
            [(number, step_px, grid.rows, grid.cols, get_args(Side).index(side))],
            resampling or Resampling(),
            guidance_scale,
            callback_on_step_end,
            OUTPAINT,
        )
        block = pipeline.decode(latent, [empty])[0]
        new = new_part(block, known, unknown).moved(*offset_m)
        before = made.copy()
        made[here] = True
        canvas = merge([canvas, new.cropped(grid)], [before, made & ~before], canvas)
    return canvas
