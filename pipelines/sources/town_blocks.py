"""What stands in a block: sidewalks and street furniture on its sides, plots with houses and gardens, parks, courts.

Everything is drawn in frames (s along the street, t away from it), see town_land. Lengths in metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.sources.town_land import Frame, Sheet, outlines_of
from pipelines.sources.town_streets import Block

NOTHING, TERRAIN, GROUND, PARKING = -1, 0, 1, 2
CELL_CLASS = ("terrain", "ground", "parking")
CAR_SLOT_M = 6.2
BAY_DEPTH_M = 2.3
SQUEEZE = 0.4  # share of the last plot of a row that its neighbours make room for

# label: median (l, w, h), spread of the common factor, spread of each extent, smallest and largest (l, w, h)
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
class District:
    """How one kind of neighbourhood looks. Shares are probabilities; `per_100m2` and `per_100m` are intensities."""

    house_scale: tuple[float, float, float]
    setback_m: float  # median from sidewalk to house
    gap_m: tuple[float, float]  # free ground between houses beside driveways
    garages: float
    terrain_front: float
    terrain_back: float
    court_front: float  # share of front yards that are paved
    rough_drives: float  # share of driveways that are ground rather than parking
    terrace: float
    sidewalks: float
    bays: float
    curb_parking: float  # mean share of curb slots taken
    driveway_cars: float
    parks: float
    courts: float  # share of blocks with a big building and its car park
    hedges: float  # share of plot borders that are hedges
    walls: float  # share that are walls or fences
    shrubs_per_100m2: float
    bushes_per_100m2: float
    trees_per_100m2: float
    street_trees_per_100m: float
    tree_scale: float
    lamps_per_100m: float
    signs_per_100m: float
    lights: float  # share of street corners with a traffic light
    things_per_plot: float  # bins and boxes
    bicycles_per_plot: float
    people_per_100m: float
    trucks_per_100m: float


@dataclass(frozen=True)
class Mood:
    """What makes one block differ from the next of its district: factors of mean 1."""

    room: float  # of plots: houses and the gaps between them
    vacant: float  # share of plots without a house
    garages: float
    green: float
    trees: float
    tree_size: float
    walls: float
    cars: float
    furniture: float
    things: float
    bicycles: float
    people: float


def random_mood(rng: np.random.Generator) -> Mood:
    def gamma(shape: float) -> float:
        return float(rng.gamma(shape) / shape)

    size, room = np.exp(rng.normal(0, [0.13, 0.16])).tolist()
    if rng.random() < 0.22:  # a terrace of narrow houses
        room = 0.5
    vacant = 0.5 if rng.random() < 0.1 else 0.02
    return Mood(room, vacant, gamma(1.2), gamma(9), gamma(9), size, gamma(6), gamma(3), gamma(5), gamma(3), gamma(1), gamma(1.2))


def sizes(rng: np.random.Generator, what: str, n: int, scale: float | tuple[float, float, float] = 1.0) -> np.ndarray:
    """(n, 3) extents drawn for a kind of thing; l >= w unless it is a building."""
    median, common, each, low, high = SIZES[what]
    factor = np.exp(common * rng.standard_normal((n, 1)) + each * rng.standard_normal((n, 3)))
    drawn = (np.array(median) * scale * factor).clip(low, high)
    drawn[:, :2] = -np.sort(-drawn[:, :2], axis=1)
    return drawn


def furnish(sheet: Sheet, rng: np.random.Generator, block: Block, district: District, mood: Mood) -> None:
    """Fills a block: its sides first, then what is left inside."""
    depths = [_side_depth(rng, district) if faces else (0.0, False, False) for faces in block.streets]
    for k in range(4):
        if block.streets[k]:
            _side(sheet, rng, block, k, depths, district, mood)
    if not any(block.streets):
        _meadow(sheet, rng, block, district, mood)
        return
    use = rng.random()
    width, height = block.u1 - block.u0, block.v1 - block.v0
    whole = all(block.streets)
    if whole and use < district.parks:
        _park(sheet, rng, _interior(block, depths), district, mood)
    elif whole and use < district.parks + district.courts and min(width, height) > 45:
        fill = _garage_court if rng.random() < 0.6 else _court
        fill(sheet, rng, _interior(block, depths), district, mood)
    else:
        rows = (0, 2) if width >= height else (1, 3)
        for k in rows if whole else [block.streets.index(True)]:
            frame, length, _, _ = block.side(k)
            before, own, after = depths[k - 1][0], depths[k][0], depths[(k + 1) % 4][0]
            across = height if k % 2 == 0 else width
            depth = (across - own - depths[(k + 2) % 4][0]) / 2 if whole else across - own
            _row(sheet, rng, frame.at(before, own), length - before - after, depth, district, mood)


def _interior(block: Block, depths: list) -> tuple[Frame, float, float]:
    """What the sides leave of a block: a frame along its longer side, width, depth."""
    south, east, north, west = (d[0] for d in depths)
    width, depth = block.u1 - block.u0 - west - east, block.v1 - block.v0 - south - north
    if width >= depth:
        return Frame((block.u0 + west, block.v0 + south), (1.0, 0.0), (0.0, 1.0)), width, depth
    return Frame((block.u1 - east, block.v0 + south), (0.0, 1.0), (-1.0, 0.0)), depth, width


# ---------------------------------------------------------------- sides of a block


def _side_depth(rng: np.random.Generator, district: District) -> tuple[float, bool, bool]:
    """(depth, has a sidewalk, has parking bays) of one side."""
    sidewalk, bay = bool(rng.random() < district.sidewalks), bool(rng.random() < district.bays)
    return float(rng.uniform(2.25, 3.0)) + BAY_DEPTH_M * bay, sidewalk, bay


def _side(sheet, rng, block: Block, k: int, depths: list, district: District, mood: Mood) -> None:
    frame, length, r0, r1 = block.side(k)
    depth, sidewalk, bay = depths[k]
    before, after = depths[k - 1], depths[(k + 1) % 4]
    paved = "sidewalk" if sidewalk else "terrain"
    start, end = 0.0, length
    if r0:
        corner_class = "sidewalk" if sidewalk or before[1] else "terrain"
        start = max(r0, depth, before[0]) + 0.5
        _corner(sheet, frame, r0, start, depth, before[0], corner_class)
    if r1:
        end = length - max(r1, depth, after[0]) - 0.5
    if bay:
        _bays(sheet, rng, frame, start, end, paved, district, mood)
    _strip(sheet, frame, paved, start, end, BAY_DEPTH_M * bay, depth, 9.0 if sidewalk else 18.0)
    if not bay:
        _curb_cars(sheet, rng, frame, start + 3, end - 3, district, mood)
    _furniture(sheet, rng, frame, start, end, depth, bool(r0), district, mood)


def _corner(sheet, frame: Frame, r: float, size: float, depth: float, depth_before: float, ground_class: str) -> None:
    """The piece of sidewalk round a kerb of radius r; `size` along both streets."""
    angle = np.linspace(1.5 * np.pi, np.pi, 5)
    kerb = list(zip((r + r * np.cos(angle)).tolist(), (r + r * np.sin(angle)).tolist(), strict=True))
    inside = [(0.0, size), (depth_before, size), (depth_before, depth), (size, depth), (size, 0.0)]
    sheet.slab(frame, ground_class, inside + kerb)


def _strip(sheet, frame: Frame, ground_class: str, start: float, end: float, t0: float, t1: float, piece: float) -> None:
    cuts = np.linspace(start, end, max(1, round((end - start) / piece)) + 1).tolist()
    for a, b in zip(cuts[:-1], cuts[1:], strict=True):
        sheet.slab(frame, ground_class, [(a, t0), (b, t0), (b, t1), (a, t1)])


def _bays(sheet, rng, frame: Frame, start: float, end: float, paved: str, district: District, mood: Mood) -> None:
    """Parking bays along the road, with a tree between every few."""
    s = start
    taken = min(0.9, 1.5 * district.curb_parking * mood.cars)
    while s < end:
        run = min(end - s, CAR_SLOT_M * int(rng.integers(2, 5)))
        if end - s - run < 5:
            run = end - s
        slots = int(run / 5.6)
        if slots:
            sheet.slab(frame, "parking", [(s, 0), (s + run, 0), (s + run, BAY_DEPTH_M), (s, BAY_DEPTH_M)])
            at = s + (np.arange(slots) + 0.5) * run / slots
            _cars(sheet, rng, frame, at[rng.random(slots) < taken], 1.1)
            s += run
        gap = min(end - s, float(rng.uniform(2.0, 3.0)))
        if gap > 0:
            sheet.slab(frame, paved, [(s, 0), (s + gap, 0), (s + gap, BAY_DEPTH_M), (s, BAY_DEPTH_M)])
            if rng.random() < 0.12 * district.street_trees_per_100m:
                _trees(sheet, rng, frame, np.array([s + gap / 2]), np.array([1.1]), district, mood, "tree")
        s += gap


def _cars(sheet, rng, frame: Frame, s: np.ndarray, t: float, yaw: float = np.pi) -> None:
    """Cars parked at s; most look the way the traffic beside them goes."""
    n = len(s)
    turned = yaw + np.pi * (rng.random(n) < 0.12) + rng.normal(0, 0.03, n)
    sheet.boxes(frame, "car", s + rng.normal(0, 0.25, n), t + rng.normal(0, 0.12, n), sizes(rng, "car", n), turned)


def _curb_cars(sheet, rng, frame: Frame, start: float, end: float, district: District, mood: Mood) -> None:
    slots = int(max(0.0, end - start) / CAR_SLOT_M)
    if not slots:
        return
    at = start + (np.arange(slots) + 0.5) * (end - start) / slots
    taken = rng.random(slots) < min(0.85, district.curb_parking * mood.cars)
    _cars(sheet, rng, frame, at[taken], -0.9 if rng.random() < 0.3 else 0.1)  # half on the sidewalk as a rule
    free = at[~taken]
    trucks = free[rng.random(len(free)) < district.trucks_per_100m * CAR_SLOT_M / 100]
    if len(trucks):
        label = str(rng.choice(["truck", "truck", "bus"]))
        sheet.boxes(frame, label, trucks[:1], -1.3, sizes(rng, "truck", 1, 1.0 + 0.15 * (label == "bus")), np.pi)


def _furniture(sheet, rng, frame, start, end, depth, corner: bool, district: District, mood: Mood) -> None:
    """Lamps, signs, traffic lights, street trees, people on one side."""
    length = max(0.0, end - start)
    n = rng.poisson(district.lamps_per_100m * mood.furniture * length / 100)
    if n:
        s = start + (np.arange(n) + rng.uniform(0.25, 0.75)) * length / n
        pole = sizes(rng, "bigPole", n)
        sheet.boxes(frame, "bigPole", s, depth - 0.4, pole, rng.normal(0, 0.2, n))
        lit = rng.random(n) < 0.9
        head = sizes(rng, "lamp", n)[lit]
        bottom = (pole[lit, 2] - 0.2).clip(2, 6)
        sheet.boxes(frame, "lamp", s[lit], np.full(lit.sum(), depth - 0.8), head, np.pi / 2, bottom)
    n = rng.poisson(district.signs_per_100m * mood.furniture * length / 100)
    if n:
        s = np.where(rng.random(n) < 0.5, start + rng.uniform(0, 4, n), rng.uniform(start, max(end, start + 4), n))
        _sign(sheet, rng, frame, s, np.full(n, 0.5))
    if corner and rng.random() < district.lights:
        sheet.boxes(frame, "smallPole", start, 0.5, sizes(rng, "bigPole", 1, 0.75))
        low_high = np.array([2.2, 2.9])
        sheet.boxes(frame, "trafficLight", [start] * 2, [0.5] * 2, sizes(rng, "trafficLight", 2), np.pi / 2, low_high)
    n = rng.poisson(district.street_trees_per_100m * mood.trees * length / 100)
    if n:
        s = start + (np.arange(n) + rng.uniform(0.2, 0.8, n)) * length / n
        _trees(sheet, rng, frame, s, np.full(n, depth - 0.6), district, mood, "tree")
    groups = rng.poisson(district.people_per_100m * mood.people * length / 100 / 1.6)
    for _ in range(groups):
        n = 1 + rng.poisson(0.6)
        s, t = rng.uniform(start, end) + rng.normal(0, 0.6, n), rng.uniform(0.6, depth - 0.3, n)
        sheet.boxes(frame, "pedestrian", s, t, sizes(rng, "pedestrian", n), rng.uniform(-np.pi, np.pi, n))


def _sign(sheet, rng, frame, s: np.ndarray, t: np.ndarray) -> None:
    n = len(s)
    pole = sizes(rng, "smallPole", n)
    pole[:, 2] = pole[:, 2].clip(2.0, None)
    sheet.boxes(frame, "smallPole", s, t, pole)
    sheet.boxes(frame, "trafficSign", s, t, sizes(rng, "trafficSign", n), np.pi / 2, pole[:, 2])


# ---------------------------------------------------------------- vegetation


def _trees(sheet, rng, frame, s, t, district: District, mood: Mood, what: str) -> None:
    """Ellipsoids at (s, t): crowns of trees start above the ground, bushes on it."""
    n = len(s)
    scale = district.tree_scale * mood.tree_size if what == "tree" else 1.0
    size = sizes(rng, what, n, scale)
    bottom = rng.uniform(0.05, 0.3, n) * size[:, 2] if what == "tree" else 0.0
    sheet.boxes(frame, "vegetation", s, t, size, rng.uniform(-np.pi, np.pi, n), bottom, ellipsoid=True)


def _border(sheet, rng, frame, s0: float, t0: float, s1: float, t1: float, kind: str, cover: float) -> None:
    """A hedge or wall from (s0, t0) to (s1, t1), in pieces; `cover` is the share of its length that stands."""
    length = float(np.hypot(s1 - s0, t1 - t0))
    if length < 1.5:
        return
    mean = 6.2 if kind == "hedge" else 4.4
    size = sizes(rng, kind, int(length * cover / mean + rng.random()))
    n = len(size)
    if not n:
        return
    yaw, at = np.arctan2(t1 - t0, s1 - s0), 0.0
    free = max(0.0, length - size[:, 0].sum())
    gaps = free * rng.dirichlet(np.ones(n + 1))[:n]
    if size[:, 0].sum() > length:
        size[:, 0] *= length / size[:, 0].sum()
    middle = np.cumsum(size[:, 0] + gaps) - size[:, 0] / 2 + at
    s, t = s0 + np.cos(yaw) * middle, t0 + np.sin(yaw) * middle
    if kind == "hedge":
        sheet.boxes(frame, "vegetation", s, t, size, yaw + rng.normal(0, 0.03, n))
        return
    # A wall keeps its thickness and height along its run.
    size[:, 1:] = size[0, 1:] * np.exp(0.08 * rng.standard_normal((n, 2)))
    label = np.array(["wall", "fence", "wall", "gate", "guardrail"])[rng.choice(5, p=[0.5, 0.3, 0.08, 0.1, 0.02])]
    sheet.boxes(frame, str(label), s, t, size, yaw)


def _garden(sheet, rng, frame, width, depth, taken: list, district: District, mood: Mood, lush: float = 1.0) -> None:
    """Shrubs, bushes and trees in a rectangle, outside the `taken` rectangles (s0, s1, t0, t1)."""
    free = width * depth - sum((b - a) * (d - c) for a, b, c, d in taken)
    wanted = (
        ("shrub", district.shrubs_per_100m2 * mood.green),
        ("bush", district.bushes_per_100m2 * mood.green),
        ("tree", district.trees_per_100m2 * mood.trees),
    )
    for what, intensity in wanted:
        n = rng.poisson(max(0.0, free) * intensity * lush / 100)
        s, t = rng.uniform(0.3, width - 0.3, 2 * n + 4), rng.uniform(0.3, depth - 0.3, 2 * n + 4)
        clear = np.ones(len(s), bool)
        for a, b, c, d in taken:
            clear &= (s < a - 0.4) | (s > b + 0.4) | (t < c - 0.4) | (t > d + 0.4)
        s, t = s[clear][:n], t[clear][:n]
        if what == "shrub":
            size = sizes(rng, "shrub", len(s))
            turned = np.minimum(s, width - s) < np.minimum(t, depth - t)  # along the nearest border
            yaw = np.pi / 2 * turned + rng.normal(0, 0.05, len(s))
            edge = rng.random(len(s)) < 0.55
            s = np.where(edge & turned, np.where(s < width / 2, size[:, 1] / 2, width - size[:, 1] / 2), s)
            t = np.where(edge & ~turned, np.where(t < depth / 2, 0.5 + size[:, 1] / 2, depth - size[:, 1] / 2), t)
            clear = np.ones(len(s), bool)
            for a, b, c, d in taken:
                clear &= (s <= a) | (s >= b) | (t <= c) | (t >= d)
            sheet.boxes(frame, "vegetation", s[clear], t[clear], size[clear], yaw[clear])
        else:
            _trees(sheet, rng, frame, s, t, district, mood, what)


# ---------------------------------------------------------------- plots


def _row(sheet, rng, frame: Frame, length: float, depth: float, district: District, mood: Mood) -> None:
    """Houses side by side along a street, each on its plot; plots give or take a little so that the row is full."""
    plots, used = [], 0.0
    while True:
        size = sizes(rng, "building", 1, np.array(district.house_scale) * [mood.room, mood.room**0.5, 1.0])[0]
        front, back = (size[0], size[1]) if rng.random() < 0.55 else (size[1], size[0])
        garage = bool(rng.random() < district.garages * mood.garages)
        gaps = float((rng.uniform(*district.gap_m, 2) * mood.room**2).sum())
        drive = float(rng.uniform(3.5, 6.6)) if garage else 0.0
        need = front + drive + gaps
        if used + (1 - SQUEEZE) * need > length:
            break
        plots.append((front, back, size[2], garage, drive, gaps))
        used += need
    squeeze = min(1.0, length / used) if used else 1.0
    extra = max(0.0, length - used) / max(1, len(plots))
    s = 0.0
    for front, back, height, garage, drive, gaps in plots:
        width = (front + drive + gaps) * squeeze + extra
        house = (front * squeeze, back, height, garage, drive * squeeze)
        _plot(sheet, rng, frame.at(s, 0.0), width, depth, house, district, mood)
        s += width
    if not plots and length > 6:
        _paint(sheet, frame, length, depth, TERRAIN, TERRAIN, depth, [])
        _garden(sheet, rng, frame, length, depth, [], district, mood)


def _plot(sheet, rng, frame: Frame, width: float, depth: float, house: tuple, district: District, mood: Mood) -> None:
    """One plot: house, garage and driveway, path, terrace, garden, borders, bins, bicycles; or an orchard."""
    if rng.random() < mood.vacant:
        lawn = TERRAIN if rng.random() < district.terrain_front else NOTHING
        _paint(sheet, frame, width, depth, lawn, lawn, depth, [])
        _garden(sheet, rng, frame, width, depth, [], district, mood)
        _borders(sheet, rng, frame, width, depth, 4.0, (0.0, 0.0), False, district, mood)
        return
    front, back, height, garage, drive, *_ = house
    setback = float(np.clip(district.setback_m * np.exp(0.75 * rng.standard_normal()), 0.2, max(0.3, depth - back - 2)))
    drive_left = rng.random() < 0.5
    spare = max(0.0, width - front - drive)
    s0 = (drive if drive_left else 0.0) + spare * rng.uniform(0.25, 0.75)
    house_rect = (s0, s0 + front, setback, setback + back)
    long_first = front >= back
    size = np.array([max(front, back), min(front, back), height])
    yaw = (0.0 if long_first else np.pi / 2) + rng.normal(0, 0.015)
    middle = ((house_rect[0] + house_rect[1]) / 2, (house_rect[2] + house_rect[3]) / 2)
    sheet.boxes(frame, "building", *middle, size, yaw, -0.2)

    taken = [house_rect]
    painted = [(NOTHING, house_rect)]
    gate = (0.0, 0.0)
    if garage:
        g = sizes(rng, "garage", 1)[0]
        beside = max(2.8, min(drive + spare / 2, g[1]))
        g_front = setback + (back * rng.uniform(0.3, 0.9) if g[1] > beside else rng.uniform(0, 4)) + 1.0
        g_front = min(max(g_front, 4.5), depth - g[0] - 0.3)
        a, b = (0.15, 0.15 + g[1]) if drive_left else (width - 0.15 - g[1], width - 0.15)
        if g[1] > beside:  # no room beside the house: behind it
            g_front = min(house_rect[3] + rng.uniform(0.3, 2.5), depth - g[0] - 0.2)
        if g_front >= (house_rect[3] if g[1] > beside else 2.0):
            sheet.boxes(frame, "garage", (a + b) / 2, g_front + g[0] / 2, g, np.pi / 2, -0.1)
            garage_rect = (a, b, g_front, g_front + g[0])
            d0, d1 = (0.15, 0.15 + beside) if drive_left else (width - 0.15 - beside, width - 0.15)
            drive_rect = (d0, d1, 0.0, g_front)
            taken += [garage_rect, drive_rect]
            rough = rng.random() < district.rough_drives
            painted += [(GROUND if rough else PARKING, drive_rect), (NOTHING, garage_rect)]
            gate = (d0, d1)
            if rng.random() < district.driveway_cars * mood.cars and g_front > 5.2:
                _cars(sheet, rng, frame, np.array([(d0 + d1) / 2]), float(rng.uniform(2.7, g_front - 2.5)), np.pi / 2)
    court = rng.random() < district.court_front
    if not court and setback > 1.0:
        door = float(rng.uniform(s0 + 1.5, s0 + front - 1.5))
        path = (door - 0.8, door + 0.8, 0.0, setback)
        painted.append((GROUND, path))
        taken.append(path)
    if rng.random() < district.terrace and depth - house_rect[3] > 3:
        deep = min(float(rng.uniform(3.0, 6.0)), depth - house_rect[3] - 0.5)
        a = float(rng.uniform(s0, s0 + front / 2))
        patio = (a, a + front / 2, house_rect[3], house_rect[3] + deep)
        if all(patio[1] <= r[0] or patio[0] >= r[1] or patio[3] <= r[2] or patio[2] >= r[3] for r in taken[1:]):
            painted.append((GROUND, patio))
    front_class = (PARKING if rng.random() < 0.4 else GROUND) if court else TERRAIN
    if not court and rng.random() > district.terrain_front:
        front_class = NOTHING
    back_class = TERRAIN if rng.random() < district.terrain_back else NOTHING
    _paint(sheet, frame, width, depth, front_class, back_class, setback, painted)
    if court and front_class == PARKING and setback > 5:
        at = np.arange(s0 + 1.5, s0 + front - 1.2, 2.7)
        keep = at[rng.random(len(at)) < 0.5 * mood.cars]
        _cars(sheet, rng, frame, keep, setback - 2.9, np.pi / 2)
        taken.append((s0, s0 + front, 0.0, setback))

    _garden(sheet, rng, frame, width, depth, taken, district, mood)
    _borders(sheet, rng, frame, width, depth, setback, gate, court, district, mood)
    _belongings(sheet, rng, frame, house_rect, gate, district, mood)


def _borders(sheet, rng, frame, width, depth, setback, gate, court: bool, district: District, mood: Mood) -> None:
    g0, g1 = gate
    lines = []
    if not court and setback > 1.2:
        front = [(0.3, 0.45, width - 0.3, 0.45)]
        if g1 > g0:
            front = [(0.3, 0.45, g0 - 0.2, 0.45)] if g0 > width / 2 else [(g1 + 0.2, 0.45, width - 0.3, 0.45)]
        lines += front
    lines.append((0.1, 0.8, 0.1, depth - 0.8))
    lines.append((width - 0.1, setback, width - 0.1, depth - 0.8))
    if rng.random() < 0.6:
        lines.append((0.6, depth - 0.5, width - 0.6, depth - 0.5))
    hedges, walls = district.hedges * mood.green**0.5, district.walls * mood.walls
    total = max(1.0, hedges + walls)
    for line in lines:
        pick = rng.random() * total
        if pick < hedges:
            _border(sheet, rng, frame, *line, "hedge", float(rng.uniform(0.5, 1.0)))
        elif pick < hedges + walls:
            _border(sheet, rng, frame, *line, "wall", float(rng.uniform(0.5, 1.0)))
    n = rng.poisson(district.walls * mood.walls * 1.0)  # steps, retaining walls, porches
    if n:
        s, t = rng.uniform(0.5, width - 0.5, n), rng.uniform(0.4, max(0.8, setback + 2), n)
        sheet.boxes(frame, "wall", s, t, sizes(rng, "wall", n), np.pi / 2 * rng.integers(0, 2, n))


def _belongings(sheet, rng, frame, house: tuple, gate, district: District, mood: Mood) -> None:
    """Bins, boxes and bicycles before the house and beside its drive."""
    s0, s1, t0, _ = house
    n = rng.poisson(district.things_per_plot * mood.things)
    if n:
        row = (gate[1] if rng.random() < 0.5 and gate[1] else rng.uniform(s0, s1)) + 1.2 * np.arange(n)
        label = "trashbin" if rng.random() < 0.5 else "box"
        sheet.boxes(frame, label, row, max(0.4, t0 * rng.uniform(0.1, 0.9)), sizes(rng, label, n), rng.normal(0, 0.1, n))
    n = rng.poisson(district.bicycles_per_plot * mood.bicycles)
    if n:
        label = "bicycle" if rng.random() < 0.8 else "motorcycle"
        row, yaw = rng.uniform(s0, s1) + 0.9 * np.arange(n), np.pi / 2 + rng.normal(0, 0.1, n)
        sheet.boxes(frame, label, row, max(0.2, t0 - 1.2), sizes(rng, "bicycle", n), yaw)


def _paint(sheet, frame, width, depth, front: int, back: int, split: float, rects: list) -> None:
    """Slabs of a plot: `front` before t = split, `back` behind it, and `rects` (class, (s0, s1, t0, t1)) on top."""
    for low, high, base in ((0.0, split, front), (split, depth, back)):
        if high - low < 0.3:
            continue
        here = []
        for value, (a, b, c, d) in rects:
            a, b, c, d = max(a, 0.0), min(b, width), max(c, low), min(d, high)
            if b - a > 0.05 and d - c > 0.05:
                here.append((value, a, b, c, d))
        s = _lines([0.0, width] + [x for r in here for x in r[1:3]])
        t = _lines([low, high] + [x for r in here for x in r[3:5]])
        cells = np.full((len(s) - 1, len(t) - 1), base)
        ms, mt = (np.array(s)[:-1] + np.array(s)[1:]) / 2, (np.array(t)[:-1] + np.array(t)[1:]) / 2
        for value, a, b, c, d in here:
            cells[np.ix_((ms > a) & (ms < b), (mt > c) & (mt < d))] = value
        for value, outline in outlines_of(cells, s, t):
            sheet.slab(frame, CELL_CLASS[value], outline)


def _lines(values: list[float]) -> list[float]:
    """Sorted distinct grid lines, at least a centimetre apart."""
    out: list[float] = []
    for value in sorted(values):
        if not out or value - out[-1] > 0.01:
            out.append(float(value))
    return out


# ---------------------------------------------------------------- blocks without plots


def _park(sheet, rng, interior, district: District, mood: Mood) -> None:
    """Lawn with a path through it, trees, a hedge or wall round it, benches, people."""
    frame, width, depth = interior
    middle = float(rng.uniform(0.35, 0.65)) * depth
    for low, high, ground_class in (
        (0.0, middle - 1.2, "terrain"),
        (middle - 1.2, middle + 1.2, "ground"),
        (middle + 1.2, depth, "terrain"),
    ):
        tiles = np.linspace(0, width, max(1, round(width / 24)) + 1).tolist()
        rows = np.linspace(low, high, max(1, round((high - low) / 24)) + 1).tolist()
        for a, b in zip(tiles[:-1], tiles[1:], strict=True):
            for c, d in zip(rows[:-1], rows[1:], strict=True):
                sheet.slab(frame, ground_class, [(a, c), (b, c), (b, d), (a, d)])
    path = (0.0, width, middle - 1.2, middle + 1.2)
    _garden(sheet, rng, frame, width, depth, [path], district, mood)
    kind = "hedge" if rng.random() < 0.75 else "wall"
    gaps = ((0.5, 0.5, width - 0.5, 0.5), (0.5, depth - 0.5, width - 0.5, depth - 0.5))
    gaps += ((0.5, 0.5, 0.5, middle - 2), (0.5, middle + 2, 0.5, depth - 0.5))
    gaps += ((width - 0.5, 0.5, width - 0.5, middle - 2), (width - 0.5, middle + 2, width - 0.5, depth - 0.5))
    for line in gaps:
        _border(sheet, rng, frame, *line, kind, 0.8)
    n = 2 + rng.poisson(3 * mood.things)
    sheet.boxes(frame, "box", rng.uniform(2, width - 2, n), middle + rng.choice([-1.6, 1.6], n), sizes(rng, "box", n))
    n = rng.poisson(1.8 * mood.people)
    s, t = rng.uniform(2, width - 2, n), middle + rng.uniform(-1, 1, n)
    sheet.boxes(frame, "pedestrian", s, t, sizes(rng, "pedestrian", n), rng.uniform(-np.pi, np.pi, n))


def _meadow(sheet, rng, block: Block, district: District, mood: Mood) -> None:
    """Land outside the last street's corner: lawn where the district has lawns, and its vegetation."""
    frame, width, depth = Frame((block.u0, block.v0), (1.0, 0.0), (0.0, 1.0)), block.u1 - block.u0, block.v1 - block.v0
    if rng.random() < district.terrain_back:
        for a in (0.0, width / 2):
            _strip(sheet, frame, "terrain", 0.0, depth, a, a + width / 2, 20.0)
    _garden(sheet, rng, frame, width, depth, [], district, mood)


