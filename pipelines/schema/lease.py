"""Ensure that an output has one writer: a lease names the job that writes to it.

The directory `.leases/<name>` of the output holds one record per owner, numbered from 1. The highest number is the
current owner. A new owner creates the next number exclusively, so two jobs cannot both succeed. An owner rewrites its
record regularly. Without a change for its lifetime, the record has expired. Times are modification times of files, so
only the clock of the storage counts. Records are never numbered again, so an owner that was suspended notices a
successor.
"""

from __future__ import annotations

import json
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

from pipelines.runtime import storage
from pipelines.runtime.machines import find_start_time, identify_machine, is_process_alive
from pipelines.schema.file_names import make_file_name

LEASES = ".leases"
LIFETIME_S = 60.0
HEARTBEATS = 6  # Number of heartbeats per lifetime.
POLL_S = 2.0
IfBusy = Literal["refuse", "wait", "join"]


@dataclass(frozen=True)
class Owner:
    """Writer of an output.

    Attributes:
        job: Id of the Ray job, or the process id.
        host: Name of the driver's machine.
        machine: Result of `identify_machine`.
        process: Process id of the driver.
        start_time: Start time of the process (`find_start_time`).
    """

    job: str
    host: str
    machine: str
    process: int
    start_time: str

    @classmethod
    def of_this_process(cls, job: str = "") -> Owner:
        """Describe this process.

        Args:
            job: Id of the Ray job (default: the process id).

        Returns:
            The owner.
        """
        process = os.getpid()
        return cls(job or str(process), socket.gethostname(), identify_machine(), process, find_start_time(process))


class LeaseError(ValueError):
    """Raised if another job writes to the same output."""


