"""Exact top-down rasterisation: vertical ray casting at pixel centres, without casting a ray.

A vertical ray meets a triangle where its foot lies inside the triangle's shadow. So each triangle is filled row by
row: an interval of columns per row, a plane for the height, the highest hit wins. One kernel serves the ground
rasters (paper, Sec. 3.1), the BEV pictures and, after turning the mesh, the 3D pictures.
"""

from __future__ import annotations

import numpy as np

from models.scene import Grid

EDGE_PX = 1e-7  # a centre this close to an edge is inside: abutting triangles leave no crack
STEEP = 1e3  # metres a pixel: planes of sliver triangles, whose hits are kept within their own triangle's heights


def ranges(first: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Concatenated integer ranges first[i] .. first[i] + count[i] - 1, with the owner i of each value."""
    owner = np.repeat(np.arange(len(count), dtype=np.int32), count)
    start = first - (np.cumsum(count) - count)
    return start.astype(np.int32)[owner] + np.arange(len(owner), dtype=np.int32), owner


def _row_spans(u: np.ndarray, v: np.ndarray, rows: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Column intervals of triangles per pixel row.

    u, v (3, t): row and column coordinates of the corners, in pixels, a centre at each integer. Returns the row, the
    triangle and the low and high column coordinate of each span.
    """
    first = np.ceil(u.min(axis=0) - EDGE_PX).clip(0, rows).astype(np.int64)
    last = np.floor(u.max(axis=0) + EDGE_PX).clip(-1, rows - 1).astype(np.int64)
    row, triangle = ranges(first, (last - first + 1).clip(0))
    low, high = np.full(len(row), np.inf), np.full(len(row), -np.inf)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        ua, ub, va, vb = u[a], u[b], v[a], v[b]
        level = ua == ub  # an edge along a row: its ends are those of the other two
        per_row = np.where(level, 0.0, (vb - va) / np.where(level, 1.0, ub - ua))
        top, bottom = np.minimum(ua, ub) - EDGE_PX, np.where(level, -np.inf, np.maximum(ua, ub) + EDGE_PX)
        column = va[triangle] + (row - ua[triangle]) * per_row[triangle]
        # Within EDGE_PX beyond an end, the end itself.
        column = column.clip(np.minimum(va, vb)[triangle], np.maximum(va, vb)[triangle])
        crosses = (row >= top[triangle]) & (row <= bottom[triangle])
        np.minimum(low, column, out=low, where=crosses)
        np.maximum(high, column, out=high, where=crosses)
    return row, triangle, low, high


def _hits(triangles_m: np.ndarray, grid: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every pixel centre under every triangle (t, 3, 3): flat pixel index, triangle and height (m,) of each."""
    x, y, z = np.ascontiguousarray(np.asarray(triangles_m, np.float64).reshape(-1, 3, 3).T)  # (3, t) each
    u = (grid.front_m - x) / grid.resolution_m - 0.5
    v = (grid.left_m - y) / grid.resolution_m - 0.5
    # Plane z = z0 + du (u - u0) + dv (v - v0) by Cramer's rule.
    (u1, u2), (v1, v2), (z1, z2) = [(w[1] - w[0], w[2] - w[0]) for w in (u, v, z)]
    area = u1 * v2 - u2 * v1
    seen = (np.abs(area) > 1e-9) & (u.min(0) < grid.rows) & (u.max(0) > -1) & (v.min(0) < grid.cols) & (v.max(0) > -1)
    index = np.flatnonzero(seen)
    u, v, z, area = u[:, index], v[:, index], z[:, index], area[index]
    slope_u = (z1[index] * v2[index] - z2[index] * v1[index]) / area
    slope_v = (u1[index] * z2[index] - u2[index] * z1[index]) / area

    row, triangle, low, high = _row_spans(u, v, grid.rows)
    first = np.ceil(low - EDGE_PX).clip(0, grid.cols)
    count = (np.floor(high + EDGE_PX).clip(-1, grid.cols - 1) - first + 1).clip(0)
    # Along a row the height is linear: start + slope_v col.
    start = (z[0] - slope_u * u[0] - slope_v * v[0])[triangle] + slope_u[triangle] * row
    col, span = ranges(first.astype(np.int64), count.astype(np.int64))
    height = start[span] + slope_v[triangle][span] * col
    if np.abs(slope_u).max(initial=0) > STEEP or np.abs(slope_v).max(initial=0) > STEEP:
        height = height.clip(z.min(axis=0)[triangle][span], z.max(axis=0)[triangle][span])
    return row[span] * np.int32(grid.cols) + col, index[triangle][span], height


def cast_down(
    triangles_m: np.ndarray, grid: Grid, layer: np.ndarray | None = None, num_layers: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Highest hit of a vertical ray through each pixel centre, per layer.

    triangles_m (t, 3, 3): corners (x, y, z) in the grid's frame; layer (t,): which of num_layers each belongs to.
    Returns height_m (num_layers, H, W) float64, -inf where nothing is hit, and triangle (num_layers, H, W) int64,
    the index of the triangle hit, -1 for none. Of equal heights the last triangle wins. Vertical triangles cast no
    shadow and are skipped.
    """
    pixel, triangle, value = _hits(triangles_m, grid)
    if layer is not None:
        pixel = pixel + np.asarray(layer, np.int64)[triangle] * (grid.rows * grid.cols)
    height = np.full((num_layers, grid.rows, grid.cols), -np.inf)
    np.maximum.at(height.reshape(-1), pixel, value)
    hit = np.full(height.shape, -1, np.int64)
    wins = value == height.reshape(-1)[pixel]
    np.maximum.at(hit.reshape(-1), pixel[wins], triangle[wins])
    return height, hit


def height_map(triangles_m: np.ndarray, grid: Grid, layer: np.ndarray, num_layers: int) -> np.ndarray:
    """(num_layers, H, W) float32 of `cast_down`: the heights alone, in half the memory and less time."""
    pixel, triangle, value = _hits(triangles_m, grid)
    height = np.full((num_layers, grid.rows, grid.cols), -np.inf, np.float32)
    pixel += np.asarray(layer, np.int32)[triangle] * np.int32(grid.rows * grid.cols)
    np.maximum.at(height.reshape(-1), pixel, value.astype(np.float32))
    return height


def fill_polygon(outline_m: np.ndarray, grid: Grid) -> np.ndarray:
    """(H, W) bool: pixel centres inside a closed outline (n, 2), by the even-odd rule; any simple polygon."""
    u = (grid.front_m - outline_m[:, 0]) / grid.resolution_m - 0.5
    v = (grid.left_m - outline_m[:, 1]) / grid.resolution_m - 0.5
    u_next, v_next = np.roll(u, -1), np.roll(v, -1)
    low, high = np.minimum(u, u_next), np.maximum(u, u_next)
    first = np.ceil(low).clip(0, grid.rows).astype(np.int64)
    beyond = np.ceil(high).clip(0, grid.rows).astype(np.int64)  # half-open: a vertex on a row counts once
    row, edge = ranges(first, beyond - first)
    crossing = v[edge] + (row - u[edge]) / (u_next[edge] - u[edge]) * (v_next[edge] - v[edge])
    col = np.ceil(crossing).clip(0, grid.cols).astype(np.int64)
    toggles = np.bincount(row * (grid.cols + 1) + col, minlength=grid.rows * (grid.cols + 1))
    return (toggles.reshape(grid.rows, grid.cols + 1).cumsum(axis=1)[:, :-1] % 2).astype(bool)
