"""Render the comparison of generated and real scenes as one page: scores, intervals, meanings and pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from models.scene import CATEGORIES
from pipelines.metrics.distributions import HISTOGRAMS
from pipelines.reporting.chart import Chart, format_number
from pipelines.reporting.dataset_charts import spell_name
from pipelines.reporting.report import (
    Charts,
    Figure,
    KeyFigures,
    Picture,
    Pictures,
    Section,
    Table,
    Text,
    render_report_html,
)

DETAILS = (".statistics.", ".distance.", ".count_distance.", "category_", "class_", "ap3d_at", ".truths.")
# fmt: off
MEANINGS = {
    "fid": "Frechet distance of Inception's pool3 features; equal sources have 0. With more samples, the distance is "
           "lower. Compare only distances that were computed from the same number of samples",
    "sfid": "Frechet distance of Inception's spatial features, which depend on the positions of objects",
    "kid": "kernel distance of the pool3 features with a cubic kernel; equal sources have 0. The expected value does "
           "not depend on the number of samples",
    "inception_score": "confidence and variety of Inception's class predictions. The score is intended for photographs",
    "inception_score_real": "Inception score of the real pictures",
    "precision": "share of generated pictures that lie in the neighbourhood of a real picture",
    "recall": "share of real pictures that lie in the neighbourhood of a generated picture",
    "density": (
"mean number of real neighbourhoods that contain a generated picture, divided by k. Equal sources"
" have a density of about 1"
),
    "coverage": "share of real pictures whose neighbourhood contains a generated picture",
    "layout_frechet": (
"Frechet distance of object counts, object sizes and ground areas; equal sources have 0. It is not"
" an FID"
),
    "layout_mmd": "kernel distance of object counts, object sizes and ground areas; equal sources have 0",
    "random_frechet": "Frechet distance of the features of a random network; equal sources have 0. It is not an FID",
    "random_mmd": "kernel distance of the features of a random network; equal sources have 0. It is not a KID",
    "vegetation_fidelity": "share of scenes whose vegetation density matches the requested label",
    "vehicle_fidelity": "share of scenes whose vehicle density matches the requested label",
    "joint_fidelity": "share of scenes whose vegetation and vehicle densities both match the requested labels",
}
VALIDITY = {
    "overlapping": "solid objects that overlap another solid object (IoU3D > 0.05)",
    "floating": "standing objects more than 0.5 m above the ground",
    "sunken": "standing objects more than 0.5 m below the ground",
    "over_unknown_ground": "standing objects without any ground below them",
    "off_road_vehicles": "vehicles that are not on roads or parking areas",
    "buildings_on_road": "buildings on the road",
    "road_connectivity": "road pixels in the largest connected component",
}
# fmt: on


@dataclass(frozen=True, eq=False)
class ExamplePictures:
    """Pictures (H, W, 3) uint8 for the page.

    Attributes:
        real: Real examples.
        generated: Generated examples.
        neighbours: Generated pictures; each is followed by the nearest real pictures and their distances.
        worst: Generated pictures with the most faults, and a caption for each picture.
    """

    real: Sequence[np.ndarray]
    generated: Sequence[np.ndarray]
    neighbours: Sequence[tuple[np.ndarray, Sequence[np.ndarray], Sequence[float]]] = ()
    worst: Sequence[tuple[np.ndarray, str]] = ()


def render_evaluation_html(
    scores: Mapping, counts: Mapping[str, np.ndarray], shown: ExamplePictures, protocol: Sequence[str]
) -> str:
    """Render the page.

    Args:
        scores: Scores, as returned by `convert_estimates`.
        counts: (n, 11) number of objects per scene and category, for both sides. None: unknown.
        shown: Pictures.
        protocol: Paragraphs that describe the measurement.

    Returns:
        HTML page.
    """
    sections: list[Section] = [
        make_summary(scores),
        Pictures("Real scenes", [Picture("", image, "real") for image in shown.real], columns=6),
        Pictures("Generated scenes", [Picture("", image, "generated") for image in shown.generated], columns=6),
        build_score_table(scores),
    ]
    if "validity" in scores:
        sections += [
            build_validity_table(scores["validity"]),
            draw_count_charts(counts),
            build_statistics_table(scores["statistics"]),
        ]
        sections.append(build_distance_table(scores))
    if shown.worst:
        worst = [Picture(reason, image, "generated") for image, reason in shown.worst]
        note = "These generated scenes have the most faults."
        sections.append(Pictures("Worst generated scenes", worst, columns=6, note=note))
    sections += [draw_neighbour_pictures(shown), build_memorisation_table(scores["memorisation"])]
    sections.append(Text("Protocol", [*protocol, INTERVALS]))
    title = f"{scores['scenes']['generated']} generated scenes compared with {scores['scenes']['real']} real scenes"
    return render_report_html("Evaluation", sections, title)


INTERVALS = (
    "Brackets contain 95 % bootstrap intervals over scenes. The intervals of precision, recall, density and coverage "
    "keep the neighbourhoods fixed. The intervals of Frechet distances are first-order approximations. These "
    "intervals do not include the bias that a Frechet distance has for a small number of samples."
)


def format_value(value: Mapping | float | None) -> str | None:
    """Format a score as `0.53 (0.49 to 0.57)`, or as a number if it has no interval."""
    if isinstance(value, Mapping):
        if value["value"] is None:
            return None
        between = [value[end] for end in ("low", "high")]
        ends = "" if None in between else f" ({format_number(between[0])} to {format_number(between[1])})"
        return format_number(value["value"]) + ends
    return None if value is None else format_number(value)


def iterate_leaves(scores: Mapping, prefix: str = "") -> Iterator[tuple[str, Mapping | float]]:
    """Flatten nested scores: yield (names joined by dots, score). Words and nulls are skipped."""
    for name, value in scores.items():
        if isinstance(value, Mapping) and set(value) != {"value", "low", "high"}:
            yield from iterate_leaves(value, f"{prefix}{name}.")
        elif value is not None and not isinstance(value, str):
            yield prefix + name, value


def list_headlines(scores: Mapping) -> Iterator[tuple[str, Mapping | float]]:
    """Return the main scores, without the scores of single categories, classes or thresholds."""
    return ((name, value) for name, value in iterate_leaves(scores) if not any(part in name for part in DETAILS))


def make_summary(scores: Mapping) -> KeyFigures:
    """Make the key figures of the page."""
    names = ("fid", "kid", "layout_frechet", "precision_k3", "recall_k3", "random_precision_k3", "random_recall_k3")
    figures = [Figure(scores[name]["value"], name.replace("_", " ")) for name in names if name in scores]
    for name in ("overlapping", "road_connectivity"):
        if scores.get("validity", {}).get(name, {}).get("generated"):
            sides = scores["validity"][name]
            note = "" if sides["real"] is None else f"{format_number(sides['real']['value'])} in real scenes"
            figures.append(Figure(sides["generated"]["value"], VALIDITY[name], note))
    return KeyFigures("Summary", figures)


def explain_score(name: str) -> str:
    """Explain a score in words. For a name such as `random_precision_k5`, explain each part of the name."""
    if name in MEANINGS:
        return MEANINGS[name]
    base, _, k = name.removeprefix("random_").rpartition("_k")
    seen = "; features of an untrained network" if name.startswith("random_") else ""
    return f"{MEANINGS[base]}{seen}; k = {k}"


def build_score_table(scores: Mapping) -> Table:
    flat = {name: value for name, value in scores.items() if name in MEANINGS or "_k" in name}
    flat |= scores.get("label_fidelity", {})
    rows = [(name.replace("_", " "), format_value(value)) for name, value in flat.items()]
    note = (
        ""
        if "fid" in scores
        else "Inception scores are missing. They need a local file with Inception weights: pass --inception FILE."
    )
    return Table("Scores", ("score", "value"), rows, meanings=[explain_score(name) for name in flat], note=note)


def build_validity_table(validity: Mapping) -> Table:
    rows = [
        (words, *(format_value(validity[name][side]) for side in ("real", "generated")))
        for name, words in VALIDITY.items()
    ]
    note = "Real scenes also have faults. Compare each share of the generated scenes with the share of the real scenes."
    return Table("Validity", ("share of", "real", "generated"), rows, note=note)


def build_statistics_table(statistics: Mapping) -> Table:
    rows = [
        (name.replace("_", " "), *(format_value(sides[side]) for side in ("real", "generated")))
        for name, sides in statistics.items()
    ]
    note = "The rows are numbers of objects per scene, mean extents in metres, and shares of the area of a scene."
    return Table("Layout statistics", ("mean per scene", "real", "generated"), rows, note=note)


def build_distance_table(scores: Mapping) -> Table:
    units = {histogram.name: histogram.unit for histogram in HISTOGRAMS}
    named = {f"{name}.number": (found, "objects") for name, found in scores["count_distance"].items()}
    named |= {name: (found, units[name]) for name, found in scores["distance"].items()}
    rows = [
        (
            spell_name(name.removesuffix("_m").replace(".", ": ")),
            unit,
            format_value(found["between"]),
            format_value(found["within_real"]),
        )
        for name, (found, unit) in sorted(named.items())
    ]
    note = (
        "Rows with the unit 'bits' are Jensen-Shannon divergences. All other rows are Wasserstein distances in the "
        "given unit. The last column is the distance between two halves of the real scenes, which is about the lowest "
        "distance that generated scenes can reach."
    )
    columns = ("distribution", "unit", "real to generated", "real to real")
    return Table("Distances between distributions", columns, rows, note=note)


def draw_count_charts(counts: Mapping[str, np.ndarray]) -> Charts:
    charts = []
    for index, category in enumerate(CATEGORIES):
        series = {}
        for side, values in counts.items():
            at = np.linspace(0, 100, min(len(values), 101))
            series[side] = (at.tolist(), np.percentile(values[:, index], at).tolist())
        if any(max(y) > 0 for _, y in series.values()):
            charts.append(Chart(spell_name(category), series, "percentile of scenes", "number per scene"))
    return Charts("Objects per scene", charts)


def draw_neighbour_pictures(shown: ExamplePictures) -> Pictures:
    pictures = []
    for generated, nearest, distances in shown.neighbours:
        pictures.append(Picture("", generated, "generated"))
        pictures += [Picture(f"distance {d:.3g}", image, "real") for image, d in zip(nearest, distances, strict=True)]
    columns = 1 + max((len(nearest) for _, nearest, _ in shown.neighbours), default=0)
    note = (
        "The figure shows the generated scenes with the smallest distance to a real scene. Each generated "
        "scene is followed by the nearest real scenes and their distances."
    )
    return Pictures("Nearest real scenes", pictures, columns=columns, note=note)


def build_memorisation_table(found: Mapping) -> Table:
    rows = [
        (words, *(format_value(found[side][name]) for side in ("generated", "real")))
        for name, words in (("mean", "mean"), ("median", "median"), ("minimum", "minimum"), ("maximum", "maximum"))
    ]
    note = (
        f"Distances are measured in {found['features']} features. The limit is the 1 % quantile of the distances of "
        "real scenes to their nearest other real scene. The share of generated scenes below the limit is "
        f"{format_value(found['memorised'])}. The share of exact copies is {format_value(found['copies'])}."
    )
    columns = ("statistic", "generated to real", "real to other real")
    return Table("Distance to the nearest real scene", columns, rows, note=note)
