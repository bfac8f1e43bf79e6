"""Define Drive, which holds all annotations along one sequence in the world frame.

Each reader returns a Drive. The same code therefore crops the Scenes of all sources (paper, supplement A, Dataset
Construction). This module depends only on numpy. The town can therefore be used without ray or pyarrow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np

from models.limits import require_within
from models.scene import Grid, Scene, canonicalize_boxes, make_yaw_rotation
from pipelines.geometry.rasterize import fill_polygon, rasterize_heights
from pipelines.schema.attribution import find_attribution

STATIC = -1
HIDDEN = -1  # Layer of LayeredGround without a ground class.
PART_PIXELS = 2**22  # Pixels of the bounding boxes of the triangles that are rasterised together.
EXTRUSION_M = 1e-3  # Maximum deviation of a slab's underside from a shifted copy of its top.


@dataclass(frozen=True)
class Pose:
    """Gravity-aligned ego pose in the world frame, with z up.

    Attributes:
        xyz_m: Position of the vehicle in the world frame (m).
        yaw_rad: Angle from the world's x axis to the vehicle's x axis (rad).
    """

    xyz_m: np.ndarray  # (3,) float64
    yaw_rad: float

    def to_ego(self, points_m: np.ndarray | Sequence[Any]) -> np.ndarray:
        """Transform points from the world frame to the ego frame.

        The subtraction uses float64, because world coordinates may be large.

        Args:
            points_m: (..., 3) points in the world frame (m).

        Returns:
            (..., 3) points in the ego frame (m).
        """
        return (np.asarray(points_m, np.float64) - self.xyz_m) @ make_yaw_rotation(self.yaw_rad)

    def to_world(self, points_m: np.ndarray | Sequence[Any]) -> np.ndarray:
        """Transform points from the ego frame to the world frame.

        Args:
            points_m: (..., 3) points in the ego frame (m).

        Returns:
            (..., 3) points in the world frame (m).
        """
        return np.asarray(points_m, np.float64) @ make_yaw_rotation(self.yaw_rad).T + self.xyz_m


@dataclass(frozen=True, eq=False)
class SlabGround:
    """Ground as extruded polygons (KITTI-360 and the town).

    Each polygon is a slab: a closed triangle mesh with one class.

    Attributes:
        slab_class: Index of each slab's class in the drive's ground_classes.
        vertices_m: Vertices in the world frame (m).
        vertex_slab: Index of each vertex's slab.
        triangles: Vertex indices; a triangle belongs to the slab of its first vertex.
    """

    slab_class: np.ndarray  # (s,)
    vertices_m: np.ndarray  # (v, 3) float64
    vertex_slab: np.ndarray  # (v,)
    triangles: np.ndarray  # (t, 3)

    def near(self, low_m: np.ndarray, high_m: np.ndarray) -> SlabGround:
        """Select the slabs that have a vertex in a rectangle.

        Args:
            low_m: (2,) lower corner in the world frame (m).
            high_m: (2,) upper corner in the world frame (m).

        Returns:
            The ground with only these slabs.
        """
        xy = self.vertices_m[:, :2]
        kept = np.zeros(len(self.slab_class), bool)
        kept[self.vertex_slab[((xy >= low_m) & (xy <= high_m)).all(axis=1)]] = True
        vertex, triangle = kept[self.vertex_slab], kept[self.vertex_slab[self.triangles[:, 0]]]
        return SlabGround(
            slab_class=self.slab_class[kept],
            vertices_m=self.vertices_m[vertex],
            vertex_slab=(np.cumsum(kept) - 1)[self.vertex_slab[vertex]],
            triangles=(np.cumsum(vertex) - 1)[self.triangles[triangle]],
        )

    @cached_property
    def _upper(self) -> tuple[np.ndarray, np.ndarray]:
        """Return all triangles except those of undersides, and the slab index of each triangle.

        Undersides are not needed: a vertical ray first hits the top or a side of an extruded slab. In KITTI-360's
        format, the second half of a slab's vertices is a copy of the first half that is shifted down.
        """
        count = np.bincount(self.vertex_slab, minlength=len(self.slab_class))
        place = np.arange(len(self.vertex_slab)) - (np.cumsum(count) - count)[self.vertex_slab]
        half = (count // 2)[self.vertex_slab]
        lower = place >= half
        down_m = self.vertices_m[lower] - self.vertices_m[np.flatnonzero(lower) - half[lower]]
        owner = self.vertex_slab[lower]
        first_m = down_m[np.unique(owner, return_index=True)[1]]
        same = np.abs(down_m - first_m[np.cumsum(np.diff(owner, prepend=owner[:1]) > 0)]).max(axis=1) < EXTRUSION_M
        extruded = count % 2 == 0
        extruded[owner[~same | (down_m[:, 2] >= 0)]] = False
        slab = self.vertex_slab[self.triangles[:, 0]]
        upper = ~(lower[self.triangles].all(axis=1) & extruded[slab])
        return self.triangles[upper], slab[upper]

    def rasterise(self, pose: Pose, grid: Grid, num_classes: int) -> tuple[np.ndarray, np.ndarray]:
        """Rasterise the tops of the slabs from above.

        As in the paper (supplement A), only ground polygons with at least one vertex in the crop are used.

        Args:
            pose: Ego pose of the scene.
            grid: Raster grid in the scene frame.
            num_classes: Number G of ground classes.

        Returns:
            height_m (G, H, W) float32 in the scene frame (m), and occupied (G, H, W) bool.

        Raises:
            LimitError: The ground exceeds the limit scene_coverage.
        """
        local = pose.to_ego(self.vertices_m)
        inside = np.zeros(len(self.slab_class), bool)
        inside[self.vertex_slab[grid.contains(local[:, 0], local[:, 1])]] = True
        triangles, slab = self._upper
        kept = np.flatnonzero(inside[slab])
        return _rasterize_triangles(local[triangles[kept]], grid, self.slab_class[slab[kept]], num_classes)


@dataclass(frozen=True, eq=False)
class MapGround:
    """Ground as map polygons with heights from a raster (Argoverse 2).

    Attributes:
        polygon_class: Index of each polygon's class in the drive's ground_classes.
        polygons_m: Outlines (n, 2) in the world frame (m). The world frame is the city frame.
        raster_m: Ground heights in the world frame (m); NaN marks unknown heights.
        raster_from_world: Similarity transform from world points to pixel coordinates (column, row).
    """

    polygon_class: list[int]
    polygons_m: list[np.ndarray]  # (n, 2) each
    raster_m: np.ndarray  # (rows, cols)
    raster_from_world: np.ndarray  # (3, 3)

    def near(self, low_m: np.ndarray, high_m: np.ndarray) -> MapGround:
        """Select the polygons whose bounding box intersects a rectangle.

        The height raster is not cropped.

        Args:
            low_m: (2,) lower corner in the world frame (m).
            high_m: (2,) upper corner in the world frame (m).

        Returns:
            The ground with only these polygons.
        """
        reach = [(p.max(axis=0) >= low_m).all() and (p.min(axis=0) <= high_m).all() for p in self.polygons_m]
        return replace(
            self,
            polygon_class=[k for k, keep in zip(self.polygon_class, reach, strict=True) if keep],
            polygons_m=[p for p, keep in zip(self.polygons_m, reach, strict=True) if keep],
        )

    def rasterise(self, pose: Pose, grid: Grid, num_classes: int) -> tuple[np.ndarray, np.ndarray]:
        """Rasterise the polygons.

        A pixel is occupied if a polygon covers its centre and the ground height is known.

        Args:
            pose: Ego pose of the scene.
            grid: Raster grid in the scene frame.
            num_classes: Number G of ground classes.

        Returns:
            height_m (G, H, W) float32 in the scene frame (m), and occupied (G, H, W) bool.

        Raises:
            LimitError: The ground exceeds the limit scene_coverage.
        """
        x, y = np.meshgrid(grid.x_m(), grid.y_m(), indexing="ij")
        world = pose.to_world(np.stack([x, y, np.zeros_like(x)], axis=-1))[..., :2]
        pixel = world @ self.raster_from_world[:2, :2].T + self.raster_from_world[:2, 2]
        col, row = np.floor(pixel[..., 0]).astype(np.int64), np.floor(pixel[..., 1]).astype(np.int64)
        rows, cols = self.raster_m.shape
        on_map = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
        surface = np.full(x.shape, np.nan)
        surface[on_map] = self.raster_m[row[on_map], col[on_map]]
        surface -= pose.xyz_m[2]
        height = np.full((num_classes, *x.shape), -np.inf, np.float32)
        work = 0
        for index, outline in zip(self.polygon_class, self.polygons_m, strict=True):
            local = pose.to_ego(np.column_stack([outline, np.zeros(len(outline))]))[:, :2]
            low, high = local.min(axis=0), local.max(axis=0)
            if high[0] < grid.back_m or low[0] > grid.front_m or high[1] < grid.right_m or low[1] > grid.left_m:
                continue
            work += x.size + len(local) * grid.rows
            require_within("scene_coverage", work, "ground polygons", is_partial=True)
            covered = fill_polygon(local, grid) & np.isfinite(surface)
            height[index][covered] = surface[covered]
        return _interpolate_heights(height)


@dataclass(frozen=True, eq=False)
class SurfaceGround:
    """Ground as triangles of the real surface (own drives).

    Each triangle has a class.

    Attributes:
        triangles_m: Corners in the world frame (m).
        triangle_class: Index of each triangle's class in the drive's ground_classes.
    """

    triangles_m: np.ndarray  # (t, 3, 3) float64
    triangle_class: np.ndarray  # (t,)

    def near(self, low_m: np.ndarray, high_m: np.ndarray) -> SurfaceGround:
        """Select the triangles whose bounding box intersects a rectangle.

        Args:
            low_m: (2,) lower corner in the world frame (m).
            high_m: (2,) upper corner in the world frame (m).

        Returns:
            The ground with only these triangles.
        """
        xy = self.triangles_m[..., :2]
        kept = ((xy.max(axis=1) >= low_m) & (xy.min(axis=1) <= high_m)).all(axis=1)
        return SurfaceGround(self.triangles_m[kept], self.triangle_class[kept])

    def rasterise(self, pose: Pose, grid: Grid, num_classes: int) -> tuple[np.ndarray, np.ndarray]:
        """Rasterise the surface at pixel centres.

        Where two surfaces of the same class overlap, the upper surface is used. In contrast to SlabGround, a polygon
        fills every pixel that it covers, even if it has no vertex in the crop. For example, a road of 1 km may have no
        vertex in the crop.

        Args:
            pose: Ego pose of the scene.
            grid: Raster grid in the scene frame.
            num_classes: Number G of ground classes.

        Returns:
            height_m (G, H, W) float32 in the scene frame (m), and occupied (G, H, W) bool.

        Raises:
            LimitError: The ground exceeds the limit scene_coverage.
        """
        middle_m = np.array([(grid.front_m + grid.back_m) / 2, (grid.left_m + grid.right_m) / 2, 0.0])
        center_m, reach_m = pose.to_world(middle_m)[:2], np.hypot(grid.rows, grid.cols) * grid.resolution_m / 2
        seen = self.near(center_m - reach_m, center_m + reach_m)
        return _rasterize_triangles(pose.to_ego(seen.triangles_m), grid, seen.triangle_class, num_classes)


@dataclass(frozen=True, eq=False)
class LayeredGround:
    """Ground as layers of triangles, of which the uppermost counts at each place (maps).

    Attributes:
        triangles_m: Corners in the world frame (m).
        triangle_layer: Index of each triangle's layer.
        layer_class: Index of each layer's class in the drive's ground_classes, from the top layer to the bottom layer;
            HIDDEN for layers without a class, such as buildings and water, which hide the layers below them.
        fill_class: Index of the class of places without a layer, at the height of the nearest ground in the crop; None:
            these places have no ground.
    """

    triangles_m: np.ndarray  # (t, 3, 3) float64
    triangle_layer: np.ndarray  # (t,)
    layer_class: tuple[int, ...]
    fill_class: int | None = None

    def near(self, low_m: np.ndarray, high_m: np.ndarray) -> LayeredGround:
        """Select the triangles whose bounding box intersects a rectangle.

        Args:
            low_m: (2,) lower corner in the world frame (m).
            high_m: (2,) upper corner in the world frame (m).

        Returns:
            The ground with only these triangles.
        """
        seen = SurfaceGround(self.triangles_m, self.triangle_layer).near(low_m, high_m)
        return replace(self, triangles_m=seen.triangles_m, triangle_layer=seen.triangle_class)

    def rasterise(self, pose: Pose, grid: Grid, num_classes: int) -> tuple[np.ndarray, np.ndarray]:
        """Rasterise the layers at pixel centres. Each pixel has at most one class.

        Args:
            pose: Ego pose of the scene.
            grid: Raster grid in the scene frame.
            num_classes: Number G of ground classes.

        Returns:
            height_m (G, H, W) float32 in the scene frame (m), and occupied (G, H, W) bool.

        Raises:
            LimitError: The ground exceeds the limit scene_coverage.
        """
        surface = SurfaceGround(self.triangles_m, self.triangle_layer)
        layer_height, covered = surface.rasterise(pose, grid, len(self.layer_class))
        height = np.zeros((num_classes, grid.rows, grid.cols), np.float32)
        occupied = np.zeros(height.shape, bool)
        free = np.ones(height.shape[1:], bool)
        for layer, index in enumerate(self.layer_class):
            if index != HIDDEN:
                seen = covered[layer] & free
                height[index][seen] = layer_height[layer][seen]
                occupied[index] |= seen
            free &= ~covered[layer]
        if self.fill_class is not None and free.any() and occupied.any():
            from scipy.ndimage import distance_transform_edt  # The town needs only numpy.

            _, (row, col) = cast(tuple, distance_transform_edt(~occupied.any(axis=0), return_indices=True))
            nearest_m = height.max(axis=0, where=occupied, initial=-np.inf)[row, col]
            height[self.fill_class][free] = nearest_m[free]
            occupied[self.fill_class] |= free
        return height, occupied


def _rasterize_triangles(
    triangles_m: np.ndarray, grid: Grid, layer: np.ndarray, num_layers: int
) -> tuple[np.ndarray, np.ndarray]:
    """Rasterise triangles in the scene frame, in parts that need little memory.

    Args:
        triangles_m: (t, 3, 3) corners (m).
        grid: Raster grid.
        layer: (t,) ground class of each triangle.
        num_layers: Number of ground classes.

    Returns:
        height_m (G, H, W) float32 (m), and occupied (G, H, W) bool.

    Raises:
        LimitError: The triangles lie above each other so often that rasterising them would need minutes.
    """
    xy = triangles_m[..., :2]
    border_m = np.array([[grid.back_m, grid.right_m], [grid.front_m, grid.left_m]])
    extent_m = np.minimum(xy.max(axis=1), border_m[1]) - np.maximum(xy.min(axis=1), border_m[0])
    pixels = np.prod(np.ceil(np.maximum(extent_m, 0.0) / grid.resolution_m) + 1, axis=1)
    total = np.cumsum(pixels)
    if len(total):
        require_within("scene_coverage", int(total[-1]), "ground triangles")
    height_m = np.full((num_layers, grid.rows, grid.cols), -np.inf, np.float32)
    cuts = np.searchsorted(total, np.arange(PART_PIXELS, total[-1] if len(total) else 0, PART_PIXELS))
    for part in np.split(np.arange(len(triangles_m)), np.unique(cuts)):
        if len(part):
            drawn_m = rasterize_heights(triangles_m[part], grid, np.asarray(layer)[part], num_layers)
            np.maximum(height_m, drawn_m, out=height_m)
    return _interpolate_heights(height_m)


def _interpolate_heights(height_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return float32 heights and the mask of pixels with a height.

    Pixels without a height have value -inf in the input and 0 in the result. The input is overwritten.
    """
    occupied = height_m > -np.inf
    height_m[~occupied] = 0.0
    return height_m.astype(np.float32, copy=False), occupied


