"""Paths, command line and error messages: functions that an executable needs before it imports heavy packages."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass
from inspect import get_annotations
from types import ModuleType
from typing import Annotated, Any, get_args, get_type_hints

import tyro

from jobs.support.log import JsonLines, use_log_format
from jobs.support.renames import find_renamed
from jobs.support.stopping import stop_on_sigterm

# Environment variables that Ray reads at import and at start. Variables that the user has set keep their values.
RAY_ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_TRAIN_ENABLE_PRINT_PATCH": "0",
    "RAY_TRAIN_HEALTH_CHECK_INTERVAL_S": "0.5",
    "RAY_TRAIN_WORKER_GROUP_START_TIMEOUT_S": "30",  # After the loss of a node, Ray may first ask for lost CPUs.
    # Without this value, Ray kills the reader process after every read if there are few CPUs. The next reader
    # process then needs 10 s for imports.
    "RAY_idle_worker_killing_time_threshold_ms": "300000",
    "OMP_WAIT_POLICY": "PASSIVE",  # If another process is busy, spinning threads make torch five times slower.
    # By default, glibc returns the memory of every large tensor to the kernel. The resulting page faults take 10 to
    # 20 % of a training step on the CPU.
    "MALLOC_MMAP_MAX_": "0",
    "MALLOC_TRIM_THRESHOLD_": "-1",
}


# With the value 0, Ray uses 127.0.0.1 as the address of this node, so a Ray that a job starts listens on the loopback
# interface only. On macOS and Windows this is the default. It must not be set on a cluster.
LOOPBACK_ENVIRONMENT = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}


def set_ray_environment() -> None:
    """Set the variables that Ray reads at its import, except those that the user has set."""
    own = {} if os.environ.get("RAY_ADDRESS") else LOOPBACK_ENVIRONMENT
    for name, value in (RAY_ENVIRONMENT | own).items():
        os.environ.setdefault(name, value)


def home_path(*parts: str) -> str:
    """Return a path under $PRITTI_HOME (default ~/pritti; may be a URI).

    The path is absolute because a submitted Ray job runs in a copy of the working directory.
    """
    from models.uris import join_uri

    return join_uri(make_absolute(os.environ.get("PRITTI_HOME", "~/pritti")), *parts)


# Jobs that log to MLflow.
TRACKED = frozenset(
    ["train_lvae", "train_dit", "ablate_lvae", "evaluate_scenes", "evaluate_seams", "evaluate_voxels", "publish_model"]
)


def require_tracking_uri() -> None:
    """Check that MLflow has a place for its database.

    Raises:
        ValueError: $PRITTI_HOME is a URI, and $MLFLOW_TRACKING_URI is not set.
    """
    from models.uris import is_uri

    home = home_path()
    if is_uri(home) and not os.environ.get("MLFLOW_TRACKING_URI"):
        raise ValueError(
            f"PRITTI_HOME is {home}, but MLFLOW_TRACKING_URI is not set, and MLflow's database cannot be in object"
            " storage; set MLFLOW_TRACKING_URI to a tracking server such as http://mlflow:5000, or to"
            " sqlite:////path/mlflow.db"
        )


def make_absolute(path: str) -> str:
    """Return an absolute path or URI, which is valid for workers in other working directories."""
    from models.uris import is_uri, resolve_local_path

    return path if is_uri(path) else resolve_local_path(path)


def resolve_path(path: str, *default: str) -> str:
    """Return the absolute path of an option, or the default under $PRITTI_HOME if the option is empty."""
    return make_absolute(path) if path else home_path(*default)


def require_positive(config: object, *names: str) -> None:
    """Check integer options, of which None means the default.

    Args:
        config: Options of a job.
        *names: Names of fields to check.

    Raises:
        ValueError: One of the named options is below 1.
    """
    for name in names:
        if (value := getattr(config, name)) is not None and value < 1:
            raise ValueError(f"--{name.replace('_', '-')} is {value}, expected at least 1")


def read_positive_number(variable: str, default: float) -> float:
    """Return the number of an environment variable.

    Args:
        variable: Name of the variable.
        default: Value if the variable is not set.

    Raises:
        ValueError: The variable is not a positive number.
    """
    text = os.environ.get(variable, "")
    try:
        number = float(text or default)
    except ValueError:
        number = 0.0
    if not number > 0:
        raise ValueError(f"{variable} is {text!r}, expected a number of seconds greater than 0")
    return number


def find_root_cause(error: BaseException) -> BaseException:
    """Return the exception that the user should read. Ray wraps this exception in other exceptions.

    The function skips exceptions of Ray that wrap another exception. The next ValueError or OSError comes from this
    package. The function returns this error, because its message names the file and the remedy. The messages of deeper
    causes name neither.
    """
    seen: set[int] = set()
    while id(error) not in seen:
        seen.add(id(error))
        inner = getattr(error, "cause", None)
        if inner is None and isinstance(error, (ValueError, OSError)):
            return error
        error = inner or error.__cause__ or error
    return error


def hide_empty_defaults(options: ModuleType) -> None:
    """Remove empty defaults from the help of the option classes in a module.

    tyro appends "(default: None)" or "(default: '')" to the help of an option. The help of these options states the
    default in words.

    Args:
        options: Module jobs.<job>.
    """
    classes = [value for value in vars(options).values() if isinstance(value, type) and is_dataclass(value)]
    for cls in {base for value in classes for base in value.__mro__ if is_dataclass(base)}:
        hints = get_type_hints(cls, include_extras=True)
        for field in fields(cls):
            if field.default in ("", None, ()) and field.name in get_annotations(cls):
                cls.__annotations__[field.name] = Annotated[hints[field.name], tyro.conf.arg(help_behavior_hint="")]


def expand_flags(cls: Any, words: Sequence[str]) -> list[str]:
    """Add the value to options of the type bool | None that are written as flags.

    tyro needs a value for these options. `--name` becomes `--name True`, and `--no-name` becomes `--name False`.

    Args:
        cls: Option class, or union of the option classes of subcommands.
        words: Words of the command line.

    Returns:
        Words for tyro.
    """
    classes = [cls] if isinstance(cls, type) else [getattr(part, "__origin__", part) for part in get_args(cls)]
    hints = [pair for one in classes for pair in get_type_hints(one).items()]
    names = {f"--{name.replace('_', '-')}" for name, hint in hints if hint == (bool | None)}
    expanded = []
    for word, following in zip(words, (*words[1:], ""), strict=False):
        positive = f"--{word.removeprefix('--no-')}"
        if word in names and following not in ("True", "False", "None"):
            expanded += [word, "True"]
        else:
            expanded += [positive, "False"] if word.startswith("--no-") and positive in names else [word]
    return expanded


def run(job: str, args: Sequence[str] | None = None, prog: str | None = None) -> None:
    """Parse the command line of a job, check its options, then import and run its implementation.

    The option classes come from the module jobs.<job> even if the file runs as __main__. Thus each class exists only
    once. A ValueError or OSError is reported as one line on stderr with exit code 2.

    Args:
        job: Module name, such as "sample_scenes".
        args: Words of the command line (default: sys.argv[1:]).
        prog: Program name in the help text (default: the file's name).
    """
    options = importlib.import_module(f"jobs.{job}")
    words = sys.argv[1:] if args is None else list(args)
    if renamed := find_renamed(job, words):
        exit_with_error(renamed)
    if not {"-h", "--help"}.isdisjoint(words):
        hide_empty_defaults(options)
        if hasattr(signal, "SIGPIPE"):
            signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # `--help | head` ends silently.
    default = {"default": options.DEFAULT} if hasattr(options, "DEFAULT") else {}
    words = expand_flags(options.Config, words)
    config = tyro.cli(options.Config, args=words, prog=prog, description=options.__doc__, **default)
    set_ray_environment()
    with use_log_format(getattr(config, "log_format", "text")):
        try:
            if job in TRACKED:
                require_tracking_uri()
            if check := import_check(job):
                check(config)
            with stop_on_sigterm():
                importlib.import_module(f"jobs.implementation.{job}").main(config)
        except KeyboardInterrupt as error:
            print(f"{str(error) or 'interrupted'}; run the same command again to resume", file=sys.stderr)
            sys.exit(1)
        except Exception as error:
            cause = find_root_cause(error)
            if isinstance(cause, (ValueError, OSError)):
                exit_with_error(str(cause).split("\nFailed to apply UDF transform", 1)[0])  # without Ray's advice
            if isinstance(sys.stderr, JsonLines):
                sys.stderr.write(traceback.format_exc())
                sys.exit(1)
            raise


def import_check(job: str) -> Callable[[object], object] | None:
    """Return the check function of a job, or None; check functions need neither torch nor Ray."""
    return getattr(importlib.import_module("jobs.implementation.checks"), f"check_{job}", None)


def exit_with_error(message: str) -> None:
    """Print one line on stderr and exit with code 2."""
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)
