"""Read the state of this driver's tasks and actors from Ray's global control store. No dashboard is needed."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass

import ray
from ray.core.generated.common_pb2 import TaskStatus  # pyright: ignore[reportAttributeAccessIssue]
from ray.core.generated.gcs_pb2 import TaskEvents  # pyright: ignore[reportAttributeAccessIssue]
from ray.util import placement_group_table

RUNNING = {TaskStatus.RUNNING, TaskStatus.RUNNING_IN_RAY_GET, TaskStatus.RUNNING_IN_RAY_WAIT}
ENDED = {TaskStatus.FINISHED, TaskStatus.FAILED}


@dataclass(frozen=True)
class RunningTask:
    """Task of this driver that has started and not ended.

    Attributes:
        name: Name of the function or method.
        node: First 8 digits of the id of the node.
        process: Process id of the worker.
        seconds: Time since its start (s).
        attempt: Number of earlier attempts.
    """

    name: str
    node: str
    process: int
    seconds: float
    attempt: int


def _read_task_events() -> list[TaskEvents]:
    from ray._private.state import state

    job = ray.get_runtime_context().get_job_id()
    events = map(TaskEvents.FromString, state._connect_and_get_accessor().get_task_events())
    return [event for event in events if event.job_id.hex() == job]


def list_running_tasks() -> list[RunningTask]:
    """List the tasks of this driver that run now.

    Returns:
        Tasks, the longest first.
    """
    found = []
    for event in _read_task_events():
        times = dict(event.state_updates.state_ts_ns)
        is_driver = event.task_info.type == 3  # The driver itself is listed as a task.
        if is_driver or ENDED & set(times) or not (started := [times[key] for key in RUNNING & set(times)]):
            continue
        found.append(
            RunningTask(
                event.task_info.name,
                event.state_updates.node_id.hex()[:8],
                event.state_updates.worker_pid,
                time.time() - min(started) / 1e9,
                event.attempt_number,
            )
        )
    return sorted(found, key=lambda task: -task.seconds)


def count_retries() -> int:
    """Count the tasks of this driver that Ray started again because a worker or node died, and restarts of actors.

    Returns:
        Number of repeated attempts. Ray keeps a limited number of tasks, so a long run may have had more.
    """
    from ray._private.state import state

    job = ray.get_runtime_context().get_job_id()
    actors = state.actor_table(None).values()
    restarts = sum(int(actor.get("NumRestarts", 0)) for actor in actors if actor.get("JobID") == job)
    return restarts + sum(event.attempt_number > 0 for event in _read_task_events())


def shorten_actor_name(name: str) -> str:
    """Return the name of the class of an actor.

    Args:
        name: Name of the actor's first task, such as "MapWorker(Map(Sampler)).__init__" or "Outpainter.__init__".

    Returns:
        Name such as "Sampler".
    """
    inside = re.sub(r"^MapWorker\((?:Map\w*\()?", "", name)
    return re.split(r"[).]", inside, maxsplit=1)[0]


def list_waiting() -> list[str]:
    """Describe what this driver's actors and training workers wait for.

    Returns:
        One text per kind of actor or group that has no room, such as "3 Sampler". Empty if nothing waits.
    """
    from ray._private.state import state

    job = ray.get_runtime_context().get_job_id()
    names: dict[str, int] = {}
    for event in _read_task_events():
        if event.task_info.type == 1 and not ({TaskStatus.RUNNING, *ENDED} & set(event.state_updates.state_ts_ns)):
            name = shorten_actor_name(event.task_info.name)
            names[name] = names.get(name, 0) + 1
    pending = sum(
        actor["JobID"] == job and actor["State"] == "PENDING_CREATION" for actor in state.actor_table(None).values()
    )
    groups = [
        group["bundles"] for group in placement_group_table().values() if group["state"] in ("PENDING", "RESCHEDULING")
    ]
    found = [f"{count} {name}" for name, count in names.items()] if pending else []
    for bundles in groups:
        needs = sorted({" and ".join(f"{value:g} {kind}" for kind, value in part.items()) for part in bundles.values()})
        found.append(f"{len(bundles)} workers with {', '.join(needs)}")
    return found
