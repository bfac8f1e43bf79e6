"""Export the roads of a Scene as ASAM OpenDRIVE 1.7: reference lines, elevation, driving lanes and junctions.

Each road of centerlines.py becomes an OpenDRIVE road with at least one driving lane per side. The reference line of a
road consists of cubic curves through points of the centreline. Roads end before a node. At each node, a connecting road
leads from each road to every other road. The inertial frame of OpenDRIVE is the scene frame. The offset in the header
is the position of the scene in the world frame. Traffic keeps to the right.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from models.scene import Scene
from pipelines.geometry.centerlines import Road, RoadNetwork, extract_road_network

KNOT_M = 5.0  # Distance between points of a reference line.
LANE_M = 3.5  # Approximate lane width, which determines the number of lanes per side.
LEAST_ROAD_M = 2.0  # Minimum length of a road between two junctions.
CLEAR = 1.3  # Distance from a node to the road ends, as a multiple of the half width of the widest road.
SAMPLES = 64  # Number of samples that measure the length of a cubic curve.


@dataclass(frozen=True, eq=False)
class ReferenceLine:
    """A smooth curve through k knots.

    The curve parameter is the cumulative chord length.

    Attributes:
        curve: Map from cumulative chord length to x, y and z in the scene frame (m).
        breaks: Cumulative chord length at each knot (m).
        lengths_m: Length of the curve between successive knots, seen from above (m).
        width_m: Width of the whole road at each knot (m).
    """

    curve: CubicSpline
    breaks: np.ndarray  # (k,)
    lengths_m: np.ndarray  # (k - 1,)
    width_m: np.ndarray  # (k,)

    @staticmethod
    def through(xyz_m: np.ndarray, width_m: np.ndarray, tangents: np.ndarray | None = None) -> ReferenceLine:
        """Fit a curve through points.

        Args:
            xyz_m: (k, 3) points in the scene frame (m), k >= 2.
            width_m: (k,) width of the whole road at the points (m).
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
        return ReferenceLine(curve, breaks, speed.mean(axis=1) * np.diff(breaks), width_m)

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


def fit_reference_lines(network: RoadNetwork) -> list[ReferenceLine]:
    """Fit a curve to each road.

    Roads are shortened at junctions.

    Args:
        network: Roads and nodes.

    Returns:
        One curve per road, in the order of the roads.
    """
    clear_m = [
        CLEAR * max(float(np.median(road.width_m)) for road in network.list_leaving(node)) / 2
        for node in range(len(network.nodes_m))
    ]
    return [
        _shorten_road(road, *(clear_m[node] if node >= 0 else 0.0 for node in (road.start, road.end)))
        for road in network.roads
    ]


def _shorten_road(road: Road, from_start_m: float, from_end_m: float) -> ReferenceLine:
    along = np.append(0, np.cumsum(np.linalg.norm(np.diff(road.xyz_m[:, :2], axis=0), axis=1)))
    spare_m = max(along[-1] - LEAST_ROAD_M, 0) / max(from_start_m + from_end_m, 1e-9)
    low, high = from_start_m * min(1, spare_m), along[-1] - from_end_m * min(1, spare_m)
    at = np.linspace(low, high, max(2, round((high - low) / KNOT_M) + 1))
    xyz_m = np.stack([np.interp(at, along, road.xyz_m[:, axis]) for axis in range(3)], axis=1)
    usual_m = np.median(road.width_m)  # At a fork, the mask is wider than each of the roads.
    width_m = np.interp(at, along, np.minimum(road.width_m, 1.15 * usual_m))
    return ReferenceLine.through(xyz_m, width_m)


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
    lines = fit_reference_lines(network)
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
    about = {"revMajor": "1", "revMinor": "7", "name": scene.scene_id, "version": "1.00", "vendor": "PrITTI on Ray"}
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
                _make_widths(lane, line, max(left, right))


def _make_widths(lane: ET.Element, line: ReferenceLine, lanes: int) -> None:
    """Write the width of a lane, which is linear between knots."""
    width_m = line.width_m / 2 / lanes
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
        width_m = np.array([lines[come].width_m[come_end], lines[go].width_m[go_end]])
        width_m = width_m * lanes / [list_lanes(lines[come]), list_lanes(lines[go])]
        line = ReferenceLine.through(np.stack([a_m, b_m]), width_m, np.stack([a_way, b_way]))
        number = sum(1 for _ in root.iter("road"))
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
