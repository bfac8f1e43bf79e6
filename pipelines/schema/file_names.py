"""Make names of files and directories from ids of scenes, sequences and other names in tables, which may be hostile."""

from __future__ import annotations

import hashlib
import re

MAX_LETTERS = 120  # A name has at most this length before its suffix. File systems allow 255 bytes.
UNSAFE = re.compile(r"[^A-Za-z0-9._+=@,-]")


def make_file_name(name: str) -> str:
    """Return a name for a file or a directory that stays inside its directory, on every operating system.

    Names of ASCII letters, digits and some punctuation are kept. In other names, each other character becomes "-", and
    "~" and a hash of the whole name follow. Different names therefore never share a file.

    Args:
        name: Id from a table, such as a scene id, without a suffix.

    Returns:
        A name that is neither empty nor "." nor "..", does not begin with "." and contains no separator.
    """
    if name and not name.startswith(".") and len(name) <= MAX_LETTERS and not UNSAFE.search(name):
        return name
    kept = UNSAFE.sub("-", name)[:MAX_LETTERS].lstrip(".")
    return f"{kept or 'unnamed'}~{hashlib.sha256(name.encode('utf-8', 'surrogatepass')).hexdigest()[:12]}"
