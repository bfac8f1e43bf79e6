"""Compare the windows of large scenes with data, ring by ring, with Ray tasks.

A city is cut into windows of the size of a scene (pipelines/metrics/cities.py). The windows of each group of rings are
written as a source of a dataset directory, and scored like generated scenes against crops of the data. The ceiling
consists of windows of large procedural towns, which have no centre.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.distance import jensenshannon

from models.composition.block_grid import RANKS, BlockGrid, BlockIndex
from models.labels import ANY, FREE
from models.scene import DENSITIES, Grid, Scene
from models.tensors import resample_scene_ground
from pipelines.evaluation.evaluate import compute_scene_means
from pipelines.evaluation.features import READER_CPUS
from pipelines.evaluation.traffic import Traffic, simulate_traffic
from pipelines.generation.tiles import join_tiles
from pipelines.metrics.cities import (
    HECTARE_M2,
    QUANTITIES,
    SEAM_RECORD_SHAPE,
    WINDOW_M,
    Window,
    measure_city,
    measure_seams_by_ring,
)
from pipelines.metrics.intervals import Estimate
from pipelines.metrics.relations import fuse_ground
from pipelines.metrics.seams import estimate_seam_ratios
from pipelines.metrics.validity import judge_densities
from pipelines.preprocess.sources.town.version2.town import make_large_scene
from pipelines.rendering.render import render_bev
from pipelines.runtime import storage
from pipelines.runtime.ray_tasks import map_tasks
from pipelines.schema.dataset import Dataset
from pipelines.schema.scene_subset import SceneSubset, select_evenly
from pipelines.schema.tables import Shard

CENTER_M = (WINDOW_M / 2, 0.0)  # Centre of the first scene of a city, in the frame of the city.
SPLIT = "windows"
MAX_GROUPS = 5  # Groups of rings of a city.
FINE_CELLS = 1024  # Cells per block for locating seams: records do not hold the latent size, which is smaller.
OVERVIEW_PX = 768
REFERENCE, CEILING = "reference", "ceiling"
TOWN_SEEDS_START = 2_000_000  # Towns of the ceiling have other seeds than those of datasets.
Label = tuple[str | None, str | None]  # Densities of vegetation and vehicles; None: any.


@dataclass(frozen=True)
class CityResult:
    """Measures of one city.

    Attributes:
        side: Name of the set to which the city belongs.
        city: Scene id.
        rows: One dictionary per window: ahead, left, ring, group, direction, kept, label and QUANTITIES.
        angles_m: (n, 18) length of centrelines by direction, per window (m).
        city_blocks_m2: Areas of the city blocks (m^2).
        connectivity: Share of road pixels in the largest connected part.
        area_m2: Area of the city (m^2).
        seams: Record (4, 2, 2) of the seams of each group of rings; empty if no seams are known.
        overview: (h, w, 3) uint8 picture of the city from above.
        traffic: Result of a simulation of traffic; None without simulation or without roads.
    """

    side: str
    city: str
    rows: list[dict]
    angles_m: np.ndarray
    city_blocks_m2: np.ndarray
    connectivity: float
    area_m2: float
    seams: dict[str, np.ndarray]
    overview: np.ndarray
    traffic: Traffic | None


class BlockLabels(NamedTuple):
    """Requested labels of the blocks of a run with --labels-map.

    Attributes:
        labels: Label of each block.
        step_m: Distance between neighbouring blocks (m).
    """

    labels: dict[BlockIndex, Label]
    step_m: float

    def find_label(self, ahead_m: float, left_m: float) -> Label:
        """Return the label of the block whose centre is nearest to a point.

        Args:
            ahead_m: Distance of the point ahead of the centre of block (0, 0) (m).
            left_m: Distance of the point to the left of this centre (m).

        Returns:
            The label.
        """
        rows, cols = zip(*self.labels, strict=True)
        ahead, left = (
            int(np.clip(round(at_m / self.step_m), min(steps), max(steps)))
            for at_m, steps in ((ahead_m, rows), (left_m, cols))
        )
        return self.labels[ahead, left]


@dataclass(frozen=True)
class CityRequest:
    """One large scene to measure.

    Attributes:
        side: Name of the set.
        number: Number within the set.
        tiles: Shard and row of the scene, or of each of its tiles; none for a procedural town.
        town_seed: Seed of a procedural town.
        corner_m: x of the rear border and y of the right border of a scene in tiles, in the frame of the city (m).
        extent_m: Side of a procedural town (m).
        seams_m: Positions of seams along x and y in the frame of the city (m). Positions outside the city are ignored.
        traffic: Whether to simulate traffic with SUMO.
        label: Requested densities of vegetation and vehicles; None: any. Windows of a procedural town are kept only if
            they have these densities.
        block_labels: Labels of the blocks; each window has the label of the nearest block. None: all have `label`.
        rings_per_group: Number of rings per group (`name_group`).
    """

    side: str
    number: int
    tiles: tuple[tuple[Shard, int], ...] = ()
    town_seed: int = 0
    corner_m: tuple[float, float] | None = None
    extent_m: float = 0.0
    seams_m: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())
    traffic: bool = False
    label: Label = (None, None)
    block_labels: BlockLabels | None = None
    rings_per_group: int = 1


def find_seams_m(block_grid: BlockGrid, cell_m: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Find the positions at which a new block meets known content, along the axes through the first block.

    Args:
        block_grid: Bounded block grid of a city.
        cell_m: Side of a latent cell (m).

    Returns:
        Positions x and y of the seams (m, frame of the first block).
    """
    ahead, behind, left, right = block_grid.num_blocks or (0, 0, 0, 0)
    found = []
    for low, high, place in ((-behind, ahead, lambda k: (k, 0)), (-right, left, lambda k: (0, k))):
        owner = np.full(block_grid.step * (high - low) + block_grid.size, low - 1)
        for k in sorted(range(low, high + 1), key=lambda k, place=place: block_grid.rank(place(k))):
            start, margin = (k - low) * block_grid.step, block_grid.margin if k else 0
            first, last = start + margin * (k > low), start + block_grid.size - margin * (k < high)
            part = owner[first:last]
            part[part < low] = k
        edges = np.flatnonzero(np.diff(owner)) + 1
        found.append(tuple((int(edge) + low * block_grid.step) * cell_m for edge in edges))
    return found[0], tuple(y - WINDOW_M / 2 for y in found[1])


