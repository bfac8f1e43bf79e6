"""Load training batches from tables. Ray tasks read samples in advance.

The order of the samples depends only on the seed. The order is fixed before the first sample is read. Each epoch visits
the shards in random order and shuffles the samples within windows of a few shards. Each worker uses its rank and the
step to compute the rows that it needs. A resumed run therefore continues with the next batch. The samples of two
workers, taken together, are the samples that a single worker would read.

The loader does not use Ray Data, whose executor runs in the training process. While finished blocks wait, the executor
polls without pauses and holds the global interpreter lock of Python. With Ray Data, training steps on two cores take up
to four times as long as with this loader (docs/experiments/reading_training_data.md).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from typing import Protocol, cast

import numpy as np
import pyarrow as pa
import ray

from models.augment import Augmentation
from models.labels import compose_label, find_label_index
from models.layout import LayoutSpec
from models.scene import Grid
from models.tensors import encode_height, encode_layout, encode_primitives, resample_ground
from pipelines.schema.conversion import find_category_indices, list_ground_steps, parse_scenes, read_fixed_lists
from pipelines.schema.dataset import DENSITY_COLUMNS, label_scenes
from pipelines.schema.density_labels import DensityThresholds
from pipelines.schema.ground_surface import find_surface, find_surface_offset, to_model_surface
from pipelines.schema.tables import Shard
from pipelines.schema.validation import validate_shard

WINDOW_SHARDS = 4
CACHED_SHARDS = 4 * WINDOW_SHARDS  # Number of shards in memory: the windows of four datasets.
SAMPLES_PER_TASK = 256
AHEAD = 2  # Number of tasks that read samples in advance, while the training uses the samples of another task.
READ_HERE_AFTER_S = 60.0  # Time after which a worker reads samples itself, because no task has read them.
READER_CPUS = 0.5  # With more CPUs per reader, readers and training workers would wait for each other on two cores.

Arrays = dict[str, np.ndarray]
Thresholds = tuple[DensityThresholds, DensityThresholds] | None  # Of the vegetation and the vehicle density.
Reader = Callable[[Shard, np.ndarray, np.ndarray], Arrays]  # (Shard, rows, positions in the stream) -> samples.


class SampleOrder(Protocol):
    """The endless, seeded order of training samples: `Stream`, or `MixedStream` of mixed_stream.py."""

    @property
    def shards(self) -> tuple[Shard, ...]: ...

    @property
    def batch_size(self) -> int: ...

    def positions(self, first: int, count: int) -> tuple[np.ndarray, np.ndarray]: ...


@dataclass(frozen=True)
class Stream:
    """The endless, seeded order of the samples of a training run.

    Attributes:
        shards: Shards of the training split.
        counts: Number of samples of each shard in an epoch.
        batch_size: Global batch size.
        seed: Seed of the order.
        rows: Row of each sample of each shard in an epoch; a row may be repeated. Empty: each row once.

    Raises:
        ValueError: There are no samples, or `rows` and `counts` differ in length.
    """

    shards: tuple[Shard, ...]
    counts: tuple[int, ...]
    batch_size: int
    seed: int
    rows: tuple[tuple[int, ...], ...] = ()

    def __post_init__(self) -> None:
        if not self.shards or sum(self.counts) == 0:
            raise ValueError("the training split has no scenes")
        if self.rows and tuple(map(len, self.rows)) != self.counts:
            raise ValueError(f"rows has {list(map(len, self.rows))} entries per shard, counts {list(self.counts)}")

    def positions(self, first: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the shard and the row of each of the samples first .. first + count - 1 of the stream."""
        epoch_size = sum(self.counts)
        wanted = np.arange(first, first + count)
        shard, row = np.empty(count, np.int64), np.empty(count, np.int64)
        for epoch in np.unique(wanted // epoch_size):
            here = wanted // epoch_size == epoch
            shards, rows = shuffle_epoch(self.counts, self.seed, int(epoch))
            shard[here], row[here] = shards[wanted[here] % epoch_size], rows[wanted[here] % epoch_size]
        if self.rows:
            row = np.array([self.rows[k][i] for k, i in zip(shard, row, strict=True)], np.int64)
        return shard, row


@lru_cache(maxsize=4)
def shuffle_epoch(counts: tuple[int, ...], seed: int, epoch: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the shard, and the index within the shard, of all samples in the order of one epoch.

    The shards are in random order. Rows are shuffled within windows of WINDOW_SHARDS shards.
    """
    rng = np.random.default_rng([seed, epoch])
    order = rng.permutation(len(counts))
    shards, rows = [], []
    for start in range(0, len(order), WINDOW_SHARDS):
        window = order[start : start + WINDOW_SHARDS]
        shard = np.repeat(window, [counts[k] for k in window])
        row = np.concatenate([np.arange(counts[k]) for k in window])
        mix = rng.permutation(len(shard))
        shards.append(shard[mix])
        rows.append(row[mix])
    return np.concatenate(shards), np.concatenate(rows)


def split_batch(batch: int, rank: int, world: int) -> range:
    """Return the positions of a worker's samples in the global batch; the shares differ by at most one sample.

    Args:
        batch: Global batch size.
        rank: Rank of the worker.
        world: Number of workers.

    Returns:
        Positions.
    """
    return range(rank * batch // world, (rank + 1) * batch // world)


def read_samples(
    stream: SampleOrder, read: Reader, first: int, count: int, batch: int, rank: int, world: int
) -> Arrays:
    """Read, in order, the samples of one rank in `count` consecutive global batches, beginning with batch `first`."""
    shard, row = stream.positions(first * batch, count * batch)
    mine = np.isin(np.arange(count * batch) % batch, split_batch(batch, rank, world))
    shard, row, place = shard[mine], row[mine], first * batch + np.flatnonzero(mine)
    out: Arrays = {}
    for k in np.unique(shard):
        here = np.flatnonzero(shard == k)
        for name, values in read(stream.shards[k], row[here], place[here]).items():
            if name not in out:
                out[name] = np.empty((len(shard), *values.shape[1:]), values.dtype)
            out[name][here] = values
    return out


def iterate_batches(
    stream: SampleOrder, read: Reader, start_step: int, stop_step: int, rank: int = 0, world: int = 1
) -> Iterator[Arrays]:
    """Yield the local batches of one worker for steps start_step .. stop_step - 1.

    Ray tasks read the next samples in advance; AHEAD is the number of these tasks.

    Args:
        stream: Order of the samples.
        read: Function that reads samples of a shard.
        start_step: First step.
        stop_step: Step after the last step.
        rank: Rank of the worker.
        world: Number of workers.

    Yields:
        Dictionary of read-only arrays, each with the samples of `split_batch`.

    Raises:
        ValueError: There are more workers than samples in a batch.
    """
    batch = stream.batch_size
    if batch < world:
        raise ValueError(f"batch size {batch} is smaller than the number of workers, {world}")
    per_task, local = max(1, SAMPLES_PER_TASK // batch), len(split_batch(batch, rank, world))
    reader = ray.remote(num_cpus=READER_CPUS)(read_samples)
    shared = ray.put(stream), ray.put(read)
    firsts, reading = iter(range(start_step, stop_step, per_task)), deque()
    while True:
        for first in islice(firsts, 1 + AHEAD - len(reading)):
            part = first, min(per_task, stop_step - first), batch, rank, world
            reading.append((reader.remote(*shared, *part), part))
        if not reading:
            return
        task, part = reading.popleft()
        done, _ = ray.wait([task], timeout=READ_HERE_AFTER_S)
        # Without room for reading tasks, the training would wait for them, and they for the training.
        samples = cast(Arrays, ray.get(task)) if done else read_samples(stream, read, *part)
        for start in range(0, len(next(iter(samples.values()))), local):
            yield {name: values[start : start + local] for name, values in samples.items()}


@dataclass(frozen=True)
class LayoutReader:
    """Read samples for stage 1: encoded layouts (models/tensors.py), optionally augmented.

    Attributes:
        spec: Layout of the model.
        augment: Augmentation. None: the stored scenes are not changed.
        clip_heights: Whether to clip ground heights to the bounds of the layout.
    """

    spec: LayoutSpec
    augment: Augmentation | None = None
    clip_heights: bool = True

    def __call__(self, shard: Shard, rows: np.ndarray, places: np.ndarray | None = None) -> Arrays:
        augment = self.augment
        if augment:
            if places is None:
                raise ValueError("augmentation needs the position of each sample in the stream")
            scenes = parse_scenes(*_read_tables(shard), shard.source, shard.split, rows.tolist())
            moved = (augment(to_model_surface(s, self.spec), int(k)) for s, k in zip(scenes, places, strict=True))
            layouts = (encode_layout(scene, self.spec, self.clip_heights) for scene in moved)
        else:
            stored = _read_stored_layouts(shard)
            layouts = (stored.layout(int(row), self.spec, self.clip_heights) for row in rows)
        out: Arrays = {}
        for k, layout in enumerate(layouts):
            for name, value in layout.items():
                if name not in out:
                    out[name] = np.empty((len(rows), *value.shape), value.dtype)
                out[name][k] = value
        return out


@lru_cache(maxsize=CACHED_SHARDS)
def _read_tables(shard: Shard) -> tuple[pa.Table, pa.Table, pa.Table]:
    return shard.read_tables()


@dataclass(frozen=True, eq=False)
class StoredLayouts:
    """Columns of a shard from which layouts are encoded. Encoding from Scene objects would take twice the time.

    Attributes:
        first: (scenes,) index of the first primitive of each scene.
        count: (scenes,) number of primitives of each scene.
        category: (n,) int8 category of each primitive.
        center_m: (n, 3) centre of each primitive (m, scene frame).
        cholesky: (n, 6) Cholesky parameters of each primitive.
        rasters: Rasters table.
        source: Source of the scenes.
        scene_ids: Ids of the scenes. Source and ids determine the reference surface.
    """

    first: np.ndarray
    count: np.ndarray
    category: np.ndarray
    center_m: np.ndarray
    cholesky: np.ndarray
    rasters: pa.Table
    source: str
    scene_ids: list[str]

    def layout(self, row: int, spec: LayoutSpec, clip_heights: bool = True) -> Arrays:
        """Encode one scene like `encode_layout`."""
        here = slice(self.first[row], self.first[row] + self.count[row])
        primitives = encode_primitives(self.category[here], self.center_m[here], self.cholesky[here], spec)
        return self.ground(row, spec, clip_heights) | primitives

    def ground(self, row: int, spec: LayoutSpec, clip_heights: bool = True) -> Arrays:
        """Encode the ground of one scene. One table, which all scenes share, maps stored heights to encoded heights."""
        raster = {name: self.rasters[name][row].as_py() for name in self.rasters.column_names}
        grid = Grid(raster["front_m"], raster["left_m"], raster["resolution_m"], raster["rows"], raster["cols"])
        classes = raster["ground_classes"]
        steps, mask = list_ground_steps(raster["height"], raster["occupied"], (len(classes), grid.rows, grid.cols))
        surface = find_surface(self.source, self.scene_ids[row], spec.surface)
        scaled = _scale_steps(spec, raster["height_step_m"], find_surface_offset(surface, spec), clip_heights)
        height = np.zeros(mask.shape, scaled.dtype)
        height[mask] = scaled[steps.view(np.uint16)]
        if classes != list(spec.ground_classes):
            place = [classes.index(name) if name in classes else -1 for name in spec.ground_classes]
            height, mask = (np.stack([v[k] if k >= 0 else np.zeros_like(v[0]) for k in place]) for v in (height, mask))
        height, mask = resample_ground(height, mask, grid, spec.grid)
        return {"height": height, "occupied": mask}


@lru_cache(maxsize=4)
def _scale_steps(spec: LayoutSpec, step_m: float, offset_m: float, clip_heights: bool) -> np.ndarray:
    """Return (65536,) the result of `encode_height` for each 16-bit stored height, plus an offset."""
    steps = np.arange(2**16, dtype=np.uint16).view(np.int16)
    return encode_height(steps * np.float32(step_m) + np.float32(offset_m), spec, clip_heights)


@lru_cache(maxsize=CACHED_SHARDS)
def _read_stored_layouts(shard: Shard) -> StoredLayouts:
    scenes = shard.read("scenes", ["scene_id", "primitive_offset", "num_primitives"])
    columns = ["scene_id", "category", "x_m", "y_m", "z_m", "cholesky"]
    primitives = shard.read("primitives", columns, encoded=("scene_id", "category")).combine_chunks()
    rasters = shard.read("rasters")
    try:
        validate_shard(scenes, primitives, rasters)
    except ValueError as error:
        raise ValueError(f"{shard.path('scenes')}: {error}; run the preprocessing again") from error
    return StoredLayouts(
        first=scenes["primitive_offset"].to_numpy(),
        count=scenes["num_primitives"].to_numpy(),
        category=find_category_indices(primitives["category"]),
        center_m=np.stack([primitives[f"{axis}_m"].to_numpy() for axis in "xyz"], axis=1),
        cholesky=read_fixed_lists(primitives["cholesky"], 6),
        rasters=rasters.combine_chunks(),
        source=shard.source,
        scene_ids=scenes["scene_id"].to_pylist(),
    )


@lru_cache(maxsize=CACHED_SHARDS)
def _read_latents(shard: Shard, latents_root: str, label: str, thresholds: Thresholds) -> Arrays:
    table = Shard(latents_root, shard.source, shard.split, shard.number).read("latents")
    scenes = shard.read("scenes", ["scene_id"])
    if table["scene_id"].to_pylist() != scenes["scene_id"].to_pylist():
        raise ValueError(
            f"{shard.path('latents')} is not aligned with {shard.path('scenes')}; encode the latents again"
        )
    moments = {name: table[name].combine_chunks().to_numpy_ndarray() for name in ("mean", "logvar")}
    return moments | {"label": read_label_indices(shard, label, thresholds)}


@lru_cache(maxsize=CACHED_SHARDS)
def _read_street_latents(shard: Shard, latents_root: str) -> Arrays:
    table = Shard(latents_root, shard.source, shard.split, shard.number).read("street_latents")
    if table["scene_id"].to_pylist() != shard.read("scenes", ["scene_id"])["scene_id"].to_pylist():
        raise ValueError(
            f"{shard.path('street_latents')} is not aligned with {shard.path('scenes')}; encode the latents again"
        )
    names = {"ground": "street_ground", "cells": "street_cells"}
    return {name: table[column].combine_chunks().to_numpy_ndarray() for column, name in names.items()}


LABEL_COLUMNS = ("vegetation_density", "vehicle_density", "free_pose")  # Columns that determine a label.


def repeat_crops(scenes: pa.Table, repeats: int) -> tuple[int, ...]:
    """Return the rows of a scenes table, each crop at any place `repeats` times and each view of a vehicle once."""
    crop = np.array(scenes["free_pose"].to_pylist(), bool)
    return tuple(np.repeat(np.arange(len(crop)), np.where(crop, repeats, 1)).tolist())


def read_label_indices(shard: Shard, label: str, thresholds: Thresholds = None) -> np.ndarray:
    """Return (n,) int64: the index of the label of each scene of a shard in LABELS[label].

    With thresholds of the vegetation and the vehicle density, the labels are computed; otherwise, the stored labels are
    used.
    """
    if thresholds is None:
        return label_indices(shard.read("scenes", list(LABEL_COLUMNS)), label)
    return label_indices(label_scenes(shard.read("scenes", [*DENSITY_COLUMNS, "free_pose"]), *thresholds), label)


def label_indices(scenes: pa.Table, label: str) -> np.ndarray:
    """Return (n,) int64: for each row of a scenes table, the index of its label in LABELS[label]."""
    parts = zip(*(scenes[name].to_pylist() for name in LABEL_COLUMNS), strict=True)
    names = [compose_label(label, vegetation, vehicle, bool(free_pose)) for vegetation, vehicle, free_pose in parts]
    return np.array([find_label_index(label, str(name)) for name in names], np.int64)


@dataclass(frozen=True)
class LatentReader:
    """Read samples for stage 2: labels, and moments of the latents.

    Attributes:
        latents_roots: Directory of the latents of each dataset directory.
        label: Kind of label.
        streets: Whether to read the latents of the streets, too.
        thresholds: Thresholds of the vegetation and the vehicle density, from which labels are computed. None: each
            scene has its stored label.
    """

    latents_roots: Mapping[str, str]
    label: str
    streets: bool = False
    thresholds: Thresholds = None

    def __call__(self, shard: Shard, rows: np.ndarray, places: np.ndarray | None = None) -> Arrays:
        root = self.latents_roots[shard.root]
        arrays = _read_latents(shard, root, self.label, self.thresholds)
        if self.streets:
            arrays = arrays | _read_street_latents(shard, root)
        return {name: values[rows] for name, values in arrays.items()}
