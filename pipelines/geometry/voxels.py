"""Convert scenes to semantic voxels, which make the layouts of different methods comparable (paper, Sec. 4.1 Metrics,
Tab. 1).

These rules determine the class of a voxel:

* A primitive fills a voxel if it contains the centre of the voxel. This test of the centre is exact for rotated boxes
  and ellipsoids and includes the boundary (EDGE_M). If several primitives contain the centre, the finest category wins
  (PRECEDENCE). The order of primitives has no effect.
* Ground fills one voxel per column. This voxel contains the fused surface (`Scene.surface`) at the centre of the
  column. Primitives take precedence over ground.
* All other voxels are EMPTY. Class ids are those of the palette.

The paper does not define the range in z, the thickness of the ground, or the precedence of overlapping primitives.

The code stores a column of voxels as one integer with one bit per level. In each column, a primitive fills one run of
consecutive levels. A scene is therefore stored as a few hundred thousand runs instead of millions of voxels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from models.scene import CATEGORIES, CATEGORY_INDEX, ELLIPSOID, Grid, Scene
from models.voxel_grids import CLASS_BITS, NUM_CLASSES
from pipelines.geometry.rasterize import concatenate_ranges
from pipelines.schema.palette import CATEGORY_IDS, CLASS_COLORS, list_ground_ids

# Fine categories come before coarse ones. A traffic sign inside a tree crown is visible. A hedge inside a building is
# hidden.
PRECEDENCE = (
    "human",
    "two_wheelers",
    "traffic_control",
    "pole",
    "object",
    "vehicle_small",
    "vehicle_big",
    "construction_small",
    "vegetation_ellipsoid",
    "vegetation_cuboid",
    "construction_big",
)
EDGE_M = 1e-9  # A voxel centre within this distance of a primitive's boundary counts as inside.
LEVEL_AXIS = 1e-12  # A unit axis with |z| below this value counts as horizontal.
MAX_LEVELS = 64  # Number of bits in the integer of a column.
PART_COLUMNS = 2**20  # Number of columns that are processed together (100 MB).

assert sorted(PRECEDENCE) == sorted(CATEGORIES) and len(CLASS_COLORS) == NUM_CLASSES


@dataclass(frozen=True)
class VoxelGrid:
    """A voxel grid with one column of voxels per pixel of a horizontal grid. All levels have the same height.

    The default is the paper's 256 x 256 x 32 voxels, with an edge length of 0.25 m. The paper does not define the
    range in z.

    Attributes:
        columns: Horizontal grid, with one column of voxels per pixel.
        bottom_m: Lower end of the range in z, in the scene frame (m).
        top_m: Upper end of the range in z, in the scene frame (m).
        levels: Number of levels, at most 64.
    """

    columns: Grid = field(default_factory=Grid)
    bottom_m: float = -1.5
    top_m: float = 6.5
    levels: int = 32

    def __post_init__(self) -> None:
        if not 1 <= self.levels <= MAX_LEVELS:
            raise ValueError(f"VoxelGrid: levels is {self.levels}, expected 1 to {MAX_LEVELS}")
        if not (np.isfinite([self.bottom_m, self.top_m]).all() and self.bottom_m < self.top_m):
            raise ValueError(f"VoxelGrid: bottom_m {self.bottom_m} must lie below top_m {self.top_m}")

    @property
    def step_m(self) -> float:
        """Height of a voxel (m)."""
        return (self.top_m - self.bottom_m) / self.levels

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of rows, columns and levels."""
        return self.columns.rows, self.columns.cols, self.levels

    def z_m(self) -> np.ndarray:
        """Return the z of the voxel centres (levels,), ascending, in the scene frame (m)."""
        return self.bottom_m + (np.arange(self.levels) + 0.5) * self.step_m


