"""Encode, decode and sample scenes with the networks of a pipeline."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from tqdm.auto import tqdm

from models.composition.attachments import decode_with_spare_poles, resolve_attachments
from models.composition.deduplicate import find_lower_confidence_duplicates
from models.composition.generator import StepCallback
from models.configured_pipeline import PAG_START, ConfiguredPipeline
from models.labels import FREE, find_label_index, split_label
from models.limits import require_within
from models.sampling.diffusion import (
    GENERATE,
    MAX_GUIDANCE_SCALE,
    Denoiser,
    InpaintCondition,
    OnStep,
    SamplingSchedule,
    SceneKey,
    SceneNoise,
    sample,
    sample_with_scheduler,
    scale_noise,
    switch_at_timestep,
    with_guidance,
    with_known,
)
from models.sampling.repaint import InpaintingConfig, TrainedInpainting
from models.scene import Scene
from models.tensors import make_empty_scene, make_layout_batch


def draw_seeds(
    generator: torch.Generator | Sequence[torch.Generator] | None, seed: int | Sequence[int], count: int
) -> list[int]:
    """Return one seed per scene.

    Args:
        generator: One generator per scene, or a single generator, which draws one common seed for all scenes. None:
            `seed` is used.
        seed: One seed for all scenes, or one per scene.
        count: Number of scenes.

    Returns:
        `count` seeds.

    Raises:
        ValueError: The number of generators is neither 1 nor `count`.
    """
    if generator is None:
        return [seed] * count if isinstance(seed, int) else list(seed)
    drawn = [
        int(torch.randint(2**31, (), generator=one, device=one.device))
        for one in ([generator] if isinstance(generator, torch.Generator) else generator)
    ]
    if len(drawn) not in (1, count):
        raise ValueError(f"{len(drawn)} generators for {count} scenes: expected one, or one per scene")
    return drawn * (count // len(drawn))


def _get_version(weight: Tensor) -> int:
    """Return a number that each change of a tensor in place raises. Tensors of the inference mode have none."""
    return 0 if weight.is_inference() else weight._version


class SamplingPipeline(ConfiguredPipeline):
    """Encode, decode and sample scenes; see `ConfiguredPipeline` for the arguments."""

    @contextmanager
    def _guide(
        self, model: Denoiser, timesteps: np.ndarray | Tensor, condition: InpaintCondition | None = None
    ) -> Iterator[Denoiser]:
        """Yield the denoiser with the guidance of the constraints, if any; log failures of the guidance at the end."""
        if self.guidance is None:
            yield model
            return
        before = self.guidance.report.fallbacks
        yield self.guidance.wrap(model, timesteps.tolist(), condition)
        self.guidance.warn_of_fallbacks(before)

    @torch.no_grad()
    def encode(self, scenes: Sequence[Scene]) -> Float[Tensor, "b c h w"]:
        """Encode scenes to posterior means, and normalise these means for the diffusion model.

        Args:
            scenes: Scenes that cover the area of the model's grid.

        Returns:
            Latents.
        """
        shift, scale = self._moments()
        return (self.lvae.encode(make_layout_batch(list(scenes), self.spec).to(self.device)).mean - shift) / scale

    @torch.no_grad()
    def decode(
        self,
        latents: Float[Tensor, "b c h w"],
        identities: Sequence[Scene],
        existence_threshold: float | None = None,
        deduplicate: bool = True,
        attach: bool | None = None,
        raster_px: int | None = None,
    ) -> list[Scene]:
        """Decode latents to scenes.

        By default, latents are decoded one at a time. Each scene is therefore bit-identical for any batch size. With
        `SamplingExecution.decode_batch_size`, scenes are equal up to rounding.

        Args:
            latents: Latents.
            identities: Scenes whose ids and labels are copied to the results.
            existence_threshold: Only primitives with a higher existence probability are kept; None: the threshold of
                the pipeline.
            deduplicate: A cell decoder may propose the same object in two cells. If True, only the proposal with the
                higher existence probability is kept.
            attach: Whether signs are attached to poles, walls and buildings, and poles are put on the ground
                (models/composition/attachments.py); None: the default of the pipeline. `attachments` counts the
                changes.
            raster_px: Number of rows and of columns of the rasters; None: that of the model's grid. Only models whose
                ground consists of level sets decode another resolution.

        Returns:
            One scene per latent.

        Raises:
            ValueError: The threshold is not between 0 and 1, a latent holds NaN or infinity, or the model has no level
                sets and `raster_px` is not its resolution.
        """
        threshold = self.resolve_existence_threshold(existence_threshold)
        shift, scale = self._moments()
        if not torch.isfinite(latents).all():  # Decoded, such a latent would give an empty scene.
            raise ValueError("a latent holds NaN or infinity: the weights of the model are damaged")
        attach = self.config.attach if attach is None else attach
        spec, parts = self.spec, latents.split(self.execution.decode_batch_size)
        if raster_px is not None:
            require_within("raster_pixels", raster_px**2 * len(spec.ground_classes), "raster_px")
            spec = spec.with_resolution(raster_px)
        layouts = [
            layout for part in parts for layout in self.lvae.decode(part * scale + shift, raster_px=raster_px).layouts()
        ]
        scenes = []
        for layout, identity in zip(layouts, identities, strict=True):
            scene, spare = decode_with_spare_poles(layout, spec, identity, threshold)
            if deduplicate and self.lvae.proposes_duplicates:
                scene = scene.select(~find_lower_confidence_duplicates(scene))
            scenes.append(resolve_attachments(scene, spare, spec.slab_offset_m, self.attachments) if attach else scene)
        return scenes

    def new_identity(self, run: str, seed: int, index: int, label: str) -> Scene:
        """Return an empty Scene that has the id and the labels of the generated scene.

        Args:
            run: Run name.
            seed: Seed of the run.
            index: Index of the scene within the run.
            label: Label of the scene.

        Returns:
            The empty scene.
        """
        vegetation, vehicle = split_label(self.dit.config.label, label)
        return make_empty_scene(
            f"generated-{run}-{seed}-{index:07d}",
            f"generated-{run}",
            str(seed),
            index,
            self.spec,
            vegetation_density=vegetation,
            vehicle_density=vehicle,
            free_pose=label.endswith(FREE),
        )

    def label_tensor(self, labels: Sequence[str]) -> Tensor:
        """Convert labels to class indices.

        Args:
            labels: Names of labels.

        Returns:
            (b,) class indices.

        Raises:
            ValueError: A label is unknown to the model, or `labels` is empty or one string.
        """
        if isinstance(labels, str) or not len(labels):
            raise ValueError(f"labels is {labels!r}, expected a list with one label per scene")
        return torch.tensor([find_label_index(self.dit.config.label, name) for name in labels], device=self.device)

    def make_denoiser(
        self,
        timesteps: np.ndarray | Tensor,
        label: Int[Tensor, " b"],
        guidance_scale: float = 1.0,
        pag_scale: float | None = None,
    ) -> Denoiser:
        """Return the DiT with guidance and precomputed modulations, run as `set_execution` says.

        Perturbed-attention guidance applies to the conditional and to the unconditional noise, and only to timesteps
        from PAG_START on (a limited interval; Kynkäänniemi et al., NeurIPS 2024).

        The last denoiser is kept for batches with the same timesteps, so they share a CUDA graph. It is made again if a
        batch has a new label, or if weights change; changes through `weight.data` are not noticed.

        Args:
            timesteps: All timesteps that the denoiser will receive.
            label: Class index of each scene.
            guidance_scale: Scale of classifier-free guidance; 1 switches guidance off.
            pag_scale: Scale of perturbed-attention guidance; None: the scale of `use_pag`.

        Returns:
            Function that maps latents (b, c, h, w), timesteps (b,) and labels (b,) to noise.

        Raises:
            ValueError: The guidance scale is out of range.
        """
        if not 0 <= guidance_scale <= MAX_GUIDANCE_SCALE:
            raise ValueError(
                f"guidance_scale is {guidance_scale}, expected 0 to {MAX_GUIDANCE_SCALE:g}; 1 switches the guidance off"
            )
        pag_scale = self.pag_scale if pag_scale is None else pag_scale
        null, drops = self.dit.null_label, self.config.pag_drops_label
        labels = {*label.tolist()} if guidance_scale == 1.0 else {*label.tolist(), null}
        weights = tuple((weight.data_ptr(), _get_version(weight)) for weight in self.dit.parameters())
        key = tuple(sorted({*timesteps.tolist()})), guidance_scale, pag_scale, drops, self.execution, weights
        if self._denoiser is not None and self._denoiser[0] == key:
            if labels <= self._denoiser[1]:
                return self._denoiser[2]
            labels |= self._denoiser[1]
        self._denoiser = None  # Free the old graph before the next capture.

        def build(steps: list[int], scale: float) -> Denoiser:
            with self.execution.autocast(self.device):
                model = self.dit.precompute_conditioning(steps, labels, scale, drops)
            return self.execution.wrap(with_guidance(model, null, guidance_scale), self.device)

        start = PAG_START * self.diffusion.num_timesteps if pag_scale else float("inf")
        guided, plain = ([int(t) for t in timesteps if (t >= start) == side] for side in (True, False))
        if not guided or not plain:
            model = build(guided or plain, pag_scale if guided else 0.0)
        else:
            model = switch_at_timestep(start, build(guided, pag_scale), build(plain, 0.0))
        self._denoiser = key, labels, model
        return model

    @contextmanager
    def _step_callback(self, num_evaluations: int, callback: StepCallback | None) -> Iterator[OnStep]:
        """Yield a function for the sampler to call after each step.

        The function advances the progress bar and calls the user's callback.
        """
        with tqdm(total=num_evaluations, **self._progress_bar) as bar:

            def on_step(number: int, timestep: int, latents: Tensor) -> Tensor:
                bar.update()
                return callback(self, number, timestep, {"latents": latents})["latents"] if callback else latents

            yield on_step

    def sample_latents(
        self,
        labels: Sequence[str],
        seed: int | Sequence[int],
        indices: Sequence[SceneKey],
        num_inference_steps: int | None = None,
        guidance_scale: float = 1.0,
        callback_on_step_end: StepCallback | None = None,
        noise_scaling: float | None = None,
        purpose: int = GENERATE,
        condition: InpaintCondition | None = None,
        known_guidance_scale: float = 1.0,
        pag_factor: float = 1.0,
    ) -> Float[Tensor, "b c h w"]:
        """Sample latents. Each latent depends only on the seed, its index, its label and its condition.

        Args:
            labels: Label of each scene.
            seed: One seed for all scenes, or one per scene.
            indices: Index of each scene within the run, or another key; the noise depends on the seed and this key.
            num_inference_steps: Number of denoising steps; None: the default of the pipeline.
            guidance_scale: Scale of classifier-free guidance; 1 switches guidance off.
            callback_on_step_end: See `generate`.
            noise_scaling: Divisor of the predicted noise; None: the default of the pipeline.
            purpose: Purpose of the noise: GENERATE, OUTPAINT or INPAINT (models/sampling/diffusion.py).
            condition: Known part of the latents, which an inpainting network continues.
            known_guidance_scale: Scale of guidance by the known part; 1 switches this guidance off.
            pag_factor: Factor of the scale of perturbed-attention guidance.

        Returns:
            Latents.

        Raises:
            ValueError: A label is unknown, a number is out of range, the scheduler uses fractional timesteps, or the
                network cannot read a known part.
        """
        noise = SceneNoise(seed, indices, self.latent_shape, self.device, purpose)
        label, noise_scaling = self.label_tensor(labels), self.resolve_noise_scaling(noise_scaling)
        steps: int = self.config.num_inference_steps if num_inference_steps is None else num_inference_steps
        timesteps = self._select_timesteps(steps)
        pag_scale = self.pag_scale * pag_factor
        model = scale_noise(self.make_denoiser(timesteps, label, guidance_scale, pag_scale), noise_scaling)
        if condition is not None:
            model = with_known(model, condition, self.diffusion, known_guidance_scale)
        with (
            self._step_callback(steps, callback_on_step_end) as on_step,
            self._guide(model, timesteps, condition) as guided,
        ):
            if self.uses_ddpm:
                latents = sample(guided, SamplingSchedule(self.diffusion, steps), noise, label, on_step=on_step)
            else:
                latents = sample_with_scheduler(guided, self.scheduler, noise, label, on_step)
        return latents if condition is None else torch.where(condition.mask.bool(), latents, condition.latent)

    def _select_timesteps(self, num_inference_steps: int) -> np.ndarray | Tensor:
        """Return the timesteps of the sampler, and prepare the scheduler of diffusers for them."""
        # Raise an error for an invalid number of steps; diffusers would accept it.
        timesteps = self.diffusion.select_timesteps(num_inference_steps)
        if self.uses_ddpm:
            return timesteps
        self.scheduler.set_timesteps(num_inference_steps, device=self.device)
        if self.scheduler.timesteps.is_floating_point():
            raise ValueError(
                f"{self.scheduler_config.class_name} uses fractional timesteps, which the DiT does not support; "
                "use DPM-Solver++ or DDIM"
            )
        return self.scheduler.timesteps

    def generate(
        self,
        labels: Sequence[str],
        seed: int = 0,
        indices: Sequence[int] | None = None,
        num_inference_steps: int | None = None,
        guidance_scale: float = 1.0,
        run: str = "run",
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
        callback_on_step_end: StepCallback | None = None,
        noise_scaling: float | None = None,
        existence_threshold: float | None = None,
    ) -> list[Scene]:
        """Generate one Scene per label.

        Scene i depends only on the seed, indices[i] and labels[i], but not on the other scenes of the batch.

        Args:
            labels: Label of each scene, such as "low-medium".
            seed: Seed of the run.
            indices: Index of each scene within the run (default: 0, 1, ...).
            num_inference_steps: Number of denoising steps; None: the default of the pipeline.
            guidance_scale: Scale of classifier-free guidance; 1 switches guidance off.
            run: Run name; it is part of the scene ids.
            generator: One generator for all scenes, or one per scene. None: `seed` is used; otherwise, `seed` is
                ignored.
            callback_on_step_end: Function f(pipeline, step, timestep, {"latents": ...}), called after each step. The
                function returns a dictionary {"latents": ...} for the next step.
            noise_scaling: Divisor of the predicted noise; None: the default of the pipeline.
            existence_threshold: Only primitives with a higher existence probability are kept; None: the threshold of
                the pipeline.

        Returns:
            The scenes in the order of the labels.

        Raises:
            ValueError: A label is unknown or a number is out of range.
        """
        indices = range(len(labels)) if indices is None else indices
        seeds = draw_seeds(generator, seed, len(labels))
        latents = self.sample_latents(
            labels, seeds, indices, num_inference_steps, guidance_scale, callback_on_step_end, noise_scaling
        )
        scenes = zip(seeds, indices, labels, strict=True)
        return self.decode(latents, [self.new_identity(run, *scene) for scene in scenes], existence_threshold)

    __call__ = generate

    def inpaint_latents(
        self,
        condition: InpaintCondition,
        labels: Sequence[str],
        seed: int | Sequence[int],
        indices: Sequence[SceneKey],
        repaint: InpaintingConfig | None = None,
        guidance_scale: float = 1.0,
        callback_on_step_end: StepCallback | None = None,
        purpose: int = GENERATE,
    ) -> Float[Tensor, "b c h w"]:
        """Sample latents with RePaint (paper, Sec. 3.3), or with an inpainting network.

        Where the mask of the condition is 0, the latents are bit-identical to the condition.

        Args:
            condition: Known latents and masks.
            labels: Label of each scene.
            seed: One seed for all scenes, or one per scene.
            indices: Key of each scene; the noise depends on the seed and this key.
            repaint: Options of inpainting; None: see `resolve_inpainting`.
            guidance_scale: Scale of classifier-free guidance; 1 switches guidance off.
            callback_on_step_end: See `generate`.
            purpose: Purpose of the noise: GENERATE, OUTPAINT or INPAINT (models/sampling/diffusion.py).

        Returns:
            Latents.

        Raises:
            ValueError: A label is unknown, a number is out of range, or the network cannot read a known part.
        """
        repaint = self.resolve_inpainting(repaint)
        if isinstance(repaint, TrainedInpainting):
            return self.sample_latents(
                labels,
                seed,
                indices,
                repaint.num_inference_steps,
                guidance_scale,
                callback_on_step_end,
                purpose=purpose,
                condition=condition,
                known_guidance_scale=repaint.known_guidance_scale,
                pag_factor=1.0 if repaint.pag_factor is None else repaint.pag_factor,
            )
        schedule = SamplingSchedule(self.diffusion, repaint.num_inference_steps, repaint.eta)
        noise = SceneNoise(seed, indices, self.latent_shape, self.device, purpose)
        label = self.label_tensor(labels)
        scaling = 1.0 if repaint.eta == 1 else self.config.noise_scaling
        # Perturbed-attention guidance would add too many objects (docs/experiments/town2_weights.md, Outpainting).
        model = scale_noise(self.make_denoiser(schedule.timesteps, label, guidance_scale, 0.0), scaling)
        with (
            self._step_callback(repaint.num_evaluations, callback_on_step_end) as on_step,
            self._guide(model, schedule.timesteps, condition) as guided,
        ):
            return sample(
                guided,
                schedule,
                noise,
                label,
                repaint.transitions(),
                condition,
                on_step,
                repaint.pseudoinverse_guidance,
            )
