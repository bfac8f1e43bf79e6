"""Measure how options of outpainting change the content of cities.

    python benchmarks/city_causes.py --work DIRECTORY --real $PRITTI_HOME/datasets/town
    python benchmarks/city_causes.py --work DIRECTORY --real DIRECTORY --variants default no-plan copied

Each variant differs from the variant in its column "differs from" by one option. The same generated scenes are extended
with each variant by jobs/outpaint_scenes.py, and all cities are measured like those of jobs/evaluate_city.py. The
window of the given scene is left out. The table also has scenes of the data with the same label, and windows of
procedural towns (ceiling). $PRITTI_HOME is set to --work, where the benchmark resumes after an interruption.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import ray
import tyro
from common import describe_machine

from jobs.implementation.evaluate_city import list_cities
from pipelines.evaluation.cities import (
    CEILING,
    REFERENCE,
    TOWN_SEEDS_START,
    CityRequest,
    CityResult,
    compute_quantity_scores,
    compute_whole_scores,
    measure_cities,
    parse_label,
    read_run_record,
    select_reference,
)
from pipelines.metrics.intervals import Estimate
from pipelines.schema.dataset import Dataset

ROOT = Path(__file__).resolve().parent.parent
NO_PLAN = ("--plan-streets", "False")
GUIDED = (*NO_PLAN, "--inpainting", "guided")


class Variant(NamedTuple):
    """Options of jobs/outpaint_scenes.py, and the variant that differs by one option."""

    options: tuple[str, ...]
    control: str


VARIANTS = {
    "default": Variant((), ""),
    "views": Variant(("--free-blocks", "none"), "default"),
    "label-guidance": Variant(("--guidance-scale", "1.5"), "default"),
    "no-constraints": Variant(("--no-constraints",), "default"),
    "no-plan": Variant(NO_PLAN, "default"),
    "outward": Variant((*NO_PLAN, "--order", "outward", "--overlap", "0.25"), "no-plan"),
    "outward-half": Variant((*NO_PLAN, "--order", "outward", "--overlap", "0.5"), "outward"),
    "copied": Variant((*NO_PLAN, "--neighbour-latents", "copy"), "no-plan"),
    "paper-latents": Variant((*NO_PLAN, "--neighbour-latents", "paper"), "copied"),
    "guided": Variant(GUIDED, "no-plan"),
    "guided-eta-0": Variant((*GUIDED, "--eta", "0"), "guided"),
    "guided-eta-1": Variant((*GUIDED, "--eta", "1"), "guided"),
    "guided-half": Variant((*GUIDED, "--pseudoinverse-guidance", "0.5"), "guided"),
}
VEGETATION = ("vegetation_cuboid_per_ha", "vegetation_ellipsoid_per_ha")
COLUMNS = {
    "vegetation": VEGETATION,
    "cars": ("vehicle_small_per_ha",),
    "buildings, walls": ("construction_big_per_ha", "construction_small_per_ha"),
    "poles, signs": ("pole_per_ha", "traffic_control_per_ha"),
    "road, terrain": ("road_share", "terrain_share"),
    "junctions, dead ends": ("junctions_per_ha", "dead_ends_per_ha"),
}


@dataclass(frozen=True)
class Config:
    work: str
    """Directory for scenes and cities."""
    real: str
    """Dataset directory of the town with held-out scenes."""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """Variants to measure."""
    model: str = "town"
    """Pipeline."""
    label: str = "medium-medium"
    """Densities of vegetation and vehicles."""
    num_cities: int = 2
    """Number of cities per variant."""
    extent_m: float = 352.0
    """Side of a city in metres."""
    num_towns: int = 3
    """Number of procedural towns of the ceiling."""
    seed: int = 7
    """Seed of the given scenes."""


def run_job(name: str, *options: str) -> None:
    """Run a job; a job that has finished before returns at once."""
    subprocess.run([sys.executable, ROOT / "jobs" / f"{name}.py", *options], check=True, cwd=ROOT)


def make_cities(config: Config) -> None:
    """Generate the given scenes, and the cities of all variants around them."""
    os.environ["PRITTI_HOME"] = str(Path(config.work).resolve())
    model = ("--model", config.model)
    given = ("--num-scenes", str(config.num_cities), "--labels", config.label, "--seed", str(config.seed))
    run_job("sample_scenes", *model, *given, "--run", "given")
    extent = ("--extent-m", f"{config.extent_m}", f"{config.extent_m}")
    shared = ("--source", "generated-given", "--label", config.label, "--precision", "bf16", "--num-actors", "2")
    for name in config.variants:
        options = (*extent, *shared, "--max-scenes", str(config.num_cities), *VARIANTS[name].options)
        run_job("outpaint_scenes", *model, "--run", name, *options)


def measure_variants(config: Config) -> tuple[dict[str, list[CityResult]], list[dict]]:
    """Measure the cities of all variants, the towns and the data."""
    root, dataset, label = str(Path(config.work, "outpainted")), Dataset.open(config.real), parse_label(config.label)
    requests, resolution_m = [], 0.0
    for name in config.variants:
        record = read_run_record(root, f"generated-{name}")
        for number, city in enumerate(list_cities(root, f"generated-{name}", record)):
            resolution_m = city.resolution_m
            requests.append(
                CityRequest(name, number, city.tiles, seams_m=record.seams_m, label=label, rings_per_group=99)
            )
    for k in range(config.num_towns):
        town = CityRequest(CEILING, k, town_seed=TOWN_SEEDS_START + k, extent_m=config.extent_m, label=label)
        requests.append(town)
    reference = select_reference(dataset, "test", label, 400)
    windows = str(Path(config.work, "windows"))
    results, rows = measure_cities(requests, reference, windows, dataset, resolution_m, num_tasks=2)
    by_side: dict[str, list[CityResult]] = {}
    for result in results:
        by_side.setdefault(result.side, []).append(result)
    return by_side, rows


def format_estimate(value: Estimate | float | None, digits: int) -> str:
    """Format the value of an estimate without its interval."""
    value = value.value if isinstance(value, Estimate) else value
    return "–" if value is None else f"{value:.{digits}f}"


def format_row(name: str, rows: list[dict], whole: dict, generated: bool) -> str:
    """Return one row of the table."""
    if generated:
        rows = [row for row in rows if row["ring"] > 0]
    means = compute_quantity_scores(rows)["all"]
    texts = []
    for keys in COLUMNS.values():
        digits = 3 if keys[0].endswith("_share") else 1
        texts.append(", ".join(format_estimate(means[key], digits) for key in keys))
    seams = whole.get("seams", {}).get("all", {})
    texts.append(format_estimate(whole.get("road_connectivity"), 2))
    texts.append(", ".join(format_estimate(value, 2) for value in list(seams.values())[:2]) or "–")
    return f"| {name} | {VARIANTS[name].control if name in VARIANTS else ''} | {' | '.join(texts)} |"


def main(config: Config) -> None:
    if unknown := sorted(set(config.variants) - set(VARIANTS)):
        raise SystemExit(f"--variants {unknown[0]} is unknown; choose from {', '.join(VARIANTS)}")
    make_cities(config)
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    by_side, reference = measure_variants(config)
    ray.shutdown()
    print(describe_machine())
    counts = Counter({side: sum(row["ring"] > 0 for r in found for row in r.rows) for side, found in by_side.items()})
    print(f"{config.num_cities} cities of {config.extent_m:g} m per variant, windows per variant: {dict(counts)}")
    print(
        f"| variant | differs from | {' | '.join(COLUMNS)} | road in the largest part | class changes, height steps |"
    )
    print("|" + "---|" * (len(COLUMNS) + 4))
    for side, found in by_side.items():
        rows = [row for result in found for row in result.rows]
        print(format_row(side, rows, compute_whole_scores(found, by_side[CEILING]), side != CEILING))
    print(format_row(REFERENCE, reference, {}, False))


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