class RunRecord(NamedTuple):
    """Options of a run of jobs/outpaint_scenes.py, from its record.

    Attributes:
        label: Requested densities of vegetation and vehicles; None: unknown, or the run took the label of each scene.
        seams_m: Positions of seams along x and y (`find_seams_m`); none if they are unknown.
        corner_m: x of the rear border and y of the right border of scenes in tiles (m); None if scenes are whole.
        size_m: Length and width of scenes in tiles (m); None if scenes are whole.
        block_labels: Labels of the blocks; None without --labels-map.
    """

    label: Label | None = None
    seams_m: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())
    corner_m: tuple[float, float] | None = None
    size_m: tuple[float, float] | None = None
    block_labels: BlockLabels | None = None


def read_run_record(root: str, source: str) -> RunRecord:
    """Read the record of a run of jobs/outpaint_scenes.py.

    Args:
        root: Dataset directory.
        source: Source of the run, such as generated-outpainted.

    Returns:
        The options; defaults without a record.
    """
    path = storage.join_uri(root, f"{source}.json")
    options = storage.read_json(path) if storage.exists(path) else {}
    label = parse_label(options["label"]) if options.get("label") else None
    if not {"overlap", "num_blocks", "order"} <= set(options):
        return RunRecord(label)
    grid = BlockGrid.from_overlap(
        FINE_CELLS,
        options["overlap"],
        options.get("margin", 0.0),
        rank=RANKS[options["order"]],
        num_blocks=tuple(options["num_blocks"]),
    )
    ahead, behind, left, right = options["num_blocks"]
    step_m = WINDOW_M * (1 - options["overlap"])
    record = RunRecord(label, find_seams_m(grid, WINDOW_M / FINE_CELLS))
    if rows := options.get("labels_map"):
        labels = {
            (ahead - row, left - col): parse_label(name)
            for row, names in enumerate(rows)
            for col, name in enumerate(names)
        }
        record = record._replace(label=(None, None), block_labels=BlockLabels(labels, step_m))
    if options.get("tile_m"):
        corner_m = -behind * step_m, -WINDOW_M / 2 - right * step_m
        size_m = WINDOW_M + (ahead + behind) * step_m, WINDOW_M + (left + right) * step_m
        record = record._replace(corner_m=corner_m, size_m=size_m)
    return record


