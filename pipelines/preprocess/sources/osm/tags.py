"""Interpret the tags of OpenStreetMap: widths of roads, heights of buildings, and classes of areas.

The meaning of the tags follows the OpenStreetMap wiki (Key:width, Key:lanes, Key:building:levels, Street parking,
Sidewalks, Simple 3D Buildings). Values for missing tags are usual dimensions of European streets.
"""

from __future__ import annotations

import re
from typing import NamedTuple

Tags = dict[str, str]

FOOT_M, INCH_M = 0.3048, 0.0254
LEVEL_M = 3.0

# Width of a lane of each class of road (m).
LANE_M = {
    "motorway": 3.75,
    "trunk": 3.5,
    "primary": 3.5,
    "secondary": 3.25,
    "tertiary": 3.0,
    "unclassified": 2.75,
    "residential": 2.75,
    "living_street": 2.5,
    "road": 2.75,
    "busway": 3.5,
    "service": 2.25,
}
STREETS = tuple(name for name in LANE_M if name not in ("service", "busway", "motorway"))  # Poses lie on them.
FAST_ROADS = ("motorway", "trunk")  # Each direction has two lanes and a separate way.
MIN_ROAD_M, MAX_ROAD_M = 2.0, 40.0
ONE_LANE_M = 3.5  # Least width of a road with one lane.
# Ways of people who walk or cycle, their ground class, and their width (m).
PATHS = {
    "footway": ("sidewalk", 2.0),
    "pedestrian": ("sidewalk", 4.0),
    "cycleway": ("sidewalk", 2.0),
    "steps": ("sidewalk", 2.0),
    "path": ("ground", 1.5),
    "bridleway": ("ground", 2.0),
    "track": ("ground", 2.75),
}
SIDEWALK_M = 2.0
# Depth of parking spaces at the kerb (m).
PARKING_M = {"parallel": 2.2, "diagonal": 4.5, "perpendicular": 5.0}
YES = ("yes", "true", "1")

# Ground class of areas; the first key that matches decides. "" hides the ground below (water).
AREA_CLASSES = {
    "amenity": {"parking": "parking", "bicycle_parking": "sidewalk", "motorcycle_parking": "parking"},
    "natural": {
        "water": "",
        **dict.fromkeys(("wood", "scrub", "grassland", "heath", "fell", "wetland", "tree_group"), "terrain"),
        **dict.fromkeys(("sand", "beach", "bare_rock", "scree", "shingle"), "ground"),
    },
    "leisure": {
        **dict.fromkeys(("park", "garden", "golf_course", "dog_park", "nature_reserve"), "terrain"),
        **dict.fromkeys(("pitch", "playground", "track"), "ground"),
        "swimming_pool": "",
    },
    "landuse": {
        **dict.fromkeys(
            (
                "allotments",
                "cemetery",
                "farmland",
                "flowerbed",
                "forest",
                "grass",
                "greenfield",
                "meadow",
                "orchard",
                "plant_nursery",
                "recreation_ground",
                "village_green",
                "vineyard",
            ),
            "terrain",
        ),
        **dict.fromkeys(("railway", "depot"), "ground"),
        **dict.fromkeys(("basin", "reservoir"), ""),
    },
}

# Height of buildings without tags for height and levels (m); other buildings have two levels.
BUILDING_M = {
    **dict.fromkeys(("garage", "garages", "carport", "shed", "hut", "kiosk", "roof", "greenhouse"), 2.8),
    "apartments": 5 * LEVEL_M,
    "church": 15.0,
    "cathedral": 30.0,
    "industrial": 8.0,
    "warehouse": 8.0,
    "hotel": 5 * LEVEL_M,
    "office": 4 * LEVEL_M,
}
GARAGES = ("garage", "garages", "carport", "shed", "hut")
MAX_BUILDING_M = 400.0


