"""Compare generated scenes with real scenes, or any two sources, by scores of the scenes' features.

features.py computes the features. Each score has a 95 % interval over scenes (metrics/intervals.py). Only scores of
Inception features have the usual names (fid, sfid, kid, inception_score, precision, ...). The names of other scores
have a prefix: `layout_` for layout statistics, `relation_` for relation statistics, `lite0_` for EfficientNet-Lite0,
and `random_` for a network with random weights. `two_sample_auc` uses layout and relation statistics.

A score means something only next to two other values from the same run: a ceiling (other real scenes) and controls
(damaged real scenes). `score_sets` computes all of them with the same reference scenes and the same number of scenes.
reconstruction.py scores reconstructions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np
import ray

from models.scene import CATEGORIES
from pipelines.metrics import distributions, statistics, validity
from pipelines.metrics.adm_npz import ReferenceMoments
from pipelines.metrics.controls import CONTROLS
from pipelines.metrics.frechet import (
    StoredGaussian,
    compute_frechet_distance,
    compute_frechet_influence,
    compute_influence_maps,
    compute_moments,
    compute_transport,
)
from pipelines.metrics.inception_score import compute_inception_score
from pipelines.metrics.intervals import Estimate, estimate_from_influence, estimate_mean, estimate_ratios
from pipelines.metrics.kernel_distance import compute_kernel_distance
from pipelines.metrics.neighbours import (
    FeatureSet,
    NeighbourhoodScores,
    compute_ball_radii,
    find_nearest,
    find_within,
    iterate_blocks,
    judge_neighbours,
    prepare_features,
    require_comparable,
)
from pipelines.metrics.relations import RELATION_HISTOGRAMS, RELATIONS
from pipelines.metrics.two_sample import FOLDS, MIN_SCENES, classify_samples
from pipelines.runtime.ray_tasks import MAX_RETRIES

Described = Mapping[str, np.ndarray]  # Arrays, or StoredFeatures that are read when they are used.
Unit = tuple[Callable[..., dict], tuple]
ROWS_PER_TASK = 4096
RELATION_LIMIT = 5.0  # Standardised relation statistics are clipped to this value; rare categories have outliers.
NEIGHBOURS = 3  # Number of nearest real scenes that are reported per generated scene.
LIMIT_QUANTILE = 0.01  # Quantile of the distances from real scenes to their nearest other real scene.
# Features of the distances to the nearest real scene, best first, and their names in the report.
NEAREST_FEATURES = {
    "vgg16": "VGG16 fc",
    "pool3": "Inception pool3",
    "lite0": "EfficientNet-Lite0",
    "random": "untrained",
}


def compare_datasets(
    real: Described,
    generated: Described,
    ground_classes: Sequence[str] = (),
    k: Sequence[int] = (3,),
    reference: ReferenceMoments | None = None,
) -> dict:
    """Score `generated` against `real`.

    Args:
        real: Features of the real scenes (dictionary from name to array).
        generated: Features of the generated scenes (dictionary from name to array).
        ground_classes: Names of the ground classes in the layout statistics.
        k: Neighbourhood sizes of precision and recall.
        reference: Moments of all real pictures. If these moments are given, fid and sfid are computed against them, as
            in ADM's evaluator.

    Returns:
        Nested scores. Scores with an interval are Estimates.
    """
    counts = {"real": len(real["scene_id"]), "generated": len(generated["scene_id"])}
    units = list_set_units(real, generated, ground_classes, k)
    if "statistics" in real and "statistics" in generated:
        units.append((compute_layout_scores, (real, generated, tuple(ground_classes))))
    if "pool3" in real and "pool3" in generated:
        units.append((compute_inception_scores, (real, generated, reference)))
    return {"scenes": counts} | run_units(units)


def list_set_units(
    real: Described, generated: Described, ground_classes: Sequence[str] = (), k: Sequence[int] = (3,)
) -> list[Unit]:
    """List the computations of `compute_set_scores`. They are independent and run as Ray tasks.

    Args:
        real: Features of the real scenes.
        generated: Features of the generated scenes, or of a ceiling or control.
        ground_classes: Names of the ground classes in the layout statistics.
        k: Neighbourhood sizes of precision and recall.

    Returns:
        Functions with their arguments; each returns a dictionary of scores.
    """
    sides = real, generated

    def both_have(name: str) -> bool:
        return all(name in side for side in sides)

    units: list[Unit] = []
    if both_have("statistics"):
        units += [(compute_statistics_scores, (*sides, name)) for name in ("relation", "layout")]
        units.append((compute_two_sample_scores, (*sides, tuple(ground_classes))))
    spaces = {"pool3": ("", {"frechet": "fid", "mmd": "kid"}), "lite0": ("lite0_", {"mmd": "kid"})}
    for features, (prefix, names) in (spaces | {"random": ("random_", {})}).items():
        if both_have(features):
            units.append((compute_space_scores, (*sides, features, prefix, names, tuple(k))))
    if both_have("spatial"):
        units.append((compute_spatial_scores, sides))
    return units


def compute_set_scores(
    real: Described, generated: Described, ground_classes: Sequence[str] = (), k: Sequence[int] = (3,)
) -> dict[str, Any]:
    """Compute the scores that compare two sets of scenes as wholes.

    Args:
        real: Features of the real scenes.
        generated: Features of the generated scenes, or of a ceiling or control.
        ground_classes: Names of the ground classes in the layout statistics.
        k: Neighbourhood sizes of precision and recall.

    Returns:
        Estimates by name, and `two_sample_features`.
    """
    return run_units(list_set_units(real, generated, ground_classes, k))


def run_units(units: Sequence[Unit]) -> dict[str, Any]:
    """Run computations as Ray tasks, and merge their dictionaries in order (`map_units`)."""
    return {name: value for part in map_units(units) for name, value in part.items()}


def map_units(units: Sequence[Unit]) -> list[dict[str, Any]]:
    """Run computations as Ray tasks.

    The driver holds neither features nor matrices: a task reads the columns that it uses (`StoredFeatures`).

    Args:
        units: Functions with their arguments.

    Returns:
        Dictionary of each computation, in order.
    """
    shared: dict[int, Any] = {}

    def share(value: Any) -> Any:
        if isinstance(value, dict) and any(isinstance(part, np.ndarray) for part in value.values()):
            return shared.setdefault(id(value), ray.put(value))
        return value

    return ray.get([run_unit.remote(function, *map(share, arguments)) for function, arguments in units])


@ray.remote(num_cpus=1, max_retries=MAX_RETRIES)
def run_unit(function: Callable[..., Any], *arguments: Any) -> Any:
    return function(*arguments)


def standardize_sides(real: Described, generated: Described, name: str) -> Sequence[np.ndarray]:
    """Return the standardised layout or relation statistics of both sides."""
    if name == "layout":
        return statistics.standardize_statistics(real["statistics"], generated["statistics"])
    parts = statistics.standardize_statistics(real["relations"], generated["relations"])
    return [part.clip(-RELATION_LIMIT, RELATION_LIMIT) for part in parts]


def compute_statistics_scores(real: Described, generated: Described, name: str) -> dict[str, Estimate]:
    """Compute the Frechet distance and the MMD of layout or relation statistics; `name` is "layout" or "relation"."""
    sides = standardize_sides(real, generated, name)
    return {f"{name}_frechet": estimate_frechet(*sides), f"{name}_mmd": compute_kernel_distance(*sides)}


def compute_two_sample_scores(real: Described, generated: Described, ground_classes: Sequence[str]) -> dict[str, Any]:
    """Compute the AUC of the two-sample test; no scores if there are too few scenes or places."""
    places = group_places(real["place"]), group_places(generated["place"])
    if min(map(len, places)) < MIN_SCENES or min(len(np.unique(side)) for side in places) < FOLDS:
        return {}
    features = [np.concatenate([side["relations"], side["statistics"]], axis=1) for side in (real, generated)]
    names = [*RELATIONS, *statistics.list_statistic_names(ground_classes)]
    found = classify_samples(features[0], features[1], names, places)
    return {"two_sample_auc": found.auc, "two_sample_features": found.features}


def compute_space_scores(
    real: Described, generated: Described, features: str, prefix: str, names: Mapping[str, str], k: Sequence[int]
) -> dict[str, Estimate]:
    """Compute `compute_feature_scores` of a column, with a prefix and with other names."""
    found = compute_feature_scores(real[features], generated[features], k)
    return {prefix + names.get(name, name): value for name, value in found.items()}


def compute_spatial_scores(real: Described, generated: Described) -> dict[str, Estimate]:
    """Compute sfid."""
    return {"sfid": estimate_frechet(real["spatial"], generated["spatial"])}


def compute_inception_scores(
    real: Described, generated: Described, reference: ReferenceMoments | None
) -> dict[str, Estimate | None]:
    """Compute the Inception score of both sides, and fid and sfid against the moments of all real pictures."""
    scores: dict[str, Estimate | None] = {}
    if reference:
        scores["fid"] = compute_frechet_to(reference.pool3, generated["pool3"])
        scores["sfid"] = compute_frechet_to(reference.spatial, generated["spatial"]) if reference.spatial else None
    scores["inception_score"] = compute_inception_score(generated["logits"])
    return scores | {"inception_score_real": compute_inception_score(real["logits"])}


def group_places(places: np.ndarray) -> np.ndarray:
    """Group scenes by drive if there are enough drives, otherwise by place.

    Args:
        places: (n,) places from features.py, such as "kitti360/<drive>/3/-1".

    Returns:
        (n,) names of the groups.
    """
    drives = np.array([name.rsplit("/", 2)[0] for name in places])
    return drives if len(np.unique(drives)) >= FOLDS else places


# ------------------------------------------------------------------------------------------- ceiling and controls


def rate_validity(side: Described) -> dict[str, Estimate | None]:
    """Estimate the rate of each of validity.MEASURES.

    Args:
        side: Features of a set of scenes.

    Returns:
        Rates by name. None: the measure applies to no object.
    """
    return dict(zip(validity.MEASURES, compute_pair_ratios(side["validity"]), strict=True))


def score_sets(
    real: Described, sets: Mapping[str, Described], ground_classes: Sequence[str] = (), k: Sequence[int] = (3,)
) -> dict[str, dict[str, Estimate]]:
    """Score several sets of scenes against the same real scenes, in parallel Ray tasks.

    Args:
        real: Features of the reference scenes.
        sets: Features of each set, for example of generated scenes, of other real scenes and of damaged scenes.
        ground_classes: Names of the ground classes in the layout statistics.
        k: Neighbourhood sizes of precision and recall.

    Returns:
        Scores of each set. Names of validity measures begin with `validity.`.
    """
    units = {name: list_set_units(real, side, ground_classes, k) for name, side in sets.items()}
    parts = iter(map_units([unit for of_set in units.values() for unit in of_set]))
    found: dict[str, dict[str, Estimate]] = {}
    for name, side in sets.items():
        scores = {key: value for _ in units[name] for key, value in next(parts).items()}
        found[name] = {key: value for key, value in scores.items() if isinstance(value, Estimate)}
        if "validity" in side:
            rates = rate_validity(side)
            found[name] |= {f"validity.{key}": rate for key, rate in rates.items() if rate is not None}
    return found


def measure_badness(name: str, value: float) -> float:
    """Convert a score to a number that is larger for worse scores.

    Args:
        name: Name of the score.
        value: Value of the score.

    Returns:
        The value itself, or its negative.
    """
    higher_is_better = ("precision", "recall", "density", "coverage", "inception_score", "road_connectivity")
    return -value if any(word in name for word in higher_is_better) else value


def is_sensitive(name: str, control: Estimate, ceiling: Estimate) -> bool:
    """Return whether a score rates a control worse than the ceiling, with disjoint 95 % intervals.

    Args:
        name: Name of the score.
        control: Score of the control.
        ceiling: Score of other real scenes.

    Returns:
        True if the score notices the damage.
    """
    is_disjoint = control.low > ceiling.high or control.high < ceiling.low
    return is_disjoint and measure_badness(name, control.value) > measure_badness(name, ceiling.value)


def find_sensitive_scores(sets: Mapping[str, Mapping[str, Estimate]]) -> dict[str, list[str]]:
    """Find the controls that each score notices.

    Args:
        sets: Scores by set; "ceiling" and any number of controls.

    Returns:
        Names of the controls for each score of the ceiling.
    """
    ceiling, names = sets["ceiling"], [name for name in sets if name in CONTROLS]
    return {
        score: [name for name in names if score in sets[name] and is_sensitive(score, sets[name][score], value)]
        for score, value in ceiling.items()
    }


# ----------------------------------------------------------------------------------------------------- features


def estimate_frechet(real: np.ndarray, generated: np.ndarray) -> Estimate:
    """Estimate the Frechet distance of two sets of features; both sets are resampled."""
    a, b = compute_moments(real), compute_moments(generated)
    between = compute_transport(a, b, real)
    by_real, by_generated = compute_influence_maps(b, between)
    influences = [
        compute_frechet_influence(real, a, b.mean, by_real),
        compute_frechet_influence(generated, b, a.mean, by_generated),
    ]
    return estimate_from_influence(compute_frechet_distance(a, b, between), influences)


def compute_frechet_to(reference: StoredGaussian, generated: np.ndarray) -> Estimate:
    """Estimate the Frechet distance to fixed moments; only the generated samples are resampled."""
    b = compute_moments(generated)
    between = compute_transport(reference, b)
    influence = compute_frechet_influence(generated, b, reference.mean, compute_influence_maps(b, between)[1])
    return estimate_from_influence(compute_frechet_distance(reference, b, between), [influence])


def compute_feature_scores(real: np.ndarray, generated: np.ndarray, k: Sequence[int]) -> dict[str, Estimate]:
    """Compute frechet, mmd and `compute_neighbourhood_scores`.

    Raises:
        ValueError: The features are not finite. The message names the side and the sample.
    """
    real, generated = require_comparable(real, generated, at_least=2)
    found = {"frechet": estimate_frechet(real, generated), "mmd": compute_kernel_distance(real, generated)}
    return found | compute_neighbourhood_scores(real, generated, k)


def compute_neighbourhood_scores(real: np.ndarray, generated: np.ndarray, k: Sequence[int]) -> dict[str, Estimate]:
    """Compute precision, recall, density and coverage for each k, with names such as precision_k3.

    For the intervals, only the samples that are tested for membership in a ball are resampled. The balls are kept. If a
    resample defined the balls, a sample that is drawn twice would be its own neighbour.

    Raises:
        ValueError: There are too few samples for the largest k.
    """
    if max(k) >= min(len(real), len(generated)):
        raise ValueError(
            f"--k {max(k)} needs more than {max(k)} scenes on each side, got {len(real)} and {len(generated)}; "
            "give a smaller k or more scenes"
        )
    found = {}
    for one in map_neighbourhoods(real, generated, k):
        found[f"precision_k{one.k}"] = estimate_mean(one.in_real > 0, key=1)
        found[f"recall_k{one.k}"] = estimate_mean(one.in_generated)
        found[f"density_k{one.k}"] = estimate_mean(one.in_real / one.k, key=1)
        found[f"coverage_k{one.k}"] = estimate_mean(one.covered)
    return found


def map_neighbourhoods(real: np.ndarray, generated: np.ndarray, k: Sequence[int]) -> list[NeighbourhoodScores]:
    """Compute precision, recall, density and coverage in Ray tasks of ROWS_PER_TASK rows; `judge_neighbours`."""
    sides = [Shared(side) for side in prepare_features(real, generated, k)]
    radii = [
        Shared(np.concatenate(map_tiles(partial(compute_ball_radii, k=k), len(side.value), side), axis=1))
        for side in sides
    ]
    return judge_neighbours(k, map_tiles(find_within, len(real), *sides, *radii))


class Shared:
    """A value that several Ray tasks use. It is stored once, when the first task needs it."""

    def __init__(self, value: Any) -> None:
        self.value = value

    @cached_property
    def reference(self) -> Any:
        return ray.put(self.value)


def map_tiles(function: Callable[..., Any], count: int, *arguments: Shared) -> list[Any]:
    """Call a function with ranges of ROWS_PER_TASK rows, as Ray tasks if there are several.

    A single range is computed here: a task inside a task would start another process.

    Args:
        function: Function of the arguments and a range of rows.
        count: Number of rows.
        *arguments: Arguments.

    Returns:
        Results in the order of the rows.
    """
    tiles = [range(start, min(start + ROWS_PER_TASK, count)) for start in range(0, count, ROWS_PER_TASK)]
    if len(tiles) == 1:
        return [function(*(argument.value for argument in arguments), tiles[0])]
    references = [argument.reference for argument in arguments]
    return ray.get([run_unit.remote(function, *[*references, tile]) for tile in tiles])


def find_nearest_rows(
    side: FeatureSet, others: FeatureSet, rows: range, count: int, themselves: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Run `find_nearest` in blocks of rows."""
    parts = [find_nearest(side, others, block, count, themselves) for block in iterate_blocks(rows)]
    squared, index = zip(*parts, strict=True)
    return np.concatenate(squared), np.concatenate(index)


