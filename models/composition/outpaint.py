"""A growing world: blocks on a lattice, what a new one knows of earlier ones, and all of them put together.

The paper's outpainting (supplement B.3) is three blocks by three, the given one in the middle. Any rectangle is the same
with more blocks, and so is a world without end: only the order differs in which neighbours are made.

Block (i, j) lies i steps ahead and j steps left of block (0, 0); a step is (1 - overlap) of a block. Every block has a
rank that follows from (i, j) alone. Where blocks overlap, the lowest rank owns; equal ranks never meet in what they own.
A block is made knowing what lower ranks own of it. So the world does not depend on when, where or in which order its
blocks are made.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby, product

import numpy as np
import torch
from torch import Tensor

from models.composition.seam_blending import new_part, spread
from models.layout import LayoutSpec
from models.scene import Grid, Scene, joined, merge

Place = tuple[int, int]  # (i, j) of a block: steps ahead, steps left
Encode = Callable[[Sequence[Scene]], Tensor]  # scenes on the model's grid -> latents (b, c, h, w)


def outward(place: Place) -> int:
    """Ranks from block (0, 0) outward: the paper's four sides, then its four corners, and so on."""
    return abs(place[0]) + abs(place[1])


def colour(place: Place) -> int:
    """Four ranks for a world without end: every second block both ways, those between two of them, the rest."""
    return place[0] % 2 + 2 * (place[1] % 2)


