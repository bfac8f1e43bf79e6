"""Kill random workers, raylets and drivers while jobs run, and compare the results with those of undisturbed runs.

    python benchmarks/chaos.py                           100 kills on disk and on S3, about two hours on two cores
    python benchmarks/chaos.py --kills 3 --stores s3     quicker
    python benchmarks/chaos.py --stages sample --seed 7 --first 12 --kills 1     repeat run 12 of seed 7

The runner starts a cluster of raylets on this machine. With the store s3 (an S3 server of moto), no raylet sees the
disks of another. Each stage first runs undisturbed. Each further run of a stage has its own output. At a random moment
of the stage's duration, the runner kills a random worker, a random raylet or the driver with SIGKILL. A new raylet
replaces a killed one. A stage whose driver was killed, or which fails because its nodes died, runs again with the same
command. Every run must then have the tables, scores and weights of the undisturbed run: no scene is lost or duplicated.
The runner prints one line per run and ends with exit code 1 if a run differs.
"""

from __future__ import annotations

import itertools
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import psutil
import pyarrow as pa
import pyarrow.fs as pafs
import pyarrow.parquet as pq
import tyro
from common import describe_machine
from raylets import (
    KEYS,
    ROOT,
    Cluster,
    are_namespaces_allowed,
    create_bucket,
    run_cluster,
    run_mlflow,
    run_s3,
    wait_for_server,
)

from models.uris import join_uri, resolve_uri

# Command lines of the stages. @ is the output of the run, @STAGE the output of the undisturbed run of a stage, and % is
# the name of the run.
STAGES = {
    "preprocess": "preprocess_scenes town --num-train 32 --num-test 16 --output @",
    "train_lvae": "train_lvae smoke --dataset @preprocess --name % --output @ --steps 24 --checkpoint-every 8",
    "encode": "encode_latents --dataset @preprocess --lvae @train_lvae --output @",
    "train_dit": "train_dit smoke --dataset @preprocess --latents @encode --name % --output @ --steps 24"
    " --checkpoint-every 8",
    "sample": "sample_scenes --model @train_dit --num-scenes 136 --num-inference-steps 2 --existence-threshold 0.01"
    " --num-actors 2 --output @",
    "outpaint": "outpaint_scenes --model @train_dit --input @sample --max-scenes 1 --inpainting guided"
    " --num-inference-steps 2 --num-actors 2 --output @",
    "edit": "edit_scenes translate --input @sample --where true --offset-m 1 0 0 --num-examples 1 --output @",
    "evaluate": "evaluate_scenes --real @preprocess --generated @sample --run samples --lvae @train_lvae --lite0 False"
    " --max-scenes 24 --max-reconstructed-scenes 8 --num-examples 1 --output @",
    "publish": "publish_model --name % --model @train_dit --evaluation @evaluate --output @",
    "load": "sample_scenes --model models:/publish/1 --num-scenes 2 --num-inference-steps 2 --output @",
}
DISTURBED = ("preprocess", "train_lvae", "encode", "train_dit", "sample", "outpaint", "evaluate")
SCORES = ("metrics.json", "latents.json", "dataset.json")
STAGE_TIMEOUT_S = 300.0
VICTIMS = ("worker", "raylet", "driver")


@dataclass(frozen=True)
class Config:
    kills: int = 100
    """Number of kills. Each disturbed run has one, unless the stage ends before the kill."""
    stores: tuple[Literal["disk", "s3"], ...] = ("disk", "s3")
    """Storage of all inputs and outputs; the runs use the stores in turn."""
    stages: tuple[str, ...] = DISTURBED
    """Stages to disturb, in turn."""
    raylets: int = 3
    """Number of nodes, each with one CPU."""
    victims: tuple[Literal["worker", "raylet", "driver"], ...] = ()
    """Victims, in turn (default: a random victim)."""
    seed: int = 0
    """Seed of the moments and victims."""
    first: int = 0
    """Number of the first run; run k of a seed has always the same stage, store, share of the duration and, without
    --victims, the same victim."""
    log: str = ""
    """File to which one JSON object per run is appended (default: none)."""


