"""Tests of jobs on clusters that grow, lose nodes or have too few of them."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
from helpers import ROOT
from test_faults import read_directory

sys.path.insert(0, str(ROOT / "benchmarks"))
from raylets import RAY, Cluster, kill_family, run_cluster

TRAIN = [sys.executable, str(ROOT / "jobs/train_lvae.py"), "smoke"]
SAMPLE = [sys.executable, str(ROOT / "jobs/sample_scenes.py"), "--num-scenes", "2", "--num-inference-steps", "2"]

NODE = {"resources": {"CPU": 2}, "node_config": {}, "min_workers": 0, "max_workers": 1}
HEAD = {"resources": {"CPU": 1}, "node_config": {}, "max_workers": 0}
AUTOSCALER = {  # Ray's provider for tests, which starts nodes as processes of this machine
    "cluster_name": "test",
    "max_workers": 1,
    "provider": {"type": "fake_multinode"},
    "available_node_types": {"worker": NODE, "ray.head.default": HEAD},
    "head_node_type": "ray.head.default",
    "idle_timeout_minutes": 5,
    "upscaling_speed": 1.0,
    "file_mounts_sync_continuously": False,
    **{name: {} for name in ("auth", "docker", "file_mounts")},
    **{name: [] for name in ("cluster_synced_files", "rsync_exclude", "rsync_filter", "initialization_commands")},
    **{
        f"{name}_commands": [] for name in ("setup", "head_setup", "worker_setup", "head_start_ray", "worker_start_ray")
    },
}


@pytest.fixture
def folder() -> Path:
    """A folder with a short path, as Ray's sockets need."""
    path = Path(os.environ.get("TMPDIR", "/tmp")) / f"pritti-{os.getpid()}-{time.monotonic_ns() % 10**6}"
    path.mkdir()
    return path


def make_environment(tmp_path: Path, **more: str) -> dict[str, str]:
    environment = os.environ | {"PRITTI_HOME": str(tmp_path / "home"), "RAY_AUTH_MODE": "disabled"} | more
    for name in ("RAY_ADDRESS", "MLFLOW_TRACKING_URI"):
        environment.pop(name, None)
    return environment


def wait_for_line(process: subprocess.Popen, pattern: str) -> re.Match:
    """Read the output of a process until a line matches."""
    lines = []
    for line in process.stdout:
        lines.append(line)
        if found := re.search(pattern, line):
            return found
    raise AssertionError("".join(lines[-50:]))


@pytest.mark.slow
def test_gpus_that_torch_cannot_use_are_an_error(folder, tmp_path):
    with run_cluster(Cluster(folder, None, make_environment(tmp_path)), 1, num_gpus=1) as cluster:

        def sample(*words: str) -> subprocess.CompletedProcess:
            command = [*SAMPLE, "--output", str(tmp_path / "made"), *words]
            return subprocess.run(command, env=cluster.environment, capture_output=True, text=True, timeout=200)

        without = sample()
        assert without.returncode == 2
        assert re.search(r"error: node [\d.]+: Ray assigned GPU 0, but torch .* finds no CUDA device", without.stderr)
        more = sample("--gpus", "2")
        assert more.returncode == 2 and "needs 1 CPU and 2 GPU 1 times, but this cluster has room for 0" in more.stderr
        assert sample("--gpus", "0", "--log-format", "json").returncode == 0


