"""Tests of simulated traffic: recorded files of SUMO, obstacles, tables and reports; slow tests run SUMO."""

import gzip
import shutil
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import shapely
from helpers import ROOT, make_straight_drive, random_scene

from models.scene import CATEGORY_INDEX, Grid, Scene, make_yaw_rotation
from pipelines.geometry.parked_vehicles import find_parked_vehicles, select_road
from pipelines.io.web_export import export_web_tracks
from pipelines.preprocess.sources.town.version2.town import make_large_crops
from pipelines.rendering.traffic_view import render_traffic
from pipelines.reporting.traffic_report import count_failures, render_traffic_html, summarise_traffic
from pipelines.schema.columns import TRACKS, TRAFFIC
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import Shard
from pipelines.traffic import dataset, sumo
from pipelines.traffic.dataset import TrafficRequest, make_tracks_table, make_traffic_row, simulate_part
from pipelines.traffic.demand import KINDS, Demand, make_routes
from pipelines.traffic.lateral import swerve
from pipelines.traffic.network import Network, read_network
from pipelines.traffic.obstacles import (
    close_roads,
    find_contacts,
    make_footprints,
    remove_occupied_road,
    select_footprints,
)
from pipelines.traffic.simulation import measure_health, put_on_ground, read_tracks, simulate_scene
from pipelines.traffic.sumo import find_sumo

GRID = Grid(128.0, 64.0, 0.5, 256, 256)
RECORDED = ROOT / "tests/data/traffic"
needs_sumo = pytest.mark.skipif(find_sumo() is None, reason="needs SUMO (extra traffic)")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    for path in RECORDED.glob("*.xml.gz"):
        (folder / path.stem).write_bytes(gzip.decompress(path.read_bytes()))
    return folder


@pytest.fixture(scope="module")
def network(recorded) -> Network:
    return read_network(recorded / "net.xml", GRID)


@pytest.fixture(scope="module")
def town() -> Scene:
    """The scene of the recorded files."""
    return next(iter(make_large_crops(1_000_001, 1, GRID)))


def make_street(cars: list[tuple[float, float, float]], width_m: float = 8.0) -> Scene:
    """Return a straight road along x in the middle of a scene, with cars at x and y with a yaw."""
    scene = random_scene(0, len(cars), grid=Grid(64.0, 32.0, 0.25, 256, 256))
    occupied = np.zeros_like(scene.occupied)
    occupied[scene.ground_classes.index("road")] = np.abs(scene.grid.y_m())[None, :] < width_m / 2
    category = np.full(len(cars), CATEGORY_INDEX["vehicle_small"], scene.category.dtype)
    return replace(
        scene,
        scene_id="street",
        occupied=occupied,
        height_m=np.zeros_like(scene.height_m),
        category=category,
        center_m=np.array([[x, y, 0.75] for x, y, _ in cars], np.float32).reshape(-1, 3),
        rotation=np.array([make_yaw_rotation(yaw) for *_, yaw in cars], np.float32).reshape(-1, 3, 3),
        size_m=np.tile(np.array([[4.4, 1.8, 1.5]], np.float32), (len(cars), 1)),
    )


# ------------------------------------------------------------------------------------------------ files of SUMO


def test_network_has_the_edges_and_links_of_the_file(recorded, network):
    root = ElementTree.parse(recorded / "net.xml").getroot()
    edges = [edge for edge in root.iter("edge") if edge.get("function") is None]
    driving = {edge.get("id") for edge in edges if any(lane.get("allow") != "pedestrian" for lane in edge.iter("lane"))}
    assert set(network.graph) == driving and len(driving) == 30
    walked = {edge.get("id") for edge in edges if any(lane.get("allow") == "pedestrian" for lane in edge.iter("lane"))}
    assert set(network.sidewalks) == walked
    assert network.entries and network.exits and network.count_unreachable() == 0
    for edge in network.entries:  # A route of SUMO begins there.
        x_m, y_m = network.lanes[edge][0].shape_m[0]
        assert min(GRID.front_m - x_m, x_m - GRID.back_m, GRID.left_m - y_m, y_m - GRID.right_m) < 5
    routes = ElementTree.parse(recorded / "routes.xml").getroot().iter("route")
    for route in (one.get("edges").split() for one in routes):
        assert all(network.graph.has_edge(*pair) for pair in zip(route[:-1], route[1:], strict=True))
        assert route[0] in network.entries and route[-1] in network.exits