@dataclass(frozen=True)
class Lattice:
    """Blocks of `size` cells every `step` cells. `last` bounds the world: places (-behind..ahead, -right..left)."""

    size: int
    step: int
    rank: Callable[[Place], int] = outward
    last: tuple[int, int, int, int] | None = (1, 1, 1, 1)  # ahead, behind, left, right; None: no end

    @classmethod
    def of(cls, size: int, overlap: float, **options) -> Lattice:
        """Raises ValueError for an overlap between two cells, or one that leaves a world without end with holes or knots."""
        step = round(size * (1 - overlap))
        if not 0 < step < size or abs(step - size * (1 - overlap)) > 1e-6:
            raise ValueError(f"overlap {overlap} is not a whole number of the {size} latent cells between 0 and 1")
        lattice = cls(size, step, **options)
        if lattice.rank is colour and 2 * step <= size:
            raise ValueError(f"overlap {overlap}: four colours need less than 0.5, or equal ranks would meet")
        return lattice

    def holds(self, place: Place) -> bool:
        if self.last is None:
            return True
        ahead, behind, left, right = self.last
        return -behind <= place[0] <= ahead and -right <= place[1] <= left

    def places(self) -> list[Place]:
        """All places of a bounded world. Raises ValueError for one without end."""
        if self.last is None:
            raise ValueError("a world without end has no list of places")
        ahead, behind, left, right = self.last
        return list(product(range(-behind, ahead + 1), range(-right, left + 1)))

    def fronts(self, places: Iterable[Place]) -> list[list[Place]]:
        """Places by rank, lowest first: those of a front can be made at the same time."""
        ordered = sorted(places, key=lambda place: (self.rank(place), place))
        return [list(front) for _, front in groupby(ordered, key=self.rank)]

    def earlier(self, place: Place) -> list[Place]:
        """Overlapping places of lower rank, lowest first: what a block must know before it is made."""
        reach = range(-((self.size - 1) // self.step), (self.size - 1) // self.step + 1)
        near = [(place[0] + i, place[1] + j) for i in reach for j in reach]
        rank = self.rank(place)
        return sorted((p for p in near if self.holds(p) and self.rank(p) < rank), key=lambda p: (self.rank(p), p))

    def cells(self, place: Place, of: Place) -> tuple[slice, slice]:
        """Rows and columns of the block at `place` that the block at `of` covers."""
        rows, cols = (
            slice(max(0, shift), max(0, min(self.size, self.size + shift)))
            for shift in ((a - b) * self.step for a, b in zip(place, of, strict=True))
        )
        return rows, cols

    def owned(self, place: Place) -> np.ndarray:
        """(size, size) cells of a block that belong to it: those that no earlier block covers."""
        mine = np.ones((self.size, self.size), bool)
        for other in self.earlier(place):
            mine[self.cells(place, other)] = False
        return mine

    def known(self, place: Place) -> list[tuple[Place, np.ndarray]]:
        """Earlier places with the cells (size, size) of this block that each owns; those that own none left out."""
        parts = []
        for other in self.earlier(place):
            here = np.zeros((self.size, self.size), bool)
            here[self.cells(place, other)] = self.owned(other)[self.cells(other, place)]
            if here.any():
                parts.append((other, here))
        return parts


@dataclass(frozen=True, eq=False)
class Block:
    """A block that is made: what it owns as a Scene, and its latent (c, h, w), in its own frame, `datum_m` above the world's.

    `known_ground` is the share of what it knew beforehand that had any ground: the paper's outpainting fails where it is
    next to nothing. 1 where nothing was known.
    """

    scene: Scene
    latent: Tensor
    datum_m: float = 0.0
    known_ground: float = 1.0


@dataclass(frozen=True, eq=False)
class Task:
    """A block to be made: what is known of it as a Scene and as latent (c, h, w), mask 1 = make, and its datum."""

    known: Scene
    latent: Tensor
    unknown: Tensor
    datum_m: float

    @property
    def knows(self) -> bool:
        return not bool(self.unknown.all())

    @cached_property
    def new_pixels(self) -> np.ndarray:
        """(rows, cols) True where the block is made."""
        return self.known.grid.enlarged(self.unknown[0].cpu().numpy() > 0)


def height_near(scene: Scene, x_m: float, y_m: float) -> float:
    """Height of the fused surface at the occupied pixel nearest to a point; 0 if there is none."""
    height, ground_class = scene.surface()
    row, col = np.nonzero(ground_class >= 0)
    if len(row) == 0:
        return 0.0
    x, y = scene.grid.x_m()[row], scene.grid.y_m()[col]
    nearest = ((x - x_m) ** 2 + (y - y_m) ** 2).argmin()
    return float(height[row[nearest], col[nearest]])


class World:
    """Blocks of a model's scenes on a lattice; nothing is kept here but how they fit together."""

    def __init__(self, lattice: Lattice, spec: LayoutSpec, encode: Encode, level_m: float = 0.0) -> None:
        """`level_m`: height of the ground under the origin of a block's frame, as the model's training data have it."""
        self.lattice, self.spec, self.encode, self.level_m = lattice, spec, encode, level_m

    @property
    def step_px(self) -> int:
        return self.lattice.step * (self.spec.grid.rows // self.lattice.size)

    @property
    def step_m(self) -> float:
        return self.step_px * self.spec.grid.resolution_m

    def seen_from(self, place: Place, other: Place, block: Block) -> Scene:
        """The part of a block's Scene inside another block's grid, in that one's frame and the world's heights."""
        x, y = ((a - b) * self.step_m for a, b in zip(other, place, strict=True))
        return block.scene.moved(x, y, block.datum_m).cropped(self.spec.grid)

    def task(self, place: Place, made: Mapping[Place, Block], empty: Scene, mode: str) -> Task:
        """What is known of a block. `copy` takes the neighbours' latents as they are (the paper); `reencode` what they
        decode to, moved into the block's frame and down to its datum, encoded anew: object latents hold absolute centres.

        Raises KeyError if an earlier block that it must know is not among those made.
        """
        parts = [(other, made[other], cells) for other, cells in self.lattice.known(place)]
        grid = self.spec.grid
        scenes = [self.seen_from(place, other, block) for other, block, _ in parts]
        known = merge(scenes, [grid.enlarged(cells) for *_, cells in parts], empty) if parts else empty
        own = self.lattice.owned(place)
        unknown = torch.from_numpy(own)
        datum = height_near(known, 0.0, 0.0) - self.level_m if parts and mode == "reencode" else 0.0
        known = known.moved(0, 0, -datum)
        latent = self.encode([spread(known, grid.enlarged(own))])[0]
        if mode == "copy":
            latent = torch.zeros_like(latent)
            for other, block, cells in parts:
                there, here = self.lattice.cells(other, place), self.lattice.cells(place, other)
                mine = torch.from_numpy(cells[here]).to(latent.device)
                latent[:, *here] = torch.where(mine, block.latent[:, *there].to(latent), latent[:, *here])
        return Task(known, latent, unknown.to(latent).expand_as(latent), datum)

    def block(self, task: Task, latent: Tensor, made: Scene) -> Block:
        """A block from what its task's latent became: the new part, without objects that are known already."""
        own = new_part(made, task.known, task.new_pixels)
        seen = task.known.occupied.any(axis=0)[~task.new_pixels]
        return Block(own, latent, task.datum_m, float(seen.mean()) if task.knows else 1.0)

    def stitched(self, made: Mapping[Place, Block], like: Scene, grid: Grid | None = None) -> Scene:
        """All blocks as one Scene, each with what it owns; ids and labels from `like`. Default grid: all of them.

        Grids count from block (0, 0), in whole pixels.
        """
        small = self.spec.grid
        if grid is None:
            ahead, left = (max(place[k] for place in made) for k in (0, 1))
            behind, right = (-min(place[k] for place in made) for k in (0, 1))
            grid = replace(
                small,
                front_m=small.front_m + ahead * self.step_m,
                left_m=small.left_m + left * self.step_m,
                rows=small.rows + (ahead + behind) * self.step_px,
                cols=small.cols + (left + right) * self.step_px,
            )
        shape = (len(self.spec.ground_classes), grid.rows, grid.cols)
        height, occupied, objects = np.zeros(shape, np.float32), np.zeros(shape, bool), []
        for place, block in sorted(made.items()):
            x, y = (steps * self.step_m for steps in place)
            mine = small.enlarged(self.lattice.owned(place))
            part = block.scene.moved(x, y, block.datum_m)
            here, there = grid.shared(part.grid)
            for whole, piece in ((height, part.height_m), (occupied, part.occupied)):
                np.copyto(whole[:, *here], piece[:, *there], where=mine[there])
            objects.append(part.select(grid.contains(part.center_m[:, 0], part.center_m[:, 1])))
        classes = self.spec.ground_classes
        return replace(like, grid=grid, height_m=height, occupied=occupied, ground_classes=classes, **joined(objects))
