"""Orthographic cameras: views from above and oblique views, with exact ray casting of ellipsoids."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from models.scene import ELLIPSOID, Grid, Scene
from pipelines.geometry.rasterize import concatenate_ranges, fill_triangles, list_integers_between

FILL = 0.95  # Share of the image that the scene fills, in the direction (width or height) that limits the scale.
ROUNDING_M = 1e-6  # Tolerance for depths, larger than their rounding errors.
BELOW_M, ABOVE_M = 2.0, 14.0  # Vertical range that the camera covers, relative to the ego vehicle's origin.


@dataclass(frozen=True, eq=False)
class Camera:
    """An orthographic camera.

    In the camera frame, x points up and y points left in the image. The z axis points towards the viewer. Lengths are
    in metres.

    Attributes:
        camera_from_scene: Rotation from the scene frame to the camera frame.
        view: Pixel grid in the camera frame.
    """

    camera_from_scene: np.ndarray  # (3, 3)
    view: Grid  # Pixel grid in the camera frame.

    def turn(self, points_m: np.ndarray) -> np.ndarray:
        """Rotate points from the scene frame into the camera frame.

        Args:
            points_m: (..., 3) points in the scene frame (m).

        Returns:
            (..., 3) points in the camera frame (m).
        """
        return points_m @ self.camera_from_scene.T


def make_top_camera(view: Grid) -> Camera:
    """Return the camera that looks straight down. The camera frame equals the scene frame.

    Args:
        view: Pixel grid in the scene frame.

    Returns:
        The camera.
    """
    return Camera(np.eye(3), view)


def make_oblique_camera(grid: Grid, width: int, height: int, azimuth_deg: float, elevation_deg: float) -> Camera:
    """Return an oblique camera that shows the whole grid at the largest scale that fits the image.

    Args:
        grid: Horizontal extent of the scene.
        width: Image width in pixels.
        height: Image height in pixels.
        azimuth_deg: Angle of the view direction to the left of +x (forward), in degrees.
        elevation_deg: Downward angle of the view direction, in degrees, in (0, 90].

    Returns:
        The camera.

    Raises:
        ValueError: elevation_deg lies outside (0, 90].
    """
    if not 0 < elevation_deg <= 90:
        raise ValueError(f"elevation_deg is {elevation_deg}, expected a value in (0, 90]")
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    ahead, left = (
        np.array([np.cos(azimuth), np.sin(azimuth), 0]),
        np.array([-np.sin(azimuth), np.cos(azimuth), 0]),
    )
    up = np.sin(elevation) * ahead + np.array([0, 0, np.cos(elevation)])
    camera_from_scene = np.stack([up, left, np.cross(up, left)])

    box = [grid.back_m, grid.front_m], [grid.right_m, grid.left_m], [-BELOW_M, ABOVE_M]
    x, y, _ = camera_from_scene @ np.array(np.meshgrid(*box)).reshape(3, -1)
    resolution_m = max(np.ptp(x) / height, np.ptp(y) / width) / FILL
    front_m = (x.min() + x.max() + height * resolution_m) / 2
    left_m = (y.min() + y.max() + width * resolution_m) / 2
    return Camera(camera_from_scene, Grid(front_m, left_m, resolution_m, height, width))


def find_facing_sides(corners_m: np.ndarray) -> np.ndarray:
    """Find the triangles whose outer side faces +z.

    Args:
        corners_m: (t, 3, 3) corners, counter-clockwise seen from outside.

    Returns:
        Indices of the triangles that face the viewer.
    """
    x, y, _ = corners_m.T  # each is (3, t)
    return np.flatnonzero((x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]) > 1e-9)


def cast_ellipsoids(scene: Scene, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Find the nearest ellipsoid on the ray through each pixel centre.

    The intersection is exact, because no mesh approximates the ellipsoids.

    Args:
        scene: Scene.
        camera: Orthographic camera.

    Returns:
        depth_m (H, W) float64: z in the camera frame (m), -inf if there is no hit. primitive (H, W) int64: index of the
        primitive, -1 if there is no hit.
    """
    pixel, chord, chords = _compute_chords(scene, camera)
    shape = camera.view.rows, camera.view.cols
    depth, primitive = np.full(shape, -np.inf), np.full(shape, -1, np.int64)
    value = _compute_depth_m(pixel, chord, chords, camera.view)
    fill_triangles(pixel, chords.primitive.take(chord), value, depth.reshape(-1), primitive.reshape(-1))
    return depth, primitive


