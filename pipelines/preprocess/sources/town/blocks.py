"""Build the content of a block.

The sides of a block have sidewalks and street furniture. The interior has houses, a park or a court. Positions are in
local frames (land.py), in metres: s runs along the street, and t points away from the street.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from pipelines.preprocess.sources.town.assets import (
    Site,
    draw_sizes,
    place_cars,
    plant_border,
    plant_garden,
    plant_strip,
    plant_trees,
)
from pipelines.preprocess.sources.town.land import LocalFrame
from pipelines.preprocess.sources.town.plots import (
    GROUND,
    NOTHING,
    TERRAIN,
    House,
    build_house_row,
    build_plot,
    paint_plots,
)
from pipelines.preprocess.sources.town.streets import CityBlock, trace_kerb

CAR_SLOT_M = 6.2
BAY_DEPTH_M = 2.3


def furnish_block(site: Site, block: CityBlock) -> None:
    """Build the content of a block: first its sides, then its interior."""
    depths = [_compute_side_depth(site) if faces else (0.0, False, False) for faces in block.streets]
    for k in range(4):
        if block.streets[k]:
            _build_side(site, block, k, depths)
    if not any(block.streets):
        _build_meadow(site, block)
        return
    use = site.rng.random()
    width, height = block.u1 - block.u0, block.v1 - block.v0
    whole = all(block.streets)
    if whole and use < site.district.parks:
        _build_park(site, _fill_interior(block, depths))
    elif whole and use < site.district.parks + site.district.courts and min(width, height) > 45:
        fill = _build_garage_court if site.rng.random() < 0.6 else _build_court
        fill(site, _fill_interior(block, depths))
    else:
        rows = (0, 2) if width >= height else (1, 3)
        for k in rows if whole else [block.streets.index(True)]:
            frame, length, _, _ = block.side(k)
            before, own, after = depths[k - 1][0], depths[k][0], depths[(k + 1) % 4][0]
            across = height if k % 2 == 0 else width
            depth = (across - own - depths[(k + 2) % 4][0]) / 2 if whole else across - own
            build_house_row(site, frame.at(before, own), length - before - after, depth)


def _fill_interior(block: CityBlock, depths: list) -> tuple[LocalFrame, float, float]:
    """Return the interior of a block: a frame along the longer side, the width and the depth."""
    south, east, north, west = (d[0] for d in depths)
    width, depth = block.u1 - block.u0 - west - east, block.v1 - block.v0 - south - north
    if width >= depth:
        return LocalFrame((block.u0 + west, block.v0 + south), (1.0, 0.0), (0.0, 1.0)), width, depth
    return LocalFrame((block.u1 - east, block.v0 + south), (0.0, 1.0), (-1.0, 0.0)), depth, width


# ---------------------------------------------------------------- sides of a block


def _compute_side_depth(site: Site) -> tuple[float, bool, bool]:
    """Return the depth of one side, whether the side has a sidewalk, and whether it has parking bays."""
    sidewalk, bay = bool(site.rng.random() < site.district.sidewalks), bool(site.rng.random() < site.district.bays)
    return float(site.rng.uniform(2.25, 3.0)) + BAY_DEPTH_M * bay, sidewalk, bay


def _build_side(site: Site, block: CityBlock, k: int, depths: list) -> None:
    frame, length, r0, r1 = block.side(k)
    depth, sidewalk, bay = depths[k]
    before, after = depths[k - 1], depths[(k + 1) % 4]
    paved = "sidewalk" if sidewalk else "terrain"
    start, end = 0.0, length
    if r0:
        corner_class = "sidewalk" if sidewalk or before[1] else "terrain"
        start = max(r0, depth, before[0]) + 0.5
        build_corner(site, frame, r0, start, depth, before[0], corner_class)
    if r1:
        end = length - max(r1, depth, after[0]) - 0.5
    if bay:
        _place_bays(site, frame, start, end, paved)
    plant_strip(site.sheet, frame, paved, start, end, BAY_DEPTH_M * bay, depth, 9.0 if sidewalk else 18.0)
    if not bay:
        _place_curb_cars(site, frame, start + 3, end - 3)
    _place_furniture(site, frame, start, end, depth, bool(r0))


def build_corner(
    site: Site, frame: LocalFrame, r: float, size: float, depth: float, depth_before: float, ground_class: str
) -> None:
    """Build the sidewalk around a kerb of radius r. `size` is the extent of the sidewalk along both streets."""
    inside = [(0.0, size), (depth_before, size), (depth_before, depth), (size, depth), (size, 0.0)]
    site.sheet.slab(frame, ground_class, inside + trace_kerb(0.0, 0.0, r))


def _place_bays(site: Site, frame: LocalFrame, start: float, end: float, paved: str) -> None:
    """Build parking bays along the road, with trees between groups of bays."""
    s = start
    occupancy = min(0.9, 1.5 * site.district.curb_parking * site.mood.cars)
    while s < end:
        run = min(end - s, CAR_SLOT_M * int(site.rng.integers(2, 5)))
        if end - s - run < 5:
            run = end - s
        slots = int(run / 5.6)
        if slots:
            site.sheet.slab(frame, "parking", [(s, 0), (s + run, 0), (s + run, BAY_DEPTH_M), (s, BAY_DEPTH_M)])
            at = s + (np.arange(slots) + 0.5) * run / slots
            place_cars(site, frame, at[site.rng.random(slots) < occupancy], 1.1)
            s += run
        gap = min(end - s, float(site.rng.uniform(2.0, 3.0)))
        if gap > 0:
            site.sheet.slab(frame, paved, [(s, 0), (s + gap, 0), (s + gap, BAY_DEPTH_M), (s, BAY_DEPTH_M)])
            if site.rng.random() < 0.12 * site.district.street_trees_per_100m:
                plant_trees(site, frame, np.array([s + gap / 2]), np.array([1.1]), "tree")
        s += gap


def _place_curb_cars(site: Site, frame: LocalFrame, start: float, end: float) -> None:
    slots = int(max(0.0, end - start) / CAR_SLOT_M)
    if not slots:
        return
    at = start + (np.arange(slots) + 0.5) * (end - start) / slots
    taken = site.rng.random(slots) < min(0.85, site.district.curb_parking * site.mood.cars)
    # Most cars stand partly on the sidewalk.
    place_cars(site, frame, at[taken], -0.9 if site.rng.random() < 0.3 else 0.1)
    free = at[~taken]
    trucks = free[site.rng.random(len(free)) < site.district.trucks_per_100m * CAR_SLOT_M / 100]
    if len(trucks):
        label = str(site.rng.choice(["truck", "truck", "bus"]))
        site.sheet.boxes(
            frame, label, trucks[:1], -1.3, draw_sizes(site.rng, "truck", 1, 1.0 + 0.15 * (label == "bus")), np.pi
        )


def _place_furniture(site: Site, frame: LocalFrame, start: float, end: float, depth: float, corner: bool) -> None:
    """Place lamps, traffic signs, traffic lights, street trees and pedestrians on one side of a block."""
    length = max(0.0, end - start)
    n = site.rng.poisson(site.district.lamps_per_100m * site.mood.furniture * length / 100)
    if n:
        s = start + (np.arange(n) + site.rng.uniform(0.25, 0.75)) * length / n
        pole = draw_sizes(site.rng, "bigPole", n)
        site.sheet.boxes(frame, "bigPole", s, depth - 0.4, pole, site.rng.normal(0, 0.2, n))
        lit = site.rng.random(n) < 0.9
        head = draw_sizes(site.rng, "lamp", n)[lit]
        bottom = (pole[lit, 2] - 0.2).clip(2, 6)
        site.sheet.boxes(frame, "lamp", s[lit], np.full(lit.sum(), depth - 0.8), head, np.pi / 2, bottom)
    n = site.rng.poisson(site.district.signs_per_100m * site.mood.furniture * length / 100)
    if n:
        s = np.where(
            site.rng.random(n) < 0.5, start + site.rng.uniform(0, 4, n), site.rng.uniform(start, max(end, start + 4), n)
        )
        _place_sign(site, frame, s, np.full(n, 0.5))
    if corner and site.rng.random() < site.district.lights:
        site.sheet.boxes(frame, "smallPole", start, 0.5, draw_sizes(site.rng, "bigPole", 1, 0.75))
        low_high = np.array([2.2, 2.9])
        site.sheet.boxes(
            frame, "trafficLight", [start] * 2, [0.5] * 2, draw_sizes(site.rng, "trafficLight", 2), np.pi / 2, low_high
        )
    n = site.rng.poisson(site.district.street_trees_per_100m * site.mood.trees * length / 100)
    if n:
        s = start + (np.arange(n) + site.rng.uniform(0.2, 0.8, n)) * length / n
        plant_trees(site, frame, s, np.full(n, depth - 0.6), "tree")
    groups = site.rng.poisson(site.district.people_per_100m * site.mood.people * length / 100 / 1.6)
    for _ in range(groups):
        n = 1 + site.rng.poisson(0.6)
        s, t = site.rng.uniform(start, end) + site.rng.normal(0, 0.6, n), site.rng.uniform(0.6, depth - 0.3, n)
        site.sheet.boxes(
            frame, "pedestrian", s, t, draw_sizes(site.rng, "pedestrian", n), site.rng.uniform(-np.pi, np.pi, n)
        )


def _place_sign(site: Site, frame: LocalFrame, s: np.ndarray, t: np.ndarray) -> None:
    n = len(s)
    pole = draw_sizes(site.rng, "smallPole", n)
    pole[:, 2] = pole[:, 2].clip(2.0, None)
    site.sheet.boxes(frame, "smallPole", s, t, pole)
    site.sheet.boxes(frame, "trafficSign", s, t, draw_sizes(site.rng, "trafficSign", n), np.pi / 2, pole[:, 2])


# ---------------------------------------------------------------- blocks without rows


def _build_park(site: Site, interior: tuple[LocalFrame, float, float]) -> None:
    """Build a park: a lawn with a path, trees, benches and pedestrians, and a hedge or wall around the lawn."""
    frame, width, depth = interior
    middle = float(site.rng.uniform(0.35, 0.65)) * depth
    for low, high, ground_class in (
        (0.0, middle - 1.2, "terrain"),
        (middle - 1.2, middle + 1.2, "ground"),
        (middle + 1.2, depth, "terrain"),
    ):
        tiles = np.linspace(0, width, max(1, round(width / 24)) + 1).tolist()
        rows = np.linspace(low, high, max(1, round((high - low) / 24)) + 1).tolist()
        for a, b in pairwise(tiles):
            for c, d in pairwise(rows):
                site.sheet.slab(frame, ground_class, [(a, c), (b, c), (b, d), (a, d)])
    path = (0.0, width, middle - 1.2, middle + 1.2)
    plant_garden(site, frame, width, depth, [path])
    kind = "hedge" if site.rng.random() < 0.75 else "wall"
    gaps = ((0.5, 0.5, width - 0.5, 0.5), (0.5, depth - 0.5, width - 0.5, depth - 0.5))
    gaps += ((0.5, 0.5, 0.5, middle - 2), (0.5, middle + 2, 0.5, depth - 0.5))
    gaps += ((width - 0.5, 0.5, width - 0.5, middle - 2), (width - 0.5, middle + 2, width - 0.5, depth - 0.5))
    for line in gaps:
        plant_border(site, frame, *line, kind, 0.8)
    n = 2 + site.rng.poisson(3 * site.mood.objects)
    site.sheet.boxes(
        frame,
        "box",
        site.rng.uniform(2, width - 2, n),
        middle + site.rng.choice([-1.6, 1.6], n),
        draw_sizes(site.rng, "box", n),
    )
    n = site.rng.poisson(1.8 * site.mood.people)
    s, t = site.rng.uniform(2, width - 2, n), middle + site.rng.uniform(-1, 1, n)
    site.sheet.boxes(
        frame, "pedestrian", s, t, draw_sizes(site.rng, "pedestrian", n), site.rng.uniform(-np.pi, np.pi, n)
    )


def _build_meadow(site: Site, block: CityBlock) -> None:
    """Build the area beyond the outermost street corners: vegetation and, if the district has lawns, a lawn."""
    frame, width, depth = (
        LocalFrame((block.u0, block.v0), (1.0, 0.0), (0.0, 1.0)),
        block.u1 - block.u0,
        block.v1 - block.v0,
    )
    if site.rng.random() < site.district.terrain_back:
        for a in (0.0, width / 2):
            plant_strip(site.sheet, frame, "terrain", 0.0, depth, a, a + width / 2, 20.0)
    plant_garden(site, frame, width, depth, [])


def _build_garage_court(site: Site, interior: tuple[LocalFrame, float, float]) -> None:
    """Build a court between two rows of garages. There are hedges behind the garages and a house at one end."""
    frame, width, depth = interior
    g = draw_sizes(site.rng, "garage", 1)[0]
    margin, aisle = (depth - 2 * g[0] - 9.0) / 2, 9.0
    start = float(site.rng.uniform(4, max(4.5, width * 0.2)))
    n = int((width - start - 18) / (g[1] + 0.1))
    at = start + (np.arange(n) + 0.5) * (g[1] + 0.1)
    end = start + n * (g[1] + 0.1)
    for low in (margin, margin + g[0] + aisle):
        here = at[site.rng.random(n) < 0.92]
        size = np.exp(0.02 * site.rng.standard_normal((len(here), 3))) * g
        site.sheet.boxes(frame, "garage", here, low + g[0] / 2, size, np.pi / 2, -0.1)
    plant_strip(site.sheet, frame, "parking", 0.0, end, margin + g[0], margin + g[0] + aisle, end / 2)
    here = at[site.rng.random(n) < 0.25 * site.mood.cars]
    place_cars(site, frame, here, margin + g[0] + 2.7, np.pi / 2)
    for low in (0.0, depth - margin):
        edge = frame.at(0.0, low)
        if margin > 1 and site.rng.random() < site.district.terrain_front:
            plant_strip(site.sheet, frame, "terrain", 0.0, width, low, low + margin, 25.0)
        if margin > 1.5:
            plant_garden(site, edge, width, margin, [])
        plant_border(
            site, edge, 0.5, margin / 2, width - 0.5, margin / 2, "hedge", 0.8 * min(1.0, site.district.hedges)
        )
    house = frame.at(end + 1, margin)
    build_plot(site, house, width - end - 1, depth - 2 * margin, House(12.0, 16.0, 10.0))


def _build_court(site: Site, interior: tuple[LocalFrame, float, float]) -> None:
    """Build a large building with a car park in front of it, parked cars, a garden, and a wall at the back."""
    frame, width, depth = interior
    lot = float(site.rng.uniform(16.0, 19.0))
    beds = np.linspace(0, width, max(2, round(width / 22)) + 1).tolist()
    for a, b in pairwise(beds):
        site.sheet.slab(frame, "terrain", [(a, 0), (b, 0), (b, 2.5), (a, 2.5)])
        site.sheet.slab(frame, "parking", [(a, 2.5), (b, 2.5), (b, 2.5 + lot), (a, 2.5 + lot)])
    plant_garden(site, frame, width, 2.5, [], lush=2.0)
    slots = np.arange(2.0, width - 2.0, 2.75)
    for t, yaw in ((5.1, np.pi / 2), (lot, -np.pi / 2)):
        taken = site.rng.random(len(slots)) < min(0.8, 0.25 * site.mood.cars)
        place_cars(site, frame, slots[taken], t, yaw)

    yard, behind = frame.at(0.0, 2.5 + lot), depth - 2.5 - lot
    forecourt, deep = min(6.0, behind * 0.2), min(20.0, behind * 0.6)
    big = np.array([min(width * 0.6, 44.0), deep, float(site.rng.uniform(6, 14))])
    middle = width * float(site.rng.uniform(0.45, 0.55))
    house = (middle - big[0] / 2, middle + big[0] / 2, forecourt, forecourt + deep)
    site.sheet.boxes(yard, "building", middle, forecourt + deep / 2, big, 0.0, -0.2)
    paved = (house[0] - 2.0, house[1] + 2.0, 0.0, forecourt)
    lawn = TERRAIN if site.rng.random() < site.district.terrain_back else NOTHING
    paint_plots(site, yard, width, behind, lawn, lawn, behind, [(GROUND, paved), (NOTHING, house)])
    plant_garden(site, yard, width, behind, [house, paved])
    plant_border(site, yard, 0.5, behind - 0.6, width - 0.5, behind - 0.6, "wall", 0.8)
    plant_border(site, yard, width - 0.5, 1.0, width - 0.5, behind - 1, "hedge", 0.7)
    if site.rng.random() < 0.2:
        site.sheet.boxes(yard, "truck", middle, -2.0, draw_sizes(site.rng, "truck", 1), 0.0)
