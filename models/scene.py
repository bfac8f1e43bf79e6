"""Scene: one semantic layout of 64 m x 64 m, stored as arrays in metres (paper, Sec. 3.1).

Real and generated scenes use the same class and the same scene frame. The origin of the scene frame is the ego vehicle.
**x points forward, y to the left, and z up** (against gravity).

In the paper, the frame is also tilted by the pitch and roll of the IMU. Without this tilt, the ground of neighbouring
blocks fits together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

# Categories of the paper (supplement Tab. "object categories"). Slots of a layout have the same order.
CATEGORIES = (
    "vegetation_cuboid",
    "vegetation_ellipsoid",
    "vehicle_big",
    "vehicle_small",
    "two_wheelers",
    "human",
    "construction_big",
    "construction_small",
    "pole",
    "traffic_control",
    "object",
)
CATEGORY_INDEX = {name: index for index, name in enumerate(CATEGORIES)}
ELLIPSOID = CATEGORY_INDEX["vegetation_ellipsoid"]
VEGETATION = (CATEGORY_INDEX["vegetation_cuboid"], ELLIPSOID)
VEHICLES = (CATEGORY_INDEX["vehicle_big"], CATEGORY_INDEX["vehicle_small"])
# Objects to which a sign, a lamp or a signal can be attached, and the largest gap between an object and its support.
SUPPORTERS = tuple(CATEGORY_INDEX[name] for name in ("construction_big", "construction_small", "pole"))
SUPPORT_M = 0.3

# The paper's five ground classes and the crossings of Argoverse 2.
GROUND_CLASSES = ("road", "sidewalk", "parking", "terrain", "ground", "crossing")
KITTI_GROUND_CLASSES = GROUND_CLASSES[:5]
ROAD_CLASSES = ("road", "crossing")
DRIVABLE_CLASSES = (*ROAD_CLASSES, "parking")

DENSITIES = ("low", "medium", "high")

# Fields of a Scene with one row per primitive.
PER_PRIMITIVE = ("category", "center_m", "rotation", "size_m", "existence", "heading_rad", "instance_id", "label")


@dataclass(frozen=True)
class Grid:
    """Pixel grid in top view in the scene frame. Row 0 is farthest ahead; column 0 is leftmost.

    The centre of pixel (row, col) is x = front_m - (row + .5) resolution_m, y = left_m - (col + .5) resolution_m.

    Attributes:
        front_m: x of the front border (metres, scene frame).
        left_m: y of the left border (metres, scene frame).
        resolution_m: Side of a pixel (metres).
        rows: Number of rows.
        cols: Number of columns.
    """

    front_m: float = 64.0
    left_m: float = 32.0
    resolution_m: float = 0.25
    rows: int = 256
    cols: int = 256

    @property
    def back_m(self) -> float:
        """x of the rear border (metres, scene frame)."""
        return self.front_m - self.rows * self.resolution_m

    @property
    def right_m(self) -> float:
        """y of the right border (metres, scene frame)."""
        return self.left_m - self.cols * self.resolution_m

    def x_m(self) -> np.ndarray:
        """Return the x coordinates (rows,) of the pixel centres in metres."""
        return self.front_m - (np.arange(self.rows) + 0.5) * self.resolution_m

    def y_m(self) -> np.ndarray:
        """Return the y coordinates (cols,) of the pixel centres in metres."""
        return self.left_m - (np.arange(self.cols) + 0.5) * self.resolution_m

    def contains(self, x_m: Any, y_m: Any) -> Any:
        """Test whether points lie inside the rectangle of the grid.

        The front border and the left border belong to the rectangle; the other two borders do not.

        Args:
            x_m: x coordinates (metres, scene frame), as a number, an array or a tensor.
            y_m: y coordinates (metres, scene frame).

        Returns:
            Booleans with the broadcast shape of the inputs.
        """
        return (x_m > self.back_m) & (x_m <= self.front_m) & (y_m > self.right_m) & (y_m <= self.left_m)

    def intersect(self, other: Grid) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """Find the pixels in which this grid overlaps another grid.

        Args:
            other: Grid of the same resolution in the same frame.

        Returns:
            Row and column slices into this grid, then row and column slices into `other`.

        Raises:
            ValueError: The grids are not aligned to whole pixels.
        """
        row0 = (other.front_m - self.front_m) / self.resolution_m
        col0 = (other.left_m - self.left_m) / self.resolution_m
        aligned = np.allclose([row0, col0], np.round([row0, col0]), atol=1e-6)
        if other.resolution_m != self.resolution_m or not aligned:
            raise ValueError(f"{self} and {other} must have the same resolution and differ by whole pixels")
        here, there = [], []
        for ahead, count, others in ((round(row0), self.rows, other.rows), (round(col0), self.cols, other.cols)):
            start = max(0, -ahead)  # `ahead`: index of this grid's first pixel in the other grid.
            stop = max(start, min(count, others - ahead))
            here.append(slice(start, stop))
            there.append(slice(start + ahead, stop + ahead))
        return (here[0], here[1]), (there[0], there[1])

    def upsample_cells(self, cells: np.ndarray) -> np.ndarray:
        """Upsample values of cells to pixels by repeating them.

        Args:
            cells: (h, w) values; h must divide `rows` and w must divide `cols`.

        Returns:
            (rows, cols) values.
        """
        h, w = cells.shape
        return cells.repeat(self.rows // h, axis=0).repeat(self.cols // w, axis=1)

    def pixel(self, x_m: np.ndarray | float, y_m: np.ndarray | float) -> tuple[Any, Any]:
        """Find the pixel that contains each point.

        Args:
            x_m: x coordinates (metres, scene frame).
            y_m: y coordinates (metres, scene frame).

        Returns:
            Row and column indices as int64; they may lie outside the grid.
        """
        row = np.floor((self.front_m - np.asarray(x_m)) / self.resolution_m).astype(np.int64)
        col = np.floor((self.left_m - np.asarray(y_m)) / self.resolution_m).astype(np.int64)
        return row, col


def canonicalize_boxes(rotation: np.ndarray, size_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Order the axes of boxes: the most vertical axis is the height, length >= width, and yaw is in [-pi/2, pi/2).

    The boxes themselves do not change. Left-handed axes (determinant < 0) become right-handed, because a box equals its
    mirror image.

    Args:
        rotation: (n, 3, 3) matrices; their columns are the axes of the boxes in the scene frame.
        size_m: (n, 3) full extents along these axes (metres).

    Returns:
        rotation (n, 3, 3), right-handed with columns (length, width, height), and size_m (n, 3) = (l, w, h).
    """
    rotation, size_m = np.asarray(rotation), np.asarray(size_m)
    if len(size_m) == 0:
        return rotation.reshape(0, 3, 3), size_m.reshape(0, 3)
    up = np.abs(rotation[:, 2, :]).argmax(axis=1)
    rest = np.array([[1, 2], [2, 0], [0, 1]])[up]
    swap = np.take_along_axis(size_m, rest, 1) @ np.array([-1.0, 1.0]) > 0
    rest[swap] = rest[swap, ::-1]
    order = np.concatenate([rest, up[:, None]], axis=1)
    rotation = np.take_along_axis(rotation, order[:, None, :], axis=2)
    size_m = np.take_along_axis(size_m, order, axis=1)

    height_axis = rotation[:, :, 2] * np.where(rotation[:, 2, 2] < 0, -1.0, 1.0)[:, None]
    length_axis = rotation[:, :, 0]
    backward = (length_axis[:, 0] < 0) | ((length_axis[:, 0] == 0) & (length_axis[:, 1] > 0))
    length_axis = length_axis * np.where(backward, -1.0, 1.0)[:, None]
    width_axis = np.cross(height_axis, length_axis)
    return np.stack([length_axis, width_axis, height_axis], axis=2).astype(rotation.dtype), size_m


