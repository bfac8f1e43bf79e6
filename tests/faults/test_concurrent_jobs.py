"""Tests of two jobs with the same output, as processes of their own, also if the first is killed."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers import ROOT
from test_faults import read_directory

sys.path.insert(0, str(ROOT / "benchmarks"))
from raylets import kill_family

pytestmark = pytest.mark.slow  # tests/unit/test_lease.py tests the same rules without jobs.
JOBS = {
    "preprocess": ("preprocess_scenes", "town", "--num-train", "64", "--num-test", "8"),
    "sample": ("sample_scenes", "--model", "town", "--num-scenes", "72", "--sampler", "dpm++")
    + ("--num-inference-steps", "3"),
}


def start(job: str, output: Path, *words: str) -> subprocess.Popen:
    """Start a job with its own Ray."""
    environment = os.environ | {"PRITTI_HOME": str(output.parent), "RAY_AUTH_MODE": "disabled"}
    environment.pop("RAY_ADDRESS", None)
    name, *options = JOBS[job]
    command = [sys.executable, str(ROOT / "jobs" / f"{name}.py"), *options, "--output", str(output), *words]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def wait_until(is_true: Callable[[], object], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not is_true():
        assert time.monotonic() < end
        time.sleep(0.05)


def list_tables(output: Path) -> list[Path]:
    return sorted(path for path in output.rglob("*.parquet") if "/." not in str(path.relative_to(output)))


@pytest.mark.parametrize("job", list(JOBS))
def test_second_job_is_refused_or_waits_and_takes_over(tmp_path, job):
    output = tmp_path / "made"
    processes = [start(job, output)]
    try:
        wait_until(lambda: list_tables(output))
        assert processes[0].poll() is None
        processes[0].send_signal(signal.SIGSTOP)  # The first job cannot end before the others start.
        processes += [start(job, output, "--if-busy", "refuse"), start(job, output, "--if-busy", "wait")]
        refused = processes[1].communicate(timeout=120)[0]
        assert processes[1].returncode == 2 and f"job {processes[0].pid} on " in refused, refused
        assert f"waiting for job {processes[0].pid} on " in processes[2].stdout.readline()
        kill_family(processes[0])
        waiting = processes[2].communicate(timeout=200)[0]
        assert processes[2].returncode == 0, waiting
    finally:
        for process in processes:
            kill_family(process)
    undisturbed = start(job, tmp_path / "whole")
    text = undisturbed.communicate(timeout=200)[0]
    assert undisturbed.returncode == 0, text
    made, whole = (
        {name: value for name, value in read_directory(path).items() if name.endswith(".parquet")}
        for path in (output, tmp_path / "whole")
    )
    assert made == whole and len(made) >= 6


def test_joined_job_waits_and_reports_the_same_result(tmp_path):
    output = tmp_path / "made"
    first = start("preprocess", output)
    try:
        wait_until(lambda: list(output.glob(".leases/*/*.json")))
        first.send_signal(signal.SIGSTOP)  # The first job cannot end before the other has found its lease.
        joined = start("preprocess", output, "--if-busy", "join")
        assert f"waiting for job {first.pid} on " in joined.stdout.readline()
        first.send_signal(signal.SIGCONT)
        texts = [process.communicate(timeout=200)[0] for process in (first, joined)]
    finally:
        kill_family(first)
    assert first.returncode == joined.returncode == 0, texts
    assert "already complete" in texts[1]
