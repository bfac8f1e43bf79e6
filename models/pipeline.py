"""PrITTIPipeline: LVAE and DiT as one object in diffusers' conventions; labels and seeds in, Scenes out. No Ray."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from diffusers import DDPMScheduler, DiffusionPipeline
from jaxtyping import Float
from torch import Tensor

from models.diffusion import GENERATE, OUTPAINT, Diffusion, Known, SceneNoise, Walk, guided, sample
from models.dit import DiT
from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.outpaint import CORNERS, SIDES, OutpaintCanvas
from models.repaint import JUMP_LENGTH, RESAMPLINGS, repaint_transitions
from models.scene import DENSITIES, Scene
from models.tensors import EXISTENCE_THRESHOLD, layout_batch, new_scene, scene_from_layout

NUM_INFERENCE_STEPS = 250  # paper, supplement B.3

# What a DiT may be conditioned on; the joint label is 3 * vegetation + vehicle.
LABELS = {
    "vegetation": DENSITIES,
    "vehicle": DENSITIES,
    "joint": tuple(f"{vegetation}-{vehicle}" for vegetation in DENSITIES for vehicle in DENSITIES),
    "none": ("any",),
}


def label_index(kind: str, name: str) -> int:
    """Index of a label's name; ValueError lists the names of this kind."""
    if name not in LABELS[kind]:
        raise ValueError(f"label {name!r} is unknown to a {kind} model, expected one of: {', '.join(LABELS[kind])}")
    return LABELS[kind].index(name)


def scheduler() -> DDPMScheduler:
    """The paper's noise schedule as a diffusers scheduler, for saving and for its samplers."""
    d = Diffusion()
    return DDPMScheduler(
        num_train_timesteps=d.num_timesteps,
        beta_start=d.beta_start,
        beta_end=d.beta_end,
        beta_schedule="linear",
        variance_type="fixed_small",
        timestep_spacing="leading",
        clip_sample=False,
    )


@dataclass(frozen=True)
class Resampling:
    """How inpainting walks: RePaint's roll-back and resamplings over `num_steps` visited timesteps."""

    num_steps: int = NUM_INFERENCE_STEPS
    jump_length: int = JUMP_LENGTH
    resamplings: int = RESAMPLINGS