def test_tracks_are_centres_of_the_recorded_vehicles(recorded):
    tracks = read_tracks(recorded / "fcd.xml")
    root = ElementTree.parse(recorded / "fcd.xml").getroot()
    rows = [(float(step.get("time")), user) for step in root.iter("timestep") for user in step]
    assert len(tracks) == len(rows) > 300
    time, user = next((time, user) for time, user in rows if user.tag == "vehicle" and user.get("type") == "car")
    k = np.flatnonzero((tracks.object_id == int(user.get("id"))) & (tracks.time_s == time))[0]
    front = np.array([float(user.get("x")), float(user.get("y"))])
    ahead = np.array([np.cos(tracks.yaw_rad[k]), np.sin(tracks.yaw_rad[k])])
    assert np.allclose(tracks.center_m[k, :2] + 2.2 * ahead, front, atol=1e-6)
    assert np.tan(np.radians(90 - float(user.get("angle")))) == pytest.approx(ahead[1] / ahead[0], rel=1e-6)
    for number in np.unique(tracks.object_id):  # The speed of SUMO is that of the positions.
        part = tracks.select((tracks.object_id == number) & tracks.is_vehicle)
        moved = np.linalg.norm(np.diff(part.center_m[:, :2], axis=0), axis=1)
        if len(moved) > 3:
            assert np.median(np.abs(moved - part.speed_mps[1:])) < 1.5


def test_health_agrees_with_the_recorded_statistics(recorded, network, town):
    parked = find_parked_vehicles(town)
    driving = ~parked & np.isin(town.category, [2, 3])
    routes = make_routes(network, town, driving, Demand(duration_s=40.0, vehicles_per_min=12.0), 0)
    tracks = read_tracks(recorded / "fcd.xml")
    health = measure_health(town, network, routes, parked, tracks, recorded)
    vehicles = ElementTree.parse(recorded / "statistics.xml").getroot().find("vehicles")
    trips = list(ElementTree.parse(recorded / "arrivals.xml").getroot().iter("tripinfo"))
    assert health.inserted == int(vehicles.get("inserted")) == len(np.unique(tracks.object_id[tracks.is_vehicle])) == 8
    assert health.arrived == len(trips) == 8 and health.teleports == health.collisions == 0
    assert health.mean_distance_m == pytest.approx(np.mean([float(trip.get("routeLength")) for trip in trips]))
    assert health.pedestrians == len(np.unique(tracks.object_id[~tracks.is_vehicle]))
    assert health.parked == parked.sum() > 20 and health.roads == 30


def test_routes_are_reproducible_and_reach_the_border(network, town):
    demand, nobody = Demand(), np.zeros(len(town), bool)
    first, again, other = (make_routes(network, town, nobody, demand, seed) for seed in (0, 0, 1))
    assert first.content == again.content != other.content
    assert first.routed == 40 and first.requested >= first.routed
    root = ElementTree.fromstring(first.content)
    departures = [float(user.get("depart")) for user in root if user.tag in ("vehicle", "person")]
    assert departures == sorted(departures) and max(departures) < demand.duration_s
    assert {vehicle.get("type") for vehicle in root.iter("vehicle")} <= set(KINDS)
    assert len(list(root.iter("person"))) == 12


def test_vehicles_in_traffic_start_at_their_places(network, town):
    edge, lanes = next((edge, lanes) for edge, lanes in network.lanes.items() if lanes[0].length_m > 20)
    shape = lanes[0].shape_m
    middle = len(shape) // 2
    yaw = np.arctan2(*(shape[middle + 1] - shape[middle])[1::-1])
    found = network.find_lane(shape[middle], float(yaw) + np.pi)  # Boxes have no front.
    assert found is not None and found[0] == edge
    along = np.linalg.norm(np.diff(shape[: middle + 1], axis=0), axis=1).sum()
    assert found[2] == pytest.approx(along, abs=0.01)
    assert network.find_lane(shape[middle], float(yaw) + np.pi / 2) is None


# ------------------------------------------------------------------------------------------------- obstacles


def test_vehicles_at_the_kerb_are_parked():
    scene = make_street([(20, 3.0, 0.0), (30, -3.1, np.pi), (40, 1.8, 0.0), (50, 8.0, 1.0)])
    assert find_parked_vehicles(scene).tolist() == [True, True, False, True]
    border = make_street([(62.5, 1.8, 0.0)])  # The road continues beyond the border of the scene.
    assert not find_parked_vehicles(border).any()