def score_nearest_distances(real: Described, generated: Described) -> tuple[str, dict]:
    """Compute the distances to the nearest real scene with the best features that both sides have.

    Returns:
        Name of the score, and `compute_nearest_distances` with the name of the features. The name is `memorisation`
        only for VGG16, the network of the paper's analysis; otherwise it names the features, such as
        `nearest_distance_lite0`.
    """
    features = next(name for name in NEAREST_FEATURES if name in real and name in generated)
    found = run_units([(compute_column_distances, (real, generated, features))])
    name = "memorisation" if features == "vgg16" else f"nearest_distance_{features}"
    return name, found | {"features": NEAREST_FEATURES[features]}


def compute_column_distances(real: Described, generated: Described, features: str) -> dict:
    """Run `compute_nearest_distances` with a column of features."""
    return compute_nearest_distances(real[features], generated[features])


def compute_nearest_distances(real: np.ndarray, generated: np.ndarray) -> dict:
    """Compare the distances from generated to real samples with the distances between real samples.

    With VGG16 features, this is the paper's analysis of memorisation (supplement).

    Returns:
        `generated`: statistics of the distance from each generated sample to the nearest real sample. `real`:
        statistics of the distance from each real sample to the nearest other real sample. `below_limit`: share
        of generated samples with a distance below the 1 % quantile of the distances of real samples. `copies`: share of
        generated samples at distance 0. `nearest` (m, 3): for each generated sample, the indices of the three nearest
        real samples; the nearest comes first. `distance` (m, 3): distances from each generated sample to these nearest
        real samples.
    """
    sides = [Shared(side) for side in prepare_features(real, generated, (NEIGHBOURS,))]
    find_others = partial(find_nearest_rows, count=NEIGHBOURS, themselves=False)
    found_others = map_tiles(find_others, len(generated), sides[1], sides[0])
    squared, index = (np.concatenate(part) for part in zip(*found_others, strict=True))
    find_own = partial(find_nearest_rows, count=1, themselves=True)
    own = np.sqrt(np.concatenate([part[0][:, 0] for part in map_tiles(find_own, len(real), sides[0], sides[0])]))
    distance = np.sqrt(squared)
    found = {}
    for name, values in (("generated", distance[:, 0]), ("real", own)):
        found[name] = {
            "mean": estimate_mean(values),
            "median": float(np.median(values)),
            "minimum": float(values.min()),
            "maximum": float(values.max()),
        }
    limit = np.quantile(own, LIMIT_QUANTILE)
    found["below_limit"] = estimate_mean(distance[:, 0] < limit)
    found["copies"] = estimate_mean(distance[:, 0] == 0)
    return found | {"nearest": index, "distance": distance}


