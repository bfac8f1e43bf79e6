"""Check the entries of configs of unknown origin: types and ranges, before a value is used.

A config is JSON that another person may have written. Each function raises a ValueError that names entry, value and
expected range. No function converts a value: True is no integer, and "3" is no number.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

SHOWN_LETTERS = 60


def show_value(value: object) -> str:
    """Return a value as text for an error message, at most SHOWN_LETTERS characters.

    Args:
        value: Any parsed JSON value.

    Returns:
        Python notation of the value, shortened if necessary.
    """
    if type(value) is int and abs(value) >= 10**SHOWN_LETTERS:  # Python cannot convert thousands of digits to text.
        return f"an integer of more than {SHOWN_LETTERS} digits"
    if isinstance(value, str):
        value = value[: SHOWN_LETTERS + 1]
    elif isinstance(value, list | tuple | dict) and len(value) > SHOWN_LETTERS:
        return f"a {type(value).__name__} of {len(value)} entries"
    try:
        shown = repr(value)
    except (ValueError, RecursionError):  # A nested integer has too many digits, or the nesting is too deep.
        return f"a {type(value).__name__}"
    return shown if len(shown) <= SHOWN_LETTERS else f"{shown[: SHOWN_LETTERS - 3]}..."


@dataclass(frozen=True)
class Integer:
    """Rule: an integer in [low, high]."""

    low: int
    high: int


@dataclass(frozen=True)
class Number:
    """Rule: a finite number in [low, high]."""

    low: float
    high: float


@dataclass(frozen=True)
class Choice:
    """Rule: one of several texts."""

    choices: Sequence[str]


@dataclass(frozen=True)
class Flag:
    """Rule: true or false."""


@dataclass(frozen=True)
class Text:
    """Rule: a text of at most `letters` characters."""

    letters: int = 200


@dataclass(frozen=True)
class Sequential:
    """Rule: a list of `low` to `high` entries that all obey the rule `entry`."""

    entry: Rule
    low: int
    high: int


Rule = Integer | Number | Choice | Flag | Text | Sequential

LARGE = 1e6  # Largest accepted coordinate, bound, shift or scale in a config.
FINITE = Number(-LARGE, LARGE)


def check_entry(name: str, value: Any, rule: Rule) -> None:
    """Check a value of a config.

    Args:
        name: Name of the entry, for the message.
        value: Parsed JSON value.
        rule: Rule of the entry.

    Raises:
        ValueError: The value does not obey the rule.
    """
    match rule:
        case Integer(low, high):
            valid, expected = type(value) is int and low <= value <= high, f"an integer from {low} to {high}"
        case Number(low, high):
            is_number = isinstance(value, int | float) and type(value) is not bool
            valid, expected = is_number and low <= value <= high, f"a number from {low:g} to {high:g}"
        case Choice(choices):
            valid, expected = type(value) is str and value in choices, f"one of: {', '.join(choices)}"
        case Flag():
            valid, expected = type(value) is bool, "true or false"
        case Text(letters):
            valid, expected = type(value) is str and len(value) <= letters, f"a text of at most {letters} characters"
        case Sequential(entry, low, high):
            valid = isinstance(value, list | tuple) and low <= len(value) <= high
            expected = f"a list of {low if low == high else f'{low} to {high}'} entries"
            if valid:
                for k, part in enumerate(value):
                    check_entry(f"{name}[{k}]", part, entry)
    if not valid:
        raise ValueError(f"{name} is {show_value(value)}, expected {expected}")


def check_entries(
    values: object, rules: Mapping[str, Rule], place: str = "", required: Sequence[str] = (), others: bool = False
) -> None:
    """Check that a value is an object whose entries are known and obey their rules.

    Args:
        values: Parsed JSON value.
        rules: Rule of each known entry.
        place: Name of the object; it precedes the names of its entries in messages.
        required: Entries that must be present.
        others: Whether unknown entries are accepted.

    Raises:
        ValueError: The value is not an object, an entry is unknown or missing, or an entry has an invalid value.
    """
    if not isinstance(values, Mapping):
        raise ValueError(f"{place or 'the config'} is {show_value(values)}, expected an object")
    prefix = f"{place}." if place else ""
    for name in required:
        if name not in values:
            raise ValueError(f"{prefix}{name} is missing")
    for name, value in values.items():
        if name in rules:
            check_entry(f"{prefix}{name}", value, rules[name])
        elif not others:
            raise ValueError(f"{prefix}{show_value(name)} is unknown, expected some of: {', '.join(rules)}")
