"""Parse JSON of unknown origin: only what RFC 8259 allows, and no key twice."""

from __future__ import annotations

import json
from typing import Any

from models.limits import require_within


def parse_json(content: bytes, allow_nan: bool = False) -> Any:
    """Parse a JSON text.

    Args:
        content: UTF-8 bytes.
        allow_nan: Whether to accept NaN, Infinity and numbers beyond the range of 64 bits, so that the caller can name
            their row.

    Returns:
        Parsed value.

    Raises:
        LimitError: The text exceeds the limit json_bytes or json_values.
        ValueError: The text is not JSON, contains a repeated key or, unless `allow_nan`, NaN or Infinity, or is nested
            too deeply.
    """
    require_within("json_bytes", len(content))
    # Each value of a JSON text needs up to a hundred times more memory than its text.
    require_within("json_values", sum(map(content.count, (b",", b"[", b"{", b":"))))
    strict: dict[str, Any] = {} if allow_nan else {"parse_constant": _refuse_constant, "parse_float": _parse_float}
    try:
        return json.loads(content.decode("utf-8-sig"), object_pairs_hook=_make_object, **strict)
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