def test_parked_vehicles_take_road_and_can_block_it():
    free = make_street([(20, 3.0, 0.0)])
    parked = np.ones(1, bool)
    less = remove_occupied_road(free, parked)
    lost = select_road(free) & ~select_road(less)
    assert (lost.sum() * 0.25**2) == pytest.approx(4.6 * 2.0, rel=0.15)
    wide = remove_occupied_road(make_street([(20, 3.0, 0.0)]), np.zeros(1, bool))
    assert select_road(wide).all() == select_road(free).all()
    across = make_street([(20, 0.8, np.pi / 2)], width_m=5.0)  # 1.1 m and .5 m remain free.
    rows = select_road(remove_occupied_road(across, parked)).any(axis=1)
    assert not rows[np.abs(across.grid.x_m() - 20) < 0.8].any() and rows[np.abs(across.grid.x_m() - 20) > 4].all()


def test_closed_roads_lie_on_the_road():
    scene = make_street([])
    closed = close_roads(scene, 3)
    lost = select_road(scene) & ~select_road(closed)
    assert 0.1 < lost.sum() / select_road(scene).sum() < 0.9
    assert np.array_equal(closed.occupied[1:], scene.occupied[1:]) and np.array_equal(
        close_roads(scene, 3).occupied, closed.occupied
    )


def test_contacts_are_overlaps_of_boxes():
    boxes = make_footprints(np.array([[0.0, 0.0], [10.0, 0.0]]), np.array([0.0, np.pi / 4]), np.array([[4.0, 2.0]] * 2))
    assert shapely.area(boxes).tolist() == pytest.approx([8.0, 8.0])
    near = make_footprints(np.array([[3.9, 0.0]]), np.zeros(1), np.array([[4.0, 2.0]]))
    assert find_contacts(boxes, near).tolist() == [True, False]
    assert find_contacts(boxes, near[:0]).tolist() == [False, False]


def test_vehicles_swerve_around_parked_ones():
    scene = make_street([(20, 2.2, 0.0)])
    parked = np.ones(1, bool)
    before = make_straight_drive(2.0, speed_mps=8.0)
    after = swerve(before, scene, parked, 0.5)
    boxes = [make_footprints(t.center_m[:, :2], t.yaw_rad, t.size_m[:, :2]) for t in (before, after)]
    car = make_footprints(scene.center_m[:, :2], scene.yaw_rad, scene.size_m[:, :2])
    assert find_contacts(boxes[0], car).any() and not find_contacts(boxes[1], car).any()
    shift = after.center_m[:, 1] - before.center_m[:, 1]
    assert shift.min() < -0.5 and np.abs(shift[-3:]).max() < 0.3  # Far from the parked car.
    assert np.abs(np.diff(shift)).max() < 1.2 and np.allclose(after.center_m[:, 0], before.center_m[:, 0])
    walker = make_straight_drive(2.0, "pedestrian")
    assert np.array_equal(swerve(walker, scene, parked, 0.5).center_m, walker.center_m)


def test_road_users_stand_on_the_ground():
    scene = make_street([])
    slope = replace(scene, height_m=(scene.occupied * 0.05 * scene.grid.x_m()[:, None]).astype(np.float32))
    tracks = make_straight_drive()
    made = put_on_ground(tracks, slope, 0.3)
    assert np.allclose(made.center_m[:, 2], 0.05 * tracks.center_m[:, 0] + 0.75 - 0.3, atol=0.02)
    off_road = put_on_ground(make_straight_drive(y_m=20.0), slope, 0.0)  # The nearest ground is that of the road.
    assert np.allclose(off_road.center_m[:, 2], 0.05 * tracks.center_m[:, 0] + 0.75, atol=0.02)


def test_footprint_pixels_are_those_of_the_box():
    scene = make_street([(20, 3.0, 0.5)])
    pixels = select_footprints(scene, np.ones(1, bool))
    x_m, y_m = np.meshgrid(scene.grid.x_m(), scene.grid.y_m(), indexing="ij")
    inside = shapely.contains_xy(
        make_footprints(scene.center_m[:, :2], scene.yaw_rad, scene.size_m[:, :2])[0], x_m, y_m
    )
    assert (pixels != inside).sum() < 0.1 * inside.sum()


# -------------------------------------------------------------------------------------------- tables and pages


def test_tables_of_tracks_hold_all_positions(recorded, town):
    tracks = read_tracks(recorded / "fcd.xml")
    table = make_tracks_table("one", tracks)
    assert table.schema == TRACKS and len(table) == len(tracks)
    assert set(table["category"].to_pylist()) <= {"vehicle_small", "vehicle_big", "two_wheelers", "human"}
    assert np.allclose(table["x_m"].to_numpy(), tracks.center_m[:, 0], atol=1e-4)
    shown = export_web_tracks(table)
    assert len(shown) == len(np.unique(tracks.object_id)) and sum(len(one["places"]) for one in shown) == len(tracks)
    frames = render_traffic(town, table, 128)
    assert len(frames) > 30 and frames[0].shape == (128, 128, 3)
    assert any((frames[0] != frame).any() for frame in frames)


