"""Statistics of KITTI-360 scenes (64 x 64 m), and a comparison with scenes of the town."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from models.scene import CATEGORIES, DENSITIES, VEGETATION, Scene
from pipelines.schema.density_labels import classify_density, compute_density_thresholds

# Relative tolerance. For targets less than 3, the absolute tolerance COUNT_TOLERANCE_SMALL applies.
COUNT_TOLERANCE = 0.20
COUNT_TOLERANCE_SMALL = 0.5
AREA_TOLERANCE = 0.05
SIZE_TOLERANCE = 0.15

# Mean number of primitives in scenes with low, medium and high vegetation density.
COUNTS = {
    "vegetation_cuboid": (14, 72, 114),
    "vegetation_ellipsoid": (12, 71, 109),
    "vehicle_big": (0, 0, 0),
    "vehicle_small": (14, 12, 8),
    "two_wheelers": (0.3, 0.7, 1.5),
    "human": (0, 0.3, 1),
    "construction_big": (9, 8, 5),
    "construction_small": (14, 24, 24),
    "pole": (5, 8, 8),
    "traffic_control": (4, 8, 8),
    "object": (2, 5, 6),
}
# Share of the scene's area (4096 m2) that each class covers, in scenes with low, medium and high vegetation density.
AREAS = {
    "road": (0.19, 0.19, 0.14),
    "sidewalk": (0.12, 0.11, 0.11),
    "parking": (0.02, 0.07, 0.05),
    "terrain": (0.13, 0.31, 0.44),
    "ground": (0.06, 0.06, 0.03),
    "none": (0.48, 0.27, 0.24),
}
# Median length, width and height over all scenes (m). Buildings and garages have separate entries.
SIZES_M = {
    "vegetation_cuboid": (5, 2.2, 2.0),
    "vegetation_ellipsoid": (5.5, 4.8, 6),
    "vehicle_big": (8.3, 3.2, 2.8),
    "vehicle_small": (4.4, 2.0, 1.5),
    "two_wheelers": (2.0, 0.75, 1.35),
    "human": (0.9, 0.8, 1.75),
    "building": (16, 12, 11),
    "garage": (8, 6.4, 3.4),
    "construction_small": (3.5, 0.75, 1.5),
    "pole": (0.65, 0.6, 4),
    "traffic_control": (1.0, 0.65, 0.8),
    "object": (1.1, 0.85, 1.25),
}
TARGETS = {"counts": COUNTS, "areas": AREAS, "sizes_m": SIZES_M}


class Row(NamedTuple):
    """One line of the comparison.

    Attributes:
        what: Name of the quantity.
        label: Vegetation density label, or "all".
        target: Value of KITTI-360.
        measured: Value of the town.
        ok: Whether the difference lies within the tolerance.
    """

    what: str
    label: str
    target: float
    measured: float
    ok: bool


@dataclass(frozen=True, eq=False)
class Sample:
    """Statistics of n scenes for `measure_town`.

    Attributes:
        counts: Number of primitives of each category in each scene.
        vegetation_volume_m3: Total volume of the vegetation in each scene (m3).
        areas: Share of each scene's area that each class covers, in the order of AREAS.
        size_m: Sizes (k, 3) of all boxes for each name in SIZES_M (m).
    """

    counts: np.ndarray  # (n, 11)
    vegetation_volume_m3: np.ndarray  # (n,)
    areas: np.ndarray  # (n, 6)
    size_m: dict[str, np.ndarray]  # (k, 3)

    @property
    def vegetation_count(self) -> np.ndarray:
        """Number of vegetation primitives of each scene (n,)."""
        return self.counts[:, list(VEGETATION)].sum(axis=1)

    def labels(self) -> np.ndarray:
        """Return the vegetation density label of each scene (n,). The thresholds are percentiles of this sample."""
        thresholds = compute_density_thresholds(self.vegetation_count, self.vegetation_volume_m3)
        return classify_density(self.vegetation_count, self.vegetation_volume_m3, thresholds)


def make_sample(scenes: Iterable[Scene]) -> Sample:
    """Compute the statistics of a stream of scenes without keeping the scenes in memory."""
    counts, volumes, areas, size_of = [], [], [], {name: [np.zeros((0, 3))] for name in SIZES_M}
    for scene in scenes:
        counts.append(scene.counts())
        volumes.append(scene.volume_m3[np.isin(scene.category, VEGETATION)].sum())
        share = dict(zip(scene.ground_classes, scene.occupied.mean(axis=(1, 2)), strict=True))
        share["none"] = 1.0 - scene.occupied.any(axis=0).mean()
        areas.append([share.get(name, 0.0) for name in AREAS])
        for name in SIZES_M:
            of_label = name in ("building", "garage")
            which = scene.label == name if of_label else scene.category == CATEGORIES.index(name)
            size_of[name].append(scene.size_m[which])
    size_m = {name: np.concatenate(parts) for name, parts in size_of.items()}
    return Sample(np.array(counts), np.array(volumes), np.array(areas), size_m)


def measure_town(scenes: Iterable[Scene] | Sample) -> list[Row]:
    """Compare measured and target values of all TARGETS.

    Density labels are computed from the percentiles of these scenes. A category or label that does not occur gives NaN.
    Its comparison fails.
    """
    sample = scenes if isinstance(scenes, Sample) else make_sample(scenes)
    label = sample.labels()
    rows = []
    for k, which in enumerate(DENSITIES):
        here = label == which
        mean = sample.counts[here].mean(axis=0) if here.any() else np.full(len(CATEGORIES), np.nan)
        for index, name in enumerate(CATEGORIES):
            target = float(COUNTS[name][k])
            tolerance = COUNT_TOLERANCE_SMALL if target < 3 else COUNT_TOLERANCE * target
            rows.append(_make_row(f"mean count {name}", which, target, mean[index], tolerance))
        share = sample.areas[here].mean(axis=0) if here.any() else np.full(len(AREAS), np.nan)
        for index, name in enumerate(AREAS):
            rows.append(_make_row(f"area share {name}", which, AREAS[name][k], share[index], AREA_TOLERANCE))
    for name, target_size in SIZES_M.items():
        size = sample.size_m[name]
        median = np.median(size, axis=0) if len(size) else np.full(3, np.nan)
        for axis, extent in enumerate(("length", "width", "height")):
            target = float(target_size[axis])
            rows.append(_make_row(f"median {extent} {name}", "all", target, median[axis], SIZE_TOLERANCE * target))
    return rows


def _make_row(what: str, label: str, target: float, measured: float, tolerance: float) -> Row:
    return Row(what, label, target, float(measured), bool(abs(measured - target) <= tolerance))
