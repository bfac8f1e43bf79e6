"""Outputs of the layout VAE: the posterior from the encoders, and the layouts from the decoders."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from models.layout import FEATURES
from models.tensors import DecodedLayout
from models.vae.matching import MatchWeights


@dataclass(frozen=True, eq=False)
class Posterior:
    """Diagonal Gaussian over the joint layout latent.

    If the model has both branches, the first half of the channels belongs to the ground, the second to the objects.

    Attributes:
        mean: Mean.
        logvar: Log-variance.
    """

    mean: Float[Tensor, "batch c2 h w"]
    logvar: Float[Tensor, "batch c2 h w"]

    def float(self) -> Posterior:
        """Convert to float32, because losses need more precision than bfloat16."""
        return Posterior(self.mean.float(), self.logvar.float())

    def sample(self, noise: Float[Tensor, "batch c2 h w"]) -> Float[Tensor, "batch c2 h w"]:
        """Sample latents by reparameterisation.

        Args:
            noise: Standard normal noise.

        Returns:
            Latents.
        """
        return self.mean + (0.5 * self.logvar).exp() * noise


class Prediction(NamedTuple):
    """Predicted primitives.

    Attributes:
        features: Normalised features of the proposals, ordered by category.
        existence_logit: Logit of the existence probability of the proposals.
    """

    features: Float[Tensor, "batch proposals 9"]
    existence_logit: Float[Tensor, "batch proposals"]


class Proposals(NamedTuple):
    """Output of an object decoder.

    Attributes:
        features: Normalised features of the proposals, ordered by category.
        existence_logit: Logit of the existence probability of the proposals.
        auxiliary: Predictions of the layers before the last, which have losses in training.
        denoised: Predictions of the denoising queries, per layer. Their batch axis also counts the groups: the groups
            of a sample follow one another. Slot k of a prediction belongs to slot k of the true layout.
    """

    features: Float[Tensor, "batch proposals 9"]
    existence_logit: Float[Tensor, "batch proposals"]
    auxiliary: tuple[Prediction, ...] = ()
    denoised: tuple[Prediction, ...] = ()


@dataclass(frozen=True, eq=False)
class LayoutOutput:
    """Output of the decoders, normalised as in LayoutBatch.

    Attributes:
        height: Normalised heights.
        occupancy_logit: Logit of the probability that a pixel is occupied.
        features: Normalised features of the proposals, ordered by category.
        existence_logit: Logit of the existence probability of the proposals.
        proposals: Number of proposals per category. The decoder "detr" has one proposal per slot; "cells" may have more
            proposals.
        match_weights: Weights of the matching cost.
        feature_unit: Length unit of each normalised feature in matching and losses.
        branches: Branches of the model. The outputs of a missing branch are placeholders.
        auxiliary: See `Proposals`.
        denoised: See `Proposals`.
        signed_distance: Signed distances from the edges of the masks in units of `reach_px` pixels, positive inside;
            None for models without level sets.
        reach_px: Unit of `signed_distance` in pixels.
        local_field: Direction of the streets and height of the ground (models/vae/local_frame.py); None for models
            without a local frame.
    """

    height: Float[Tensor, "batch ground rows cols"]
    occupancy_logit: Float[Tensor, "batch ground rows cols"]
    features: Float[Tensor, "batch proposals 9"]
    existence_logit: Float[Tensor, "batch proposals"]
    proposals: tuple[int, ...]
    match_weights: MatchWeights
    feature_unit: tuple[float, ...] = (1.0,) * FEATURES
    branches: str = "both"
    auxiliary: tuple[Prediction, ...] = ()
    denoised: tuple[Prediction, ...] = ()
    signed_distance: Float[Tensor, "batch ground rows cols"] | None = None
    reach_px: int = 1
    local_field: Float[Tensor, "batch 3 coarse coarse"] | None = None

    def float(self) -> LayoutOutput:
        """Convert to float32, because losses need more precision than bfloat16."""
        names = ("height", "occupancy_logit", "features", "existence_logit")
        further = {
            name: tuple(Prediction(*(part.float() for part in found)) for found in getattr(self, name))
            for name in ("auxiliary", "denoised")
        }
        distance = None if self.signed_distance is None else self.signed_distance.float()
        changed = {name: getattr(self, name).float() for name in names}
        return replace(self, **changed, **further, signed_distance=distance)

    def layouts(self) -> list[DecodedLayout]:
        """Return one numpy layout per sample, with probabilities instead of logits."""
        parts = (self.occupancy_logit.sigmoid(), self.height, self.features, self.existence_logit.sigmoid())
        category = np.repeat(np.arange(len(self.proposals)), self.proposals)
        occupancy, height, features, existence = (part.float().cpu().numpy() for part in parts)
        samples = zip(occupancy, height, features, existence, strict=True)
        return [DecodedLayout(*sample, category) for sample in samples]
