"""Measure large scenes window by window, to find out whether a city changes with the distance from its centre.

A window is a square with sides of WINDOW_M, the size of a scene that a model generates at once. Window (i, j) lies i
windows ahead of the first one and j windows to its left. The ring of a window is max(|i|, |j|): ring 0 is the first
window, and ring 1 consists of the eight windows around it. Windows that reach beyond the scene are left out.

Streets, junctions and city blocks are measured on the whole scene, because the border of a window would cut them. A
city block is an area between roads, unlike a block of outpainting (glossary).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from models.scene import CATEGORIES, GROUND_CLASSES, ROAD_CLASSES, Grid, Scene
from pipelines.geometry.centerlines import RoadNetwork, extract_road_network
from pipelines.geometry.masks import label_parts
from pipelines.metrics.relations import fuse_ground
from pipelines.metrics.seams import FAR_M, MEASURES, NEAR_M, measure_scene_seams

WINDOW_M = 64.0
HECTARE_M2 = 10_000.0
BORDER_M = 4.0  # A road that ends this close to the border of the scene continues outside.
# Streets along the axes lie in the middle of a bin, so that small deviations do not change their bin.
ANGLE_EDGES_DEG = np.linspace(-5, 175, 19)
MIN_CITY_BLOCK_M2 = 100.0  # Smaller areas between roads are traffic islands.
SEAM_RECORD_SHAPE = (len(MEASURES), 2, 2)  # Shape of a record of seams.
DIRECTIONS = ("centre", "ahead", "left", "behind", "right")

QUANTITIES = (
    *(f"{category}_per_ha" for category in CATEGORIES),
    *(f"{name}_share" for name in GROUND_CLASSES),  # Share of the area of the window.
    "annotated_share",  # Share of the area with ground of any class.
    "road_m_per_ha",  # Length of the centrelines of roads (m).
    "junctions_per_ha",
    "dead_ends_per_ha",
    "slope",  # Mean inclination of the ground (m per m).
    "step_m",  # 99 % quantile of the height differences of neighbouring pixels.
    "level_m",  # Mean height of the ground (scene frame).
)


@dataclass(frozen=True, eq=False)
class Window:
    """One window of a city.

    Attributes:
        scene: Content of the window, moved to the frame of a scene of the model: x from 0 to WINDOW_M, y from
            -WINDOW_M / 2 to WINDOW_M / 2. Heights are those of the city.
        ahead: Number of windows between this one and the first one along x; negative behind it.
        left: Number of windows between this one and the first one along y; negative to the right.
    """

    scene: Scene
    ahead: int
    left: int

    @property
    def ring(self) -> int:
        """Ring of the window; 0 for the first window."""
        return max(abs(self.ahead), abs(self.left))

    @property
    def direction(self) -> str:
        """Direction from the first window: one of DIRECTIONS. Windows on a diagonal are ahead or behind."""
        if not self.ring:
            return DIRECTIONS[0]
        if abs(self.ahead) >= abs(self.left):
            return "ahead" if self.ahead > 0 else "behind"
        return "left" if self.left > 0 else "right"


@dataclass(frozen=True, eq=False)
class CityMeasurement:
    """Measures of the n windows of a city, and of the whole city.

    Attributes:
        windows: Windows, in the order of the rows of the arrays.
        quantities: Values of QUANTITIES per window; NaN where a value is undefined.
        angles_m: Length of the road centrelines of each window by direction, in bins of ANGLE_EDGES_DEG (m). The
            direction is measured from the x axis of the city.
        city_blocks_m2: Areas of the city blocks: parts between roads that do not touch the border of the city (m^2).
        connectivity: Share of road pixels in the largest 4-connected part; NaN without road.
    """

    windows: list[Window]
    quantities: np.ndarray  # (n, len(QUANTITIES))
    angles_m: np.ndarray  # (n, 18)
    city_blocks_m2: np.ndarray  # (b,)
    connectivity: float


def list_window_grids(grid: Grid, center_m: tuple[float, float] | None = None) -> list[tuple[int, int, Grid]]:
    """List the windows of a grid.

    Args:
        grid: Grid of the city.
        center_m: Centre (x, y) of the first window (m, scene frame), rounded to whole pixels. None: centre of the grid.

    Returns:
        For each window that lies entirely in the grid: number of windows ahead, to the left, and its grid.

    Raises:
        ValueError: The side of a window is no even number of pixels, or no window fits into the grid.
    """
    pixels = round(WINDOW_M / grid.resolution_m)
    if abs(pixels * grid.resolution_m - WINDOW_M) > 1e-6 or pixels % 2:
        raise ValueError(f"pixels of {grid.resolution_m} m: {WINDOW_M:g} m are no even number of pixels")
    x_m, y_m = center_m or ((grid.front_m + grid.back_m) / 2, (grid.left_m + grid.right_m) / 2)
    starts = [
        round((edge_m - middle_m) / grid.resolution_m) - pixels // 2
        for edge_m, middle_m in ((grid.front_m, x_m), (grid.left_m, y_m))
    ]
    steps = [
        range(-((count - pixels - start) // pixels), start // pixels + 1)
        for start, count in zip(starts, (grid.rows, grid.cols), strict=True)
    ]
    found = []
    for i in steps[0]:
        for j in steps[1]:
            front_m = grid.front_m - (starts[0] - i * pixels) * grid.resolution_m
            left_m = grid.left_m - (starts[1] - j * pixels) * grid.resolution_m
            found.append((i, j, Grid(front_m, left_m, grid.resolution_m, pixels, pixels)))
    if not found:
        raise ValueError(
            f"{grid.rows} x {grid.cols} pixels of {grid.resolution_m} m hold no window of {WINDOW_M:g} m around"
            f" ({x_m:g}, {y_m:g})"
        )
    return found


def measure_city(city: Scene, center_m: tuple[float, float] | None = None) -> CityMeasurement:
    """Measure the windows of a large scene, and the whole scene.

    Args:
        city: Scene, at least as large as one window.
        center_m: Centre (x, y) of the first window (m, scene frame). None: centre of the scene.

    Returns:
        Quantities per window, and streets, city blocks and connectivity of the whole scene.

    Raises:
        ValueError: No window fits into the scene (`list_window_grids`).
    """
    places = list_window_grids(city.grid, center_m)
    height_m, classes = fuse_ground(city)
    network = extract_road_network(city)
    junctions_m, ends_m = network.nodes_m[:, :2], find_dead_ends(network, city.grid)
    middle_m, length_m, bins = _split_roads(network)
    windows, rows, angles = [], [], []
    for ahead, left, grid in places:
        scene = city.crop(grid)
        moved = scene.translate(WINDOW_M - grid.front_m, WINDOW_M / 2 - grid.left_m)
        windows.append(Window(replace(moved, scene_id=f"{city.scene_id}/{ahead:+d}{left:+d}"), ahead, left))
        here, _ = city.grid.intersect(grid)
        inside = grid.contains(middle_m[:, 0], middle_m[:, 1])
        angles.append(np.bincount(bins[inside], length_m[inside], minlength=len(ANGLE_EDGES_DEG) - 1))
        streets = (
            angles[-1].sum(),
            *(grid.contains(points_m[:, 0], points_m[:, 1]).sum() for points_m in (junctions_m, ends_m)),
        )
        rows.append(_measure_window(scene, height_m[here], classes[here], streets))
    roads = np.isin(classes, [GROUND_CLASSES.index(name) for name in ROAD_CLASSES])
    return CityMeasurement(
        windows,
        np.array(rows),
        np.array(angles),
        measure_city_blocks_m2(roads, city.grid.resolution_m),
        _measure_connectivity(roads),
    )


def _measure_window(scene: Scene, height_m: np.ndarray, classes: np.ndarray, streets: tuple[float, ...]) -> list[float]:
    """Return the values of QUANTITIES of a window, of which `streets` holds those of the road network per window."""
    hectares = WINDOW_M**2 / HECTARE_M2
    known = classes >= 0
    shares = np.bincount(classes[known], minlength=len(GROUND_CLASSES)) / classes.size
    down_m, right_m = np.diff(height_m, axis=0), np.diff(height_m, axis=1)
    both_down, both_right = known[1:] & known[:-1], known[:, 1:] & known[:, :-1]
    corner = both_down[:, :-1] & both_right[:-1]  # Pixels with ground below and to the right.
    slope = step_m = np.nan
    if corner.any():
        steps_m = np.concatenate([np.abs(down_m[both_down]), np.abs(right_m[both_right])])
        slope = np.hypot(down_m[:, :-1][corner], right_m[:-1][corner]).mean() / scene.grid.resolution_m
        step_m = np.quantile(steps_m, 0.99)
    heights = [slope, step_m, height_m[known].mean() if known.any() else np.nan]
    per_hectare = np.array(streets) / hectares
    return [*(scene.counts() / hectares), *shares, known.mean(), *per_hectare, *heights]


def find_dead_ends(network: RoadNetwork, grid: Grid) -> np.ndarray:
    """Find the ends of roads that are neither at a junction nor at the border of the scene.

    Args:
        network: Roads.
        grid: Grid of the scene.

    Returns:
        Positions (n, 2) (m, scene frame).
    """
    ends = [
        road.xyz_m[point, :2] for road in network.roads for node, point in ((road.start, 0), (road.end, -1)) if node < 0
    ]
    ends_m = np.reshape(ends, (-1, 2))
    to_border_m = np.minimum(
        np.minimum(grid.front_m - ends_m[:, 0], ends_m[:, 0] - grid.back_m),
        np.minimum(grid.left_m - ends_m[:, 1], ends_m[:, 1] - grid.right_m),
    )
    return ends_m[to_border_m > BORDER_M]


def _split_roads(network: RoadNetwork) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return middle (p, 2), length (p,) and bin of ANGLE_EDGES_DEG (p,) of the pieces of all centrelines."""
    lines_m = [road.xyz_m[:, :2] for road in network.roads]
    first = np.concatenate([np.zeros((0, 2)), *(line[:-1] for line in lines_m)])
    last = np.concatenate([np.zeros((0, 2)), *(line[1:] for line in lines_m)])
    step_m = last - first
    angle_deg = (np.degrees(np.arctan2(step_m[:, 1], step_m[:, 0])) + 5) % 180 - 5
    bins = np.digitize(angle_deg, ANGLE_EDGES_DEG[1:-1])
    return (first + last) / 2, np.linalg.norm(step_m, axis=1), bins