# ------------------------------------------------------------------------------------------------------ layouts


def compute_layout_scores(real: Described, generated: Described, ground_classes: Sequence[str]) -> dict:
    """Compute statistics and validity of both sides, distances between the sides, and label fidelity."""
    names = statistics.list_statistic_names(ground_classes)
    sides = {"real": real, "generated": generated}
    means = {side: compute_scene_means(part["statistics"]) for side, part in sides.items()}
    rates = {side: compute_pair_ratios(part["validity"]) for side, part in sides.items()}
    categories = slice(0, len(CATEGORIES))
    # The distance between two halves of the real scenes is about the lowest distance that a source can reach.
    halves = real["statistics"][::2], real["statistics"][1::2]
    counts = distributions.compute_count_distances(*(part["statistics"][:, categories] for part in sides.values()))
    count_floor = distributions.compute_count_distances(*(half[:, categories] for half in halves))
    return {
        "statistics": {name: {side: means[side][i] for side in sides} for i, name in enumerate(names)},
        "count_distance": {name: {"between": counts[name], "within_real": count_floor[name].value} for name in counts},
        "distance": compare_histograms(real, generated, "histograms", distributions.HISTOGRAMS),
        "relation_distance": compare_histograms(real, generated, "relation_histograms", RELATION_HISTOGRAMS),
        "validity": {name: {side: rates[side][i] for side in sides} for i, name in enumerate(validity.MEASURES)},
        "category_validity": {side: compute_category_rates(part["category_validity"]) for side, part in sides.items()},
        "label_fidelity": dict(zip(validity.LABEL_MEASURES, compute_pair_ratios(generated["fidelity"]), strict=True)),
    }


