"""Primitives read off the latent cells they were scattered to: an object decoder without queries.

Differs from the paper, whose DETR decoder searches the whole latent for every query. The encoder puts a primitive into
the cell under its centre, so that cell already knows it: here every cell proposes a few primitives per category,
with centres in and around itself. Same latent, same outputs, same losses; matching counts distance in cells and lets
existence decide only between proposals of about the same place, or the surest cell would be trained on everybody's
primitive.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.layout import FEATURES
from models.vae.config import ObjectConfig
from models.vae.matching import MatchWeights

REACH_CELLS = 0.5  # how far outside its cell a proposal's centre may lie
MAX_PER_CELL = 4
SPARE = 16  # proposals per slot, where MAX_PER_CELL allows them: primitives crowd


class CellDecoder(nn.Module):
    """Object latent -> normalised features in [0, 1] and existence logits of `proposals[k]` primitives per category.

    SPARE times as many proposals as slots where cells allow it, `min_proposals_per_cell` to MAX_PER_CELL per cell and
    category: rare things, too, come in groups. Cells are read one by one, by the same small network: its neighbours
    know nothing of a primitive that the cell does not.
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
        # Normalised (x, y) of each cell's middle, row-major: row 0 is farthest ahead, column 0 leftmost.
        middle = 1 - (torch.arange(latent_size, dtype=torch.float32) + 0.5) / latent_size
        self.register_buffer("middle", torch.cartesian_prod(middle, middle)[:, None], persistent=False)
        self.reach = (1 + 2 * REACH_CELLS) / latent_size

    def forward(
        self, latent: Float[Tensor, "batch c h w"]
    ) -> tuple[Float[Tensor, "batch n 9"], Float[Tensor, "batch n"]]:
        cells = latent.flatten(2).transpose(1, 2)
        out = self.head(self.net(cells)).unflatten(2, (-1, 1 + FEATURES))  # (b, cells, k, 10)
        values = out[..., 1:].sigmoid()
        center_xy = (self.middle + (values[..., :2] - 0.5) * self.reach).clamp(0, 1)
        features = torch.cat([center_xy, values[..., 2:]], dim=-1)  # (b, cells, k, 9)
        # (b, k, cells) in this order: category by category, since k is.
        return features.transpose(1, 2).flatten(1, 2), out[..., 0].transpose(1, 2).flatten(1)

    def init_from_data(self, feature_logit: Float[Tensor, "categories 9"], count: Float[Tensor, " categories"]) -> None:
        """Set the last bias: the middle of the cell, mean height and shape per category, existence by `count`."""
        existence = (count / count.new_tensor(self.proposals)).clamp(0.001, 0.99).logit()
        bias = torch.cat([existence[:, None], torch.zeros_like(feature_logit[:, :2]), feature_logit[:, 2:]], dim=1)
        self.head.bias.copy_(bias.repeat_interleave(torch.tensor(self.per_cell), dim=0).flatten())
