"""Run the long tasks of visitors one at a time, with progress, a fair queue, budgets and cancellation."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from pipelines.studio.limits import StudioError, StudioLimits

HOUR_S = 3600.0
logger = logging.getLogger(__name__)


class Cancelled(Exception):
    """Raised when the visitor cancels a task."""


@dataclass(eq=False)
class BackgroundTask:
    """A sampling run and its progress.

    Attributes:
        visitor: Visitor who started the task.
        name: Name of the operation.
        total: Total number of network evaluations of the operation.
        run: Function that does the work.
        done: Number of finished network evaluations.
        error: Error message; "" means no error.
        cancelled: Whether the visitor has cancelled the task.
        finished: Whether the task has ended.
    """

    visitor: str
    name: str
    total: int
    run: Callable[[BackgroundTask], None]
    done: int = 0
    error: str = ""
    cancelled: bool = False
    finished: bool = False

    def step(self, pipeline: Any, number: int, timestep: int, values: dict) -> dict:
        """Count one step of the sampler, which calls this function after each step."""
        if self.cancelled:
            raise Cancelled
        self.done += 1
        return values


class TaskQueue:
    """A thread that runs tasks one at a time.

    Each visitor has at most one task. Among the waiting tasks, the task of the visitor who used the fewest network
    evaluations during the last hour is next; the earliest of these, if there are several.
    """

    def __init__(self, limits: StudioLimits, clock: Callable[[], float] = time.monotonic) -> None:
        """Start the thread.

        Args:
            limits: Limits of the number of tasks and of the network evaluations.
            clock: Function that returns the time (s).
        """
        self.limits, self.clock = limits, clock
        self.waiting: list[BackgroundTask] = []
        self.running: BackgroundTask | None = None
        self.used: defaultdict[str, deque[tuple[float, int]]] = defaultdict(deque)
        self.seconds_per_evaluation: float | None = None
        self.condition = threading.Condition()
        threading.Thread(target=self._work, daemon=True, name="studio-tasks").start()

    def put(self, task: BackgroundTask) -> None:
        """Add a task.

        Raises:
            StudioError: The visitor already has a task, too many tasks are waiting, or the task exceeds the budget of a
                request or of the visitor.
        """
        limits = self.limits
        if task.total > limits.request_evaluations:
            raise StudioError(
                f"{task.name} needs {task.total:,} network evaluations, and the studio accepts"
                f" {limits.request_evaluations:,} per request; use fewer steps, fewer resamplings or a smaller region,"
                " or run jobs/inpaint_scenes.py or jobs/outpaint_scenes.py"
            )
        with self.condition:
            if any(other.visitor == task.visitor for other in self._list_active()):
                raise StudioError("your last task is still running; wait for it or cancel it", 429, 1)
            if len(self.waiting) >= limits.max_waiting:
                raise StudioError(
                    f"the queue is full ({len(self.waiting)} tasks are waiting); try again in a minute",
                    429,
                    self._estimate(self.waiting) or 60,
                )
            used = self._count_used(task.visitor)
            if used + task.total > limits.visitor_evaluations:
                raise StudioError(
                    f"you used {used:,} of {limits.visitor_evaluations:,} network evaluations per hour, and"
                    f" {task.name} needs {task.total:,}; try again later",
                    429,
                    600,
                )
            self.waiting.append(task)
            self.condition.notify()

    def cancel(self, task: BackgroundTask) -> None:
        """Cancel a task. A waiting task ends immediately, a running task after its current network evaluation."""
        with self.condition:
            task.cancelled = True
            if task in self.waiting:
                self.waiting.remove(task)
                task.finished = True

    def describe(self, task: BackgroundTask) -> dict:
        """Return the state of a task as plain values.

        `position` is the number of tasks before it, and `estimate_s` is the expected time until its end (s), or None.
        """
        with self.condition:
            order = self._order()
            position = 1 + order.index(task) if task in order else 0
            ahead = ([self.running] if self.running else []) + order[:position]
            estimate_s = None if task.finished else self._estimate(ahead if position else [task])
            names = ("name", "total", "done", "error", "cancelled", "finished")
            state = {name: getattr(task, name) for name in names}
        return state | {"position": position, "estimate_s": estimate_s}

    def _list_active(self) -> list[BackgroundTask]:
        return self.waiting + ([self.running] if self.running else [])

    def _order(self) -> list[BackgroundTask]:
        return sorted(self.waiting, key=lambda task: self._count_used(task.visitor))  # The sort is stable.

    def _estimate(self, tasks: list[BackgroundTask]) -> int | None:
        if self.seconds_per_evaluation is None:
            return None
        return round(self.seconds_per_evaluation * sum(task.total - task.done for task in tasks)) + 1

    def _count_used(self, visitor: str) -> int:
        uses = self.used.get(visitor)
        while uses and uses[0][0] < self.clock() - HOUR_S:
            uses.popleft()
        if not uses:
            self.used.pop(visitor, None)
            return 0
        return sum(count for _, count in uses)

    def _work(self) -> None:
        with suppress(OSError, AttributeError):  # On Linux, a thread can have a lower priority than its process.
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)
        while True:
            with self.condition:
                while not self.waiting:
                    self.condition.wait()
                task = self.running = self._order()[0]
                self.waiting.remove(task)
            start = self.clock()
            try:
                if not task.cancelled:
                    task.run(task)
            except Cancelled:
                pass
            except StudioError as error:
                task.error = str(error)
            except Exception:
                logger.exception("studio: %s failed", task.name)
                task.error = f"{task.name} failed; the log of the studio has the reason"
            with self.condition:
                self.used[task.visitor].append((self.clock(), task.done))
                if task.done:
                    now = (self.clock() - start) / task.done
                    before = self.seconds_per_evaluation
                    self.seconds_per_evaluation = now if before is None else 0.7 * before + 0.3 * now
                self.running = None
                task.finished = True
