"""Add objects to a Sheet: plants, walls, cars, and furniture of the sidewalk. All lengths are in metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.preprocess.sources.town.assets import Rect, draw_sizes
from pipelines.preprocess.sources.town.land import Land, LocalFrame, Sheet
from pipelines.preprocess.sources.town.version2.districts import District, Variation

ALIGNED = 0.75  # Share of ellipsoids whose axes are parallel to the street.
CLUSTER_M = 1.3  # Spread of the plants of a cluster.
PLANTS_PER_CLUSTER = 1.2
CANDIDATES_PER_PLANT = 4  # Number of places of which a plant takes the one farthest from other plants.
WALL_LABELS = ("wall", "fence", "gate", "guardrail")
WALL_SHARES = (0.6, 0.29, 0.09, 0.02)


class StreetSheet(Sheet):
    """Sheet whose boxes keep their angle to the street where streets do not cross at right angles."""

    # A tilted pole would not touch its lamp or sign.
    upright = (*Sheet.upright, "smallPole", "bigPole", "lamp", "trafficSign", "trafficLight", "bicycle", "motorcycle")

    def __init__(self) -> None:
        super().__init__()
        self.box_yaw_rad: list[np.ndarray] = []  # (n,) angle of each box to the s axis of its frame.

    def take_yaw(self, yaw_rad: np.ndarray | float, count: int) -> np.ndarray | float:
        """Keep the angle of `count` boxes, which is measured in the world, and return an angle of 0 on the board."""
        self.box_yaw_rad.append(np.broadcast_to(np.asarray(yaw_rad, float), count))
        return 0.0

    def find_directions(self, rows: np.ndarray, land: Land) -> np.ndarray:
        """Return the world directions (n, 2) of the length axes of all boxes, whose rows are joined in `rows`."""
        along, yaw = super().find_directions(rows, land), np.concatenate(self.box_yaw_rad)
        cos, sin = np.cos(yaw), np.sin(yaw)
        return np.stack([cos * along[:, 0] - sin * along[:, 1], sin * along[:, 0] + cos * along[:, 1]], axis=1)


@dataclass(frozen=True)
class Site:
    """State while a block is built."""

    sheet: Sheet
    rng: np.random.Generator
    district: District
    variation: Variation


def is_free(s: np.ndarray, t: np.ndarray, taken: list[Rect], margin: float) -> np.ndarray:
    """Return whether points lie outside all rectangles, enlarged by a margin."""
    free = np.ones(len(s), bool)
    for s0, s1, t0, t1 in taken:
        free &= (s < s0 - margin) | (s > s1 + margin) | (t < t0 - margin) | (t > t1 + margin)
    return free


def scatter_plants(
    site: Site, width: float, depth: float, count: int, mean_t: float, taken: list[Rect], planted: np.ndarray
) -> np.ndarray:
    """Return free places (s, t) of at most `count` plants, about mean_t from the front and apart from `planted`."""
    rng = site.rng
    clusters = max(1, round(count / PLANTS_PER_CLUSTER))
    place = rng.integers(0, clusters, CANDIDATES_PER_PLANT * (count + 2))
    s = rng.uniform(0.2, max(0.3, width - 0.2), clusters)[place] + CLUSTER_M * rng.standard_normal(len(place))
    t = rng.gamma(1.8, mean_t / 1.8, clusters)[place] + CLUSTER_M * rng.standard_normal(len(place))
    inside = (s > 0.2) & (s < width - 0.2) & (t > 0.4) & (t < depth - 0.2)
    inside &= is_free(s, t, taken, 0.25)
    return choose_apart(np.stack([s[inside], t[inside]], axis=1), count, planted)


def choose_apart(places: np.ndarray, count: int, planted: np.ndarray) -> np.ndarray:
    """Return at most `count` of the places (n, 2), by Mitchell's best-candidate sampling (1991).

    Each chosen place is the one of the next few places that is farthest from `planted` (m, 2) and from those chosen.
    """
    chosen = list(planted)
    for group in np.array_split(places, max(1, min(count, len(places)))):
        if len(group):
            gaps = np.linalg.norm(group[:, None] - np.array(chosen).reshape(1, -1, 2), axis=2)
            chosen.append(group[int(gaps.min(axis=1, initial=np.inf).argmax())])
    return np.array(chosen[len(planted) :]).reshape(-1, 2)


def draw_yaw(rng: np.random.Generator, count: int, spread_rad: float = 0.15) -> np.ndarray:
    """Return angles (count,) along or across the street."""
    return np.pi / 2 * rng.integers(0, 2, count) + rng.normal(0, spread_rad, count)


def add_ellipsoids(site: Site, frame: LocalFrame, s: np.ndarray, t: np.ndarray, what: str) -> None:
    """Add trees or bushes. Tree crowns begin above the ground, and bushes begin at the ground."""
    count, rng = len(s), site.rng
    if not count:
        return
    size = draw_sizes(rng, what, count, site.district.tree_scale * site.variation.tree_size if what == "tree" else 1.0)
    bottom = rng.uniform(0.05, 0.25, count) * size[:, 2] if what == "tree" else rng.uniform(-0.3, 0.1, count)
    yaw = np.where(rng.random(count) < ALIGNED, draw_yaw(rng, count, 0.15), rng.uniform(-np.pi, np.pi, count))
    site.sheet.boxes(frame, "vegetation", s, t, size, yaw, bottom, ellipsoid=True)


def plant_garden(
    site: Site, frame: LocalFrame, width: float, depth: float, taken: list[Rect], lush: float = 1.0
) -> None:
    """Plant shrubs, bushes and trees. Most plants stand near the street, where a vehicle sees them."""
    district, variation, rng = site.district, site.variation, site.rng
    rates = (
        ("shrub", district.shrubs_per_100m * variation.shrubs, 5.8),
        ("bush", district.bushes_per_100m * variation.bushes, 3.4),
        ("tree", district.trees_per_100m * variation.trees, 4.4),
    )
    planted = {"shrub": np.empty((0, 2)), "ellipsoid": np.empty((0, 2))}
    for what, rate, mean_t in rates:
        count = int(rng.poisson(rate * lush * width / 100))
        if not count:
            continue
        kind = "shrub" if what == "shrub" else "ellipsoid"
        places = scatter_plants(site, width, depth, count, mean_t, taken, planted[kind])
        if not len(places):
            continue
        planted[kind] = np.concatenate([planted[kind], places])
        s, t = places.T
        if what != "shrub":
            add_ellipsoids(site, frame, s, t, what)
            continue
        scale = np.where(rng.random((len(s), 1)) < 0.08, 1.7, 1.0) * np.array([1.0, 0.93, 1.0])
        size = draw_sizes(rng, "shrub", len(s), scale)
        yaw = draw_yaw(rng, len(s))
        across = np.abs(np.sin(yaw)) > 0.7
        half = np.where(across, size[:, 0], size[:, 1]) / 2
        t = np.maximum(t, half + 0.1)  # Hedges do not reach onto the sidewalk.
        site.sheet.boxes(frame, "vegetation", s, t, size, yaw)


def add_patch(site: Site, frame: LocalFrame, ground_class: str, s: float, t: float, side_m: float) -> None:
    """Add a small square of ground, such as the pit of a tree or a landing. It covers the ground below."""
    a, b, c, d = s - side_m / 2, s + side_m / 2, t - side_m / 2, t + side_m / 2
    site.sheet.slab(frame, ground_class, [(a, c), (b, c), (b, d), (a, d)])


def add_hedge(site: Site, frame: LocalFrame, s0: float, t0: float, s1: float, t1: float, cover: float) -> None:
    """Add adjacent hedge pieces from (s0, t0) to (s1, t1) that cover the share `cover` of the length."""
    _add_line(site, frame, (s0, t0, s1, t1), "hedge", 5.6, cover)


def add_wall(site: Site, frame: LocalFrame, s0: float, t0: float, s1: float, t1: float, cover: float) -> None:
    """Add wall or fence pieces from (s0, t0) to (s1, t1) that cover the share `cover` of the length."""
    _add_line(site, frame, (s0, t0, s1, t1), "wall", 5.2, cover)


def _add_line(site: Site, frame: LocalFrame, ends: Rect, what: str, piece: float, cover: float) -> None:
    s0, t0, s1, t1 = ends
    length, rng = float(np.hypot(s1 - s0, t1 - t0)), site.rng
    if length * cover < 0.8:
        return
    count = max(1, round(length * cover / piece))
    size = draw_sizes(rng, what, count)
    share = rng.dirichlet(np.full(count, 8.0))
    size[:, 0] = length * cover * share
    start = rng.uniform(0, length * (1 - cover))
    middle = start + np.cumsum(size[:, 0]) - size[:, 0] / 2
    ds, dt = (s1 - s0) / length, (t1 - t0) / length
    (au, av), (iu, iv) = frame.along, frame.inward
    # The pieces follow the line, also where it is not at a right angle to the street.
    line = LocalFrame(
        frame.at(s0, t0).origin, (ds * au + dt * iu, ds * av + dt * iv), (ds * iu - dt * au, ds * iv - dt * av)
    )
    size[:, 1:] = size[0, 1:] * np.exp(0.06 * rng.standard_normal((count, 2)))
    if what == "hedge":
        site.sheet.boxes(line, "vegetation", middle, 0.0, size, rng.normal(0, 0.02, count))
    else:
        label = WALL_LABELS[int(rng.choice(len(WALL_LABELS), p=WALL_SHARES))]
        site.sheet.boxes(line, label, middle, 0.0, size)


def add_steps(site: Site, frame: LocalFrame, s: float, t0: float, t1: float, walk_m: float) -> None:
    """Add low walls at a door or a driveway of width walk_m: along its sides, along the sidewalk, and a step."""
    rng = site.rng
    length = float(np.clip(rng.uniform(2.0, 6.5), 0.9, max(0.9, t1 - t0)))
    t = t1 - length / 2 if rng.random() < 0.4 else t0 + length / 2
    for side in (-1, 1):
        if rng.random() < 0.3:
            size = draw_sizes(rng, "wall", 1)[0]
            size[0] = length
            site.sheet.boxes(frame, "wall", s + side * (walk_m / 2 + size[1] / 2), t, size, np.pi / 2)
        if rng.random() < 0.34:
            size = draw_sizes(rng, "wall", 1)[0]
            middle = s + side * (walk_m / 2 + size[0] / 2)
            site.sheet.boxes(frame, "wall", middle, t0 + size[1] / 2, size, 0.0)
    if rng.random() < 0.3:
        size = draw_sizes(rng, "wall", 1)[0] * (1, 1, 0.5)
        size[0] = max(size[1], walk_m)
        site.sheet.boxes(frame, "wall", s, t1 - size[1] / 2, size, 0.0)


def add_cars(site: Site, frame: LocalFrame, s: np.ndarray, t: float, yaw: float, turned: float = 0.05) -> None:
    """Add parked cars at the positions s. The share `turned` of the cars points the other way."""
    count, rng = len(s), site.rng
    if not count:
        return
    angle = yaw + np.pi * (rng.random(count) < turned) + rng.normal(0, 0.025, count)
    at, aside = s + rng.normal(0, 0.2, count), t + rng.normal(0, 0.1, count)
    site.sheet.boxes(frame, "car", at, aside, draw_sizes(rng, "car", count), angle)