def parse_length(text: str | None) -> float | None:
    """Return a length in metres, such as 3.5, "3,5 m", "350 cm", "12 ft" or 12'6"; None if the text is no length."""
    if not text:
        return None
    text = text.strip().replace(",", ".")
    if match := re.fullmatch(r"(\d+(?:\.\d+)?)'(?:\s*(\d+(?:\.\d+)?)\")?", text):
        return float(match[1]) * FOOT_M + float(match[2] or 0) * INCH_M
    if match := re.fullmatch(r"(\d+(?:\.\d+)?)\s*(m|meter|metre|cm|ft|km)?", text.lower()):
        return float(match[1]) * {"cm": 0.01, "ft": FOOT_M, "km": 1000.0}.get(match[2] or "", 1.0)
    return None


def parse_count(text: str | None) -> float | None:
    """Return the first number of a text such as "2" or "2;3"; None if there is none."""
    match = re.match(r"\s*(\d+(?:\.\d+)?)", text or "")
    return float(match[1]) if match else None


def is_underground(tags: Tags) -> bool:
    """Return whether a feature lies in a tunnel, below the ground or inside a building."""
    tunnel, level = tags.get("tunnel", "no"), tags.get("layer", "0")
    return (
        tunnel not in ("no", "building_passage", "passage", "arcade")
        or tags.get("location") == "underground"
        or (level.startswith("-") and tags.get("bridge", "no") == "no" and "building" not in tags)
        or tags.get("indoor", "no") != "no"
    )


class Profile(NamedTuple):
    """Cross-section of a road. Sides are those of a viewer who looks along the way.

    Attributes:
        highway: Class without the suffix _link.
        ground: Ground class of the carriageway.
        left_m: Distance from the line of the way to the left kerb, or to the parking spaces there (m).
        right_m: The same on the right.
        parking_m: Depth of parking spaces on the left and on the right (m).
        sidewalk_m: Width of the sidewalks on the left and on the right (m); 0: none is known.
        knows_sidewalk: Whether tags state that the left and the right side have, or do not have, a sidewalk.
        oneway: 1 along the way, -1 against it, 0 for both directions.
        has_width: Whether the width follows from the tag width or lanes.
    """

    highway: str
    ground: str
    left_m: float
    right_m: float
    parking_m: tuple[float, float]
    sidewalk_m: tuple[float, float]
    knows_sidewalk: tuple[bool, bool]
    oneway: int
    has_width: bool


def find_profile(tags: Tags) -> Profile | None:
    """Return the cross-section of a road; None for ways that vehicles do not use, and for areas."""
    highway = tags.get("highway", "")
    base = highway.removesuffix("_link")
    if base not in LANE_M or tags.get("area") in YES:
        return None
    oneway = _find_oneway(tags, highway)
    parking = _find_parking(tags)
    width, has_width = _find_width(tags, base, bool(oneway), highway != base)
    left = right = width / 2
    if "width" in tags:  # The tag includes parking lanes on the carriageway.
        inside = tuple(depth if _get_side(tags, "parking", k) == "lane" else 0.0 for k, depth in enumerate(parking))
        if width - sum(inside) >= MIN_ROAD_M:
            left, right = left - inside[0], right - inside[1]
    ground = "parking" if tags.get("service") in ("driveway", "parking_aisle") else "road"
    sidewalks, knows = _find_sidewalks(tags)
    return Profile(base, ground, left, right, parking, sidewalks, knows, oneway, has_width)


def _find_oneway(tags: Tags, highway: str) -> int:
    text = tags.get("oneway", "")
    if text in ("-1", "reverse"):
        return -1
    if text in YES or (not text and (tags.get("junction") in ("roundabout", "circular") or highway == "motorway")):
        return 1
    return 0


def _find_width(tags: Tags, base: str, oneway: bool, is_link: bool) -> tuple[float, bool]:
    """Return the width of the carriageway, and whether a tag states it."""
    tagged = parse_length(tags.get("width"))
    if tagged is not None and MIN_ROAD_M <= tagged <= MAX_ROAD_M:
        return tagged, True
    lanes = parse_count(tags.get("lanes"))
    has_lanes = lanes is not None and 1 <= lanes <= 12
    if not has_lanes:
        lanes = 1.0 if is_link or (oneway and base not in FAST_ROADS) or tags.get("service") else 2.0
    width = (lanes or 1.0) * LANE_M[base]
    if base != "service":
        width = max(width, ONE_LANE_M)
    elif lanes == 1.0:
        width = 3.0
    return min(width, MAX_ROAD_M), has_lanes


