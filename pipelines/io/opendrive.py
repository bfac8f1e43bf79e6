"""Export the roads of a Scene as ASAM OpenDRIVE 1.7: reference lines, elevation, lanes, kerbs and junctions.

Each road of centerlines.py becomes an OpenDRIVE road with at least one driving lane per side. The reference line of a
road consists of cubic curves through points of the centreline. The lanes end at the border of the road's polygon
(geometry/ground_polygons.py). Where a sidewalk adjoins, the border is a kerb and the sidewalk is a lane. Roads end
before a node. At each node, a connecting road leads from each road to every other road. The inertial frame of OpenDRIVE
is the scene frame. The offset in the header is the position of the scene in the world frame. Traffic keeps to the
right.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Any

import numpy as np
import shapely
from scipy.interpolate import CubicSpline

from models.scene import ROAD_CLASSES, Grid, Scene
from pipelines.geometry.centerlines import Road, RoadNetwork, extract_road_network
from pipelines.geometry.ground_polygons import build_ground_polygons
from pipelines.schema.file_names import clean_xml_text

KNOT_M = 5.0  # Distance between points of a reference line.
LANE_M = 3.5  # Approximate lane width, which determines the number of lanes per side.
LEAST_ROAD_M = 2.0  # Minimum length of a road between two junctions.
CLEAR = 1.3  # Distance from a node to the road ends, as a multiple of the half width of the widest road.
WIDEST = 1.15  # Largest width of a side, as a multiple of half the usual width of the road. Forks are wider.
NARROWEST = 0.5  # Smallest width of a side, as such a multiple.
SIDEWALK_M = (0.8, 6.0)  # Smallest median width and largest width of a sidewalk lane.
KERB_M = 0.12  # Height of a sidewalk lane above the road.
MAX_PX = 2048  # Larger scenes are divided into parts of this side, because polygons need about 200 bytes per pixel.
SAMPLES = 64  # Number of samples that measure the length of a cubic curve.


@dataclass(frozen=True, eq=False)
class ReferenceLine:
    """A smooth curve through k knots.

    The curve parameter is the cumulative chord length.

    Attributes:
        curve: Map from cumulative chord length to x, y and z in the scene frame (m).
        breaks: Cumulative chord length at each knot (m).
        lengths_m: Length of the curve between successive knots, seen from above (m).
        sides_m: Width of the left and the right side of the road at each knot (m).
        sidewalks_m: Width of the left and the right sidewalk at each knot (m); 0: there is none.
    """

    curve: CubicSpline
    breaks: np.ndarray  # (k,)
    lengths_m: np.ndarray  # (k - 1,)
    sides_m: np.ndarray  # (k, 2)
    sidewalks_m: np.ndarray  # (k, 2)

    @staticmethod
    def through(xyz_m: np.ndarray, sides_m: np.ndarray, tangents: np.ndarray | None = None) -> ReferenceLine:
        """Fit a curve through points.

        Args:
            xyz_m: (k, 3) points in the scene frame (m), k >= 2.
            sides_m: (k, 2) width of the left and the right side of the road at the points (m).
            tangents: (2, 2) unit directions at the first and last point, seen from above. None: the directions at the
                ends are free.

        Returns:
            The curve.
        """
        breaks = np.append(0, np.cumsum(np.linalg.norm(np.diff(xyz_m[:, :2], axis=0), axis=1)))
        # scipy's annotation allows only a string, but its documentation also allows tuples.
        ends: Any = "natural" if len(xyz_m) > 2 else "not-a-knot"
        if tangents is not None:
            slope = (xyz_m[-1, 2] - xyz_m[0, 2]) / breaks[-1]
            ends = tuple((1, np.append(tangent, slope)) for tangent in tangents)
        curve = CubicSpline(breaks, xyz_m, bc_type=ends)
        at = breaks[:-1, None] + np.diff(breaks)[:, None] * (np.arange(SAMPLES) + 0.5) / SAMPLES
        speed = np.linalg.norm(curve(at, 1)[..., :2], axis=-1)
        return ReferenceLine(curve, breaks, speed.mean(axis=1) * np.diff(breaks), sides_m, np.zeros_like(sides_m))

    @property
    def width_m(self) -> np.ndarray:
        """Width of the whole road at each knot (k,), in metres."""
        return self.sides_m.sum(axis=1)

    @property
    def length_m(self) -> float:
        """Length seen from above (m)."""
        return float(self.lengths_m.sum())

    @property
    def starts_m(self) -> np.ndarray:
        """Length of the line up to each knot (k,), in metres."""
        return np.append(0, np.cumsum(self.lengths_m))

    def end(self, which: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the position and direction of the line at one end.

        Args:
            which: 0 for the first point, -1 for the last point.

        Returns:
            Point (3,) in the scene frame (m), and unit direction (2,) along the line.
        """
        direction = self.curve(self.breaks[which], 1)[:2]
        return self.curve(self.breaks[which]), direction / np.linalg.norm(direction)


