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
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from models.layout import FEATURES
from models.matching import MatchWeights

REACH_CELLS = 0.5  # how far outside its cell a proposal's centre may lie
MAX_PER_CELL = 4


class ResidualBlock(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.GroupNorm(8, width), nn.GroupNorm(8, width)
        self.conv1, self.conv2 = (nn.Conv2d(width, width, 3, padding=1) for _ in range(2))

    def forward(self, x: Float[Tensor, "batch d h w"]) -> Float[Tensor, "batch d h w"]:
        y = self.conv1(F.silu(self.norm1(x)))
        return x + self.conv2(F.silu(self.norm2(y)))


class CellDecoder(nn.Module):
    """Object latent -> normalised features in [0, 1] and existence logits of `proposals[k]` primitives per category.

    Four times as many proposals as slots where cells allow it, one to MAX_PER_CELL per cell and category.
    """

    def __init__(self, slots: tuple[int, ...], latent_channels: int, latent_size: int, width: int, layers: int) -> None:
        super().__init__()
        cells = latent_size**2
        self.per_cell = tuple(min(MAX_PER_CELL, max(1, math.ceil(4 * count / cells))) for count in slots)
        self.proposals = tuple(count * cells for count in self.per_cell)
        self.match_weights = MatchWeights(existence=1.0, center=3.0 * latent_size)
        self.net = nn.Sequential(
            nn.Conv2d(latent_channels, width, 3, padding=1),
            *(ResidualBlock(width) for _ in range(layers)),
            nn.GroupNorm(8, width),
            nn.SiLU(),
        )
        self.head = nn.Conv2d(width, sum(self.per_cell) * (1 + FEATURES), 1)
        # Normalised (x, y) of each cell's middle: row 0 is farthest ahead, column 0 leftmost.
        middle = 1 - (torch.arange(latent_size, dtype=torch.float32) + 0.5) / latent_size
        self.register_buffer("middle", torch.stack(torch.meshgrid(middle, middle, indexing="ij")), persistent=False)

    def forward(
        self, latent: Float[Tensor, "batch c h w"]
    ) -> tuple[Float[Tensor, "batch n 9"], Float[Tensor, "batch n"]]:
        size = latent.shape[-1]
        out = self.head(self.net(latent)).unflatten(1, (-1, 1 + FEATURES))  # (b, k, 10, h, w)
        values = out[:, :, 1:].sigmoid()
        offset = (values[:, :, :2] - 0.5) * (1 + 2 * REACH_CELLS) / size
        center_xy = (self.middle + offset).clamp(0, 1)
        features = torch.cat([center_xy, values[:, :, 2:]], dim=2)  # (b, k, 9, h, w)
        # (b, k, h, w) in this order: category by category, since k is.
        return features.permute(0, 1, 3, 4, 2).flatten(1, 3), out[:, :, 0].flatten(1)

    def start_at(self, feature_logit: Float[Tensor, "categories 9"], count: Float[Tensor, categories]) -> None:
        """Set the last bias: the middle of the cell, mean height and shape per category, existence by `count`."""
        existence = (count / count.new_tensor(self.proposals)).clamp(0.001, 0.99).logit()
        bias = torch.cat([existence[:, None], torch.zeros_like(feature_logit[:, :2]), feature_logit[:, 2:]], dim=1)
        self.head.bias.copy_(bias.repeat_interleave(torch.tensor(self.per_cell), dim=0).flatten())
