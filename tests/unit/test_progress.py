"""Tests of progress lines, stalls and the log format."""

import io
import json
import sys
import time
import traceback

import pytest

from jobs.support import progress
from jobs.support.log import JsonLines, print_event, use_log_format
from jobs.support.progress import Track, Watch


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_line_states_done_rate_time_left_and_age():
    clock = Clock()
    track = Track("sample scenes", 1000, clock)
    track.advance(200)  # written by an earlier run
    clock.now += 50
    track.advance(100)
    track.rejects = 3
    clock.now += 50
    text, values = track.describe()
    assert text == ("sample scenes: 300 of 1,000 (30 %), 1/s, 12 min left, last progress 50 s ago, 3 rejects")
    assert values["left_s"] == 700 and values["rate_per_s"] == 1 and values["age_s"] == 50


def test_followed_work_starts_at_its_first_number():
    clock = Clock()
    track = Track("train", 1000, clock)
    track.is_followed = True
    clock.now += 60  # a training starts slowly, and resumes at step 800
    track.advance(800)
    clock.now += 10
    track.advance(50)
    assert track.rate == pytest.approx(5) and "30 s left" in track.describe()[0]


def test_stall_names_the_tasks_that_hang(monkeypatch):
    task = progress.list_running_tasks.__globals__["RunningTask"]("Map(write)", "0123abcd", 42, 1200.0, 1)
    monkeypatch.setattr(progress, "list_running_tasks", lambda: [task])
    clock = Clock()
    watch = Watch(600, clock)
    last = clock.now
    clock.now += 599
    assert watch.look(last, lambda: []) == []
    clock.now += 1
    ((text, values),) = watch.look(last, lambda: [])
    assert text == "no progress for 10 min; running: Map(write) (node 0123abcd, process 42, 20 min, attempt 2)"
    clock.now += 500
    assert values["event"] == "stall" and watch.look(last, lambda: []) == []  # not repeated before another 600 s


def test_waiting_actors_are_announced_within_a_minute(monkeypatch):
    monkeypatch.setattr(progress, "describe_cluster", lambda: "1 node with 2 CPU (free: no resources)")
    clock = Clock()
    watch = Watch(600, clock)
    assert watch.look(clock.now, lambda: ["3 Sampler"]) == []
    clock.now += 30
    ((text, _),) = watch.look(clock.now, lambda: ["3 Sampler"])
    assert text == "waiting for room: 3 Sampler. The cluster has 1 node with 2 CPU (free: no resources)"
    clock.now += 30
    assert watch.look(clock.now, lambda: ["3 Sampler"]) == []


def test_json_lines_hold_every_printed_line(monkeypatch):
    out, errors = io.StringIO(), io.StringIO()
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", errors)
    with use_log_format("json"):
        print("first", end="")
        print(" line\n\nsecond ü")
        print_event("third", {"event": "progress", "done": 3.0})
        print("error: no such file", file=sys.stderr)
        print("no end", end="")
    records = [json.loads(line) for line in out.getvalue().splitlines()]
    assert [record["message"] for record in records] == ["first line", "second ü", "third", "no end"]
    assert records[2]["done"] == 3.0 and all(time.strptime(r["time"], "%Y-%m-%dT%H:%M:%SZ") for r in records)
    (error,) = map(json.loads, errors.getvalue().splitlines())
    assert error["level"] == "error" and error["message"] == "error: no such file"
    assert sys.stdout is out and not isinstance(sys.stdout, JsonLines)


def test_traceback_is_one_json_object_without_colours(monkeypatch):
    errors = io.StringIO()
    monkeypatch.setattr(sys, "stderr", errors)
    with use_log_format("json"):
        try:
            raise KeyError("gone")
        except KeyError:
            sys.stderr.write(traceback.format_exc())
        print("\x1b[36m(worker pid=1)\x1b[0m ready", file=sys.stderr)
    error, line = map(json.loads, errors.getvalue().splitlines())
    assert error["level"] == "error" and error["message"] == "KeyError: 'gone'"
    assert error["traceback"].startswith("Traceback (most recent call last)") and "test_progress" in error["traceback"]
    assert line["level"] == "warning" and line["message"] == "(worker pid=1) ready"


@pytest.mark.parametrize(
    "name", ["MapWorker(Map(Sampler)).__init__", "MapWorker(MapBatches(Sampler)).__init__", "Sampler.__init__"]
)
def test_names_of_actors_are_short(name):
    from pipelines.runtime.cluster_state import shorten_actor_name

    assert shorten_actor_name(name) == "Sampler"


@pytest.mark.parametrize(("error", "status"), [(KeyboardInterrupt(), "KILLED"), (OSError(), "FAILED")])
def test_run_of_a_stopped_job_does_not_stay_running(monkeypatch, error, status):
    from jobs.support.tracking import Tracker

    ended: list[str] = []
    monkeypatch.setattr(Tracker, "finish", lambda self, name: ended.append(name))
    with pytest.raises(type(error)), Tracker("uri", "run").end_on_error():
        raise error
    assert ended == [status]