def fit_reference_lines(network: RoadNetwork, scene: Scene) -> list[ReferenceLine]:
    """Fit a curve to each road, and measure its sides and sidewalks along the curve.

    Roads are shortened at junctions.

    Args:
        network: Roads and nodes of the scene.
        scene: Scene whose ground has the borders of the roads.

    Returns:
        One curve per road, in the order of the roads.
    """
    clear_m = [
        CLEAR * max(float(np.median(road.width_m)) for road in network.list_leaving(node)) / 2
        for node in range(len(network.nodes_m))
    ]
    roads, sidewalks = _build_street_polygons(scene)
    lines = []
    for road in network.roads:
        line = _shorten_road(road, *(clear_m[node] if node >= 0 else 0.0 for node in (road.start, road.end)))
        lines.append(_fit_sides(line, *(_cut_near_road(parts, line) for parts in (roads, sidewalks))))
    return lines


def _cut_near_road(parts: np.ndarray, line: ReferenceLine) -> shapely.Geometry:
    """Return the area of polygons that the rays of `_fit_sides` can reach: whole cities have very large polygons."""
    place = line.curve(line.breaks)[:, :2]
    margin_m = 2 * WIDEST * float(np.median(line.width_m)) + SIDEWALK_M[1]
    bounds = *(place.min(axis=0) - margin_m), *(place.max(axis=0) + margin_m)
    return shapely.union_all(shapely.make_valid(shapely.clip_by_rect(parts, *bounds)))


