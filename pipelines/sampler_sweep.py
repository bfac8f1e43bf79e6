"""How good scenes are by sampler and number of steps: rows, table, charts and page of `jobs/sweep_samplers.py`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pipelines.chart import Chart
from pipelines.metrics.intervals import Estimate
from pipelines.report import Charts, Picture, Pictures, Table, Text, report_html

# Scores of `evaluate.compare` by their place in it, with their name in words.
MEASURES = {
    "layout_frechet": (("layout_frechet",), "layout Fréchet distance"),
    "random_frechet": (("random_frechet",), "random-network Fréchet distance"),
    "precision": (("random_precision_k3",), "random-network precision"),
    "recall": (("random_recall_k3",), "random-network recall"),
    "road_connectivity": (("validity", "road_connectivity", "generated"), "road connectivity"),
    "overlapping": (("validity", "overlapping", "generated"), "overlapping objects"),
    "sunken": (("validity", "sunken", "generated"), "sunken objects"),
}
CHARTED = ("layout_frechet", "random_frechet", "precision", "road_connectivity")


def sampler_row(sampler: str, steps: int, seconds_per_scene: float | None, scores: Mapping) -> dict:
    """One row: each measure with the ends of its interval, None where it has no value; an actor's seconds, None if none were seen."""
    count = scores["scenes"]["generated"]
    row = {"sampler": sampler, "steps": steps, "scenes": count, "seconds_per_scene": seconds_per_scene}
    for name, (place, _) in MEASURES.items():
        found: Mapping | Estimate | None = scores
        for part in place:
            found = found[part]
        value, low, high = found or (None, None, None)
        row |= {name: value, f"{name}_low": low, f"{name}_high": high}
    return row


def as_good_as(row: Mapping, reference: Mapping) -> bool:
    """Does every measure's interval overlap that of the reference, where both have one?"""
    known = [name for name in MEASURES if row[name] is not None and reference[name] is not None]
    return all(
        row[f"{name}_low"] <= reference[f"{name}_high"] and reference[f"{name}_low"] <= row[f"{name}_high"]
        for name in known
    )


def reference_row(rows: Sequence[Mapping]) -> Mapping:
    """The paper's sampler with the most steps there are of it; without it, the most steps of any."""
    return max(rows, key=lambda row: (row["sampler"] == "ddpm", row["steps"]))


def sampler_table(rows: Sequence[Mapping]) -> Table:
    reference, cells = reference_row(rows), []
    for row in rows:
        scores = (
            None if row[name] is None else f"{row[name]:.3g} ({row[f'{name}_low']:.3g} to {row[f'{name}_high']:.3g})"
            for name in MEASURES
        )
        good = "–" if row is reference else "yes" if as_good_as(row, reference) else "no"
        seconds = "–" if row["seconds_per_scene"] is None else f"{row['seconds_per_scene']:.2f}"
        cells.append((row["sampler"], row["steps"], seconds, *scores, good))
    names = [words for _, words in MEASURES.values()]
    alike = f"as {reference['sampler']} of {reference['steps']}"
    note = (
        "In brackets: 95 % bootstrap intervals. Seconds: of one actor, weights loaded. Last column: do all intervals overlap "
        f"with those of {reference['sampler']} of {reference['steps']} steps?"
    )
    return Table("Scores by sampler and steps", ("sampler", "steps", "s per scene", *names, alike), cells, note=note)


def sampler_charts(rows: Sequence[Mapping]) -> list[Chart]:
    """A chart per measure, a series per sampler, over the number of steps."""
    charts = []
    for name in CHARTED:
        series = {}
        for sampler in dict.fromkeys(row["sampler"] for row in rows):
            points = sorted((r["steps"], r[name]) for r in rows if r["sampler"] == sampler and r[name] is not None)
            series[sampler] = tuple(map(list, zip(*points, strict=True))) if points else ([], [])
        words = MEASURES[name][1]
        charts.append(Chart(words[0].upper() + words[1:], series, "steps", words))
    return charts


def sampler_html(rows: Sequence[Mapping], pictures: Sequence[Picture], columns: int, how: Sequence[str]) -> str:
    """The page; `pictures` are the same scenes in every row, `columns` of them."""
    note = "One row per sampler and number of steps; the same scene numbers and labels in each."
    sections = [
        sampler_table(rows),
        Charts("By number of steps", sampler_charts(rows)),
        Pictures("Scenes", pictures, columns, note),
        Text("How", how),
    ]
    return report_html("Samplers", sections)
