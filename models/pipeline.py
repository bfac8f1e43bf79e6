"""PrITTIPipeline: LVAE and DiT as one object in diffusers' conventions; labels and seeds in, Scenes out. No Ray."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from diffusers import DDPMScheduler, DiffusionPipeline
from jaxtyping import Float
from torch import Tensor

from models.diffusion import Diffusion, Known, SceneNoise, Walk, guided, sample
from models.dit import DiT
from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.repaint import CORNERS, SIDES, repaint_transitions
from models.scene import DENSITIES, Scene, merge
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
    jump_length: int = 10
    resamplings: int = 10


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
    ) -> Float[Tensor, "b c h w"]:
        """RePaint: latents that keep `known` bit for bit where its mask is 0 (paper, Sec. 3.3)."""
        walk = Walk(self.diffusion, resampling.num_steps)
        transitions = repaint_transitions(resampling.num_steps, resampling.jump_length, resampling.resamplings)
        noise = SceneNoise(seed, indices, self.lvae.latent_shape, self.device)
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
        canvas = OutpaintCanvas.around(self, scene, overlap)
        passes = (SIDES, CORNERS)
        for number, offsets in enumerate(passes):
            blocks = [canvas.block(offset, mode) for offset in offsets]
            known = Known(torch.stack([b.latent for b in blocks]), torch.stack([b.unknown for b in blocks]))

            def progress(done: int, total: int, number: int = number) -> None:
                if callback:
                    callback(number * total + done, len(passes) * total)

            draws = [8 * index + 4 * number + k for k in range(len(offsets))]
            latents = self.complete(
                known, [label] * len(offsets), seed, draws, resampling or Resampling(), guidance_scale, progress
            )
            scenes = self.decode(latents, [replace(scene, grid=self.spec.grid)] * len(offsets))
            for offset, block, latent, generated in zip(offsets, blocks, latents, scenes, strict=True):
                canvas.paste(offset, latent, generated, block.datum_m)
        return canvas.scene


@dataclass(frozen=True, eq=False)
class OutpaintBlock:
    """What a block to be generated knows: latent (c, h, w), unknown (c, h, w) = 1 to generate, height datum."""

    latent: Tensor
    unknown: Tensor
    datum_m: float


class OutpaintCanvas:
    """A growing scene and its latents on a cell grid around one first block.

    Offsets are (forward, left) in block steps; a step is (1 - overlap) of a block.
    """

    def __init__(self, pipeline: PrITTIPipeline, scene: Scene, latent: Tensor, owned: np.ndarray, step: int) -> None:
        self.pipeline, self.scene, self.latent, self.owned, self.step = pipeline, scene, latent, owned, step
        self.size = pipeline.lvae.latent_shape[1]
        self.pixels_per_cell = pipeline.spec.grid.rows // self.size
        self.origin_height_m = self.height_near(0.0, 0.0)

    @classmethod
    def around(cls, pipeline: PrITTIPipeline, scene: Scene, overlap: float) -> OutpaintCanvas:
        channels, size, _ = pipeline.lvae.latent_shape
        step = round(size * (1 - overlap))
        if not 0 < step < size or abs(step - size * (1 - overlap)) > 1e-6:
            raise ValueError(f"overlap {overlap} is not a whole number of the {size} latent cells between 0 and 1")
        grid = pipeline.spec.grid
        if scene.grid != grid:
            raise ValueError(f"scene {scene.scene_id} has grid {scene.grid}, the model needs {grid}")
        margin_m = step * grid.rows // size * grid.resolution_m
        pad = 2 * step * grid.rows // size
        large = replace(
            grid,
            front_m=grid.front_m + margin_m,
            left_m=grid.left_m + margin_m,
            rows=grid.rows + pad,
            cols=grid.cols + pad,
        )
        middle = slice(step, step + size)
        latent = torch.zeros(channels, size + 2 * step, size + 2 * step, device=pipeline.device)
        latent[:, middle, middle] = pipeline.encode([scene])[0]
        owned = np.zeros(latent.shape[1:], bool)
        owned[middle, middle] = True
        return cls(pipeline, scene.cropped(large), latent, owned, step)

    def cells(self, offset: tuple[int, int]) -> tuple[slice, slice]:
        """Rows and columns of the canvas that a block covers."""
        forward, left = offset
        row, col = self.step * (1 - forward), self.step * (1 - left)
        return slice(row, row + self.size), slice(col, col + self.size)

    def shift_m(self, offset: tuple[int, int]) -> tuple[float, float]:
        """Position of a block's origin in the canvas frame."""
        meters = self.step * self.pixels_per_cell * self.scene.grid.resolution_m
        return offset[0] * meters, offset[1] * meters

    def height_near(self, x_m: float, y_m: float) -> float:
        """Height of the known fused surface at the occupied pixel nearest to a point; 0 if there is none."""
        height, ground_class = self.scene.surface()
        row, col = np.nonzero(ground_class >= 0)
        if len(row) == 0:
            return 0.0
        x, y = self.scene.grid.x_m()[row], self.scene.grid.y_m()[col]
        nearest = ((x - x_m) ** 2 + (y - y_m) ** 2).argmin()
        return float(height[row[nearest], col[nearest]])

    def block(self, offset: tuple[int, int], mode: str) -> OutpaintBlock:
        """What is known of a block before it is generated."""
        rows, cols = self.cells(offset)
        latent = self.latent[:, rows, cols]
        unknown = torch.from_numpy(~self.owned[rows, cols]).to(latent).expand_as(latent)
        if mode == "copy":
            return OutpaintBlock(latent, unknown, 0.0)
        x, y = self.shift_m(offset)
        datum = self.height_near(x, y) - self.origin_height_m
        grid = self.pipeline.spec.grid
        there = replace(grid, front_m=grid.front_m + x, left_m=grid.left_m + y)
        scene = replace(self.scene.cropped(there).moved(-x, -y, -datum), grid=grid)
        return OutpaintBlock(self.pipeline.encode([scene])[0], unknown, datum)

    def paste(self, offset: tuple[int, int], latent: Tensor, generated: Scene, datum_m: float) -> None:
        """Take from a generated block what nobody owns yet."""
        rows, cols = self.cells(offset)
        new = np.zeros_like(self.owned)
        new[rows, cols] = ~self.owned[rows, cols]
        mask = torch.from_numpy(new[rows, cols]).to(latent.device)
        self.latent[:, rows, cols] = torch.where(mask, latent, self.latent[:, rows, cols])
        x, y = self.shift_m(offset)
        moved = generated.moved(x, y, datum_m).cropped(self.scene.grid)
        self.owned |= new

        def pixels(cells: np.ndarray) -> np.ndarray:
            return cells.repeat(self.pixels_per_cell, axis=0).repeat(self.pixels_per_cell, axis=1)

        self.scene = merge([self.scene, moved], [pixels(self.owned & ~new), pixels(new)], self.scene)
