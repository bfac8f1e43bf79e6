"""Measure preprocessing on Ray with one and two workers, and on a simulated cluster of many nodes.

    python benchmarks/preprocess_scaling.py                 # about six minutes
    python benchmarks/preprocess_scaling.py --nodes 16      # many-node part with 16 simulated nodes of one CPU

The simulated cluster runs on one machine. The results are the CPU time and the network traffic of the driver per scene.
One driver serves all nodes. Both numbers must therefore be small, and they must not grow with the number of nodes.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("RAY_AUTH_MODE", "disabled")
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")

import logging
import pickle
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import ray
import ray.data
import tyro
from common import DENSE_SEEDS, describe_machine, spread, write_raw

from pipelines.preprocess.ingest import ingest_drives
from pipelines.preprocess.sharding import ShardTask, plan_kitti360
from pipelines.preprocess.sources import kitti360
from pipelines.schema.tables import find_shards

# number of poses of KITTI-360; number of logs of Argoverse 2, with two logs per shard
FULL_POSES, FULL_LOGS = 80_000, 1_000


@dataclass(frozen=True)
class Config:
    spacing_m: float = 1.5
    """Distance between poses in metres; 1.5 m gives about 1,700 scenes per sequence."""
    rounds: int = 2
    """Number of comparisons between one worker and two workers."""
    nodes: int = 8
    """Number of simulated nodes with one CPU each."""


@dataclass(frozen=True)
class Run:
    scenes: int
    shards: int
    seconds: float
    driver_seconds: float  # CPU time of the driver process.
    manifest_bytes: int  # Size of the manifests that the workers return to the driver.


def time_ingest(tasks: list[ShardTask]) -> Run:
    """Measure the time of one preprocessing run on the running Ray cluster."""
    received = []
    with tempfile.TemporaryDirectory() as out:
        start, clock = time.perf_counter(), time.process_time()
        result = ingest_drives(
            tasks, out, {"source": "kitti360"}, on_shard=lambda m: received.append(len(pickle.dumps(m)))
        )
        seconds, driver = time.perf_counter() - start, time.process_time() - clock
        assert len(find_shards(out)) == sum(1 for t in tasks if t.parts[0].poses)
    return Run(sum(result.scenes.values()), len(tasks), seconds, driver, sum(received))


def warm_up_workers(tasks: list[ShardTask]) -> None:
    """Let the workers import all modules before the measurement starts."""
    time_ingest(tasks[:2])


def start(**options) -> None:
    ray.init(logging_level="ERROR", log_to_driver=False, object_store_memory=500 * 2**20, **options)
    silence_ray_data()


def silence_ray_data() -> None:
    ray.data.DataContext.get_current().enable_progress_bars = False
    logging.getLogger("ray.data").setLevel(logging.ERROR)


def main(config: Config) -> None:
    print(describe_machine())
    raw = Path(tempfile.gettempdir()) / f"pritti-benchmark-raw-{config.spacing_m:g}"
    write_raw(raw, DENSE_SEEDS, config.spacing_m)
    tasks = plan_kitti360(str(raw), split=False)
    traffic = sum(len(pickle.dumps(kitti360.read_drive(raw, s)[0])) for s in kitti360.list_sequences(raw))

    runs: dict[int, list[Run]] = {1: [], 2: []}
    for _ in range(config.rounds):
        for workers in runs:
            start(address="local", num_cpus=workers)
            warm_up_workers(tasks)
            runs[workers].append(time_ingest(tasks))
            ray.shutdown()
    for workers, found in runs.items():
        rate = spread([r.scenes / r.seconds for r in found], digits=0)
        share = spread([100 * r.driver_seconds / r.seconds for r in found], digits=1)
        print(
            f"workers {workers}: {found[0].scenes} scenes in {found[0].shards} shards, {rate} scenes/s, "
            f"driver busy {share} % of the time"
        )
    gain = [a.seconds / b.seconds for a, b in zip(runs[1], runs[2], strict=True)]
    print(f"two workers against one: {spread(gain)} x")

    from ray.cluster_utils import Cluster

    for nodes in (2, config.nodes):
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "object_store_memory": 150 * 2**20})
        for _ in range(nodes - 1):
            cluster.add_node(num_cpus=1, object_store_memory=150 * 2**20)
        ray.init(address=cluster.address, logging_level="ERROR", log_to_driver=False)
        silence_ray_data()
        warm_up_workers(tasks)
        run = time_ingest(tasks)
        per_scene_ms, per_shard_ms = 1e3 * run.driver_seconds / run.scenes, 1e3 * run.driver_seconds / run.shards
        print(
            f"{nodes} nodes: driver {per_scene_ms:.2f} ms of CPU per scene ({per_shard_ms:.0f} ms per shard), "
            f"{run.manifest_bytes / run.scenes:.0f} bytes of manifests per scene to the driver; drives in the object "
            f"store: {traffic / 1e6:.1f} MB once, and once per node that reads them"
        )
        ray.shutdown()
        cluster.shutdown()
    shards = FULL_POSES / (run.scenes / run.shards) + FULL_LOGS / 2
    print(
        f"extrapolation: all of KITTI-360 and 1,000 logs of Argoverse 2 are {shards:.0f} shards, "
        f"{shards * per_shard_ms / 1e3:.0f} s of the driver's CPU time for any number of nodes"
    )


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
