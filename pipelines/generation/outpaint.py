"""Scenes -> larger scenes: blocks as Ray tasks, each as soon as those that it must know are made."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property

import pyarrow as pa
import ray
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from models.composition.outpaint import Block, Lattice, Place, World, colour, height_near, outward
from models.pipeline import Resampling
from models.scene import Scene
from models.tensors import new_scene
from pipelines.generation.sample import Request, claim_run, label_of, load_pipeline, on_model_grid
from pipelines.io.mesh_export import scene_glb
from pipelines.runtime import storage
from pipelines.runtime.ray_tasks import gpus_per_actor
from pipelines.schema.scene_subset import Selection
from pipelines.schema.tables import Shard

RANKS = {"outward": outward, "colours": colour}
ARRAYS = ("category", "center_m", "rotation", "size_m", "existence", "height_m", "occupied")
HARDLY_KNOWN = 0.1  # share of ground in what a block knew beforehand
MAX_RETRIES = 3  # of a block whose process died


@dataclass(frozen=True)
class OutpaintRequest(Request):
    """How to extend scenes; `label` None means each scene's own. `last`: blocks ahead, behind, left, right."""

    label: str | None
    seed: int
    overlap: float
    mode: str
    resampling: Resampling
    guidance_scale: float
    last: tuple[int, int, int, int] = (1, 1, 1, 1)
    order: str = "outward"
    batch_size: int = 4

    def scene_id(self, number: int) -> str:
        return f"{self.source}-{self.seed}-{number:07d}"

    def blocks(self, number: int) -> str:
        """Directory of a scene's blocks, until they are put together."""
        return storage.join(self.output, "blocks", self.run, f"{number:07d}")

    def lattice(self, size: int) -> Lattice:
        return Lattice.of(size, self.overlap, rank=RANKS[self.order], last=self.last)


@dataclass(frozen=True)
class Batch:
    """Blocks of a scene to be made together, and those that must be made before."""

    number: int  # of the scene
    places: tuple[Place, ...]
    needs: frozenset[Place]


def batches(lattice: Lattice, number: int, batch_size: int) -> list[Batch]:
    """All blocks of a scene but the given one, in an order that can be worked off; always the same batches."""
    made = []
    for front in lattice.fronts(place for place in lattice.places() if place != (0, 0)):
        for start in range(0, len(front), batch_size):
            places = tuple(front[start : start + batch_size])
            needs = frozenset(other for place in places for other, _ in lattice.known(place)) - {(0, 0)}
            made.append(Batch(number, places, needs))
    return made


# ------------------------------------------------------------------------------------------------------------ blocks


def block_path(directory: str, place: Place) -> str:
    return storage.join(directory, f"{place[0]:+05d}{place[1]:+05d}.safetensors")


def write_block(block: Block, path: str) -> None:
    """Exactly, unlike the tables: a run that was interrupted goes on as if it had not been."""
    arrays = {name: torch.from_numpy(getattr(block.scene, name).copy()) for name in ARRAYS}
    arrays |= {"latent": block.latent.cpu().contiguous()}
    arrays |= {"of_block": torch.tensor([block.datum_m, block.known_ground], dtype=torch.float64)}
    data = save(arrays)
    storage.write_whole(path, lambda stream: stream.write(data))


def read_block(path: str, empty: Scene) -> Block:
    """Raises ValueError naming a file that is missing or damaged."""
    try:
        arrays = load(storage.read_bytes(path))
    except SafetensorError as error:
        raise ValueError(f"{path}: not a whole block ({error}); delete it and run the job again") from error
    latent, (datum_m, known_ground) = arrays.pop("latent"), arrays.pop("of_block").tolist()
    scene = replace(
        empty,
        heading_rad=None,
        instance_id=None,
        label=None,
        **{name: value.numpy() for name, value in arrays.items()},
    )
    return Block(scene, latent, datum_m, known_ground)


class Outpainter:
    """Actor with a pipeline: makes blocks, and puts a scene's blocks together."""

    def __init__(self, request: OutpaintRequest, chosen: list[tuple[Shard, int]]) -> None:
        self.request, self.chosen = request, chosen
        self.pipeline = load_pipeline(request.model)

    @cached_property
    def lattice(self) -> Lattice:
        return self.request.lattice(self.pipeline.lvae.latent_shape[-1])

    def given(self, number: int) -> Scene:
        shard, row = self.chosen[number]
        return on_model_grid(shard.scenes([row])[0], self.pipeline.spec)

    def world(self, number: int, places: Sequence[Place]) -> tuple[World, Scene, dict[Place, Block]]:
        """A scene's world, the given scene, and its blocks at `places`; the given one is among them."""
        given = self.given(number)
        empty = new_scene(given.scene_id, given.source, given.sequence, given.frame, self.pipeline.spec)
        made = {place: read_block(block_path(self.request.blocks(number), place), empty) for place in places}
        made[(0, 0)] = Block(given, self.pipeline.encode([given])[0])
        world = World(self.lattice, self.pipeline.spec, self.pipeline.encode, height_near(given, 0.0, 0.0))
        return world, given, made

    def extend(self, batch: Batch) -> None:
        """Make the blocks of a batch and write each."""
        request = self.request
        world, given, known = self.world(batch.number, sorted(batch.needs))
        made = self.pipeline.extend(
            world,
            batch.places,
            known,
            given,
            request.label or label_of(given, self.pipeline.dit.config.label),
            request.seed,
            batch.number,
            request.mode,
            request.resampling,
            request.guidance_scale,
        )
        for place, block in made.items():
            write_block(block, block_path(request.blocks(batch.number), place))

    def finish(self, number: int) -> None:
        """Write a scene's tables and GLB from its blocks, and a table of the blocks; delete their files."""
        request = self.request
        world, given, made = self.world(number, [place for place in self.lattice.places() if place != (0, 0)])
        name = request.scene_id(number)
        scene = replace(
            world.stitched(made, given), scene_id=name, source=request.source, split="generated", frame=number
        )
        path = storage.join(request.output, "glb", request.run, f"{name}.glb")
        storage.write_whole(path, lambda stream: stream.write(scene_glb(scene)))
        rows = [
            {"scene_id": name, "ahead": i, "left": j, "datum_m": block.datum_m, "known_ground": block.known_ground}
            for (i, j), block in sorted(made.items())
        ]
        storage.write_parquet(pa.Table.from_pylist(rows), blocks_table(request, number))
        request.shard(number).write([scene])
        storage.delete_directory(request.blocks(number))