def make_rows(arrived: int, failure: str | None = None, control: bool = False) -> dict:
    counts = {name: 0 for name in TRAFFIC.names if TRAFFIC.field(name).type == pa.int32()}
    row = make_traffic_row("a", control, None, failure)
    return (
        row
        if failure
        else row | counts | {"inserted": 40, "routed": 40, "requested": 50, "roads": 10, "arrived": arrived}
    )


def test_scores_of_traffic_ignore_scenes_without_simulation():
    table = pa.Table.from_pylist([make_rows(40), make_rows(30), make_rows(0, "scene a has no road")], schema=TRAFFIC)
    scores = summarise_traffic(table)
    assert scores["arrived"].value == pytest.approx(70 / 80) and scores["arrived"].low < scores["arrived"].high
    assert scores["routed"].value == pytest.approx(0.8)
    assert count_failures(table) == {"the scene has no road": 1}
    nothing = table.slice(2)
    assert set(summarise_traffic(nothing).values()) == {None}
    html = render_traffic_html({"scenes": table, "control": nothing}, [], [], {"seed": 0})
    assert "the scene has no road" in html and "0.875" in html


def test_scene_without_road_is_a_failure_and_the_rest_continues(tmp_path, monkeypatch):
    empty = replace(make_street([]), occupied=np.zeros_like(make_street([]).occupied), scene_id="empty")
    shard = Shard(str(tmp_path), "town", "test", 0)
    shard.write([empty, make_street([])])
    tracks = make_straight_drive(1.0)
    real = dataset.simulate_scene

    def simulate(scene, *arguments):
        if scene.scene_id == "empty":
            return real(scene, *arguments)
        raise RuntimeError("bin/sumo of SUMO failed with code 139: Segmentation fault")

    monkeypatch.setattr(dataset, "simulate_scene", simulate)
    monkeypatch.setattr(dataset, "require_sumo", lambda: Path("sumo"))
    monkeypatch.setattr(dataset, "check_sumo", lambda home: None)
    monkeypatch.setattr("pipelines.traffic.simulation.require_sumo", lambda: Path("sumo"))
    found = simulate_part(dataset.Part(TrafficRequest(str(tmp_path), Demand(), control=False), shard, [0, 1]))
    reasons = [found.traffic[k]["failure"][0].as_py() for k in (0, 1)]
    assert reasons[0] == "scene empty has no road to export" and "Segmentation fault" in reasons[1]
    assert not len(found.tracks[0]) and len(tracks)


def test_missing_sumo_is_reported_before_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr(sumo, "find_sumo", lambda: None)
    Shard(str(tmp_path), "town", "test", 0).write([make_street([])])
    request = TrafficRequest(str(tmp_path), Demand())
    with pytest.raises(RuntimeError, match=r"install the extra traffic \(pip install 'pritti-on-ray\[traffic\]'\)"):
        dataset.simulate_dataset(request, SceneSubset(str(tmp_path)))


# ------------------------------------------------------------------------------------------------------- SUMO


@needs_sumo
@pytest.mark.slow
def test_simulation_is_reproducible_and_fails_on_closed_roads(town):
    demand = Demand(duration_s=60.0)
    (tracks, health), (again, same) = (simulate_scene(town, demand, 0, 0.3) for _ in range(2))
    assert health == same and np.array_equal(tracks.center_m, again.center_m)
    assert health.inserted >= 20 and health.arrived >= 0.95 * health.inserted and health.collisions == 0
    assert health.parked_contacts <= 0.5 * health.inserted
    other, _ = simulate_scene(town, demand, 1, 0.3)
    assert len(other) != len(tracks) or not np.array_equal(other.center_m, tracks.center_m)
    _, closed = simulate_scene(close_roads(town, 0), demand, 0, 0.3)
    assert closed.routed / closed.requested < 0.8 * health.routed / health.requested


@needs_sumo
@pytest.mark.slow
def test_damaged_network_is_a_clear_error(tmp_path, monkeypatch):
    shutil.copy(RECORDED / "net.xml.gz", tmp_path / "net.xml")
    with pytest.raises(RuntimeError, match=r"net\.xml of SUMO"):
        read_network(tmp_path / "net.xml", GRID)
    with pytest.raises(RuntimeError, match="of SUMO failed with code"):
        sumo.run_program(find_sumo(), "bin/netconvert", "--opendrive", tmp_path / "none.xodr")
