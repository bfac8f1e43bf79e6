"""Parse OpenDRIVE files into roads. Unknown elements are skipped and counted."""

from __future__ import annotations

import gzip
import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from os import PathLike
from typing import Any
from xml.etree.ElementTree import Element, ParseError

import defusedxml
import defusedxml.ElementTree
import numpy as np

from models.limits import find_limit, require_within
from pipelines.preprocess.sources.input_paths import InputPath, find_local_file, make_input_path
from pipelines.preprocess.sources.maps import make_map_name
from pipelines.preprocess.sources.opendrive.reference_line import KINDS, NO_CUBICS, Cubics, Geometry, ReferenceLine

SUFFIXES = (".xodr", ".xodr.gz")
MAX_ROAD_M = 100_000.0
MAX_COORDINATE_M = 1e8
PARAMETERS = {
    "line": (),
    "arc": ("curvature",),
    "spiral": ("curvStart", "curvEnd"),
    "poly3": ("a", "b", "c", "d"),
    "paramPoly3": ("aU", "bU", "cU", "dU", "aV", "bV", "cV", "dV"),
}
GET_FILE = "pass an OpenDRIVE file (.xodr or .xodr.gz)"


@dataclass(frozen=True, eq=False)
class Lane:
    """A lane of a lane section.

    Attributes:
        id: Number, positive on the left of the reference line and negative on the right.
        kind: Value of the attribute type.
        width: Width by the distance from the start of the section (m).
        border: Distance of the outer border from the lane offset (m), instead of the width.
        height: Inner and outer height above the road by the distance from the start of the section (m).
        material: Name of the surface, or "".
    """

    id: int
    kind: str
    width: Cubics
    border: Cubics
    height: tuple[Cubics, Cubics]
    material: str


@dataclass(frozen=True, eq=False)
class Section:
    """A lane section.

    Attributes:
        s_m: Start along the road (m).
        end_m: End along the road (m).
        lanes: Lanes without the centre lane.
    """

    s_m: float
    end_m: float
    lanes: tuple[Lane, ...]


@dataclass(frozen=True, eq=False)
class Road:
    """A road.

    Attributes:
        id: Identifier.
        junction: Identifier of the junction that a connecting road belongs to; "" for other roads.
        drives_left: Whether traffic keeps to the left.
        line: Reference line.
        lane_offset: Distance of the centre lane from the reference line (m).
        sections: Lane sections.
        objects: Elements object.
        signals: Elements signal.
    """

    id: str
    junction: str
    drives_left: bool
    line: ReferenceLine
    lane_offset: Cubics
    sections: tuple[Section, ...]
    objects: tuple[Element, ...]
    signals: tuple[Element, ...]


@dataclass(frozen=True, eq=False)
class Map:
    """The roads of a file.

    Attributes:
        name: Name of the file without suffixes, with characters that scene ids may contain.
        projection: Text of geoReference, or "".
        attribution: Licence notice that this project's export wrote, or None.
        roads: Roads.
        skipped: Number of elements that were skipped for each reason.
    """

    name: str
    projection: str
    attribution: str | None
    roads: list[Road]
    skipped: Counter[str]


class SkippedError(ValueError):
    """Raised for an element that cannot be read. The message states the reason."""


def read_map(path: str | PathLike) -> Map:
    """Read an OpenDRIVE file.

    Args:
        path: File, possibly compressed with gzip.

    Returns:
        The roads. Roads that cannot be read are skipped and counted.

    Raises:
        ValueError: The file is no OpenDRIVE file, or it has no road that can be read.
    """
    source = make_input_path(path)
    root = _parse_xml(source)
    if root.tag != "OpenDRIVE":
        raise ValueError(f"{source} has the root element {root.tag[:40]!r}, expected 'OpenDRIVE'; {GET_FILE}")
    skipped: Counter[str] = Counter()
    roads = []
    for element in root.iter("road"):
        try:
            roads.append(_read_road(element, skipped))
        except SkippedError as error:
            skipped[str(error)] += 1
    if not roads:
        reason = f" ({next(iter(skipped))})" if skipped else ""
        raise ValueError(f"{source} has no road that can be read{reason}; {GET_FILE}")
    header = root.find("header")
    reference = header.find("geoReference") if header is not None else None
    notice = None if header is None else header.find("userData[@code='attribution']")
    attribution = None if notice is None else (notice.get("value") or "")[: find_limit("text_characters")]
    projection = " ".join((reference.text or "").split())[:500] if reference is not None else ""
    return Map(make_map_name(source, SUFFIXES), projection, attribution or None, roads, skipped)


def _parse_xml(source: InputPath) -> Element:
    if not source.is_file():  # Reading a named pipe would never end.
        raise ValueError(f"{source} is missing or is not a regular file; {GET_FILE}")
    local, limit = find_local_file(source), find_limit("json_bytes")
    try:
        with gzip.open(local) if source.name.endswith(".gz") else open(local, "rb") as stream:
            content = stream.read(limit + 1)
        require_within("json_bytes", len(content), f"{source}, decompressed")
        return defusedxml.ElementTree.fromstring(content, forbid_dtd=True)
    except (ParseError, defusedxml.DefusedXmlException, OSError, EOFError, LookupError) as error:
        raise ValueError(f"{source}: broken XML ({str(error)[:120]}); {GET_FILE}") from error