def measure_city_blocks_m2(roads: np.ndarray, resolution_m: float) -> np.ndarray:
    """Measure the city blocks.

    Args:
        roads: (H, W) bool; True for each pixel of a road.
        resolution_m: Side of a pixel (m).

    Returns:
        Areas (b,) of the 4-connected parts without road that do not touch the border and have at least
        MIN_CITY_BLOCK_M2 (m^2).
    """
    parts, _ = label_parts(~roads)
    border = np.unique(np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]]))
    areas_m2 = np.bincount(parts.ravel()) * resolution_m**2
    areas_m2[border] = 0
    areas_m2[0] = 0  # Roads.
    return areas_m2[areas_m2 >= MIN_CITY_BLOCK_M2]


def _measure_connectivity(roads: np.ndarray) -> float:
    """Return the share of road pixels in the largest 4-connected part; NaN without road."""
    sizes = np.bincount(label_parts(roads)[0].ravel())[1:]
    return float(sizes.max() / sizes.sum()) if len(sizes) else float("nan")


def measure_seams_by_ring(
    city: Scene, rows: Sequence[int], cols: Sequence[int], center_m: tuple[float, float] | None = None
) -> dict[int, np.ndarray]:
    """Measure the seams of a city by the ring in which they lie.

    Each seam crosses the whole city. It is cut into pieces of WINDOW_M, and each piece is compared with nearby lines
    (`seams.measure_scene_seams`) on a strip along the seam.

    Args:
        city: Scene.
        rows: Pixel rows; a seam lies before each of these rows.
        cols: Pixel columns; a seam lies before each of these columns.
        center_m: Centre (x, y) of the first window (m, scene frame). None: centre of the scene.

    Returns:
        For each ring: sum of the records (4, 2, 2) of the seams whose middle lies in windows of this ring.

    Raises:
        ValueError: A seam lies on or beyond the edge of the scene.
    """
    grid = city.grid
    for line, count in [*((row, grid.rows) for row in rows), *((col, grid.cols) for col in cols)]:
        if not 0 < line < count:
            raise ValueError(
                f"scene {city.scene_id}: there is a seam before pixel {line}, expected pixels 1 to {count - 1}"
            )
    x_m, y_m = center_m or ((grid.front_m + grid.back_m) / 2, (grid.left_m + grid.right_m) / 2)
    origin_px = (grid.front_m - x_m) / grid.resolution_m, (grid.left_m - y_m) / grid.resolution_m
    side, reach = round(WINDOW_M / grid.resolution_m), round((FAR_M + NEAR_M) / grid.resolution_m)
    found: dict[int, np.ndarray] = {}
    for axis, lines in ((0, rows), (1, cols)):
        counts = (grid.rows, grid.cols)
        first_px = round(origin_px[1 - axis]) - side // 2  # Start of the first window along the seam.
        starts = range(first_px % side, counts[1 - axis] - side + 1, side)
        for line in lines:
            low, high = max(0, line - reach), min(counts[axis], line + reach)
            for start in starts:
                ranges = [(low, high), (start, start + side)]
                (row0, row1), (col0, col1) = ranges if axis == 0 else ranges[::-1]
                strip = city.crop(
                    Grid(
                        grid.front_m - row0 * grid.resolution_m,
                        grid.left_m - col0 * grid.resolution_m,
                        grid.resolution_m,
                        row1 - row0,
                        col1 - col0,
                    )
                )
                others = [other - low for other in lines if low < other < high and other != line]
                here = ([line - low], (), others) if axis == 0 else ((), [line - low], (), others)
                along_px, across_px = start + side / 2 - origin_px[1 - axis], line - origin_px[axis]
                ring = int(max(abs(along_px), abs(across_px)) / side + 0.5)  # A border belongs to the outer ring.
                found[ring] = found.get(ring, np.zeros(SEAM_RECORD_SHAPE)) + measure_scene_seams(strip, *here)
    return found
