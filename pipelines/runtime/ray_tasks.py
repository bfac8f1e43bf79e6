"""Run numbered pieces of work as Ray Data graphs: one task each, or a pool of actors that keep a model loaded."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

import ray
import ray.data
from ray.util.annotations import RayDeprecationWarning

# Retries of a task whose worker died. Ray replaces a killed worker; a shard that always kills its worker stops the run.
MAX_RETRIES = 20


def count_gpus_per_actor() -> int:
    """Return 1 if the cluster has GPUs, even if the driver's machine has none; else 0."""
    return int(ray.cluster_resources().get("GPU", 0) > 0)


def make_numbered_rows(numbers: Sequence[int]) -> ray.data.Dataset:
    """Rows {"id": number}, one row per block, so that each row becomes a task."""
    return ray.data.from_items([{"id": number} for number in numbers], override_num_blocks=len(numbers))


def map_dataset(dataset: ray.data.Dataset, function: Callable[..., Any], **options: Any) -> ray.data.Dataset:
    """`Dataset.map` for a function or an actor class that takes more arguments than the row.

    Args:
        dataset: Rows in.
        function: Function of a row and of `fn_args` or `fn_kwargs`, or an actor class that returns such a function.
        options: Options of `Dataset.map`. Ray's annotations allow functions of the row only.
    """
    return dataset.map(cast(Any, function), **options)


def flat_map_dataset(
    dataset: ray.data.Dataset, function: Callable[..., list[dict]], **options: Any
) -> ray.data.Dataset:
    """`Dataset.flat_map` for a function that takes more arguments than the row; see `map_dataset`."""
    return dataset.flat_map(cast(Any, function), **options)


def map_rows(
    dataset: ray.data.Dataset, function: Callable[[dict], dict], num_cpus: float = 1, at_once: int | None = None
) -> ray.data.Dataset:
    """Run one Ray task per row, and retry a task whose worker died.

    Args:
        dataset: Rows in.
        function: Returns the row that replaces a row.
        num_cpus: CPUs of a task.
        at_once: Maximum number of tasks that run concurrently (default: no limit). Tasks reuse worker processes.
    """
    compute = None if at_once is None else ray.data.TaskPoolStrategy(size=at_once)
    with warnings.catch_warnings():  # Ray 2.64 announces another form of this option, which 2.60 does not have
        warnings.simplefilter("ignore", RayDeprecationWarning)
        return map_dataset(dataset, function, num_cpus=num_cpus, compute=compute, max_retries=MAX_RETRIES)


def map_actors(
    numbers: Sequence[int], actor: type, arguments: tuple, num_actors: int, **resources: float
) -> Iterator[dict]:
    """Yield the rows that actors return for {"id": number}, in order of completion. No numbers start no actor.

    Args:
        numbers: Numbers of the pieces of work.
        actor: Actor class; its instances take and return a row.
        arguments: Arguments of its constructor.
        num_actors: Maximum number of actors.
        resources: num_cpus or num_gpus of one actor (default: one GPU if the cluster has GPUs).
    """
    if not numbers:
        return
    graph = map_dataset(
        make_numbered_rows(numbers),
        actor,
        fn_constructor_args=arguments,
        compute=ray.data.ActorPoolStrategy(size=min(num_actors, len(numbers))),
        **(resources or {"num_gpus": count_gpus_per_actor()}),
    )
    yield from graph.iter_rows()