def find_ellipsoids_over(scene: Scene, camera: Camera, depth_m: np.ndarray) -> np.ndarray:
    """Find the pixels where the depth from `cast_ellipsoids` exceeds the depth in `depth_m`.

    The function first compares a lower bound of the ellipsoid's depth with `depth_m`. The function computes the exact
    depth only where the lower bound does not exceed `depth_m`.

    Args:
        scene: Scene.
        camera: Orthographic camera.
        depth_m: (H, W) depth to compare with: z in the camera frame (m).

    Returns:
        Flat pixel indices. The same pixel may occur several times.
    """
    pixel, chord, chords = _compute_chords(scene, camera)
    there_m = depth_m.reshape(-1).take(pixel)
    over = chords.least_m.take(chord) > there_m
    unsure = np.flatnonzero(~over)
    over[unsure] = _compute_depth_m(pixel.take(unsure), chord.take(unsure), chords, camera.view) > there_m.take(unsure)
    return pixel[over]


class _Chords(NamedTuple):
    """Chords in an image. A chord is the part of a row of pixel centres that lies inside an ellipsoid.

    There are m chords, ordered by ellipsoid.
    """

    primitive: np.ndarray  # (m,) index of the primitive in the scene.
    row_start: np.ndarray  # (m,) flat index of the first pixel in the row.
    least_m: np.ndarray  # (m,) lower bound of the depth of any hit.
    terms: tuple[np.ndarray, ...]  # (m,) each, the terms that `_compute_depth_m` needs.


def _compute_chords(scene: Scene, camera: Camera) -> tuple[np.ndarray, np.ndarray, _Chords]:
    """Return the flat pixel index (k,) and chord index (k,) of each pixel centre inside an ellipsoid, and the chords.

    Let L be the Cholesky factor of R diag(size / 2)^2 R^T. The surface of an ellipsoid is the set of points center + L
    s with |s| = 1. L is lower triangular. Therefore x determines the first entry of s, and y then determines the second
    entry. The third entry of s is the positive square root of 1 minus the squares of the other two entries.
    """
    view = camera.view
    primitive = np.flatnonzero(scene.category == ELLIPSOID)
    half = camera.camera_from_scene @ (scene.rotation[primitive] * (scene.size_m[primitive, None, :] / 2.0))
    lower = np.linalg.cholesky(half @ half.transpose(0, 2, 1))
    x, y, z = camera.turn(scene.center_m[primitive].astype(np.float64)).T
    row_middle = (view.front_m - x) / view.resolution_m - 0.5
    col_middle = (view.left_m - y) / view.resolution_m - 0.5

    reach = lower[:, 0, 0] / view.resolution_m
    first, count = list_integers_between(row_middle - reach, row_middle + reach, view.rows)
    row, primitive = concatenate_ranges(first, count), np.repeat(primitive, count)
    least_m = z - np.hypot(lower[:, 2, 0], lower[:, 2, 1]) - ROUNDING_M
    x, y, z, col_middle, least_m, l00, _, _, l10, l11, _, l20, l21, l22 = np.repeat(
        [x, y, z, col_middle, least_m, *lower.reshape(-1, 9).T], count, axis=1
    )
    s0 = (view.x_m()[row] - x) / l00
    shift, rest = l10 * s0, 1 - s0**2
    middle, reach = col_middle - shift / view.resolution_m, l11 * np.sqrt(np.maximum(rest, 0)) / view.resolution_m
    first, count = list_integers_between(middle - reach, middle + reach, view.cols)
    terms = y, shift, l11, rest, z + l20 * s0, l21, l22
    row_start = row * view.cols
    chord = np.repeat(np.arange(len(count)), count)
    return concatenate_ranges(row_start + first, count), chord, _Chords(primitive, row_start, least_m, terms)


def _compute_depth_m(pixel: np.ndarray, chord: np.ndarray, chords: _Chords, view: Grid) -> np.ndarray:
    """Return the depth (k,) of an ellipsoid at each pixel of a chord. The argument `pixel` holds flat pixel indices."""
    y, shift, l11, rest, middle, l21, l22 = chords.terms
    col = pixel - chords.row_start.take(chord)
    s1 = (view.y_m().take(col) - y.take(chord) - shift.take(chord)) / l11.take(chord)
    s2 = np.sqrt(np.maximum(rest.take(chord) - s1**2, 0))
    return middle.take(chord) + l21.take(chord) * s1 + l22.take(chord) * s2
