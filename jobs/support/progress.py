"""Show the progress of a job: bars on a terminal, otherwise one line a minute, and Ray metrics.

A thread also announces actors without room, and a stall: no progress for $PRITTI_STALL_SECONDS (default 600).
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import ray
from rich.progress import Progress, ProgressColumn, TaskID

from jobs.support.cli import read_positive_number
from jobs.support.log import print_event
from pipelines.runtime.cluster_state import count_retries, list_running_tasks, list_waiting
from pipelines.runtime.resources import describe_cluster

LINE_S = 60.0  # Time between two lines.
WAITING_S = 30.0  # Time after which actors without room are announced; repeated every STALL_S.
STALL_S = 600.0
STALL_VARIABLE = "PRITTI_STALL_SECONDS"
POLL_S = 5.0
COUNT_S = 30.0  # Time between two counts of retries, for which all task events of the cluster are read.
EARLIER_S = 0.5  # Units that arrive in this time were finished by an earlier run.
SHOWN_TASKS = 5


def format_duration(seconds: float) -> str:
    """Return a duration as text, such as "45 s", "12 min" or "3.5 h"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


class Track:
    """Numbers of one bar."""

    def __init__(self, name: str, total: float | None, clock: Callable[[], float]) -> None:
        self.name, self.total, self.clock = name, total, clock
        self.done, self.at_start, self.rejects, self.is_followed = 0.0, 0.0, 0, False
        self.started = self.advanced = clock()

    def advance(self, amount: float) -> None:
        if amount <= 0:
            return
        now = self.clock()
        if now - self.started < EARLIER_S or (self.is_followed and not self.done):
            # Units of an earlier run say nothing about the rate.
            self.at_start, self.started = self.done + amount, now if self.is_followed else self.started
        self.done += amount
        self.advanced = now

    @property
    def rate(self) -> float:
        """Units per second of this run."""
        return (self.done - self.at_start) / max(self.clock() - self.started, 1e-3)

    @property
    def is_complete(self) -> bool:
        return self.total is not None and self.done >= self.total

    def describe(self) -> tuple[str, dict[str, Any]]:
        """Return a line and its values."""
        age_s = self.clock() - self.advanced
        left_s = (self.total - self.done) / self.rate if self.total is not None and self.rate else None
        values = {
            "stage": self.name,
            "done": self.done,
            "total": self.total,
            "rate_per_s": round(self.rate, 4),
            "left_s": left_s and round(left_s, 1),
            "age_s": round(age_s, 1),
            "rejects": self.rejects,
        }
        parts = [f"{self.name}: {self.done:,.0f}"]
        if self.total is not None:
            parts[0] += f" of {self.total:,.0f} ({100 * self.done / max(self.total, 1):.0f} %)"
        parts.append(f"{self.rate:.3g}/s")
        if self.is_complete:
            parts.append(format_duration(self.clock() - self.started))
        elif left_s is not None:
            parts.append(f"{format_duration(left_s)} left")
        if not self.is_complete:
            parts.append(f"last progress {format_duration(age_s)} ago")
        if self.rejects:
            parts.append(f"{self.rejects:,} rejects")
        return ", ".join(parts), values


class Watch:
    """Finds actors without room and stalls. `look` is called every few seconds."""

    def __init__(self, stall_s: float = STALL_S, clock: Callable[[], float] = time.monotonic) -> None:
        self.stall_s, self.clock = stall_s, clock
        self.waiting_since: float | None = None
        self.stalled_at = -float("inf")

    def look(self, last_progress: float, waiting: Callable[[], list[str]] = list_waiting) -> list[tuple[str, dict]]:
        """Return lines, each with its values.

        Args:
            last_progress: Time of the last progress.
            waiting: Function that lists what waits for room.
        """
        now, lines = self.clock(), []
        if found := waiting():
            self.waiting_since = now if self.waiting_since is None else self.waiting_since
            if now - self.waiting_since >= WAITING_S:
                text = f"waiting for room: {'; '.join(found)}. The cluster has {describe_cluster()}"
                lines.append((text, {"event": "waiting", "waiting": found}))
                self.waiting_since = now + self.stall_s
        else:
            self.waiting_since = None
        if now - max(last_progress, self.stalled_at) >= self.stall_s:
            self.stalled_at = now
            tasks = list_running_tasks()[:SHOWN_TASKS]
            hanging = [
                f"{task.name} (node {task.node}, process {task.process}, {format_duration(task.seconds)}"
                + (f", attempt {task.attempt + 1})" if task.attempt else ")")
                for task in tasks
            ]
            text = f"no progress for {format_duration(now - last_progress)}; running: {'; '.join(hanging) or 'no task'}"
            lines.append((text, {"event": "stall", "tasks": hanging}))
        return lines


