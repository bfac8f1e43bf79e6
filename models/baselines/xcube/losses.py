"""Losses of the four stages of XCube, and statistics of latents. Random numbers come from one generator per sample."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, cast

import torch
from torch import Tensor

from models.base import ConfiguredModel
from models.baselines.base import Networks, read_grids
from models.baselines.sparse import Sites
from models.baselines.xcube.diffusion import FineDiffusion, LatentDiffusion, velocity_error
from models.baselines.xcube.vae import VoxelVAE, mean_per_scene
from models.training import LossFunction, sample_noise, sample_timesteps, sample_uniform
from models.voxel_grids import FINE, Factor

COARSE: Factor = (4, 4, 4)
COARSE_VAE, FINE_VAE, COARSE_DIFFUSION, FINE_DIFFUSION = "coarse_vae", "fine_vae", "coarse_diffusion", "fine_diffusion"
MEASURED_SCENES = 8  # Scenes whose latents give the standard deviation.


def crop_grids(fine: Tensor, coarse: Tensor, uniform: Tensor, crop: int) -> tuple[Tensor, Tensor]:
    """Cut the same random square of columns out of both levels of each scene.

    Args:
        fine: (b, rows, cols, levels) fine voxels.
        coarse: (b, rows / 4, cols / 4, levels / 4) coarse voxels.
        uniform: (b, 2) random numbers between 0 and 1, which select the position.
        crop: Side of the square in coarse voxels; 0 or a side that exceeds the grid: the whole grid.

    Returns:
        Fine and coarse voxels of the squares.
    """
    starts, sizes = [], []
    for axis in (1, 2):
        size = min(crop or coarse.shape[axis], coarse.shape[axis])
        free = coarse.shape[axis] - size
        starts.append((uniform[:, axis - 1] * (free + 1)).long().clamp(max=free))
        sizes.append(size)

    def cut(grids: Tensor, step: int) -> Tensor:
        scene = torch.arange(len(grids), device=grids.device)[:, None, None]
        rows, cols = (
            start[:, None] * step + torch.arange(size * step, device=grids.device)
            for start, size in zip(starts, sizes, strict=True)
        )
        return grids[scene, rows[:, :, None], cols[:, None, :]]

    return cut(fine, COARSE[0]), cut(coarse, 1)


def draw_cell_noise(vae: VoxelVAE, voxels: Tensor, generators: list[torch.Generator], count: int = 1) -> Tensor:
    """Draw noise for all cells of the bottleneck of a VAE.

    Args:
        vae: VAE.
        voxels: (b, rows, cols, levels) class ids.
        generators: One generator per sample.
        count: Number of draws.

    Returns:
        (count, b, rows, cols, levels, channels) standard normal noise of the bottleneck.
    """
    shape = (*vae.coarsen_shape(voxels.shape[1:]), vae.config.latent_channels)
    return sample_noise(generators, shape, voxels.device, count)


def make_vae_loss(
    network: ConfiguredModel, networks: Networks, class_counts: Sequence[int], is_fine: bool, crop: int = 0
) -> LossFunction:
    """Return the loss of a VAE: structure, classes and KL divergence.

    Args:
        network: VAE.
        networks: Networks of earlier stages. They are not used.
        class_counts: Number of voxels of each class. They are not used.
        is_fine: Whether the VAE is that of the fine level.
        crop: Side of the training crops of the fine level in coarse voxels; 0: no crop.

    Returns:
        Loss function.
    """
    vae = cast(VoxelVAE, network)

    def loss(
        model: Callable[..., Any], arrays: dict[str, Tensor], generators: list[torch.Generator]
    ) -> dict[str, Tensor]:
        voxels, coarse = read_grids(arrays, COARSE), None
        if is_fine:
            uniform = sample_uniform(generators, 2, voxels.device)
            voxels, coarse = crop_grids(read_grids(arrays, FINE), voxels, uniform, crop)
        (noise,) = draw_cell_noise(vae, voxels, generators)
        return {name: value.mean() for name, value in model(voxels, noise, coarse).items()}

    return loss


def make_coarse_diffusion_loss(
    network: ConfiguredModel, networks: Networks, class_counts: Sequence[int]
) -> LossFunction:
    """Return the loss of the coarse diffusion: mean squared error of v.

    Args:
        network: Diffusion network of the coarse level.
        networks: Networks of earlier stages, with the coarse VAE.
        class_counts: Number of voxels of each class. They are not used.

    Returns:
        Loss function.
    """
    diffusion, vae = cast(LatentDiffusion, network), cast(VoxelVAE, networks[COARSE_VAE])

    def loss(
        model: Callable[..., Any], arrays: dict[str, Tensor], generators: list[torch.Generator]
    ) -> dict[str, Tensor]:
        voxels = read_grids(arrays, COARSE)
        uniform = sample_uniform(generators, 1, voxels.device)
        of_posterior, noise = draw_cell_noise(vae, voxels, generators, 2)
        with torch.no_grad():
            posterior = vae.encode(voxels, vae.find_sites(voxels, None))
            clean = posterior.sites.to_dense(posterior.sample(of_posterior)) / diffusion.config.scale
        timestep = sample_timesteps(uniform[:, 0], "uniform", len(diffusion.noise_shares))
        noisy, velocity = diffusion.noise_and_velocity(clean.movedim(-1, 1), noise.movedim(-1, 1), timestep)
        return {"loss": velocity_error(model(noisy, timestep), velocity).mean()}

    return loss


def make_fine_diffusion_loss(
    network: ConfiguredModel, networks: Networks, class_counts: Sequence[int], crop: int = 0
) -> LossFunction:
    """Return the loss of the fine diffusion: mean squared error of v at the coarse voxels that are not empty.

    Args:
        network: Diffusion network of the fine level.
        networks: Networks of earlier stages, with the fine VAE.
        class_counts: Number of voxels of each class. They are not used.
        crop: Side of the training crops in coarse voxels; 0: no crop.

    Returns:
        Loss function.
    """
    diffusion, vae = cast(FineDiffusion, network), cast(VoxelVAE, networks[FINE_VAE])

    def loss(
        model: Callable[..., Any], arrays: dict[str, Tensor], generators: list[torch.Generator]
    ) -> dict[str, Tensor]:
        whole = read_grids(arrays, COARSE)
        uniform = sample_uniform(generators, 3, whole.device)
        voxels, coarse = crop_grids(read_grids(arrays, FINE), whole, uniform[:, 1:], crop)
        of_posterior, noise = draw_cell_noise(vae, voxels, generators, 2)
        with torch.no_grad():
            posterior = vae.encode(voxels, vae.find_sites(voxels, coarse))
            clean = posterior.sample(of_posterior) / diffusion.config.scale
        top = posterior.sites
        timestep = sample_timesteps(uniform[:, 0], "uniform", len(diffusion.noise_shares))
        at = top.coords.unbind(1)
        noisy, velocity = diffusion.noise_and_velocity(clean, noise[at], timestep[top.scene])
        error = velocity_error(model(noisy, timestep, coarse[at], diffusion.find_sites(top)), velocity)
        return {"loss": mean_per_scene(error, top).mean()}

    return loss


@torch.no_grad()
def measure_latents(networks: Networks, arrays: dict[str, Tensor], is_fine: bool) -> dict[str, Any]:
    """Measure the standard deviation of latents, including the variance of the posteriors.

    Args:
        networks: Networks of earlier stages, with the VAE.
        arrays: Arrays of training samples. The first MEASURED_SCENES scenes are read.
        is_fine: Whether the latents are those of the fine level.

    Returns:
        `scale`: standard deviation. For the coarse level also `shape`: rows, columns and levels of the latents.
    """
    vae = cast(VoxelVAE, networks[FINE_VAE if is_fine else COARSE_VAE])
    grids = read_grids({name: value[:MEASURED_SCENES] for name, value in arrays.items()}, FINE if is_fine else COARSE)
    coarse = read_grids(arrays, COARSE)
    posteriors = [
        encode_scenes(vae, grids[k : k + 1].to(vae.device), coarse[k : k + 1].to(vae.device) if is_fine else None)
        for k in range(len(grids))
    ]
    mean, logvar = (torch.cat(parts).double() for parts in zip(*(p[:2] for p in posteriors), strict=True))
    deviation = float((mean.var(correction=0) + logvar.exp().mean()).sqrt()) if len(mean) else 1.0
    # The limits are those of the config.
    measured: dict[str, Any] = {"scale": min(max(deviation, 1e-6), 1e6)}
    return measured if is_fine else measured | {"shape": vae.coarsen_shape(grids.shape[1:])}


def encode_scenes(vae: VoxelVAE, voxels: Tensor, coarse: Tensor | None) -> tuple[Tensor, Tensor, Sites]:
    """Encode scenes one after another, so the memory does not grow with their number.

    Args:
        vae: VAE.
        voxels: (b, rows, cols, levels) class ids.
        coarse: (b, rows / 4, cols / 4, levels / 4) class ids of the coarser level, if the VAE has a condition.

    Returns:
        (n, channels) mean and logarithm of the variance of the latents, and the n voxels of the bottleneck.
    """
    posteriors = []
    for k in range(len(voxels)):
        scene, of_coarse = voxels[k : k + 1].long(), None if coarse is None else coarse[k : k + 1].long()
        posteriors.append(vae.encode(scene, vae.find_sites(scene, of_coarse)))
    mask = torch.cat([posterior.sites.mask for posterior in posteriors])
    mean, logvar = (torch.cat(parts) for parts in zip(*(p[:2] for p in posteriors), strict=True))
    return mean, logvar, Sites.from_mask(mask)
