"""A dataset directory: statistics of its training split, density labels and dataset.json.

dataset.json is written last, so a directory that holds it is complete.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from models.layout import Bounds, LayoutSpec
from models.scene import CATEGORIES, GROUND_CLASSES, VEGETATION, VEHICLES, Grid
from pipelines.runtime import storage
from pipelines.schema.density_labels import DensityThresholds, classify_density, compute_density_thresholds
from pipelines.schema.tables import SCENES, Shard

DESCRIPTION = "dataset.json"
Extremes = dict[str, list[list[float]]]  # name -> [lowest, highest], a number per entry
# Meaning of ground heights: "top" of slabs, 0.3 m above the surface that objects stand on, or that "surface" itself.
SURFACE = {"town": "top", "kitti360": "top", "av2": "surface", "own": "surface"}


@dataclass(frozen=True)
class Statistics:
    """Statistics of the training split: label thresholds and the LayoutSpec."""

    vegetation: DensityThresholds
    vehicle: DensityThresholds
    spec: LayoutSpec


def count_groups(scenes: pa.Table, group: tuple[int, ...]) -> np.ndarray:
    """(n,) number of primitives of a group of categories in each row of `scenes`."""
    return np.asarray(sum(scenes[f"num_{CATEGORIES[k]}"].to_numpy() for k in group))


def compute_training_statistics(
    manifests: list[dict], staging: str, grid: Grid, slots: tuple[int, ...] | None
) -> Statistics:
    """Compute thresholds, 95th percentiles of counts and bounds of the training split.

    Args:
        manifests: Manifests of all shards.
        staging: Directory with the shards' tables.
        grid: Grid of the rasters.
        slots: Fixed number of slots per category (the paper's sum to N = 514); None for the 95th percentiles.

    Raises:
        ValueError: The training split is empty.
    """
    training = [m for m in manifests if m["split"] == "train" and m["scenes"]]
    if not training:
        raise ValueError("the training split is empty; give more data, or preprocess without a split")
    shards = [Shard(staging, m["source"], m["split"], m["number"]) for m in training]
    columns = [*(f"num_{name}" for name in CATEGORIES), "vegetation_volume_m3", "vehicle_volume_m3"]
    scenes = pa.concat_tables([shard.read("scenes", columns) for shard in shards])
    counts = np.stack([scenes[f"num_{name}"].to_numpy() for name in CATEGORIES], axis=1)
    present = counts.sum(axis=0) > 0
    p95 = np.ceil(np.percentile(counts, 95, axis=0)).clip(1).astype(int)
    chosen = np.array(slots) if slots else p95

    measured = merge_extremes(m["extremes"] for m in training)

    def bounds(name: str, width: int) -> Bounds:
        low, high = (np.array(v) for v in measured.get(name, [[0.0] * width, [1.0] * width]))
        margin = np.maximum(0.01 * (high - low), 1e-3)
        return Bounds(tuple((low - margin).tolist()), tuple((high + margin).tolist()))

    z = bounds("z", 1)
    classes = {name for m in training for name in m["ground_classes"]}
    spec = LayoutSpec(
        categories=tuple(name for name, keep in zip(CATEGORIES, present, strict=True) if keep),
        slots=tuple(int(n) for n in chosen[present]),
        ground_classes=tuple(name for name in GROUND_CLASSES if name in classes),
        grid=grid,
        center_bounds_m=Bounds((grid.back_m, grid.right_m, *z.low), (grid.front_m, grid.left_m, *z.high)),
        cholesky_bounds=bounds("cholesky", 6),
        height_bounds_m=bounds("height", 1),
        surface=SURFACE[training[0]["source"]],
    )

    def thresholds(group: tuple[int, ...], volume: str) -> DensityThresholds:
        return compute_density_thresholds(count_groups(scenes, group), scenes[volume].to_numpy())

    return Statistics(
        vegetation=thresholds(VEGETATION, "vegetation_volume_m3"),
        vehicle=thresholds(VEHICLES, "vehicle_volume_m3"),
        spec=spec,
    )


def label_scenes(scenes: pa.Table, statistics: Statistics) -> pa.Table:
    """Return the scenes table with both density labels."""
    groups = (("vegetation", VEGETATION, statistics.vegetation), ("vehicle", VEHICLES, statistics.vehicle))
    for name, group, thresholds in groups:
        labels = classify_density(count_groups(scenes, group), scenes[f"{name}_volume_m3"].to_numpy(), thresholds)
        column = f"{name}_density"
        scenes = scenes.set_column(
            scenes.column_names.index(column), SCENES.field(column), pa.array(labels, pa.string())
        )
    return scenes.cast(SCENES)


@dataclass(frozen=True)
class Dataset:
    """A complete dataset directory: its dataset.json, read and checked."""

    root: str
    source: str
    scenes: dict[str, int]
    spec: LayoutSpec
    vegetation: DensityThresholds
    vehicle: DensityThresholds

    @classmethod
    def open(cls, root: str) -> Dataset:
        """Raises ValueError if `root` holds no complete dataset."""
        path = storage.join_uri(root, DESCRIPTION)
        if not storage.exists(path):
            raise ValueError(f"{root}: no dataset.json here; run jobs/preprocess_scenes.py with --output {root} first")
        content = storage.read_json(path)
        try:
            return cls(
                root=root,
                source=content["source"],
                scenes=content["scenes"],
                spec=LayoutSpec.from_dict(content["layout"]),
                vegetation=DensityThresholds(**content["vegetation_thresholds"]),
                vehicle=DensityThresholds(**content["vehicle_thresholds"]),
            )
        except (KeyError, TypeError) as error:
            raise ValueError(f"{path}: not a dataset description ({error!r}); preprocess again") from error


def merge_extremes(parts: Iterable[Extremes]) -> Extremes:
    """Return the lowest and highest values over all parts."""
    parts = list(parts)
    return {
        name: [
            np.min([p[name][0] for p in parts if name in p], axis=0).tolist(),
            np.max([p[name][1] for p in parts if name in p], axis=0).tolist(),
        ]
        for name in {name for p in parts for name in p}
    }
