"""Interface between the composition functions and a pipeline, implemented by `models.pipeline.PrITTIPipeline`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from torch import Tensor

from models.composition.inpaint import Contents
from models.composition.road_sketch import SketchedRoad
from models.composition.street_plan import StreetPlan
from models.layout import LayoutSpec
from models.sampling.diffusion import InpaintCondition, SceneKey
from models.sampling.repaint import InpaintingConfig
from models.scene import Scene

# Type of diffusers' `callback_on_step_end`: (pipeline, step, timestep, tensors) -> tensors.
StepCallback = Callable[[Any, int, int, dict], dict]


@runtime_checkable
class SceneGenerator(Protocol):
    """Encode, decode and inpaint scenes of a fixed size."""

    @property
    def spec(self) -> LayoutSpec:
        """Layout of the scenes."""
        ...

    @property
    def uses_ddpm(self) -> bool:
        """True if the sampler of the model is that of the paper (DDPM)."""
        ...

    @property
    def has_split_latent(self) -> bool:
        """True if the first half of the channels of a latent belongs to the ground, the second half to the objects."""
        ...

    @property
    def label_kind(self) -> str:
        """Kind of label, a key of `models.labels.LABELS`."""
        ...

    @property
    def plans_streets(self) -> bool:
        """True if the model can plan streets."""
        ...

    def plan_streets(
        self,
        scene: Scene,
        label_at: Callable[[float, float], str],
        seed: int = 0,
        index: int = 0,
        sketches: Sequence[SketchedRoad] = (),
    ) -> StreetPlan:
        """Plan the streets around a scene (see `PrITTIPipeline.plan_streets`).

        Args:
            scene: Scene that the plan continues.
            label_at: Function that maps x and y (m, frame of the scene) to the label of the block there.
            seed: Seed of the noise.
            index: Index of the scene; the noise depends on the seed and this index.
            sketches: Sketched roads that the plan contains.

        Returns:
            The plan.
        """
        ...

    @property
    def latent_shape(self) -> tuple[int, int, int]:
        """Shape (c, h, w) of a latent."""
        ...

    def encode(self, scenes: Sequence[Scene]) -> Tensor:
        """Encode scenes to latents.

        Args:
            scenes: Scenes on the model's grid.

        Returns:
            (b, c, h, w) latents.
        """
        ...

    def decode(
        self, latents: Tensor, identities: Sequence[Scene], *, deduplicate: bool = True, attach: bool | None = None
    ) -> list[Scene]:
        """Decode latents to scenes.

        Args:
            latents: (b, c, h, w) latents.
            identities: Scenes whose ids and labels are copied to the results.
            deduplicate: If True, keep only one of several proposals for the same object.
            attach: Whether signs are attached to their supporters, and poles are put on the ground; None: the
                default of the model.

        Returns:
            One scene per latent.
        """
        ...

    def new_identity(self, run: str, seed: int, index: int, label: str) -> Scene:
        """Return an empty Scene that has the id of the generated scene.

        Args:
            run: Run name.
            seed: Seed of the run.
            index: Index of the scene within the run.
            label: Label of the scene.

        Returns:
            The empty scene.
        """
        ...

    def label_tensor(self, labels: Sequence[str]) -> Tensor:
        """Convert labels to class indices.

        Args:
            labels: Names of labels.

        Returns:
            (b,) class indices.
        """
        ...

    def sample_latents(
        self,
        labels: Sequence[str],
        seed: int | Sequence[int],
        indices: Sequence[SceneKey],
        num_inference_steps: int | None = None,
        guidance_scale: float = 1.0,
        callback_on_step_end: StepCallback | None = None,
        *,
        purpose: int = ...,
    ) -> Tensor:
        """Sample latents with the sampler of the model.

        Args:
            labels: Label of each scene.
            seed: Seed of the noise, or one seed per scene.
            indices: Key of each scene; the noise depends on the seed and this key.
            num_inference_steps: Number of denoising steps; None: the default of the model.
            guidance_scale: Scale of classifier-free guidance; 1 switches guidance off.
            callback_on_step_end: See `PrITTIPipeline.generate`.
            purpose: Purpose of the noise: GENERATE, OUTPAINT or INPAINT (models/sampling/diffusion.py).

        Returns:
            (b, c, h, w) latents.
        """
        ...

    def resolve_inpainting(self, repaint: InpaintingConfig | None, knows_streets: bool = False) -> InpaintingConfig:
        """Return options of inpainting and outpainting.

        Args:
            repaint: Options; None: the default of the model (`PrITTIPipeline.resolve_inpainting`).
            knows_streets: Whether all streets are known, from a plan or a map.

        Returns:
            The options.
        """
        ...

    def inpaint_latents(
        self,
        condition: InpaintCondition,
        labels: Sequence[str],
        seed: int | Sequence[int],
        indices: Sequence[SceneKey],
        repaint: InpaintingConfig | None = None,
        guidance_scale: float = 1.0,
        callback_on_step_end: StepCallback | None = None,
        purpose: int = ...,
    ) -> Tensor:
        """Sample latents that equal the condition wherever its mask is 0.

        Args:
            condition: Known latents and masks.
            labels: Label of each scene.
            seed: Seed of the noise, or one seed per scene.
            indices: Key of each scene; the noise depends on the seed and this key.
            repaint: Options of inpainting; None: see `resolve_inpainting`.
            guidance_scale: Scale of classifier-free guidance; 1 switches guidance off.
            callback_on_step_end: See `PrITTIPipeline.generate`.
            purpose: Purpose of the noise: GENERATE, OUTPAINT or INPAINT (models/sampling/diffusion.py).

        Returns:
            (b, c, h, w) latents.
        """
        ...

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
        *,
        callback_on_step_end: StepCallback | None = None,
        composite: bool = True,
        keep: Sequence[str] = (),
        kept_pixels: Sequence[np.ndarray] | None = None,
    ) -> list[Scene]:
        """Regenerate regions of scenes (see `PrITTIPipeline.inpaint`).

        Args:
            scenes: Scenes on the model's grid.
            regions: One mask (rows, cols) per scene; True marks the pixels to regenerate.
            labels: Label of each scene.
            contents: Part of the scene to regenerate: "both", "ground" or "objects".
            seed: Seed of the noise.
            indices: Key of each scene; the noise depends on the seed and this key.
            repaint: Options of inpainting; None: see `resolve_inpainting`.
            guidance_scale: Scale of classifier-free guidance; 1 switches guidance off.
            callback_on_step_end: See `PrITTIPipeline.generate`.
            composite: If True, copy everything outside the regions from the input.
            keep: Names of the categories whose objects are kept inside of the regions.
            kept_pixels: One mask (rows, cols) per scene of the pixels with kept objects; None: those of the scenes.

        Returns:
            The regenerated scenes.
        """
        ...
