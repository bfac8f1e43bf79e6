"""Road network of a scene for SUMO: netconvert reads the OpenDRIVE export of the scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np

from models.scene import Grid, Scene
from pipelines.io.opendrive import export_opendrive
from pipelines.traffic.sumo import read_float, read_xml, run_program

SIDEWALK = "pedestrian"  # Lanes that allow only this class are sidewalks.
TWO_WAY_M = 4.4  # Smallest width of a road on which two vehicles can pass each other.
BORDER_M = 5.0  # Edges that begin or end this close to the border of the scene are entries or exits.
TURN = "--no-turnarounds.except-deadend"  # Vehicles turn at dead ends only.
TYPES = "data/typemap/opendriveNetconvertPedestrians.typ.xml"


@dataclass(frozen=True, eq=False)
class Lane:
    """A driving lane.

    Attributes:
        index: Index of the lane in its edge.
        shape_m: (k, 2) points of the middle of the lane, in the direction of travel (m).
        length_m: Length (m).
        width_m: Width (m).
    """

    index: int
    shape_m: np.ndarray
    length_m: float
    width_m: float


@dataclass(frozen=True, eq=False)
class Network:
    """Road network.

    Attributes:
        path: File of SUMO.
        lanes: Driving lanes of each edge. An edge is one direction of a road.
        graph: Edges (nodes of the graph) and the connections between them.
        entries: Edges that begin at the border of the scene.
        exits: Edges that end there.
        sidewalks: Length of the sidewalk of each edge that has one (m).
        num_warnings: Number of warnings of netconvert.
        num_one_way: Number of roads that are too narrow for two directions, and have lost one.
    """

    path: Path
    lanes: dict[str, list[Lane]]
    graph: Any
    entries: set[str]
    exits: set[str]
    sidewalks: dict[str, float]
    num_warnings: int
    num_one_way: int = 0

    def count_unreachable(self) -> int:
        """Return the number of edges on which no vehicle can drive from an entry to an exit of the scene."""
        ahead = _list_reachable(self.graph, self.entries)
        behind = _list_reachable(self.graph.reverse(copy=False), self.exits)
        return len(self.graph) - len(ahead & behind)

    def list_narrow_roads(self) -> list[tuple[str, str]]:
        """Return both edges of each road on which two vehicles cannot pass each other."""
        pairs = [(edge, f"-{edge}") for edge in self.lanes if f"-{edge}" in self.lanes]
        widths = [sum(lane.width_m for edge in pair for lane in self.lanes[edge]) for pair in pairs]
        return [pair for pair, width in zip(pairs, widths, strict=True) if width < TWO_WAY_M]

    def choose_one_way(self) -> list[str]:
        """Choose the edges to remove so that narrow roads have one direction and no further edge is unreachable."""
        removed: list[str] = []
        rest = replace(self, graph=self.graph.copy())
        allowed = rest.count_unreachable()
        for number, pair in enumerate(self.list_narrow_roads()):
            for edge in pair if number % 2 else pair[::-1]:
                links = list(rest.graph.in_edges(edge, data=True)), list(rest.graph.out_edges(edge, data=True))
                rest.graph.remove_node(edge)
                if len(rest.graph) and rest.count_unreachable() <= allowed:
                    removed.append(edge)
                    break
                rest.graph.add_node(edge)
                rest.graph.add_edges_from(links[0] + links[1])
        return removed

    def find_lane(self, xy_m: np.ndarray, yaw_rad: float) -> tuple[str, Lane, float] | None:
        """Find the lane on which a vehicle drives.

        Args:
            xy_m: (2,) centre of the vehicle (m).
            yaw_rad: Direction of its length axis; the vehicle may drive in the opposite direction.

        Returns:
            Edge, lane and distance from the begin of the lane (m); None if no lane within 2 m has this direction.
        """
        best = None
        for edge, lanes in self.lanes.items():
            for lane in lanes:
                start, step = lane.shape_m[:-1], np.diff(lane.shape_m, axis=0)
                length = np.maximum(np.linalg.norm(step, axis=1), 1e-9)
                along = (((xy_m - start) * step).sum(axis=1) / length).clip(0, length)
                distance = np.linalg.norm(start + step * (along / length)[:, None] - xy_m, axis=1)
                k = int(distance.argmin())
                turn = np.arctan2(step[k, 1], step[k, 0]) - yaw_rad
                if distance[k] < (2.0 if best is None else best[0]) and abs(np.cos(turn)) > 0.8:
                    best = float(distance[k]), edge, lane, float(length[:k].sum() + along[k])
        return None if best is None else best[1:]


def _list_reachable(graph: Any, starts: set[str]) -> set[str]:
    """Return the edges that can be reached from some edges, with these edges."""
    starts = starts & set(graph)
    return set(nx.multi_source_dijkstra_path_length(graph, starts, weight=None)) if starts else set()


def build_network(scene: Scene, home: Path, folder: Path) -> Network:
    """Export the roads of a scene and convert them to a network of SUMO.

    Args:
        scene: Scene.
        home: Home directory of SUMO.
        folder: Directory for the files scene.xodr and net.xml.

    Returns:
        The network, in the scene frame.

    Raises:
        ValueError: The scene has no road, or no road on which vehicles may drive.
        RuntimeError: netconvert fails.
    """
    (folder / "scene.xodr").write_bytes(export_opendrive(scene))
    files = ("--opendrive", folder / "scene.xodr", "--output-file", folder / "net.xml", "--type-files", home / TYPES)
    options = ("--offset.disable-normalization", "--opendrive.import-all-lanes", "--walkingareas", "--crossings.guess")
    options += ("--flatten",)  # netconvert gives the ends of edges the height of the junction's middle.
    messages = run_program(home, "bin/netconvert", *files, *options, TURN)
    warnings = messages.count("Warning:")
    network = read_network(folder / "net.xml", scene.grid, warnings)
    if not network.lanes:
        raise ValueError(f"scene {scene.scene_id} has no road on which vehicles may drive")
    removed = network.choose_one_way()
    if removed:
        edges = ("--remove-edges.explicit", ",".join(removed), TURN)
        run_program(home, "bin/netconvert", "-s", network.path, *edges, "--output-file", folder / "one_way.xml")
        network = replace(read_network(folder / "one_way.xml", scene.grid, warnings), num_one_way=len(removed))
    return network


def read_network(path: Path, grid: Grid, num_warnings: int = 0) -> Network:
    """Read a network of SUMO.

    Args:
        path: File of netconvert.
        grid: Grid of the scene.
        num_warnings: Number of warnings of netconvert.

    Returns:
        The network.
    """
    root = read_xml(path)
    lanes: dict[str, list[Lane]] = {}
    sidewalks: dict[str, float] = {}
    for edge in root.iterfind("edge"):
        if edge.get("function"):
            continue
        name = edge.get("id", "")
        for lane in edge.iterfind("lane"):
            length, width = read_float(lane, "length"), read_float(lane, "width", 3.2)
            if lane.get("allow") == SIDEWALK:
                sidewalks[name] = length
                continue
            shape = np.array([point.split(",")[:2] for point in lane.get("shape", "").split()], float)
            lanes.setdefault(name, []).append(Lane(int(read_float(lane, "index")), shape, length, width))
    graph = nx.DiGraph()
    graph.add_nodes_from(lanes)
    driving = {(name, lane.index) for name, found in lanes.items() for lane in found}
    for link in root.iterfind("connection"):
        ends = [(link.get(side, ""), int(read_float(link, f"{side}Lane"))) for side in ("from", "to")]
        if all(end in driving for end in ends):
            graph.add_edge(ends[0][0], ends[1][0], weight=lanes[ends[1][0]][0].length_m)
    entries, exits = (
        {name for name, found in lanes.items() if _is_at_border(found[0].shape_m[place], grid)} for place in (0, -1)
    )
    graph.remove_edges_from([link for link in graph.edges if link[0] in exits])  # Vehicles do not turn there.
    return Network(path, lanes, graph, entries, exits, sidewalks, num_warnings)


def _is_at_border(point_m: np.ndarray, grid: Grid) -> bool:
    x_m, y_m = point_m
    return bool(min(grid.front_m - x_m, x_m - grid.back_m, grid.left_m - y_m, y_m - grid.right_m) < BORDER_M)
