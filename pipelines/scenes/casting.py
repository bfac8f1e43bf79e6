"""What a parallel camera sees of a Scene: triangles by the one rasteriser, ellipsoids exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.scene import ELLIPSOID, Grid, Scene
from pipelines.scenes.rasters import ranges

FILL = 0.95  # of the picture's width or height, whichever is tighter
BELOW_M, ABOVE_M = 2.0, 14.0  # what a camera frames below and above the ego vehicle's ground


@dataclass(frozen=True, eq=False)
class Camera:
    """A parallel camera. Its frame: x up and y left in the picture, z towards the viewer; metres."""

    camera_from_scene: np.ndarray  # (3, 3) rotation
    view: Grid  # the pixels, in the camera frame

    def turned(self, points_m: np.ndarray) -> np.ndarray:
        """Scene points (..., 3) in the camera frame."""
        return points_m @ self.camera_from_scene.T


def looking_down(view: Grid) -> Camera:
    """The camera of the picture from above: its frame is the scene's."""
    return Camera(np.eye(3), view)


def looking_at(grid: Grid, width: int, height: int, azimuth_deg: float, elevation_deg: float) -> Camera:
    """The camera that has all of the grid in a picture of width x height pixels, as large as it fits.

    It looks along +x (forward) turned left by azimuth_deg, and down by elevation_deg, above 0 and at most 90.
    """
    if not 0 < elevation_deg <= 90:
        raise ValueError(f"elevation_deg is {elevation_deg}, must be above 0 and at most 90")
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


def facing(corners_m: np.ndarray) -> np.ndarray:
    """Indices of the triangles (t, 3, 3), counter-clockwise from outside, whose outside is seen from +z."""
    x1, y1 = (corners_m[:, 1, :2] - corners_m[:, 0, :2]).T
    x2, y2 = (corners_m[:, 2, :2] - corners_m[:, 0, :2]).T
    return np.flatnonzero(x1 * y2 - x2 * y1 > 1e-9)


def cast_ellipsoids(scene: Scene, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Nearest hit of the ray through each pixel centre with the scene's ellipsoids; exact.

    Returns depth_m (H, W) float64, z in the camera frame, -inf where nothing is hit, and primitive (H, W)
    int64, its index in the scene, -1 for none.

    With L the Cholesky factor of R diag(size / 2)^2 R^T an ellipsoid is center + L s, |s| = 1. L is lower
    triangular: x gives the first entry of s, y then the second, and the positive root the third.
    """
    view = camera.view
    primitive = np.flatnonzero(scene.category == ELLIPSOID)
    half = camera.camera_from_scene @ (scene.rotation[primitive] * (scene.size_m[primitive, None, :] / 2.0))
    lower = np.linalg.cholesky(half @ half.transpose(0, 2, 1))
    x, y, z = camera.turned(scene.center_m[primitive].astype(np.float64)).T
    row_middle = (view.front_m - x) / view.resolution_m - 0.5
    col_middle = (view.left_m - y) / view.resolution_m - 0.5

    row, one = _pixel_spans(row_middle, lower[:, 0, 0] / view.resolution_m, view.rows)
    s0 = (view.x_m()[row] - x[one]) / lower[one, 0, 0]
    middle = col_middle[one] - lower[one, 1, 0] * s0 / view.resolution_m
    reach = lower[one, 1, 1] * np.sqrt((1 - s0**2).clip(0)) / view.resolution_m
    col, span = _pixel_spans(middle, reach, view.cols)
    one, row, s0 = one[span], row[span], s0[span]
    s1 = (view.y_m()[col] - y[one] - lower[one, 1, 0] * s0) / lower[one, 1, 1]
    s2 = np.sqrt((1 - s0**2 - s1**2).clip(0))
    value = z[one] + lower[one, 2, 0] * s0 + lower[one, 2, 1] * s1 + lower[one, 2, 2] * s2

    depth, hit = np.full(view.rows * view.cols, -np.inf), np.full(view.rows * view.cols, -1, np.int64)
    pixel = row * view.cols + col
    np.maximum.at(depth, pixel, value)
    wins = value == depth[pixel]
    np.maximum.at(hit, pixel[wins], primitive[one[wins]])
    return depth.reshape(view.rows, view.cols), hit.reshape(view.rows, view.cols)


def _pixel_spans(middle: np.ndarray, reach: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """All integers in [0, count) within middle[i] ± reach[i], and the i of each."""
    first = np.ceil(middle - reach).clip(0, count).astype(np.int64)
    beyond = (np.floor(middle + reach).clip(-1, count - 1) + 1).astype(np.int64)
    return ranges(first, (beyond - first).clip(0))
