"""Print report tables on the terminal."""

from __future__ import annotations

import sys
from typing import IO

from rich import box
from rich.console import Console
from rich.table import Table as RichTable

from pipelines.reporting.report import Table, format_cell


def print_table(table: Table, file: IO[str] | None = None) -> None:
    """Print a report's table on the terminal, or to a file with lines of 200 characters."""
    lines = RichTable(title=table.title, caption=table.note, box=box.SIMPLE)
    for name in table.columns:
        lines.add_column(name, overflow="fold")  # do not truncate long names, which may differ only at the end
    for row in table.rows:
        lines.add_row(*map(format_cell, row))
    Console(file=file, width=None if file is None and sys.stdout.isatty() else 200).print(lines)
