"""Implementation of jobs/evaluate_city.py."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pyarrow as pa
from rich.console import Console
from rich.table import Table

from jobs.evaluate_city import Config
from jobs.support.cli import require_positive, resolve_path
from jobs.support.lite0 import prepare_lite0
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from jobs.support.scores import publish_scores
from models.labels import ANY
from models.scene import DENSITIES
from pipelines.evaluation.cities import (
    CEILING,
    REFERENCE,
    SPLIT,
    TOWN_SEEDS_START,
    CityJob,
    CityResult,
    compute_quantity_scores,
    compute_whole_scores,
    measure_cities,
    name_group,
    name_source,
    read_seams_m,
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

GENERATED, CONTROL = "generated", "control"
DAMAGE = "moved"  # Damage of the default control.
ENOUGH_WINDOWS = 100
SHOWN = 2  # Number of overviews per side.

Label = tuple[str | None, str | None]


def evaluate_city(config: Config) -> dict:
    """Measure and score all windows, write all files, and return the content of metrics.json."""
    require_positive(config, "num_reference", "num_towns", "num_actors")
    if config.num_towns < 2:
        raise ValueError(f"--num-towns is {config.num_towns}, expected at least 2: towns are compared with each other")
    generated = resolve_path(config.generated, "outpainted")
    dataset = Dataset.open(resolve_path(config.real, "datasets", "town"))
    output = resolve_path(config.output, "evaluations", "city")
    runs = {GENERATED: config.run} | ({CONTROL: config.control_run} if config.control_run else {})
    cities = {side: list_cities(generated, f"generated-{run}") for side, run in runs.items()}
    label = parse_label(config.label) if config.label else find_label(cities[GENERATED])
    reference = select_reference(dataset, config.real_split, label, config.num_reference)
    extent_m = min(extent for *_, extent in cities[GENERATED])
    jobs = [
        CityJob(side, number, (shard, row), seams_m=read_seams_m(generated, shard.source))
        for side, listed in cities.items()
        for number, (shard, row, _) in enumerate(listed)
    ]
    jobs += [CityJob(CEILING, k, (None, TOWN_SEEDS_START + k), extent_m, label=label) for k in range(config.num_towns)]
    with hold_output(output, "evaluation", config):
        root = storage.join_uri(output, "windows")
        storage.delete_directory(root)
        with JobProgress() as bar:
            tasks = {
                side: bar.add_task(f"measure {side}", total=total)
                for side, total in {REFERENCE: len(reference), **Counter(job.side for job in jobs)}.items()
            }
            results, reference_rows = measure_cities(
                jobs, reference, root, dataset, config.num_actors, lambda side: bar.advance(tasks[side])
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
        for side, groups in rings.items():
            whole = scores["whole"].get(side, {})
            for group, found in groups.items():
                found["street_distance"] = whole.get("street_distance", {}).get(group)
                found["seams"] = whole.get("seams", {}).get(group, {})
        every = [row for found in rows.values() for row in found]
        storage.write_parquet(pa.Table.from_pylist(every), storage.join_uri(output, "windows.parquet"))
        tags = {"generated": generated, "real": dataset.root, "label": format_label(label)}
        nested = publish_scores(output, scores, tags)
        overviews = [
            Picture(result.city, result.overview, side) for side, found in by_side.items() for result in found[:SHOWN]
        ]
        how = describe(config, dataset, label, by_side, count, reference_rows)
        storage.write_text(render_city_html(nested, rows, overviews, how), storage.join_uri(output, "city.html"))
        return nested


def list_cities(root: str, source: str) -> list[tuple[Shard, int, float]]:
    """List the large scenes of a source: shard, row and the shorter side (m)."""
    found = []
    for shard in find_shards(root, "scenes", source, None):
        for row, scene in enumerate(shard.scenes()):
            side_m = min(scene.grid.rows, scene.grid.cols) * scene.grid.resolution_m
            found.append((shard, row, side_m))
    return found


def find_label(cities: list[tuple[Shard, int, float]]) -> Label:
    """Return the label that all cities have.

    Raises:
        ValueError: The cities have different labels.
    """
    labels = set()
    for shard, row, _ in cities:
        table = shard.read("scenes", ["vegetation_density", "vehicle_density"])
        labels.add(tuple(table[name][row].as_py() for name in table.column_names))
    if len(labels) > 1:
        shown = ", ".join(sorted(format_label(label) for label in labels))
        raise ValueError(f"the cities have the labels {shown}; evaluate one label at a time, or pass --label any-any")
    return labels.pop()


def parse_label(text: str) -> Label:
    """Return the densities of vegetation and vehicles that a label names."""
    parts = [*text.split("-"), ANY][:2]
    if unknown := set(parts) - {*DENSITIES, ANY}:
        raise ValueError(
            f"--label is {text!r}, expected densities such as low-medium or any-any, of {', '.join(DENSITIES)}, {ANY};"
            f" {sorted(unknown)[0]!r} is unknown"
        )
    return tuple(None if part == ANY else part for part in parts)  # pyright: ignore[reportReturnType]


def format_label(label: Label) -> str:
    """Return the name of a label."""
    return "-".join(part or ANY for part in label)


def score_rings(
    config: Config, root: str, output: str, dataset: Dataset, rows: dict[str, list[dict]], bar: JobProgress
) -> tuple[dict, int]:
    """Compare the windows of each group of rings with the reference.

    Returns:
        Scores by side and group of rings, and the number of windows of each compared set.
    """
    sets = {
        (side, group): SceneSubset(root, name_source(side, ring), SPLIT)
        for side in rows
        if side not in (REFERENCE, CEILING)
        for ring in sorted({row["ring"] for row in rows[side]})
        for group in [name_group(ring)]
    }
    sets[CEILING, "all"] = SceneSubset(root, CEILING, SPLIT)
    counts = {key: count_scenes(subset) for key, subset in sets.items()}
    if not counts[CEILING, "all"]:
        raise ValueError(
            f"no window of {config.num_towns} towns has the label; use more --num-towns, or --label any-any"
        )
    count = min(counts.values())
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
    count: int,
    reference_rows: list[dict],
) -> list[str]:
    """Return the sentences of the page about the compared sets."""
    control = (
        f"The control are {len(by_side[CONTROL])} scenes of run {config.control_run}."
        if config.control_run
        else f"The control are windows of the ceiling with damage: {CONTROLS[DAMAGE]}."
    )
    return [
        f"Cities: {len(by_side[GENERATED])} scenes of run {config.run}.",
        f"Reference: {len(reference_rows)} scenes of {dataset.root}, split {config.real_split}, label"
        f" {format_label(label)}; crops at any place if the dataset has such crops.",
        f"Ceiling: windows with this label of {config.num_towns} procedural towns.",
        control,
        f"Each set of windows has {count} windows. Windows are moved vertically, so that the ground at their origin is"
        " as high as in the reference.",
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
