"""Multinomial diffusion of class ids (Hoogeboom et al., 2021), as in PDD.

Step t of the forward process keeps the class of a voxel with a probability alpha_t and otherwise draws one of K classes
uniformly. A network predicts the logits of the clean classes. The reverse step inserts these probabilities into the
closed form of q(x_{t-1} | x_t, x_0). The reverse step of a voxel multiplies them with the likelihood of its own noisy
class, so the exact reverse process needs the distribution of a clean class given all other voxels.

Timesteps count from 0: timestep t has noise of t + 1 steps. All probabilities are logarithms.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from models.base import register_computed_buffers
from models.training import sample_uniform

LOG_ZERO = -70.0  # Logarithm of a probability of zero. It is finite, so it has no undefined products.
SCHEDULE_OFFSET, LEAST_KEPT = 0.008, math.sqrt(0.001)  # Of the cosine schedule.
AUXILIARY_WEIGHT = 5e-4
UNIFORM_SHARE = 0.5  # Share of training timesteps that are uniform.


def make_log_one_hot(class_id: Tensor, num_classes: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Return the logarithms of one-hot vectors.

    Args:
        class_id: (b, *grid) int64 class ids.
        num_classes: Number K of classes.
        dtype: Data type of the result.

    Returns:
        (b, K, *grid): 0 for the class of the voxel, LOG_ZERO for the others.
    """
    shape = class_id.shape[0], num_classes, *class_id.shape[1:]
    return torch.full(shape, LOG_ZERO, dtype=dtype, device=class_id.device).scatter_(1, class_id[:, None], 0.0)


def sample_categorical(log_probabilities: Tensor, uniform: Tensor) -> Tensor:
    """Draw a class per voxel by inversion of the cumulative distribution.

    Args:
        log_probabilities: (b, K, *grid) logarithms of normalised probabilities.
        uniform: (b, *grid) random numbers between 0 and 1.

    Returns:
        (b, *grid) int64 class ids.
    """
    return (uniform[:, None] >= log_probabilities.exp().cumsum(1)[:, :-1]).sum(1)


