"""PrITTIPipeline combines the layout VAE and the DiT and generates Scenes, in the style of diffusers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch

from models.composition.block_grid import BlockIndex, choose_arrangement, label_blocks
from models.composition.extend import Side, extend_scene
from models.composition.generator import StepCallback
from models.composition.inpaint import (
    Contents,
    composite_scenes,
    grow_to_cells,
    hide_replaced_objects,
    make_latent_mask,
    select_kept_pixels,
)
from models.composition.outpaint import count_planned_cells, outpaint_scene, uses_street_plan
from models.composition.road_sketch import SketchedRoad, Streets
from models.composition.street_plan import StreetPlan, convert_label
from models.sampling.diffusion import INPAINT, InpaintCondition, SceneKey
from models.sampling.repaint import InpaintingConfig
from models.sampling_pipeline import SamplingPipeline, draw_seeds
from models.scene import Scene


class PrITTIPipeline(SamplingPipeline):
    """Generate, inpaint and outpaint Scenes. Methods and file formats are similar to those of diffusers pipelines.

    The base classes load, save and configure the networks (`models.configured_pipeline.ConfiguredPipeline`, which
    describes the arguments), and sample, encode and decode (`models.sampling_pipeline.SamplingPipeline`).
    """

    def inpaint(
        self,
        scenes: Sequence[Scene],
        regions: Sequence[np.ndarray],
        labels: Sequence[str],
        contents: Contents = "both",
        seed: int = 0,
        indices: Sequence[SceneKey] | None = None,
        repaint: InpaintingConfig | None = None,
        guidance_scale: float = 1.0,
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
        callback_on_step_end: StepCallback | None = None,
        composite: bool = True,
        keep: Sequence[str] = (),
        kept_pixels: Sequence[np.ndarray] | None = None,
    ) -> list[Scene]:
        """Regenerate a region of each scene; regions are enlarged to whole latent cells (paper, Sec. 3.3).

        Args:
            scenes: Scenes on the model's grid.
            regions: One mask (rows, cols) per scene; True marks the pixels to regenerate
                (models/composition/inpaint.py).
            labels: Label of each scene.
            contents: "objects": regenerate objects on the known ground. "ground": regenerate the ground under the known
                objects. "both": regenerate ground and objects. With a local frame, object latents hold no absolute yaw
                and height, so "ground" knows only the places and shapes of the objects.
            seed: Seed of the run.
            indices: Key of each scene; the noise depends on it (default: 0, 1, ...).
            repaint: Options of inpainting; None: see `resolve_inpainting`.
            guidance_scale: Scale of classifier-free guidance; 1 switches guidance off.
            generator: See `generate`.
            callback_on_step_end: See `generate`.
            composite: If True, copy everything outside the regions from the input. If False, the decoders also
                reconstruct the area outside the regions.
            keep: Names of the categories whose objects are kept inside of the regions, such as "construction_big". The
                model generates the other objects around them.
            kept_pixels: One mask (rows, cols) per scene of the pixels whose objects are kept. None:
                `models.composition.inpaint.select_kept_pixels` of the scenes.

        Returns:
            The regenerated scenes.

        Raises:
            ValueError: A scene is not on the model's grid, the latent is not split and `contents` is not "both" or
                objects are kept, or a kept category is unknown.
        """
        indices = range(len(scenes)) if indices is None else indices
        for scene in scenes:
            self.require_grid(scene)
        if contents != "both" and not self.has_split_latent:
            raise ValueError(f"this model's latent mixes ground and objects, so it cannot regenerate only {contents}")
        if keep and not self.has_split_latent:
            raise ValueError("this model's latent mixes ground and objects, so it cannot keep objects of a region")
        shape = self.latent_shape
        kept: Sequence[np.ndarray] = kept_pixels or ()
        if keep and kept_pixels is None:
            kept = [select_kept_pixels(scene, keep, scene.grid.rows // shape[-1]) for scene in scenes]
        mask = make_latent_mask(regions, shape, contents, kept).to(self.device)
        seeds = draw_seeds(generator, seed, len(scenes))
        cells = [grow_to_cells(region, scene.grid, shape[-1]) for scene, region in zip(scenes, regions, strict=True)]
        known = [hide_replaced_objects(*pair, keep) for pair in zip(scenes, cells, strict=True)] if keep else scenes
        condition = InpaintCondition(self.encode(known), mask)
        latents = self.inpaint_latents(
            condition,
            labels,
            seeds,
            indices,
            repaint,
            guidance_scale,
            callback_on_step_end,
            INPAINT,
        )
        generated = self.decode(latents, scenes)
        if not composite:
            return generated
        return [
            composite_scenes(scene, new, region, contents, keep, pixels)
            for scene, new, region, pixels in zip(scenes, generated, cells, kept or [None] * len(scenes), strict=True)
        ]

    def outpaint(
        self,
        scene: Scene,
        label: str | Mapping[BlockIndex, str],
        seed: int = 0,
        index: int = 0,
        overlap: float | None = None,
        mode: str | None = None,
        num_blocks: tuple[int, int, int, int] = (1, 1, 1, 1),
        repaint: InpaintingConfig | None = None,
        guidance_scale: float = 1.0,
        callback_on_step_end: StepCallback | None = None,
        side: Side | None = None,
        order: str | None = None,
        free_blocks: str | None = None,
        roads: Sequence[Streets] = (),
        margin: float | None = None,
        plan_streets: bool | None = None,
    ) -> Scene:
        """Extend a scene by generated blocks; the input content is unchanged (paper, supplement B.3).

        Args:
            scene: Scene on the model's grid. If `side` is set, the scene may be larger than one block.
            label: One label for all blocks, or a mapping from block index (steps ahead, steps to the left) to label.
            seed: Seed of the run.
            index: Index of the scene within the run.
            overlap: Fraction of a block that overlaps its neighbour; it must correspond to a whole number of latent
                cells. None: see `models.composition.block_grid.choose_arrangement`; 0.5 with `side`.
            mode: "copy" copies the shifted latents of the neighbours. "reencode" transforms the decoded content of the
                neighbours into the frame of the block and encodes it again. Object latents contain absolute centres,
                which a copy does not change. "paper" is the outpainting of the paper: a copy, without blending of the
                ground and without removal of duplicates. None: the mode that the pipeline stores (`neighbour_latents`).
            num_blocks: Number of blocks to add ahead, behind, to the left and to the right. The paper adds one block on
                every side.
            repaint: Options of inpainting; None: see `resolve_inpainting`.
            guidance_scale: Scale of classifier-free guidance; 1 switches guidance off.
            callback_on_step_end: See `generate`.
            side: "ahead", "behind", "left" or "right". If `side` is set, the scene is extended only on this side, by
                (1 - overlap) of a block, and `num_blocks`, `mode`, `order` and `free_blocks` are ignored: the
                neighbours are encoded again.
            order: "outward" or "colours"; None: see `choose_arrangement`.
            free_blocks: Blocks that count as crops at any place and heading, instead of views of a vehicle: "none",
                "off-street" or "all"; None: see `choose_arrangement`. Ignored if `label` is a mapping.
            roads: Roads that the generated blocks contain, in the frame of the scene; ignored with `side`.
            margin: Width of the outermost part of a block that its neighbours generate again, as a fraction of a block;
                None: see `choose_arrangement`.
            plan_streets: Whether streets are planned before blocks; None: if the model can do this and there is more
                than one block on a side (`models.composition.outpaint.uses_street_plan`). Ignored with `side`.

        Returns:
            One scene that covers all blocks.

        Raises:
            ValueError: The scene does not fit the model, the overlap is not a whole number of cells, a road contradicts
                the ground of the scene, or the model cannot plan streets.
        """
        if side is not None:
            if not isinstance(label, str):
                raise ValueError("to extend a scene on one side, pass one label for all blocks")
            share = 0.5 if overlap is None else overlap
            return extend_scene(self, scene, side, label, seed, share, repaint, guidance_scale, callback_on_step_end)
        self.require_grid(scene)
        mode = str(mode or self.config.neighbour_latents)
        has_plan = uses_street_plan(self, roads, mode, max(num_blocks) > 1, plan_streets)
        cells = count_planned_cells(self, roads, has_plan)
        arrangement = choose_arrangement(num_blocks, order, overlap, free_blocks, margin, cells)
        if isinstance(label, str):
            label = label_blocks(self.dit.config.label, label, num_blocks, arrangement.free_blocks)
        return outpaint_scene(
            self,
            scene,
            label,
            seed,
            index,
            arrangement,
            mode,
            num_blocks,
            repaint,
            guidance_scale,
            callback_on_step_end,
            roads,
            has_plan,
        )

    @property
    def plans_streets(self) -> bool:
        """True if the pipeline has a street planner."""
        return self.street_planner is not None

    def plan_streets(
        self,
        scene: Scene | None,
        label_at: Callable[[float, float], str],
        seed: int = 0,
        index: int = 0,
        sketches: Sequence[SketchedRoad] = (),
    ) -> StreetPlan:
        """Plan the streets around a scene over any distance, before blocks are generated.

        Args:
            scene: Scene that the plan continues; None: the plan starts from nothing.
            label_at: Function that maps x and y (m, frame of the scene) to the label of the block there.
            seed: Seed of the noise.
            index: Index of the scene; the noise depends on the seed and this index.
            sketches: Sketched roads that the plan contains, in the frame of the scene.

        Returns:
            The plan, which generates its windows on demand.

        Raises:
            ValueError: The pipeline has no street planner, or the scene has other ground classes or another grid.
        """
        if self.street_planner is None:
            raise ValueError("this pipeline has no street planner; add one with train_street_planner.py")
        kind = self.dit.config.label

        def convert(x_m: float, y_m: float) -> str:
            return convert_label(kind, label_at(x_m, y_m))

        return StreetPlan(self.street_planner, scene, convert, seed, index, sketches=sketches)

    def require_grid(self, scene: Scene) -> None:
        """Raise an error if the grid or the ground classes of a scene differ from those of the model.

        Args:
            scene: Scene.

        Raises:
            ValueError: The grid or the ground classes differ.
        """
        if scene.grid != self.spec.grid or scene.ground_classes != self.spec.ground_classes:
            raise ValueError(
                f"scene {scene.scene_id} has {scene.grid} and ground classes {scene.ground_classes}; "
                f"the model needs {self.spec.grid} and {self.spec.ground_classes}"
            )
