"""Segment a mesh with class colours into ground vertices, boxes and ellipsoids."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from models.scene import ELLIPSOID, Grid
from pipelines.schema.palette import CATEGORY_IDS, CLASS_COLORS, CLASS_ID, EMPTY, GROUND_CLASS_ID

COLOR_TOLERANCE = 12  # Tolerance per channel (0 to 255). Dark colours in 8-bit linear light have errors of up to 7.
FAR = 64  # The colour distance of a vertex is clipped to this value when sRGB and linear light are compared.
ON_GRID_PX = 0.02  # Maximum distance of a ground vertex from a pixel's corner or centre.
MAX_MIXED = 0.5  # Maximum share of ground vertices whose colour lies between two classes.
VEGETATION = (int(CATEGORY_IDS[0]), int(CATEGORY_IDS[ELLIPSOID]))  # Both vegetation classes have the same colour.
CLASS_IDS = np.array(sorted(set(CLASS_ID.values()) - {VEGETATION[1]}))
IS_GROUND = np.isin(np.arange(len(CLASS_COLORS)), list(GROUND_CLASS_ID.values()))


# ------------------------------------------------------------------------------------------------------- colours


def convert_to_stored_linear(color: np.ndarray) -> bool:
    """Return whether colours match the palette better as linear light than as sRGB.

    Args:
        color: (v, 3) colours in [0, 1].

    Returns:
        True for linear light.
    """
    off = [np.minimum(find_nearest_class(color, linear, CLASS_IDS)[1], FAR).sum() for linear in (True, False)]
    return bool(off[0] < off[1])


def find_nearest_class(color: np.ndarray, linear: bool, class_ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the class with the nearest colour for each vertex.

    Args:
        color: (v, 3) colours in [0, 1].
        linear: Whether the colours are linear light instead of sRGB.
        class_ids: Candidate class ids.

    Returns:
        Class id (v,), and the largest difference in a colour channel (v,), on a scale of 0 to 255.
    """
    levels = np.round(color * 65535).astype(np.int64).clip(0, 65535)
    code, place = np.unique(levels @ np.array([2**32, 2**16, 1], np.int64), return_inverse=True)
    value = np.stack([code >> 32, code >> 16 & 65535, code & 65535], axis=1) / 65535
    if linear:
        value = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)  # IEC 61966-2-1
    off = np.abs(255 * value[:, None] - CLASS_COLORS[class_ids].astype(float)).max(axis=2)
    return class_ids[off.argmin(axis=1)][place], off.min(axis=1)[place]


# -------------------------------------------------------------------------------------------------------- pieces


class MeshPieces(NamedTuple):
    """Content of a mesh in the scene frame: ground vertices, boxes and ellipsoids.

    Attributes:
        ground_m: Positions of the ground vertices, one per pixel (m).
        ground_id: Class id of each ground vertex.
        corners_m: Corners of each box (m).
        box_id: Class id of each box.
        clouds: Vertices (k, 3) of each ellipsoid (m).
    """

    ground_m: np.ndarray  # (v, 3)
    ground_id: np.ndarray  # (v,)
    corners_m: np.ndarray  # (b, 8, 3)
    box_id: np.ndarray  # (b,)
    clouds: list[np.ndarray]  # (k, 3) each


def segment_mesh(vertices_m: np.ndarray, triangles: np.ndarray, color: np.ndarray, linear: bool) -> MeshPieces:
    """Segment a mesh into its connected pieces.

    A piece is ground if most of its coloured vertices have the colour of a ground class. In a mesh without triangles,
    each vertex is a piece.

    Args:
        vertices_m: (v, 3) vertices in the scene frame (m).
        triangles: (t, 3) vertex indices; (0, 3) for a point cloud.
        color: (v, 3) colours in [0, 1].
        linear: Whether the colours are linear light instead of sRGB.

    Returns:
        Ground, boxes and ellipsoids.

    Raises:
        ValueError: A vertex has no class colour, or a piece is not ground, a box or an ellipsoid. The message gives
            the position of the piece and the fault.
    """
    class_id, off = find_nearest_class(color, linear, CLASS_IDS)
    class_id = np.where(off <= COLOR_TOLERANCE, class_id, EMPTY)
    piece = _split_connected(triangles, len(vertices_m))
    votes = np.zeros((piece.max(initial=-1) + 1, len(CLASS_COLORS)), np.int64)
    np.add.at(votes, (piece, class_id), 1)
    votes[:, EMPTY] = 0
    unknown = ~np.any(votes, axis=1)[piece]
    if len(triangles):
        # Vertices that belong to no triangle do not need a class colour.
        unknown[np.setdiff1d(np.arange(len(unknown)), triangles)] = False
    if unknown.any():
        stored = "".join(f"{round(255 * value):02x}" for value in color[unknown][0])
        raise ValueError(
            f"colour #{stored} ({'linear' if linear else 'sRGB'}) of {unknown.sum()} vertices is no class colour;"
            " paint vertices or materials in palette colours (textures are not read)"
        )
    on_ground = IS_GROUND[votes.argmax(axis=1)][piece]
    if not len(triangles) and not on_ground.all():
        raise ValueError("the primitives are points without triangles; export boxes and spheres as meshes")
    ground_m, ground_id = vertices_m[on_ground], class_id[on_ground]
    faces = triangles[~on_ground[triangles[:, 0]]]
    used, faces = np.unique(faces, return_inverse=True)  # Some sphere meshes do not use the vertices at the poles.
    boxes, clouds = _find_primitives(vertices_m[used], class_id[used], faces.reshape(-1, 3))
    return MeshPieces(
        ground_m, _split_mixed(ground_m, np.where(IS_GROUND[ground_id], ground_id, EMPTY)), *boxes, clouds
    )


