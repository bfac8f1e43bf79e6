"""Street views against rays cast at the same mesh, roads against lines that are known, OpenDRIVE against its schema."""

import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from importlib.metadata import distribution
from pathlib import Path

import numpy as np
import pytest
import trimesh
from lxml import etree
from PIL import Image
from scenes import random_scene
from scipy.integrate import cumulative_trapezoid

from models.scene import ELLIPSOID, Grid, Scene
from pipelines.geometry.centerlines import drive, road_network
from pipelines.io.mesh_export import GROUND, scene_triangles
from pipelines.io.opendrive import lanes_of, reference_lines, scene_opendrive
from pipelines.preprocess.sources.town.generator import town_drive
from pipelines.rendering.pinhole import Lens, StreetCamera, StreetRenderer, shaded
from pipelines.schema.palette import CATEGORY_IDS, EMPTY
from pipelines.schema.tables import Shard

SMALL = Lens().resized(176, 47)


@pytest.fixture(scope="module")
def town_scenes() -> list[Scene]:
    return [town_drive(seed).scene(k, "test") for seed, k in ((3, 20), (4, 20), (8, 10))]


def rays(camera: StreetCamera) -> np.ndarray:
    """(h, w, 3) scene-frame directions whose camera z is 1."""
    lens = camera.lens
    u, v = np.meshgrid(np.arange(lens.width), np.arange(lens.height))
    local = np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones(u.shape)], axis=-1)
    return local @ camera.camera_from_scene


# --------------------------------------------------------------------------------------------------------- views


@pytest.mark.parametrize("seed", range(3))
def test_a_view_is_what_rays_meet(seed):
    """embree on the whole mesh; ellipsoids, facets there and round here, by their own quadratic."""
    scene = random_scene(seed, 60, tilt_rad=0.4)
    # Rays are cast at outsides only, as the renderer's: a camera inside a box sees out of it.
    camera = StreetCamera.at([1.0, 2.0, 3.0], 0.2, -0.1, SMALL)
    view, way = StreetRenderer(scene).view(camera), rays(camera)
    soup = scene_triangles(scene)
    flat = scene.category[soup.primitive.clip(0)] != ELLIPSOID
    flat |= soup.primitive == GROUND
    corners = soup.corners_m[flat]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = ((corners[:, 0] - camera.position_m) * normal).sum(axis=1) < 0
    mesh = trimesh.Trimesh(corners[facing].reshape(-1, 3), np.arange(3 * facing.sum()).reshape(-1, 3), process=False)
    directions = way.reshape(-1, 3)
    origins = np.tile(camera.position_m, (len(directions), 1))
    hit_m, ray, triangle = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    depth = np.full(len(directions), np.inf)
    depth[ray] = ((hit_m - camera.position_m) * directions[ray]).sum(axis=1) / (directions[ray] ** 2).sum(axis=1)
    primitive = np.full(len(directions), GROUND)
    primitive[ray] = soup.primitive[flat][facing][triangle]
    class_id = np.zeros(len(directions), np.uint8)
    class_id[ray] = soup.class_id[flat][facing][triangle]
    for index in np.flatnonzero(scene.category == ELLIPSOID):
        unit = (scene.rotation[index] * (2 / scene.size_m[index])).T.astype(float)
        d, p = directions @ unit.T, unit @ (scene.center_m[index] - camera.position_m)
        a, b, c = (d * d).sum(1), d @ p, p @ p - 1
        if camera.local(scene.center_m[index])[2] < 3.5 or c < 0:  # beside the camera, or around it: left out
            continue
        inside = b * b - a * c
        near = np.where((inside > 0) & (b > 0), (b - np.sqrt(np.maximum(inside, 0))) / a, np.inf)
        closer = near < depth
        depth[closer], primitive[closer], class_id[closer] = near[closer], index, CATEGORY_IDS[ELLIPSOID]
    same = np.isclose(view.depth_m.ravel(), depth, rtol=1e-3)
    assert same.mean() > 0.999 and np.isfinite(depth).mean() > 0.3
    assert (view.primitive.ravel() == primitive)[same].mean() > 0.999
    assert (view.class_id.ravel() == class_id)[same].mean() > 0.999
    assert (view.class_id[~np.isfinite(view.depth_m)] == EMPTY).all()
    assert (scene.category[view.primitive[view.primitive >= 0]] == ELLIPSOID).any()