class Store:
    """A home directory on disk or on S3, with the cluster that works on it."""

    def __init__(self, kind: str, home: str, cluster: Cluster) -> None:
        self.kind, self.home, self.cluster = kind, home, cluster
        self.seconds: dict[str, float] = {}
        self.expected: dict[str, dict[str, str]] = {}

    def list_words(self, stage: str, run: str) -> list[str]:
        """Return the command line of a stage."""

        def replace(word: str) -> str:
            if word.startswith("@"):
                return join_uri(self.home, "results", word[1:] or run)
            return run if word == "%" else word

        job, *words = STAGES[stage].split()
        return [sys.executable, str(ROOT / "jobs" / f"{job}.py"), *map(replace, words)]

    def start(self, stage: str, run: str, log: Path) -> subprocess.Popen:
        """Start the driver of a stage."""
        with log.open("a") as stream:
            return subprocess.Popen(
                self.list_words(stage, run),
                cwd=self.cluster.folder,
                env=self.cluster.environment | {"PRITTI_HOME": self.home},
                stdout=stream,
                stderr=stream,
            )

    def run_undisturbed(self, stage: str) -> None:
        """Run a stage, and keep its duration and the digests of its files."""
        if stage in self.expected:
            return
        for other in STAGES:
            if f"@{other}" in STAGES[stage].split() or (stage == "load" and other == "publish"):
                self.run_undisturbed(other)
        log, started = self.cluster.folder / f"{self.kind}-{stage}.log", time.monotonic()
        process = self.start(stage, stage, log)
        if wait(process, STAGE_TIMEOUT_S) != 0:
            raise RuntimeError(f"the undisturbed run of {stage} failed: {log.read_text()[-3000:]}")
        self.seconds[stage] = time.monotonic() - started
        self.expected[stage] = self.digest(stage)
        if not self.expected[stage]:
            raise RuntimeError(f"the undisturbed run of {stage} wrote no tables, scores or weights")
        print(f"{self.kind} {stage}: undisturbed, {self.seconds[stage]:.0f} s", flush=True)

    def digest(self, run: str) -> dict[str, str]:
        """Return a digest of each table, file of scores and file of weights of a run, by relative path."""
        file_system, path = resolve_uri(join_uri(self.home, "results", run))
        found = file_system.get_file_info(pafs.FileSelector(path, recursive=True, allow_not_found=True))
        names = {info.path[len(path) + 1 :]: info.path for info in found if info.is_file}
        names = {name: place for name, place in names.items() if not name.startswith(".") and "/." not in name}
        return {
            name: digest_file(file_system, place)
            for name, place in names.items()
            if name.endswith((".parquet", ".safetensors")) or name in SCORES
        }


def digest_file(file_system: pafs.FileSystem, place: str) -> str:
    """Return the digest of a table's content in its order, or of a file's bytes."""
    if place.endswith(".parquet"):
        table = pq.read_table(place, filesystem=file_system, partitioning=None)
        sink = pa.BufferOutputStream()
        with pa.ipc.new_stream(sink, table.schema.remove_metadata()) as writer:
            writer.write_table(table.replace_schema_metadata().combine_chunks())
        return f"{table.num_rows} rows {sha256(sink.getvalue()).hexdigest()[:16]}"
    content = file_system.open_input_stream(place).read()
    return f"{len(content)} bytes {sha256(content).hexdigest()[:16]}"


