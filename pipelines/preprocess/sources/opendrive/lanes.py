"""Surfaces of the lanes of OpenDRIVE roads as triangles, and the areas of junctions."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import shapely

from pipelines.preprocess.sources.opendrive.file import Lane, Map, Road, Section
from pipelines.preprocess.sources.osm.buildings import repair_polygons

# From top to bottom; see LayeredGround.
LAYERS = ("road", "parking", "building", "sidewalk", "ground", "terrain")
STEP_M = 1.0  # Largest length of a piece of a lane.
# Lane types of OpenDRIVE 1.4 to 1.8 with a ground class. Lanes of other types, such as none, have the class of their
# material, if it has one.
LANE_CLASSES = {
    **dict.fromkeys(
        (
            *("driving", "stop", "bidirectional", "entry", "exit", "offRamp", "onRamp", "connectingRamp", "slipLane"),
            *("bus", "taxi", "HOV", "special1", "special2", "special3", "mwyEntry", "mwyExit", "restricted"),
            *("roadWorks", "shoulder", "tram", "rail", "shared"),
        ),
        "road",
    ),
    "parking": "parking",
    **dict.fromkeys(("sidewalk", "walking", "biking", "border", "curb"), "sidewalk"),
    "median": "terrain",
}
DRIVING = ("driving", "bidirectional", "entry", "exit", "bus", "shared")  # Lanes on which poses lie.
MATERIAL_CLASSES = {"grass": "terrain", "gravel": "ground", "cobble": "ground", "soil": "terrain", "dirt": "terrain"}
MIN_WIDTH_M = 0.01
CLOSING_M = 3.0  # Gaps of a junction between connecting roads that are narrower than twice this become road.
MAX_HOLE_M2 = 150.0  # Larger holes of a junction remain, such as the middle of a roundabout.


class Strip(NamedTuple):
    """Borders of a lane in a section, at the same stations.

    Attributes:
        lane: Lane.
        s_m: Distances along the road (m).
        inner_m: Distance of the inner border from the reference line, positive on the left (m).
        outer_m: Distance of the outer border (m).
        height_m: Height of the inner and the outer border above the road (m).
    """

    lane: Lane
    s_m: np.ndarray  # (n,)
    inner_m: np.ndarray  # (n,)
    outer_m: np.ndarray  # (n,)
    height_m: np.ndarray  # (n, 2)


def list_strips(road: Road, section: Section, step_m: float = STEP_M) -> Iterator[Strip]:
    """Yield the lanes of a section, from the centre outwards on each side.

    Args:
        road: Road.
        section: One of its sections.
        step_m: Largest distance of stations (m).

    Yields:
        Borders of each lane.
    """
    records = [record.start_m for lane in section.lanes for record in (lane.width, lane.border)]
    extra = np.concatenate([*records, np.zeros(0)]) + section.s_m
    s = road.line.list_stations(section.s_m, section.end_m, step_m, extra)
    at = s - section.s_m
    center = road.lane_offset.evaluate(s)
    for sign in (1, -1):
        inner = center
        for lane in sorted((lane for lane in section.lanes if lane.id * sign > 0), key=lambda lane: abs(lane.id)):
            if len(lane.border.start_m) and not len(lane.width.start_m):
                outer = center + sign * np.abs(lane.border.evaluate(at))
            else:
                outer = inner + sign * lane.width.evaluate(at).clip(0.0)
            height = np.stack([record.evaluate(at) for record in lane.height], axis=1)
            yield Strip(lane, s, inner, outer, height)
            inner = outer


def find_lane_class(lane: Lane) -> str | None:
    """Return the ground class of a lane; None if its type and its material have none."""
    return LANE_CLASSES.get(lane.kind) or MATERIAL_CLASSES.get(lane.material.lower())


def triangulate_lanes(roads: Map) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate all lanes with a ground class, and the areas of junctions.

    Args:
        roads: Map.

    Returns:
        (t, 3, 3) triangles in the inertial frame (m), and the index (t,) of the layer of each in LAYERS.
    """
    parts, layers = [np.zeros((0, 3, 3))], [np.zeros(0, np.int64)]
    of_junction: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for road in roads.roads:
        for section in road.sections:
            for strip in list_strips(road, section):
                name = find_lane_class(strip.lane)
                if name is None or np.abs(strip.outer_m - strip.inner_m).max() < MIN_WIDTH_M:
                    continue
                inner, outer = place_borders(road, strip)
                triangles = _triangulate_strip(inner, outer)
                parts.append(triangles)
                layers.append(np.full(len(triangles), LAYERS.index(name)))
                if road.junction and name == "road":
                    of_junction.setdefault(road.junction, []).append((inner, outer))
    for pieces in of_junction.values():
        triangles = _fill_junction(pieces)
        parts.append(triangles)
        layers.append(np.full(len(triangles), LAYERS.index("road")))
    return np.concatenate(parts), np.concatenate(layers)


