"""Build the plots of a row: houses, garages, driveways, paths, annotated ground, gardens and small objects.

A row runs along a street. Its houses stand on one building line. The annotated ground ends at a depth behind the
houses, because a vehicle on the street sees no further.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipelines.preprocess.sources.town.assets import Rect, draw_sizes
from pipelines.preprocess.sources.town.land import LocalFrame
from pipelines.preprocess.sources.town.plots import GROUND, NOTHING, PARKING, TERRAIN, paint_strip
from pipelines.preprocess.sources.town.version2.assets import (
    Site,
    add_cars,
    add_hedge,
    add_patch,
    add_steps,
    add_wall,
    plant_garden,
)

MIN_FRONT_M = 5.0
MIN_PIECE_M = 0.15
TURNED = 0.18  # Share of detached houses that are not parallel to the street.
DETACHED_GARAGES = 0.7  # Share of garages with a gap to the house.
Kind = Literal["detached", "terrace", "perimeter", "court", "green"]
COURT_M = (7.0, 12.0)  # Depth of a car park in front of houses.


@dataclass(frozen=True)
class Row:
    """Properties that the plots of a row share.

    Attributes:
        kind: Arrangement of the houses.
        depth: Depth of the row.
        setback: Distance of the building line from the sidewalk.
        house_depth: Extent of the houses away from the street.
        seen: Depth of the annotated ground.
        lawn: Whether ground is annotated.
        below: Whether the annotated ground continues below the houses.
        height: Median height of the houses.
        wall_front: Whether walls, not hedges, stand along the sidewalk.
    """

    kind: Kind
    depth: float
    setback: float
    house_depth: float
    seen: float
    lawn: bool
    below: bool
    height: float
    wall_front: bool

    @property
    def reach(self) -> float:
        """Depth up to the back of the houses."""
        return min(self.depth, self.setback + self.house_depth) if self.kind != "green" else min(self.depth, 8.0)


@dataclass(frozen=True)
class Plot:
    """A plot of a row: width, extent of the house along the street, and widths of the driveway and of the left gap."""

    width: float
    front: float
    driveway: float
    left: float
    joined: bool = False


def draw_row(site: Site, kind: Kind, depth: float) -> Row:
    """Sample the properties of a row whose depth is at most `depth`."""
    rng, district = site.rng, site.district
    scale = np.array(district.house_scale)
    size = draw_sizes(rng, "building", 1, scale)[0]
    across, height = float(size[rng.integers(0, 2)]), float(size[2])
    setback = float(rng.uniform(*district.setback_m))
    if kind == "perimeter":
        setback, height = float(rng.uniform(0.1, 0.8)), float(height * 1.15)
    if kind == "court":
        setback, across = float(rng.uniform(*COURT_M)) + 0.8, float(min(across, 14.0))
    if kind == "terrace":
        setback, across = float(rng.uniform(1.5, 4.5)), float(np.clip(across, 8.5, 11.5))
    across = float(min(across, max(MIN_FRONT_M, depth - 1.0)))
    setback = min(setback, max(0.2, depth - across - 0.5))
    behind = float(rng.uniform(*district.behind_m))
    seen = min(depth, setback + across + behind) if kind != "green" else min(depth, float(rng.uniform(5.0, 18.0)))
    lawn, below = bool(rng.random() < district.lawn), bool(rng.random() < district.ground_below)
    wall_front = bool(rng.random() < district.walls / (district.walls + district.hedges))
    return Row(kind, depth, setback, across, seen, lawn, below, float(height), wall_front)


def build_row(site: Site, frame: LocalFrame, length: float, row: Row) -> None:
    """Build the plots of a row side by side. Plot widths are scaled to fill the row."""
    if length < 3.0:
        return
    if row.kind == "green" or length < MIN_FRONT_M + 2:
        build_green(site, frame, length, min(row.depth, row.seen))
        return
    plots = _plan_plots(site, row, length)
    used = sum(plot.width for plot in plots)
    factor, s = length / used, 0.0
    for plot in plots:
        scaled = Plot(plot.width * factor, plot.front * factor, plot.driveway * factor, plot.left * factor, plot.joined)
        _build_plot(site, frame.at(s, 0.0), row, scaled)
        s += scaled.width


def _plan_plots(site: Site, row: Row, length: float) -> list[Plot]:
    """Return plots whose total width differs from `length` by at most half a plot."""
    rng, district, plots, used = site.rng, site.district, [], 0.0
    left_in_group = 0
    while True:
        size = draw_sizes(rng, "building", 1, np.array(district.house_scale) * site.variation.room)[0]
        if row.kind in ("detached", "court"):
            front = float(size[rng.integers(0, 2)])
            gaps = rng.uniform(*district.gap_m, 2)
            has_driveway = row.kind == "detached" and rng.random() < district.driveways
            driveway = float(rng.uniform(5.0, 8.4)) if has_driveway else 0.0
            plot = Plot(front + driveway + float(gaps.sum()), front, driveway, float(gaps[0]))
        else:
            front = float(rng.uniform(5.6, 7.6) if row.kind == "terrace" else rng.uniform(9.0, 17.0))
            gap = 0.0
            if left_in_group == 0:
                left_in_group = int(rng.integers(3, 7))
                gap = float(rng.uniform(2.0, 5.0)) if plots else 0.0
            left_in_group -= 1
            plot = Plot(front + gap, front, 0.0, gap, joined=True)
        if plots and used + plot.width / 2 > length:
            return plots
        plots.append(plot)
        used += plot.width


def _build_plot(site: Site, frame: LocalFrame, row: Row, plot: Plot) -> None:
    rng, district = site.rng, site.district
    if (not plot.joined and rng.random() < district.vacant) or plot.front < MIN_FRONT_M - 1:
        build_green(site, frame, plot.width, min(row.depth, row.seen))
        return
    mirrored = not plot.joined and rng.random() < 0.5
    # A mirrored plot has its driveway on the other side: s is reflected.
    s0 = plot.left + (plot.driveway if not mirrored else 0.0)
    setback = row.setback + (0.0 if plot.joined else float(rng.normal(0, 0.35)))
    setback = float(np.clip(setback, 0.1, max(0.2, row.depth - row.house_depth)))
    across = row.house_depth * (1.0 if plot.joined else float(np.exp(rng.normal(0, 0.12))))
    walls: Rect = (s0, s0 + plot.front, setback, setback + across)
    height = row.height * float(np.exp(rng.normal(0, 0.03 if plot.joined else 0.12)))
    _add_building(site, frame, "building", walls, height, 0.0 if plot.joined else _draw_turn(rng))
    painted: list[tuple[int, Rect]] = [] if row.below else [(NOTHING, walls)]
    taken: list[Rect] = [walls]
    open_front: list[tuple[float, float]] = []
    if not plot.joined and rng.random() < district.passages:
        room = plot.width - plot.front - plot.driveway - plot.left if mirrored is False else plot.left
        wide = min(room, float(rng.uniform(1.8, 4.2)))
        side = (walls[1], walls[1] + wide) if not mirrored else (walls[0] - wide, walls[0])
        painted.append((GROUND, (*side, 0.0, setback + across)))
        taken.append((*side, 0.0, setback + across))
    if plot.driveway > 2.2:
        strip = (plot.left, plot.left + plot.driveway) if not mirrored else (walls[1], walls[1] + plot.driveway)
        driveway = _build_driveway(site, frame, row, walls, strip)
        painted.append((PARKING if rng.random() < 0.85 else GROUND, driveway))
        taken.append(driveway)
        open_front.append(driveway[:2])
    court = row.kind == "court" or (rng.random() < district.paved_fronts and setback > 2.0)
    if row.kind == "court":
        lot = (0.0, plot.width, 0.0, setback - 0.6)
        painted.insert(0, (PARKING, lot))
        taken.append(lot)
        at = np.arange(1.6, plot.width - 1.4, 2.8)
        cars = at[rng.random(len(at)) < 0.38 * site.variation.cars]
        add_cars(site, frame, cars, setback - 3.4, np.pi / 2, 0.2)
    elif court:
        painted.insert(0, (PARKING if rng.random() < 0.5 else GROUND, (walls[0], walls[1], 0.0, setback)))
        taken.append((walls[0], walls[1], 0.0, setback))
        if setback > 5.5:
            at = np.arange(walls[0] + 1.5, walls[1] - 1.2, 2.8)
            add_cars(site, frame, at[rng.random(len(at)) < 0.4 * site.variation.cars], setback - 2.8, np.pi / 2)
    elif setback > 0.8:
        door = float(rng.uniform(walls[0] + 0.2 * plot.front, walls[1] - 0.2 * plot.front))
        walk = float(rng.uniform(1.0, 1.9))
        path = (door - walk / 2, door + walk / 2, 0.0, setback)
        if rng.random() < 0.7:
            painted.append((GROUND, path))
        taken.append(path)
        open_front.append(path[:2])
        for _ in range(rng.poisson(district.steps_per_plot * site.variation.walls * (0.5 if plot.joined else 1.0))):
            at = door if rng.random() < 0.6 else float(rng.uniform(0.5, plot.width - 0.5))
            add_steps(site, frame, at, 0.1, setback, walk)
    for _ in range(rng.poisson(district.patches_per_100m * plot.width / 100)):
        s, t = rng.uniform(0.5, plot.width - 0.5), rng.uniform(0.5, max(0.6, setback - 0.4))
        add_patch(site, frame, "ground", s, t, float(rng.uniform(0.5, 0.95)))
    base = TERRAIN if row.lawn else NOTHING
    paint_plot(site, frame, plot.width, row.seen, base, painted, 0.0 if row.below else setback)
    _add_borders(site, frame, row, plot.width, setback, open_front, court)
    plant_garden(site, frame, plot.width, min(row.depth, setback + across + 4.0), taken)
    _add_belongings(site, frame, walls, open_front)


def _draw_turn(rng: np.random.Generator) -> float:
    """Return the angle of a detached house to the street; a few houses are turned away from it."""
    return float(rng.normal(0, 0.28 if rng.random() < TURNED else 0.03))


def _add_building(site: Site, frame: LocalFrame, label: str, walls: Rect, height: float, turn_rad: float) -> None:
    along, across = walls[1] - walls[0], walls[3] - walls[2]
    yaw = turn_rad if along >= across else np.pi / 2 + turn_rad
    size = np.array([max(along, across), min(along, across), height])
    site.sheet.boxes(frame, label, (walls[0] + walls[1]) / 2, (walls[2] + walls[3]) / 2, size, yaw)


def _build_driveway(site: Site, frame: LocalFrame, row: Row, walls: Rect, strip: tuple[float, float]) -> Rect:
    """Build a driveway next to a house, with a garage at its end, a car and low walls. Return the driveway."""
    rng, width = site.rng, strip[1] - strip[0]
    end = float(np.clip(walls[2] + rng.uniform(1.0, 9.0), 4.8, max(4.8, row.depth - 6.0)))
    if rng.random() < site.district.garages and row.depth - end > 5.0:
        size = draw_sizes(rng, "garage", 1)[0]
        deep = min(float(size[0]), row.depth - end - 0.2)
        apart = float(rng.uniform(0.3, 0.7)) if rng.random() < DETACHED_GARAGES else 0.05
        garage = (strip[0] + apart, strip[1] - apart, end, end + deep)
        _add_building(site, frame, "garage", garage, float(size[2]), 0.0)
    if rng.random() < site.district.driveway_cars * site.variation.cars and end > 5.0:
        middle = (strip[0] + strip[1]) / 2
        add_cars(site, frame, np.array([middle]), float(rng.uniform(2.6, max(2.7, end - 2.4))), np.pi / 2, 0.4)
    if rng.random() < 0.45 * min(1.5, site.variation.walls):
        add_steps(site, frame, (strip[0] + strip[1]) / 2, 0.1, min(end, walls[2] + 2.0), width)
    return (strip[0], strip[1], 0.0, end)


def _add_borders(
    site: Site, frame: LocalFrame, row: Row, width: float, setback: float, gates: list[tuple[float, float]], court: bool
) -> None:
    """Add hedges or walls along the sidewalk, except at gates, and along one side of the plot."""
    rng, district, variation = site.rng, site.district, site.variation
    density = district.walls * variation.walls if row.wall_front else district.hedges * variation.shrubs
    if not court and setback > 1.0 and rng.random() < min(1.0, 1.4 * density):
        start = 0.2
        for gate in [*sorted(gates), (width - 0.2, width)]:
            if gate[0] - start > 1.2:
                line = (start, 0.45, gate[0] - 0.1, 0.45)
                (add_wall if row.wall_front else add_hedge)(site, frame, *line, float(rng.uniform(0.6, 1.0)))
            start = max(start, gate[1] + 0.1)
    end = min(row.depth, setback + float(rng.uniform(3.0, 10.0)))
    if rng.random() < district.walls * variation.walls:
        add_wall(site, frame, 0.1, 0.4, 0.1, end, float(rng.uniform(0.5, 1.0)))
    elif rng.random() < district.hedges * variation.shrubs:
        add_hedge(site, frame, 0.2, 0.8, 0.2, end, float(rng.uniform(0.5, 1.0)))


def _add_belongings(site: Site, frame: LocalFrame, walls: Rect, gates: list[tuple[float, float]]) -> None:
    """Add bins, boxes and bicycles near the entrances of a plot."""
    rng, front = site.rng, walls[2]
    count = rng.poisson(site.district.objects_per_plot * site.variation.objects)
    if count:
        start = gates[0][1] + 0.5 if gates else rng.uniform(walls[0], walls[1])
        label = "trashbin" if rng.random() < 0.55 else "box"
        t = max(0.4, front * rng.uniform(0.15, 0.8))
        yaw = np.pi / 2 * (rng.random(count) < 0.7) + rng.normal(0, 0.15, count)
        site.sheet.boxes(frame, label, start + 1.2 * np.arange(count), t, draw_sizes(rng, label, count), yaw)
    count = rng.poisson(site.district.bicycles_per_plot * site.variation.bicycles)
    if count:
        label = "bicycle" if rng.random() < 0.8 else "motorcycle"
        s = rng.uniform(walls[0], walls[1]) + 0.9 * np.arange(count)
        yaw = np.pi / 2 + rng.normal(0, 0.1, count)
        site.sheet.boxes(frame, label, s, max(0.2, front - 1.2), draw_sizes(rng, "bicycle", count), yaw)


def build_green(site: Site, frame: LocalFrame, width: float, depth: float, lush: float = 1.15) -> None:
    """Build ground without a house: a lawn with a hedge or a wall along the sidewalk, and plants."""
    rng = site.rng
    if width < 0.5 or depth < 0.5:
        return
    if rng.random() < site.district.lawn:
        paint_plot(site, frame, width, depth, TERRAIN, [])
    if rng.random() < 0.7 * site.district.hedges + 0.1:
        add_hedge(site, frame, 0.2, 0.6, width - 0.2, 0.6, float(rng.uniform(0.6, 1.0)))
    elif rng.random() < site.district.walls:
        add_wall(site, frame, 0.2, 0.45, width - 0.2, 0.45, float(rng.uniform(0.5, 1.0)))
    plant_garden(site, frame, width, depth, [], lush)


def paint_plot(
    site: Site,
    frame: LocalFrame,
    width: float,
    depth: float,
    base: int,
    rects: list[tuple[int, Rect]],
    split: float = 0.0,
) -> None:
    """Paint the slabs of a plot: class `base` up to `depth`, and the rectangles (class, rectangle) on top.

    Every rectangle must reach the front of the plot or the line t = split, so that no patch has a hole.
    """
    for low, high in ((0.0, min(split, depth)), (min(split, depth), depth)):
        if high - low < 0.3:
            continue
        paint_strip(site.sheet, frame, (0.0, width, low, high), base, rects, MIN_PIECE_M, _list_lines)


def _list_lines(values: list[float]) -> list[float]:
    """Return sorted grid lines with a spacing of at least MIN_PIECE_M; the smallest and the largest value are kept.

    A thinner piece of ground could cross itself when the board is bent.
    """
    ordered = sorted(values)
    out = [float(ordered[0])]
    for value in ordered:
        if value - out[-1] > MIN_PIECE_M and ordered[-1] - value > MIN_PIECE_M:
            out.append(float(value))
    return [*out, float(ordered[-1])]