@pytest.mark.slow
def test_stopped_training_is_killed_in_mlflow_and_resumes(tmp_path):
    from jobs.support.tracking import close_dead_runs, make_client

    environment = make_environment(tmp_path)

    def start() -> subprocess.Popen:
        words = [*TRAIN, "--steps", "200", "--checkpoint-every", "20"]
        return subprocess.Popen(
            words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, bufsize=1
        )

    first = start()
    try:
        wait_for_line(first, r"step 24/200")
        second = subprocess.run([*TRAIN, "--steps", "200"], env=environment, capture_output=True, text=True)
        assert second.returncode == 2 and "writes 'lvae-smoke' here" in second.stderr  # never two trainings of a run
        first.send_signal(signal.SIGTERM)
        rest = first.communicate(timeout=60)[0]
        assert first.returncode == 1 and "the job was stopped (SIGTERM); run the same command again to resume" in rest
    finally:
        kill_family(first)
    api = make_client(f"sqlite:///{tmp_path}/home/mlflow.db")

    def read_run():
        (run,) = api.search_runs([api.get_experiment_by_name("pritti-lvae").experiment_id])
        return run

    assert read_run().info.status == "KILLED"
    again = start()
    try:
        assert int(wait_for_line(again, r"step (\d+)/200")[1]) > 20
        assert read_run().info.status == "RUNNING"
        again.send_signal(signal.SIGKILL)
    finally:
        kill_family(again)
    assert read_run().info.status == "RUNNING"  # a killed driver cannot change it
    close_dead_runs(api, api.get_experiment_by_name("pritti-lvae").experiment_id)  # as each job does at its start
    assert read_run().info.status == "KILLED"


@pytest.mark.slow
def test_training_survives_the_loss_of_its_controller(tmp_path):
    """Ray Train's controller is an actor that Ray does not start again."""
    process = subprocess.Popen(
        [*TRAIN, "--steps", "120", "--checkpoint-every", "20"],
        env=make_environment(tmp_path),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        bufsize=1,
    )
    try:
        wait_for_line(process, r"step (24|48)/120")
        family = psutil.Process(process.pid).children(recursive=True)
        (controller,) = [one for one in family if "TrainController" in "".join(one.cmdline()[:1])]
        controller.kill()
        wait_for_line(process, r"lvae-smoke: the controller of the workers died; training continues")
        assert int(wait_for_line(process, r"lvae-smoke: 1 worker, from step (\d+)")[1]) >= 20
        rest = process.communicate(timeout=200)[0]
        assert process.returncode == 0 and "trained: " in rest, rest[-3000:]
    finally:
        kill_family(process)