def test_normals_point_at_the_camera_and_every_call_is_the_same(town_scenes):
    camera = StreetCamera.at([2.0, 0.0, 1.2], 0.0, lens=SMALL)
    renderer = StreetRenderer(town_scenes[0])
    view, again = renderer.view(camera), renderer.view(camera)
    seen = np.isfinite(view.depth_m)
    assert np.allclose(np.linalg.norm(view.normal[seen], axis=1), 1, atol=1e-4)
    assert ((view.normal * rays(camera)).sum(axis=-1)[seen] < 1e-4).all()
    for one, other in zip(view, again, strict=True):
        assert np.array_equal(one, other)
    assert shaded(view).shape == (47, 176, 3) and len(np.unique(shaded(view).reshape(-1, 3), axis=0)) > 50


def test_what_is_cut_by_the_near_plane_is_seen_up_to_it():
    """A long box beside the camera, from behind it to far ahead: its side fills the picture's left half."""
    scene = random_scene(0, 1, tilt_rad=0)
    box = {"category": np.array([6], np.int8), "center_m": np.array([[0, 3, 0]], np.float32), "label": None}
    box |= {"size_m": np.array([[100, 2, 8]], np.float32), "rotation": np.eye(3, dtype=np.float32)[None]}
    scene = replace(scene, occupied=np.zeros_like(scene.occupied), height_m=np.zeros_like(scene.height_m), **box)
    lens = Lens(100, 50, 50.0, 50.0, 49.5, 24.5)
    view = StreetRenderer(scene).view(StreetCamera.at([0, 0, 0], 0.0, lens=lens))
    u = np.arange(50)  # left half: the plane y = 2 m
    expected = 2 / ((49.5 - u) / 50.0)
    assert np.allclose(view.depth_m[25, :48], expected[:48], rtol=1e-4) and (view.primitive[:, 50:] == GROUND).all()


def test_half_the_pixels_show_the_same_view():
    full, half = Lens(), Lens().resized(704, 188)
    assert half.fx == pytest.approx(full.fx / 2)
    for corner in ((-0.5, -0.5), (1407.5, 375.5)):  # borders of the picture lie in the same directions
        there = ((corner[0] + 0.5) / 2 - 0.5 - half.cx) / half.fx, ((corner[1] + 0.5) / 2 - 0.5 - half.cy) / half.fy
        assert np.allclose(there, [(corner[0] - full.cx) / full.fx, (corner[1] - full.cy) / full.fy])


# --------------------------------------------------------------------------------------------------------- roads


def scene_of_roads(ways: list[np.ndarray], width_m: float, grid: Grid | None = None) -> Scene:
    """A scene whose road mask is all that lies within half a width of some lines (k, 2); it climbs by 2 %."""
    grid = grid or Grid()
    x, y = np.meshgrid(grid.x_m(), grid.y_m(), indexing="ij")
    road = np.zeros(x.shape, bool)
    for way in ways:
        for a, b in zip(way[:-1], way[1:], strict=True):
            along = ((x - a[0]) * (b - a)[0] + (y - a[1]) * (b - a)[1]) / ((b - a) @ (b - a))
            nearest = a[:, None, None] + along.clip(0, 1) * (b - a)[:, None, None]
            road |= np.hypot(x - nearest[0], y - nearest[1]) < width_m / 2
    scene = random_scene(0, 4, grid=grid)
    occupied = np.zeros_like(scene.occupied)
    occupied[0] = road
    return replace(scene, occupied=occupied, height_m=np.where(occupied, 0.02 * x, 0).astype(np.float32))


def off_m(points: np.ndarray, ways: list[np.ndarray]) -> np.ndarray:
    """(k,) distance of points (k, 2) from the nearest of the lines."""
    found = []
    for way in ways:
        for a, b in zip(way[:-1], way[1:], strict=True):
            along = ((points - a) @ (b - a) / ((b - a) @ (b - a))).clip(0, 1)
            found.append(np.linalg.norm(points - a - along[:, None] * (b - a), axis=1))
    return np.min(found, axis=0)


ANGLE = np.linspace(0, np.pi / 2, 30)
ARC = np.stack([10 + 40 * np.sin(ANGLE), 25 - 40 * (1 - np.cos(ANGLE))], axis=1)
STRAIGHT = np.array([[-20.0, 3.0], [90.0, 3.0]])
OBLIQUE = np.array([[-10.0, -40.0], [80.0, 40.0]])
SIDE = np.array([[30.0, 3.0], [30.0, 60.0]])


@pytest.mark.parametrize("way, width_m", [(STRAIGHT, 6.5), (OBLIQUE, 7.0), (ARC, 6.0)])
def test_one_road_is_its_centreline(way, width_m):
    network = road_network(scene_of_roads([way], width_m))
    (road,) = network.roads
    assert (road.start, road.end, len(network.nodes_m)) == (-1, -1, 0)
    assert off_m(road.xyz_m[:, :2], [way]).max() < 0.6
    assert np.median(np.abs(road.width_m - width_m)) < 0.6
    inner = road.xyz_m[(road.xyz_m[:, 0] > 8) & (road.xyz_m[:, 0] < 56)]
    assert np.abs(inner[:, 2] - 0.02 * inner[:, 0]).max() < 0.05
    steps = np.linalg.norm(np.diff(road.xyz_m[:, :2], axis=0), axis=1)
    assert np.abs(steps - 1).max() < 0.3


