"""Compare plain sampling, constraints, --repair and both on the same seeds, next to the data's own values.

    python benchmarks/constraints.py                      128 scenes of the released weights, four ways, 6 minutes
    python benchmarks/constraints.py --scenes 32

The four ways run in turn on chunks of scenes, so a busy machine slows all of them equally. Real scenes are test scenes
of the built-in town on the grid of the model. Overlap by volume, footprints and headings are measures that --repair
does not optimise; --repair optimises IoU3D, floating and sunken objects.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import tyro
from common import describe_machine

from models.labels import list_usual_labels
from models.pipeline import PrITTIPipeline
from models.sampling.constraints import ConstraintConfig
from models.scene import CATEGORIES, CATEGORY_INDEX, VEHICLES, Scene
from pipelines.editing.edit import Repair
from pipelines.generation.sample import load_pipeline, resample_to_model_grid
from pipelines.metrics.intervals import Estimate, estimate_ratios
from pipelines.metrics.relations import UNSUPPORTED, fuse_ground, measure_objects
from pipelines.metrics.validity import find_faults
from pipelines.preprocess.sources.town.generator import TEST_SEEDS_START, generate_town

WAYS = {"plain": (False, False), "constraints": (True, False), "repair": (False, True), "both": (True, True)}
FAULTS = (
    "overlapping_iou3d",
    "overlapping",
    "constructions_on_road",
    "constructions_on_sidewalk",
    "floating",
    "sunken",
    "across_lane_vehicles",
    "over_unknown_ground",
)
MEASURES = (*FAULTS, "buildings_on_road", "signs_unsupported", "poles_unsupported", "heading_deg")


@dataclass(frozen=True)
class Config:
    model: str = "town"
    town_version: int = 2
    """Version of the town whose test scenes are the real scenes."""
    scenes: int = 128
    """Number of scenes per way, and of real scenes."""
    seed: int = 0
    sampler: str = "sde-dpm++"
    steps: int = 20
    chunk: int = 8
    """Number of scenes per batch."""
    last: float = ConstraintConfig.last
    """Share of the steps that are guided, and further options of ConstraintConfig."""
    every: int = ConstraintConfig.every
    iterations: int = ConstraintConfig.iterations
    step: float = ConstraintConfig.step
    trust: float = ConstraintConfig.trust


def measure_scene(scene: Scene, slab_offset_m: float) -> np.ndarray:
    """Return numerator and denominator (measures, 2) of MEASURES."""
    objects = measure_objects(scene, slab_offset_m, *fuse_ground(scene))
    faults = find_faults(scene, slab_offset_m, names=FAULTS, objects=objects)
    buildings = scene.category == CATEGORY_INDEX["construction_big"]
    inside = scene.grid.contains(scene.center_m[:, 0], scene.center_m[:, 1])
    pairs = [(bad.sum(), among.sum()) for bad, among in faults.values()]
    pairs.append(((faults["constructions_on_road"][0] & buildings).sum(), buildings.sum()))
    for name in ("traffic_control", "pole"):
        members = (scene.category == CATEGORY_INDEX[name]) & inside
        pairs.append(((objects.support[members] == UNSUPPORTED).sum(), members.sum()))
    vehicles = np.isin(scene.category, VEHICLES) & (objects.edge_m < 0)
    pairs.append((np.degrees(objects.edge_angle_rad[vehicles]).sum(), vehicles.sum()))
    return np.array(pairs, np.float64)


def make_real_scenes(pipeline: PrITTIPipeline, count: int, town_version: int) -> list[Scene]:
    towns = 8
    drives = [generate_town(TEST_SEEDS_START + k, town_version) for k in range(towns)]
    per_town = -(-count // towns)
    scenes = [
        drive.scene(int(number), "test") for drive in drives for number in np.linspace(0, len(drive) - 1, per_town)
    ]
    return [resample_to_model_grid(scene, pipeline.spec) for scene in scenes[:count]]


def format_share(estimate: Estimate | None, scale: float) -> str:
    if estimate is None:
        return "–"
    value, low, high = (scale * part for part in estimate)
    return f"{value:.2f} ({low:.2f} to {high:.2f})"


def print_table(records: dict[str, np.ndarray], counts: dict[str, np.ndarray], seconds: dict[str, float]) -> None:
    """Print one row per measure and one column per set of scenes."""
    shares = {name: estimate_ratios(found[:, :, 0], found[:, :, 1]) for name, found in records.items()}
    print("| measure | " + " | ".join(records) + " |\n" + "|---" * (len(records) + 1) + "|")
    for k, name in enumerate(MEASURES):
        scale = 1.0 if name.endswith("_deg") else 100.0
        cells = [format_share(found[k], scale) for found in shares.values()]
        print(f"| {name.replace('_', ' ')} | " + " | ".join(cells) + " |")
    for k, name in enumerate(CATEGORIES):
        print(f"| number of {name} | " + " | ".join(f"{found[k]:.2f}" for found in counts.values()) + " |")
    times = [f"{seconds[name]:.3f}" if name in seconds else "–" for name in records]
    print("| seconds per scene | " + " | ".join(times) + " |")


def main(config: Config) -> None:
    pipeline = load_pipeline(config.model)
    pipeline.use_sampler(config.sampler)
    offset_m = pipeline.spec.slab_offset_m
    guidance = ConstraintConfig(
        last=config.last, every=config.every, iterations=config.iterations, step=config.step, trust=config.trust
    )
    repair = Repair(slab_offset_m=offset_m, drop=False)
    labels = list_usual_labels(pipeline.dit.config.label)
    made: dict[str, list[Scene]] = {name: [] for name in WAYS}
    seconds = dict.fromkeys(WAYS, 0.0)
    reports = []

    def generate(way: str, numbers: Sequence[int]) -> list[Scene]:
        is_guided, is_repaired = WAYS[way]
        pipeline.set_constraints(guidance if is_guided else None)
        scenes = pipeline.generate(
            [labels[k % len(labels)] for k in numbers], config.seed, numbers, config.steps, run="constraints"
        )
        if pipeline.guidance:
            reports.append(pipeline.guidance.report)
        if is_repaired:
            scenes = [repair.apply_to(scene, np.ones(len(scene), bool))[0] for scene in scenes]
        return scenes

    generate("both", range(config.chunk))  # Warm-up.
    for start in range(0, config.scenes, config.chunk):
        numbers = range(start, min(start + config.chunk, config.scenes))
        for way in WAYS:
            began = time.process_time()
            made[way] += generate(way, numbers)
            seconds[way] += time.process_time() - began
    sets = {"data": make_real_scenes(pipeline, config.scenes, config.town_version)} | made
    print(describe_machine(), guidance)
    print(f"{config.scenes} scenes per column, {sum(r.fallbacks for r in reports)} fallbacks", flush=True)
    records = {name: np.stack([measure_scene(one, offset_m) for one in scenes]) for name, scenes in sets.items()}
    counts = {name: np.mean([scene.counts() for scene in scenes], axis=0) for name, scenes in sets.items()}
    print_table(records, counts, {name: value / config.scenes for name, value in seconds.items()})


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
