"""Dataset directory: statistics of the training split, density labels and the metadata file dataset.json.

The writer creates dataset.json last. A directory that holds dataset.json is therefore complete.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from models.layout import Bounds, LayoutSpec
from models.scene import CATEGORIES, GROUND_CLASSES, VEGETATION, VEHICLES, Grid
from pipelines.runtime import storage
from pipelines.schema.columns import SCENES
from pipelines.schema.density_labels import DensityThresholds, classify_density, compute_density_thresholds
from pipelines.schema.ground_surface import SURFACE
from pipelines.schema.tables import Shard

DESCRIPTION = "dataset.json"
Extremes = dict[str, list[list[float]]]  # Name -> [lowest, highest]; both are lists with one value per component.


@dataclass(frozen=True)
class Statistics:
    """Statistics of the training split: the thresholds of both density labels, and the LayoutSpec.

    Attributes:
        vegetation: Thresholds of the vegetation density label.
        vehicle: Thresholds of the vehicle density label.
        spec: Categories, slots, ground classes, raster grid and value bounds that the models need.
    """

    vegetation: DensityThresholds
    vehicle: DensityThresholds
    spec: LayoutSpec


def count_groups(scenes: pa.Table, group: tuple[int, ...]) -> np.ndarray:
    """Count the primitives of a group of categories in each scene.

    Args:
        scenes: Rows of the scenes table.
        group: Indices into CATEGORIES.

    Returns:
        (n,) number of primitives, one per row of `scenes`.
    """
    return np.asarray(sum(scenes[f"num_{CATEGORIES[k]}"].to_numpy() for k in group))


def compute_training_statistics(
    manifests: list[dict], staging: str, grid: Grid, slots: tuple[int, ...] | float
) -> Statistics:
    """Compute density thresholds, slots per category and value bounds from the training split.

    Args:
        manifests: Manifests of all shards.
        staging: Directory with the tables of the shards.
        grid: Grid of the rasters.
        slots: Number of slots per category; in the paper, they sum to N = 514. A float is a percentile of each
            category's count per scene.

    Returns:
        Statistics of all training scenes.

    Raises:
        ValueError: The training split is empty.
    """
    training = [m for m in manifests if m["split"] == "train" and m["scenes"]]
    if not training:
        raise ValueError("the training split is empty; add more data, or preprocess without a split")
    shards = [Shard(staging, m["source"], m["split"], m["number"]) for m in training]
    columns = [*(f"num_{name}" for name in CATEGORIES), "vegetation_volume_m3", "vehicle_volume_m3"]
    scenes = pa.concat_tables([shard.read("scenes", columns) for shard in shards])
    counts = np.stack([scenes[f"num_{name}"].to_numpy() for name in CATEGORIES], axis=1)
    present = counts.sum(axis=0) > 0
    if isinstance(slots, tuple):
        chosen = np.array(slots)
    else:
        chosen = np.ceil(np.percentile(counts, slots, axis=0)).clip(1).astype(int)

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


# Columns of the scenes table from which density labels are computed.
DENSITY_COLUMNS = (
    *(f"num_{CATEGORIES[k]}" for k in (*VEGETATION, *VEHICLES)),
    *("vegetation_volume_m3", "vehicle_volume_m3", "vegetation_density", "vehicle_density"),
)


def label_scenes(scenes: pa.Table, vegetation: DensityThresholds, vehicle: DensityThresholds) -> pa.Table:
    """Fill both density labels of the scenes table.

    Args:
        scenes: Rows of the scenes table, with at least DENSITY_COLUMNS.
        vegetation: Thresholds of the vegetation density label.
        vehicle: Thresholds of the vehicle density label.

    Returns:
        The scenes table with values in the columns vegetation_density and vehicle_density.
    """
    groups = (("vegetation", VEGETATION, vegetation), ("vehicle", VEHICLES, vehicle))
    for name, group, thresholds in groups:
        labels = classify_density(count_groups(scenes, group), scenes[f"{name}_volume_m3"].to_numpy(), thresholds)
        column = f"{name}_density"
        scenes = scenes.set_column(
            scenes.column_names.index(column), SCENES.field(column), pa.array(labels, pa.string())
        )
    return scenes


@dataclass(frozen=True)
class Dataset:
    """A complete dataset directory with the content of its dataset.json.

    Attributes:
        root: Path or URI of the directory.
        source: Value of the source column, such as kitti360.
        scenes: Number of scenes per split.
        spec: LayoutSpec of the training split.
        vegetation: Thresholds of the vegetation density label.
        vehicle: Thresholds of the vehicle density label.
    """

    root: str
    source: str
    scenes: dict[str, int]
    spec: LayoutSpec
    vegetation: DensityThresholds
    vehicle: DensityThresholds

    @classmethod
    def open(cls, root: str) -> Dataset:
        """Read and check the dataset.json of a dataset directory.

        Args:
            root: Path or URI of the directory.

        Returns:
            The dataset's metadata.

        Raises:
            ValueError: `root` does not contain a complete dataset, or dataset.json is invalid.
        """
        path = storage.join_uri(root, DESCRIPTION)
        if not storage.exists(path):
            raise ValueError(f"{root} holds no dataset.json; run jobs/preprocess_scenes.py with --output {root} first")
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
            raise ValueError(f"{path} is not a valid dataset description ({error!r}); preprocess again") from error


def merge_extremes(parts: Iterable[Extremes]) -> Extremes:
    """Merge the value ranges of several parts.

    Args:
        parts: For each part, a map from name to lowest and highest value. A name may be missing in some parts.

    Returns:
        Lowest and highest value of each name over all parts.
    """
    parts = list(parts)
    return {
        name: [
            np.min([p[name][0] for p in parts if name in p], axis=0).tolist(),
            np.max([p[name][1] for p in parts if name in p], axis=0).tolist(),
        ]
        for name in {name for p in parts for name in p}
    }
