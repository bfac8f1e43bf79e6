"""Measure the CPU time to start the interpreter alone, a process with a loaded pipeline, and Ray workers.

    python benchmarks/import_time.py                    # a minute

The time of a Ray worker includes the start of Ray. The benchmark also lists the import time of torch as a reference for
the speed of the machine.
"""

from __future__ import annotations

import importlib
import resource
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass

import ray
import tyro
from common import describe_machine

PROCESSES = {
    "import torch": "import torch",
    "PrITTIPipeline.from_pretrained('town')": (
        "from models import PrITTIPipeline; PrITTIPipeline.from_pretrained('town')"
    ),
    "... and DPM-Solver++, from diffusers": (
        "from models import PrITTIPipeline; p = PrITTIPipeline.from_pretrained('town'); "
        "p.use_sampler('dpm++'); p.scheduler"
    ),
    "import diffusers.DiffusionPipeline": "from diffusers import DiffusionPipeline",
}
WORKERS = {
    "preprocessing": ["pipelines.preprocess.ingest"],
    "reading scenes": ["pipelines.schema.tables"],
    "layout metrics": ["pipelines.metrics.validity", "pipelines.metrics.distributions", "pipelines.metrics.statistics"],
    "sampling": ["pipelines.generation.sample"],
}


@dataclass(frozen=True)
class Config:
    rounds: int = 5
    """Number of measurements of each value; the median is printed."""


def measure_process(code: str) -> float:
    """Return the CPU seconds (user and system) of an interpreter that runs the code."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", code], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@ray.remote(max_calls=1)
def measure_worker(modules: list[str]) -> float:
    """Return the CPU seconds of a new Ray worker from its start until the modules are imported."""
    for name in modules:
        importlib.import_module(name)
    return time.process_time()


def main(config: Config) -> None:
    print(describe_machine())
    seconds: dict[str, list[float]] = {}
    ray.init(address="local", num_cpus=1, include_dashboard=False, log_to_driver=False)
    for _ in range(config.rounds):  # measure in turn, so a busy machine slows all measurements equally
        for name, code in PROCESSES.items():
            seconds.setdefault(name, []).append(measure_process(code))
        for name, modules in WORKERS.items():
            seconds.setdefault(f"Ray worker, {name}", []).append(ray.get(measure_worker.remote(modules)))
    for name, values in seconds.items():
        print(f"{name}: {statistics.median(values):.2f} s of CPU ({min(values):.2f} to {max(values):.2f})")


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
