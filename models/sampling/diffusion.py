"""Denoising diffusion on layout latents (paper, supplement B.3): schedule, training target and the one sampler.

States are counted on the visited timesteps: state i means "noised to timestep visited[i]", state -1 means clean.
Plain sampling walks n-1, n-2, ..., 0, -1; RePaint walks the same road with detours (repaint.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from diffusers import SchedulerMixin
from jaxtyping import Float, Int
from torch import Tensor

Denoiser = Callable[[Tensor, Tensor, Tensor], Tensor]  # latent, timestep (b,), label (b,) -> noise
Key = int | tuple[int, ...]  # a scene's number, or several numbers that tell it from others
OnStep = Callable[[int, int, Tensor], Tensor]  # number of the step from 0, its timestep, latent -> latent to go on with


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

    def visited(self, num_steps: int) -> np.ndarray:
        """(num_steps,) ascending timesteps, "leading" spacing: 0, 4, ..., 996 for 250 of 1000.

        Raises ValueError for a number that leaves more than a tenth of them unvisited: 600 steps of 1 begin at 599, where
        the network expects two tenths of the signal, and would be given none.
        """
        if not 1 <= num_steps <= self.num_timesteps:
            raise ValueError(f"num_steps is {num_steps}, expected 1 to {self.num_timesteps}")
        apart = self.num_timesteps // num_steps
        if num_steps * apart < 0.9 * self.num_timesteps:
            near = self.num_timesteps // (apart + 1), self.num_timesteps // apart
            raise ValueError(
                f"num_steps is {num_steps}: {apart} apart, they would begin at {(num_steps - 1) * apart} of "
                f"{self.num_timesteps}; expected {near[0]} or {near[1]}"
            )
        return np.arange(num_steps) * apart

    def add_noise(
        self, clean: Float[Tensor, "b c h w"], noise: Float[Tensor, "b c h w"], timestep: Int[Tensor, b]
    ) -> Float[Tensor, "b c h w"]:
        """z_t = sqrt(alpha_bar_t) z_0 + sqrt(1 - alpha_bar_t) eps."""
        alpha_bar = torch.from_numpy(self.alpha_bar).to(clean.device)[timestep][:, None, None, None]
        return alpha_bar.sqrt().to(clean.dtype) * clean + (1 - alpha_bar).sqrt().to(clean.dtype) * noise


class Walk:
    """The visited timesteps of one sampling run, with every transition between their states.

    `eta` is DDIM's (Song et al., 2021): how much of the noise of DDPM's steps there is, 1 in the paper, 0 for none.
    """

    def __init__(self, diffusion: Diffusion, num_steps: int, eta: float = 1.0) -> None:
        self.timesteps, self.eta = diffusion.visited(num_steps), eta
        self.alpha_bar = np.append(diffusion.alpha_bar[self.timesteps], 1.0)  # [-1] is the clean state

    def __len__(self) -> int:
        return len(self.timesteps)

    def plain(self) -> list[tuple[int, int]]:
        """(from, to) states of sampling without detours."""
        return [(i, i - 1) for i in reversed(range(len(self)))]

    def to_state(self, clean: Tensor, noise: Tensor, state: int) -> Tensor:
        """Noise a clean latent to a state; state -1 returns it bit for bit."""
        if state == -1:
            return clean
        a = self.alpha_bar[state]
        return a**0.5 * clean + (1 - a) ** 0.5 * noise

    def up(self, latent: Tensor, noise: Tensor, state: int, to: int) -> Tensor:
        """q(z_to | z_state) for to > state: add the noise between two states."""
        ratio = self.alpha_bar[to] / self.alpha_bar[state]
        return ratio**0.5 * latent + (1 - ratio) ** 0.5 * noise

    def down(self, latent: Tensor, predicted_noise: Tensor, noise: Tensor, state: int) -> Tensor:
        """p(z_{state-1} | z_state): with eta 1 mean and variance of the posterior, from the predicted noise.

        Written through z_0 so that it holds for spaced timesteps (beta = 1 - alpha_bar_i / alpha_bar_{i-1}).
        """
        a, a_prev = self.alpha_bar[state], self.alpha_bar[state - 1]
        variance = self.eta**2 * (1 - a_prev) / (1 - a) * (1 - a / a_prev)
        clean = (latent - (1 - a) ** 0.5 * predicted_noise) / a**0.5
        mean = a_prev**0.5 * clean + (1 - a_prev - variance) ** 0.5 * predicted_noise
        return mean if state == 0 else mean + variance**0.5 * noise


# What noise is drawn for: the same scene number must not start generation and outpainting from the same noise.
GENERATE, OUTPAINT, INPAINT = 1, 2, 3


class SceneNoise:
    """Standard normal noise keyed by (seed, scene index, purpose): each scene draws its own sequence.

    The same scene comes out whatever the batch size, the number of workers or the scenes beside it. `seed` is one for
    all, or one per scene.
    """

    def __init__(
        self,
        seed: int | Sequence[int],
        indices: Sequence[Key],
        shape: tuple[int, ...],
        device: torch.device | str,
        purpose: int = GENERATE,
    ) -> None:
        seeds = [seed] * len(indices) if isinstance(seed, int) else seed
        keys = [(index,) if isinstance(index, int) else index for index in indices]
        self.generators = [keyed_generator(one, *key, purpose) for one, key in zip(seeds, keys, strict=True)]
        self.shape, self.device = shape, device

    def draw(self) -> Float[Tensor, "b ..."]:
        noise = torch.stack([torch.randn(self.shape, generator=generator) for generator in self.generators])
        return noise.to(self.device)


def keyed_generator(*key: int) -> torch.Generator:
    """A CPU generator that depends on every number of the key, and on nothing else."""
    # SeedSequence takes [a] and [a, 0] for the same: the length goes in too.
    state = np.random.SeedSequence([len(key), *(k & 0xFFFFFFFF for k in key)]).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state >> np.uint64(1)))


def guided(model: Denoiser, null_label: int, scale: float) -> Denoiser:
    """Classifier-free guidance; at scale 1 the model itself, without a second half of the batch."""
    if scale == 1.0:
        return model

    def predict(latent: Tensor, timestep: Tensor, label: Tensor) -> Tensor:
        both = torch.cat([label, torch.full_like(label, null_label)])
        conditional, unconditional = model(latent.repeat(2, 1, 1, 1), timestep.repeat(2), both).chunk(2)
        return unconditional + scale * (conditional - unconditional)

    return predict


def rescaled(model: Denoiser, noise_scaling: float) -> Denoiser:
    """The noise that a model predicts, divided by a number near 1; at 1 the model itself.

    Epsilon scaling (Ning et al., ICLR 2024): along a run a network meets its own errors, which it takes for noise; a little less
    of what it predicts is taken away. Keeps in what is drawn the deviation that the data have.
    """
    if noise_scaling == 1.0:
        return model
    return lambda latent, timestep, label: model(latent, timestep, label) / noise_scaling


@dataclass(frozen=True, eq=False)
class Known:
    """What must stay: clean latents and a mask, 1 = generate, 0 = keep (paper, Eqs. "z_known" ff.)."""

    latent: Float[Tensor, "b c h w"]
    mask: Float[Tensor, "b c h w"]


@torch.no_grad()
def sample(
    model: Denoiser,
    walk: Walk,
    noise: SceneNoise,
    label: Int[Tensor, b],
    transitions: list[tuple[int, int]] | None = None,
    known: Known | None = None,
    on_step: OnStep | None = None,
    known_guidance: float = 0.0,
) -> Float[Tensor, "b c h w"]:
    """Clean latents, by ancestral sampling along `transitions` (plain by default): DDPM's, or the walk's eta of its noise.

    Downward, the model denoises; upward, noise is added back (RePaint). With `known`, the known part is noised to
    the state just reached and pasted in after each downward step. Differs from the paper, which prints the level
    just left (Eq. "z_known"): the two parts would not match. At the end the known part is z_0, bit for bit.
    `known_guidance` times what `explaining` says is added to the part that is made; not in the paper.
    `on_step` is called after every evaluation of the model.
    """
    latent, evaluations = noise.draw(), 0
    for state, to in transitions or walk.plain():
        if to > state:
            latent = walk.up(latent, noise.draw(), state, to)
            continue
        timestep = int(walk.timesteps[state])
        pull: Tensor | float = 0.0
        if known is not None and known_guidance:
            predicted, pull = explaining(model, latent, timestep, label, walk.alpha_bar[state], known)
        else:
            predicted = model(latent, torch.full_like(label, timestep), label)
        step_noise = noise.draw() if to >= 0 else torch.zeros_like(latent)
        latent = walk.down(latent, predicted, step_noise, state) + known_guidance * pull
        if known is not None:
            kept = walk.to_state(known.latent, noise.draw() if to >= 0 else known.latent, to)
            latent = torch.where(known.mask.bool(), latent, kept)
        if on_step:
            latent = on_step(evaluations, timestep, latent)
        evaluations += 1
    return latent


def explaining(
    model: Denoiser, latent: Tensor, timestep: int, label: Int[Tensor, b], alpha_bar: float, known: Known
) -> tuple[Tensor, Tensor]:
    """The model's noise, and which way to move the latent for the clean one it stands for to meet what is known.

    Pseudo-inverse guidance (Song et al., ICLR 2023) with a mask for the measurement: the Jacobian's transpose of the clean
    estimate, times what that lacks in the known part, times sqrt(alpha_bar). Pasting alone leaves the made part ignorant of
    the known one wherever a network has not learnt to look. Costs a step about what a second evaluation would.
    """
    with torch.enable_grad():
        latent = latent.detach().requires_grad_()
        predicted = model(latent, torch.full_like(label, timestep), label)
        clean = (latent - (1 - alpha_bar) ** 0.5 * predicted) / alpha_bar**0.5
        lacking = ((1 - known.mask) * (known.latent - clean)).detach()
        (direction,) = torch.autograd.grad(clean, latent, lacking)
    return predicted.detach(), alpha_bar**0.5 * direction


@torch.no_grad()
def solve(
    model: Denoiser,
    solver: SchedulerMixin,
    noise: SceneNoise,
    label: Int[Tensor, b],
    on_step: OnStep | None = None,
) -> Float[Tensor, "b c h w"]:
    """Clean latents by one of diffusers' schedulers that take noise from outside or none, as DPM-Solver++ and DDIM.

    Takes the steps that `solver.set_timesteps` has set.
    """
    latent = noise.draw() * solver.init_noise_sigma
    stochastic = str(solver.config.get("algorithm_type")).startswith("sde-")
    for number, timestep in enumerate(solver.timesteps):
        predicted = model(solver.scale_model_input(latent, timestep), timestep.expand(len(label)), label)
        drawn = {"variance_noise": noise.draw()} if stochastic else {}
        latent = solver.step(predicted, timestep, latent, **drawn).prev_sample
        if on_step:
            latent = on_step(number, int(timestep), latent)
    return latent
