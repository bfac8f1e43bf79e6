"""Join the tiles of a large scene that jobs/outpaint_scenes.py --tile-m wrote."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from models.scene import Scene, concatenate_primitives


def join_tiles(tiles: Sequence[Scene], back_m: float, right_m: float) -> Scene:
    """Join tiles to one scene, the inverse of `BlockComposer.cut_tiles` and `Tile.to_own_frame`.

    Args:
        tiles: Tiles of one large scene, each in its own frame; the first tile is that at the rear right corner.
        back_m: x of the rear border of the large scene, in the frame of its first block (m).
        right_m: y of the right border (m).

    Returns:
        The large scene, in the frame of its first block, with the ids and labels of the first tile.

    Raises:
        ValueError: A tile does not lie on the pixels of the others.
    """
    first = tiles[0]
    resolution_m = first.grid.resolution_m
    cos, sin = np.cos(first.world_yaw_rad), np.sin(first.world_yaw_rad)
    middle_m = right_m + first.grid.cols * resolution_m / 2
    parts = []
    for tile in tiles:
        dx, dy = np.subtract(tile.world_xyz_m, first.world_xyz_m)[:2]
        place = np.array([back_m + cos * dx + sin * dy, middle_m - sin * dx + cos * dy])
        # Tables hold the origin of a tile with limited precision. It lies on the border or in the middle of a pixel.
        half_px = resolution_m / 2
        exact = np.round(place / half_px) * half_px
        if np.abs(exact - place).max() > 0.2 * half_px:
            raise ValueError(f"scene {tile.scene_id} does not lie on the pixels of scene {first.scene_id}")
        parts.append(tile.translate(*map(float, exact)))
    front_m, left_m = (max(getattr(part.grid, name) for part in parts) for name in ("front_m", "left_m"))
    rows, cols = round((front_m - back_m) / resolution_m), round((left_m - right_m) / resolution_m)
    grid = replace(first.grid, front_m=front_m, left_m=left_m, rows=rows, cols=cols)
    shape = (len(first.ground_classes), rows, cols)
    height, occupied = np.zeros(shape, np.float32), np.zeros(shape, bool)
    for part in parts:
        here, there = grid.intersect(part.grid)
        height[:, *here], occupied[:, *here] = part.height_m[:, *there], part.occupied[:, *there]
    return replace(first, grid=grid, height_m=height, occupied=occupied, **concatenate_primitives(parts))
