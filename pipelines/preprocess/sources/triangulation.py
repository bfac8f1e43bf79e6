"""Triangulate simple polygons with many vertices in little time, for any shape.

shapely triangulates by ear clipping, which needs seconds for some outlines of 10,000 points. This module instead cuts
the polygon into monotone pieces by a sweep line (de Berg et al., Computational Geometry, Ch. 3), triangulates the
pieces, and flips edges until the triangulation is Delaunay (Lawson, 1977). All steps use only the given vertices.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

FEW_POINTS = 1_000  # With so few vertices, shapely needs at most some 100 ms.
FLIPS_PER_VERTEX = 20  # Upper bound of the number of flips; real outlines need about one flip per vertex.

Points = Sequence[Sequence[float]]


def triangulate_polygon(vertices: np.ndarray) -> np.ndarray:
    """Triangulate a simple polygon.

    Args:
        vertices: (n, 2) different vertices of a simple polygon; the last vertex connects to the first.

    Returns:
        (t, 3) indices of vertices: the constrained Delaunay triangulation.
    """
    if len(vertices) > FEW_POINTS:
        triangles = _triangulate_monotone_pieces(vertices)
        if _fills_polygon(vertices, triangles):
            return triangles
    polygon = shapely.constrained_delaunay_triangles(shapely.Polygon(vertices))
    # Each triangle is a closed ring of four points.
    corners = shapely.get_coordinates(polygon).reshape(-1, 4, 2)[:, :3]
    index = {tuple(point): k for k, point in enumerate(vertices.tolist())}
    return np.array([[index[tuple(corner)] for corner in triangle] for triangle in corners.tolist()], int).reshape(
        -1, 3
    )


def _triangulate_monotone_pieces(vertices: np.ndarray) -> np.ndarray:
    """Return (t, 3) triangles. Rounding errors of almost degenerate polygons can make them incomplete."""
    x, y = vertices.T
    counterclockwise = np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)) > 0
    points = (vertices if counterclockwise else vertices[::-1]).tolist()
    try:
        pieces = _trace_pieces(points, _find_diagonals(points))
        triangles = [triangle for piece in pieces for triangle in _triangulate_monotone(points, piece)]
        triangles = _flip_to_delaunay(points, triangles)
    except (IndexError, KeyError):
        return np.zeros((0, 3), int)
    made = np.array(triangles, int).reshape(-1, 3)
    return made if counterclockwise else len(points) - 1 - made


def _fills_polygon(vertices: np.ndarray, triangles: np.ndarray) -> bool:
    """Return whether triangles are all counterclockwise or all clockwise and have the area of the polygon."""
    if len(triangles) == 0:
        return False
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    wanted = 2 * shapely.area(shapely.Polygon(vertices))
    tolerance = 1e-9 * wanted + 1e-13 * np.ptp(vertices, axis=0).max() ** 2
    return bool(abs(np.abs(area).sum() - wanted) <= tolerance and abs(abs(area.sum()) - wanted) <= tolerance)


def _cross(points: Points, a: int, b: int, c: int) -> float:
    """Return twice the area of the triangle a, b, c, positive if it is counterclockwise."""
    (ax, ay), (bx, by), (cx, cy) = points[a], points[b], points[c]
    return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)


def _find_diagonals(points: Points) -> list[tuple[int, int]]:
    """Return the diagonals that cut a counterclockwise polygon into pieces that are monotone in y."""
    n = len(points)
    order = sorted(range(n), key=lambda k: (-points[k][1], points[k][0]))  # The sweep line moves down.
    rank = [0] * n
    for place, k in enumerate(order):
        rank[k] = place
    edges: list[int] = []  # Edges k -> k + 1 on the sweep line with the interior on their right, from left to right.
    helper: dict[int, int] = {}
    merges: set[int] = set()
    diagonals = []

    def find(k: int) -> int:
        """Return the number of edges that lie to the left of vertex k."""
        low, high = 0, len(edges)
        while low < high:
            middle = (low + high) // 2
            if _cross(points, edges[middle], (edges[middle] + 1) % n, k) > 0:
                low = middle + 1
            else:
                high = middle
        return low

    def connect(k: int, edge: int, always: bool = False) -> None:
        if always or helper[edge] in merges:
            diagonals.append((k, helper[edge]))

    def remove(k: int) -> None:
        """Remove the edge that ends in vertex k."""
        edge, place = (k - 1) % n, find(k)
        for near in range(max(0, place - 1), min(len(edges), place + 3)):
            if edges[near] == edge:
                del edges[near]
                return
        edges.remove(edge)

    def insert(k: int) -> None:
        edges.insert(find(k), k)
        helper[k] = k

    try:
        for k in order:
            before, after = (k - 1) % n, (k + 1) % n
            starts, ends = rank[before] > rank[k] < rank[after], rank[before] < rank[k] > rank[after]
            convex = _cross(points, before, k, after) > 0
            if starts and convex:
                insert(k)
            elif starts:
                left = edges[find(k) - 1]
                connect(k, left, always=True)
                helper[left] = k
                insert(k)
            elif ends and convex:
                connect(k, before)
                remove(k)
            else:
                if ends or rank[before] < rank[k]:
                    connect(k, before)
                    remove(k)
                if ends or rank[before] > rank[k]:
                    left = edges[find(k) - 1]
                    connect(k, left)
                    helper[left] = k
                else:
                    insert(k)
                if ends:
                    merges.add(k)
    except ValueError:  # Rounding errors changed the order of the edges.
        raise IndexError from None
    return diagonals


def _trace_pieces(points: Points, diagonals: list[tuple[int, int]]) -> list[list[int]]:
    """Return the pieces of a counterclockwise polygon that diagonals cut apart, each as a counterclockwise list."""
    n = len(points)
    ends: list[list[int]] = [[] for _ in range(n)]
    for a, b in diagonals:
        ends[a].append(b)
        ends[b].append(a)
    successors: dict[tuple[int, int], int] = {}
    for k, others in enumerate(ends):
        # Neighbours by angle, clockwise from the previous vertex of the outline to the next vertex.
        around = [(k + 1) % n, *others, (k - 1) % n]
        x, y = points[k]
        angle = {other: np.arctan2(points[other][1] - y, points[other][0] - x) for other in around}
        first = angle[around[0]]
        # The interior lies counterclockwise of the next vertex, up to the previous vertex.
        inner = sorted(others, key=lambda other: (angle[other] - first) % (2 * np.pi))
        fan = [around[0], *inner, around[-1]]
        for here, there in zip(fan[1:], fan[:-1], strict=True):
            successors[here, k] = there
    pieces = []
    while successors:
        (a, b), following = successors.popitem()
        piece = [a, b]
        while following != a:
            piece.append(following)
            a_, b = b, following
            following = successors.pop((a_, b))
        successors.pop((b, a))
        pieces.append(piece)
    return pieces


def _triangulate_monotone(points: Points, piece: list[int]) -> list[tuple[int, int, int]]:
    """Return the triangles of a counterclockwise piece that is monotone in y."""
    if len(piece) == 3:
        return [(piece[0], piece[1], piece[2])]
    keys = [(-points[k][1], points[k][0]) for k in piece]
    top, bottom = keys.index(min(keys)), keys.index(max(keys))
    m = len(piece)
    left = {piece[(top + step) % m] for step in range((bottom - top) % m)}  # Counterclockwise leads down on the left.
    order = [piece[place] for place in sorted(range(m), key=keys.__getitem__)]
    stack, triangles = order[:2], []
    for k in order[2:]:
        if k == order[-1] or (k in left) != (stack[-1] in left):
            for a, b in zip(stack[:-1], stack[1:], strict=True):
                triangles.append((a, b, k))
            stack = [stack[-1], k]
            continue
        last = stack.pop()
        side = 1.0 if k in left else -1.0
        while stack and side * _cross(points, stack[-1], last, k) > 0:
            triangles.append((stack[-1], last, k))
            last = stack.pop()
        stack += [last, k]
    return [t if _cross(points, *t) >= 0 else (t[0], t[2], t[1]) for t in triangles]


def _flip_to_delaunay(points: Points, triangles: list[tuple[int, int, int]]) -> list[tuple[int, int, int]]:
    """Flip inner edges until each satisfies the Delaunay condition, or a bound on the number of flips is reached."""
    apex: dict[tuple[int, int], int] = {}  # Third corner of the triangle on the left of each directed edge.
    for a, b, c in triangles:
        apex[a, b], apex[b, c], apex[c, a] = c, a, b
    stack = [edge for edge in apex if edge[0] < edge[1] and edge[::-1] in apex]
    flips = FLIPS_PER_VERTEX * len(points)
    while stack and flips:
        a, b = stack.pop()
        c, d = apex.get((a, b)), apex.get((b, a))
        if c is None or d is None or not _is_inside_circle(points, a, b, c, d):
            continue
        if _cross(points, c, d, b) <= 0 or _cross(points, d, c, a) <= 0:  # The two triangles are not convex.
            continue
        del apex[a, b], apex[b, a]
        apex[c, d], apex[d, b], apex[b, c] = b, c, d
        apex[d, c], apex[c, a], apex[a, d] = a, d, c
        stack += [(b, c), (c, a), (a, d), (d, b)]
        flips -= 1
    return [(a, b, c) for (a, b), c in apex.items() if a < b and a < c]


def _is_inside_circle(points: Points, a: int, b: int, c: int, d: int) -> bool:
    """Return whether d lies clearly inside the circle through a, b, c, which are counterclockwise."""
    (dx, dy) = points[d]
    (ax, ay), (bx, by), (cx, cy) = ((x - dx, y - dy) for x, y in (points[a], points[b], points[c]))
    aa, bb, cc = ax * ax + ay * ay, bx * bx + by * by, cx * cx + cy * cy
    terms = aa * (bx * cy - by * cx), bb * (cx * ay - cy * ax), cc * (ax * by - ay * bx)
    return sum(terms) > 1e-12 * sum(map(abs, terms))
