"""Render the comparison of large scenes with data as one page: scores by ring, and a map of each quantity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from pipelines.metrics.cities import QUANTITIES, WINDOW_M
from pipelines.reporting.chart import Chart, format_number
from pipelines.reporting.contact_sheet import write_text
from pipelines.reporting.dataset_charts import spell_name
from pipelines.reporting.evaluation_report import format_value
from pipelines.reporting.report import Charts, Picture, Pictures, Section, Table, Text, render_report_html

CELL_PX = 56
SIDES = ("generated", "reference", "ceiling")  # Order of the values in the table by label.
LEVEL_M = 5.0  # Difference of the level of the ground at which the colour of a map is fullest (m).
EPSILON = 1e-6  # Added to values before their ratio, so that a value expected to be 0 is red.
FEW_COLOR, MANY_COLOR = np.array([49, 104, 180]), np.array([190, 60, 40])  # A quarter or less; four times or more.
MEANINGS = {
    "two_sample_auc": "AUC of a classifier that separates windows from real scenes; 0.5 is perfect",
    "relation_frechet": "distance of relations between objects and ground",
    "lite0_frechet": "distance of features of EfficientNet-Lite0",
    "lite0_coverage_k3": "share of real scenes with a window in their neighbourhood",
    "label_fidelity.vegetation_fidelity": "share of windows with the requested density of vegetation",
    "label_fidelity.vehicle_fidelity": "share of windows with the requested density of vehicles",
    "validity.overlapping.generated": "share of solid objects that overlap another by a quarter",
    "validity.unattached.generated": "share of signs, lamps and poles without support",
}
CITY_QUANTITIES = {
    "cities": "number of cities",
    "road_connectivity": "share of road pixels in the largest connected part",
    "city_blocks_per_ha": "city blocks per hectare that do not touch the border",
    "median_city_block_m2": "median area of these city blocks (m²)",
    "vehicles_routed": "share of simulated vehicles with a way to a random street (SUMO)",
    "vehicles_arrived": "share of these vehicles that arrive within 15 minutes",
}
WHOLE_MEANINGS = {
    "street_distance": "mean Jensen-Shannon distance (base 2) between the street directions of a city and of each town",
    "seams.class_changes": "rate of class changes at seams divided by that at nearby lines",
    "seams.height_step": "height steps at seams divided by those at nearby lines",
    "seams.cut_objects": "rate of cut objects at seams divided by that at nearby lines",
    "seams.doubled_objects": "rate of doubled objects at seams divided by that at nearby lines",
}


def find_score(scores: Any, name: str) -> Any:
    """Return a nested score by its name with dots; None if it is absent. The empty name returns `scores`."""
    for part in name.split(".") if name else ():
        scores = scores.get(part) if scores else None
    return scores


def list_columns(scores: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """List the columns of the tables by ring: heading, side and group of rings."""
    sides = {side: groups for side, groups in scores["rings"].items() if side != "ceiling"}
    columns = [(f"{side}, ring {group}", side, group) for side, groups in sides.items() for group in groups]
    return [*columns, ("ceiling", "ceiling", "all")]


def build_ring_table(scores: Mapping[str, Any]) -> Table:
    """Build the table of the scores that compare sets of windows with the reference."""
    columns, rows, meanings = list_columns(scores), [], []
    for name, meaning in MEANINGS.items():
        found = [find_score(scores["rings"][side][group], name) for _, side, group in columns]
        if any(value is not None for value in found):
            last = name.removesuffix(".generated").split(".")[-1]
            rows.append((spell_name(last), *map(format_value, found)))
            meanings.append(meaning)
    note = (
        "Each column compares the same number of windows with the reference. The ceiling consists of windows of"
        " procedural towns. They are selected by their label, so their label fidelity is no ceiling. Brackets contain"
        " 95 % bootstrap intervals over windows."
    )
    return Table("Scores by ring", ("score", *(heading for heading, *_ in columns)), rows, meanings, note)


def build_quantity_table(scores: Mapping[str, Any]) -> Table:
    """Build the table of the mean of each quantity by ring, with the reference and the ceiling."""
    quantities = scores["quantities"]
    columns = [entry for entry in list_columns(scores) if entry[1] != "ceiling" and entry[1] in quantities]
    rows = []
    for name in QUANTITIES:
        found = [quantities[side][group][name] for _, side, group in columns]
        found += [quantities[side]["all"][name] for side in ("ceiling", "reference") if side in quantities]
        rows.append((spell_name(name), *map(format_value, found)))
    headings = [heading for heading, *_ in columns]
    note = (
        "Reference: scenes of the data with the same label. Each of them is measured alone, so its border cuts streets."
        " Therefore compare junctions, dead ends and road lengths with the ceiling."
    )
    ends = [side for side in ("ceiling", "reference") if side in quantities]
    return Table("Quantities by ring", ("quantity", *headings, *ends), rows, note=note)


def build_label_table(scores: Mapping[str, Any]) -> Table:
    """Build the table of the mean of each quantity by label, in cities with several labels."""
    labels = scores["labels"]

    def average(name: str, side: str) -> dict[str, float] | None:
        found = [sides.get(side, {}).get(name) for sides in labels.values()]
        known = [estimate["value"] for estimate in found if estimate]
        return {"value": float(np.mean(known))} if len(known) == len(found) else None

    rows = [
        (
            spell_name(name),
            *(format_means(*(sides.get(side, {}).get(name) for side in SIDES)) for sides in labels.values()),
            format_means(*(average(name, side) for side in SIDES)),
        )
        for name in QUANTITIES
    ]
    note = (
        "Each cell holds the mean over the windows with the label, and in brackets those of the reference and of the"
        " ceiling (–: no window of a town has the label). The last column is the mean over the labels. The streets of"
        " the reference are cut at the border of each scene."
    )
    return Table("Quantities by label", ("quantity", *labels, "mean of labels"), rows, note=note)


def format_means(*estimates: Mapping[str, float] | None) -> str:
    """Return the values of estimates as text; those after the first one are in brackets."""
    first, *others = (format_number(found["value"]) if found else "–" for found in estimates)
    return f"{first} ({', '.join(others)})"


def build_street_table(scores: Mapping[str, Any]) -> Table:
    """Build the table of street directions and seams by ring. They use all windows of a ring."""
    columns = [
        (f"{side}, ring {group}", side, group)
        for side, whole in scores["whole"].items()
        for group in whole["street_distance"]
    ]
    rows, meanings = [], []
    for name, meaning in WHOLE_MEANINGS.items():
        first, *rest = name.split(".")
        found = [find_score(scores["whole"][side][first].get(group), ".".join(rest)) for _, side, group in columns]
        if any(value is not None for value in found):
            rows.append((spell_name(name.split(".")[-1]), *map(format_value, found)))
            meanings.append(meaning)
    note = (
        "The ceiling compares towns with each other. Distances between few streets are larger, so compare equal rings."
        " A ratio of 1 means that seams are invisible."
    )
    return Table("Streets and seams by ring", ("score", *(heading for heading, *_ in columns)), rows, meanings, note)


def build_whole_table(scores: Mapping[str, Any]) -> Table:
    """Build the table of the scores of whole cities."""
    sides = list(scores["whole"])
    rows = [
        (spell_name(name), *(format_value(scores["whole"][side].get(name)) for side in sides))
        for name in CITY_QUANTITIES
    ]
    return Table("Whole cities", ("quantity", *sides), rows, list(CITY_QUANTITIES.values()))


def draw_map(values: Mapping[tuple[int, int], float], expected: float, difference: float | None = None) -> np.ndarray:
    """Draw the mean value of each window; colours show how it differs from an expected value.

    Args:
        values: Value by (windows ahead, windows to the left). Windows without a value are grey.
        expected: Value at which a window is white; blue windows have less and red ones more. NaN: all are grey.
        difference: Difference from `expected` at which the colours are fullest. None: they are fullest at a quarter
            and at four times `expected`.

    Returns:
        (h, w, 3) uint8 picture; ahead is up and left is left.
    """
    reach = max((max(abs(ahead), abs(left)) for ahead, left in values), default=0)
    side = 2 * reach + 1
    image = Image.new("RGB", (side * CELL_PX, side * CELL_PX), "white")
    draw = ImageDraw.Draw(image)
    for (ahead, left), value in values.items():
        x, y = (reach - left) * CELL_PX, (reach - ahead) * CELL_PX
        color = (238, 238, 238)
        if np.isfinite(value) and np.isfinite(expected):
            if difference is None:
                strength = np.log((value + EPSILON) / (expected + EPSILON)) / np.log(4)
            else:
                strength = (value - expected) / difference
            strength = float(np.clip(strength, -1, 1))
            goal = MANY_COLOR if strength > 0 else FEW_COLOR
            color = tuple(int(c) for c in 255 + abs(strength) * (goal - 255))
        draw.rectangle((x, y, x + CELL_PX - 2, y + CELL_PX - 2), fill=color)
        write_text(draw, x + 4, y + CELL_PX / 2 - 8, format_number(value) if np.isfinite(value) else "–", 13, "#222")
    return np.asarray(image)


def draw_maps(rows: Sequence[Mapping[str, Any]], expected: Mapping[str, float]) -> Pictures:
    """Draw one map per quantity with the mean over the cities of one side."""
    pictures = []
    for name in QUANTITIES:
        found: dict[tuple[int, int], list[float]] = {}
        for row in rows:
            found.setdefault((row["ahead"], row["left"]), []).append(row[name])
        means = {
            place: float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")
            for place, values in found.items()
        }
        goal = expected[name]
        caption = f"{spell_name(name)}; expected: {format_number(goal) if np.isfinite(goal) else '–'}"
        pictures.append(Picture(caption, draw_map(means, goal, LEVEL_M if name == "level_m" else None)))
    note = (
        f"Each square is a window of {WINDOW_M:g} m and shows the mean over cities; ahead is up. White: as expected."
        f" Blue: a quarter or less (level: {LEVEL_M:g} m less). Red: four times or more (level: {LEVEL_M:g} m more)."
        " Street quantities are compared with the ceiling, others with the reference."
    )
    return Pictures("Maps", pictures, 3, note)


def draw_ring_charts(scores: Mapping[str, Any]) -> Charts:
    """Draw common quantities over the rings, for each side."""
    charts = []
    for name in ("vegetation_cuboid_per_ha", "vehicle_small_per_ha", "construction_big_per_ha", "road_share"):
        series = {}
        for side, groups in scores["quantities"].items():
            if side not in ("reference", "ceiling"):
                known = [
                    (float(np.mean([int(ring) for ring in group.split("-")])), found[name]["value"])
                    for group, found in groups.items()
                    if group != "all" and found[name]
                ]
                series[side] = tuple(map(list, zip(*known, strict=True))) if known else ([], [])
        last = max((max(x) for x, _ in series.values() if x), default=0)
        for side in ("ceiling", "reference"):
            value = scores["quantities"][side]["all"][name]["value"]
            series[side] = ([0, max(last, 1)], [value, value])
        charts.append(Chart(spell_name(name), series, "ring, or middle of a group of rings", spell_name(name)))
    return Charts("Rings", charts)


def render_city_html(
    scores: Mapping[str, Any],
    rows: Mapping[str, Sequence[Mapping[str, Any]]],
    overviews: Sequence[Picture],
    how: Sequence[str],
) -> str:
    """Render the page.

    Args:
        scores: Content of metrics.json.
        rows: Rows of the windows of each side.
        overviews: Pictures of cities from above.
        how: Sentences about the compared sets.

    Returns:
        HTML.
    """
    quantities = scores["quantities"]
    streets = ("road_m_per_ha", "junctions_per_ha", "dead_ends_per_ha")
    expected = {}
    for name in QUANTITIES:
        found = quantities["ceiling" if name in streets else "reference"]["all"][name]
        expected[name] = found["value"] if found else float("nan")
    sections: list[Section] = [
        build_ring_table(scores),
        draw_ring_charts(scores),
        build_street_table(scores),
        build_quantity_table(scores),
        *([build_label_table(scores)] if "labels" in scores else []),
        build_whole_table(scores),
        Pictures("Cities from above", overviews, 2),
        draw_maps(rows["generated"], expected),
        Text("Method", how),
    ]
    return render_report_html("Cities", sections)
