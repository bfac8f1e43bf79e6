"""Roads that a user draws, which outpainting takes as known ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from models.scene import Grid, Scene

ROAD, SIDEWALK, TERRAIN = "road", "sidewalk", "terrain"
SAMPLING_M = 0.5  # Distance between the points at which a sketch is compared with given ground.


@dataclass(frozen=True)
class SketchedRoad:
    """A road with sidewalks on both sides.

    Attributes:
        points_m: Points (x, y) of the centreline, at least two (m, frame of block (0, 0)).
        width_m: Width of the road.
        sidewalk_m: Width of each sidewalk; 0 for none.

    Raises:
        ValueError: There are fewer than two points, or a number is not finite or out of range.
    """

    points_m: tuple[tuple[float, float], ...]
    width_m: float = 7.0
    sidewalk_m: float = 2.0

    def __post_init__(self) -> None:
        points = np.asarray(self.points_m, float)
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2 or not np.isfinite(points).all():
            raise ValueError(f"points_m is {self.points_m}, expected two or more points [x, y] in metres")
        if not 2.0 <= self.width_m <= 40.0 or not 0.0 <= self.sidewalk_m <= 20.0:
            raise ValueError(
                f"width_m is {self.width_m}, sidewalk_m is {self.sidewalk_m}; expected 2 to 40 and 0 to 20"
            )

    def measure_distance(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Return the distance of points to the centreline.

        Args:
            x_m: x coordinates, broadcastable with `y_m` (m).
            y_m: y coordinates (m).

        Returns:
            Distances (m).
        """
        nearest = np.full(np.broadcast_shapes(np.shape(x_m), np.shape(y_m)), np.inf)
        points = np.asarray(self.points_m, float)
        for start, stop in zip(points[:-1], points[1:], strict=True):
            along, length2 = stop - start, float(np.square(stop - start).sum())
            share = ((x_m - start[0]) * along[0] + (y_m - start[1]) * along[1]) / max(length2, 1e-9)
            share = np.clip(share, 0, 1)
            distance = np.hypot(x_m - start[0] - share * along[0], y_m - start[1] - share * along[1])
            nearest = np.minimum(nearest, distance)
        return nearest


def draw_roads(roads: Sequence[SketchedRoad], grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Draw roads on a grid.

    Args:
        roads: Roads.
        grid: Grid in the frame of the roads.

    Returns:
        Masks (rows, cols) of the pixels of roads and of sidewalks, without common pixels.
    """
    road, sidewalk = np.zeros((2, grid.rows, grid.cols), bool)
    for one in roads:
        reach, points = one.width_m / 2 + one.sidewalk_m, np.asarray(one.points_m, float)
        low, high = points.min(axis=0) - reach, points.max(axis=0) + reach
        if low[0] > grid.front_m or high[0] < grid.back_m or low[1] > grid.left_m or high[1] < grid.right_m:
            continue
        distance = one.measure_distance(grid.x_m()[:, None], grid.y_m()[None, :])
        road |= distance <= one.width_m / 2
        sidewalk |= distance <= reach
    return road, sidewalk & ~road


def add_sketched_ground(
    scene: Scene, roads: Sequence[SketchedRoad], where: np.ndarray, offset_m: tuple[float, float], level_m: float
) -> tuple[Scene, np.ndarray]:
    """Replace ground by sketched roads.

    Args:
        scene: Scene whose ground is known or extrapolated; without ground, the surroundings of the roads are terrain.
        roads: Roads in the frame of block (0, 0).
        where: (rows, cols) bool mask of the pixels that may change.
        offset_m: x and y of the origin of the scene in the frame of block (0, 0) (m).
        level_m: Height of the roads if the scene has no ground (m).

    Returns:
        The scene, and the mask of the pixels of roads and sidewalks.

    Raises:
        ValueError: The scene has no class road, sidewalk or terrain.
    """
    grid = scene.grid
    there = replace(grid, front_m=grid.front_m + offset_m[0], left_m=grid.left_m + offset_m[1])
    road, sidewalk = (mask & where for mask in draw_roads(roads, there))
    drawn = road | sidewalk
    if not drawn.any():
        return scene, drawn
    if missing := [name for name in (ROAD, SIDEWALK, TERRAIN) if name not in scene.ground_classes]:
        raise ValueError(f"the ground of the model has no class {missing[0]}, so it cannot follow sketched roads")
    occupied, height_m = scene.occupied.copy(), scene.height_m.copy()
    surface_m = np.where(occupied, height_m, -np.inf).max(axis=0)
    if not occupied.any():
        occupied[scene.ground_classes.index(TERRAIN)] = True
    surface_m = np.where(np.isfinite(surface_m), surface_m, level_m).astype(np.float32)
    for k, name in enumerate(scene.ground_classes):
        own = {ROAD: road, SIDEWALK: sidewalk}.get(name, np.zeros_like(drawn))
        occupied[k] = np.where(drawn, own, occupied[k])
        height_m[k] = np.where(drawn & own | occupied[k] & ~scene.occupied[k], surface_m, height_m[k])
        height_m[k] *= occupied[k]
    return replace(scene, occupied=occupied, height_m=height_m), drawn


def check_sketch(roads: Sequence[SketchedRoad], scene: Scene) -> None:
    """Check that roads do not contradict the ground of the given scene.

    Args:
        roads: Roads in the frame of the scene.
        scene: Given scene.

    Raises:
        ValueError: A centreline runs over ground of another class. The message states where.
    """
    _, classes = scene.surface()
    for number, one in enumerate(roads, start=1):
        points = np.asarray(one.points_m, float)
        for start, stop in zip(points[:-1], points[1:], strict=True):
            count = 2 + int(np.hypot(*(stop - start)) / SAMPLING_M)
            x_m, y_m = (np.linspace(start[k], stop[k], count) for k in (0, 1))
            inside = scene.grid.contains(x_m, y_m)
            row, col = scene.grid.pixel(x_m[inside], y_m[inside])
            for k, (i, j) in enumerate(zip(row, col, strict=True)):
                found = int(classes[i, j])
                if found >= 0 and scene.ground_classes[found] != ROAD:
                    raise ValueError(
                        f"road {number} of the sketch runs over {scene.ground_classes[found]} of scene"
                        f" {scene.scene_id} at ({x_m[inside][k]:.1f}, {y_m[inside][k]:.1f}) m; start the road on a road"
                        " of the scene, or outside of the scene"
                    )
