"""Inpainting: select regions, and combine known and generated parts of scenes (paper, Sec. 3.3).

A region is a boolean mask (rows, cols) over the pixels of a scene; True marks the pixels to regenerate. The operators
|, & and ~ combine regions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from models.composition.deduplicate import find_regenerated_objects
from models.composition.seam_blending import blend_ground
from models.scene import CATEGORY_INDEX, Grid, Scene, concatenate_primitives, make_yaw_rotation, merge_scenes

Contents = Literal["both", "ground", "objects"]  # Part of the scene to regenerate inside a region.


def contains_points(corners_m: Sequence[Any] | np.ndarray, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Test whether points lie inside a polygon, by the even-odd rule.

    Args:
        corners_m: Corners (x, y) of the polygon (metres).
        x_m: x coordinates of the points (metres).
        y_m: y coordinates of the points (metres), broadcastable with `x_m`.

    Returns:
        Boolean per point.

    Raises:
        ValueError: There are fewer than three corners, or a number is not finite.
    """
    corners = np.asarray(corners_m, float)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.isfinite(corners).all():
        raise ValueError(f"polygon {np.asarray(corners_m).tolist()}: expected three or more corners (x, y) in metres")
    inside = np.zeros(np.broadcast_shapes(np.shape(x_m), np.shape(y_m)), bool)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if x0 != x1:  # Test whether the edge crosses the ray that starts at the point and runs towards +y.
            crosses = (x0 > x_m) != (x1 > x_m)
            inside ^= crosses & (y_m < y0 + (x_m - x0) / (x1 - x0) * (y1 - y0))
    return inside


def select_polygon(grid: Grid, corners_m: Sequence[Any] | np.ndarray) -> np.ndarray:
    """Select the pixels whose centre lies inside a polygon.

    Args:
        grid: Grid of the scene.
        corners_m: Corners (x, y) of the polygon (metres, scene frame).

    Returns:
        (rows, cols) bool.

    Raises:
        ValueError: There are fewer than three corners, or a number is not finite.
    """
    return contains_points(corners_m, grid.x_m()[:, None], grid.y_m()[None, :])


def select_half_plane(grid: Grid, normal: Sequence[float], offset_m: float) -> np.ndarray:
    """Select the pixels that lie at least `offset_m` from the origin along a direction.

    For example, normal (1, 0) and offset 40 select all pixels at least 40 m ahead.

    Args:
        grid: Grid of the scene.
        normal: Direction (x, y); its length must exceed 0 but has no effect.
        offset_m: Distance from the origin along the direction (metres).

    Returns:
        (rows, cols) bool.

    Raises:
        ValueError: The direction has length 0.
    """
    direction = np.asarray(normal, float)
    if direction.shape != (2,) or not 0 < (length := np.hypot(*direction)) < np.inf:
        raise ValueError(f"direction {np.asarray(normal).tolist()}: expected (x, y) of a length above 0")
    along = direction[0] * grid.x_m()[:, None] + direction[1] * grid.y_m()[None, :]
    return along >= offset_m * length


def select_around_objects(scene: Scene, primitives: Sequence[int] | np.ndarray, margin_m: float = 1.0) -> np.ndarray:
    """Select the pixels inside the bounding boxes of primitives; the boxes are first enlarged by a margin.

    Args:
        scene: Scene.
        primitives: Indices of the primitives.
        margin_m: Margin on all sides (metres).

    Returns:
        (rows, cols) bool.

    Raises:
        IndexError: The scene has no primitive with this index.
    """
    chosen = scene.select(np.asarray(primitives, int))
    region = np.zeros((scene.grid.rows, scene.grid.cols), bool)
    upright = make_yaw_rotation(chosen.yaw_rad)
    half_m = np.abs(np.swapaxes(upright, 1, 2) @ chosen.rotation) @ chosen.size_m[..., None] / 2 + margin_m
    for center, axes, half in zip(chosen.center_m, upright, half_m[:, :2, 0], strict=True):
        signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
        region |= select_polygon(scene.grid, center[:2] + (signs * half) @ axes[:2, :2].T)
    return region


