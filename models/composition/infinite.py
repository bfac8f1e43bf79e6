"""An unbounded scene: any block on demand, at bounded cost, independent of the blocks requested before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from models.composition.generator import SceneGenerator
from models.composition.outpaint import (
    BlockComposer,
    BlockGrid,
    BlockIndex,
    SceneBlock,
    find_ground_height,
    generate_blocks,
    rank_four_colors,
)
from models.sampling.repaint import RePaintConfig
from models.scene import Grid, Scene


class InfiniteScene:
    """Blocks of a model in four colours (outpaint.py); each depends on at most eight neighbours and on block (0, 0).

    Block (0, 0) sets the level of the ground. Generated blocks are kept in memory until `drop_block`.

    Args:
        model: A PrITTIPipeline.
        label: Class of all blocks, or a function of the block's index.
        seed: Seed of the scene.
        overlap: Fraction of a block that overlaps its neighbour, below 0.5.
        mode, repaint, guidance_scale: As for `PrITTIPipeline.outpaint`.

    Raises:
        ValueError: The model does not know the label, or the overlap is 0.5 or more.
    """

    def __init__(
        self,
        model: SceneGenerator,
        label: str | Callable[[BlockIndex], str],
        seed: int = 0,
        overlap: float = 0.25,
        mode: str = "reencode",
        repaint: RePaintConfig | None = None,
        guidance_scale: float = 1.0,
    ) -> None:
        self.model, self.label, self.seed = model, label, seed
        self.options: dict[str, Any] = {"mode": mode, "repaint": repaint, "guidance_scale": guidance_scale}
        block_grid = BlockGrid.from_overlap(model.latent_shape[-1], overlap, rank=rank_four_colors, num_blocks=None)
        self.composer = BlockComposer(block_grid, model.spec, model.encode)
        self.blocks: dict[BlockIndex, SceneBlock] = {}
        model.label_tensor([self.label_of((0, 0))])

    def label_of(self, index: BlockIndex) -> str:
        """Class of a block."""
        return self.label if isinstance(self.label, str) else self.label(index)

    def get_block(self, index: BlockIndex) -> SceneBlock:
        """The block at (steps ahead, steps left); it and its predecessors are generated if they are missing."""
        if index not in self.blocks:
            known = {other: self.get_block(other) for other, _ in self.composer.block_grid.known_cells(index)}
            if known:
                self.composer.level_m = find_ground_height(self.get_block((0, 0)).scene, 0.0, 0.0)
            label = self.label_of(index)
            like = self.model.new_identity("city", self.seed, 0, label)
            # One block at a time: a batch would round differently, and the scene would depend on the requests.
            self.blocks |= generate_blocks(
                self.model, self.composer, [index], known, like, {index: label}, self.seed, **self.options
            )
        return self.blocks[index]

    def drop_block(self, index: BlockIndex) -> None:
        """Free the memory of a block; if requested again, the same block is regenerated."""
        self.blocks.pop(index, None)

    def get_scene(self, ahead_m: float, behind_m: float, left_m: float, right_m: float) -> Scene:
        """One Scene of the rectangle from `behind_m` behind the origin to `ahead_m` ahead, `right_m` to `left_m`.

        The rectangle grows to whole pixels.

        Raises:
            ValueError: The rectangle is empty.
        """
        if not (ahead_m > -behind_m and left_m > -right_m):
            raise ValueError(
                f"an empty rectangle: {ahead_m} m ahead, {behind_m} behind, {left_m} left, {right_m} right"
            )
        resolution_m = self.model.spec.grid.resolution_m
        front, back, left, right = (-(-m // resolution_m) for m in (ahead_m, behind_m, left_m, right_m))
        grid = Grid(front * resolution_m, left * resolution_m, resolution_m, int(front + back), int(left + right))
        blocks = {index: self.get_block(index) for index in self.list_blocks(grid)}
        like = self.model.new_identity("city", self.seed, 0, self.label_of((0, 0)))
        return self.composer.stitch(blocks, replace(like, scene_id=f"{like.sequence}-{self.seed}"), grid)

    def list_blocks(self, grid: Grid) -> list[BlockIndex]:
        """Indices of all blocks that overlap a grid."""
        block, step_m = self.model.spec.grid, self.composer.step_m
        # Block i covers block.back_m + i step_m to block.front_m + i step_m.
        ahead = range(int((grid.back_m - block.front_m) // step_m), int((grid.front_m - block.back_m) // step_m) + 2)
        left = range(int((grid.right_m - block.left_m) // step_m), int((grid.left_m - block.right_m) // step_m) + 2)
        return [
            (i, j)
            for i in ahead
            for j in left
            if block.back_m + i * step_m < grid.front_m
            and block.front_m + i * step_m > grid.back_m
            and block.right_m + j * step_m < grid.left_m
            and block.left_m + j * step_m > grid.right_m
        ]
