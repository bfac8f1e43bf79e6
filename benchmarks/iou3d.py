"""Measure speed and errors of exact IoU3D of rotated boxes and of sampled IoU3D of ellipsoids.

    python benchmarks/iou3d.py

Cases and reference values come from tests/unit/test_iou3d.py. The reference is manifold3d. If manifold3d disagrees, the
reference is an intersection of half-spaces in float64. Times are CPU seconds of one thread.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1] / "tests/unit"))

import numpy as np
from common import DENSE_SEEDS, describe_machine, format_ratios, spread, time_interleaved
from scipy.spatial.transform import Rotation
from test_iou3d import TOLERANCE, disturbed, halfspace_iou, manifold_iou, pairs, random_boxes, sphere_lens

from models.geometry.iou3d import (
    Boxes,
    compute_ellipsoid_iou3d_pairs,
    compute_iou3d_matrix,
    compute_iou3d_pairs,
    extract_boxes,
    find_overlapping_bounds,
    make_boxes,
)
from models.scene import ELLIPSOID
from pipelines.preprocess.sources.town.generator import generate_town

ROUNDS = 7
NUM_PAIRS, NUM_MANIFOLD = 100_000, 1_000
PAPER_OBJECTS = 514


def main() -> None:
    print(describe_machine())
    time_overlapping_pairs()
    time_whole_scenes()
    print_errors()
    print_ellipsoid_errors()


def time_overlapping_pairs() -> None:
    """Measure the time per pair of overlapping rotated boxes, for this project's code and for manifold3d."""
    rng = np.random.default_rng(0)
    a, b = random_boxes(rng, 3 * NUM_PAIRS, 0.5, 0.5, 4), random_boxes(rng, 3 * NUM_PAIRS, 0.5, 0.5, 4)
    kept = np.flatnonzero(compute_iou3d_pairs(a, b) > 0)[:NUM_PAIRS]
    a, b = a.take(kept), b.take(kept)
    few = np.arange(NUM_MANIFOLD)
    ways = {
        "ours": lambda _: compute_iou3d_pairs(a, b),
        "manifold3d": lambda _: manifold_iou(a.take(few), b.take(few)),
    }
    seconds = time_interleaved(ways, ROUNDS)
    ours, theirs = ([s / n for s in seconds[name]] for name, n in (("ours", len(kept)), ("manifold3d", len(few))))
    rates = [[1e-3 / s for s in per_pair] for per_pair in (ours, theirs)]
    print(
        f"{len(kept)} overlapping pairs, thousand pairs/s/core: ours {spread(rates[0], 1, 0)}, "
        f"manifold3d {spread(rates[1])}: {format_ratios(theirs, ours, 0)}"
    )


