"""Print lines as text or as JSON objects (option --log-format)."""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO

TRACEBACK = "Traceback (most recent call last):"
ANSI = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")  # Colours of terminals.


class JsonLines:
    """Text stream that writes each printed line as one JSON object with time, level and message."""

    def __init__(self, stream: TextIO, level: str) -> None:
        self.stream, self.level = stream, level
        self.encoding, self.errors = stream.encoding, stream.errors
        self._rest = ""

    def write(self, text: str) -> int:
        text_ended = text.endswith("\n") and not self._rest
        if TRACEBACK in text and text_ended:  # One object, which contains the whole traceback.
            trace = ANSI.sub("", text).strip()
            self.write_event(trace.rsplit("\n", 1)[-1], {"level": "error", "traceback": trace})
            return len(text)
        *lines, self._rest = (self._rest + text).split("\n")
        for line in lines:
            if line.strip():
                self.write_event(ANSI.sub("", line.rstrip("\r")), {})
        return len(text)

    def write_event(self, message: str, values: dict[str, Any]) -> None:
        """Write one object."""
        stamp = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        level = "error" if message.startswith("error: ") else self.level
        record = {"time": stamp, "level": level, "message": message} | values
        self.stream.write(json.dumps(record, ensure_ascii=False, default=str) + "\n")
        self.stream.flush()

    def flush(self) -> None:
        self.stream.flush()

    def close_line(self) -> None:
        """Write the rest of a line without an end."""
        if self._rest.strip():
            self.write("\n")

    def isatty(self) -> bool:
        return False

    def fileno(self) -> int:
        return self.stream.fileno()


def print_event(message: str, values: dict[str, Any]) -> None:
    """Print a line; in JSON, the object also contains the values.

    Args:
        message: Text.
        values: Further values of the JSON object.
    """
    if isinstance(sys.stdout, JsonLines):
        sys.stdout.write_event(message, values)
    else:
        print(message, flush=True)


@contextmanager
def use_log_format(log_format: str) -> Iterator[None]:
    """Write all lines of standard output and standard error in a format while the body runs.

    Args:
        log_format: "text" or "json".

    Yields:
        None.
    """
    if log_format != "json":
        yield
        return
    before = sys.stdout, sys.stderr
    out, errors = JsonLines(sys.stdout, "info"), JsonLines(sys.stderr, "warning")
    sys.stdout, sys.stderr = out, errors  # type: ignore[assignment]
    try:
        yield
    finally:
        out.close_line()
        errors.close_line()
        sys.stdout, sys.stderr = before
