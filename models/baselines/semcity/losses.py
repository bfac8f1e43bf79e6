"""Losses of both stages of SemCity."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor

from models.base import ConfiguredModel
from models.baselines.base import Networks, flip_grids, read_grids
from models.baselines.lovasz import compute_lovasz_softmax
from models.baselines.semcity.autoencoder import TriplaneAutoencoder, find_positions
from models.baselines.semcity.queries import select_queries
from models.baselines.semcity.unet import TriplaneUNet
from models.training import LossFunction, sample_noise, sample_timesteps, sample_uniform
from models.voxel_grids import Factor


def weigh_classes(class_counts: Sequence[int]) -> Tensor:
    """Return the weight of each class in the cross-entropy: the cube root of f_max / f.

    Args:
        class_counts: Number of voxels of each class in the training split.

    Returns:
        (classes,) weights; classes that do not occur have weight 0.
    """
    counts = torch.tensor(class_counts, dtype=torch.float64)
    return torch.where(counts > 0, (counts.max() / counts.clamp(min=1)) ** (1 / 3), 0.0).float()


def make_autoencoder_loss(factor: Factor, num_queries: int, class_order: bool = False) -> Callable:
    """Return `Stage.make_loss` of the autoencoder: weighted cross-entropy and Lovasz-Softmax at selected voxels.

    Args:
        factor: Size of the voxels.
        num_queries: Number of voxels per scene.
        class_order: Whether voxels are listed by class (`select_queries`).

    Returns:
        Function that returns the loss.
    """

    def make_loss(network: ConfiguredModel, networks: Networks, class_counts: Sequence[int]) -> LossFunction:
        weights = weigh_classes(class_counts)

        def loss(
            model: Callable[..., Any], arrays: dict[str, Tensor], generators: list[torch.Generator]
        ) -> dict[str, Tensor]:
            voxels = read_grids(arrays, factor)
            (voxels,) = flip_grids([voxels], sample_uniform(generators, 2, voxels.device))
            index = torch.stack(
                [
                    select_queries(one, num_queries, generator, class_order)
                    for one, generator in zip(voxels, generators, strict=True)
                ]
            )
            logits = model(voxels, find_positions(index, voxels.shape[1:])).float().flatten(0, 1)
            labels = voxels.flatten(1).gather(1, index).flatten()
            entropy = F.cross_entropy(logits, labels, weights.to(logits.device))
            lovasz = compute_lovasz_softmax(logits.softmax(dim=1), labels)
            accuracy = (logits.detach().argmax(dim=1) == labels).float().mean()
            return {"loss": entropy + lovasz, "cross_entropy": entropy, "lovasz": lovasz, "accuracy": accuracy}

        return loss

    return make_loss


def make_diffusion_loss(factor: Factor) -> Callable:
    """Return `Stage.make_loss` of the diffusion: the squared error of the clean triplane.

    Args:
        factor: Size of the voxels.

    Returns:
        Function that returns the loss.
    """

    def make_loss(network: ConfiguredModel, networks: Networks, class_counts: Sequence[int]) -> LossFunction:
        autoencoder = cast(TriplaneAutoencoder, networks["autoencoder"])
        diffusion = cast(TriplaneUNet, network).diffusion

        def loss(
            model: Callable[..., Any], arrays: dict[str, Tensor], generators: list[torch.Generator]
        ) -> dict[str, Tensor]:
            voxels = read_grids(arrays, factor)
            uniform = sample_uniform(generators, 3, voxels.device)
            (noise,) = sample_noise(generators, autoencoder.latent_shape, voxels.device)
            (voxels,) = flip_grids([voxels], uniform[:, :2])
            with torch.no_grad():
                clean = autoencoder.encode(voxels).float()
            timestep = sample_timesteps(uniform[:, 2], "uniform", diffusion.num_timesteps)
            predicted = model(diffusion.add_noise(clean, noise, timestep), timestep).float()
            error = F.mse_loss(predicted, clean)
            return {"loss": error, "relative_error": error / clean.var()}

        return loss

    return make_loss
