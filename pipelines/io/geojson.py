"""Export a Scene seen from above as GeoJSON: polygons of the ground classes and outlines of the primitives.

Coordinates are x and y of the scene frame (metres) instead of longitudes and latitudes.
"""

from __future__ import annotations

import json

import numpy as np
import shapely

from models.scene import CATEGORIES, ELLIPSOID, Scene
from pipelines.geometry.ground_polygons import build_ground_polygons
from pipelines.schema.palette import COLOR_HEX

SIMPLIFY_M = 0.05  # See `build_ground_polygons`.
DECIMALS = 3


def export_geojson(scene: Scene) -> bytes:
    """Export a scene to a GeoJSON feature collection.

    A ground class is one feature with a MultiPolygon. A primitive is one feature with the convex hull of its outline
    seen from above: of its eight corners, or of its ellipsoid. Coordinates are metres in the scene frame, not degrees.

    Args:
        scene: Scene.

    Returns:
        Content of the .geojson file (UTF-8).
    """
    features = [
        _make_feature(shape, kind="ground", name=name, color=f"#{COLOR_HEX[name]}", area_m2=round(shape.area, DECIMALS))
        for name, shape in build_ground_polygons(scene, SIMPLIFY_M).items()
    ]
    for index, outline_m in enumerate(list_outlines(scene)):
        name = CATEGORIES[scene.category[index]]
        about = {"kind": "primitive", "name": name, "color": f"#{COLOR_HEX[name]}", "label": str(scene.label[index])}
        center_m, size_m = (np.round(v[index].astype(float), DECIMALS).tolist() for v in (scene.center_m, scene.size_m))
        yaw_rad = round(float(scene.yaw_rad[index]), 6)
        features.append(_make_feature(outline_m, **about, center_m=center_m, size_m=size_m, yaw_rad=yaw_rad))
    notice = {"attribution": scene.attribution} if scene.attribution else {}
    collection = {"type": "FeatureCollection", "name": scene.scene_id, "unit": "m", **notice, "features": features}
    return json.dumps(collection, ensure_ascii=False).encode()


def list_outlines(scene: Scene) -> list[shapely.Geometry]:
    """List the outlines of the primitives seen from above.

    Args:
        scene: Scene.

    Returns:
        One polygon per primitive in the scene frame (m); a primitive without area has a line or a point.
    """
    signs = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T
    angle = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    outlines = []
    for center_m, rotation, size_m, category in zip(
        scene.center_m, scene.rotation, scene.size_m, scene.category, strict=True
    ):
        edges = (rotation * size_m)[:2].astype(float)  # (2, 3)
        if category == ELLIPSOID:  # The outline of an ellipsoid is an ellipse with the covariance edges @ edges.T / 4.
            value, axis = np.linalg.eigh(edges @ edges.T / 4)
            points = (axis * np.sqrt(value.clip(0)) @ circle).T
        else:
            points = signs @ edges.T
        outlines.append(shapely.convex_hull(shapely.multipoints(points + center_m[:2])))
    return outlines


def _make_feature(shape: shapely.Geometry, **properties: object) -> dict:
    rounded = shapely.transform(shape, lambda points: np.round(points, DECIMALS))
    rounded = shapely.orient_polygons(shapely.remove_repeated_points(rounded))  # RFC 7946: counter-clockwise exteriors.
    return {"type": "Feature", "geometry": json.loads(shapely.to_geojson(rounded)), "properties": properties}
