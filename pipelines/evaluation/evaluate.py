"""Compare generated scenes with real scenes, or any two sources, by scores of the scenes' features.

features.py computes the features. Each score has a 95 % interval over scenes (metrics/intervals.py). Only scores of
Inception features have the usual names (fid, sfid, kid, inception_score, precision, ...). The names of other scores
have a prefix: `layout_` for layout statistics, and `random_` for a network with random weights. reconstruction.py
scores reconstructions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import ray

from models.scene import CATEGORIES
from pipelines.metrics import distributions, statistics, validity
from pipelines.metrics.adm_npz import ReferenceMoments
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
    judge_neighbours,
    prepare_features,
    require_comparable,
)

Described = Mapping[str, np.ndarray]
ROWS_PER_TASK = 4096
NEIGHBOURS = 3  # Number of nearest real scenes that are reported per generated scene.
MEMORISED_QUANTILE = 0.01  # Quantile of the distances from real scenes to their nearest other real scene.


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
    scores: dict[str, Any] = {"scenes": {"real": len(real["scene_id"]), "generated": len(generated["scene_id"])}}
    if "statistics" in real and "statistics" in generated:
        layout = statistics.standardize_statistics(real["statistics"], generated["statistics"])
        scores |= {"layout_frechet": estimate_frechet(*layout), "layout_mmd": compute_kernel_distance(*layout)}
        scores |= compute_layout_scores(real, generated, ground_classes)
    scores |= {
        f"random_{name}": value
        for name, value in compute_feature_scores(real["random"], generated["random"], k).items()
    }
    if "pool3" in real and "pool3" in generated:
        names = {"frechet": "fid", "mmd": "kid"}
        found = compute_feature_scores(real["pool3"], generated["pool3"], k)
        scores |= {names.get(name, name): value for name, value in found.items()}
        scores["sfid"] = estimate_frechet(real["spatial"], generated["spatial"])
        if reference:
            scores["fid"] = compute_frechet_to(reference.pool3, generated["pool3"])
            scores["sfid"] = compute_frechet_to(reference.spatial, generated["spatial"]) if reference.spatial else None
        scores["inception_score"] = compute_inception_score(generated["logits"])
        scores["inception_score_real"] = compute_inception_score(real["logits"])
    return scores


# ----------------------------------------------------------------------------------------------------- features


def estimate_frechet(real: np.ndarray, generated: np.ndarray) -> Estimate:
    """Estimate the Frechet distance of two sets of features; both sets are resampled."""
    a, b = compute_moments(real), compute_moments(generated)
    between = compute_transport(a, b)
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
    """Run `compute_neighbourhoods` in Ray tasks of ROWS_PER_TASK rows; the tasks share one copy of the features."""
    sides = prepare_features(real, generated, k)
    shared = [ray.put(side) for side in sides]
    radii = [
        np.concatenate(ray.get([compute_radii_task.remote(part, rows, k) for rows in split_rows(len(side))]), axis=1)
        for part, side in zip(shared, sides, strict=True)
    ]
    (real_side, generated_side), (real_balls, generated_balls) = shared, [ray.put(part) for part in radii]
    tasks = [
        find_within_task.remote(real_side, generated_side, real_balls, generated_balls, rows)
        for rows in split_rows(len(real))
    ]
    return judge_neighbours(k, ray.get(tasks))


def split_rows(count: int) -> list[range]:
    return [range(start, min(start + ROWS_PER_TASK, count)) for start in range(0, count, ROWS_PER_TASK)]


@ray.remote(num_cpus=1)
def compute_radii_task(side: FeatureSet, rows: range, k: Sequence[int]) -> np.ndarray:
    return compute_ball_radii(side, rows, k)


@ray.remote(num_cpus=1)
def find_within_task(
    real: FeatureSet, generated: FeatureSet, real_balls: np.ndarray, generated_balls: np.ndarray, rows: range
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return find_within(real, generated, real_balls, generated_balls, rows)


def compute_memorisation(real: np.ndarray, generated: np.ndarray) -> dict:
    """Compare the distances from generated to real samples with the distances between real samples (paper, supplement).

    Returns:
        `generated`: statistics of the distance from each generated sample to the nearest real sample. `real`:
        statistics of the distance from each real sample to the nearest other real sample. `memorised`: share of
        generated samples with a distance below the 1 % quantile of the distances of real samples. `copies`: share of
        generated samples at distance 0. `nearest` (m, 3): for each generated sample, the indices of the three nearest
        real samples; the nearest comes first. `distance` (m, 3): distances from each generated sample to these nearest
        real samples.
    """
    sides = prepare_features(real, generated, (NEIGHBOURS,))
    squared, index = find_nearest(sides[1], sides[0], range(len(generated)), NEIGHBOURS)
    own = np.sqrt(find_nearest(sides[0], sides[0], range(len(real)), 1, themselves=True)[0][:, 0])
    distance = np.sqrt(squared)
    found = {}
    for name, values in (("generated", distance[:, 0]), ("real", own)):
        found[name] = {
            "mean": estimate_mean(values),
            "median": float(np.median(values)),
            "minimum": float(values.min()),
            "maximum": float(values.max()),
        }
    limit = np.quantile(own, MEMORISED_QUANTILE)
    found["memorised"] = estimate_mean(distance[:, 0] < limit)
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
    floor = distributions.compute_histogram_distances(real["histograms"][::2], real["histograms"][1::2])
    distances = distributions.compute_histogram_distances(real["histograms"], generated["histograms"])
    counts = distributions.compute_count_distances(*(part["statistics"][:, categories] for part in sides.values()))
    count_floor = distributions.compute_count_distances(*(half[:, categories] for half in halves))
    return {
        "statistics": {name: {side: means[side][i] for side in sides} for i, name in enumerate(names)},
        "count_distance": {name: {"between": counts[name], "within_real": count_floor[name].value} for name in counts},
        "distance": {
            name: {"between": found, "within_real": floor[name].value if name in floor else None}
            for name, found in distances.items()
        },
        "validity": {name: {side: rates[side][i] for side in sides} for i, name in enumerate(validity.MEASURES)},
        "label_fidelity": dict(zip(validity.LABEL_MEASURES, compute_pair_ratios(generated["fidelity"]), strict=True)),
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
