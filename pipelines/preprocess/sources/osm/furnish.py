"""Add what an extract of OpenStreetMap lacks to its streets, with the rules of the town: parked vehicles, pedestrians,
plants, lamps, signals, signs, sidewalks and front gardens. Car parks get cars.

The label of each added object begins with FURNISHED. Where the extract has plants, lamps or signs, no others are added.
Roads without buildings near them are unchanged.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import shapely
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from models.geometry.iou3d import make_boxes
from models.geometry.suppression import find_suppressed
from models.scene import CATEGORY_INDEX, VEGETATION, VEHICLES
from pipelines.preprocess.sources.osm.buildings import find_direction
from pipelines.preprocess.sources.osm.ground import LayerPolygon
from pipelines.preprocess.sources.osm.roads import Road
from pipelines.preprocess.sources.osm.tags import PARKING_M, STREETS
from pipelines.preprocess.sources.town.land import Land, LocalFrame
from pipelines.preprocess.sources.town.version2.assets import Site, StreetSheet, add_cars, plant_garden
from pipelines.preprocess.sources.town.version2.blocks import CAR_SLOT_M, Side, add_furniture, park_cars
from pipelines.preprocess.sources.town.version2.districts import DISTRICTS, District, draw_variation
from pipelines.preprocess.sources.town.world import collect_boxes

FURNISHED = "furnished "  # Prefix of the label of added objects.
AROUND_M = 60.0  # Radius in which the share of built area determines the district.
BUILT_SHARE = (("centre", 0.3), ("suburb", 0.1), ("green", 0.02))  # Least share of built area of each district.
GARDEN_M = 14.0  # Depth of the front gardens, from the sidewalk.
VERGE_M = 1.5
CORNER_M = 9.0  # Free length at junctions.
MIN_PIECE_M = 8.0
KNOWN_M = 25.0  # Within this distance of objects that the extract contains, no others of their kind are added.
BAY_M, LOT_ROW_M, LOT_AISLE_M = 2.6, 5.2, 6.0  # Width and length of a bay of a car park, and width of its aisles.
LOT_TAKEN = 0.5  # Share of occupied bays.
MAX_LOT_M2 = 20_000.0
LARGEST_IOU3D = 0.1  # Maximum IoU3D between two added objects of a category.
OVERLAP_SQUARE_M = 64.0
FLAT = Land(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)), 0.0, np.zeros(3))


class Piece(NamedTuple):
    """One side of a straight piece of a street.

    Attributes:
        road: Street.
        side: 0 on the left of the way, 1 on the right.
        frame: Origin at the kerb, s along the street against the direction of travel, t away from it.
        length_m: Length (m).
    """

    road: Road
    side: int
    frame: LocalFrame
    length_m: float


def furnish_streets(
    roads: list[Road],
    footprints: list[Any],
    boxes: dict[str, np.ndarray],
    ground: list[LayerPolygon],
    seed: int,
    drive_on_left: bool,
) -> tuple[dict[str, np.ndarray], list[LayerPolygon]]:
    """Add objects and ground along the streets.

    Args:
        roads: Roads.
        footprints: Footprints of buildings (m).
        boxes: Per-box arrays of the objects that the extract contains.
        ground: Ground that the extract contains.
        seed: Seed.
        drive_on_left: Whether vehicles drive on the left.

    Returns:
        Per-box arrays of the added objects, and layers and polygons of the added ground.
    """
    rng = np.random.default_rng([7309, seed])
    sheet, more_ground = StreetSheet(), []
    built = _BuiltArea(footprints)
    walked = _index([polygon for name, polygon in ground if name == "sidewalk"])
    for piece in _list_pieces(roads, drive_on_left):
        district = built.find_district(piece.frame.uv(np.array([piece.length_m / 2]), np.zeros(1))[0])
        if district is None:
            continue
        site = Site(sheet, rng, district, draw_variation(rng))
        depth, has_sidewalk = _find_sidewalk(piece, site, walked, more_ground)
        _furnish_piece(site, piece, depth, has_sidewalk)
    for name, polygon in ground:
        if name == "parking":
            _fill_lots(sheet, rng, polygon)
    if not sheet.box_label:
        return {name: values[:0] for name, values in boxes.items()}, more_ground
    added = collect_boxes(sheet, rng, FLAT)
    kept = _find_fitting(added, boxes, footprints, ground)
    added = {name: values[kept] for name, values in added.items()}
    added["label"] = np.array([FURNISHED + label for label in added["label"]], object)
    added["instance_id"] = np.full(kept.sum(), -1, np.int64)
    return added, more_ground


class _BuiltArea:
    """Share of built area around a place."""

    def __init__(self, footprints: list[Any]) -> None:
        self.area = shapely.area(footprints)
        centers = shapely.get_coordinates(shapely.centroid(footprints)) if footprints else np.zeros((0, 2))
        self.tree = cKDTree(centers) if len(centers) else None

    def find_district(self, xy_m: np.ndarray) -> District | None:
        """Return the district of a place (2,); None where almost nothing is built."""
        if self.tree is None:
            return None
        share = self.area[self.tree.query_ball_point(xy_m, AROUND_M)].sum() / (np.pi * AROUND_M**2)
        return next((DISTRICTS[name] for name, least in BUILT_SHARE if share >= least), None)


def _index(polygons: list[Any]) -> shapely.STRtree:
    return shapely.STRtree(polygons)


def _list_pieces(roads: list[Road], drive_on_left: bool) -> Iterator[Piece]:
    """Yield both sides of the straight pieces of streets, without junctions and bends."""
    uses = Counter(node for road in roads for node in set(road.nodes))
    for road in roads:
        profile = road.profile
        if profile.highway not in STREETS or "bridge" in road.tags:
            continue
        points = shapely.get_coordinates(road.line)
        for k in range(len(points) - 1):
            start, end = points[k], points[k + 1]
            length = float(np.hypot(*(end - start)))
            trims = [CORNER_M if uses[road.nodes[k + end_]] > 1 else 0.5 for end_ in (0, 1)]
            if length - sum(trims) < MIN_PIECE_M:
                continue
            along = (end - start) / length
            start = start + along * trims[0]
            length -= sum(trims)
            left = np.array([-along[1], along[0]])
            for side, kerb, outward in ((0, profile.left_m, left), (1, profile.right_m, -left)):
                # Vehicles on this side travel along the way (1) or against it (-1).
                travel = profile.oneway or (1 if (side == 1) != drive_on_left else -1)
                origin = start + kerb * outward + (along * length if travel == 1 else 0.0)
                frame = LocalFrame(_as_pair(origin), _as_pair(-travel * along), _as_pair(outward))
                yield Piece(road, side, frame, length)


def _find_sidewalk(
    piece: Piece, site: Site, walked: shapely.STRtree, more_ground: list[LayerPolygon]
) -> tuple[float, bool]:
    """Return the depth of the sidewalk or the verge, and whether there is a sidewalk. Unknown sidewalks are added."""
    profile, side = piece.road.profile, piece.side
    kerb = (profile.left_m, profile.right_m)[side] + profile.parking_m[side]
    width = profile.sidewalk_m[side]
    if not width and not profile.knows_sidewalk[side]:
        probe = piece.frame.uv(np.full(3, piece.length_m / 2), profile.parking_m[side] + np.array([0.8, 1.8, 2.8]))
        if len(walked.query(shapely.points(probe), predicate="intersects")[0]):
            width = 2.0  # The sidewalk is a separate way in the extract.
        elif site.rng.random() < site.district.sidewalks:
            width = float(np.mean(site.district.sidewalk_m))
            more_ground.append(("sidewalk", _make_side(piece, kerb + width)))
    depth = width or VERGE_M
    more_ground.append(("terrain", _make_side(piece, kerb + depth + GARDEN_M)))
    return depth, bool(width)


def _make_side(piece: Piece, outer_m: float) -> Any:
    """Return the strip between the line of a street and a distance from it, along a piece and its ends."""
    profile = piece.road.profile
    kerb = (profile.left_m, profile.right_m)[piece.side]
    s = np.array([-CORNER_M, piece.length_m + CORNER_M])
    inner, outer = piece.frame.uv(s, np.full(2, -kerb)), piece.frame.uv(s, np.full(2, outer_m - kerb))
    return shapely.Polygon(np.concatenate([inner, outer[::-1]]))


def _furnish_piece(site: Site, piece: Piece, depth: float, has_sidewalk: bool) -> None:
    profile, side, rng = piece.road.profile, piece.side, site.rng
    parking = profile.parking_m[side]
    place = Side(depth, has_sidewalk, False, (profile.left_m + profile.right_m) / 2)
    index = 0 if side else 2  # Rules of the town differ between the two sides of a street.
    if parking and not _is_forbidden(piece):
        _fill_parking(site, piece, parking)
    elif not parking and _allows_parking(piece):
        park_cars(site, piece.frame, 2.0, piece.length_m - 2.0, index, place)
    frame = piece.frame.at(0.0, parking)
    add_furniture(site, frame, 0.0, piece.length_m, index, place, bool(rng.random() < 0.5))
    plant_garden(site, frame.at(0.0, depth), piece.length_m, GARDEN_M, [])


def _allows_parking(piece: Piece) -> bool:
    """Return whether tags leave open whether cars park on a side."""
    side = ("left", "right")[piece.side]
    tags = piece.road.tags
    return not any(key.startswith((f"parking:{side}", "parking:both", "parking:lane")) for key in tags)


def _is_forbidden(piece: Piece) -> bool:
    """Return whether tags forbid to park or stop on the parking spaces of a side."""
    side = ("left", "right")[piece.side]
    texts = [piece.road.tags.get(f"parking:{name}:restriction", "") for name in (side, "both")]
    return any(text in ("no_parking", "no_stopping", "no_standing") for text in texts)


def _fill_parking(site: Site, piece: Piece, depth: float) -> None:
    """Add cars to parking spaces at the kerb."""
    slot, turn = (CAR_SLOT_M, np.pi) if depth <= PARKING_M["parallel"] else (BAY_M, np.pi / 2)
    count = int(piece.length_m / slot)
    at = (np.arange(count) + 0.5) * piece.length_m / max(1, count)
    taken = site.rng.random(count) < min(0.9, 1.3 * site.district.kerb_cars * site.variation.cars)
    add_cars(site, piece.frame, at[taken], depth / 2, turn)


def _fill_lots(sheet: StreetSheet, rng: np.random.Generator, polygon: Any) -> None:
    """Add cars in pairs of rows to car parks."""
    district = DISTRICTS["suburb"]
    for part in shapely.get_parts(polygon):
        if not 60.0 < part.area < MAX_LOT_M2 or part.area < 0.5 * shapely.oriented_envelope(part).area:
            continue
        yaw, middle = find_direction(part), np.array(part.centroid.coords[0])
        along = np.array([np.cos(yaw), np.sin(yaw)])
        frame = LocalFrame(_as_pair(middle), _as_pair(along), (-float(along[1]), float(along[0])))
        reach = float(np.hypot(*(np.array(part.bounds[2:]) - part.bounds[:2]))) / 2
        period = 2 * LOT_ROW_M + LOT_AISLE_M
        rows = np.concatenate(
            [
                [k * period - LOT_ROW_M / 2, k * period + LOT_ROW_M / 2]
                for k in range(-int(reach / period) - 1, int(reach / period) + 2)
            ]
        )
        inside = shapely.buffer(part, -1.0)
        site = Site(sheet, rng, district, draw_variation(rng))
        for t in rows.tolist():
            s = np.arange(-reach, reach, BAY_M)
            fits = shapely.contains_xy(inside, frame.uv(s, np.full(len(s), t)))
            s = s[fits & (rng.random(len(s)) < LOT_TAKEN)]
            add_cars(site, frame, s, t, np.pi / 2, 0.5)


def _find_fitting(
    added: dict[str, np.ndarray], known: dict[str, np.ndarray], footprints: list[Any], ground: list[LayerPolygon]
) -> np.ndarray:
    """Return a mask of added objects outside of buildings, and, except cars, outside of carriageways.

    Objects near mapped objects of their kind are left out, and so are those that overlap other added objects.
    """
    category, xy = added["category"], added["center_m"][:, :2]
    points = shapely.points(xy)
    kept = np.ones(len(xy), bool)
    kept[_index(footprints).query(points, predicate="intersects")[0]] = False
    is_car = np.isin(category, VEHICLES)
    roads = _index([polygon for name, polygon in ground if name in ("road", "parking")])
    on_road = np.zeros(len(xy), bool)
    on_road[roads.query(points, predicate="intersects")[0]] = True
    kept &= ~on_road | is_car
    for group in (VEGETATION, *[(k,) for k in range(len(CATEGORY_INDEX)) if k not in VEGETATION + VEHICLES]):
        theirs = known["center_m"][np.isin(known["category"], group), :2]
        mine = np.flatnonzero(np.isin(category, group))
        if len(theirs) and len(mine):
            distance, _ = cKDTree(theirs).query(xy[mine], distance_upper_bound=KNOWN_M)
            kept[mine[np.isfinite(distance)]] = False
    kept[_find_overlapping(added, np.flatnonzero(kept))] = False
    return kept


def _find_overlapping(added: dict[str, np.ndarray], index: np.ndarray) -> np.ndarray:
    """Return those of the objects `index` that overlap earlier ones of their category, except vegetation.

    Objects are compared within squares, because comparing all pairs would need too much memory.
    """
    index = index[~np.isin(added["category"][index], VEGETATION)]
    square = np.floor(added["center_m"][index, :2] / OVERLAP_SQUARE_M).astype(np.int64)
    _, owner = np.unique(square, axis=0, return_inverse=True)
    found = [np.zeros(0, np.int64)]
    limits = np.full(len(CATEGORY_INDEX), LARGEST_IOU3D)
    for members in np.split(np.argsort(owner, kind="stable"), np.cumsum(np.bincount(owner))[:-1]):
        here = index[members]
        shapes = make_boxes(*(added[name][here] for name in ("center_m", "rotation", "size_m")))
        found.append(here[find_suppressed(shapes, added["category"][here], -np.arange(len(here)), limits)])
    return np.concatenate(found)


def _as_pair(xy: np.ndarray) -> tuple[float, float]:
    return float(xy[0]), float(xy[1])
