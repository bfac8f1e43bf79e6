"""PrITTIPipeline: LVAE and DiT as one object in diffusers' conventions; labels and seeds in, Scenes out. No Ray."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import torch
from diffusers import DDIMScheduler, DDPMScheduler, DiffusionPipeline, DPMSolverMultistepScheduler, SchedulerMixin
from jaxtyping import Float
from torch import Tensor

from models.composition.deduplicate import repeated
from models.composition.inpaint import Contents, composited, latent_mask, whole_cells
from models.composition.outpaint import Block, Lattice, Place, World, height_near
from models.dit import DiT
from models.labels import label_index
from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.pretrained import pipeline_path
from models.sampling.diffusion import (
    GENERATE,
    INPAINT,
    OUTPAINT,
    Denoiser,
    Diffusion,
    Key,
    Known,
    OnStep,
    SceneNoise,
    Walk,
    guided,
    rescaled,
    sample,
    solve,
)
from models.sampling.repaint import JUMP_LENGTH, RESAMPLINGS, repaint_transitions
from models.scene import Scene
from models.tensors import EXISTENCE_THRESHOLD, layout_batch, new_scene, scene_from_layout

NUM_INFERENCE_STEPS = 250  # paper, supplement B.3

# The paper's, and others for fewer steps: diffusers' class and its options. Steps even in the log of signal to noise: on a
# Gaussian of a tenth of the latent's deviation, 20 of them keep 93 % of it, 20 even in time 31 %.
SAMPLERS = {
    "ddpm": (DDPMScheduler, {"timestep_spacing": "leading"}),
    "ddim": (DDIMScheduler, {"timestep_spacing": "leading"}),
    "dpm++": (DPMSolverMultistepScheduler, {"use_lu_lambdas": True, "algorithm_type": "dpmsolver++"}),
    "sde-dpm++": (DPMSolverMultistepScheduler, {"use_lu_lambdas": True, "algorithm_type": "sde-dpmsolver++"}),
}
StepCallback = Callable[[DiffusionPipeline, int, int, dict], dict]  # diffusers' callback_on_step_end


def seeds_of(generator: torch.Generator | Sequence[torch.Generator] | None, seed: int, count: int) -> list[int]:
    """A seed per scene: `seed` without a generator, else what one draws for all, or each for its scene."""
    if generator is None:
        return [seed] * count
    drawn = [
        int(torch.randint(2**31, (), generator=one, device=one.device))
        for one in ([generator] if isinstance(generator, torch.Generator) else generator)
    ]
    if len(drawn) not in (1, count):
        raise ValueError(f"{len(drawn)} generators for {count} scenes: expected one, or one per scene")
    return drawn * (count // len(drawn))


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


def require_scaling(noise_scaling: float) -> float:
    """The same number. Raises ValueError for one that is not near 1."""
    if not 0.9 <= noise_scaling <= 1.1:
        raise ValueError(f"noise_scaling is {noise_scaling}, expected 1 (none) or a little more, up to 1.1")
    return noise_scaling


@dataclass(frozen=True)
class Resampling:
    """How inpainting walks: RePaint's roll-back and resamplings over `num_steps` visited timesteps; default: the paper's.

    `known_guidance`: how strongly what is made is drawn to what is known (diffusion.explaining); 0 is not at all. `eta`: how
    much noise steps add (diffusion.Walk); of few steps with noise small objects get lost.
    """

    num_steps: int = NUM_INFERENCE_STEPS
    jump_length: int = JUMP_LENGTH
    resamplings: int = RESAMPLINGS
    known_guidance: float = 0.0
    eta: float = 1.0

    @classmethod
    def guided(cls, num_steps: int = 50) -> Resampling:
        """Ours: joins better than the paper's and keeps more objects, for a twenty-fourth of the work (BENCHMARKS.md)."""
        return cls(num_steps, resamplings=1, known_guidance=1.0, eta=0.3)

    def __post_init__(self) -> None:
        if not 0 <= self.eta <= 1:
            raise ValueError(f"eta is {self.eta}, expected 0 (steps add no noise) to 1 (the paper)")
        if not 0 <= self.known_guidance < math.inf:
            raise ValueError(f"known_guidance is {self.known_guidance}, expected 0 (none) or more; 1 is its weight")

    def transitions(self) -> list[tuple[int, int]]:
        return repaint_transitions(self.num_steps, self.jump_length, self.resamplings)

    @property
    def evaluations(self) -> int:
        """How often the network is asked."""
        return sum(to < state for state, to in self.transitions())


