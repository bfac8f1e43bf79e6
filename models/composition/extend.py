"""Extend scenes that are larger than one block to one side, or regenerate a region of them (paper, Sec. 3.3)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from models.composition.block_grid import BlockGrid
from models.composition.generator import SceneGenerator, StepCallback
from models.composition.inpaint import (
    Contents,
    composite_scenes,
    grow_to_cells,
    hide_replaced_objects,
    make_latent_mask,
    select_kept_pixels,
)
from models.composition.outpaint import find_ground_height
from models.composition.seam_blending import extract_new_part, extrapolate_ground
from models.sampling.diffusion import OUTPAINT, InpaintCondition
from models.sampling.repaint import InpaintingConfig
from models.scene import Grid, Scene, merge_scenes
from models.tensors import make_empty_scene

Side = Literal["ahead", "behind", "left", "right"]


def expand_grid(grid: Grid, side: Side | str, pixels: int) -> Grid:
    """Add pixels to a grid on one side.

    Args:
        grid: Grid.
        side: "ahead", "behind", "left" or "right".
        pixels: Number of rows or columns to add.

    Returns:
        The larger grid.

    Raises:
        ValueError: The side is unknown.
    """
    if side not in get_args(Side):
        raise ValueError(f"side {side!r}, expected one of: {', '.join(get_args(Side))}")
    more_m = pixels * grid.resolution_m
    if side in ("ahead", "behind"):
        front_m = grid.front_m + (more_m if side == "ahead" else 0)
        return replace(grid, front_m=front_m, rows=grid.rows + pixels)
    return replace(grid, left_m=grid.left_m + (more_m if side == "left" else 0), cols=grid.cols + pixels)


def tile_side(grid: Grid, side: Side | str, block: Grid, step_px: int) -> Iterator[Grid]:
    """Yield windows along one side of a grid. Each window has the size of one block.

    Args:
        grid: Grid of the scene.
        side: "ahead", "behind", "left" or "right".
        block: Grid of one block.
        step_px: Distance between neighbouring windows in pixels; the last window ends at the border of the grid.

    Yields:
        Grids of the size of one block.
    """
    along = grid.cols if side in ("ahead", "behind") else grid.rows
    size = block.cols if side in ("ahead", "behind") else block.rows
    for start in [*range(0, along - size, step_px), along - size]:
        row = {"ahead": 0, "behind": grid.rows - block.rows}.get(side, start)
        col = {"left": 0, "right": grid.cols - block.cols}.get(side, start)
        front_m, left_m = grid.front_m - row * grid.resolution_m, grid.left_m - col * grid.resolution_m
        yield replace(block, front_m=front_m, left_m=left_m)


def tile_region(grid: Grid, region: np.ndarray, block: Grid, cell_px: int) -> list[Grid]:
    """Return windows that together cover a region. Each window has the size of one block.

    If the region fits into one block, the only window is centred on the region. Otherwise, windows overlap by half a
    block.

    Args:
        grid: Grid of the scene.
        region: (rows, cols) bool with at least one True pixel.
        block: Grid of one block.
        cell_px: Side of a latent cell in pixels. Windows are aligned to whole cells.

    Returns:
        Grids of the size of one block.
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
        replace(block, front_m=grid.front_m - row * grid.resolution_m, left_m=grid.left_m - col * grid.resolution_m)
        for row in starts(rows, grid.rows, block.rows)
        for col in starts(cols, grid.cols, block.cols)
    ]


def to_block_frame(
    canvas: Scene, window: Grid, block: Grid, level_m: float
) -> tuple[Scene, tuple[float, float, float]]:
    """Crop a window of a scene and transform the crop into the frame of the model.

    The translation along z moves the ground at the origin to height `level_m`.

    Args:
        canvas: Scene.
        window: Grid of the window in the frame of `canvas`.
        block: Grid of one block in the model's frame.
        level_m: Ground height at the origin of the model's frame (metres).

    Returns:
        The cropped scene and the translation (x, y, z) back to the frame of `canvas`, in metres.
    """
    dx_m, dy_m = block.front_m - window.front_m, block.left_m - window.left_m
    known = canvas.crop(window).translate(dx_m, dy_m)
    datum_m = find_ground_height(known, 0.0, 0.0) - level_m
    return known.translate(0, 0, -datum_m), (-dx_m, -dy_m, datum_m)


