"""Grids of overlapping blocks: ranks, ownership of cells, arrangement and labels.

Block (i, j) lies i steps ahead of block (0, 0) and j steps to its left. A step is (1 - overlap) of a block. The rank of
a block depends only on (i, j). A cell that several blocks cover is owned by the block with the lowest rank. With a
margin, blocks do not own their outermost cells where they have neighbours: a block sees only one side of these cells.
Blocks of the same rank never own the same cell. The condition of a block consists of those of its cells that blocks of
lower rank own. The result therefore does not depend on the time, the machine or the order of generation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby, product
from typing import Any, NamedTuple

import numpy as np

from models.labels import mark_free, require_labels

BlockIndex = tuple[int, int]  # (i, j): i steps ahead of block (0, 0), j steps to the left.
# Blocks that count as crops at any place and heading: none, those off the street of block (0, 0), or all but (0, 0).
FREE_BLOCKS: dict[str, Callable[[BlockIndex], bool]] = {
    "none": lambda index: False,
    "off-street": lambda index: index[1] != 0,
    "all": lambda index: index != (0, 0),
}
PLAN_MARGIN = 0.0625  # Width of the margin of blocks that know all streets, as a fraction of a block.


def rank_outward(index: BlockIndex) -> int:
    """Return the distance |i| + |j| of a block from block (0, 0): sides come first, then corners, as in the paper.

    Args:
        index: Index of the block.

    Returns:
        Rank.
    """
    return abs(index[0]) + abs(index[1])


def rank_four_colors(index: BlockIndex) -> int:
    """Return one of four ranks for a block of an unbounded grid, depending on whether i and j are odd.

    Args:
        index: Index of the block.

    Returns:
        Rank from 0 to 3. Blocks of the same rank are at least two steps apart.
    """
    return index[0] % 2 + 2 * (index[1] % 2)


RANKS: dict[str, Callable[[BlockIndex], int]] = {"outward": rank_outward, "colours": rank_four_colors}


def find_rank(order: str) -> Callable[[BlockIndex], int]:
    """Return the function that ranks blocks.

    Args:
        order: Order of the blocks, a key of RANKS.

    Returns:
        Function from the index of a block to its rank.

    Raises:
        ValueError: The order is unknown.
    """
    if order not in RANKS:
        raise ValueError(f"order is {order!r}, expected one of: {', '.join(RANKS)}")
    return RANKS[order]


def find_free_blocks(name: str) -> Callable[[BlockIndex], bool]:
    """Return the function that tells which blocks count as crops at any place and heading.

    Args:
        name: Key of FREE_BLOCKS.

    Returns:
        Function from the index of a block to whether it counts as such a crop.

    Raises:
        ValueError: The name is unknown.
    """
    if name not in FREE_BLOCKS:
        raise ValueError(f"free_blocks is {name!r}, expected one of: {', '.join(FREE_BLOCKS)}")
    return FREE_BLOCKS[name]


class Arrangement(NamedTuple):
    """How blocks are arranged.

    Attributes:
        order: Order of the blocks, a key of RANKS.
        overlap: Overlap of neighbouring blocks as a fraction of a block.
        free_blocks: Blocks that count as crops at any place and heading, a key of FREE_BLOCKS.
        margin: Width of the margin of blocks as a fraction of a block (`BlockGrid`).
    """

    order: str
    overlap: float
    free_blocks: str
    margin: float = 0.0


def choose_arrangement(
    num_blocks: tuple[int, int, int, int],
    order: str | None = None,
    overlap: float | None = None,
    free_blocks: str | None = None,
    margin: float | None = None,
    planned_cells: int = 0,
) -> Arrangement:
    """Return how blocks are arranged.

    By default, one block on each side is arranged as in the paper: outward, with an overlap of 0.5, and as views of a
    vehicle. Over longer distances, the content would drift. There, the order is that of four colours, the overlap is
    0.25, and the blocks are crops at any place.

    Args:
        num_blocks: Number of blocks ahead of, behind, to the left of and to the right of block (0, 0).
        order: Order of the blocks, a key of RANKS; None: the default.
        overlap: Overlap of neighbouring blocks; None: 0.25 for colours and 0.5 for outward.
        free_blocks: Blocks that count as crops at any place and heading, a key of FREE_BLOCKS; None: the default.
        margin: Width of the margin of blocks as a fraction of a block; None: PLAN_MARGIN if all streets are
            known, else 0.
        planned_cells: Number of latent cells per side of a block if all streets are known, else 0. Blocks see only one
            side of streets along their border, so a margin of whole cells leaves these to the neighbours.

    Returns:
        The arrangement.

    Raises:
        ValueError: The order is unknown.
    """
    is_far = max(num_blocks) > 1
    order = order or ("colours" if is_far else "outward")
    find_rank(order)
    if overlap is None:
        overlap = 0.25 if order == "colours" else 0.5
    if margin is None:
        margin = int(planned_cells * PLAN_MARGIN) / max(planned_cells, 1) if overlap > 2 * PLAN_MARGIN else 0.0
    return Arrangement(order, overlap, free_blocks or ("all" if is_far else "none"), margin)


@dataclass(frozen=True)
class BlockGrid:
    """Blocks of `size` cells, placed every `step` cells.

    Attributes:
        size: Side of a block in latent cells.
        step: Distance between neighbouring blocks in cells.
        rank: Function that returns the rank of a block; lower ranks are generated first.
        num_blocks: Number of blocks ahead of, behind, to the left of and to the right of block (0, 0). None: unbounded.
        margin: Number of outermost cells that a block does not own on sides with a neighbour. Block (0, 0), whose
            content may be given, owns all of its cells.
    """

    size: int
    step: int
    rank: Callable[[BlockIndex], int] = rank_outward
    num_blocks: tuple[int, int, int, int] | None = (1, 1, 1, 1)
    margin: int = 0

    @classmethod
    def from_overlap(cls, size: int, overlap: float, margin: float = 0.0, **options: Any) -> BlockGrid:
        """Make a block grid from the overlap of neighbouring blocks.

        Args:
            size: Side of a block in latent cells.
            overlap: Fraction of a block that overlaps its neighbour.
            margin: Width of the margin as a fraction of a block.
            **options: Other fields of `BlockGrid`.

        Returns:
            The block grid.

        Raises:
            ValueError: The overlap or the margin is not a whole number of cells, blocks of the same rank would overlap,
                or the margin is half of the overlap or more.
        """
        step = round(size * (1 - overlap))
        if not 0 < step < size or abs(step - size * (1 - overlap)) > 1e-6:
            raise ValueError(
                f"overlap {overlap} must lie between 0 and 1 and be a multiple of 1 / {size} (one latent cell)"
            )
        cells = round(size * margin)
        if not 0 <= 2 * cells < size - step or abs(cells - size * margin) > 1e-6:
            raise ValueError(
                f"the margin is {margin}, expected at least 0, less than half of the overlap {overlap}, and a multiple"
                f" of 1 / {size} (one latent cell)"
            )
        grid = cls(size, step, margin=cells, **options)
        if grid.rank is rank_four_colors and 2 * step <= size:
            raise ValueError(
                f"overlap is {overlap}, expected less than 0.5: otherwise, blocks of the same rank overlap"
            )
        return grid

    def contains(self, index: BlockIndex) -> bool:
        """Test whether the grid contains a block.

        Args:
            index: Index of the block.

        Returns:
            True if the grid contains the block; always True for an unbounded grid.
        """
        if self.num_blocks is None:
            return True
        ahead, behind, left, right = self.num_blocks
        return -behind <= index[0] <= ahead and -right <= index[1] <= left

    def indices(self) -> list[BlockIndex]:
        """List all blocks of a bounded grid.

        Raises:
            ValueError: The grid is unbounded.
        """
        if self.num_blocks is None:
            raise ValueError("cannot list the blocks of an unbounded grid")
        ahead, behind, left, right = self.num_blocks
        return list(product(range(-behind, ahead + 1), range(-right, left + 1)))

    def group_by_rank(self, indices: Iterable[BlockIndex]) -> list[list[BlockIndex]]:
        """Group blocks by rank, starting with the lowest rank.

        Args:
            indices: Indices of blocks.

        Returns:
            Groups of blocks. The blocks of one group can be generated concurrently.
        """
        ordered = sorted(indices, key=lambda index: (self.rank(index), index))
        return [list(group) for _, group in groupby(ordered, key=self.rank)]

    def list_predecessors(self, index: BlockIndex) -> list[BlockIndex]:
        """List the blocks that must be generated first: those that overlap this block and have a lower rank.

        Args:
            index: Index of the block.

        Returns:
            Indices of the predecessors in ascending order of rank.
        """
        reach = range(-((self.size - 1) // self.step), (self.size - 1) // self.step + 1)
        near = [(index[0] + i, index[1] + j) for i in reach for j in reach]
        rank = self.rank(index)
        return sorted((p for p in near if self.contains(p) and self.rank(p) < rank), key=lambda p: (self.rank(p), p))

    def overlap_cells(self, index: BlockIndex, of: BlockIndex) -> tuple[slice, slice]:
        """Return the cells of a block that another block also covers.

        Args:
            index: Index of the block.
            of: Index of the other block.

        Returns:
            Row slice and column slice of block `index`.
        """
        rows, cols = (
            slice(max(0, shift), max(0, min(self.size, self.size + shift)))
            for shift in ((a - b) * self.step for a, b in zip(index, of, strict=True))
        )
        return rows, cols

    def _inner_cells(self, index: BlockIndex) -> np.ndarray:
        """Return the (size, size) bool mask of the cells of a block that are not in its margin."""
        inner = np.ones((self.size, self.size), bool)
        if index == (0, 0):
            return inner
        (i, j), margin = index, self.margin
        if self.contains((i + 1, j)):
            inner[:margin] = False
        if self.contains((i - 1, j)):
            inner[self.size - margin :] = False
        if self.contains((i, j + 1)):
            inner[:, :margin] = False
        if self.contains((i, j - 1)):
            inner[:, self.size - margin :] = False
        return inner

    def new_cells(self, index: BlockIndex) -> np.ndarray:
        """Return the cells of a block that no predecessor owns. The block generates them.

        Args:
            index: Index of the block.

        Returns:
            (size, size) bool.
        """
        new = np.ones((self.size, self.size), bool)
        for other in self.list_predecessors(index):
            new[self.overlap_cells(index, other)] &= ~self._inner_cells(other)[self.overlap_cells(other, index)]
        return new

    def owned_cells(self, index: BlockIndex) -> np.ndarray:
        """Return the cells that a block owns: its new cells without its margin.

        Args:
            index: Index of the block.

        Returns:
            (size, size) bool.
        """
        return self.new_cells(index) & self._inner_cells(index)

    def known_cells(self, index: BlockIndex) -> list[tuple[BlockIndex, np.ndarray]]:
        """Return the cells of a block that its predecessors own.

        Args:
            index: Index of the block.

        Returns:
            Index and mask (size, size) bool of each predecessor that owns cells of this block.
        """
        parts = []
        for other in self.list_predecessors(index):
            here = np.zeros((self.size, self.size), bool)
            here[self.overlap_cells(index, other)] = self.owned_cells(other)[self.overlap_cells(other, index)]
            if here.any():
                parts.append((other, here))
        return parts


def label_blocks(
    kind: str,
    label: str | Sequence[Sequence[str]],
    num_blocks: tuple[int, int, int, int],
    free_blocks: str = "none",
) -> dict[BlockIndex, str]:
    """Return the label of each block of a rectangle.

    Args:
        kind: Kind of label of the model, a key of `LABELS`.
        label: Label of all blocks; or a map with one row per row of blocks, of which the first is farthest ahead, and
            one label per block, of which the first is leftmost.
        num_blocks: Number of blocks ahead of, behind, to the left of and to the right of block (0, 0).
        free_blocks: Blocks that count as crops at any place and heading: a key of FREE_BLOCKS. Only partial labels
            distinguish crops from views of a vehicle.

    Returns:
        Label by block.

    Raises:
        ValueError: The map has another size, a label is unknown, or `free_blocks` is unknown.
    """
    is_free = find_free_blocks(free_blocks)
    ahead, behind, left, right = num_blocks
    rows, cols = ahead + behind + 1, left + right + 1
    labels = [[label] * cols] * rows if isinstance(label, str) else label
    if len(labels) != rows or any(len(row) != cols for row in labels):
        found = " and ".join(str(width) for width in sorted({len(row) for row in labels}))
        raise ValueError(
            f"the number of rows is {len(labels)}, with {found or 'no'} labels per row; the city has {rows} rows with "
            f"{cols} blocks each"
        )
    require_labels(kind, {name for row in labels for name in row})
    by_block = {}
    for index in product(range(-behind, ahead + 1), range(-right, left + 1)):
        name = labels[ahead - index[0]][left - index[1]]
        by_block[index] = mark_free(kind, name) if is_free(index) else name
    return by_block
