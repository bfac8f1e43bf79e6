"""Select scenes of a dataset directory: evenly spaced, by distance between poses, or balanced over density labels."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
import pyarrow as pa
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from pipelines.runtime import storage
from pipelines.schema.tables import Shard, find_shards

Pick = Literal["spread", "first", "farthest", "apart", "balanced"]
Half = Literal["first", "second"]
COLUMNS = ["sequence", "x_m", "y_m", "vegetation_density", "vehicle_density"]
HALVES_APART_M = 64.0  # Scenes of two halves show no common ground, because a crop has a side of 64 m.
HALVES_CUTS = 33  # Number of cuts to try.
ONE_WORLD = ("kitti360",)  # Sources in which all drives share one world frame.


@dataclass(frozen=True)
class SceneSubset:
    """A selection of at most `limit` scenes of a dataset directory.

    The selection rules (`pick`) are:

    * spread: evenly spaced over all scenes.
    * first: the first scenes.
    * farthest: farthest point sampling of the poses (paper, supplement, Precision and Recall Metrics).
    * apart: poses with pairwise distances of at least `apart_m`, evenly subsampled to `limit` (paper, same section as
      for farthest).
    * balanced: the same number of scenes for each pair of density labels if available, evenly spaced within a pair.

    Attributes:
        root: Dataset directory.
        source: Value of the source column (default: all sources).
        split: Value of the split column (default: all splits).
        limit: Maximum number of scenes (default: all).
        pick: Selection rule.
        apart_m: Minimum distance between poses for the rule "apart" (m).
        half: Select only from the "first" or the "second" half of the places; "" means all (`split_halves`).
        ids: Select only the scenes with these ids, in the order of the tables; empty means all.
    """

    root: str
    source: str | None = None
    split: str | None = None
    limit: int | None = None
    pick: Pick | str = "spread"
    apart_m: float = 0.0
    half: Half | str = ""
    ids: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.limit is not None and self.limit < 1:
            raise ValueError(f"limit is {self.limit}, expected at least 1 scene")
        if self.pick not in get_args(Pick):
            raise ValueError(f"pick is {self.pick!r}, expected one of {', '.join(get_args(Pick))}")
        if self.pick == "apart" and not self.apart_m > 0:
            raise ValueError(f"apart_m is {self.apart_m}, expected a distance greater than 0")

    def shards(self) -> list[tuple[Shard, list[int]]]:
        """Return each shard that has selected rows, together with the numbers of these rows.

        The first call makes the selection; later calls return the same result.

        Returns:
            Shards in order, with the selected row numbers of each shard in ascending order.

        Raises:
            ValueError: The dataset directory holds no matching scene, or no scene with one of the ids.
        """
        return self._shards

    def files(self) -> list[list]:
        """Return a fingerprint of each selected file, followed by the numbers of the selected rows.

        The result changes when the selection or a file changes.
        """
        prints = storage.fingerprint_files([shard.path("scenes") for shard, _ in self._shards])
        return [[*found, rows] for found, (_, rows) in zip(prints, self._shards, strict=True)]

    def to_record(self) -> dict[str, Any]:
        """Return the attributes by name, without `ids` if it is empty.

        Records of runs of earlier versions have no ids.
        """
        return {name: value for name, value in asdict(self).items() if name != "ids" or value}

    def fingerprint(self) -> str:
        """Return the first sixteen hexadecimal digits of the SHA-256 digest of `files`."""
        return hashlib.sha256(json.dumps(self.files()).encode()).hexdigest()[:16]

    @cached_property
    def _shards(self) -> list[tuple[Shard, list[int]]]:
        shards = find_shards(self.root, "scenes", self.source, self.split)
        tables = [shard.read("scenes", COLUMNS) for shard in shards]
        worlds = [shard.source for shard in shards]
        counts = np.array([len(table) for table in tables])
        starts = np.cumsum(counts) - counts
        found = self._find_ids(shards) if self.ids else np.arange(counts.sum())
        chosen = found[np.sort(self.chosen(pa.concat_tables(tables).take(found), np.repeat(worlds, counts)[found]))]
        if not len(chosen):
            raise ValueError(f"{self.root}: the shards of {self.source or 'all sources'} hold no scene")
        rows = [chosen[(chosen >= s) & (chosen < s + n)] - s for s, n in zip(starts, counts, strict=True)]
        return [(shard, r.tolist()) for shard, r in zip(shards, rows, strict=True) if len(r)]

    def _find_ids(self, shards: list[Shard]) -> np.ndarray:
        """Return the row numbers of the scenes with the ids, counted over all shards, in ascending order."""
        known = [name for shard in shards for name in shard.read("scenes", ["scene_id"])["scene_id"].to_pylist()]
        return np.unique(find_scene_ids(self.root, known, self.ids))

    def chosen(self, scenes: pa.Table, source: np.ndarray) -> np.ndarray:
        """Select rows of a table of all scenes.

        Args:
            scenes: Table of all scenes with the columns COLUMNS.
            source: (n,) source of each scene.

        Returns:
            Selected row numbers, in order of selection.
        """
        if self.half:
            places = split_halves(*read_poses(scenes, source))[("first", "second").index(self.half)]
            inner = replace(self, half="")
            return places[inner.chosen(scenes.take(places), source[places])]
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


def find_scene_ids(root: str, known: Sequence[str], wanted: Sequence[str]) -> np.ndarray:
    """Find scenes by their ids.

    Args:
        root: Dataset directory, for the message.
        known: Ids of all scenes.
        wanted: Ids to find.

    Returns:
        (k,) indices in `known`, in the order of `wanted`.

    Raises:
        ValueError: A scene does not exist. The message names some existing scenes.
    """
    index = {scene_id: k for k, scene_id in enumerate(known)}
    for name in wanted:
        if name not in index:
            alike = [other for other in known if name in other][:3]
            spread: list[int] = select_evenly(len(known), min(3, len(known))).tolist()
            some = alike or [known[k] for k in spread]
            raise ValueError(
                f"{root}: no scene {name!r} among {len(known)} scenes; existing scenes include {', '.join(some)}"
            )
    return np.array([index[name] for name in wanted], int)


def read_described_columns(parts: list[tuple[Shard, list[int]]]) -> tuple[pa.Table, np.ndarray]:
    """Read COLUMNS of the selected rows of several shards.

    Args:
        parts: Shards with their row numbers.

    Returns:
        Table with one row per scene, in the order of `parts`; and the source of each scene (n,).
    """
    table = pa.concat_tables([shard.read("scenes", COLUMNS).take(rows) for shard, rows in parts])
    return table, np.repeat([shard.source for shard, _ in parts], [len(rows) for _, rows in parts])


def list_label_pairs(scenes: pa.Table) -> np.ndarray:
    """Return both density labels of each scene as one string.

    Args:
        scenes: Table with the columns vegetation_density and vehicle_density.

    Returns:
        (n,) str, such as "('low', 'high')".
    """
    return np.array([str(pair) for pair in zip(*(scenes[name].to_pylist() for name in COLUMNS[-2:]), strict=True)])


def select_evenly(total: int, count: int) -> np.ndarray:
    """Select evenly spaced integers from 0 to total - 1.

    Args:
        total: Number of integers from which to select.
        count: Number of integers to select, at most `total`.

    Returns:
        (count,) selected integers in ascending order.
    """
    return np.floor((np.arange(count) + 0.5) * total / max(count, 1)).astype(int)


def read_poses(scenes: pa.Table, source: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Read the position of each scene and the index of its world frame.

    Callers treat poses of different world frames as infinitely far apart.

    Args:
        scenes: Table of the n scenes with the columns COLUMNS.
        source: (n,) source of each scene.

    Returns:
        (n, 2) position in the world frame (m), and (n,) index of the world frame.
    """
    world = np.where(np.isin(source, ONE_WORLD), "", scenes["sequence"].to_numpy().astype(str))
    world = np.unique(np.char.add(np.char.add(source.astype(str), "/"), world), return_inverse=True)[1]
    return np.stack([scenes["x_m"].to_numpy(), scenes["y_m"].to_numpy()], axis=1), world


