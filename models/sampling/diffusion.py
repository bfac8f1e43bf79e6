"""Denoising diffusion on layout latents (paper, supplement B.3): noise schedule and samplers.

States are counted on the visited timesteps: state i has the noise of timestep `timesteps[i]`, state -1 is clean.
Sampling passes the states n-1, n-2, ..., 0, -1; RePaint adds jumps back to noisier states (repaint.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

Denoiser = Callable[[Tensor, Tensor, Tensor], Tensor]  # latent, timestep (b,), label (b,) -> noise
SceneKey = int | tuple[int, ...]  # a scene's index, or several numbers that identify it
OnStep = Callable[[int, int, Tensor], Tensor]  # index of the step, its timestep, latent -> latent of the next step


@dataclass(frozen=True)
class Diffusion:
    """DDPM with a linear variance schedule; the paper's numbers (supplement B.3, Implementation Details)."""

    num_timesteps: int = 1000
    beta_start: float = 0.0015
    beta_end: float = 0.015

    @cached_property
    def alpha_bar(self) -> np.ndarray:
        """(T,) float64 cumulative product of 1 - beta_t."""
        return np.cumprod(1 - np.linspace(self.beta_start, self.beta_end, self.num_timesteps, dtype=np.float64))

    def select_timesteps(self, num_inference_steps: int) -> np.ndarray:
        """Select ascending timesteps (n,) with "leading" spacing: 0, 4, ..., 996 for 250 of 1000.

        Raises:
            ValueError: The number is out of range, or the timesteps would cover less than nine tenths of the schedule.
                600 timesteps with a spacing of 1 begin at 599, where the network expects two tenths of the signal and
                would receive pure noise.
        """
        if not 1 <= num_inference_steps <= self.num_timesteps:
            raise ValueError(f"num_inference_steps is {num_inference_steps}, expected 1 to {self.num_timesteps}")
        spacing = self.num_timesteps // num_inference_steps
        if num_inference_steps * spacing < 0.9 * self.num_timesteps:
            near = self.num_timesteps // (spacing + 1), self.num_timesteps // spacing
            raise ValueError(
                f"num_inference_steps is {num_inference_steps}: with a spacing of {spacing} they would begin at "
                f"{(num_inference_steps - 1) * spacing} of {self.num_timesteps}; expected {near[0]} or {near[1]}"
            )
        return np.arange(num_inference_steps) * spacing

    def add_noise(
        self, clean: Float[Tensor, "b c h w"], noise: Float[Tensor, "b c h w"], timestep: Int[Tensor, " b"]
    ) -> Float[Tensor, "b c h w"]:
        """z_t = sqrt(alpha_bar_t) z_0 + sqrt(1 - alpha_bar_t) eps."""
        alpha_bar = torch.from_numpy(self.alpha_bar).to(clean.device)[timestep][:, None, None, None]
        return alpha_bar.sqrt().to(clean.dtype) * clean + (1 - alpha_bar).sqrt().to(clean.dtype) * noise


class SamplingSchedule:
    """The visited timesteps of one sampling run and the transitions between their states.

    Args:
        diffusion: The noise schedule.
        num_inference_steps: Number of visited timesteps.
        eta: Share of the noise of DDPM's steps (DDIM; Song et al., 2021): 1 in the paper, 0 for none.
    """

    def __init__(self, diffusion: Diffusion, num_inference_steps: int, eta: float = 1.0) -> None:
        self.timesteps, self.eta = diffusion.select_timesteps(num_inference_steps), eta
        self.alpha_bar = np.append(diffusion.alpha_bar[self.timesteps], 1.0)  # [-1] is the clean state

    def __len__(self) -> int:
        return len(self.timesteps)

    def descending_transitions(self) -> list[tuple[int, int]]:
        """Transitions (from, to) without jumps."""
        return [(i, i - 1) for i in reversed(range(len(self)))]

    def noise_to_state(self, clean: Tensor, noise: Tensor, state: int) -> Tensor:
        """Add noise to a clean latent up to a state; state -1 returns it bit for bit."""
        if state == -1:
            return clean
        a = self.alpha_bar[state]
        return a**0.5 * clean + (1 - a) ** 0.5 * noise

    def step_up(self, latent: Tensor, noise: Tensor, state: int, to: int) -> Tensor:
        """Sample q(z_to | z_state) for to > state: add the noise between two states."""
        ratio = self.alpha_bar[to] / self.alpha_bar[state]
        return ratio**0.5 * latent + (1 - ratio) ** 0.5 * noise

    def step_down(self, latent: Tensor, predicted_noise: Tensor, noise: Tensor, state: int) -> Tensor:
        """Sample p(z_{state-1} | z_state). With eta 1 it has the mean and the variance of DDPM's posterior.

        Written through z_0, so that it holds for spaced timesteps (beta = 1 - alpha_bar_i / alpha_bar_{i-1}).
        """
        a, a_prev = self.alpha_bar[state], self.alpha_bar[state - 1]
        variance = self.eta**2 * (1 - a_prev) / (1 - a) * (1 - a / a_prev)
        clean = (latent - (1 - a) ** 0.5 * predicted_noise) / a**0.5
        mean = a_prev**0.5 * clean + (1 - a_prev - variance) ** 0.5 * predicted_noise
        return mean if state == 0 else mean + variance**0.5 * noise


