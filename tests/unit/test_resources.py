"""Tests of counting and requesting the resources of a cluster."""

from types import SimpleNamespace

import pytest

from jobs.support import trainer
from pipelines.runtime import resources
from pipelines.runtime.resources import ResourcePolicy, count_room, require_room, set_resource_policy


@pytest.fixture
def nodes(monkeypatch) -> list[dict]:
    """Nodes of a cluster; tests add and remove nodes."""
    found: list[dict] = []
    total = {"CPU": 0.0}
    monkeypatch.setattr(resources.ray, "nodes", lambda: found)
    monkeypatch.setattr(resources.ray, "cluster_resources", lambda: total)
    monkeypatch.setattr(resources.ray, "available_resources", lambda: total)
    return found


def add_node(nodes: list[dict], alive: bool = True, **have: float) -> None:
    nodes.append({"Alive": alive, "Resources": have})


def test_room_is_counted_per_node(nodes):
    add_node(nodes, CPU=3.0)
    add_node(nodes, CPU=3.0, GPU=1.0)
    add_node(nodes, CPU=64.0, alive=False)
    assert count_room({"CPU": 2.0}) == 2  # the third CPU of each node does not make a third process
    assert count_room({"CPU": 1.0}) == 6
    assert count_room({"CPU": 1.0, "GPU": 1.0}) == 1
    assert count_room({"CPU": 1.0, "GPU": 0.5}) == 2
    assert count_room({"CPU": 1.0, "TPU": 1.0}) == 0


def test_room_leaves_place_for_following_tasks(nodes):
    add_node(nodes, CPU=1.0)
    add_node(nodes, CPU=1.0)
    assert count_room({"CPU": 0.5}, {"CPU": 0.5}) == 3
    assert count_room({"CPU": 1.0}, {"CPU": 0.5}) == 1  # one node must keep half a CPU
    assert count_room({"CPU": 1.0}, {"CPU": 2.0}) == 0
    add_node(nodes, CPU=1.5)
    assert count_room({"CPU": 1.0}, {"CPU": 0.5}) == 3


def test_missing_room_is_one_clear_error(nodes):
    add_node(nodes, CPU=2.0)
    with pytest.raises(ValueError, match=r"an actor needs 1 CPU and 1 GPU 1 times.*room for 0.*--wait-for-resources"):
        require_room({"CPU": 1.0, "GPU": 1.0}, 1, "an actor")


def test_gpus_are_not_replaced_by_cpus(nodes):
    add_node(nodes, CPU=2.0)
    assert resources.make_model_resources() == {"CPU": 1.0}
    with set_resource_policy(ResourcePolicy(gpus=1)):
        assert resources.make_model_resources() == {"CPU": 1.0, "GPU": 1}
    with set_resource_policy(ResourcePolicy(gpus=0)):
        assert resources.make_model_resources() == {"CPU": 1.0}


@pytest.mark.parametrize("values", [{"gpus": -1}, {"gpus": 1.5}, {"wait_s": -1}, {"wait_s": float("inf")}])
def test_invalid_policy_is_refused(values):
    with pytest.raises(ValueError, match="expected a"):
        ResourcePolicy(**values)


@pytest.mark.parametrize(
    ("cpus", "allowed", "workers", "threads"), [(8, 8, 2, 4), (8, 2, 1, 2), (2, 8, 1, 2), (2, 1, 4, 1)]
)
def test_threads_stay_within_allowed_cpus(monkeypatch, cpus, allowed, workers, threads):
    monkeypatch.setattr(trainer.os, "sched_getaffinity", lambda pid: set(range(allowed)), raising=False)
    monkeypatch.setattr(trainer.ray, "get_runtime_context", lambda: SimpleNamespace(get_node_id=lambda: "b"))
    nodes = [{"NodeID": "a", "Resources": {"CPU": 64.0}}, {"NodeID": "b", "Resources": {"CPU": float(cpus)}}]
    monkeypatch.setattr(trainer.ray, "nodes", lambda: nodes)
    assert trainer.count_threads(workers) == threads