def split_halves(xy_m: np.ndarray, world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split scenes into two halves that show different places.

    The scenes are ordered by world frame and, within a frame, along the direction in which the poses spread most. The
    first half is the beginning of this order. The second half consists of the remaining scenes that lie at least
    HALVES_APART_M from each scene of the first half. The order is cut where the smaller half is largest.

    Args:
        xy_m: (n, 2) position of each pose (m).
        world: (n,) index of each pose's world frame.

    Returns:
        Indices of the first and of the second half, in ascending order. If all scenes lie close together, the second
        half is empty.
    """
    along_m = np.empty(len(world))
    for frame in np.unique(world):
        here = world == frame
        centred = xy_m[here] - xy_m[here].mean(axis=0)
        along_m[here] = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
    order = np.lexsort([along_m, world])
    cuts = np.unique(np.linspace(1, (len(order) + 1) // 2, HALVES_CUTS).astype(int))
    halves = [(order[:cut], _drop_near(order[:cut], order[cut:], xy_m, world)) for cut in cuts]
    first, second = max(halves, key=lambda pair: min(map(len, pair)))
    return np.sort(first), np.sort(second)


def _drop_near(first: np.ndarray, rest: np.ndarray, xy_m: np.ndarray, world: np.ndarray) -> np.ndarray:
    """Return the scenes of `rest` that lie at least HALVES_APART_M from each scene of `first`."""
    near = np.zeros(len(rest), bool)
    for frame in np.intersect1d(world[first], world[rest]):
        mine, theirs = first[world[first] == frame], world[rest] == frame
        near[theirs] = cKDTree(xy_m[mine]).query(xy_m[rest[theirs]])[0] < HALVES_APART_M
    return rest[~near]


def select_farthest(xy_m: np.ndarray, world: np.ndarray, count: int) -> np.ndarray:
    """Select poses by farthest point sampling, starting with pose 0.

    For every k, the first k indices are also a farthest point sample.

    Args:
        xy_m: (n, 2) position of each pose (m).
        world: (n,) index of each pose's world frame.
        count: Number of poses to select, at most n.

    Returns:
        (count,) indices in order of selection.
    """
    nearest_m = np.full(len(xy_m), np.inf)
    chosen = np.zeros(count, int)
    for place in range(1, count + 1):
        last = chosen[place - 1]
        there = world == world[last]
        nearest_m[there] = np.minimum(nearest_m[there], np.hypot(*(xy_m[there] - xy_m[last]).T))
        # The value -1 excludes this pose. Another pose at the same position (0 m) remains selectable.
        nearest_m[last] = -1
        if place < count:
            chosen[place] = nearest_m.argmax()
    return chosen


def select_apart(xy_m: np.ndarray, world: np.ndarray, apart_m: float) -> np.ndarray:
    """Select each pose that lies at least apart_m from all poses selected so far.

    The search uses a grid of cells of width apart_m. Each pose is compared with the poses in its cell and the eight
    neighbouring cells.

    Args:
        xy_m: (n, 2) position of each pose (m).
        world: (n,) index of each pose's world frame.
        apart_m: Minimum distance between selected poses (m).

    Returns:
        Indices of the selected poses in ascending order.
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
    """Select the same number of scenes for each label where possible.

    If a label has too few scenes, more scenes of the other labels are selected. Scenes are evenly spaced within a
    label.

    Args:
        labels: (n,) label of each scene.
        count: Number of scenes to select, at most n.

    Returns:
        (count,) indices, grouped by label.
    """
    groups = [np.flatnonzero(labels == label) for label in np.unique(labels)]
    shares = np.zeros(len(groups), int)
    while (left := count - shares.sum()) > 0:
        open_groups = [g for g, group in enumerate(groups) if shares[g] < len(group)]
        for g in open_groups[: max(1, left)]:
            shares[g] += min(max(1, left // len(open_groups)), len(groups[g]) - shares[g])
    parts = [group[select_evenly(len(group), share)] for group, share in zip(groups, shares, strict=True)]
    return np.concatenate(parts)
