"""Run the studio in a Ray actor: one process holds the model and the sessions of all visitors.

The actor has no name and runs no HTTP server; only Ray's internal ports reach it. Ray Serve is not used: each of its
replicas listens on all network interfaces, and its proxy answers some addresses without access control.
"""

from __future__ import annotations

import logging
import sys
from typing import Any

import ray
import ray.exceptions
from pydantic import BaseModel

from pipelines.runtime.resources import count_gpus_per_model
from pipelines.studio.limits import StudioLimits
from pipelines.studio.studio import Answer, Studio, make_json_answer

logger = logging.getLogger(__name__)
THREADS = 16  # Number of requests that the actor works on at the same time.
MAX_PENDING = 256  # Maximum number of requests that the actor has not answered; further requests are refused.

# Many threads allocate scenes of different sizes. With one arena per thread, or if freed memory is kept for training
# (RAY_ENVIRONMENT), the process would need three times the memory of its scenes.
MALLOC = {
    "MALLOC_ARENA_MAX": "2",
    "MALLOC_MMAP_MAX_": "65536",
    "MALLOC_MMAP_THRESHOLD_": "131072",
    "MALLOC_TRIM_THRESHOLD_": "131072",
}


class StudioActor:
    """Actor that answers the requests of all visitors."""

    def __init__(
        self,
        model: str,
        datasets: list[str],
        limits: StudioLimits,
        threads: int | None,
        constraints: bool | None = None,
    ) -> None:
        import torch

        if threads:
            torch.set_num_threads(threads)
        sys.setswitchinterval(0.001)  # Requests wait less for the thread that samples.
        self.error: ValueError | None = None
        try:
            self.studio = Studio(model, datasets, limits, constraints)
        except ValueError as error:  # An error in __init__ would end the process, with a long log.
            self.error = error
            logger.error("studio: %s", error)

    def answer(self, operation: str, visitor: str, request: BaseModel | None) -> Answer:
        """Carry out one request (`Studio.answer`)."""
        if self.error:  # The process has restarted, and the files have changed.
            return make_json_answer({"detail": "the studio cannot read its files; its log has the reason"}, 503)
        return self.studio.answer(operation, visitor, request)

    def ready(self) -> bool:
        """Return True when the model is loaded. Raises ValueError if the model or a dataset cannot be read."""
        if self.error:
            raise self.error
        return True


class ActorBackend:
    """Sends requests to a studio in an actor, which restarts if its process dies."""

    def __init__(
        self,
        model: str,
        datasets: list[str],
        limits: StudioLimits,
        threads: int | None = None,
        constraints: bool | None = None,
    ) -> None:
        """Start the actor and wait until it has loaded the model.

        Args:
            model: Pipeline directory.
            datasets: Dataset directories.
            limits: Limits of memory and computing time.
            threads: Number of CPU threads for the network. None: all cores.
            constraints: Whether constraints guide sampling by default. None: the value that the model stores.

        Raises:
            ValueError: A directory contains no model, or a dataset contains no readable scenes.
        """
        actor: Any = ray.remote(StudioActor).options(
            num_cpus=0,
            num_gpus=count_gpus_per_model(),
            max_concurrency=THREADS,
            max_restarts=-1,
            max_pending_calls=MAX_PENDING,
            runtime_env={"env_vars": MALLOC},
        )
        self.actor = actor.remote(model, datasets, limits, threads, constraints)
        try:
            ray.get(self.actor.ready.remote())
        except ValueError as error:  # Ray's error is also of the type of its cause.
            self.stop()
            raise getattr(error, "cause", error) from None

    async def answer(self, operation: str, visitor: str, request: BaseModel | None = None) -> Answer:
        """Carry out one request (`Studio.answer`). If the actor is overloaded or restarts, the answer says so."""
        try:
            return await self.actor.answer.remote(operation, visitor, request)
        except ray.exceptions.PendingCallsLimitExceeded:
            return make_json_answer({"detail": "the studio is overloaded; try again"}, 429, 5)
        except ray.exceptions.RayActorError:
            return make_json_answer({"detail": "the studio restarts; your scene is lost, reload the page"}, 503, 20)

    def stop(self) -> None:
        """Stop the actor."""
        ray.kill(self.actor)
