"""Common parts of networks that are trained as diffusion models: schedule, labels, and weights of the loss."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from models.base import ConfiguredModel
from models.labels import LABELS
from models.limits import require_within
from models.options import Integer, Number, Rule, check_entries
from models.sampling.diffusion import Diffusion

SCHEDULE_RULES: dict[str, Rule] = {
    "num_timesteps": Integer(1, 2**31),
    "beta_start": Number(1e-9, 0.9999),
    "beta_end": Number(1e-9, 0.9999),
}


class DiffusionModel(ConfiguredModel, ABC):
    """A network that predicts the noise, or v, in latents (b, channels, size, size).

    Its config has the entries `schedule`, `prediction`, `label`, `num_labels`, `shift` and `scale`. Its buffer
    `noise_shares` (timesteps, 2) holds the weights of the latent and of v in the noise, of `make_noise_shares`.
    """

    noise_shares: Tensor

    @property
    @abstractmethod
    def latent_shape(self) -> tuple[int, int, int]:
        """Shape (c, h, w) of a latent."""

    @property
    @abstractmethod
    def num_mask_uniform(self) -> int:
        """Number of random numbers per sample of `make_known_masks`; 0 if the network reads no known part."""

    @abstractmethod
    def make_known_masks(self, uniform: Tensor, values: Tensor) -> Tensor:
        """Make masks of random known parts for the training.

        Args:
            uniform: (b, num_mask_uniform) random numbers between 0 and 1.
            values: (b, c, h, w) clean latents before normalisation.

        Returns:
            Masks with the shape of `values`; 1 marks values to generate, 0 marks known values.
        """

    @property
    def diffusion(self) -> Diffusion:
        """Noise schedule of the training."""
        return Diffusion(**self.config.schedule)

    @property
    def null_label(self) -> int:
        """Index of the null label."""
        return self.config.num_labels

    def loss_weight(self, timestep: Int[Tensor, " batch"]) -> Float[Tensor, " batch"]:
        """Return the weight of the squared noise error in the training loss.

        The weight is chosen such that the squared error of the network output (noise or v) has weight 1 at every
        timestep.

        Args:
            timestep: Timesteps.

        Returns:
            One weight per sample.
        """
        if self.config.prediction == "epsilon":
            return torch.ones(len(timestep), device=timestep.device)
        return self.noise_shares[timestep, 1] ** -2


def make_noise_shares(schedule: Diffusion) -> Tensor:
    """Return the weights of the latent and of v in the noise.

    Args:
        schedule: Noise schedule.

    Returns:
        (timesteps, 2) float32.

    Raises:
        LimitError: The schedule exceeds the limit of training timesteps.
    """
    require_within("model_timesteps", schedule.num_timesteps)
    alpha_bar = torch.from_numpy(schedule.alpha_bar)
    return torch.stack([(1 - alpha_bar).sqrt(), alpha_bar.sqrt()], dim=1).float()


def parse_schedule(schedule: Any) -> Diffusion:
    """Check the entry `schedule` of a stored config.

    Args:
        schedule: The entry, an object or a Diffusion.

    Returns:
        The noise schedule.

    Raises:
        ValueError: A value is invalid, or the schedule exceeds the limit of training timesteps.
    """
    if not isinstance(schedule, Diffusion):
        check_entries(schedule, SCHEDULE_RULES, "schedule")
        require_within("model_timesteps", schedule.get("num_timesteps", 1), "schedule.num_timesteps")
        schedule = Diffusion(**schedule)
    if schedule.beta_start > schedule.beta_end:
        raise ValueError(f"schedule.beta_start is {schedule.beta_start}, above beta_end {schedule.beta_end}")
    return schedule


def require_num_labels(config: Mapping[str, Any]) -> None:
    """Check that the entries `num_labels` and `label` of a config agree.

    Args:
        config: Checked entries.

    Raises:
        ValueError: They do not agree.
    """
    if config["num_labels"] != len(LABELS[config["label"]]):
        raise ValueError(
            f"num_labels is {config['num_labels']}, expected {len(LABELS[config['label']])}, the number of"
            f" {config['label']} labels"
        )
