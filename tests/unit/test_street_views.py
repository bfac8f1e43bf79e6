"""Tests of street views (compared with ray casting), of centrelines, and of OpenDRIVE files (checked by their
schema)."""

import xml.etree.ElementTree as ET
from dataclasses import replace
from importlib.metadata import distribution

import numpy as np
import pytest
import shapely
import trimesh
from helpers import random_scene
from lxml import etree
from scipy.integrate import cumulative_trapezoid

from models.scene import ELLIPSOID, UNSET, Grid, Scene
from pipelines.geometry.centerlines import extract_road_network, plan_drive
from pipelines.geometry.ground_polygons import build_ground_polygons
from pipelines.io.mesh_export import GROUND, triangulate_scene
from pipelines.io.opendrive import export_opendrive, fit_reference_lines, list_lanes
from pipelines.preprocess.sources.town.generator import generate_town
from pipelines.rendering.pinhole import Lens, StreetCamera, StreetRenderer, shade_view
from pipelines.schema.palette import CATEGORY_IDS, EMPTY

SMALL = Lens().resize(176, 47)


@pytest.fixture(scope="module")
def town_scenes() -> list[Scene]:
    return [generate_town(seed).scene(k, "test") for seed, k in ((3, 20), (4, 20), (8, 10))]


def compute_rays(camera: StreetCamera) -> np.ndarray:
    """Return ray directions (h, w, 3) in the scene frame, with a camera z of 1."""
    lens = camera.lens
    u, v = np.meshgrid(np.arange(lens.width), np.arange(lens.height))
    local = np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones(u.shape)], axis=-1)
    return local @ camera.camera_from_scene


# --------------------------------------------------------------------------------------------------------- views


@pytest.mark.parametrize("seed", range(3))
def test_street_view_equals_ray_casting(seed):
    """The reference for boxes and ground is embree. The reference for ellipsoids is the exact quadric."""
    scene = random_scene(seed, 60, tilt_rad=0.4)
    # As in the renderer, a ray hits a face only from outside. A camera inside a box therefore sees through its faces.
    camera = StreetCamera.at([1.0, 2.0, 3.0], 0.2, -0.1, SMALL)
    view, way = StreetRenderer(scene).view(camera), compute_rays(camera)
    soup = triangulate_scene(scene)
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
        if (
            camera.local(scene.center_m[index])[2] < 3.5 or c < 0
        ):  # exclude ellipsoids that contain the camera or are near the camera
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


def test_street_view_normals_face_camera_and_are_deterministic(town_scenes):
    camera = StreetCamera.at([2.0, 0.0, 1.2], 0.0, lens=SMALL)
    renderer = StreetRenderer(town_scenes[0])
    view, again = renderer.view(camera), renderer.view(camera)
    seen = np.isfinite(view.depth_m)
    assert np.allclose(np.linalg.norm(view.normal[seen], axis=1), 1, atol=1e-4)
    assert ((view.normal * compute_rays(camera)).sum(axis=-1)[seen] < 1e-4).all()
    for one, other in zip(view, again, strict=True):
        assert np.array_equal(one, other)
    assert shade_view(view).shape == (47, 176, 3) and len(np.unique(shade_view(view).reshape(-1, 3), axis=0)) > 50


def test_street_view_clips_at_near_plane():
    """The side of a long box fills the left half of the picture. The box reaches from behind the camera to far
    ahead."""
    scene = random_scene(0, 1, tilt_rad=0)
    box = {"category": np.array([6], np.int8), "center_m": np.array([[0, 3, 0]], np.float32), "label": UNSET}
    box |= {"size_m": np.array([[100, 2, 8]], np.float32), "rotation": np.eye(3, dtype=np.float32)[None]}
    scene = replace(scene, occupied=np.zeros_like(scene.occupied), height_m=np.zeros_like(scene.height_m), **box)
    lens = Lens(100, 50, 50.0, 50.0, 49.5, 24.5)
    view = StreetRenderer(scene).view(StreetCamera.at([0, 0, 0], 0.0, lens=lens))
    u = np.arange(50)  # the left half of the picture shows the plane y = 2 m
    expected = 2 / ((49.5 - u) / 50.0)
    assert np.allclose(view.depth_m[25, :48], expected[:48], rtol=1e-4) and (view.primitive[:, 50:] == GROUND).all()


def test_street_view_at_half_resolution_shows_same_view():
    full, half = Lens(), Lens().resize(704, 188)
    assert half.fx == pytest.approx(full.fx / 2)
    for corner in ((-0.5, -0.5), (1407.5, 375.5)):  # the border rays are the same at both resolutions
        there = ((corner[0] + 0.5) / 2 - 0.5 - half.cx) / half.fx, ((corner[1] + 0.5) / 2 - 0.5 - half.cy) / half.fy
        assert np.allclose(there, [(corner[0] - full.cx) / full.fx, (corner[1] - full.cy) / full.fy])


