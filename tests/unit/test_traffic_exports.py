"""Tests of scenarios and animations: the schema of ASAM, Khronos' validator, and the positions in the files."""

import gzip
import io
import json
import shutil
import struct
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import trimesh
from helpers import ROOT
from lxml import etree

from models.scene import CATEGORIES, Grid, Scene
from pipelines.geometry.parked_vehicles import find_driving_vehicles
from pipelines.io.animation import export_animation
from pipelines.io.mesh_export import GLTF_FROM_SCENE
from pipelines.io.mesh_import import import_glb
from pipelines.io.openscenario import export_openscenario
from pipelines.preprocess.sources.town.version2.town import make_large_crops
from pipelines.schema.columns import TRACKS
from pipelines.schema.tracks import list_road_users, select_tracks
from pipelines.traffic.dataset import make_tracks_table
from pipelines.traffic.simulation import put_on_ground, read_tracks

xosc: Any = pytest.importorskip("scenariogeneration.xosc", reason="no scenariogeneration")
GRID = Grid(128.0, 64.0, 0.5, 256, 256)


@pytest.fixture(scope="module")
def town() -> Scene:
    """The scene of the recorded traffic, with a licence notice."""
    return replace(next(iter(make_large_crops(1_000_001, 1, GRID))), attribution="someone <&>")


@pytest.fixture(scope="module")
def tracks(town, tmp_path_factory) -> pa.Table:
    """Recorded traffic; objects stand 0.3 m below the ground heights."""
    path = tmp_path_factory.mktemp("recorded") / "fcd.xml"
    path.write_bytes(gzip.decompress((ROOT / "tests/data/traffic/fcd.xml.gz").read_bytes()))
    return make_tracks_table(town.scene_id, put_on_ground(read_tracks(path), town, 0.3))


@pytest.fixture(scope="module")
def scenario(town, tracks) -> etree._Element:
    return etree.fromstring(export_openscenario(town, tracks, "../xodr/town.xodr"))


def test_road_users_are_the_rows_of_the_table(tracks):
    users = list_road_users(tracks)
    assert sum(len(user.time_s) for user in users) == len(tracks) > 300
    assert [user.object_id for user in users] == sorted(set(tracks["object_id"].to_pylist()))
    rows = tracks.filter(pa.array(tracks["object_id"].to_numpy() == users[3].object_id))
    assert users[3].time_s.tolist() == rows["time_s"].to_pylist()
    assert users[3].center_m[:, 1].tolist() == rows["y_m"].to_pylist()
    assert users[3].category == rows["category"][0].as_py()
    assert list_road_users(TRACKS.empty_table()) == []
    assert len(select_tracks(tracks, "elsewhere")) == 0


# ----------------------------------------------------------------------------------------------- OpenSCENARIO


def test_scenario_is_valid_openscenario(scenario, town):
    path = distribution("scenariogeneration").locate_file("schemas/OpenSCENARIO_1_2.xsd")
    etree.XMLSchema(etree.parse(str(path))).assertValid(scenario)
    header = scenario.find("FileHeader")
    assert (header.get("revMinor"), header.find("License").get("name")) == ("2", "someone <&>")
    assert scenario.find("RoadNetwork/LogicFile").get("filepath") == "../xodr/town.xodr"
    xosc.Scenario.parse(xosc_element(scenario))  # The package can read what it wrote.
    broken = etree.fromstring(etree.tostring(scenario))
    broken.find("Entities").append(etree.Element("Entity"))
    assert not etree.XMLSchema(etree.parse(str(path))).validate(broken)


def xosc_element(root: etree._Element) -> Any:
    """Return an lxml element as an element of the standard library."""
    import xml.etree.ElementTree as ElementTree

    return ElementTree.fromstring(etree.tostring(root))


