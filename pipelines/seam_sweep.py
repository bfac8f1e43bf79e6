"""How much seams show by steps, roll-back, resamplings and guidance: rows, table and page of `jobs/sweep_seams.py`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from models.pipeline import Resampling
from pipelines.metrics.intervals import Estimate
from pipelines.metrics.seams import MEASURES
from pipelines.report import Picture, Pictures, Table, Text, report_html
from pipelines.seams import MEANINGS


def seam_row(resampling: Resampling, seams: int, ratios: Mapping[str, Estimate | None]) -> dict:
    """One row: the setting, what a block costs, and each ratio with the ends of its interval; None where there is none."""
    row = {
        "steps": resampling.num_steps,
        "jump_length": resampling.jump_length,
        "resamplings": resampling.resamplings,
        "known_guidance": resampling.known_guidance,
        "evaluations": resampling.evaluations,
        "seams": seams,
    }
    for name in MEASURES:
        value, low, high = ratios[name] or (None, None, None)
        row |= {name: value, f"{name}_low": low, f"{name}_high": high}
    return row


def seam_table(rows: Sequence[Mapping]) -> Table:
    def shown(row: Mapping, name: str) -> str | None:
        return None if row[name] is None else f"{row[name]:.2f} ({row[f'{name}_low']:.2f} to {row[f'{name}_high']:.2f})"

    names = ("steps", "jump_length", "resamplings", "known_guidance", "evaluations", "seams")
    cells = [(*(row[name] for name in names), *(shown(row, name) for name in MEASURES)) for row in rows]
    columns = (
        "steps",
        "jump length",
        "resamplings",
        "known guidance",
        "evaluations a block",
        "seams",
        *(name.replace("_", " ") for name in MEASURES),
    )
    note = "1: the line does not show. In brackets: 95 % bootstrap intervals over scenes. With guidance an evaluation costs about two."
    return Table("Across seams over nearby lines", columns, cells, note=note)


def seam_sweep_html(rows: Sequence[Mapping], pictures: Sequence[Picture], how: Sequence[str]) -> str:
    """The page; `pictures` are the first scene of every row."""
    meanings = [f"{name.replace('_', ' ').capitalize()}: {words}." for name, words in MEANINGS.items()]
    sections = [seam_table(rows), Pictures("Scenes", pictures, columns=3), Text("How", [*how, *meanings])]
    return report_html("Seams by effort", sections)
