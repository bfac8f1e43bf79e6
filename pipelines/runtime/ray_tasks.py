"""Run units of work with one Ray task per unit, or as Ray Data graphs, also with actors that keep a model loaded."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import Any, TypeVar, cast

import ray
import ray.data
from ray.util.annotations import RayDeprecationWarning

from pipelines.runtime.resources import Resources, make_model_resources, require_room

# Number of retries for a task whose worker died. Ray replaces a killed worker. If a shard kills each worker that reads
# it, the run stops.
MAX_RETRIES = 20
TASKS_PER_CPU = 4

Item = TypeVar("Item")
Result = TypeVar("Result")


def map_tasks(
    function: Callable[[Item], Result], items: Sequence[Item], num_cpus: float = 1, at_once: int | None = None
) -> Iterator[Result]:
    """Call a function in one Ray task per item, and retry a task whose worker died.

    At most TASKS_PER_CPU tasks per CPU of the cluster wait or run, so the driver's memory does not depend on the number
    of items. If a task fails, the other tasks are cancelled.

    Args:
        function: Function of an item. Its name is the name of the tasks.
        items: One item per unit of work.
        num_cpus: Number of CPUs per task.
        at_once: Maximum number of concurrent tasks (default: no limit).

    Yields:
        Results in order of completion.
    """
    task = ray.remote(num_cpus=num_cpus, max_retries=MAX_RETRIES)(function)
    waiting = iter(items)
    running: list[ray.ObjectRef] = []

    def submit() -> None:
        limit = at_once or int(TASKS_PER_CPU * max(1, ray.cluster_resources().get("CPU", 1)))
        running.extend(
            task.options(name=function.__name__).remote(item) for item in islice(waiting, limit - len(running))
        )

    try:
        submit()
        while running:
            done, running[:] = ray.wait(running)
            result = ray.get(done[0])
            submit()  # before the caller uses the result
            yield result
    finally:
        for reference in running:
            ray.cancel(reference)


def make_numbered_rows(numbers: Sequence[int]) -> ray.data.Dataset:
    """Make one row {"id": number} per number. Each row is a separate block and becomes one task."""
    return ray.data.from_items([{"id": number} for number in numbers], override_num_blocks=len(numbers))


def map_dataset(dataset: ray.data.Dataset, function: Callable[..., Any], **options: Any) -> ray.data.Dataset:
    """Call `Dataset.map` with a function or an actor class that takes more arguments than the row.

    Args:
        dataset: Input rows.
        function: Function whose arguments are a row and further arguments (`fn_args`, `fn_kwargs`). Alternatively, an
            actor class whose instances can be called with these arguments.
        options: Options of `Dataset.map`. Ray's type annotations allow only functions with one argument, the row.

    Returns:
        Output rows.
    """
    return dataset.map(cast(Any, function), **options)


def flat_map_dataset(
    dataset: ray.data.Dataset, function: Callable[..., list[dict]], **options: Any
) -> ray.data.Dataset:
    """Call `Dataset.flat_map` with a function that takes more arguments than the row; see `map_dataset`."""
    return dataset.flat_map(cast(Any, function), **options)


def map_rows(
    dataset: ray.data.Dataset, function: Callable[[dict], dict], num_cpus: float = 1, at_once: int | None = None
) -> ray.data.Dataset:
    """Run one Ray task per row, and retry a task whose worker died.

    Args:
        dataset: Input rows.
        function: Function that takes an input row and returns an output row.
        num_cpus: Number of CPUs per task.
        at_once: Maximum number of concurrent tasks (default: no limit). Tasks reuse worker processes.

    Returns:
        Output rows.
    """
    compute = None if at_once is None else ray.data.TaskPoolStrategy(size=at_once)
    with warnings.catch_warnings():  # Ray 2.64 deprecates this option, but Ray 2.60 lacks the replacement.
        warnings.simplefilter("ignore", RayDeprecationWarning)
        return map_dataset(dataset, function, num_cpus=num_cpus, compute=compute, max_retries=MAX_RETRIES)


def map_actors(
    numbers: Sequence[int], actor: type, arguments: tuple, num_actors: int, num_cpus: float = 1, uses_gpu: bool = True
) -> Iterator[dict]:
    """Yield the rows that actors return for {"id": number}, in order of completion.

    If there are no numbers, no actor starts.

    Args:
        numbers: Index of each unit of work.
        actor: Actor class. Its instances are called with a row and return a row.
        arguments: Arguments of the constructor.
        num_actors: Maximum number of actors.
        num_cpus: Number of CPUs per actor.
        uses_gpu: Whether an actor holds a model for a GPU (`count_gpus_per_model`).

    Yields:
        Output rows.

    Raises:
        ValueError: The cluster has no room for one actor.
    """
    if numbers:
        graph = make_actor_graph(numbers, actor, arguments, num_actors, num_cpus, uses_gpu)
        yield from graph.iter_rows()


def defer_errors(actor: type) -> type:
    """Return an actor class that raises errors of its constructor when it is called.

    Ray replaces an error of a constructor by a text, and starts the actor again.

    Args:
        actor: Actor class.

    Returns:
        Class with the same name.
    """

    def construct(self: Any, *arguments: Any) -> None:
        self._error = None
        try:
            actor.__init__(self, *arguments)
        except Exception as error:
            self._error = error

    def call(self: Any, row: dict) -> dict:
        if self._error is not None:
            raise self._error
        return actor.__call__(self, row)

    return type(actor.__name__, (actor,), {"__init__": construct, "__call__": call})


def make_actor_graph(
    numbers: Sequence[int],
    actor: type,
    arguments: tuple,
    num_actors: int,
    num_cpus: float = 1,
    uses_gpu: bool = True,
    spare: Resources | None = None,
) -> ray.data.Dataset:
    """Make a graph in which actors process {"id": number}.

    The pool starts with the actors that fit on the cluster. It grows when the cluster grows. More actors would wait,
    and take the places of killed actors and of the tasks that follow.

    Args:
        numbers: Index of each unit of work.
        actor: Actor class.
        arguments: Arguments of the constructor.
        num_actors: Maximum number of actors.
        num_cpus: Number of CPUs per actor.
        uses_gpu: Whether an actor holds a model for a GPU.
        spare: Resources of a task that processes the rows of the actors.

    Returns:
        Output rows.

    Raises:
        ValueError: The cluster has no room for one actor.
    """
    need = make_model_resources(num_cpus) if uses_gpu else {"CPU": num_cpus}
    room = require_room(need, 1, f"an actor ({actor.__name__})", spare)
    most = min(num_actors, len(numbers))
    return map_dataset(
        make_numbered_rows(numbers),
        defer_errors(actor),
        fn_constructor_args=arguments,
        compute=ray.data.ActorPoolStrategy(min_size=min(most, room), max_size=most),
        num_cpus=num_cpus,
        num_gpus=need.get("GPU", 0),
    )
