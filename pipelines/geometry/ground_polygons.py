"""Convert the fused ground of a Scene to a mesh and to polygons with smooth borders between classes.

The scene stores one class per pixel. Between pixels, each class has a score: its mask, smoothed by a Gaussian. The
border between two classes lies where their scores are equal. The ground is divided into triangles whose corners are
pixel centres. A border crosses an edge whose ends have different classes at one point, and a triangle with three
classes is divided at a point in its middle. All classes therefore share their borders, without gaps or overlaps, and
every pixel centre keeps its class.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely
from scipy import ndimage

from models.scene import Grid, Scene
from pipelines.geometry.rasterize import cast_rays_down

SMOOTH_PX = 1.0  # Standard deviation of the Gaussian.
LEAST_MARGIN = 0.1  # Smallest difference between scores. Borders keep a distance from pixel centres.


class GroundMesh(NamedTuple):
    """Triangles of the ground in the scene frame. All classes use the same vertices.

    Attributes:
        vertices_m: Vertices (m): first those of the pixels, then those of the borders.
        triangles: Indices of vertices, counter-clockwise seen from above.
        class_index: Class of each triangle, as an index into `Scene.ground_classes`.
    """

    vertices_m: np.ndarray  # (v, 3) float64
    triangles: np.ndarray  # (t, 3) int64
    class_index: np.ndarray  # (t,) int64


class _Division(NamedTuple):
    """Division of all triangles between pixel centres, including those without ground (class -1).

    The points are numbered: pixels (with a border row and column on each side), then crossings on edges along rows,
    along columns and along diagonals, then middles of triangles.
    """

    points_px: np.ndarray  # (p, 2) row and column.
    uniform_blocks: np.ndarray  # (u,) first pixel of each block of 2 x 2 pixels of one class.
    triangles: np.ndarray  # (t, 3) triangles of the other blocks.
    triangle_class: np.ndarray  # (t,)
    segments: np.ndarray  # (s, 2) borders, with their class on the left side seen from above.
    segment_class: np.ndarray  # (s,)
    crossings: np.ndarray  # (c,) numbers of the crossings.
    crossing_ends: np.ndarray  # (c, 2) pixels at the ends of the edge of each crossing.
    crossing_share: np.ndarray  # (c,) position of each crossing between its two ends.
    middle_pixels: np.ndarray  # (m, 3) pixels around each middle of a triangle, numbered from p - m.


def build_ground_polygons(scene: Scene, simplify_m: float = 0.0) -> dict[str, shapely.MultiPolygon]:
    """Trace the area of each ground class, seen from above.

    The polygons of different classes do not overlap, and adjacent polygons share their vertices.

    Args:
        scene: Scene.
        simplify_m: Simplify shared borders with the method of Visvalingam and Whyatt. A vertex may be removed if the
            triangle with its neighbours is smaller than the square of this length (m). 0: keep all vertices.

    Returns:
        Polygons by class name in the scene frame (m), for each class that occurs.

    Raises:
        ValueError: `simplify_m` is negative or not finite.
    """
    if not (np.isfinite(simplify_m) and simplify_m >= 0):
        raise ValueError(f"simplify_m is {simplify_m}, expected 0 or more (metres)")
    _, winner = scene.surface()
    parts = _divide_ground(winner, len(scene.ground_classes))
    xy_m = _convert_to_metres(parts.points_px, scene.grid)
    names, shapes = [], []
    for index, name in enumerate(scene.ground_classes):
        rings = _trace_rings(parts.segments[parts.segment_class == index])
        if rings:
            area = shapely.build_area(shapely.MultiLineString([xy_m[[*ring, ring[0]]] for ring in rings]))
            names.append(name)
            shapes.append(area)
    if simplify_m and shapes:
        shapes = shapely.coverage_simplify(shapes, simplify_m)
    return {
        name: shape if isinstance(shape, shapely.MultiPolygon) else shapely.MultiPolygon([shape])
        for name, shape in zip(names, shapes, strict=True)
    }


def build_smooth_ground(scene: Scene) -> GroundMesh:
    """Build the mesh of the fused ground with smooth borders between classes.

    Heights are linear between pixel centres. At a border with an area without ground, the height is that of the pixel.

    Args:
        scene: Scene.

    Returns:
        The mesh. It covers exactly the polygons of `build_ground_polygons`.
    """
    height_m, winner = scene.surface()
    parts = _divide_ground(winner, len(scene.ground_classes))
    padded, cols = np.pad(winner, 1, mode="edge").ravel(), winner.shape[1] + 2
    known = padded >= 0
    pixel_m = np.pad(height_m, 1, mode="edge").ravel().astype(float)
    start, end = parts.crossing_ends.T
    share = np.where(known[start] & known[end], parts.crossing_share, np.where(known[start], 0.0, 1.0))
    middle = np.where(known[parts.middle_pixels], 1.0, 0.0)
    z_m = np.zeros(len(parts.points_px))
    z_m[: len(pixel_m)] = pixel_m
    z_m[parts.crossings] = (1 - share) * pixel_m[start] + share * pixel_m[end]
    middle_m = (pixel_m[parts.middle_pixels] * middle).sum(axis=1) / middle.sum(axis=1).clip(1)
    z_m[len(z_m) - len(middle_m) :] = middle_m
    kept, block = parts.triangle_class >= 0, parts.uniform_blocks
    block = block[known[block]]
    first, second = (block, block + cols, block + 1), (block + 1, block + cols, block + cols + 1)
    whole = np.stack([*first, *second], axis=1).reshape(-1, 3)
    triangles = np.concatenate([whole, parts.triangles[kept]])
    used = np.zeros(len(z_m), bool)
    used[triangles] = True
    vertices_m = np.column_stack([_convert_to_metres(parts.points_px[used], scene.grid), z_m[used]])
    class_index = np.concatenate([np.repeat(padded[block].astype(np.int64), 2), parts.triangle_class[kept]])
    return GroundMesh(vertices_m, (np.cumsum(used) - 1)[triangles], class_index)


def resample_smoothly(scene: Scene, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Rasterise the fused ground of a scene on another grid of any resolution.

    In contrast to `models.tensors.resample_scene_ground`, borders are smooth on finer grids.

    Args:
        scene: Scene.
        grid: Grid of the result.

    Returns:
        Height (H, W) in metres float32, and class (H, W) int8 as an index into `ground_classes`; -1: no ground.
    """
    mesh = build_smooth_ground(scene)
    height_m, hit = (part[0] for part in cast_rays_down(mesh.vertices_m[mesh.triangles], grid))
    found = hit >= 0
    classes = np.append(mesh.class_index, -1)[hit].astype(np.int8)
    return np.where(found, height_m, 0).astype(np.float32), classes


