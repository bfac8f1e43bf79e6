"""An unbounded scene that generates any block on demand, independently of earlier requests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from models.composition.block_grid import BlockGrid, BlockIndex, choose_arrangement, find_free_blocks, find_rank
from models.composition.generator import SceneGenerator
from models.composition.outpaint import (
    BlockComposer,
    SceneBlock,
    check_roads,
    count_planned_cells,
    find_ground_height,
    generate_blocks,
    make_street_plan,
    uses_street_plan,
)
from models.composition.road_sketch import Streets
from models.labels import mark_free
from models.sampling.repaint import InpaintingConfig
from models.scene import Grid, Scene


class InfiniteScene:
    """An unbounded scene of blocks.

    Block (0, 0) sets the ground height. With the default order and without a street plan, the cost of a block is
    bounded. A distant section of a street plan needs all sections between it and the first one. Generated blocks are
    kept in memory until `drop_block` is called.

    Args:
        model: A PrITTIPipeline.
        label: One label for all blocks, or a function that returns the label for a block index.
        free_blocks: Blocks that count as crops at any place and heading, a key of FREE_BLOCKS; it has no effect on a
            function.
        seed: Seed of the scene.
        overlap: Fraction of a block that overlaps its neighbour; it must be below 0.5 with the order "colours".
        mode: "reencode", "copy" or "paper"; see `PrITTIPipeline.outpaint`.
        repaint: Options of inpainting; None: see `resolve_inpainting`.
        guidance_scale: Scale of classifier-free guidance; 1 switches guidance off.
        scene: Content of block (0, 0), on the model's grid. None: block (0, 0) is generated.
        scene_index: Index of the scene. With the same scene, seed, index, labels and options, each block equals that of
            `PrITTIPipeline.outpaint`, up to rounding. With "colours", blocks at the border of the latter are equal if
            its numbers of blocks are even.
        roads: Sketched roads, in the frame of block (0, 0); they need the mode "reencode" and latents with separate
            channels for ground and objects.
        order: Order of the blocks, a key of RANKS. With "colours", each block depends on at most eight neighbours and
            on block (0, 0). With "outward", it depends on all blocks of a rectangle with block (0, 0).
        margin: Width of the margin of blocks as a fraction of a block; None: see `block_grid.choose_arrangement`.
        plan_streets: Whether streets are planned before blocks; None: if the model can do this
            (`outpaint.uses_street_plan`).

    Raises:
        ValueError: The order, the label or `free_blocks` is unknown, the overlap is 0.5 or more with "colours", or the
            model cannot follow the roads.
    """

    def __init__(
        self,
        model: SceneGenerator,
        label: str | Callable[[BlockIndex], str],
        seed: int = 0,
        overlap: float = 0.25,
        mode: str = "reencode",
        repaint: InpaintingConfig | None = None,
        guidance_scale: float = 1.0,
        scene: Scene | None = None,
        scene_index: int = 0,
        roads: Sequence[Streets] = (),
        order: str = "colours",
        margin: float | None = None,
        plan_streets: bool | None = None,
        free_blocks: str = "all",
    ) -> None:
        self.model, self.label, self.seed, self.scene_index = model, label, seed, scene_index
        self.is_free = find_free_blocks(free_blocks)
        self.options: dict[str, Any] = {"mode": mode, "repaint": repaint, "guidance_scale": guidance_scale}
        self.plans_streets = uses_street_plan(model, roads, mode, True, plan_streets)
        size = model.latent_shape[-1]
        cells = count_planned_cells(model, roads, self.plans_streets)
        margin = choose_arrangement((2, 2, 2, 2), order, overlap, None, margin, cells).margin
        block_grid = BlockGrid.from_overlap(size, overlap, margin, rank=find_rank(order), num_blocks=None)
        self.composer = BlockComposer(block_grid, model.spec, model.encode, roads=roads)
        self.blocks: dict[BlockIndex, SceneBlock] = {}
        self.scene, self.roads = scene, roads
        self.plan: Streets | None = None
        model.label_tensor([self.label_of((0, 0))])
        given = scene or model.new_identity("city", seed, 0, self.label_of((0, 0)))
        check_roads(roads, given, mode, model.has_split_latent)

    def label_of(self, index: BlockIndex) -> str:
        """Return the label of a block.

        Args:
            index: Index of the block (steps ahead, steps to the left).

        Returns:
            The label.
        """
        if not isinstance(self.label, str):
            return self.label(index)
        return mark_free(self.model.label_kind, self.label) if self.is_free(index) else self.label

    def get_block(self, index: BlockIndex) -> SceneBlock:
        """Return a block. If the block does not exist, generate its missing predecessors and then the block.

        Args:
            index: Index of the block (steps ahead, steps to the left).

        Returns:
            The block.
        """
        waiting = [index]  # A loop, because with the order "outward", blocks may have thousands of predecessors.
        while waiting:
            needs = [other for other, _ in self.composer.block_grid.known_cells(waiting[-1])]
            missing = [other for other in ((0, 0), *needs) if other not in self.blocks] if needs else []
            if missing and waiting[-1] not in self.blocks:
                waiting += missing
                continue
            last = waiting.pop()
            if last not in self.blocks:
                self._generate_block(last, {other: self.blocks[other] for other in needs})
        return self.blocks[index]

    def _generate_block(self, index: BlockIndex, known: dict[BlockIndex, SceneBlock]) -> None:
        """Generate a block whose predecessors exist; block (0, 0) may be given."""
        if index == (0, 0) and self.scene is not None:
            self.blocks[index] = SceneBlock(self.scene, self.model.encode([self.scene])[0])
            return
        if known:
            first = self.blocks[0, 0].scene
            self.composer.level_m = find_ground_height(first, 0.0, 0.0)
            if self.plans_streets and self.plan is None:
                step_m = self.composer.step_m
                plan = make_street_plan(
                    self.model, first, self.roads, self.label_of, step_m, self.seed, self.scene_index
                )
                self.plan, self.composer.roads = plan, [*self.roads, plan]
        label = self.label_of(index)
        like = self.model.new_identity("city", self.seed, 0, label)
        # Generate one block at a time. Rounding differs between batch sizes. If blocks were generated in batches, the
        # content of a block would depend on the requests.
        self.blocks |= generate_blocks(
            self.model,
            self.composer,
            [index],
            known,
            like,
            {index: label},
            self.seed,
            self.scene_index,
            **self.options,
        )

    def drop_block(self, index: BlockIndex) -> None:
        """Free the memory of a block. A later request regenerates the same block.

        Args:
            index: Index of the block (steps ahead, steps to the left).
        """
        self.blocks.pop(index, None)

    def get_scene(self, ahead_m: float, behind_m: float, left_m: float, right_m: float) -> Scene:
        """Return one Scene that covers a rectangle around the origin.

        The rectangle is enlarged to whole pixels.

        Args:
            ahead_m: Extent ahead of the origin (metres).
            behind_m: Extent behind the origin (metres).
            left_m: Extent to the left (metres).
            right_m: Extent to the right (metres).

        Returns:
            The scene of this rectangle.

        Raises:
            ValueError: The rectangle is empty.
        """
        if not (ahead_m > -behind_m and left_m > -right_m):
            raise ValueError(
                f"the rectangle is empty: {ahead_m} m ahead, {behind_m} m behind, {left_m} m left, {right_m} m right"
            )
        resolution_m = self.model.spec.grid.resolution_m
        front, back, left, right = (-(-m // resolution_m) for m in (ahead_m, behind_m, left_m, right_m))
        grid = Grid(front * resolution_m, left * resolution_m, resolution_m, int(front + back), int(left + right))
        blocks = {index: self.get_block(index) for index in self.list_blocks(grid)}
        like = self.model.new_identity("city", self.seed, 0, self.label_of((0, 0)))
        return self.composer.stitch(blocks, replace(like, scene_id=f"{like.sequence}-{self.seed}"), grid)

    def list_blocks(self, grid: Grid) -> list[BlockIndex]:
        """List the blocks that overlap a grid.

        Args:
            grid: Grid in the frame of block (0, 0).

        Returns:
            Indices of the blocks.
        """
        block, step_m = self.model.spec.grid, self.composer.step_m
        # Along x, block i extends from block.back_m + i step_m to block.front_m + i step_m.
        ahead = range(int((grid.back_m - block.front_m) // step_m), int((grid.front_m - block.back_m) // step_m) + 2)
        left = range(int((grid.right_m - block.left_m) // step_m), int((grid.left_m - block.right_m) // step_m) + 2)
        return [(i, j) for i in ahead for j in left if self.composer.covers((i, j), grid)]