class JobProgress(Progress):
    """Progress bars on a terminal; otherwise, lines. Enter it as a context, as rich's Progress."""

    def __init__(self, *columns: str | ProgressColumn, **options: Any) -> None:
        self.is_shown = sys.stdout.isatty()
        super().__init__(*columns, disable=not self.is_shown, **options)
        self.tracks: dict[TaskID, Track] = {}
        self._watch = Watch(read_positive_number(STALL_VARIABLE, STALL_S))
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._gauges: dict[str, Any] = {}
        self._retries = 0
        self._followed: list[tuple[TaskID, Callable[[], float]]] = []

    def add_task(self, description: str, *arguments: Any, total: float | None = 100.0, **fields: Any) -> TaskID:
        task = super().add_task(description, *arguments, total=total, **fields)
        self.tracks[task] = Track(description, total, time.monotonic)
        return task

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        super().advance(task_id, advance)
        track = self.tracks[task_id]
        was_complete = track.is_complete
        track.advance(advance)
        if track.is_complete and not was_complete:
            self._print(*track.describe())

    def update(self, task_id: TaskID, **changes: Any) -> None:
        super().update(task_id, **changes)
        track = self.tracks[task_id]
        if changes.get("total") is not None:
            track.total = changes["total"]
        if changes.get("advance"):
            track.advance(changes["advance"])
        if changes.get("completed") is not None:
            track.advance(changes["completed"] - track.done)

    def add_rejects(self, task_id: TaskID, count: int) -> None:
        """Count rejected scenes."""
        self.tracks[task_id].rejects += count

    def start(self) -> None:
        super().start()
        if self._thread is None:
            self._thread = threading.Thread(target=self._report, name="progress", daemon=True)
            self._thread.start()

    def follow(self, description: str, total: float, read: Callable[[], float]) -> None:
        """Show the progress of work outside this process.

        Args:
            description: Name of the bar.
            total: Number of units.
            read: Function that returns the number of finished units.
        """
        task = self.add_task(description, total=total)
        self.tracks[task].is_followed = True
        self._followed.append((task, read))

    def stop(self) -> None:
        self._stop.set()
        super().stop()

    def _report(self) -> None:
        printed = time.monotonic()
        counted = -float("inf")
        while not self._stop.wait(POLL_S):
            if not ray.is_initialized() or not self.tracks:
                continue
            with suppress(Exception):  # A report must not end the job; the cluster may be about to end.
                for task, read in self._followed:
                    self.advance(task, max(0.0, read() - self.tracks[task].done))
                if time.monotonic() - counted >= COUNT_S:
                    counted, self._retries = time.monotonic(), count_retries()
                current = [track for track in self.tracks.values() if not track.is_complete]
                self._export(current)
                for text, values in self._watch.look(max(track.advanced for track in self.tracks.values())):
                    self._print(text, values, always=True)
                if time.monotonic() - printed >= LINE_S:
                    printed = time.monotonic()
                    for track in current[-1:]:
                        text, values = track.describe()
                        self._print(f"{text}, {self._retries} retries", values | {"retries": self._retries})

    def _print(self, text: str, values: dict[str, Any], always: bool = False) -> None:
        if always or not self.is_shown:
            print_event(text, {"event": "progress"} | values)

    def _export(self, tracks: list[Track]) -> None:
        """Set the Ray metrics, which Prometheus reads from each node."""
        from ray.util.metrics import Gauge

        for track in tracks[-1:]:
            values = {
                "done": track.done,
                "total": track.total or 0.0,
                "rate_per_second": track.rate,
                "last_progress_age_seconds": track.clock() - track.advanced,
                "rejects": track.rejects,
                "retries": self._retries,
            }
            for name, value in values.items():
                if name not in self._gauges:
                    self._gauges[name] = Gauge(f"pritti_{name}", METRICS[name], ("stage", "job"))
                self._gauges[name].set(value, {"stage": track.name, "job": os.path.basename(sys.argv[0])})


METRICS = {
    "done": "Finished units (scenes, shards or blocks) of the current stage",
    "total": "Units of the current stage",
    "rate_per_second": "Finished units per second",
    "last_progress_age_seconds": "Time since the last finished unit",
    "rejects": "Rejected scenes",
    "retries": "Tasks and actors that were started again",
}
