"""Measure the memory and the CPU time of the driver when it scores many scenes.

    python benchmarks/evaluation_driver.py                       60,000 scenes per side, about an hour on two cores
    python benchmarks/evaluation_driver.py --num-scenes 2000     a minute

The features of `--num-described` town scenes are computed, and repeated with noise until there are enough rows. The CPU
time that the driver needs per scene to compute features is the difference between many and 64 scenes. Targets: at most
1 GB of memory (resident, without the shared object store), at most 0.3 ms of CPU time per scene, both independent of
the number of scenes.
"""

from __future__ import annotations

import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import tyro
from common import describe_machine

from jobs.support.ray_session import start_ray
from pipelines.evaluation.evaluate import compare_datasets, score_nearest_distances
from pipelines.evaluation.features import FeatureConfig, FeatureParts, compute_scene_features, write_part
from pipelines.preprocess import ingest
from pipelines.preprocess.sharding import plan_town
from pipelines.schema.dataset import Dataset
from pipelines.schema.scene_subset import SceneSubset

PART = 64
FEW = 64
NOISE = 0.3  # Noise on features of networks, in standard deviations of each feature.


@dataclass(frozen=True)
class Config:
    num_scenes: int = 60_000
    """Number of scenes per side."""
    num_described: int = 1024
    """Number of real scenes whose features are computed; the other side has 64."""
    seed: int = 0
    """Random seed."""


def write_features(directory: str, seen: dict[str, np.ndarray], count: int, seed: int) -> FeatureParts:
    """Write the features of `count` scenes, drawn from the rows in `seen`; features of networks get noise."""
    rng = np.random.default_rng(seed)
    columns = [name for name in seen if name not in ("scene_id", "place")]
    for number, first in enumerate(range(0, count, PART)):
        names = [f"scene-{k}" for k in range(first, min(first + PART, count))]
        rows = rng.integers(0, len(seen["scene_id"]), len(names))
        values = {name: seen[name][rows] for name in columns}
        spread = NOISE * seen["random"].std(axis=0)
        values["random"] = values["random"] + rng.normal(size=values["random"].shape) * spread
        write_part(directory, number, names, names, values)
    return FeatureParts(directory, -(-count // PART))


def measure_private_bytes() -> int:
    """Return the resident memory of this process without shared memory, in which the object store is."""
    memory = psutil.Process().memory_info()
    return memory.rss - memory.shared


def main(config: Config) -> None:
    print(describe_machine())
    start_ray()
    with tempfile.TemporaryDirectory() as folder:
        town = str(Path(folder, "town"))
        ingest.ingest_drives(plan_town(config.num_described, FEW, config.seed), town, {"source": "town"})
        dataset, sides, spent_s = Dataset.open(town), {}, []
        for name, split in (("generated", "test"), ("real", "train")):
            selection, cpu = SceneSubset(town, "town", split), time.process_time()
            described = compute_scene_features(selection, dataset, FeatureConfig(), f"{folder}/few-{name}", 2)
            spent_s.append(time.process_time() - cpu)
            many = f"{folder}/many-{name}"
            sides[name] = write_features(many, described.read(), config.num_scenes, config.seed + len(sides)).open()
        peak, done = measure_private_bytes(), threading.Event()
        before = peak

        def watch() -> None:
            nonlocal peak
            while not done.wait(0.1):
                peak = max(peak, measure_private_bytes())

        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        started, cpu = time.perf_counter(), time.process_time()
        scores = compare_datasets(sides["real"], sides["generated"], dataset.spec.ground_classes)
        _, nearest = score_nearest_distances(sides["real"], sides["generated"])
        seconds, cpu_s = time.perf_counter() - started, time.process_time() - cpu
        done.set()
        watcher.join()
    print(f"{config.num_scenes:,} x {config.num_scenes:,} scenes, {len(scores)} scores, {seconds:.0f} s")
    per_scene_ms = 1e3 * (spent_s[1] - spent_s[0]) / max(1, config.num_described - FEW)
    print(f"features of {config.num_described:,} scenes: {per_scene_ms:.3f} ms of the driver's CPU time per scene")
    print(f"copies {nearest['copies'].value:.3f}, random_frechet {scores['random_frechet'].value:.4g}")
    print(
        f"driver: {peak / 1e9:.2f} GB (before: {before / 1e9:.2f}), {1e3 * cpu_s / 2 / config.num_scenes:.3f} ms/scene"
    )


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
