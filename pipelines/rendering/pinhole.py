"""Render classes, instances and depth of a Scene for a pinhole camera.

The result is exact and deterministic. In the image plane, 1 / depth is linear over a flat triangle. The code for
vertical rays (rasterize.py) can therefore cast camera rays; 1 / depth replaces the height. The intersection of a ray
with an ellipsoid is exact: it is the solution of a quadratic equation. The camera frame is that of KITTI-360: x right,
y down, z forward, in metres. Pixel centres have integer coordinates (u to the right, v down).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from models.scene import ELLIPSOID, Grid, Scene
from pipelines.geometry.rasterize import concatenate_ranges, fill_triangles, find_hits, list_integers_between
from pipelines.io.mesh_export import GROUND, Triangles, triangulate_cuboids, triangulate_ground
from pipelines.schema.palette import CATEGORY_IDS, CLASS_COLORS, EMPTY

NEAR_M = 0.1  # Surfaces closer to the camera than this distance are invisible.
# Rotation for a camera that looks along x
CAMERA_FROM_LEVEL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


@dataclass(frozen=True)
class Lens:
    """Camera intrinsics in pixels.

    The default is KITTI-360's rectified left camera, image_00 (calibration/perspective.txt).
    """

    width: int = 1408
    height: int = 376
    fx: float = 552.554261
    fy: float = 552.554261
    cx: float = 682.049453
    cy: float = 238.769549

    def resize(self, width: int, height: int) -> Lens:
        """Return the intrinsics of the same view at another image size.

        Args:
            width: New image width in pixels.
            height: New image height in pixels.

        Returns:
            The intrinsics.
        """
        x, y = width / self.width, height / self.height
        centre = (self.cx + 0.5) * x - 0.5, (self.cy + 0.5) * y - 0.5
        return Lens(width, height, self.fx * x, self.fy * y, *centre)


@dataclass(frozen=True, eq=False)
class StreetCamera:
    """A pinhole camera with its pose in a scene.

    Attributes:
        lens: Intrinsics.
        position_m: Position in the scene frame (m).
        camera_from_scene: Rotation from the scene frame to the camera frame.
    """

    lens: Lens
    position_m: np.ndarray  # (3,)
    camera_from_scene: np.ndarray  # (3, 3)

    @staticmethod
    def at(
        position_m: np.ndarray | Sequence[float], yaw_rad: float, pitch_rad: float = 0.0, lens: Lens | None = None
    ) -> StreetCamera:
        """Make a camera without roll.

        Args:
            position_m: (3,) position in the scene frame (m).
            yaw_rad: Angle of the view direction to the left of the scene's x axis (rad).
            pitch_rad: Upward angle of the view direction (rad).
            lens: Intrinsics (default: those of KITTI-360 at 704 x 188 pixels).

        Returns:
            The camera.
        """
        cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
        level_from_scene = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        cos, sin = np.cos(pitch_rad), np.sin(pitch_rad)
        pitched = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
        rotation = CAMERA_FROM_LEVEL @ pitched @ level_from_scene
        return StreetCamera(lens or Lens().resize(704, 188), np.asarray(position_m, float), rotation)

    def local(self, points_m: np.ndarray) -> np.ndarray:
        """Transform points from the scene frame to the camera frame.

        Args:
            points_m: (..., 3) points in the scene frame (m).

        Returns:
            (..., 3) points in the camera frame (m).
        """
        return (points_m - self.position_m) @ self.camera_from_scene.T


class StreetView(NamedTuple):
    """Rendered images of one camera, with H x W pixels.

    Attributes:
        class_id: Class id of the palette; EMPTY for sky.
        primitive: Index of the primitive in the scene; GROUND for ground and sky.
        depth_m: z in the camera frame (m); inf for sky.
        normal: Outward unit normal in the scene frame; 0 for sky.
    """

    class_id: np.ndarray  # uint8
    primitive: np.ndarray  # int32
    depth_m: np.ndarray  # float32
    normal: np.ndarray  # (H, W, 3) float32

    @property
    def semantic(self) -> np.ndarray:
        """Palette colour of each pixel: (H, W, 3) uint8 sRGB. The sky is white."""
        return CLASS_COLORS[self.class_id]

    def instance(self) -> np.ndarray:
        """Return the instance image (H, W) uint16: 0 for ground and sky, otherwise the index of the primitive + 1."""
        return (self.primitive + 1).astype(np.uint16)


class StreetRenderer:
    """Render one scene for many cameras. Data that do not depend on the camera are computed once."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        parts = triangulate_ground(scene), triangulate_cuboids(scene)
        self.soup = Triangles(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    @cached_property
    def normals(self) -> np.ndarray:
        """Unit normals of the triangles: (t, 3) float32."""
        a, b, c = np.moveaxis(self.soup.corners_m, 1, 0)
        normal = np.cross(b - a, c - a)
        return (normal / np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-12)).astype(np.float32)

    def view(self, camera: StreetCamera) -> StreetView:
        """Render the scene for a camera.

        Args:
            camera: Camera in the scene.

        Returns:
            Class, primitive, depth and normal of each pixel.
        """
        shape = camera.lens.height, camera.lens.width
        nearness, triangle = np.zeros(shape), np.full(shape, -1, np.int64)
        index, corners = _clip_in_front(camera.local(self.soup.corners_m), camera.lens)
        pixel, owner, value = find_hits(_project_to_image(corners, camera.lens), _list_pixels(camera.lens), index)
        fill_triangles(pixel, owner, value, nearness.reshape(-1), triangle.reshape(-1))

        flat = triangle >= 0
        class_id = np.where(flat, self.soup.class_id[triangle], EMPTY).astype(np.uint8)
        primitive = np.where(flat, self.soup.primitive[triangle], GROUND).astype(np.int32)
        normal = np.where(flat[..., None], self.normals[triangle], np.float32(0))
        pixel, ball, value = _intersect_ellipsoids(self.scene, camera)
        over = np.full(shape, GROUND, np.int64)
        fill_triangles(pixel, ball, value, nearness.reshape(-1), over.reshape(-1))
        row, col = np.nonzero(over != GROUND)
        class_id[row, col], primitive[row, col] = CATEGORY_IDS[ELLIPSOID], over[row, col]
        with np.errstate(divide="ignore"):
            depth_m = 1 / nearness
        normal[row, col] = self._ball_normals(camera, row, col, depth_m[row, col], over[row, col])
        return StreetView(class_id, primitive, depth_m.astype(np.float32), normal)

    def _ball_normals(
        self, camera: StreetCamera, row: np.ndarray, col: np.ndarray, depth_m: np.ndarray, primitive: np.ndarray
    ) -> np.ndarray:
        rays = _make_rays(camera.lens, row, col) * depth_m[:, None]
        point_m = rays @ camera.camera_from_scene + camera.position_m
        axes = self.scene.rotation / self.scene.size_m[:, None, :] ** 2
        gradient = (axes @ self.scene.rotation.transpose(0, 2, 1))[primitive]
        normal = np.einsum("kij,kj->ki", gradient, point_m - self.scene.center_m[primitive])
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _list_pixels(lens: Lens) -> Grid:
    """Return the image as a Grid (rasterize.py). At pixel coordinates (u, v), x = -v - 1/2 and y = -u - 1/2."""
    return Grid(0.0, 0.0, 1.0, lens.height, lens.width)