def test_a_side_street_makes_a_node_and_three_roads():
    network = road_network(scene_of_roads([STRAIGHT, SIDE], 6.5))
    assert len(network.roads) == 3 and len(network.nodes_m) == 1
    assert np.linalg.norm(network.nodes_m[0, :2] - [30, 3]) < 1.5
    assert len(network.leaving(0)) == 3 and sorted(r.start + r.end for r in network.roads) == [-1, -1, -1]
    for road in network.leaving(0):
        assert road.end == -1 and off_m(road.xyz_m[:, :2], [STRAIGHT, SIDE]).max() < 1.2


def test_a_crossing_is_one_node_and_rough_edges_make_no_roads():
    across = np.array([[34.0, -60.0], [34.0, 60.0]])
    scene = scene_of_roads([STRAIGHT, across], 7.0)
    network = road_network(scene)
    assert len(network.roads) == 4 and len(network.nodes_m) == 1 and len(network.leaving(0)) == 4
    rough = scene.occupied.copy()
    rng = np.random.default_rng(0)
    rough[0] &= rng.random(rough[0].shape) > 0.02  # pinholes
    rough[0, 5:9, 5:9] = True  # an island
    spotted = road_network(replace(scene, occupied=rough, height_m=np.where(rough, scene.height_m, 0)))
    assert len(spotted.roads) == 4
    nothing = np.zeros_like(scene.occupied)
    assert road_network(replace(scene, occupied=nothing, height_m=np.zeros_like(scene.height_m))).roads == ()


def test_a_drive_goes_straight_on_and_keeps_right():
    network = road_network(scene_of_roads([STRAIGHT, SIDE], 6.0))
    way = drive(network)
    assert len(drive(replace(network, roads=()))) == 0
    assert way[0, 0] < 2 and way[-1, 0] > 60  # past the side street
    inner = way[(way[:, 0] > 5) & ((way[:, 0] < 20) | (way[:, 0] > 42))]
    assert np.abs(inner[:, 1] - 1.5).max() < 0.5  # a quarter of 6 m right of y = 3
    assert (np.diff(way[:, 0]) > 0).all()
    left = drive(network, right=-0.25)
    assert left[10:20, 1].mean() > 4
    back = drive(network, start_m=(64.0, 3.0))
    assert back[0, 0] > 60 and back[-1, 0] < 4 and back[10:15, 1].mean() > 3.5  # right is the other side


# ----------------------------------------------------------------------------------------------------- OpenDRIVE


@pytest.fixture(scope="module")
def schema() -> etree.XMLSchema:
    path = distribution("asam-qc-opendrive").locate_file("qc_opendrive/schema/1.7.0/opendrive_17_core.xsd")
    return etree.XMLSchema(etree.parse(str(path)))


def sampled(road: ET.Element) -> tuple[np.ndarray, np.ndarray]:
    """(k, 3) points of a road's reference line and (k,) headings, as a reader of the standard computes them."""
    points, headings = [], []
    elevation = [{k: float(v) for k, v in e.attrib.items()} for e in road.iter("elevation")]
    for geometry in road.iter("geometry"):
        g = {k: float(v) for k, v in geometry.attrib.items()}
        p = {k: float(v) for k, v in geometry.find("paramPoly3").attrib.items() if k != "pRange"}
        t = np.linspace(0, 1, 401)
        u, v = (p[f"a{w}"] + p[f"b{w}"] * t + p[f"c{w}"] * t**2 + p[f"d{w}"] * t**3 for w in "UV")
        cos, sin = np.cos(g["hdg"]), np.sin(g["hdg"])
        x, y = g["x"] + cos * u - sin * v, g["y"] + sin * u + cos * v
        along = cumulative_trapezoid(np.hypot(np.gradient(x, t), np.gradient(y, t)), t, initial=0)
        assert along[-1] == pytest.approx(g["length"], rel=2e-3)
        s = g["s"] + t * g["length"]
        record = [e for e in elevation if e["s"] <= g["s"] + 1e-6][-1]
        ds = s - record["s"]
        z = record["a"] + record["b"] * ds + record["c"] * ds**2 + record["d"] * ds**3
        points.append(np.stack([x, y, z], axis=1))
        headings.append(np.arctan2(np.gradient(y, t), np.gradient(x, t)))
    for before, after in zip(points[:-1], points[1:], strict=True):
        assert np.abs(before[-1] - after[0]).max() < 1e-4  # joined
    return np.concatenate(points), np.concatenate(headings)


