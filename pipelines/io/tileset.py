"""3D Tiles 1.1: the tileset of a large scene whose tiles are GLB files (OGC 22-025r4).

A viewer of 3D Tiles loads the tiles near its camera. The coordinates of the tileset are those of the scene: metres, x
forward, y left, z up. Viewers rotate the content of each tile from y up (glTF) to z up.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from models.scene import Scene

# A viewer shows a tile if the error without it, as seen from the camera, exceeds some pixels. Without its content, a
# tile lacks objects up to the size of a building.
ERROR_M = 16.0
# Viewers rotate glTF's axes x, y, z to x, -z, y. These are y, -x and z of the scene (mesh_export.GLTF_FROM_SCENE).
SCENE_FROM_CONTENT = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], float)


class TileContent(NamedTuple):
    """A tile and its bounds.

    Attributes:
        name: Name of the GLB file without its ending.
        low_m: Lowest x, y and z of its content (m, frame of the tileset).
        high_m: Highest x, y and z.
        origin_m: Origin of the coordinates of the GLB file (m, frame of the tileset).
    """

    name: str
    low_m: Sequence[float]
    high_m: Sequence[float]
    origin_m: Sequence[float]


def find_tile_bounds(scene: Scene) -> tuple[list[float], list[float]]:
    """Return the bounds of the ground and of the boxes of a scene.

    Args:
        scene: Scene.

    Returns:
        Lowest and highest x, y and z (m, scene frame).
    """
    reach_m = 0.5 * np.einsum("nij,nj->ni", np.abs(scene.rotation), scene.size_m)
    height_m, ground_class = scene.surface()
    ground_m = height_m[ground_class >= 0]
    grid = scene.grid
    low = [[grid.back_m, grid.right_m, ground_m.min() if ground_m.size else 0.0], *(scene.center_m - reach_m).tolist()]
    high = [[grid.front_m, grid.left_m, ground_m.max() if ground_m.size else 0.0], *(scene.center_m + reach_m).tolist()]
    return np.min(low, axis=0).tolist(), np.max(high, axis=0).tolist()


def make_tileset(tiles: Sequence[TileContent]) -> dict[str, Any]:
    """Return the content of tileset.json.

    Args:
        tiles: Tiles, at least one. Their GLB files lie next to tileset.json.

    Returns:
        The tileset.

    Raises:
        ValueError: There is no tile.
    """
    if not tiles:
        raise ValueError("a tileset needs at least one tile")
    low, high = (
        pick([getattr(tile, name) for tile in tiles], axis=0) for pick, name in ((np.min, "low_m"), (np.max, "high_m"))
    )
    extent_m = float(np.linalg.norm(np.subtract(high, low)))
    children: list[dict[str, Any]] = []
    for tile in tiles:
        (x0, y0, z0), (x1, y1, z1) = np.subtract(tile.low_m, tile.origin_m), np.subtract(tile.high_m, tile.origin_m)
        children.append(
            {
                "boundingVolume": _make_box([y0, -x1, z0], [y1, -x0, z1]),
                "geometricError": 0.0,
                "content": {"uri": f"{tile.name}.glb"},
                "transform": [*SCENE_FROM_CONTENT.T[:3].ravel().tolist(), *map(float, tile.origin_m), 1.0],
            }
        )
    root = {"boundingVolume": _make_box(low, high), "geometricError": ERROR_M, "refine": "ADD", "children": children}
    return {"asset": {"version": "1.1"}, "geometricError": extent_m, "root": root}


def _make_box(low: Sequence[float] | np.ndarray, high: Sequence[float] | np.ndarray) -> dict[str, list[float]]:
    """Return a bounding volume: centre, then the half axes x, y and z."""
    (x, y, z), (dx, dy, dz) = (np.add(high, low) / 2).tolist(), (np.subtract(high, low) / 2).tolist()
    return {"box": [x, y, z, dx, 0.0, 0.0, 0.0, dy, 0.0, 0.0, 0.0, dz]}
