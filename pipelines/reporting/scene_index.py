"""Index the scenes of a dataset directory; select and sort scenes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipelines.schema.columns import SCENES
from pipelines.schema.scene_subset import find_scene_ids, select_evenly
from pipelines.schema.tables import Shard, find_shards

SORTS = {
    "vegetation": "vegetation_volume_m3",
    "vehicles": "vehicle_volume_m3",
    "primitives": "num_primitives",
}


@dataclass(frozen=True, eq=False)
class Catalogue:
    """Scenes of a dataset directory, or only of one source or split.

    Attributes:
        root: Dataset directory.
        scenes: Rows of the scenes table with the additional columns source and split, without world_from_imu.
        shards: Shards of the scenes.
        shard: (n,) index of the shard of each scene.
        row: (n,) row of each scene within the shard.
        damaged: Reason for each shard that was left out, by the path of its scenes table.
    """

    root: str
    scenes: pa.Table
    shards: tuple[Shard, ...]
    shard: np.ndarray
    row: np.ndarray
    damaged: dict[str, str] = field(default_factory=dict)

    @classmethod
    def read(
        cls, root: str, source: str | None = None, split: str | None = None, skip_damaged: bool = False
    ) -> Catalogue:
        """Read the scenes tables of a dataset directory.

        Args:
            root: Dataset directory.
            source: Source to read. None: all sources are read.
            split: Split to read. None: all splits are read.
            skip_damaged: Whether to leave out shards whose scenes table is damaged, instead of raising an error.

        Returns:
            Catalogue of all scenes.

        Raises:
            ValueError: The directory has no scene of this source and split, or a scenes table is damaged.
        """
        columns = [name for name in SCENES.names if name != "world_from_imu"]
        shards, tables, damaged = [], [], {}
        for shard in find_shards(root, "scenes", source, split):
            try:
                table = shard.read("scenes", columns)
            except ValueError as error:
                if not skip_damaged:
                    raise
                damaged[shard.path("scenes")] = str(error)
                continue
            shards.append(shard)
            for name in ("source", "split"):
                table = table.append_column(name, pa.array([getattr(shard, name)] * len(table), pa.string()))
            tables.append(table)
        lengths = [len(table) for table in tables]
        if sum(lengths) == 0:
            reasons = f" ({next(iter(damaged.values()))})" if damaged else ""
            raise ValueError(f"{root}: the scenes tables have no readable row{reasons}; run their job again")
        return cls(
            root=root,
            scenes=pa.concat_tables(tables),
            shards=tuple(shards),
            shard=np.repeat(np.arange(len(shards)), lengths),
            row=np.concatenate([np.arange(n) for n in lengths]),
            damaged=damaged,
        )

    def __len__(self) -> int:
        return len(self.scenes)

    def column(self, name: str) -> np.ndarray:
        """Return a column (n,) as numbers, with NaN for null, or as an object array of strings."""
        return self.scenes[name].to_numpy()

    def find(self, scene_ids: Sequence[str]) -> np.ndarray:
        """Return the indices of scenes.

        Args:
            scene_ids: Scene ids.

        Returns:
            (k,) indices.

        Raises:
            ValueError: A scene does not exist. The message names some existing scenes.
        """
        return find_scene_ids(self.root, self.scenes["scene_id"].to_pylist(), scene_ids)

    @staticmethod
    def spread(order: np.ndarray, count: int) -> np.ndarray:
        """Return at most `count` evenly spaced entries of `order`."""
        return order[select_evenly(len(order), min(count, len(order)))]

    def draw(self, count: int, seed: int) -> np.ndarray:
        """Return the indices of at most `count` random scenes without repetition."""
        return np.random.default_rng(seed).permutation(len(self))[:count]

    def sort_column(self, sort: str) -> str:
        """Return the column by which an order sorts. Raises ValueError if there is no such column."""
        column = SORTS.get(sort, sort)
        if column not in SCENES.names or not pa.types.is_primitive(SCENES.field(column).type):
            raise ValueError(
                f"--sort {sort}: expected drive, random, {', '.join(SORTS)} or a numeric column of the scenes table, "
                "such as num_pole or road_area_m2"
            )
        return column

    def choose(self, count: int, sort: str, pick: str = "uniform", seed: int = 0) -> np.ndarray:
        """Choose scenes and return them in an order.

        Args:
            count: Maximum number of scenes.
            sort: random, drive (by sequence and frame) or an order that `sort_column` accepts. Scenes that have no
                value in the column are skipped.
            pick: uniform (evenly spaced from lowest to highest), lowest or highest.
            seed: Seed of the random order.

        Returns:
            Indices of the scenes.

        Raises:
            ValueError: The column does not exist, or it has no value for any scene.
        """
        if sort == "random":
            return self.draw(count, seed)
        if sort == "drive":
            keys = [(name, "ascending") for name in ("source", "split", "sequence", "frame")]
            order = pc.sort_indices(self.scenes, keys).to_numpy()  # pyright: ignore[reportAttributeAccessIssue]
        else:
            values = self.column(self.sort_column(sort)).astype(float)
            order = np.argsort(values, kind="stable")[: np.isfinite(values).sum()]
            if len(order) == 0:
                raise ValueError(f"--sort {sort}: in {self.root}, no scene has a value in this column")
        if pick == "uniform":
            return self.spread(order, count)
        return order[:count] if pick == "lowest" else order[::-1][:count]

    def drop_damaged(self, indices: np.ndarray) -> tuple[np.ndarray, dict[str, str]]:
        """Drop scenes of shards whose primitives or rasters are damaged.

        Args:
            indices: Indices of scenes.

        Returns:
            Indices of the other scenes, and the reason for each damaged shard, by the path of its scenes table.

        Raises:
            ValueError: All of these shards are damaged.
        """
        reasons = {}
        for number in np.unique(self.shard[indices]).tolist():
            try:
                self.shards[number].read_tables()
            except ValueError as error:
                reasons[number] = str(error)
        kept = indices[~np.isin(self.shard[indices], list(reasons))]
        if len(indices) and not len(kept):
            raise ValueError(next(iter(reasons.values())))
        return kept, {self.shards[number].path("scenes"): reason for number, reason in reasons.items()}

    def chunks(self, indices: np.ndarray, size: int) -> Iterator[tuple[Shard, list[int], list[int]]]:
        """Yield chunks of at most `size` scenes of one shard: (shard, rows in the shard, positions in `indices`)."""
        for shard in np.unique(self.shard[indices]):
            places = np.flatnonzero(self.shard[indices] == shard)
            for start in range(0, len(places), size):
                chosen = places[start : start + size]
                yield self.shards[shard], self.row[indices[chosen]].tolist(), chosen.tolist()