def wait(process: subprocess.Popen, seconds: float) -> int | None:
    """Wait for a process; return its exit code, or None after `seconds` (the process is then killed)."""
    try:
        return process.wait(seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return None


def find_victims(cluster: Cluster, kind: str, driver: subprocess.Popen) -> list[Callable[[], object]]:
    """Return functions that kill one process or node each. The head survives: its loss ends the cluster."""
    if kind == "driver":
        return [driver.kill]
    if kind == "raylet":
        return [lambda number=number: cluster.kill_raylet(number) for number in cluster.raylets if number]
    workers = [process for number in sorted(cluster.raylets) for process in cluster.find_processes(number, "ray::")]
    idle = ("IDLE", "Agent")  # The loss of an agent ends its raylet.
    return [kill_worker(process) for process in workers if not any(word in read_command(process) for word in idle)]


def read_command(process: psutil.Process) -> str:
    with suppress(psutil.NoSuchProcess, IndexError):
        return process.cmdline()[0]
    return "IDLE"


def kill_worker(process: psutil.Process) -> Callable[[], object]:
    def kill() -> None:
        with suppress(psutil.NoSuchProcess):
            process.kill()

    return kill


def disturb(store: Store, stage: str, run: str, victim: str, rng: random.Random) -> dict[str, Any]:
    """Run a stage with one kill; return a record with the differences to the undisturbed run."""
    log = store.cluster.folder / f"{run}.log"
    moment_s = 0.9 * rng.random() * store.seconds[stage]
    started, killed, attempts, failures = time.monotonic(), "", 1, []
    process = store.start(stage, run, log)
    with suppress(subprocess.TimeoutExpired):
        process.wait(moment_s)
    while process.poll() is None and not killed:
        if victims := find_victims(store.cluster, victim, process):
            rng.choice(victims)()
            killed = f"{victim} after {time.monotonic() - started:.1f} s"
        else:  # No task runs at this moment.
            time.sleep(0.05)
    code = wait(process, STAGE_TIMEOUT_S)
    restore_raylets(store.cluster)
    while code != 0 and attempts < 4:
        failures.append("timeout" if code is None else f"exit code {code}")
        attempts += 1
        code = wait(store.start(stage, run, log), STAGE_TIMEOUT_S)
    faults = [f"exit code {code}"] if code else []
    faults += find_faults(store.digest(run), store.expected[stage])
    needless = [] if victim == "driver" or not failures else [f"{victim} killed: {', '.join(failures)}"]
    return {
        "run": run,
        "store": store.kind,
        "stage": stage,
        "killed": killed or "nothing: the stage had ended",
        "attempts": attempts,
        "seconds": round(time.monotonic() - started, 1),
        "repeated": needless,
        "faults": faults,
        "log": log.read_text()[-4000:] if faults or needless else "",
    }


def find_faults(found: dict[str, str], expected: dict[str, str]) -> list[str]:
    """Return the differences between the digests of a run and of the undisturbed run."""
    faults = [f"lost {name}" for name in expected if name not in found]
    faults += [f"added {name}" for name in found if name not in expected]
    both = sorted(set(found) & set(expected))
    return faults + [f"{name}: {found[name]}, not {expected[name]}" for name in both if found[name] != expected[name]]


def restore_raylets(cluster: Cluster) -> None:
    """Replace killed raylets."""
    for number in range(cluster.num_raylets):
        if number not in cluster.raylets or cluster.raylets[number].poll() is not None:
            cluster.start_raylet(number)


@contextmanager
def open_store(kind: str, folder: Path, num_raylets: int, has_mlflow: bool = True, **options: Any) -> Iterator[Store]:
    """Start the servers and the cluster for a store; stop them when the body ends."""
    folder.mkdir()
    disk = folder / "disk"
    disk.mkdir()
    environment = (
        os.environ
        | KEYS
        | {
            "PRITTI_CACHE": str(disk / "cache"),
            "RAY_worker_niceness": "0",
            "RAY_idle_worker_killing_time_threshold_ms": "300000",
            "RAY_TRAIN_HEALTH_CHECK_INTERVAL_S": "0.2",
            "OMP_NUM_THREADS": "1",
            "OMP_WAIT_POLICY": "PASSIVE",
            "DO_NOT_TRACK": "true",
            "MLFLOW_DISABLE_TELEMETRY": "true",
            "PRITTI_LEASE_SECONDS": "10",
        }
    )
    with ExitStack() as stack:
        home, url = str(folder / "home"), ""
        if kind == "s3":
            url = stack.enter_context(run_s3(folder, environment))
            home = f"s3://tests/home?endpoint_override={url}&region=us-east-1"
            environment |= {"MLFLOW_S3_ENDPOINT_URL": url, "AWS_DEFAULT_REGION": "us-east-1"}
        artifacts = "s3://tests/mlartifacts" if kind == "s3" else str(folder / "mlartifacts")
        tracking = stack.enter_context(run_mlflow(folder, artifacts, environment)) if has_mlflow else ""
        environment["MLFLOW_TRACKING_URI"] = tracking
        os.environ |= KEYS
        private = disk if kind == "s3" else None
        cluster = stack.enter_context(run_cluster(Cluster(folder, private, environment), num_raylets, **options))
        if kind == "s3":
            create_bucket(url)
        if tracking:
            wait_for_server(f"{tracking}/health")
        yield Store(kind, home, cluster)


def run_kills(config: Config, get_store: Callable[[str], Store]) -> Counter[str]:
    """Run stages with one kill each until there are enough kills.

    Args:
        config: Options of this script.
        get_store: Function that returns the store of a kind.

    Returns:
        Number of kills by victim, of runs with another result, and of stages that failed because of a worker or raylet.
    """
    counts: Counter[str] = Counter()
    for k in itertools.count(config.first):
        if sum(counts[victim] for victim in VICTIMS) >= config.kills:
            break
        rng = random.Random(f"{config.seed} {k}")
        store, stage = get_store(config.stores[k % len(config.stores)]), config.stages[k % len(config.stages)]
        store.run_undisturbed(stage)
        killed = sum(counts[name] for name in VICTIMS)
        victim = config.victims[killed % len(config.victims)] if config.victims else rng.choice(VICTIMS)
        record = disturb(store, stage, f"run-{k}", victim, rng)
        counts[record["killed"].split()[0].rstrip(":")] += 1
        counts["different"] += bool(record["faults"])
        counts["repeated"] += bool(record["repeated"])
        print(" ".join(f"{name}={value}" for name, value in record.items() if name != "log" and value), flush=True)
        if config.log:
            with open(config.log, "a") as stream:
                stream.write(json.dumps(record) + "\n")
    return counts


def main(config: Config) -> int:
    """Run the stages; return the exit code."""
    if config.raylets < 2 and config.victims == ("raylet",):
        print("error: the head is never killed, so --victims raylet needs --raylets 2 or more", file=sys.stderr)
        return 2
    if "s3" in config.stores and not are_namespaces_allowed():
        print("error: mount namespaces are forbidden here (unshare -rm); use --stores disk", file=sys.stderr)
        return 2
    print(f"seed {config.seed}; {describe_machine()}", flush=True)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="chaos-")))
        has_mlflow = set(config.stages) != {"preprocess"}  # All other stages need a trained model.

        @cache
        def get_store(kind: str) -> Store:
            return stack.enter_context(open_store(kind, folder / kind, config.raylets, has_mlflow))

        counts = run_kills(config, get_store)
    print(", ".join(f"{name}: {count}" for name, count in counts.items()))
    return 1 if counts["different"] else 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Config, description=__doc__)))