# ---------------------------------------------------------------------------------------------------- numbers


def read_number(element: Element, name: str, default: float | None = None, largest: float = MAX_COORDINATE_M) -> float:
    """Return a finite number of an attribute.

    Args:
        element: Element.
        name: Name of the attribute.
        default: Value if the attribute is absent; None: the attribute is required.
        largest: Largest absolute value.

    Returns:
        The number.

    Raises:
        SkippedError: The attribute is missing, no number, or too large.
    """
    text = element.get(name)
    if text is None and default is not None:
        return default
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not abs(value) <= largest:
        raise SkippedError(
            f"{element.tag} with {name}={(text or '')[:20]!r}, expected a finite number of at most {largest:g}"
        )
    return value


def _read_cubics(parent: Element | None, tag: str, start: str, names: str = "abcd") -> Cubics:
    """Return the piecewise polynomial of the child elements `tag`."""
    found = [] if parent is None else parent.findall(tag)
    if not found:
        return NO_CUBICS
    rows = np.array([[read_number(e, start, 0.0), *(read_number(e, n, 0.0) for n in names)] for e in found])
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    return Cubics(rows[:, 0], rows[:, 1:])


# ------------------------------------------------------------------------------------------------------ roads


def _read_road(element: Element, skipped: Counter[str]) -> Road:
    length = read_number(element, "length", largest=MAX_ROAD_M)
    plan, lanes = element.find("planView"), element.find("lanes")
    pieces = [] if plan is None else [_read_geometry(child) for child in plan.findall("geometry")]
    pieces = sorted((piece for piece in pieces if piece.length_m > 0), key=lambda piece: piece.s_m)
    if not pieces or length <= 0:
        raise SkippedError("road without a reference line")
    sections = _read_sections(lanes, length)
    if not any(section.lanes for section in sections):
        raise SkippedError("road without lanes")
    for child in element:
        if child.tag not in KNOWN:
            skipped[f"element {str(child.tag)[:40]} of a road"] += 1
    line = ReferenceLine(
        length,
        tuple(pieces),
        _read_cubics(element.find("elevationProfile"), "elevation", "s"),
        _read_cubics(element.find("lateralProfile"), "superelevation", "s"),
    )
    junction = element.get("junction", "-1")
    return Road(
        id=str(element.get("id", ""))[:100],
        junction="" if junction == "-1" else junction[:100],
        drives_left=element.get("rule", "RHT") == "LHT",
        line=line,
        lane_offset=_read_cubics(lanes, "laneOffset", "s"),
        sections=sections,
        objects=tuple(element.findall("objects/object")),
        signals=tuple(element.findall("signals/signal")),
    )


KNOWN = (
    *("link", "type", "planView", "elevationProfile", "lateralProfile", "lanes", "objects", "signals"),
    *("surface", "railroad", "userData", "include", "dataQuality"),
)


def _read_geometry(element: Element) -> Geometry:
    kind = next((child for child in element if child.tag in KINDS), None)
    if kind is None:
        known = ", ".join(KINDS)
        raise SkippedError(f"road with a geometry of none of the kinds {known}")
    values: tuple[float, ...] = tuple(read_number(kind, name) for name in PARAMETERS[kind.tag])
    if kind.tag == "paramPoly3":
        values += (float(kind.get("pRange", "normalized") != "arcLength"),)
    x, y = read_number(element, "x"), read_number(element, "y")
    s, length = read_number(element, "s"), read_number(element, "length", largest=MAX_ROAD_M)
    return Geometry(kind.tag, s, x, y, read_number(element, "hdg"), length, values)


def _read_sections(lanes: Element | None, length: float) -> tuple[Section, ...]:
    found = [] if lanes is None else lanes.findall("laneSection")
    starts = [read_number(section, "s", 0.0) for section in found]
    order = sorted(range(len(found)), key=starts.__getitem__)
    ends = [*(starts[k] for k in order[1:]), length]
    return tuple(
        Section(starts[k], min(end, length), tuple(_read_lanes(found[k])))
        for k, end in zip(order, ends, strict=True)
        if min(end, length) > starts[k]
    )


def _read_lanes(section: Element) -> Iterable[Lane]:
    for lane in (*section.findall("left/lane"), *section.findall("right/lane")):
        number = int(read_number(lane, "id", largest=1000))
        if not number:
            continue
        material: Any = lane.find("material")
        yield Lane(
            id=number,
            kind=lane.get("type", "none"),
            width=_read_cubics(lane, "width", "sOffset"),
            border=_read_cubics(lane, "border", "sOffset"),
            height=(_read_steps(lane, "inner"), _read_steps(lane, "outer")),
            material="" if material is None else str(material.get("surface", ""))[:40],
        )


def _read_steps(lane: Element, name: str) -> Cubics:
    """Return the heights of a lane, which are constant between records."""
    found = lane.findall("height")
    if not found:
        return NO_CUBICS
    rows = np.array([[read_number(e, "sOffset", 0.0), read_number(e, name, 0.0), 0.0, 0.0, 0.0] for e in found])
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    return Cubics(rows[:, 0], rows[:, 1:])
