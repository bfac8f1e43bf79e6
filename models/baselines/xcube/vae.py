"""Sparse VAE of XCube for one level of the hierarchy, with structure prediction and pruning."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

from models.base import ConfiguredModel, register_to_config
from models.baselines.sparse import CHILDREN, Sites, SparseConvolution, SparseDownsample, SparseUpsample
from models.options import Integer, Number, Rule, Sequential, check_entries
from models.voxel_grids import EMPTY, NUM_CLASSES, coarsen_shape

LOGVAR_RANGE = (-30.0, 20.0)
RULES: dict[str, Rule] = {
    "widths": Sequential(Integer(1, 4096), 2, 8),
    "blocks": Integer(1, 16),
    "latent_channels": Integer(1, 1024),
    "condition_channels": Integer(0, 1024),
    "num_classes": Integer(2, 256),
    "structure_weight": Number(0, 1e6),
    "semantic_weight": Number(0, 1e6),
    "kl_weight": Number(0, 1e6),
}


def mean_per_scene(values: Float[Tensor, " n"], sites: Sites) -> Float[Tensor, " b"]:
    """Average values of active voxels over each scene.

    Args:
        values: Values of active voxels.
        sites: Active voxels.

    Returns:
        float32 mean of each scene; 0 for a scene without active voxels.
    """
    values = values.float()
    sums = values.new_zeros(2, sites.shape[0])
    total, count = sums.index_add(1, sites.scene, torch.stack([values, torch.ones_like(values)]))
    return total / count.clamp(min=1)


class SparseResidualBlock(nn.Module):
    """Two submanifold convolutions with a skip connection.

    Args:
        inputs: Number of input channels.
        outputs: Number of output channels.
        embedding: Number of channels of an embedding of each scene, which scales and shifts features; 0: none.
    """

    def __init__(self, inputs: int, outputs: int, embedding: int = 0) -> None:
        super().__init__()
        self.norms = nn.ModuleList([nn.LayerNorm(inputs), nn.LayerNorm(outputs)])
        self.convolutions = nn.ModuleList(
            [SparseConvolution(inputs, outputs), SparseConvolution(outputs, outputs, zero=True)]
        )
        self.modulation = nn.Linear(embedding, 2 * outputs) if embedding else None
        self.skip = nn.Linear(inputs, outputs) if inputs != outputs else nn.Identity()

    def forward(
        self, x: Float[Tensor, "n inputs"], sites: Sites, embedding: Float[Tensor, "b e"] | None = None
    ) -> Float[Tensor, "n outputs"]:
        """Apply the block.

        Args:
            x: Features of active voxels.
            sites: Active voxels.
            embedding: Embedding of each scene, if the block has one.

        Returns:
            Features of the same voxels.
        """
        h = self.norms[1](self.convolutions[0](F.silu(self.norms[0](x)), sites))
        if self.modulation is not None:
            scale, shift = self.modulation(embedding)[sites.scene].chunk(2, dim=1)
            h = h * (1 + scale) + shift
        return self.skip(x) + self.convolutions[1](F.silu(h), sites)


class Posterior(NamedTuple):
    """Normal distribution of latents.

    Attributes:
        mean: (n, channels) mean.
        logvar: (n, channels) logarithm of the variance.
        sites: The n voxels of the bottleneck.
    """

    mean: Tensor
    logvar: Tensor
    sites: Sites

    def sample(self, noise: Float[Tensor, "b rows cols levels channels"]) -> Float[Tensor, "n channels"]:
        """Draw latents.

        Args:
            noise: Standard normal noise of all cells of the bottleneck.

        Returns:
            Latents.
        """
        return self.mean + (0.5 * self.logvar).exp() * noise[self.sites.coords.unbind(1)]


class Decoded(NamedTuple):
    """Output of the decoder.

    Attributes:
        structure: For each division of voxels, from coarse to fine: (m, 8) logits of the children.
        sites: The n voxels of the finest grid.
        semantic: (n, num_classes - 1) logits of the classes that are not empty.
    """

    structure: list[Tensor]
    sites: Sites
    semantic: Tensor

    def to_voxels(self) -> UInt8[Tensor, "b rows cols levels"]:
        """Return the most probable class of each voxel."""
        return self.sites.to_dense((self.semantic.argmax(1) + 1).to(torch.uint8), EMPTY)


class VoxelVAE(ConfiguredModel):
    """Encode semantic voxels to latents at the voxels of a coarser grid, and decode them.

    Args:
        widths: Number of channels of each level. Each level but the first has voxels of twice the size.
        blocks: Number of residual blocks per level, in the encoder and in the decoder.
        latent_channels: Number of channels of a latent.
        condition_channels: Number of channels of the embedding of the coarser level. 0: the VAE is that of the coarsest
            level. It has no condition, and its bottleneck holds all cells of the grid.
        num_classes: Number of classes, with that of empty voxels.
        structure_weight: Weight of the cross-entropy of the structure of each level.
        semantic_weight: Weight of the cross-entropy of the classes.
        kl_weight: Weight of the KL divergence of a voxel of the bottleneck.
    """

    @register_to_config
    def __init__(
        self,
        widths: Sequence[int] = (64, 128, 256, 512),
        blocks: int = 1,
        latent_channels: int = 8,
        condition_channels: int = 0,
        num_classes: int = NUM_CLASSES,
        structure_weight: float = 20.0,
        semantic_weight: float = 20.0,
        kl_weight: float = 0.03,
    ) -> None:
        super().__init__()
        first, last = widths[0], widths[-1]
        pairs = list(zip(widths[:-1], widths[1:], strict=True))

        def make_blocks(width: int) -> nn.ModuleList:
            return nn.ModuleList([SparseResidualBlock(width, width) for _ in range(blocks)])

        self.embed = nn.Embedding(num_classes, first)
        self.encoder = nn.ModuleList([make_blocks(width) for width in widths])
        self.down = nn.ModuleList([SparseDownsample(*pair) for pair in pairs])
        self.moments = nn.Sequential(nn.LayerNorm(last), nn.Linear(last, 2 * latent_channels))
        self.condition = nn.Embedding(num_classes, condition_channels) if condition_channels else None
        self.input = nn.Linear(latent_channels + condition_channels, last)
        self.decoder = nn.ModuleList([make_blocks(width) for width in widths])
        self.structure = nn.ModuleList([nn.Linear(width, CHILDREN) for width in widths[1:]])
        self.up = nn.ModuleList([SparseUpsample(fine, coarse) for coarse, fine in pairs])
        self.output = nn.Sequential(nn.LayerNorm(first), nn.SiLU(), nn.Linear(first, num_classes - 1))

    @classmethod
    def parse_config(cls, config: dict[str, Any]) -> dict[str, Any]:
        """Check all entries.

        Args:
            config: Value of every constructor argument.

        Returns:
            Keyword arguments of the constructor.

        Raises:
            ValueError: An entry has an invalid value.
        """
        check_entries(config, RULES)
        return config

    @property
    def factor(self) -> int:
        """Edge length of a voxel of the bottleneck, in voxels of the input."""
        return 2 ** (len(self.config.widths) - 1)

    def coarsen_shape(self, shape: Sequence[int]) -> tuple[int, int, int]:
        """Return the size of the bottleneck.

        Args:
            shape: Rows, columns and levels of the input.

        Returns:
            Rows, columns and levels of the bottleneck.

        Raises:
            ValueError: A side of the input is not a multiple of `factor`.
        """
        return coarsen_shape(tuple(shape), (self.factor, self.factor, self.factor))

    def find_sites(self, voxels: Int[Tensor, "b r c l"], coarse: Int[Tensor, "b rr cc ll"] | None) -> list[Sites]:
        """Find the active voxels of all levels.

        Args:
            voxels: Class ids.
            coarse: Class ids of the coarser level; None: the VAE is that of the coarsest level.

        Returns:
            Active voxels from the level of `voxels` to the bottleneck.

        Raises:
            ValueError: The coarser level is missing or not expected, or has another size than the bottleneck.
        """
        shape = self.coarsen_shape(voxels.shape[1:])
        if (coarse is None) != (self.condition is None):
            raise ValueError(f"a VAE with condition_channels {self.config.condition_channels} got coarse {coarse}")
        if coarse is not None and coarse.shape[1:] != shape:
            raise ValueError(f"the coarser level has the size {tuple(coarse.shape[1:])}, expected {shape}")
        sites = [Sites.from_mask(voxels != EMPTY)]
        for _ in range(len(self.config.widths) - 2):
            sites.append(sites[-1].coarsen())
        if coarse is None:
            top = torch.ones((len(voxels), *shape), dtype=torch.bool, device=voxels.device)
        else:
            top = coarse != EMPTY
        return [*sites[: len(self.config.widths) - 1], Sites.from_mask(top)]

    def encode(self, voxels: Int[Tensor, "b r c l"], sites: list[Sites]) -> Posterior:
        """Encode voxels.

        Args:
            voxels: Class ids.
            sites: Active voxels of all levels, of `find_sites`.

        Returns:
            Distribution of the latents.
        """
        h = self.embed(voxels[sites[0].coords.unbind(1)])
        for level, blocks in enumerate(self.encoder):
            if level:
                h = self.down[level - 1](h, sites[level - 1], sites[level])
            for block in blocks:  # pyright: ignore[reportGeneralTypeIssues]
                h = block(h, sites[level])
        mean, logvar = self.moments(h).float().chunk(2, dim=1)
        return Posterior(mean, logvar.clamp(*LOGVAR_RANGE), sites[-1])

    def decode(
        self,
        latent: Float[Tensor, "n channels"],
        top: Sites,
        coarse: Int[Tensor, "b rr cc ll"] | None = None,
        sites: list[Sites] | None = None,
    ) -> Decoded:
        """Decode latents.

        Args:
            latent: Latents.
            top: Voxels of the bottleneck.
            coarse: Class ids of the coarser level, if the VAE has a condition.
            sites: True active voxels of all levels, for training. None: voxels are pruned where the predicted
                probability is below 1/2.

        Returns:
            Structure and classes.
        """
        if self.condition is not None and coarse is not None:
            latent = torch.cat([latent, self.condition(coarse[top.coords.unbind(1)])], dim=1)
        h, now, structure = self.input(latent), top, []
        for level in reversed(range(len(self.decoder))):
            for block in self.decoder[level]:  # pyright: ignore[reportGeneralTypeIssues]
                h = block(h, now)
            if level:
                structure.append(self.structure[level - 1](h))
                finer = now.refine(structure[-1] > 0) if sites is None else sites[level - 1]
                h, now = self.up[level - 1](h, now, finer), finer
        return Decoded(structure, now, self.output(h))

    def forward(
        self,
        voxels: Int[Tensor, "b r c l"],
        noise: Float[Tensor, "b rr cc ll channels"],
        coarse: Int[Tensor, "b rr cc ll"] | None = None,
    ) -> dict[str, Tensor]:
        """Compute the losses of each scene.

        Args:
            voxels: Class ids.
            noise: Standard normal noise of all cells of the bottleneck.
            coarse: Class ids of the coarser level, if the VAE has a condition.

        Returns:
            (b,) losses: structure (sum over levels), semantic, kl, and loss, their weighted sum.
        """
        sites = self.find_sites(voxels, coarse)
        posterior = self.encode(voxels, sites)
        decoded = self.decode(posterior.sample(noise), sites[-1], coarse, sites)
        structure = torch.zeros(len(voxels), device=voxels.device)
        for logits, parent, fine in zip(decoded.structure, sites[:0:-1], sites[-2::-1], strict=True):
            exists = (parent.find_children(fine) < len(fine)).float()
            entropy = F.binary_cross_entropy_with_logits(logits.float(), exists, reduction="none")
            structure = structure + mean_per_scene(entropy.mean(1), parent)
        target = voxels[sites[0].coords.unbind(1)] - 1
        semantic = mean_per_scene(F.cross_entropy(decoded.semantic.float(), target, reduction="none"), sites[0])
        mean, logvar = posterior.mean, posterior.logvar
        kl = mean_per_scene(0.5 * (mean**2 + logvar.exp() - 1 - logvar).sum(1), posterior.sites)
        weights = self.config
        loss = weights.structure_weight * structure + weights.semantic_weight * semantic + weights.kl_weight * kl
        return {"loss": loss, "structure": structure, "semantic": semantic, "kl": kl}