class PrITTIPipeline(DiffusionPipeline):
    """Generates Scenes. `from_pretrained(directory)` and `save_pretrained(directory)` as in diffusers."""

    def __init__(self, lvae: LayoutVAE, dit: DiT, scheduler: DDPMScheduler) -> None:
        super().__init__()
        self.register_modules(lvae=lvae, dit=dit, scheduler=scheduler)
        self.lvae.eval().requires_grad_(False)
        self.dit.eval().requires_grad_(False)
        if dit.config.layout is not None:
            self.spec.require(LayoutSpec.from_dict(dit.config.layout), "the DiT")

    @property
    def spec(self) -> LayoutSpec:
        return self.lvae.spec

    @property
    def diffusion(self) -> Diffusion:
        c = self.scheduler.config
        return Diffusion(c.num_train_timesteps, c.beta_start, c.beta_end)

    def _moments(self) -> tuple[Tensor, Tensor]:
        channels = self.dit.config.channels
        shift, scale = self.dit.config.shift or [0.0] * channels, self.dit.config.scale or [1.0] * channels
        return tuple(torch.tensor(v, device=self.device)[:, None, None] for v in (shift, scale))

    @torch.no_grad()
    def encode(self, scenes: Sequence[Scene]) -> Float[Tensor, "b c h w"]:
        """Posterior means of scenes, in the space the diffusion model lives in."""
        shift, scale = self._moments()
        return (self.lvae.encode(layout_batch(list(scenes), self.spec).to(self.device)).mean - shift) / scale

    @torch.no_grad()
    def decode(
        self, latents: Float[Tensor, "b c h w"], identities: Sequence[Scene], threshold: float = EXISTENCE_THRESHOLD
    ) -> list[Scene]:
        """Scenes from latents; ids and labels from `identities`. Latents are decoded one by one.

        One at a time on purpose: the scene is then the same to the last bit whatever stood beside it.
        """
        shift, scale = self._moments()
        layouts = [self.lvae.decode(latent[None] * scale + shift).layouts()[0] for latent in latents]
        return [
            scene_from_layout(layout, self.spec, identity, threshold)
            for layout, identity in zip(layouts, identities, strict=True)
        ]

    def identity(self, run: str, seed: int, index: int, label: str) -> Scene:
        """The empty Scene number `index` of a run, carrying the labels it is asked for."""
        vegetation, vehicle = None, None
        if self.dit.config.label == "vegetation":
            vegetation = label
        elif self.dit.config.label == "vehicle":
            vehicle = label
        elif self.dit.config.label == "joint":
            vegetation, vehicle = label.split("-")
        return new_scene(
            f"generated-{run}-{seed}-{index:07d}",
            f"generated-{run}",
            str(seed),
            index,
            self.spec,
            vegetation_density=vegetation,
            vehicle_density=vehicle,
        )

    def label_tensor(self, labels: Sequence[str]) -> Tensor:
        return torch.tensor([label_index(self.dit.config.label, name) for name in labels], device=self.device)

    def sample_latents(
        self,
        labels: Sequence[str],
        seed: int,
        indices: Sequence[int],
        num_inference_steps: int = NUM_INFERENCE_STEPS,
        guidance_scale: float = 1.0,
        callback: Callable[[int, int], None] | None = None,
    ) -> Float[Tensor, "b c h w"]:
        """Latents of scenes `indices`; each depends on (seed, its index, its label) only."""
        walk = Walk(self.diffusion, num_inference_steps)
        noise = SceneNoise(seed, indices, self.lvae.latent_shape, self.device)
        model = guided(self.dit, self.dit.null_label, guidance_scale)
        return sample(model, walk, noise, self.label_tensor(labels), on_step=callback)

    def generate(
        self,
        labels: Sequence[str],
        seed: int = 0,
        indices: Sequence[int] | None = None,
        num_inference_steps: int = NUM_INFERENCE_STEPS,
        guidance_scale: float = 1.0,
        run: str = "run",
        callback: Callable[[int, int], None] | None = None,
    ) -> list[Scene]:
        """One Scene per label. Scene i depends on (seed, indices[i]) only, whatever the batch."""
        indices = range(len(labels)) if indices is None else indices
        latents = self.sample_latents(labels, seed, indices, num_inference_steps, guidance_scale, callback)
        identities = [self.identity(run, seed, index, label) for index, label in zip(indices, labels, strict=True)]
        return self.decode(latents, identities)

    __call__ = generate

    def complete(
        self,
        known: Known,
        labels: Sequence[str],
        seed: int,
        indices: Sequence[int],
        resampling: Resampling,
        guidance_scale: float = 1.0,
        callback: Callable[[int, int], None] | None = None,
        purpose: int = GENERATE,
    ) -> Float[Tensor, "b c h w"]:
        """RePaint: latents that keep `known` bit for bit where its mask is 0 (paper, Sec. 3.3)."""
        walk = Walk(self.diffusion, resampling.num_steps)
        transitions = repaint_transitions(resampling.num_steps, resampling.jump_length, resampling.resamplings)
        noise = SceneNoise(seed, indices, self.lvae.latent_shape, self.device, purpose)
        model = guided(self.dit, self.dit.null_label, guidance_scale)
        return sample(model, walk, noise, self.label_tensor(labels), transitions, known, callback)

    def outpaint(
        self,
        scene: Scene,
        label: str,
        seed: int = 0,
        index: int = 0,
        overlap: float = 0.5,
        mode: str = "reencode",
        resampling: Resampling | None = None,
        guidance_scale: float = 1.0,
        callback: Callable[[int, int], None] | None = None,
    ) -> Scene:
        """The scene extended to all sides: four sides in one batch, then four corners (paper, supplement B.3).

        `copy` hands each block the shifted latent, as the paper does; `reencode` hands it what is known so far as a
        Scene, moved into the block's frame and height datum, encoded anew: object latents hold absolute centres,
        which a copy leaves wrong. Returns a Scene on a grid (2 - overlap) + (1 - overlap) times as large, stitched by
        ownership: what stood first stays, an object belongs to the block that owns the pixel under its centre.
        """
        if mode not in ("copy", "reencode"):
            raise ValueError(f"outpainting mode {mode!r}, expected 'copy' or 'reencode'")
        canvas = OutpaintCanvas.around(scene, self.spec, self.encode, overlap)
        passes = (SIDES, CORNERS)
        for number, offsets in enumerate(passes):
            blocks = [canvas.block(offset, mode) for offset in offsets]
            known = Known(torch.stack([b.latent for b in blocks]), torch.stack([b.unknown for b in blocks]))

            def progress(done: int, total: int, number: int = number) -> None:
                if callback:
                    callback(number * total + done, len(passes) * total)

            draws = [8 * index + 4 * number + k for k in range(len(offsets))]
            latents = self.complete(
                known,
                [label] * len(offsets),
                seed,
                draws,
                resampling or Resampling(),
                guidance_scale,
                progress,
                OUTPAINT,
            )
            scenes = self.decode(latents, [replace(scene, grid=self.spec.grid)] * len(offsets))
            for offset, block, latent, generated in zip(offsets, blocks, latents, scenes, strict=True):
                canvas.paste(offset, latent, generated, block.datum_m)
        return canvas.scene
