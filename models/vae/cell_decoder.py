"""Object decoder without queries: each latent cell proposes primitives inside or close to the cell.

The paper instead uses a DETR decoder, whose queries attend to the whole latent. The encoder writes each primitive into
the cell under its centre, so this cell contains the information about the primitive. Here, each cell therefore makes a
few proposals per category.

The latent, the outputs and the losses are the same as in the paper. The unit of distances in the matching is one cell.
Existence probabilities then matter only between proposals at almost the same position. With the matching weights of the
paper, cells with high existence probabilities would be matched to primitives of other cells.
"""

from __future__ import annotations

import math
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.base import apply_in_float32, register_computed_buffers
from models.layout import FEATURES
from models.limits import require_within
from models.vae.config import ObjectConfig
from models.vae.matching import MatchWeights
from models.vae.outputs import Proposals

REACH_CELLS = 0.5  # Largest distance of a proposal's centre from the border of its cell (in cells).
MAX_PER_CELL = 4
SPARE = 16  # Proposals per slot. The number is high because many primitives can lie in one cell.


class CellDecoder(nn.Module):
    """Decode an object latent to features and existence logits of `proposals[k]` proposals per category k.

    Features are normalised to [0, 1]. The decoder makes SPARE proposals per slot, but at least `min_proposals_per_cell`
    and at most MAX_PER_CELL proposals per cell and category. The number of proposals has a minimum, because objects of
    a rare category also occur in groups. One small network decodes each cell separately, because the encoder writes
    each primitive into only one cell.
    """

    def __init__(self, slots: tuple[int, ...], latent_channels: int, latent_size: int, config: ObjectConfig) -> None:
        super().__init__()
        hidden = config.head_hidden
        cells = latent_size**2
        wanted = (max(config.min_proposals_per_cell, math.ceil(SPARE * count / cells)) for count in slots)
        self.per_cell = tuple(min(MAX_PER_CELL, count) for count in wanted)
        self.proposals = tuple(count * cells for count in self.per_cell)
        self.match_weights = MatchWeights(existence=1.0)
        self.net = nn.Sequential(
            nn.Linear(latent_channels, hidden),
            nn.SiLU(),
            nn.Linear(hidden, hidden),
            nn.SiLU(),
            nn.Linear(hidden, hidden),
        )
        self.head = nn.Linear(hidden, sum(self.per_cell) * (1 + FEATURES))
        self.latent_size = latent_size
        register_computed_buffers(self)
        self.reach = (1 + 2 * REACH_CELLS) / latent_size

    def compute_buffers(self) -> dict[str, Tensor]:
        """Return normalised (x, y) of the cell centres in row-major order. Row 0 is farthest ahead."""
        require_within("model_buffers", 2 * self.latent_size**2, "centres of the cells")
        middle = 1 - (torch.arange(self.latent_size, dtype=torch.float32) + 0.5) / self.latent_size
        return {"middle": torch.cartesian_prod(middle, middle)[:, None]}

    def forward(self, latent: Float[Tensor, "batch c h w"]) -> Proposals:
        """Decode object latents.

        Args:
            latent: Object latents.

        Returns:
            Normalised features and existence logits; proposals are ordered by category.
        """
        cells = latent.flatten(2).transpose(1, 2)
        out = apply_in_float32(self.head, self.net(cells)).unflatten(2, (-1, 1 + FEATURES))  # (b, cells, k, 10)
        values = out[..., 1:].sigmoid()
        center_xy = (cast(Tensor, self.middle) + (values[..., :2] - 0.5) * self.reach).clamp(0, 1)
        features = torch.cat([center_xy, values[..., 2:]], dim=-1)  # (b, cells, k, 9)
        # The order (b, k, cells) sorts proposals by category, because k is sorted by category.
        return Proposals(features.transpose(1, 2).flatten(1, 2), out[..., 0].transpose(1, 2).flatten(1))

    def init_from_data(self, feature_logit: Float[Tensor, "categories 9"], count: Float[Tensor, " categories"]) -> None:
        """Set the output biases to the cell centres, and to the mean height, shape and existence of each category.

        Args:
            feature_logit: Logits of the mean normalised features of each category.
            count: Mean number of primitives of each category in a scene.
        """
        existence = (count / count.new_tensor(self.proposals)).clamp(0.001, 0.99).logit()
        bias = torch.cat([existence[:, None], torch.zeros_like(feature_logit[:, :2]), feature_logit[:, 2:]], dim=1)
        self.head.bias.copy_(bias.repeat_interleave(torch.tensor(self.per_cell), dim=0).flatten())
