"""Compute the visible surface and the light of each pixel in 3D images.

The scene is lit by a sun with soft shadows and by a sky. Primitives have thin outlines. The sky light is stronger on
surfaces that face up. The sky light is weaker near other surfaces. Class colours are kept: a horizontal surface in the
sun has exactly its palette colour.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from models.scene import ELLIPSOID, Grid, Scene
from pipelines.geometry.masks import find_nearest_true
from pipelines.geometry.orthographic import (
    Camera,
    cast_ellipsoids,
    find_facing_sides,
    make_oblique_camera,
    make_top_camera,
)
from pipelines.geometry.rasterize import cast_rays_down
from pipelines.io.mesh_export import make_unit_cuboid, triangulate_cuboids, triangulate_ground
from pipelines.schema.palette import CATEGORY_IDS, CLASS_COLORS

PLATE, TABLE = len(CLASS_COLORS), len(CLASS_COLORS) + 1  # Colour ids of plate and table; they follow the class ids.
_SRGB = np.vstack([CLASS_COLORS, [[226, 228, 232], [243, 245, 248]]]) / 255
LINEAR_COLORS = (_SRGB**2.2).astype(np.float32)

# Direction of the sun's rays. The angles are defined like the angles of a camera's view direction.
SUN_AZIMUTH_DEG, SUN_ELEVATION_DEG = -62.0, 52.0
SUN = np.array([0.68, 0.65, 0.60], np.float32)  # Linear RGB of sunlight on a horizontal surface.
SKY = 1 - SUN
SHADOW_PX, SHADOW_BIAS_PX = 900, 1.2
# Height map: number of pixels along the longer side, standard deviation of the blur (m), and margin around the grid
# (m).
SKY_PX, NEARBY_M, MARGIN_M = 640, 1.6, 12.0
# Shares of light that are removed: OUTLINE on a line between two primitives, CREASE on a line between two faces of one
# primitive.
OUTLINE, CREASE = 0.5, 0.25

SCENERY = 0  # Part number of ground, plate and table. Their borders have no lines.


class Faces(NamedTuple):
    """Triangles to render.

    Attributes:
        corners_m: Corners (t, 3, 3) in the scene frame (m).
        color_id: Row index (t,) into LINEAR_COLORS.
        part: Part number (t,), which is SCENERY or 4 * (primitive + 1) + face.
    """

    corners_m: np.ndarray
    color_id: np.ndarray
    part: np.ndarray


class Surfaces(NamedTuple):
    """Visible surface of each pixel, for H x W pixels.

    Attributes:
        depth_m: z in the camera frame (m).
        color_id: Row index into LINEAR_COLORS.
        part: Part number, which is SCENERY or 4 * (primitive + 1) + face.
        normal: Outward unit normal in the scene frame.
    """

    depth_m: np.ndarray  # float32
    color_id: np.ndarray  # uint8
    part: np.ndarray  # int32
    normal: np.ndarray  # (H, W, 3) float32


def render_lit(scene: Scene, camera: Camera) -> np.ndarray:
    """Render a scene on its plate on a table, lit by sun and sky.

    Args:
        scene: Scene.
        camera: Orthographic camera.

    Returns:
        (H, W, 3) float32 linear RGB.
    """
    sheet_m = _make_sheet(scene)
    table_z_m = float(sheet_m.min()) - 1.0
    solid = _join_faces(_make_plate(scene.grid, sheet_m, table_z_m), _make_cuboid_faces(scene))
    seen = _cast_surfaces(scene, camera, _join_faces(_make_ground_faces(scene), solid), table_z_m)

    x, y = camera.view.x_m().astype(np.float32)[:, None], camera.view.y_m().astype(np.float32)[None, :]
    point = [up * x + left * y + near * seen.depth_m for up, left, near in camera.camera_from_scene.T.tolist()]
    sun = make_oblique_camera(scene.grid, SHADOW_PX, SHADOW_PX, SUN_AZIMUTH_DEG, SUN_ELEVATION_DEG)
    cosine = (seen.normal @ sun.camera_from_scene[2].astype(np.float32)).clip(0)
    direct = cosine / sun.camera_from_scene[2, 2].astype(np.float32) * _find_sunlit(scene, solid, sun, point, cosine)
    sky = (0.65 + 0.35 * seen.normal[..., 2]) * _measure_open_sky(scene, solid, table_z_m, point)
    kept = 1 - _draw_lines(seen)
    light = (direct * kept)[..., None] * SUN + (sky * kept)[..., None] * SKY
    return LINEAR_COLORS.take(seen.color_id, axis=0) * light


def _join_faces(*parts: Faces) -> Faces:
    return Faces(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _cast_surfaces(scene: Scene, camera: Camera, faces: Faces, table_z_m: float) -> Surfaces:
    """Return the nearest surface at each pixel: a face, an ellipsoid, or the table below the scene."""
    turned = camera.turn(faces.corners_m)
    seen = find_facing_sides(turned)
    (depth,), (hit,) = cast_rays_down(turned[seen], camera.view)
    depth = np.where(hit < 0, _compute_table_depth(camera, table_z_m), depth)
    # Index -1 (no hit) selects the last entry, the colour of the table under the scene.
    color_id = np.append(faces.color_id[seen], np.uint8(TABLE)).take(hit, mode="wrap")
    part = np.append(faces.part[seen], SCENERY).astype(np.int32).take(hit, mode="wrap")
    normal = np.vstack([_compute_normals(faces.corners_m[seen]), [[0, 0, 1]]]).astype(np.float32)
    normal = normal.take(hit, axis=0, mode="wrap")

    round_depth, primitive = cast_ellipsoids(scene, camera)
    row, col = np.nonzero(round_depth > depth)
    primitive = primitive[row, col]
    depth[row, col] = round_depth[row, col]
    color_id[row, col] = CATEGORY_IDS[ELLIPSOID]
    part[row, col] = 4 * (primitive + 1)
    normal[row, col] = _compute_ellipsoid_normals(scene, camera, depth, row, col, primitive)
    return Surfaces(depth.astype(np.float32), color_id, part, normal)


def _make_ground_faces(scene: Scene) -> Faces:
    corners, class_id, _ = triangulate_ground(scene)
    return Faces(corners, class_id, np.full(len(corners), SCENERY))


def _make_cuboid_faces(scene: Scene) -> Faces:
    corners, class_id, primitive = triangulate_cuboids(scene)
    vertices, triangles = make_unit_cuboid()
    axis = np.abs(_compute_normals(vertices[triangles])).argmax(axis=1)
    return Faces(corners, class_id, 4 * (primitive + 1) + np.tile(axis, len(corners) // 12))


def _make_sheet(scene: Scene) -> np.ndarray:
    """Return the heights (rows, cols) of the plate, which lies just below the ground.

    The plate has about one height per metre along each axis. Where the scene has no ground, the plate has the height of
    the nearest ground.
    """
    height, winner = scene.surface()
    if (winner < 0).all():
        return np.zeros((2, 2))
    nearest = find_nearest_true(winner >= 0)
    step = max(1, round(1 / scene.grid.resolution_m))
    below = ndimage.minimum_filter(height[nearest], 2 * step + 1) - 0.08
    nodes = [np.linspace(0, n - 1, max(2, n // step + 1)).round().astype(int) for n in height.shape]
    return below[np.ix_(*nodes)]


def _make_plate(grid: Grid, sheet_m: np.ndarray, table_z_m: float) -> Faces:
    """Return the plate, which covers the whole grid and has walls down to the table."""
    rows, cols = sheet_m.shape
    x, y = np.linspace(grid.front_m, grid.back_m, rows), np.linspace(grid.left_m, grid.right_m, cols)
    top = np.stack([*np.meshgrid(x, y, indexing="ij"), sheet_m], axis=-1)
    rim = np.concatenate([top[0], top[1:, -1], top[-1, -2::-1], top[-2::-1, 0]])  # Clockwise seen from above.
    foot = rim * [1, 1, 0] + [0, 0, table_z_m]
    corners = np.concatenate([_make_quads(top), _make_quads(np.stack([foot, rim]))])
    return Faces(corners, np.full(len(corners), PLATE, np.uint8), np.full(len(corners), SCENERY))


def _compute_table_depth(camera: Camera, table_z_m: float) -> np.ndarray:
    """Return the depth (H, 1) of the table in each image row: the solution of z = up * x + near * depth."""
    up, _, near = camera.camera_from_scene[:, 2]
    return ((table_z_m - up * camera.view.x_m()) / near)[:, None]


def _make_quads(points: np.ndarray) -> np.ndarray:
    """Return the triangles (2 (r - 1) (c - 1), 3, 3) of a grid of points (r, c, 3).

    The triangles face up if x decreases with the row index and y decreases with the column index.
    """
    here, right, below, across = points[:-1, :-1], points[:-1, 1:], points[1:, :-1], points[1:, 1:]
    return np.stack([here, below, right, right, below, across], axis=2).reshape(-1, 3, 3)


def _compute_normals(corners_m: np.ndarray) -> np.ndarray:
    """Return the unit outward normals (t, 3) of triangles (t, 3, 3)."""
    normal = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-12)


def _compute_ellipsoid_normals(
    scene: Scene, camera: Camera, depth_m: np.ndarray, row: np.ndarray, col: np.ndarray, primitive: np.ndarray
) -> np.ndarray:
    """Return the unit normals (k, 3) of ellipsoids in the scene frame at the pixels (row, col)."""
    view = camera.view
    point = np.stack([view.x_m()[row], view.y_m()[col], depth_m[row, col]], axis=1) @ camera.camera_from_scene
    axes = scene.rotation / scene.size_m[:, None, :] ** 2
    gradient = axes @ scene.rotation.transpose(0, 2, 1)  # R diag(1 / size^2) R^T
    normal = np.einsum("kij,kj->ki", gradient[primitive], point - scene.center_m[primitive])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _find_top(scene: Scene, solid: Faces, camera: Camera) -> np.ndarray:
    """Return the depth (H, W) float32 of the nearest plate, cuboid or ellipsoid; -inf if there is no hit."""
    turned = camera.turn(solid.corners_m)
    (flat,), _ = cast_rays_down(turned[find_facing_sides(turned)], camera.view)
    return np.maximum(flat, cast_ellipsoids(scene, camera)[0]).astype(np.float32)


def _find_sunlit(scene: Scene, solid: Faces, sun: Camera, point: list[np.ndarray], cosine: np.ndarray) -> np.ndarray:
    """Return the share (H, W) of sunlight at each point, in [0, 1].

    The shadow map is averaged over neighbouring pixels.
    """
    blocker = _add_rim(_find_top(scene, solid, sun), -np.inf)
    x, y, z = (a * point[0] + b * point[1] + c * point[2] for a, b, c in sun.camera_from_scene.tolist())
    z += SHADOW_BIAS_PX * sun.view.resolution_m / cosine.clip(0.15)  # The bias is larger at grazing incidence.
    pixel = _project_flat(sun.view, x, y)
    free = np.zeros(z.shape, np.float32)
    neighbours = (0, 1, -1, SHADOW_PX, -SHADOW_PX)
    for offset in neighbours:
        free += blocker.take(pixel + offset, mode="clip") <= z
    return free / len(neighbours)


def _measure_open_sky(scene: Scene, solid: Faces, table_z_m: float, point: list[np.ndarray]) -> np.ndarray:
    """Return the share (H, W) of sky light.

    The deeper a point lies below the mean height around the point, the smaller is its share of sky light.
    """
    grid = scene.grid
    length_m, width_m = (n * grid.resolution_m + 2 * MARGIN_M for n in (grid.rows, grid.cols))
    resolution_m = max(length_m, width_m) / SKY_PX
    rows, cols = round(length_m / resolution_m), round(width_m / resolution_m)
    view = Grid(grid.front_m + MARGIN_M, grid.left_m + MARGIN_M, resolution_m, rows, cols)
    top = _find_top(scene, solid, make_top_camera(view)).clip(table_z_m)
    around = ndimage.gaussian_filter(top, NEARBY_M / resolution_m)
    depth = (_add_rim(around, table_z_m).take(_project_flat(view, point[0], point[1])) - point[2]).clip(0)
    return 0.3 + 0.7 * np.exp(-depth / 2.5)


def _add_rim(picture: np.ndarray, value: float) -> np.ndarray:
    """Return the flattened image (H W,) with `value` in the two outermost rows and columns on each side.

    These pixels represent the area outside the image.
    """
    framed = np.full_like(picture, value)
    framed[2:-2, 2:-2] = picture[2:-2, 2:-2]
    return framed.reshape(-1)


def _project_flat(view: Grid, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the index into the flattened image for each point. Points outside the image get the nearest pixel."""
    row = ((view.front_m - x) * (1 / view.resolution_m)).clip(0, view.rows - 1).astype(np.int32)
    col = ((view.left_m - y) * (1 / view.resolution_m)).clip(0, view.cols - 1).astype(np.int32)
    return row * view.cols + col


def _draw_lines(seen: Surfaces) -> np.ndarray:
    """Return the share (H, W) of light that lines remove.

    At a border between two parts, the line lies on the part that is nearer to the camera.
    """
    lost = np.zeros(seen.part.shape, np.float32)
    for axis in (0, 1):
        one, two = (np.s_[:-1], np.s_[1:]) if axis == 0 else (np.s_[:, :-1], np.s_[:, 1:])
        border = seen.part[one] != seen.part[two]
        strength = np.where(seen.part[one] >> 2 != seen.part[two] >> 2, OUTLINE, CREASE).astype(np.float32)
        nearer = seen.depth_m[one] > seen.depth_m[two]
        lost[one] = np.maximum(lost[one], strength * (border & nearer))
        lost[two] = np.maximum(lost[two], strength * (border & ~nearer))
    return lost
