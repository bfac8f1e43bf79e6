"""Tests of GeoParquet files, which geopandas opens."""

import io
import json
from dataclasses import replace

import geopandas
import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely
from helpers import random_scene

from models.scene import CATEGORIES
from pipelines.io.geojson import export_geojson
from pipelines.io.geoparquet import export_geoparquet


def read(content: bytes, folder) -> geopandas.GeoDataFrame:
    (folder / "scene.geoparquet").write_bytes(content)
    return geopandas.read_parquet(folder / "scene.geoparquet")


def test_geopandas_reads_the_outlines_of_geojson(tmp_path, town_drive_3):
    scene = town_drive_3.scene(20)
    frame = read(export_geoparquet(scene), tmp_path)
    expected = json.loads(export_geojson(scene))["features"]
    assert frame.crs is None and len(frame) == len(expected) and frame.geometry.is_valid.all()
    assert frame["name"].tolist() == [feature["properties"]["name"] for feature in expected]
    for row, feature in zip(frame.itertuples(), expected, strict=True):
        shape = shapely.geometry.shape(feature["geometry"])
        assert row.geometry.area == pytest.approx(shape.area, abs=0.01 + 1e-3 * shape.area)
    primitives = frame[frame["kind"] == "primitive"]
    assert np.allclose(primitives["height_m"], scene.size_m[:, 2]) and len(primitives) == len(scene)
    assert primitives["name"].tolist() == [CATEGORIES[k] for k in scene.category]


def test_world_outlines_have_the_pose_of_the_drive(tmp_path, town_drive_3):
    scene = town_drive_3.scene(20)
    frame = read(export_geoparquet(scene), tmp_path)
    world = geopandas.GeoSeries.from_wkb(frame["geometry_world"]) if frame["geometry_world"].dtype == object else (
        frame["geometry_world"])  # fmt: skip
    chosen = (frame["kind"] == "primitive").to_numpy()
    centers = np.stack([world[chosen].centroid.x, world[chosen].centroid.y], axis=1)
    pose = town_drive_3.pose(20)
    assert np.allclose(centers, pose.to_world(scene.center_m)[:, :2], atol=0.3)
    assert np.allclose(world.area, frame.geometry.area, rtol=1e-5)
    sampled = replace(scene, world_from_imu=None)
    assert "geometry_world" not in read(export_geoparquet(sampled), tmp_path).columns


def test_metadata_follow_the_specification():
    scene = replace(random_scene(0), attribution="someone")
    schema = pq.read_schema(io.BytesIO(export_geoparquet(scene)))
    geo = json.loads(schema.metadata[b"geo"])
    assert geo["version"] == "1.1.0" and geo["primary_column"] in geo["columns"]
    column = geo["columns"]["geometry"]
    assert column["encoding"] == "WKB" and column["crs"] is None and column["geometry_types"]
    assert schema.metadata[b"attribution"] == b"someone"
    nothing = scene.select(np.zeros(len(scene), bool))
    empty = replace(nothing, occupied=np.zeros_like(scene.occupied))
    assert pq.read_table(io.BytesIO(export_geoparquet(empty))).num_rows == 0
