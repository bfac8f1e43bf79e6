"""Plan the streets of a city with a diffusion model, before its blocks are generated.

Blocks that do not know each other cannot agree on streets. A street planner (models/street_planner.py) generates signed
distances (street_distances.py) over sections of 256 m. It continues known parts. The first section knows the streets of
the given scene. Each further section knows those of its predecessors, which overlap it by a quarter of its side. Blocks
then take the plan as known ground, like a map of all roads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from models.composition.block_grid import BlockGrid, BlockIndex, rank_outward
from models.composition.road_sketch import SketchedRoad, draw_roads
from models.composition.street_distances import (
    GAP_M,
    REACH_M,
    StreetDistances,
    measure_street_distances,
    read_street_masks,
)
from models.labels import ANY, compose_label, find_label_index, split_label
from models.sampling.diffusion import PLAN, InpaintCondition, SceneNoise, sample_with_scheduler, with_known
from models.sampling.schedulers import SAMPLERS, SchedulerConfig
from models.scene import Grid, Scene
from models.street_planner import CHANNELS, LABEL_KIND, PIXEL_M, StreetPlanner, measure_border_distances

SAMPLER = "dpm++"
SECTION_OVERLAP = 0.25  # Share of the side of a section that its neighbour also covers (docs/experiments/cities.md).
SKETCH_RESOLUTION_M = 0.5  # Side of the pixels from which the distances of sketched roads are computed.
LabelAt = Callable[[float, float], str]  # Maps x and y (m, frame of block (0, 0)) to the label of the block there.


def convert_label(kind: str, label: str) -> str:
    """Return the label of a street plan that fits the label of a block.

    Args:
        kind: Kind of label of the blocks, a key of `models.labels.LABELS`.
        label: Label of a block.

    Returns:
        Label of the street planner.
    """
    return str(compose_label(LABEL_KIND, *split_label(kind, label), True))


class StreetPlan:
    """An unbounded street plan that generates sections on demand. It does not depend on the order of requests.

    Attributes:
        sections: Distances (2, size, size) of the generated sections, by index (m).

    Args:
        planner: Street planner.
        given: Scene that the plan continues. Its grid must consist of whole pixels of the plan. None: nothing is given,
            and the first section has its centre at the origin.
        label_at: Label of the streets at a place (`convert_label`); None: any.
        seed: Seed of the noise.
        scene_index: Index of the scene. The noise depends on the seed, this index and the section.
        num_inference_steps: Number of denoising steps; None: the default of the sampler.
        sketches: Sketched roads that the plan contains, in the frame of the given scene.

    Raises:
        ValueError: The scene has no roads and sidewalks, or a grid that a plan cannot continue.
    """

    def __init__(
        self,
        planner: StreetPlanner,
        given: Scene | None = None,
        label_at: LabelAt | None = None,
        seed: int = 0,
        scene_index: int = 0,
        num_inference_steps: int | None = None,
        sketches: Sequence[SketchedRoad] = (),
    ) -> None:
        self.planner, self.label_at, self.seed, self.scene_index = planner, label_at, seed, scene_index
        self.sketches = tuple(sketches)
        size = planner.config.size
        self.section_grid = BlockGrid.from_overlap(size, SECTION_OVERLAP, rank=rank_outward, num_blocks=None)
        # First pixels of the first section, counted ahead from x = 0 and to the left from y = 0.
        self._first = -size // 2, -size // 2
        self._given, self._is_given = np.zeros((CHANNELS, size, size), np.float32), np.zeros((size, size), bool)
        if given is not None:
            self._set_given(given)
        self.sections: dict[BlockIndex, np.ndarray] = {}
        self._owned: dict[BlockIndex, np.ndarray] = {}
        sampler = SchedulerConfig.ddpm(planner.diffusion).with_sampler(SAMPLER)
        steps = num_inference_steps or SAMPLERS[SAMPLER].num_inference_steps
        planner.diffusion.select_timesteps(steps)  # Raises an error for an invalid number of steps.
        self._scheduler: Any = sampler.build()
        self._steps = steps

    def _set_given(self, given: Scene) -> None:
        """Put the given scene in the middle of the first section."""
        distance_m = measure_street_distances(*read_street_masks(given), given.grid.resolution_m)
        size, (rows, cols) = self.section_grid.size, distance_m.shape[1:]
        back_px, right_px = given.grid.back_m / PIXEL_M, given.grid.right_m / PIXEL_M
        if rows > size or cols > size or (size - rows) % 2 or (size - cols) % 2 or back_px % 1 or right_px % 1:
            raise ValueError(
                f"scene {given.scene_id} has {given.grid}; a street plan continues scenes of at most {self.section_m:g}"
                f" m whose borders lie at multiples of {PIXEL_M:g} m"
            )
        row, col = (size - rows) // 2, (size - cols) // 2
        self._first = round(back_px) - row, round(right_px) - col
        middle = slice(row, row + rows), slice(col, col + cols)
        self._given[:, *middle] = distance_m
        # Distances that are independent of the surroundings of the scene.
        self._is_given[middle] = (np.abs(distance_m) <= measure_border_distances(rows, cols)).all(axis=0)

    @property
    def section_m(self) -> float:
        """Side of a section (m)."""
        return self.section_grid.size * PIXEL_M

    def _find_section_grid(self, index: BlockIndex) -> Grid:
        """Return the grid of the pixels of a section."""
        size, step = self.section_grid.size, self.section_grid.step
        back, right = (first + k * step for first, k in zip(self._first, index, strict=True))
        return Grid((back + size) * PIXEL_M, (right + size) * PIXEL_M, PIXEL_M, size, size)

    def _cover(self, grid: Grid) -> Grid:
        """Return the grid of all pixels of the plan that are needed to draw the streets on a grid."""
        margin = int(np.ceil(GAP_M / PIXEL_M)) + 1
        back, right = (int(low_m // PIXEL_M) - margin for low_m in (grid.back_m, grid.right_m))
        front, left = (int(-(-high_m // PIXEL_M)) + margin for high_m in (grid.front_m, grid.left_m))
        return Grid(front * PIXEL_M, left * PIXEL_M, PIXEL_M, front - back, left - right)

    def _owns(self, index: BlockIndex) -> np.ndarray:
        """Return the (size, size) bool mask of the pixels that a section owns."""
        if index not in self._owned:
            self._owned[index] = self.section_grid.owned_cells(index)
        return self._owned[index]

    def list_sections(self, grid: Grid) -> list[BlockIndex]:
        """List the sections from which the streets on a grid are drawn, without their predecessors.

        Args:
            grid: Grid in the frame of block (0, 0), of any resolution.

        Returns:
            Indices of the sections.
        """
        cover, ranges = self._cover(grid), []
        size, step = self.section_grid.size, self.section_grid.step
        for first, low_m, count in zip(
            self._first, (cover.back_m, cover.right_m), (cover.rows, cover.cols), strict=True
        ):
            # Section k spans the pixels from first + k step to first + k step + size.
            low = round(low_m / PIXEL_M) - first
            ranges.append(range((low - size) // step + 1, -(-(low + count) // step)))
        found = product(*ranges)
        return [k for k in found if self._owns(k)[cover.intersect(self._find_section_grid(k))[1]].any()]

    def list_predecessors(self, index: BlockIndex) -> list[BlockIndex]:
        """List the sections that a section continues.

        Args:
            index: Index of the section (steps ahead, steps to the left).

        Returns:
            Indices of the sections.
        """
        return [other for other, _ in self.section_grid.known_cells(index)]

    def collect(self, grid: Grid) -> StreetDistances:
        """Return the plan of a rectangle, and generate missing sections.

        Args:
            grid: Grid in the frame of block (0, 0), of any resolution.

        Returns:
            Distances on all pixels of the plan that are needed to draw the streets on the grid.
        """
        cover = self._cover(grid)
        distance_m = np.full((CHANNELS, cover.rows, cover.cols), -REACH_M, np.float32)
        for index in self.list_sections(grid):
            here, there = cover.intersect(self._find_section_grid(index))
            np.copyto(distance_m[:, *here], self.get_section(index)[:, *there], where=self._owns(index)[there])
        return StreetDistances(cover.front_m, cover.left_m, distance_m)

    def draw(self, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
        """Draw the streets on a grid, and generate missing sections.

        Args:
            grid: Grid in the frame of block (0, 0).

        Returns:
            Masks (rows, cols) of the pixels of roads, and of roads and sidewalks.
        """
        return self.collect(grid).draw(grid)

    def find_contradiction(self, scene: Scene) -> None:
        """Return None: the plan continues the streets of the given scene.

        Args:
            scene: Given scene.
        """
        return

    def get_section(self, index: BlockIndex) -> np.ndarray:
        """Return the distances of a section; generate its missing predecessors and the section.

        Args:
            index: Index of the section (steps ahead, steps to the left).

        Returns:
            (2, size, size) float32 distances (m).
        """
        waiting = [index]  # A loop, because distant sections have thousands of predecessors.
        while waiting:
            missing = [other for other in self.list_predecessors(waiting[-1]) if other not in self.sections]
            if missing and waiting[-1] not in self.sections:
                waiting += missing
                continue
            last = waiting.pop()
            if last not in self.sections:
                self.sections[last] = self._generate_section(last)
        return self.sections[index]

    def put_section(self, index: BlockIndex, distance_m: np.ndarray) -> None:
        """Store a section that another process has generated.

        Args:
            index: Index of the section.
            distance_m: (2, size, size) distances (m).
        """
        self.sections[index] = distance_m

    def _find_known(self, index: BlockIndex) -> tuple[np.ndarray, np.ndarray]:
        """Return the known distances (2, size, size) of a section, and the mask (size, size) of the known pixels."""
        size = self.section_grid.size
        known_m, is_known = np.zeros((CHANNELS, size, size), np.float32), np.zeros((size, size), bool)
        if index == (0, 0):
            known_m, is_known = self._given.copy(), self._is_given.copy()
        for other, cells in self.section_grid.known_cells(index):
            here, there = self.section_grid.overlap_cells(index, other), self.section_grid.overlap_cells(other, index)
            np.copyto(known_m[:, *here], self.sections[other][:, *there], where=cells[here])
            is_known |= cells
        if self.sketches:
            grid = self._find_section_grid(index)
            side = round(PIXEL_M / SKETCH_RESOLUTION_M)
            fine = replace(grid, resolution_m=SKETCH_RESOLUTION_M, rows=grid.rows * side, cols=grid.cols * side)
            road, sidewalk = draw_roads(self.sketches, fine)
            sketched_m = measure_street_distances(road, road | sidewalk, SKETCH_RESOLUTION_M)
            is_sketched = (sketched_m[0] >= 0) & ~is_known
            np.copyto(known_m, sketched_m, where=is_sketched)
            is_known |= is_sketched
        return known_m, is_known

    def _generate_section(self, index: BlockIndex) -> np.ndarray:
        known_m, is_known = self._find_known(index)
        if is_known.all():
            return known_m
        config, device = self.planner.config, self.planner.device
        shift, scale = (torch.tensor(value, device=device)[:, None, None] for value in (config.shift, config.scale))
        grid = self._find_section_grid(index)
        middle = (grid.front_m + grid.back_m) / 2, (grid.left_m + grid.right_m) / 2
        name = self.label_at(*middle) if self.label_at else f"{ANY}-{ANY}-free"
        label = torch.tensor([find_label_index(LABEL_KIND, name)], device=device)
        known = (torch.from_numpy(known_m).to(device) - shift) / scale
        mask = torch.from_numpy(~is_known).to(known).expand(1, CHANNELS, -1, -1)
        condition = InpaintCondition(known[None], mask)
        self._scheduler.set_timesteps(self._steps, device=device)
        noise = SceneNoise(self.seed, [(self.scene_index, *index)], known.shape, device, PLAN)
        model = with_known(self.planner.make_denoiser(), condition, self.planner.diffusion)
        latent: Tensor = sample_with_scheduler(model, self._scheduler, noise, label)
        latent = torch.where(mask.bool(), latent, condition.latent)[0]
        found_m = (latent * scale + shift).clamp(-REACH_M, REACH_M).cpu().numpy()
        return np.where(is_known, known_m, found_m)