def parse_label(text: str) -> Label:
    """Return the densities of vegetation and vehicles that a label names; None for a density that it does not name.

    Args:
        text: Label of any kind, such as low, low-medium or any-high-free.

    Returns:
        Densities of vegetation and vehicles.

    Raises:
        ValueError: A density is unknown.
    """
    parts = [*text.removesuffix(FREE).split("-"), ANY][:2]
    if unknown := sorted(set(parts) - {*DENSITIES, ANY}):
        raise ValueError(
            f"label {text!r}: density {unknown[0]!r} is unknown, expected one of {', '.join(DENSITIES)}, {ANY}; write"
            " the densities of vegetation and vehicles, such as low-medium or any-any"
        )
    vegetation, vehicle = (None if part == ANY else part for part in parts)
    return vegetation, vehicle


def find_origin_level_m(scene: Scene) -> float:
    """Return the height of the ground at the pixel with ground that is nearest to (0, 0); NaN without ground."""
    height_m, classes = fuse_ground(scene)
    rows, cols = np.nonzero(classes >= 0)
    if not len(rows):
        return float("nan")
    x_m, y_m = scene.grid.x_m()[rows], scene.grid.y_m()[cols]
    nearest = np.hypot(x_m, y_m).argmin()
    return float(height_m[rows[nearest], cols[nearest]])


def measure_city_windows(
    job: CityRequest, root: str, dataset: Dataset, level_m: float, resolution_m: float
) -> CityResult:
    """Measure one city, and write its windows to a dataset directory, one source per group of rings.

    Args:
        job: City.
        root: Dataset directory of the windows.
        dataset: Dataset with the thresholds of density labels.
        level_m: Height of the ground at the origin of the reference scenes; windows are moved vertically to this
            height (m).
        resolution_m: Side of a pixel of a procedural town (m).

    Returns:
        Measures of the windows and of the whole city.
    """
    if job.tiles:
        tiles = [shard.scenes([row])[0] for shard, row in job.tiles]
        city = join_tiles(tiles, *job.corner_m) if job.corner_m else tiles[0]
    else:
        city = make_large_scene(job.town_seed, job.extent_m, resolution_m)
    measured = measure_city(city, CENTER_M)
    windows: dict[str, list[Scene]] = {}
    rows = []
    for window, values in zip(measured.windows, measured.quantities, strict=True):
        scene, place = window.scene, (window.ahead * WINDOW_M, window.left * WINDOW_M)
        judged = judge_densities(scene, dataset.vegetation, dataset.vehicle)
        kept = bool(job.tiles) or all(wanted in (None, own) for wanted, own in zip(job.label, judged, strict=True))
        vegetation, vehicle = job.label if job.tiles else judged
        if job.block_labels:
            vegetation, vehicle = job.block_labels.find_label(*place)
        own_m = find_origin_level_m(scene)
        if np.isfinite(own_m):
            scene = scene.translate(0.0, 0.0, level_m - own_m)
        x_m, y_m, z_m = city.world_xyz_m
        scene = replace(
            scene,
            scene_id=f"{job.side}-{job.number:04d}{window.ahead:+04d}{window.left:+04d}",
            sequence=f"{job.side}-{job.number:04d}",
            vegetation_density=vegetation,
            vehicle_density=vehicle,
            world_xyz_m=(x_m + place[0], y_m + place[1], z_m),
        )
        group = name_group(window.ring, job.rings_per_group)
        rows.append(_make_row(job.side, city, window, values, (vegetation, vehicle), group, kept))
        if kept:
            windows.setdefault(name_source(job.side, group), []).append(scene)
    for source, scenes in windows.items():
        Shard(root, source, SPLIT, job.number).write([replace(s, source=source, split=SPLIT) for s in scenes])
    seams: dict[str, np.ndarray] = {}
    if any(job.seams_m):
        grid = city.grid
        lines = (
            [line for at_m in places if 0 < (line := round((edge_m - at_m) / grid.resolution_m)) < count]
            for edge_m, count, places in zip(
                (grid.front_m, grid.left_m), (grid.rows, grid.cols), job.seams_m, strict=True
            )
        )
        for ring, record in measure_seams_by_ring(city, *lines, center_m=CENTER_M).items():
            group = name_group(ring, job.rings_per_group)
            seams[group] = seams.get(group, 0) + record
    area_m2 = city.grid.rows * city.grid.cols * city.grid.resolution_m**2
    return CityResult(
        job.side,
        city.scene_id,
        rows,
        measured.angles_m,
        measured.city_blocks_m2,
        measured.connectivity,
        area_m2,
        seams,
        render_bev(city, OVERVIEW_PX),
        simulate_traffic(city) if job.traffic and np.isfinite(measured.connectivity) else None,
    )


