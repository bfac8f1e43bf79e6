"""Add single objects and groups of objects to a Sheet: cars, trees, hedges, walls and gardens.

All lengths are in metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pipelines.preprocess.sources.town.districts import District, Mood
from pipelines.preprocess.sources.town.land import LocalFrame, Sheet

Rect = tuple[float, float, float, float]  # s0, s1, t0, t1

# Per label: median (l, w, h); spread of the common scale factor; spread of each axis; smallest and largest (l, w, h).
SIZES = {
    "building": ((16, 12, 11), 0.16, 0.14, (8, 6.5, 4), (34, 22, 24)),
    "garage": ((8, 6.4, 3.4), 0.10, 0.08, (5, 3, 2.4), (12, 9, 5)),
    "tree": ((6.7, 6.0, 8.0), 0.36, 0.16, (1.2, 1.0, 1.0), (16, 15, 16)),
    "bush": ((4.2, 3.6, 3.8), 0.35, 0.20, (0.8, 0.8, 0.6), (8, 7, 6)),
    "hedge": ((5.0, 1.5, 1.9), 0.15, 0.42, (1.7, 0.6, 0.6), (15, 3.4, 4.5)),
    "shrub": ((4.9, 2.7, 2.0), 0.30, 0.28, (0.9, 0.7, 0.4), (14, 9, 6)),
    "wall": ((3.5, 0.75, 1.5), 0.05, 0.48, (0.9, 0.2, 0.5), (14, 1.6, 4)),
    "car": ((4.4, 2.0, 1.5), 0.04, 0.06, (3.3, 1.6, 1.2), (5.6, 2.5, 2.2)),
    "truck": ((8.3, 3.2, 2.8), 0.10, 0.10, (5, 2.2, 2.2), (16, 3.8, 4.2)),
    "bicycle": ((2.0, 0.75, 1.35), 0.06, 0.10, (1.4, 0.4, 0.9), (2.6, 1.2, 1.9)),
    "pedestrian": ((0.9, 0.8, 1.75), 0.05, 0.10, (0.5, 0.4, 1.1), (1.6, 1.3, 2.1)),
    "smallPole": ((0.55, 0.5, 2.2), 0.10, 0.18, (0.2, 0.2, 1.2), (1.2, 1.1, 3.2)),
    "bigPole": ((0.7, 0.68, 5.2), 0.08, 0.18, (0.3, 0.3, 3.2), (1.6, 1.5, 7.5)),
    "lamp": ((1.15, 0.65, 0.6), 0.12, 0.2, (0.4, 0.3, 0.3), (2.4, 1.2, 1.4)),
    "trafficSign": ((0.85, 0.6, 0.95), 0.10, 0.2, (0.3, 0.2, 0.4), (1.8, 1.2, 2.0)),
    "trafficLight": ((0.8, 0.7, 1.2), 0.10, 0.15, (0.4, 0.4, 0.6), (1.4, 1.2, 2.0)),
    "trashbin": ((0.95, 0.8, 1.2), 0.10, 0.15, (0.4, 0.4, 0.7), (1.8, 1.4, 1.8)),
    "box": ((1.3, 0.9, 1.3), 0.15, 0.22, (0.5, 0.4, 0.6), (3.2, 2.4, 2.6)),
}


@dataclass(frozen=True)
class Site:
    """State while a block is built: sheet, random generator, district and mood."""

    sheet: Sheet
    rng: np.random.Generator
    district: District
    mood: Mood


def draw_sizes(
    rng: np.random.Generator, what: str, n: int, scale: float | np.ndarray | tuple[float, float, float] = 1.0
) -> np.ndarray:
    """Return random sizes (n, 3) of n objects of one kind (m), with length >= width.

    `scale` multiplies the sizes: one factor for all axes, or one factor per axis.
    """
    median, common, each, low, high = SIZES[what]
    factor = np.exp(common * rng.standard_normal((n, 1)) + each * rng.standard_normal((n, 3)))
    drawn = (np.array(median) * scale * factor).clip(low, high)
    drawn[:, :2] = -np.sort(-drawn[:, :2], axis=1)
    return drawn


def plant_strip(
    sheet: Sheet, frame: LocalFrame, ground_class: str, start: float, end: float, t0: float, t1: float, piece: float
) -> None:
    """Add adjacent slabs from s = start to s = end, each about `piece` metres long."""
    cuts = np.linspace(start, end, max(1, round((end - start) / piece)) + 1).tolist()
    for a, b in pairwise(cuts):
        sheet.slab(frame, ground_class, [(a, t0), (b, t0), (b, t1), (a, t1)])


def place_cars(site: Site, frame: LocalFrame, s: np.ndarray, t: float, yaw: float = np.pi) -> None:
    """Place parked cars at the positions s along the street. Most cars point in the direction of the adjacent lane."""
    n = len(s)
    turned = yaw + np.pi * (site.rng.random(n) < 0.12) + site.rng.normal(0, 0.03, n)
    site.sheet.boxes(
        frame,
        "car",
        s + site.rng.normal(0, 0.25, n),
        t + site.rng.normal(0, 0.12, n),
        draw_sizes(site.rng, "car", n),
        turned,
    )


def plant_trees(site: Site, frame: LocalFrame, s: np.ndarray, t: np.ndarray, what: str) -> None:
    """Add ellipsoids at (s, t). Tree crowns begin above the ground, and bushes begin at the ground."""
    n = len(s)
    scale = site.district.tree_scale * site.mood.tree_size if what == "tree" else 1.0
    size = draw_sizes(site.rng, what, n, scale)
    bottom = site.rng.uniform(0.05, 0.3, n) * size[:, 2] if what == "tree" else 0.0
    site.sheet.boxes(frame, "vegetation", s, t, size, site.rng.uniform(-np.pi, np.pi, n), bottom, ellipsoid=True)


def plant_border(
    site: Site, frame: LocalFrame, s0: float, t0: float, s1: float, t1: float, kind: str, cover: float
) -> None:
    """Build a hedge or wall from (s0, t0) to (s1, t1) in pieces. The pieces cover the share `cover` of the length."""
    length = float(np.hypot(s1 - s0, t1 - t0))
    if length < 1.5:
        return
    mean = 6.2 if kind == "hedge" else 4.4
    size = draw_sizes(site.rng, kind, int(length * cover / mean + site.rng.random()))
    n = len(size)
    if not n:
        return
    yaw = np.arctan2(t1 - t0, s1 - s0)
    free = max(0.0, length - size[:, 0].sum())
    gaps = free * site.rng.dirichlet(np.ones(n + 1))[:n]
    if size[:, 0].sum() > length:
        size[:, 0] *= length / size[:, 0].sum()
    middle = np.cumsum(size[:, 0] + gaps) - size[:, 0] / 2
    s, t = s0 + np.cos(yaw) * middle, t0 + np.sin(yaw) * middle
    if kind == "hedge":
        site.sheet.boxes(frame, "vegetation", s, t, size, yaw + site.rng.normal(0, 0.03, n))
        return
    # A wall has nearly constant thickness and height along its length.
    size[:, 1:] = size[0, 1:] * np.exp(0.08 * site.rng.standard_normal((n, 2)))
    label = np.array(["wall", "fence", "wall", "gate", "guardrail"])[site.rng.choice(5, p=[0.5, 0.3, 0.08, 0.1, 0.02])]
    site.sheet.boxes(frame, str(label), s, t, size, yaw)


def plant_garden(
    site: Site, frame: LocalFrame, width: float, depth: float, taken: list[Rect], lush: float = 1.0
) -> None:
    """Plant shrubs, bushes and trees in a rectangle, but not in the `taken` rectangles (s0, s1, t0, t1)."""
    free = width * depth - sum((b - a) * (d - c) for a, b, c, d in taken)
    wanted = (
        ("shrub", site.district.shrubs_per_100m2 * site.mood.green),
        ("bush", site.district.bushes_per_100m2 * site.mood.green),
        ("tree", site.district.trees_per_100m2 * site.mood.trees),
    )
    for what, intensity in wanted:
        n = site.rng.poisson(max(0.0, free) * intensity * lush / 100)
        s, t = site.rng.uniform(0.3, width - 0.3, 2 * n + 4), site.rng.uniform(0.3, depth - 0.3, 2 * n + 4)
        clear = np.ones(len(s), bool)
        for a, b, c, d in taken:
            clear &= (s < a - 0.4) | (s > b + 0.4) | (t < c - 0.4) | (t > d + 0.4)
        s, t = s[clear][:n], t[clear][:n]
        if what == "shrub":
            size = draw_sizes(site.rng, "shrub", len(s))
            turned = np.minimum(s, width - s) < np.minimum(t, depth - t)  # The plant is parallel to the nearest border.
            yaw = np.pi / 2 * turned + site.rng.normal(0, 0.05, len(s))
            edge = site.rng.random(len(s)) < 0.55
            s = np.where(edge & turned, np.where(s < width / 2, size[:, 1] / 2, width - size[:, 1] / 2), s)
            t = np.where(edge & ~turned, np.where(t < depth / 2, 0.5 + size[:, 1] / 2, depth - size[:, 1] / 2), t)
            clear = np.ones(len(s), bool)
            for a, b, c, d in taken:
                clear &= (s <= a) | (s >= b) | (t <= c) | (t >= d)
            site.sheet.boxes(frame, "vegetation", s[clear], t[clear], size[clear], yaw[clear])
        else:
            plant_trees(site, frame, s, t, what)