def blocks_table(request: OutpaintRequest, number: int) -> str:
    return storage.join(request.output, "block_tables", request.run, f"{number:07d}.parquet")


# --------------------------------------------------------------------------------------------------------------- run


def outpaint_scenes(
    request: OutpaintRequest, selection: Selection, num_actors: int = 1, on_blocks: Callable[[int], None] | None = None
) -> pa.Table:
    """Extend the selected scenes; a row per block. Goes on where it stopped. `on_blocks` gets how many more are made.

    Raises ValueError if the output holds a run made with other options.
    """
    chosen = [(shard, row) for shard, rows in selection.shards() for row in rows]
    pipeline = load_pipeline(request.model)
    lattice = request.lattice(pipeline.lvae.latent_shape[-1])
    parts = [storage.join(request.output, "blocks", request.run)]
    claim_run(request, pipeline, parts, input=asdict(selection), scenes=selection.files())

    waiting, done = [], {}
    for number in range(len(chosen)):
        if request.shard(number).is_written():
            continue
        there = {place for place in lattice.places() if storage.exists(block_path(request.blocks(number), place))}
        done[number] = there
        waiting += [b for b in batches(lattice, number, request.batch_size) if not there.issuperset(b.places)]
    if on_blocks:
        per_scene = len(lattice.places()) - 1
        on_blocks(per_scene * len(chosen) - sum(len(batch.places) for batch in waiting))
    if done:
        work_off(request, chosen, waiting, done, num_actors, on_blocks)
    return pa.concat_tables(storage.read_parquet(blocks_table(request, number)) for number in range(len(chosen)))


def work_off(
    request: OutpaintRequest,
    chosen: list[tuple[Shard, int]],
    waiting: list[Batch],
    done: dict[int, set[Place]],
    num_actors: int,
    on_blocks: Callable[[int], None] | None,
) -> None:
    """Hand batches to idle actors as soon as what they need is made, and each scene that is whole to be put together."""
    actor = ray.remote(Outpainter).options(
        num_cpus=1, num_gpus=gpus_per_actor(), max_restarts=-1, max_task_retries=MAX_RETRIES
    )
    room = int(ray.cluster_resources().get("GPU" if gpus_per_actor() else "CPU", 0))
    count = min(num_actors, max(len(waiting), len(done)), max(1, room))  # one without room would take a killed one's
    workers = [actor.remote(request, chosen) for _ in range(count)]
    try:
        hand_out(workers, waiting, done, on_blocks)
    finally:  # an error's traceback would keep them, and their CPUs, alive
        for worker in workers:
            ray.kill(worker)


def hand_out(
    workers: list, waiting: list[Batch], done: dict[int, set[Place]], on_blocks: Callable[[int], None] | None
) -> None:
    """Until nothing is left to do. An actor works from when it is up: others may have taken its room."""
    idle: list = []
    running: dict[ray.ObjectRef, tuple] = {worker.__ray_ready__.remote(): (None, worker) for worker in workers}
    left = {number: sum(batch.number == number for batch in waiting) for number in done}
    whole = [number for number, batches_left in left.items() if not batches_left]
    while waiting or whole or any(task is not None for task, _ in running.values()):
        while idle and (task := next_task(waiting, whole, done)) is not None:
            worker = idle.pop()
            call = worker.extend if isinstance(task, Batch) else worker.finish
            running[call.remote(task)] = task, worker
        (finished,), _ = ray.wait(list(running), num_returns=1)
        task, worker = running.pop(finished)
        ray.get(finished)
        idle.append(worker)
        if isinstance(task, Batch):
            done[task.number].update(task.places)
            left[task.number] -= 1
            if not left[task.number]:
                whole.append(task.number)
            if on_blocks:
                on_blocks(len(task.places))


def next_task(waiting: list[Batch], whole: list[int], done: Mapping[int, set[Place]]) -> Batch | int | None:
    """Takes the first task that can be done now out of its list."""
    if whole:
        return whole.pop(0)
    for position, batch in enumerate(waiting):
        if batch.needs <= done[batch.number]:
            return waiting.pop(position)
    return None
