"""Measure the time of precision, recall and FID, and compare it with a direct implementation of ADM's formulas.

    python benchmarks/generation.py                      # 1,000 samples per side with both, 10,000 with ours
    python benchmarks/generation.py --samples 61913      # ours only, on Ray: memory and time

There are two kinds of features. The first kind resembles Inception features: a few dozen of the 2,048 dimensions have
most of the variance. The second kind is isotropic noise. It is the worst case, because all distances are similar. Times
are wall-clock seconds on all cores.
"""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np
import scipy.linalg
import torch
from common import describe_machine, format_ratios, spread, time_interleaved

from pipelines.metrics.frechet import Moments, compute_frechet_distance, compute_moments
from pipelines.metrics.neighbours import compute_neighbourhoods, prepare_features

DIMENSIONS = 2048
ROUNDS = 3


def make_features(count: int, seed: int, falling: bool) -> np.ndarray:
    """Return features (count, 2048) in float32.

    If `falling` is true, no feature is negative. The mean square along axis k of a random basis is then proportional to
    1 / k^2.
    """
    rng = np.random.default_rng(seed)
    values = rng.standard_normal((count, DIMENSIONS), dtype=np.float32)
    if not falling:
        return values
    mix = np.random.default_rng(7).standard_normal((DIMENSIONS, DIMENSIONS), dtype=np.float32) / DIMENSIONS**0.5
    strength = np.arange(1, DIMENSIONS + 1, dtype=np.float32) ** -1.0
    return np.maximum(0.1 + 0.001 * seed + (values * strength) @ mix, 0)


def compute_adm_precision_recall(real: np.ndarray, generated: np.ndarray, k: int = 3) -> tuple[float, float]:
    """Compute precision and recall as ADM's evaluator does.

    The squared distance of x and y is computed in float16 as |x|^2 - 2 x.y + |y|^2. The function sorts whole rows to
    find the radius.
    """
    sides = [torch.from_numpy(side).half() for side in (real, generated)]

    def distances(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        squares = [side.float().square().sum(1).half() for side in (x, y)]
        return (squares[0][:, None] - 2 * (x @ y.T) + squares[1]).clamp(min=0)

    radii = [distances(side, side).float().sort(1).values[:, k] for side in sides]
    between = distances(*sides).float()
    precision = (between <= radii[0][:, None]).any(0).float().mean()
    recall = (between <= radii[1]).any(1).float().mean()
    return float(precision), float(recall)


def compute_adm_frechet(a: Moments, b: Moments) -> float:
    """Compute the Frechet distance with a general matrix square root, as ADM does."""
    root = scipy.linalg.sqrtm(a.covariance @ b.covariance).real
    return float(np.square(a.mean - b.mean).sum() + np.trace(a.covariance + b.covariance - 2 * root))


def read_peak_gib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def compare_with_adm() -> None:
    real, generated = (make_features(1000, seed, True) for seed in (0, 1))
    found = time_interleaved(
        {
            "ADM": lambda _: compute_adm_precision_recall(real, generated),
            "ours": lambda _: compute_neighbourhoods(real, generated),
        },
        ROUNDS,
        time.perf_counter,
    )
    print(
        f"precision and recall, 1,000 a side: ADM {spread(found['ADM'])} s, ours {spread(found['ours'])} s: "
        f"{format_ratios(*found.values())}"
    )
    theirs, ours = compute_adm_precision_recall(real, generated), compute_neighbourhoods(real, generated)[0]
    print(f"  ADM {theirs[0]:.4f} {theirs[1]:.4f}, ours (exact) {ours.precision:.4f} {ours.recall:.4f}")
    a, b = compute_moments(make_features(5000, 0, True)), compute_moments(make_features(5000, 1, True))
    found = time_interleaved(
        {"sqrtm": lambda _: compute_adm_frechet(a, b), "eigenvalues": lambda _: compute_frechet_distance(a, b)},
        ROUNDS,
        time.perf_counter,
    )
    print(
        f"FID from moments: sqrtm {spread(found['sqrtm'])} s, eigenvalues {spread(found['eigenvalues'])} s: "
        f"{format_ratios(*found.values())}"
    )
    print(f"  relative difference {abs(compute_adm_frechet(a, b) / compute_frechet_distance(a, b) - 1):.1e}")


def time_scores(count: int) -> None:
    for name, falling in (("falling spectrum", True), ("isotropic", False)):
        real, generated = (make_features(count, seed, falling) for seed in (0, 1))
        before, seconds = read_peak_gib(), []
        for _ in range(ROUNDS):
            start = time.perf_counter()
            found = compute_neighbourhoods(real, generated)[0]
            seconds.append(time.perf_counter() - start)
        axes = prepare_features(real, generated, (3,))[0].left.shape[1] - 3
        print(
            f"precision and recall, {count:,} a side, {name} ({axes} axes): {spread(seconds)} s, "
            f"{read_peak_gib() - before:.2f} GiB above the features; {found.precision:.4f} {found.recall:.4f}"
        )


def time_scores_over_ray(count: int) -> None:
    import ray

    from pipelines.evaluation.evaluate import map_neighbourhoods

    ray.init(address="local", logging_level="WARNING")
    real, generated = (make_features(count, seed, True) for seed in (0, 1))
    start = time.perf_counter()
    found = map_neighbourhoods(real, generated, (3,))[0]
    print(
        f"precision and recall, {count:,} a side over Ray: {time.perf_counter() - start:.0f} s, driver's peak "
        f"{read_peak_gib():.1f} GiB; {found.precision:.4f} {found.recall:.4f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, help="a side, over Ray")
    count = parser.parse_args().samples
    print(describe_machine())
    if count:
        time_scores_over_ray(count)
    else:
        compare_with_adm()
        time_scores(10_000)


if __name__ == "__main__":
    main()