def test_scenario_has_all_objects_and_road_users_once(scenario, town, tracks):
    names = [entity.get("name") for entity in scenario.iter("ScenarioObject")]
    still = {f"{CATEGORIES[town.category[k]]}_{k:05d}" for k in np.flatnonzero(~find_driving_vehicles(town))}
    moving = {f"road_user_{user.object_id:05d}" for user in list_road_users(tracks)}
    assert len(names) == len(set(names)) and set(names) == still | moving
    assert {private.get("entityRef") for private in scenario.find("Storyboard/Init").iter("Private")} == still
    assert [actor.get("entityRef") for actor in scenario.iter("EntityRef")] == sorted(moving)
    kinds = {child.tag for entity in scenario.iter("ScenarioObject") for child in entity}
    assert kinds == {"Vehicle", "MiscObject", "Pedestrian"}


def test_boxes_in_the_scenario_are_the_boxes_of_the_scene(scenario, town):
    """The box of an entity is given relative to its reference point; its centre is that of the primitive."""
    places = {
        private.get("entityRef"): {k: float(v) for k, v in next(private.iter("WorldPosition")).attrib.items()}
        for private in scenario.iter("Private")
    }
    boxes = {e.get("name"): e.find(".//BoundingBox") for e in scenario.iter("ScenarioObject")}
    for k in np.flatnonzero(~find_driving_vehicles(town))[::5]:
        name = f"{CATEGORIES[town.category[k]]}_{k:05d}"
        place, box = places[name], boxes[name]
        x, y, z = (float(box.find("Center").get(axis)) for axis in "xyz")
        cos, sin = np.cos(place["h"]), np.sin(place["h"])
        found = [place["x"] + cos * x - sin * y, place["y"] + sin * x + cos * y, place["z"] + z]
        assert np.allclose(found, town.center_m[k] + [0, 0, 0.3], atol=0.03)
        size = [float(box.find("Dimensions").get(axis)) for axis in ("length", "width", "height")]
        assert np.allclose(size, town.size_m[k], atol=1e-3)


def test_vehicles_follow_the_table_on_the_ground(scenario, town, tracks):
    height_m = town.surface()[0]
    for user in list_road_users(tracks):
        group = next(g for g in scenario.iter("ManeuverGroup") if g.get("name").endswith(f"{user.object_id:05d}"))
        starts = [float(c.get("value")) for c in group.iter("SimulationTimeCondition")]
        assert starts[0] == starts[1] == user.time_s[0] and starts[-1] > user.time_s[-1]
        vertices = list(group.iter("Vertex"))
        assert np.allclose([float(v.get("time")) for v in vertices], user.time_s, atol=1e-4)
        x, y, z, yaw = np.array([[float(v[0][0].get(a)) for a in "xyzh"] for v in vertices]).T
        axle_m = 0.3 * user.size_m[0] if user.category != "human" else 0.0
        center_m = np.stack([x + axle_m * np.cos(yaw), y + axle_m * np.sin(yaw)], axis=1)
        assert np.allclose(center_m, user.center_m[:, :2], atol=1e-3)
        row, col = town.grid.pixel(user.center_m[:, 0], user.center_m[:, 1])
        inside = (row >= 0) & (col >= 0) & (row < town.grid.rows) & (col < town.grid.cols)
        ground_m = height_m[row.clip(0, 255), col.clip(0, 255)]
        assert np.median(np.abs(z - ground_m)[inside]) < 0.05  # Wheels stand on the road of the OpenDRIVE file.
        assert np.abs(np.diff(yaw)).max(initial=0) < np.pi


def test_scene_without_traffic_is_refused(town):
    for export in (
        lambda: export_openscenario(town, TRACKS.empty_table(), "a.xodr"),
        lambda: export_animation(town, TRACKS.empty_table()),
    ):
        with pytest.raises(ValueError, match="has no traffic to export"):
            export()


def test_missing_package_is_named(town, tracks, monkeypatch):
    monkeypatch.setitem(sys.modules, "scenariogeneration.xosc", None)
    with pytest.raises(ValueError, match=r"pritti-on-ray\[openscenario\]"):
        export_openscenario(town, tracks, "a.xodr")


# -------------------------------------------------------------------------------------------------- animation


@pytest.fixture(scope="module")
def animation(town, tracks) -> bytes:
    return export_animation(town, tracks)


def read_chunks(content: bytes) -> tuple[dict, bytes]:
    size = struct.unpack_from("<I", content, 12)[0]
    return json.loads(content[20 : 20 + size]), content[28 + size :]


