"""Outpainting on a grid of overlapping blocks (paper, supplement B.3).

The paper adds eight blocks around a scene, which gives a grid of three by three blocks. This module also supports
rectangles of any size and unbounded grids. By default, the order, the overlap and the use of neighbours also differ
from the paper (`choose_arrangement`, MODES).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
import torch
from torch import Tensor

from models.composition.block_grid import RANKS, Arrangement, BlockGrid, BlockIndex
from models.composition.generator import SceneGenerator, StepCallback
from models.composition.inpaint import find_region_cells
from models.composition.road_sketch import (
    ROAD,
    SIDEWALK,
    RoadMap,
    SketchedRoad,
    Streets,
    add_sketched_ground,
    check_sketch,
)
from models.composition.seam_blending import extract_new_part, extrapolate_ground
from models.composition.street_plan import StreetPlan
from models.layout import LayoutSpec
from models.sampling.diffusion import OUTPAINT, InpaintCondition
from models.sampling.repaint import InpaintingConfig, RePaintConfig
from models.scene import Grid, Scene, concatenate_primitives, merge_scenes
from models.tensors import make_empty_scene

# How a block uses its neighbours. "reencode" and "copy" differ in the known latents (`BlockComposer.condition_block`);
# both blend the ground and remove duplicates. "paper" copies the latents and does neither.
MODES = ("reencode", "copy", "paper")
# Lowest share of known pixels with ground. Below it, a block is generated without its surroundings, except with
# "paper". Otherwise, it would continue the empty surroundings, and so would its neighbours.
MIN_KNOWN_GROUND = 0.1
EncodeScenes = Callable[[Sequence[Scene]], Tensor]  # Maps scenes on the model's grid to latents (b, c, h, w).


@dataclass(frozen=True, eq=False)
class SceneBlock:
    """A generated block.

    Attributes:
        scene: Content of the cells that the block owns, in the block's frame.
        latent: (c, h, w) latent of the whole block.
        datum_m: Height of the block's frame above the frame of block (0, 0) (metres).
        known_ground: Fraction of the known pixels that have ground; 1 if the block had no known pixels. The paper's
            outpainting fails if this fraction is near 0. Below MIN_KNOWN_GROUND, blocks ignore their surroundings.
    """

    scene: Scene
    latent: Tensor
    datum_m: float = 0.0
    known_ground: float = 1.0


@dataclass(frozen=True, eq=False)
class BlockCondition:
    """Known part of a block that is not yet generated.

    Attributes:
        known: Known part as a Scene.
        latent: Latent (c, h, w) of the known part.
        mask: (c, h, w); 1 marks values to generate, 0 marks values to keep.
        datum_m: Height of the block's frame above the frame of block (0, 0) (metres).
        known_ground: Fraction of the known pixels that have ground; 1 if there are no known pixels.
        owned: (h, w) bool mask of the latent cells that the block owns.
    """

    known: Scene
    latent: Tensor
    mask: Tensor
    datum_m: float
    known_ground: float
    owned: np.ndarray

    @property
    def is_empty(self) -> bool:
        """True if the block has no known part."""
        return bool(self.mask.all())

    @cached_property
    def new_pixels(self) -> np.ndarray:
        """(rows, cols) bool mask of the pixels to generate."""
        return self.known.grid.upsample_cells(
            self.mask[-1].cpu().numpy() > 0
        )  # An object channel: sketched ground is decoded, too.


@dataclass(frozen=True)
class Tile:
    """A rectangle of a large scene.

    Attributes:
        row: Number of tiles between this tile and the rear border of the scene.
        col: Number of tiles between this tile and the right border of the scene.
        grid: Pixel grid in the frame of block (0, 0).
        blocks: Blocks that cover parts of the tile.
    """

    row: int
    col: int
    grid: Grid
    blocks: tuple[BlockIndex, ...]

    @property
    def origin_m(self) -> tuple[float, float, float]:
        """Origin of the frame of the tile, the middle of its rear border, in the frame of block (0, 0) (m)."""
        return self.grid.back_m, (self.grid.left_m + self.grid.right_m) / 2, 0.0

    def to_own_frame(self, scene: Scene) -> Scene:
        """Move the content of the tile to the frame of the tile.

        Args:
            scene: Content of the tile in the frame of block (0, 0).

        Returns:
            The same content; `world_xyz_m` states where the frame of the tile lies in the world frame.
        """
        x_m, y_m, _ = self.origin_m
        cos, sin = np.cos(scene.world_yaw_rad), np.sin(scene.world_yaw_rad)
        x, y, z = scene.world_xyz_m
        origin = (x + cos * x_m - sin * y_m, y + sin * x_m + cos * y_m, z)
        return replace(scene.translate(-x_m, -y_m), world_xyz_m=origin, world_from_imu=None)


def find_ground_height(scene: Scene, x_m: float, y_m: float) -> float:
    """Return the ground height at the occupied pixel that is nearest to a point.

    Args:
        scene: Scene.
        x_m: x of the point (metres, scene frame).
        y_m: y of the point (metres, scene frame).

    Returns:
        Height in metres; 0 if the scene has no ground.
    """
    height, ground_class = scene.surface()
    row, col = np.nonzero(ground_class >= 0)
    if len(row) == 0:
        return 0.0
    x, y = scene.grid.x_m()[row], scene.grid.y_m()[col]
    nearest = ((x - x_m) ** 2 + (y - y_m) ** 2).argmin()
    return float(height[row[nearest], col[nearest]])


class BlockComposer:
    """Condition blocks on their predecessors, and combine blocks into one scene. The composer stores no blocks.

    Args:
        block_grid: Block grid.
        spec: Layout of one block.
        encode: Function that encodes scenes to latents.
        level_m: Ground height at the origin of a block's frame in the training data (metres).
        roads: Streets whose ground all blocks know; the latents of the model must be split.
    """

    def __init__(
        self,
        block_grid: BlockGrid,
        spec: LayoutSpec,
        encode: EncodeScenes,
        level_m: float = 0.0,
        roads: Sequence[Streets] = (),
    ) -> None:
        self.block_grid, self.spec, self.encode, self.level_m = block_grid, spec, encode, level_m
        self.roads = roads

    @property
    def knows_streets(self) -> bool:
        """True if all streets are known, from a plan or a map."""
        return any(isinstance(one, RoadMap | StreetPlan) for one in self.roads)

    @property
    def step_px(self) -> int:
        """Distance between neighbouring blocks in pixels."""
        return self.block_grid.step * (self.spec.grid.rows // self.block_grid.size)

    @property
    def step_m(self) -> float:
        """Distance between neighbouring blocks in metres."""
        return self.step_px * self.spec.grid.resolution_m

    def find_grid(self, indices: Iterable[BlockIndex]) -> Grid:
        """Return the pixel grid of blocks.

        Args:
            indices: Indices of the blocks.

        Returns:
            Smallest grid that covers the blocks, in the frame of block (0, 0).
        """
        rows, cols = zip(*indices, strict=True)
        small = self.spec.grid
        return replace(
            small,
            front_m=small.front_m + max(rows) * self.step_m,
            left_m=small.left_m + max(cols) * self.step_m,
            rows=small.rows + (max(rows) - min(rows)) * self.step_px,
            cols=small.cols + (max(cols) - min(cols)) * self.step_px,
        )

    def cut_tiles(self, tile_m: float | None = None) -> list[Tile]:
        """Cut the area of all blocks into tiles. The last tile of a row or a column may be smaller.

        Args:
            tile_m: Side of a tile (metres); None: one tile covers all blocks.

        Returns:
            Tiles, row by row from the rear border, each row from the right border.

        Raises:
            ValueError: The side is no multiple of the pixel size, or is smaller than a block.
        """
        whole, small = self.find_grid(self.block_grid.indices()), self.spec.grid
        pixel_m = small.resolution_m
        side = max(whole.rows, whole.cols) if tile_m is None else round(tile_m / pixel_m)
        if tile_m is not None and (side < small.rows or abs(side * pixel_m - tile_m) > 1e-6):
            raise ValueError(
                f"the side of a tile is {tile_m:g} m, expected at least {small.rows * pixel_m:g} m and a multiple of "
                f"the pixel size ({pixel_m:g} m)"
            )
        tiles = []
        for row, col in product(range(-(-whole.rows // side)), range(-(-whole.cols // side))):
            rows, cols = (min(side, total - k * side) for k, total in ((row, whole.rows), (col, whole.cols)))
            front_m = whole.back_m + (row * side + rows) * pixel_m
            left_m = whole.right_m + (col * side + cols) * pixel_m
            grid = replace(whole, front_m=front_m, left_m=left_m, rows=rows, cols=cols)
            tiles.append(
                Tile(row, col, grid, tuple(index for index in self.block_grid.indices() if self.covers(index, grid)))
            )
        return tiles

    def covers(self, index: BlockIndex, grid: Grid) -> bool:
        """Test whether a block covers a pixel of a grid.

        Args:
            index: Index of the block.
            grid: Grid in the frame of block (0, 0).

        Returns:
            True if the block and the grid have a common pixel.
        """
        x_m, y_m, small = index[0] * self.step_m, index[1] * self.step_m, self.spec.grid
        return (
            small.back_m + x_m < grid.front_m
            and small.front_m + x_m > grid.back_m
            and small.right_m + y_m < grid.left_m
            and small.left_m + y_m > grid.right_m
        )

    def to_block_frame(self, index: BlockIndex, other: BlockIndex, block: SceneBlock) -> Scene:
        """Crop a block to the area of another block.

        Args:
            index: Index of the block that defines the area of the result and its axes x and y.
            other: Index of the block to crop.
            block: Content of block `other`.

        Returns:
            The cropped scene. The x and y coordinates of this scene are in the frame of block `index`, and its z
            coordinates are in the frame of block (0, 0).
        """
        x, y = ((a - b) * self.step_m for a, b in zip(other, index, strict=True))
        return block.scene.translate(x, y, block.datum_m).crop(self.spec.grid)

    def condition_block(
        self, index: BlockIndex, blocks: Mapping[BlockIndex, SceneBlock], empty: Scene, mode: str
    ) -> BlockCondition:
        """Collect the known part of a block from its predecessors.

        Args:
            index: Index of the block.
            blocks: Generated blocks; they must include all predecessors of the block.
            empty: Empty Scene whose ids are copied to the result.
            mode: "copy" and "paper" copy the latents of the neighbours, as in the paper. "reencode" transforms the
                decoded content of the neighbours into the block's frame and encodes it again. Object latents contain
                absolute centres. A copy does not change these centres.

        Returns:
            The known part.

        Raises:
            KeyError: A predecessor is missing.
        """
        parts = [(other, blocks[other], cells) for other, cells in self.block_grid.known_cells(index)]
        grid = self.spec.grid
        scenes = [self.to_block_frame(index, other, block) for other, block, _ in parts]
        known = merge_scenes(scenes, [grid.upsample_cells(cells) for *_, cells in parts], empty) if parts else empty
        new_cells = self.block_grid.new_cells(index)
        mask = torch.from_numpy(new_cells)
        datum_m = find_ground_height(known, 0.0, 0.0) - self.level_m if parts and mode == "reencode" else 0.0
        known = known.translate(0, 0, -datum_m)
        new = grid.upsample_cells(new_cells)
        shown, offset_m = extrapolate_ground(known, new), (index[0] * self.step_m, index[1] * self.step_m)
        shown, drawn = add_sketched_ground(shown, self.roads, new, offset_m, self.level_m)
        latent = self.encode([shown])[0]
        if mode != "reencode":
            latent = torch.zeros_like(latent)
            for other, block, cells in parts:
                there, here = self.block_grid.overlap_cells(other, index), self.block_grid.overlap_cells(index, other)
                shared = torch.from_numpy(cells[here]).to(latent.device)
                latent[:, *here] = torch.where(shared, block.latent[:, *there].to(latent), latent[:, *here])
        seen = (np.any(known.occupied, axis=0) | drawn)[~new | drawn]
        known_ground = float(seen.mean()) if len(seen) else 1.0
        mask = mask.to(latent).expand_as(latent)
        if drawn.any():  # The first half of the channels belongs to the ground.
            sketched = ~find_region_cells(~drawn, len(new_cells))
            mask = mask.clone()
            mask[: len(mask) // 2, torch.from_numpy(sketched)] = 0.0
        return BlockCondition(known, latent, mask, datum_m, known_ground, self.block_grid.owned_cells(index))

    def finish_block(
        self, condition: BlockCondition, latent: Tensor, generated: Scene, blend: bool = True
    ) -> SceneBlock:
        """Reduce a decoded block to the cells that it owns.

        Args:
            condition: Known part of the block.
            latent: (c, h, w) latent of the whole block.
            generated: Decoded block.
            blend: See `extract_new_part`.

        Returns:
            The block, which contains only the cells that it owns.
        """
        owned = generated.grid.upsample_cells(condition.owned)
        own = extract_new_part(generated, condition.known, condition.new_pixels, blend, owned)
        return SceneBlock(own, latent, condition.datum_m, condition.known_ground)

    def stitch(self, blocks: Mapping[BlockIndex, SceneBlock], like: Scene, grid: Grid | None = None) -> Scene:
        """Combine blocks into one Scene; each block contributes the cells that it owns.

        Args:
            blocks: Generated blocks.
            like: Scene whose ids and labels are copied to the result.
            grid: Grid of the result, aligned with block (0, 0) to whole pixels. None: the grid covers all blocks.

        Returns:
            The combined scene.
        """
        small = self.spec.grid
        grid = self.find_grid(blocks) if grid is None else grid
        shape = (len(self.spec.ground_classes), grid.rows, grid.cols)
        height, occupied, objects = np.zeros(shape, np.float32), np.zeros(shape, bool), []
        for index, block in sorted(blocks.items()):
            x, y = (steps * self.step_m for steps in index)
            owned = small.upsample_cells(self.block_grid.owned_cells(index))
            part = block.scene.translate(x, y, block.datum_m)
            here, there = grid.intersect(part.grid)
            for whole, piece in ((height, part.height_m), (occupied, part.occupied)):
                np.copyto(whole[:, *here], piece[:, *there], where=owned[there])
            objects.append(part.select(grid.contains(part.center_m[:, 0], part.center_m[:, 1])))
        classes = self.spec.ground_classes
        primitives = concatenate_primitives(objects)
        return replace(like, grid=grid, height_m=height, occupied=occupied, ground_classes=classes, **primitives)


def check_roads(roads: Sequence[Streets], scene: Scene, mode: str, has_split_latent: bool) -> None:
    """Check that outpainting can follow sketched roads.

    Args:
        roads: Roads in the frame of the scene.
        scene: Scene to extend.
        mode: One of MODES.
        has_split_latent: Whether separate channels of the latents hold the ground.

    Raises:
        ValueError: The mode is not "reencode", the latents are not split, or a road contradicts the ground of the scene
            (`check_sketch`).
    """
    if not roads:
        return
    if mode != "reencode":
        raise ValueError(f"sketched roads need the mode reencode, not {mode}, because they are encoded")
    if not has_split_latent:
        raise ValueError("the latents of this model mix ground and objects, so it cannot follow sketched roads")
    check_sketch(roads, scene)


def uses_street_plan(
    model: SceneGenerator, roads: Sequence[Streets], mode: str, is_far: bool, wanted: bool | None
) -> bool:
    """Return whether the streets of a large scene are planned before its blocks.

    Args:
        model: Model.
        roads: Known streets. A map of all roads needs no plan; sketched roads become part of the plan.
        mode: One of MODES.
        is_far: Whether there is more than one block on a side.
        wanted: Whether a plan is requested; None: a plan is made for far blocks, if the model can do this.

    Returns:
        Whether to make a plan.

    Raises:
        ValueError: A plan is requested, but the model cannot plan streets or use a plan, or there is a map.
    """
    if wanted is False:
        return False
    has_map = any(isinstance(one, RoadMap) for one in roads)
    fault = ""
    if not model.plans_streets:
        fault = "this model has no street planner; add one with train_street_planner.py"
    elif not model.has_split_latent or {ROAD, SIDEWALK} - set(model.spec.ground_classes):
        fault = "this model has no separate latent for roads and sidewalks"
    elif mode != "reencode":
        fault = f"a plan needs the mode reencode, not {mode}"
    elif has_map:
        fault = "the map of the roads already is a plan"
    if wanted and fault:
        raise ValueError(f"streets cannot be planned: {fault}")
    return not fault and (wanted or is_far)


def make_label_finder(
    label: str | Mapping[BlockIndex, str] | Callable[[BlockIndex], str], step_m: float, grid: Grid
) -> Callable[[float, float], str]:
    """Return the function that maps places to labels, for a street plan.

    Args:
        label: Label of all blocks, a mapping from block index to label, or a function of the block index.
        step_m: Distance between neighbouring blocks (m).
        grid: Grid of block (0, 0).

    Returns:
        Function that maps x and y (m, frame of block (0, 0)) to the label of the block there. Where a mapping has no
        block, the label is that of the nearest block.
    """
    middle = (grid.front_m + grid.back_m) / 2, (grid.left_m + grid.right_m) / 2

    def label_at(x_m: float, y_m: float) -> str:
        index = round((x_m - middle[0]) / step_m), round((y_m - middle[1]) / step_m)
        if isinstance(label, str):
            return label
        if not isinstance(label, Mapping):
            return label(index)
        return label[min(label, key=lambda one: (abs(one[0] - index[0]) + abs(one[1] - index[1]), one))]

    return label_at


def make_street_plan(
    model: SceneGenerator,
    scene: Scene,
    roads: Sequence[Streets],
    label: str | Mapping[BlockIndex, str] | Callable[[BlockIndex], str],
    step_m: float,
    seed: int,
    scene_index: int,
) -> StreetPlan:
    """Plan the streets around a scene.

    Args:
        model: Model with a street planner.
        scene: Scene to extend.
        roads: Known streets. Sketched roads become part of the plan.
        label: Label of blocks (`make_label_finder`).
        step_m: Distance between neighbouring blocks (m).
        seed: Seed of the noise.
        scene_index: Index of the scene.

    Returns:
        The plan.
    """
    sketches = [one for one in roads if isinstance(one, SketchedRoad)]
    return model.plan_streets(scene, make_label_finder(label, step_m, scene.grid), seed, scene_index, sketches)


def count_planned_cells(model: SceneGenerator, roads: Sequence[Streets], plans_streets: bool) -> int:
    """Return the number of latent cells per side of a block if all streets are known, for `choose_arrangement`.

    Args:
        model: Model.
        roads: Known streets.
        plans_streets: Whether streets are planned.

    Returns:
        Number of cells; 0 if some streets are unknown.
    """
    is_known = plans_streets or any(isinstance(one, RoadMap) for one in roads)
    return model.latent_shape[-1] if is_known else 0


def generate_blocks(
    model: SceneGenerator,
    composer: BlockComposer,
    indices: Sequence[BlockIndex],
    blocks: Mapping[BlockIndex, SceneBlock],
    like: Scene,
    label: str | Mapping[BlockIndex, str],
    seed: int = 0,
    scene_index: int = 0,
    mode: str = "reencode",
    repaint: InpaintingConfig | None = None,
    guidance_scale: float = 1.0,
    callback_on_step_end: StepCallback | None = None,
) -> dict[BlockIndex, SceneBlock]:
    """Generate blocks in one batch, conditioned on existing blocks.

    Args:
        model: Model that generates one block.
        composer: Block grid and the functions that combine blocks.
        indices: Blocks to generate.
        blocks: Existing blocks; they must include all predecessors of `indices`.
        like: Scene whose ids are copied to the result.
        label: One label for all blocks, or a mapping from block index to label.
        seed: Seed of the noise.
        scene_index: Index of the scene. The noise depends on the seed, this index and the block index.
        mode: One of MODES.
        repaint: Options of inpainting; None: see `resolve_inpainting`. Blocks without known surroundings are generated
            like single scenes, with the sampler of the model; if it is DDPM and RePaint is used, with the steps of
            RePaint.
        guidance_scale: Scale of classifier-free guidance; 1 switches guidance off.
        callback_on_step_end: See `PrITTIPipeline.generate`.

    Returns:
        The new blocks by index.

    Raises:
        KeyError: A block has no label, or a predecessor is missing.
        ValueError: `mode` is unknown.
    """
    if mode not in MODES:
        raise ValueError(f"outpainting mode is {mode!r}, expected one of: {', '.join(MODES)}")
    empty = make_empty_scene(like.scene_id, like.source, like.sequence, like.frame, model.spec)
    conditions = [composer.condition_block(index, blocks, empty, mode) for index in indices]
    as_paper = mode == "paper"
    labels = [label if isinstance(label, str) else label[index] for index in indices]
    keys = [(scene_index, *index) for index in indices]
    alone = [not as_paper and (c.is_empty or c.known_ground < MIN_KNOWN_GROUND) for c in conditions]
    latents, masks = (torch.stack(values) for values in zip(*((c.latent, c.mask) for c in conditions), strict=True))
    repaint = model.resolve_inpainting(repaint, composer.knows_streets)
    masks[alone] = 1.0
    for new in (True, False):
        chosen = [k for k, one in enumerate(alone) if one == new]
        if not chosen:
            continue
        names, chosen_keys, options = [labels[k] for k in chosen], [keys[k] for k in chosen], repaint
        if new and isinstance(repaint, RePaintConfig):
            if not model.uses_ddpm:  # Few steps of DDPM would lose objects.
                latents[chosen] = model.sample_latents(
                    names, seed, chosen_keys, None, guidance_scale, callback_on_step_end, purpose=OUTPAINT
                )
                continue
            options = replace(repaint, resamplings=1, pseudoinverse_guidance=0.0)  # They need a known part.
        condition = InpaintCondition(latents[chosen], masks[chosen])
        latents[chosen] = model.inpaint_latents(
            condition, names, seed, chosen_keys, options, guidance_scale, callback_on_step_end, OUTPAINT
        )
    scenes = model.decode(latents, [empty] * len(indices), deduplicate=not as_paper, attach=False if as_paper else None)
    parts = zip(indices, conditions, latents, scenes, strict=True)
    return {
        index: composer.finish_block(condition, latent, scene, blend=not as_paper)
        for index, condition, latent, scene in parts
    }


def outpaint_scene(
    model: SceneGenerator,
    scene: Scene,
    label: str | Mapping[BlockIndex, str],
    seed: int,
    scene_index: int,
    arrangement: Arrangement,
    mode: str,
    num_blocks: tuple[int, int, int, int],
    repaint: InpaintingConfig | None,
    guidance_scale: float,
    callback_on_step_end: StepCallback | None,
    roads: Sequence[Streets] = (),
    plan_streets: bool = False,
) -> Scene:
    """Extend a scene on the model's grid by generated blocks on its four sides.

    Args:
        model: Model.
        scene: Scene on the model's grid.
        label: One label for all blocks, or a mapping from block index to label.
        seed: Seed of the noise.
        scene_index: Index of the scene. The noise depends on the seed and this index.
        arrangement: Order and overlap of the blocks; its overlap must correspond to a whole number of latent cells.
        mode: One of MODES.
        num_blocks: Number of blocks to add ahead, behind, to the left and to the right.
        repaint: Options of inpainting; None: see `resolve_inpainting`.
        guidance_scale: Scale of classifier-free guidance; 1 switches guidance off.
        callback_on_step_end: See `PrITTIPipeline.generate`.
        roads: Sketched roads in the frame of the scene (`check_roads`).
        plan_streets: Whether the streets are planned first (`uses_street_plan`).

    Returns:
        One scene that covers all blocks.

    Raises:
        ValueError: The overlap is not a whole number of cells, `mode` is unknown, or the model cannot follow the roads.
    """
    check_roads(roads, scene, mode, model.has_split_latent)
    block_grid = BlockGrid.from_overlap(
        model.latent_shape[-1],
        arrangement.overlap,
        arrangement.margin,
        rank=RANKS[arrangement.order],
        num_blocks=num_blocks,
    )
    composer = BlockComposer(block_grid, model.spec, model.encode, find_ground_height(scene, 0.0, 0.0), roads)
    if plan_streets:
        plan = make_street_plan(model, scene, roads, label, composer.step_m, seed, scene_index)
        composer.roads = [*roads, plan]
    blocks = {(0, 0): SceneBlock(scene, model.encode([scene])[0])}
    for group in block_grid.group_by_rank(index for index in block_grid.indices() if index not in blocks):
        blocks |= generate_blocks(
            model,
            composer,
            group,
            blocks,
            scene,
            label,
            seed,
            scene_index,
            mode,
            repaint,
            guidance_scale,
            callback_on_step_end,
        )
    return composer.stitch(blocks, scene)
