"""Compute exact precision, recall, density and coverage from the nearest neighbours of features.

The method first discards pairs by a bound on their distance, then verifies the remaining pairs. Each feature vector has
a short vector, which holds its first principal coordinates and the length of the residual. The distance of two short
vectors is a lower bound of the true distance. A float32 matrix product computes this bound. Only undecided pairs need
the true distance, which is computed from differences in float64. The results, including ties, are the same as with the
full float64 distance matrix. The method needs only a fraction of the time and memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pipelines.metrics.frechet import check_features

BLOCK_ROWS = 1024  # Rows per block of the distance matrix; a block takes 4 kB per column.
# Number of candidates in addition to k. The k-th smallest upper bound of the candidates limits the k-th distance.
SPARE_NEIGHBOURS = 8
# Number of pairs per block of exact distances. At 2,048 dimensions, a block has 2 MB and fits into a cache.
PAIRS_PER_BLOCK = 128
BASIS_SAMPLES = 512  # Number of samples from which the principal axes are computed.
# Share of the variance along the principal axes. With more axes, fewer exact distances are necessary.
KEPT_VARIANCE = 0.997
MOST_LEFT_OVER = 0.02  # If the residual holds a larger share of the variance, the whole features are used.
FLOAT32_ROUNDING = 2.0**-24


@dataclass(frozen=True)
class NeighbourhoodScores:
    """Precision, recall, density and coverage for one neighbourhood size.

    The ball of a sample is centred at the sample. The radius of the ball is the distance to the k-th nearest other
    sample of the same set (real or generated). Precision and recall follow Kynkaanniemi et al. 2019 and the supplement
    of the paper. Density and coverage follow Naeem et al. 2020.

    Attributes:
        k: Neighbourhood size.
        in_real: (m,) int64. For each generated sample, the number of balls of real samples that contain this sample.
        in_generated: (n,) bool, whether each real sample lies in the ball of a generated sample.
        covered: (n,) bool, whether the ball of each real sample contains a generated sample.
    """

    k: int
    in_real: np.ndarray
    in_generated: np.ndarray
    covered: np.ndarray

    @property
    def precision(self) -> float:
        """Return the share of generated samples that lie in the ball of a real sample."""
        return float((self.in_real > 0).mean())

    @property
    def recall(self) -> float:
        """Return the share of real samples that lie in the ball of a generated sample."""
        return float(self.in_generated.mean())

    @property
    def density(self) -> float:
        """Return 1 / k times the mean number of real balls that contain a generated sample; it may exceed 1."""
        return float(self.in_real.mean() / self.k)

    @property
    def coverage(self) -> float:
        """Return the share of real samples whose ball contains a generated sample."""
        return float(self.covered.mean())


@dataclass(frozen=True, eq=False)
class PrincipalBasis:
    """Principal axes of the samples of both sides together.

    Attributes:
        mean: (d,) float64 mean of the samples.
        axes: (p, d) float64 orthonormal rows. None: the features themselves are used.
    """

    mean: np.ndarray
    axes: np.ndarray | None


@dataclass(frozen=True, eq=False)
class FeatureSet:
    """Features of one side with their short vectors.

    Attributes:
        features: (n, d) features.
        left: (n, p + 3) float32 left factors of dot products. The dot product of left[i] and right[j] is the squared
            distance of short vectors i and j.
        right: (n, p + 3) float32 right factors of dot products.
        length: (n,) length of the short vector of each sample.
        rest: (n,) length of the residual, the part outside the axes.
        slack: (n,) contribution of each sample to the rounding error of a dot product. The error is at most the sum of
            the contributions of both samples.
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
    """Compute the short vectors of both sides for the filter.

    Args:
        real: (n, d) features.
        generated: (m, d) features.
        k: Neighbourhood sizes.

    Returns:
        Feature sets of the real and the generated side.

    Raises:
        ValueError: The features are not finite or differ in width, or a side has at most max(k) samples.
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
    """Compute NeighbourhoodScores for each neighbourhood size (paper, supplement, Evaluation).

    The paper's protocol has n = m; other sizes are allowed. In addition to the features, memory for BLOCK_ROWS x max(n,
    m) float32 numbers is needed.

    Args:
        real: (n, d) features.
        generated: (m, d) features.
        k: Neighbourhood sizes.

    Returns:
        Scores in the order of k.

    Raises:
        ValueError: The features are not finite or differ in width, or a side has at most max(k) samples.
    """
    sides = prepare_features(real, generated, k)
    radii = [compute_ball_radii(side, range(len(side)), k) for side in sides]
    return judge_neighbours(k, [find_within(sides[0], sides[1], radii[0], radii[1], range(len(real)))])


def judge_neighbours(
    k: Sequence[int], parts: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]
) -> list[NeighbourhoodScores]:
    """Merge the results of `find_within` for all parts of the real samples into NeighbourhoodScores for each k.

    Args:
        k: Neighbourhood sizes.
        parts: Results of `find_within`, in the order of the real samples.

    Returns:
        Scores in the order of k.
    """
    parts_in_real, parts_in_generated, parts_covered = zip(*parts, strict=True)
    in_real = np.asarray(sum(parts_in_real))
    in_generated, covered = (np.concatenate(part, axis=1) for part in (parts_in_generated, parts_covered))
    return [NeighbourhoodScores(size, in_real[i], in_generated[i], covered[i]) for i, size in enumerate(k)]


def check_k(k: Sequence[int]) -> int:
    """Return the largest neighbourhood size.

    Args:
        k: Neighbourhood sizes.

    Returns:
        Largest element of k.

    Raises:
        ValueError: k is empty, or a neighbourhood size is less than 1.
    """
    if not k or min(k) < 1:
        raise ValueError(f"k must name neighbourhood sizes of at least 1, got {list(k)}")
    return max(k)


def require_comparable(real: np.ndarray, generated: np.ndarray, at_least: int) -> tuple[np.ndarray, np.ndarray]:
    """Check the features of both sides and return them as floats.

    Args:
        real: (n, d) features.
        generated: (m, d) features.
        at_least: Minimum number of samples per side.

    Returns:
        Features of both sides, float32 or float64.

    Raises:
        ValueError: The features are not 2-d, are not finite or differ in width, or a side has too few samples.
    """
    real, generated = check_features(real, "real", at_least), check_features(generated, "generated", at_least)
    if real.shape[1] != generated.shape[1]:
        raise ValueError(
            f"real features have {real.shape[1]} dimensions, but generated features have {generated.shape[1]}"
        )
    return real, generated


# ------------------------------------------------------------------------------------------------------- filter


def compute_principal_axes(real: np.ndarray, generated: np.ndarray) -> PrincipalBasis:
    """Compute the principal axes that hold KEPT_VARIANCE of the variance, from evenly spaced samples of both sides.

    Args:
        real: (n, d) features.
        generated: (m, d) features.

    Returns:
        Axes and mean.
    """
    count = min(BASIS_SAMPLES // 2, len(real), len(generated))
    some = np.concatenate([side[np.arange(count) * len(side) // count] for side in (real, generated)])
    some = some.astype(np.float64)
    mean = some.mean(axis=0)
    centred = some - mean
    # The eigenproblem of the samples x samples matrix is much smaller than a decomposition of `centred`. The
    # eigenvalues are ascending.
    strength, vectors = np.linalg.eigh(centred @ centred.T)
    held = np.cumsum(strength[::-1].clip(0))
    count = 1 + int(np.searchsorted(held, KEPT_VARIANCE * held[-1]))
    axes, _ = np.linalg.qr(centred.T @ vectors[:, -count:])
    return PrincipalBasis(mean, axes.T)


def project_to_axes(features: np.ndarray, basis: PrincipalBasis) -> FeatureSet:
    """Compute the short vectors of features for the filter.

    Let the rows of Q be the axes. Let r and r' be the residuals of two features x = Q^T c + r and y = Q^T c' + r'. Then
    |x - y|^2 is the sum of |c - c'|^2 and |r - r'|^2. The length |r - r'| lies between the difference and the sum of
    |r| and |r'|. Let v = (c, |r|). The bound |v - v'|^2 is the dot product of (-2 v, |v|^2, 1) and (v', 1, |v'|^2).

    Args:
        features: (n, d) features.
        basis: Axes and mean.

    Returns:
        Features with their short vectors.
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
    # For a dot product of t terms with unit rounding u, the rounding error is at most t u sum |a||b|. This bound is at
    # most 2 t u (|v|^2 + |v'|^2). The code uses t + 4 instead of t, because the terms themselves are rounded too.
    slack = 2 * (width + 6) * FLOAT32_ROUNDING * norm
    return FeatureSet(features, left, right, np.sqrt(norm), rest, slack)


