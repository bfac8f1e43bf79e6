"""Roads that outpainting takes as known ground: centrelines, or a map of all roads of an area."""

from __future__ import annotations

import base64
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, cast, runtime_checkable

import numpy as np
from scipy.ndimage import distance_transform_edt, map_coordinates

from models.scene import Grid, Scene

ROAD, SIDEWALK, TERRAIN = "road", "sidewalk", "terrain"
SAMPLING_M = 0.5  # Distance between the points at which a sketch is compared with given ground.
CORE_M = 1.5  # Pixels of a map that lie deeper inside of a road are compared with given ground.
MAX_CONTRADICTION = 0.05  # Largest share of these pixels that may lie on other ground of the given scene.


@runtime_checkable
class Streets(Protocol):
    """Streets that outpainting takes as known ground: a sketched road, a map or a plan."""

    def draw(self, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
        """Draw the streets on a grid.

        Args:
            grid: Grid in the frame of block (0, 0).

        Returns:
            Masks (rows, cols) of the pixels of roads, and of roads and sidewalks.
        """
        ...

    def find_contradiction(self, scene: Scene) -> tuple[float, float, str] | None:
        """Find a point of the streets on given ground of another class.

        Args:
            scene: Given scene, in the frame of block (0, 0).

        Returns:
            x and y of such a point (m), and the class of the ground; None if there is no such point.
        """
        ...


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

    def draw(self, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
        """Draw the road on a grid.

        Args:
            grid: Grid in the frame of the road.

        Returns:
            Masks (rows, cols) of the pixels of the road and of the road with its sidewalks.
        """
        reach, points = self.width_m / 2 + self.sidewalk_m, np.asarray(self.points_m, float)
        low, high = points.min(axis=0) - reach, points.max(axis=0) + reach
        if low[0] > grid.front_m or high[0] < grid.back_m or low[1] > grid.left_m or high[1] < grid.right_m:
            return np.zeros((grid.rows, grid.cols), bool), np.zeros((grid.rows, grid.cols), bool)
        distance = self.measure_distance(grid.x_m()[:, None], grid.y_m()[None, :])
        return distance <= self.width_m / 2, distance <= reach

    def find_contradiction(self, scene: Scene) -> tuple[float, float, str] | None:
        """Find a point of the centreline on given ground of another class.

        Args:
            scene: Given scene, in the frame of the road.

        Returns:
            x and y of the first such point (m), and the class of the ground; None if there is no such point.
        """
        points = np.asarray(self.points_m, float)
        for start, stop in zip(points[:-1], points[1:], strict=True):
            count = 2 + int(np.hypot(*(stop - start)) / SAMPLING_M)
            x_m, y_m = (np.linspace(start[k], stop[k], count) for k in (0, 1))
            inside = scene.grid.contains(x_m, y_m)
            if found := _find_other_ground(scene, x_m[inside], y_m[inside])[:1]:
                return found[0]
        return None


@dataclass(frozen=True)
class RoadMap:
    """All roads and sidewalks of an area, seen from above.

    Attributes:
        pixel_m: Side of a pixel (m).
        center_m: x and y of the centre of the map (m, frame of block (0, 0)).
        shape: Number of pixels along x and along y.
        packed: Classes of the pixels, packed by `from_classes`.

    Raises:
        ValueError: A number is not finite or out of range, or the classes do not fit the shape.
    """

    pixel_m: float
    center_m: tuple[float, float]
    shape: tuple[int, int]
    packed: str

    def __post_init__(self) -> None:
        if not 0.1 <= self.pixel_m <= 10.0 or not all(map(math.isfinite, self.center_m)):
            raise ValueError(f"pixel_m is {self.pixel_m}, center_m is {self.center_m}; expected 0.1 to 10, and numbers")
        if self.classes.max(initial=0) > 2:
            raise ValueError("a map of roads has the classes 0 (other), 1 (road) and 2 (sidewalk) only")

    @classmethod
    def from_classes(cls, classes: np.ndarray, pixel_m: float, center_m: tuple[float, float] = (0.0, 0.0)) -> RoadMap:
        """Make a map from the class of each pixel.

        Args:
            classes: (rows, cols) uint8: 0 other, 1 road, 2 sidewalk. The first row is farthest ahead, the first column
                leftmost.
            pixel_m: Side of a pixel (m).
            center_m: x and y of the centre of the map (m, frame of block (0, 0)).

        Returns:
            The map.
        """
        packed = base64.b64encode(zlib.compress(np.ascontiguousarray(classes, np.uint8).tobytes(), 9)).decode()
        rows, cols = classes.shape
        return cls(pixel_m, center_m, (rows, cols), packed)

    @cached_property
    def classes(self) -> np.ndarray:
        """(rows, cols) uint8 class of each pixel."""
        return np.frombuffer(zlib.decompress(base64.b64decode(self.packed)), np.uint8).reshape(self.shape)

    def draw(self, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
        """Draw the roads on a grid; borders run between the centres of pixels.

        Args:
            grid: Grid in the frame of block (0, 0).

        Returns:
            Masks (rows, cols) of the pixels of roads, and of roads and sidewalks.
        """
        rows, cols = self.shape
        row = (self.center_m[0] - grid.x_m()) / self.pixel_m + (rows - 1) / 2
        col = (self.center_m[1] - grid.y_m()) / self.pixel_m + (cols - 1) / 2
        top, left = (max(0, math.floor(at.min())) for at in (row, col))
        part = self.classes[top : math.ceil(row.max()) + 1, left : math.ceil(col.max()) + 1]
        if not part.size:
            return np.zeros((grid.rows, grid.cols), bool), np.zeros((grid.rows, grid.cols), bool)
        at = np.meshgrid(row - top, col - left, indexing="ij")
        road, paved = (
            map_coordinates(mask.astype(np.float32), at, order=1, mode="constant") >= 0.5
            for mask in (part == 1, part > 0)
        )
        return road, road | paved

    def find_contradiction(self, scene: Scene) -> tuple[float, float, str] | None:
        """Find given ground of another class inside of the roads.

        Args:
            scene: Given scene, in the frame of block (0, 0).

        Returns:
            x and y of such a point (m), and the class of the ground; None if at most MAX_CONTRADICTION of the pixels
            deep inside of the roads lie on other ground.
        """
        return find_deep_contradiction(self.draw(scene.grid)[0], scene)


def find_deep_contradiction(road: np.ndarray, scene: Scene) -> tuple[float, float, str] | None:
    """Find ground of another class deep inside of roads.

    Args:
        road: (rows, cols) bool mask of the roads on the grid of the scene.
        scene: Scene.

    Returns:
        x and y of such a point (m), and the class of the ground; None if at most MAX_CONTRADICTION of the pixels deep
        inside of the roads lie on other ground.
    """
    depth_m = np.asarray(distance_transform_edt(road)) * scene.grid.resolution_m
    row, col = np.nonzero(depth_m > CORE_M)
    found = _find_other_ground(scene, scene.grid.x_m()[row], scene.grid.y_m()[col])
    return found[len(found) // 2] if len(found) > MAX_CONTRADICTION * len(row) else None


def _find_other_ground(scene: Scene, x_m: np.ndarray, y_m: np.ndarray) -> list[tuple[float, float, str]]:
    """Return x, y (m) and the ground class of those points at which a scene has ground other than road."""
    classes = scene.surface()[1][scene.grid.pixel(x_m, y_m)]
    is_other = (classes >= 0) & (classes != scene.ground_classes.index(ROAD) if ROAD in scene.ground_classes else True)
    names = (scene.ground_classes[k] for k in classes[is_other])
    return [(float(x), float(y), name) for x, y, name in zip(x_m[is_other], y_m[is_other], names, strict=True)]


def draw_roads(roads: Sequence[Streets], grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Draw roads on a grid.

    Args:
        roads: Roads.
        grid: Grid in the frame of the roads.

    Returns:
        Masks (rows, cols) of the pixels of roads and of sidewalks, without common pixels.
    """
    road, paved = np.zeros((2, grid.rows, grid.cols), bool)
    for one in roads:
        of_road, with_sidewalks = one.draw(grid)
        road |= of_road
        paved |= with_sidewalks
    return road, paved & ~road


def add_sketched_ground(
    scene: Scene,
    roads: Sequence[Streets],
    where: np.ndarray,
    offset_m: tuple[float, float],
    level_m: float,
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
    return (put_streets(scene, road, sidewalk, level_m) if drawn.any() else scene), drawn


def keep_streets(scene: Scene) -> tuple[Scene, np.ndarray]:
    """Keep only the streets of a scene: terrain lies around them, at the height of the nearest street.

    Args:
        scene: Scene.

    Returns:
        The scene without objects, and the (rows, cols) bool mask of the pixels of roads and sidewalks. Without streets,
        the scene has no ground.

    Raises:
        ValueError: The scene has no class road, sidewalk or terrain.
    """
    surface_m, classes = scene.surface()
    names = scene.ground_classes
    road, sidewalk = (
        classes == names.index(name) if name in names else np.zeros_like(classes, bool) for name in (ROAD, SIDEWALK)
    )
    paved = road | sidewalk
    nothing = np.zeros_like(scene.occupied)
    bare = replace(scene.select(np.zeros(len(scene), bool)), occupied=nothing, height_m=np.zeros_like(scene.height_m))
    if not paved.any():
        return bare, paved
    bare = put_streets(bare, road, sidewalk, 0.0)
    _, (row, col) = cast(tuple, distance_transform_edt(~paved, return_indices=True))
    return replace(bare, height_m=bare.occupied * surface_m[row, col].astype(np.float32)), paved


def put_streets(scene: Scene, road: np.ndarray, sidewalk: np.ndarray, level_m: float) -> Scene:
    """Replace ground by streets.

    Args:
        scene: Scene whose ground is known or extrapolated; without ground, the surroundings of the streets are terrain.
        road: (rows, cols) bool mask of the roads.
        sidewalk: (rows, cols) bool mask of the sidewalks.
        level_m: Height of the ground if the scene has none (m).

    Returns:
        The scene with the streets.

    Raises:
        ValueError: The scene has no class road, sidewalk or terrain.
    """
    drawn = road | sidewalk
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
    return replace(scene, occupied=occupied, height_m=height_m)


def check_sketch(roads: Sequence[Streets], scene: Scene) -> None:
    """Check that roads do not contradict the ground of the given scene.

    Args:
        roads: Roads in the frame of the scene.
        scene: Given scene.

    Raises:
        ValueError: A road runs over ground of another class. The message states where.
    """
    for number, one in enumerate(roads, start=1):
        if found := one.find_contradiction(scene):
            x_m, y_m, name = found
            raise ValueError(
                f"road {number} of the sketch runs over {name} of scene {scene.scene_id} at ({x_m:.1f}, {y_m:.1f}) m;"
                " start the road on a road of the scene, or outside of the scene"
            )
