"""Describe layouts by histograms, and compute the distance between two sources from these histograms.

No pictures and no network weights are needed. Each scene is described by a vector of counts over fixed bins. The sum
over the scenes of a source is the histogram of the source. The confidence interval is computed from sums over resampled
scenes. Two histograms are compared by the Wasserstein distance, in the unit of the histogram. Histograms whose bins
have no order are compared by the Jensen-Shannon divergence, in bits. The bins of small values are narrow, because the
bin width limits the resolution.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from models.scene import CATEGORIES, GROUND_CLASSES, Scene
from pipelines.geometry.masks import measure_depth
from pipelines.metrics.intervals import Estimate, compute_weights, make_estimate

EXTENT_EDGES_M = np.geomspace(0.1, 60, 49)
PAIR_EDGES_M = np.geomspace(0.25, 100, 33)
ROAD_DISTANCE_EDGES_M = np.linspace(0, 40, 41)
ROAD_WIDTH_EDGES_M = np.linspace(0, 40, 81)
NO_GROUND = "none"
MIN_ROAD_WIDTH_M = 2.0  # Smaller widths are artefacts of rough road borders.


@dataclass(frozen=True, eq=False)
class Histogram:
    """A named histogram over lengths or over named bins.

    Attributes:
        name: Name of the histogram, such as pole.height_m.
        edges: Edges of the bins, in `length_unit`. The first and last bins also count values beyond the outer edges.
            None: the bins are named.
        bins: Names of the bins, for bins that have no order.
        length_unit: Unit of the edges.
    """

    name: str
    edges: np.ndarray | None = None
    bins: tuple[str, ...] = ()
    length_unit: str = "m"

    def __len__(self) -> int:
        return len(self.bins) if self.edges is None else len(self.edges) - 1

    @property
    def unit(self) -> str:
        """Return the unit of the distance between two histograms of this type."""
        return "bits" if self.edges is None else self.length_unit

    def count(self, values: np.ndarray) -> np.ndarray:
        """Count values per bin.

        Args:
            values: Values in the unit of the edges, or bin numbers for named bins.

        Returns:
            (bins,) int64 counts.
        """
        if self.edges is not None:
            values = np.searchsorted(self.edges[1:-1], values, side="right")
        return np.bincount(values, minlength=len(self))


def _list_histograms() -> Iterator[Histogram]:
    for category in CATEGORIES:
        for extent in ("length", "width", "height"):
            yield Histogram(f"{category}.{extent}_m", EXTENT_EDGES_M)
        yield Histogram(f"{category}.ground_below", bins=(*GROUND_CLASSES, NO_GROUND))
        yield Histogram(f"{category}.to_road_m", ROAD_DISTANCE_EDGES_M)
        yield Histogram(f"{category}.pair_distance_m", PAIR_EDGES_M)
    yield Histogram("road_width_m", ROAD_WIDTH_EDGES_M)


HISTOGRAMS = tuple(_list_histograms())
ENDS = np.cumsum([len(histogram) for histogram in HISTOGRAMS])


def compute_scene_histograms(scene: Scene) -> np.ndarray:
    """Count the values of one scene over the bins of HISTOGRAMS.

    Each category has four kinds of values: extents of primitives, ground classes under centres, distances of centres
    from the nearest road pixel, and horizontal distances between pairs of centres. A scene without road has no
    distances to the road. The last histogram holds the widths of the road.

    Args:
        scene: Scene to describe.

    Returns:
        (ENDS[-1],) uint32 counts, one histogram after the other.
    """
    width_m, to_road_m = measure_road_widths(scene)
    row, col = scene.grid.pixel(scene.center_m[:, 0], scene.center_m[:, 1])
    inside = scene.grid.contains(scene.center_m[:, 0], scene.center_m[:, 1])
    pixel = row.clip(0, scene.grid.rows - 1), col.clip(0, scene.grid.cols - 1)
    class_bin = np.array([*(GROUND_CLASSES.index(name) for name in scene.ground_classes), len(GROUND_CLASSES)])
    below = np.where(inside, class_bin[scene.surface()[1][pixel]], len(GROUND_CLASSES))
    parts = []
    for index in range(len(CATEGORIES)):
        members = scene.category == index
        parts += [*scene.size_m[members].T.astype(np.float64), below[members]]
        parts.append(to_road_m[pixel][members & inside] if to_road_m is not None else np.zeros(0))
        parts.append(compute_pair_distances(scene.center_m[members, :2]))
    parts.append(width_m)
    counted = [histogram.count(part) for histogram, part in zip(HISTOGRAMS, parts, strict=True)]
    return np.concatenate(counted).astype(np.uint32)


def compute_pair_distances(xy_m: np.ndarray) -> np.ndarray:
    """Return the distances between all pairs of points.

    Args:
        xy_m: (n, 2) points (m).

    Returns:
        (n (n - 1) / 2,) distances (m).
    """
    first, second = np.triu_indices(len(xy_m), 1)
    return np.hypot(*(xy_m[first] - xy_m[second]).T.astype(np.float64))


def measure_road_widths(scene: Scene) -> tuple[np.ndarray, np.ndarray | None]:
    """Measure the width of the road along its middle line.

    The middle line consists of the local maxima of the distance from the border of the road. The width is twice that
    distance. The edge of the scene does not count as a border.

    Args:
        scene: Scene with rasters of its ground classes.

    Returns:
        (p,) widths (m), and (H, W) distance of each pixel from the road (m). The distance is None if the scene has no
        road.
    """
    road = np.zeros(scene.occupied.shape[1:], bool)
    if "road" in scene.ground_classes:
        road = scene.occupied[scene.ground_classes.index("road")]
    if not road.any():
        return np.zeros(0), None
    to_road_m = measure_depth(~road) * scene.grid.resolution_m
    if road.all():
        return np.zeros(0), to_road_m
    depth_px = measure_depth(road)
    middle = road & (depth_px == ndimage.maximum_filter(depth_px, 3))
    width_m = (2 * depth_px[middle] - 1) * scene.grid.resolution_m
    return width_m[width_m >= MIN_ROAD_WIDTH_M], to_road_m


# --------------------------------------------------------------------------------------------------- two sources


def compute_histogram_distances(
    real: np.ndarray, generated: np.ndarray, histograms: Sequence[Histogram] = HISTOGRAMS
) -> dict[str, Estimate]:
    """Compute the distance between two sources for each histogram.

    Args:
        real: (n, bins) counts of real scenes.
        generated: (m, bins) counts of generated scenes.
        histograms: Histograms in the order of the bins.

    Returns:
        Dictionary from the name of a histogram to the distance in the unit of the histogram. Histograms that are empty
        in one of the sources have no entry.
    """
    drawn = [compute_weights(len(side), key) for key, side in enumerate((real, generated))]
    found = {}
    ends = np.cumsum([len(histogram) for histogram in histograms])
    for histogram, end in zip(histograms, ends, strict=True):
        columns = slice(end - len(histogram), end)
        sums = [w @ side[:, columns].astype(np.float64) for w, side in zip(drawn, (real, generated), strict=True)]
        if min(part[0].sum() for part in sums) == 0:
            continue
        p, q = (normalize_histogram(part) for part in sums)
        found[histogram.name] = make_estimate(
            compute_jensen_shannon(p, q) if histogram.edges is None else compute_wasserstein(p, q, histogram.edges)
        )
    return found


def compute_count_distances(real: np.ndarray, generated: np.ndarray) -> dict[str, Estimate]:
    """Compute the Wasserstein distance between the distributions of the number of objects per scene, for each category.

    Args:
        real: (n, 11) number of objects of each category in real scenes.
        generated: (m, 11) number of objects of each category in generated scenes.

    Returns:
        Distance per category (unit: number of objects).
    """
    drawn = [compute_weights(len(side), key) for key, side in enumerate((real, generated))]
    found = {}
    for index, category in enumerate(CATEGORIES):
        sides = real[:, index].astype(int), generated[:, index].astype(int)
        bins = 1 + max(side.max() for side in sides)
        p, q = (w @ np.eye(bins)[side] for w, side in zip(drawn, sides, strict=True))
        found[category] = make_estimate(compute_wasserstein(p, q, np.arange(bins + 1) - 0.5))
    return found


def normalize_histogram(counts: np.ndarray) -> np.ndarray:
    """Scale each histogram to a sum of 1.

    Args:
        counts: (b, bins) histograms, one per row.

    Returns:
        (b, bins) rows with sum 1; a row of zeros becomes NaN.
    """
    total = counts.sum(axis=1, keepdims=True)
    return np.divide(counts, total, out=np.full_like(counts, np.nan), where=total > 0)


def compute_wasserstein(p: np.ndarray, q: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Compute the Wasserstein-1 distance of pairs of distributions; the mass of each bin lies at its middle.

    Args:
        p: (b, bins) distributions.
        q: (b, bins) distributions.
        edges: (bins + 1,) edges of the bins.

    Returns:
        (b,) distances in the unit of the edges.
    """
    step = np.diff((edges[1:] + edges[:-1]) / 2)
    return (np.abs(np.cumsum(p - q, axis=1)[:, :-1]) * step).sum(axis=1)


def compute_jensen_shannon(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Compute the Jensen-Shannon divergence of pairs of distributions.

    Args:
        p: (b, bins) distributions.
        q: (b, bins) distributions.

    Returns:
        (b,) divergences in bits, in [0, 1].
    """
    return np.clip(
        compute_entropy_bits((p + q) / 2) - (compute_entropy_bits(p) + compute_entropy_bits(q)) / 2, 0.0, 1.0
    )


def compute_entropy_bits(p: np.ndarray) -> np.ndarray:
    """Compute the entropy of distributions over the last axis; 0 log 0 counts as 0.

    Args:
        p: (..., bins) distributions.

    Returns:
        (...) entropies in bits.
    """
    return -(p * np.log2(np.where(p > 0, p, 1.0))).sum(axis=-1)
