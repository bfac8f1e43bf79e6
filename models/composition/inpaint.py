"""Inpainting: which part of a scene to make anew, and the scene put together from both (paper, Sec. 3.3).

A region is a mask (rows, cols) over a scene's pixels, True = make anew. Regions are sets: join them with |, & and ~.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from models.composition.deduplicate import doubles
from models.composition.seam_blending import continued
from models.scene import Grid, Scene, joined, merge, yaw_rotation

Contents = Literal["both", "ground", "objects"]  # what to make anew inside a region


def polygon_contains(corners_m: Sequence[Sequence[float]], x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Whether points (x_m, y_m, broadcast together) lie inside a polygon of corners (x, y) in metres; even-odd rule.

    Raises ValueError for fewer than three corners or numbers that are not finite.
    """
    corners = np.asarray(corners_m, float)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.isfinite(corners).all():
        raise ValueError(f"polygon {np.asarray(corners_m).tolist()}: expected three or more corners (x, y) in metres")
    inside = np.zeros(np.broadcast_shapes(np.shape(x_m), np.shape(y_m)), bool)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if x0 != x1:  # does the edge cross the ray from the point towards +y?
            crosses = (x0 > x_m) != (x1 > x_m)
            inside ^= crosses & (y_m < y0 + (x_m - x0) / (x1 - x0) * (y1 - y0))
    return inside


def polygon_region(grid: Grid, corners_m: Sequence[Sequence[float]]) -> np.ndarray:
    """(rows, cols) pixels whose centre lies inside a polygon of corners (x, y) in metres (`polygon_contains`)."""
    return polygon_contains(corners_m, grid.x_m()[:, None], grid.y_m()[None, :])


def half_plane_region(grid: Grid, normal: Sequence[float], offset_m: float) -> np.ndarray:
    """(rows, cols) pixels at least `offset_m` along a direction (x, y), which need not have length 1.

    (1, 0) and 40: everything at least 40 m ahead. Raises ValueError for a direction of length 0.
    """
    direction = np.asarray(normal, float)
    if direction.shape != (2,) or not 0 < (length := np.hypot(*direction)) < np.inf:
        raise ValueError(f"direction {np.asarray(normal).tolist()}: expected (x, y) of a length above 0")
    along = direction[0] * grid.x_m()[:, None] + direction[1] * grid.y_m()[None, :]
    return along >= offset_m * length


def object_region(scene: Scene, primitives: Sequence[int], margin_m: float = 1.0) -> np.ndarray:
    """(rows, cols) pixels within the upright bounds of primitives, grown by a margin. IndexError for none of that number."""
    chosen = scene.select(np.asarray(primitives, int))
    region = np.zeros((scene.grid.rows, scene.grid.cols), bool)
    upright = yaw_rotation(chosen.yaw_rad)
    half_m = np.abs(np.swapaxes(upright, 1, 2) @ chosen.rotation) @ chosen.size_m[..., None] / 2 + margin_m
    for center, axes, half in zip(chosen.center_m, upright, half_m[:, :2, 0], strict=True):
        signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
        region |= polygon_region(scene.grid, center[:2] + (signs * half) @ axes[:2, :2].T)
    return region


def cells_of(region: np.ndarray, size: int) -> np.ndarray:
    """(size, size) latent cells that hold a pixel of a region. ValueError if pixels do not divide into cells."""
    rows, cols = region.shape
    if rows % size or cols % size:
        raise ValueError(f"a region of {rows} x {cols} pixels does not divide into {size} x {size} cells")
    return region.reshape(size, rows // size, size, cols // size).any(axis=(1, 3))


def whole_cells(region: np.ndarray, grid: Grid, size: int) -> np.ndarray:
    """The region grown to whole latent cells: what is really made anew."""
    return grid.enlarged(cells_of(region, size))


def latent_mask(regions: Sequence[np.ndarray], shape: tuple[int, int, int], contents: Contents) -> Tensor:
    """(b, c, h, w) float32, 1 = make anew: in a split latent the first half of the channels is the ground's.

    Raises ValueError for unknown contents.
    """
    if contents not in get_args(Contents):
        raise ValueError(f"contents {contents!r}, expected one of: {', '.join(get_args(Contents))}")
    channels, size, _ = shape
    cells = torch.from_numpy(np.stack([cells_of(region, size) for region in regions])).float()
    mask = cells[:, None].repeat(1, channels, 1, 1)
    if contents != "both":
        kept = slice(channels // 2, None) if contents == "ground" else slice(channels // 2)
        mask[:, kept] = 0
    return mask


def composited(scene: Scene, made: Scene, region: np.ndarray, contents: Contents) -> Scene:
    """The scene with what was made anew inside a region of whole cells; all else from the scene, bit for bit. New ground
    is bent near the border to go on from the given (borders.py).

    Pixels by place, primitives by the pixel under their centre. Decoders see the whole latent: what they say outside the
    region differs a little from the scene although the latent there does not. A known object near the border may so be
    decoded a little inside it: it is not put there again.
    """
    nothing = np.zeros_like(region)
    ground, objects = (nothing if contents == other else region for other in ("objects", "ground"))
    kept = merge([scene], [~objects], scene)
    made = continued(made.select(~doubles(made, kept)), scene, ground)
    of_ground = merge([scene, made], [~ground, ground], scene)
    new = merge([made], [objects], scene)
    both = joined([kept, new])
    return replace(scene, height_m=of_ground.height_m, occupied=of_ground.occupied, **both)
