"""Measure CPU time, requests and bytes of each stage on object storage, for the cost model (costs.py).

    python benchmarks/cost_rates.py                     a quarter of an hour on two cores; writes cost_rates.json

Each stage runs twice on an S3 server of this machine (moto), with few and with many units. A rate is the difference of
both runs, divided by the difference of the units, so it excludes the start of Ray and Python. CPU time is the sum over
all processes of the cluster and of the driver, not of the servers. The dense towns in KITTI-360's format have the
density of real drives. All other stages use the built-in town. `encode` uses an
untrained layout VAE with the size of the released one, `sample` and `outpaint` use the released weights.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import psutil
import pyarrow.fs as pafs
import tyro
from chaos import Store, open_store
from common import DENSE_SEEDS, describe_machine, write_raw

from models.uris import join_uri, resolve_uri

ROOT = Path(__file__).parents[1]
RATES = Path(__file__).with_name("cost_rates.json")
WRITES = ("PUT", "POST")
TOWNS = {"few": (256, 64), "many": (768, 256)}  # Numbers of training and test scenes.
BLOCKS = {"few": 8, "many": 24}  # Blocks around a scene, one and two on each side.


@dataclass(frozen=True)
class Config:
    output: Path = RATES
    """JSON file to write."""


@dataclass(frozen=True)
class Usage:
    """What a run used.

    Attributes:
        units: Number of scenes or blocks.
        cpu_s: CPU time of driver and cluster (s).
        writes: Number of requests that write objects (PUT, POST without deletions).
        reads: Number of all other requests but deletions (GET, HEAD, lists).
        stored_bytes: Bytes of the output.
    """

    units: int
    cpu_s: float
    writes: int
    reads: int
    stored_bytes: int


@contextmanager
def watch_cpu_time(roots: list[int]) -> Iterator[dict[tuple[int, float], float]]:
    """Sum the CPU time of processes and their descendants while the body runs; yield seconds by process."""
    seconds: dict[tuple[int, float], float] = {}
    before: dict[tuple[int, float], float] = {}

    def look(found: dict[tuple[int, float], float]) -> None:
        for root in roots:
            with suppress(psutil.NoSuchProcess):
                parent = psutil.Process(root)
                for process in [parent, *parent.children(recursive=True)]:
                    with suppress(psutil.NoSuchProcess):
                        times = process.cpu_times()
                        found[process.pid, process.create_time()] = times.user + times.system

    look(before)
    done = threading.Event()

    def watch() -> None:
        while not done.wait(0.2):
            look(seconds)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield seconds
    finally:
        look(seconds)
        done.set()
        thread.join()
        for key, value in before.items():
            if key in seconds:
                seconds[key] -= value


class Stages:
    """Runs jobs on a store, and measures what they use."""

    def __init__(self, store: Store) -> None:
        self.store, self.log = store, store.cluster.folder / "moto_server.log"

    def locate(self, name: str) -> str:
        return join_uri(self.store.home, "results", name)

    def run(self, job: str, *words: str) -> float:
        """Run a job; return its CPU time (s)."""
        command = [sys.executable, str(ROOT / "jobs" / f"{job}.py"), *words]
        environment = self.store.cluster.environment | {"PRITTI_HOME": self.store.home}
        del environment["PRITTI_LEASE_SECONDS"]  # The short leases of chaos.py would send more heartbeats.
        with (self.store.cluster.folder / "jobs.log").open("a") as log:
            driver = subprocess.Popen(command, env=environment, cwd=ROOT, stdout=log, stderr=log)
            roots = [driver.pid, *(raylet.pid for raylet in self.store.cluster.raylets.values())]
            with watch_cpu_time(roots) as seconds:
                code = driver.wait()
        if code:
            raise RuntimeError(f"{job} ended with {code}: {Path(log.name).read_text()[-3000:]}")
        return sum(seconds.values())

    def measure(self, units: int, output: str, job: str, *words: str) -> Usage:
        """Run a job with the given output, and return what it used."""
        before = count_requests(self.log)
        cpu_s = self.run(job, *words, "--output", self.locate(output))
        requests = count_requests(self.log) - before
        file_system, path = resolve_uri(self.locate(output))
        stored = sum(info.size or 0 for info in file_system.get_file_info(pafs.FileSelector(path, recursive=True)))
        print(
            f"{output}: {units} units, {cpu_s:.0f} s of CPU time, {dict(requests)}, {stored / 1e6:.1f} MB", flush=True
        )
        return Usage(units, cpu_s, requests["write"], requests["read"], stored)


def count_requests(log: Path) -> Counter[str]:
    """Count the requests of an S3 server's log by kind: write, read or delete."""
    counts: Counter[str] = Counter()
    for method, target in re.findall(r'"(GET|HEAD|PUT|POST|DELETE) (\S+) HTTP', log.read_text()):
        is_deletion = method == "DELETE" or (method == "POST" and target.endswith("?delete="))
        counts["delete" if is_deletion else "write" if method in WRITES else "read"] += 1
    return counts