def _garage_court(sheet, rng, interior, district: District, mood: Mood) -> None:
    """Two rows of garages that face each other across a court, hedges behind them, a house at each end."""
    frame, width, depth = interior
    g = sizes(rng, "garage", 1)[0]
    margin, aisle = (depth - 2 * g[0] - 9.0) / 2, 9.0
    start = float(rng.uniform(4, max(4.5, width * 0.2)))
    n = int((width - start - 18) / (g[1] + 0.1))
    at = start + (np.arange(n) + 0.5) * (g[1] + 0.1)
    end = start + n * (g[1] + 0.1)
    for low in (margin, margin + g[0] + aisle):
        here = at[rng.random(n) < 0.92]
        size = np.exp(0.02 * rng.standard_normal((len(here), 3))) * g
        sheet.boxes(frame, "garage", here, low + g[0] / 2, size, np.pi / 2, -0.1)
    for a, b in ((0.0, (start + end) / 2), ((start + end) / 2, end)):
        sheet.slab(frame, "parking", [(a, margin + g[0]), (b, margin + g[0]), (b, margin + g[0] + aisle), (a, margin + g[0] + aisle)])
    cars = at[rng.random(n) < 0.25 * mood.cars]
    _cars(sheet, rng, frame, cars, margin + g[0] + 2.7, np.pi / 2)
    for low in (0.0, depth - margin):
        strip = frame.at(0.0, low)
        if margin > 1 and rng.random() < district.terrain_front:
            _strip(sheet, frame, "terrain", 0.0, width, low, low + margin, 25.0)
        if margin > 1.5:
            _garden(sheet, rng, strip, width, margin, [], district, mood)
        _border(sheet, rng, strip, 0.5, margin / 2, width - 0.5, margin / 2, "hedge", 0.8 * min(1.0, district.hedges))
    house = frame.at(end + 1, margin)
    _plot(sheet, rng, house, width - end - 1, depth - 2 * margin, (12.0, 16.0, 10.0, False, 0.0), district, mood)


