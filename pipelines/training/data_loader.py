"""Load training batches from tables; Ray tasks read ahead, in an order that depends on the seed alone.

The stream of samples is fixed before anything is read: epoch after epoch, shards in random order, rows shuffled
within a window of a few shards. Every worker computes from its rank and the step which rows it needs. A resumed run
therefore continues with the next batch, and two workers see the samples that one worker would see.

The loader does not use Ray Data, whose executor runs in the training process. While finished blocks wait, it polls
without a pause and holds Python's lock, which makes steps on two cores four times as long (BENCHMARKS.md).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from typing import cast

import numpy as np
import pyarrow as pa
import ray

from models.augment import Augmentation
from models.labels import compose_label, find_label_index
from models.layout import LayoutSpec
from models.scene import Grid
from models.tensors import encode_height, encode_layout, encode_primitives, resample_ground
from pipelines.schema.tables import Shard, find_category_indices, list_ground_steps, parse_scenes, read_fixed_lists

WINDOW_SHARDS = 4
SAMPLES_PER_TASK = 256
AHEAD = 2  # tasks running or done while the samples of another are consumed
READER_CPUS = 0.5  # leaves room next to a training worker on two cores; with more, both would wait for each other

Arrays = dict[str, np.ndarray]
Reader = Callable[[Shard, np.ndarray, np.ndarray], Arrays]  # shard, rows, their places in the stream -> stacked samples


@dataclass(frozen=True)
class Stream:
    """The endless, seeded order of samples of a training run."""

    shards: tuple[Shard, ...]
    counts: tuple[int, ...]
    batch_size: int  # global
    seed: int

    def __post_init__(self) -> None:
        if not self.shards or sum(self.counts) == 0:
            raise ValueError("there is nothing to train on: the training split has no scenes")

    def positions(self, first: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        """(shard, row) of samples first .. first + count - 1 of the stream."""
        epoch_size = sum(self.counts)
        wanted = np.arange(first, first + count)
        shard, row = np.empty(count, np.int64), np.empty(count, np.int64)
        for epoch in np.unique(wanted // epoch_size):
            here = wanted // epoch_size == epoch
            shards, rows = shuffle_epoch(self.counts, self.seed, int(epoch))
            shard[here], row[here] = shards[wanted[here] % epoch_size], rows[wanted[here] % epoch_size]
        return shard, row


@lru_cache(maxsize=4)
def shuffle_epoch(counts: tuple[int, ...], seed: int, epoch: int) -> tuple[np.ndarray, np.ndarray]:
    """Every (shard, row) once: shards permuted, rows shuffled within windows of WINDOW_SHARDS shards."""
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


def read_samples(stream: Stream, read: Reader, first: int, count: int, batch: int, rank: int, world: int) -> Arrays:
    """Read the rank's share of `count` consecutive global batches from batch `first`, in order."""
    shard, row = stream.positions(first * batch, count * batch)
    mine = (np.arange(count * batch) % batch) // (batch // world) == rank
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
    stream: Stream, read: Reader, start_step: int, stop_step: int, rank: int = 0, world: int = 1
) -> Iterator[Arrays]:
    """Yield the local batches of steps start_step .. stop_step - 1 of one worker; Ray tasks read AHEAD of them.

    Args:
        stream: Order of the samples.
        read: Reads samples of a shard.
        start_step: First step.
        stop_step: Step after the last one.
        rank: Number of the worker.
        world: Number of workers.

    Yields:
        Read-only arrays by name, (batch size / world, ...) each.

    Raises:
        ValueError: The number of workers does not divide the global batch size.
    """
    batch = stream.batch_size
    if batch % world:
        raise ValueError(f"batch size {batch} does not divide by {world} workers")
    per_task, local = max(1, SAMPLES_PER_TASK // batch), batch // world
    reader = ray.remote(num_cpus=READER_CPUS)(read_samples)
    shared = ray.put(stream), ray.put(read)
    firsts, reading = iter(range(start_step, stop_step, per_task)), deque()
    while True:
        for first in islice(firsts, 1 + AHEAD - len(reading)):
            reading.append(reader.remote(*shared, first, min(per_task, stop_step - first), batch, rank, world))
        if not reading:
            return
        samples = cast(Arrays, ray.get(reading.popleft()))
        for start in range(0, len(next(iter(samples.values()))), local):
            yield {name: values[start : start + local] for name, values in samples.items()}


@dataclass(frozen=True)
class LayoutReader:
    """Reads samples for stage 1: encoded layouts (models/tensors.py) under a LayoutSpec, optionally augmented."""

    spec: LayoutSpec
    augment: Augmentation | None = None

    def __call__(self, shard: Shard, rows: np.ndarray, places: np.ndarray | None = None) -> Arrays:
        augment = self.augment
        if augment:
            if places is None:
                raise ValueError("augmented samples need their places in the stream")
            scenes = parse_scenes(*_read_scene_tables(shard), shard.source, shard.split, rows.tolist())
            layouts = (encode_layout(augment(s, int(k)), self.spec) for s, k in zip(scenes, places, strict=True))
        else:
            stored = _read_stored_layouts(shard)
            layouts = (stored.layout(int(row), self.spec) for row in rows)
        out: Arrays = {}
        for k, layout in enumerate(layouts):
            for name, value in layout.items():
                if name not in out:
                    out[name] = np.empty((len(rows), *value.shape), value.dtype)
                out[name][k] = value
        return out


@lru_cache(maxsize=2 * WINDOW_SHARDS)
def _read_scene_tables(shard: Shard) -> tuple[pa.Table, pa.Table, pa.Table]:
    return tuple(shard.read(table) for table in ("scenes", "primitives", "rasters"))


@dataclass(frozen=True, eq=False)
class StoredLayouts:
    """The columns of a shard that layouts need; encoding them without Scenes takes half the time."""

    first: np.ndarray  # (scenes,) row of a scene's first primitive
    count: np.ndarray  # (scenes,)
    category: np.ndarray  # (n,) int8
    center_m: np.ndarray  # (n, 3)
    cholesky: np.ndarray  # (n, 6)
    rasters: pa.Table

    def layout(self, row: int, spec: LayoutSpec) -> Arrays:
        """`encode_layout` of one scene."""
        here = slice(self.first[row], self.first[row] + self.count[row])
        primitives = encode_primitives(self.category[here], self.center_m[here], self.cholesky[here], spec)
        return self.ground(row, spec) | primitives

    def ground(self, row: int, spec: LayoutSpec) -> Arrays:
        """Encode the ground of one scene; a table of all stored heights is scaled once, for all scenes."""
        raster = {name: self.rasters[name][row].as_py() for name in self.rasters.column_names}
        grid = Grid(raster["front_m"], raster["left_m"], raster["resolution_m"], raster["rows"], raster["cols"])
        classes = raster["ground_classes"]
        steps, mask = list_ground_steps(raster["height"], raster["occupied"], (len(classes), grid.rows, grid.cols))
        height = np.zeros(mask.shape, np.uint16)
        height[mask] = _scale_steps(spec, raster["height_step_m"])[steps.view(np.uint16)]
        if classes != list(spec.ground_classes):
            place = [classes.index(name) if name in classes else -1 for name in spec.ground_classes]
            height, mask = (np.stack([v[k] if k >= 0 else np.zeros_like(v[0]) for k in place]) for v in (height, mask))
        height, mask = resample_ground(height, mask, grid, spec.grid)
        return {"height": height, "occupied": mask}


@lru_cache(maxsize=4)
def _scale_steps(spec: LayoutSpec, step_m: float) -> np.ndarray:
    """(65536,) uint16: `encode_height` of every 16-bit number of height steps."""
    steps = np.arange(2**16, dtype=np.uint16).view(np.int16)
    return encode_height(steps * np.float32(step_m), spec)


@lru_cache(maxsize=2 * WINDOW_SHARDS)
def _read_stored_layouts(shard: Shard) -> StoredLayouts:
    scenes = shard.read("scenes", ["scene_id", "primitive_offset", "num_primitives"])
    primitives = shard.read("primitives", ["category", "x_m", "y_m", "z_m", "cholesky"]).combine_chunks()
    rasters = shard.read("rasters")
    if scenes["scene_id"] != rasters["scene_id"]:
        raise ValueError(f"{shard.path('rasters')} is not aligned with {shard.path('scenes')}; preprocess again")
    return StoredLayouts(
        first=scenes["primitive_offset"].to_numpy(),
        count=scenes["num_primitives"].to_numpy(),
        category=find_category_indices(primitives["category"]),
        center_m=np.stack([primitives[f"{axis}_m"].to_numpy() for axis in "xyz"], axis=1),
        cholesky=read_fixed_lists(primitives["cholesky"], 6),
        rasters=rasters.combine_chunks(),
    )


@lru_cache(maxsize=2 * WINDOW_SHARDS)
def _read_latents(shard: Shard, latents_root: str, label: str) -> Arrays:
    table = Shard(latents_root, shard.source, shard.split, shard.number).read("latents")
    scenes = shard.read("scenes", ["scene_id", "vegetation_density", "vehicle_density"])
    if table["scene_id"].to_pylist() != scenes["scene_id"].to_pylist():
        raise ValueError(
            f"{shard.path('latents')} is not aligned with {shard.path('scenes')}; encode the latents again"
        )
    moments = {name: table[name].combine_chunks().to_numpy_ndarray() for name in ("mean", "logvar")}
    return moments | {"label": label_indices(scenes, label)}


def label_indices(scenes: pa.Table, label: str) -> np.ndarray:
    """(n,) int64: index into LABELS[label] per row of a scenes table."""
    densities = zip(scenes["vegetation_density"].to_pylist(), scenes["vehicle_density"].to_pylist(), strict=True)
    names = [compose_label(label, vegetation, vehicle) for vegetation, vehicle in densities]
    return np.array([find_label_index(label, str(name)) for name in names], np.int64)


@dataclass(frozen=True)
class LatentReader:
    """Reads samples for stage 2: posterior moments and labels."""

    latents_root: str
    label: str

    def __call__(self, shard: Shard, rows: np.ndarray, places: np.ndarray | None = None) -> Arrays:
        return {name: values[rows] for name, values in _read_latents(shard, self.latents_root, self.label).items()}
