"""Build a row of houses along a street: plots with driveways, paths, gardens, borders and small objects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pipelines.preprocess.sources.town.assets import Rect, Site, draw_sizes, place_cars, plant_border, plant_garden
from pipelines.preprocess.sources.town.land import LocalFrame, Sheet, trace_outlines

NOTHING, TERRAIN, GROUND, PARKING = -1, 0, 1, 2
CELL_CLASS = ("terrain", "ground", "parking")
SQUEEZE = 0.4  # Maximum share of the last plot beyond the end of the row. All plots then shrink to fit the row.


@dataclass(frozen=True)
class House:
    """Plan of a house: extents along the street and away from the street, height, and driveway width."""

    front_m: float
    back_m: float
    height_m: float
    garage: bool = False
    drive_m: float = 0.0


def build_house_row(site: Site, frame: LocalFrame, length: float, depth: float) -> None:
    """Build houses side by side along a street, one per plot. Plot widths are scaled to fill the row."""
    planned, used = [], 0.0
    scale = np.array(site.district.house_scale) * [site.mood.room, site.mood.room**0.5, 1.0]
    while True:
        size = draw_sizes(site.rng, "building", 1, scale)[0]
        front, back = (size[0], size[1]) if site.rng.random() < 0.55 else (size[1], size[0])
        garage = bool(site.rng.random() < site.district.garages * site.mood.garages)
        gaps = float((site.rng.uniform(*site.district.gap_m, 2) * site.mood.room**2).sum())
        drive = float(site.rng.uniform(3.5, 6.6)) if garage else 0.0
        need = front + drive + gaps
        if used + (1 - SQUEEZE) * need > length:
            break
        planned.append((need, House(front, back, size[2], garage, drive)))
        used += need
    squeeze = min(1.0, length / used) if used else 1.0
    extra = max(0.0, length - used) / max(1, len(planned))
    s = 0.0
    for need, house in planned:
        house = replace(house, front_m=house.front_m * squeeze, drive_m=house.drive_m * squeeze)
        width = need * squeeze + extra
        build_plot(site, frame.at(s, 0.0), width, depth, house)
        s += width
    if not planned and length > 6:
        paint_plots(site, frame, length, depth, TERRAIN, TERRAIN, depth, [])
        plant_garden(site, frame, length, depth, [])


def build_plot(site: Site, frame: LocalFrame, width: float, depth: float, house: House) -> None:
    """Build one plot: house, garage, driveway, path, terrace, garden, borders and small objects.

    Some plots have no house, only a garden.
    """
    if site.rng.random() < site.mood.vacant:
        lawn = TERRAIN if site.rng.random() < site.district.terrain_front else NOTHING
        paint_plots(site, frame, width, depth, lawn, lawn, depth, [])
        plant_garden(site, frame, width, depth, [])
        _plant_borders(site, frame, width, depth, 4.0, (0.0, 0.0), False)
        return
    setback = site.district.setback_m * np.exp(0.75 * site.rng.standard_normal())
    setback = float(np.clip(setback, 0.2, max(0.3, depth - house.back_m - 2)))
    drive_left = bool(site.rng.random() < 0.5)
    spare = max(0.0, width - house.front_m - house.drive_m)
    s0 = (house.drive_m if drive_left else 0.0) + spare * site.rng.uniform(0.25, 0.75)
    walls = (s0, s0 + house.front_m, setback, setback + house.back_m)
    _build_house(site, frame, walls, house)
    painted = [(NOTHING, walls)]
    if house.garage:
        room = house.drive_m + spare / 2
        painted += _build_garage(site, frame, width, depth, walls, room, drive_left)
    gate = painted[1][1][:2] if len(painted) > 1 else (0.0, 0.0)
    court = bool(site.rng.random() < site.district.court_front)
    if not court and setback > 1.0:
        door = float(site.rng.uniform(walls[0] + 1.5, walls[1] - 1.5))
        painted.append((GROUND, (door - 0.8, door + 0.8, 0.0, setback)))
    taken = [rect for _, rect in painted]
    if site.rng.random() < site.district.terrace and depth - walls[3] > 3:
        deep = min(float(site.rng.uniform(3.0, 6.0)), depth - walls[3] - 0.5)
        left = float(site.rng.uniform(s0, s0 + house.front_m / 2))
        terrace = (left, left + house.front_m / 2, walls[3], walls[3] + deep)
        if not any(_compute_overlap(terrace, rect) for rect in taken[1:]):
            painted.append((GROUND, terrace))
    front = (PARKING if site.rng.random() < 0.4 else GROUND) if court else TERRAIN
    if not court and site.rng.random() > site.district.terrain_front:
        front = NOTHING
    back = TERRAIN if site.rng.random() < site.district.terrain_back else NOTHING
    paint_plots(site, frame, width, depth, front, back, setback, painted)
    if front == PARKING and setback > 5:
        at = np.arange(walls[0] + 1.5, walls[1] - 1.2, 2.7)
        place_cars(site, frame, at[site.rng.random(len(at)) < 0.5 * site.mood.cars], setback - 2.9, np.pi / 2)
        taken.append((walls[0], walls[1], 0.0, setback))

    plant_garden(site, frame, width, depth, taken)
    _plant_borders(site, frame, width, depth, setback, gate, court)
    _place_belongings(site, frame, walls, gate)


def _build_house(site: Site, frame: LocalFrame, walls: Rect, house: House) -> None:
    size = np.array([*sorted((house.front_m, house.back_m), reverse=True), house.height_m])
    yaw = (0.0 if house.front_m >= house.back_m else np.pi / 2) + site.rng.normal(0, 0.015)
    site.sheet.boxes(frame, "building", (walls[0] + walls[1]) / 2, (walls[2] + walls[3]) / 2, size, yaw, -0.2)


def _build_garage(
    site: Site, frame: LocalFrame, width: float, depth: float, walls: Rect, room: float, left: bool
) -> list[tuple[int, Rect]]:
    """Build a garage and a driveway with an optional car.

    The garage is behind the house if there is no room next to the house. The function returns the rectangles to paint,
    with the driveway first. The list is empty if the plot is too shallow.
    """
    size = draw_sizes(site.rng, "garage", 1)[0]
    beside = max(2.8, min(room, size[1]))
    fits = size[1] <= beside
    front = walls[2] + site.rng.uniform(0, 4) + 1.0 if fits else walls[3] + site.rng.uniform(0.3, 2.5)
    front = float(min(max(front, 4.5), depth - size[0] - 0.2))
    if front < (2.0 if fits else walls[3]):
        return []
    a, b = (0.15, 0.15 + size[1]) if left else (width - 0.15 - size[1], width - 0.15)
    d0, d1 = (0.15, 0.15 + beside) if left else (width - 0.15 - beside, width - 0.15)
    site.sheet.boxes(frame, "garage", (a + b) / 2, front + size[0] / 2, size, np.pi / 2, -0.1)
    if site.rng.random() < site.district.driveway_cars * site.mood.cars and front > 5.2:
        place_cars(site, frame, np.array([(d0 + d1) / 2]), float(site.rng.uniform(2.7, front - 2.5)), np.pi / 2)
    drive = GROUND if site.rng.random() < site.district.rough_drives else PARKING
    return [(drive, (d0, d1, 0.0, front)), (NOTHING, (a, b, front, front + size[0]))]


def _compute_overlap(a: Rect, b: Rect) -> bool:
    return a[0] < b[1] and b[0] < a[1] and a[2] < b[3] and b[2] < a[3]


def _plant_borders(
    site: Site, frame: LocalFrame, width: float, depth: float, setback: float, gate: tuple[float, float], court: bool
) -> None:
    """Build hedges and walls around a plot.

    There are gaps at the gate (s0, s1) and at a court. Steps and low walls are added.
    """
    g0, g1 = gate
    lines: list[tuple[float, float, float, float]] = []
    if not court and setback > 1.2:
        gate_right = g1 > g0 > width / 2
        lines.append(
            (g1 + 0.2 if g1 > g0 and not gate_right else 0.3, 0.45, g0 - 0.2 if gate_right else width - 0.3, 0.45)
        )
    lines.append((0.1, 0.8, 0.1, depth - 0.8))
    lines.append((width - 0.1, setback, width - 0.1, depth - 0.8))
    if site.rng.random() < 0.6:
        lines.append((0.6, depth - 0.5, width - 0.6, depth - 0.5))
    hedges, walls = site.district.hedges * site.mood.green**0.5, site.district.walls * site.mood.walls
    total = max(1.0, hedges + walls)
    for line in lines:
        pick = site.rng.random() * total
        if pick < hedges:
            plant_border(site, frame, *line, "hedge", float(site.rng.uniform(0.5, 1.0)))
        elif pick < hedges + walls:
            plant_border(site, frame, *line, "wall", float(site.rng.uniform(0.5, 1.0)))
    n = site.rng.poisson(site.district.walls * site.mood.walls)  # Steps, retaining walls and porches.
    if n:
        s, t = site.rng.uniform(0.5, width - 0.5, n), site.rng.uniform(0.4, max(0.8, setback + 2), n)
        site.sheet.boxes(frame, "wall", s, t, draw_sizes(site.rng, "wall", n), np.pi / 2 * site.rng.integers(0, 2, n))


def _place_belongings(site: Site, frame: LocalFrame, walls: Rect, gate: tuple[float, float]) -> None:
    """Place bins, boxes and bicycles in front of the house and next to the driveway."""
    s0, s1, t0, _ = walls
    n = site.rng.poisson(site.district.objects_per_plot * site.mood.objects)
    if n:
        row = (gate[1] if site.rng.random() < 0.5 and gate[1] else site.rng.uniform(s0, s1)) + 1.2 * np.arange(n)
        label = "trashbin" if site.rng.random() < 0.5 else "box"
        aside = max(0.4, t0 * site.rng.uniform(0.1, 0.9))
        site.sheet.boxes(frame, label, row, aside, draw_sizes(site.rng, label, n), site.rng.normal(0, 0.1, n))
    n = site.rng.poisson(site.district.bicycles_per_plot * site.mood.bicycles)
    if n:
        label = "bicycle" if site.rng.random() < 0.8 else "motorcycle"
        row, yaw = site.rng.uniform(s0, s1) + 0.9 * np.arange(n), np.pi / 2 + site.rng.normal(0, 0.1, n)
        site.sheet.boxes(frame, label, row, max(0.2, t0 - 1.2), draw_sizes(site.rng, "bicycle", n), yaw)


def paint_plots(
    site: Site,
    frame: LocalFrame,
    width: float,
    depth: float,
    front: int,
    back: int,
    split: float,
    rects: list[tuple[int, Rect]],
) -> None:
    """Paint the slabs of a plot: class `front` for t < split, class `back` for t > split, and `rects` on top.

    Each entry of `rects` is (class, (s0, s1, t0, t1)).
    """
    for low, high, base in ((0.0, split, front), (split, depth, back)):
        if high - low < 0.3:
            continue
        paint_strip(site.sheet, frame, (0.0, width, low, high), base, rects, 0.05, _list_lines)


def paint_strip(
    sheet: Sheet,
    frame: LocalFrame,
    area: Rect,
    base: int,
    rects: list[tuple[int, Rect]],
    least: float,
    list_lines: Callable[[list[float]], list[float]],
) -> None:
    """Paint the slabs of a rectangle: class `base`, and the parts of `rects` inside the rectangle on top.

    Args:
        sheet: Sheet to which slabs are added.
        frame: Frame of the rectangle.
        area: Rectangle (s0, s1, t0, t1) in metres.
        base: Index into CELL_CLASS, or NOTHING.
        rects: (class, rectangle) of each part.
        least: Smaller extents (m) of a part are left out.
        list_lines: Function that sorts grid lines and merges close ones.
    """
    here = []
    for value, (a, b, c, d) in rects:
        a, b, c, d = max(a, area[0]), min(b, area[1]), max(c, area[2]), min(d, area[3])
        if b - a > least and d - c > least:
            here.append((value, a, b, c, d))
    s = list_lines([*area[:2]] + [x for r in here for x in r[1:3]])
    t = list_lines([*area[2:]] + [x for r in here for x in r[3:5]])
    cells = np.full((len(s) - 1, len(t) - 1), base)
    ms, mt = (np.array(s)[:-1] + np.array(s)[1:]) / 2, (np.array(t)[:-1] + np.array(t)[1:]) / 2
    for value, a, b, c, d in here:
        cells[np.ix_((ms > a) & (ms < b), (mt > c) & (mt < d))] = value
    for value, outline in trace_outlines(cells, s, t):
        sheet.slab(frame, CELL_CLASS[value], outline)


def _list_lines(values: list[float]) -> list[float]:
    """Return sorted distinct grid lines with a spacing of at least 1 cm."""
    out: list[float] = []
    for value in sorted(values):
        if not out or value - out[-1] > 0.01:
            out.append(float(value))
    return out
