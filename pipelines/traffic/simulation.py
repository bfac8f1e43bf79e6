"""Simulate the traffic of one scene: trajectories of vehicles and pedestrians, and the health of the road network."""

from __future__ import annotations

import tempfile
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

from models.scene import CATEGORY_INDEX, VEHICLES, Scene
from pipelines.geometry.masks import find_nearest_true
from pipelines.geometry.parked_vehicles import find_parked_vehicles
from pipelines.traffic.demand import KINDS, Demand, Routes, make_routes
from pipelines.traffic.lateral import swerve
from pipelines.traffic.network import Network, build_network
from pipelines.traffic.obstacles import find_contacts, make_footprints, remove_occupied_road
from pipelines.traffic.sumo import read_float, read_xml, require_sumo, run_program
from pipelines.traffic.tracks import Tracks

TELEPORT_S = 60.0  # SUMO removes a vehicle that has waited for this time from the jam, and counts it.
STEP_S = 0.25  # Time step of SUMO.
TOUCH_M = 0.1  # Vehicles touch an object if they overlap it by more than this distance.
FIXED = tuple(CATEGORY_INDEX[name] for name in ("construction_big", "construction_small", "pole", "object"))


@dataclass(frozen=True)
class TrafficHealth:
    """What happened to the vehicles of a scene.

    Attributes:
        roads: Number of edges: directions of roads.
        one_way_roads: Number of roads that are too narrow for two directions between parked vehicles.
        unreachable_roads: Number of edges on which no vehicle can drive from an entry to an exit.
        network_warnings: Number of warnings of netconvert.
        requested: Number of pairs of an entry and an exit of the scene that were drawn.
        routed: Number of these pairs with a route. Each is a vehicle.
        inserted: Number of vehicles that SUMO inserted, with those that start in the scene.
        arrived: Number of inserted vehicles that left the scene, without teleports.
        teleports: Number of times that SUMO moved a vehicle out of a jam.
        collisions: Number of collisions between vehicles.
        pedestrian_collisions: Number of collisions of vehicles and pedestrians.
        parked: Number of parked vehicles of the scene.
        parked_contacts: Number of vehicles that touched a parked vehicle.
        fixed_contacts: Number of vehicles that touched a building, wall, pole or other object.
        pedestrians: Number of inserted pedestrians.
        mean_distance_m: Mean length of the ways of the arrived vehicles (m); NaN without such vehicles.
        mean_speed_mps: Mean speed of the arrived vehicles (m/s).
    """

    roads: int
    one_way_roads: int
    unreachable_roads: int
    network_warnings: int
    requested: int
    routed: int
    inserted: int
    arrived: int
    teleports: int
    collisions: int
    pedestrian_collisions: int
    parked: int
    parked_contacts: int
    fixed_contacts: int
    pedestrians: int
    mean_distance_m: float
    mean_speed_mps: float


def simulate_scene(scene: Scene, demand: Demand, seed: int, slab_offset_m: float) -> tuple[Tracks, TrafficHealth]:
    """Simulate the traffic of a scene.

    The result depends only on the arguments. Parked vehicles are obstacles (obstacles.py).

    Args:
        scene: Scene.
        demand: Traffic.
        seed: Seed; the traffic depends on it and on the id of the scene.
        slab_offset_m: Height of the ground raster above the surface on which objects stand (m).

    Returns:
        Trajectories and health.

    Raises:
        ValueError: The scene has no road, or no route leads through its roads.
        RuntimeError: SUMO is not installed, or one of its programs fails.
    """
    home = require_sumo()
    seed = (zlib.crc32(scene.scene_id.encode()) + seed) % 2**31
    parked = find_parked_vehicles(scene)
    driving = np.isin(scene.category, VEHICLES) & ~parked
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        network = build_network(remove_occupied_road(scene, parked), home, folder)
        routes = make_routes(network, scene, driving, demand, seed)
        (folder / "routes.xml").write_bytes(routes.content)
        run_sumo(home, network.path, folder, demand, seed)
        tracks = read_tracks(folder / "fcd.xml")
        tracks = swerve(tracks, scene, parked | np.isin(scene.category, FIXED), demand.time_step_s)
        tracks = put_on_ground(tracks, scene, slab_offset_m)
        health = measure_health(scene, network, routes, parked, tracks, folder)
    return tracks, health


def run_sumo(home: Path, network: Path, folder: Path, demand: Demand, seed: int) -> None:
    """Run the simulation.

    Args:
        home: Home directory of SUMO.
        network: File of the network.
        folder: Directory with routes.xml, in which SUMO writes fcd.xml, arrivals.xml, statistics.xml and
            collisions.xml.
        demand: Traffic.
        seed: Seed.

    Raises:
        RuntimeError: SUMO fails.
    """
    files = ("--net-file", network, "--route-files", folder / "routes.xml")
    written = {"--fcd-output": "fcd.xml", "--tripinfo-output": "arrivals.xml", "--statistic-output": "statistics.xml"}
    outputs = [part for option, name in written.items() for part in (option, folder / name)]
    times = ("--step-length", STEP_S, "--device.fcd.period", demand.time_step_s)
    times += ("--end", demand.duration_s + demand.drain_s)
    safety = ("--time-to-teleport", TELEPORT_S, "--collision.action", "warn", "--collision.check-junctions")
    safety += ("--collision-output", folder / "collisions.xml")
    # Pedestrians and vehicles that wait for each other would block a junction.
    safety += ("--pedestrian.striping.jamtime", 5, "--pedestrian.striping.jamtime.crossing", 1)
    safety += ("--pedestrian.striping.jamtime.narrow", 1)
    quiet = ("--no-step-log", "--no-warnings", "--ignore-route-errors", "--precision", 3)
    run_program(home, "bin/sumo", *files, *outputs, *times, *safety, *quiet, "--seed", seed)


