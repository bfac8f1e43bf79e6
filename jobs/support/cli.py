"""What every job shares: where things live, how Ray is started, and how an error reaches the person who typed.

Importing this is cheap: ray and torch are imported when a job runs, not for `--help`.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipelines.reporting.report import Table


def home(*parts: str) -> str:
    """A place under $PRITTI_HOME (default ~/pritti; may be a URI). Absolute: a submitted job runs in a copy."""
    base = os.environ.get("PRITTI_HOME", "~/pritti")
    base = base.rstrip("/") if "://" in base else os.path.abspath(os.path.expanduser(base))
    return "/".join([base, *parts])


def absolute(path: str) -> str:
    """A path as the user means it, whatever directory the job's workers run in."""
    return path if "://" in path else os.path.abspath(os.path.expanduser(path))


def require_positive(config: object, *names: str) -> None:
    """Raises ValueError for an option of these that is below 1."""
    for name in names:
        if (given := getattr(config, name)) < 1:
            raise ValueError(f"--{name.replace('_', '-')} is {given}, expected at least 1")


# What Ray reads when it starts, unless the user has set it.
RAY_ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_TRAIN_ENABLE_PRINT_PATCH": "0",
    "RAY_TRAIN_HEALTH_CHECK_INTERVAL_S": "0.5",
    "RAY_TRAIN_ENABLE_PREEMPTION_WATCHER": "0",
    "RAY_TRAIN_WORKER_GROUP_START_TIMEOUT_S": "300",  # a busy machine or a slow disk imports torch for a minute
    # Few CPUs mean few idle processes: a reader would be killed after every read and start again, 10 s of imports each.
    "RAY_idle_worker_killing_time_threshold_ms": "300000",
    "OMP_WAIT_POLICY": "PASSIVE",  # spinning threads slow torch fivefold beside a busy process
    # glibc hands every large tensor back to the kernel and faults it in again: a tenth to a fifth of a step on the CPU.
    "MALLOC_MMAP_MAX_": "0",
    "MALLOC_TRIM_THRESHOLD_": "-1",
}


def start_ray(training: bool = False) -> None:
    """Join the cluster that RAY_ADDRESS names or start one on this machine; nothing if Ray already runs.

    A Ray of this command's own ends with it and nobody would open its dashboard; but Ray Train asks that once a second
    who is still alive, and complains if there is none.
    """
    for name, value in RAY_ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    import ray
    import ray.data

    if ray.is_initialized():
        return
    ray.init(logging_level=logging.WARNING, log_to_driver=True, include_dashboard=training)
    context = ray.data.DataContext.get_current()
    context.enable_progress_bars = False
    context.print_on_execution_start = False
    context.raise_original_map_exception = True  # a worker's ValueError stays one: see `root_cause`
    logging.getLogger("ray.data").setLevel(logging.WARNING)
    logging.getLogger("ray.data._internal.progress").setLevel(logging.ERROR)  # that its bars are off: ours are on
    for name in ("exceptions", "_internal.execution.streaming_executor_state"):  # tracebacks of what reaches us anyway
        logging.getLogger(f"ray.data.{name}").setLevel(logging.CRITICAL)


def run_packed(config: dict[str, bytes]) -> None:
    """What Ray Train calls in its workers. Its controller unpickles it too, and need not import the models for that."""
    from ray import cloudpickle

    cloudpickle.loads(config["packed"])()


def root_cause(error: BaseException) -> BaseException:
    """The exception that user-facing text should come from: Ray wraps a worker's error several times.

    The first ValueError or OSError on the way down is ours, with file and fix; what caused it says less.
    """
    seen: set[int] = set()
    while id(error) not in seen:
        seen.add(id(error))
        inner = getattr(error, "cause", None)
        if inner is None and isinstance(error, (ValueError, OSError)):
            return error
        error = inner or error.__cause__ or error
    return error


def print_table(table: Table, file: IO[str] | None = None) -> None:
    """A report's table on the terminal; into a file, wide lines."""
    from rich import box
    from rich.console import Console
    from rich.table import Table as Lines

    from pipelines.reporting.report import written

    lines = Lines(title=table.title, caption=table.note, box=box.SIMPLE)
    for name in table.columns:
        lines.add_column(name, overflow="fold")  # names are told apart by their ends
    for row in table.rows:
        lines.add_row(*map(written, row))
    Console(file=file, width=None if file is None and sys.stdout.isatty() else 200).print(lines)


def run(main: Callable[[Any], None], config: Any, **tyro_options: Any) -> None:
    """Parse the command line into `config` and run. A ValueError becomes one clear line and exit code 2."""
    import tyro

    parsed = tyro.cli(config, **tyro_options)
    try:
        main(parsed)
    except KeyboardInterrupt:
        sys.exit("interrupted; the same command goes on where it stopped")
    except Exception as error:
        cause = root_cause(error)
        if isinstance(cause, (ValueError, OSError)):
            said = str(cause).split("\nFailed to apply UDF transform", 1)[0]  # Ray's remark on how to retry
            print(f"error: {said}", file=sys.stderr)
            sys.exit(2)
        raise
