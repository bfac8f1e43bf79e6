"""What the layout VAE computes: the posterior of its encoders and the output of its decoders."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from torch import Tensor

from models.layout import FEATURES
from models.tensors import DecodedLayout
from models.vae.matching import MatchWeights


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
        occupancy, height, features, existence = (part.float().cpu().numpy() for part in parts)
        samples = zip(occupancy, height, features, existence, strict=True)
        return [DecodedLayout(*sample, category) for sample in samples]
