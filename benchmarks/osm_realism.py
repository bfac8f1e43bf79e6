"""Compare streets and buildings of the town with extracts of OpenStreetMap.

    python benchmarks/osm_realism.py EXTRACT.osm.gz ... --towns 12

Each quantity has one value per building, junction or street. The distance between two sets of values is their
Wasserstein distance, divided by the standard deviation of the values of the extract. Streets of a town are the
centrelines of its rasterised roads. Data of OpenStreetMap: (c) OpenStreetMap contributors, ODbL.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import osmium
import shapely
import tyro
from common import describe_machine
from scipy.stats import wasserstein_distance

from models.scene import CATEGORY_INDEX, Grid
from pipelines.geometry.centerlines import extract_road_network
from pipelines.preprocess.sources.drive import Drive
from pipelines.preprocess.sources.town.generator import TOWN_VERSIONS, generate_town

EARTH_RADIUS_M = 6_371_000.0
STREETS = ("residential", "living_street", "unclassified", "tertiary", "secondary", "primary")
NEAR_STREET_M = 60.0  # Buildings that are farther from every street are not counted.
TOUCHING_M = 0.3  # Buildings whose footprints are closer than this distance touch.
ARM_M = 12.0  # The direction of a street at a junction is measured over this length.
MIN_BUILDING_M2 = 20.0
RESOLUTION_M = 0.5  # Raster in which the centrelines of a town are traced.
QUANTITIES = (
    "distance_to_street_m",  # From the footprint to the nearest centreline.
    "square_to_street",  # cos 4a, where a is the angle between the longer side of a building and the street.
    "touches_neighbour",  # 1 if the building touches another building, otherwise 0.
    "log_area_m2",  # log10 of the area of a building.
    "elongation",  # Length of a building divided by its width.
    "junction_degree",  # Number of streets at a junction.
    "junction_angle_deg",  # Smallest angle between two neighbouring streets at a junction.
    "street_log_m",  # log10 of the length of a street between two junctions.
)


@dataclass(frozen=True)
class Config:
    files: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Extracts of OpenStreetMap: .osm, .osm.gz or .osm.pbf."""
    version: tuple[int, ...] = TOWN_VERSIONS
    """Versions of the town."""
    towns: int = 12
    """Number of towns per version."""
    first_seed: int = 2_000_000
    """Seed of the first town."""


@dataclass(frozen=True, eq=False)
class Plan:
    """Buildings and streets of a place.

    Attributes:
        buildings: Footprints (m).
        streets: (k, 2) points of each street between two junctions or ends (m).
        ends: Names of the junctions at the start and at the end of each street; -1 for an end without junction.
    """

    buildings: list[shapely.Polygon]
    streets: list[np.ndarray]
    ends: list[tuple[int, int]]


def read_osm(path: str) -> Plan:
    """Read footprints of buildings and centrelines of streets.

    Args:
        path: Extract of OpenStreetMap.

    Returns:
        Buildings and streets in metres, in a local projection.

    Raises:
        ValueError: The file cannot be read, or it has no building or no street.
    """
    outlines, ways = [], []
    try:
        for way in osmium.FileProcessor(path, osmium.osm.NODE | osmium.osm.WAY).with_locations():
            if not way.is_way() or not ("building" in way.tags or way.tags.get("highway") in STREETS):
                continue
            points = [(node.ref, node.lon, node.lat) for node in way.nodes if node.location.valid()]
            if "building" in way.tags:
                if len(points) >= 4 and points[0][0] == points[-1][0]:
                    outlines.append(np.array([point[1:] for point in points]))
            elif len(points) >= 2:
                ways.append(points)
    except RuntimeError as error:
        raise ValueError(f"{path}: {error}; pass an extract of OpenStreetMap (.osm, .osm.gz or .osm.pbf)") from error
    if not outlines or not ways:
        raise ValueError(f"{path}: {len(outlines)} buildings and {len(ways)} streets; pass an extract with both")
    middle = np.concatenate(outlines).mean(axis=0)
    scale = np.radians(EARTH_RADIUS_M) * np.array([np.cos(np.radians(middle[1])), 1.0])
    buildings = [shapely.Polygon((outline - middle) * scale) for outline in outlines]
    streets, ends = _split_ways([[(ref, (np.array(place) - middle) * scale) for ref, *place in way] for way in ways])
    return Plan([b for b in buildings if b.is_valid and b.area >= MIN_BUILDING_M2], streets, ends)


