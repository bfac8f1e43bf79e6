"""Limits of the studio: how much memory and computing time visitors may use."""

from __future__ import annotations

from dataclasses import dataclass


class StudioError(ValueError):
    """An error whose message a visitor may read. It names no path of the server.

    Attributes:
        status: HTTP status of the response.
        retry_after_s: Seconds after which the visitor should try again; 0 means no advice.
    """

    def __init__(self, message: str, status: int = 400, retry_after_s: int = 0) -> None:
        super().__init__(message)
        self.status, self.retry_after_s = status, retry_after_s


@dataclass(frozen=True)
class StudioLimits:
    """Limits of one studio.

    Attributes:
        max_sessions: Maximum number of visitors with a session.
        idle_s: A session that is idle for this time (s) is deleted.
        protected_s: If there are too many sessions, a session may be replaced after this idle time (s).
        session_bytes: Maximum size of the scene and the undo history of one session (bytes).
        total_bytes: Maximum size of all sessions (bytes).
        max_waiting: Maximum number of waiting tasks.
        request_evaluations: Maximum number of network evaluations per request, counted per block.
        visitor_evaluations: Maximum number of network evaluations per visitor and hour.
        max_area_m2: Maximum area of a scene (m²).
        max_primitives: Maximum number of primitives of a scene.
        max_edits: Maximum number of edits since a scene was opened or generated.
    """

    max_sessions: int = 256
    idle_s: float = 2 * 3600
    protected_s: float = 15 * 60
    session_bytes: int = 64 * 2**20
    total_bytes: int = 2**29
    max_waiting: int = 16
    request_evaluations: int = 4_000
    visitor_evaluations: int = 20_000
    max_area_m2: float = 65_536
    max_primitives: int = 20_000
    max_edits: int = 2_000
