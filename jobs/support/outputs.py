"""Prepare the output of a job: start Ray, check that all nodes share the storage, and ensure that no other job writes.

Each job enters `hold_output` before its first write.
"""

from __future__ import annotations

import json
import logging
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from jobs.support.cli import home_path, read_positive_number
from jobs.support.ray_session import start_ray
from jobs.support.stopping import stop_job, stop_on_sigterm
from models.uris import split_name
from pipelines.runtime.resources import ResourcePolicy, set_resource_policy
from pipelines.runtime.shared_storage import require_shared_storage
from pipelines.schema.lease import LIFETIME_S, IfBusy, Lease, Owner

logger = logging.getLogger(__name__)

NODES_S = 5.0  # Time between two searches for new nodes.
NODE_ATTEMPTS = 3  # Number of failed checks of new nodes after which the job stops.
LIFETIME_VARIABLE = "PRITTI_LEASE_SECONDS"  # Time after which the lease of a silent job expires.
JOB_VARIABLE = "RAY_JOB_CONFIG_JSON_ENV_VAR"  # Ray sets this variable in submitted jobs.


def find_job_id() -> str:
    """Return the submission id of this Ray job, or "" if the process was not submitted as a job."""
    try:
        return json.loads(os.environ.get(JOB_VARIABLE, "{}"))["metadata"]["job_submission_id"]
    except (ValueError, KeyError, TypeError):
        return ""


@contextmanager
def hold_lease(output: str, name: str, if_busy: IfBusy = "refuse") -> Iterator[None]:
    """Hold the right to write to an output while the body runs. Ray is not needed.

    Args:
        output: Directory or URI to which this job and its tasks write.
        name: Name of the run or table that is written. Jobs with other names may write to the same output.
        if_busy: Behaviour if another job writes to the same output (`Lease.acquire`).

    Yields:
        None.

    Raises:
        ValueError: Another job writes to the output.
        OSError: The output cannot be written.
    """
    lifetime_s = read_positive_number(LIFETIME_VARIABLE, LIFETIME_S)
    lease = Lease(output, name, Owner.of_this_process(find_job_id()), stop_job, lifetime_s)
    with stop_on_sigterm():
        lease.acquire(if_busy, lambda line: print(line, flush=True))
        state = "failed"
        try:
            yield
            state = "finished"
        except KeyboardInterrupt:
            state = "killed"
            raise
        finally:
            with suppress(OSError):  # If the storage fails, the error of the body counts, and the lease expires.
                lease.release(state)


@contextmanager
def watch_new_nodes(output: str, checked: set[str]) -> Iterator[None]:
    """Check nodes that join the cluster while the body runs; stop the job if a node does not share the output.

    Args:
        output: Directory or URI to which tasks write.
        checked: Ids of the nodes that need no check.

    Yields:
        None.
    """
    done = threading.Event()

    def watch() -> None:
        known, failures = checked, 0
        while not done.wait(NODES_S):
            try:
                known, failures = known | require_shared_storage(output, known), 0
            except ValueError as error:
                failures += 1  # The storage of a node that has just started may need a moment.
                if failures == NODE_ATTEMPTS and not done.is_set():
                    stop_job(str(error))
                    return
            except Exception as error:  # The cluster or the storage does not answer; the job itself will notice.
                logger.debug("new nodes were not checked: %s", error)

    thread = threading.Thread(target=watch, name="new-nodes", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join(NODES_S)  # Let a check that runs delete its markers.


@contextmanager
def hold_output(output: str, name: str, options: object = None, training: bool = False) -> Iterator[None]:
    """Start Ray, check that all nodes share an output, and hold the right to write to it while the body runs.

    Args:
        output: Directory or URI to which this job and its tasks write.
        name: Name of the run or table that is written (`hold_lease`).
        options: Options of the job. The fields `if_busy` (`Lease.acquire`), `gpus` and `wait_for_resources_s`
            (`ResourcePolicy`) are used if they exist.
        training: Start Ray with a dashboard (`start_ray`).

    Yields:
        None.

    Raises:
        ValueError: The output is not shared by all nodes, or another job writes to it.
        OSError: The output cannot be written.
    """
    policy = ResourcePolicy(getattr(options, "gpus", None), getattr(options, "wait_for_resources_s", 0.0))
    start_ray(training)
    if_busy: IfBusy = getattr(options, "if_busy", "refuse")
    nodes = require_shared_storage(output)
    with set_resource_policy(policy), hold_lease(output, name, if_busy), watch_new_nodes(output, nodes):
        yield


@contextmanager
def hold_training(name: str, output: str, options: object = None) -> Iterator[None]:
    """Hold the right to train a run and to write its model while the body runs.

    Args:
        name: Name of the run; its checkpoints are in $PRITTI_HOME/runs/<name>.
        output: Directory or URI of the model. Its lease is next to it, because the directory is published.
        options: Options of the job (`hold_output`).

    Yields:
        None.

    Raises:
        ValueError: An output is not shared by all nodes, or another job writes to it.
        OSError: An output cannot be written.
    """
    if_busy: IfBusy = getattr(options, "if_busy", "refuse")
    with hold_output(home_path("runs"), name, options, training=True), hold_lease(*split_name(output), if_busy):
        yield
