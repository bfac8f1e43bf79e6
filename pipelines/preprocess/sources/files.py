"""Read whole files of a drive within limits. Errors name the file and the remedy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from models.limits import LimitError, require_within


def read_file(path: Path, remedy: str) -> bytes:
    """Read a regular file that has at most json_bytes bytes.

    Args:
        path: File.
        remedy: End of the error message.

    Returns:
        Content of the file.

    Raises:
        ValueError: The file is missing, is no regular file, cannot be read or exceeds the limit.
    """
    try:
        if not path.is_file():  # Reading a named pipe would never end.
            raise ValueError(f"{path} is missing or no regular file; {remedy}")
        require_within("json_bytes", path.stat().st_size, str(path))
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror}); {remedy}") from error


def read_json_file(path: Path, remedy: str) -> Any:
    """Read a JSON file. NaN and Infinity are kept, so that the caller can name their row.

    Args:
        path: File.
        remedy: End of the error message.

    Returns:
        Parsed value.

    Raises:
        ValueError: The file is missing, is not JSON, contains a repeated key, is nested too deeply or exceeds a limit.
    """
    content = read_file(path, remedy)
    try:
        require_within("json_values", sum(map(content.count, (b",", b"[", b"{", b":"))), str(path))
        return json.loads(content, object_pairs_hook=_make_object)
    except LimitError:
        raise
    except RecursionError as error:
        raise ValueError(f"{path}: broken JSON (the values are nested too deeply); {remedy}") from error
    except ValueError as error:
        raise ValueError(f"{path}: broken JSON ({str(error)[:120]}); {remedy}") from error


def _make_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) < len(pairs):
        seen: set[str] = set()
        twice = next(name for name, _ in pairs if name in seen or seen.add(name))
        raise ValueError(f"the key {twice[:40]!r} occurs twice in one object")
    return made
