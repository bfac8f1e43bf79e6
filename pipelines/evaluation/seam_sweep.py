"""Compare the visibility of seams between settings of RePaint and guidance, for `jobs/sweep_seams.py`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from models.sampling.repaint import InpaintingConfig, RePaintConfig
from models.scene import VEGETATION, Scene
from pipelines.evaluation.seams import MEANINGS
from pipelines.metrics.intervals import Estimate
from pipelines.metrics.seams import MEASURES
from pipelines.reporting.report import Picture, Pictures, Section, Table, Text, render_report_html


def count_objects_per_ha(scenes: Iterable[Scene]) -> float:
    """Return the number of objects per hectare in the scenes; vegetation is not counted."""
    objects, area_m2 = 0, 0.0
    for scene in scenes:
        objects += int((~np.isin(scene.category, VEGETATION)).sum())
        area_m2 += scene.grid.rows * scene.grid.cols * scene.grid.resolution_m**2
    return objects / area_m2 * 10_000


def make_seam_row(
    mode: str,
    repaint: InpaintingConfig | None,
    seams: int,
    objects_per_ha: float | None,
    ratios: Mapping[str, Estimate | None],
) -> dict:
    """Make the row of one setting: options, cost per block, and ratios with intervals. Unknown values are None.

    Real scenes have no options (`repaint` is None); their `mode` is a description.
    """
    of_repaint = repaint if isinstance(repaint, RePaintConfig) else None
    row = {
        "neighbour_latents": mode,
        "steps": repaint and repaint.num_inference_steps,
        "jump_length": of_repaint and of_repaint.jump_length,
        "resamplings": of_repaint and of_repaint.resamplings,
        "known_guidance": of_repaint and of_repaint.pseudoinverse_guidance,
        "eta": of_repaint and of_repaint.eta,
        "evaluations": repaint and repaint.num_evaluations,
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

    names = (
        "neighbour_latents",
        "steps",
        "jump_length",
        "resamplings",
        "known_guidance",
        "eta",
        "evaluations",
        "objects_per_ha",
        "seams",
    )
    rounded = [{**row, "objects_per_ha": row["objects_per_ha"] and round(row["objects_per_ha"])} for row in rows]
    cells = [(*(row[name] for name in names), *(shown(row, name) for name in MEASURES)) for row in rounded]
    columns = (
        "neighbour latents",
        "steps",
        "jump length",
        "resamplings",
        "guidance",
        "eta",
        "network evaluations per block",
        "objects per hectare",
        "seams",
        *(name.replace("_", " ") for name in MEASURES),
    )
    note = (
        "A ratio of 1 means that seams are invisible. Brackets contain 95 % bootstrap intervals over scenes. With "
        "pseudo-inverse guidance, one evaluation costs about as much as two evaluations without it. Objects exclude "
        "vegetation."
    )
    return Table("Seam ratios", columns, cells, note=note)


def render_seam_sweep_html(rows: Sequence[Mapping], pictures: Sequence[Picture], how: Sequence[str]) -> str:
    """Render the page. `pictures` show the first scene of each row."""
    meanings = [f"{name.replace('_', ' ').capitalize()}: {words}." for name, words in MEANINGS.items()]
    sections: list[Section] = [build_seam_table(rows), Pictures("Generated scenes", pictures, columns=3)]
    sections.append(Text("Method", [*how, *meanings]))
    return render_report_html("Seams by sampling effort", sections)
