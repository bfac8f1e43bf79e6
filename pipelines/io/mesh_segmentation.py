"""Segment a mesh with class colours into ground vertices, boxes and ellipsoids."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from models.limits import require_within
from models.scene import ELLIPSOID, Grid
from pipelines.schema.palette import CATEGORY_IDS, CLASS_COLORS, CLASS_ID, EMPTY, GROUND_CLASS_ID

COLOR_TOLERANCE = 12  # Tolerance per channel (0 to 255). Dark colours in 8-bit linear light have errors of up to 7.
FAR = 64  # The colour distance of a vertex is clipped to this value when sRGB and linear light are compared.
ON_GRID_PX = 0.02  # Maximum distance of a ground vertex from a pixel's corner or centre.
MIN_CENTERS = 0.1  # Minimum share of the vertices at pixel centres in an export with smooth borders.
MAX_MIXED = 0.5  # Maximum share of ground vertices whose colour lies between two classes.
VEGETATION = (int(CATEGORY_IDS[0]), int(CATEGORY_IDS[ELLIPSOID]))  # Both vegetation classes have the same colour.
CLASS_IDS = np.array(sorted(set(CLASS_ID.values()) - {VEGETATION[1]}))
CHUNK = 8192  # Number of colours that are compared with the palette at once, so that the memory is bounded.
IS_GROUND = np.isin(np.arange(len(CLASS_COLORS)), list(GROUND_CLASS_ID.values()))


# ------------------------------------------------------------------------------------------------------- colours


def classify_colors(color: np.ndarray) -> tuple[bool, np.ndarray, np.ndarray]:
    """Find the class with the nearest colour for each vertex, in sRGB or linear light.

    Args:
        color: (v, 3) colours in [0, 1].

    Returns:
        Whether the colours match the palette better as linear light than as sRGB; class id (v,); and the largest
        difference in a colour channel (v,), on a scale of 0 to 255.
    """
    distinct, place = _list_colors(color)
    (linear_id, linear_off), (srgb_id, srgb_off) = (
        (nearest[place], off[place])
        for nearest, off in (_compare_colors(distinct, way, CLASS_IDS) for way in (True, False))
    )
    if np.minimum(linear_off, FAR).sum() < np.minimum(srgb_off, FAR).sum():
        return True, linear_id, linear_off
    return False, srgb_id, srgb_off


def find_nearest_class(color: np.ndarray, linear: bool, class_ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the class with the nearest colour for each vertex.

    Args:
        color: (v, 3) colours in [0, 1].
        linear: Whether the colours are linear light instead of sRGB.
        class_ids: Candidate class ids.

    Returns:
        Class id (v,), and the largest difference in a colour channel (v,), on a scale of 0 to 255.
    """
    distinct, place = _list_colors(color)
    nearest, off = _compare_colors(distinct, linear, class_ids)
    return nearest[place], off[place]


