"""Implementation of jobs/evaluate_city.py."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import pyarrow as pa
from rich.console import Console
from rich.table import Table

from jobs.evaluate_city import Config
from jobs.support.cli import require_positive, resolve_path
from jobs.support.lite0 import prepare_lite0
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from jobs.support.scores import publish_scores
from pipelines.evaluation.cities import (
    CEILING,
    REFERENCE,
    SPLIT,
    TOWN_SEEDS_START,
    CityRequest,
    CityResult,
    Label,
    RunRecord,
    choose_rings_per_group,
    compute_label_scores,
    compute_quantity_scores,
    compute_whole_scores,
    format_label,
    list_groups,
    measure_cities,
    name_source,
    parse_label,
    read_run_record,
    select_reference,
)
from pipelines.evaluation.evaluate import compare_datasets
from pipelines.evaluation.features import FeatureConfig, compute_scene_features, count_scenes
from pipelines.metrics.controls import CONTROLS
from pipelines.reporting.city_report import build_ring_table, render_city_html
from pipelines.reporting.report import Picture
from pipelines.runtime import storage
from pipelines.schema.dataset import Dataset
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import Shard, find_shards
from pipelines.traffic.sumo import find_sumo

GENERATED, CONTROL = "generated", "control"
DAMAGE = "moved"  # Damage of the default control.
ENOUGH_WINDOWS = 100
MIN_WINDOWS = 6  # Scores with 3 neighbours need more than 3 windows.
MIN_EXTENT_M = 192.0  # Rings 0 and 1.
MAX_TOWN_EXTENT_M = 576.0  # Side of a town of the ceiling: 9 x 9 windows.
SHOWN = 2  # Number of overviews per side.


def evaluate_city(config: Config) -> dict:
    """Measure and score all windows, write all files, and return the content of metrics.json."""
    require_positive(config, "num_reference", "num_towns", "num_actors", "rings_per_group")
    if config.num_towns < 2:
        raise ValueError(f"--num-towns is {config.num_towns}, expected at least 2: towns are compared with each other")
    generated = resolve_path(config.generated, "outpainted")
    dataset = Dataset.open(resolve_path(config.real, "datasets", "town"))
    output = resolve_path(config.output, "evaluations", "city")
    runs = {GENERATED: config.run} | ({CONTROL: config.control_run} if config.control_run else {})
    records = {side: read_run_record(generated, f"generated-{run}") for side, run in runs.items()}
    cities = {side: list_cities(generated, f"generated-{run}", records[side]) for side, run in runs.items()}
    labels = {side: find_label(listed, records[side], config.label) for side, listed in cities.items()}
    if len(set(labels.values())) > 1:
        shown = " and ".join(f"{format_label(label)} ({runs[side]})" for side, label in labels.items())
        raise ValueError(f"the runs have different labels, {shown}; compare runs with one label, or pass --label")
    label = labels[GENERATED]
    resolutions = {city.resolution_m for listed in cities.values() for city in listed}
    if len(resolutions) > 1:
        shown = ", ".join(f"{resolution_m:g} m" for resolution_m in sorted(resolutions))
        raise ValueError(f"the cities have pixels of {shown}; compare cities with pixels of one size")
    (resolution_m,) = resolutions
    traffic = config.traffic and find_sumo() is not None
    reference = select_reference(dataset, config.real_split, label, config.num_reference)
    extent_m = min(city.side_m for city in cities[GENERATED])
    if extent_m < MIN_EXTENT_M:
        raise ValueError(
            f"a city of run {config.run} has a side of {extent_m:g} m, expected at least {MIN_EXTENT_M:g} m, which hold"
            " rings 0 and 1; use outpaint_scenes.py --extent-m"
        )
    make_request = partial(
        CityRequest,
        traffic=traffic,
        label=label,
        rings_per_group=config.rings_per_group or choose_rings_per_group(extent_m),
    )
    jobs = [
        make_request(
            side,
            number,
            city.tiles,
            corner_m=records[side].corner_m,
            seams_m=records[side].seams_m,
            block_labels=records[side].block_labels,
        )
        for side, listed in cities.items()
        for number, city in enumerate(listed)
    ]
    town_m = min(extent_m, MAX_TOWN_EXTENT_M)
    jobs += [make_request(CEILING, k, town_seed=TOWN_SEEDS_START + k, extent_m=town_m) for k in range(config.num_towns)]
    with hold_output(output, "evaluation", config):
        root = storage.join_uri(output, "windows")
        storage.delete_directory(root)
        with JobProgress() as bar:
            tasks = {
                side: bar.add_task(f"measure {side}", total=total)
                for side, total in {REFERENCE: len(reference), **Counter(job.side for job in jobs)}.items()
            }
            results, reference_rows = measure_cities(
                jobs,
                reference,
                root,
                dataset,
                resolution_m,
                config.num_actors,
                lambda side: bar.advance(tasks[side]),
            )
            by_side: dict[str, list[CityResult]] = {}
            for result in results:
                by_side.setdefault(result.side, []).append(result)
            rows = {side: [row for result in found for row in result.rows] for side, found in by_side.items()}
            rows[REFERENCE] = reference_rows
            rings, count = score_rings(config, root, output, dataset, rows, bar)
        scores = {
            "windows_per_set": count,
            "rings": rings,
            "quantities": {side: compute_quantity_scores(found) for side, found in rows.items()},
            "whole": {side: compute_whole_scores(found, by_side[CEILING]) for side, found in by_side.items()},
        }
        has_map = any(record.block_labels for record in records.values())
        if has_map:
            scores["labels"] = compute_label_scores(rows, (GENERATED, REFERENCE))
        every = [row for found in rows.values() for row in found]
        storage.write_parquet(pa.Table.from_pylist(every), storage.join_uri(output, "windows.parquet"))
        tags = {"generated": generated, "real": dataset.root, "label": format_label(label)}
        nested = publish_scores(output, scores, tags)
        overviews = [
            Picture(result.city, result.overview, side) for side, found in by_side.items() for result in found[:SHOWN]
        ]
        how = describe(config, dataset, label, by_side, town_m, count, reference_rows, has_map)
        storage.write_text(render_city_html(nested, rows, overviews, how), storage.join_uri(output, "city.html"))
        return nested


class City(NamedTuple):
    """Shard and row of a large scene, or of its tiles; its shorter side (m), the size of its pixels (m), its label."""

    tiles: tuple[tuple[Shard, int], ...]
    side_m: float
    resolution_m: float
    label: Label


def list_cities(root: str, source: str, record: RunRecord) -> list[City]:
    """List the large scenes of a source; the tiles of one scene are consecutive and have the same frame.

    Raises:
        ValueError: The source has no scene.
    """
    found: dict[int, list[tuple[dict, dict, tuple[Shard, int]]]] = {}
    for shard in find_shards(root, "scenes", source, None):
        scenes = shard.read("scenes", ["frame", "vegetation_density", "vehicle_density"]).to_pylist()
        rasters = shard.read("rasters", ["rows", "cols", "resolution_m"]).to_pylist()
        for row, (scene, raster) in enumerate(zip(scenes, rasters, strict=True)):
            number = scene.pop("frame") if record.corner_m else len(found)
            found.setdefault(number, []).append((scene, raster, (shard, row)))
    if not found:
        raise ValueError(f"{root}: source {source} holds no scene")
    cities = []
    for number in sorted(found):
        parts = found[number]
        resolution_m = parts[0][1]["resolution_m"]
        sides_m = record.size_m or tuple(parts[0][1][name] * resolution_m for name in ("rows", "cols"))
        label = parts[0][0]["vegetation_density"], parts[0][0]["vehicle_density"]
        cities.append(City(tuple(place for *_, place in parts), min(sides_m), resolution_m, label))
    return cities


def find_label(cities: list[City], record: RunRecord, option: str) -> Label:
    """Return the requested label of all cities of a run: the option, that of the run's record, or that of the cities.

    Raises:
        ValueError: The cities have different labels.
    """
    if option:
        return parse_label(option)
    if record.label:
        return record.label
    labels = {city.label for city in cities}
    if len(labels) > 1:
        shown = ", ".join(sorted(format_label(label) for label in labels))
        raise ValueError(f"the cities have the labels {shown}; evaluate one label at a time, or pass --label any-any")
    return labels.pop()


def score_rings(
    config: Config, root: str, output: str, dataset: Dataset, rows: dict[str, list[dict]], bar: JobProgress
) -> tuple[dict, int]:
    """Compare the windows of each group of rings with the reference.

    Returns:
        Scores by side and group of rings, and the number of windows of each compared set.
    """
    sets = {
        (side, group): SceneSubset(root, name_source(side, group), SPLIT)
        for side in rows
        if side not in (REFERENCE, CEILING)
        for group in list_groups(rows[side])
    }
    sets[CEILING, "all"] = SceneSubset(root, CEILING, SPLIT)
    counts = {key: count_scenes(subset) for key, subset in sets.items()}
    counts[REFERENCE, "all"] = len(rows[REFERENCE])
    (side, group), count = min(counts.items(), key=lambda entry: entry[1])
    if count < MIN_WINDOWS:
        advice = {CEILING: "use more --num-towns", REFERENCE: "use a dataset with more scenes of the label"}
        raise ValueError(
            f"only {count} windows of the set {side}, ring {group}, expected at least {MIN_WINDOWS}:"
            f" {advice.get(side, 'outpaint more scenes')}, or pass --label any-any"
        )
    count = min(number for key, number in counts.items() if key[0] != REFERENCE)
    looks = FeatureConfig(lite0=prepare_lite0())

    def describe_set(subset: SceneSubset, name: str, control: str = "") -> dict:
        task = bar.add_task(f"describe {name}", total=count_scenes(subset))
        how, directory = replace(looks, control=control), storage.join_uri(output, "described", name)
        return compute_scene_features(
            subset, dataset, how, directory, config.num_actors, lambda n: bar.advance(task, n)
        ).read()

    truth = describe_set(SceneSubset(root, REFERENCE, SPLIT), REFERENCE)
    scores: dict[str, dict] = {}

    def score(side: str, group: str, subset: SceneSubset, control: str = "") -> None:
        made = describe_set(replace(subset, limit=count, pick="spread"), f"{side}-{group}", control)
        scores.setdefault(side, {})[group] = compare_datasets(truth, made, dataset.spec.ground_classes)

    for (side, group), subset in sets.items():
        score(side, group, subset)
    if CONTROL not in rows:
        score(CONTROL, "all", sets[CEILING, "all"], DAMAGE)
    return scores, count


def describe(
    config: Config,
    dataset: Dataset,
    label: Label,
    by_side: dict[str, list[CityResult]],
    town_m: float,
    count: int,
    reference_rows: list[dict],
    has_map: bool,
) -> list[str]:
    """Return the sentences of the page about the compared sets."""
    control = (
        f"The control consists of {len(by_side[CONTROL])} scenes of run {config.control_run}."
        if config.control_run
        else f"The control consists of windows of the ceiling with damage: {CONTROLS[DAMAGE]}."
    )
    return [
        f"Cities: {len(by_side[GENERATED])} scenes of run {config.run}.",
        f"Reference: {len(reference_rows)} scenes of {dataset.root}, split {config.real_split}, label"
        f" {format_label(label)}; crops at any place if the dataset has such crops.",
        f"Ceiling: windows of {config.num_towns} procedural towns (version 2) of {town_m:g} m with this label. They are"
        " selected by their measured label, so their label fidelity is 1 and no ceiling.",
        control,
        f"Each set of windows has {count} windows. Windows are moved vertically, so that the ground at their origin is"
        " as high as in the reference. Intervals treat windows as independent. They are too narrow, because windows of"
        " one city resemble each other.",
        "Street directions, city blocks and connectivity use all windows of the towns, whatever their label.",
        *(["Each window has the label of the nearest block of --labels-map."] if has_map else []),
        *([] if find_sumo() else ["Traffic was not simulated, because SUMO is not installed (extra traffic)."]),
    ]


def main(config: Config) -> None:
    scores = evaluate_city(config)
    shown = build_ring_table(scores)
    table = Table(*map(str, shown.columns))
    for row in shown.rows:
        table.add_row(*("–" if cell is None else str(cell) for cell in row))
    Console().print(table)
    if scores["windows_per_set"] < ENOUGH_WINDOWS:
        print(f"only {scores['windows_per_set']} windows per set: outpaint more scenes for reliable scores")
