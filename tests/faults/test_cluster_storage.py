"""Tests of a cluster of two raylets that do not share the output: each has its own mount namespace."""

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from helpers import ROOT

import psutil  # isort: skip # Ray bundles this module; import ray first

RAY = [str(Path(sys.executable).with_name("ray"))]
MOUNT = 'mount -t tmpfs none "$0" && exec "$@"'
TOWN_WORDS = ("jobs/preprocess_scenes.py", "town", "--num-train", "16", "--num-test", "8", "--output")


@contextmanager
def start_raylets(private: Path, folder: Path) -> Iterator[dict[str, str]]:
    """Start a head and a second node that sees an empty directory at `private`; yield the environment of jobs.

    Only the processes that this function starts are ended.
    """
    probe = subprocess.run(["unshare", "-rm", "sh", "-c", MOUNT, str(private), "true"], capture_output=True)
    if probe.returncode:
        pytest.skip("mount namespaces are forbidden here (unshare -rm)")
    environment = os.environ | {
        "RAY_AUTH_MODE": "disabled",
        "RAY_TMPDIR": str(folder),
        "PYTHONPATH": str(ROOT),
    }
    for name in ("RAY_ADDRESS", "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"):
        environment.pop(name, None)
    port = str(20_000 + os.getpid() % 10_000)
    head = ["start", "--head", "--port", port, "--num-cpus=1", "--include-dashboard=false"]
    second = ["start", f"--address=127.0.0.1:{port}", "--num-cpus=1"]
    common = ["--node-ip-address=127.0.0.1", "--block", "--disable-usage-stats", "--object-store-memory=100000000"]
    processes = []
    try:
        for words in ([*RAY, *head], ["unshare", "-rm", "sh", "-c", MOUNT, str(private), *RAY, *second]):
            log = (folder / f"node-{len(processes)}.log").open("w")
            processes.append(subprocess.Popen([*words, *common], env=environment, stdout=log, stderr=log))
            wait_for_line(Path(log.name), "--block")
        yield environment | {"RAY_ADDRESS": f"127.0.0.1:{port}"}
    finally:
        family = [child for p in processes for child in psutil.Process(p.pid).children(recursive=True)]
        for process in [*processes, *family]:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        for process in processes:
            process.wait()


def wait_for_line(log: Path, text: str, seconds: float = 60.0) -> None:
    """Wait until a line of a log contains a text."""
    end = time.monotonic() + seconds
    while text not in log.read_text():
        assert time.monotonic() < end, log.read_text()[-2000:]
        time.sleep(0.2)


def test_output_that_nodes_do_not_share_stops_the_job(tmp_path_factory):
    folder = Path(os.environ.get("TMPDIR", "/tmp")) / f"pritti-{os.getpid()}"  # Ray's sockets need a short path.
    folder.mkdir(exist_ok=True)
    output = tmp_path_factory.mktemp("output")
    with start_raylets(output, folder) as environment:
        words = [sys.executable, *TOWN_WORDS, str(output / "town")]
        done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=200)
        lines = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
        assert done.returncode == 2 and len(lines) == 1, done.stdout[-2000:] + done.stderr[-3000:]
        assert re.search(
            rf"node \S+ \([\d.]+, \w+\) does not share {output}/town with the driver: .*"
            r"use a directory that all nodes mount, such as NFS, or object storage \(s3://bucket/...\)",
            lines[0],
        )
        assert not [path for path in output.rglob("*") if path.is_file()]
