"""Tests of the function that runs one Ray task per unit of work, on a real cluster."""

import os
import time
from pathlib import Path

import pytest

from jobs.support.cli import find_root_cause
from pipelines.runtime.ray_tasks import map_tasks


def test_results_are_complete_and_few_tasks_run_together(cluster):
    def note_times(number: int) -> tuple[int, float, float]:
        started = time.time()
        time.sleep(0.05)
        return number, started, time.time()

    assert list(map_tasks(note_times, [])) == []
    found = list(map_tasks(note_times, range(9), num_cpus=0.1, at_once=3))
    assert sorted(number for number, _, _ in found) == list(range(9))
    assert max(sum(start <= at < end for _, start, end in found) for _, at, _ in found) <= 3


def test_task_whose_worker_died_runs_again(cluster, tmp_path):
    def die_once(number: int) -> int:
        marker = tmp_path / str(number)
        if number == 1 and not marker.exists():
            marker.touch()
            os._exit(1)
        return number

    assert sorted(map_tasks(die_once, range(4))) == [0, 1, 2, 3]
    assert (tmp_path / "1").exists()


def test_error_keeps_its_type_and_cancels_other_tasks(cluster, tmp_path):
    def fail_first(number: int) -> int:
        if number == 0:
            raise ValueError("a.parquet: damaged; delete this file")
        time.sleep(0.1)
        Path(tmp_path, str(number)).touch()
        return number

    with pytest.raises(ValueError, match="damaged") as caught:
        list(map_tasks(fail_first, range(400)))
    cause = find_root_cause(caught.value)
    assert type(cause) is ValueError and str(cause) == "a.parquet: damaged; delete this file"
    time.sleep(1)
    count = len(list(tmp_path.iterdir()))
    time.sleep(1)
    assert len(list(tmp_path.iterdir())) == count < 40