def put_on_ground(tracks: Tracks, scene: Scene, slab_offset_m: float) -> Tracks:
    """Set the heights of road users to those of the ground.

    Args:
        tracks: Trajectories.
        scene: Scene.
        slab_offset_m: Height of the ground raster above the surface on which objects stand (m).

    Returns:
        Trajectories.
    """
    height_m, classes = scene.surface()
    known = classes >= 0
    ground_m = height_m[find_nearest_true(known)] if known.any() else height_m
    row = (scene.grid.front_m - tracks.center_m[:, 0]) / scene.grid.resolution_m - 0.5
    col = (scene.grid.left_m - tracks.center_m[:, 1]) / scene.grid.resolution_m - 0.5
    center_m = tracks.center_m.copy()
    center_m[:, 2] = map_coordinates(ground_m.astype(float), [row, col], order=1, mode="nearest")
    center_m[:, 2] += tracks.size_m[:, 2] / 2 - slab_offset_m
    return replace(tracks, center_m=center_m)


def read_tracks(path: Path) -> Tracks:
    """Read the trajectories that SUMO writes with --fcd-output.

    SUMO states the middle of the front of a vehicle, and the compass direction.

    Args:
        path: XML file.

    Returns:
        Trajectories, ordered by road user and time, at height 0.
    """
    rows, kinds = [], []
    for step in read_xml(path).iterfind("timestep"):
        time_s = read_float(step, "time")
        for user in step:
            place = (read_float(user, key) for key in ("x", "y", "angle", "speed"))
            rows.append((read_float(user, "id"), time_s, *place))
            kinds.append(user.get("type") or "pedestrian")
    table = np.array(rows, float).reshape(-1, 6)
    kind = np.array(kinds, dtype="<U16")
    order = np.lexsort([table[:, 1], table[:, 0]])
    table, kind = table[order], kind[order]
    yaw = (np.pi / 2 - np.deg2rad(table[:, 4]) + np.pi) % (2 * np.pi) - np.pi
    size_m = np.array([KINDS[name].size_m for name in kind]).reshape(-1, 3)
    center = np.pad(table[:, 2:4], ((0, 0), (0, 1)))
    back_m = np.where(kind == "pedestrian", 0.0, size_m[:, 0] / 2)
    center[:, :2] -= back_m[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    return Tracks(table[:, 0].astype(np.int64), kind, table[:, 1], center, yaw, table[:, 5])


def measure_health(
    scene: Scene, network: Network, routes: Routes, parked: np.ndarray, tracks: Tracks, folder: Path
) -> TrafficHealth:
    """Measure the health of a simulation.

    Args:
        scene: Scene.
        network: Network.
        routes: Road users.
        parked: (n,) bool mask of the parked vehicles.
        tracks: Trajectories.
        folder: Directory with the files arrivals.xml, statistics.xml and collisions.xml of SUMO.

    Returns:
        Health.
    """
    root = read_xml(folder / "statistics.xml")

    def count(element: str, name: str) -> int:
        found = root.find(element)
        return 0 if found is None else int(read_float(found, name))

    trips = [trip for trip in read_xml(folder / "arrivals.xml").iterfind("tripinfo") if not trip.get("vaporized")]
    distance, duration = (np.array([read_float(trip, name) for trip in trips]) for name in ("routeLength", "duration"))
    hits = list(read_xml(folder / "collisions.xml").iterfind("collision"))
    on_foot = sum("pedestrian" in (hit.get("victimType"), hit.get("colliderType")) for hit in hits)
    vehicles = tracks.select(tracks.is_vehicle)
    size_m = vehicles.size_m[:, :2] - 2 * TOUCH_M
    footprints = make_footprints(vehicles.center_m[:, :2], vehicles.yaw_rad, size_m)
    contacts = []
    for found in (parked, np.isin(scene.category, FIXED)):
        others = scene.select(found)
        shapes = make_footprints(others.center_m[:, :2], others.yaw_rad, others.size_m[:, :2])
        contacts.append(len(np.unique(vehicles.object_id[find_contacts(footprints, shapes)])))
    return TrafficHealth(
        roads=len(network.graph),
        one_way_roads=network.num_one_way,
        unreachable_roads=network.count_unreachable(),
        network_warnings=network.num_warnings,
        requested=routes.requested,
        routed=routes.routed,
        inserted=count("vehicles", "inserted"),
        arrived=max(0, len(trips) - count("teleports", "total")),
        teleports=count("teleports", "total"),
        collisions=len(hits) - on_foot,
        pedestrian_collisions=on_foot,
        parked=int(parked.sum()),
        parked_contacts=contacts[0],
        fixed_contacts=contacts[1],
        pedestrians=len(np.unique(tracks.object_id[~tracks.is_vehicle])),
        mean_distance_m=float(distance.mean()) if len(distance) else float("nan"),
        mean_speed_mps=float((distance / np.maximum(duration, 1e-3)).mean()) if len(distance) else float("nan"),
    )