class MultinomialDiffusion(nn.Module):
    """Forward process, reverse process and training loss. The module has no parameters.

    Args:
        num_classes: Number K of classes, at least 2.
        num_timesteps: Number T of steps.

    Attributes:
        log_step: (T, 2) float64 logarithms of alpha_t and 1 - alpha_t.
        log_total: (T + 1, 2) float64 logarithms of the product of the first n alphas, and of 1 - this product.
    """

    log_step: Tensor
    log_total: Tensor

    def __init__(self, num_classes: int, num_timesteps: int = 100) -> None:
        super().__init__()
        self.num_classes, self.num_timesteps = num_classes, num_timesteps
        register_computed_buffers(self)

    def compute_buffers(self) -> dict[str, Tensor]:
        """Return the tables of the cosine schedule.

        As in PDD, the square of the usual cumulative product is the square of a cosine, and alpha_t is not below
        LEAST_KEPT.

        Returns:
            log_step and log_total.
        """
        angle = torch.linspace(0, 1, self.num_timesteps + 1, dtype=torch.float64)
        level = torch.cos((angle + SCHEDULE_OFFSET) / (1 + SCHEDULE_OFFSET) * math.pi / 2)
        log_keep = (level[1:] / level[:-1]).clamp(LEAST_KEPT, 1).log()
        log_total = torch.cat([log_keep.new_zeros(1), log_keep.cumsum(0)])
        tables = {"log_step": log_keep, "log_total": log_total}
        return {
            name: torch.stack([value, torch.log(-torch.expm1(value)).clamp(min=LOG_ZERO)], 1)
            for name, value in tables.items()
        }

    def _look_up(self, table: Tensor, timestep: Tensor, like: Tensor) -> tuple[Tensor, Tensor]:
        """Return both columns of a table at the timesteps, shaped for tensors (b, K, *grid)."""
        keep, replace = table[timestep].to(like.dtype).view(-1, 2, *(1,) * (like.dim() - 1)).unbind(1)
        return keep, replace - math.log(self.num_classes)

    def add_noise(self, clean: Tensor, timestep: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
        """Draw from q(x_t | x_0).

        Args:
            clean: (b, *grid) int64 class ids.
            timestep: (b,) timesteps.
            generators: One generator per sample.

        Returns:
            (b, *grid) int64 class ids.
        """
        uniform = sample_uniform(list(generators), 2 * clean[0].numel(), clean.device)
        choice, drawn = uniform.view(len(clean), 2, *clean.shape[1:]).unbind(1)
        keep = self.log_total[timestep + 1, 0].exp().view(-1, *(1,) * (clean.dim() - 1))
        other = (drawn * self.num_classes).long().clamp(max=self.num_classes - 1)
        return torch.where(choice < keep, clean, other)

    def compute_log_posterior(self, log_clean: Tensor, noisy: Tensor, timestep: Tensor) -> Tensor:
        """Return the logarithm of q(x_{t-1} | x_t, x_0), with a distribution in the place of x_0.

        Args:
            log_clean: (b, K, *grid) logarithms of the probabilities of clean classes.
            noisy: (b, *grid) int64 class ids x_t.
            timestep: (b,) timesteps t. At 0, the result is the distribution of the clean class.

        Returns:
            (b, K, *grid) logarithms of normalised probabilities.
        """
        keep, replace = self._look_up(self.log_total, timestep, log_clean)
        before = torch.logaddexp(log_clean + keep, replace)
        step_keep, step_replace = self._look_up(self.log_step, timestep, log_clean)
        index = noisy[:, None]
        stays = before.gather(1, index) + torch.logaddexp(step_keep, step_replace)
        return (before + step_replace).scatter(1, index, stays).log_softmax(1)

    def compute_kl(self, log_clean: Tensor, clean: Tensor, noisy: Tensor, timestep: Tensor) -> Tensor:
        """Return the divergence of the true reverse step from the predicted one.

        Args:
            log_clean: (b, K, *grid) logarithms of the predicted probabilities of clean classes.
            clean: (b, *grid) int64 class ids.
            noisy: (b, *grid) int64 class ids.
            timestep: (b,) timesteps. At 0, the result is the negative log-likelihood of the clean class.

        Returns:
            (b, *grid) divergences (nats).
        """
        true = self.compute_log_posterior(make_log_one_hot(clean, self.num_classes, log_clean.dtype), noisy, timestep)
        return (true.exp() * (true - self.compute_log_posterior(log_clean, noisy, timestep))).sum(1)

    def compute_prior_kl(self) -> Tensor:
        """Return the divergence of q(x_T | x_0) from the uniform distribution, which all classes share.

        Returns:
            Divergence per voxel (nats).
        """
        keep, replace = self.log_total[-1]
        other = replace - math.log(self.num_classes)
        logs = torch.cat([torch.logaddexp(keep, other).view(1), other.expand(self.num_classes - 1)])
        return (logs.exp() * (logs + math.log(self.num_classes))).sum()

    def compute_gains(self, shares: Tensor) -> Tensor:
        """Return the divergence per timestep for independent voxels, whose exact reverse process is known.

        The sum over all timesteps is the entropy of the classes, less the information that is left in x_T.

        Args:
            shares: (K,) share of each class among the voxels.

        Returns:
            (T,) mean divergences per voxel (nats).
        """
        classes, timestep = self.num_classes, torch.arange(self.num_timesteps, device=shares.device)
        # Axis 1 of the grid is the clean class, and axis 2 the noisy class.
        clean = torch.arange(classes, device=shares.device)[:, None].expand(len(timestep), classes, classes)
        noisy = clean.transpose(1, 2)
        log_clean = shares.log().clamp(min=LOG_ZERO)[:, None, None].expand(len(timestep), classes, classes, classes)
        keep, replace = (part[:, 0] for part in self._look_up(self.log_total[1:], timestep, log_clean))
        joint = (torch.eye(classes, device=shares.device) * keep.exp() + replace.exp()) * shares[:, None]
        return (joint * self.compute_kl(log_clean, clean, noisy, timestep)).sum((1, 2))

    def weigh_timesteps(self, shares: Tensor) -> Tensor:
        """Return the probabilities of timesteps in the training: a mixture of `compute_gains` and equal probabilities.

        PDD estimates the probabilities from the losses of earlier steps. These estimates would depend on the number of
        workers and on the parts of a batch. The probabilities here follow from the data alone.

        Args:
            shares: (K,) share of each class among the voxels.

        Returns:
            (T,) probabilities.
        """
        gains = self.compute_gains(shares)
        return UNIFORM_SHARE / self.num_timesteps + (1 - UNIFORM_SHARE) * gains / gains.sum()

    def compute_losses(
        self, logits: Tensor, clean: Tensor, noisy: Tensor, timestep: Tensor, probability: Tensor
    ) -> dict[str, Tensor]:
        """Return the training loss per column of voxels, an estimate of the negative log-likelihood bound.

        Args:
            logits: (b, K, rows, cols, levels) predicted logits of the clean classes.
            clean: (b, rows, cols, levels) int64 class ids.
            noisy: (b, rows, cols, levels) int64 class ids x_t.
            timestep: (b,) timesteps t.
            probability: (b,) probabilities with which the timesteps were drawn.

        Returns:
            loss: divergence / probability + prior + AUXILIARY_WEIGHT (2 - t / T) cross-entropy / probability, summed
            over the voxels of a column (nats). bound: the loss without the cross-entropy. cross_entropy: mean
            cross-entropy of the clean classes (nats per voxel).
        """
        log_clean = logits.log_softmax(1)
        kl = self.compute_kl(log_clean, clean, noisy, timestep).flatten(1).mean(1)
        cross_entropy = -log_clean.gather(1, clean[:, None]).flatten(1).mean(1)
        auxiliary = torch.where(timestep == 0, kl, cross_entropy)
        weight = AUXILIARY_WEIGHT * (2 - timestep / self.num_timesteps)
        bound = kl / probability + self.compute_prior_kl().to(kl.dtype)
        loss = bound + weight * auxiliary / probability
        levels = clean.shape[-1]
        return {
            "loss": levels * loss.mean(),
            "bound": levels * bound.detach().mean(),
            "cross_entropy": cross_entropy.detach().mean(),
        }

    @torch.no_grad()
    def sample(
        self,
        denoise: Callable[[Tensor, Tensor], Tensor],
        shape: tuple[int, ...],
        generators: Sequence[torch.Generator],
        clean: Tensor | None = None,
        known: Tensor | None = None,
    ) -> Tensor:
        """Draw clean classes with the reverse process.

        Known voxels are replaced by their noised version before each step, and by their classes at the end.

        Args:
            denoise: Function of noisy classes (b, *grid) and timesteps (b,) that returns logits (b, K, *grid).
            shape: Shape of the grid of a sample.
            generators: One generator per sample. A sample depends only on its generator.
            clean: (b, *grid) int64 classes of known voxels; None: no voxel is known.
            known: (b, *grid) bool: voxels to keep.

        Returns:
            (b, *grid) int64 class ids.
        """
        device, count = self.log_step.device, math.prod(shape)

        def draw() -> Tensor:
            return sample_uniform(list(generators), count, device).view(-1, *shape)

        noisy = (draw() * self.num_classes).long().clamp(max=self.num_classes - 1)
        for step in reversed(range(self.num_timesteps)):
            timestep = torch.full((len(noisy),), step, device=device)
            if clean is not None and known is not None:
                noisy = torch.where(known, self.add_noise(clean, timestep, generators), noisy)
            log_clean = denoise(noisy, timestep).log_softmax(1)
            noisy = sample_categorical(self.compute_log_posterior(log_clean, noisy, timestep), draw())
        return noisy if clean is None or known is None else torch.where(known, clean, noisy)
