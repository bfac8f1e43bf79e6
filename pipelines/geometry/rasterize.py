"""Rasterise triangles from above. The result is exact for vertical rays through pixel centres.

A vertical ray hits a triangle if the pixel centre lies inside the triangle's vertical projection. The code fills each
triangle row by row. Each row of a triangle is an interval of columns, and the triangle's plane gives the heights. Each
pixel keeps the highest hit. The same code makes the ground rasters (paper, Sec. 3.1) and the BEV images. The same code
makes the 3D images from a rotated mesh.
"""

from __future__ import annotations

import numpy as np

from models.scene import Grid

# A pixel centre within this distance of an edge counts as inside. This prevents gaps between adjacent triangles.
EDGE_PX = 1e-7
# If the slope of a triangle (m per pixel) exceeds STEEP, the heights of its hits are clamped to the height range of the
# triangle.
STEEP = 1e3


def concatenate_ranges(first: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Concatenate the integer ranges first[i] .. first[i] + count[i] - 1.

    If x holds one value per range, `np.repeat(x, count)` gives, for each integer of the result, the value of its range.

    Args:
        first: (n,) first integer of each range.
        count: (n,) length of each range.

    Returns:
        (sum of count,) integers.
    """
    return np.repeat(first - (np.cumsum(count) - count), count) + np.arange(count.sum())


def list_integers_between(low: np.ndarray, high: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Find the integers that lie in [0, size) and in [low[i], high[i]].

    Args:
        low: (n,) lower bounds, inclusive.
        high: (n,) upper bounds, inclusive.
        size: Upper bound of all integers, exclusive.

    Returns:
        First integer of each interval, and number of integers in each interval, both (n,) int64.
    """
    first = np.minimum(np.maximum(np.ceil(low), 0), size)
    count = np.maximum(np.minimum(np.floor(high) + 1, size) - first, 0)
    return first.astype(np.int64), count.astype(np.int64)


def find_hits(triangles_m: np.ndarray, grid: Grid, owner: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points where vertical rays through pixel centres hit triangles.

    Args:
        triangles_m: (t, 3, 3) corners (x, y, z) in the frame of the grid (m).
        grid: Pixel grid.
        owner: (t,) value that is returned with each hit of a triangle.

    Returns:
        Flat pixel index, owner and height (m) of each hit; three arrays (m,), ordered by triangle.
    """
    x, y, z = np.ascontiguousarray(triangles_m.astype(np.float64).T)  # each is (3, t)
    u = (grid.front_m - x) / grid.resolution_m - 0.5
    v = (grid.left_m - y) / grid.resolution_m - 0.5
    # The plane of a triangle is z = z0 + du (u - u0) + dv (v - v0). Cramer's rule gives du and dv.
    (u1, u2), (v1, v2), (z1, z2) = [(w[1] - w[0], w[2] - w[0]) for w in (u, v, z)]
    area = u1 * v2 - u2 * v1
    first, rows = list_integers_between(u.min(axis=0) - EDGE_PX, u.max(axis=0) + EDGE_PX, grid.rows)
    _, cols = list_integers_between(v.min(axis=0) - EDGE_PX, v.max(axis=0) + EDGE_PX, grid.cols)
    index = np.flatnonzero((np.abs(area) > 1e-9) & (rows > 0) & (cols > 0))
    slope_u = (z1 * v2 - z2 * v1).take(index) / area.take(index)
    slope_v = (u1 * z2 - u2 * z1).take(index) / area.take(index)
    u, v, z = u.take(index, axis=1), v.take(index, axis=1), z.take(index, axis=1)
    plane = [z[0] - slope_u * u[0] - slope_v * v[0], slope_u, slope_v, z.min(axis=0), z.max(axis=0)]

    spans = rows.take(index)
    row = concatenate_ranges(first.take(index), spans)
    low, high = _find_column_intervals(row, spans, u, v)
    first, count = list_integers_between(low - EDGE_PX, high + EDGE_PX, grid.cols)
    col = concatenate_ranges(first, count)
    # Along a row, the height is linear in the column: start + slope_v * col.
    start, along_u, along_v, lowest, highest = np.repeat(plane, spans, axis=1)
    height = np.repeat(start + along_u * row, count) + np.repeat(along_v, count) * col
    if np.abs(slope_u).max(initial=0) > STEEP or np.abs(slope_v).max(initial=0) > STEEP:
        height = np.minimum(np.maximum(height, np.repeat(lowest, count)), np.repeat(highest, count))
    return np.repeat(row * grid.cols, count) + col, np.repeat(np.repeat(owner.take(index), spans), count), height


def _find_column_intervals(
    row: np.ndarray, spans: np.ndarray, u: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each pixel row of a triangle, the lowest and the highest column coordinate (s,) in this row.

    The argument `spans` (t,) contains the number of rows per triangle. The arguments `u` and `v` (3, t) are row and
    column coordinates of the corners, in pixels. Pixel centres have integer coordinates.
    """
    u_end, v_end = u[[1, 2, 0]], v[[1, 2, 0]]  # Edge k leads from corner k to the next corner.
    per_row = (v_end - v) / np.where(u == u_end, 1.0, u_end - u)
    edges = [u, v, per_row, np.minimum(u, u_end), np.maximum(u, u_end)]
    u, v, per_row, top, bottom = np.repeat(edges, spans, axis=2)
    nearest = np.minimum(np.maximum(row, top), bottom)
    column = v + (nearest - u) * per_row
    misses = np.abs(row - nearest) > EDGE_PX
    return np.where(misses, np.inf, column).min(axis=0), np.where(misses, -np.inf, column).max(axis=0)


def fill_triangles(
    pixel: np.ndarray, owner: np.ndarray, value: np.ndarray, height: np.ndarray, winner: np.ndarray
) -> None:
    """Draw hits into images in place: each pixel keeps the highest value and its owner.

    If several hits have the same value, the last hit wins. A hit also replaces an equal value in the image.

    Args:
        pixel: (m,) flat pixel index of each hit.
        owner: (m,) value to write to `winner`.
        value: (m,) height or depth of each hit.
        height: (pixels,) highest value so far; changed in place.
        winner: (pixels,) owner of the highest value; changed in place.
    """
    np.maximum.at(height, pixel, value)
    wins = value == height.take(pixel)
    winner[pixel[wins]] = owner[wins]


def cast_rays_down(
    triangles_m: np.ndarray, grid: Grid, layer: np.ndarray | None = None, num_layers: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Find the highest hit of the vertical ray through each pixel centre, per layer.

    If several triangles have the same height, the last triangle wins. Vertical triangles have no area seen from above
    and are skipped.

    Args:
        triangles_m: (t, 3, 3) corners (x, y, z) in the frame of the grid (m).
        grid: Pixel grid.
        layer: (t,) layer of each triangle, in 0 .. num_layers - 1 (default: layer 0).
        num_layers: Number of layers.

    Returns:
        height_m (num_layers, H, W) float64: height (m), -inf if there is no hit. triangle (num_layers, H, W) int64:
        index of the triangle, -1 if there is no hit.
    """
    pixel, triangle, value = find_hits(triangles_m, grid, np.arange(len(triangles_m)))
    if layer is not None:
        pixel += np.asarray(layer, np.int64)[triangle] * (grid.rows * grid.cols)
    height = np.full((num_layers, grid.rows, grid.cols), -np.inf)
    hit = np.full(height.shape, -1, np.int64)
    fill_triangles(pixel, triangle, value, height.reshape(-1), hit.reshape(-1))
    return height, hit


def rasterize_heights(triangles_m: np.ndarray, grid: Grid, layer: np.ndarray, num_layers: int) -> np.ndarray:
    """Return only the heights from `cast_rays_down`.

    Compared with `cast_rays_down`, this function needs half of the memory and less time.

    Args:
        triangles_m: (t, 3, 3) corners (x, y, z) in the frame of the grid (m).
        grid: Pixel grid.
        layer: (t,) layer of each triangle, in 0 .. num_layers - 1.
        num_layers: Number of layers.

    Returns:
        (num_layers, H, W) float32 height (m), -inf if there is no hit.
    """
    pixel, layer_start, value = find_hits(triangles_m, grid, np.asarray(layer, np.int64) * (grid.rows * grid.cols))
    height = np.full((num_layers, grid.rows, grid.cols), -np.inf, np.float32)
    np.maximum.at(height.reshape(-1), layer_start + pixel, value.astype(np.float32))
    return height


def fill_polygon(outline_m: np.ndarray, grid: Grid) -> np.ndarray:
    """Return a mask of the pixel centres inside a polygon, according to the even-odd rule.

    Args:
        outline_m: (n, 2) vertices (x, y) of any simple polygon (m); the last vertex connects to the first.
        grid: Pixel grid.

    Returns:
        (H, W) bool.
    """
    u = (grid.front_m - outline_m[:, 0]) / grid.resolution_m - 0.5
    v = (grid.left_m - outline_m[:, 1]) / grid.resolution_m - 0.5
    u_next, v_next = np.roll(u, -1), np.roll(v, -1)
    low, high = np.minimum(u, u_next), np.maximum(u, u_next)
    first = np.ceil(low).clip(0, grid.rows).astype(np.int64)
    # The row interval of each edge is half-open. A vertex on a row therefore counts once.
    beyond = np.ceil(high).clip(0, grid.rows).astype(np.int64)
    row, edge = concatenate_ranges(first, beyond - first), np.repeat(np.arange(len(u)), beyond - first)
    crossing = v[edge] + (row - u[edge]) / (u_next[edge] - u[edge]) * (v_next[edge] - v[edge])
    col = np.ceil(crossing).clip(0, grid.cols).astype(np.int64)
    toggles = np.bincount(row * (grid.cols + 1) + col, minlength=grid.rows * (grid.cols + 1))
    return (toggles.reshape(grid.rows, grid.cols + 1).cumsum(axis=1)[:, :-1] % 2).astype(bool)
