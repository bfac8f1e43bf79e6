"""Extract the road network of a Scene from its road mask: centrelines with heights and widths, which meet at nodes.

The mask is cleaned and thinned to a skeleton of one pixel width. The skeleton is cut at its forks. Spurs, which are
artefacts of an uneven outline, are removed. Forks that are closer together than the road width become one node. Beyond
the scene's border, the mask repeats the values at the border. A road therefore crosses the border in a straight line.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import networkx as nx
import numpy as np
from scipy import ndimage
from skimage.morphology import skeletonize

from models.scene import ROAD_CLASSES, Scene
from pipelines.geometry.masks import find_nearest_true, label_parts, measure_depth

CELL_M = 0.5  # Cell size of the mask for thinning.
HOLE_M2, ISLAND_M2 = 25.0, 40.0  # Minimum area of a hole, and minimum area of an island.
MARGIN_M = 16.0  # Width of the padding beyond the scene's border.
SPUR = 1.6  # Minimum length of a dead end, as a multiple of the half width at its fork.
ONE_NODE = 1.0  # Minimum distance between forks, as a multiple of the sum of their half widths.
SMOOTH_M = 3.0  # Standard deviation of the Gaussian that smooths a line.
LEAST_M = 4.0  # Minimum length of a road.
AROUND = np.ones((3, 3), int)  # Neighbourhood of eight pixels.


@dataclass(frozen=True, eq=False)
class Road:
    """A road between two nodes: k evenly spaced points of its centreline, in the scene frame.

    Attributes:
        xyz_m: Points on the ground (m).
        width_m: Width of the whole road at each point (m).
        start: Number of the node at the first point. If the first point lies at the scene's border or is a dead end,
            -1.
        end: Number of the node at the last point. If the last point lies at the scene's border or is a dead end, -1.
        number: Number of the road in the network.
    """

    xyz_m: np.ndarray  # (k, 3)
    width_m: np.ndarray  # (k,)
    start: int
    end: int
    number: int

    @property
    def length_m(self) -> float:
        """Length seen from above (m)."""
        return float(np.linalg.norm(np.diff(self.xyz_m[:, :2], axis=0), axis=1).sum())

    def reverse(self) -> Road:
        """Return the same road in the opposite direction."""
        return Road(self.xyz_m[::-1], self.width_m[::-1], self.end, self.start, self.number)


@dataclass(frozen=True, eq=False)
class RoadNetwork:
    """Roads, and the nodes where three or more road ends meet.

    Attributes:
        roads: All roads; a road's number is its index.
        nodes_m: Position of each node in the scene frame (m).
    """

    roads: tuple[Road, ...]
    nodes_m: np.ndarray  # (n, 3)

    def list_leaving(self, node: int) -> list[Road]:
        """Return the roads at a node.

        Each road is directed away from the node.

        Args:
            node: Number of the node.

        Returns:
            Roads that start at the node. Roads that end at the node are reversed.
        """
        leaving = []
        for road in self.roads:
            leaving += [road] if road.start == node else []
            leaving += [road.reverse()] if road.end == node else []
        return leaving


def extract_road_network(scene: Scene, spacing_m: float = 1.0) -> RoadNetwork:
    """Extract the centrelines of a scene's roads.

    Args:
        scene: Scene; the network is empty if the scene has no road class.
        spacing_m: Approximate distance between points of a centreline (m).

    Returns:
        Roads and nodes.
    """
    mask = _make_road_mask(scene)
    margin = round(MARGIN_M / CELL_M)
    wide = np.pad(mask, margin, mode="edge")
    half_m = measure_depth(wide) * CELL_M
    graph = _trace_graph(skeletonize(wide))
    _prune(graph, half_m, margin)
    _unite_close_nodes(graph, half_m)
    height_m = _interpolate_height(scene, mask.shape)

    roads, ends = [], []
    for u, v, path in graph.edges(data="path"):
        path = path - margin
        for inside, first, last in _find_inside(_smooth(path, SMOOTH_M / CELL_M), mask.shape):
            if len(inside) * CELL_M < LEAST_M:
                continue
            line = inside if first else _straighten_ends(inside[::-1], half_m, margin)[::-1]
            line = line if last else _straighten_ends(line, half_m, margin)
            line = _resample_line(line, spacing_m / CELL_M)
            x_m = scene.grid.front_m - (line[:, 0] + 0.5) * CELL_M
            y_m = scene.grid.left_m - (line[:, 1] + 0.5) * CELL_M
            z_m = _smooth(ndimage.map_coordinates(height_m, line.T, order=1, mode="nearest"), SMOOTH_M / spacing_m)
            width_m = 2 * ndimage.map_coordinates(half_m, line.T + margin, order=1, mode="nearest")
            roads.append(Road(np.stack([x_m, y_m, z_m], axis=1), width_m, -1, -1, len(roads)))
            ends.append([node if whole and graph.degree(node) > 2 else None for node, whole in ((u, first), (v, last))])
    nodes = sorted({node for pair in ends for node in pair if node is not None})
    number = {node: k for k, node in enumerate(nodes)} | {None: -1}
    roads = [replace(road, start=number[a], end=number[b]) for road, (a, b) in zip(roads, ends, strict=True)]
    network = RoadNetwork(tuple(roads), np.zeros((len(nodes), 3)))
    meeting = [np.mean([road.xyz_m[0] for road in network.list_leaving(k)], axis=0) for k in range(len(nodes))]
    return replace(network, nodes_m=np.reshape(meeting, (-1, 3)))


def _make_road_mask(scene: Scene) -> np.ndarray:
    """Return the road mask (h, w) in cells of CELL_M, without small holes and islands."""
    index = [scene.ground_classes.index(name) for name in ROAD_CLASSES if name in scene.ground_classes]
    road = np.any(scene.occupied[index], axis=0)
    factor = max(1, round(CELL_M / scene.grid.resolution_m))
    rows, cols = (n // factor for n in road.shape)
    cells = road[: rows * factor, : cols * factor].reshape(rows, factor, cols, factor).mean(axis=(1, 3)) >= 0.5
    cells = ~_keep_large_parts(~cells, HOLE_M2, border=True)
    return _keep_large_parts(cells, ISLAND_M2)


def _keep_large_parts(mask: np.ndarray, area_m2: float, border: bool = False) -> np.ndarray:
    """Return the 4-connected parts of a mask that have at least the given area.

    With `border`, smaller parts that touch the border of the mask are kept as well.
    """
    parts, count = label_parts(mask)
    keep = np.bincount(parts.ravel(), minlength=count + 1) * CELL_M**2 >= area_m2
    if border:
        keep[np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]])] = True
    keep[0] = False
    return keep[parts]


def _trace_graph(skeleton: np.ndarray) -> nx.MultiGraph:
    """Convert a skeleton to a graph.

    Forks and ends become nodes with the attribute `place` (2,): row and column. A line between two nodes u < v becomes
    an edge. The attribute `path` (k, 2) of the edge leads from u to v.
    """
    neighbours = ndimage.convolve(skeleton.astype(int), AROUND, mode="constant") - 1
    forks, count = label_parts(skeleton & (neighbours > 2), AROUND)
    graph = nx.MultiGraph()
    for fork in range(1, count + 1):
        graph.add_node(fork, place=np.argwhere(forks == fork).mean(axis=0))
    lines, number = label_parts(skeleton & (forks == 0), AROUND)
    touching = ndimage.maximum_filter(forks, size=3)
    for where, line in zip(ndimage.find_objects(lines, number), range(1, number + 1), strict=True):
        path = _order_pixels(np.argwhere(lines[where] == line)) + [s.start for s in where]
        ends = []
        for end in (0, -1):
            fork = int(touching[tuple(path[end])])
            # If a line is a single pixel between two forks, find the second fork among the neighbours of this pixel.
            if len(path) == 1 and end == -1 and fork:
                around = forks[path[0][0] - 1 : path[0][0] + 2, path[0][1] - 1 : path[0][1] + 2]
                fork = int(min(set(around[around > 0].tolist()) - {ends[0]}, default=0))
            if not fork:
                fork = graph.number_of_nodes() + count + 1
                graph.add_node(fork, place=path[end].astype(float))
            ends.append(fork)
        _join(graph, ends[0], ends[1], path.astype(float))
    return graph


def _join(graph: nx.MultiGraph, u: int, v: int, path: np.ndarray) -> None:
    """Add an edge with a path (k, 2) from u to v, and extend the path to both nodes."""
    path = np.concatenate([[graph.nodes[u]["place"]], path, [graph.nodes[v]["place"]]])
    graph.add_edge(min(u, v), max(u, v), path=path if u <= v else path[::-1])


def _order_pixels(pixels: np.ndarray) -> np.ndarray:
    """Sort the pixels (k, 2) of an 8-connected line from one end to the other. The line has no forks."""
    left = {tuple(p) for p in pixels.tolist()}

    def beside(p: tuple[int, int]) -> Iterator[tuple[int, int]]:
        steps = ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
        return ((p[0] + i, p[1] + j) for i, j in steps if (p[0] + i, p[1] + j) in left)

    here = min(left, key=lambda p: (sum(1 for _ in beside(p)), p))
    found = []
    while here is not None:
        found.append(here)
        left.discard(here)
        here = next(beside(here), None)
    return np.array(found)


def _measure_length(path: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) * CELL_M


def _measure_half_width(graph: nx.MultiGraph, node: int, half_m: np.ndarray) -> float:
    return float(half_m[tuple(np.round(graph.nodes[node]["place"]).astype(int))])


def _prune(graph: nx.MultiGraph, half_m: np.ndarray, margin: int) -> None:
    """Remove spurs in order of length, the shortest first. At each former fork, join the two lines that remain."""
    while True:
        spurs = []
        for u, v, key, path in graph.edges(keys=True, data="path"):
            for end, fork in ((u, v), (v, u)):
                row, col = graph.nodes[end]["place"]
                inner = margin <= row < half_m.shape[0] - margin and margin <= col < half_m.shape[1] - margin
                longest = SPUR * _measure_half_width(graph, fork, half_m)
                if graph.degree(end) == 1 and graph.degree(fork) > 2 and inner and _measure_length(path) < longest:
                    spurs.append((_measure_length(path), end, fork, key))
        if not spurs:
            return
        _, end, _, _ = min(spurs)
        graph.remove_node(end)
        _straighten(graph)


def _straighten(graph: nx.MultiGraph) -> None:
    """Join the two lines at each node where exactly two lines meet."""
    for node in [n for n, degree in graph.degree() if degree == 2]:
        edges = list(graph.edges(node, keys=True, data="path"))
        if len(edges) == 2:  # A loop also has degree 2, but it is a single edge.
            parts, ends = [], []
            for u, v, _, path in edges:
                other = v if u == node else u
                ends.append(other)
                parts.append(path if other <= node else path[::-1])  # Each path leads towards the node.
            graph.remove_node(node)
            _join(graph, ends[0], ends[1], np.concatenate([parts[0][1:-1], parts[1][::-1][1:-1]]))


def _unite_close_nodes(graph: nx.MultiGraph, half_m: np.ndarray) -> None:
    """Merge two forks into one node if the line between them is shorter than the road width.

    The closest pair is merged first.
    """
    while True:
        close = []
        for u, v, path in graph.edges(data="path"):
            if u != v and graph.degree(u) > 2 and graph.degree(v) > 2:
                length = _measure_length(path)
                if length < ONE_NODE * (_measure_half_width(graph, u, half_m) + _measure_half_width(graph, v, half_m)):
                    close.append((length, u, v))
        if not close:
            return
        _, u, v = min(close)
        for key in list(graph[u][v]):
            graph.remove_edge(u, v, key)
        graph.nodes[u]["place"] = (graph.nodes[u]["place"] + graph.nodes[v]["place"]) / 2
        ways = [edge for node in (u, v) for edge in graph.edges(node, keys=True, data="path")]
        for a, b, key, path in ways:
            if graph.has_edge(a, b, key):
                graph.remove_edge(a, b, key)
            start, end = (u if node in (u, v) else node for node in sorted((a, b)))
            _join(graph, start, end, path[1:-1])
        graph.remove_node(v)
        _straighten(graph)


def _smooth(line: np.ndarray, sigma: float) -> np.ndarray:
    """Smooth a line (k,) or (k, 2) along k and keep its ends fixed."""
    reach = min(len(line) - 1, int(4 * sigma))
    if reach < 1:
        return line
    before, after = 2 * line[0] - line[reach:0:-1], 2 * line[-1] - line[-2 : -reach - 2 : -1]
    long = np.concatenate([before, line, after])
    return ndimage.gaussian_filter1d(long, sigma, axis=0)[reach : reach + len(line)]


def _find_inside(line: np.ndarray, shape: tuple[int, int]) -> Iterator[tuple[np.ndarray, bool, bool]]:
    """Yield the sections of a line (k, 2) inside the scene.

    Two flags state whether the section includes the first point and the last point of the line.
    """
    inside = ((line >= -0.5) & (line <= np.array(shape) - 0.5)).all(axis=1)
    border = np.flatnonzero(np.diff(inside.astype(int), prepend=0, append=0)).reshape(-1, 2)
    for start, stop in border.tolist():
        yield line[start:stop], start == 0, stop == len(line)


def _straighten_ends(line: np.ndarray, half_m: np.ndarray, margin: int) -> np.ndarray:
    """At the scene's border, replace the end of a line (k, 2) by a straight continuation.

    Without this step, the padded mask bends the line within half a road width of the border.
    """
    half = half_m[tuple(np.round(line[-1] + margin).astype(int))] / CELL_M
    left = len(line) - int(2 * half)
    if left < 4 * half:
        return line
    step = (line[left - 1] - line[left - 1 - int(2 * half)]) / int(2 * half)
    ahead = line[left - 1] + np.arange(1, 4 * int(half) + 2)[:, None] * step
    shape = np.array(half_m.shape) - 2 * margin
    outside = ((ahead < -0.5) | (ahead > shape - 0.5)).any(axis=1)
    return np.concatenate([line[:left], ahead[: int(outside.argmax())]]) if outside.any() else line


def _resample_line(line: np.ndarray, spacing: float) -> np.ndarray:
    """Return points (n, 2) that are evenly spaced along a line and include both ends."""
    along = np.append(0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1)))
    wanted = np.linspace(0, along[-1], max(2, round(along[-1] / spacing) + 1))
    return np.stack([np.interp(wanted, along, line[:, axis]) for axis in (0, 1)], axis=1)


def _interpolate_height(scene: Scene, shape: tuple[int, int]) -> np.ndarray:
    """Return the height (h, w) of the road in cells of CELL_M.

    Cells without road get the height of the nearest road.
    """
    index = [scene.ground_classes.index(name) for name in ROAD_CLASSES if name in scene.ground_classes]
    known = np.any(scene.occupied[index], axis=0)
    height_m = np.where(scene.occupied[index], scene.height_m[index], -np.inf).max(axis=0, initial=-np.inf)
    if not known.any():
        return np.zeros(shape)
    nearest = find_nearest_true(known)
    factor = max(1, round(CELL_M / scene.grid.resolution_m))
    middle = np.s_[factor // 2 :: factor]
    return height_m[nearest][middle, middle][: shape[0], : shape[1]]


def plan_drive(network: RoadNetwork, start_m: tuple[float, float] = (0.0, 0.0), right: float = 0.25) -> np.ndarray:
    """Plan a smooth path on the ground along the roads.

    The path begins at the road end that is nearest to start_m. At each node, the path continues along the unused road
    with the smallest change of direction.

    Args:
        network: Roads.
        start_m: Position (x, y) in the scene frame (m).
        right: Offset to the right of the centreline, as a share of the road width. 0.25 is the middle of the right
            half.

    Returns:
        (k, 3) points in the scene frame (m). Their spacing is that of the points of the roads. If there are no roads,
        the shape is (0, 3).
    """
    starts = [r for road in network.roads for r in (road, road.reverse()) if r.start == -1]
    starts = starts or [r for road in network.roads for r in (road, road.reverse())]
    if not starts:
        return np.zeros((0, 3))
    here = min(starts, key=lambda r: float(np.hypot(*(r.xyz_m[0, :2] - start_m))))
    ways, driven = [here], {here.number}
    while here.end >= 0:
        onward = [road for road in network.list_leaving(here.end) if road.number not in driven]
        if not onward:
            break
        here = max(
            onward, key=lambda road, last=here: float(_compute_direction(last.reverse()) @ -_compute_direction(road))
        )
        ways.append(here)
        driven.add(here.number)
    line = np.concatenate([way.xyz_m for way in ways])
    width_m = np.concatenate([way.width_m for way in ways])
    apart = np.append(True, np.linalg.norm(np.diff(line, axis=0), axis=1) > 1e-6)
    line, width_m = line[apart], width_m[apart]
    ahead = np.gradient(line[:, :2], axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True).clip(1e-9)
    beside = right * np.minimum(width_m, np.median(width_m))[:, None] * np.stack([ahead[:, 1], -ahead[:, 0]], axis=1)
    line = line + np.pad(beside, ((0, 0), (0, 1)))
    spacing_m = np.median(np.linalg.norm(np.diff(line, axis=0), axis=1))
    return _smooth(line, SMOOTH_M / spacing_m)


def _compute_direction(road: Road) -> np.ndarray:
    """Return the unit direction (2,) of a road at its first point, seen from above."""
    way = road.xyz_m[min(5, len(road.xyz_m) - 1), :2] - road.xyz_m[0, :2]
    return way / np.linalg.norm(way)