def make_rate(few: Usage, many: Usage) -> dict[str, float]:
    """Return the use per unit, from two runs."""
    units = many.units - few.units
    names = ("cpu_s", "writes", "reads", "stored_bytes")
    return {name: round((asdict(many)[name] - asdict(few)[name]) / units, 6) for name in names}


def measure_rates(stages: Stages, raw: Path) -> dict[str, dict[str, float]]:
    """Run all stages; return the use per unit by stage."""
    found: dict[str, dict[str, Usage]] = {}
    where = stages.locate
    for size, seeds in (("few", DENSE_SEEDS[:1]), ("many", DENSE_SEEDS)):
        write_raw(raw / size, seeds)
        file_system, path = resolve_uri(where(f"raw-{size}"))
        pafs.copy_files(str(raw / size), path, destination_filesystem=file_system)
        units = sum(len(p.read_text().splitlines()) for p in (raw / size).rglob("poses.txt"))
        words = ("kitti360", "--input", where(f"raw-{size}"))
        found.setdefault("preprocess", {})[size] = stages.measure(
            units, f"kitti360-{size}", "preprocess_scenes", *words
        )
    for size, (train, test) in TOWNS.items():
        town = where(f"town-{size}")
        stages.run("preprocess_scenes", "town", "--num-train", str(train), "--num-test", str(test), "--output", town)
        lvae = where(f"lvae-{size}")
        stages.run("train_lvae", "town", "--dataset", town, "--steps", "4", "--name", f"lvae-{size}", "--output", lvae)
        words = ("--dataset", town, "--lvae", lvae)
        usage = stages.measure(train + test, f"latents-{size}", "encode_latents", *words)
        found.setdefault("encode", {})[size] = usage
        words = ("--model", "town", "--num-scenes", str(test), "--sampler", "dpm++", "--num-inference-steps", "20")
        found.setdefault("sample", {})[size] = stages.measure(test, f"made-{size}", "sample_scenes", *words)
        words = ("--real", town, "--generated", where(f"made-{size}"), "--max-scenes", str(test), "--controls")
        found.setdefault("evaluate", {})[size] = stages.measure(test, f"scores-{size}", "evaluate_scenes", *words)
        words = ("--model", "town", "--input", where("made-few"), "--max-scenes", "1", "--inpainting", "guided")
        sides = ("ahead", "behind", "left", "right")
        words += tuple(word for side in sides for word in (f"--blocks-{side}", "1" if size == "few" else "2"))
        found.setdefault("outpaint", {})[size] = stages.measure(BLOCKS[size], f"city-{size}", "outpaint_scenes", *words)
    return {stage: make_rate(usage["few"], usage["many"]) for stage, usage in found.items()}


def main(config: Config) -> None:
    machine = describe_machine()
    print(machine, flush=True)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cost-")))
        store = stack.enter_context(open_store("s3", folder / "s3", 1, num_cpus=2))
        rates = measure_rates(Stages(store), folder / "raw")
    record = {"command": "python benchmarks/cost_rates.py", "machine": machine, "per_unit": rates}
    config.output.write_text(json.dumps(record, indent=2) + "\n")
    print(f"{config.output}: {json.dumps(rates, indent=2)}")


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
