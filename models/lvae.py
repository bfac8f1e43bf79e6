"""The layout VAE (paper, Sec. 3.2 and supplement B.2): two branches, one joint latent that stays split by channel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from diffusers import ConfigMixin, ModelMixin
from diffusers.configuration_utils import register_to_config
from jaxtyping import Float
from torch import Tensor

from models.cells import CellDecoder
from models.ground import GroundDecoder, GroundEncoder
from models.ground import start_at as start_ground
from models.layout import FEATURES, LayoutBatch, LayoutSpec
from models.matching import MatchWeights
from models.objects import ObjectDecoder, ObjectEncoder
from models.tensors import DecodedLayout


@dataclass(frozen=True, eq=False)
class Posterior:
    """Diagonal Gaussian over the joint layout latent: the first half of the channels is ground, the second objects."""

    mean: Float[Tensor, "batch c2 h w"]
    logvar: Float[Tensor, "batch c2 h w"]

    def sample(self, noise: Float[Tensor, "batch c2 h w"]) -> Float[Tensor, "batch c2 h w"]:
        """Reparameterised sample for standard normal noise."""
        return self.mean + (0.5 * self.logvar).exp() * noise


@dataclass(frozen=True, eq=False)
class LayoutOutput:
    """What the decoders say, normalised as in LayoutBatch; logits where a probability is meant.

    The object decoder proposes `proposals[k]` primitives of category k: the spec's slots (DETR) or more (cells).
    """

    height: Float[Tensor, "batch ground rows cols"]
    occupancy_logit: Float[Tensor, "batch ground rows cols"]
    features: Float[Tensor, "batch proposals 9"]
    existence_logit: Float[Tensor, "batch proposals"]
    proposals: tuple[int, ...]
    match_weights: MatchWeights

    def layouts(self) -> list[DecodedLayout]:
        """One numpy layout per sample, probabilities instead of logits."""
        parts = (self.occupancy_logit.sigmoid(), self.height, self.features, self.existence_logit.sigmoid())
        category = np.repeat(np.arange(len(self.proposals)), self.proposals)
        return [
            DecodedLayout(*sample, category) for sample in zip(*(p.float().cpu().numpy() for p in parts), strict=True)
        ]


# Posteriors start narrow (sigma 0.14): decoders see the latent, not noise, from the first step on. With sigma 1,
# the default, the same number of steps ends at 1.5 times the loss (tests/test_models.py, one batch, 300 steps).
INITIAL_LOGVAR = -4.0


def logit(probability: Tensor) -> Tensor:
    """Logit of a probability that may be 0 or 1."""
    return probability.clamp(0.01, 0.99).logit()


class LayoutVAE(ModelMixin, ConfigMixin):
    """Encodes layouts into a (2 c, h, w) latent and decodes them back.

    `layout` is a LayoutSpec as a dict, so that a saved model inverts its own outputs. h = w = raster pixels /
    (fold 2^(len(channels) - 1)). `shortcut`: a linear way past the ground networks. `decoder` is the paper's DETR or `cells`: proposals of each latent cell (cells.py).
    """

    @register_to_config
    def __init__(
        self,
        layout: dict,
        latent_channels: int = 32,
        channels: tuple[int, ...] = (64, 128, 256, 512),
        norm_groups: int = 32,
        fold: int = 1,
        width: int = 512,
        layers: int = 6,
        heads: int = 8,
        hidden: int = 1024,
        head_hidden: int = 1024,
        decoder: str = "detr",
        shortcut: bool = False,
    ) -> None:
        super().__init__()
        spec = LayoutSpec.from_dict(layout)
        factor = fold * 2 ** (len(channels) - 1)
        if spec.grid.rows != spec.grid.cols or spec.grid.rows % factor:
            raise ValueError(f"LayoutVAE needs a square grid divisible by {factor}, got {spec.grid}")
        size, num_classes = spec.grid.rows // factor, len(spec.ground_classes)
        ground = (num_classes, latent_channels, tuple(channels), norm_groups, fold, shortcut)
        self.ground_encoder, self.ground_decoder = GroundEncoder(*ground), GroundDecoder(*ground)
        self.object_encoder = ObjectEncoder(spec.slots, latent_channels, size, width, layers, heads, hidden)
        if decoder == "detr":
            self.object_decoder = ObjectDecoder(
                spec.slots, latent_channels, size, width, layers, heads, hidden, head_hidden
            )
        elif decoder == "cells":
            self.object_decoder = CellDecoder(spec.slots, latent_channels, size, width, layers)
        else:
            raise ValueError(f"LayoutVAE: decoder is {decoder!r}, expected 'detr' (the paper's) or 'cells'")
        with torch.no_grad():
            self.ground_encoder.net.conv_out.bias[latent_channels:] = INITIAL_LOGVAR
            self.object_encoder.grid[latent_channels:] = INITIAL_LOGVAR

    @torch.no_grad()
    def start_at(self, batch: LayoutBatch) -> None:
        """Start every output at its mean over `batch`, a sample of training layouts (shortcuts: models/ground.py).

        Adam moves a bias by about the learning rate per step: from zero, thousands of steps would go into learning
        that a pole is thin and that most pixels are no road.
        """
        start_ground(self.ground_encoder, self.ground_decoder, batch.height, batch.occupied)
        groups = list(zip(batch.features.split(self.spec.slots, 1), batch.real.split(self.spec.slots, 1), strict=True))
        features = torch.stack([f[r].mean(dim=0) if r.any() else f.new_full((FEATURES,), 0.5) for f, r in groups])
        count = torch.stack([r.sum() / len(r) for _, r in groups])
        self.object_decoder.start_at(logit(features), count)

    @property
    def spec(self) -> LayoutSpec:
        return LayoutSpec.from_dict(self.config.layout)

    @property
    def latent_shape(self) -> tuple[int, int, int]:
        """(2 c, h, w) of the joint latent."""
        moments, rows, cols = self.object_encoder.grid.shape
        return moments, rows, cols

    def encode(self, batch: LayoutBatch) -> Posterior:
        """Joint posterior: channel groups [ground; objects] of mean and of log-variance."""
        ground_mean, ground_logvar = self.ground_encoder(torch.cat([batch.height, batch.occupied], dim=1)).chunk(2, 1)
        object_mean, object_logvar = self.object_encoder(batch.features, batch.real).chunk(2, 1)
        logvar = torch.cat([ground_logvar, object_logvar], dim=1).clamp(-30, 20)
        return Posterior(torch.cat([ground_mean, object_mean], dim=1), logvar)

    def decode(self, latent: Float[Tensor, "batch c2 h w"]) -> LayoutOutput:
        """Each decoder reads its own half of the channels."""
        ground, objects = latent.chunk(2, dim=1)
        height, occupancy_logit = self.ground_decoder(ground).chunk(2, dim=1)
        decoder = self.object_decoder
        features, existence_logit = decoder(objects)
        return LayoutOutput(
            height, occupancy_logit, features, existence_logit, decoder.proposals, decoder.match_weights
        )

    def forward(self, batch: LayoutBatch, noise: Float[Tensor, "batch c2 h w"]) -> tuple[LayoutOutput, Posterior]:
        """Reconstruction from a sampled latent, and the posterior it was sampled from."""
        posterior = self.encode(batch)
        return self.decode(posterior.sample(noise)), posterior
