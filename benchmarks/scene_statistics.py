"""Measure the time of the statistics of one scene, in CPU milliseconds of one thread.

    python benchmarks/scene_statistics.py

Relations and validity are measured together, as in the evaluation: the relations of the objects are used twice. Target:
relation statistics and validity together take at most 5 ms per scene more than the validity measures of version 0.2.0
alone (overlap by IoU3D, height above ground, ground class and road connectivity).
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import tyro
from common import describe_machine, spread, time_interleaved

from models.layout import SLAB_OFFSET_M
from models.scene import Scene
from pipelines.geometry.masks import label_parts
from pipelines.metrics.distributions import compute_scene_histograms
from pipelines.metrics.relations import fuse_ground, measure_objects, summarise_relations
from pipelines.metrics.statistics import compute_layout_statistics
from pipelines.metrics.validity import compute_category_validity, find_faults
from pipelines.preprocess.sources.town.generator import generate_town

EARLIER = ("overlapping_iou3d", "floating", "sunken", "over_unknown_ground", "off_road_vehicles")


@dataclass(frozen=True)
class Config:
    scenes: int = 60
    rounds: int = 5


def measure_relations_and_validity(scene: Scene) -> None:
    height_m, classes = fuse_ground(scene)
    objects = measure_objects(scene, SLAB_OFFSET_M, height_m, classes)
    summarise_relations(scene, objects, classes)
    compute_category_validity(scene, SLAB_OFFSET_M, objects)


def measure_earlier_validity(scene: Scene) -> None:
    find_faults(scene, SLAB_OFFSET_M, names=EARLIER)
    label_parts(scene.occupied[scene.ground_classes.index("road")])  # Road connectivity.


MEASURED: dict[str, Callable[[Scene], object]] = {
    "relations and validity": measure_relations_and_validity,
    "validity of version 0.2.0": measure_earlier_validity,
    "layout statistics": compute_layout_statistics,
    "layout histograms": compute_scene_histograms,
}


def main(config: Config) -> None:
    drives = [generate_town(seed) for seed in range(3)]
    numbers = np.linspace(0, 1, -(-config.scenes // len(drives)))
    scenes = [drive.scene(int(share * (len(drive) - 1)), "test") for drive in drives for share in numbers]
    print(
        describe_machine(), f"{len(scenes)} scenes, {np.mean([len(scene) for scene in scenes]):.0f} objects per scene"
    )

    def repeat(measure: Callable[[Scene], object]) -> Callable[[int], object]:
        return lambda _: [measure(scene) for scene in scenes]

    ways = {name: repeat(measure) for name, measure in MEASURED.items()}
    seconds = {
        name: [value / len(scenes) for value in found[1:]]  # The first round warms up.
        for name, found in time_interleaved(ways, config.rounds + 1).items()
    }
    for name, found in seconds.items():
        print(f"{name}: {spread(found, 1e3, 2)} ms per scene")
    added = [a - b for a, b in zip(*list(seconds.values())[:2], strict=True)]
    print(f"new: {spread(added, 1e3, 2)} ms per scene")


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
