"""How much seams show by steps, roll-back, resamplings and guidance: rows, table and page of `jobs/sweep_seams.py`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from models.sampling.repaint import RePaintConfig
from models.scene import VEGETATION, Scene
from pipelines.evaluation.seams import MEANINGS
from pipelines.metrics.intervals import Estimate
from pipelines.metrics.seams import MEASURES
from pipelines.reporting.report import Picture, Pictures, Table, Text, render_report_html


def count_objects_per_ha(scenes: Iterable[Scene]) -> float:
    """How many objects other than plants stand on a hectare of all the ground that scenes cover."""
    objects, area_m2 = 0, 0.0
    for scene in scenes:
        objects += int((~np.isin(scene.category, VEGETATION)).sum())
        area_m2 += scene.grid.rows * scene.grid.cols * scene.grid.resolution_m**2
    return objects / area_m2 * 10_000


def make_seam_row(
    repaint: RePaintConfig, seams: int, objects_per_ha: float, ratios: Mapping[str, Estimate | None]
) -> dict:
    """Make one row: the setting, the cost of a block, and each ratio with the ends of its interval; None if unknown."""
    row = {
        "steps": repaint.num_inference_steps,
        "jump_length": repaint.jump_length,
        "resamplings": repaint.resamplings,
        "known_guidance": repaint.pseudoinverse_guidance,
        "eta": repaint.eta,
        "evaluations": repaint.num_evaluations,
        "objects_per_ha": objects_per_ha,
        "seams": seams,
    }
    for name in MEASURES:
        value, low, high = ratios[name] or (None, None, None)
        row |= {name: value, f"{name}_low": low, f"{name}_high": high}
    return row


def build_seam_table(rows: Sequence[Mapping]) -> Table:
    def shown(row: Mapping, name: str) -> str | None:
        return None if row[name] is None else f"{row[name]:.2f} ({row[f'{name}_low']:.2f} to {row[f'{name}_high']:.2f})"

    names = ("steps", "jump_length", "resamplings", "known_guidance", "eta", "evaluations", "objects_per_ha", "seams")
    rounded = [{**row, "objects_per_ha": round(row["objects_per_ha"])} for row in rows]
    cells = [(*(row[name] for name in names), *(shown(row, name) for name in MEASURES)) for row in rounded]
    columns = (
        "steps",
        "jump length",
        "resamplings",
        "known guidance",
        "eta",
        "evaluations a block",
        "objects a hectare",
        "seams",
        *(name.replace("_", " ") for name in MEASURES),
    )
    note = (
        "1: the line does not show. In brackets: 95 % bootstrap intervals over scenes. With guidance an evaluation "
        "costs about two. Objects: all but plants."
    )
    return Table("Across seams over nearby lines", columns, cells, note=note)


def render_seam_sweep_html(rows: Sequence[Mapping], pictures: Sequence[Picture], how: Sequence[str]) -> str:
    """Render the page; `pictures` are the first scene of every row."""
    meanings = [f"{name.replace('_', ' ').capitalize()}: {words}." for name, words in MEANINGS.items()]
    sections = [build_seam_table(rows), Pictures("Scenes", pictures, columns=3), Text("How", [*how, *meanings])]
    return render_report_html("Seams by effort", sections)
