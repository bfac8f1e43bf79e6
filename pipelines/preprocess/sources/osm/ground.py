"""Ground of an extract as layers of polygons. Upper layers hide lower layers, so that each place has one class."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import shapely

from models.scene import KITTI_GROUND_CLASSES
from pipelines.preprocess.sources.drive import HIDDEN, LayeredGround
from pipelines.preprocess.sources.osm.buildings import repair_polygons
from pipelines.preprocess.sources.osm.extract import Extract
from pipelines.preprocess.sources.osm.roads import Road
from pipelines.preprocess.sources.osm.tags import find_area_class, find_path, is_underground

# From top to bottom. Buildings and water hide the layers below them and have no ground class.
LAYERS = ("road", "parking", "building", "sidewalk", "water", "ground", "terrain")
ROUND = 4  # Segments per quarter circle of rounded ends and corners.
MAX_POINTS = 500  # Polygons with more points are cut into tiles, because triangulating them takes too long.
TILE_M = 128.0

LayerPolygon = tuple[str, Any]  # Name of a layer, and a polygon or multipolygon (m).


def make_strip(line: Any, from_m: float, to_m: float, is_round: bool = False) -> Any:
    """Return the strip of a line between two distances from it.

    Args:
        line: Line (m).
        from_m: Distance of one border (m); positive on the left of the line, negative on the right.
        to_m: Distance of the other border (m).
        is_round: Whether the ends are half circles, which connect the strips of successive lines.

    Returns:
        Polygon or multipolygon.
    """
    middle, half = (from_m + to_m) / 2, abs(to_m - from_m) / 2
    if abs(middle) > 1e-3:
        moved = shapely.offset_curve(line, middle, quad_segs=ROUND)
        line = line if moved.is_empty else moved
    return shapely.buffer(line, half, quad_segs=ROUND, cap_style="round" if is_round else "flat")


def list_ground(extract: Extract, roads: Iterable[Road]) -> list[LayerPolygon]:
    """Return the polygons of roads, paths and areas, but not those of buildings.

    Args:
        extract: Extract.
        roads: Its roads.

    Returns:
        Layer and polygon of each.
    """
    found: list[LayerPolygon] = []
    for road in roads:
        profile, line = road.profile, road.line
        found.append((profile.ground, make_strip(line, -profile.right_m, profile.left_m, is_round=True)))
        for sign, kerb, parking, sidewalk in zip(
            (1, -1), (profile.left_m, profile.right_m), profile.parking_m, profile.sidewalk_m, strict=True
        ):
            if parking:
                found.append(("parking", make_strip(line, sign * kerb, sign * (kerb + parking))))
            if sidewalk:
                # The strip begins on the carriageway, which hides it there. No gap can remain in bends.
                outer = kerb + parking + sidewalk
                found.append(("sidewalk", make_strip(line, 0.0, sign * outer)))
    for way in extract.lines:
        path = None if is_underground(way.tags) else find_path(way.tags)
        if path is not None and "area:highway" not in way.tags:
            name, width = path
            found.append((name, make_strip(way.geometry, -width / 2, width / 2, is_round=True)))
    areas = [(find_area_class(area.tags), area.geometry) for area in extract.areas if not is_underground(area.tags)]
    areas = [(name, geometry) for name, geometry in areas if name is not None]
    if areas:
        repaired, _ = repair_polygons([geometry for _, geometry in areas])
        found += [(name or "water", polygon) for (name, _), polygon in zip(areas, repaired, strict=True)]
    return found


def make_ground(polygons: list[LayerPolygon]) -> LayeredGround:
    """Triangulate polygons at height 0.

    Args:
        polygons: Layer (one of LAYERS) and polygon or multipolygon (m) of each.

    Returns:
        The ground, with the classes KITTI_GROUND_CLASSES.
    """
    layers, pieces = [], []
    for name, polygon in polygons:
        parts = [part for part in shapely.get_parts(polygon) if part.geom_type == "Polygon" and not part.is_empty]
        parts = [piece for part in parts for piece in _cut_into_tiles(part)]
        pieces += parts
        layers += [LAYERS.index(name)] * len(parts)
    triangles, owner = _triangulate(np.array(pieces, object))
    classes = tuple(KITTI_GROUND_CLASSES.index(name) if name in KITTI_GROUND_CLASSES else HIDDEN for name in LAYERS)
    flat = np.concatenate([triangles, np.zeros((*triangles.shape[:2], 1))], axis=2)
    return LayeredGround(flat, np.array(layers, np.int64)[owner], classes)


def _cut_into_tiles(polygon: Any) -> list[Any]:
    """Return the polygon, or its parts in tiles of TILE_M if it has many points."""
    if shapely.get_num_coordinates(polygon) <= MAX_POINTS:
        return [polygon]
    low, high = np.floor(np.array(polygon.bounds).reshape(2, 2) / TILE_M + [[0], [1]]).astype(int)
    shapely.prepare(polygon)
    found = []
    for i in range(low[0], high[0]):
        for j in range(low[1], high[1]):
            part = shapely.clip_by_rect(polygon, i * TILE_M, j * TILE_M, (i + 1) * TILE_M, (j + 1) * TILE_M)
            found += [piece for piece in shapely.get_parts(part) if piece.geom_type == "Polygon"]
    return found


def _triangulate(polygons: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return triangles (t, 3, 2) and the index (t,) of the polygon of each."""
    if not len(polygons):
        return np.zeros((0, 3, 2)), np.zeros(0, np.int64)
    collections = shapely.constrained_delaunay_triangles(polygons)
    parts, owner = shapely.get_parts(collections, return_index=True)
    return shapely.get_coordinates(parts).reshape(-1, 4, 2)[:, :3], owner