def voxelize(scene: Scene, voxels: VoxelGrid) -> np.ndarray:
    """Convert a scene to voxels.

    Args:
        scene: Scene.
        voxels: Voxel grid in the scene frame.

    Returns:
        (rows, cols, levels) uint8 class ids. Rows and columns have the order of the rasters; level 0 is the lowest.
    """
    rows, cols, levels = voxels.shape
    # In entry k, the bits of all levels below k are set.
    below = np.array([2**k - 1 for k in range(levels + 1)], np.uint64)
    place = np.empty(len(CATEGORIES), np.int64)
    place[[CATEGORY_INDEX[name] for name in PRECEDENCE]] = np.arange(len(PRECEDENCE))
    filled = np.zeros((len(PRECEDENCE), rows * cols), np.uint64)
    for part in _split_parts(scene, voxels):
        for runs in (_compute_box_runs(part, voxels), _compute_ellipsoid_runs(part, voxels)):
            first, beyond = _find_levels(runs.low_m, runs.high_m, voxels)
            layer = (place * rows * cols)[part.category].take(runs.primitive)
            np.bitwise_or.at(filled.reshape(-1), layer + runs.column, below.take(beyond) & ~below.take(first))

    planes = np.zeros((CLASS_BITS, rows * cols), np.uint64)  # Plane b holds bit b of the class id of every voxel.
    taken = np.zeros(rows * cols, np.uint64)
    for column, name in zip(filled, PRECEDENCE, strict=True):
        _set_class(planes, column & ~taken, int(CATEGORY_IDS[CATEGORY_INDEX[name]]))
        taken |= column
    surface_m, class_id = _voxelize_ground(scene, voxels)
    inside = (surface_m >= voxels.bottom_m) & (surface_m < voxels.top_m)
    level = np.where(inside, (surface_m - voxels.bottom_m) / voxels.step_m, 0).astype(np.int64).clip(0, levels - 1)
    column = np.where(inside, below[level + 1] ^ below[level], np.uint64(0)) & ~taken
    _set_class(planes, column, class_id)
    return _unpack_grid(planes, levels).reshape(voxels.shape)


def _set_class(planes: np.ndarray, column: np.ndarray, class_id: np.ndarray | int) -> None:
    """Write a class id to the empty voxels in `column` (columns,).

    The class id is a single number, or an array with one number per column.
    """
    for bit, plane in enumerate(planes):
        has_bit = (class_id >> bit) & 1
        if isinstance(has_bit, np.ndarray):
            plane |= column * has_bit.astype(np.uint64)
        elif has_bit:
            plane |= column


