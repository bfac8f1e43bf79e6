"""Numbered pieces of work -> a pool of actors: the graph that most of the jobs are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import ray
import ray.data


def gpus_per_actor() -> int:
    """1 where the cluster has GPUs (the driver's machine need not have one), else 0."""
    return int(ray.cluster_resources().get("GPU", 0) > 0)


def fan_out(
    numbers: Sequence[int], actor: type, arguments: tuple, num_actors: int, **resources: float
) -> Iterator[dict]:
    """Rows that actors return for {"id": number}, as they come; nothing is started for no number.

    `resources` are of one actor, num_cpus or num_gpus; without any, a GPU each where there are some.
    """
    if not numbers:
        return
    graph = ray.data.from_items([{"id": number} for number in numbers], override_num_blocks=len(numbers)).map(
        actor,
        fn_constructor_args=arguments,
        compute=ray.data.ActorPoolStrategy(size=min(num_actors, len(numbers))),
        **(resources or {"num_gpus": gpus_per_actor()}),
    )
    yield from graph.iter_rows()