def require_blocks(model: SceneGenerator, scene: Scene) -> None:
    """Raise an error if a scene does not fit the model or is smaller than one block.

    Args:
        model: Model.
        scene: Scene.

    Raises:
        ValueError: The scene is smaller than a block, or its resolution or ground classes differ from those of the
            model.
    """
    spec, block = model.spec, model.spec.grid
    if scene.grid.resolution_m != block.resolution_m or scene.ground_classes != spec.ground_classes:
        raise ValueError(
            f"{scene}: the model needs {block.resolution_m} m per pixel and {', '.join(spec.ground_classes)}"
        )
    if scene.grid.rows < block.rows or scene.grid.cols < block.cols:
        raise ValueError(f"{scene} is smaller than a block of {block.rows} x {block.cols}")


def split_region(model: SceneGenerator, scene: Scene, region: np.ndarray) -> list[tuple[Grid, np.ndarray]]:
    """Split a region into blocks, which are then regenerated one after another.

    Args:
        model: Model.
        scene: Scene.
        region: (rows, cols) bool; True marks the pixels to regenerate.

    Returns:
        One pair per block: its window, and the mask (rows, cols) of the pixels to regenerate. The masks are disjoint
        and consist of whole cells.

    Raises:
        ValueError: The scene is smaller than a block, or its resolution or ground classes differ from those of the
            model.
    """
    require_blocks(model, scene)
    block, size = model.spec.grid, model.latent_shape[-1]
    remaining, parts = region.copy(), []
    for window in tile_region(scene.grid, region, block, block.rows // size) if region.any() else []:
        here = scene.grid.intersect(window)[0]
        if remaining[here].any():
            parts.append((window, grow_to_cells(remaining[here], block, size)))
            remaining[here] &= ~parts[-1][1]
    return parts


@dataclass(frozen=True)
class InpaintStep:
    """Several variants of one regenerated block of a scene.

    Attributes:
        known: Input of the block, one scene per variant.
        generated: Decoded block before compositing, one scene per variant.
        region: (rows, cols) bool; True marks the regenerated pixels of the block. The region consists of whole cells.
        canvases: The whole scene after compositing the block, one scene per variant.
    """

    known: list[Scene]
    generated: list[Scene]
    region: np.ndarray
    canvases: list[Scene]


def inpaint_blocks(
    model: SceneGenerator,
    scene: Scene,
    region: np.ndarray,
    label: str,
    contents: Contents = "both",
    seed: int = 0,
    indices: Sequence[int] = (0,),
    repaint: InpaintingConfig | None = None,
    guidance_scale: float = 1.0,
    callback_on_step_end: StepCallback | None = None,
    keep: Sequence[str] = (),
) -> Iterator[InpaintStep]:
    """Regenerate a region of a large scene block by block, with one variant per index.

    For a scene on the model's grid, the result equals that of `PrITTIPipeline.inpaint`. The region is enlarged to whole
    cells. All other pixels and objects remain unchanged.

    Args:
        model: Model.
        scene: Scene, at least as large as one block.
        region: (rows, cols) bool; True marks the pixels to regenerate.
        label: Label of the scene.
        contents: Part of the scene to regenerate; see `PrITTIPipeline.inpaint`.
        seed: Seed of the noise.
        indices: Index of each variant; the noise depends on the seed and this index.
        repaint: Options of inpainting; None: see `resolve_inpainting`.
        guidance_scale: Scale of classifier-free guidance; 1 switches guidance off.
        callback_on_step_end: See `PrITTIPipeline.generate`.
        keep: Names of the categories whose objects are kept inside of the region.

    Yields:
        One step per block. The last step contains the finished scenes in `canvases`.

    Raises:
        ValueError: The region is empty, or the scene does not fit the model (`require_blocks`).
    """
    if not region.any():
        raise ValueError(f"{scene}: the region contains no pixel of this scene")
    canvases, level_m = [scene] * len(indices), find_ground_height(scene, 0.0, 0.0)
    kept = select_kept_pixels(scene, keep, model.spec.grid.rows // model.latent_shape[-1]) if keep else None
    if keep:  # Objects of blocks that are regenerated later are not known.
        canvases = [hide_replaced_objects(scene, region, keep)] * len(indices)
    for number, (window, part) in enumerate(split_region(model, scene, region)):
        blocks = [to_block_frame(canvas, window, model.spec.grid, level_m) for canvas in canvases]
        known = [block for block, _ in blocks]
        generated = model.inpaint(
            known,
            [part] * len(known),
            [label] * len(known),
            contents,
            seed,
            [(index, number) if number else index for index in indices],
            repaint,
            guidance_scale,
            callback_on_step_end=callback_on_step_end,
            composite=False,
            keep=keep,
            kept_pixels=None if kept is None else [kept[scene.grid.intersect(window)[0]]] * len(known),
        )
        inside = np.zeros_like(region)
        inside[scene.grid.intersect(window)[0]] = part
        canvases = [
            composite_scenes(canvas, new.translate(*offset_m).crop(scene.grid), inside, contents, keep, kept)
            for canvas, new, (_, offset_m) in zip(canvases, generated, blocks, strict=True)
        ]
        yield InpaintStep(known, generated, part, canvases)


def extend_scene(
    model: SceneGenerator,
    scene: Scene,
    side: Side | str,
    label: str,
    seed: int = 0,
    overlap: float = 0.5,
    repaint: InpaintingConfig | None = None,
    guidance_scale: float = 1.0,
    callback_on_step_end: StepCallback | None = None,
) -> Scene:
    """Extend a scene on one side by (1 - overlap) of a block (see `PrITTIPipeline.outpaint`).

    Each new block is conditioned on the part of the scene that it overlaps. This part is transformed to the frame and
    the ground height of the block before it is encoded.

    Args:
        model: Model.
        scene: Scene, at least as large as one block.
        side: "ahead", "behind", "left" or "right".
        label: Label of all blocks.
        seed: Seed of the noise.
        overlap: Fraction of a block that overlaps the scene; it must correspond to a whole number of latent cells.
        repaint: Options of inpainting; None: see `resolve_inpainting`.
        guidance_scale: Scale of classifier-free guidance; 1 switches guidance off.
        callback_on_step_end: See `PrITTIPipeline.generate`.

    Returns:
        The extended scene.

    Raises:
        ValueError: The side is unknown, the overlap is not a whole number of cells, or the scene does not fit the model
            (`require_blocks`).
    """
    spec, block = model.spec, model.spec.grid
    require_blocks(model, scene)
    size = model.latent_shape[-1]
    step_px = BlockGrid.from_overlap(size, overlap).step * (block.rows // size)
    grid = expand_grid(scene.grid, side, step_px)
    canvas, level_m = scene.crop(grid), find_ground_height(scene, 0.0, 0.0)
    covered = np.zeros((grid.rows, grid.cols), bool)
    covered[grid.intersect(scene.grid)[0]] = True
    empty = make_empty_scene(scene.scene_id, scene.source, scene.sequence, scene.frame, spec)
    for number, window in enumerate(tile_side(grid, side, block, step_px)):
        here = grid.intersect(window)[0]
        unknown = ~covered[here]
        known, offset_m = to_block_frame(canvas, window, block, level_m)
        latent = model.encode([extrapolate_ground(known, unknown)])
        mask = make_latent_mask([unknown], model.latent_shape, "both").to(latent.device)
        latent = model.inpaint_latents(
            InpaintCondition(latent, mask),
            [label],
            seed,
            [(number, step_px, grid.rows, grid.cols, get_args(Side).index(side))],
            repaint,
            guidance_scale,
            callback_on_step_end,
            OUTPAINT,
        )
        generated = model.decode(latent, [empty])[0]
        new = extract_new_part(generated, known, unknown).translate(*offset_m)
        before = covered.copy()
        covered[here] = True
        canvas = merge_scenes([canvas, new.crop(grid)], [before, covered & ~before], canvas)
    return canvas
