"""The street grid of a town: streets, junctions, the blocks between the streets, and the route of the car.

All coordinates are board coordinates (land.py). A u-street runs along v at a constant u. A v-street runs along u at a
constant v.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pipelines.preprocess.sources.town.land import LocalFrame, Sheet

ROAD_SLAB_M = 30.0  # Length of a road slab. A slab covers about 200 m2.
BOARD = LocalFrame((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
ARMS = ((1, 0), (0, 1), (-1, 0), (0, -1))  # east, north, west, south.

Node = tuple[int, int]


@dataclass(frozen=True, eq=False)
class Streets:
    """Streets and junctions of a town in board coordinates.

    Attributes:
        u_m: Positions of the u-streets (m).
        v_m: Positions of the v-streets (m).
        half_u_m: Half widths of the u-streets (m).
        half_v_m: Half widths of the v-streets (m).
        edges: Pairs of neighbouring nodes that a street connects; the lower node comes first.
        corner_m: Radius of the kerb at each junction (m).
    """

    u_m: np.ndarray
    v_m: np.ndarray
    half_u_m: np.ndarray
    half_v_m: np.ndarray
    edges: frozenset[tuple[Node, Node]]
    corner_m: dict[Node, float]

    def has(self, a: Node, b: Node) -> bool:
        """Return whether a street connects two neighbouring nodes."""
        return (min(a, b), max(a, b)) in self.edges

    def arms(self, node: Node) -> list[bool]:
        """Return four values: whether a street connects the node to its east, north, west and south neighbour."""
        return [self.has(node, (node[0] + di, node[1] + dj)) for di, dj in ARMS]

    def at(self, node: Node) -> np.ndarray:
        """Return the board position (2,) of a node."""
        return np.array([self.u_m[node[0]], self.v_m[node[1]]])

    def reach(self, node: Node, axis: int) -> float:
        """Return the extent of a junction from its centre along u (axis 0) or v (axis 1), in metres."""
        return (self.half_u_m[node[0]] if axis == 0 else self.half_v_m[node[1]]) + self.corner_m[node]


@dataclass(frozen=True)
class CityBlock:
    """A rectangle of the board between road edges.

    Attributes:
        u0: Lower bound along u (m).
        u1: Upper bound along u (m).
        v0: Lower bound along v (m).
        v1: Upper bound along v (m).
        streets: Four values, for the sides south, east, north and west: whether the side faces a street.
        corners: Kerb radii at the corners SW, SE, NE and NW (m); 0 at a corner without a kerb.
        kind: Name of the district.
    """

    u0: float
    u1: float
    v0: float
    v1: float
    streets: tuple[bool, bool, bool, bool]
    corners: tuple[float, float, float, float]
    kind: str

    def side(self, index: int) -> tuple[LocalFrame, float, float, float]:
        """Return the frame of a side, the length of the side, and the radii of its two corners.

        The origin of the frame is the left end of the side, seen from the middle of the street. t points into the
        block.
        """
        u0, u1, v0, v1 = self.u0, self.u1, self.v0, self.v1
        origin, along, inward, length = (
            ((u0, v0), (1.0, 0.0), (0.0, 1.0), u1 - u0),
            ((u1, v0), (0.0, 1.0), (-1.0, 0.0), v1 - v0),
            ((u1, v1), (-1.0, 0.0), (0.0, -1.0), u1 - u0),
            ((u0, v1), (0.0, -1.0), (1.0, 0.0), v1 - v0),
        )[index]
        return LocalFrame(origin, along, inward), length, self.corners[index], self.corners[(index + 1) % 4]


def lay_streets(
    rng: np.random.Generator, spacing_u_m: list[float], spacing_v_m: list[float], missing: float
) -> tuple[Streets, list[tuple[int, int, int, int]]]:
    """Return streets with the specified spacings, and blocks as node ranges (i0, i1, j0, j1).

    Some streets between two blocks are omitted; `missing` is their share. The blocks on both sides of an omitted street
    form one block, and the junctions at its ends become T-junctions.
    """
    u = np.concatenate([[0.0], np.cumsum(spacing_u_m)])
    v = np.concatenate([[0.0], np.cumsum(spacing_v_m)])
    nu, nv = len(u), len(v)
    edges = {((i, j), (i + 1, j)) for i in range(nu - 1) for j in range(nv)}
    edges |= {((i, j), (i, j + 1)) for i in range(nu) for j in range(nv - 1)}

    inner = [((i, j), (i, j + 1)) for i in range(1, nu - 1) for j in range(nv - 1)]
    inner += [((i, j), (i + 1, j)) for j in range(1, nv - 1) for i in range(nu - 1)]
    merged: dict[tuple[int, int], tuple[int, int, int, int]] = {}
    lost: set[Node] = set()
    for k in rng.permutation(len(inner)):
        (a, b), want = inner[k], rng.random() < missing
        vertical = a[0] == b[0]
        pair = [(a[0] - 1, a[1]), a] if vertical else [(a[0], a[1] - 1), a]
        if not want or a in lost or b in lost or pair[0] in merged or pair[1] in merged:
            continue
        edges.remove((a, b))
        lost |= {a, b}
        span = (pair[0][0], pair[1][0] + 1, pair[0][1], pair[1][1] + 1)
        merged[pair[0]] = merged[pair[1]] = span
    cells = {merged.get((i, j), (i, i + 1, j, j + 1)) for i in range(nu - 1) for j in range(nv - 1)}
    corner = {(i, j): float(rng.uniform(3.6, 6.2)) for i in range(nu) for j in range(nv)}
    half_u, half_v = rng.uniform(2.85, 3.75, nu), rng.uniform(2.85, 3.75, nv)
    return Streets(u, v, half_u, half_v, frozenset(edges), corner), sorted(cells)


def list_blocks(
    streets: Streets,
    cells: list[tuple[int, int, int, int]],
    kind_at: Callable[[float, float], str],
    outskirts_m: float,
) -> list[CityBlock]:
    """Return the blocks between the streets, and a ring of blocks of depth outskirts_m around the town.

    kind_at(u, v) returns the kind of district at the point (u, v) of the town's plan.
    """
    u, v, hu, hv = streets.u_m, streets.v_m, streets.half_u_m, streets.half_v_m
    blocks = []
    for i0, i1, j0, j1 in cells:
        radii = streets.corner_m
        corners = (radii[i0, j0], radii[i1, j0], radii[i1, j1], radii[i0, j1])
        kind = kind_at((u[i0] + u[i1]) / 2, (v[j0] + v[j1]) / 2)
        u0, u1, v0, v1 = u[i0] + hu[i0], u[i1] - hu[i1], v[j0] + hv[j0], v[j1] - hv[j1]
        blocks.append(CityBlock(u0, u1, v0, v1, (True, True, True, True), corners, kind))
    south, north, west, east = v[0] - hv[0], v[-1] + hv[-1], u[0] - hu[0], u[-1] + hu[-1]
    d, none = outskirts_m, (0.0, 0.0, 0.0, 0.0)
    for i in range(len(u) - 1):
        left, right = (west if i == 0 else u[i]), (east if i == len(u) - 2 else u[i + 1])
        middle = (u[i] + u[i + 1]) / 2
        blocks.append(
            CityBlock(left, right, south - d, south, (False, False, True, False), none, kind_at(middle, v[0]))
        )
        blocks.append(
            CityBlock(left, right, north, north + d, (True, False, False, False), none, kind_at(middle, v[-1]))
        )
    for j in range(len(v) - 1):
        low, high = (south if j == 0 else v[j]), (north if j == len(v) - 2 else v[j + 1])
        middle = (v[j] + v[j + 1]) / 2
        blocks.append(CityBlock(west - d, west, low, high, (False, True, False, False), none, kind_at(u[0], middle)))
        blocks.append(CityBlock(east, east + d, low, high, (False, False, False, True), none, kind_at(u[-1], middle)))
    for left, right, i in ((west - d, west, 0), (east, east + d, -1)):
        for low, high, j in ((south - d, south, 0), (north, north + d, -1)):
            blocks.append(CityBlock(left, right, low, high, (False, False, False, False), none, kind_at(u[i], v[j])))
    return [replace(b, u0=float(b.u0), u1=float(b.u1), v0=float(b.v0), v1=float(b.v1)) for b in blocks]


def pave_streets(streets: Streets, sheet: Sheet) -> None:
    """Add the road slabs of all streets and junctions, without gaps or overlaps."""
    for a, b in sorted(streets.edges):
        axis = 0 if a[1] == b[1] else 1
        start = streets.at(a)[axis] + streets.reach(a, axis)
        end = streets.at(b)[axis] - streets.reach(b, axis)
        middle = streets.v_m[a[1]] if axis == 0 else streets.u_m[a[0]]
        half = streets.half_v_m[a[1]] if axis == 0 else streets.half_u_m[a[0]]
        cuts = np.linspace(start, end, max(1, round((end - start) / ROAD_SLAB_M)) + 1)
        for low, high in pairwise(cuts.tolist()):
            corners = [(low, middle - half), (high, middle - half), (high, middle + half), (low, middle + half)]
            sheet.slab(BOARD, "road", corners if axis == 0 else [(y, x) for x, y in corners])
    for node in sorted(streets.corner_m):
        sheet.slab(BOARD, "road", trace_junction(streets, node))


def trace_junction(streets: Streets, node: Node) -> list[tuple[float, float]]:
    """Return the counter-clockwise outline of a junction; kerbs between neighbouring arms are quarter circles."""
    (u, v), arms, r = streets.at(node), streets.arms(node), streets.corner_m[node]
    hu, hv = streets.half_u_m[node[0]], streets.half_v_m[node[1]]
    points: list[tuple[float, float]] = []
    for quadrant, (su, sv) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        first, second = arms[quadrant], arms[(quadrant + 1) % 4]
        # The end of an arm is a straight edge. Each of the two adjacent quadrants adds one corner.
        along_first = (hu + r, hv) if quadrant % 2 == 0 else (hu, hv + r)
        along_second = (hu, hv + r) if quadrant % 2 == 0 else (hu + r, hv)
        if first and second:
            local = trace_kerb(hu, hv, r)[:: 1 if quadrant % 2 == 0 else -1]
        else:
            local = [along_first] * first + [(hu, hv)] + [along_second] * second
        points += [(float(u + su * x), float(v + sv * y)) for x, y in local]
    return points


def trace_kerb(hu: float, hv: float, r: float) -> list[tuple[float, float]]:
    """Return a quarter circle of radius r at a block corner, relative to a junction with half widths hu and hv."""
    angle = np.linspace(1.5 * np.pi, np.pi, 5)  # Angles, from the arm along u to the arm along v.
    return list(zip((hu + r + r * np.cos(angle)).tolist(), (hv + r + r * np.sin(angle)).tolist(), strict=True))


@dataclass(frozen=True, eq=False)
class Route:
    """A drive through all streets in board coordinates, with about one sample per metre.

    Attributes:
        uv: Position on the lane (m).
        heading: Unit direction of travel.
        lane_m: Distance from the centre of the lane to the centre of the street (m).
    """

    uv: np.ndarray  # (k, 2)
    heading: np.ndarray  # (k, 2)
    lane_m: np.ndarray  # (k,)


def plan_route(rng: np.random.Generator, streets: Streets) -> Route:
    """Plan a route on the right-hand lanes that uses every street at least once."""
    nodes = _walk(rng, streets)
    uv, lane = [], []
    for k, (a, b) in enumerate(pairwise(nodes)):
        start, end, aside = _compute_lane(streets, a, b)
        if k:
            uv.append(_compute_turn(uv[-1][-1], _compute_direction(nodes[k - 1], a), start, _compute_direction(a, b)))
            lane.append(np.full(len(uv[-1]), aside))
        steps = max(2, int(np.abs(end - start).max()))
        uv.append(start + (end - start) * np.linspace(0, 1, steps)[:, None])
        lane.append(np.full(steps, aside))
    uv, lane = np.concatenate(uv), np.concatenate(lane)
    ahead = np.gradient(uv, axis=0)
    return Route(uv, ahead / np.linalg.norm(ahead, axis=1, keepdims=True).clip(1e-9), lane)


def _compute_direction(a: Node, b: Node) -> np.ndarray:
    return np.sign(np.array(b, float) - np.array(a, float))


def _compute_lane(streets: Streets, a: Node, b: Node) -> tuple[np.ndarray, np.ndarray, float]:
    axis = 0 if a[1] == b[1] else 1
    along = _compute_direction(a, b)
    aside = float(streets.half_v_m[a[1]] if axis == 0 else streets.half_u_m[a[0]]) * 0.28
    right = np.array([along[1], -along[0]]) * aside
    start = streets.at(a) + along * streets.reach(a, axis) + right
    return start, streets.at(b) - along * streets.reach(b, axis) + right, aside


def _compute_turn(start: np.ndarray, heading: np.ndarray, end: np.ndarray, out: np.ndarray) -> np.ndarray:
    """Return a parabola (k, 2) from one lane to the next. For a U-turn, the path is a straight line."""
    knee = start + heading * ((end - start) @ heading) if abs(heading @ out) < 0.5 else (start + end) / 2
    steps = max(3, int(np.linalg.norm(end - start)))
    w = np.linspace(0, 1, steps)[1:-1, None]
    return (1 - w) ** 2 * start + 2 * w * (1 - w) * knee + w**2 * end


def _walk(rng: np.random.Generator, streets: Streets) -> list[Node]:
    """Return the nodes of a walk over all edges.

    The walk prefers unused streets, and it prefers straight streets to turns. At a node without unused streets, the
    walk goes to the nearest unused street.
    """
    near: dict[Node, list[Node]] = {}
    for a, b in sorted(streets.edges):
        near.setdefault(a, []).append(b)
        near.setdefault(b, []).append(a)
    fresh = set(streets.edges)
    nodes = sorted(near)
    walk = [nodes[rng.integers(len(nodes))]]
    while fresh:
        here = walk[-1]
        new = [n for n in near[here] if (min(here, n), max(here, n)) in fresh]
        if new:
            weight = np.ones(len(new))
            if len(walk) > 1:
                weight += [2.0 * (_compute_direction(walk[-2], here) @ _compute_direction(here, n) > 0.5) for n in new]
            path = [new[rng.choice(len(new), p=weight / weight.sum())]]
        else:
            path = _find_shortest(near, here, {n for edge in fresh for n in edge}, walk[-2] if len(walk) > 1 else None)
        for there in path:
            fresh.discard((min(walk[-1], there), max(walk[-1], there)))
            walk.append(there)
    return walk


def _find_shortest(near: dict[Node, list[Node]], start: Node, goals: set[Node], behind: Node | None) -> list[Node]:
    """Return the shortest path from start to the nearest goal.

    The path does not contain start and does not begin with a U-turn.
    """
    came: dict[Node, Node] = {n: start for n in near[start] if n != behind}
    queue = deque(came)
    while queue:
        here = queue.popleft()
        if here in goals:
            path = [here]
            while came[path[-1]] != start:
                path.append(came[path[-1]])
            return path[::-1]
        for there in near[here]:
            if there not in came and there != start:
                came[there] = here
                queue.append(there)
    raise AssertionError("no unused street is reachable, although all streets are connected")