class PrITTIPipeline(DiffusionPipeline):
    """Generates Scenes. `from_pretrained(directory)` and `save_pretrained(directory)` as in diffusers.

    `noise_scaling` is what all samplers but the paper's divide the network's noise by (diffusion.rescaled); not in the paper.
    Primitives whose existence is above `existence_threshold` are in a scene; 0.3 in the paper.
    """

    def __init__(
        self,
        lvae: LayoutVAE,
        dit: DiT,
        scheduler: SchedulerMixin,
        noise_scaling: float = 1.0,
        existence_threshold: float = EXISTENCE_THRESHOLD,
    ) -> None:
        super().__init__()
        self.register_modules(lvae=lvae, dit=dit, scheduler=scheduler)
        self.register_to_config(noise_scaling=noise_scaling, existence_threshold=existence_threshold)
        self.lvae.eval().requires_grad_(False)
        self.dit.eval().requires_grad_(False)
        if dit.config.layout is not None:
            self.spec.require(LayoutSpec.from_dict(dit.config.layout), "the DiT")

    @classmethod
    def from_pretrained(cls, directory: str, **options) -> PrITTIPipeline:
        """A pipeline from a directory that `save_pretrained` or jobs/train_dit.py wrote, or by the name of released weights.

        "town" comes with the package (models/pretrained.py); nothing is ever fetched. Raises ValueError for what is neither.
        """
        return super().from_pretrained(pipeline_path(directory), **{"low_cpu_mem_usage": False} | options)

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
        self, latents: Float[Tensor, "b c h w"], identities: Sequence[Scene], existence_threshold: float | None = None
    ) -> list[Scene]:
        """Scenes from latents; ids and labels from `identities`. Latents are decoded one by one.

        One at a time on purpose: the scene is then the same to the last bit whatever stood beside it. Where every cell
        decodes by itself, two of them may claim one object: the surer stays (duplicates.repeated).
        """
        threshold = self.threshold(existence_threshold)
        shift, scale = self._moments()
        layouts = [self.lvae.decode(latent[None] * scale + shift).layouts()[0] for latent in latents]
        scenes = [
            scene_from_layout(layout, self.spec, identity, threshold)
            for layout, identity in zip(layouts, identities, strict=True)
        ]
        if self.lvae.config.decoder != "cells":
            return scenes
        return [scene.select(~repeated(scene)) for scene in scenes]

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

    def _denoiser(self, timesteps: np.ndarray | Tensor, label: Tensor, guidance_scale: float) -> Denoiser:
        """The DiT, guided, with all that does not depend on the latent computed."""
        null = self.dit.null_label
        labels = label.tolist() if guidance_scale == 1.0 else [*label.tolist(), null]
        return guided(self.dit.prepared(timesteps.tolist(), labels), null, guidance_scale)

    def use_sampler(self, name: str) -> None:
        """Sample by one of SAMPLERS from now on: "ddpm" is the paper's; another of diffusers' may be set as `scheduler`."""
        if name not in SAMPLERS:
            raise ValueError(f"sampler {name!r} is unknown, expected one of: {', '.join(SAMPLERS)}")
        kind, changes = SAMPLERS[name]
        self.scheduler = kind.from_config(self.scheduler.config, **changes)

    def scaling(self, noise_scaling: float | None) -> float:
        """The number given, or the pipeline's own with its present sampler. Raises ValueError for one that is not near 1."""
        if noise_scaling is None:
            return 1.0 if isinstance(self.scheduler, DDPMScheduler) else self.config.noise_scaling
        return require_scaling(noise_scaling)

    def threshold(self, existence_threshold: float | None) -> float:
        """The number given, or the pipeline's own. Raises ValueError for one that is no probability."""
        if existence_threshold is None:
            return self.config.existence_threshold
        if not 0 < existence_threshold < 1:
            raise ValueError(f"existence_threshold is {existence_threshold}, expected between 0 and 1")
        return existence_threshold

    @contextmanager
    def _watched(self, evaluations: int, callback: StepCallback | None) -> Iterator[OnStep]:
        """What a sampler calls after each evaluation of the model: moves a progress bar, then calls the user's."""
        with self.progress_bar(total=evaluations) as bar:

            def on_step(number: int, timestep: int, latents: Tensor) -> Tensor:
                bar.update()
                return callback(self, number, timestep, {"latents": latents})["latents"] if callback else latents

            yield on_step

    def sample_latents(
        self,
        labels: Sequence[str],
        seed: int | Sequence[int],
        indices: Sequence[int],
        num_inference_steps: int = NUM_INFERENCE_STEPS,
        guidance_scale: float = 1.0,
        callback_on_step_end: StepCallback | None = None,
        noise_scaling: float | None = None,
    ) -> Float[Tensor, "b c h w"]:
        """Latents of scenes `indices`; each depends on (seed, its index, its label) only."""
        noise = SceneNoise(seed, indices, self.lvae.latent_shape, self.device)
        label, noise_scaling = self.label_tensor(labels), self.scaling(noise_scaling)
        with self._watched(num_inference_steps, callback_on_step_end) as on_step:
            if isinstance(self.scheduler, DDPMScheduler):
                walk = Walk(self.diffusion, num_inference_steps)
                model = rescaled(self._denoiser(walk.timesteps, label, guidance_scale), noise_scaling)
                return sample(model, walk, noise, label, on_step=on_step)
            self.diffusion.visited(num_inference_steps)  # diffusers would take any number
            self.scheduler.set_timesteps(num_inference_steps, device=self.device)
            if self.scheduler.timesteps.is_floating_point():
                raise ValueError(
                    f"{type(self.scheduler).__name__} has timesteps between whole ones: DPM-Solver++ and DDIM have not"
                )
            model = rescaled(self._denoiser(self.scheduler.timesteps, label, guidance_scale), noise_scaling)
            return solve(model, self.scheduler, noise, label, on_step)

    def generate(
        self,
        labels: Sequence[str],
        seed: int = 0,
        indices: Sequence[int] | None = None,
        num_inference_steps: int = NUM_INFERENCE_STEPS,
        guidance_scale: float = 1.0,
        run: str = "run",
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
        callback_on_step_end: StepCallback | None = None,
        noise_scaling: float | None = None,
        existence_threshold: float | None = None,
    ) -> list[Scene]:
        """One Scene per label. Scene i depends on (seed, indices[i], its label) only, whatever the batch.

        A `generator` draws the seed, one per scene their seeds. `callback_on_step_end(pipeline, step, timestep,
        {"latents": ...})` returns such a dict, as in diffusers. `noise_scaling`, `existence_threshold`: instead of the pipeline's own.
        """
        indices = range(len(labels)) if indices is None else indices
        seeds = seeds_of(generator, seed, len(labels))
        latents = self.sample_latents(
            labels, seeds, indices, num_inference_steps, guidance_scale, callback_on_step_end, noise_scaling
        )
        scenes = zip(seeds, indices, labels, strict=True)
        return self.decode(latents, [self.identity(run, *scene) for scene in scenes], existence_threshold)

    __call__ = generate

    def complete(
        self,
        known: Known,
        labels: Sequence[str],
        seed: int | Sequence[int],
        indices: Sequence[Key],
        resampling: Resampling,
        guidance_scale: float = 1.0,
        callback_on_step_end: StepCallback | None = None,
        purpose: int = GENERATE,
    ) -> Float[Tensor, "b c h w"]:
        """RePaint: latents that keep `known` bit for bit where its mask is 0 (paper, Sec. 3.3)."""
        walk = Walk(self.diffusion, resampling.num_steps, resampling.eta)
        transitions = resampling.transitions()
        noise = SceneNoise(seed, indices, self.lvae.latent_shape, self.device, purpose)
        label = self.label_tensor(labels)
        scaling = 1.0 if resampling.eta == 1 else self.config.noise_scaling
        model = rescaled(self._denoiser(walk.timesteps, label, guidance_scale), scaling)
        with self._watched(resampling.evaluations, callback_on_step_end) as on_step:
            return sample(model, walk, noise, label, transitions, known, on_step, resampling.known_guidance)

    def inpaint(
        self,
        scenes: Sequence[Scene],
        regions: Sequence[np.ndarray],
        labels: Sequence[str],
        contents: Contents = "both",
        seed: int = 0,
        indices: Sequence[int] | None = None,
        resampling: Resampling | None = None,
        guidance_scale: float = 1.0,
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
        callback_on_step_end: StepCallback | None = None,
        composite: bool = True,
    ) -> list[Scene]:
        """Scenes made anew inside their regions (inpaint.py), in whole latent cells (paper, Sec. 3.3).

        "objects" alone puts objects on the given ground; "ground" alone, ground under the given objects. The rest is the
        input's; without `composite` it is what the decoders make of the known latent. Raises ValueError for scenes that
        are not on the model's grid, or for a model whose latent is not split if contents are not "both".
        """
        indices = range(len(scenes)) if indices is None else indices
        for scene in scenes:
            self.require_grid(scene)
        if contents != "both" and not self.lvae.config.split_latent:
            raise ValueError(f"this model's latent mixes ground and objects: {contents} cannot be made anew alone")
        shape = self.lvae.latent_shape
        mask = latent_mask(regions, shape, contents).to(self.device)
        seeds = seeds_of(generator, seed, len(scenes))
        known = Known(self.encode(scenes), mask)
        latents = self.complete(
            known, labels, seeds, indices, resampling or Resampling(), guidance_scale, callback_on_step_end, INPAINT
        )
        made = self.decode(latents, scenes)
        if not composite:
            return made
        return [
            composited(scene, one, whole_cells(region, scene.grid, shape[-1]), contents)
            for scene, one, region in zip(scenes, made, regions, strict=True)
        ]

    def extend(
        self,
        world: World,
        places: Sequence[Place],
        made: Mapping[Place, Block],
        like: Scene,
        label: str | Mapping[Place, str],
        seed: int = 0,
        index: int = 0,
        mode: str = "reencode",
        resampling: Resampling | None = None,
        guidance_scale: float = 1.0,
        callback_on_step_end: StepCallback | None = None,
    ) -> dict[Place, Block]:
        """Blocks of a world, all in one batch, that know those made before; ids from `like`, noise from seed, index, place.

        Raises KeyError for a place without a label, or one whose earlier neighbours are not all made.
        """
        if mode not in ("copy", "reencode"):
            raise ValueError(f"outpainting mode {mode!r}, expected 'copy' or 'reencode'")
        empty = new_scene(like.scene_id, like.source, like.sequence, like.frame, self.spec)
        tasks = [world.task(place, made, empty, mode) for place in places]
        known = Known(torch.stack([task.latent for task in tasks]), torch.stack([task.unknown for task in tasks]))
        resampling = resampling or Resampling()
        if not any(task.knows for task in tasks):  # nothing to harmonise with
            resampling = replace(resampling, resamplings=1, known_guidance=0.0)
        latents = self.complete(
            known,
            [label if isinstance(label, str) else label[place] for place in places],
            seed,
            [(index, *place) for place in places],
            resampling,
            guidance_scale,
            callback_on_step_end,
            OUTPAINT,
        )
        scenes = self.decode(latents, [empty] * len(places))
        parts = zip(places, tasks, latents, scenes, strict=True)
        return {place: world.block(task, latent, scene) for place, task, latent, scene in parts}

    def outpaint(
        self,
        scene: Scene,
        label: str | Mapping[Place, str],
        seed: int = 0,
        index: int = 0,
        overlap: float = 0.5,
        mode: str = "reencode",
        last: tuple[int, int, int, int] = (1, 1, 1, 1),
        resampling: Resampling | None = None,
        guidance_scale: float = 1.0,
        callback_on_step_end: StepCallback | None = None,
    ) -> Scene:
        """The scene extended by blocks ahead, behind, left and right, `last` of each (outpaint.py).

        One to every side is the paper's outpainting: four sides in one batch, then four corners (supplement B.3). `copy`
        hands each block the shifted latent, as the paper does; `reencode` hands it what is known so far as a Scene, moved
        into the block's frame and height datum, encoded anew: object latents hold absolute centres, which a copy leaves
        wrong. `label` is one for all blocks or a mapping from (steps ahead, steps left). Raises ValueError for a scene
        that is not on the model's grid, or an overlap between two cells.
        """
        self.require_grid(scene)
        lattice = Lattice.of(self.lvae.latent_shape[-1], overlap, last=last)
        world = World(lattice, self.spec, self.encode, height_near(scene, 0.0, 0.0))
        made = {(0, 0): Block(scene, self.encode([scene])[0])}
        for front in lattice.fronts(place for place in lattice.places() if place not in made):
            made |= self.extend(
                world, front, made, scene, label, seed, index, mode, resampling, guidance_scale, callback_on_step_end
            )
        return world.stitched(made, scene)

    def require_grid(self, scene: Scene) -> None:
        """Raises ValueError for a scene that is not on the model's grid, with its ground classes."""
        if scene.grid != self.spec.grid or scene.ground_classes != self.spec.ground_classes:
            raise ValueError(
                f"scene {scene.scene_id} has {scene.grid} and ground classes {scene.ground_classes}; "
                f"the model needs {self.spec.grid} and {self.spec.ground_classes}"
            )
