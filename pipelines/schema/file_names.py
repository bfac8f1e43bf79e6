"""Convert untrusted texts of tables to safe names of files and directories, and to text for XML files."""

from __future__ import annotations

import hashlib
import re

MAX_CHARACTERS = 120  # A name has at most this length before its suffix. File systems allow 255 bytes.
UNSAFE = re.compile(r"[^A-Za-z0-9._+=@,-]")
NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # Characters that XML 1.0 forbids.


def make_file_name(name: str) -> str:
    """Return a name for a file or a directory that stays inside its directory.

    A name of at most 120 ASCII letters, digits and characters of `._+=@,-` that does not begin with "." is kept. In any
    other name, each other character becomes "-", and "~" and a hash of the original name follow. On file systems that
    distinguish case, different names give different files.

    Args:
        name: Id from a table, such as a scene id, without a suffix.

    Returns:
        A name that is neither empty nor "." nor "..", does not begin with "." and contains no separator.
    """
    if name and not name.startswith(".") and len(name) <= MAX_CHARACTERS and not UNSAFE.search(name):
        return name
    kept = UNSAFE.sub("-", name)[:MAX_CHARACTERS].lstrip(".")
    return f"{kept or 'unnamed'}~{hashlib.sha256(name.encode('utf-8', 'surrogatepass')).hexdigest()[:12]}"


def clean_xml_text(text: str) -> str:
    """Replace the characters that XML 1.0 forbids, such as control characters.

    Args:
        text: Text from a table.

    Returns:
        Text that an XML file can hold; each forbidden character is replaced by U+FFFD.
    """
    return NOT_XML.sub("\ufffd", text)