def compute_yaw(rotation: np.ndarray) -> np.ndarray:
    """Compute the yaw of the length axis.

    Args:
        rotation: (n, 3, 3) matrices; their columns are the axes of the boxes, and column 0 is the length axis.

    Returns:
        (n,) yaw in radians, in [-pi/2, pi/2) for canonical boxes.
    """
    return np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])


def make_yaw_rotation(yaw_rad: np.ndarray | float) -> np.ndarray:
    """Return rotation matrices about the z axis.

    Args:
        yaw_rad: Rotation angles, positive to the left (radians, any shape).

    Returns:
        (..., 3, 3) rotation matrices.
    """
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    zero, one = np.zeros_like(cos), np.ones_like(cos)
    rows = [np.stack(row, -1) for row in ([cos, -sin, zero], [sin, cos, zero], [zero, zero, one])]
    return np.stack(rows, -2)


UNSET = np.zeros(0)  # Placeholder that `Scene` replaces by an array of defaults.


@dataclass(frozen=True, eq=False)
class Scene:
    """One scene with n primitives and G ground classes on an H x W grid, in metres and radians in the scene frame.

    Attributes:
        scene_id: Unique id of the scene.
        source: Name of the source.
        sequence: Name of the drive; for generated scenes, the seed.
        frame: Index of the frame within the drive; for generated scenes, the index of the scene within the run.
        split: Name of the split.
        category: Category of each primitive.
        center_m: Centres.
        rotation: Rotation matrices, whose columns are the axes of the primitives in canonical order
            (`canonicalize_boxes`).
        size_m: Length, width and height: full extents along the columns of `rotation`.
        ground_classes: Names of the ground classes of the rasters.
        height_m: Ground height per ground class; 0 where `occupied` is False.
        occupied: Ground mask per ground class.
        grid: Pixel grid of the rasters.
        existence: Existence probability; 1 for annotated primitives.
        heading_rad: Direction of travel; NaN where it is unknown. Decoded primitives have no heading, because Cholesky
            parameters do not distinguish front and back.
        instance_id: Id of the object in the annotation of the source; -1: no id.
        label: Class name of the object in the annotation of the source; default: the name of the category.
        world_xyz_m: Position of the scene frame's origin in the world frame.
        world_yaw_rad: Yaw of the scene frame in the world frame.
        world_from_imu: (3, 4) full pose from the source; None: unknown.
        vegetation_density: Density label of the vegetation; None: unknown.
        vehicle_density: Density label of the vehicles; None: unknown.
        free_pose: Whether the scene is a crop at any place and heading; False for a view of a vehicle.
        attribution: Licence notice that copies of the scene must state; None if there is none.
    """

    scene_id: str
    source: str
    sequence: str
    frame: int
    split: str
    category: np.ndarray  # (n,) int8, index into CATEGORIES.
    center_m: np.ndarray  # (n, 3) float32
    rotation: np.ndarray  # (n, 3, 3) float32
    size_m: np.ndarray  # (n, 3) float32: length, width, height.
    ground_classes: tuple[str, ...]  # (G,) names from GROUND_CLASSES
    height_m: np.ndarray  # (G, H, W) float32
    occupied: np.ndarray  # (G, H, W) bool
    grid: Grid = field(default_factory=Grid)
    existence: np.ndarray = field(default_factory=lambda: UNSET)  # (n,) float32; default: 1
    heading_rad: np.ndarray = field(default_factory=lambda: UNSET)  # (n,) float32; default: NaN
    instance_id: np.ndarray = field(default_factory=lambda: UNSET)  # (n,) int64; default: -1
    label: np.ndarray = field(default_factory=lambda: UNSET)  # (n,) str; default: name of the category.
    world_xyz_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    world_yaw_rad: float = 0.0
    world_from_imu: np.ndarray | None = None
    vegetation_density: str | None = None
    vehicle_density: str | None = None
    free_pose: bool = False
    attribution: str | None = None

    def __post_init__(self) -> None:
        n = len(self.category)
        defaults = {
            "existence": np.ones(n, np.float32),
            "heading_rad": np.full(n, np.nan, np.float32),
            "instance_id": np.full(n, -1, np.int64),
            "label": np.array([CATEGORIES[c] for c in self.category], dtype=object),
        }
        for name, value in defaults.items():
            if getattr(self, name) is UNSET:
                object.__setattr__(self, name, value)
        shape = (len(self.ground_classes), self.grid.rows, self.grid.cols)
        expected = {"center_m": (n, 3), "rotation": (n, 3, 3), "size_m": (n, 3), "height_m": shape, "occupied": shape}
        expected |= {name: (n,) for name in defaults}
        for name, want in expected.items():
            got = getattr(self, name).shape
            if got != want:
                raise ValueError(f"scene {self.scene_id}: {name} has shape {got}, expected {want}")

    def __len__(self) -> int:
        return len(self.category)

    def __repr__(self) -> str:
        ground = f"{self.grid.rows} x {self.grid.cols} at {self.grid.resolution_m} m"
        return f"Scene({self.scene_id!r}, {len(self)} primitives, ground {ground})"

    @property
    def volume_m3(self) -> np.ndarray:
        """(n,) volume of each primitive (m^3): l w h for cuboids, pi/6 l w h for ellipsoids."""
        return self.size_m.prod(axis=1) * np.where(self.category == ELLIPSOID, np.pi / 6, 1.0)

    @property
    def yaw_rad(self) -> np.ndarray:
        """(n,) yaw of the length axis of each primitive (radians)."""
        return compute_yaw(self.rotation)

    @property
    def bottom_m(self) -> np.ndarray:
        """(n,) z coordinate of the lowest point of each primitive (metres, scene frame)."""
        half_m = 0.5 * np.abs(self.rotation[:, 2, :]) * self.size_m
        down_m = np.where(self.category == ELLIPSOID, np.sqrt((half_m**2).sum(axis=1)), half_m.sum(axis=1))
        return self.center_m[:, 2] - down_m

    def ground_under(self) -> tuple[np.ndarray, np.ndarray]:
        """Return height and class of the ground under the centre of each primitive, from the fused ground (`surface`).

        Returns:
            Height (n,) in metres and class (n,). If there is no ground, the height is NaN and the class is -1.
        """
        height_m, winner = self.surface()
        x_m, y_m = self.center_m[:, 0], self.center_m[:, 1]
        row, col = self.grid.pixel(x_m, y_m)
        pixel = row.clip(0, self.grid.rows - 1), col.clip(0, self.grid.cols - 1)
        known = self.grid.contains(x_m, y_m) & (winner[pixel] >= 0)
        return np.where(known, height_m[pixel], np.nan), np.where(known, winner[pixel], -1)

    def counts(self) -> np.ndarray:
        """Return the number of primitives per category as an array (11,)."""
        return np.bincount(self.category, minlength=len(CATEGORIES))

    def ground_area_m2(self) -> np.ndarray:
        """Return the occupied area (G,) of each ground class in m^2."""
        return self.occupied.sum(axis=(1, 2)) * self.grid.resolution_m**2

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Fuse the ground classes into one surface (paper, supplement B.2, Layout Reconstruction).

        At each pixel, the class with the greatest height is kept. If two classes have the same height, the class with
        the higher index is kept. A crossing therefore replaces the road under it.

        Returns:
            Height (H, W) in metres, and class (H, W) int8 as an index into `ground_classes`; -1: no ground.
        """
        top = np.full(self.height_m.shape[1:], -np.inf, np.float32)
        winner = np.full(top.shape, -1, np.int8)
        for k, (height, occupied) in enumerate(zip(self.height_m, self.occupied, strict=True)):
            higher = occupied & (height >= top)
            np.copyto(top, height, where=higher)
            np.copyto(winner, k, where=higher)
        np.copyto(top, 0, where=winner < 0)
        return top, winner

    def select(self, keep: np.ndarray | slice | Sequence[int]) -> Scene:
        """Return the scene with a subset of its primitives.

        Args:
            keep: Mask or indices of the primitives to keep. Indices also define the order of the result.

        Returns:
            The scene with these primitives and the same ground.
        """
        return replace(self, **{name: getattr(self, name)[keep] for name in PER_PRIMITIVE})

    def translate(self, dx_m: float, dy_m: float, dz_m: float = 0.0) -> Scene:
        """Return the scene moved by (dx, dy, dz), including primitives, ground and grid.

        Args:
            dx_m: Translation along x (metres).
            dy_m: Translation along y (metres).
            dz_m: Translation along z (metres).

        Returns:
            The moved scene.
        """
        grid = replace(self.grid, front_m=self.grid.front_m + dx_m, left_m=self.grid.left_m + dy_m)
        center = self.center_m + np.array([dx_m, dy_m, dz_m], np.float32)
        height = np.where(self.occupied, self.height_m + np.float32(dz_m), np.float32(0))
        return replace(self, center_m=center, height_m=height, grid=grid)

    def crop(self, grid: Grid) -> Scene:
        """Crop the scene to another grid. Pixels outside the scene are empty.

        Args:
            grid: Grid of the same resolution, aligned to whole pixels.

        Returns:
            The scene on `grid`, with all primitives whose centre lies inside `grid`.

        Raises:
            ValueError: The grids are not aligned.
        """
        here, there = grid.intersect(self.grid)
        shape = (len(self.ground_classes), grid.rows, grid.cols)
        height, occupied = np.zeros(shape, np.float32), np.zeros(shape, bool)
        height[:, *here], occupied[:, *here] = self.height_m[:, *there], self.occupied[:, *there]
        inside = grid.contains(self.center_m[:, 0], self.center_m[:, 1])
        return replace(self.select(inside), height_m=height, occupied=occupied, grid=grid)


def merge_scenes(scenes: list[Scene], owned: list[np.ndarray], like: Scene) -> Scene:
    """Merge scenes on the same grid. Each pixel comes from the scene that owns it.

    A primitive of a scene is kept if this scene owns the pixel under the centre of the primitive.

    Args:
        scenes: Scenes on `like.grid`.
        owned: One mask (H, W) bool per scene; True marks owned pixels. The masks are disjoint.
        like: Scene whose ids, labels, pose and grid are copied to the result.

    Returns:
        The merged scene; all fields except the content come from `like`.
    """
    height, occupied = np.zeros_like(like.height_m), np.zeros_like(like.occupied)
    parts = []
    for scene, mask in zip(scenes, owned, strict=True):
        height[:, mask], occupied[:, mask] = scene.height_m[:, mask], scene.occupied[:, mask]
        row, col = like.grid.pixel(scene.center_m[:, 0], scene.center_m[:, 1])
        row, col = row.clip(0, like.grid.rows - 1), col.clip(0, like.grid.cols - 1)
        parts.append(scene.select(mask[row, col]))
    return replace(like, height_m=height, occupied=occupied, **concatenate_primitives(parts))


def concatenate_primitives(scenes: Sequence[Scene]) -> dict[str, Any]:
    """Concatenate the primitives of scenes.

    Args:
        scenes: Scenes in order.

    Returns:
        Mapping from the name of each per-primitive field to its concatenated values.
    """
    return {name: np.concatenate([getattr(scene, name) for scene in scenes]) for name in PER_PRIMITIVE}
