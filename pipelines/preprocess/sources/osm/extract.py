"""Read an extract of OpenStreetMap into features in a local metric frame.

The frame has its origin at the middle of the region, x to the east and y to the north. The projection is transverse
Mercator (pyproj). Its scale error is less than 1e-4 within MAX_EXTENT_M.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
import osmium.filter
import osmium.geom
import pyproj
import shapely

from models.limits import LimitError, require_within
from pipelines.preprocess.sources.input_paths import InputPath, find_local_file, make_input_path
from pipelines.preprocess.sources.maps import make_map_name

SUFFIXES = (".osm", ".osm.gz", ".osm.bz2", ".osm.pbf", ".pbf")
KEYS = (
    "amenity",
    "area:highway",
    "barrier",
    "building",
    "building:part",
    "highway",
    "landuse",
    "leisure",
    "man_made",
    "natural",
    "power",
    "traffic_sign",
)
# Keys of areas, in addition to highway. Each way is also a line, closed or not.
AREA_KEYS = ("amenity", "area:highway", "building", "building:part", "landuse", "leisure", "natural")
MAX_EXTENT_M = 100_000.0
MAX_LATITUDE_DEG = 84.0
ROAD_M = 20.0
MARGIN_M = 150.0  # Crops of poses at the border of the region contain features up to this distance outside of it.
GET_EXTRACT = "pass an extract of OpenStreetMap (.osm, .osm.gz, .osm.bz2 or .osm.pbf)"
CUT_OUT = "cut out a part with --bbox WEST SOUTH EAST NORTH or --origin LATITUDE LONGITUDE"


@dataclass(frozen=True)
class Region:
    """Part of an extract. At most one of bbox_deg and origin_deg is set; without them, it is the whole extract.

    Attributes:
        bbox_deg: Longitude of the western border, latitude of the southern, longitude of the eastern, and latitude of
            the northern border.
        origin_deg: Latitude and longitude of the middle of a square.
        radius_m: Half of the side of this square (m).
    """

    bbox_deg: tuple[float, float, float, float] | None = None
    origin_deg: tuple[float, float] | None = None
    radius_m: float = 500.0


@dataclass(frozen=True, eq=False)
class Feature:
    """A node, a way or an area with its tags.

    Attributes:
        id: Number of the node, way or relation.
        tags: Tags.
        geometry: Point, line, polygon or multipolygon (m).
        nodes: Numbers of the nodes of a way.
    """

    id: int
    tags: dict[str, str]
    geometry: Any
    nodes: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class Extract:
    """The features of a region.

    Attributes:
        name: Name of the file without suffixes, with characters that scene ids may contain.
        projection: Projection from longitude and latitude to x and y, in the notation of PROJ.
        box_m: Lower and upper corner (x, y) of the region (m).
        points: Nodes with tags.
        lines: Ways.
        areas: Closed ways and multipolygons with a key of AREA_KEYS or the key highway.
        skipped: Number of features that were skipped for each reason.
    """

    name: str
    projection: str
    box_m: np.ndarray  # (2, 2)
    points: list[Feature]
    lines: list[Feature]
    areas: list[Feature]
    skipped: Counter[str]


def read_extract(path: str | PathLike, region: Region | None = None, only_roads: bool = False) -> Extract:
    """Read the features of a region.

    Args:
        path: Extract of OpenStreetMap.
        region: Region (default: the whole extract).
        only_roads: Whether to read only ways with the key highway.

    Returns:
        The features, in the order of the file.

    Raises:
        ValueError: The file cannot be read, it has no highway in the region, or the region spans the antimeridian,
            latitudes beyond MAX_LATITUDE_DEG, or more than MAX_EXTENT_M.
    """
    region = region or Region()
    source = make_input_path(path)
    if not source.is_file():  # Reading a named pipe would never end.
        raise ValueError(f"{source} is missing or is not a regular file; {GET_EXTRACT}")
    local = find_local_file(source)
    require_within("map_bytes", local.stat().st_size, f"{source}; {CUT_OUT}")
    skipped: Counter[str] = Counter()
    keys, geometries, records = [], [], []
    try:
        for number, (kind, geometry, record) in enumerate(_iterate(str(local), only_roads, skipped)):
            require_within("map_features", number, f"{source}; {CUT_OUT}", is_partial=True)
            keys.append(kind)
            geometries.append(geometry)
            records.append(record)
    except LimitError:
        raise
    except (RuntimeError, ValueError, osmium.InvalidLocationError) as error:  # Files that osmium cannot parse.
        remedy = "sort the file with 'osmium sort'" if "out of order" in str(error) else GET_EXTRACT
        raise ValueError(f"{source}: {str(error)[:200]}; {remedy}") from error
    geometries = np.array(geometries, object)
    is_road = np.array([kind == "line" and "highway" in tags for kind, (_, tags, _) in zip(keys, records, strict=True)])
    if not is_road.any():
        raise ValueError(f"{source} has no way with the key highway; {GET_EXTRACT}")
    box_deg = _find_box(source, region, shapely.total_bounds(geometries[is_road]))
    projection, project = _make_projection(box_deg)
    box_m = _find_box_m(source, region, box_deg, project)
    geometries = shapely.transform(geometries, project)
    low_m, high_m = box_m[0] - MARGIN_M, box_m[1] + MARGIN_M
    bounds = shapely.bounds(geometries)
    kept = (bounds[:, :2] <= high_m).all(axis=1) & (bounds[:, 2:] >= low_m).all(axis=1)
    if not (kept & is_road).any():
        raise ValueError(
            f"{source}: no highway lies in the region; the highways of the file span "
            f"{_format_box(shapely.total_bounds(_restore(geometries[is_road], projection)))} "
            "(west, south, east, north)"
        )
    found: dict[str, list[Feature]] = {"point": [], "line": [], "area": []}
    for index in np.flatnonzero(kept).tolist():
        identity, tags, nodes = records[index]
        found[keys[index]].append(Feature(identity, tags, geometries[index], nodes))
    return Extract(
        make_map_name(source, SUFFIXES), projection, box_m, found["point"], found["line"], found["area"], skipped
    )


Record = tuple[int, dict[str, str], tuple[int, ...]]


def _iterate(path: str, only_roads: bool, skipped: Counter[str]) -> Iterator[tuple[str, Any, Record]]:
    """Yield kind, geometry in degrees, and record of each feature."""
    processor = osmium.FileProcessor(path)
    if only_roads:
        processor = processor.with_locations().with_filter(osmium.filter.KeyFilter("highway"))
    else:
        processor = processor.with_areas().with_filter(osmium.filter.KeyFilter(*KEYS))
    make_wkb = osmium.geom.WKBFactory().create_multipolygon
    for item in processor:
        entity: Any = item  # The type checker does not know which of the four types it is.
        if entity.is_node():
            if only_roads:
                continue
            if entity.location.valid():
                place = shapely.Point(entity.location.lon, entity.location.lat)
                yield "point", place, (entity.id, dict(entity.tags), ())
            else:
                skipped["node with an invalid location"] += 1
        elif entity.is_way():
            nodes = [node for node in entity.nodes if node.location.valid()]
            if len(nodes) < 2:
                skipped["way with fewer than two known nodes"] += 1
                continue
            line = shapely.LineString([(node.lon, node.lat) for node in nodes])
            yield "line", line, (entity.id, dict(entity.tags), tuple(node.ref for node in nodes))
        elif entity.is_area() and any(key in entity.tags for key in (*AREA_KEYS, "highway")):
            try:
                area = shapely.from_wkb(bytes.fromhex(make_wkb(entity)))
            except (RuntimeError, shapely.errors.GEOSException):
                skipped["area without a valid outline"] += 1
                continue
            yield "area", area, (entity.orig_id(), dict(entity.tags), ())


def _find_box(source: InputPath, region: Region, of_roads: np.ndarray) -> np.ndarray:
    """Return west, south, east and north of the region in degrees."""
    if region.bbox_deg is not None:
        box = np.array(region.bbox_deg, float)
        if box[0] > box[2]:
            raise ValueError(
                f"--bbox {_format_box(box)}: the region spans the antimeridian, where no local projection is defined; "
                "preprocess the parts on both sides one by one"
            )
        if not (box[1] < box[3] and box[0] < box[2]):
            raise ValueError(
                f"--bbox {_format_box(box)}: expected WEST SOUTH EAST NORTH in degrees, such as "
                f"--bbox {_format_box(of_roads)}"
            )
    elif region.origin_deg is not None:
        latitude, longitude = region.origin_deg
        box = np.array([longitude, latitude, longitude, latitude])
    else:
        box = np.array(of_roads, float)
    if np.abs(box[[1, 3]]).max() > MAX_LATITUDE_DEG or np.abs(box[[0, 2]]).max() > 180:
        raise ValueError(
            f"{source}: the region {_format_box(box)} (west, south, east, north) exceeds latitudes of "
            f"{MAX_LATITUDE_DEG:g} degrees or longitudes of 180 degrees; {CUT_OUT}"
        )
    if box[2] - box[0] > 180:
        raise ValueError(
            f"{source}: the region {_format_box(box)} (west, south, east, north) spans the antimeridian or half of the "
            f"earth; {CUT_OUT}"
        )
    return box


def _make_projection(box_deg: np.ndarray) -> tuple[str, Any]:
    """Return the projection, and a function from (n, 2) longitudes and latitudes to (n, 2) metres."""
    longitude, latitude = (box_deg[:2] + box_deg[2:]) / 2
    text = f"+proj=tmerc +lat_0={latitude:.7f} +lon_0={longitude:.7f} +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m"
    convert = pyproj.Proj(text)
    return text, lambda degrees: np.column_stack(convert(degrees[:, 0], degrees[:, 1]))


def _restore(geometries: np.ndarray, projection: str) -> np.ndarray:
    """Return geometries in degrees."""
    convert = pyproj.Proj(projection)
    return shapely.transform(geometries, lambda m: np.column_stack(convert(m[:, 0], m[:, 1], inverse=True)))


def _find_box_m(source: InputPath, region: Region, box_deg: np.ndarray, project: Any) -> np.ndarray:
    """Return the lower and the upper corner of the region in metres."""
    if region.origin_deg is not None:
        if 2 * region.radius_m > MAX_EXTENT_M:
            raise ValueError(f"--radius-m is {region.radius_m:g}, expected at most {MAX_EXTENT_M / 2:g}")
        return np.array([[-1.0, -1.0], [1.0, 1.0]]) * region.radius_m
    west, south, east, north = box_deg
    corners = project(np.array([[west, south], [east, south], [east, north], [west, north]]))
    low, high = corners.min(axis=0), corners.max(axis=0)
    if not (np.isfinite(corners).all() and (high - low).max() <= MAX_EXTENT_M):
        raise ValueError(
            f"{source}: the region {_format_box(box_deg)} (west, south, east, north) is wider than "
            f"{MAX_EXTENT_M / 1000:g} km; {CUT_OUT}"
        )
    # The lanes of the outermost roads lie next to their lines.
    return np.stack([low, high]) + (0.0 if region.bbox_deg is not None else np.array([[-ROAD_M], [ROAD_M]]))


def _format_box(box: np.ndarray) -> str:
    return " ".join(f"{value:.5f}" for value in box)
