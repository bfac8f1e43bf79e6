"""Test of SECURITY.md."""

import re
from pathlib import Path

from models.limits import LIMITS

ROOT = Path(__file__).parents[2]


def test_security_page_lists_limits():
    text = (ROOT / "SECURITY.md").read_text()
    listed = {
        name.lower(): (value, meaning)
        for name, value, meaning in re.findall(r"\| ([A-Z_]+) \| ([\d,]+) \| (.*) \|", text)
    }
    assert listed == {name: (f"{limit.value:,}", limit.meaning) for name, limit in LIMITS.items()}
