"""Reference lines of OpenDRIVE roads: lines, arcs, spirals, cubic polynomials and parametric cubic curves.

Formulas: ASAM OpenDRIVE 1.7, Sec. 7 (geometry) and 9 (lanes). All angles are counter-clockwise from x.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

STEP_M = 0.5  # Step of numerical integration of spirals.
GAUSS_X, GAUSS_W = np.polynomial.legendre.leggauss(5)


class Cubics(NamedTuple):
    """Piecewise cubic polynomials a + b d + c d^2 + d d^3 of the distance d from the start of a piece.

    Attributes:
        start_m: Starts of the pieces, ascending (m).
        terms: Coefficients a, b, c and d of each piece.
    """

    start_m: np.ndarray  # (k,)
    terms: np.ndarray  # (k, 4)

    def evaluate(self, at_m: np.ndarray, default: float = 0.0) -> np.ndarray:
        """Return the values at distances.

        Args:
            at_m: (n,) distances from the start of the road or the lane section (m).
            default: Value before the first piece, and without pieces.

        Returns:
            (n,) values.
        """
        if not len(self.start_m):
            return np.full(len(at_m), default)
        piece = np.searchsorted(self.start_m, at_m + 1e-9, side="right") - 1
        d = at_m - self.start_m[piece.clip(0)]
        a, b, c, e = self.terms[piece.clip(0)].T
        return np.where(piece >= 0, a + d * (b + d * (c + d * e)), default)


NO_CUBICS = Cubics(np.zeros(0), np.zeros((0, 4)))


@dataclass(frozen=True)
class Geometry:
    """One piece of a reference line.

    Attributes:
        kind: line, arc, spiral, poly3 or paramPoly3.
        s_m: Start along the road (m).
        x_m: x of the start (m).
        y_m: y of the start (m).
        heading_rad: Direction at the start.
        length_m: Length (m).
        values: Parameters of the kind: curvature (arc), start and end curvature (spiral), a to d (poly3), or the eight
            coefficients of u and v and whether the parameter is normalised (paramPoly3).
    """

    kind: str
    s_m: float
    x_m: float
    y_m: float
    heading_rad: float
    length_m: float
    values: tuple[float, ...] = ()

    def evaluate(self, distance_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points and directions.

        Args:
            distance_m: (n,) distances from the start of the piece, ascending (m).

        Returns:
            Points (n, 2) in the inertial frame (m), and directions (n,) (rad).
        """
        u, v, turn = _EVALUATE[self.kind](distance_m, self.length_m, self.values)
        cos, sin = np.cos(self.heading_rad), np.sin(self.heading_rad)
        points = np.stack([self.x_m + cos * u - sin * v, self.y_m + sin * u + cos * v], axis=1)
        return points, self.heading_rad + turn


Local = tuple[np.ndarray, np.ndarray, np.ndarray]  # u and v (m), and direction relative to u (rad)


def _evaluate_line(d: np.ndarray, length: float, values: tuple[float, ...]) -> Local:
    return d, np.zeros_like(d), np.zeros_like(d)


def _evaluate_arc(d: np.ndarray, length: float, values: tuple[float, ...]) -> Local:
    turn = values[0] * d
    if abs(values[0]) < 1e-12:
        return _evaluate_line(d, length, values)
    return np.sin(turn) / values[0], (1 - np.cos(turn)) / values[0], turn


def _evaluate_spiral(d: np.ndarray, length: float, values: tuple[float, ...]) -> Local:
    """Integrate cos and sin of the direction, a quadratic polynomial of the distance, by Gaussian quadrature."""
    start, end = values
    slope = (end - start) / length if length else 0.0

    def find_turn(at: np.ndarray) -> np.ndarray:
        return at * (start + slope * at / 2)

    steps = np.union1d(np.append(np.arange(0.0, d.max(initial=0.0), STEP_M), 0.0), d)
    half = np.diff(steps)[:, None] / 2
    turn = find_turn(steps[:-1, None] + half * (1 + GAUSS_X))
    u = np.append(0.0, np.cumsum((half * GAUSS_W * np.cos(turn)).sum(axis=1)))
    v = np.append(0.0, np.cumsum((half * GAUSS_W * np.sin(turn)).sum(axis=1)))
    place = np.searchsorted(steps, d)
    return u[place], v[place], find_turn(d)


