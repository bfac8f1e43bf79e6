"""Start Ray or join a cluster."""

from __future__ import annotations

import logging
import os
from typing import Any

import ray
import ray.data
from ray import cloudpickle

from jobs.support.cli import set_ray_environment
from jobs.support.stopping import keep_sigterm_handler


def start_ray(training: bool = False, object_store_bytes: int | None = None) -> None:
    """Join the cluster at RAY_ADDRESS, or start Ray on this machine; do nothing if Ray already runs.

    Args:
        training: Also start the dashboard. Ray Train asks the dashboard once per second which workers are alive, and
            logs a warning if there is no dashboard. If another Ray on this machine has a dashboard, Ray Train asks that
            one, does not find its controller and restarts the training. Other jobs do not need the dashboard.
        object_store_bytes: Size of the object store of a Ray that is started on this machine (default: Ray's choice).
    """
    set_ray_environment()
    if ray.is_initialized():
        return
    store: dict[str, Any] = {} if os.environ.get("RAY_ADDRESS") else {"object_store_memory": object_store_bytes}
    # Without RAY_ADDRESS, Ray would join any cluster that somebody has started on this machine.
    address = os.environ.get("RAY_ADDRESS") or "local"
    with keep_sigterm_handler():
        ray.init(address, logging_level=logging.WARNING, log_to_driver=True, include_dashboard=training, **store)
    context = ray.data.DataContext.get_current()
    context.enable_progress_bars = False
    context.print_on_execution_start = False
    context.raise_original_map_exception = True  # `find_root_cause` needs the type of a worker's error
    logging.getLogger("ray.data").setLevel(logging.WARNING)
    logging.getLogger("ray.data._internal.progress").setLevel(logging.ERROR)  # the jobs show progress bars
    for name in ("exceptions", "_internal.execution.streaming_executor_state"):  # Ray also raises these errors
        logging.getLogger(f"ray.data.{name}").setLevel(logging.CRITICAL)


def run_packed(config: dict[str, bytes]) -> None:
    """Unpickle and call a function in a Ray Train worker.

    The function is passed as bytes. Ray Train's controller therefore neither unpickles the function nor imports the
    models.
    """
    cloudpickle.loads(config["packed"])()