def place_borders(road: Road, strip: Strip) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (n, 3) of the inner and of the outer border of a lane in the inertial frame (m)."""
    inner = road.line.place(strip.s_m, strip.inner_m, strip.height_m[:, 0])
    return inner, road.line.place(strip.s_m, strip.outer_m, strip.height_m[:, 1])


def _triangulate_strip(inner: np.ndarray, outer: np.ndarray) -> np.ndarray:
    first = np.stack([inner[:-1], inner[1:], outer[1:]], axis=1)
    second = np.stack([inner[:-1], outer[1:], outer[:-1]], axis=1)
    return np.concatenate([first, second])


def _fill_junction(borders: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return triangles of the gaps between the lanes of a junction, with the heights of nearby vertices.

    Args:
        borders: Points (n, 3) of the inner and of the outer border of each lane (m).

    Returns:
        (t, 3, 3) triangles (m).
    """
    vertices = np.concatenate([np.concatenate(pair) for pair in borders])
    lanes, _ = repair_polygons([shapely.Polygon(np.concatenate([a, b[::-1]])[:, :2]) for a, b in borders])
    surface = shapely.union_all(shapely.buffer(lanes, 0.02))
    closed = shapely.buffer(shapely.buffer(surface, CLOSING_M, quad_segs=4), -CLOSING_M, quad_segs=4)
    filled = [
        shapely.Polygon(part.exterior, [r for r in part.interiors if shapely.Polygon(r).area > MAX_HOLE_M2])
        for part in shapely.get_parts(closed)
        if part.geom_type == "Polygon"
    ]
    gaps = shapely.get_parts(shapely.difference(shapely.union_all(filled), surface))
    gaps = gaps[(shapely.get_type_id(gaps) == 3) & (shapely.area(gaps) > 1e-3)]
    if not len(gaps):
        return np.zeros((0, 3, 3))
    pieces = shapely.get_parts(shapely.constrained_delaunay_triangles(gaps))
    corners = shapely.get_coordinates(pieces).reshape(-1, 4, 2)[:, :3]
    tree = shapely.STRtree(np.array(shapely.points(vertices[:, :2])))
    nearest = tree.nearest(shapely.points(corners.reshape(-1, 2)))
    return np.concatenate([corners, vertices[nearest, 2].reshape(-1, 3, 1)], axis=2)


class LanePoses(NamedTuple):
    """Poses in the middle of driving lanes.

    Attributes:
        xyz_m: Points on the road (m).
        yaw_rad: Directions of travel.
    """

    xyz_m: np.ndarray  # (p, 3)
    yaw_rad: np.ndarray  # (p,)


def make_lane_poses(roads: Map, spacing_m: float) -> LanePoses:
    """Return poses on the innermost driving lane of each side of each road outside of junctions.

    Args:
        roads: Map.
        spacing_m: Distance between successive poses of a lane (m).

    Returns:
        Poses.
    """
    xyz, yaw = [np.zeros((0, 3))], [np.zeros(0)]
    for road in roads.roads:
        if road.junction:
            continue
        for section in road.sections:
            for sign in (1, -1):
                lanes = [lane.id for lane in section.lanes if lane.id * sign > 0 and lane.kind in DRIVING]
                if not lanes:
                    continue
                chosen = min(lanes, key=abs)
                strip = next(strip for strip in list_strips(road, section) if strip.lane.id == chosen)
                # Poses lie at (k + 0.5) * spacing_m along the road, regardless of its sections.
                first = np.ceil((section.s_m - spacing_m / 2) / spacing_m) * spacing_m + spacing_m / 2
                s = np.arange(first, section.end_m, spacing_m)
                width = np.interp(s, strip.s_m, np.abs(strip.outer_m - strip.inner_m))
                middle = np.interp(s, strip.s_m, (strip.inner_m + strip.outer_m) / 2)
                s, middle = s[width > 1.5], middle[width > 1.5]
                if not len(s):
                    continue
                _, direction = road.line.evaluate(s)
                travels_along = (sign < 0) != road.drives_left
                xyz.append(road.line.place(s, middle))
                yaw.append(direction + (0.0 if travels_along else np.pi))
    turned = (np.concatenate(yaw) + np.pi) % (2 * np.pi) - np.pi
    return LanePoses(np.concatenate(xyz), turned)