def _evaluate_poly3(d: np.ndarray, length: float, values: tuple[float, ...]) -> Local:
    """Evaluate v(u). The length along the curve is approximated by a table."""
    a, b, c, e = values
    table = np.linspace(0.0, length, max(2, int(length / STEP_M) + 1) * 4)
    slope = b + table * (2 * c + 3 * e * table)
    speed = np.hypot(1.0, slope)
    along = np.append(0.0, np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(table)))
    u = np.interp(d, along, table)
    return u, a + u * (b + u * (c + e * u)), np.arctan(b + u * (2 * c + 3 * e * u))


def _evaluate_param_poly3(d: np.ndarray, length: float, values: tuple[float, ...]) -> Local:
    *terms, is_normalized = values
    p = d / length if is_normalized and length else d
    (a, b, c, e), (a2, b2, c2, e2) = terms[:4], terms[4:]
    u, v = a + p * (b + p * (c + e * p)), a2 + p * (b2 + p * (c2 + e2 * p))
    return u, v, np.arctan2(b2 + p * (2 * c2 + 3 * e2 * p), b + p * (2 * c + 3 * e * p))


_EVALUATE = {
    "line": _evaluate_line,
    "arc": _evaluate_arc,
    "spiral": _evaluate_spiral,
    "poly3": _evaluate_poly3,
    "paramPoly3": _evaluate_param_poly3,
}
KINDS = tuple(_EVALUATE)


@dataclass(frozen=True, eq=False)
class ReferenceLine:
    """The reference line of a road with its heights.

    Attributes:
        length_m: Length seen from above (m).
        pieces: Geometries, by ascending start.
        elevation: Height of the reference line (m).
        superelevation: Lateral slope (rad); positive: the left side is higher.
    """

    length_m: float
    pieces: tuple[Geometry, ...]
    elevation: Cubics
    superelevation: Cubics

    def evaluate(self, s_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points and directions.

        Args:
            s_m: (n,) distances along the road, ascending (m).

        Returns:
            Points (n, 3) in the inertial frame (m), and directions (n,) (rad).
        """
        starts = np.array([piece.s_m for piece in self.pieces])
        owner = np.searchsorted(starts, s_m + 1e-9, side="right").clip(1) - 1
        points, direction = np.zeros((len(s_m), 2)), np.zeros(len(s_m))
        for index in np.unique(owner):
            mine, piece = owner == index, self.pieces[index]
            distance = (s_m[mine] - piece.s_m).clip(0.0, piece.length_m)
            points[mine], direction[mine] = piece.evaluate(distance)
        return np.column_stack([points, self.elevation.evaluate(s_m)]), direction

    def place(self, s_m: np.ndarray, t_m: np.ndarray, height_m: np.ndarray | float = 0.0) -> np.ndarray:
        """Return points next to the reference line.

        Args:
            s_m: (n,) distances along the road, ascending (m).
            t_m: (n,) distances from the line, positive on the left (m).
            height_m: Height above the surface of the road (m).

        Returns:
            (n, 3) points in the inertial frame (m).
        """
        points, direction = self.evaluate(s_m)
        tilt = self.superelevation.evaluate(s_m)
        points[:, 0] -= t_m * np.cos(tilt) * np.sin(direction)
        points[:, 1] += t_m * np.cos(tilt) * np.cos(direction)
        points[:, 2] += t_m * np.sin(tilt) + height_m
        return points

    def list_stations(self, start_m: float, end_m: float, step_m: float, extra_m: np.ndarray) -> np.ndarray:
        """Return distances from start_m to end_m with steps of at most step_m, and the starts of pieces and records.

        Args:
            start_m: First distance (m).
            end_m: Last distance (m).
            step_m: Largest step (m).
            extra_m: Further distances to include (m).

        Returns:
            (n,) distances, ascending (m).
        """
        count = max(1, int(np.ceil((end_m - start_m) / step_m)))
        starts = np.array([piece.s_m for piece in self.pieces])
        found = np.concatenate([np.linspace(start_m, end_m, count + 1), starts, extra_m])
        return np.unique(found[(found >= start_m) & (found <= end_m)])