# Purposes of noise: generation and outpainting of the same scene index must start from different noise.
GENERATE, OUTPAINT, INPAINT = 1, 2, 3


class SceneNoise:
    """Standard normal noise keyed by (seed, scene index, purpose): each scene draws its own sequence.

    A scene therefore does not depend on the batch size, the number of workers or the other scenes of its batch.
    `seed` is one number for all scenes, or one per scene.
    """

    def __init__(
        self,
        seed: int | Sequence[int],
        indices: Sequence[SceneKey],
        shape: tuple[int, ...],
        device: torch.device | str,
        purpose: int = GENERATE,
    ) -> None:
        seeds = [seed] * len(indices) if isinstance(seed, int) else seed
        keys = [(index,) if isinstance(index, int) else index for index in indices]
        self.generators = [make_keyed_generator(one, *key, purpose) for one, key in zip(seeds, keys, strict=True)]
        self.shape, self.device = shape, device

    def draw(self) -> Float[Tensor, "b ..."]:
        noise = torch.stack([torch.randn(self.shape, generator=generator) for generator in self.generators])
        return noise.to(self.device)


def make_keyed_generator(*key: int) -> torch.Generator:
    """A CPU generator that depends on every number of the key, and on nothing else."""
    # SeedSequence takes [a] and [a, 0] for the same: the length goes in too.
    state = np.random.SeedSequence([len(key), *(k & 0xFFFFFFFF for k in key)]).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state >> np.uint64(1)))


def with_guidance(model: Denoiser, null_label: int, scale: float) -> Denoiser:
    """Add classifier-free guidance to a model; at scale 1 it is returned unchanged and evaluated once per step."""
    if scale == 1.0:
        return model

    def predict(latent: Tensor, timestep: Tensor, label: Tensor) -> Tensor:
        both = torch.cat([label, torch.full_like(label, null_label)])
        conditional, unconditional = model(latent.repeat(2, 1, 1, 1), timestep.repeat(2), both).chunk(2)
        return unconditional + scale * (conditional - unconditional)

    return predict


def scale_noise(model: Denoiser, noise_scaling: float) -> Denoiser:
    """Divide the noise that a model predicts by a number near 1; at 1 the model is returned unchanged.

    Epsilon scaling (Ning et al., ICLR 2024): during sampling a network takes its own errors for noise. Dividing its
    prediction compensates for that, so that samples keep the standard deviation of the data.
    """
    if noise_scaling == 1.0:
        return model
    return lambda latent, timestep, label: model(latent, timestep, label) / noise_scaling


@dataclass(frozen=True, eq=False)
class InpaintCondition:
    """Clean known latents and a mask, 1 = generate, 0 = keep (paper, Eqs. "z_known" ff.)."""

    latent: Float[Tensor, "b c h w"]
    mask: Float[Tensor, "b c h w"]


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

    Downward transitions denoise; upward ones add noise back (RePaint). With a condition, the known part is noised to
    the state just reached and pasted in after each downward step. Differs from the paper, which prints the level just
    left (Eq. "z_known"): the two parts would have different noise levels. In the end the known part is z_0 bit for bit.

    Args:
        model: Predicts the noise in a latent.
        schedule: Visited timesteps and the noise of each step.
        noise: The scenes' random numbers.
        label: Class index of each scene.
        transitions: Pairs (from, to) of states (default: descending, without jumps).
        condition: Known part of the latents.
        on_step: Called after every evaluation of the model; returns the latent to continue with.
        guidance_weight: Weight of `pseudoinverse_guidance` towards the known part; not in the paper.
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
    """Predict the noise, and the direction that moves the estimate of the clean latent towards the known part.

    Pseudo-inverse guidance (Song et al., ICLR 2023) with a mask as the measurement: the transposed Jacobian of the
    clean estimate, times its difference from the known part, times sqrt(alpha_bar). Pasting alone does not inform the
    generated part where a network has not learnt to. One call costs about as much as two evaluations.
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
    """Sample clean latents with a scheduler of diffusers, such as DPM-Solver++ or DDIM, after its `set_timesteps`.

    `scheduler` is a SchedulerMixin (diffusers is not imported here). Schedulers that add noise must accept it as an
    argument, so that each scene keeps its own random numbers.
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