@contextmanager
def train_elastically(
    folder: Path, tmp_path: Path, checkpoint_every: int
) -> Iterator[tuple[Cluster, subprocess.Popen]]:
    """Train with one or two workers on three nodes of one CPU each."""
    environment = make_environment(tmp_path, RAY_TRAIN_HEALTH_CHECK_INTERVAL_S="0.5")
    with run_cluster(Cluster(folder, None, environment), 3) as cluster:
        words = [*TRAIN, "--steps", "4000", "--checkpoint-every", str(checkpoint_every), "--num-workers", "2"]
        process = subprocess.Popen(
            [*words, "--min-workers", "1"],
            env=cluster.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        try:
            yield cluster, process
        finally:
            kill_family(process)


@pytest.mark.slow
def test_training_loses_nodes_and_regains_them(folder, tmp_path):
    with train_elastically(folder, tmp_path, 8) as (cluster, process):
        wait_for_line(process, "lvae-smoke: 2 workers, from step 0")
        wait_for_line(process, r"step \d+/4000")
        cluster.kill_raylet(1)
        cluster.kill_raylet(2)
        fewer = wait_for_line(process, r"lvae-smoke: 1 worker, from step (\d+)")
        assert int(fewer[1]) >= 16
        cluster.start_raylet(1)
        cluster.start_raylet(2)
        # New nodes repeat the logs of the lost ones, because all nodes of this machine share a folder for logs.
        more = wait_for_line(process, r"lvae-smoke: 2 workers, from step ([1-9]\d*)")
        assert int(more[1]) > int(fewer[1])
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 1


@pytest.mark.slow
def test_notice_of_preemption_saves_a_checkpoint(folder, tmp_path):
    with train_elastically(folder, tmp_path, 4000) as (cluster, process):
        wait_for_line(process, r"step \d+/4000")
        record = tmp_path / "home/runs/lvae-smoke/checkpoint_manager_snapshot.json"  # Ray Train's list of checkpoints

        def has_checkpoint() -> bool:
            return record.exists() and "checkpoint_2" in record.read_text()  # the names begin with the year

        assert not has_checkpoint()
        for number in (1, 2):
            drain(cluster, number)
        end = time.monotonic() + 60
        while not has_checkpoint():
            assert time.monotonic() < end and process.poll() is None
            time.sleep(0.2)
        for number in (1, 2):  # The cloud takes the nodes.
            cluster.kill_raylet(number)
        fewer = wait_for_line(process, r"lvae-smoke: 1 worker, from step (\d+)")
        assert int(fewer[1]) >= 50


def drain(cluster: Cluster, number: int) -> None:
    """Announce that a node will be taken away in 60 s, as KubeRay and cloud autoscalers do."""
    code = (
        "import sys, ray\nray.init(logging_level='ERROR')\n"
        "print([n['NodeID'] for n in ray.nodes() if n['NodeManagerAddress'] == sys.argv[1]][0])"
    )
    words = [sys.executable, "-c", code, f"127.0.0.{number + 1}"]
    found = subprocess.run(words, env=cluster.environment, capture_output=True, text=True, check=True)
    words = [RAY, "drain-node", "--address", cluster.environment["RAY_ADDRESS"], "--node-id", found.stdout.split()[-1]]
    words += ["--reason", "DRAIN_NODE_REASON_PREEMPTION", "--reason-message", "test"]
    subprocess.run([*words, "--deadline-remaining-seconds", "60"], env=cluster.environment, check=True)


@pytest.mark.slow
def test_same_command_resumes_after_loss_of_the_head(folder, tmp_path):
    """The head dies with all nodes, as in a power cut; a new head is a new cluster."""
    words = [sys.executable, str(ROOT / "jobs/preprocess_scenes.py"), "town", "--num-train", "512", "--output"]
    cluster = Cluster(folder, None, make_environment(tmp_path))
    environment = dict(cluster.environment)
    with run_cluster(cluster, 1, num_cpus=2):
        log = (tmp_path / "driver.log").open("w")
        driver = subprocess.Popen(
            [*words, str(tmp_path / "lost")], env=cluster.environment, stdout=log, stderr=subprocess.STDOUT
        )
        while driver.poll() is None and not list((tmp_path / "lost").rglob("*.parquet")):
            time.sleep(0.05)
        cluster.kill_raylet(0)
        assert driver.wait(180) != 0  # The driver does not wait for the dead head forever.
    (folder / "next").mkdir()
    with run_cluster(Cluster(folder / "next", None, environment), 1, num_cpus=2) as cluster:
        for name in ("lost", "whole"):
            subprocess.run([*words, str(tmp_path / name)], env=cluster.environment, check=True, timeout=200)
    found = {name: read_directory(tmp_path / name) for name in ("lost", "whole")}
    tables = [{name: part for name, part in files.items() if name.endswith(".parquet")} for files in found.values()]
    assert tables[0] == tables[1] and len(tables[0]) >= 6


@pytest.mark.slow
def test_missing_nodes_come_from_the_autoscaler(folder, tmp_path):
    config = folder / "autoscaler.json"
    config.write_text(json.dumps(AUTOSCALER))
    environment = make_environment(tmp_path, RAY_FAKE_CLUSTER="1", AUTOSCALER_UPDATE_INTERVAL_S="1")
    head = {"head_words": (f"--autoscaling-config={config}",), "port": 6379}  # Ray's provider expects this port
    with run_cluster(Cluster(folder, None, environment), 1, **head) as cluster:
        del cluster.environment["RAY_FAKE_CLUSTER"]

        def run(*words: str) -> subprocess.CompletedProcess:
            return subprocess.run(
                [sys.executable, *words], cwd=ROOT, env=cluster.environment, capture_output=True, text=True, timeout=200
            )

        code = (
            "import sys, ray\nfrom pipelines.runtime.resources import *\nray.init()\n"
            "with set_resource_policy(ResourcePolicy(wait_s=float(sys.argv[1]))):\n"
            "    print('room', require_room({'CPU': 2}, 1, 'an actor'))"
        )
        assert "needs 2 CPU 1 times, but this cluster has room for 0" in run("-c", code, "0").stderr
        found = run("-c", code, "90")
        assert "room 1" in found.stdout, found.stdout + found.stderr
        assert "waiting for 2 CPU 1 times (an actor): 1 node with 1 CPU" in found.stdout