def format_label(label: Label) -> str:
    """Return the name of a label, such as low-medium or low-any."""
    return "-".join(part or ANY for part in label)


def _make_row(
    side: str, city: Scene, window: Window, values: np.ndarray, label: Label, group: str, kept: bool = True
) -> dict[str, Any]:
    """Return the row of a window in windows.parquet."""
    return {
        "side": side,
        "city": city.scene_id,
        "ahead": window.ahead,
        "left": window.left,
        "ring": window.ring,
        "group": group,
        "direction": window.direction,
        "kept": kept,
        "label": format_label(label),
    } | dict(zip(QUANTITIES, values.tolist(), strict=True))


def name_group(ring: int, rings_per_group: int = 1) -> str:
    """Return the name of the group of rings to which a ring belongs.

    Ring 0 is a single window and belongs to the first group.

    Args:
        ring: Number of the ring.
        rings_per_group: Number of rings per group, in the first group without ring 0.

    Returns:
        First and last ring of the group, such as 0-1, 2 or 4-6.
    """
    number = max(ring - 1, 0) // rings_per_group
    first, last = number * rings_per_group + (number > 0), (number + 1) * rings_per_group
    return str(first) if first == last else f"{first}-{last}"


def list_groups(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the groups of rings of rows of windows, from the centre outwards."""
    return list(dict.fromkeys(row["group"] for row in sorted(rows, key=lambda row: row["ring"])))


def choose_rings_per_group(extent_m: float) -> int:
    """Return the number of rings per group, so that a report has at most MAX_GROUPS groups.

    Args:
        extent_m: Side of the city (m).

    Returns:
        Number of rings per group, at least 1.
    """
    return max(1, ceil((extent_m / 2 - WINDOW_M / 2) // WINDOW_M / MAX_GROUPS))


def name_source(side: str, group: str) -> str:
    """Return the source of the windows of a group of rings; the ceiling has no centre and thus one source."""
    return side if side == CEILING else f"{side}-ring-{group}"


def measure_reference_part(
    part: tuple[Shard, list[int]], number: int, root: str, resolution_m: float
) -> tuple[list[dict], list[float]]:
    """Measure scenes of the data as single windows, and write them as the source REFERENCE.

    Args:
        part: Shard and numbers of its rows.
        number: Number of the part.
        root: Dataset directory of the windows.
        resolution_m: Side of a pixel to which the ground is resampled (m).

    Returns:
        Rows as in CityResult, and the height of the ground at the origin of each scene (m).

    Raises:
        ValueError: A scene does not have the size of a window, or its pixels do not fit `resolution_m`.
    """
    shard, chosen = part
    scenes, rows = [], []
    pixels = round(WINDOW_M / resolution_m)
    grid = Grid(WINDOW_M, WINDOW_M / 2, resolution_m, pixels, pixels)
    for scene in shard.scenes(chosen):
        try:
            height_m, occupied = resample_scene_ground(scene, scene.ground_classes, grid)
        except ValueError as error:
            raise ValueError(
                f"scene {scene.scene_id} of the reference does not fit windows of {WINDOW_M:g} m with pixels of"
                f" {resolution_m:g} m: {error}"
            ) from error
        scene = replace(scene, grid=grid, height_m=height_m, occupied=occupied)
        scenes.append(scene)
        measured = measure_city(scene, CENTER_M)
        label = scene.vegetation_density, scene.vehicle_density
        rows.append(_make_row(REFERENCE, scene, measured.windows[0], measured.quantities[0], label, name_group(0)))
    Shard(root, REFERENCE, SPLIT, number).write([replace(s, source=REFERENCE, split=SPLIT) for s in scenes])
    return rows, [find_origin_level_m(scene) for scene in scenes]


def select_reference(dataset: Dataset, split: str, label: Label, limit: int) -> list[tuple[Shard, list[int]]]:
    """Select evenly spaced scenes of the data that have a label; crops at any place if the dataset has such crops.

    Args:
        dataset: Dataset.
        split: Split of the scenes.
        label: Densities of vegetation and vehicles; None: any.
        limit: Maximum number of scenes.

    Returns:
        Shards with row numbers.

    Raises:
        ValueError: No scene has the label.
    """
    found: list[tuple[Shard, int, bool]] = []
    for shard, rows in SceneSubset(dataset.root, dataset.source, split).shards():
        table = shard.read("scenes", ["vegetation_density", "vehicle_density", "free_pose"]).take(rows)
        for row, (vegetation, vehicle, free) in zip(rows, zip(*table.to_pydict().values(), strict=True), strict=True):
            if all(wanted in (None, own) for wanted, own in zip(label, (vegetation, vehicle), strict=True)):
                found.append((shard, row, free))
    if any(free for *_, free in found):
        found = [entry for entry in found if entry[2]]
    if not found:
        wanted = "-".join(part or ANY for part in label)
        raise ValueError(
            f"{dataset.root}: split {split} has no scene with label {wanted}; choose another --label or --real-split"
        )
    parts: dict[Shard, list[int]] = {}
    for at in select_evenly(len(found), min(limit, len(found))):
        shard, row, _ = found[at]
        parts.setdefault(shard, []).append(row)
    return list(parts.items())


def measure_cities(
    jobs: Sequence[CityRequest],
    reference: list[tuple[Shard, list[int]]],
    root: str,
    dataset: Dataset,
    resolution_m: float,
    num_tasks: int,
    on_done: Callable[[str], None] = lambda name: None,
) -> tuple[list[CityResult], list[dict]]:
    """Measure the reference scenes and then all cities, in Ray tasks.

    Args:
        jobs: Cities.
        reference: Selected scenes of the data (`select_reference`).
        root: Dataset directory of the windows.
        dataset: Dataset of the reference.
        resolution_m: Side of a pixel of the cities, to which the reference and the towns are resampled (m).
        num_tasks: Maximum number of concurrent tasks.
        on_done: Called with the name of the side after each city, and with REFERENCE after each part of the reference.

    Returns:
        Measures of the cities in the order of `jobs`, and the rows of the reference.

    Raises:
        ValueError: No scene of the reference has ground.
    """

    def measure_part(number: int) -> tuple[int, list[dict], list[float]]:
        return number, *measure_reference_part(reference[number], number, root, resolution_m)

    parts, levels = {}, []
    for number, rows, levels_m in map_tasks(measure_part, range(len(reference)), READER_CPUS, num_tasks):
        parts[number] = rows
        levels += levels_m
        on_done(REFERENCE)
    if not np.isfinite(levels).any():
        raise ValueError(f"{dataset.root}: none of {len(levels)} scenes of the reference has ground")
    level_m = float(np.nanmedian(levels))

    def measure(number: int) -> tuple[int, CityResult]:
        return number, measure_city_windows(jobs[number], root, dataset, level_m, resolution_m)

    found = {}
    for number, result in map_tasks(measure, range(len(jobs)), READER_CPUS, num_tasks):
        found[number] = result
        on_done(result.side)
    return [found[number] for number in range(len(jobs))], [row for number in sorted(parts) for row in parts[number]]


# ------------------------------------------------------------------------------------------------------ scores


def compute_quantity_scores(rows: Sequence[dict]) -> dict[str, dict[str, Estimate | None]]:
    """Estimate the mean of each quantity over windows, by group of rings.

    Args:
        rows: Rows of windows of one side; those that are not kept are left out.

    Returns:
        For each group of rings from the centre outwards, and for "all": estimates by QUANTITIES.
    """
    kept = [row for row in rows if row["kept"]]
    groups = {group: [row for row in kept if row["group"] == group] for group in list_groups(kept)} | {"all": kept}
    return {group: _estimate_quantities(chosen) for group, chosen in groups.items() if chosen}


def compute_label_scores(
    rows: Mapping[str, Sequence[dict]], required: Sequence[str]
) -> dict[str, dict[str, dict[str, Estimate | None]]]:
    """Estimate the mean of each quantity by label and side.

    Args:
        rows: Rows of the windows of each side.
        required: Sides that must have windows with a label; other labels are left out.

    Returns:
        For each label: estimates by side and QUANTITIES.
    """
    groups: dict[str, dict[str, list[dict]]] = {}
    for side, found in rows.items():
        for row in found:
            if row["kept"]:
                groups.setdefault(row["label"], {}).setdefault(side, []).append(row)
    return {
        label: {side: _estimate_quantities(found) for side, found in by_side.items()}
        for label, by_side in sorted(groups.items())
        if by_side.keys() >= set(required)
    }


def _estimate_quantities(rows: Sequence[dict]) -> dict[str, Estimate | None]:
    """Return the estimated mean of each of QUANTITIES over windows."""
    values = np.array([[row[name] for name in QUANTITIES] for row in rows], float)
    return dict(zip(QUANTITIES, compute_scene_means(values), strict=True))


def compute_whole_scores(results: Sequence[CityResult], towns: Sequence[CityResult]) -> dict[str, Any]:
    """Score cities as wholes: connectivity, city blocks, street directions and seams.

    Args:
        results: Cities of one side.
        towns: Cities of the ceiling, with whose streets those of `results` are compared. A town is not compared with
            itself. Windows of all labels count.

    Returns:
        Scores by name. Street distances and seams are nested by group of rings.
    """
    city_blocks_m2 = np.concatenate([result.city_blocks_m2 for result in results])
    scores: dict[str, Any] = {
        "cities": len(results),
        "road_connectivity": compute_scene_means(np.array([[result.connectivity] for result in results]))[0],
        "city_blocks_per_ha": len(city_blocks_m2) / sum(result.area_m2 for result in results) * HECTARE_M2,
        "median_city_block_m2": float(np.median(city_blocks_m2)) if len(city_blocks_m2) else None,
    }
    if simulated := [result.traffic for result in results if result.traffic]:
        shares = np.array([[found.routed / found.requested, found.arrived_share] for found in simulated])
        scores["vehicles_routed"], scores["vehicles_arrived"] = compute_scene_means(shares)
    towns_m = np.array([town.angles_m.sum(axis=0) for town in towns])
    distances: dict[str, Any] = {}
    seams: dict[str, Any] = {}
    for group in (*list_groups([row for result in results for row in result.rows]), "all"):
        of_group = [[group in (row["group"], "all") for row in result.rows] for result in results]
        angles_m = np.array([r.angles_m[mask].sum(axis=0) for r, mask in zip(results, of_group, strict=True)])
        found = compute_street_distances(angles_m, towns_m)
        same = [[result.city == town.city for town in towns] for result in results]
        found = np.where(same, np.nan, found)
        known = np.isfinite(found)
        per_city = np.divide(
            np.where(known, found, 0).sum(axis=1),
            known.sum(axis=1),
            out=np.full(len(found), np.nan),
            where=known.any(axis=1),
        )
        distances[group] = compute_scene_means(per_city[:, None])[0]
        records = [
            sum(
                (record for name, record in result.seams.items() if group in (name, "all")),
                np.zeros(SEAM_RECORD_SHAPE),
            )
            for result in results
        ]
        if any(record.any() for record in records):
            seams[group] = estimate_seam_ratios(np.array(records))
    return scores | {"street_distance": distances, "seams": seams}


def compute_street_distances(angles_m: np.ndarray, towns_m: np.ndarray) -> np.ndarray:
    """Compute the Jensen-Shannon distance between the street directions of each city and each town.

    Args:
        angles_m: (n, 18) length of streets by direction in n cities.
        towns_m: (k, 18) the same of k towns.

    Returns:
        (n, k) distances between 0 and 1 (base 2); NaN if a city or a town has no street.
    """

    def normalise(lengths: np.ndarray) -> np.ndarray:
        with np.errstate(invalid="ignore"):
            return lengths / lengths.sum(axis=1, keepdims=True)

    return np.array(
        [[jensenshannon(one, other, base=2) for other in normalise(towns_m)] for one in normalise(angles_m)]
    ).reshape(len(angles_m), len(towns_m))
