"""Compute precision, recall, density and coverage from nearest neighbours of features, exactly and fast.

The method filters and verifies. A short vector holds the first principal coordinates of features and the length of the
residual. Distances of short vectors never exceed the true ones, and come from a float32 matrix product. A true distance
is computed, in float64 by differences, only where the bounds do not decide. The results are those of the full float64
distance matrix, including ties, in a fraction of its time and memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pipelines.metrics.frechet import check_features

BLOCK_ROWS = 1024  # rows of a block of the distance matrix: 4 kB x number of columns
SPARE_NEIGHBOURS = 8  # candidates beyond the k-th whose upper bounds bound its distance
PAIRS_PER_BLOCK = 128  # pairs per block of exact distances: 2 MB at 2048-d, which fits a cache
BASIS_SAMPLES = 512  # samples that the principal axes are computed from
KEPT_VARIANCE = 0.997  # share of their variance; more axes slow the filter, fewer leave more pairs to verify
MOST_LEFT_OVER = 0.02  # share of the total variance in the residual; above it the filter uses whole features
FLOAT32_ROUNDING = 2.0**-24


@dataclass(frozen=True)
class NeighbourhoodScores:
    """Scores at one neighbourhood size. A ball reaches from a sample to its k-th nearest other sample of its side.

    Precision and recall: Kynkaanniemi et al. 2019, and the paper's supplement; density and coverage: Naeem et al. 2020.
    """

    k: int
    in_real: np.ndarray  # (m,) int64: real balls that each generated sample lies in
    in_generated: np.ndarray  # (n,) bool: each real sample lies in some generated sample's ball
    covered: np.ndarray  # (n,) bool: each real sample's ball holds some generated sample

    @property
    def precision(self) -> float:
        """Return the share of generated samples in some real ball."""
        return float((self.in_real > 0).mean())

    @property
    def recall(self) -> float:
        return float(self.in_generated.mean())

    @property
    def density(self) -> float:
        """Return the mean number of real balls that a generated sample lies in, over k. It may exceed 1."""
        return float(self.in_real.mean() / self.k)

    @property
    def coverage(self) -> float:
        return float(self.covered.mean())


@dataclass(frozen=True, eq=False)
class PrincipalBasis:
    """Principal axes (p, d) of a sample of both sides, orthonormal rows, and their mean (d,), float64.

    None for the features' own axes, all of them.
    """

    mean: np.ndarray
    axes: np.ndarray | None


@dataclass(frozen=True, eq=False)
class FeatureSet:
    """One side's features (n, d) with their short vectors.

    left (n, p + 3) and right (n, p + 3), float32: left[i] . right[j] is the squared distance of the short vectors.
    length (n,): of the features about their mean; rest (n,): of what the axes leave over; slack (n,): bound of a
    product's rounding, per sample of a pair.
    """

    features: np.ndarray
    left: np.ndarray
    right: np.ndarray
    length: np.ndarray
    rest: np.ndarray
    slack: np.ndarray

    def __len__(self) -> int:
        return len(self.features)


def prepare_features(real: np.ndarray, generated: np.ndarray, k: Sequence[int]) -> tuple[FeatureSet, FeatureSet]:
    """Convert both sides to the filter's form.

    Raises ValueError for features that are not finite, of unequal width, or of max(k) samples or fewer.
    """
    real, generated = require_comparable(real, generated, at_least=check_k(k) + 1)
    basis = compute_principal_axes(real, generated)
    sides = project_to_axes(real, basis), project_to_axes(generated, basis)
    whole = sum(np.square(side.length).sum() for side in sides)
    rest = sum(np.square(side.rest).sum() for side in sides)
    if rest <= MOST_LEFT_OVER * whole:
        return sides
    basis = PrincipalBasis(basis.mean, None)
    return project_to_axes(real, basis), project_to_axes(generated, basis)


def compute_neighbourhoods(
    real: np.ndarray, generated: np.ndarray, k: Sequence[int] = (3,)
) -> list[NeighbourhoodScores]:
    """Compute NeighbourhoodScores for each k, from features (n, d) and (m, d) (paper, supplement, Evaluation).

    Memory: BLOCK_ROWS x max(n, m) float32, besides the features. The paper's protocol takes n = m; other sizes work.
    Raises ValueError as `prepare` does.
    """
    sides = prepare_features(real, generated, k)
    radii = [compute_ball_radii(side, range(len(side)), k) for side in sides]
    return judge_neighbours(k, [find_within(sides[0], sides[1], radii[0], radii[1], range(len(real)))])


def judge_neighbours(
    k: Sequence[int], parts: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]
) -> list[NeighbourhoodScores]:
    """Compute NeighbourhoodScores for each k from the `find_within` of all parts of the real samples, in order."""
    parts_in_real, parts_in_generated, parts_covered = zip(*parts, strict=True)
    in_real = np.asarray(sum(parts_in_real))
    in_generated, covered = (np.concatenate(part, axis=1) for part in (parts_in_generated, parts_covered))
    return [NeighbourhoodScores(size, in_real[i], in_generated[i], covered[i]) for i, size in enumerate(k)]


def check_k(k: Sequence[int]) -> int:
    """Return the largest of the neighbourhood sizes. Raises ValueError if there is none or one is below 1."""
    if not k or min(k) < 1:
        raise ValueError(f"k must name neighbourhood sizes of at least 1, got {list(k)}")
    return max(k)


def require_comparable(real: np.ndarray, generated: np.ndarray, at_least: int) -> tuple[np.ndarray, np.ndarray]:
    """Check and return both sides. Raises ValueError as `check_features` does, and for unequal dimensions."""
    real, generated = check_features(real, "real", at_least), check_features(generated, "generated", at_least)
    if real.shape[1] != generated.shape[1]:
        raise ValueError(f"real features have {real.shape[1]} dimensions, generated {generated.shape[1]}")
    return real, generated


# ------------------------------------------------------------------------------------------------------- filter


def compute_principal_axes(real: np.ndarray, generated: np.ndarray) -> PrincipalBasis:
    """Compute the principal axes that hold KEPT_VARIANCE of evenly spaced samples of both sides."""
    count = min(BASIS_SAMPLES // 2, len(real), len(generated))
    some = np.concatenate([side[np.arange(count) * len(side) // count] for side in (real, generated)])
    some = some.astype(np.float64)
    mean = some.mean(axis=0)
    centred = some - mean
    strength, vectors = np.linalg.eigh(centred @ centred.T)  # ascending; far smaller than a decomposition of `centred`
    held = np.cumsum(strength[::-1].clip(0))
    count = 1 + int(np.searchsorted(held, KEPT_VARIANCE * held[-1]))
    axes, _ = np.linalg.qr(centred.T @ vectors[:, -count:])
    return PrincipalBasis(mean, axes.T)


def project_to_axes(features: np.ndarray, basis: PrincipalBasis) -> FeatureSet:
    """Convert features (n, d) to the filter's form.

    For axes Q and x = Q^T c + r: |x - y|^2 = |c - c'|^2 + |r - r'|^2, and |r - r'| lies between the difference and the
    sum of |r| and |r'|. With v = (c, |r|), (-2 v, |v|^2, 1) . (v', 1, |v'|^2) = |v - v'|^2 in one product.
    """
    width = 1 + (len(basis.mean) if basis.axes is None else len(basis.axes))
    left, right = (np.empty((len(features), width + 2), np.float32) for _ in range(2))
    norm, rest = (np.zeros(len(features)) for _ in range(2))
    for start in range(0, len(features), BLOCK_ROWS):
        rows = slice(start, start + BLOCK_ROWS)
        coordinates = centred = features[rows] - basis.mean
        if basis.axes is not None:
            coordinates = centred @ basis.axes.T
            rest[rows] = np.linalg.norm(centred - coordinates @ basis.axes, axis=1)
        short = np.column_stack([coordinates, rest[rows]])
        norm[rows] = np.square(short).sum(axis=1)
        left[rows, :-2], right[rows, :-2] = -2 * short, short
    left[:, -2], left[:, -1], right[:, -2], right[:, -1] = norm, 1, 1, norm
    # |rounding of a product of t terms| <= t u sum |a||b| <= t u 2 (|v|^2 + |v'|^2), and t + 4 grants the terms' own.
    slack = 2 * (width + 6) * FLOAT32_ROUNDING * norm
    return FeatureSet(features, left, right, np.sqrt(norm), rest, slack)


# ------------------------------------------------------------------------------------------------------- verify


def compute_ball_radii(side: FeatureSet, rows: range, k: Sequence[int]) -> np.ndarray:
    """(len(k), len(rows)) squared distance of each sample of `rows` to its k-th nearest other sample."""
    radii = np.empty((len(k), len(rows)))
    for block in iterate_blocks(rows):
        radii[:, block.start - rows.start : block.stop - rows.start] = find_nearest(
            side, side, block, check_k(k), themselves=True
        )[0][:, [size - 1 for size in k]].T
    return radii


def find_nearest(
    side: FeatureSet, others: FeatureSet, rows: range, count: int, themselves: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Squared distances (rows, count) of samples of `side` to the nearest of `others`, ascending, and their indices.

    `themselves`: both are one side, and no sample is its own neighbour. Of equal distances the lower index comes first.
    """
    bound = torch.from_numpy(side.left[rows.start : rows.stop] @ others.right.T)
    own = torch.arange(len(rows))
    if themselves:
        bound[own, own + rows.start] = torch.inf
    low, column = bound.topk(min(count + SPARE_NEIGHBOURS, len(others) - themselves), largest=False)
    here, slack = slice(rows.start, rows.stop), side.slack[rows.start : rows.stop] + others.slack.max()
    high = low.numpy() + 4 * side.rest[here, None] * others.rest[column.numpy()]
    reach = np.sort(high, axis=1)[:, count - 1] + 2 * slack
    row, column = torch.nonzero(bound <= round_up_float32(reach)[:, None]).numpy().T
    squared = compute_squared_distances(side.features, row + rows.start, others.features, column)
    order = np.lexsort((column, squared, row))
    first = np.searchsorted(row, np.arange(len(rows)))
    chosen = order[first[:, None] + np.arange(count)]
    return squared[chosen], column[chosen]


