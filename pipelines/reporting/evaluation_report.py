"""Render the comparison of generated with real scenes as one page: scores, intervals, meanings and pictures."""

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
    "fid": "Frechet distance of Inception's pool3 features; 0 is equal. Falls with the number of samples: compare at "
           "equal numbers only",
    "sfid": "the same of its spatial features, which see where things lie",
    "kid": "kernel distance of the pool3 features, cubic kernel; 0 is equal, without bias from the number of samples",
    "inception_score": "how sure Inception is of each picture, and how varied it finds them; made for photographs",
    "inception_score_real": "the same of the real pictures",
    "precision": "share of generated pictures that lie among the real ones",
    "recall": "share of real pictures that lie among the generated ones",
    "density": "real neighbourhoods that a generated picture lies in, over k; about 1 for equal sources",
    "coverage": "share of real pictures with a generated one in their neighbourhood",
    "layout_frechet": "Frechet distance of counts, sizes and areas of scenes; 0 is equal. Not an FID",
    "layout_mmd": "kernel distance of the same; 0 is equal",
    "random_frechet": "Frechet distance of pictures as a fixed, untrained network sees them; 0 is equal. Not an FID",
    "random_mmd": "kernel distance of the same; 0 is equal. Not a KID",
    "vegetation_fidelity": "share of scenes whose vegetation is as dense as was asked for",
    "vehicle_fidelity": "share of scenes whose vehicles are as dense as was asked for",
    "joint_fidelity": "share of scenes of which both hold",
}
VALIDITY = {
    "overlapping": "solid objects that stand in one another (IoU3D > 0.05)",
    "floating": "standing objects more than half a metre above the ground",
    "sunken": "standing objects more than half a metre below the ground",
    "over_unknown_ground": "standing objects over no ground at all",
    "off_road_vehicles": "vehicles off road and parking",
    "buildings_on_road": "buildings in the road",
    "road_connectivity": "road pixels that hang together in one piece",
}
# fmt: on


@dataclass(frozen=True, eq=False)
class ExamplePictures:
    """Pictures (H, W, 3) uint8 for the page: examples of both sides, and generated ones with the nearest real ones."""

    real: Sequence[np.ndarray]
    generated: Sequence[np.ndarray]
    neighbours: Sequence[tuple[np.ndarray, Sequence[np.ndarray], Sequence[float]]] = ()
    worst: Sequence[tuple[np.ndarray, str]] = ()


