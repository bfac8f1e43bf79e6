"""Tests of what a job reports about its tasks and actors, on a real cluster."""

import json
import os
import re
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest
import ray.data
from helpers import ROOT

from jobs.support.cli import find_root_cause
from jobs.support.progress import METRICS, JobProgress
from pipelines.runtime.cluster_state import count_retries, list_running_tasks, list_waiting
from pipelines.runtime.ray_tasks import map_actors


def wait_until(is_true: Callable[[], object], seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not is_true():
        assert time.monotonic() < end
        time.sleep(0.2)


def test_retries_running_tasks_and_waiting_actors_are_listed(cluster, tmp_path):
    @ray.remote(num_cpus=0, max_retries=2)
    def die_once_and_hang(marker: str, end: str) -> None:
        if not os.path.exists(marker):
            Path(marker).touch()
            os._exit(1)
        while not os.path.exists(end):
            time.sleep(0.1)

    @ray.remote(num_cpus=100)
    class Giant:
        pass

    before = count_retries()
    task = die_once_and_hang.remote(str(tmp_path / "marker"), str(tmp_path / "end"))
    giant = Giant.remote()
    wait_until(lambda: [found for found in list_running_tasks() if found.name == "die_once_and_hang"])
    (found,) = [found for found in list_running_tasks() if found.name == "die_once_and_hang"]
    assert found.attempt == 1 and found.process > 0 and 0 <= found.seconds < 60
    assert count_retries() == before + 1
    wait_until(lambda: "1 Giant" in list_waiting())
    ray.kill(giant)
    (tmp_path / "end").touch()
    ray.get(task)
    wait_until(lambda: "1 Giant" not in list_waiting())


@pytest.mark.parametrize(("given", "expected"), [("", "local"), ("127.0.0.1:6379", "127.0.0.1:6379")])
def test_job_joins_a_cluster_only_if_its_address_is_given(monkeypatch, given, expected):
    """By default, Ray joins any cluster that somebody has started on this machine."""
    from jobs.support.ray_session import start_ray

    found = []
    monkeypatch.setenv("RAY_ADDRESS", given)
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "init", lambda address=None, **_: found.append(address))
    start_ray()
    assert found == [expected]


def test_more_actors_than_the_cluster_has_room_for_do_not_hang(cluster):
    class Double:
        def __call__(self, row: dict) -> dict:
            return {"id": row["id"], "twice": 2 * row["id"]}

    rows = list(map_actors(range(20), Double, (), num_actors=64))
    assert sorted(row["twice"] for row in rows) == list(range(0, 40, 2))


def test_error_of_an_actors_constructor_keeps_its_type(cluster, monkeypatch):
    context = ray.data.DataContext.get_current()
    monkeypatch.setattr(context, "raise_original_map_exception", True)  # as start_ray does

    class Broken:
        def __init__(self) -> None:
            raise ValueError("model.bin: damaged; copy it again")

        def __call__(self, row: dict) -> dict:
            return row

    with pytest.raises(Exception, match=r"model\.bin") as caught:
        list(map_actors(range(2), Broken, (), num_actors=1))
    cause = find_root_cause(caught.value)
    assert isinstance(cause, ValueError) and str(cause).startswith("model.bin: damaged; copy it again")


def test_prometheus_reads_the_metrics_of_the_dashboard(cluster):
    dashboard = json.loads((ROOT / "infra/grafana/pritti.json").read_text())
    asked = {name for panel in dashboard["panels"] for part in panel["targets"] for name in find_metrics(part["expr"])}
    assert asked == {f"ray_pritti_{name}" for name in METRICS}
    port = ray.nodes()[0]["MetricsExportPort"]
    with JobProgress() as bar:
        task = bar.add_task("sample scenes", total=10)
        bar.advance(task, 4)
        bar.add_rejects(task, 2)

        def read() -> str:
            return urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10).read().decode()

        def find_values() -> list[str]:  # Earlier jobs of this process have other stages.
            return re.findall(r'^ray_pritti_done\{.*stage="sample scenes".* (\S+)$', read(), re.M)

        # Ray may export the first value, which is 0, before the next one.
        wait_until(lambda: asked <= set(find_metrics(read())) and find_values() == ["4.0"], 60)


def find_metrics(text: str) -> list[str]:
    return re.findall(r"ray_pritti_[a-z_]+", text)
