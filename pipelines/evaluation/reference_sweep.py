"""Measure how the number of reference scenes and their selection by pose affect precision and recall.

The supplement of the paper studies this effect (Precision and Recall Metrics, and the figure on sampling strategies).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pipelines.evaluation.evaluate import compute_neighbourhood_scores
from pipelines.reporting.chart import Chart
from pipelines.reporting.report import Charts, Table, Text, render_report_html
from pipelines.schema.scene_subset import select_apart, select_balanced, select_farthest

MEASURES = ("precision", "recall", "density", "coverage")


@dataclass(frozen=True, eq=False)
class ReferenceSet:
    """A selection of real scenes.

    Attributes:
        strategy: Rule by which scenes are selected: "farthest" or "apart".
        setting: For "farthest", the number of scenes. For "apart", the minimum distance between scenes (m).
        rows: (n,) indices of the selected real scenes.
    """

    strategy: str
    setting: float
    rows: np.ndarray


def list_references(
    xy_m: np.ndarray, world: np.ndarray, sizes: Sequence[int], distances_m: Sequence[float], least: int, most: int
) -> Iterator[ReferenceSet]:
    """Select reference sets of `least` to `most` scenes by the poses (n, 2) of the scenes, and yield the sets.

    Values of `sizes` that exceed n are skipped.
    """
    fitting = [size for size in sorted(sizes) if least <= size <= min(len(xy_m), most)]
    order = select_farthest(xy_m, world, max(fitting)) if fitting else np.zeros(0, int)
    for size in fitting:
        yield ReferenceSet("farthest", size, order[:size])
    for distance_m in sorted(distances_m, reverse=True):
        rows = select_apart(xy_m, world, distance_m)
        if least <= len(rows) <= most:
            yield ReferenceSet("apart", distance_m, rows)


def score_reference(
    reference: ReferenceSet, real: np.ndarray, generated: np.ndarray, labels: np.ndarray, k: Sequence[int]
) -> list[dict]:
    """Score a reference set against the same number of generated scenes; return one row for each k.

    Each label occurs equally often among the selected generated scenes.
    """
    count = len(reference.rows)
    found = compute_neighbourhood_scores(real[reference.rows], generated[select_balanced(labels, count)], k)
    rows = []
    for size in k:
        row = {"strategy": reference.strategy, "setting": float(reference.setting), "samples": count, "k": size}
        for name in MEASURES:
            value = found[f"{name}_k{size}"]
            row |= {name: value.value, f"{name}_low": value.low, f"{name}_high": value.high}
        rows.append(row)
    return rows


def draw_sweep_charts(rows: Sequence[dict]) -> list[Chart]:
    """Draw precision and recall against the number of scenes, with one chart per strategy, as in the paper's figure."""
    charts = []
    for strategy, title in (
        ("apart", "Poses with a minimum distance"),
        ("farthest", "Farthest-point selection of poses"),
    ):
        series = {}
        for name in ("precision", "recall"):
            for k in sorted({row["k"] for row in rows}):
                points = [(r["samples"], r[name]) for r in rows if (r["strategy"], r["k"]) == (strategy, k)]
                points.sort()
                series[f"{name}, k = {k}"] = tuple(map(list, zip(*points, strict=True))) if points else ([], [])
        charts.append(Chart(title, series, "scenes per side", "share"))
    return charts


def build_sweep_table(rows: Sequence[dict]) -> Table:
    def shown(row: dict, name: str) -> str:
        return f"{row[name]:.3f} ({row[f'{name}_low']:.3f} to {row[f'{name}_high']:.3f})"

    how = {"farthest": "farthest", "apart": "at least {:g} m apart"}
    cells = [
        (
            how[row["strategy"]].format(row["setting"]),
            row["samples"],
            row["k"],
            *(shown(row, name) for name in MEASURES),
        )
        for row in rows
    ]
    return Table("Scores by reference set", ("real scenes", "scenes per side", "k", *MEASURES), cells)


def render_sweep_html(rows: Sequence[dict], how: Sequence[str]) -> str:
    """Render the page."""
    sections = [Charts("Precision and recall", draw_sweep_charts(rows)), build_sweep_table(rows), Text("Method", how)]
    return render_report_html("Precision and recall for each reference set", sections)


def sweep_references(
    real: np.ndarray,
    generated: np.ndarray,
    labels: np.ndarray,
    chosen: Sequence[ReferenceSet],
    k: Sequence[int],
    on_reference: Callable[[], None] = lambda: None,
) -> list[dict]:
    """Score all reference sets. Raises ValueError if there is no reference set."""
    if not chosen:
        raise ValueError(
            f"no reference set fits {len(real)} real and {len(generated)} generated scenes; "
            "give smaller --reference-sizes or greater --min-distances-m, or generate more scenes"
        )
    rows = []
    for reference in chosen:
        rows += score_reference(reference, real, generated, labels, k)
        on_reference()
    return rows