def read_accessor(tree: dict, numbers: bytes, index: int) -> np.ndarray:
    accessor = tree["accessors"][index]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    start = tree["bufferViews"][accessor["bufferView"]]["byteOffset"]
    values = np.frombuffer(numbers, "<f4", accessor["count"] * width, start)
    return values.reshape(-1, width)


def test_animation_passes_khronos_validator(animation, tmp_path):
    modules = Path(sys.prefix) / "npm" / "node_modules"  # The Makefile installs the validator if npm exists.
    if not (shutil.which("node") and modules.is_dir()):
        pytest.skip("no node, or no gltf-validator in .venv/npm")
    path = tmp_path / "a.glb"
    path.write_bytes(animation)
    script = Path(__file__).with_name("validate_glb.js")
    done = subprocess.run(["node", script, modules, path], capture_output=True, text=True, check=True)
    (report,) = json.loads(done.stdout)
    assert report["issues"]["messages"] == [] and report["info"]["animationCount"] == 1


def test_animated_nodes_follow_the_table(animation, tracks):
    """Between two times of the table, a node is between the two positions, and it is visible only then."""
    tree, numbers = read_chunks(animation)
    (moves,) = tree["animations"]
    channels = {(c["target"]["node"], c["target"]["path"]): moves["samplers"][c["sampler"]] for c in moves["channels"]}
    nodes = {node["name"]: number for number, node in enumerate(tree["nodes"])}
    for user in list_road_users(tracks):
        number = nodes[f"road_user_{user.object_id:04d}"]
        curves = {
            path: [read_accessor(tree, numbers, channels[number, path][end]) for end in ("input", "output")]
            for path in ("translation", "rotation", "scale")
        }
        times_s, centers_m = curves["translation"]
        assert np.array_equal(times_s[:, 0], user.time_s) and np.array_equal(centers_m, user.center_m)
        x, y, z, w = curves["rotation"][1].T
        assert np.allclose([x, y], 0) and np.allclose(np.hypot(z, w), 1)
        assert np.allclose(np.exp(1j * 2 * np.arctan2(z, w)), np.exp(1j * user.yaw_rad), atol=1e-5)
        assert (z[1:] * z[:-1] + w[1:] * w[:-1] > 0).all()
        (seen_s, sizes_m) = curves["scale"]
        assert channels[number, "scale"]["interpolation"] == "STEP"
        for time_s, size_m in ((user.time_s[0], user.size_m), (user.time_s[-1], user.size_m), (1e4, np.zeros(3))):
            at = np.searchsorted(seen_s[:, 0], time_s, side="right") - 1
            assert np.allclose(sizes_m[at], size_m)
        if user.time_s[0] > 0:
            assert seen_s[0, 0] == 0 and (sizes_m[0] == 0).all()


def test_animation_without_player_is_the_scene_without_traffic(animation, town):
    loaded = trimesh.load_scene(io.BytesIO(animation), file_type="glb")
    still = town.select(~find_driving_vehicles(town))
    shown = [name for name in loaded.graph.nodes_geometry if not name.startswith("road_user_")]
    assert len(shown) == len(still) + 1
    for name in loaded.graph.nodes_geometry:
        if name.startswith("road_user_"):
            assert np.allclose(loaded.graph[name][0][:3, :3], 0)
    back = import_glb(animation)
    assert np.array_equal(back.category, still.category) and np.allclose(back.center_m, still.center_m, atol=1e-4)
    scene_node = loaded.graph["scene"][0]
    assert np.allclose(scene_node, GLTF_FROM_SCENE)


def test_road_user_with_one_position_appears(town, tracks):
    one = tracks.slice(0, 1)
    root = etree.fromstring(export_openscenario(town, one, "a.xodr"))
    path = distribution("scenariogeneration").locate_file("schemas/OpenSCENARIO_1_2.xsd")
    etree.XMLSchema(etree.parse(str(path))).assertValid(root)
    assert not list(root.iter("Vertex")) and len(list(root.iter("AddEntityAction"))) == 1
    tree, _ = read_chunks(export_animation(town, one))
    assert len(tree["animations"][0]["channels"]) == 3
