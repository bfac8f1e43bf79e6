"""Identify this machine and its processes, so that files in shared storage can name their writer."""

from __future__ import annotations

import hashlib
import os
import socket
from functools import lru_cache
from pathlib import Path

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
MEMORY, CONTROL_GROUP = Path("/proc/meminfo"), Path("/sys/fs/cgroup")
PROCESSES = Path("/proc/self/ns/pid")  # Containers of one machine have different process ids.


@lru_cache(maxsize=1)
def identify_machine() -> str:
    """Return 12 hexadecimal digits that differ between machines, between containers and after a restart.

    Two processes with the same result see each other's process ids.
    """
    parts = [socket.gethostname()]
    try:
        parts += [BOOT_ID.read_text().strip(), os.readlink(PROCESSES)]
    except OSError:  # not Linux
        import uuid

        parts += [str(uuid.getnode())]
    return hashlib.sha256("/".join(parts).encode()).hexdigest()[:12]


def find_start_time(process: int) -> str:
    """Return the start time of a process in ticks of the kernel, or "" if it is unknown.

    A process id can be used again after its process has ended. The start time differs.
    """
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return ""


def is_process_alive(process: int, start_time: str = "") -> bool:
    """Return whether a process of this machine exists.

    Args:
        process: Process id.
        start_time: Result of `find_start_time` when the process ran; "" accepts every process with this id.

    Returns:
        False if the process has ended.
    """
    if start_time and find_start_time(process) != start_time:
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):  # a process of another user; no such id can exist
        return process < 2**31
    return True


def find_available_bytes() -> float:
    """Return the memory in bytes that new processes of this container can use, or infinity if it is unknown.

    Returns:
        The smaller of the available memory of the machine and the free part of the limit of the container.
    """
    found = [float("inf")]
    try:
        lines = MEMORY.read_text().splitlines()
        found += [1024.0 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
        limit, used = ((CONTROL_GROUP / name).read_text().strip() for name in ("memory.max", "memory.current"))
        found += [float(limit) - float(used)] if limit != "max" else []
    except (OSError, ValueError, IndexError):  # not Linux, or no limit
        pass
    return max(min(found), 0.0)
