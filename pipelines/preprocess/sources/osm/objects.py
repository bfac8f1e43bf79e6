"""Objects of an extract as boxes and ellipsoids: trees, hedges, walls, lamps, signals, signs, bollards, furniture.

OpenStreetMap states the place of an object and seldom its size. Missing sizes of plants, lamps, signals and signs are
drawn from the distributions of the town (sources/town/assets.py), with a random generator that depends on the number of
the node or way. Other objects have the default sizes below; size tags of street furniture are not read.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import shapely

from pipelines.preprocess.sources.osm.extract import Extract, Feature
from pipelines.preprocess.sources.osm.roads import NearestRoads, Road, sample_line
from pipelines.preprocess.sources.osm.tags import Tags, is_underground, parse_length
from pipelines.preprocess.sources.town.assets import draw_sizes

REACH_M = 30.0  # Largest distance of the road that an object faces.
KERB_M = 0.6  # Distance from the kerb to the poles of signals and signs that are mapped on the road.
TREE_ROW_M = 8.0  # Distance between the trees of a row.
PIECE_M = 10.0  # Longest piece of a hedge, wall or fence.
BOLLARD_ROW_M = 1.5
POLE_SIDE_M = 0.2
LAMP_REACH_M = 0.35  # Distance from a pole to the middle of its lamp.
MAX_PIECES = 2_000  # Pieces of one line.

# Barriers along a line: label, category, default width and height (m).
BARRIERS = {
    "hedge": ("vegetation_cuboid", 1.2, 1.6),
    "wall": ("construction_small", 0.3, 1.8),
    "city_wall": ("construction_small", 1.5, 5.0),
    "retaining_wall": ("construction_small", 0.4, 1.2),
    "fence": ("construction_small", 0.2, 1.5),
    "guard_rail": ("construction_small", 0.3, 0.8),
    "handrail": ("construction_small", 0.2, 1.0),
    "jersey_barrier": ("construction_small", 0.6, 0.9),
}
# Objects at a point: category, and length, width and height (m).
FURNITURE = {
    "amenity": {
        "bench": (1.8, 0.6, 0.8),
        "waste_basket": (0.5, 0.5, 1.0),
        "waste_disposal": (1.4, 1.1, 1.2),
        "recycling": (1.6, 1.2, 1.6),
        "post_box": (0.6, 0.5, 1.3),
        "vending_machine": (0.9, 0.6, 1.7),
        "bicycle_parking": (2.0, 1.0, 0.9),
        "telephone": (0.9, 0.9, 2.2),
        "fountain": (2.5, 2.5, 1.0),
    },
    "man_made": {"street_cabinet": (1.2, 0.5, 1.3)},
    "barrier": {"block": (1.0, 0.6, 0.6), "rock": (1.0, 0.8, 0.7), "jersey_barrier": (2.0, 0.6, 0.9)},
}
# Poles at a point: height (m).
POLES = {
    "man_made": {"pole": 6.0, "flagpole": 8.0, "mast": 15.0},
    "power": {"pole": 9.0},
    "barrier": {"bollard": 1.0},
}
GATES = ("gate", "lift_gate", "swing_gate", "toll_booth")
SIGN_HIGHWAYS = ("stop", "give_way", "traffic_sign", "bus_stop")


class Box(NamedTuple):
    """A box or ellipsoid that stands upright.

    Attributes:
        category: Name of the category.
        label: Value of the tag that states the kind of object.
        xy_m: Centre (m).
        yaw_rad: Angle from x to the length axis.
        size_m: Length, width and height (m).
        bottom_m: Height of the lowest point above the ground (m).
        id: Number of the node, way or relation.
    """

    category: str
    label: str
    xy_m: tuple[float, float]
    yaw_rad: float
    size_m: tuple[float, float, float]
    bottom_m: float
    id: int


def make_objects(extract: Extract, roads: list[Road]) -> list[Box]:
    """Return the objects of an extract without its buildings.

    Args:
        extract: Extract.
        roads: Its roads.

    Returns:
        Boxes and ellipsoids.
    """
    nearest = NearestRoads(roads)
    found: list[Box] = []
    for feature in extract.lines:
        if not is_underground(feature.tags):
            found += _make_line_objects(feature)
    on_road = {node: road for road in roads for node in road.nodes}
    for feature in extract.points:
        if not is_underground(feature.tags):
            found += _make_point_objects(feature, nearest, on_road)
    return found


# ------------------------------------------------------------------------------------------------------- lines


def _make_line_objects(feature: Feature) -> Iterator[Box]:
    tags, line = feature.tags, feature.geometry
    barrier = tags.get("barrier", "")
    if barrier in BARRIERS:
        category, width, height = BARRIERS[barrier]
        width = _get_length(tags, "width", width, 0.1, 5.0)
        yield from _make_pieces(feature, category, barrier, width, _get_length(tags, "height", height, 0.2, 12.0))
    elif barrier == "bollard":
        distance = np.arange(0.0, line.length + 1e-9, BOLLARD_ROW_M)[:MAX_PIECES]
        for place in sample_line(line, distance)[0].tolist():
            yield _make_pole(feature, "bollard", place, 0.0, 1.0)
    elif tags.get("natural") == "tree_row":
        distance = np.arange(TREE_ROW_M / 2, line.length, TREE_ROW_M)[:MAX_PIECES]
        rng = np.random.default_rng([7308, feature.id])
        points, along = sample_line(line, distance)
        for place, direction in zip(points.tolist(), along, strict=True):
            yield _make_plant(feature, "tree", place, float(np.arctan2(direction[1], direction[0])), rng)


def _make_pieces(feature: Feature, category: str, label: str, width: float, height: float) -> Iterator[Box]:
    """Yield boxes along the segments of a line; long segments are cut."""
    points = shapely.get_coordinates(feature.geometry)
    made = 0
    for start, end in zip(points[:-1], points[1:], strict=True):
        length = float(np.hypot(*(end - start)))
        count = int(np.ceil(length / PIECE_M))
        if length < 0.3 or made + count > MAX_PIECES:
            continue
        made += count
        yaw = float(np.arctan2(*(end - start)[::-1]))
        for k in range(count):
            x, y = (start + (end - start) * (k + 0.5) / count).tolist()
            yield Box(category, label, (x, y), yaw, (length / count, width, height), 0.0, feature.id)


# ------------------------------------------------------------------------------------------------------ points


def _make_point_objects(feature: Feature, nearest: NearestRoads, on_road: dict[int, Road]) -> Iterator[Box]:
    tags, highway = feature.tags, feature.tags.get("highway", "")
    place = shapely.get_coordinates(feature.geometry)[0]
    xy = place.tolist()
    if tags.get("natural") in ("tree", "shrub"):
        rng = np.random.default_rng([7308, feature.id])
        yield _make_plant(feature, tags["natural"], xy, float(rng.uniform(-np.pi, np.pi)), rng)
        return
    if highway == "street_lamp":
        yield from _make_lamp(feature, place, nearest)
        return
    if highway == "traffic_signals":
        yield from _make_signals(feature, place, on_road.get(feature.id), nearest)
        return
    if "traffic_sign" in tags or highway in SIGN_HIGHWAYS:
        label = "traffic_sign" if "traffic_sign" in tags else highway
        yield from _make_sign(feature, label, place, on_road.get(feature.id), nearest)
        return
    for key, heights in POLES.items():
        if tags.get(key) in heights:
            label = tags[key]
            height = _get_length(tags, "height", heights[label], 0.4, 40.0)
            yield _make_pole(feature, label, xy, _face_road(place, nearest), height)
            return
    for key, sizes in FURNITURE.items():
        if tags.get(key) in sizes:
            label = tags[key]
            yield Box("object", label, _as_pair(xy), _face_road(place, nearest), sizes[label], 0.0, feature.id)
            return
    if tags.get("barrier") in GATES:
        road = on_road.get(feature.id)
        width = _get_length(tags, "width", road.profile.left_m + road.profile.right_m if road else 2.0, 0.5, 15.0)
        yaw = _face_road(place, nearest) + (np.pi / 2 if road else 0.0)
        yield Box("construction_small", tags["barrier"], _as_pair(xy), yaw, (width, 0.2, 1.3), 0.0, feature.id)


def _face_road(place: np.ndarray, nearest: NearestRoads) -> float:
    """Return the direction of the nearest road, or 0."""
    found = nearest.find(place, REACH_M)
    return float(np.arctan2(found[2][1], found[2][0])) if found else 0.0


def _make_plant(feature: Feature, kind: str, xy: list[float], yaw: float, rng: np.random.Generator) -> Box:
    """Return a tree, whose crown begins above the ground, or a shrub."""
    length, width, height = draw_sizes(rng, "tree" if kind == "tree" else "bush", 1)[0].tolist()
    tags = feature.tags
    tagged = parse_length(tags.get("diameter_crown"))
    if tagged is not None and 0.5 <= tagged <= 40.0:
        length = width = tagged
    total = parse_length(tags.get("height"))
    bottom = float(rng.uniform(0.05, 0.25)) * height if kind == "tree" else 0.0
    if total is not None and 0.5 <= total <= 60.0:
        bottom = bottom / (bottom + height) * total
        height = total - bottom
    return Box("vegetation_ellipsoid", kind, _as_pair(xy), yaw, (length, width, height), bottom, feature.id)


def _make_pole(feature: Feature, label: str, xy: list[float], yaw: float, height: float) -> Box:
    side = POLE_SIDE_M if height < 8.0 else 2 * POLE_SIDE_M
    return Box("pole", label, _as_pair(xy), yaw, (side, side, height), 0.0, feature.id)


def _make_lamp(feature: Feature, place: np.ndarray, nearest: NearestRoads) -> Iterator[Box]:
    """Yield a pole, and a lamp that touches it on the side of the road."""
    rng = np.random.default_rng([7308, feature.id])
    height = _get_length(feature.tags, "height", float(draw_sizes(rng, "bigPole", 1)[0, 2]), 2.0, 15.0)
    head = draw_sizes(rng, "lamp", 1)[0]
    found = nearest.find(place, REACH_M)
    toward = found[1] - place if found else np.array([1.0, 0.0])
    toward = toward / max(float(np.hypot(*toward)), 1e-6)
    yaw = float(np.arctan2(toward[1], toward[0]))
    yield _make_pole(feature, "street_lamp", place.tolist(), yaw, height)
    x, y = (place + LAMP_REACH_M * toward).tolist()
    yield Box("traffic_control", "street_lamp", (x, y), yaw, _as_size(head), height - 0.4, feature.id)


def _make_signals(feature: Feature, place: np.ndarray, road: Road | None, nearest: NearestRoads) -> Iterator[Box]:
    """Yield poles with a signal: one per direction of travel at the kerb, or one at a place apart from a road."""
    rng = np.random.default_rng([7308, feature.id])
    for xy, yaw in _find_posts(feature, place, road, nearest, "traffic_signals:direction"):
        signal = draw_sizes(rng, "trafficLight", 1)[0]
        yield _make_pole(feature, "traffic_signals", xy, yaw, 3.4)
        yield Box(
            "traffic_control", "traffic_signals", _as_pair(xy), yaw, _as_size(signal), 3.4 - signal[2], feature.id
        )


def _make_sign(
    feature: Feature, label: str, place: np.ndarray, road: Road | None, nearest: NearestRoads
) -> Iterator[Box]:
    rng = np.random.default_rng([7308, feature.id])
    posts = _find_posts(feature, place, road, nearest, "direction")
    for xy, yaw in posts[:1]:
        sign = draw_sizes(rng, "trafficSign", 1)[0]
        yield _make_pole(feature, label, xy, yaw, 2.3)
        yield Box("traffic_control", label, _as_pair(xy), yaw, _as_size(sign), 2.2, feature.id)


def _find_posts(
    feature: Feature, place: np.ndarray, road: Road | None, nearest: NearestRoads, key: str
) -> list[tuple[list[float], float]]:
    """Return places and angles of the poles of a signal or a sign.

    On the line of a road, the result has one pole per controlled direction of travel, at the right kerb in this
    direction, also with left-hand traffic.
    """
    if road is None:
        return [(place.tolist(), _face_road(place, nearest) + np.pi / 2)]
    foot, along = sample_line(road.line, np.array([road.line.project(shapely.Point(place))]))
    stated = feature.tags.get(key, feature.tags.get("direction", ""))
    ways = {"forward": (1,), "backward": (-1,)}.get(
        stated, (1, -1) if road.profile.oneway == 0 else (road.profile.oneway,)
    )
    posts = []
    for way in ways:
        right = way * np.array([along[0, 1], -along[0, 0]])
        kerb = (road.profile.right_m if way == 1 else road.profile.left_m) + KERB_M
        posts.append(((foot[0] + kerb * right).tolist(), float(np.arctan2(right[1], right[0]))))
    return posts


def _get_length(tags: Tags, key: str, default: float, low: float, high: float) -> float:
    """Return the length that a tag states, or the default if there is none in the range."""
    value = parse_length(tags.get(key))
    return value if value is not None and low <= value <= high else default


def _as_pair(xy: Any) -> tuple[float, float]:
    return float(xy[0]), float(xy[1])


def _as_size(size: np.ndarray) -> tuple[float, float, float]:
    return float(size[0]), float(size[1]), float(size[2])
