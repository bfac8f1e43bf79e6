"""Parse JSON of unknown origin: only what RFC 8259 allows, and no key twice."""

from __future__ import annotations

import json
from typing import Any

from models.limits import require_within


def parse_json(content: bytes | str) -> Any:
    """Parse a JSON text.

    Args:
        content: Text, or UTF-8 bytes.

    Returns:
        Parsed value.

    Raises:
        ValueError: The text is not JSON, contains NaN, Infinity or a repeated key, is nested too deeply, or exceeds the
            limit json_bytes.
    """
    require_within("json_bytes", len(content))
    try:
        text = content if isinstance(content, str) else content.decode("utf-8-sig")
        return json.loads(
            text, parse_constant=_refuse_constant, parse_float=_parse_float, object_pairs_hook=_make_object
        )
    except RecursionError as error:
        raise ValueError("the values are nested too deeply") from error


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is not a JSON number")


def _parse_float(text: str) -> float:
    value = float(text)
    if value in (float("inf"), float("-inf")):
        raise ValueError(f"{text[:40]} exceeds the range of 64-bit numbers")
    return value


def _make_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) < len(pairs):
        seen: set[str] = set()
        twice = next(name for name, _ in pairs if name in seen or seen.add(name))
        raise ValueError(f"the key {twice[:80]!r} occurs twice in one object")
    return made