def _list_colors(color: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct colours (u,), each as three numbers of 16 bits in one integer, and the index (v,) of each."""
    levels = np.round(color * 65535).astype(np.int64).clip(0, 65535)
    return np.unique(levels @ np.array([2**32, 2**16, 1], np.int64), return_inverse=True)


def _compare_colors(code: np.ndarray, linear: bool, class_ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    nearest, off = np.empty(len(code), class_ids.dtype), np.empty(len(code))
    for start in range(0, len(code), CHUNK):
        part = slice(start, start + CHUNK)
        value = np.stack([code[part] >> 32, code[part] >> 16 & 65535, code[part] & 65535], axis=1) / 65535
        if linear:
            value = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)  # IEC 61966-2-1
        apart = np.abs(255 * value[:, None] - CLASS_COLORS[class_ids].astype(float)).max(axis=2)
        nearest[part], off[part] = class_ids[apart.argmin(axis=1)], apart.min(axis=1)
    return nearest, off


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


class Mesh(NamedTuple):
    """Parts of a mesh in one array each.

    Attributes:
        vertices_m: Vertices in the scene frame (m).
        triangles: Vertex indices; the vertices of a triangle belong to one part.
        color: Colours in [0, 1].
        part: Number of the part of each vertex.
    """

    vertices_m: np.ndarray  # (v, 3)
    triangles: np.ndarray  # (t, 3)
    color: np.ndarray  # (v, 3)
    part: np.ndarray  # (v,)


def segment_mesh(mesh: Mesh, grid: Grid) -> MeshPieces:
    """Segment a mesh into its connected pieces.

    A piece is ground if most of its coloured vertices have the colour of a ground class. In a part without triangles,
    each vertex is a piece.

    Args:
        mesh: Parts of the mesh.
        grid: Raster grid of the ground.

    Returns:
        Ground, boxes and ellipsoids.

    Raises:
        ValueError: A vertex has no class colour, or a piece is not ground, a box or an ellipsoid. The message gives
            the position of the piece and the fault.
    """
    vertices_m, triangles, color, part = mesh
    linear, class_id, off = classify_colors(color)
    class_id = np.where(off <= COLOR_TOLERANCE, class_id, EMPTY)
    piece = _split_connected(triangles, len(vertices_m))
    num_pieces, num_classes = piece.max(initial=-1) + 1, len(CLASS_COLORS)
    colored = class_id != EMPTY
    vote, count = np.unique(piece[colored] * num_classes + class_id[colored], return_counts=True)
    order = np.lexsort((-(vote % num_classes), count))  # The last entry of a piece has the most votes.
    winner = np.full(num_pieces, EMPTY)
    winner[vote[order] // num_classes] = vote[order] % num_classes
    has_triangles = np.zeros(part.max(initial=-1) + 1, bool)
    has_triangles[part[triangles[:, 0]]] = True
    is_corner = np.zeros(len(part), bool)
    is_corner[triangles] = True
    # Vertices that belong to no triangle do not need a class colour, except in a point cloud.
    unknown = (winner == EMPTY)[piece] & (is_corner | ~has_triangles[part])
    if unknown.any():
        stored = "".join(f"{round(255 * value):02x}" for value in color[unknown][0])
        raise ValueError(
            f"colour #{stored} ({'linear' if linear else 'sRGB'}) of {unknown.sum()} vertices is no class colour;"
            " paint vertices or materials in palette colours (textures are not read)"
        )
    on_ground = IS_GROUND[winner][piece]
    if not (on_ground | has_triangles[part]).all():
        raise ValueError("the primitives are points without triangles; export boxes and spheres as meshes")
    ground_m, ground_id = vertices_m[on_ground], class_id[on_ground]
    ground_id = _split_mixed(ground_m, np.where(IS_GROUND[ground_id], ground_id, EMPTY), part[on_ground], grid)
    faces = triangles[~on_ground[triangles[:, 0]]]
    used, faces = np.unique(faces, return_inverse=True)  # Some sphere meshes do not use the vertices at the poles.
    boxes, clouds = _find_primitives(vertices_m[used], class_id[used], faces.reshape(-1, 3), part[used])
    return MeshPieces(ground_m, ground_id, *boxes, clouds)


def _split_connected(triangles: np.ndarray, num_vertices: int) -> np.ndarray:
    """For each vertex, return the number (v,) of the connected piece to which it belongs."""
    start, end = triangles[:, [0, 1]].ravel(), triangles[:, [1, 2]].ravel()
    graph = coo_array((np.ones(len(start), bool), (start, end)), shape=(num_vertices, num_vertices))
    return connected_components(graph, directed=False)[1] if num_vertices else np.zeros(0, int)


def _split_mixed(ground_m: np.ndarray, class_id: np.ndarray, part: np.ndarray, grid: Grid) -> np.ndarray:
    """Return the class ids of ground vertices.

    A vertex whose colour lies between two classes gets the class of the nearest pixel of the part with a class colour.
    """
    mixed = class_id == EMPTY
    shares = np.bincount(part[mixed]), np.bincount(part, minlength=part[mixed].max(initial=-1) + 1)
    if (shares[0] > MAX_MIXED * shares[1][: len(shares[0])]).any():
        raise ValueError(
            f"{mixed.sum()} of {len(mixed)} ground vertices have no class colour; turn off colour smoothing"
        )
    if not mixed.any():
        return class_id
    # The search uses pixels, because many vertices at one position would make it slow.
    pixel, class_id = _find_pixels(ground_m, grid), class_id.copy()
    for number in np.unique(part[mixed]):
        here = part == number
        known, unknown = here & ~mixed, here & mixed
        keys = pixel[known] @ np.array([grid.cols, 1]) * len(CLASS_COLORS) + class_id[known]
        _, first = np.unique(keys, return_index=True)
        wanted, place = np.unique(pixel[unknown] @ np.array([grid.cols, 1]), return_inverse=True)
        _, nearest = cKDTree(pixel[known][first]).query(np.stack(np.divmod(wanted, grid.cols), axis=1))
        class_id[unknown] = class_id[known][first][nearest][place]
    return class_id


def _find_primitives(
    points_m: np.ndarray, class_id: np.ndarray, faces: np.ndarray, part: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], list[np.ndarray]]:
    """Return corners_m (b, 8, 3) and class ids (b,) of the boxes, and the vertices of each ellipsoid."""
    piece = _split_connected(faces, len(points_m))
    if len(small := part[np.bincount(piece)[piece] < 8]):
        # In a part with small pieces, merge vertices that the mesh repeats along edges.
        to_merge = np.zeros(part.max() + 1, bool)
        to_merge[small] = True
        solo = np.where(to_merge[part], -1, np.arange(len(part)))
        first, place = _group_rows(np.column_stack([points_m, class_id, part, solo]))
        points_m, class_id, faces = points_m[first], class_id[first], place[faces]
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
    require_within("glb_ellipsoids", int(round_.sum()))
    boxes = start[~round_]
    clouds = [points_m[first : first + count] for first, count in zip(start[round_], size[round_], strict=True)]
    return (points_m[boxes[:, None] + np.arange(8)], lowest[~round_]), clouds


def _group_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first row of each group of equal rows in the order of the rows, and the group (n,) of each row."""
    order = np.lexsort(rows.T)
    is_new = np.ones(len(rows), bool)
    is_new[1:] = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    group = np.empty(len(rows), np.int64)
    group[order] = np.cumsum(is_new) - 1
    first = order[is_new]  # The order of `lexsort` is stable.
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.sort(first), rank[group]


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

    Exports with smooth borders have further vertices between pixel centres. They are left out.

    A vertex at a corner is the far left corner of its pixel (x = front_m - row * resolution_m). If a pixel has several
    vertices of one class, the highest vertex is used.

    Args:
        vertices_m: (v, 3) vertices in the scene frame (m). Either all vertices lie at pixel corners, or vertices lie at
            pixel centres.
        class_id: (v,) class id of each vertex.
        classes: G ground classes of the raster.
        grid: Raster grid.

    Returns:
        height_m (G, H, W) float32 and occupied (G, H, W) bool.

    Raises:
        ValueError: The vertices lie neither at pixel corners nor at pixel centres, or a vertex lies outside the grid.
    """
    at_pixels = _find_pixel_centers(vertices_m, grid)
    vertices_m, class_id = vertices_m[at_pixels], class_id[at_pixels]
    pixel = _find_pixels(vertices_m, grid)
    require_within("raster_pixels", len(classes) * grid.rows * grid.cols, "the grid")
    height_m = np.full((len(classes), grid.rows, grid.cols), -np.inf, np.float32)
    layer = np.zeros(len(CLASS_COLORS), np.int64)
    layer[[GROUND_CLASS_ID[name] for name in classes]] = np.arange(len(classes))
    np.maximum.at(height_m, (layer[class_id], *pixel.T), vertices_m[:, 2].astype(np.float32))
    occupied = np.isfinite(height_m)
    height_m[~occupied] = 0
    return height_m, occupied


def _find_pixel_centers(vertices_m: np.ndarray, grid: Grid) -> np.ndarray:
    """Return which vertices (v,) lie at pixel centres.

    If a vertex lies outside the grid, or if fewer than MIN_CENTERS of the vertices are found, all are True. The mesh is
    then no export with smooth borders.
    """
    at_px = (np.array([grid.front_m, grid.left_m]) - vertices_m[:, :2]) / grid.resolution_m
    inside = (at_px >= -ON_GRID_PX) & (at_px <= np.array([grid.rows, grid.cols]) + ON_GRID_PX)
    if not (len(inside) and inside.all()):
        return np.ones(len(vertices_m), bool)
    found = np.all(np.abs(at_px - 0.5 - np.round(at_px - 0.5)) <= ON_GRID_PX, axis=1)
    return found if found.mean() >= MIN_CENTERS else np.ones(len(vertices_m), bool)


def _find_pixels(vertices_m: np.ndarray, grid: Grid) -> np.ndarray:
    """Return the row and the column (v, 2) of each ground vertex."""
    with np.errstate(over="ignore", invalid="ignore"):
        at_px = (np.array([grid.front_m, grid.left_m]) - vertices_m[:, :2]) / grid.resolution_m
        from_corner, from_center = (np.abs(at - np.round(at)).max(initial=0) for at in (at_px, at_px - 0.5))
        pixel = np.round(at_px if from_corner <= from_center else at_px - 0.5)
    off_px = min(from_corner, from_center)
    if not (off_px <= ON_GRID_PX and ((pixel >= 0) & (pixel < [grid.rows, grid.cols])).all()):
        low, high = vertices_m.min(axis=0), vertices_m.max(axis=0)
        raise ValueError(
            f"ground vertices, x {low[0]:.3f} to {high[0]:.3f}, y {low[1]:.3f} to {high[1]:.3f}, z {low[2]:.3f} to"
            f" {high[2]:.3f} m in the scene frame, are not one per pixel of {grid}; check the axes, and give each"
            " pixel a vertex at its corner or centre"
        )
    return pixel.astype(np.int64)
