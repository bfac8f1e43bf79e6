"""Stop a job on SIGTERM as on Ctrl-C: leases are released, and the job says that it can be resumed."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

Handler = Callable[[int, FrameType | None], None]
_reasons: list[str] = []  # Reason for a SIGTERM that this process sends to itself.
_handlers: list[Handler] = []  # The handler that `stop_on_sigterm` has installed.


class JobStopped(KeyboardInterrupt):
    """Raised in the main thread by SIGTERM (`ray job stop`) or by `stop_job`; the message is the reason."""


@contextmanager
def stop_on_sigterm() -> Iterator[None]:
    """Raise JobStopped in the main thread when the first SIGTERM arrives; further ones are ignored.

    In other threads, and inside another body of this function, the function does nothing.
    """
    if threading.current_thread() is not threading.main_thread() or is_handled():
        yield
        return

    reason = ""

    def stop(signum: int, frame: FrameType | None) -> None:
        nonlocal reason
        signal.signal(signum, signal.SIG_IGN)  # A second one would interrupt the release of leases.
        reason = _reasons.pop() if _reasons else "the job was stopped (SIGTERM)"
        raise JobStopped(reason)

    before = signal.signal(signal.SIGTERM, stop)
    _handlers.append(stop)
    try:
        yield
    except KeyboardInterrupt as error:
        if reason and not isinstance(error, JobStopped):  # Ray Train raises another KeyboardInterrupt.
            raise JobStopped(reason) from error
        raise
    finally:
        _handlers.remove(stop)
        signal.signal(signal.SIGTERM, before)


def is_handled() -> bool:
    """Return whether SIGTERM now raises JobStopped."""
    return signal.getsignal(signal.SIGTERM) in _handlers


@contextmanager
def keep_sigterm_handler() -> Iterator[None]:
    """Keep the handler of `stop_on_sigterm`, if there is one. `ray.init` replaces it by one that ends the process."""
    handled = is_handled() and threading.current_thread() is threading.main_thread()
    try:
        yield
    finally:
        if handled:
            signal.signal(signal.SIGTERM, _handlers[-1])


def stop_job(message: str) -> None:
    """Stop this job from another thread.

    Args:
        message: Reason, which the job prints.
    """
    _reasons.append(message)
    os.kill(os.getpid(), signal.SIGTERM)
