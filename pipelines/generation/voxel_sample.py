"""Run voxel methods with actors: generate, reconstruct, inpaint and outpaint scenes into the table voxels."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from itertools import chain
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from models.baselines.base import repeat_grids
from models.baselines.directory import load_baseline
from models.sampling.diffusion import make_keyed_generator
from models.scene import Grid
from models.voxel_grids import FINE, FINE_SHAPE, Factor, coarsen_voxels, name_voxel_column
from pipelines.geometry.voxels import VoxelGrid
from pipelines.io.voxel_table import make_voxel_row, make_voxel_table, unpack_voxels
from pipelines.runtime import storage
from pipelines.runtime.ray_tasks import map_actors
from pipelines.runtime.resources import find_device
from pipelines.schema.run_guard import guard_run
from pipelines.schema.tables import Shard, find_shards
from pipelines.training.latents import digest_weights

Task = Literal["sample", "reconstruct", "inpaint", "outpaint"]
Half = Literal["front", "back", "left", "right"]


@dataclass(frozen=True)
class VoxelSampleRequest:
    """Run of a voxel method. Its scenes are written as source generated-<run> of a dataset directory.

    Scene i depends only on the seed, i and the options. The coarser levels of a hierarchical method are the sources
    generated-<run>-<size of voxels>. All grids are divided into voxels of 0.25 m.

    Attributes:
        model: Directory of jobs/train_baseline.py.
        output: Dataset directory.
        run: Run name.
        task: sample new scenes; or reconstruct, inpaint or outpaint the scenes of `dataset`.
        num_scenes: Number of scenes.
        seed: Seed.
        dataset: Dataset directory with the table voxels; "" for new scenes.
        split: Split of the dataset.
        half: Part of each scene that inpainting generates.
        windows: Rows and columns of windows of an outpainted scene.
        shard_scenes: Number of scenes per shard.
    """

    model: str
    output: str
    run: str
    task: Task = "sample"
    num_scenes: int = 64
    seed: int = 0
    dataset: str = ""
    split: str = "test"
    half: Half = "front"
    windows: tuple[int, int] = (3, 3)
    shard_scenes: int = 32

    def __post_init__(self) -> None:
        if self.task not in get_args(Task) or self.half not in get_args(Half):
            raise ValueError(
                f"task is {self.task!r}, half {self.half!r}; expected {get_args(Task)} and {get_args(Half)}"
            )
        if self.num_scenes < 1:
            raise ValueError(f"num_scenes is {self.num_scenes}, expected at least 1")
        if (self.task == "sample") == bool(self.dataset):
            raise ValueError(f"task {self.task} {'reads no' if self.dataset else 'needs a'} dataset")

    def source(self, factor: Factor = FINE) -> str:
        """Return the source of the scenes of a level.

        Args:
            factor: Size of the voxels of a coarser level, or FINE for the result.

        Returns:
            Value of the source column.
        """
        return f"generated-{self.run}{'' if factor == FINE else name_voxel_column(factor).replace('voxels_', '-')}"

    def shards(self, factor: Factor = FINE) -> list[Shard]:
        """Return the shards of a level.

        Args:
            factor: Size of the voxels of a coarser level, or FINE for the result.

        Returns:
            All shards.
        """
        count = -(-self.num_scenes // self.shard_scenes)
        return [Shard(self.output, self.source(factor), "generated", k) for k in range(count)]

    def indices(self, number: int) -> range:
        """Return the numbers of the scenes of a shard.

        Args:
            number: Number of the shard.

        Returns:
            Numbers.
        """
        return range(number * self.shard_scenes, min((number + 1) * self.shard_scenes, self.num_scenes))


class VoxelSampler:
    """Actor that runs a method for one shard per row.

    The input row holds the number of the shard. The output row holds the number of scenes, the duration of the networks
    (s) and the largest memory use of the process (bytes).
    """

    def __init__(self, request: VoxelSampleRequest, batch_size: int) -> None:
        self.request, self.batch_size = request, batch_size
        self.pipeline = load_baseline(request.model)
        for network in self.pipeline.networks.values():
            network.to(find_device())
        self.given = list_given_scenes(request) if request.dataset else []

    def __call__(self, row: dict) -> dict:
        request, number = self.request, row["id"]
        indices = request.indices(number)
        rows: dict[Factor, list[dict]] = {}
        seconds = 0.0
        for start in range(0, len(indices), self.batch_size):
            chosen = indices[start : start + self.batch_size]
            given = [self._read(index) for index in chosen] if request.dataset else []
            started = time.perf_counter()
            grids = self._run(chosen, [voxels for _, voxels in given])
            if self.pipeline.device.type == "cuda":
                torch.cuda.synchronize()
            seconds += time.perf_counter() - started
            for place, (factor, made) in enumerate(reversed(list(grids.items()))):
                level: Factor = FINE if place == 0 else factor  # The finest level is the result.
                for k, index in enumerate(chosen):
                    name = given[k][0] if given else f"{request.run}-{index:06d}"
                    rows.setdefault(level, []).append(make_generated_row(name, made[k], factor))
        for level, found in rows.items():
            storage.write_parquet(make_voxel_table(found), request.shards(level)[number].path("voxels"))
        used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
        if self.pipeline.device.type == "cuda":
            used = torch.cuda.max_memory_allocated()
        return {"id": number, "scenes": len(indices), "seconds": seconds, "peak_bytes": float(used)}

    def _read(self, index: int) -> tuple[str, np.ndarray]:
        """Return the id and the voxels of a given scene, as the method reads them."""
        shard, row = self.given[index]
        table = shard.read("voxels", ["scene_id", "rows", "cols", "levels", "voxels"])
        try:
            voxels = unpack_voxels(table, row)
            if voxels.shape != FINE_SHAPE:
                sides, wanted = (" x ".join(map(str, shape)) for shape in (voxels.shape, FINE_SHAPE))
                raise ValueError(f"row {row}: a grid of {sides} voxels, but the method reads {wanted}")
        except ValueError as error:
            raise ValueError(f"{shard.path('voxels')}: {error}") from error
        return table["scene_id"][row].as_py(), coarsen_voxels(voxels, self.pipeline.factors[-1])

    def _run(self, indices: range, given: list[np.ndarray]) -> dict[Factor, Tensor]:
        """Return the grids of all levels of a batch."""
        request, pipeline = self.request, self.pipeline
        generators = [make_keyed_generator(request.seed, index) for index in indices]
        if request.task == "sample":
            return pipeline.sample(generators)
        voxels = torch.from_numpy(np.stack(given))
        finest = pipeline.factors[-1]
        if request.task == "reconstruct":
            return pipeline.reconstruct(voxels)
        if request.task == "outpaint":
            return {finest: pipeline.outpaint(voxels, *request.windows, generators)}
        unknown = mark_half(voxels.shape[1:3], request.half).expand(len(voxels), -1, -1)
        return {finest: pipeline.inpaint(voxels, unknown, generators)}


def mark_half(shape: tuple[int, ...], half: Half) -> Tensor:
    """Return a mask of half of a scene.

    Args:
        shape: Number of rows and columns.
        half: Part of the scene.

    Returns:
        (rows, cols) bool.
    """
    rows, cols = shape
    mask = torch.zeros(rows, cols, dtype=torch.bool)
    part = {
        "front": (slice(rows // 2), slice(None)),
        "back": (slice(rows // 2, None), slice(None)),
        "left": (slice(None), slice(cols // 2)),
        "right": (slice(None), slice(cols // 2, None)),
    }[half]
    mask[part] = True
    return mask


def make_generated_row(scene_id: str, voxels: Tensor, factor: Factor) -> dict:
    """Return the row of a generated grid, divided into fine voxels.

    Args:
        scene_id: Name of the scene.
        voxels: (rows, cols, levels) uint8 class ids.
        factor: Size of the voxels.

    Returns:
        Row of the table voxels. The grid is in the scene frame; outpainted grids extend equally to all sides.
    """
    fine = repeat_grids(voxels[None].cpu(), factor)[0].numpy()
    own = Grid()
    ahead_m, side_m = (
        (side - full) * own.resolution_m / 2 for side, full in zip(fine.shape[:2], FINE_SHAPE[:2], strict=True)
    )
    columns = replace(
        own, front_m=own.front_m + ahead_m, left_m=own.left_m + side_m, rows=fine.shape[0], cols=fine.shape[1]
    )
    return make_voxel_row(scene_id, fine, VoxelGrid(columns), ())


def list_given_scenes(request: VoxelSampleRequest) -> list[tuple[Shard, int]]:
    """Return the shard and the row of the first scenes of the dataset.

    Args:
        request: Options.

    Returns:
        One pair per scene.

    Raises:
        ValueError: The dataset has no voxels, or fewer scenes than requested.
    """
    shards = find_shards(request.dataset, "voxels", split=request.split)
    given = [(shard, row) for shard in shards for row in range(storage.read_num_rows(shard.path("voxels")))]
    if len(given) < request.num_scenes:
        raise ValueError(
            f"{request.dataset}: {len(given)} scenes of split {request.split} have voxels, expected at least"
            f" {request.num_scenes}; use a smaller --num-scenes"
        )
    return given[: request.num_scenes]


def sample_voxels(
    request: VoxelSampleRequest,
    num_actors: int = 1,
    batch_size: int = 4,
    on_shard: Callable[[dict], None] | None = None,
) -> dict:
    """Run a method and write the table voxels. To resume an interrupted run, call this function again.

    The file generated-<run>-voxels.json records the time per scene and the memory use.

    Args:
        request: Options.
        num_actors: Maximum number of actors; each holds the networks.
        batch_size: Number of scenes per batch.
        on_shard: Called with the row of each finished shard.

    Returns:
        Method, number of scenes, seconds per scene of one actor, and largest memory use (bytes). The last two are those
        of this call; they are None if all scenes existed.

    Raises:
        ValueError: The output contains a run of the same name with other options, the method cannot do the task, or a
            scene of the dataset has another size.
    """
    pipeline = load_baseline(request.model)
    options = {name: value for name, value in asdict(request).items() if name not in ("model", "output")}
    options["weights"] = "-".join(digest_weights(network) for network in pipeline.networks.values())
    guard_run(request.output, request.source(), request.run, options, [request.shards()[0].place("voxels")])
    if request.dataset:
        list_given_scenes(request)
    levels = [FINE, *pipeline.factors[:-1]] if request.task in ("sample", "reconstruct") else [FINE]
    promised = {
        shard.path("voxels"): len(request.indices(shard.number)) for level in levels for shard in request.shards(level)
    }
    faults = storage.find_faulty_files(promised)
    missing = [
        number
        for number in range(len(request.shards()))
        if any(request.shards(level)[number].path("voxels") in faults for level in levels)
    ]
    there = ({"id": k, "scenes": len(request.indices(k))} for k in range(len(request.shards())) if k not in missing)
    made = map_actors(missing, VoxelSampler, (request, batch_size), num_actors)
    scenes, seconds, peak = 0, 0.0, 0.0
    for row in chain(there, made):
        if on_shard:
            on_shard(row)
        if "seconds" in row:
            scenes, seconds, peak = scenes + row["scenes"], seconds + row["seconds"], max(peak, row["peak_bytes"])
    storage.require_rows(promised)
    summary = {"method": pipeline.method, "num_scenes": request.num_scenes, "batch_size": batch_size}
    summary |= {"seconds_per_scene": seconds / scenes if scenes else None, "peak_bytes": peak or None}
    if scenes:
        storage.write_json(summary, storage.join_uri(request.output, f"{request.source()}-voxels.json"))
    return summary


def iterate_voxels(shards: list[Shard], limit: int | None = None) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the scenes of shards of the table voxels.

    Args:
        shards: Shards.
        limit: Maximum number of scenes (default: all).

    Yields:
        Scene id, and (rows, cols, levels) uint8 class ids.

    Raises:
        ValueError: A file is damaged. The message names the file.
    """
    count = 0
    for shard in shards:
        table = shard.read("voxels", ["scene_id", "rows", "cols", "levels", "voxels"])
        for row in range(len(table)):
            if limit is not None and count >= limit:
                return
            try:
                yield table["scene_id"][row].as_py(), unpack_voxels(table, row)
            except ValueError as error:
                raise ValueError(f"{shard.path('voxels')}: {error}") from error
            count += 1
