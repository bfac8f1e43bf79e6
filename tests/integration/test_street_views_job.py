"""Tests of the jobs for street views and exports, on Ray."""

import json
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from models.scene import Scene
from pipelines.io.mesh_export import GROUND, build_painted_ground, triangulate_scene
from pipelines.preprocess.sources.town.generator import generate_town
from pipelines.runtime import storage
from pipelines.schema.palette import CATEGORY_IDS
from pipelines.schema.tables import Shard
from pipelines.traffic.dataset import make_tracks_table
from pipelines.traffic.tracks import Tracks


@pytest.fixture(scope="module")
def town_scenes() -> list[Scene]:
    return [generate_town(seed).scene(k, "test") for seed, k in ((3, 20), (4, 20), (8, 10))]


def make_tracks() -> Tracks:
    """Return two cars that drive ahead for 4 s."""
    time_s = np.tile(np.arange(5.0), 2)
    number = np.repeat([0, 1], 5)
    center_m = np.stack([5.0 + 8.0 * time_s, 4.0 * number, np.zeros(10)], axis=1)
    return Tracks(number, np.full(10, "car"), time_s, center_m, np.zeros(10), np.full(10, 8.0))


def test_street_view_and_export_jobs_process_table(town_scenes, tmp_path, cluster):
    from jobs.export_scenes import Config as ExportConfig
    from jobs.implementation.export_scenes import export
    from jobs.implementation.render_streets import render
    from jobs.render_streets import Config

    nothing = np.zeros_like(town_scenes[1].occupied)
    bare = replace(town_scenes[1], scene_id="bare", occupied=nothing, height_m=np.zeros(nothing.shape, np.float32))
    Shard(str(tmp_path), "town", "test", 0).write([town_scenes[0], bare])
    options = Config(input=str(tmp_path), max_scenes=2, spacing_m=8.0, width_px=176, height_px=47)
    frames = render(options)
    assert frames["bare"] == 0 and frames[town_scenes[0].scene_id] > 5
    where = tmp_path / "streets" / "drive" / town_scenes[0].scene_id
    about = json.loads((where / "cameras.json").read_text())
    assert len(about["frames"]) == len(list((where / "depth").glob("*.png"))) == frames[town_scenes[0].scene_id]
    first = about["frames"][0]
    camera_m = np.array(first["scene_from_camera"])[:3, 3]
    position = town_scenes[0].select(np.zeros(1, int))
    ground_m, _ = replace(position, center_m=camera_m[None].astype(np.float32)).ground_under()
    assert camera_m[2] - ground_m[0] == pytest.approx(1.55, abs=0.1)
    depth_m = np.asarray(Image.open(where / "depth" / "000000.png")) / about["depth_per_m"]
    ids = np.asarray(Image.open(where / "class_id" / "000000.png"))
    instances = np.asarray(Image.open(where / "instance" / "000000.png")).astype(int)
    assert depth_m.shape == ids.shape == (47, 176) and depth_m.max() > 20 and instances.max() <= len(town_scenes[0])
    assert (ids[instances > 0] == CATEGORY_IDS[town_scenes[0].category[instances[instances > 0] - 1]]).all()
    written = (where / "sheet.png").stat().st_mtime_ns
    assert render(options) == frames and (where / "sheet.png").stat().st_mtime_ns == written
    lost = where / "depth" / "000001.png"
    lost.unlink()  # The second run writes missing files again.
    assert render(options) == frames and lost.exists()
    with pytest.raises(ValueError, match=r"run 'drive' with spacing_m=8.0, asked for 2.0; choose another --run"):
        render(replace(options, spacing_m=2.0))

    output, counts, refused = export(ExportConfig(str(tmp_path), formats=("glb", "ply", "npz", "xodr", "geojson")))
    assert counts == {"glb": 2, "ply": 2, "npz": 2, "xodr": 1, "geojson": 2}
    assert list(refused) == ["bare"] and refused["bare"].startswith("xodr: scene bare has no road")
    with pytest.raises(ValueError, match=r"tracks.*no such file.*jobs/simulate_traffic.py, or pass its directory"):
        export(ExportConfig(str(tmp_path), formats=("animation",)))
    traffic = make_tracks_table(town_scenes[0].scene_id, make_tracks())
    storage.write_parquet(traffic, Shard(str(tmp_path / "simulated"), "town", "test", 0).path("tracks"))
    config = ExportConfig(str(tmp_path), formats=("xosc", "animation"), tracks=str(tmp_path / "simulated"))
    _, counts, refused = export(config)
    assert counts == {"xodr": 1, "xosc": 1, "animation": 1}
    reasons = [part.partition(":")[0] for part in refused["bare"].split("; ")]
    assert reasons == ["xodr", "xosc", "animation"] and "no traffic to export" in refused["bare"]
    scenario = ElementTree.parse(Path(output) / "xosc" / f"{town_scenes[0].scene_id}.xosc")
    roads = scenario.find("RoadNetwork/LogicFile").get("filepath")
    assert ElementTree.parse(Path(output) / "xosc" / roads).getroot().tag == "OpenDRIVE"
    assert sum(e.get("name").startswith("road_user") for e in scenario.iter("ScenarioObject")) == 2
    assert (Path(output) / "animation" / f"{town_scenes[0].scene_id}.glb").stat().st_size > 10_000
    path = Path(output)
    mesh = trimesh.load(path / "ply" / f"{town_scenes[0].scene_id}.ply", process=False)
    soup = triangulate_scene(town_scenes[0])
    objects = soup.corners_m[soup.primitive != GROUND]
    vertices_m, triangles, _ = build_painted_ground(town_scenes[0])
    truth = trimesh.Trimesh(
        np.concatenate([vertices_m, objects.reshape(-1, 3)]),
        np.concatenate([triangles, len(vertices_m) + np.arange(3 * len(objects)).reshape(-1, 3)]),
        process=False,
    )
    assert np.allclose(np.sort(mesh.area_faces), np.sort(truth.area_faces), atol=1e-3)
