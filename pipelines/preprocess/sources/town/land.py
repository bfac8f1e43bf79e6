"""The terrain of a town (bends of streets and hills) and the container for its slabs and boxes.

A town is designed in board coordinates (u, v) in metres, where every street is straight. `Land` maps the board to the
world frame by two shears, x = u + a(v) and y = v + b(x). Shears keep areas, and adjacent shapes remain adjacent.
Streets become curved, and some junctions are not right-angled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

SLAB_THICKNESS_M = 0.6  # Thickness of KITTI-360's ground slabs. Objects stand on the mid-plane of the slabs.
EDGE_STEP_M = 10.0  # Maximum length of a slab edge. Short edges have small errors at bends and hills.
MAX_CORNERS = 40  # Maximum number of corners of a slab, as in KITTI-360.


@dataclass(frozen=True, eq=False)
class Land:
    """Map from board to world coordinates, and the height of the real surface."""

    bend_u: np.ndarray  # (k, 3): amplitude (m), wave number (rad/m) and phase (rad) of a(v).
    bend_v: np.ndarray  # (k, 3): amplitude (m), wave number (rad/m) and phase (rad) of b(x).
    hills: np.ndarray  # (k, 4): amplitude (m), wave vector (2,) in rad/m, phase (rad).
    yaw_rad: float
    origin_m: np.ndarray  # (3,) float64 world position of board point (0, 0).

    def _turn(self) -> np.ndarray:
        cos, sin = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.array([[cos, -sin], [sin, cos]])

    def _bend(self, uv: np.ndarray) -> np.ndarray:
        x = uv[..., 0] + _draw_waves(self.bend_u, uv[..., 1])
        return np.stack([x, uv[..., 1] + _draw_waves(self.bend_v, x)], axis=-1)

    def xy(self, uv: np.ndarray) -> np.ndarray:
        """Return the world x and y of board points (..., 2)."""
        return self._bend(np.asarray(uv, np.float64)) @ self._turn().T + self.origin_m[:2]

    def uv(self, xy: np.ndarray) -> np.ndarray:
        """Return the board points of world points (..., 2), the inverse of `xy`."""
        x, y = np.moveaxis((np.asarray(xy, np.float64) - self.origin_m[:2]) @ self._turn(), -1, 0)
        v = y - _draw_waves(self.bend_v, x)
        return np.stack([x - _draw_waves(self.bend_u, v), v], axis=-1)

    def direction(self, uv: np.ndarray, along: np.ndarray) -> np.ndarray:
        """Return the unit world direction (..., 2) of the board direction `along` (..., 2) at `uv`."""
        bent = self._bend(uv)
        dx = along[..., 0] + _compute_slopes(self.bend_u, uv[..., 1]) * along[..., 1]
        dy = along[..., 1] + _compute_slopes(self.bend_v, bent[..., 0]) * dx
        world = np.stack([dx, dy], axis=-1) @ self._turn().T
        return world / np.linalg.norm(world, axis=-1, keepdims=True)

    def surface_m(self, xy: np.ndarray) -> np.ndarray:
        """Return the world z of the real surface (...,) at world points (..., 2)."""
        phase = (np.asarray(xy) - self.origin_m[:2]) @ self.hills[:, 1:3].T + self.hills[:, 3]
        return self.origin_m[2] + (self.hills[:, 0] * np.sin(phase)).sum(axis=-1)

    def grade(self, xy: np.ndarray) -> np.ndarray:
        """Return the slope of the surface along world x and y (..., 2)."""
        phase = (np.asarray(xy) - self.origin_m[:2]) @ self.hills[:, 1:3].T + self.hills[:, 3]
        return (self.hills[:, 0] * np.cos(phase)) @ self.hills[:, 1:3]


def _draw_waves(waves: np.ndarray, at: np.ndarray) -> np.ndarray:
    return (waves[:, 0] * np.sin(at[..., None] * waves[:, 1] + waves[:, 2])).sum(axis=-1)


def _compute_slopes(waves: np.ndarray, at: np.ndarray) -> np.ndarray:
    return (waves[:, 0] * waves[:, 1] * np.cos(at[..., None] * waves[:, 1] + waves[:, 2])).sum(axis=-1)


def draw_land(rng: np.random.Generator) -> Land:
    """Sample the terrain of a town and its position in the world frame.

    Streets bend by at most about 15 degrees in each direction. The slope of hills is at most 3 %.
    """

    def bends() -> np.ndarray:
        wave = 2 * np.pi / rng.uniform(170, 480, 2)
        slope = rng.uniform(0.0, 0.27) * rng.dirichlet([1.5, 1.5])
        return np.stack([slope / wave, wave, rng.uniform(0, 2 * np.pi, 2)], axis=1)

    # The slopes of the two waves are perpendicular, and the total slope never exceeds 3 %.
    wave, direction = 2 * np.pi / rng.uniform(320, 760, 2), rng.uniform(0, 2 * np.pi) + np.array([0.0, np.pi / 2])
    steepest, share = rng.uniform(0.026, 0.03), rng.uniform(0.3, 1.27)
    grade = steepest * np.array([np.cos(share), np.sin(share)])
    vector = wave[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
    hills = np.column_stack([grade / wave, vector, rng.uniform(0, 2 * np.pi, 2)])
    origin = np.array([*rng.uniform(500, 4000, 2), rng.uniform(108, 125)])
    return Land(bends(), bends(), hills, rng.uniform(-np.pi, np.pi), origin)


@dataclass(frozen=True)
class LocalFrame:
    """Local frame on the board: s runs along a street, and t points away from the street. Axes are unit directions."""

    origin: tuple[float, float]
    along: tuple[float, float]
    inward: tuple[float, float]

    def uv(self, s: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return the board points (..., 2) of (s, t)."""
        (ou, ov), (au, av), (iu, iv) = self.origin, self.along, self.inward
        return np.stack([ou + s * au + t * iu, ov + s * av + t * iv], axis=-1)

    def at(self, s: float, t: float) -> LocalFrame:
        """Return the frame with its origin at (s, t) and the same axes."""
        (ou, ov), (au, av), (iu, iv) = self.origin, self.along, self.inward
        return LocalFrame((ou + s * au + t * iu, ov + s * av + t * iv), self.along, self.inward)