# --------------------------------------------------------------------------------------------------------- roads


def make_scene_of_roads(ways: list[np.ndarray], width_m: float, grid: Grid | None = None) -> Scene:
    """Return a scene on a slope of 2 %. The road covers all points within width_m / 2 of the lines (k, 2)."""
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


def compute_distance_m(points: np.ndarray, ways: list[np.ndarray]) -> np.ndarray:
    """Return the distance (k,) of points (k, 2) from the nearest line in m."""
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
def test_centerlines_of_single_road_equal_its_axis(way, width_m):
    network = extract_road_network(make_scene_of_roads([way], width_m))
    (road,) = network.roads
    assert (road.start, road.end, len(network.nodes_m)) == (-1, -1, 0)
    assert compute_distance_m(road.xyz_m[:, :2], [way]).max() < 0.6
    assert np.median(np.abs(road.width_m - width_m)) < 0.6
    inner = road.xyz_m[(road.xyz_m[:, 0] > 8) & (road.xyz_m[:, 0] < 56)]
    assert np.abs(inner[:, 2] - 0.02 * inner[:, 0]).max() < 0.05
    steps = np.linalg.norm(np.diff(road.xyz_m[:, :2], axis=0), axis=1)
    assert np.abs(steps - 1).max() < 0.3


def test_centerlines_split_at_side_street():
    network = extract_road_network(make_scene_of_roads([STRAIGHT, SIDE], 6.5))
    assert len(network.roads) == 3 and len(network.nodes_m) == 1
    assert np.linalg.norm(network.nodes_m[0, :2] - [30, 3]) < 1.5
    assert len(network.list_leaving(0)) == 3 and sorted(r.start + r.end for r in network.roads) == [-1, -1, -1]
    for road in network.list_leaving(0):
        assert road.end == -1 and compute_distance_m(road.xyz_m[:, :2], [STRAIGHT, SIDE]).max() < 1.2


def test_centerlines_have_one_node_per_crossing_without_spurs():
    across = np.array([[34.0, -60.0], [34.0, 60.0]])
    scene = make_scene_of_roads([STRAIGHT, across], 7.0)
    network = extract_road_network(scene)
    assert len(network.roads) == 4 and len(network.nodes_m) == 1 and len(network.list_leaving(0)) == 4
    rough = scene.occupied.copy()
    rng = np.random.default_rng(0)
    rough[0] &= rng.random(rough[0].shape) > 0.02  # Small holes in the road.
    rough[0, 5:9, 5:9] = True  # A separate piece of road.
    spotted = extract_road_network(replace(scene, occupied=rough, height_m=np.where(rough, scene.height_m, 0)))
    assert len(spotted.roads) == 4
    nothing = np.zeros_like(scene.occupied)
    assert extract_road_network(replace(scene, occupied=nothing, height_m=np.zeros_like(scene.height_m))).roads == ()


def test_route_goes_straight_and_keeps_right():
    network = extract_road_network(make_scene_of_roads([STRAIGHT, SIDE], 6.0))
    way = plan_drive(network)
    assert len(plan_drive(replace(network, roads=()))) == 0
    assert way[0, 0] < 2 and way[-1, 0] > 60  # the drive passes the side street
    inner = way[(way[:, 0] > 5) & ((way[:, 0] < 20) | (way[:, 0] > 42))]
    assert np.abs(inner[:, 1] - 1.5).max() < 0.5  # the lane centre is 6 m / 4 = 1.5 m to the right of y = 3 m
    assert (np.diff(way[:, 0]) > 0).all()
    left = plan_drive(network, right=-0.25)
    assert left[10:20, 1].mean() > 4
    back = plan_drive(network, start_m=(64.0, 3.0))
    assert (
        back[0, 0] > 60 and back[-1, 0] < 4 and back[10:15, 1].mean() > 3.5
    )  # in the opposite direction, the right lane is on the other side


# ----------------------------------------------------------------------------------------------------- OpenDRIVE


@pytest.fixture(scope="module")
def schema() -> etree.XMLSchema:
    path = distribution("asam-qc-opendrive").locate_file("qc_opendrive/schema/1.7.0/opendrive_17_core.xsd")
    return etree.XMLSchema(etree.parse(str(path)))


def sample_reference_line(road: ET.Element) -> tuple[np.ndarray, np.ndarray]:
    """Return points (k, 3) and headings (k,) of the reference line of a road, as defined by OpenDRIVE."""
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
        assert np.abs(before[-1] - after[0]).max() < 1e-4  # geometries are continuous
    return np.concatenate(points), np.concatenate(headings)


def list_driving_lanes(road: ET.Element, side: str) -> list[ET.Element]:
    return [lane for lane in road.findall(f"lanes/laneSection/{side}/lane") if lane.get("type") == "driving"]


