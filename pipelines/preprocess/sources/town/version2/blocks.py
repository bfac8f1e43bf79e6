"""Build the content of a block: sidewalks, parked cars and street furniture on its sides, and rows of houses.

Positions are in local frames (land.py), in metres: s runs along the street, and t points away from the street.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.preprocess.sources.town.assets import draw_sizes, plant_strip
from pipelines.preprocess.sources.town.land import LocalFrame
from pipelines.preprocess.sources.town.streets import CityBlock, trace_kerb
from pipelines.preprocess.sources.town.version2.assets import Site, add_cars, add_ellipsoids, add_patch, draw_yaw
from pipelines.preprocess.sources.town.version2.plots import MIN_PIECE_M, Kind, build_green, build_row, draw_row

CAR_SLOT_M = 6.6
VERGE_M = (2.2, 3.6)  # Depth of a verge with a path, which takes the place of a sidewalk.
PATH_M = 1.1  # Width of this path.
BAY_DEPTH_M = 2.3
POLE_SPREAD_RAD = 0.2  # Boxes of poles are annotated along or across the street, with this spread.
SIGN_OFFSET_M = 0.03  # Standard deviation of the distance between the centres of a sign and its pole, per axis.
NARROW_M = 2.9  # In streets with a smaller half width, cars stand on one side only.
MIN_CORNER_WALK_M = 0.7  # Least distance of the inner corner of a sidewalk from the kerb, along each street.


@dataclass(frozen=True)
class Side:
    """One side of a block: depth of sidewalk and bays, whether they exist, and half width of the street."""

    depth: float
    sidewalk: bool
    bay: bool
    half_street: float


NO_SIDE = Side(0.0, False, False, 0.0)


def furnish_block(site: Site, block: CityBlock, half_streets: tuple[float, float, float, float]) -> None:
    """Build the content of a block: first its sides, then its rows of houses."""
    sides = [
        _draw_side(site, half) if faces else NO_SIDE for faces, half in zip(block.streets, half_streets, strict=True)
    ]
    cuts = [_compute_cut(block.corners[k], sides[k], sides[k - 1]) for k in range(4)]
    for k in range(4):
        if block.streets[k]:
            _build_side(site, block, k, sides, cuts)
    if all(block.streets):
        _build_rows(site, block, sides, cuts)
    elif any(block.streets):
        k = block.streets.index(True)
        frame, length, _, _ = block.side(k)
        across = block.v1 - block.v0 if k % 2 == 0 else block.u1 - block.u0
        row = draw_row(site, _draw_kind(site, False), across - sides[k].depth)
        build_row(site, frame.at(0.0, sides[k].depth), length, row)


def _draw_kind(site: Site, perimeter: bool) -> Kind:
    if perimeter:
        return "perimeter"
    draw, district = site.rng.random(), site.district
    shares = np.cumsum([district.greens, district.terraces, district.courts])
    kinds: tuple[Kind, ...] = ("green", "terrace", "court", "detached")
    return kinds[int(np.searchsorted(shares, draw, side="right"))]


def _compute_cut(radius: float, side: Side, before: Side) -> float:
    """Return the length by which the inner corner of a sidewalk is cut, so that a wide kerb leaves room to walk."""
    needed = (1 - np.sqrt(0.5)) * radius + MIN_CORNER_WALK_M
    return float(max(0.0, 2 * (needed - min(side.depth, before.depth)))) if radius else 0.0


def _build_rows(site: Site, block: CityBlock, sides: list[Side], cuts: list[float]) -> None:
    """Build two rows along the longer sides of a block, and rows or gardens along the other sides."""
    rng = site.rng
    width, height = block.u1 - block.u0, block.v1 - block.v0
    long_sides = (0, 2) if width >= height else (1, 3)
    perimeter = bool(rng.random() < site.district.perimeters)
    reach = {}
    for k in long_sides:
        across = height if k % 2 == 0 else width
        depth = (across - sides[k].depth - sides[(k + 2) % 4].depth) / 2
        row = draw_row(site, _draw_kind(site, perimeter), depth)
        reach[k] = row.reach
        frame, length, _, _ = block.side(k)
        flanks = [0.0 if perimeter else float(rng.uniform(2.5, 6.0)) for _ in range(2)]
        start, end = sides[k - 1].depth + flanks[0], length - sides[(k + 1) % 4].depth - flanks[1]
        build_row(site, frame.at(start, sides[k].depth), end - start, row)
        _build_flank(site, block, (k - 1) % 4, sides, cuts, flanks[0], row.reach, at_start=False)
        _build_flank(site, block, (k + 1) % 4, sides, cuts, flanks[1], row.reach, at_start=True)
    for k in ((long_sides[0] + 1) % 4, (long_sides[1] + 1) % 4):
        frame, length, _, _ = block.side(k)
        # The rows of the two neighbouring sides begin at the ends of this side.
        start = sides[k - 1].depth + reach[(k - 1) % 4] + 0.5
        end = length - sides[(k + 1) % 4].depth - reach[(k + 1) % 4] - 0.5
        across = width if k % 2 else height
        depth = min(16.0, (across - sides[k].depth - sides[(k + 2) % 4].depth) / 2 - 1.0)
        kind = _draw_kind(site, perimeter) if end - start > 9.0 else "green"
        build_row(site, frame.at(start, sides[k].depth), end - start, draw_row(site, kind, depth))


def _build_flank(
    site: Site,
    block: CityBlock,
    k: int,
    sides: list[Side],
    cuts: list[float],
    depth: float,
    reach: float,
    at_start: bool,
) -> None:
    """Build the garden between side k and the outermost house of a neighbouring row."""
    if depth < 1.0:
        return
    frame, length, _, _ = block.side(k)
    near, cut = (sides[k - 1], cuts[k]) if at_start else (sides[(k + 1) % 4], cuts[(k + 1) % 4])
    width = reach - cut
    start = near.depth + cut if at_start else length - near.depth - cut - width
    build_green(site, frame.at(start, sides[k].depth), width, depth)


# ---------------------------------------------------------------- sides of a block


def _draw_side(site: Site, half_street: float) -> Side:
    bay, sidewalk = bool(site.rng.random() < site.district.bays), bool(site.rng.random() < site.district.sidewalks)
    walk = float(site.rng.uniform(*site.district.sidewalk_m)) + (0.6 if half_street > 3.9 else 0.0)
    if not sidewalk:
        walk = float(site.rng.uniform(*VERGE_M))
    return Side(walk + BAY_DEPTH_M * bay, sidewalk, bay, half_street)


def _build_side(site: Site, block: CityBlock, k: int, sides: list[Side], cuts: list[float]) -> None:
    frame, length, r0, r1 = block.side(k)
    side, before, after = sides[k], sides[k - 1], sides[(k + 1) % 4]
    paved = "sidewalk" if side.sidewalk else "terrain"
    start, end = 0.0, length
    if r0:
        start = max(r0, side.depth + cuts[k], before.depth + cuts[k]) + 0.3
        ground_class = "sidewalk" if side.sidewalk or before.sidewalk else "terrain"
        _build_corner(site, frame, r0, start, side.depth, before.depth, cuts[k], ground_class)
    if r1:
        cut = cuts[(k + 1) % 4]
        end = length - max(r1, side.depth + cut, after.depth + cut) - 0.3
    if side.bay:
        _build_bays(site, frame, start, end, paved)
    piece = 11.0 if side.sidewalk else 18.0
    paved_from, paved_to = BAY_DEPTH_M * side.bay, side.depth - (0.0 if side.sidewalk else PATH_M)
    plant_strip(site.sheet, frame, paved, start, end, paved_from, paved_to, piece)
    if not side.sidewalk:
        plant_strip(site.sheet, frame, "ground", start, end, paved_to, side.depth, piece)
    if not side.bay:
        park_cars(site, frame, start + 4.0, end - 4.0, k, side)
    add_furniture(site, frame, start, end, k, side, bool(r0))


def _build_corner(
    site: Site, frame: LocalFrame, r: float, size: float, depth: float, depth_before: float, cut: float, ground: str
) -> None:
    """Build the sidewalk around a kerb of radius r. `size` is the extent of the sidewalk along both streets."""
    inner = [(depth_before, depth)] if cut < 0.1 else [(depth_before, depth + cut), (depth_before + cut, depth)]
    inside = [(0.0, size), (depth_before, size), *inner, (size, depth), (size, 0.0)]
    site.sheet.slab(frame, ground, inside + trace_kerb(0.0, 0.0, r))


def _build_bays(site: Site, frame: LocalFrame, start: float, end: float, paved: str) -> None:
    """Build parking bays along the road, with trees between groups of bays."""
    rng, s = site.rng, start
    while s < end - MIN_PIECE_M:
        run = min(end - s, CAR_SLOT_M * int(rng.integers(2, 5)))
        if end - s - run < 5:
            run = end - s
        slots = int(run / 5.6)
        if slots:
            site.sheet.slab(frame, "parking", [(s, 0), (s + run, 0), (s + run, BAY_DEPTH_M), (s, BAY_DEPTH_M)])
            at = s + (np.arange(slots) + 0.5) * run / slots
            taken = rng.random(slots) < min(0.9, 1.3 * site.district.kerb_cars * site.variation.cars)
            add_cars(site, frame, at[taken], 1.15, np.pi)
            s += run
        gap = min(end - s, float(rng.uniform(2.0, 3.0)))
        if gap > MIN_PIECE_M:
            site.sheet.slab(frame, paved, [(s, 0), (s + gap, 0), (s + gap, BAY_DEPTH_M), (s, BAY_DEPTH_M)])
            if rng.random() < 0.5:
                add_ellipsoids(site, frame, np.array([s + gap / 2]), np.array([1.1]), "tree")
        s += gap


def park_cars(site: Site, frame: LocalFrame, start: float, end: float, k: int, side: Side) -> None:
    """Park a row of cars along the kerb, in the direction of the adjacent lane."""
    rng, district = site.rng, site.district
    slots = int(max(0.0, end - start) / CAR_SLOT_M)
    rows = district.kerb_rows if side.half_street >= NARROW_M or k >= 2 else 0.25 * district.kerb_rows
    if not slots or rng.random() > rows:
        return
    at = start + (np.arange(slots) + 0.5) * (end - start) / slots
    # Rows of cars have long gaps: a place is taken more often if the place before it is taken.
    share = min(0.9, district.kerb_cars * site.variation.cars)
    draws = rng.random((slots, 2))
    taken = np.empty(slots, bool)
    for place in range(slots):
        keeps = place > 0 and draws[place, 0] < 0.45
        taken[place] = taken[place - 1] if keeps else draws[place, 1] < share
    t = 0.15 if rng.random() < 0.45 and side.sidewalk else -1.0  # Some rows stand partly on the sidewalk.
    add_cars(site, frame, at[taken], t, np.pi)
    free = at[~taken]
    big = free[rng.random(len(free)) < district.trucks]
    if len(big):
        label = str(rng.choice(["truck", "truck", "bus"]))
        size = draw_sizes(rng, "truck", 1, 1.0 + 0.15 * (label == "bus"))
        site.sheet.boxes(frame, label, big[:1], -1.5, size, np.pi)


def add_furniture(site: Site, frame: LocalFrame, start: float, end: float, k: int, side: Side, corner0: bool) -> None:
    """Add lamps at regular distances, signs near junctions, traffic lights, rows of trees and pedestrians."""
    rng, district, variation = site.rng, site.district, site.variation
    length, walk = max(0.0, end - start), side.depth if side.sidewalk else 1.3  # On a verge, poles stand near the road.
    main = side.half_street > 3.9
    # Poles stand at regular distances. The first one stands where the adjacent lane meets a junction. Every other pole
    # is a lamp on one side of a street, or on both sides of a main street.
    places = np.arange(start + 1.5 + (0.0 if k < 2 else 6.0 * (not corner0)), end - 1.0, district.lamp_spacing_m / 2)
    for number, place in enumerate(places + rng.normal(0, 0.9, len(places))):
        if number == 0 and corner0 and rng.random() < district.lights * (2.0 if main else 0.7):
            _add_lights(site, frame, place, 0.5)
        elif number % 2 == 1 and (main or k < 2):
            _add_lamps(site, frame, np.array([place]), walk - 0.3)
        elif rng.random() < district.signs * variation.furniture * (1.0 if number == 0 else 0.55):
            _add_sign(site, frame, place, 0.4 if rng.random() < 0.45 else walk - 0.1)
    if rng.random() < district.avenues and length > 15:
        spacing = rng.uniform(7.5, 12.0)
        s = np.arange(start + rng.uniform(2, 6), end - 2, spacing)
        s = s[rng.random(len(s)) < 0.9]
        s = s + rng.normal(0, 0.5, len(s))
        inside = walk > 2.0  # On wide sidewalks, the trees stand in pits.
        add_ellipsoids(site, frame, s, np.full(len(s), 0.6 if inside else walk + 0.6), "tree")
        for place in s[: len(s) * inside]:
            add_patch(site, frame, "terrain", place, 0.6, 0.9)
    for _ in range(rng.poisson(district.people_per_100m * variation.people * length / 100 / 1.6)):
        count = 1 + rng.poisson(0.6)
        s, t = rng.uniform(start, end) + rng.normal(0, 0.6, count), rng.uniform(0.4, max(0.5, walk - 0.2), count)
        yaw = rng.uniform(-np.pi, np.pi, count)
        site.sheet.boxes(frame, "pedestrian", s, t, draw_sizes(rng, "pedestrian", count), yaw)


def _add_lamps(site: Site, frame: LocalFrame, s: np.ndarray, t: float) -> None:
    """Add poles with a lamp above the street; the lamp touches its pole."""
    if not len(s):
        return
    pole = draw_sizes(site.rng, "bigPole", len(s))
    site.sheet.boxes(frame, "bigPole", s, t, pole, draw_yaw(site.rng, len(s), POLE_SPREAD_RAD))
    lit = site.rng.random(len(s)) < site.district.lamps
    head = draw_sizes(site.rng, "lamp", len(s))
    count = int(lit.sum())
    out = site.rng.uniform(0.2, 0.45, count)  # Distance from the pole towards the street.
    site.sheet.boxes(frame, "lamp", s[lit], t - out, head[lit], draw_yaw(site.rng, count), pole[lit, 2] - 0.4)


def _add_sign(site: Site, frame: LocalFrame, s: float, t: float) -> None:
    """Add a pole with one or two signs on it."""
    rng = site.rng
    tall = rng.random() < 0.5
    pole = draw_sizes(rng, "bigPole" if tall else "smallPole", 1, (1.0, 1.0, 0.8) if tall else (1.0, 1.0, 1.2))[0]
    pole[2] = max(2.0, pole[2])
    site.sheet.boxes(frame, "bigPole" if tall else "smallPole", s, t, pole, draw_yaw(rng, 1, POLE_SPREAD_RAD))
    bottom = pole[2] - 0.1
    for _ in range(1 + (rng.random() < 0.2)):  # The second sign is below the first one.
        sign = draw_sizes(rng, "trafficSign", 1)[0]
        ds, dt = rng.normal(0, SIGN_OFFSET_M, 2)
        site.sheet.boxes(frame, "trafficSign", s + ds, t + dt, sign, draw_yaw(rng, 1), bottom)
        bottom -= sign[2] + 0.05


def _add_lights(site: Site, frame: LocalFrame, s: float, t: float) -> None:
    """Add a pole with two traffic lights."""
    pole = draw_sizes(site.rng, "bigPole", 1, 0.75)[0]
    lights = draw_sizes(site.rng, "trafficLight", 2)
    second = 2.25 + lights[0, 2]
    pole[2] = max(3.4, second, pole[2])
    site.sheet.boxes(frame, "smallPole", s, t, pole, draw_yaw(site.rng, 1, POLE_SPREAD_RAD))
    ds, dt = site.rng.normal(0, SIGN_OFFSET_M, (2, 2))
    site.sheet.boxes(frame, "trafficLight", s + ds, t + dt, lights, draw_yaw(site.rng, 2), np.array([2.2, second]))