def test_files_follow_the_schema_and_the_centrelines(town_scenes, schema):
    counted = 0
    for scene in [*town_scenes, scene_of_roads([STRAIGHT, SIDE], 12.5)]:
        content = scene_opendrive(scene)
        schema.assertValid(etree.fromstring(content))
        network, root = road_network(scene), ET.fromstring(content)
        lines = reference_lines(network)
        roads = root.findall("road")
        assert root.find("header/offset").get("hdg") is not None and len(roads) >= len(lines)
        for element, road, line in zip(roads, network.roads, lines, strict=False):
            points, headings = sampled(element)
            way = road.xyz_m
            assert off_m(points[:, :2], [way[:, :2]]).max() < 0.5
            nearest = np.linalg.norm(points[:, None, :2] - way[None, :, :2], axis=2).argmin(axis=1)
            assert np.abs(points[:, 2] - way[nearest, 2]).max() < 0.1
            assert np.abs(np.angle(np.exp(1j * np.diff(headings)))).max() < 0.05  # smooth
            assert float(element.get("length")) == pytest.approx(line.length_m)
            width_m = [
                sum(float(lane.find("width").get("a")) for lane in element.findall(f"lanes/laneSection/{side}/lane"))
                for side in ("left", "right")
            ]
            assert sum(width_m) == pytest.approx(line.width_m[0], rel=1e-6)
            assert len(element.findall("lanes/laneSection/right/lane")) == lanes_of(line)
            counted += 1
    assert counted > 8


def test_ways_through_a_junction_join_the_lanes_of_its_roads(schema):
    root = ET.fromstring(scene_opendrive(scene_of_roads([STRAIGHT, SIDE], 6.5)))
    roads = {road.get("id"): road for road in root.findall("road")}
    (junction,) = root.findall("junction")
    connections = junction.findall("connection")
    assert len(connections) == 6 and len(roads) == 9
    for connection in connections:
        way = roads[connection.get("connectingRoad")]
        assert way.get("junction") == junction.get("id")
        points, headings = sampled(way)
        for which, name in ((0, "predecessor"), (-1, "successor")):
            link = way.find(f"link/{name}")
            other_points, other_headings = sampled(roads[link.get("elementId")])
            end = 0 if link.get("contactPoint") == "start" else -1
            assert np.abs(points[which] - other_points[end]).max() < 1e-3
            turn = headings[which] - other_headings[end]
            assert abs(np.sin(turn)) < 0.05  # in line with it, the one way or the other
            leads_on = (which == 0) == (end == -1)
            assert (np.cos(turn) > 0) == leads_on
        link = connection.find("laneLink")
        coming = roads[connection.get("incomingRoad")]
        at_end = way.find("link/predecessor").get("contactPoint") == "end"
        assert int(link.get("from")) == (-1 if at_end else 1) and link.get("to") == "-1"
        assert coming.find(f"link/{'successor' if at_end else 'predecessor'}").get("elementType") == "junction"


def test_a_scene_without_a_road_is_refused():
    scene = random_scene(0, 4)
    nothing = np.zeros_like(scene.occupied)
    with pytest.raises(ValueError, match="test-0000 has no road to export"):
        scene_opendrive(replace(scene, occupied=nothing, height_m=np.zeros_like(scene.height_m)))


# ---------------------------------------------------------------------------------------------------------- jobs


def test_streets_and_exports_of_a_table(town_scenes, tmp_path, cluster):
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
    with pytest.raises(ValueError, match=r"run 'drive' with spacing_m=8.0, asked for 2.0; choose another --run"):
        render(replace(options, spacing_m=2.0))

    output, counts, refused = export(ExportConfig(str(tmp_path), formats=("glb", "ply", "npz", "xodr")))
    assert counts == {"glb": 2, "ply": 2, "npz": 2, "xodr": 1}
    assert list(refused) == ["bare"] and refused["bare"].startswith("xodr: scene bare has no road")
    path = Path(output)
    mesh = trimesh.load(path / "ply" / f"{town_scenes[0].scene_id}.ply", process=False)
    soup = scene_triangles(town_scenes[0])
    assert len(mesh.faces) == len(soup.corners_m)
    assert np.allclose(
        np.sort(mesh.area_faces),
        np.sort(
            trimesh.Trimesh(
                soup.corners_m.reshape(-1, 3), np.arange(3 * len(soup.corners_m)).reshape(-1, 3), process=False
            ).area_faces
        ),
        atol=1e-3,
    )
