"""Tests of clusters whose nodes share no disk: each raylet has its own mount namespace.

One of them is a short version of benchmarks/chaos.py: three kills, one of each kind.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers import ROOT
from s3_server import record_connections

sys.path.insert(0, str(ROOT / "benchmarks"))
import chaos
from raylets import Cluster, are_namespaces_allowed, run_cluster

from models.uris import join_uri, resolve_uri
from pipelines.runtime import storage

pytestmark = pytest.mark.skipif(not are_namespaces_allowed(), reason="mount namespaces are forbidden (unshare -rm)")
TOWN_WORDS = ("jobs/preprocess_scenes.py", "town", "--num-train", "16", "--num-test", "8", "--output")
RUN_JOBS = """
import json, sys, time
from jobs.support.cli import run
for path, *words in json.loads(sys.argv[1]):
    print(f"{time.monotonic():.0f} s: {path}", flush=True)
    run(path.rpartition("/")[2].removesuffix(".py"), words)
"""


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    """A folder with a short path, as Ray's sockets need."""
    with tempfile.TemporaryDirectory(prefix="pritti-", ignore_cleanup_errors=True) as path:
        yield Path(path)


@pytest.fixture(scope="module")
def s3(folder) -> Iterator[tuple[chaos.Store, list[str]]]:
    """Two nodes without a shared disk, MLflow and S3; and a list of all connections of jobs to other hosts."""
    from ray.util import get_node_ip_address

    with record_connections() as (proxy, connections), chaos.open_store("s3", folder / "s3", 2) as store:
        outside = {name: proxy for name in ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY")}
        hosts = f"localhost,127.0.0.1,127.0.0.2,{get_node_ip_address()}"  # 127.0.0.2 is the second raylet.
        store.cluster.environment |= outside | {name: hosts for name in ("no_proxy", "NO_PROXY")}
        yield store, connections


@pytest.mark.slow
def test_output_that_nodes_do_not_share_stops_the_job(folder, tmp_path):
    output = tmp_path / "output"
    output.mkdir()
    with run_cluster(Cluster(folder, output, dict(os.environ)), 2) as cluster:
        words = [sys.executable, *TOWN_WORDS, str(output / "town")]
        done = subprocess.run(words, cwd=ROOT, env=cluster.environment, capture_output=True, text=True, timeout=200)
        lines = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
        assert done.returncode == 2 and len(lines) == 1, done.stdout[-2000:] + done.stderr[-3000:]
        assert re.search(
            rf"node \S+ \([\d.]+, \w+\) does not share {output}/town with the driver: .*"
            r"use a directory that all nodes mount, such as NFS, or object storage \(s3://bucket/...\)",
            lines[0],
        )
        assert not [path for path in output.rglob("*") if path.is_file()]


@pytest.mark.slow
def test_unshared_node_that_joins_later_stops_the_job(folder, tmp_path):
    output = tmp_path / "output"
    output.mkdir()
    with run_cluster(Cluster(folder, output, dict(os.environ)), 1) as cluster:
        words = [sys.executable, "jobs/preprocess_scenes.py", "town", "--num-train", "2000"]
        words += ["--output", str(output / "town")]
        driver = subprocess.Popen(words, cwd=ROOT, env=cluster.environment, stderr=subprocess.PIPE, text=True)
        while driver.poll() is None and not storage.list_files(str(output), ".parquet"):
            time.sleep(0.1)
        cluster.start_raylet(1)
        errors = driver.communicate(timeout=200)[1]
        assert driver.returncode == 1 and re.search(rf"\(127.0.0.2, \w+\) does not share {output}/town with", errors)
        assert not list(output.rglob(".node-*"))


@pytest.mark.slow
def test_chain_on_s3_survives_loss_of_a_node(s3, folder, cluster, tmp_path, monkeypatch):
    from jobs.implementation.sample_scenes import sample
    from jobs.sample_scenes import Config
    from models.local_copy import make_local_copy

    store, connections = s3
    words = json.dumps([store.list_words(stage, stage)[1:] for stage in chaos.STAGES])
    with (folder / "out").open("w") as log:
        driver = subprocess.Popen(
            [sys.executable, "-c", RUN_JOBS, words],
            cwd=store.cluster.folder,
            env=store.cluster.environment | {"PRITTI_HOME": store.home},
            stdout=log,
            stderr=subprocess.STDOUT,
        )
    scenes = join_uri(store.home, "results", "sample", "scenes")
    while driver.poll() is None and not storage.list_files(scenes, ".parquet"):
        time.sleep(0.1)
    store.cluster.kill_raylet(1)
    code = chaos.wait(driver, 400)
    output = (folder / "out").read_text()
    assert code == 0, output[-5000:]
    store.expected |= {stage: store.digest(stage) for stage in chaos.STAGES}
    starts_s = [int(second) for second in re.findall(r"^(\d+) s: ", output, re.M)]
    store.seconds |= dict(zip(chaos.STAGES, np.diff(starts_s), strict=False))
    assert all(store.expected.values()) and len(starts_s) == len(chaos.STAGES)
    assert connections == []  # No request to a model hub or any other host
    assert not list(folder.rglob("s3:*")) and not list(Path.cwd().glob("s3:*"))
    # The same tables as those of a local run with a local copy of the model.
    model = make_local_copy(join_uri(store.home, "results", "train_dit"))
    words = store.list_words("sample", "sample")
    count, steps = (int(words[words.index(name) + 1]) for name in ("--num-scenes", "--num-inference-steps"))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    sample(
        Config(
            model=model,
            output=str(tmp_path / "local"),
            num_scenes=count,
            num_inference_steps=steps,
            existence_threshold=0.01,
        )
    )
    local = resolve_uri(str(tmp_path / "local"))
    tables = {name: value for name, value in store.expected["sample"].items() if name.endswith(".parquet")}
    assert tables == {name: chaos.digest_file(local[0], f"{local[1]}/{name}") for name in tables}


@pytest.mark.slow
def test_three_kills_leave_the_tables_unchanged(s3, tmp_path):
    store, _ = s3
    chaos.restore_raylets(store.cluster)
    log = tmp_path / "log"
    kinds = ("driver", "raylet", "worker")
    config = chaos.Config(kills=3, stores=("s3",), stages=("preprocess",), victims=kinds, log=str(log))
    chaos.run_kills(config, lambda kind: store)
    records = [json.loads(line) for line in log.read_text().splitlines()]
    assert [record["killed"].split()[0] for record in records if "after" in record["killed"]] == list(kinds)
    assert not [record for record in records if record["faults"] or record["repeated"]]


def test_lost_doubled_and_changed_tables_are_faults():
    expected = {"scenes/a.parquet": "5 rows 01", "scenes/b.parquet": "5 rows 02", "metrics.json": "9 bytes 03"}
    found = {"scenes/a.parquet": "10 rows 04", "scenes/c.parquet": "5 rows 02", "metrics.json": "9 bytes 03"}
    assert chaos.find_faults(found, expected) == [
        "lost scenes/b.parquet",
        "added scenes/c.parquet",
        "scenes/a.parquet: 10 rows 04, not 5 rows 01",
    ]
