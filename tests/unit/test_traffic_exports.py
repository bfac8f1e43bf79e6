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
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import trimesh
from helpers import ROOT
from lxml import etree
from scipy.spatial import cKDTree

from models.scene import CATEGORIES, Grid, Scene
from pipelines.geometry.parked_vehicles import find_driving_vehicles, find_parked_vehicles
from pipelines.io.animation import export_animation
from pipelines.io.mesh_export import GLTF_FROM_SCENE
from pipelines.io.mesh_import import import_glb
from pipelines.io.opendrive import export_opendrive
from pipelines.io.openscenario import export_openscenario
from pipelines.preprocess.sources.town.version2.town import make_large_crops
from pipelines.schema.columns import TRACKS
from pipelines.schema.tracks import find_time_step, list_road_users, select_tracks
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
    moving = {user.name for user in list_road_users(tracks)}
    assert len(names) == len(set(names)) and set(names) == still | moving
    assert {private.get("entityRef") for private in scenario.find("Storyboard/Init").iter("Private")} == still
    assert [actor.get("entityRef") for actor in scenario.iter("EntityRef")] == [u.name for u in list_road_users(tracks)]
    kinds = {child.tag for entity in scenario.iter("ScenarioObject") for child in entity}
    assert kinds == {"Vehicle", "MiscObject", "Pedestrian"}


def test_boxes_in_the_scenario_are_the_boxes_of_the_scene(scenario, town):
    """The box of an entity is given relative to its reference point; its centre is that of the primitive."""
    places = {
        private.get("entityRef"): {k: float(v) for k, v in next(private.iter("WorldPosition")).attrib.items()}
        for private in scenario.iter("Private")
    }
    boxes = {e.get("name"): e.find(".//BoundingBox") for e in scenario.iter("ScenarioObject")}
    for k in np.flatnonzero(~find_driving_vehicles(town)):
        name = f"{CATEGORIES[town.category[k]]}_{k:05d}"
        found = place_corners(places[name], boxes[name])
        local = np.array(list(product((-0.5, 0.5), repeat=3))) * town.size_m[k]
        expected = local @ town.rotation[k].T + town.center_m[k] + [0, 0, 0.3]
        assert cKDTree(found).query(expected)[0].max() < 0.03  # Turned by 180 degrees, a box is the same.


def place_corners(place: dict, box: etree._Element) -> np.ndarray:
    """Return the corners (8, 3) of a box by the rules of OpenSCENARIO: yaw about z, pitch about y, roll about x."""
    center = np.array([float(box.find("Center").get(axis)) for axis in "xyz"])
    size = np.array([float(box.find("Dimensions").get(axis)) for axis in ("length", "width", "height")])
    local = center + np.array(list(product((-0.5, 0.5), repeat=3))) * size
    (ch, cp, cr), (sh, sp, sr) = ([f(place[a]) for a in "hpr"] for f in (np.cos, np.sin))
    yaw = np.array([[ch, -sh, 0], [sh, ch, 0], [0, 0, 1]])
    pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return local @ (yaw @ pitch @ roll).T + [place[axis] for axis in "xyz"]


def test_fronts_of_entities_are_those_of_the_scene(town, tracks):
    """A heading along or against the length gives the front; a heading across it, as of signs, does not turn it."""
    parked = np.flatnonzero(find_parked_vehicles(town))[:3]
    for turn_rad in (0.0, np.pi, np.pi / 2):
        heading_rad = town.heading_rad.copy()
        heading_rad[parked] = town.yaw_rad[parked] + turn_rad
        root = etree.fromstring(export_openscenario(replace(town, heading_rad=heading_rad), tracks, "a.xodr"))
        found = {private.get("entityRef"): next(private.iter("WorldPosition")) for private in root.iter("Private")}
        for k in parked:
            h = float(found[f"{CATEGORIES[town.category[k]]}_{k:05d}"].get("h"))
            ahead = town.yaw_rad[k] + (np.pi if turn_rad == np.pi else 0.0)
            assert np.cos(h - ahead) == pytest.approx(1, abs=1e-5)


def test_vehicles_follow_the_table_on_the_ground(scenario, town, tracks):
    height_m = town.surface()[0]
    for user in list_road_users(tracks):
        group = next(g for g in scenario.iter("ManeuverGroup") if g.get("name").endswith(f" {user.name}"))
        starts = [float(c.get("value")) for c in group.iter("SimulationTimeCondition")]
        assert starts == [user.time_s[0], user.time_s[0], user.time_s[-1] + find_time_step([user])]
        timing = next(group.iter("Timing"))
        assert (timing.get("domainAbsoluteRelative"), timing.get("scale"), timing.get("offset")) == (
            "absolute",
            "1.0",
            "0.0",
        )
        entity = next(e for e in scenario.iter("ScenarioObject") if e.get("name") == user.name)
        size = [float(next(entity.iter("Dimensions")).get(name)) for name in ("length", "width", "height")]
        assert np.allclose(size, user.size_m, atol=1e-3)
        first = next(group.iter("AddEntityAction"))[0][0]
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
        assert np.abs(np.diff(yaw)).max(initial=0) < np.pi and np.allclose(np.cos(yaw - user.yaw_rad), 1, atol=1e-5)
        assert [float(first.get(a)) for a in "xyzh"] == [x[0], y[0], z[0], yaw[0]]


def test_scene_without_traffic_is_refused(town):
    for export in (
        lambda: export_openscenario(town, TRACKS.empty_table(), "a.xodr"),
        lambda: export_animation(town, TRACKS.empty_table()),
    ):
        with pytest.raises(ValueError, match="has no traffic to export"):
            export()


def test_texts_that_xml_forbids_are_replaced(town, tracks):
    odd = replace(town, scene_id="$a\x07b", attribution="c\x00d")
    root = etree.fromstring(export_openscenario(odd, tracks, "a.xodr"))
    assert root.find("FileHeader").get("description") == "Scene $a\ufffdb"
    assert root.find("FileHeader/License").get("name") == "c\ufffdd"
    assert etree.fromstring(export_opendrive(odd)).find("header").get("name") == "$a\ufffdb"


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
        number = nodes[user.name]
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
    original = np.flatnonzero(~find_driving_vehicles(town))  # Nodes have the numbers of the whole scene.
    assert set(shown) == {f"{CATEGORIES[town.category[k]]}_{k:04d}" for k in original} | {"ground"}
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
