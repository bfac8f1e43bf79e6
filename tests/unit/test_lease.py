"""Tests of leases: an output has one writer, also if a writer was killed or clocks differ."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest

from pipelines.runtime import machines, storage
from pipelines.schema.lease import Lease, LeaseError, Owner

ELSEWHERE = {"machine": "0" * 12, "host": "other"}


def make_lease(output: Path, job: str, lifetime_s: float = 60.0, lost: list[str] | None = None, **changes) -> Lease:
    owner = replace(Owner.of_this_process(job), **changes)
    return Lease(str(output), "run", owner, (lost if lost is not None else []).append, lifetime_s)


def test_second_writer_is_refused_with_the_job_of_the_first(tmp_path):
    first = make_lease(tmp_path, "job-1")
    first.acquire()
    with pytest.raises(LeaseError, match=r"job job-1 on .* writes 'run' here.*--if-busy wait"):
        make_lease(tmp_path, "job-2").acquire()
    Lease(str(tmp_path), "another run", Owner.of_this_process("job-3"), print).acquire()
    first.release("finished")
    second = make_lease(tmp_path, "job-2")
    second.acquire()
    second.release("finished")
    assert second.number == 2


def test_of_many_concurrent_writers_one_acquires(tmp_path):
    outcomes: list[str] = []

    def acquire(number: int) -> None:
        try:
            make_lease(tmp_path, f"job-{number}", **ELSEWHERE).acquire()
            outcomes.append("acquired")
        except LeaseError:
            outcomes.append("refused")

    threads = [threading.Thread(target=acquire, args=(k,)) for k in range(16)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert outcomes.count("acquired") == 1 and outcomes.count("refused") == 15


@pytest.mark.parametrize("state", ["finished", "failed"])
@pytest.mark.parametrize("if_busy", ["wait", "join"])
def test_waiting_writer_continues_when_the_first_ends(tmp_path, if_busy, state):
    first, second, lines = make_lease(tmp_path, "job-1", 3.0), make_lease(tmp_path, "job-2", 3.0), []
    first.acquire()
    timer = threading.Timer(0.7, first.release, [state])
    timer.start()
    if (if_busy, state) == ("join", "failed"):
        with pytest.raises(LeaseError, match=r"job job-1 .*did not finish \(failed\); run the same command again"):
            second.acquire(if_busy, lines.append)
    else:
        second.acquire(if_busy, lines.append)
        second.release("finished")
    timer.join()
    assert len(lines) == 1 and "waiting for job job-1" in lines[0]


def test_killed_writer_of_this_machine_is_replaced_immediately(tmp_path):
    code = (
        "import os, sys; from pipelines.schema.lease import Lease, Owner;"
        "Lease(sys.argv[1], 'run', Owner.of_this_process('killed'), print).acquire(); os.kill(os.getpid(), 9)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)])
    assert done.returncode == -9
    with_lease = make_lease(tmp_path, "job-2")
    with_lease.acquire()
    with_lease.release("finished")


def test_silent_writer_expires_by_the_clock_of_storage(tmp_path, monkeypatch):
    """The clocks of the two machines differ by an hour."""
    lost: list[str] = []
    silent = make_lease(tmp_path, "job-1", 0.6, lost, **ELSEWHERE)
    silent._keep = lambda: None
    silent.acquire()
    monkeypatch.setattr(time, "time", lambda: 3600.0)
    other = make_lease(tmp_path, "job-2", 0.6)
    with pytest.raises(LeaseError):
        other.acquire()
    time.sleep(0.8)
    other.acquire()
    assert "job job-2" in silent._beat()  # The silent writer notices its successor.
    silent.release("finished")
    with pytest.raises(LeaseError, match="job job-2"):
        make_lease(tmp_path, "job-3").acquire()
    other.release("finished")


def test_heartbeat_keeps_the_lease_and_reports_its_loss(tmp_path):
    lost: list[str] = []
    lease = make_lease(tmp_path, "job-1", 0.6, lost, **ELSEWHERE)
    lease.acquire()
    time.sleep(1.2)
    with pytest.raises(LeaseError, match="job job-1"):
        make_lease(tmp_path, "job-2").acquire()
    assert make_lease(tmp_path, "job-2", **ELSEWHERE)._create(2)  # as if it had seen an expired lease
    time.sleep(0.4)
    assert len(lost) == 1 and "job-2" in lost[0]
    lease.release("killed")


def test_process_ids_are_recognised_after_reuse():
    assert machines.is_process_alive(os.getpid(), machines.find_start_time(os.getpid()))
    assert not machines.is_process_alive(os.getpid(), "1")
    assert not machines.is_process_alive(2**31 - 1)


def test_sigterm_stops_the_job_and_ends_its_lease_as_killed(tmp_path):
    from jobs.support.outputs import hold_lease
    from jobs.support.stopping import JobStopped

    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(JobStopped, match=r"the job was stopped \(SIGTERM\)"), hold_lease(str(tmp_path), "run"):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(30)
    assert signal.getsignal(signal.SIGTERM) == before
    (record,) = tmp_path.glob(".leases/*/*.json")
    assert json.loads(record.read_text())["state"] == "killed"
    joined = make_lease(tmp_path, "job-2")
    joined.acquire("join")  # An ended job is not waited for.
    joined.release("finished")


def test_second_sigterm_does_not_interrupt_the_cleanup():
    from jobs.support.stopping import JobStopped, keep_sigterm_handler, stop_on_sigterm

    cleaned, before = [], signal.getsignal(signal.SIGTERM)  # Ray's, if an earlier test has connected this process.
    with pytest.raises(JobStopped), stop_on_sigterm():
        with keep_sigterm_handler():  # As around `ray.init`, which replaces the handler.
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
        try:
            with stop_on_sigterm():  # A part of the job.
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(30)
        finally:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.2)
            cleaned.append(True)
    assert cleaned == [True] and signal.getsignal(signal.SIGTERM) == before


def test_repeated_request_of_the_same_writer_is_no_conflict(tmp_path, monkeypatch):
    """Object storage stored the record, but its answer was lost: the client repeats the request, which is refused."""
    create = storage.create_file
    monkeypatch.setattr(storage, "create_file", lambda *arguments: create(*arguments) and create(*arguments))
    lease = make_lease(tmp_path, "job-1")
    lease.acquire()
    with pytest.raises(LeaseError, match="job job-1"):
        make_lease(tmp_path, "job-2").acquire()
    lease.release("finished")


def test_record_that_a_successor_deletes_is_read_again(tmp_path, monkeypatch):
    first = make_lease(tmp_path, "job-1")
    first.acquire()
    first.release("killed")
    read, successor = storage.read_json, make_lease(tmp_path, "job-2")

    def read_late(path: str):
        monkeypatch.setattr(storage, "read_json", read)
        successor.acquire()  # deletes the record of the first job
        return read(path)

    reader = make_lease(tmp_path, "job-3")
    monkeypatch.setattr(storage, "read_json", read_late)
    number, record = reader._read_newest()
    assert (number, record["job"]) == (2, "job-2")
    successor.release("finished")
