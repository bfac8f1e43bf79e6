"""Start a Ray cluster of several raylets on this machine, each with disks that the others do not see.

A raylet in a mount namespace (unshare -rm) sees an empty directory at `Places.private`. Only the processes that this
module starts are ended.
"""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil

ROOT = Path(__file__).parents[1]
RAY = str(Path(sys.executable).with_name("ray"))
MOUNT = 'mount -t tmpfs none "$0" && exec "$@"'
KEYS = {"AWS_ACCESS_KEY_ID": "testing", "AWS_SECRET_ACCESS_KEY": "testing", "AWS_EC2_METADATA_DISABLED": "true"}
OBJECT_STORE_BYTES = 150_000_000


def are_namespaces_allowed() -> bool:
    """Return whether this user may create mount namespaces."""
    with tempfile.TemporaryDirectory() as folder:
        command = ["unshare", "-rm", "sh", "-c", MOUNT, folder, "true"]
        return shutil.which("unshare") is not None and not subprocess.run(command, capture_output=True).returncode


def find_free_port() -> int:
    """Return a port of the loopback interface on which nothing listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def kill_family(process: subprocess.Popen | psutil.Process) -> None:
    """Kill a process and its descendants, the process first so that it starts no others."""
    with suppress(psutil.NoSuchProcess):
        parent = psutil.Process(process.pid)
        family = parent.children(recursive=True)
        parent.kill()
        for child in family:
            with suppress(psutil.NoSuchProcess):
                child.kill()
    process.wait()


@contextmanager
def run_server(words: Sequence[str], folder: Path, environment: Mapping[str, str]) -> Iterator[None]:
    """Run a server until the body ends. The body calls `wait_for_server` before its first request."""
    with (folder / f"{Path(words[0]).name}.log").open("w") as log:
        process = subprocess.Popen(words, cwd=folder, env=dict(environment), stdout=log, stderr=log)
    try:
        yield
    finally:
        kill_family(process)


def wait_for_server(url: str, seconds: float = 90.0) -> None:
    """Wait until a URL answers."""
    end = time.monotonic() + seconds
    while True:
        with suppress(OSError), urllib.request.urlopen(url, timeout=5):
            return
        if time.monotonic() > end:
            raise RuntimeError(f"no answer at {url}")
        time.sleep(0.1)


@contextmanager
def run_s3(folder: Path, environment: Mapping[str, str]) -> Iterator[str]:
    """Run an S3 server (moto); yield its URL. `create_bucket` waits for it."""
    port = find_free_port()
    url = f"http://127.0.0.1:{port}"
    command = [str(Path(sys.executable).with_name("moto_server")), "-H", "127.0.0.1", "-p", str(port)]
    with run_server(command, folder, environment):
        yield url


def create_bucket(url: str) -> None:
    """Create the bucket `tests` of an S3 server, as soon as the server answers."""
    import boto3

    wait_for_server(f"{url}/moto-api/")
    keys = {"aws_access_key_id": "testing", "aws_secret_access_key": "testing", "region_name": "us-east-1"}
    boto3.client("s3", endpoint_url=url, **keys).create_bucket(Bucket="tests")


@contextmanager
def run_mlflow(folder: Path, artifacts: str, environment: Mapping[str, str]) -> Iterator[str]:
    """Run an MLflow server with its database in `folder`; yield its URL, which answers at /health later.

    Clients write artifacts to `artifacts`, a path or s3:// URI, without this server.
    """
    port = find_free_port()
    url = f"http://127.0.0.1:{port}"
    command = [str(Path(sys.executable).with_name("mlflow")), "server", "--host", "127.0.0.1", "--port", str(port)]
    command += ["--workers", "1", "--backend-store-uri", f"sqlite:///{folder}/mlflow.db", "--no-serve-artifacts"]
    with run_server([*command, "--default-artifact-root", artifacts], folder, environment):
        yield url


@dataclass
class Cluster:
    """Head and further raylets.

    Attributes:
        folder: Folder for logs and sockets; its path must be short.
        private: Directory at which every raylet but the head sees its own empty disk. None: no such directory.
        environment: Environment of raylets and jobs. `start` adds RAY_ADDRESS.
        raylets: Process of each node by number; 0 is the head.
    """

    folder: Path
    private: Path | None
    environment: dict[str, str]
    raylets: dict[int, subprocess.Popen] = field(default_factory=dict)
    num_raylets: int = 0
    num_cpus: int = 1
    num_gpus: int = 0

    def start(
        self,
        num_raylets: int,
        num_cpus: int = 1,
        num_gpus: int = 0,
        dashboard: bool = False,
        head_words: Sequence[str] = (),
        port: int = 0,
    ) -> None:
        """Start the head and further raylets.

        Args:
            num_raylets: Number of nodes, including the head.
            num_cpus: Number of CPUs of each node.
            num_gpus: Number of GPUs of each node, which exist by name only.
            dashboard: Also start the dashboard, which accepts jobs.
            head_words: Further words of the command that starts the head.
            port: Port of the head. 0: a free port.
        """
        port = port or find_free_port()
        self.num_raylets, self.num_cpus, self.num_gpus = num_raylets, num_cpus, num_gpus
        for name in ("RAY_ADDRESS", "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"):
            self.environment.pop(name, None)
        self.environment |= {"RAY_AUTH_MODE": "disabled", "RAY_TMPDIR": str(self.folder), "PYTHONPATH": str(ROOT)}
        head = ["--head", "--port", str(port), f"--include-dashboard={dashboard}".lower(), *head_words]
        if dashboard:
            self.dashboard_port = find_free_port()
            head += ["--dashboard-port", str(self.dashboard_port)]
        self.start_raylet(0, head)
        self.environment["RAY_ADDRESS"] = f"127.0.0.1:{port}"
        for number in range(1, num_raylets):
            self.start_raylet(number)

    def start_raylet(self, number: int, words: Sequence[str] = ()) -> None:
        """Start a node. Without `words`, it joins the head."""
        environment = dict(self.environment)
        address = environment.pop("RAY_ADDRESS", "")
        command = [RAY, "start", *(words or [f"--address={address}"]), f"--num-cpus={self.num_cpus}", "--block"]
        command += [f"--num-gpus={self.num_gpus}"] if self.num_gpus else []
        # Jobs join the node that has their address, 127.0.0.1. This is the head.
        command += [f"--node-ip-address=127.0.0.{number + 1}", "--disable-usage-stats"]
        command += [f"--object-store-memory={OBJECT_STORE_BYTES}"]
        # Submitted jobs need an agent. The agent of another cluster on this machine may have the usual port.
        command += [f"--dashboard-agent-listen-port={find_free_port()}"]
        if number:  # Nodes of one directory would overwrite the code of submitted jobs.
            command += ["--temp-dir", str(self.folder / f"n{number}")]
        if self.private and number:
            command = ["unshare", "-rm", "sh", "-c", MOUNT, str(self.private), *command]
        path = self.folder / f"node-{number}.log"
        with path.open("w") as log:
            self.raylets[number] = subprocess.Popen(command, cwd=self.folder, env=environment, stdout=log, stderr=log)
        end = time.monotonic() + 60
        while "--block" not in path.read_text():  # Ray prints this word when the node runs.
            if time.monotonic() > end or self.raylets[number].poll() is not None:
                raise RuntimeError(f"raylet {number} did not start: {path.read_text()[-2000:]}")
            time.sleep(0.1)

    def find_processes(self, number: int, kind: str) -> list[psutil.Process]:
        """Return the processes of a node whose command line begins with "raylet" or with "ray::"."""
        found = []
        with suppress(psutil.NoSuchProcess):
            for process in psutil.Process(self.raylets[number].pid).children(recursive=True):
                with suppress(psutil.NoSuchProcess, psutil.ZombieProcess, IndexError):
                    word = process.cmdline()[0]
                    if word.rpartition("/")[2].startswith(kind):
                        found.append(process)
        return found

    def kill_raylet(self, number: int) -> None:
        """Kill a node with all its processes."""
        kill_family(self.raylets.pop(number))

    def stop(self) -> None:
        """Kill all nodes."""
        for number in sorted(self.raylets, reverse=True):
            self.kill_raylet(number)


@contextmanager
def run_cluster(cluster: Cluster, num_raylets: int, **options: Any) -> Iterator[Cluster]:
    """Start a cluster, and stop it when the body ends."""
    try:
        cluster.start(num_raylets, **options)
        yield cluster
    finally:
        cluster.stop()
