"""Tests of the GeoJSON export, which shapely reads."""

import json
from dataclasses import replace

import numpy as np
import pytest
import shapely
from helpers import empty_scene, example_scene

from models.scene import CATEGORIES, ELLIPSOID
from pipelines.geometry.ground_polygons import build_ground_polygons
from pipelines.io.geojson import export_geojson, list_outlines
from pipelines.io.mesh_export import compute_placements, make_unit_ellipsoid


def test_geojson_holds_ground_and_primitives():
    scene = example_scene()
    collection = json.loads(export_geojson(scene))
    ground = [f for f in collection["features"] if f["properties"]["kind"] == "ground"]
    objects = [f for f in collection["features"] if f["properties"]["kind"] == "primitive"]
    exact = build_ground_polygons(scene)
    assert {f["properties"]["name"] for f in ground} == set(exact)
    for feature in ground:
        shape = shapely.from_geojson(json.dumps(feature["geometry"]))
        name = feature["properties"]["name"]
        assert all(part.exterior.is_ccw and not any(hole.is_ccw for hole in part.interiors) for part in shape.geoms)
        assert shape.is_valid and shape.area == pytest.approx(exact[name].area, rel=0.01, abs=0.5)
        assert feature["properties"]["area_m2"] == pytest.approx(shape.area, abs=0.01)
    assert [f["properties"]["name"] for f in objects] == [CATEGORIES[c] for c in scene.category]
    assert np.allclose([f["properties"]["center_m"] for f in objects], scene.center_m, atol=1e-3)


def test_outlines_equal_hulls_of_meshes():
    scene = example_scene()
    ball, _ = make_unit_ellipsoid()
    box = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T
    for outline, transform, category in zip(
        list_outlines(scene), compute_placements(scene), scene.category, strict=True
    ):
        points = (ball if category == ELLIPSOID else box) @ transform[:3, :3].T + transform[:3, 3]
        hull = shapely.convex_hull(shapely.multipoints(points[:, :2]))
        assert outline.intersection(hull).area > 0.97 * max(outline.area, hull.area)


def test_geojson_accepts_empty_scene():
    assert json.loads(export_geojson(empty_scene()))["features"] == []
    flat = replace(example_scene(3), size_m=np.zeros((3, 3), np.float32))
    assert len(json.loads(export_geojson(flat))["features"]) > 3
