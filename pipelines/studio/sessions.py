"""Sessions of the visitors: a scene with undo history each, bounded in number, size and age."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from models.scene import Scene
from pipelines.editing.edit import Edit
from pipelines.studio.limits import StudioError, StudioLimits
from pipelines.studio.tasks import BackgroundTask

PRIMITIVE_BYTES = 300  # Approximate size of one primitive in memory, including its label (bytes).
EDIT_BYTES = 1_000
MAX_HISTORY = 200  # Maximum number of operations to undo, if their states fit into the session.


class State(NamedTuple):
    """One state of a session: the scene, and the edits since the scene was opened or generated."""

    scene: Scene | None = None
    edits: tuple[Edit, ...] = ()


@dataclass(eq=False)
class Session:
    """The scene of a visitor, with earlier states and undone states.

    Attributes:
        state: Current state.
        past: Earlier states with the name of the operation that followed.
        future: Undone states with the name of the operation that led to them.
        task: Last task.
        used_s: Time of the last request (s).
        shown: Description of the current scene for the page, as JSON, or None.
        ground: Heights, masks and description of a ground that was shown, because edits keep the ground.
        size: Size of all states (bytes).
        lock: Lock for operations that change the session.
    """

    state: State = field(default_factory=State)
    past: list[tuple[str, State]] = field(default_factory=list)
    future: list[tuple[str, State]] = field(default_factory=list)
    task: BackgroundTask | None = None
    used_s: float = 0.0
    shown: bytes | None = None
    ground: tuple[np.ndarray, np.ndarray, dict] | None = None
    size: int = 0
    lock: threading.RLock = field(default_factory=threading.RLock)

    def put(self, name: str, scene: Scene, edits: tuple[Edit, ...], session_bytes: int) -> None:
        """Store the state that results from an operation called `name`, and drop the oldest states if necessary.

        Args:
            name: Name of the operation.
            scene: New scene.
            edits: Edits since the scene was opened or generated.
            session_bytes: Maximum size of the session (bytes).

        Raises:
            StudioError: The scene alone exceeds the maximum size.
        """
        with self.lock:
            state = State(scene, edits)
            if (size := measure_bytes([state])) > session_bytes:
                raise StudioError(
                    f"the scene needs {size / 2**20:.0f} MiB, and a session has {session_bytes / 2**20:.0f} MiB; use"
                    " jobs/edit_scenes.py or jobs/outpaint_scenes.py"
                )
            self.past = [*self.past, (name, self.state)][-MAX_HISTORY:]
            self.state, self.future, self.shown = state, [], None
            while (size := self.measure_bytes()) > session_bytes and self.past:
                self.past = self.past[1 + len(self.past) // 8 :]
            self.size = size

    def drop_history(self) -> None:
        """Drop earlier and undone states."""
        with self.lock:
            self.past, self.future = [], []
            self.size = self.measure_bytes()

    def restore(self, state: State) -> None:
        """Replace the current state, without a history."""
        with self.lock:
            self.state, self.shown = state, None
            self.drop_history()

    def undo(self) -> None:
        """Restore the state before the last operation."""
        with self.lock:
            if self.past:
                name, state = self.past.pop()
                self.future.append((name, self.state))
                self.state, self.shown = state, None

    def redo(self) -> None:
        """Restore the last undone state."""
        with self.lock:
            if self.future:
                name, state = self.future.pop()
                self.past.append((name, self.state))
                self.state, self.shown = state, None

    def require_scene(self) -> Scene:
        """Return the current scene. Raises StudioError if no scene is open."""
        if self.state.scene is None:
            raise StudioError("no scene is open; open or generate one first")
        return self.state.scene

    def require_idle(self, status: int = 409) -> Session:
        """Return the session. Raises StudioError with a status if a task of the visitor is running."""
        if self.is_busy():
            raise StudioError("your last task is still running; wait for it or cancel it", status)
        return self

    def is_busy(self) -> bool:
        """Return whether a task of the visitor is waiting or running."""
        return self.task is not None and not self.task.finished

    def measure_bytes(self) -> int:
        """Return the size of all states; an array that several states share counts once."""
        states = [state for _, state in (*self.past, *self.future)]
        return measure_bytes([*states, self.state]) + len(self.shown or b"")


def measure_bytes(states: list[State]) -> int:
    """Return the approximate size of states in memory (bytes); an array that several states share counts once."""
    arrays = {}
    total = 0
    for scene, edits in states:
        total += EDIT_BYTES * len(edits)
        if scene is not None:
            total += PRIMITIVE_BYTES * len(scene)
            arrays |= {id(array): array.nbytes for array in map(find_owner, (scene.height_m, scene.occupied))}
    return total + sum(arrays.values())


def find_owner(array: np.ndarray) -> np.ndarray:
    """Return the array that owns the memory of a view."""
    while isinstance(array.base, np.ndarray):
        array = array.base
    return array


class SessionStore:
    """The sessions of all visitors."""

    def __init__(self, limits: StudioLimits, clock: Callable[[], float] = time.monotonic) -> None:
        """Make an empty store.

        Args:
            limits: Limits of the number, size and age of sessions.
            clock: Function that returns the time (s).
        """
        self.limits, self.clock = limits, clock
        self.sessions: OrderedDict[str, Session] = OrderedDict()  # The least recently used session comes first.
        self.lock = threading.Lock()

    def open(self, visitor: str) -> Session:
        """Return the session of a visitor. A visitor without a session gets a new one.

        Raises:
            StudioError: There are too many sessions, and all of them were used recently.
        """
        now, limits = self.clock(), self.limits
        with self.lock:
            self._delete(limits.idle_s, now)
            if visitor not in self.sessions and len(self.sessions) >= limits.max_sessions:
                self._delete(limits.protected_s, now, len(self.sessions) - limits.max_sessions + 1)
                if len(self.sessions) >= limits.max_sessions:
                    raise StudioError(f"the studio is full ({limits.max_sessions} visitors); try again later", 429, 60)
            session = self.sessions.setdefault(visitor, Session())
            self.sessions.move_to_end(visitor)
            session.used_s = now
            return session

    def _delete(self, idle_s: float, now: float, most: int | None = None) -> None:
        """Delete at most `most` sessions that were idle for `idle_s`, the least recently used first."""
        old = [name for name, one in self.sessions.items() if now - one.used_s >= idle_s and not one.is_busy()]
        for name in old[:most]:
            del self.sessions[name]

    def trim(self, current: Session) -> None:
        """Make all sessions fit into `total_bytes` after an operation of one session.

        The undo histories of the least recently used sessions are dropped first, then sessions that are idle for
        `protected_s`, then the history of `current`. If this is not enough, the operation is undone.

        Args:
            current: Session that has changed.

        Raises:
            StudioError: The sessions do not fit.
        """
        with self.lock:
            excess = sum(session.size for session in self.sessions.values()) - self.limits.total_bytes
            for session in list(self.sessions.values()):
                if excess > 0 and session is not current:
                    before = session.size
                    session.drop_history()
                    excess -= before - session.size
            for name, session in list(self.sessions.items()):
                is_idle = self.clock() - session.used_s >= self.limits.protected_s and not session.is_busy()
                if excess > 0 and is_idle and session is not current:
                    excess -= session.size
                    del self.sessions[name]
            if excess > 0:
                previous = current.past[-1][1] if current.past else State()
                before = current.size
                current.drop_history()
                excess -= before - current.size
            if excess > 0:
                current.restore(previous)
                raise StudioError("the memory of the studio is full; try again later", 429, 60)