def compare_histograms(
    real: Described, generated: Described, column: str, histograms: Sequence[distributions.Histogram]
) -> dict[str, dict]:
    """Compute the distance of each histogram between the sides, and between two halves of the real scenes."""
    found = distributions.compute_histogram_distances(real[column], generated[column], histograms)
    floor = distributions.compute_histogram_distances(real[column][::2], real[column][1::2], histograms)
    return {
        name: {"between": value, "within_real": floor[name].value if name in floor else None}
        for name, value in found.items()
    }


def compute_category_rates(records: np.ndarray) -> dict[str, dict[str, Estimate]]:
    """Estimate the rate of each object measure for each category that the measure applies to."""
    shape = len(validity.OBJECT_MEASURES), len(CATEGORIES)
    rates = compute_pair_ratios(records)
    return {
        measure: {CATEGORIES[c]: rate for c in range(shape[1]) if (rate := rates[m * shape[1] + c]) is not None}
        for m, measure in enumerate(validity.OBJECT_MEASURES)
    }


def compute_scene_means(values: np.ndarray) -> list[Estimate | None]:
    """Estimate column means, ignoring NaN. The estimate is None if all values of a column are NaN."""
    known = np.isfinite(values)
    return estimate_ratios(np.where(known, values, 0), known)


def compute_pair_ratios(records: np.ndarray) -> list[Estimate | None]:
    """Estimate the rate of each measure from records (n, 2 * measures).

    In a record, the numerator of each measure is followed by the denominator.
    """
    return estimate_ratios(records[:, ::2], records[:, 1::2])


