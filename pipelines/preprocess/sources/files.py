"""Read whole files of a drive within limits. Errors name the file and the remedy."""

from __future__ import annotations

from typing import Any

from models.limits import LimitError, require_within
from models.strict_json import parse_json
from pipelines.preprocess.sources.input_paths import InputPath, find_local_file


def read_file(path: InputPath, remedy: str) -> bytes:
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
        local = find_local_file(path)
        require_within("json_bytes", local.stat().st_size, str(path))
        return local.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror}); {remedy}") from error


def read_json_file(path: InputPath, remedy: str) -> Any:
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
        return parse_json(content, allow_nan=True)
    except LimitError as error:
        raise LimitError(f"{path}: {error}") from error
    except ValueError as error:
        raise ValueError(f"{path}: broken JSON ({str(error)[:120]}); {remedy}") from error


def are_all_numbers(values: list, largest: float) -> bool:
    """Return whether all values are numbers in [-largest, largest]. NaN and true do not count as numbers."""
    return all(type(value) in (int, float) and abs(value) <= largest for value in values)
