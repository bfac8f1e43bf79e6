"""Stop a job on SIGTERM as on Ctrl-C: leases are released, and the job says that it can be resumed."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_reasons: list[str] = []  # Reason for a SIGTERM that this process sends to itself.


class JobStopped(KeyboardInterrupt):
    """Raised in the main thread by SIGTERM (`ray job stop`) or by the loss of a lease; the message is the reason."""


@contextmanager
def stop_on_sigterm() -> Iterator[None]:
    """Raise JobStopped in the main thread when SIGTERM arrives. In other threads, this function does nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    reason = ""

    def stop(signum: int, frame: FrameType | None) -> None:
        nonlocal reason
        reason = _reasons.pop() if _reasons else "the job was stopped (SIGTERM)"
        raise JobStopped(reason)

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    except KeyboardInterrupt as error:
        if reason and not isinstance(error, JobStopped):  # Ray Train raises another KeyboardInterrupt.
            raise JobStopped(reason) from error
        raise
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def keep_sigterm_handler() -> Iterator[None]:
    """Restore the handler of SIGTERM after the body. `ray.init` replaces it by one that ends the process."""
    handler = signal.getsignal(signal.SIGTERM)
    yield
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)


def stop_job(message: str) -> None:
    """Stop this job from another thread.

    Args:
        message: Reason, which the job prints.
    """
    _reasons.append(message)
    os.kill(os.getpid(), signal.SIGTERM)