# ------------------------------------------------------------------------------------------------------ writing


def flatten_scores(scores: Mapping, prefix: str = "") -> dict[str, Estimate | float]:
    """Flatten nested scores; names are joined by dots. None, arrays and numbers that are not finite are skipped."""
    flat: dict[str, Estimate | float] = {}
    for name, value in scores.items():
        if isinstance(value, Mapping):
            flat |= flatten_scores(value, f"{prefix}{name}.")
        elif isinstance(value, Estimate):
            flat[prefix + name] = value
        elif isinstance(value, int | float) and np.isfinite(value):
            flat[prefix + name] = float(value)
    return flat


def convert_estimates(scores: Mapping) -> dict:
    """Convert nested scores to values that JSON can store.

    An Estimate becomes a dictionary with value, low and high. NaN and infinity become null. Arrays are skipped.
    """

    def number(value: float) -> float | None:
        return value if np.isfinite(value) else None

    def converted(value: Any) -> Any:
        if isinstance(value, Mapping):
            return convert_estimates(value)
        if isinstance(value, Estimate):
            return {name: number(part) for name, part in value._asdict().items()}
        return number(float(value)) if isinstance(value, np.floating | float) else value

    return {name: converted(value) for name, value in scores.items() if not isinstance(value, np.ndarray)}
