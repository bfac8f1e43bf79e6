"""A city without end: any of its blocks on demand, in bounded work, the same whatever was asked for before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from models.composition.outpaint import Block, Lattice, Place, World, colour, height_near
from models.pipeline import PrITTIPipeline, Resampling
from models.scene import Grid, Scene


class City:
    """Blocks of a pipeline in four colours (outpaint.py): a block depends on nine others at most, eight around it and (0, 0).

    Block (0, 0) sets the level of the ground. What was made stays in memory; `forget` what is no longer needed.
    """

    def __init__(
        self,
        pipeline: PrITTIPipeline,
        label: str | Callable[[Place], str],
        seed: int = 0,
        overlap: float = 0.25,
        mode: str = "reencode",
        resampling: Resampling | None = None,
        guidance_scale: float = 1.0,
    ) -> None:
        """Raises ValueError for a label that the model does not know, or an overlap of a half or more."""
        self.pipeline, self.label, self.seed = pipeline, label, seed
        self.options = {"mode": mode, "resampling": resampling, "guidance_scale": guidance_scale}
        lattice = Lattice.of(pipeline.lvae.latent_shape[-1], overlap, rank=colour, last=None)
        self.world = World(lattice, pipeline.spec, pipeline.encode)
        self.made: dict[Place, Block] = {}
        pipeline.label_tensor([self.label_of((0, 0))])

    def label_of(self, place: Place) -> str:
        return self.label if isinstance(self.label, str) else self.label(place)

    def block(self, place: Place) -> Block:
        """The block at (steps ahead, steps left), with those it depends on if they are not made yet."""
        if place not in self.made:
            known = {other: self.block(other) for other, _ in self.world.lattice.known(place)}
            if known:
                self.world.level_m = height_near(self.block((0, 0)).scene, 0.0, 0.0)
            label = self.label_of(place)
            like = self.pipeline.identity("city", self.seed, 0, label)
            # One at a time: a batch would round differently, and the world would depend on what was asked for together.
            self.made |= self.pipeline.extend(
                self.world, [place], known, like, {place: label}, self.seed, **self.options
            )
        return self.made[place]

    def forget(self, place: Place) -> None:
        """Free a block; asked for again, it is made again, the same."""
        self.made.pop(place, None)

    def scene(self, ahead_m: float, behind_m: float, left_m: float, right_m: float) -> Scene:
        """The rectangle from `behind_m` behind the origin to `ahead_m` ahead, and `right_m` to `left_m`, as one Scene.

        Grows to whole pixels. Raises ValueError for an empty rectangle.
        """
        if not (ahead_m > -behind_m and left_m > -right_m):
            raise ValueError(
                f"an empty rectangle: {ahead_m} m ahead, {behind_m} behind, {left_m} left, {right_m} right"
            )
        resolution = self.pipeline.spec.grid.resolution_m
        front, back, left, right = (-(-m // resolution) for m in (ahead_m, behind_m, left_m, right_m))
        grid = Grid(front * resolution, left * resolution, resolution, int(front + back), int(left + right))
        made = {place: self.block(place) for place in self.places(grid)}
        like = self.pipeline.identity("city", self.seed, 0, self.label_of((0, 0)))
        return self.world.stitched(made, replace(like, scene_id=f"{like.sequence}-{self.seed}"), grid)

    def places(self, grid: Grid) -> list[Place]:
        """All blocks that reach into a grid."""
        small, step = self.pipeline.spec.grid, self.world.step_m
        # Block i covers small.back_m + i step to small.front_m + i step.
        ahead = range(int((grid.back_m - small.front_m) // step), int((grid.front_m - small.back_m) // step) + 2)
        left = range(int((grid.right_m - small.left_m) // step), int((grid.left_m - small.right_m) // step) + 2)
        return [
            (i, j)
            for i in ahead
            for j in left
            if small.back_m + i * step < grid.front_m
            and small.front_m + i * step > grid.back_m
            and small.right_m + j * step < grid.left_m
            and small.left_m + j * step > grid.right_m
        ]
