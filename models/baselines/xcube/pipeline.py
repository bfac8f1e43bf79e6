"""Generation, reconstruction and inpainting of scenes with the trained networks of XCube."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor

from models.baselines.base import Grids, Networks, VoxelPipeline, coarsen_grids
from models.baselines.sparse import Sites
from models.baselines.xcube.diffusion import CoarseDiffusion, FineDiffusion, sample_latents
from models.baselines.xcube.losses import (
    COARSE,
    COARSE_DIFFUSION,
    COARSE_VAE,
    FINE_DIFFUSION,
    FINE_VAE,
    encode_scenes,
)
from models.baselines.xcube.vae import VoxelVAE
from models.training import sample_noise
from models.voxel_grids import EMPTY, FINE, Factor


class Pipeline(VoxelPipeline):
    """Trained networks of XCube, which generate coarse voxels, then fine voxels in the coarse voxels.

    Memory: scenes are encoded and decoded one after another. The number of voxels of a scene has the bound of its grid,
    so a sampled level that is full of voxels needs about two gigabytes with the preset `paper`. The latents of all
    scenes of a call are sampled together.

    Args:
        networks: Networks of the stages coarse_vae, fine_vae, coarse_diffusion and fine_diffusion.

    Raises:
        ValueError: A network is missing, or networks do not fit together.
    """

    method: ClassVar[str] = "xcube"
    factors: tuple[Factor, ...] = (COARSE, FINE)

    def __init__(self, networks: Networks) -> None:
        names = (COARSE_VAE, FINE_VAE, COARSE_DIFFUSION, FINE_DIFFUSION)
        if missing := [name for name in names if name not in networks]:
            raise ValueError(f"xcube: the network of the stage {missing[0]} is missing; train all stages: {names}")
        super().__init__(networks)
        self.coarse_vae, self.fine_vae = (cast(VoxelVAE, self.networks[name]) for name in names[:2])
        self.coarse_diffusion = cast(CoarseDiffusion, self.networks[COARSE_DIFFUSION])
        self.fine_diffusion = cast(FineDiffusion, self.networks[FINE_DIFFUSION])
        for vae, name in ((self.coarse_vae, COARSE_DIFFUSION), (self.fine_vae, FINE_DIFFUSION)):
            channels, expected = self.networks[name].config.channels, vae.config.latent_channels
            if channels != expected:
                raise ValueError(f"xcube: {name} has {channels} channels, expected those of its VAE, {expected}")
        if self.fine_vae.factor != COARSE[0] or self.fine_vae.condition is None:
            raise ValueError(
                f"xcube: the fine VAE has the widths {self.fine_vae.config.widths} and condition_channels"
                f" {self.fine_vae.config.condition_channels}, expected three widths and a condition"
            )
        if self.coarse_vae.condition is not None:
            raise ValueError("xcube: the coarse VAE has a condition, expected condition_channels 0")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Rows, columns and levels of the finest grid."""
        step = self.coarse_vae.factor * COARSE[0]
        rows, cols, levels = (side * step for side in self.coarse_diffusion.config.shape)
        return rows, cols, levels

    def sample(self, generators: Sequence[torch.Generator]) -> Grids:
        """Generate scenes.

        Args:
            generators: One generator per scene. A scene depends only on its generator.

        Returns:
            Grids of the levels (4, 4, 4) and (1, 1, 1). A scene whose coarse level is empty is empty.
        """
        coarse = self._sample_coarse(list(generators))
        return {COARSE: coarse, FINE: self._sample_fine(coarse, list(generators))}

    @torch.no_grad()
    def reconstruct(self, voxels: Tensor) -> Grids:
        """Encode and decode each level of scenes with its VAE. The fine level is given the true coarse level.

        Args:
            voxels: (n, rows, cols, levels) uint8: finest grids of the scenes.

        Returns:
            Grids of the levels (4, 4, 4) and (1, 1, 1).
        """
        voxels, coarse = voxels.to(self.device), coarsen_grids(voxels, COARSE).to(self.device)
        latent, _, sites = encode_scenes(self.coarse_vae, coarse, None)
        fine_latent, _, fine_sites = encode_scenes(self.fine_vae, voxels, coarse)
        return {
            COARSE: self._decode(self.coarse_vae, latent, sites, None),
            FINE: self._decode(self.fine_vae, fine_latent, fine_sites, coarse),
        }

    @torch.no_grad()
    def inpaint(self, voxels: Tensor, unknown: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
        """Generate a part of given scenes: the coarse level, then the fine level.

        At each step, the latents of known columns are replaced by the noisy latents of the known part (RePaint without
        resampling). A latent is known if all of its columns are known. The known part is encoded without the unknown
        part, and overwrites the result.

        Args:
            voxels: (n, rows, cols, levels) uint8: finest grids of the scenes.
            unknown: (n, rows, cols) bool: columns to generate. Their voxels are not read.
            generators: One generator per scene.

        Returns:
            (n, rows, cols, levels) uint8: the scenes. Known columns are those of `voxels`.

        Raises:
            ValueError: The scenes have another size than those that the networks generate.
        """
        if tuple(voxels.shape[1:]) != self.shape or unknown.shape != voxels.shape[:3]:
            raise ValueError(
                f"voxels of the shape {tuple(voxels.shape)} and unknown of the shape {tuple(unknown.shape)},"
                f" expected scenes of {self.shape}"
            )
        voxels, unknown = voxels.to(self.device), unknown.to(self.device)
        known = torch.where(unknown[..., None], EMPTY, voxels)
        coarse = self._sample_coarse(list(generators), coarsen_grids(known, COARSE), _coarsen_mask(unknown, COARSE[0]))
        fine = self._sample_fine(coarse, list(generators), known, unknown)
        return torch.where(unknown[..., None], fine, voxels)

    @torch.no_grad()
    def _sample_coarse(
        self, generators: list[torch.Generator], known: Tensor | None = None, unknown: Tensor | None = None
    ) -> Tensor:
        """Sample coarse voxels.

        Args:
            generators: One generator per scene.
            known: (n, rows, cols, levels) uint8 coarse voxels of the known part.
            unknown: (n, rows, cols) bool: coarse columns with unknown fine columns.

        Returns:
            (n, rows, cols, levels) uint8. Known columns are those of `known`. In other columns, a voxel with known
            content is not empty.
        """
        vae, network = self.coarse_vae, self.coarse_diffusion
        shape, scale = (*network.config.shape, network.config.channels), network.config.scale
        latent_known = latent_unknown = None
        if known is not None and unknown is not None:
            mean, _, sites = encode_scenes(vae, known, None)
            latent_known = sites.to_dense(mean / scale)
            latent_unknown = _coarsen_mask(unknown, vae.factor)[..., None, None]

        def predict(latent: Tensor, timestep: int) -> Tensor:
            at = torch.full((len(generators),), timestep, device=self.device)
            return network(latent.movedim(-1, 1), at).movedim(1, -1)

        def draw() -> Tensor:
            return sample_noise(generators, shape, self.device)[0]

        latent = sample_latents(predict, network.make_sampling_schedule(), draw, latent_known, latent_unknown)
        top = Sites.from_mask(torch.ones(latent.shape[:4], dtype=torch.bool, device=self.device))
        voxels = self._decode(vae, latent.flatten(0, 3) * scale, top, None)
        if known is None or unknown is None:
            return voxels
        return torch.where(unknown[..., None] & (voxels != EMPTY), voxels, known)

    @torch.no_grad()
    def _sample_fine(
        self,
        coarse: Tensor,
        generators: list[torch.Generator],
        known: Tensor | None = None,
        unknown: Tensor | None = None,
    ) -> Tensor:
        """Sample fine voxels in coarse voxels.

        Args:
            coarse: (n, rows, cols, levels) uint8 coarse voxels.
            generators: One generator per scene.
            known: (n, 4 rows, 4 cols, 4 levels) uint8 fine voxels of the known part.
            unknown: (n, 4 rows, 4 cols) bool: unknown fine columns.

        Returns:
            (n, 4 rows, 4 cols, 4 levels) uint8. All voxels lie in coarse voxels that are not empty.
        """
        vae, network = self.fine_vae, self.fine_diffusion
        sites = network.find_sites(Sites.from_mask(coarse != EMPTY))
        top, channels, scale = sites[0], network.config.channels, network.config.scale
        classes = coarse[top.coords.unbind(1)].long()
        counts = torch.bincount(top.scene, minlength=len(coarse)).tolist()
        latent_known = latent_unknown = None
        if known is not None and unknown is not None:
            latent_known = encode_scenes(vae, known, coarse)[0] / scale
            scene, row, col, _ = top.coords.unbind(1)
            latent_unknown = _coarsen_mask(unknown, COARSE[0])[scene, row, col][:, None]

        def draw() -> Tensor:
            noise = [torch.randn(n, channels, generator=g) for n, g in zip(counts, generators, strict=True)]
            return torch.cat(noise).to(self.device)

        def predict(latent: Tensor, timestep: int) -> Tensor:
            return network(latent, torch.full((len(coarse),), timestep, device=self.device), classes, sites)

        latent = sample_latents(predict, network.make_sampling_schedule(), draw, latent_known, latent_unknown)
        return self._decode(vae, latent * scale, top, coarse)

    @torch.no_grad()
    def _decode(self, vae: VoxelVAE, latent: Tensor, top: Sites, coarse: Tensor | None) -> Tensor:
        """Decode scenes one after another, so the memory does not grow with their number.

        Args:
            vae: VAE.
            latent: (n, channels) latents.
            top: Voxels of the bottleneck.
            coarse: (b, rows, cols, levels) coarse voxels, if the VAE has a condition.

        Returns:
            (b, rows, cols, levels) uint8 voxels of the level of the VAE.
        """
        scenes = []
        for k in range(top.shape[0]):
            one = Sites.from_mask(top.mask[k : k + 1])
            of_coarse = None if coarse is None else coarse[k : k + 1].long()
            scenes.append(vae.decode(latent[top.scene == k], one, of_coarse).to_voxels())
        return torch.cat(scenes)


def _coarsen_mask(mask: Tensor, step: int) -> Tensor:
    """Return which blocks of step x step columns contain True.

    Args:
        mask: (n, rows, cols) bool.
        step: Side of a block.

    Returns:
        (n, rows / step, cols / step) bool.
    """
    return F.max_pool2d(mask[:, None].float(), step)[:, 0] > 0