def _compute_reach_m(grid: Grid) -> float:
    """Return the distance from the ego vehicle to the farthest corner of the crop (m)."""
    return float(np.hypot(max(abs(grid.front_m), abs(grid.back_m)), max(abs(grid.left_m), abs(grid.right_m))))


@dataclass(frozen=True, eq=False)
class Drive:
    """All n boxes, the ground and all p poses of one sequence.

    The world frame has z up; values are float64 (m).

    Attributes:
        source: Value of the source column.
        sequence: Name of the drive.
        category: Index into CATEGORIES.
        rotation: Orientation of each box in the world frame, as any proper rotation; scenes store the canonical form.
        size_m: Full extents along the columns of `rotation`.
        heading_rad: Yaw of the direction of travel in the world frame; NaN if unknown.
        instance_id: Number of the object, or -1.
        label: Class name in the source dataset.
        timestamp: Frame in which a moving box has this position; STATIC for static boxes.
        frame: Frame number of each pose.
        world_from_imu: Pose matrices of the IMU, whose x axis points forward.
        free_pose: Whether a pose lies at any place and heading instead of being that of a vehicle (default: False).
    """

    source: str
    sequence: str
    category: np.ndarray  # (n,) int8
    center_m: np.ndarray  # (n, 3)
    rotation: np.ndarray  # (n, 3, 3)
    size_m: np.ndarray  # (n, 3)
    heading_rad: np.ndarray  # (n,)
    instance_id: np.ndarray  # (n,) int64
    label: np.ndarray  # (n,) str objects
    timestamp: np.ndarray  # (n,) int64
    ground_classes: tuple[str, ...]
    ground: SlabGround | MapGround | SurfaceGround | LayeredGround
    frame: np.ndarray  # (p,) int64
    world_from_imu: np.ndarray  # (p, 3, 4)
    free_pose: np.ndarray | None = None  # (p,) bool

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.frame)

    def at(self, poses: np.ndarray, grid: Grid | None = None) -> Drive:
        """Select poses and the content that can lie in their crops.

        A smaller drive makes cropping faster.

        Args:
            poses: Indices of the poses.
            grid: Raster grid of the scenes (default: the paper's).

        Returns:
            The drive with only these poses.
        """
        xy = self.world_from_imu[poses, :2, 3]
        reach_m = _compute_reach_m(grid or Grid())
        low_m, high_m = xy.min(axis=0) - reach_m, xy.max(axis=0) + reach_m
        near = ((self.center_m[:, :2] >= low_m) & (self.center_m[:, :2] <= high_m)).all(axis=1)
        near &= (self.timestamp == STATIC) | np.isin(self.timestamp, self.frame[poses])
        per_box = ("category", "center_m", "rotation", "size_m", "heading_rad", "instance_id", "label", "timestamp")
        return replace(
            self,
            **{name: getattr(self, name)[near] for name in per_box},
            ground=self.ground.near(low_m, high_m),
            frame=self.frame[poses],
            world_from_imu=self.world_from_imu[poses],
            free_pose=None if self.free_pose is None else self.free_pose[poses],
        )

    def pose(self, index: int) -> Pose:
        """Return the gravity-aligned ego pose.

        This differs from the paper, which keeps pitch and roll.

        Args:
            index: Index of the pose.

        Returns:
            Position and yaw.
        """
        matrix = self.world_from_imu[index]
        return Pose(matrix[:, 3], float(np.arctan2(matrix[1, 0], matrix[0, 0])))

    def scene(self, index: int, split: str = "unused", grid: Grid | None = None) -> Scene:
        """Crop the Scene ahead of a pose.

        The scene contains the primitives with a centre in the crop, if they are static or belong to the frame of the
        pose.

        Args:
            index: Index of the pose.
            split: Value of the split column.
            grid: Raster grid of the scene (default: the paper's).

        Returns:
            The scene.

        Raises:
            LimitError: The scene exceeds the limit scene_primitives or scene_coverage.
        """
        grid = grid or Grid()
        pose, frame = self.pose(index), int(self.frame[index])
        near = np.abs(self.center_m[:, :2] - pose.xyz_m[:2]).max(axis=1) <= _compute_reach_m(grid)
        near = np.flatnonzero(near & ((self.timestamp == STATIC) | (self.timestamp == frame)))
        center = pose.to_ego(self.center_m[near])
        inside = grid.contains(center[:, 0], center[:, 1])
        near, center = near[inside], center[inside]
        require_within("scene_primitives", len(near), f"{self.sequence}, frame {frame}")
        rotation, size = canonicalize_boxes(make_yaw_rotation(-pose.yaw_rad) @ self.rotation[near], self.size_m[near])
        heading = (self.heading_rad[near] - pose.yaw_rad + np.pi) % (2 * np.pi) - np.pi
        height, occupied = self.ground.rasterise(pose, grid, len(self.ground_classes))
        x_m, y_m, z_m = (float(v) for v in pose.xyz_m)
        return Scene(
            scene_id=f"{self.source}-{self.sequence}-{frame:010d}",
            source=self.source,
            sequence=self.sequence,
            frame=frame,
            split=split,
            category=self.category[near],
            center_m=center.astype(np.float32),
            rotation=rotation.astype(np.float32),
            size_m=size.astype(np.float32),
            heading_rad=heading.astype(np.float32),
            instance_id=self.instance_id[near],
            label=self.label[near],
            ground_classes=self.ground_classes,
            height_m=height,
            occupied=occupied,
            grid=grid,
            world_xyz_m=(x_m, y_m, z_m),
            world_yaw_rad=pose.yaw_rad,
            world_from_imu=self.world_from_imu[index],
            free_pose=self.free_pose is not None and bool(self.free_pose[index]),
            attribution=find_attribution(self.source),
        )
