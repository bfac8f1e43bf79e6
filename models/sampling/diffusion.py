"""Denoising diffusion on layout latents (paper, supplement B.3): noise schedule and samplers.

Sampling uses a subset of the timesteps. A latent in state i has the noise level of timestep `timesteps[i]`; a latent in
state -1 has no noise. Sampling proceeds through the states n-1, n-2, ..., 0, -1. RePaint adds jumps back to noisier
states (repaint.py).
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

Denoiser = Callable[[Tensor, Tensor, Tensor], Tensor]  # Maps latent, timestep (b,) and label (b,) to noise.
SceneKey = int | tuple[int, ...]  # Index of a scene, or several integers that identify the scene.
OnStep = Callable[[int, int, Tensor], Tensor]  # Maps step, timestep and latent to the next latent.
MAX_GUIDANCE_SCALE = 100.0
KNOWN_GUIDANCE_START = 0.3  # Lowest timestep with guidance by the known part, as a share of the number of timesteps.


@dataclass(frozen=True)
class Diffusion:
    """DDPM with a linear variance schedule; the defaults are those of the paper (supplement B.3).

    Attributes:
        num_timesteps: Number T of training timesteps.
        beta_start: Variance of the first timestep.
        beta_end: Variance of the last timestep.
    """

    num_timesteps: int = 1000
    beta_start: float = 0.0015
    beta_end: float = 0.015

    @cached_property
    def alpha_bar(self) -> np.ndarray:
        """(T,) float64 cumulative product of 1 - beta_t."""
        return np.cumprod(1 - np.linspace(self.beta_start, self.beta_end, self.num_timesteps, dtype=np.float64))

    def select_timesteps(self, num_inference_steps: int) -> np.ndarray:
        """Select ascending timesteps with "leading" spacing, for example 0, 4, ..., 996 for 250 of 1000.

        An error is raised if the selected timesteps do not cover most of the schedule. For example, 600 timesteps would
        have a spacing of 1, so sampling would start at timestep 599. At timestep 599, the network expects an input with
        20 % signal, but the input would be pure noise.

        Args:
            num_inference_steps: Number n of timesteps.

        Returns:
            (n,) timesteps in ascending order.

        Raises:
            ValueError: The number is out of range, or the timesteps cover less than 90 % of the schedule.
        """
        if not 1 <= num_inference_steps <= self.num_timesteps:
            raise ValueError(f"num_inference_steps is {num_inference_steps}, expected 1 to {self.num_timesteps}")
        spacing = self.num_timesteps // num_inference_steps
        if num_inference_steps * spacing < 0.9 * self.num_timesteps:
            near = self.num_timesteps // (spacing + 1), self.num_timesteps // spacing
            raise ValueError(
                f"num_inference_steps is {num_inference_steps}: with a spacing of {spacing}, sampling would begin "
                f"at timestep {(num_inference_steps - 1) * spacing} of {self.num_timesteps}; "
                f"expected {near[0]} or {near[1]}"
            )
        return np.arange(num_inference_steps) * spacing

    def add_noise(
        self, clean: Float[Tensor, "b c h w"], noise: Float[Tensor, "b c h w"], timestep: Int[Tensor, " b"]
    ) -> Float[Tensor, "b c h w"]:
        """Add noise: z_t = sqrt(alpha_bar_t) z_0 + sqrt(1 - alpha_bar_t) eps.

        Args:
            clean: Clean latents z_0.
            noise: Standard normal noise eps.
            timestep: Timestep of each sample.

        Returns:
            Noisy latents z_t.
        """
        alpha_bar = _copy_alpha_bar(self, clean.device)[timestep][:, None, None, None]
        return alpha_bar.sqrt().to(clean.dtype) * clean + (1 - alpha_bar).sqrt().to(clean.dtype) * noise


@cache
def _copy_alpha_bar(diffusion: Diffusion, device: torch.device) -> Tensor:
    """Copy alpha_bar to a device once, because each copy would wait for a GPU."""
    return torch.from_numpy(diffusion.alpha_bar).to(device)


PAPER_SCHEDULE = Diffusion()


class SamplingSchedule:
    """Timesteps of a sampling run, and the transitions between its states.

    Args:
        diffusion: Noise schedule.
        num_inference_steps: Number of timesteps that sampling uses.
        eta: Fraction of the noise of DDPM that each step adds (DDIM; Song et al., 2021). The paper uses 1; 0 adds no
            noise.
        large_variance: Whether each step adds noise of the variance beta instead of that of the posterior, the other
            choice of DDPM (Ho et al., 2020, Sec. 3.2). It needs eta 1.
    """

    def __init__(
        self, diffusion: Diffusion, num_inference_steps: int, eta: float = 1.0, large_variance: bool = False
    ) -> None:
        self.timesteps, self.eta = diffusion.select_timesteps(num_inference_steps), eta
        self.large_variance = large_variance
        self.alpha_bar = np.append(diffusion.alpha_bar[self.timesteps], 1.0)  # The last entry is the clean state.

    def __len__(self) -> int:
        return len(self.timesteps)

    def descending_transitions(self) -> list[tuple[int, int]]:
        """Return the transitions (from, to) of a sampling run without jumps."""
        return [(i, i - 1) for i in reversed(range(len(self)))]

    def noise_to_state(self, clean: Tensor, noise: Tensor, state: int) -> Tensor:
        """Add noise to a clean latent up to a state.

        Args:
            clean: Clean latent z_0.
            noise: Standard normal noise.
            state: Target state; for state -1, `clean` is returned unchanged.

        Returns:
            Latent at this state.
        """
        if state == -1:
            return clean
        a = self.alpha_bar[state]
        return a**0.5 * clean + (1 - a) ** 0.5 * noise

    def step_up(self, latent: Tensor, noise: Tensor, state: int, to: int) -> Tensor:
        """Add noise to move a latent to a higher state: sample q(z_to | z_state).

        Args:
            latent: Latent at `state`.
            noise: Standard normal noise.
            state: Current state.
            to: Target state; it must be greater than `state`.

        Returns:
            Latent at state `to`.
        """
        ratio = self.alpha_bar[to] / self.alpha_bar[state]
        return ratio**0.5 * latent + (1 - ratio) ** 0.5 * noise

    def step_down(self, latent: Tensor, predicted_noise: Tensor, noise: Tensor, state: int) -> Tensor:
        """Perform one denoising step: sample p(z_{state-1} | z_state).

        If eta is 1, mean and variance are those of the posterior of DDPM. The formula contains z_0 and therefore also
        holds for spaced timesteps, with beta = 1 - alpha_bar_i / alpha_bar_{i-1}.

        Args:
            latent: Latent at `state`.
            predicted_noise: Noise that the model predicts in `latent`.
            noise: Standard normal noise.
            state: Current state.

        Returns:
            Latent at state `state` - 1.
        """
        a, a_prev = self.alpha_bar[state], self.alpha_bar[state - 1]
        variance = self.eta**2 * (1 - a_prev) / (1 - a) * (1 - a / a_prev)
        clean = (latent - (1 - a) ** 0.5 * predicted_noise) / a**0.5
        mean = a_prev**0.5 * clean + (1 - a_prev - variance) ** 0.5 * predicted_noise
        variance = 1 - a / a_prev if self.large_variance else variance
        return mean if state == 0 else mean + variance**0.5 * noise


# Purposes of noise. Generation and outpainting of the same scene index must start from different noise.
GENERATE, OUTPAINT, INPAINT, PLAN = 1, 2, 3, 4


@cache
def start_noise_threads() -> ThreadPoolExecutor:
    """Return the threads that draw noise for GPUs; they start with the first draw."""
    return ThreadPoolExecutor(min(16, os.cpu_count() or 1), "noise")


def start_drawing(
    generators: Sequence[torch.Generator], shape: tuple[int, ...], device: torch.device, count: int = 1
) -> tuple[Float[Tensor, "count b ..."], list[Future]]:
    """Start to draw standard normal noise in threads, with one generator per sample.

    Args:
        generators: Generators of the CPU.
        shape: Shape of the noise of one sample.
        device: Device that will use the noise. Copies from pinned memory to a GPU do not wait for the GPU.
        count: Number of draws of each sample, one after another.

    Returns:
        Memory of the CPU for the noise, and one future per sample. The noise is complete when all futures are done.
    """
    noise = torch.empty((count, len(generators), *shape), pin_memory=device.type == "cuda")

    def draw(sample: int) -> None:
        for part in noise[:, sample]:
            torch.randn(shape, generator=generators[sample], out=part)

    threads = start_noise_threads()
    return noise, [threads.submit(draw, sample) for sample in range(len(generators))]


def finish_drawing(
    noise: Float[Tensor, "count b ..."], parts: Sequence[Future], device: torch.device
) -> Float[Tensor, "count b ..."]:
    """Wait for the noise of `start_drawing`.

    Args:
        noise: Memory of the noise.
        parts: One future per sample.
        device: Device of the result.

    Returns:
        Noise on the device.
    """
    for part in parts:
        part.result()
    return noise.to(device, non_blocking=True)


class SceneNoise:
    """Standard normal noise. Each scene has a separate sequence, determined by seed, scene key and purpose.

    The noise of a scene does not depend on the batch size, the number of workers or the other scenes of the batch. It
    is drawn on the CPU, so it is equal for all devices. For a GPU, threads draw the next noise while the GPU works.

    Args:
        seed: One seed for all scenes, or one per scene.
        indices: Key of each scene.
        shape: Shape of the noise of one scene.
        device: Device of the noise.
        purpose: GENERATE, OUTPAINT, INPAINT or PLAN.
        ahead: Whether threads draw the next noise. None: if the device is a GPU.
    """

    def __init__(
        self,
        seed: int | Sequence[int],
        indices: Sequence[SceneKey],
        shape: tuple[int, ...],
        device: torch.device | str,
        purpose: int = GENERATE,
        ahead: bool | None = None,
    ) -> None:
        seeds = [seed] * len(indices) if isinstance(seed, int) else seed
        keys = [(index,) if isinstance(index, int) else index for index in indices]
        generators = [make_keyed_generator(one, *key, purpose) for one, key in zip(seeds, keys, strict=True)]
        self._use_generators(generators, shape, device, ahead)

    @classmethod
    def from_generators(
        cls, generators: Sequence[torch.Generator], shape: tuple[int, ...], device: torch.device | str
    ) -> SceneNoise:
        """Return noise of given generators, which are advanced by each draw.

        Args:
            generators: One generator of the CPU per scene.
            shape: Shape of the noise of one scene.
            device: Device of the noise.

        Returns:
            Noise.
        """
        noise = cls.__new__(cls)
        noise._use_generators(list(generators), shape, device, ahead=False)
        return noise

    def _use_generators(
        self,
        generators: list[torch.Generator],
        shape: tuple[int, ...],
        device: torch.device | str,
        ahead: bool | None,
    ) -> None:
        self.generators, self.shape, self.device = generators, shape, torch.device(device)
        self.ahead = self.device.type == "cuda" if ahead is None else ahead
        self.next = self._start() if self.ahead else None  # Noise of the next call.

    def draw(self) -> Float[Tensor, "b ..."]:
        """Return the next noise of all scenes, of shape (b, *shape)."""
        if self.next is None:
            noise = torch.stack([torch.randn(self.shape, generator=generator) for generator in self.generators])
            return noise.to(self.device)
        noise = finish_drawing(*self.next, self.device)[0]
        self.next = self._start()
        return noise

    def _start(self) -> tuple[Tensor, list[Future]]:
        return start_drawing(self.generators, self.shape, self.device)


def make_keyed_generator(*key: int) -> torch.Generator:
    """Return a CPU generator that depends only on the integers of a key.

    Args:
        *key: Integers.

    Returns:
        A new generator.
    """
    # SeedSequence returns the same state for [a] and [a, 0]. The length of the key makes the two states differ.
    state = np.random.SeedSequence([len(key), *(k & 0xFFFFFFFF for k in key)]).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state >> np.uint64(1)))


def with_guidance(model: Denoiser, null_label: int, scale: float) -> Denoiser:
    """Add classifier-free guidance to a model.

    Args:
        model: Model that predicts the noise.
        null_label: Index of the null label.
        scale: Guidance scale. If the scale is 1, the model is returned unchanged, so each step needs only one
            evaluation.

    Returns:
        A model that predicts the guided noise.
    """
    if scale == 1.0:
        return model

    def predict(latent: Tensor, timestep: Tensor, label: Tensor) -> Tensor:
        both = torch.cat([label, torch.full_like(label, null_label)])
        conditional, unconditional = model(latent.repeat(2, 1, 1, 1), timestep.repeat(2), both).chunk(2)
        return unconditional + scale * (conditional - unconditional)

    return predict


def switch_at_timestep(limit: float, noisy: Denoiser, clean: Denoiser) -> Denoiser:
    """Use one model at noisy timesteps and another model at the other timesteps.

    Args:
        limit: Lowest timestep of the first model.
        noisy: Model for timesteps from `limit` on.
        clean: Model for timesteps below `limit`.

    Returns:
        A model for all timesteps. All samples of a batch must have the same timestep.
    """
    return lambda latent, timestep, label: (noisy if timestep[0] >= limit else clean)(latent, timestep, label)


def scale_noise(model: Denoiser, noise_scaling: float) -> Denoiser:
    """Divide the predicted noise of a model by a number near 1.

    This is epsilon scaling (Ning et al., ICLR 2024). During sampling, a network interprets errors of earlier steps as
    noise. The division compensates for these errors, so samples have the standard deviation of the data.

    Args:
        model: Model that predicts the noise.
        noise_scaling: Divisor. If the divisor is 1, the model is returned unchanged.

    Returns:
        A model that predicts the scaled noise.
    """
    if noise_scaling == 1.0:
        return model
    return lambda latent, timestep, label: model(latent, timestep, label) / noise_scaling


@dataclass(frozen=True, eq=False)
class InpaintCondition:
    """Known part of latents (paper, supplement, Eq. 20 to 22).

    Attributes:
        latent: Clean latents of the known part.
        mask: 1 marks values to generate, 0 marks values to keep.
    """

    latent: Float[Tensor, "b c h w"]
    mask: Float[Tensor, "b c h w"]


def join_known(latent: Float[Tensor, "b c h w"], condition: InpaintCondition) -> Float[Tensor, "b 3*c h w"]:
    """Append the known part to noisy latents, as the input of an inpainting network (`models.dit.DiT`).

    Args:
        latent: Noisy latents.
        condition: Known part of the clean latents.

    Returns:
        Noisy latents; clean latents, 0 where they are unknown; and 1 where they are known, else 0.
    """
    known = 1 - condition.mask
    return torch.cat([latent, known * condition.latent, known], dim=1)


def with_known(
    model: Denoiser, condition: InpaintCondition, diffusion: Diffusion, known_guidance_scale: float = 1.0
) -> Denoiser:
    """Condition an inpainting network on known parts, with any sampler.

    In the known part, the predicted noise is the one whose clean estimate is the known latent. Sampling therefore ends
    at the known latent.

    Guidance by the known part is classifier-free guidance with the known part instead of the label. It applies to
    timesteps from KNOWN_GUIDANCE_START on.

    Args:
        model: Inpainting network.
        condition: Known part of the latents.
        diffusion: Noise schedule.
        known_guidance_scale: Scale of guidance by the known part; 1 switches this guidance off.

    Returns:
        A denoiser for latents without the known part.
    """
    kept = ~condition.mask.bool()
    nothing = InpaintCondition(torch.zeros_like(condition.latent), torch.ones_like(condition.mask))
    start = KNOWN_GUIDANCE_START * diffusion.num_timesteps if known_guidance_scale != 1.0 and kept.any() else math.inf

    def predict(latent: Tensor, timestep: Tensor, label: Tensor) -> Tensor:
        noise = model(join_known(latent, condition), timestep, label)
        if timestep[0] >= start:
            without = model(join_known(latent, nothing), timestep, label)
            noise = without + known_guidance_scale * (noise - without)
        alpha_bar = float(diffusion.alpha_bar[int(timestep[0])])
        return torch.where(kept, (latent - alpha_bar**0.5 * condition.latent) / (1 - alpha_bar) ** 0.5, noise)

    return predict


@torch.no_grad()
def sample(
    model: Denoiser,
    schedule: SamplingSchedule,
    noise: SceneNoise,
    label: Int[Tensor, " b"],
    transitions: list[tuple[int, int]] | None = None,
    condition: InpaintCondition | None = None,
    on_step: OnStep | None = None,
    guidance_weight: float = 0.0,
) -> Float[Tensor, "b c h w"]:
    """Sample clean latents by ancestral sampling along `transitions`.

    A transition to a lower state removes noise; a transition to a higher state adds noise (RePaint). With a condition,
    each denoising step then replaces the known part. The new value is the clean latent of the known part, plus noise of
    the level of the new state. In the result, the known part is bit-identical to the clean latent.

    The paper instead uses the noise level of the previous state (Eq. "z_known"). The known part and the generated part
    would then have different noise levels.

    Args:
        model: Model that predicts the noise in a latent.
        schedule: Timesteps and the noise of each step.
        noise: Source of the random numbers of each scene.
        label: Class index of each scene.
        transitions: Pairs (from, to) of states; None: all states in descending order, without jumps.
        condition: Known part of the latents; None: no known part.
        on_step: Function that is called after every evaluation of the model and returns the latent for the next step.
        guidance_weight: Weight of `pseudoinverse_guidance` towards the known part. The paper does not use this
            guidance.

    Returns:
        Clean latents.
    """
    latent, evaluations = noise.draw(), 0
    for state, to in transitions or schedule.descending_transitions():
        if to > state:
            latent = schedule.step_up(latent, noise.draw(), state, to)
            continue
        timestep = int(schedule.timesteps[state])
        direction: Tensor | float = 0.0
        if condition is not None and guidance_weight:
            predicted, direction = pseudoinverse_guidance(
                model, latent, timestep, label, schedule.alpha_bar[state], condition
            )
        else:
            predicted = model(latent, torch.full_like(label, timestep), label)
        step_noise = noise.draw() if to >= 0 else torch.zeros_like(latent)
        latent = schedule.step_down(latent, predicted, step_noise, state) + guidance_weight * direction
        if condition is not None:
            kept = schedule.noise_to_state(condition.latent, noise.draw() if to >= 0 else condition.latent, to)
            latent = torch.where(condition.mask.bool(), latent, kept)
        if on_step:
            latent = on_step(evaluations, timestep, latent)
        evaluations += 1
    return latent


def pseudoinverse_guidance(
    model: Denoiser,
    latent: Float[Tensor, "b c h w"],
    timestep: int,
    label: Int[Tensor, " b"],
    alpha_bar: float,
    condition: InpaintCondition,
) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b c h w"]]:
    """Predict the noise and a direction that moves the clean estimate towards the known part.

    This is pseudo-inverse guidance (Song et al., ICLR 2023), where the measurement is the known part. The direction is
    sqrt(alpha_bar) J^T d. J is the Jacobian of the clean estimate, and d is the difference between the known part and
    the clean estimate. A network that was not trained for inpainting needs such guidance, because pasting the known
    part is not enough. One call costs about two evaluations of the model.

    Args:
        model: Model that predicts the noise.
        latent: Noisy latents.
        timestep: Timestep of all latents.
        label: Class index of each scene.
        alpha_bar: Value of alpha_bar at this timestep.
        condition: Known part of the latents.

    Returns:
        Predicted noise and direction.
    """
    with torch.enable_grad():
        latent = latent.detach().requires_grad_()
        predicted = model(latent, torch.full_like(label, timestep), label)
        clean = (latent - (1 - alpha_bar) ** 0.5 * predicted) / alpha_bar**0.5
        difference = ((1 - condition.mask) * (condition.latent - clean)).detach()
        (direction,) = torch.autograd.grad(clean, latent, difference)
    return predicted.detach(), alpha_bar**0.5 * direction


@torch.no_grad()
def sample_with_scheduler(
    model: Denoiser,
    scheduler: Any,
    noise: SceneNoise,
    label: Int[Tensor, " b"],
    on_step: OnStep | None = None,
) -> Float[Tensor, "b c h w"]:
    """Sample clean latents with a scheduler of diffusers, such as DPM-Solver++ or DDIM.

    Args:
        model: Model that predicts the noise.
        scheduler: A SchedulerMixin whose `set_timesteps` was called. A scheduler that adds noise must accept the noise
            as an argument, because each scene has separate noise.
        noise: Source of the random numbers of each scene.
        label: Class index of each scene.
        on_step: Function that is called after every evaluation of the model and returns the latent for the next step.

    Returns:
        Clean latents.
    """
    latent = noise.draw() * scheduler.init_noise_sigma
    stochastic = str(scheduler.config.get("algorithm_type")).startswith("sde-")
    for number, timestep in enumerate(scheduler.timesteps):
        predicted = model(scheduler.scale_model_input(latent, timestep), timestep.expand(len(label)), label)
        variance_noise = {"variance_noise": noise.draw()} if stochastic else {}
        latent = scheduler.step(predicted, timestep, latent, **variance_noise).prev_sample
        if on_step:
            latent = on_step(number, int(timestep), latent)
    return latent