def _get_side(tags: Tags, key: str, side: int) -> str | None:
    """Return the value of key:left or key:right, or else of key:both."""
    return tags.get(f"{key}:{('left', 'right')[side]}", tags.get(f"{key}:both"))


def _find_parking(tags: Tags) -> tuple[float, float]:
    """Return the depth of parking spaces on the left and on the right."""

    def find(side: int) -> float:
        where, former = _get_side(tags, "parking", side), _get_side(tags, "parking:lane", side)
        if where in ("lane", "street_side", "half_on_kerb", "on_kerb", "shoulder", "yes"):
            name = ("left", "right")[side]
            way = tags.get(f"parking:{name}:orientation", tags.get("parking:both:orientation", "parallel"))
            return PARKING_M.get(way, PARKING_M["parallel"])
        return PARKING_M.get(former or "", 0.0)

    return find(0), find(1)


def _find_sidewalks(tags: Tags) -> tuple[tuple[float, float], tuple[bool, bool]]:
    """Return the widths of the sidewalks, and whether tags state that they exist or do not exist."""
    general = tags.get("sidewalk", "")

    def find(side: int) -> tuple[float, bool]:
        name = ("left", "right")[side]
        own = _get_side(tags, "sidewalk", side)
        if own is None and not general:
            return 0.0, False
        exists = own in YES if own is not None else general in ("both", "yes", name)
        width = parse_length(tags.get(f"sidewalk:{name}:width", tags.get("sidewalk:both:width"))) or SIDEWALK_M
        return (min(width, 10.0) if exists else 0.0), True

    (left, knows_left), (right, knows_right) = find(0), find(1)
    return (left, right), (knows_left, knows_right)


def find_path(tags: Tags) -> tuple[str, float] | None:
    """Return the ground class and the width of a way for people who walk or cycle; None for other ways."""
    found = PATHS.get(tags.get("highway", ""))
    if found is None or tags.get("area") in YES or tags.get("footway") == "crossing":
        return None
    width = parse_length(tags.get("width"))
    return found[0], width if width is not None and 0.5 <= width <= MAX_ROAD_M else found[1]


def find_area_class(tags: Tags) -> str | None:
    """Return the ground class of an area, "" for water, None for areas without a ground class."""
    marked = tags.get("area:highway")
    if marked is not None:
        base = marked.removesuffix("_link")
        if base in LANE_M or marked == "traffic_island":
            return "sidewalk" if marked == "traffic_island" else "road"
        return PATHS[marked][0] if marked in PATHS else None
    if "highway" in tags:
        highway = tags["highway"]
        if tags.get("area") in YES or highway in ("pedestrian", "rest_area"):
            return "road" if highway in LANE_M else PATHS.get(highway, ("sidewalk",))[0]
        return None
    if tags.get("amenity") == "parking" and tags.get("parking") in ("underground", "multi-storey", "rooftop"):
        return None
    for key, classes in AREA_CLASSES.items():
        if tags.get(key) in classes:
            return classes[tags[key]]
    return None


class Heights(NamedTuple):
    """Lowest and highest point of a building above the ground (m), and whether tags state the highest point."""

    bottom_m: float
    top_m: float
    is_known: bool


def find_heights(tags: Tags) -> Heights:
    """Return the vertical extent of a building or of a part of a building (wiki: Simple 3D Buildings)."""
    kind = tags.get("building:part", "yes")
    kind = tags.get("building", "yes") if kind in ("yes", "no") else kind
    bottom = parse_length(tags.get("min_height"))
    if bottom is None:
        bottom = LEVEL_M * (parse_count(tags.get("building:min_level")) or 0.0)
    top = parse_length(tags.get("height"))
    levels, roof = parse_count(tags.get("building:levels")), parse_count(tags.get("roof:levels")) or 0.0
    is_known = top is not None or levels is not None
    if top is None:
        top = LEVEL_M * (levels + 0.7 * roof) if levels is not None else BUILDING_M.get(kind, 2 * LEVEL_M)
    top = min(max(top, 2.0), MAX_BUILDING_M)
    return Heights(min(bottom, top - 1.0) if bottom > 0 else 0.0, top, is_known)
