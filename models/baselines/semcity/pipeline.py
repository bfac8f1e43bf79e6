"""Generate, reconstruct, inpaint and outpaint scenes with SemCity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor

from models.baselines.base import Grids, Networks, VoxelPipeline
from models.baselines.semcity.autoencoder import TriplaneAutoencoder
from models.baselines.semcity.triplane import project_unknown
from models.baselines.semcity.unet import TriplaneUNet
from models.sampling.diffusion import Denoiser, InpaintCondition, SamplingSchedule, SceneNoise, sample
from models.sampling.repaint import repaint_transitions
from models.voxel_grids import EMPTY, FINE_SHAPE

JUMP_LENGTH, RESAMPLINGS = 20, 5  # Of RePaint, as published.


class Pipeline(VoxelPipeline):
    """The trained networks of SemCity, `autoencoder` and `diffusion`."""

    method = "semcity"

    def __init__(self, networks: Networks) -> None:
        super().__init__(networks)
        self.autoencoder = cast(TriplaneAutoencoder, self.networks["autoencoder"])
        self.unet = cast(TriplaneUNet, self.networks["diffusion"])
        if tuple(self.unet.sizes) != tuple(self.autoencoder.sizes):
            raise ValueError(
                f"the diffusion generates planes of {tuple(self.unet.sizes)} cells, but the autoencoder reads"
                f" {tuple(self.autoencoder.sizes)}; train the stage diffusion with this autoencoder"
            )
        rows, cols, levels = (full // side for full, side in zip(FINE_SHAPE, self.shape, strict=True))
        self.factors = ((rows, cols, levels),)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Rows, columns and levels of the generated grids."""
        rows, cols, levels = self.autoencoder.config.shape
        return rows, cols, levels

    def _denoise(self) -> Denoiser:
        """Return a function that predicts the noise, which follows from the clean triplane of the network."""
        alpha_bar = torch.from_numpy(self.unet.diffusion.alpha_bar).float().to(self.device)

        def predict(latent: Tensor, timestep: Tensor, label: Tensor) -> Tensor:
            a = alpha_bar[timestep][:, None, None, None]
            clean = self.unet(latent, timestep).clamp(-1, 1)
            return (latent - a.sqrt() * clean) / (1 - a).sqrt()

        return predict

    def _sample_triplanes(
        self, generators: Sequence[torch.Generator], condition: InpaintCondition | None = None
    ) -> Tensor:
        diffusion = self.unet.diffusion
        steps = diffusion.num_timesteps
        jumps = repaint_transitions(steps, min(JUMP_LENGTH, steps), RESAMPLINGS) if condition else None
        noise = SceneNoise.from_generators(generators, self.autoencoder.latent_shape, self.device)
        label = torch.zeros(len(generators), dtype=torch.long, device=self.device)
        schedule = SamplingSchedule(diffusion, steps, large_variance=True)  # As published.
        return sample(self._denoise(), schedule, noise, label, jumps, condition)

    def sample(self, generators: Sequence[torch.Generator]) -> Grids:
        """Generate scenes by DDPM with all timesteps.

        Args:
            generators: One generator per scene. A scene depends only on its generator.

        Returns:
            Grids of the only level.
        """
        return {self.factors[0]: self.autoencoder.decode_voxels(self._sample_triplanes(generators))}

    @torch.no_grad()
    def reconstruct(self, voxels: Tensor) -> Grids:
        """Encode scenes to triplanes, and decode the most probable class of each voxel.

        Args:
            voxels: (n, rows, cols, levels) uint8 grids.

        Returns:
            Grids of the only level.
        """
        return {self.factors[0]: self.autoencoder.decode_voxels(self.autoencoder.encode(voxels.to(self.device)))}

    @torch.no_grad()
    def inpaint(self, voxels: Tensor, unknown: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
        """Generate a part of given scenes by RePaint on planes.

        The scene is encoded with empty voxels in unknown columns. Cells of the planes that depend on unknown columns
        are generated.

        Args:
            voxels: (n, rows, cols, levels) uint8 grids.
            unknown: (n, rows, cols) bool: columns to generate.
            generators: One generator per scene.

        Returns:
            (n, rows, cols, levels) uint8.
        """
        voxels, unknown = voxels.to(self.device), unknown.to(self.device)
        known = torch.where(unknown[..., None], EMPTY, voxels)
        latent = self.autoencoder.encode(known)
        mask = project_unknown(unknown, self.autoencoder.sizes).expand_as(latent)
        made = self.autoencoder.decode_voxels(self._sample_triplanes(generators, InpaintCondition(latent, mask)))
        return torch.where(unknown[..., None], made, voxels)