def find_region_cells(region: np.ndarray, size: int) -> np.ndarray:
    """Find the latent cells that contain a pixel of a region.

    Args:
        region: (rows, cols) bool.
        size: Number of cells per side of the latent grid.

    Returns:
        (size, size) bool.

    Raises:
        ValueError: The pixels do not divide into `size` cells per side.
    """
    rows, cols = region.shape
    if rows % size or cols % size:
        raise ValueError(f"a region of {rows} x {cols} pixels does not divide into {size} x {size} latent cells")
    return np.any(region.reshape(size, rows // size, size, cols // size), axis=(1, 3))


def grow_to_cells(region: np.ndarray, grid: Grid, size: int) -> np.ndarray:
    """Enlarge a region to whole latent cells, because the model can regenerate only whole cells.

    Args:
        region: (rows, cols) bool.
        grid: Grid of the region.
        size: Number of cells per side of the latent grid.

    Returns:
        (rows, cols) bool.

    Raises:
        ValueError: The pixels do not divide into `size` cells per side.
    """
    return grid.upsample_cells(find_region_cells(region, size))


SOLID = ("construction_big", "construction_small", "vehicle_big", "vehicle_small")  # No object fits inside of these.


def find_kept_objects(scene: Scene, keep: Sequence[str]) -> np.ndarray:
    """Find the objects of some categories.

    Args:
        scene: Scene.
        keep: Names of categories.

    Returns:
        (n,) bool.

    Raises:
        ValueError: A name is no category.
    """
    if unknown := [name for name in keep if name not in CATEGORY_INDEX]:
        raise ValueError(f"category {unknown[0]!r}, expected some of: {', '.join(CATEGORY_INDEX)}")
    return np.isin(scene.category, [CATEGORY_INDEX[name] for name in keep])


def select_kept_pixels(scene: Scene, keep: Sequence[str], cell_px: int) -> np.ndarray:
    """Select the pixels whose objects are known if some categories are kept.

    These are the latent cells that contain the centre of a kept object, and the footprints of kept solid objects (of
    the categories SOLID), because no other object fits there.

    Args:
        scene: Scene.
        keep: Names of the categories whose objects are kept.
        cell_px: Side of a latent cell in pixels.

    Returns:
        (rows, cols) bool.

    Raises:
        ValueError: A name is no category.
    """
    kept = scene.select(find_kept_objects(scene, keep))
    solid = np.flatnonzero(find_kept_objects(kept, SOLID))
    found = select_around_objects(kept, solid, 0.0)
    x_m, y_m = kept.center_m[:, 0], kept.center_m[:, 1]
    inside = scene.grid.contains(x_m, y_m)
    row, col = scene.grid.pixel(x_m[inside], y_m[inside])
    at = np.arange(cell_px)
    row, col = row // cell_px * cell_px, col // cell_px * cell_px
    rows, cols = np.minimum(row[:, None] + at, scene.grid.rows - 1), np.minimum(col[:, None] + at, scene.grid.cols - 1)
    found[rows[:, :, None], cols[:, None, :]] = True
    return found


def make_latent_mask(
    regions: Sequence[np.ndarray],
    shape: tuple[int, int, int],
    contents: Contents | str,
    kept: Sequence[np.ndarray] = (),
) -> Tensor:
    """Convert regions to a mask of the latents.

    The first half of the channels of a split latent belongs to the ground, the second half to the objects.

    Args:
        regions: One mask (rows, cols) per scene.
        shape: Shape (c, h, w) of a latent.
        contents: Channels to regenerate: "both", "ground" or "objects".
        kept: For each scene, the pixels whose objects are kept (`select_kept_pixels`). In cells that consist of such
            pixels, the object channels are kept.

    Returns:
        (b, c, h, w) float32; 1 marks values to regenerate, 0 marks values to keep.

    Raises:
        ValueError: `contents` is unknown.
    """
    if contents not in get_args(Contents):
        raise ValueError(f"contents {contents!r}, expected one of: {', '.join(get_args(Contents))}")
    channels, size, _ = shape
    cells = torch.from_numpy(np.stack([find_region_cells(region, size) for region in regions])).float()
    mask = cells[:, None].repeat(1, channels, 1, 1)
    if contents != "both":
        kept_channels = slice(channels // 2, None) if contents == "ground" else slice(channels // 2)
        mask[:, kept_channels] = 0
    if len(kept):
        free = torch.from_numpy(np.stack([find_region_cells(~pixels, size) for pixels in kept])).float()
        mask[:, channels // 2 :] *= free[:, None]
    return mask


def hide_replaced_objects(scene: Scene, region: np.ndarray, keep: Sequence[str]) -> Scene:
    """Remove the objects that inpainting replaces.

    Args:
        scene: Scene.
        region: (rows, cols) bool, in whole latent cells.
        keep: Names of the categories whose objects are kept.

    Returns:
        The scene with its objects outside of the region, and with the kept objects inside of it.
    """
    inside = np.zeros(len(scene), bool)
    on_grid = scene.grid.contains(scene.center_m[:, 0], scene.center_m[:, 1])
    inside[on_grid] = region[scene.grid.pixel(scene.center_m[on_grid, 0], scene.center_m[on_grid, 1])]
    return scene.select(~inside | find_kept_objects(scene, keep))


def composite_scenes(
    scene: Scene,
    generated: Scene,
    region: np.ndarray,
    contents: Contents,
    keep: Sequence[str] = (),
    kept_pixels: np.ndarray | None = None,
) -> Scene:
    """Combine a scene with its regenerated part; everything outside the region is bit-identical to the input.

    Pixels inside the region come from the generated scene. A primitive lies in the region if the pixel under its centre
    lies in the region. Generated ground is blended into the known ground at the border (seam_blending.py).

    Decoders read the whole latent. Outside the region, the decoded scene therefore differs slightly from the input,
    although the latent there is the same. A known object near the border may be decoded slightly inside the region.
    Copies of known objects inside the region are removed.

    Args:
        scene: Input scene.
        generated: Decoded scene on the same grid.
        region: (rows, cols) bool, in whole latent cells.
        contents: Part of the scene that was regenerated.
        keep: Names of the categories whose objects are kept inside of the region. The generated scene adds no objects
            of these categories.
        kept_pixels: (rows, cols) bool; the generated scene adds no objects whose centre lies there.

    Returns:
        The combined scene.
    """
    nothing = np.zeros_like(region)
    ground, objects = (nothing if contents == other else region for other in ("objects", "ground"))
    kept = merge_scenes([scene], [~objects], scene)
    generated = blend_ground(generated.select(~find_regenerated_objects(generated, kept)), scene, ground)
    of_ground = merge_scenes([scene, generated], [~ground, ground], scene)
    if keep:
        kept_inside = scene.select(find_kept_objects(scene, keep))
        kept = replace(kept, **concatenate_primitives([kept, merge_scenes([kept_inside], [objects], scene)]))
        generated = generated.select(~find_kept_objects(generated, keep))
    free = objects if kept_pixels is None else objects & ~kept_pixels
    new = merge_scenes([generated], [free], scene)
    both = concatenate_primitives([kept, new])
    return replace(scene, height_m=of_ground.height_m, occupied=of_ground.occupied, **both)
