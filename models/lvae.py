"""The layout VAE (paper, Sec. 3.2 and supplement B.2): two branches, one joint latent that stays split by channel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import torch
from diffusers import ConfigMixin, ModelMixin
from diffusers.configuration_utils import register_to_config
from jaxtyping import Float
from torch import Tensor

from models.batch import LayoutBatch
from models.layout import FEATURES, LayoutSpec
from models.tensors import DecodedLayout
from models.vae.cell_decoder import CellDecoder
from models.vae.ground import GroundDecoder, GroundEncoder
from models.vae.ground import start_at as start_ground
from models.vae.matching import MatchWeights
from models.vae.objects import ObjectDecoder, ObjectEncoder


@dataclass(frozen=True, eq=False)
class Posterior:
    """Diagonal Gaussian over the joint layout latent: the first half of the channels is ground, the second objects."""

    mean: Float[Tensor, "batch c2 h w"]
    logvar: Float[Tensor, "batch c2 h w"]

    def float(self) -> Posterior:
        """In single precision: losses are not for bf16."""
        return Posterior(self.mean.float(), self.logvar.float())

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
    feature_unit: tuple[float, ...] = (1.0,) * FEATURES  # normalised features are matched and compared in these
    branches: str = "both"  # which of them were decoded; the other's values are placeholders

    def float(self) -> LayoutOutput:
        """In single precision: losses are not for bf16."""
        names = ("height", "occupancy_logit", "features", "existence_logit")
        return replace(self, **{name: getattr(self, name).float() for name in names})

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
SOLVED_LOGVAR = -8.0  # of a ground that starts solved (ground.py): sigma 0.018

BRANCHES = ("both", "ground", "objects")
OBJECT_DECODER = "object_decoder."  # how its parameters' names begin
EMPTY_LOGIT = -6.0  # occupancy where there is no ground branch


def logit(probability: Tensor) -> Tensor:
    """Logit of a probability that may be 0 or 1."""
    return probability.clamp(0.01, 0.99).logit()


class LayoutVAE(ModelMixin, ConfigMixin):
    """Encodes layouts into a (2 c, h, w) latent and decodes them back.

    `layout` is a LayoutSpec as a dict, so that a saved model inverts its own outputs. h = w = raster pixels /
    (fold 2^(len(channels) - 1)). `fold`, `attention` and `shortcut`: ground.py and objects.py. `decoder` is the paper's
    DETR or `cells`: proposals of each latent cell, `least_per_cell` or more of each category (cells.py).

    The paper's ablations: without `split_latent` both decoders read the joint latent; with `branches` ground or
    objects there is that branch alone, its latent has c channels, and the other side of a layout comes out empty.
    """

    @register_to_config
    def __init__(
        self,
        layout: dict,
        latent_channels: int = 32,
        channels: tuple[int, ...] = (64, 128, 256, 512),
        norm_groups: int = 32,
        fold: int = 1,
        attention: bool = True,
        width: int = 512,
        layers: int = 6,
        heads: int = 8,
        hidden: int = 1024,
        head_hidden: int = 1024,
        decoder: str = "detr",
        shortcut: bool = False,
        split_latent: bool = True,
        branches: str = "both",
        least_per_cell: int = 1,
    ) -> None:
        super().__init__()
        if branches not in BRANCHES:
            raise ValueError(f"LayoutVAE: branches is {branches!r}, expected one of {BRANCHES}")
        spec = LayoutSpec.from_dict(layout)
        factor = fold * 2 ** (len(channels) - 1)
        if spec.grid.rows != spec.grid.cols or spec.grid.rows % factor:
            raise ValueError(f"LayoutVAE needs a square grid divisible by {factor}, got {spec.grid}")
        size, num_classes = spec.grid.rows // factor, len(spec.ground_classes)
        # Proposals of cells say where things are to a fraction of their cell; so that losses see it too, metres count in
        # cells. The paper's DETR, whose queries search the whole crop, is trained on normalised numbers.
        self.feature_unit = (
            spec.feature_unit(spec.grid.rows * spec.grid.resolution_m / size)
            if decoder == "cells"
            else (1.0,) * FEATURES
        )
        self.latent_shape = (latent_channels * (2 if branches == "both" else 1), size, size)  # of the joint latent
        seen = latent_channels if split_latent else self.latent_shape[0]  # channels that a decoder reads
        self.ground_encoder = self.ground_decoder = self.object_encoder = self.object_decoder = None
        if branches != "objects":
            ground = (tuple(channels), norm_groups, fold, attention, shortcut)
            self.ground_encoder = GroundEncoder(num_classes, latent_channels, *ground)
            self.ground_decoder = GroundDecoder(num_classes, seen, *ground)
            with torch.no_grad():
                logvar = SOLVED_LOGVAR if shortcut else INITIAL_LOGVAR
                self.ground_encoder.net.conv_out.bias[latent_channels:] = logvar
        if branches != "ground":
            body = (size, width, layers, heads, hidden)
            self.object_encoder = ObjectEncoder(spec.slots, latent_channels, *body, shortcut)
            if decoder == "detr":
                self.object_decoder = ObjectDecoder(spec.slots, seen, *body, head_hidden)
            elif decoder == "cells":
                self.object_decoder = CellDecoder(spec.slots, seen, size, head_hidden, least_per_cell)
            else:
                raise ValueError(f"LayoutVAE: decoder is {decoder!r}, expected 'detr' (the paper's) or 'cells'")
            with torch.no_grad():
                self.object_encoder.grid[latent_channels:] = INITIAL_LOGVAR

    @torch.no_grad()
    def start_at(self, batch: LayoutBatch) -> None:
        """Start every output at its mean over `batch`, a sample of training layouts (shortcuts: models/vae/ground.py).

        Adam moves a bias by about the learning rate per step: from zero, thousands of steps would go into learning
        that a pole is thin and that most pixels are no road.
        """
        if self.ground_encoder:
            start_ground(self.ground_encoder, self._ground_start(), batch.height, batch.occupied)
        if not self.object_encoder:
            return
        groups = list(zip(batch.features.split(self.spec.slots, 1), batch.real.split(self.spec.slots, 1), strict=True))
        features = torch.stack([f[r].mean(dim=0) if r.any() else f.new_full((FEATURES,), 0.5) for f, r in groups])
        count = torch.stack([r.sum() / len(r) for _, r in groups])
        self.object_decoder.start_at(logit(features), count)

    def keep_latents_of(self, state: dict[str, Tensor]) -> None:
        """Take all but the object decoder from the weights of a model of the same encoders; only that decoder trains on.

        What the decoder is trained to read is then what another model, trained on those latents, writes.
        """
        mine = {name: value for name, value in self.state_dict().items() if name.startswith(OBJECT_DECODER)}
        theirs = {name: value for name, value in state.items() if not name.startswith(OBJECT_DECODER)}
        self.load_state_dict(theirs | mine)
        for name, parameter in self.named_parameters():
            parameter.requires_grad_(name.startswith(OBJECT_DECODER))

    def learning_rates(self) -> dict[str, float]:
        """Shares of the learning rate, by beginning of a parameter's name: what starts solved must not be shaken."""
        if not self.config.shortcut:
            return {}
        return {"ground_encoder.shortcut": 0.05, "ground_decoder.shortcut": 0.05, "ground_": 0.25}

    def _ground_start(self) -> GroundDecoder | SimpleNamespace:
        """What `start_ground` fills: of a shortcut that reads the joint latent the ground's part, the rest is zero."""
        decoder, own = self.ground_decoder, self.config.latent_channels
        if decoder.shortcut is None or decoder.shortcut.in_channels == own:
            return decoder
        decoder.shortcut.weight[own:] = 0
        shortcut = SimpleNamespace(weight=decoder.shortcut.weight[:own], bias=decoder.shortcut.bias)
        return SimpleNamespace(net=decoder.net, unfold=decoder.unfold, shortcut=shortcut)

    @property
    def spec(self) -> LayoutSpec:
        return LayoutSpec.from_dict(self.config.layout)

    def encode(self, batch: LayoutBatch) -> Posterior:
        """Joint posterior: channel groups [ground; objects] of mean and of log-variance."""
        moments = []
        if self.ground_encoder:
            moments.append(self.ground_encoder(torch.cat([batch.height, batch.occupied], dim=1)).chunk(2, 1))
        if self.object_encoder:
            moments.append(self.object_encoder(batch.features, batch.real).chunk(2, 1))
        mean, logvar = (torch.cat(part, dim=1) for part in zip(*moments, strict=True))
        return Posterior(mean, logvar.clamp(-30, 20))

    def decode(self, latent: Float[Tensor, "batch c2 h w"]) -> LayoutOutput:
        """Each decoder reads its own half of the channels, without `split_latent` all of them."""
        split = self.config.split_latent and self.config.branches == "both"
        ground, objects = latent.chunk(2, dim=1) if split else (latent, latent)
        height, occupancy_logit = self.decode_ground(ground)
        unit, branches = self.feature_unit, self.config.branches
        return LayoutOutput(height, occupancy_logit, *self.decode_objects(objects), unit, branches)

    def decode_ground(self, latent: Float[Tensor, "batch c h w"]) -> tuple[Tensor, Tensor]:
        """Heights and occupancy logits; nothing occupied where there is no ground branch."""
        if self.ground_decoder:
            return self.ground_decoder(latent).chunk(2, dim=1)
        grid = self.spec.grid
        height = latent.new_zeros(len(latent), len(self.spec.ground_classes), grid.rows, grid.cols)
        return height, torch.full_like(height, EMPTY_LOGIT)

    def decode_objects(self, latent: Float[Tensor, "batch c h w"]) -> tuple[Tensor, Tensor, tuple, MatchWeights]:
        """Features, existence logits, proposals and how to match them; no proposal where there is no object branch."""
        if self.object_decoder:
            return *self.object_decoder(latent), self.object_decoder.proposals, self.object_decoder.match_weights
        features = latent.new_zeros(len(latent), 0, FEATURES)
        return features, features[..., 0], (0,) * len(self.spec.slots), MatchWeights()

    def forward(
        self,
        batch: LayoutBatch,
        noise: Float[Tensor, "batch c2 h w"],
        corruption: Float[Tensor, "batch c2 h w"] | None = None,
    ) -> tuple[LayoutOutput, Posterior]:
        """Reconstruction from a sampled latent, and the posterior it was sampled from.

        `corruption` is more noise on the latent, in units of each channel's deviation over a scene's cells: decoders
        learn to bear what a diffusion model's latents are off.

        Differs from the paper: it has no such noise. Zheng et al. 2025 (RAE) train decoders so; here encoders learn with
        them, and the strength is drawn anew for each scene (training.stacked_corruption).
        """
        posterior = self.encode(batch)
        latent = posterior.sample(noise)
        if corruption is not None:
            latent = latent + corruption * posterior.mean.std(dim=(2, 3), keepdim=True)
        return self.decode(latent), posterior