def _split_connected(triangles: np.ndarray, num_vertices: int) -> np.ndarray:
    """For each vertex, return the number (v,) of the connected piece to which it belongs."""
    start, end = triangles[:, [0, 1]].ravel(), triangles[:, [1, 2]].ravel()
    graph = coo_array((np.ones(len(start), bool), (start, end)), shape=(num_vertices, num_vertices))
    return connected_components(graph, directed=False)[1] if num_vertices else np.zeros(0, int)


def _split_mixed(ground_m: np.ndarray, class_id: np.ndarray) -> np.ndarray:
    """Return the class ids of ground vertices.

    A vertex whose colour lies between two classes gets the class of the nearest vertex with a class colour.
    """
    mixed = class_id == EMPTY
    if mixed.sum() > MAX_MIXED * len(mixed):
        raise ValueError(
            f"{mixed.sum()} of {len(mixed)} ground vertices have no class colour; turn off colour smoothing"
        )
    if mixed.any():
        _, nearest = cKDTree(ground_m[~mixed, :2]).query(ground_m[mixed, :2])
        class_id = class_id.copy()
        class_id[mixed] = class_id[~mixed][nearest]
    return class_id


def _find_primitives(
    points_m: np.ndarray, class_id: np.ndarray, faces: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], list[np.ndarray]]:
    """Return corners_m (b, 8, 3) and class ids (b,) of the boxes, and the vertices of each ellipsoid."""
    piece = _split_connected(faces, len(points_m))
    if (np.bincount(piece) < 8).any():  # Merge vertices that the mesh repeats along edges.
        keys, place = np.unique(np.column_stack([points_m, class_id]), axis=0, return_inverse=True)
        points_m, class_id, faces = keys[:, :3], keys[:, 3].astype(np.int64), place.ravel()[faces]
        piece = _split_connected(faces, len(points_m))
    order, size = np.argsort(piece, kind="stable"), np.bincount(piece)
    start = np.cumsum(size) - size
    points_m, class_id = points_m[order], class_id[order]
    lowest, highest = (part.reduceat(class_id, start) if len(size) else start for part in (np.minimum, np.maximum))
    _refuse(lowest != highest, points_m, start, "is painted in several colours")
    _refuse(size < 8, points_m, start, "has fewer than eight vertices")
    round_ = size > 8
    _refuse(
        round_ & (lowest != VEGETATION[0]),
        points_m,
        start,
        "has more than eight vertices but is not vegetation",
    )
    boxes = start[~round_]
    clouds = [points_m[first : first + count] for first, count in zip(start[round_], size[round_], strict=True)]
    return (points_m[boxes[:, None] + np.arange(8)], lowest[~round_]), clouds


def _refuse(bad: np.ndarray, points_m: np.ndarray, start: np.ndarray, what: str) -> None:
    if bad.any():
        x, y, z = points_m[start[bad][0]]
        raise ValueError(
            f"the piece at x {x:.2f}, y {y:.2f}, z {z:.2f} m {what} ({bad.sum()} such pieces); export primitives as"
            " boxes and spheres, one class each"
        )


# ------------------------------------------------------------------------------------------------------- rasters


def rasterize_ground(
    vertices_m: np.ndarray, class_id: np.ndarray, classes: tuple[str, ...], grid: Grid
) -> tuple[np.ndarray, np.ndarray]:
    """Rasterise ground vertices, which lie at the corners or at the centres of pixels.

    A vertex at a corner is the far left corner of its pixel (x = front_m - row * resolution_m). If a pixel has several
    vertices of one class, the highest vertex is used.

    Args:
        vertices_m: (v, 3) vertices in the scene frame (m). Either all vertices lie at pixel corners, or all vertices
            lie at pixel centres.
        class_id: (v,) class id of each vertex.
        classes: G ground classes of the raster.
        grid: Raster grid.

    Returns:
        height_m (G, H, W) float32 and occupied (G, H, W) bool.

    Raises:
        ValueError: The vertices lie neither at pixel corners nor at pixel centres, or a vertex lies outside the grid.
    """
    at_px = (np.array([grid.front_m, grid.left_m]) - vertices_m[:, :2]) / grid.resolution_m
    from_corner, from_center = (np.abs(at - np.round(at)).max(initial=0) for at in (at_px, at_px - 0.5))
    pixel = np.round(at_px if from_corner <= from_center else at_px - 0.5)
    off_px = min(from_corner, from_center)
    if off_px > ON_GRID_PX or ((pixel < 0) | (pixel >= [grid.rows, grid.cols])).any():
        low, high = vertices_m.min(axis=0), vertices_m.max(axis=0)
        raise ValueError(
            f"ground vertices, x {low[0]:.3f} to {high[0]:.3f}, y {low[1]:.3f} to {high[1]:.3f}, z {low[2]:.3f} to"
            f" {high[2]:.3f} m in the scene frame, are not one per pixel of {grid}; check the axes, and give each"
            " pixel a vertex at its corner or centre"
        )
    height_m = np.full((len(classes), grid.rows, grid.cols), -np.inf)
    layer = np.zeros(len(CLASS_COLORS), np.int64)
    layer[[GROUND_CLASS_ID[name] for name in classes]] = np.arange(len(classes))
    np.maximum.at(height_m, (layer[class_id], *pixel.T.astype(np.int64)), vertices_m[:, 2])
    occupied = np.isfinite(height_m)
    return np.where(occupied, height_m, 0).astype(np.float32), occupied
