"""Extend scenes by blocks with Ray. A block is generated as soon as all blocks on which it depends are done."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import pyarrow as pa
import ray
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from models.composition.block_grid import RANKS, BlockGrid, BlockIndex, choose_arrangement, label_blocks
from models.composition.outpaint import (
    BlockComposer,
    SceneBlock,
    Tile,
    check_roads,
    count_planned_cells,
    find_ground_height,
    generate_blocks,
    make_street_plan,
    uses_street_plan,
)
from models.composition.road_sketch import RoadMap, SketchedRoad
from models.composition.street_plan import StreetPlan
from models.execution import SamplingExecution
from models.pipeline import PrITTIPipeline
from models.sampling.repaint import InpaintingConfig
from models.scene import UNSET, Scene
from models.tensors import make_empty_scene
from pipelines.generation.sample import (
    Request,
    find_scene_label,
    guard_generation_run,
    load_pipeline,
    resample_to_model_grid,
)
from pipelines.generation.street_plans import (
    Part,
    Section,
    SectionTask,
    draw_plan,
    list_sections,
    make_section_path,
    read_section,
    write_section,
)
from pipelines.io.mesh_export import export_glb
from pipelines.io.tileset import TileContent, find_tile_bounds, make_tileset
from pipelines.reporting.city_page import pack_overview, pack_tile, render_city_html
from pipelines.runtime import storage
from pipelines.runtime.resources import make_model_resources, require_room
from pipelines.schema.ground_surface import to_model_surface
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import Shard, find_unwritten, require_written

ARRAYS = ("category", "center_m", "rotation", "size_m", "existence", "height_m", "occupied")
MAX_RETRIES = 3  # Number of retries for a block whose process died.


@dataclass(frozen=True)
class OutpaintRequest(Request):
    """Options of outpainting.

    Attributes:
        label: Label of the generated blocks. None: the label of each scene is used.
        labels_map: Label of each block in rows, instead of `label` (`label_blocks`). The input scene does not change.
        free_blocks: Blocks that count as crops at any place and heading (`label_blocks`).
        tile_m: Side (m) of the tiles in which a scene is written. No step holds a whole scene in memory. None: each
            scene is written as a whole.
        roads: Sketched roads in the frame of each scene, which its blocks contain.
        margin: Width of the margin of blocks as a fraction of a block (`BlockGrid`). None: see `choose_arrangement`.
        plan_streets: Whether streets are planned before blocks. None: see `uses_street_plan`.
        seed: Seed of the noise.
        overlap: Overlap of neighbouring blocks as a fraction of a block.
        mode: Outpainting mode of `generate_blocks`. None: the mode that the pipeline stores.
        repaint: How known parts are continued.
        guidance_scale: Scale of classifier-free guidance.
        num_blocks: Four numbers of blocks to generate: ahead, behind, to the left, to the right.
        order: Order in which blocks are generated (a key of RANKS).
        batch_size: Maximum number of blocks per batch.
        execution: How the model runs.
        constraints: Whether constraints guide sampling. None: the value that the model stores.
    """

    label: str | None
    seed: int
    overlap: float
    mode: str | None
    repaint: InpaintingConfig
    guidance_scale: float
    num_blocks: tuple[int, int, int, int] = (1, 1, 1, 1)
    order: str = "outward"
    batch_size: int = 4
    execution: SamplingExecution = field(default_factory=SamplingExecution)
    constraints: bool | None = None
    labels_map: tuple[tuple[str, ...], ...] | None = None
    free_blocks: str = "none"
    tile_m: float | None = None
    roads: tuple[SketchedRoad | RoadMap, ...] = ()
    margin: float | None = None
    plan_streets: bool | None = None

    def scene_id(self, number: int) -> str:
        """Return the id of an extended scene.

        Args:
            number: Number of the scene in the run.

        Returns:
            Scene id.
        """
        return f"{self.source}-{self.seed}-{number:07d}"

    def blocks_directory(self, number: int) -> str:
        """Return the directory of the blocks of a scene. After the blocks are stitched, the directory is deleted.

        Args:
            number: Number of the scene in the run.

        Returns:
            Path of the directory.
        """
        return storage.join_uri(self.output, "blocks", self.run, f"{number:07d}")

    def make_block_grid(self, size: int) -> BlockGrid:
        """Return the block grid.

        Args:
            size: Side length of a block (latent cells).

        Returns:
            Block grid.

        Raises:
            ValueError: The overlap is not a whole number of cells.
        """
        return BlockGrid.from_overlap(
            size, self.overlap, self.margin or 0.0, rank=RANKS[self.order], num_blocks=self.num_blocks
        )


@dataclass(frozen=True)
class BlockBatch:
    """Blocks of a scene that are generated in one batch.

    Attributes:
        number: Number of the scene in the run.
        indices: Indices of the blocks.
        needs: Blocks that the batch depends on, and sections of the street plan.
    """

    number: int
    indices: tuple[BlockIndex, ...]
    needs: frozenset[Part]


@dataclass(frozen=True)
class TileTask:
    """A tile of a scene to write.

    Attributes:
        number: Number of the scene in the run.
        tile: Number of the tile in the list of `BlockComposer.cut_tiles`.
        needs: Indices of the blocks that cover the tile, without the input block.
    """

    number: int
    tile: int
    needs: frozenset[Part]


def list_batches(
    block_grid: BlockGrid,
    number: int,
    batch_size: int,
    sections: Mapping[BlockIndex, Sequence[Section]] | None = None,
) -> list[BlockBatch]:
    """List the batches of a scene in an order that respects dependencies; the input block is not included.

    The batches depend only on the arguments. A resumed run therefore has the same batches.

    Args:
        block_grid: Block grid.
        number: Number of the scene in the run.
        batch_size: Maximum number of blocks per batch.
        sections: Sections of the street plan that each block needs; None: there is no plan.

    Returns:
        Batches.
    """
    listed = []
    for group in block_grid.group_by_rank(index for index in block_grid.indices() if index != (0, 0)):
        for start in range(0, len(group), batch_size):
            indices = tuple(group[start : start + batch_size])
            needs = frozenset(other for index in indices for other, _ in block_grid.known_cells(index)) - {(0, 0)}
            streets = frozenset(section for index in indices for section in (sections or {}).get(index, ()))
            listed.append(BlockBatch(number, indices, needs | streets))
    return listed


# ------------------------------------------------------------------------------------------------------------ blocks


def make_block_path(directory: str, index: BlockIndex) -> str:
    """Return the path of the file of a block.

    Args:
        directory: Directory of the blocks of the scene.
        index: Index of the block.

    Returns:
        Path of a .safetensors file.
    """
    return storage.join_uri(directory, f"{index[0]:+05d}{index[1]:+05d}.safetensors")


def write_block(block: SceneBlock, path: str) -> None:
    """Write a block at full precision, because the tables round values. A resumed run then gives exactly the same
    scene.

    Args:
        block: Block.
        path: Path of the .safetensors file.
    """
    arrays = {name: torch.from_numpy(getattr(block.scene, name).copy()) for name in ARRAYS}
    arrays |= {"latent": block.latent.cpu().contiguous()}
    arrays |= {"of_block": torch.tensor([block.datum_m, block.known_ground], dtype=torch.float64)}
    data = save(arrays)
    storage.write_whole(path, lambda stream: stream.write(data))


def read_block(path: str, empty: Scene) -> SceneBlock:
    """Read a block.

    Args:
        path: Path of the .safetensors file.
        empty: Empty scene that provides the grid and the ids.

    Returns:
        Block.

    Raises:
        ValueError: The file is damaged. The message names the file.
    """
    try:
        arrays = load(storage.read_bytes(path))
    except SafetensorError as error:
        raise ValueError(f"{path}: not a complete block ({error}); delete the file and run the job again") from error
    latent, (datum_m, known_ground) = arrays.pop("latent"), arrays.pop("of_block").tolist()
    scene = replace(
        empty,
        heading_rad=UNSET,
        instance_id=UNSET,
        label=UNSET,
        **{name: value.numpy() for name, value in arrays.items()},
    )
    return SceneBlock(scene, latent, datum_m, known_ground)


class Outpainter:
    """Actor that holds a pipeline, generates blocks and stitches the blocks of a scene."""

    def __init__(self, request: OutpaintRequest, chosen: list[tuple[Shard, int]]) -> None:
        self.request, self.chosen = request, chosen
        self.pipeline = load_pipeline(request.model)
        self.pipeline.use_constraints(request.constraints)
        self.pipeline.set_execution(request.execution)
        self.plans: dict[int, StreetPlan] = {}  # Street plan of the last scene.

    @cached_property
    def block_grid(self) -> BlockGrid:
        """Return the block grid for the latent size of the model."""
        return self.request.make_block_grid(self.pipeline.latent_shape[-1])

    def load_plan(self, number: int, sections: Iterable[Section]) -> StreetPlan:
        """Return the street plan of a scene.

        Args:
            number: Number of the scene in the run.
            sections: Sections that have been generated and are needed.

        Returns:
            The plan with these sections.
        """
        if number not in self.plans:
            self.plans = {number: make_plan(self.pipeline, self.request, self.load_scene(number), number)}
        plan = self.plans[number]
        for section in sections:
            index = (section.ahead, section.left)
            if index not in plan.sections:
                path = make_section_path(self.request.blocks_directory(number), section)
                plan.put_section(index, read_section(path))
        return plan

    def generate_section(self, task: SectionTask) -> None:
        """Generate a section of a street plan and write it to a file.

        Args:
            task: Section to generate.
        """
        plan = self.load_plan(task.number, (one for one in task.needs if isinstance(one, Section)))
        distance_m = plan.get_section((task.section.ahead, task.section.left))
        path = make_section_path(self.request.blocks_directory(task.number), task.section)
        write_section(distance_m, path)

    def load_scene(self, number: int) -> Scene:
        """Return an input scene, resampled to the grid of the model.

        Args:
            number: Number of the scene in the run.

        Returns:
            Scene.
        """
        shard, row = self.chosen[number]
        return resample_to_model_grid(to_model_surface(shard.scenes([row])[0], self.pipeline.spec), self.pipeline.spec)

    def load_blocks(
        self, number: int, indices: Sequence[BlockIndex]
    ) -> tuple[BlockComposer, Scene, dict[BlockIndex, SceneBlock]]:
        """Load an input scene and some of its generated blocks.

        Args:
            number: Number of the scene in the run.
            indices: Indices of generated blocks.

        Returns:
            Composer, input scene, and blocks by index. Block (0, 0) is the input scene.
        """
        given = self.load_scene(number)
        empty = make_empty_scene(given.scene_id, given.source, given.sequence, given.frame, self.pipeline.spec)
        directory = self.request.blocks_directory(number)
        blocks = {index: read_block(make_block_path(directory, index), empty) for index in indices}
        blocks[(0, 0)] = SceneBlock(given, self.pipeline.encode([given])[0])
        composer = BlockComposer(
            self.block_grid,
            self.pipeline.spec,
            self.pipeline.encode,
            find_ground_height(given, 0.0, 0.0),
            self.request.roads,
        )
        return composer, given, blocks

    def generate(self, batch: BlockBatch) -> None:
        """Generate the blocks of a batch and write each block to a file.

        Args:
            batch: Blocks to generate.
        """
        request = self.request
        parts = sorted(part for part in batch.needs if isinstance(part, tuple))
        composer, given, known = self.load_blocks(batch.number, parts)
        if request.plan_streets:
            sections = (part for part in batch.needs if isinstance(part, Section))
            composer.roads = [*request.roads, self.load_plan(batch.number, sections)]
        kind = self.pipeline.dit.config.label
        label = request.labels_map or request.label or find_scene_label(given, kind)
        blocks = generate_blocks(
            self.pipeline,
            composer,
            batch.indices,
            known,
            given,
            label_blocks(kind, label, request.num_blocks, request.free_blocks),
            request.seed,
            batch.number,
            request.mode or self.pipeline.config.neighbour_latents,
            request.repaint,
            request.guidance_scale,
        )
        for index, block in blocks.items():
            write_block(block, make_block_path(request.blocks_directory(batch.number), index))

    def write_tile(self, task: TileTask) -> None:
        """Stitch the blocks of a tile; write its tables and its GLB.

        Args:
            task: Tile to write. Without tiles, it covers the scene.
        """
        request = self.request
        parts = sorted(part for part in task.needs if isinstance(part, tuple))
        composer, given, blocks = self.load_blocks(task.number, parts)
        tiles = composer.cut_tiles(request.tile_m)
        tile, name = tiles[task.tile], request.scene_id(task.number)
        scene = composer.stitch(blocks, given, tile.grid)
        path = f"{name}.glb"
        if request.tile_m is not None:
            part = make_tile_name(tile)
            bounds = find_tile_bounds(scene)  # In the frame of the input scene.
            storage.write_json(bounds, storage.join_uri(request.output, "glb", request.run, name, f"{part}.json"))
            page = make_page_path(request, task.number, "tiles", f"{part}.js")
            storage.write_text(pack_tile(part, scene), page)
            far = make_page_path(request, task.number, "tiles", f"{part}-far.js")
            storage.write_text(pack_overview(part, scene), far)
            scene, name, path = tile.to_own_frame(scene), f"{name}-{part}", f"{name}/{part}.glb"
        scene = replace(scene, scene_id=name, source=request.source, split="generated", frame=task.number)
        path = storage.join_uri(request.output, "glb", request.run, path)
        storage.write_whole(path, lambda stream: stream.write(export_glb(scene)))
        request.shard(task.number * len(tiles) + task.tile).write([scene])

    def finish(self, number: int) -> None:
        """Write the table of blocks of a scene, the picture of its street plan if it has one, and its tileset if it has
        tiles; delete the block files.

        Args:
            number: Number of the scene in the run.
        """
        request, name, rows = self.request, self.request.scene_id(number), []
        composer, given, blocks = self.load_blocks(number, [])
        directory = request.blocks_directory(number)
        for index in sorted(self.block_grid.indices()):  # One block at a time, because a city may have thousands.
            block = blocks[index] if index in blocks else read_block(make_block_path(directory, index), given)
            about = {"datum_m": block.datum_m, "known_ground": block.known_ground}
            rows.append({"scene_id": name, "ahead": index[0], "left": index[1], **about})
        if request.tile_m is not None:
            tiles, grids, place = [], {}, storage.join_uri(request.output, "glb", request.run, name)
            for tile in composer.cut_tiles(request.tile_m):
                part = make_tile_name(tile)
                grids[part] = tile.grid
                low_m, high_m = storage.read_json(storage.join_uri(place, f"{part}.json"))
                tiles.append(TileContent(part, low_m, high_m, tile.origin_m))
            storage.write_json(make_tileset(tiles), storage.join_uri(place, "tileset.json"))
            storage.write_text(render_city_html(name, grids), make_page_path(request, number, "index.html"))
        if request.plan_streets:
            plan = self.load_plan(number, ())
            whole = composer.find_grid(self.block_grid.indices())
            plan = self.load_plan(number, (Section(*index) for index in plan.list_sections(whole)))
            picture = draw_plan(plan, whole, given.grid)
            storage.write_whole(make_plan_path(request, number), lambda stream: stream.write(picture))
        storage.write_parquet(pa.Table.from_pylist(rows), make_blocks_table_path(request, number))
        storage.delete_directory(request.blocks_directory(number))


def make_tile_name(tile: Tile) -> str:
    """Return the name of a tile within its scene, such as 003-012: row, then column.

    Args:
        tile: Tile.

    Returns:
        Name.
    """
    return f"{tile.row:03d}-{tile.col:03d}"


def make_page_path(request: OutpaintRequest, number: int, *parts: str) -> str:
    """Return the path of a file of the page of a scene in tiles.

    Args:
        request: Options of outpainting.
        number: Number of the scene in the run.
        *parts: Parts of the path below the directory of the page.

    Returns:
        Path of the file.
    """
    return storage.join_uri(request.output, "pages", request.run, request.scene_id(number), *parts)


def make_blocks_table_path(request: OutpaintRequest, number: int) -> str:
    """Return the path of the table that lists the blocks of a scene.

    Args:
        request: Options of outpainting.
        number: Number of the scene in the run.

    Returns:
        Path of a Parquet file.
    """
    return storage.join_uri(request.output, "block_tables", request.run, f"{number:07d}.parquet")


def make_plan(pipeline: PrITTIPipeline, request: OutpaintRequest, given: Scene, number: int) -> StreetPlan:
    """Return the street plan of a scene, without generated sections.

    Args:
        pipeline: Pipeline with a street planner.
        request: Options of outpainting.
        given: Scene on the grid of the model.
        number: Number of the scene in the run.

    Returns:
        The plan.
    """
    kind, block_grid = pipeline.dit.config.label, request.make_block_grid(pipeline.latent_shape[-1])
    label = request.labels_map or request.label or find_scene_label(given, kind)
    labels = label_blocks(kind, label, request.num_blocks, request.free_blocks)
    step_m = BlockComposer(block_grid, pipeline.spec, pipeline.encode).step_m
    return make_street_plan(pipeline, given, request.roads, labels, step_m, request.seed, number)


def make_plan_path(request: OutpaintRequest, number: int) -> str:
    """Return the path of the picture of the street plan of a scene.

    Args:
        request: Options of outpainting.
        number: Number of the scene in the run.

    Returns:
        Path of a PNG file.
    """
    return storage.join_uri(request.output, "street_plans", request.run, f"{request.scene_id(number)}.png")


# --------------------------------------------------------------------------------------------------------------- run


def outpaint_scenes(
    request: OutpaintRequest,
    selection: SceneSubset,
    num_actors: int = 1,
    on_blocks: Callable[[int], None] | None = None,
) -> list[str]:
    """Extend the selected scenes; resume an interrupted run.

    Args:
        request: Options of outpainting.
        selection: Scenes to extend.
        num_actors: Number of pipelines that run concurrently.
        on_blocks: Called with the number of blocks that finished since the previous call.

    Returns:
        Path of the table of blocks of each scene (`make_blocks_table_path`), in order.

    Raises:
        ValueError: The output contains a run of the same name with other options, the side of the tiles is invalid, or
            the model cannot plan streets or follow roads.
    """
    chosen = [(shard, row) for shard, rows in selection.shards() for row in rows]
    pipeline = load_pipeline(request.model)
    mode, is_far = str(request.mode or pipeline.config.neighbour_latents), max(request.num_blocks) > 1
    plans_streets = uses_street_plan(pipeline, request.roads, mode, is_far, request.plan_streets)
    planned_cells = count_planned_cells(pipeline, request.roads, plans_streets)
    chosen_options = request.order, request.overlap, request.free_blocks, request.margin
    request = replace(
        request,
        mode=mode,
        plan_streets=plans_streets,
        margin=choose_arrangement(request.num_blocks, *chosen_options, planned_cells).margin,
        repaint=pipeline.resolve_inpainting(request.repaint, planned_cells > 0),
        constraints=pipeline.resolve_constraints(request.constraints),
    )
    block_grid = request.make_block_grid(pipeline.latent_shape[-1])
    parts = [storage.join_uri(request.output, "blocks", request.run)]
    guard_generation_run(request, pipeline, parts, input=selection.to_record(), scenes=selection.files())

    for shard, row in chosen if request.roads else []:
        scene = resample_to_model_grid(shard.scenes([row])[0], pipeline.spec)
        check_roads(request.roads, scene, mode, pipeline.has_split_latent)
    composer = BlockComposer(block_grid, pipeline.spec, pipeline.encode)
    tiles = composer.cut_tiles(request.tile_m)
    promised = {request.shard(number): 1 for number in range(len(chosen) * len(tiles))}
    files = set(storage.list_files(parts[0], ".safetensors"))
    unwritten = {shard.number for shard in find_unwritten(promised)}
    waiting, missing, done = [], [], {}
    sections: list[SectionTask] = []
    for number in range(len(chosen)):
        left = [k for k in range(len(tiles)) if number * len(tiles) + k in unwritten]
        if not left and storage.exists(make_blocks_table_path(request, number)):
            continue
        missing += [TileTask(number, k, frozenset(tiles[k].blocks) - {(0, 0)}) for k in left]
        directory = request.blocks_directory(number)
        there = {index for index in block_grid.indices() if make_block_path(directory, index) in files}
        done[number] = set(there)
        streets: dict[BlockIndex, list[Section]] = {}
        if request.plan_streets:
            shard, row = chosen[number]
            given = to_model_surface(shard.scenes([row])[0], pipeline.spec)
            given = resample_to_model_grid(given, pipeline.spec)
            plan = make_plan(pipeline, request, given, number)
            grids = {index: composer.find_grid([index]) for index in block_grid.indices() if index != (0, 0)}
            streets = {index: [Section(*k) for k in plan.list_sections(grid)] for index, grid in grids.items()}
            whole = plan.list_sections(composer.find_grid(block_grid.indices()))
            needed = list_sections(plan, {Section(*index) for index in whole}, number)
            written = {task.section for task in needed if make_section_path(directory, task.section) in files}
            done[number] |= written
            sections += [task for task in needed if task.section not in written]
        batches = list_batches(block_grid, number, request.batch_size, streets)
        waiting += [batch for batch in batches if not there.issuperset(batch.indices)]
    if on_blocks:
        per_scene = len(block_grid.indices()) - 1
        on_blocks(per_scene * len(chosen) - sum(len(batch.indices) for batch in waiting))
    if request.tile_m is not None:  # Complete row after row of tiles.
        waiting.sort(key=lambda batch: (batch.number, batch.indices[0][0] // 2, block_grid.rank(batch.indices[0])))
    if done:
        run_batches(request, chosen, waiting, sections, missing, done, num_actors, on_blocks)
    require_written(promised)
    return [make_blocks_table_path(request, number) for number in range(len(chosen))]


def run_batches(
    request: OutpaintRequest,
    chosen: list[tuple[Shard, int]],
    waiting: list[BlockBatch],
    sections: list[SectionTask],
    tiles: list[TileTask],
    done: dict[int, set[Part]],
    num_actors: int,
    on_blocks: Callable[[int], None] | None,
) -> None:
    """Start actors; assign each batch to an actor as soon as the blocks on which it depends are done.

    Args:
        request: Options of outpainting.
        chosen: Shard and row of each selected scene.
        waiting: Batches to generate.
        sections: Sections of street plans to generate.
        tiles: Tiles to write.
        done: Finished blocks and sections by scene number.
        num_actors: Maximum number of actors.
        on_blocks: Called with the number of blocks of each finished batch.
    """
    need = make_model_resources()
    actor = ray.remote(Outpainter).options(
        num_cpus=need["CPU"], num_gpus=need.get("GPU", 0), max_restarts=-1, max_task_retries=MAX_RETRIES
    )
    # A waiting actor would take the CPU or GPU of a killed actor, and the killed actor could not restart.
    count = min(num_actors, max(len(waiting), len(done)), require_room(need, 1, "an actor (Outpainter)"))
    workers: list[Any] = [actor.remote(request, chosen) for _ in range(count)]
    try:
        schedule_batches(workers, waiting, sections, tiles, done, on_blocks)
    finally:  # The traceback of an error references the actors. Without ray.kill, the actors would keep their CPUs.
        for worker in workers:
            ray.kill(worker)


def schedule_batches(
    workers: list,
    waiting: list[BlockBatch],
    sections: list[SectionTask],
    tiles: list[TileTask],
    done: dict[int, set[Part]],
    on_blocks: Callable[[int], None] | None,
) -> None:
    """Give each idle actor a batch, a tile to write or a scene to finish, until all work is done.

    Actors may become ready at different times, because other work may occupy their CPUs. Each actor gets work as soon
    as it is ready.

    Args:
        workers: Actor handles.
        waiting: Batches to generate; the function empties the list.
        sections: Sections of street plans to generate; the function empties the list.
        tiles: Tiles to write; the function empties the list.
        done: Finished blocks and sections by scene number; the function adds the new ones.
        on_blocks: Called with the number of blocks of each finished batch.
    """
    idle: list = []
    running: dict[ray.ObjectRef, tuple] = {worker.__ray_ready__.remote(): (None, worker) for worker in workers}
    left = dict.fromkeys(done, 0) | Counter(task.number for task in (*waiting, *sections, *tiles))
    whole = [number for number, tasks_left in left.items() if not tasks_left]
    while waiting or sections or tiles or whole or any(task is not None for task, _ in running.values()):
        while idle and (task := pop_ready_task(waiting, sections, tiles, whole, done)) is not None:
            worker = idle.pop()
            calls = {
                BlockBatch: worker.generate,
                SectionTask: worker.generate_section,
                TileTask: worker.write_tile,
                int: worker.finish,
            }
            call = calls[type(task)]
            running[call.remote(task)] = task, worker
        (finished,), _ = ray.wait(list(running), num_returns=1)
        task, worker = running.pop(finished)
        ray.get(finished)
        idle.append(worker)
        if isinstance(task, BlockBatch):
            done[task.number].update(task.indices)
            if on_blocks:
                on_blocks(len(task.indices))
        if isinstance(task, SectionTask):
            done[task.number].add(task.section)
        if isinstance(task, (BlockBatch, SectionTask, TileTask)):
            left[task.number] -= 1
            if not left[task.number]:
                whole.append(task.number)


def pop_ready_task(
    waiting: list[BlockBatch],
    sections: list[SectionTask],
    tiles: list[TileTask],
    whole: list[int],
    done: Mapping[int, set[Part]],
) -> BlockBatch | SectionTask | TileTask | int | None:
    """Remove and return the first task whose dependencies are done.

    Args:
        waiting: Batches to generate. Batches whose sections are done are generated before further sections.
        sections: Sections of street plans to generate.
        tiles: Tiles to write. Tiles whose blocks are done are written before further blocks are generated.
        whole: Numbers of the scenes in which all tiles are written.
        done: Finished blocks and sections by scene number.

    Returns:
        A batch, a section, a tile, or the number of a scene to finish. None: no task is ready.
    """
    if whole:
        return whole.pop(0)
    for tasks in (tiles, waiting, sections):
        for position, task in enumerate(tasks):
            if task.needs <= done[task.number]:
                return tasks.pop(position)
    return None