class Sheet:
    """Slabs and boxes of a town in board coordinates, before `Land` maps them to the world frame."""

    upright = ("building", "garage", "car", "truck", "bus")  # Labels of boxes that are never tilted at random.

    def __init__(self) -> None:
        self.slabs: list[tuple[str, np.ndarray]] = []  # ground class and outline (n, 2), clockwise or counter-clockwise
        self.box_label: list[str] = []
        self.box_rows: list[
            np.ndarray
        ] = []  # (n, 11): u, v, along u, along v, l, w, h, bottom, ellipsoid, timestamp, track.

    def slab(self, frame: LocalFrame, ground_class: str, outline_st: list[tuple[float, float]]) -> None:
        """Add a slab with an outline in (s, t)."""
        st = np.asarray(outline_st, np.float64)
        self.slabs.append((ground_class, frame.uv(st[:, 0], st[:, 1])))

    def boxes(
        self,
        frame: LocalFrame,
        label: str,
        s: np.ndarray | Sequence[float] | float,
        t: np.ndarray | Sequence[float] | float,
        size_m: np.ndarray,
        yaw_rad: np.ndarray | float = 0.0,
        bottom_m: np.ndarray | float = 0.0,
        ellipsoid: bool = False,
        timestamp: np.ndarray | int = -1,
        track: np.ndarray | int = -1,
    ) -> None:
        """Add n boxes of one label.

        Args:
            frame: Local frame in which s and t are defined.
            label: Label of the boxes.
            s: Position along the street (m), (n,) or one value for all boxes.
            t: Distance from the street (m), (n,) or one value for all boxes.
            size_m: (n, 3) or (3,) length, width and height.
            yaw_rad: Angle from the s axis to the length axis (rad).
            bottom_m: Height of the underside above the surface (m).
            ellipsoid: Whether the primitives are ellipsoids.
            timestamp: Frame of a moving box; -1 for static boxes.
            track: Track number of a moving object; -1 for static objects.
        """
        s, t, size_m = np.atleast_1d(s), np.atleast_1d(t), np.atleast_2d(size_m)
        rows = np.empty((len(s), 11))
        rows[:, :2] = frame.uv(s, t)
        yaw_rad = self.take_yaw(yaw_rad, len(s))
        cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
        rows[:, 2] = cos * frame.along[0] + sin * frame.inward[0]
        rows[:, 3] = cos * frame.along[1] + sin * frame.inward[1]
        rows[:, 4:7] = size_m
        rows[:, 7], rows[:, 8], rows[:, 9], rows[:, 10] = bottom_m, ellipsoid, timestamp, track
        self.box_label += [label] * len(s)
        self.box_rows.append(rows)

    def take_yaw(self, yaw_rad: np.ndarray | float, count: int) -> np.ndarray | float:
        """Return the angle on the board of `count` boxes; a subclass can keep the angle until `find_directions`."""
        return yaw_rad

    def find_directions(self, rows: np.ndarray, land: Land) -> np.ndarray:
        """Return the world directions (n, 2) of the length axes of all boxes, whose rows are joined in `rows`."""
        return land.direction(rows[:, :2], rows[:, 2:4])