def _convert_to_metres(points_px: np.ndarray, grid: Grid) -> np.ndarray:
    """Convert rows and columns, where pixel centres have integer coordinates, to x and y in the scene frame (m)."""
    return np.array([grid.front_m, grid.left_m]) - (points_px + 0.5) * grid.resolution_m


def _compute_scores(winner: np.ndarray, num_classes: int) -> np.ndarray:
    """Return the smoothed mask (K + 1, H, W) of each class; the last mask is that of pixels without ground."""
    scores = np.zeros((num_classes + 1, *winner.shape), np.float32)
    for k in np.unique(winner):
        ndimage.gaussian_filter(
            (winner == k).astype(np.float32), SMOOTH_PX, output=scores[k], mode="nearest", truncate=3
        )
    return scores


def _divide_ground(winner: np.ndarray, num_classes: int) -> _Division:
    """Divide the triangles between pixel centres at the borders of classes.

    A border row and column on each side extend the pixels to the border of the grid.
    """
    scores = np.pad(_compute_scores(winner, num_classes), ((0, 0), (1, 1), (1, 1)), mode="edge")
    scores = scores.reshape(num_classes + 1, -1)
    classes = np.pad(winner, 1, mode="edge").astype(np.int64)
    rows, cols = classes.shape
    place = [np.clip(np.arange(-1, n - 1), -0.5, n - 2.5) for n in (rows, cols)]
    nodes_px = np.stack(np.meshgrid(*place, indexing="ij"), axis=-1).reshape(-1, 2)
    count, classes = rows * cols, classes.ravel()
    node = np.arange(count).reshape(rows, cols)
    points_px = np.concatenate([nodes_px, np.zeros((3 * count, 2))])
    # Edges along rows, columns and diagonals. The number of an edge is that of the first pixel of its block.
    along, across, diagonal = count, 2 * count, 3 * count
    numbers, starts, stops = [], [], []
    for offset, low, high in ((along, 0, 1), (across, 0, cols), (diagonal, 1, cols)):
        block = node[: rows - (offset != along), : cols - (offset != across)].ravel()
        block = block[classes[block + low] != classes[block + high]]
        numbers.append(offset + block)
        starts.append(block + low)
        stops.append(block + high)
    number, p, q = np.concatenate(numbers), np.concatenate(starts), np.concatenate(stops)
    a, b = classes[p], classes[q]
    margin_p = np.maximum(scores[a, p] - scores[b, p], LEAST_MARGIN)
    margin_q = np.maximum(scores[b, q] - scores[a, q], LEAST_MARGIN)
    share = margin_p / (margin_p + margin_q)
    points_px[number] = nodes_px[p] + share[:, None] * (nodes_px[q] - nodes_px[p])

    square = classes.reshape(rows, cols)
    uniform = (square[:-1, :-1] == square[1:, :-1]) & (square[:-1, :-1] == square[:-1, 1:])
    uniform &= square[:-1, :-1] == square[1:, 1:]
    here = node[:-1, :-1][~uniform]
    first = np.stack([here, here + cols, here + 1], axis=1)
    second = np.stack([here + 1, here + cols, here + cols + 1], axis=1)
    corners = np.concatenate([first, second])
    crossings = np.concatenate(  # Crossing between each corner and the next.
        [
            np.stack([across + here, diagonal + here, along + here], axis=1),
            np.stack([diagonal + here, along + here + cols, across + here + 1], axis=1),
        ]
    )
    pieces, piece_class, segments, segment_class = [], [], [], []
    of = classes[corners]
    same = (of == of[:, :1]).all(axis=1)
    pieces.append(corners[same])
    piece_class.append(of[same, 0])
    for turn in range(3):  # The third corner differs from the other two, which have the same class.
        i, j, k = (turn + 1) % 3, (turn + 2) % 3, turn
        alone = (of[:, i] == of[:, j]) & (of[:, k] != of[:, i])
        a, b, c = corners[alone][:, [i, j, k]].T
        enter, leave = crossings[alone][:, j], crossings[alone][:, k]
        pair, single = of[alone, i], of[alone, k]
        pieces += [np.stack(t, axis=1) for t in ((a, b, enter), (a, enter, leave), (c, leave, enter))]
        piece_class += [pair, pair, single]
        segments += [np.stack([enter, leave], axis=1), np.stack([leave, enter], axis=1)]
        segment_class += [pair, single]
    three = np.flatnonzero((of[:, 0] != of[:, 1]) & (of[:, 1] != of[:, 2]) & (of[:, 0] != of[:, 2]))
    middle = len(points_px) + np.arange(len(three))
    points_px = np.concatenate([points_px, points_px[crossings[three]].mean(axis=1)])
    for k in range(3):
        corner, after, before = corners[three, k], crossings[three, k], crossings[three, k - 1]
        pieces += [np.stack(t, axis=1) for t in ((corner, after, middle), (corner, middle, before))]
        piece_class += [of[three, k]] * 2
        segments += [np.stack([after, middle], axis=1), np.stack([middle, before], axis=1)]
        segment_class += [of[three, k]] * 2
    # The border of the grid, in the direction of the triangles at it.
    outer = np.concatenate(
        [
            np.stack([node[:-1, 0], node[1:, 0], across + node[:-1, 0]], axis=1),
            np.stack([node[-1, :-1], node[-1, 1:], along + node[-1, :-1]], axis=1),
            np.stack([node[1:, -1], node[:-1, -1], across + node[:-1, -1]], axis=1),
            np.stack([node[0, 1:], node[0, :-1], along + node[0, :-1]], axis=1),
        ]
    )
    differ = classes[outer[:, 0]] != classes[outer[:, 1]]
    for picked, (low, high) in ((~differ, (0, 1)), (differ, (0, 2)), (differ, (2, 1))):
        segments.append(outer[picked][:, [low, high]])
        segment_class.append(classes[outer[picked, 1 if (low, high) == (2, 1) else 0]])
    return _Division(
        points_px,
        node[:-1, :-1][uniform],
        np.concatenate(pieces),
        np.concatenate(piece_class),
        np.concatenate(segments),
        np.concatenate(segment_class),
        number,
        np.stack([p, q], axis=1),
        share,
        corners[three],
    )


def _trace_rings(segments: np.ndarray) -> list[list[int]]:
    """Join directed segments (s, 2) of one class to closed rings of point numbers.

    Each point is the start of at most one segment of a class.
    """
    following = dict(zip(segments[:, 0].tolist(), segments[:, 1].tolist(), strict=True))
    rings = []
    while following:
        start, point = following.popitem()
        ring = [start]
        while point != start:
            ring.append(point)
            point = following.pop(point)
        rings.append(ring)
    return rings
