"""Numbered pieces of work as Ray Data graphs: a task each, or a pool of actors that keep a model."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence

import ray
import ray.data
from ray.util.annotations import RayDeprecationWarning

# Of a task whose worker died: a killed worker is replaced, a shard that always kills its worker stops the run.
MAX_RETRIES = 20


def count_gpus_per_actor() -> int:
    """1 where the cluster has GPUs (the driver's machine need not have one), else 0."""
    return int(ray.cluster_resources().get("GPU", 0) > 0)


def make_numbered_rows(numbers: Sequence[int]) -> ray.data.Dataset:
    """Rows {"id": number}, one a block: as many tasks."""
    return ray.data.from_items([{"id": number} for number in numbers], override_num_blocks=len(numbers))


def map_rows(
    dataset: ray.data.Dataset, function: Callable[[dict], dict], num_cpus: float = 1, at_once: int | None = None
) -> ray.data.Dataset:
    """One Ray task per row, `at_once` of them, tried again when its worker dies. Processes are used again, unlike actors'."""
    compute = None if at_once is None else ray.data.TaskPoolStrategy(size=at_once)
    with warnings.catch_warnings():  # Ray says that 2.64 will take this option in another way; 2.60 has none yet
        warnings.simplefilter("ignore", RayDeprecationWarning)
        return dataset.map(function, num_cpus=num_cpus, compute=compute, max_retries=MAX_RETRIES)


def map_actors(
    numbers: Sequence[int], actor: type, arguments: tuple, num_actors: int, **resources: float
) -> Iterator[dict]:
    """Rows that actors return for {"id": number}, as they come; nothing is started for no number.

    `resources` are of one actor, num_cpus or num_gpus; without any, a GPU each where there are some.
    """
    if not numbers:
        return
    graph = make_numbered_rows(numbers).map(
        actor,
        fn_constructor_args=arguments,
        compute=ray.data.ActorPoolStrategy(size=min(num_actors, len(numbers))),
        **(resources or {"num_gpus": count_gpus_per_actor()}),
    )
    yield from graph.iter_rows()
