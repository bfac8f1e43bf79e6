"""Street plans as signed distances.

A street plan holds the signed distances to the border of the roads, and to the border of the paved area: roads and
sidewalks. Distances are positive inside. They change linearly across straight borders, so coarse pixels give the border
to a fraction of a pixel by interpolation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt, map_coordinates

from models.composition.road_sketch import ROAD, SIDEWALK, find_deep_contradiction
from models.scene import Grid, Scene
from models.street_planner import PIXEL_M

REACH_M = 8.0  # Distances are clipped to this length.
GAP_M = 12.0  # Gaps of up to this length between roads are closed when streets are drawn.


def measure_street_distances(road: np.ndarray, paved: np.ndarray, resolution_m: float) -> np.ndarray:
    """Compute signed distances from masks.

    Args:
        road: (rows, cols) bool mask of the roads.
        paved: (rows, cols) bool mask of roads and sidewalks.
        resolution_m: Side of a pixel of the masks (m). PIXEL_M must be an even number of these pixels.

    Returns:
        (2, h, w) float32 distances at the centres of pixels of PIXEL_M, positive inside, clipped to REACH_M (m).

    Raises:
        ValueError: The masks cannot be divided into pixels of PIXEL_M.
    """
    side = round(PIXEL_M / resolution_m)
    if side % 2 or abs(side * resolution_m - PIXEL_M) > 1e-6 or road.shape[0] % side or road.shape[1] % side:
        raise ValueError(
            f"masks of {road.shape} pixels of {resolution_m} m cannot be divided into pixels of {PIXEL_M} m with an"
            " even number of pixels per side"
        )
    found = []
    for mask in (road, paved):
        if mask.all() or not mask.any():
            distance_m = np.where(mask, np.inf, -np.inf)
        else:
            inside, outside = np.asarray(distance_transform_edt(mask)), np.asarray(distance_transform_edt(~mask))
            distance_m = (np.where(mask, inside - 0.5, 0.5 - outside)) * resolution_m
        distance_m = distance_m.clip(-REACH_M, REACH_M)
        half = side // 2
        parts = [distance_m[r::side, c::side] for r in (half - 1, half) for c in (half - 1, half)]
        found.append(np.mean(parts, axis=0))
    return np.stack(found).astype(np.float32)


@dataclass(frozen=True, eq=False)
class StreetDistances:
    """Signed distances on a rectangle, which outpainting takes as a map of all roads.

    Attributes:
        front_m: x of the front border (m, frame of block (0, 0)).
        left_m: y of the left border (m).
        distance_m: (2, rows, cols) distances at the centres of pixels of PIXEL_M (m). Row 0 is farthest ahead.
    """

    front_m: float
    left_m: float
    distance_m: np.ndarray

    def draw(self, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
        """Draw the roads on a grid, and close gaps between roads.

        Thin roads of generated plans have gaps. The mask of the roads is closed by a disc (morphological closing).

        Args:
            grid: Grid in the frame of block (0, 0).

        Returns:
            Masks (rows, cols) of the pixels of roads, and of roads and sidewalks. Outside of the rectangle, the nearest
            distances apply.
        """
        width = int(GAP_M / grid.resolution_m) + 1  # A pixel depends on others up to GAP_M away.
        margin_m = width * grid.resolution_m
        wide = Grid(
            grid.front_m + margin_m,
            grid.left_m + margin_m,
            grid.resolution_m,
            grid.rows + 2 * width,
            grid.cols + 2 * width,
        )
        row, col = (self.front_m - wide.x_m()) / PIXEL_M - 0.5, (self.left_m - wide.y_m()) / PIXEL_M - 0.5
        at = np.meshgrid(row, col, indexing="ij")
        road, paved = (map_coordinates(part, at, order=1, mode="nearest") >= 0 for part in self.distance_m)
        road |= _close(road, GAP_M / 2 / grid.resolution_m)
        inner = slice(width, -width)
        return road[inner, inner], (road | paved)[inner, inner]

    def find_contradiction(self, scene: Scene) -> tuple[float, float, str] | None:
        """Find given ground of another class inside of the roads.

        Args:
            scene: Given scene, in the frame of block (0, 0).

        Returns:
            x and y of such a point (m), and the class of the ground; None if there is no such ground.
        """
        return find_deep_contradiction(self.draw(scene.grid)[0], scene)


def _close(mask: np.ndarray, radius_px: float) -> np.ndarray:
    """Return the morphological closing of a mask by a disc. Values near the border of the mask are not exact."""
    if not mask.any():
        return mask
    grown = np.asarray(distance_transform_edt(~mask)) <= radius_px
    return np.asarray(distance_transform_edt(grown)) > radius_px if not grown.all() else grown


def read_street_masks(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the masks of the streets of a scene.

    Args:
        scene: Scene.

    Returns:
        Masks (rows, cols) of the pixels of roads, and of roads and sidewalks.

    Raises:
        ValueError: The scene has no ground class road or sidewalk.
    """
    if missing := {ROAD, SIDEWALK} - set(scene.ground_classes):
        raise ValueError(f"the ground of scene {scene.scene_id} has no class {min(missing)}, so it has no street plan")
    road, sidewalk = (scene.occupied[scene.ground_classes.index(name)] for name in (ROAD, SIDEWALK))
    return road, road | sidewalk