def _unpack_grid(planes: np.ndarray, levels: int) -> np.ndarray:
    """Return (columns, levels) uint8 class ids from bit planes (bits, columns)."""
    out = np.zeros((planes.shape[1], levels), np.uint8)
    for bit, plane in enumerate(planes):
        octets = plane.astype("<u8").view(np.uint8).reshape(-1, 8)[:, : -(-levels // 8)]
        out |= np.unpackbits(octets, axis=1, count=levels, bitorder="little") << np.uint8(bit)
    return out


def _find_levels(low_m: np.ndarray, high_m: np.ndarray, voxels: VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
    """Return the first level with a centre in [low, high], and the level after the last such level.

    The two numbers are equal if no centre lies in the interval.
    """
    first = np.ceil((low_m - EDGE_M - voxels.bottom_m) / voxels.step_m - 0.5).clip(0, voxels.levels)
    beyond = np.floor((high_m + EDGE_M - voxels.bottom_m) / voxels.step_m + 0.5).clip(0, voxels.levels)
    return first.astype(np.int8), np.maximum(first, beyond).astype(np.int8)


def _voxelize_ground(scene: Scene, voxels: VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
    """Return the height (columns,) and the class id (columns,) of the fused surface at the centre of each column.

    The height is NaN where the scene has no ground.
    """
    grid = voxels.columns
    row, col = scene.grid.pixel(grid.x_m(), grid.y_m())
    within = ((row >= 0) & (row < scene.grid.rows))[:, None] & ((col >= 0) & (col < scene.grid.cols))
    pixels = np.ix_(row.clip(0, scene.grid.rows - 1), col.clip(0, scene.grid.cols - 1))
    surface_m, winner = (part[pixels].reshape(-1) for part in scene.surface())
    surface_m = np.where((winner >= 0) & within.reshape(-1), surface_m.astype(np.float64), np.nan)
    return surface_m, list_ground_ids(scene).take(winner, mode="wrap")


# ------------------------------------------------------------------------------------- vertical lines and primitives


class _Runs(NamedTuple):
    """Intersections of primitives with vertical lines through column centres."""

    column: np.ndarray  # (m,) flat index of the column.
    primitive: np.ndarray  # (m,) index of the primitive in the scene.
    low_m: np.ndarray  # (m,) z of the lower end. Because of rounding errors, the value may exceed high_m.
    high_m: np.ndarray  # (m,) z of the upper end.


def _split_parts(scene: Scene, voxels: VoxelGrid) -> Iterator[Scene]:
    """Yield the scene in parts that cover about PART_COLUMNS columns each.

    The division into parts limits the memory use, which would otherwise be high for the large primitives of an
    untrained model.
    """
    step_m = voxels.columns.resolution_m
    shadow_px = (np.abs(scene.rotation[:, :2]) @ scene.size_m[:, :, None])[..., 0] / step_m + 1
    columns = np.minimum(shadow_px.prod(axis=1, dtype=np.float64), voxels.columns.rows * voxels.columns.cols)
    part = columns.cumsum() // PART_COLUMNS
    for index in np.split(np.arange(len(scene)), np.flatnonzero(np.diff(part)) + 1):
        yield scene.select(index)


def _list_pixels(
    middle_m: np.ndarray, low_m: np.ndarray, high_m: np.ndarray, first_m: float, step_m: float, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """List the pixels along an axis whose centres lie in the intervals [middle + low, middle + high].

    For each pixel, the result holds the pixel number and the index of the interval. Pixel numbers decrease along the
    axis. The centre of a pixel lies at first_m - (pixel + .5) step_m.
    """
    at = (first_m - middle_m) / step_m - 0.5
    first = np.ceil(at - (high_m + EDGE_M) / step_m).clip(0, count).astype(np.int64)
    beyond = (np.floor(at - (low_m - EDGE_M) / step_m) + 1).clip(0, count).astype(np.int64)
    lengths = (beyond - first).clip(0)
    return concatenate_ranges(first, lengths), np.repeat(np.arange(len(lengths)), lengths)


def _compute_box_runs(scene: Scene, voxels: VoxelGrid) -> _Runs:
    """Compute the runs of all boxes. In each column, the run is the intersection of the box's three slabs."""
    grid, chosen = voxels.columns, np.flatnonzero(scene.category != ELLIPSOID)
    center_m, rotation = scene.center_m[chosen].astype(np.float64), scene.rotation[chosen].astype(np.float64)
    half_m = scene.size_m[chosen].astype(np.float64) / 2
    # (n, 3, 2): half edges, projected to the ground plane
    edges_m = np.swapaxes(rotation[:, :2] * half_m[:, None], 1, 2)
    reach_m = np.abs(edges_m[:, :, 0]).sum(axis=1)

    row, box = _list_pixels(center_m[:, 0], -reach_m, reach_m, grid.front_m, grid.resolution_m, grid.rows)
    dx = grid.x_m()[row] - center_m[box, 0]
    low_m, high_m = _list_shadow_pixels(edges_m, box, dx)
    col, span = _list_pixels(center_m[box, 1], low_m, high_m, grid.left_m, grid.resolution_m, grid.cols)
    dy = grid.y_m()[col] - center_m[box, 1].take(span)

    # In z, slab j covers the range center - (R_0j dx + R_1j dy) / R_2j ± half_j / |R_2j|. If R_2j is 0, the slab adds
    # no limit to the vertical projection of the box.
    leans = np.abs(rotation[:, 2]) > LEVEL_AXIS
    inverse = np.where(leans, 1.0, 0.0) / np.where(leans, rotation[:, 2], 1.0)
    reach_m = np.where(leans, half_m * np.abs(inverse), np.inf)
    along_x, along_y = rotation[:, 0] * inverse, rotation[:, 1] * inverse
    low_m, high_m = np.full(len(col), -np.inf), np.full(len(col), np.inf)
    for j in range(3):
        middle_m = (center_m[box, 2] - along_x[box, j] * dx).take(span) - along_y[box, j].take(span) * dy
        extent_m = reach_m[box, j].take(span)
        np.maximum(low_m, middle_m - extent_m, out=low_m)
        np.minimum(high_m, middle_m + extent_m, out=high_m)
    return _Runs(row[span] * np.int32(grid.cols) + col, chosen[box].take(span), low_m, high_m)


def _list_shadow_pixels(edges_m: np.ndarray, box: np.ndarray, dx_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For box[i], return the lower and upper y (m,) of its vertical projection at the x offset dx_m[i].

    All offsets are relative to the centre of the box. The projection of a box with half edges (n, 3, 2) is a hexagon
    that is point-symmetric about the centre. The upper side of the hexagon starts at the rearmost corner and follows
    the three edges, the steepest first.
    """
    backward = (edges_m[..., 0] < 0) | ((edges_m[..., 0] == 0) & (edges_m[..., 1] < 0))
    edges_m = np.where(backward[..., None], -edges_m, edges_m)
    steepest_first = np.argsort(-np.arctan2(edges_m[..., 1], edges_m[..., 0]), axis=1)
    x, y = np.moveaxis(np.take_along_axis(edges_m, steepest_first[..., None], axis=1), -1, 0)  # each is (n, 3)
    start = 2 * (np.cumsum(x, axis=1) - x) - x.sum(axis=1, keepdims=True)
    start, step, y = start[box], np.where(x > 0, 2 * x, 1)[box], y[box]
    upright = (x == 0)[box]  # An edge without extent in x always contributes its full length.

    def upper(dx: np.ndarray) -> np.ndarray:
        walked = np.where(upright, 1.0, ((dx[:, None] - start) / step).clip(0, 1))
        return (y * (2 * walked - 1)).sum(axis=1)

    return -upper(-dx_m), upper(dx_m)


def _compute_ellipsoid_runs(scene: Scene, voxels: VoxelGrid) -> _Runs:
    """Compute the runs of all ellipsoids.

    Let L be the Cholesky factor of R diag(size / 2)^2 R^T. An ellipsoid is the set of points center + L s with |s| <=
    1. L is lower triangular. Therefore x determines the first entry of s, and y then determines the second entry. The
    third entry of s lies between the two roots of a quadratic.
    """
    grid, chosen = voxels.columns, np.flatnonzero((scene.category == ELLIPSOID) & (scene.size_m > 0).all(axis=1))
    center_m = scene.center_m[chosen].astype(np.float64)
    half = scene.rotation[chosen].astype(np.float64) * (scene.size_m[chosen, None, :].astype(np.float64) / 2)
    lower = np.linalg.cholesky(half @ np.swapaxes(half, 1, 2))

    reach_m = lower[:, 0, 0]
    row, one = _list_pixels(center_m[:, 0], -reach_m, reach_m, grid.front_m, grid.resolution_m, grid.rows)
    s0 = ((grid.x_m()[row] - center_m[one, 0]) / reach_m[one]).clip(-1, 1)
    middle_m, reach_m = lower[one, 1, 0] * s0, lower[one, 1, 1] * np.sqrt(1 - s0**2)
    col, span = _list_pixels(
        center_m[one, 1], middle_m - reach_m, middle_m + reach_m, grid.left_m, grid.resolution_m, grid.cols
    )
    one, row, s0 = one.take(span), row.take(span), s0.take(span)
    s1 = (grid.y_m()[col] - center_m[one, 1] - lower[one, 1, 0] * s0) / lower[one, 1, 1]
    middle_m = center_m[one, 2] + lower[one, 2, 0] * s0 + lower[one, 2, 1] * s1
    reach_m = lower[one, 2, 2] * np.sqrt((1 - s0**2 - s1**2).clip(0))
    return _Runs(row * np.int32(grid.cols) + col, chosen[one], middle_m - reach_m, middle_m + reach_m)


# ------------------------------------------------------------------------------------- primitives outside of the range


@dataclass(frozen=True)
class OutsideCounts:
    """Numbers of ground columns and primitives above or below a voxel grid.

    The numbers of several scenes can be added.

    Attributes:
        ground: (2,) int64: number of columns with ground, and number of columns with ground outside the grid.
        objects: (11, 3) int64. For each category: number of all primitives, number of primitives at least partly
            outside the grid, and number of primitives wholly outside the grid.
    """

    ground: np.ndarray
    objects: np.ndarray

    def __add__(self, other: OutsideCounts) -> OutsideCounts:
        return OutsideCounts(self.ground + other.ground, self.objects + other.objects)


def count_outside(scene: Scene, voxels: VoxelGrid) -> OutsideCounts:
    """Count the ground columns and the primitives that lie outside the range in z.

    Args:
        scene: Scene.
        voxels: Voxel grid in the scene frame.

    Returns:
        The counts of one scene.
    """
    surface_m, _ = _voxelize_ground(scene, voxels)
    known = np.isfinite(surface_m)
    beyond = known & ((surface_m < voxels.bottom_m) | (surface_m >= voxels.top_m))
    half_m = np.abs(scene.rotation[:, 2]).astype(np.float64) * scene.size_m / 2  # Extent of each half axis along z.
    reach_m = np.where(scene.category == ELLIPSOID, np.sqrt((half_m**2).sum(axis=1)), half_m.sum(axis=1))
    low_m, high_m = scene.center_m[:, 2] - reach_m, scene.center_m[:, 2] + reach_m
    partly = (low_m < voxels.bottom_m) | (high_m > voxels.top_m)
    wholly = (high_m < voxels.bottom_m) | (low_m > voxels.top_m)
    counts = [np.bincount(scene.category[mask], minlength=len(CATEGORIES)) for mask in (partly | True, partly, wholly)]
    return OutsideCounts(np.array([known.sum(), beyond.sum()]), np.stack(counts, axis=1))