def _build_street_polygons(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the polygons of the roads and of the sidewalks of each part of a scene."""
    grid, size_m = scene.grid, scene.grid.resolution_m
    roads, sidewalks = [], []
    for row in range(0, grid.rows, MAX_PX):
        for col in range(0, grid.cols, MAX_PX):
            counts = min(MAX_PX, grid.rows - row), min(MAX_PX, grid.cols - col)
            part = Grid(grid.front_m - row * size_m, grid.left_m - col * size_m, size_m, *counts)
            shapes = build_ground_polygons(scene.crop(part))
            roads += [shapes[name] for name in ROAD_CLASSES if name in shapes]
            sidewalks += [shapes["sidewalk"]] if "sidewalk" in shapes else []
    return np.array(roads, object), np.array(sidewalks, object)


def _shorten_road(road: Road, from_start_m: float, from_end_m: float) -> ReferenceLine:
    along = np.append(0, np.cumsum(np.linalg.norm(np.diff(road.xyz_m[:, :2], axis=0), axis=1)))
    spare_m = max(along[-1] - LEAST_ROAD_M, 0) / max(from_start_m + from_end_m, 1e-9)
    low, high = from_start_m * min(1, spare_m), along[-1] - from_end_m * min(1, spare_m)
    at = np.linspace(low, high, max(2, round((high - low) / KNOT_M) + 1))
    xyz_m = np.stack([np.interp(at, along, road.xyz_m[:, axis]) for axis in range(3)], axis=1)
    usual_m = np.median(road.width_m)  # At a fork, the mask is wider than each of the roads.
    width_m = np.interp(at, along, np.minimum(road.width_m, WIDEST * usual_m))
    return ReferenceLine.through(xyz_m, width_m[:, None] * [0.5, 0.5])


def _fit_sides(line: ReferenceLine, area: shapely.Geometry, sidewalk: shapely.Geometry) -> ReferenceLine:
    """Measure the sides of a road and its sidewalks across the line at each knot.

    A side whose border is far from the usual one, as at a fork or at the scene's border, keeps half the road's width.
    """
    usual_m = float(np.median(line.width_m)) / 2
    place, ahead = line.curve(line.breaks)[:, :2], line.curve(line.breaks, 1)[:, :2]
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) / np.linalg.norm(ahead, axis=1, keepdims=True)
    sides_m, sidewalks_m = line.sides_m.copy(), np.zeros_like(line.sides_m)
    for side, across in enumerate((left, -left)):
        reach = _measure_reach(place, across, area, 2 * WIDEST * usual_m)
        plausible = (reach >= NARROWEST * usual_m) & (reach <= WIDEST * usual_m)
        sides_m[plausible, side] = reach[plausible]
        start = place + (sides_m[:, side] + 0.05)[:, None] * across
        walk = _measure_reach(start, across, sidewalk, SIDEWALK_M[1])
        if np.median(walk) >= SIDEWALK_M[0]:
            sidewalks_m[:, side] = walk
    return replace(line, sides_m=sides_m, sidewalks_m=sidewalks_m)


def _measure_reach(start: np.ndarray, direction: np.ndarray, area: shapely.Geometry, most_m: float) -> np.ndarray:
    """Return the distance (k,) from points (k, 2) to the border of an area along unit directions (k, 2).

    The distance is 0 for points outside the area, and at most `most_m`.
    """
    rays = shapely.linestrings(np.stack([start, start + most_m * direction], axis=1))
    parts, ray = shapely.get_parts(shapely.intersection(rays, np.array(area)), return_index=True)
    at_start = shapely.distance(parts, shapely.points(start[ray])) < 1e-6
    reach = np.zeros(len(start))
    reach[ray[at_start]] = shapely.length(parts[at_start])
    return reach


def list_lanes(line: ReferenceLine) -> int:
    """Return the number of driving lanes per side.

    Args:
        line: Reference line of a road.

    Returns:
        Half the median road width divided by LANE_M, rounded to an integer >= 1.
    """
    return max(1, round(float(np.median(line.width_m)) / 2 / LANE_M))


def export_opendrive(scene: Scene) -> bytes:
    """Export the roads of a scene as an OpenDRIVE file.

    Args:
        scene: Scene with a road class.

    Returns:
        Content of the .xodr file.

    Raises:
        ValueError: The scene has no road.
    """
    network = extract_road_network(scene)
    if not network.roads:
        raise ValueError(f"scene {scene.scene_id} has no road to export")
    lines = fit_reference_lines(network, scene)
    root = ET.Element("OpenDRIVE")
    _make_header(root, scene)
    for number, (road, line) in enumerate(zip(network.roads, lines, strict=True)):
        element = _make_road(root, number, line, junction=-1)
        link = ET.SubElement(element, "link")
        for name, node in (("predecessor", road.start), ("successor", road.end)):
            if node >= 0:
                ET.SubElement(link, name, elementType="junction", elementId=_make_junction_id(node))
        _make_road_body(element, line, left=list_lanes(line), right=list_lanes(line))
    junctions = [_make_junction(root, network, lines, node) for node in range(len(network.nodes_m))]
    root.extend(junctions)  # In the file, junctions come after all roads.
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True)


def _make_header(root: ET.Element, scene: Scene) -> None:
    grid = scene.grid
    borders = {"north": grid.left_m, "south": grid.right_m, "east": grid.front_m, "west": grid.back_m}
    about = {
        "revMajor": "1",
        "revMinor": "7",
        "name": clean_xml_text(scene.scene_id),
        "version": "1.00",
        "vendor": "PrITTI on Ray",
    }
    header = ET.SubElement(root, "header", about | {name: _format_number(value) for name, value in borders.items()})
    x, y, z = scene.world_xyz_m
    ET.SubElement(
        header,
        "offset",
        x=_format_number(x),
        y=_format_number(y),
        z=_format_number(z),
        hdg=_format_number(scene.world_yaw_rad),
    )
    if scene.attribution:
        ET.SubElement(header, "userData", code="attribution", value=clean_xml_text(scene.attribution))


def _format_number(value: float) -> str:
    return f"{float(value):.9g}"


def _make_junction_id(node: int) -> str:
    return str(10_000 + node)


def _make_road(root: ET.Element, number: int, line: ReferenceLine, junction: int) -> ET.Element:
    about = {"id": str(number), "length": _format_number(line.length_m), "junction": str(junction), "rule": "RHT"}
    return ET.SubElement(root, "road", {"name": ""} | about)


def _make_road_body(
    road: ET.Element, line: ReferenceLine, left: int, right: int, links: tuple[int, int] | None = None
) -> None:
    """Write the plan view, elevation and lanes of a road.

    For a connecting road, `links` holds two signs: the sign of the lane numbers in the previous road, and the sign of
    the lane numbers in the next road.
    """
    ET.SubElement(ET.SubElement(road, "type", s="0", type="town"), "speed", max="50", unit="km/h")
    plan, profile = ET.SubElement(road, "planView"), ET.Element("elevationProfile")
    for piece, (start, s, length_m) in enumerate(
        zip(line.breaks[:-1], line.starts_m[:-1], line.lengths_m, strict=True)
    ):
        chord = line.breaks[piece + 1] - start
        # (4, 3) coefficients for a parameter in [0, 1]
        cubic = line.curve.c[::-1, piece] * chord ** np.arange(4)[:, None]
        x, y, z = cubic.T
        heading = float(np.arctan2(y[1], x[1]))
        cos, sin = np.cos(heading), np.sin(heading)
        u, v = cos * x + sin * y, cos * y - sin * x
        u[0] = v[0] = v[1] = 0.0
        at = {
            "s": _format_number(s),
            "x": _format_number(x[0]),
            "y": _format_number(y[0]),
            "hdg": _format_number(heading),
            "length": _format_number(length_m),
        }
        geometry = ET.SubElement(plan, "geometry", at)
        terms = {
            f"{name}{axis}": _format_number(term)
            for axis, part in (("U", u), ("V", v))
            for name, term in zip("abcd", part, strict=True)
        }
        ET.SubElement(geometry, "paramPoly3", terms, pRange="normalized")
        terms = {
            name: _format_number(term / length_m**power)
            for power, (name, term) in enumerate(zip("abcd", z, strict=True))
        }
        ET.SubElement(profile, "elevation", {"s": _format_number(s)} | terms)
    road.append(profile)
    section = ET.SubElement(ET.SubElement(road, "lanes"), "laneSection", s="0")
    for side, sign, count in (("left", 1, left), ("center", 0, 1), ("right", -1, right)):
        if not count:
            continue
        group = ET.SubElement(section, side)
        for k in range(count, 0, -1) if sign > 0 else range(1, count + 1):
            lane = ET.SubElement(group, "lane", id=str(sign * k), type="driving" if sign else "none", level="false")
            if sign and links:
                link = ET.SubElement(lane, "link")
                ET.SubElement(link, "predecessor", id=str(links[0] * k))
                ET.SubElement(link, "successor", id=str(links[1] * k))
            if sign:
                at = 0 if sign > 0 else 1
                _make_widths(lane, line, line.sides_m[:, at] / max(left, right))
                if k == count and line.sidewalks_m[:, at].any():
                    ET.SubElement(lane, "roadMark", sOffset="0", type="curb", color="standard", width="0.15")
        at = 0 if sign > 0 else 1
        if sign and line.sidewalks_m[:, at].any():
            walk = ET.Element("lane", id=str(sign * (count + 1)), type="sidewalk", level="false")
            _make_widths(walk, line, line.sidewalks_m[:, at])
            ET.SubElement(walk, "height", sOffset="0", inner=_format_number(KERB_M), outer=_format_number(KERB_M))
            group.insert(0 if sign > 0 else len(group), walk)


def _make_widths(lane: ET.Element, line: ReferenceLine, width_m: np.ndarray) -> None:
    """Write the width of a lane, which is linear between knots."""
    slope = np.diff(width_m) / line.lengths_m
    for s, a, b in zip(line.starts_m[:-1], width_m[:-1], slope, strict=True):
        ET.SubElement(lane, "width", sOffset=_format_number(s), a=_format_number(a), b=_format_number(b), c="0", d="0")


def _make_junction(root: ET.Element, network: RoadNetwork, lines: list[ReferenceLine], node: int) -> ET.Element:
    """Return the XML element of a junction, and add its connecting roads to `root`."""
    junction = ET.Element("junction", id=_make_junction_id(node), name="", type="default")
    ends = [
        (road.number, end)
        for road in network.roads
        for end, there in ((0, road.start), (-1, road.end))
        if there == node
    ]
    for (come, come_end), (go, go_end) in permutations(ends, 2):
        (a_m, a_way), (b_m, b_way) = lines[come].end(come_end), lines[go].end(go_end)
        a_way, b_way = (a_way if come_end else -a_way), (-b_way if go_end else b_way)
        lanes = min(list_lanes(lines[come]), list_lanes(lines[go]))
        # The connecting road continues the right side of both roads, seen in the direction of travel.
        right_m = [lines[come].sides_m[come_end, 1 if come_end else 0], lines[go].sides_m[go_end, 0 if go_end else 1]]
        right_m = np.array(right_m) * lanes / [list_lanes(lines[come]), list_lanes(lines[go])]
        sides_m = np.stack([right_m, right_m], axis=1)
        line = ReferenceLine.through(np.stack([a_m, b_m]), sides_m, np.stack([a_way, b_way]))
        number = len(root) - 1  # The header precedes the roads.
        road = _make_road(root, number, line, junction=int(_make_junction_id(node)))
        link = ET.SubElement(road, "link")
        points = ["end" if come_end else "start", "end" if go_end else "start"]
        for name, other, point in zip(("predecessor", "successor"), (come, go), points, strict=True):
            ET.SubElement(link, name, elementType="road", elementId=str(other), contactPoint=point)
        # Traffic keeps to the right. At the end of a road, traffic exits on negative lanes. At the start of a road,
        # traffic exits on positive lanes.
        signs = (-1 if come_end else 1), (1 if go_end else -1)
        _make_road_body(road, line, left=0, right=lanes, links=signs)
        about = {"incomingRoad": str(come), "connectingRoad": str(number), "contactPoint": "start"}
        connection = ET.SubElement(junction, "connection", {"id": str(len(junction))} | about)
        for k in range(1, lanes + 1):
            ET.SubElement(connection, "laneLink", {"from": str(signs[0] * k), "to": str(-k)})
    return junction
