"""Guidance of sampling by constraints: penalties on the decoded clean estimate (penalties.py).

In the last part of sampling, each guided step decodes the clean estimate of the latents and lowers the penalties by a
few steps of gradient descent on the clean estimate. The predicted noise is then changed such that it belongs to the new
estimate. Any sampler can therefore use the guidance, and the network itself needs no gradient. The paper does not have
such guidance; it suggests guidance as future work.

Similar methods are universal guidance (Bansal et al., 2023) and manifold preserving guided diffusion (He et al., 2024).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from models.lvae import LayoutVAE
from models.sampling.diffusion import Denoiser, Diffusion, InpaintCondition
from models.sampling.penalties import (
    CONSTRAINTS,
    Ground,
    compute_penalties,
    find_objects,
    make_ground,
    make_objects,
    select_constraints,
    sum_penalties,
)

DEFAULT_WEIGHTS = MappingProxyType({"footprint": 10.0, "heading": 10.0, "alignment": 10.0})
# Penalty (m) of an object whose existence probability changes from 0 to 1: objects must move, not appear or vanish.
EXISTENCE_M = 5.0
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ConstraintConfig:
    """Options of the guidance.

    Attributes:
        names: Constraints, keys of `penalties.CONSTRAINTS`. None: all constraints that the model's categories allow.
        weights: Weight of each constraint by name; a missing weight is 1. The defaults are from a comparison on the
            released model (docs/experiments/constraints.md).
        last: Share of the denoising steps, from the end, in which sampling is guided.
        every: Guide every n-th step of the guided part, counted from the last step, which is always guided.
        iterations: Number of gradient steps per guided step.
        step: Length of a gradient step: the clean estimate of a latent cell moves by `step` times the gradient, whose
            length is clipped to 1 (latent units per metre).
        trust: Largest displacement of a latent cell in a guided step. The unit is the noise level of the step times the
            root of the number of channels, which is the length of the noise in a cell.

    Raises:
        ValueError: A value is out of range, or a weight belongs to no constraint.
    """

    names: tuple[str, ...] | None = None
    weights: Mapping[str, float] = field(default_factory=lambda: DEFAULT_WEIGHTS)
    last: float = 0.5
    every: int = 2
    iterations: int = 4
    step: float = 1.5
    trust: float = 6.0

    def __post_init__(self) -> None:
        if not 0 < self.last <= 1:
            raise ValueError(f"last is {self.last}, expected a share of the steps above 0 and at most 1")
        if self.every < 1 or self.iterations < 1:
            raise ValueError(f"every is {self.every}, iterations is {self.iterations}: expected at least 1")
        if not (0 < self.step < math.inf and 0 < self.trust < math.inf):
            raise ValueError(f"step is {self.step}, trust is {self.trust}: expected finite numbers above 0")
        for name, weight in self.weights.items():
            if name not in CONSTRAINTS or not 0 <= weight < math.inf:
                raise ValueError(
                    f"the weight of constraint {name!r} is {weight}: expected a number of at least 0, and one of"
                    f" {', '.join(CONSTRAINTS)}"
                )

    def select_timesteps(self, timesteps: Sequence[int]) -> frozenset[int]:
        """Return the timesteps of guided steps.

        Args:
            timesteps: All timesteps of sampling, in any order.

        Returns:
            Guided timesteps; the lowest timestep always is one of them.
        """
        ascending = sorted({int(t) for t in timesteps})
        return frozenset(ascending[: max(1, round(self.last * len(ascending))) : self.every])


@dataclass
class GuidanceReport:
    """Counts of the guidance over all batches, in scenes times steps.

    Attributes:
        guided: Steps of scenes that were guided.
        fallbacks: Steps of scenes without a finite gradient, which continued without guidance.
    """

    guided: int = 0
    fallbacks: int = 0


class ConstraintGuidance:
    """Lower the penalties of clean estimates.

    Args:
        config: Options.
        lvae: Layout VAE whose decoders define the penalties.
        moments: Shift and scale of the latents, each (c, 1, 1): the VAE reads scale * latent + shift.
        diffusion: Noise schedule.

    Raises:
        ValueError: A requested constraint is unknown, or the model lacks its categories or ground classes.
    """

    def __init__(
        self,
        config: ConstraintConfig,
        lvae: LayoutVAE,
        moments: Callable[[], tuple[Tensor, Tensor]],
        diffusion: Diffusion,
    ) -> None:
        self.names = select_constraints(lvae.spec, config.names)
        self.config, self.lvae, self.moments, self.diffusion = config, lvae, moments, diffusion
        self.report = GuidanceReport()

    def wrap(
        self, model: Denoiser, timesteps: Sequence[int] | np.ndarray, condition: InpaintCondition | None = None
    ) -> Denoiser:
        """Return a denoiser whose predicted noise belongs to clean estimates with lower penalties.

        Args:
            model: Model that predicts the noise.
            timesteps: All timesteps of sampling.
            condition: Known part of the latents, which keeps its values.

        Returns:
            Denoiser with the same inputs and outputs.
        """
        guided = self.config.select_timesteps([int(t) for t in timesteps])

        def predict(latent: Tensor, timestep: Tensor, label: Tensor) -> Tensor:
            noise = model(latent, timestep, label)
            if (now := int(timestep[0])) not in guided:
                return noise
            alpha_bar = float(self.diffusion.alpha_bar[now])
            clean = (latent.detach() - (1 - alpha_bar) ** 0.5 * noise.detach()) / alpha_bar**0.5
            ratio = (alpha_bar / (1 - alpha_bar)) ** 0.5  # Signal-to-noise ratio of the latent.
            return noise - ratio * self.find_displacement(clean, 1 / ratio, condition).to(noise.dtype)

        return predict

    def find_displacement(
        self, clean: Float[Tensor, "b c h w"], noise_level: float, condition: InpaintCondition | None = None
    ) -> Float[Tensor, "b c h w"]:
        """Find a displacement of clean latents that lowers the penalties.

        Args:
            clean: Clean estimates.
            noise_level: Standard deviation of the noise, relative to the clean latents.
            condition: Known part of the latents, which keeps its values.

        Returns:
            Displacement; 0 for scenes whose penalty or gradient is not finite.
        """
        radius = self.config.trust * noise_level * clean.shape[1] ** 0.5
        # Penalties need the precision of float32, also if the caller samples in bfloat16.
        full_precision = torch.autocast(clean.device.type, enabled=False)
        with torch.inference_mode(False), torch.enable_grad(), full_precision:
            start = clean.detach().float().clone()
            mask = torch.ones_like(start) if condition is None else condition.mask.clone().to(start)
            if condition is not None:
                start = torch.where(mask.bool(), start, condition.latent.clone().to(start))
            displacement, failed = torch.zeros_like(start), torch.zeros(len(start), dtype=torch.bool).to(start.device)
            with torch.no_grad():
                decoded = self._decode(start)
            for _ in range(self.config.iterations):
                latent = (start + displacement).requires_grad_()
                penalty = self._measure(latent, decoded)
                if not penalty.requires_grad:  # No scene has an object.
                    break
                (gradient,) = torch.autograd.grad(penalty.sum(), latent)
                failed |= ~(torch.isfinite(gradient).flatten(1).all(dim=1) & torch.isfinite(penalty.detach()))
                gradient = torch.where(failed[:, None, None, None], 0, gradient * mask)
                length = gradient.norm(dim=1, keepdim=True)
                displacement = displacement - self.config.step * gradient / length.clamp(min=1)
                length = displacement.norm(dim=1, keepdim=True)
                displacement = displacement * (radius / length.clamp(min=radius))
            displacement[failed] = 0
        self.report.guided += int((~failed).sum())
        self.report.fallbacks += int(failed.sum())
        return displacement.detach()

    def warn_of_fallbacks(self, before: int = 0) -> None:
        """Log a warning if steps had no finite gradient.

        Args:
            before: Number of fallbacks that an earlier warning reported.
        """
        if count := self.report.fallbacks - before:
            logger.warning(
                "constraints: %d of %d guided steps had no finite gradient and continued without guidance",
                count,
                count + self.report.guided,
            )

    def measure_penalties(self, latents: Float[Tensor, "b c h w"]) -> dict[str, Tensor]:
        """Measure the penalties of latents.

        Args:
            latents: Clean latents.

        Returns:
            Penalty (m) of each scene (b,), by name.
        """
        with torch.no_grad():
            start = self._decode(latents)
            return self._measure_each(latents, start)[0]

    def _decode(self, latent: Tensor) -> _Start:
        """Return the values that are constant during the gradient steps of a guided step."""
        shift, scale = self.moments()
        output = self.lvae.decode(latent * scale + shift)
        chosen = find_objects(
            output.features, output.existence_logit, output.proposals, self.lvae.spec, self.lvae.proposes_duplicates
        )
        existence = output.existence_logit[chosen].float().sigmoid()
        return _Start(make_ground(output, self.lvae.spec), chosen, existence, output.proposals, output.local_field)

    def _measure_each(self, latent: Tensor, start: _Start) -> tuple[dict[str, Tensor], Tensor]:
        """Return the penalties of latents (m), and squared changes (b,) of existence since the start."""
        shift, scale = self.moments()
        found = self.lvae.decode_objects(self.lvae.split(latent * scale + shift)[1], start.local_field)
        objects = make_objects(found.features, found.existence_logit, start.proposals, self.lvae.spec, start.chosen)
        change = (found.existence_logit[start.chosen].float().sigmoid() - start.existence).square()
        total = change.new_zeros(len(latent)).index_add(0, start.chosen[0], change)
        return compute_penalties(objects, start.ground, self.names), total

    def _measure(self, latent: Tensor, start: _Start) -> Tensor:
        penalties, change = self._measure_each(latent, start)
        if not penalties:
            return latent.new_zeros(len(latent))
        return sum_penalties(penalties, self.config.weights) + EXISTENCE_M * change


class _Start(NamedTuple):
    """Decoded estimate before the gradient steps: ground, scene and proposal of each object, its existence, and the
    field of the local frame (None without one)."""

    ground: Ground
    chosen: tuple[Tensor, Tensor]
    existence: Tensor
    proposals: tuple[int, ...]
    local_field: Tensor | None
