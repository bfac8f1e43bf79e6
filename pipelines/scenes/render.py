"""Pictures of a Scene: from above in flat class colours, and oblique in soft light.

Both cast parallel rays with the one rasteriser: from above the scene as it is, obliquely the scene turned until
the camera looks down its z axis. Ellipsoids are cast exactly, not as meshes.
"""

from __future__ import annotations

import numpy as np

from models.scene import ELLIPSOID, Grid, Scene
from pipelines.scenes.mesh import cuboid_triangles
from pipelines.scenes.palette import CATEGORY_IDS, CLASS_COLORS, EMPTY, ground_ids
from pipelines.scenes.rasters import _ranges, cast_down


def bev_picture(scene: Scene, size_px: int = 256, supersample: int = 1) -> np.ndarray:
    """The scene from above, unlit, white where there is nothing: (H, W, 3) uint8 sRGB.

    Orthographic, up = +x (forward), left = +y; the grid exactly fills the picture and its longer side has
    size_px pixels. With supersample > 1 each pixel is the mean of that many squared. This is the picture of the
    metrics: the same to the last bit on every call.
    """
    view = view_from_above(scene.grid, size_px * supersample)
    surface, winner = scene.surface()
    row, col = scene.grid.pixel(view.x_m(), view.y_m())
    winner = winner.take(row, axis=0).take(col, axis=1)
    top = np.where(winner < 0, -np.inf, surface.take(row, axis=0).take(col, axis=1))
    class_id = ground_ids(scene).take(winner, mode="wrap")

    boxes = cuboid_triangles(scene)
    seen = upward(boxes.corners_m)
    height, hit = cast_down(boxes.corners_m[seen], view)
    box_ids = np.append(boxes.class_id[seen], np.uint8(EMPTY)).take(hit[0], mode="wrap")
    class_id = np.where(height[0] > top, box_ids, class_id)
    top = np.maximum(top, height[0])

    height, _ = cast_ellipsoids(scene, view)
    class_id = np.where(height > top, CATEGORY_IDS[ELLIPSOID], class_id)
    return shrink(CLASS_COLORS.take(class_id, axis=0), supersample)


def view_from_above(grid: Grid, size_px: int) -> Grid:
    """The same rectangle with size_px pixels along its longer side."""
    resolution_m = max(grid.rows, grid.cols) * grid.resolution_m / size_px
    rows, cols = (max(1, round(n * grid.resolution_m / resolution_m)) for n in (grid.rows, grid.cols))
    return Grid(grid.front_m, grid.left_m, resolution_m, rows, cols)


def upward(corners_m: np.ndarray) -> np.ndarray:
    """Indices of the triangles (t, 3, 3), counter-clockwise from outside, that show their outside to +z."""
    x1, y1 = (corners_m[:, 1, :2] - corners_m[:, 0, :2]).T
    x2, y2 = (corners_m[:, 2, :2] - corners_m[:, 0, :2]).T
    return np.flatnonzero(x1 * y2 - x2 * y1 > 1e-9)


def cast_ellipsoids(
    scene: Scene, view: Grid, view_from_scene: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Highest hit of a ray along z through each pixel centre with the scene's ellipsoids; exact.

    view lies in a frame turned by the rotation view_from_scene (3, 3), by default the scene's own. Returns
    height_m (H, W) float64, -inf where nothing is hit, and primitive (H, W) int64, its index in the scene, -1
    for none.

    With L the Cholesky factor of R diag(size / 2)^2 R^T an ellipsoid is center + L s, |s| = 1. L is lower
    triangular: x gives the first entry of s, y then the second, and the positive root the third.
    """
    primitive = np.flatnonzero(scene.category == ELLIPSOID)
    view_from_scene = np.eye(3) if view_from_scene is None else view_from_scene
    half = view_from_scene @ (scene.rotation[primitive] * (scene.size_m[primitive, None, :] / 2.0))
    lower = np.linalg.cholesky(half @ half.transpose(0, 2, 1))
    x, y, z = view_from_scene @ scene.center_m[primitive].T
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

    height, hit = np.full(view.rows * view.cols, -np.inf), np.full(view.rows * view.cols, -1, np.int64)
    pixel = row * view.cols + col
    np.maximum.at(height, pixel, value)
    wins = value == height[pixel]
    np.maximum.at(hit, pixel[wins], primitive[one[wins]])
    return height.reshape(view.rows, view.cols), hit.reshape(view.rows, view.cols)


def _pixel_spans(middle: np.ndarray, reach: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """All integers in [0, count) within middle[i] ± reach[i], and the i of each."""
    first = np.ceil(middle - reach).clip(0, count).astype(np.int64)
    beyond = (np.floor(middle + reach).clip(-1, count - 1) + 1).astype(np.int64)
    return _ranges(first, (beyond - first).clip(0))


def shrink(picture: np.ndarray, factor: int) -> np.ndarray:
    """(H, W, 3) uint8 with each factor x factor block replaced by its rounded mean."""
    if factor == 1:
        return picture
    rows, cols = picture.shape[0] // factor, picture.shape[1] // factor
    blocks = picture[: rows * factor, : cols * factor].reshape(rows, factor, cols, factor, 3)
    return np.round(blocks.mean(axis=(1, 3))).astype(np.uint8)