def test_opendrive_kerbs_lie_on_borders_of_road(town_scenes):
    gaps, walks = [], 0
    for scene in town_scenes:
        shapes = build_ground_polygons(scene)
        for line in fit_reference_lines(extract_road_network(scene), scene):
            place, ahead = line.curve(line.breaks)[:, :2], line.curve(line.breaks, 1)[:, :2]
            left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) / np.linalg.norm(ahead, axis=1, keepdims=True)
            kerbs = np.concatenate([place + line.sides_m[:, :1] * left, place - line.sides_m[:, 1:] * left])
            gaps += shapely.distance(shapes["road"].boundary, shapely.points(kerbs)).tolist()
            walks += int((line.sidewalks_m > 0).any(axis=0).sum())
        root = ET.fromstring(export_opendrive(scene))
        kinds = [lane.get("type") for lane in root.iter("lane")]
        marks = sum(mark.get("type") == "curb" for mark in root.iter("roadMark"))
        assert kinds.count("sidewalk") == marks > 0
    assert np.median(gaps) < 0.01 and np.mean(np.array(gaps) < 0.3) > 0.8 and walks > 5


def test_opendrive_follows_schema_and_centerlines(town_scenes, schema):
    counted = 0
    for scene in [*town_scenes, make_scene_of_roads([STRAIGHT, SIDE], 12.5)]:
        content = export_opendrive(scene)
        schema.assertValid(etree.fromstring(content))
        network, root = extract_road_network(scene), ET.fromstring(content)
        lines = fit_reference_lines(network, scene)
        roads = root.findall("road")
        assert root.find("header/offset").get("hdg") is not None and len(roads) >= len(lines)
        for element, road, line in zip(roads, network.roads, lines, strict=False):
            points, headings = sample_reference_line(element)
            way = road.xyz_m
            assert compute_distance_m(points[:, :2], [way[:, :2]]).max() < 0.5
            nearest = np.linalg.norm(points[:, None, :2] - way[None, :, :2], axis=2).argmin(axis=1)
            assert np.abs(points[:, 2] - way[nearest, 2]).max() < 0.1
            assert np.abs(np.angle(np.exp(1j * np.diff(headings)))).max() < 0.05  # headings change smoothly
            assert float(element.get("length")) == pytest.approx(line.length_m)
            width_m = [
                sum(float(lane.find("width").get("a")) for lane in list_driving_lanes(element, side))
                for side in ("left", "right")
            ]
            assert sum(width_m) == pytest.approx(line.width_m[0], rel=1e-6)
            assert len(list_driving_lanes(element, "right")) == list_lanes(line)
            counted += 1
    assert counted > 8


def test_opendrive_of_large_scenes_is_measured_in_parts(town_scenes, monkeypatch):
    for scene in town_scenes[:2]:
        network = extract_road_network(scene)
        whole = fit_reference_lines(network, scene)
        with monkeypatch.context() as patch:
            patch.setattr("pipelines.io.opendrive.MAX_PX", 100)
            parts = fit_reference_lines(network, scene)
        for one, other in zip(whole, parts, strict=True):
            assert np.abs(one.sides_m - other.sides_m).max() < 0.3
            assert np.median(np.abs(one.sides_m - other.sides_m)) < 0.01


def test_opendrive_junction_connects_lanes_of_its_roads(schema):
    root = ET.fromstring(export_opendrive(make_scene_of_roads([STRAIGHT, SIDE], 6.5)))
    roads = {road.get("id"): road for road in root.findall("road")}
    (junction,) = root.findall("junction")
    connections = junction.findall("connection")
    assert len(connections) == 6 and len(roads) == 9
    for connection in connections:
        way = roads[connection.get("connectingRoad")]
        assert way.get("junction") == junction.get("id")
        points, headings = sample_reference_line(way)
        for which, name in ((0, "predecessor"), (-1, "successor")):
            link = way.find(f"link/{name}")
            other_points, other_headings = sample_reference_line(roads[link.get("elementId")])
            end = 0 if link.get("contactPoint") == "start" else -1
            assert np.abs(points[which] - other_points[end]).max() < 1e-3
            turn = headings[which] - other_headings[end]
            assert abs(np.sin(turn)) < 0.05  # the roads are parallel and have the same or the opposite direction
            leads_on = (which == 0) == (end == -1)
            assert (np.cos(turn) > 0) == leads_on
        link = connection.find("laneLink")
        coming = roads[connection.get("incomingRoad")]
        at_end = way.find("link/predecessor").get("contactPoint") == "end"
        assert int(link.get("from")) == (-1 if at_end else 1) and link.get("to") == "-1"
        assert coming.find(f"link/{'successor' if at_end else 'predecessor'}").get("elementType") == "junction"


def test_opendrive_rejects_scene_without_road():
    scene = random_scene(0, 4)
    nothing = np.zeros_like(scene.occupied)
    with pytest.raises(ValueError, match="test-0000 has no road to export"):
        export_opendrive(replace(scene, occupied=nothing, height_m=np.zeros_like(scene.height_m)))
