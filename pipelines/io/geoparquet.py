"""Export a Scene seen from above as GeoParquet 1.1: polygons of the ground classes and outlines of the primitives.

Coordinates are metres. The reference system (crs) is null, because neither the scene frame nor the local world frames
of the sources have a code.
"""

from __future__ import annotations

import io
import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely

from models.scene import CATEGORIES, Scene
from pipelines.geometry.ground_polygons import build_ground_polygons
from pipelines.io.geojson import SIMPLIFY_M, list_outlines

GEOMETRY, WORLD = "geometry", "geometry_world"


def export_geoparquet(scene: Scene) -> bytes:
    """Export a scene to a GeoParquet file with one row per ground class and per primitive.

    The column `geometry` is in the scene frame. If the pose of the scene is known, the column `geometry_world` has the
    same outlines in the world frame of the source.

    Args:
        scene: Scene.

    Returns:
        Content of the .geoparquet file.
    """
    ground = build_ground_polygons(scene, SIMPLIFY_M)
    shapes = np.array([*ground.values(), *list_outlines(scene)], object)
    count, bottom = len(ground), scene.center_m[:, 2] - scene.size_m[:, 2] / 2
    unknown = [None] * count
    columns = {
        "scene_id": [scene.scene_id] * len(shapes),
        "kind": ["ground"] * count + ["primitive"] * len(scene),
        "name": [*ground, *(CATEGORIES[k] for k in scene.category)],
        "label": [*unknown, *map(str, scene.label)],
        "bottom_m": [*unknown, *bottom.astype(float).tolist()],
        "height_m": [*unknown, *scene.size_m[:, 2].astype(float).tolist()],
        "yaw_rad": [*unknown, *scene.yaw_rad.astype(float).tolist()],
        GEOMETRY: shapely.to_wkb(shapes).tolist() if len(shapes) else [],
    }
    types = {name: pa.string() for name in ("scene_id", "kind", "name", "label")}
    types |= {name: pa.float64() for name in ("bottom_m", "height_m", "yaw_rad")} | {GEOMETRY: pa.binary()}
    about = {GEOMETRY: _describe(shapes)}
    if scene.world_from_imu is not None:
        moved = shapely.transform(shapes, lambda points: _to_world(scene, points)) if len(shapes) else shapes
        columns[WORLD], types[WORLD] = shapely.to_wkb(moved).tolist() if len(shapes) else [], pa.binary()
        about[WORLD] = _describe(moved)
    geo = {"version": "1.1.0", "primary_column": GEOMETRY, "columns": about}
    metadata = {"geo": json.dumps(geo)} | ({"attribution": scene.attribution} if scene.attribution else {})
    table = pa.table({name: pa.array(columns[name], types[name]) for name in columns}, metadata=metadata)
    stream = io.BytesIO()
    pq.write_table(table, stream, compression="zstd")
    return stream.getvalue()


def _to_world(scene: Scene, points_m: np.ndarray) -> np.ndarray:
    """Transform points (n, 2) from the scene frame to the world frame."""
    cos, sin = np.cos(scene.world_yaw_rad), np.sin(scene.world_yaw_rad)
    return points_m @ np.array([[cos, sin], [-sin, cos]]) + np.array(scene.world_xyz_m[:2])


def _describe(shapes: np.ndarray) -> dict:
    """Return the description of a geometry column; the null of `crs` means that the coordinates have no code."""
    kinds = sorted({shape.geom_type for shape in shapes})
    bounds = {"bbox": shapely.total_bounds(shapes).tolist()} if len(shapes) else {}
    return {"encoding": "WKB", "geometry_types": kinds, "crs": None, "edges": "planar"} | bounds
