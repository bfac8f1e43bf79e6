"""Make the table of street maps, from which a street planner learns, with one Ray task per town.

A street map is a crop of MAP_M at any place and heading of a town with enough streets. Crops of scenes are too small:
they show one or two junctions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from models.composition.street_distances import measure_street_distances, read_street_masks
from models.scene import VEGETATION, VEHICLES, Grid, Scene
from models.street_planner import CHANNELS, PIXEL_M
from pipelines.preprocess.sources.town.generator import TEST_SEEDS_START
from pipelines.preprocess.sources.town.version2.town import make_large_crops
from pipelines.runtime import storage
from pipelines.runtime.ray_tasks import map_tasks
from pipelines.schema.columns import make_street_maps_schema
from pipelines.schema.density_labels import DensityThresholds, classify_density, compute_density_thresholds
from pipelines.schema.tables import Shard

MAP_PX = 64  # Pixels per side of a street map.
MAP_M = MAP_PX * PIXEL_M
RESOLUTION_M = 0.5  # Side of the pixels from which distances are computed.
MAPS_PER_TOWN = 100
NUM_TEST = 400  # Number of held-out maps.
SEEDS_START = 3_000_000  # Towns of street maps have other seeds than those of scenes and of evaluations.
SOURCE = "town"
GROUPS = {"vegetation": VEGETATION, "vehicle": VEHICLES}


@dataclass(frozen=True)
class TownMaps:
    """Street maps of one town.

    Attributes:
        shard: Shard of the table `street_maps`.
        town_seed: Seed of the town.
        count: Number of maps.
    """

    shard: Shard
    town_seed: int
    count: int


def plan_street_maps(root: str, num_train: int, num_test: int = NUM_TEST) -> list[TownMaps]:
    """Distribute street maps over towns.

    Args:
        root: Dataset directory.
        num_train: Number of maps of the training split.
        num_test: Number of maps of the test split, which come from other towns.

    Returns:
        One entry per town.
    """
    plan = []
    for split, wanted, start in (("train", num_train, 0), ("test", num_test, TEST_SEEDS_START)):
        for number, first in enumerate(range(0, wanted, MAPS_PER_TOWN)):
            shard = Shard(root, SOURCE, split, number)
            town_seed = SEEDS_START + start + number
            plan.append(TownMaps(shard, town_seed, min(MAPS_PER_TOWN, wanted - first)))
    return plan


def make_street_maps(plan: list[TownMaps], on_maps: Callable[[int], None] | None = None) -> None:
    """Write the table `street_maps`. Files that exist are kept, so an interrupted run continues.

    Args:
        plan: Maps to make.
        on_maps: Called with the number of maps of each finished town.

    Raises:
        ValueError: A file is missing or incomplete after the run.
    """
    promised = {town.shard.path("street_maps"): town.count for town in plan}
    unwritten = storage.find_faulty_files(promised)
    missing = [town for town in plan if town.shard.path("street_maps") in unwritten]
    if on_maps:
        on_maps(sum(town.count for town in plan) - sum(town.count for town in missing))
    for count in map_tasks(write_town_maps, missing):
        if on_maps:
            on_maps(count)
    storage.require_rows(promised)


def write_town_maps(town: TownMaps) -> int:
    """Write the street maps of one town.

    Args:
        town: Maps to make.

    Returns:
        Number of maps.
    """
    pixels = round(MAP_M / RESOLUTION_M)
    grid = Grid(MAP_M, MAP_M / 2, RESOLUTION_M, pixels, pixels)
    return write_street_maps(make_large_crops(town.town_seed, town.count, grid), town.shard)


def write_street_maps(scenes: Iterable[Scene], shard: Shard) -> int:
    """Write a shard of the table `street_maps`.

    Args:
        scenes: Crops of MAP_M x MAP_M, one per map.
        shard: The shard.

    Returns:
        Number of maps.
    """
    rows = [make_row(scene) for scene in scenes]
    distances = np.stack([row.pop("distance_m") for row in rows])
    schema = make_street_maps_schema((CHANNELS, MAP_PX, MAP_PX))
    columns = {name: [row[name] for row in rows] for name in rows[0]}
    columns["distance_m"] = pa.FixedShapeTensorArray.from_numpy_ndarray(distances)
    storage.write_parquet(pa.table(columns, schema=schema), shard.path("street_maps"))
    return len(rows)


def make_row(scene: Scene) -> dict:
    """Return the row of a crop in the table `street_maps`."""
    distance_m = measure_street_distances(*read_street_masks(scene), scene.grid.resolution_m)
    row: dict = {"map_id": scene.scene_id, "sequence": scene.sequence}
    for name, group in GROUPS.items():
        chosen = np.isin(scene.category, group)
        row[f"num_{name}"], row[f"{name}_volume_m3"] = int(chosen.sum()), float(scene.volume_m3[chosen].sum())
    return row | {"distance_m": distance_m.astype(np.float16)}


def compute_map_thresholds(shards: list[Shard]) -> dict[str, DensityThresholds]:
    """Compute the thresholds of the density labels of street maps.

    Args:
        shards: Shards of the training split.

    Returns:
        Thresholds by group: "vegetation" and "vehicle".
    """
    columns = [f"num_{name}" for name in GROUPS] + [f"{name}_volume_m3" for name in GROUPS]
    table = pa.concat_tables([shard.read("street_maps", columns) for shard in shards])
    return {
        name: compute_density_thresholds(table[f"num_{name}"].to_numpy(), table[f"{name}_volume_m3"].to_numpy())
        for name in GROUPS
    }


def label_street_maps(table: pa.Table, thresholds: dict[str, DensityThresholds]) -> list[tuple[str, str]]:
    """Return the density labels of vegetation and vehicles of each street map.

    Args:
        table: Rows of the table `street_maps`.
        thresholds: Result of `compute_map_thresholds`.

    Returns:
        Two labels per row.
    """
    labels = [
        classify_density(table[f"num_{name}"].to_numpy(), table[f"{name}_volume_m3"].to_numpy(), thresholds[name])
        for name in GROUPS
    ]
    return [(str(first), str(second)) for first, second in zip(*labels, strict=True)]
