"""Stages of a job that runs other jobs in sequence."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from pipelines.runtime import storage


class Stages:
    """Run stages in sequence, print the name of each stage, and record its duration in a file.

    Args:
        path: JSON file with the duration of each stage (s).
        total: Number of stages.
    """

    def __init__(self, path: str, total: int) -> None:
        self.path, self.total = path, total
        self.seconds: dict[str, float] = storage.read_json(path) if storage.exists(path) else {}
        self.done = 0

    def run(self, name: str, work: Callable[[], Any]) -> Any:
        """Run a stage and return its result.

        Args:
            name: Name of the stage.
            work: Function that does the work. It is always called, and must not repeat long work whose results exist.
                The file keeps the longest duration of each stage.

        Returns:
            Result of the function.
        """
        self.done += 1
        print(f"\n[{self.done}/{self.total}] {name}", flush=True)
        started = time.perf_counter()
        result = work()
        # A completed stage returns soon, so the longest duration is kept.
        self.seconds[name] = max(self.seconds.get(name, 0.0), time.perf_counter() - started)
        storage.write_json(self.seconds, self.path)
        return result