def _make_rays(lens: Lens, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the directions (k, 3) of the rays through pixels in the camera frame, with z = 1."""
    return np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones(len(u))], axis=1)


def _project_to_image(corners: np.ndarray, lens: Lens) -> np.ndarray:
    """Project triangles (t, 3, 3) with z > 0 from the camera frame to the grid of `_list_pixels`.

    The height is 1 / z.
    """
    x, y, z = np.moveaxis(corners, -1, 0)
    u, v = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
    return np.stack([-v - 0.5, -u - 0.5, 1 / z], axis=-1)


def _clip_in_front(corners: np.ndarray, lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Clip visible triangles (t, 3, 3) at z = NEAR_M in the camera frame. Return indices (k,) and corners (k, 3, 3)."""
    x, y, z = np.moveaxis(corners, -1, 0)
    left, right = (0 - 0.5 - lens.cx) / lens.fx, (lens.width - 0.5 - lens.cx) / lens.fx
    top, bottom = (0 - 0.5 - lens.cy) / lens.fy, (lens.height - 0.5 - lens.cy) / lens.fy
    beyond = [z < NEAR_M, x < left * z, x > right * z, y < top * z, y > bottom * z]
    index = np.flatnonzero(~np.any([side.all(axis=1) for side in beyond], axis=0))
    corners = corners[index]
    a, b, c = np.moveaxis(corners, 1, 0)
    faces_us = np.einsum("ki,ki->k", a, np.cross(b, c)) < 0  # Corners are counter-clockwise seen from outside.
    index, corners = index[faces_us], corners[faces_us]
    behind = (corners[..., 2] < NEAR_M).sum(axis=1)
    whole = np.flatnonzero(behind == 0)
    cut_index, cut = _cut(index, corners, behind)
    return np.concatenate([index[whole], cut_index]), np.concatenate([corners[whole], cut])


def _cut(index: np.ndarray, corners: np.ndarray, behind: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Clip triangles with one or two corners closer than NEAR_M.

    Each triangle gives one or two triangles at z >= NEAR_M.
    """
    found_index, found = [], []
    for count in (1, 2):
        some = np.flatnonzero(behind == count)
        near = corners[some, :, 2] < NEAR_M
        # Two corners lie on one side of the plane. The first corner is the corner on the other side.
        odd = np.argmax(near if count == 1 else ~near, axis=1)
        turned = corners[some[:, None], (odd[:, None] + np.arange(3)) % 3]
        first, second, third = np.moveaxis(turned, 1, 0)
        on_second, on_third = (_find_crossing(first, other) for other in (second, third))
        if count == 1:
            found += [np.stack([on_second, second, third], 1), np.stack([on_second, third, on_third], 1)]
            found_index += [index[some], index[some]]
        else:
            found.append(np.stack([first, on_second, on_third], 1))
            found_index.append(index[some])
    return np.concatenate(found_index), np.concatenate(found)


def _find_crossing(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the points (k, 3) where the lines from a to b (k, 3) cross z = NEAR_M."""
    share = (NEAR_M - a[:, 2]) / (b[:, 2] - a[:, 2])
    return a + share[:, None] * (b - a)


def _intersect_ellipsoids(scene: Scene, camera: StreetCamera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each ellipsoid and each pixel centre on it, return the flat pixel index, the primitive and 1 / depth (m,).

    A ray is the set of points t d, where the z of d is 1. The ray intersects the ellipsoid |M (t d - p)| = 1 where A
    t^2 - 2 B t + C = 0. Here, A = |M d|^2, B = d^T M^T M p and C = |M p|^2 - 1. A solution exists where B^2 - A C = d^T
    K d >= 0. In each row, the pixels with a solution form the interval between the roots of a quadratic. Ellipsoids
    that are not entirely in front of the camera are skipped.
    """
    lens = camera.lens
    primitive = np.flatnonzero(scene.category == ELLIPSOID)
    rotation = camera.camera_from_scene @ scene.rotation[primitive].astype(float)
    p = camera.local(scene.center_m[primitive].astype(float))
    reach_z = np.linalg.norm(rotation[:, 2, :] * scene.size_m[primitive] / 2, axis=1)
    ahead = p[:, 2] - reach_z > NEAR_M
    primitive, rotation, p = primitive[ahead], rotation[ahead], p[ahead]
    unit = rotation / (scene.size_m[primitive, None, :] / 2.0)  # M^T
    square = unit @ unit.transpose(0, 2, 1)
    b = np.einsum("kij,kj->ki", square, p)
    c = np.einsum("ki,ki->k", b, p) - 1
    cone = b[:, :, None] * b[:, None, :] - c[:, None, None] * square  # K
    # In pixel coordinates, the direction is d = J (u, v, 1).
    pixels = np.array([[1 / lens.fx, 0, -lens.cx / lens.fx], [0, 1 / lens.fy, -lens.cy / lens.fy], [0, 0, 1]])
    k = pixels.T @ cone @ pixels
    # The ellipsoid covers a row where the discriminant in u is positive. The discriminant is a quadratic in v
    # that opens downwards.
    qa = k[:, 0, 1] ** 2 - k[:, 0, 0] * k[:, 1, 1]
    qb = k[:, 0, 1] * k[:, 0, 2] - k[:, 0, 0] * k[:, 1, 2]
    qc = k[:, 0, 2] ** 2 - k[:, 0, 0] * k[:, 2, 2]
    root = np.sqrt(np.maximum(qb**2 - qa * qc, 0))
    first, count = list_integers_between((-qb + root) / qa, (-qb - root) / qa, lens.height)
    row, ball = concatenate_ranges(first, count), np.repeat(np.arange(len(primitive)), count)
    half = k[ball, 0, 1] * row + k[ball, 0, 2]
    rest = k[ball, 1, 1] * row**2 + 2 * k[ball, 1, 2] * row + k[ball, 2, 2]
    root = np.sqrt(np.maximum(half**2 - k[ball, 0, 0] * rest, 0))
    low, high = np.sort([(-half + root) / k[ball, 0, 0], (-half - root) / k[ball, 0, 0]], axis=0)
    first, count = list_integers_between(low, high, lens.width)
    col, row, ball = concatenate_ranges(first, count), np.repeat(row, count), np.repeat(ball, count)
    d = _make_rays(lens, row, col)
    of_d = np.einsum("ki,ki->k", b[ball], d)
    square_d = np.einsum("ki,kij,kj->k", d, square[ball], d)
    # The nearer root is computed as C / (B + sqrt). This avoids the difference of large numbers.
    inverse = (of_d + np.sqrt(np.maximum(of_d**2 - square_d * c[ball], 0))) / c[ball]
    return row * lens.width + col, primitive[ball], inverse


def shade_view(view: StreetView) -> np.ndarray:
    """Shade a street view in class colours with soft light and haze under a pale sky.

    Args:
        view: Rendered images of one camera.

    Returns:
        (H, W, 3) uint8 sRGB.
    """
    sun = np.array([0.35, -0.45, 0.82], np.float32)
    light = 0.62 + 0.38 * (view.normal @ sun).clip(0)
    haze = np.exp(-view.depth_m / 120.0)[..., None]
    rows = np.linspace(0, 1, view.class_id.shape[0], dtype=np.float32)[:, None, None]
    sky = np.array([188, 210, 232], np.float32) + rows * np.array([50, 34, 18], np.float32)
    color = view.semantic * light[..., None]
    picture = np.where(np.isfinite(view.depth_m)[..., None], haze * color + (1 - haze) * 232, sky)
    return picture.clip(0, 255).astype(np.uint8)