def find_within(
    real: FeatureSet, generated: FeatureSet, real_radii: np.ndarray, generated_radii: np.ndarray, rows: range
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the samples within the balls of both sides, for the real samples of `rows`.

    Args:
        real: Real samples.
        generated: Generated samples.
        real_radii: (len(k), n) squared radii.
        generated_radii: (len(k), m) squared radii.
        rows: Real samples to judge.

    Returns:
        in_real (len(k), m): number of balls of `rows` that hold each generated sample, to be summed over parts;
        in_generated and covered (len(k), len(rows)).
    """
    in_real = np.zeros(generated_radii.shape, np.int64)
    in_generated, covered = (np.zeros((len(real_radii), len(rows)), bool) for _ in range(2))
    to_column = round_up_float32(generated_radii.max(axis=0) + generated.slack + real.slack.max())
    to_row = round_up_float32(real_radii.max(axis=0) + real.slack + generated.slack.max())
    for block in iterate_blocks(rows):
        bound = torch.from_numpy(real.left[block.start : block.stop] @ generated.right.T)
        close = bound <= torch.maximum(to_row[block.start : block.stop, None], to_column)
        row, column = torch.nonzero(close).numpy().T
        low = bound[close].numpy().astype(np.float64)
        row += block.start
        slack = real.slack[row] + generated.slack[column]
        squared, low, high = low, low - slack, low + slack + 4 * real.rest[row] * generated.rest[column]
        unsure = np.zeros(len(row), bool)
        for radii in (real_radii[:, row], generated_radii[:, column]):
            unsure |= ((low <= radii) & (radii <= high)).any(axis=0)
        squared[unsure] = compute_squared_distances(real.features, row[unsure], generated.features, column[unsure])
        for index in range(len(real_radii)):
            held = squared <= real_radii[index, row]
            in_real[index] += np.bincount(column[held], minlength=len(generated))
            covered[index, row[held] - rows.start] = True
            in_generated[index, row[squared <= generated_radii[index, column]] - rows.start] = True
    return in_real, in_generated, covered


def compute_squared_distances(a: np.ndarray, i: np.ndarray, b: np.ndarray, j: np.ndarray) -> np.ndarray:
    """(p,) squared distances of a[i] and b[j] in float64, by differences; bit-identical if the sides are swapped."""
    squared = np.empty(len(i))
    for start in range(0, len(i), PAIRS_PER_BLOCK):
        block = slice(start, start + PAIRS_PER_BLOCK)
        difference = np.subtract(a[i[block]], b[j[block]], dtype=np.float64)
        np.einsum("pd,pd->p", difference, difference, out=squared[block])
    return squared


def round_up_float32(values: np.ndarray) -> Tensor:
    """Round values up to float32."""
    rounded = values.astype(np.float32)
    return torch.from_numpy(np.where(rounded < values, np.nextafter(rounded, np.float32(np.inf)), rounded))


def iterate_blocks(rows: range) -> list[range]:
    """Split rows into blocks of BLOCK_ROWS."""
    return [range(start, min(start + BLOCK_ROWS, rows.stop)) for start in range(rows.start, rows.stop, BLOCK_ROWS)]
