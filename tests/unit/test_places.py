"""Tests of squares of maps as scenes, and of ground heights of maps."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import random_scene, small_spec
from osm_map import LATITUDE, LONGITUDE, make_town_street

from models.scene import CATEGORY_INDEX, Scene
from pipelines.io.opendrive import export_opendrive
from pipelines.preprocess.places import PlaceOptions, read_place
from pipelines.schema.attribution import ATTRIBUTIONS
from pipelines.schema.ground_surface import from_model_surface, to_model_surface

HERE = PlaceOptions((LATITUDE, LONGITUDE), 128.0)


def find_share(scene: Scene, name: str) -> float:
    return float(scene.occupied[scene.ground_classes.index(name)].mean())


def test_place_is_north_up_around_its_origin(tmp_path):
    path = make_town_street().write(tmp_path / "map.osm")
    scene = read_place(path, HERE, 0.5)
    assert scene.grid.front_m == scene.grid.left_m == 64.0 and scene.grid.rows == 256
    road = scene.occupied[scene.ground_classes.index("road")]
    rows = np.flatnonzero(road.any(axis=1))  # The street runs from west to east, through the middle.
    assert road.mean() == pytest.approx(7 / 128, abs=0.005) and np.abs(scene.grid.x_m()[rows]).max() < 4
    houses = scene.center_m[scene.category == CATEGORY_INDEX["construction_big"]]
    assert set(np.round(houses[:, 0], 1)) == {18.0, -18.0}  # To the north and to the south of the street.
    assert scene.attribution == ATTRIBUTIONS["osm"]
    turned = read_place(path, replace(HERE, heading_deg=90.0), 0.5)
    columns = np.flatnonzero(turned.occupied[turned.ground_classes.index("road")].any(axis=0))
    assert np.abs(scene.grid.y_m()[columns]).max() < 4


def test_unmapped_land_of_place_is_terrain_except_buildings(tmp_path):
    path = make_town_street().write(tmp_path / "map.osm")
    scene = read_place(path, HERE, 0.5)
    houses = 14 * 12 * 2 / (20 * 128)  # Share of the area.
    assert find_share(scene, "terrain") == pytest.approx(1 - 7 / 128 - houses, abs=0.02)
    heights = scene.height_m[scene.occupied]
    assert np.ptp(heights) == 0


def test_place_without_origin_lies_on_a_street(tmp_path):
    path = make_town_street().write(tmp_path / "map.osm")
    scene = read_place(path, replace(HERE, origin=None), 0.5)
    assert find_share(scene, "road") > 0.04
    other = tmp_path / "map.xodr"
    other.write_bytes(export_opendrive(scene))
    again = read_place(str(other), PlaceOptions(None, 64.0), 0.5)
    assert again.source == "opendrive" and find_share(again, "road") > 0.04
    assert again.occupied.any(axis=0).mean() > 0.95  # The rest is terrain.


def test_place_far_from_streets_is_refused(tmp_path):
    path = make_town_street().write(tmp_path / "map.osm")
    with pytest.raises(ValueError, match=r"no highway lies in the region|no street lies within"):
        read_place(path, replace(HERE, origin=(LATITUDE + 0.02, LONGITUDE)), 0.5)
    with pytest.raises(ValueError, match="no street lies within 64 m"):
        read_place(path, replace(HERE, origin=(LATITUDE + 0.0009, LONGITUDE)), 0.5)


def test_heights_change_between_reference_surfaces():
    top = replace(small_spec(), surface="top")
    scene = replace(random_scene(0, grid=top.grid), source="osm")
    raised = to_model_surface(scene, top)
    assert np.allclose(raised.height_m, scene.height_m + 0.3 * scene.occupied)
    assert np.allclose(from_model_surface(raised, scene, top).height_m, scene.height_m, atol=1e-6)
    for source in ("town", "kitti360", "generated-run"):
        assert to_model_surface(replace(scene, source=source), top).height_m is scene.height_m
    edited = replace(scene, source="edited-run", scene_id="osm-place-0000000001")
    assert np.array_equal(to_model_surface(edited, top).height_m, raised.height_m)
    level = replace(top, surface="surface")
    assert to_model_surface(scene, level) is scene
    lowered = to_model_surface(replace(scene, source="town"), level)
    assert np.allclose(lowered.height_m, scene.height_m - 0.3 * scene.occupied)