def time_whole_scenes() -> None:
    """Measure the time of all pairs of predicted and true boxes of a scene.

    Bounds exclude most pairs. In AP3D, different categories exclude more pairs.
    """
    rng = np.random.default_rng(1)
    scenes = [drive.scene(len(drive) // 2) for drive in map(generate_town, DENSE_SEEDS)]
    truths = [(extract_boxes(scene), scene.category) for scene in scenes]
    joined = make_boxes(*(np.concatenate(parts) for parts in zip(*(box for box, _ in truths), strict=True)))
    crowd = np.arange(PAPER_OBJECTS)
    crowded = (joined.take(crowd), np.concatenate([category for _, category in truths])[crowd])
    for name, chosen in (
        ("dense towns", truths),
        (f"{PAPER_OBJECTS} boxes from several towns, moved to the same position", [crowded]),
    ):
        sides = [(disturbed(rng, box, 0.1), box, category[:, None] == category) for box, category in chosen]
        count = sum(len(a.size_m) * len(b.size_m) for a, b, _ in sides)
        for kind in ("all pairs", "pairs of one category"):
            masks = [same if kind == "pairs of one category" else np.ones_like(same) for _, _, same in sides]
            survive = sum(
                int(mask[find_overlapping_bounds(a, b)].sum()) for (a, b, _), mask in zip(sides, masks, strict=True)
            )
            seconds = time_interleaved(
                {
                    kind: lambda _, s=sides, w=masks: [
                        compute_iou3d_matrix(a, b, m) for (a, b, _), m in zip(s, w, strict=True)
                    ]
                },
                ROUNDS,
            )[kind]
            per_scene = [1e3 * s / len(sides) for s in seconds]
            print(
                f"{name}, {kind}: "
                f"{spread([1e-6 * count / s for s in seconds], 1, 1)} million pairs/s/core (including excluded pairs), "
                f"{100 * survive / count:.1f} % of {count} pairs computed, {spread(per_scene, 1, 1)} ms per scene"
            )


def print_errors() -> None:
    """Print errors against manifold3d, or against half-space intersection if manifold3d exceeds the tolerance."""
    print(f"{'case':36s} pairs   our error: median, largest   error > {TOLERANCE:g}   same for manifold3d")
    total = wrong = 0
    for name, (a, b) in pairs(np.random.default_rng(0)).items():
        ours, oracle = compute_iou3d_pairs(a, b), manifold_iou(a, b)
        error, theirs = np.abs(ours - oracle), 0
        for i in np.flatnonzero(~(error <= TOLERANCE)):
            exact = halfspace_iou(a, b, i)
            error[i] = abs(ours[i] - exact)
            theirs += not abs(oracle[i] - exact) <= TOLERANCE
        off = int((~(error <= TOLERANCE)).sum())
        total, wrong = total + len(ours), wrong + off
        print(f"{name:36s} {len(ours):5d}   {np.median(error):15.1e} {error.max():11.1e} {off:12d} {theirs:18d}")
    print(f"{wrong} of {total} pairs have an error of more than {TOLERANCE:g}")


def print_ellipsoid_errors() -> None:
    """Print errors against the closed form of spheres.

    If both spheres are stretched, the resulting ellipsoids have the same IoU.
    """
    rng, n = np.random.default_rng(2), 2_000
    radius, distance = rng.uniform(0.5, 2, (2, n)), rng.uniform(0, 3, n)
    lens = sphere_lens(*radius, distance)
    exact = lens / (4 / 3 * np.pi * (radius**3).sum(axis=0) - lens)
    stretch, turn = np.exp(rng.uniform(-1, 1, (n, 3))), Rotation.random(n, rng=rng).as_matrix()
    center = np.stack([np.zeros((n, 3)), distance[:, None] * draw_directions(rng, n)])
    sides = [
        Boxes(np.einsum("nij,nj->ni", turn, c * stretch), turn, 2 * r[:, None] * stretch)
        for c, r in zip(center, radius, strict=True)
    ]
    error = compute_ellipsoid_iou3d_pairs(*sides) - exact
    seconds = time_interleaved({"ours": lambda _: compute_ellipsoid_iou3d_pairs(*sides)}, ROUNDS)["ours"]
    print(
        f"ellipsoids, sampled: largest error {np.abs(error).max():.4f}, "
        f"root mean square {np.sqrt(np.mean(error**2)):.5f}; "
        f"{spread([1e-3 * n / s for s in seconds], 1, 1)} thousand pairs/s/core"
    )
    real = [s.select(s.category == ELLIPSOID) for s in (generate_town(seed).scene(100) for seed in DENSE_SEEDS)]
    pair = [(extract_boxes(s), disturbed(rng, extract_boxes(s), 0.1)) for s in real if len(s)]
    survive = [len(find_overlapping_bounds(a, b)[0]) for a, b in pair]
    print(f"ellipsoids of dense towns: {', '.join(map(str, survive))} pairs per scene with overlapping bounds")


def draw_directions(rng: np.random.Generator, n: int) -> np.ndarray:
    at = rng.normal(size=(n, 3))
    return at / np.linalg.norm(at, axis=1, keepdims=True)


if __name__ == "__main__":
    main()
