"""What composition needs of a pipeline; `models.pipeline.PrITTIPipeline` has it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from torch import Tensor

from models.composition.inpaint import Contents
from models.layout import LayoutSpec
from models.sampling.diffusion import InpaintCondition, SceneKey
from models.sampling.repaint import RePaintConfig
from models.scene import Scene

StepCallback = Callable[
    [Any, int, int, dict], dict
]  # diffusers' callback_on_step_end: pipeline, step, timestep, tensors


@runtime_checkable
class SceneGenerator(Protocol):
    """Encodes, decodes and inpaints scenes of one size."""

    @property
    def spec(self) -> LayoutSpec: ...

    @property
    def latent_shape(self) -> tuple[int, int, int]: ...

    def encode(self, scenes: Sequence[Scene]) -> Tensor: ...

    def decode(self, latents: Tensor, identities: Sequence[Scene]) -> list[Scene]: ...

    def new_identity(self, run: str, seed: int, index: int, label: str) -> Scene: ...

    def label_tensor(self, labels: Sequence[str]) -> Tensor: ...

    def inpaint_latents(
        self,
        condition: InpaintCondition,
        labels: Sequence[str],
        seed: int | Sequence[int],
        indices: Sequence[SceneKey],
        repaint: RePaintConfig,
        guidance_scale: float = 1.0,
        callback_on_step_end: StepCallback | None = None,
        purpose: int = ...,
    ) -> Tensor: ...

    def inpaint(
        self,
        scenes: Sequence[Scene],
        regions: Sequence[np.ndarray],
        labels: Sequence[str],
        contents: Contents = "both",
        seed: int = 0,
        indices: Sequence[SceneKey] | None = None,
        repaint: RePaintConfig | None = None,
        guidance_scale: float = 1.0,
        *,
        callback_on_step_end: StepCallback | None = None,
        composite: bool = True,
    ) -> list[Scene]: ...
