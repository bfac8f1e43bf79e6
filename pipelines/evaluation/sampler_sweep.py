"""Build the rows, the table, the charts and the page of `jobs/sweep_samplers.py`, which compares samplers.

A setting is a sampler, a number of steps, a noise scaling and a guidance scale.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pipelines.metrics.intervals import Estimate
from pipelines.reporting.chart import Chart
from pipelines.reporting.report import Charts, Picture, Pictures, Table, Text, render_report_html

# Scores of `compare_datasets`. Each score has its keys, its display name and the better values: "low", "high" or "one"
# (close to 1).
MEASURES = {
    "relation_frechet": (("relation_frechet",), "relation Fréchet distance", "low"),
    "lite0_frechet": (("lite0_frechet",), "lite0 Fréchet distance", "low"),
    "layout_frechet": (("layout_frechet",), "layout Fréchet distance", "low"),
    "random_frechet": (("random_frechet",), "random-network Fréchet distance", "low"),
    "precision": (("random_precision_k3",), "random-network precision", "high"),
    "recall": (("random_recall_k3",), "random-network recall", "high"),
    "coverage": (("random_coverage_k3",), "random-network coverage", "high"),
    "lite0_recall": (("lite0_recall_k3",), "lite0 recall", "high"),
    "lite0_coverage": (("lite0_coverage_k3",), "lite0 coverage", "high"),
    "vegetation_fidelity": (("label_fidelity", "vegetation_fidelity"), "vegetation label as requested", "high"),
    "vehicle_fidelity": (("label_fidelity", "vehicle_fidelity"), "vehicle label as requested", "high"),
    "road_connectivity": (("validity", "road_connectivity", "generated"), "road connectivity", "high"),
    "overlapping": (("validity", "overlapping", "generated"), "overlapping objects", "low"),
    "sunken": (("validity", "sunken", "generated"), "sunken objects", "low"),
    "count_ratio": (("count_ratio",), "count ratio of the category whose ratio is farthest from 1", "one"),
}
CHARTED = ("relation_frechet", "lite0_frechet", "layout_frechet", "random_frechet", "recall", "road_connectivity")
# Measures that guidance trades against each other: fidelity to the label, diversity, and distance from the data.
CHARTED_BY_SCALE = (
    "vegetation_fidelity",
    "vehicle_fidelity",
    "lite0_recall",
    "lite0_coverage",
    "relation_frechet",
    "lite0_frechet",
)
COMMON = 3.0  # Minimum number of objects per scene. The ratios of categories with fewer objects vary too much.


def compute_count_ratio(statistics: Mapping) -> tuple[str, Estimate] | None:
    """Find the category whose ratio of mean counts (generated / real) differs most from 1; return its name and ratio.

    Categories with fewer than COMMON objects per real scene are ignored. The result is None if no category remains.
    """
    ratios = {}
    for name, sides in statistics.items():
        if name.startswith("num_") and sides["real"].value >= COMMON:
            ratios[name.removeprefix("num_")] = Estimate(*(end / sides["real"].value for end in sides["generated"]))
    return max(ratios.items(), key=lambda one: compute_deviation(one[1].value)) if ratios else None


def compute_deviation(ratio: float) -> float:
    """Return the absolute logarithm of a ratio; it is 0 for the ratio 1."""
    return abs(math.log(ratio)) if ratio > 0 else math.inf


def make_sampler_row(
    sampler: str,
    steps: int | None,
    noise_scaling: float | None,
    seconds_per_scene: float | None,
    scores: Mapping,
    guidance_scale: float | None = None,
) -> dict:
    """Make the row of one setting: measures with intervals, and seconds per scene and actor. None means unknown.

    The rows of the ceiling and of a control have no steps (None); their `sampler` is a description of the scenes.
    """
    row = {"sampler": sampler, "steps": steps, "noise_scaling": noise_scaling, "guidance_scale": guidance_scale}
    row |= {"scenes": scores["scenes"]["generated"], "seconds_per_scene": seconds_per_scene}
    row["count_category"], ratio = compute_count_ratio(scores["statistics"]) or (None, None)
    for name, (place, *_) in MEASURES.items():
        found: Any = {**scores, "count_ratio": ratio}
        for part in place:
            found = found.get(part) if found else None
        value, low, high = found or (None, None, None)
        row |= {name: value, f"{name}_low": low, f"{name}_high": high}
    return row


def is_as_good_as(row: Mapping, reference: Mapping) -> bool:
    """Return whether all measures of a row are at least as good as in the reference row.

    A measure is at least as good if its value is better or if the two intervals overlap. Measures that are None in a
    row are ignored.
    """

    def good(name: str, better: str) -> bool:
        if row[name] is None or reference[name] is None:
            return True
        not_more = row[f"{name}_low"] <= reference[f"{name}_high"]
        not_less = row[f"{name}_high"] >= reference[f"{name}_low"]
        near = (not_more and not_less) or compute_deviation(row[name]) <= compute_deviation(reference[name])
        return {"low": not_more, "high": not_less, "one": near}[better]

    return all(good(name, better) for name, (_, _, better) in MEASURES.items())


def name_sampler(row: Mapping) -> str:
    """Return the name of the sampler; a noise scaling other than 1 is appended."""
    return row["sampler"] + (f" / {row['noise_scaling']:g}" if row["noise_scaling"] not in (None, 1) else "")


def name_settings(row: Mapping) -> str:
    """Return the name of the sampler as `name_sampler`; a guidance scale other than 1 is appended."""
    guidance = row["guidance_scale"]
    return name_sampler(row) + (f", guidance {guidance:g}" if guidance not in (None, 1) else "")


def select_settings(rows: Iterable[Mapping]) -> list[Mapping]:
    """Return the rows of samplers, without the ceiling and the control."""
    return [row for row in rows if row["steps"] is not None]


def find_reference_row(rows: Sequence[Mapping]) -> Mapping:
    """Return the row of the paper's sampler (ddpm) with the most steps. If there is no ddpm row, return the row with
    the most steps among all samplers."""
    return max(select_settings(rows), key=lambda row: (name_settings(row) == "ddpm", row["steps"]))


def build_sampler_table(rows: Sequence[Mapping]) -> Table:
    reference, cells = find_reference_row(rows), []
    for row in rows:
        scores = [
            None if row[name] is None else f"{row[name]:.3g} ({row[f'{name}_low']:.3g} to {row[f'{name}_high']:.3g})"
            for name in MEASURES
        ]
        if row["count_category"]:
            scores[-1] = f"{scores[-1]} {row['count_category']}"
        is_compared = row is not reference and row["steps"] is not None
        good = "–" if not is_compared else "yes" if is_as_good_as(row, reference) else "no"
        seconds = "–" if row["seconds_per_scene"] is None else f"{row['seconds_per_scene']:.2f}"
        cells.append((name_settings(row), row["steps"] or "–", seconds, *scores, good))
    names = [words for _, words, _ in MEASURES.values()]
    alike = f"as good as {name_settings(reference)} with {reference['steps']} steps"
    note = (
        "A number after / is the noise scaling of a sampler. Without a guidance scale, guidance is off. Brackets "
        "contain 95 % bootstrap intervals. Seconds are measured for one actor with loaded weights. The last column "
        "states whether each score is better than "
        f"{name_settings(reference)} with {reference['steps']} steps or within its interval. The ceiling is the score "
        "of the same number of other real scenes; the control damages these scenes."
    )
    return Table(
        "Scores by sampler and steps", ("sampler", "steps", "time per scene, s", *names, alike), cells, note=note
    )


def draw_sampler_charts(rows: Sequence[Mapping]) -> dict[str, Chart]:
    """Make one chart per measure over the number of steps, or over the guidance scale if there are several scales.

    Each chart has one series per setting of the other options. None values are left out.

    Args:
        rows: Rows of `make_sampler_row`.

    Returns:
        Charts by measure.
    """
    charts, rows = {}, select_settings(rows)
    by_scale = len({row["guidance_scale"] for row in rows}) > 1
    axis, x_label = ("guidance_scale", "guidance scale") if by_scale else ("steps", "steps")

    def name_series(row: Mapping) -> str:
        return f"{name_sampler(row)}, {row['steps']} steps" if by_scale else name_settings(row)

    for name in CHARTED_BY_SCALE if by_scale else CHARTED:
        series = {}
        for title in dict.fromkeys(map(name_series, rows)):
            points = sorted((r[axis], r[name]) for r in rows if name_series(r) == title and r[name] is not None)
            series[title] = tuple(map(list, zip(*points, strict=True))) if points else ([], [])
        words = MEASURES[name][1]
        charts[name] = Chart(words[0].upper() + words[1:], series, x_label, words)
    return charts


def render_sampler_html(rows: Sequence[Mapping], pictures: Sequence[Picture], columns: int, how: Sequence[str]) -> str:
    """Render the page. All rows of `pictures` show the same scenes; `columns` is the number of scenes per row."""
    note = "Each row shows scenes of one setting. The scene numbers and labels are the same in all rows."
    sections = [
        build_sampler_table(rows),
        Charts("Charts", list(draw_sampler_charts(rows).values())),
        Pictures("Generated scenes", pictures, columns, note),
        Text("Method", how),
    ]
    return render_report_html("Samplers", sections)