def trace_outlines(cells: np.ndarray, s: list[float], t: list[float]) -> list[tuple[int, list[tuple[float, float]]]]:
    """Return the outlines of the patches in a grid of cells.

    A patch is a 4-connected set of cells with the same value >= 0. A patch must have no holes. Outlines need not be
    rectangles.

    Args:
        cells: (len(s) - 1, len(t) - 1) int; value of each cell.
        s: Grid lines along the first axis, ascending.
        t: Grid lines along the second axis, ascending.

    Returns:
        Value and outline of each patch.
    """
    columns, rows = cells.shape
    patch = -np.ones((columns, rows), int)
    found: list[tuple[int, list[tuple[float, float]]]] = []
    for i0 in range(columns):
        for j0 in range(rows):
            if cells[i0, j0] < 0 or patch[i0, j0] >= 0:
                continue
            value, index, stack, members = cells[i0, j0], len(found), [(i0, j0)], []
            patch[i0, j0] = index
            while stack:
                i, j = stack.pop()
                members.append((i, j))
                for a, b in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
                    inside = 0 <= a < columns and 0 <= b < rows
                    if inside and patch[a, b] < 0 and cells[a, b] == value:
                        patch[a, b] = index
                        stack.append((a, b))
            found.append((int(value), [(s[i], t[j]) for i, j in _trace(set(members))]))
    return found


def _trace(members: set[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the corners of the outer outline of a set of unit cells, counter-clockwise. Collinear edges are merged."""
    ahead: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for i, j in members:
        sides = (((0, -1), (i, j), (i + 1, j)), ((1, 0), (i + 1, j), (i + 1, j + 1)))
        sides += (((0, 1), (i + 1, j + 1), (i, j + 1)), ((-1, 0), (i, j + 1), (i, j)))
        for (di, dj), start, end in sides:
            if (i + di, j + dj) not in members:
                ahead.setdefault(start, []).append(end)
    start = min(ahead)
    outline, here, step = [start], start, (0, -1)
    while True:
        # Where two cells touch only at a corner, turn to the left to follow the same cell.
        options = ahead[here]
        there = max(options, key=lambda p: step[0] * (p[1] - here[1]) - step[1] * (p[0] - here[0]))
        options.remove(there)
        turned = (there[0] - here[0], there[1] - here[1])
        if turned == step:
            outline.pop()
        outline.append(there)
        here, step = there, turned
        if here == start:
            outline.pop()
            return outline


def subdivide_outline(outline: np.ndarray) -> np.ndarray:
    """Split long edges of an outline (m, 2) at multiples of EDGE_STEP_M.

    Neighbouring outlines therefore share the new corners. Only edges parallel to a board axis are split. The result is
    counter-clockwise. If the result has more than MAX_CORNERS corners, the step is doubled or quadrupled.
    """
    for step in (EDGE_STEP_M, 2 * EDGE_STEP_M, 4 * EDGE_STEP_M, 1e6):
        cut = _cut(outline, step)
        if len(cut) <= MAX_CORNERS:
            break
    return cut


def _cut(outline: np.ndarray, step: float) -> np.ndarray:
    following = np.roll(outline, -1, axis=0)
    if (outline[:, 0] * following[:, 1] - outline[:, 1] * following[:, 0]).sum() < 0:
        outline = outline[::-1]
        following = np.roll(outline, -1, axis=0)
    points = []
    for (au, av), (bu, bv) in zip(outline.tolist(), following.tolist(), strict=True):
        points.append((au, av))
        axis = 0 if abs(bu - au) > abs(bv - av) else 1
        low, high = sorted(((au, bu), (av, bv))[axis])
        if high - low <= step * 0.5 or min(abs(bu - au), abs(bv - av)) > 1e-6:
            continue
        cuts = np.arange(np.ceil((low + 0.8) / step), np.floor((high - 0.8) / step) + 1) * step
        if (bu, bv)[axis] < (au, av)[axis]:
            cuts = cuts[::-1]
        points += [(c, av) if axis == 0 else (au, c) for c in cuts.tolist()]
    return np.array(points)


def clip_ears(outline: np.ndarray) -> list[tuple[int, int, int]]:
    """Triangulate a simple counter-clockwise outline (n, 2), convex or not, into n - 2 index triples."""
    points = outline.tolist()

    def turn(a: int, b: int, c: int) -> float:
        (ax, ay), (bx, by), (cx, cy) = points[a], points[b], points[c]
        return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)

    left = list(range(len(points)))
    triangles = []
    at, refused, slack = 0, 0, 0.0
    while len(left) > 3:
        n = len(left)
        a, b, c = left[(at - 1) % n], left[at % n], left[(at + 1) % n]
        ear = turn(a, b, c) > -slack
        if ear:
            for k in range(n):
                p = left[k]
                if p in (a, b, c) or turn(left[k - 1], p, left[(k + 1) % n]) > 0:
                    continue  # Only reflex corners can lie inside an ear.
                if turn(a, b, p) >= 0 and turn(b, c, p) >= 0 and turn(c, a, p) >= 0:
                    ear = False
                    break
        if ear:
            triangles.append((a, b, c))
            left.pop(at % n)
            at, refused = (at + 1) % (n - 1), 0  # Skip one corner to avoid fans of thin triangles.
        else:
            at, refused = (at + 1) % n, refused + 1
            if refused > n:  # Accept ears without area, because all remaining corners are collinear.
                assert slack == 0.0, "the outline must not cross itself"
                slack, refused = 1e-6, 0
    triangles.append(tuple(left))
    return triangles
