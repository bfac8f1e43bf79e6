"""Objects and signals of OpenDRIVE roads as boxes and ellipsoids."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
import shapely

from models.scene import make_yaw_rotation
from pipelines.preprocess.sources.opendrive.file import Map, Road, SkippedError, read_number
from pipelines.preprocess.sources.osm.buildings import cover_footprint, repair_polygons

PIECE_M = 10.0  # Longest piece of a wall, fence or hedge.
MAX_PIECES = 2_000  # Pieces of one object.
MIN_SIZE_M, MAX_SIZE_M = 0.05, 500.0
SIGN_M = (0.1, 0.7, 0.7)  # Length, width and height of signs and signals without a size.
LIGHT_M = (0.3, 0.3, 0.9)
POLE_REACH_M = 1.0  # A signal farther than this from every pole gets a pole.
LOW_SIGNAL_M = 0.5  # Signals below this height are marks on the road.

PARKING = ("parkingSpace", "parking")  # Standard type, and type in the maps of CARLA.

# Category of each value of the attribute type (OpenDRIVE 1.4 to 1.8).
TYPES = {
    "building": "construction_big",
    "tree": "vegetation_ellipsoid",
    "vegetation": "vegetation_cuboid",
    "barrier": "construction_small",
    "railing": "construction_small",
    "soundBarrier": "construction_small",
    "gantry": "pole",
    "pole": "pole",
    "streetLamp": "pole",
    "obstacle": "object",
    "car": "vehicle_small",
    "van": "vehicle_small",
    "trailer": "vehicle_small",
    "bus": "vehicle_big",
    "train": "vehicle_big",
    "tram": "vehicle_big",
    "bike": "two_wheelers",
    "motorbike": "two_wheelers",
    "pedestrian": "human",
}
# Default length, width and height of each category (m).
SIZES = {
    "construction_big": (10.0, 10.0, 6.0),
    "vegetation_ellipsoid": (5.0, 5.0, 7.0),
    "vegetation_cuboid": (2.0, 2.0, 1.5),
    "construction_small": (2.0, 0.3, 1.2),
    "pole": (0.2, 0.2, 4.0),
    "object": (1.0, 0.7, 1.0),
    "vehicle_small": (4.4, 1.9, 1.5),
    "vehicle_big": (11.0, 2.6, 3.0),
    "two_wheelers": (1.9, 0.7, 1.3),
    "human": (0.6, 0.6, 1.75),
}
LAMP_NAMES = ("streetLamp", "street_lamp", "lamp")
CROWN_RATIO = 0.55  # Diameter of a crown without a size, divided by the height of the tree.
TRUNK_M = 0.5  # A radius up to this value is that of the trunk.


class Box(NamedTuple):
    """A box or ellipsoid.

    Attributes:
        category: Name of the category.
        label: Attribute name or type of the object.
        center_m: Centre in the inertial frame (m).
        yaw_rad: Angle from x to the length axis.
        size_m: Length, width and height (m).
    """

    category: str
    label: str
    center_m: tuple[float, float, float]
    yaw_rad: float
    size_m: tuple[float, float, float]


class MapObjects(NamedTuple):
    """Objects of a map.

    Attributes:
        boxes: Boxes and ellipsoids.
        footprints: Footprints of buildings (m).
        parking: Outlines of parking spaces with heights (n, 3) (m).
        iou: Area of the intersection of boxes and footprint divided by that of their union, for each building.
    """

    boxes: list[Box]
    footprints: list[Any]
    parking: list[np.ndarray]
    iou: list[float]


def make_objects(roads: Map, skipped: Counter[str]) -> MapObjects:
    """Return the objects and signals of all roads.

    Args:
        roads: Map.
        skipped: Number of elements that were skipped for each reason; changed in place.

    Returns:
        Boxes, footprints and parking spaces.
    """
    found = MapObjects([], [], [], [])
    for road in roads.roads:
        for element in road.objects:
            try:
                _add_object(road, element, found, skipped)
            except SkippedError as error:
                skipped[str(error)] += 1
    poles = np.array([box.center_m[:2] for box in found.boxes if box.category == "pole"]).reshape(-1, 2)
    for road in roads.roads:
        for element in road.signals:
            try:
                found.boxes.extend(_make_signal(road, element, poles))
            except SkippedError as error:
                skipped[str(error)] += 1
    return found


# ----------------------------------------------------------------------------------------------------- objects


def _add_object(road: Road, element: Element, found: MapObjects, skipped: Counter[str]) -> None:
    kind, name = element.get("type", "none"), element.get("name", "")
    outline = _read_outline(road, element)
    if kind in PARKING:
        found.parking.append(_make_rectangle(road, element) if outline is None else outline)
        return
    category = TYPES.get(kind)
    if category is None:
        skipped[f"object of type {kind[:40]}"] += 1
        return
    label = (name or kind)[:100]
    if category == "construction_big" and outline is not None and len(outline) >= 3:
        _add_building(element, label, outline, found)
        return
    repeats = element.findall("repeat")
    if repeats:
        for repeat in repeats:
            found.boxes.extend(_make_repeated(road, element, repeat, category, label))
        return
    if category == "construction_small" and outline is not None:
        found.boxes.extend(_make_pieces(outline, category, label, 0.2, _read_height(element, category)))
        return
    found.boxes.extend(_make_single(road, element, category, label, outline))


def _find_place(road: Road, element: Element) -> tuple[np.ndarray, float]:
    """Return the foot (3,) of an object in the inertial frame, and the direction of its length axis."""
    s = read_number(element, "s")
    t, z = read_number(element, "t"), read_number(element, "zOffset", 0.0)
    at = np.array([min(max(s, 0.0), road.line.length_m)])
    _, direction = road.line.evaluate(at)
    foot = road.line.place(at, np.array([t]))[0]
    # Some files state the height above sea level instead of the height above the road.
    foot[2] += z if abs(z) < 100.0 else 0.0
    return foot, float(direction[0]) + read_number(element, "hdg", 0.0)


def _make_rectangle(road: Road, element: Element) -> np.ndarray:
    """Return the corners (4, 3) of an object that has a length and a width (m)."""
    foot, yaw = _find_place(road, element)
    along, across = (read_number(element, name) / 2 for name in ("length", "width"))
    if not (MIN_SIZE_M < 2 * along < MAX_SIZE_M and MIN_SIZE_M < 2 * across < MAX_SIZE_M):
        raise SkippedError("parking space without a size")
    corners = np.array([[along, across, 0], [-along, across, 0], [-along, -across, 0], [along, -across, 0]])
    return foot + corners @ make_yaw_rotation(yaw).T


def _read_height(element: Element, category: str) -> float:
    height = read_number(element, "height", 0.0)
    return height if MIN_SIZE_M < height < MAX_SIZE_M else SIZES[category][2]


def _make_single(road: Road, element: Element, category: str, label: str, outline: np.ndarray | None) -> Iterator[Box]:
    foot, yaw = _find_place(road, element)
    height = _read_height(element, category)
    length, width = read_number(element, "length", 0.0), read_number(element, "width", 0.0)
    radius = read_number(element, "radius", 0.0)
    if category == "vegetation_ellipsoid" and radius <= TRUNK_M and not length:
        length = width = CROWN_RATIO * height
    elif radius > 0 and not length:
        length = width = 2 * radius
    if outline is not None and len(outline) >= 3 and not length:
        cover = cover_footprint(shapely.MultiPoint(outline[:, :2]).convex_hull.buffer(0.01))
        foot[:2], yaw = cover.center_m[0], cover.yaw_rad
        length, width = cover.size_m[0].tolist()
    default = SIZES[category]
    length = length if MIN_SIZE_M < length < MAX_SIZE_M else default[0]
    width = width if MIN_SIZE_M < width < MAX_SIZE_M else default[1]
    if category == "pole":
        length, width = max(length, 0.1), max(width, 0.1)
    bottom = 0.15 * height if category == "vegetation_ellipsoid" else 0.0
    center = (float(foot[0]), float(foot[1]), float(foot[2]) + (bottom + height) / 2)
    yield Box(category, label, center, yaw, (length, width, height - bottom))
    if label in LAMP_NAMES or element.get("type") == "streetLamp":
        top = (center[0], center[1], float(foot[2]) + height)
        yield Box("traffic_control", label, top, yaw, (0.8, 0.3, 0.3))


def _make_repeated(road: Road, element: Element, repeat: Element, category: str, label: str) -> Iterator[Box]:
    """Yield the copies of an object along a road; distance 0 means one continuous object."""
    start, length = read_number(repeat, "s"), read_number(repeat, "length")
    distance = read_number(repeat, "distance", 0.0)
    continuous = distance <= 0
    count = int(np.ceil(length / PIECE_M)) if continuous else int(length // distance) + 1
    if length < 0:
        raise SkippedError("repeat with a negative length")
    if count > MAX_PIECES:
        raise SkippedError(f"repeat with more than {MAX_PIECES} copies")
    if not count:
        return
    ends = np.linspace(0.0, 1.0, count + 1)
    share = ends if continuous else np.arange(count) * distance / max(length, 1e-9)

    def blend(name: str, default: float) -> np.ndarray:
        first = read_number(repeat, f"{name}Start", default)
        return first + share * (read_number(repeat, f"{name}End", first) - first)

    s = (start + share * length).clip(0.0, road.line.length_m)
    t, z = blend("t", read_number(element, "t", 0.0)), blend("zOffset", read_number(element, "zOffset", 0.0))
    height = blend("height", _read_height(element, category)).clip(MIN_SIZE_M, MAX_SIZE_M)
    width = blend("width", SIZES[category][1]).clip(0.1, 20.0)
    points = road.line.place(s, t, np.where(np.abs(z) < 100.0, z, 0.0))
    if continuous:
        yield from _make_pieces(points, category, label, float(width.mean()), float(height.mean()))
        return
    extent = read_number(element, "length", SIZES[category][0])
    _, direction = road.line.evaluate(s)
    extent = min(max(extent, MIN_SIZE_M), MAX_SIZE_M)
    for k, (x, y, z) in enumerate(points.tolist()):
        size = (extent, float(width[k]), float(height[k]))
        yield Box(category, label, (x, y, z + size[2] / 2), float(direction[k]), size)


def _make_pieces(points: np.ndarray, category: str, label: str, width: float, height: float) -> Iterator[Box]:
    """Yield boxes along a polyline (n, 3)."""
    for a, b in zip(points[:-1], points[1:], strict=True):
        length = float(np.hypot(*(b - a)[:2]))
        if length < MIN_SIZE_M:
            continue
        x, y, z = ((a + b) / 2).tolist()
        yaw = float(np.arctan2(*(b - a)[1::-1]))
        yield Box(category, label, (x, y, z + height / 2), yaw, (length, width, height))


def _read_outline(road: Road, element: Element) -> np.ndarray | None:
    """Return the corners (n, 3) of the first outline in the inertial frame; None if there is none."""
    outline = element.find("outline")
    if outline is None:
        outline = element.find("outlines/outline")
    if outline is None:
        return None
    corners = outline.findall("cornerRoad")
    if corners:
        rows = np.array([[read_number(c, "s"), read_number(c, "t"), read_number(c, "dz", 0.0)] for c in corners])
        at = rows[:, 0].clip(0.0, road.line.length_m)
        order = np.argsort(at, kind="stable")
        points = np.empty((len(rows), 3))
        points[order] = road.line.place(at[order], rows[order, 1], rows[order, 2])
    else:
        local = outline.findall("cornerLocal")
        if not local:
            return None
        rows = np.array([[read_number(c, "u"), read_number(c, "v"), read_number(c, "z", 0.0)] for c in local])
        foot, yaw = _find_place(road, element)
        points = rows @ make_yaw_rotation(yaw).T + foot
    if len(points) > 1 and np.allclose(points[0], points[-1], atol=1e-4):
        points = points[:-1]
    return points


def _add_building(element: Element, label: str, outline: np.ndarray, found: MapObjects) -> None:
    polygons, _ = repair_polygons([shapely.Polygon(outline[:, :2])])
    footprint = polygons[0] if polygons[0].area >= 1.0 else shapely.MultiPoint(outline[:, :2]).convex_hull
    if footprint.geom_type not in ("Polygon", "MultiPolygon") or footprint.area < 1.0:
        raise SkippedError("building with an outline without area")
    cover = cover_footprint(footprint)
    corners = [*element.iter("cornerRoad"), *element.iter("cornerLocal")]
    tallest = max((read_number(corner, "height", 0.0) for corner in corners), default=0.0)
    height = tallest if MIN_SIZE_M < tallest < MAX_SIZE_M else _read_height(element, "construction_big")
    bottom = float(outline[:, 2].min())
    for (x, y), (along, across) in zip(cover.center_m.tolist(), cover.size_m.tolist(), strict=True):
        size = (max(along, MIN_SIZE_M), max(across, MIN_SIZE_M), height)
        found.boxes.append(Box("construction_big", label, (x, y, bottom + height / 2), cover.yaw_rad, size))
    found.footprints.append(footprint)
    found.iou.append(cover.iou)


# ----------------------------------------------------------------------------------------------------- signals


def _make_signal(road: Road, element: Element, poles: np.ndarray) -> Iterator[Box]:
    """Yield the box of a signal, and a pole if none is near."""
    foot, yaw = _find_place(road, element)
    height_above = read_number(element, "zOffset", 0.0)
    if height_above < LOW_SIGNAL_M:
        return
    is_light = element.get("dynamic") == "yes"
    default = LIGHT_M if is_light else SIGN_M
    width, height = read_number(element, "width", 0.0), read_number(element, "height", 0.0)
    width = width if MIN_SIZE_M < width < 20.0 else default[1]
    height = height if MIN_SIZE_M < height < 20.0 else default[2]
    yaw += read_number(element, "hOffset", 0.0)
    label = "traffic_light" if is_light else "traffic_sign"
    center = (float(foot[0]), float(foot[1]), float(foot[2]) + height / 2)
    yield Box("traffic_control", label, center, yaw, (default[0], width, height))
    near = len(poles) and np.hypot(*(poles - foot[:2]).T).min() < POLE_REACH_M
    if not near and height_above < 8.0:
        pole_m = height_above + height
        base = float(foot[2]) - height_above
        yield Box("pole", label, (center[0], center[1], base + pole_m / 2), yaw, (0.12, 0.12, pole_m))
