"""Select scenes of a dataset directory: evenly spaced, by distance between poses, or balanced over labels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np
import pyarrow as pa

from pipelines.runtime import storage
from pipelines.schema.tables import Shard, find_shards

Pick = Literal["spread", "first", "farthest", "apart", "balanced"]
COLUMNS = ["sequence", "x_m", "y_m", "vegetation_density", "vehicle_density"]
ONE_WORLD = ("kitti360",)  # sources whose drives share one world frame


@dataclass(frozen=True)
class SceneSubset:
    """Scenes of a source and a split, at most `limit` of them, chosen by `pick`.

    * spread: evenly spaced over all scenes.
    * first: the first scenes.
    * farthest: farthest point sampling of the poses (paper, supplement, Precision and Recall Metrics).
    * apart: poses at least apart_m from all earlier ones, evenly thinned to `limit` (same section of the paper).
    * balanced: equally many scenes of each pair of density labels where available, evenly spaced within each pair.
    """

    root: str
    source: str | None = None
    split: str | None = None
    limit: int | None = None
    pick: Pick | str = "spread"
    apart_m: float = 0.0

    def __post_init__(self) -> None:
        if self.limit is not None and self.limit < 1:
            raise ValueError(f"limit is {self.limit}, expected at least 1 scene")
        if self.pick not in get_args(Pick):
            raise ValueError(f"pick is {self.pick!r}, expected one of {', '.join(get_args(Pick))}")
        if self.pick == "apart" and not self.apart_m > 0:
            raise ValueError(f"apart_m is {self.apart_m}, expected a distance above 0")

    def shards(self) -> list[tuple[Shard, list[int]]]:
        """Return shards with the rows to take, in order; the first call decides. Raises ValueError if there is none."""
        return self._shards

    def files(self) -> list[list]:
        """Return fingerprints of the chosen files with the rows to take; they differ once scenes or files change."""
        return [[*storage.fingerprint_file(shard.path("scenes")), rows] for shard, rows in self._shards]

    @cached_property
    def _shards(self) -> list[tuple[Shard, list[int]]]:
        shards = find_shards(self.root, "scenes", self.source, self.split)
        tables = [shard.read("scenes", COLUMNS) for shard in shards]
        worlds = [shard.source for shard in shards]
        counts = np.array([len(table) for table in tables])
        starts = np.cumsum(counts) - counts
        chosen = np.sort(self.chosen(pa.concat_tables(tables), np.repeat(worlds, counts)))
        if not len(chosen):
            raise ValueError(f"{self.root}: the shards of {self.source or 'all sources'} hold no scene")
        rows = [chosen[(chosen >= s) & (chosen < s + n)] - s for s, n in zip(starts, counts, strict=True)]
        return [(shard, r.tolist()) for shard, r in zip(shards, rows, strict=True) if len(r)]

    def chosen(self, scenes: pa.Table, source: np.ndarray) -> np.ndarray:
        """Return the rows to take of a table of all scenes, in order of selection; `source` is (n,)."""
        total = len(scenes)
        wanted = min(total, self.limit or total)
        if self.pick == "first":
            return np.arange(wanted)
        if self.pick == "farthest":
            return select_farthest(*read_poses(scenes, source), wanted)
        if self.pick == "apart":
            kept = select_apart(*read_poses(scenes, source), self.apart_m)
            return kept[select_evenly(len(kept), min(wanted, len(kept)))]
        if self.pick == "balanced":
            return select_balanced(list_label_pairs(scenes), wanted)
        return select_evenly(total, wanted)


def read_described_columns(parts: list[tuple[Shard, list[int]]]) -> tuple[pa.Table, np.ndarray]:
    """Return COLUMNS of the scenes in some shards' rows, in that order, and their sources (n,)."""
    table = pa.concat_tables([shard.read("scenes", COLUMNS).take(rows) for shard, rows in parts])
    return table, np.repeat([shard.source for shard, _ in parts], [len(rows) for _, rows in parts])


def list_label_pairs(scenes: pa.Table) -> np.ndarray:
    """(n,) str: both density labels of each scene."""
    return np.array([str(pair) for pair in zip(*(scenes[name].to_pylist() for name in COLUMNS[-2:]), strict=True)])


def select_evenly(total: int, count: int) -> np.ndarray:
    """`count` of the numbers 0 .. total - 1, evenly spaced."""
    return np.floor((np.arange(count) + 0.5) * total / max(count, 1)).astype(int)


def read_poses(scenes: pa.Table, source: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 2) metres and (n,) world of each scene. Poses of different worlds are infinitely far apart."""
    world = np.where(np.isin(source, ONE_WORLD), "", scenes["sequence"].to_numpy().astype(str))
    world = np.unique(np.char.add(np.char.add(source.astype(str), "/"), world), return_inverse=True)[1]
    return np.stack([scenes["x_m"].to_numpy(), scenes["y_m"].to_numpy()], axis=1), world


def select_farthest(xy_m: np.ndarray, world: np.ndarray, count: int) -> np.ndarray:
    """(count,) indices by farthest point sampling of poses (n, 2). The first is 0; every prefix is a sample as well."""
    nearest_m = np.full(len(xy_m), np.inf)
    chosen = np.zeros(count, int)
    for place in range(1, count + 1):
        last = chosen[place - 1]
        there = world == world[last]
        nearest_m[there] = np.minimum(nearest_m[there], np.hypot(*(xy_m[there] - xy_m[last]).T))
        nearest_m[last] = -1  # poses in one place are different scenes
        if place < count:
            chosen[place] = nearest_m.argmax()
    return chosen


def select_apart(xy_m: np.ndarray, world: np.ndarray, apart_m: float) -> np.ndarray:
    """Return indices of poses (n, 2), in order, that lie at least apart_m from every pose selected before.

    A pose is compared with the poses in its cell and the eight neighbouring cells of a grid of that width.
    """
    cells: dict[tuple[int, int, int], list[np.ndarray]] = {}
    taken = []
    for index, (place_m, where) in enumerate(zip(xy_m, world.tolist(), strict=True)):
        row, col = np.floor(place_m / apart_m).astype(int).tolist()
        around = ((where, row + i, col + j) for i in (-1, 0, 1) for j in (-1, 0, 1))
        if all(np.hypot(*(place_m - other)) >= apart_m for cell in around for other in cells.get(cell, ())):
            cells.setdefault((where, row, col), []).append(place_m)
            taken.append(index)
    return np.array(taken, int)


def select_balanced(labels: np.ndarray, count: int) -> np.ndarray:
    """(count,) indices, equally many of each label; other labels share the places that a rare label cannot fill."""
    groups = [np.flatnonzero(labels == label) for label in np.unique(labels)]
    shares = np.zeros(len(groups), int)
    while (left := count - shares.sum()) > 0:
        open_groups = [g for g, group in enumerate(groups) if shares[g] < len(group)]
        for g in open_groups[: max(1, left)]:
            shares[g] += min(max(1, left // len(open_groups)), len(groups[g]) - shares[g])
    parts = [group[select_evenly(len(group), share)] for group, share in zip(groups, shares, strict=True)]
    return np.concatenate(parts)
