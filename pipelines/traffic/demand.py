"""Vehicles and pedestrians that a simulation inserts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple
from xml.etree import ElementTree as ET

import networkx as nx
import numpy as np

from models.scene import VEHICLES, Scene
from pipelines.traffic.network import Network


class Kind(NamedTuple):
    """A type of road user.

    Attributes:
        category: Category of the object.
        sumo_class: Class of SUMO.
        size_m: Length, width and height (m).
        share: Share of the vehicles.
    """

    category: str
    sumo_class: str
    size_m: tuple[float, float, float]
    share: float


KINDS = {
    "car": Kind("vehicle_small", "passenger", (4.4, 1.8, 1.5), 0.86),
    "truck": Kind("vehicle_big", "delivery", (7.0, 2.3, 2.9), 0.06),
    "bicycle": Kind("two_wheelers", "bicycle", (1.8, 0.6, 1.7), 0.08),
    "pedestrian": Kind("human", "pedestrian", (0.6, 0.6, 1.75), 0.0),
}


@dataclass(frozen=True)
class Demand:
    """Traffic to simulate.

    Attributes:
        duration_s: Time in which vehicles are inserted (s).
        vehicles_per_min: Vehicles that enter the scene per minute.
        pedestrians_per_min: Pedestrians that start to walk per minute.
        time_step_s: Time step of the tracks (s).
        drain_s: Time after `duration_s` in which vehicles may arrive (s).
    """

    duration_s: float = 120.0
    vehicles_per_min: float = 20.0
    pedestrians_per_min: float = 6.0
    time_step_s: float = 0.5
    drain_s: float = 120.0


@dataclass(frozen=True)
class Routes:
    """Road users of a simulation.

    Attributes:
        content: Route file of SUMO.
        requested: Number of pairs of an entry and an exit that were drawn.
        routed: Number of these pairs with a route from the entry to the exit.
    """

    content: bytes
    requested: int
    routed: int


def make_routes(network: Network, scene: Scene, driving: np.ndarray, demand: Demand, seed: int) -> Routes:
    """Make the vehicles and pedestrians of a simulation.

    Vehicles of the scene that are in traffic start at their places. Others enter at random times at random entries of
    the network, and drive on the shortest route to a random exit of another road. If there is no such route, the
    vehicle gets another entry and exit.

    Args:
        network: Network.
        scene: Scene.
        driving: (n,) bool mask of the vehicles in traffic.
        demand: Traffic.
        seed: Seed.

    Returns:
        The road users.

    Raises:
        ValueError: No route leads through the network.
    """
    rng = np.random.default_rng([7411, seed])
    entering, requested = _list_entering(network, demand, rng)
    if not entering:
        raise ValueError(f"scene {scene.scene_id}: no route leads from one border of the scene to another")
    root = ET.Element("routes")
    for name, kind in KINDS.items():
        length, width, height = (str(value) for value in kind.size_m)
        ET.SubElement(root, "vType", id=name, vClass=kind.sumo_class, length=length, width=width, height=height)
    users = [*_list_started(network, scene, driving, rng), *entering, *_list_pedestrians(network, demand, rng)]
    for number, (_, user) in enumerate(sorted(users, key=lambda item: item[0])):
        user.set("id", str(number))
        root.append(user)
    content = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return Routes(content, requested, len(entering))


def _make_vehicle(kind: str, depart_s: float, route: list[str], **options: str) -> tuple[float, ET.Element]:
    vehicle = ET.Element("vehicle", {"type": kind, "depart": f"{depart_s:.2f}"} | options)
    ET.SubElement(vehicle, "route", edges=" ".join(route))
    return depart_s, vehicle


def _list_started(
    network: Network, scene: Scene, driving: np.ndarray, rng: np.random.Generator
) -> list[tuple[float, ET.Element]]:
    """Return the vehicles of the scene, which start at their places."""
    exits, found = sorted(network.exits), []
    for k in np.flatnonzero(driving):
        place = network.find_lane(scene.center_m[k, :2], float(scene.yaw_rad[k]))
        if place is None:
            continue
        edge, lane, along_m = place
        paths = nx.single_source_dijkstra_path(network.graph, edge)
        goals = [goal for goal in exits if goal in paths]
        if goals:
            kind = "truck" if scene.category[k] == VEHICLES[0] else "car"
            front_m = min(max(along_m + KINDS[kind].size_m[0] / 2, KINDS[kind].size_m[0]), lane.length_m)
            route = paths[goals[rng.integers(len(goals))]]
            options = {"departLane": str(lane.index), "departPos": f"{front_m:.2f}", "departSpeed": "0"}
            found.append(_make_vehicle(kind, 0.0, route, **options))
    return found


def _list_entering(
    network: Network, demand: Demand, rng: np.random.Generator
) -> tuple[list[tuple[float, ET.Element]], int]:
    """Return the vehicles that enter the scene, and the number of pairs of an entry and an exit that were drawn."""
    entries, exits = sorted(network.entries), sorted(network.exits)
    pairs = [(start, goal) for start in entries for goal in exits if start == goal or not _are_same_road(start, goal)]
    paths = {start: nx.single_source_dijkstra_path(network.graph, start) for start in entries}
    if not any(goal in paths[start] for start, goal in pairs):
        return [], 0
    names = [name for name, kind in KINDS.items() if kind.share]
    shares = [KINDS[name].share for name in names]
    found, requested = [], 0
    for depart_s in np.sort(
        rng.uniform(0.0, demand.duration_s, round(demand.duration_s * demand.vehicles_per_min / 60))
    ):
        kind = str(rng.choice(names, p=shares))
        while True:
            start, goal = pairs[rng.integers(len(pairs))]
            requested += 1
            if goal in paths[start]:
                break
        options = {"departLane": "best", "departSpeed": "max"}
        found.append(_make_vehicle(kind, float(depart_s), paths[start][goal], **options))
    return found, requested


def _are_same_road(edge: str, other: str) -> bool:
    """Return whether two edges are the directions of one road."""
    return edge.lstrip("-") == other.lstrip("-")


def _list_pedestrians(network: Network, demand: Demand, rng: np.random.Generator) -> list[tuple[float, ET.Element]]:
    """Return pedestrians that walk from a random sidewalk to another."""
    edges = sorted(network.sidewalks)
    count = round(demand.duration_s * demand.pedestrians_per_min / 60) if len(edges) > 1 else 0
    found = []
    for depart_s in np.sort(rng.uniform(0.0, demand.duration_s, count)):
        start, goal = rng.choice(edges, 2, replace=False)
        person = ET.Element("person", type="pedestrian", depart=f"{depart_s:.2f}", departPos="random")
        ET.SubElement(person, "personTrip", {"from": str(start), "to": str(goal)})
        found.append((float(depart_s), person))
    return found