class Lease:
    """The right to write to an output, from `acquire` to `release`."""

    def __init__(
        self, output: str, name: str, owner: Owner, on_lost: Callable[[str], None], lifetime_s: float = LIFETIME_S
    ) -> None:
        """Describe a lease; `acquire` obtains it.

        Args:
            output: Directory or URI.
            name: Name of the run or table that is written.
            owner: This process.
            on_lost: Called in a thread with a message if another job has taken the lease over.
            lifetime_s: Time without a heartbeat after which other jobs may take the lease over (s).
        """
        self.output, self.name, self.owner, self.on_lost = output, name, owner, on_lost
        self.lifetime_s = lifetime_s
        self.directory = storage.join_uri(output, LEASES, make_file_name(name))
        self.number = 0
        self.token = secrets.token_hex(8)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    # ------------------------------------------------------------------------------------------------ acquire

    def acquire(self, if_busy: IfBusy = "refuse", report: Callable[[str], None] = print) -> None:
        """Obtain the lease, and keep it with heartbeats from a thread.

        Args:
            if_busy: Behaviour if another job holds the lease. "refuse" raises an error. "wait" waits until the job
                ends or its lease expires. "join" waits until the job ends, and raises an error if it fails.
            report: Called with one line that names the job for which this call waits.

        Raises:
            LeaseError: Another job holds the lease, or the joined job failed.
            OSError: The output cannot be written.
        """
        waited_for = 0
        while True:
            number, record = self._read_newest()
            is_running = number > 0 and record.get("state", "running") == "running"
            is_held = is_running and not self._has_expired(number, record)
            if is_held and if_busy == "refuse":
                raise LeaseError(
                    f"{self.output}: {self._describe(record)} writes {self.name!r} here; choose another output or run,"
                    " wait for that job (--if-busy wait), or follow it (--if-busy join)"
                )
            if is_held:
                if waited_for != number:
                    report(f"waiting for {self._describe(record)}, which writes {self.name!r} to {self.output}")
                waited_for = number
                time.sleep(min(POLL_S, self.lifetime_s / HEARTBEATS))
            elif if_busy == "join" and waited_for and record.get("state") != "finished":
                state = "killed" if is_running else record["state"]
                raise LeaseError(
                    f"{self.output}: {self._describe(record)}, which this job joined, did not finish ({state}); run the"
                    " same command again to resume"
                )
            elif self._create(number + 1):
                self.number = number + 1
                self._delete_old_records()
                self._thread = threading.Thread(target=self._keep, name="lease", daemon=True)
                self._thread.start()
                return

    def _create(self, number: int) -> bool:
        """Create a record exclusively; return whether it is the newest."""
        created = storage.create_file(self._path(number), self._encode("running"))
        if not created and not self._is_own(number):
            return False
        return max(self._list_numbers(), default=number) == number

    def _is_own(self, number: int) -> bool:
        """Return whether a record is ours: a request whose first answer was lost is repeated, and then refused."""
        try:
            return storage.read_json(self._path(number)).get("token") == self.token
        except (ValueError, AttributeError):
            return False

    def _delete_old_records(self) -> None:
        for number in self._list_numbers():
            if number < self.number:
                storage.delete_file(self._path(number))

    # --------------------------------------------------------------------------------------------------- keep

    def _keep(self) -> None:
        """Rewrite the record regularly, until `release` or the loss of the lease."""
        while not self._stop.wait(self.lifetime_s / HEARTBEATS):
            try:
                if message := self._beat():
                    self.on_lost(message)
                    return
            except Exception:  # The next heartbeat may succeed; otherwise, the record expires.
                continue

    def _beat(self) -> str:
        """Rewrite the record; return a message if another job has taken the lease over."""
        newest = max(self._list_numbers(), default=0)
        if newest > self.number:
            _, record = self._read_newest()
            return (
                f"{self.output}: {self._describe(record)} has taken over {self.name!r}, because this job sent no"
                f" heartbeat for {self.lifetime_s:.0f} s"
            )
        storage.write_whole(self._path(self.number), lambda stream: stream.write(self._encode("running")))
        return ""

    def release(self, state: Literal["finished", "failed", "killed"]) -> None:
        """End the lease.

        Args:
            state: Result of the job, for jobs that joined it.
        """
        self._stop.set()
        if self._thread:
            self._thread.join()
        if max(self._list_numbers(), default=0) == self.number:
            storage.write_whole(self._path(self.number), lambda stream: stream.write(self._encode(state)))

    # ------------------------------------------------------------------------------------------------ records

    def _path(self, number: int) -> str:
        return storage.join_uri(self.directory, f"{number:08d}.json")

    def _encode(self, state: str) -> bytes:
        record = asdict(self.owner) | {"state": state, "lifetime_s": self.lifetime_s, "token": self.token}
        return json.dumps(record).encode()

    def _list_numbers(self) -> list[int]:
        names = storage.list_names(self.directory, ".json")
        return [int(name.removesuffix(".json")) for name in names if name.removesuffix(".json").isdecimal()]

    def _read_newest(self) -> tuple[int, dict[str, Any]]:
        """Return the number of the newest record and its content, or (0, {}); {} also if it is being created."""
        number = max(self._list_numbers(), default=0)
        if number == 0:
            return 0, {}
        try:
            record = storage.read_json(self._path(number))
        except ValueError:
            if max(self._list_numbers(), default=0) != number:  # A successor has deleted it.
                return self._read_newest()
            record = {}  # Its owner is creating it.
        return number, record if isinstance(record, dict) else {}

    def _has_expired(self, number: int, record: dict[str, Any]) -> bool:
        """Return whether the owner has ended, or sent no heartbeat during its lifetime by the clock of the storage."""
        machine, process, start_time = (record.get(name) for name in ("machine", "process", "start_time"))
        if isinstance(process, int) and machine == identify_machine():  # Other machines' processes are not visible.
            return not is_process_alive(process, str(start_time or ""))
        written_ns = storage.find_time_ns(self._path(number))
        return self._find_now_ns() - written_ns > 1e9 * float(record.get("lifetime_s", self.lifetime_s))

    def _find_now_ns(self) -> int:
        """Return the time by the clock of the storage."""
        probe = storage.join_uri(self.directory, f"probe-{secrets.token_hex(8)}")
        storage.write_text("", probe)
        try:
            return storage.find_time_ns(probe)
        finally:
            storage.delete_file(probe)

    @staticmethod
    def _describe(record: dict[str, Any]) -> str:
        return f"job {record.get('job', 'unknown')} on {record.get('host', 'an unknown machine')}"