def _split_ways(ways: list[list[tuple[int, np.ndarray]]]) -> tuple[list[np.ndarray], list[tuple[int, int]]]:
    """Split ways at junctions: at points from which at least three lines lead away."""
    near: dict[int, set[int]] = {}
    for way in ways:
        for (a, _), (b, _) in zip(way, way[1:], strict=False):
            near.setdefault(a, set()).add(b)
            near.setdefault(b, set()).add(a)
    # A way may end where another way begins; the two are one street.
    place = {ref: point for way in ways for ref, point in way}
    stops = {ref for ref, others in near.items() if len(others) != 2}
    streets, ends, used = [], [], set()
    for start in sorted(stops):
        for there in sorted(near[start]):
            if (start, there) in used:
                continue
            path = [start, there]
            while path[-1] not in stops:
                path.append(next(ref for ref in near[path[-1]] if ref != path[-2]))
            used |= {(path[0], path[1]), (path[-1], path[-2])}
            streets.append(np.array([place[ref] for ref in path]))
            first, last = (ref if len(near[ref]) > 2 else -1 for ref in (path[0], path[-1]))
            ends.append((first, last))
    return streets, ends


def plan_drive(drive: Drive) -> Plan:
    """Return the buildings of a town, and the centrelines of its rasterised roads."""
    ground, pose = drive.ground, drive.pose(0)
    local = pose.to_ego(ground.vertices_m)[:, :2]
    low, high = local.min(axis=0) - 2.0, local.max(axis=0) + 2.0
    rows, cols = (int(n) for n in np.ceil((high - low) / RESOLUTION_M))
    front_m, left_m = low + np.array([rows, cols]) * RESOLUTION_M
    scene = drive.scene(0, grid=Grid(float(front_m), float(left_m), RESOLUTION_M, rows, cols))
    network = extract_road_network(scene)
    built = scene.category == CATEGORY_INDEX["construction_big"]
    axis = scene.rotation[built, :2, 0].astype(float)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    long = axis * scene.size_m[built, :1] / 2
    wide = np.stack([-axis[:, 1], axis[:, 0]], axis=1) * scene.size_m[built, 1:2] / 2
    center = scene.center_m[built, None, :2]
    corners = center + np.stack([-long - wide, long - wide, long + wide, wide - long], axis=1)
    buildings = [shapely.Polygon(outline) for outline in corners]
    ends = [(road.start, road.end) for road in network.roads]
    return Plan([b for b in buildings if b.area >= MIN_BUILDING_M2], [r.xyz_m[:, :2] for r in network.roads], ends)


def measure_plan(plan: Plan) -> dict[str, np.ndarray]:
    """Return the values of each of QUANTITIES."""
    lines = np.array([shapely.LineString(street) for street in plan.streets])
    buildings = np.array(plan.buildings)
    tree = shapely.STRtree(lines)
    nearest, distance_m = tree.query_nearest(buildings, return_distance=True, all_matches=False)
    street = np.empty(len(buildings), int)
    away_m = np.empty(len(buildings))
    street[nearest[0]], away_m[nearest[0]] = nearest[1], distance_m
    kept = away_m <= NEAR_STREET_M
    buildings, street, away_m = buildings[kept], street[kept], away_m[kept]
    sides = shapely.get_coordinates(shapely.oriented_envelope(buildings)).reshape(-1, 5, 2)[:, :3]
    first, second = sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 1]
    lengths = np.linalg.norm([first, second], axis=2)
    longer = np.where((lengths[0] >= lengths[1])[:, None], first, second)
    along = np.array([_find_direction(lines[k], b.centroid) for k, b in zip(street, buildings, strict=True)])
    angle = np.arctan2(longer[:, 1], longer[:, 0]) - along
    wide = shapely.buffer(buildings, TOUCHING_M / 2)
    a, b = shapely.STRtree(wide).query(wide, predicate="intersects")
    touches = np.zeros(len(buildings))
    touches[a[a != b]] = 1.0
    degree, least_deg = _measure_junctions(plan)
    between = [s for s, (u, v) in zip(plan.streets, plan.ends, strict=True) if u >= 0 and v >= 0]
    street_m = np.array([np.linalg.norm(np.diff(s, axis=0), axis=1).sum() for s in between])
    values = (
        away_m,
        np.cos(4 * angle),
        touches,
        np.log10(shapely.area(buildings)),
        lengths.max(axis=0) / np.maximum(lengths.min(axis=0), 0.1),
        degree,
        least_deg,
        np.log10(np.maximum(street_m, 1.0)),
    )
    return dict(zip(QUANTITIES, values, strict=True))