def render_evaluation_html(
    scores: Mapping, counts: Mapping[str, np.ndarray], shown: ExamplePictures, protocol: Sequence[str]
) -> str:
    """Render the page from the scores of `convert_estimates` and the counts (n, 11) of both sides, if known."""
    sections: list[Section] = [
        make_summary(scores),
        Pictures("Real", [Picture("", image, "real") for image in shown.real], columns=6),
        Pictures("Generated", [Picture("", image, "generated") for image in shown.generated], columns=6),
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
        sections.append(Pictures("Where it fails", worst, columns=6, note="The generated scenes with most faults."))
    sections += [draw_neighbour_pictures(shown), build_memorisation_table(scores["memorisation"])]
    sections.append(Text("How it was measured", [*protocol, INTERVALS]))
    title = f"{scores['scenes']['generated']} generated scenes against {scores['scenes']['real']} real ones"
    return render_report_html("Evaluation", sections, title)


INTERVALS = (
    "In brackets: 95 % bootstrap intervals over scenes. Those of precision, recall, density and coverage hold the "
    "neighbourhoods fixed; those of Frechet distances are of first order and say nothing of their bias at small "
    "numbers."
)


def format_value(value: Mapping | float | None) -> str | None:
    """`0.53 (0.49 to 0.57)`, or the number alone."""
    if isinstance(value, Mapping):
        if value["value"] is None:
            return None
        between = [value[end] for end in ("low", "high")]
        ends = "" if None in between else f" ({format_number(between[0])} to {format_number(between[1])})"
        return format_number(value["value"]) + ends
    return None if value is None else format_number(value)


def iterate_leaves(scores: Mapping, prefix: str = "") -> Iterator[tuple[str, Mapping | float]]:
    """Names joined by dots, and what `written` takes, of nested scores in plain form; words and nulls left out."""
    for name, value in scores.items():
        if isinstance(value, Mapping) and set(value) != {"value", "low", "high"}:
            yield from iterate_leaves(value, f"{prefix}{name}.")
        elif value is not None and not isinstance(value, str):
            yield prefix + name, value


def list_headlines(scores: Mapping) -> Iterator[tuple[str, Mapping | float]]:
    """The leaves that are told in short lists: none of single categories, classes or thresholds."""
    return ((name, value) for name, value in iterate_leaves(scores) if not any(part in name for part in DETAILS))


def make_summary(scores: Mapping) -> KeyFigures:
    names = ("fid", "kid", "layout_frechet", "precision_k3", "recall_k3", "random_precision_k3", "random_recall_k3")
    figures = [Figure(scores[name]["value"], name.replace("_", " ")) for name in names if name in scores]
    for name in ("overlapping", "road_connectivity"):
        if scores.get("validity", {}).get(name, {}).get("generated"):
            sides = scores["validity"][name]
            note = "" if sides["real"] is None else f"{format_number(sides['real']['value'])} in real scenes"
            figures.append(Figure(sides["generated"]["value"], VALIDITY[name], note))
    return KeyFigures("In short", figures)


def explain_score(name: str) -> str:
    """In words, what a score says; `random_precision_k5` and the like by their parts."""
    if name in MEANINGS:
        return MEANINGS[name]
    base, _, k = name.removeprefix("random_").rpartition("_k")
    seen = ", as an untrained network sees them" if name.startswith("random_") else ""
    return f"{MEANINGS[base]}{seen}; k = {k}"


def build_score_table(scores: Mapping) -> Table:
    flat = {name: value for name, value in scores.items() if name in MEANINGS or "_k" in name}
    flat |= scores.get("label_fidelity", {})
    rows = [(name.replace("_", " "), format_value(value)) for name, value in flat.items()]
    note = (
        ""
        if "fid" in scores
        else "FID, KID, Inception score and their like need local Inception weights: --inception FILE."
    )
    return Table("Scores", ("score", "value"), rows, meanings=[explain_score(name) for name in flat], note=note)


def build_validity_table(validity: Mapping) -> Table:
    rows = [
        (words, *(format_value(validity[name][side]) for side in ("real", "generated")))
        for name, words in VALIDITY.items()
    ]
    note = "Real scenes give the level to compare with; it is not zero."
    return Table("Do scenes make sense?", ("share of", "real", "generated"), rows, note=note)


def build_statistics_table(statistics: Mapping) -> Table:
    rows = [
        (name.replace("_", " "), *(format_value(sides[side]) for side in ("real", "generated")))
        for name, sides in statistics.items()
    ]
    note = "Numbers per scene, mean extents in metres, and shares of the scene's area."
    return Table("What scenes are made of", ("mean per scene", "real", "generated"), rows, note=note)


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
        "Wasserstein distances of distributions in the unit given, in bits Jensen-Shannon divergences. The last "
        "column is "
        "the distance of two halves of the real scenes: nothing comes nearer than about that."
    )
    return Table("How distributions differ", ("of", "unit", "real to generated", "within real"), rows, note=note)


def draw_count_charts(counts: Mapping[str, np.ndarray]) -> Charts:
    charts = []
    for index, category in enumerate(CATEGORIES):
        series = {}
        for side, values in counts.items():
            at = np.linspace(0, 100, min(len(values), 101))
            series[side] = (at.tolist(), np.percentile(values[:, index], at).tolist())
        if any(max(y) > 0 for _, y in series.values()):
            charts.append(Chart(spell_name(category), series, "percentile of scenes", "number per scene"))
    return Charts("Numbers of objects", charts)


def draw_neighbour_pictures(shown: ExamplePictures) -> Pictures:
    pictures = []
    for generated, nearest, distances in shown.neighbours:
        pictures.append(Picture("", generated, "generated"))
        pictures += [Picture(f"at {d:.3g}", image, "real") for image, d in zip(nearest, distances, strict=True)]
    columns = 1 + max((len(nearest) for _, nearest, _ in shown.neighbours), default=0)
    note = "The generated scenes that come nearest to a real one, each with its nearest real scenes and their distance."
    return Pictures("Is it memorised?", pictures, columns=columns, note=note)


def build_memorisation_table(found: Mapping) -> Table:
    rows = [
        (words, *(format_value(found[side][name]) for side in ("generated", "real")))
        for name, words in (("mean", "mean"), ("median", "median"), ("minimum", "smallest"), ("maximum", "greatest"))
    ]
    note = (
        f"In {found['features']} features. {format_value(found['memorised'])} of the generated scenes are nearer to "
        "a real "
        "one than all but 1 % of the real ones are to another; "
        f"{format_value(found['copies'])} equal a real one."
    )
    return Table("Distance to the nearest real scene", ("", "generated", "real, to another"), rows, note=note)