# ------------------------------------------------------------------------------------------------------- verify


def compute_ball_radii(side: FeatureSet, rows: range, k: Sequence[int]) -> np.ndarray:
    """Compute the squared distance of samples to the k-th nearest other sample of the same side.

    Args:
        side: Samples of one side.
        rows: Samples whose radii are computed.
        k: Neighbourhood sizes.

    Returns:
        (len(k), len(rows)) squared radii.

    Raises:
        ValueError: k is empty, or a neighbourhood size is less than 1.
    """
    radii = np.empty((len(k), len(rows)))
    for block in iterate_blocks(rows):
        radii[:, block.start - rows.start : block.stop - rows.start] = find_nearest(
            side, side, block, check_k(k), themselves=True
        )[0][:, [size - 1 for size in k]].T
    return radii


def find_nearest(
    side: FeatureSet, others: FeatureSet, rows: range, count: int, themselves: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Find the nearest neighbours of samples in another set. If distances are equal, the lower index comes first.

    Args:
        side: Set that contains the samples.
        others: Set that contains the neighbours.
        rows: Samples of `side`.
        count: Number of neighbours per sample.
        themselves: Whether both sets are the same. In this case, a sample does not count as its own neighbour.

    Returns:
        (rows, count) squared distances, ascending, and (rows, count) indices of the neighbours.
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
    """Find the samples that lie within balls of the other side; consider only the real samples in `rows`.

    Args:
        real: Real samples.
        generated: Generated samples.
        real_radii: (len(k), n) squared radii.
        generated_radii: (len(k), m) squared radii.
        rows: Real samples to consider.

    Returns:
        Three arrays: in_real (len(k), m), and in_generated and covered, each (len(k), len(rows)). For each generated
        sample, in_real is the number of balls that contain this sample; only the balls of the samples in `rows` count.
        To get the number for all real samples, add the arrays of all ranges of rows.
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
    """Compute squared distances in float64 from differences. Swapping the sides does not change any bit of the result.

    Args:
        a: (n, d) features.
        i: (p,) indices into a.
        b: (m, d) features.
        j: (p,) indices into b.

    Returns:
        (p,) squared distances of a[i] and b[j].
    """
    squared = np.empty(len(i))
    for start in range(0, len(i), PAIRS_PER_BLOCK):
        block = slice(start, start + PAIRS_PER_BLOCK)
        difference = np.subtract(a[i[block]], b[j[block]], dtype=np.float64)
        np.einsum("pd,pd->p", difference, difference, out=squared[block])
    return squared


def round_up_float32(values: np.ndarray) -> Tensor:
    """Round values up to float32.

    Args:
        values: float64 values.

    Returns:
        The smallest float32 values that are not less than the input values.
    """
    rounded = values.astype(np.float32)
    return torch.from_numpy(np.where(rounded < values, np.nextafter(rounded, np.float32(np.inf)), rounded))


def iterate_blocks(rows: range) -> list[range]:
    """Split a range of rows into blocks of BLOCK_ROWS.

    Args:
        rows: Rows.

    Returns:
        Consecutive ranges; the last range may be shorter.
    """
    return [range(start, min(start + BLOCK_ROWS, rows.stop)) for start in range(rows.start, rows.stop, BLOCK_ROWS)]