def _find_direction(line: shapely.LineString, point: shapely.Point) -> float:
    """Return the direction (rad) of a line at the place that is nearest to a point."""
    at = line.project(point)
    before, after = (line.interpolate(float(np.clip(at + by, 0, line.length))) for by in (-2.0, 2.0))
    return float(np.arctan2(after.y - before.y, after.x - before.x))


def _measure_junctions(plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of arms of each junction, and the smallest angle (degrees) between neighbouring arms."""
    arms: dict[int, list[float]] = {}
    for street, (start, end) in zip(plan.streets, plan.ends, strict=True):
        for node, points in ((start, street), (end, street[::-1])):
            if node >= 0:
                line = shapely.LineString(points)
                far = line.interpolate(min(ARM_M, line.length))
                arms.setdefault(node, []).append(float(np.arctan2(far.y - points[0, 1], far.x - points[0, 0])))
    found = [np.sort(angles) for angles in arms.values() if len(angles) > 2]
    least = [np.degrees(np.diff(angles, append=angles[0] + 2 * np.pi).min()) for angles in found]
    return np.array([float(len(angles)) for angles in found]), np.array(least)


def join_values(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Concatenate the values of several places."""
    return {name: np.concatenate([part[name] for part in parts]) for name in QUANTITIES}


def compute_distance(values: np.ndarray, reference: np.ndarray) -> float:
    """Return the Wasserstein distance in units of the standard deviation of the reference; NaN without values."""
    spread = reference.std() if len(reference) else 0.0
    return float(wasserstein_distance(values, reference) / spread) if len(values) and spread > 0 else np.nan


def main(config: Config) -> None:
    print(describe_machine())
    seeds = range(config.first_seed, config.first_seed + config.towns)
    towns = {
        f"town {version}": join_values([measure_plan(plan_drive(generate_town(seed, version))) for seed in seeds])
        for version in config.version
    }
    for path in config.files:
        plan = read_osm(path)
        real = measure_plan(plan)
        print(f"\n{os.path.basename(path)}: {len(plan.buildings)} buildings, {len(plan.streets)} streets")
        names = " | ".join([*towns, *(f"distance {name}" for name in towns)])
        print(f"| quantity | real | {names} |")
        print("|" + "---|" * (2 + 2 * len(towns)))
        distances = {name: [compute_distance(v[q], real[q]) for q in QUANTITIES] for name, v in towns.items()}
        for k, quantity in enumerate(QUANTITIES):
            means = [values[quantity].mean() if len(values[quantity]) else np.nan for values in (real, *towns.values())]
            cells = [f"{mean:.3f}" for mean in means] + [f"{found[k]:.2f}" for found in distances.values()]
            print(f"| {quantity} | {' | '.join(cells)} |")
        cells = [f"{np.nanmean(found):.3f}" for found in distances.values()]
        print(f"| mean distance | {' | '.join([''] * (1 + len(towns)) + cells)} |")
        if len(distances) > 1:
            first, *_, last = (np.array(found) for found in distances.values())
            print(f"town {config.version[-1]} is nearer in {(last < first).sum()} of {len(QUANTITIES)} quantities")


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