def _court(sheet, rng, interior, district: District, mood: Mood) -> None:
    """A large building behind its car park, with rows of cars, a garden and a wall at the back."""
    frame, width, depth = interior
    lot = float(rng.uniform(16.0, 19.0))
    beds = np.linspace(0, width, max(2, round(width / 22)) + 1).tolist()
    for a, b in zip(beds[:-1], beds[1:], strict=True):
        sheet.slab(frame, "terrain", [(a, 0), (b, 0), (b, 2.5), (a, 2.5)])
        sheet.slab(frame, "parking", [(a, 2.5), (b, 2.5), (b, 2.5 + lot), (a, 2.5 + lot)])
    _garden(sheet, rng, frame, width, 2.5, [], district, mood, lush=2.0)
    slots = np.arange(2.0, width - 2.0, 2.75)
    for t, yaw in ((5.1, np.pi / 2), (lot, -np.pi / 2)):
        taken = rng.random(len(slots)) < min(0.8, 0.25 * mood.cars)
        _cars(sheet, rng, frame, slots[taken], t, yaw)

    yard, behind = frame.at(0.0, 2.5 + lot), depth - 2.5 - lot
    forecourt, deep = min(6.0, behind * 0.2), min(20.0, behind * 0.6)
    big = np.array([min(width * 0.6, 44.0), deep, float(rng.uniform(6, 14))])
    middle = width * float(rng.uniform(0.45, 0.55))
    house = (middle - big[0] / 2, middle + big[0] / 2, forecourt, forecourt + deep)
    sheet.boxes(yard, "building", middle, forecourt + deep / 2, big, 0.0, -0.2)
    paved = (house[0] - 2.0, house[1] + 2.0, 0.0, forecourt)
    lawn = TERRAIN if rng.random() < district.terrain_back else NOTHING
    _paint(sheet, yard, width, behind, lawn, lawn, behind, [(GROUND, paved), (NOTHING, house)])
    _garden(sheet, rng, yard, width, behind, [house, paved], district, mood)
    _border(sheet, rng, yard, 0.5, behind - 0.6, width - 0.5, behind - 0.6, "wall", 0.8)
    _border(sheet, rng, yard, width - 0.5, 1.0, width - 0.5, behind - 1, "hedge", 0.7)
    if rng.random() < 0.2:
        sheet.boxes(yard, "truck", middle, -2.0, sizes(rng, "truck", 1), 0.0)
