"""Object branch of the layout VAE (paper, supplement B.2).

A transformer encoder computes one feature per primitive and scatters these features onto the latent grid. A DETR
decoder predicts primitives from the latent.

In shapes, N is the number of slots of all categories, d the width, and (h, w) the size of the latent grid.
"""

from __future__ import annotations

from typing import cast

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from models.base import apply_in_float32, register_computed_buffers
from models.layout import FEATURES
from models.limits import require_within
from models.vae.config import ObjectConfig
from models.vae.matching import MatchWeights

CATEGORY_EMBEDDING = 10  # 9 features + 10 embedding channels + 1 padding flag = 20 inputs (paper, Sec. 3.2).


class Attention(nn.Module):
    """Multi-head attention with separate projections, computed by the fused kernel of torch."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query, self.key, self.value, self.out = (nn.Linear(width, width) for _ in range(4))
        for projection in (self.query, self.key, self.value):
            nn.init.xavier_uniform_(projection.weight)
            nn.init.zeros_(projection.bias)

    def split(self, x: Float[Tensor, "batch n d"]) -> Float[Tensor, "batch heads n dh"]:
        """Split the channels into heads.

        Args:
            x: Projected tokens.

        Returns:
            Tokens per head.
        """
        return x.unflatten(-1, (self.heads, -1)).transpose(1, 2)

    def forward(self, query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None = None) -> Tensor:
        """Attend from queries to keys.

        Args:
            query: (b, n, d) queries.
            key: (b, m, d) keys.
            value: (b, m, d) values.
            mask: (b, m); True marks visible keys. None: all keys are visible.

        Returns:
            (b, n, d) tokens.
        """
        q, k, v = self.split(self.query(query)), self.split(self.key(key)), self.split(self.value(value))
        mask = None if mask is None else mask[:, None, None, :]
        return self.out(F.scaled_dot_product_attention(q, k, v, attn_mask=mask).transpose(1, 2).flatten(2))


def make_feed_forward(width: int, hidden: int) -> nn.Sequential:
    """Return a two-layer network with ReLU.

    Args:
        width: Width of input and output.
        hidden: Width of the hidden layer.

    Returns:
        The network.
    """
    return nn.Sequential(nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, width))


class EncoderLayer(nn.Module):
    """Transformer encoder layer with post-norm (Vaswani et al.)."""

    def __init__(self, width: int, heads: int, hidden: int) -> None:
        super().__init__()
        self.attention, self.mlp = Attention(width, heads), make_feed_forward(width, hidden)
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)

    def forward(self, x: Float[Tensor, "batch n d"], mask: Bool[Tensor, "batch n"]) -> Float[Tensor, "batch n d"]:
        """Apply the layer.

        Args:
            x: Tokens.
            mask: True for each visible token.

        Returns:
            Tokens of the same shape.
        """
        x = self.norm1(x + self.attention(x, x, x, mask))
        return self.norm2(x + self.mlp(x))


class DecoderLayer(nn.Module):
    """DETR decoder layer with post-norm. Positions are added to queries and keys but not to values."""

    def __init__(self, width: int, heads: int, hidden: int) -> None:
        super().__init__()
        self.self_attention, self.cross_attention = Attention(width, heads), Attention(width, heads)
        self.mlp = make_feed_forward(width, hidden)
        self.norm1, self.norm2, self.norm3 = nn.LayerNorm(width), nn.LayerNorm(width), nn.LayerNorm(width)

    def forward(self, x: Tensor, query_position: Tensor, memory: Tensor, memory_key: Tensor) -> Tensor:
        """Apply the layer.

        Args:
            x: (b, n, d) tokens.
            query_position: (n, d) learned position embedding of each query.
            memory: (b, hw, d) projected latent cells.
            memory_key: (b, hw, d) sum of `memory` and the position embeddings of the cells.

        Returns:
            (b, n, d) tokens.
        """
        placed = x + query_position
        x = self.norm1(x + self.self_attention(placed, placed, x))
        x = self.norm2(x + self.cross_attention(x + query_position, memory_key, memory))
        return self.norm3(x + self.mlp(x))


def find_grid_cells(centers: Float[Tensor, "batch n 3"], rows: int, cols: int) -> tuple[Tensor, Tensor]:
    """Find the latent cell under each normalised centre.

    The latent grid is oriented like the rasters: row 0 is farthest ahead and column 0 is leftmost.

    Args:
        centers: Centres, normalised to [0, 1]. x points forward, and y points to the left.
        rows: Number of rows of the latent grid.
        cols: Number of columns of the latent grid.

    Returns:
        Row and column (batch, n) of each cell.
    """
    row = ((1 - centers[..., 0]) * rows).long().clamp(0, rows - 1)
    col = ((1 - centers[..., 1]) * cols).long().clamp(0, cols - 1)
    return row, col


class ObjectEncoder(nn.Module):
    """Encode primitives to mean and log-variance of the object latent.

    The value of a cell is a learned value plus the mean of the features of its primitives. Padded slots are masked in
    the attention and are not written to the latent grid.

    With `shortcut`, a small network computes an additional term of the mean from each primitive. The inputs of the
    small network are the position in the cell, the shape and the category of the primitive. The shortcut avoids the
    loss of numerical precision in the normalisations of the transformer. The paper has no shortcut.
    """

    slot_category: Tensor

    def __init__(
        self,
        slots: tuple[int, ...],
        latent_channels: int,
        latent_size: int,
        config: ObjectConfig,
        shortcut: bool = False,
    ) -> None:
        super().__init__()
        width, heads, hidden = config.width, config.heads, config.hidden
        self.slots = tuple(slots)
        register_computed_buffers(self)
        self.category = nn.Embedding(len(slots), CATEGORY_EMBEDDING)
        self.project_in = nn.Linear(FEATURES + CATEGORY_EMBEDDING + 1, width)
        self.layers = nn.ModuleList(EncoderLayer(width, heads, hidden) for _ in range(config.layers))
        self.project_out = nn.Linear(width, 2 * latent_channels)
        self.grid = nn.Parameter(torch.zeros(2 * latent_channels, latent_size, latent_size))
        self.shortcut = None
        if shortcut:
            self.shortcut = nn.Sequential(
                nn.Linear(FEATURES + CATEGORY_EMBEDDING, width),
                nn.SiLU(),
                nn.Linear(width, width),
                nn.SiLU(),
                nn.Linear(width, latent_channels),
            )

    def compute_buffers(self) -> dict[str, Tensor]:
        """Return the category of each slot."""
        require_within("model_buffers", sum(self.slots), "slots")
        categories = [category for category, count in enumerate(self.slots) for _ in range(count)]
        return {"slot_category": torch.tensor(categories, dtype=torch.long)}

    def forward(
        self, features: Float[Tensor, "batch n features"], real: Bool[Tensor, "batch n"]
    ) -> Float[Tensor, "batch moments h w"]:
        """Encode primitives.

        Args:
            features: Normalised features of the slots.
            real: True for each slot that holds a primitive.

        Returns:
            Mean and log-variance, concatenated along the channel axis.
        """
        features, real, category = self.drop_padding(features, real)
        batch = len(features)
        moments, rows, cols = self.grid.shape
        category = self.category(category)  # (b, n, 10)
        x = torch.cat([features, category, real[..., None].to(features.dtype)], dim=-1)  # (b, n, 20)
        x = apply_in_float32(self.project_in, x)  # (b, n, d)
        # Attention needs at least one visible token, also in a scene without primitives. The first slot is therefore
        # visible, but if it is padding, it is not written to the latent grid.
        visible = real.clone()
        visible[:, 0] |= ~real.any(dim=1)
        for layer in self.layers:
            x = layer(x, visible)
        x = apply_in_float32(self.project_out, x)  # (b, n, moments)
        row, col = find_grid_cells(features[..., :3], rows, cols)
        if self.shortcut is not None:
            mean, logvar = x.chunk(2, dim=-1)
            added = apply_in_float32(self.shortcut, self.encode_in_cell(features, row, col, category))
            x = torch.cat([mean + added, logvar], dim=-1)
        x = x * real[..., None]
        cell = row * cols + col  # (b, n)
        total = x.new_zeros(batch, rows * cols, moments).scatter_add_(1, cell[..., None].expand(-1, -1, moments), x)
        count = x.new_zeros(batch, rows * cols).scatter_add_(1, cell, real.to(x.dtype))
        mean = total / count.clamp(min=1)[..., None]
        return self.grid + mean.transpose(1, 2).unflatten(2, (rows, cols))

    def encode_in_cell(self, features: Tensor, row: Tensor, col: Tensor, category: Tensor) -> Tensor:
        """Compute the input of the shortcut.

        Args:
            features: (b, n, 9) normalised features.
            row: (b, n) row of each primitive's cell.
            col: (b, n) column of each primitive's cell.
            category: (b, n, 10) category embeddings.

        Returns:
            (b, n, 19): x and y relative to the cell centre (in cells), other features scaled to [-2, 2], category
            embedding.
        """
        _, rows, cols = self.grid.shape
        down, right = (1 - features[..., 0]) * rows - row - 0.5, (1 - features[..., 1]) * cols - col - 0.5
        return torch.cat([down[..., None], right[..., None], 4 * features[..., 2:] - 2, category], dim=-1)

    def drop_padding(self, features: Tensor, real: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Move real primitives to the front, and remove trailing slots that are padding in all samples.

        Masked slots do not change the result, but they cost as much time as real primitives. On average, half of the
        paper's 514 slots are empty.

        Args:
            features: (b, N, 9) normalised features.
            real: (b, N) True for each slot that holds a primitive.

        Returns:
            Features, `real` and categories of n slots per sample, where n is the largest number of primitives in a
            scene of the batch.
        """
        most = max(int(real.sum(dim=1).max()), 1)
        order = real.to(torch.int8).argsort(dim=1, descending=True, stable=True)[:, :most]  # (b, most)
        picked = features.gather(1, order[..., None].expand(-1, -1, features.shape[-1]))
        return picked, real.gather(1, order), self.slot_category[order]


def make_sine_positions(rows: int, cols: int, width: int) -> Float[Tensor, "cells d"]:
    """Return the normalised sine position embeddings of DETR for a grid.

    Args:
        rows: Number of rows.
        cols: Number of columns.
        width: Number of channels. One half encodes the row, the other half the column.

    Returns:
        Position embeddings of the cells in row-major order.
    """

    def axis(n: int) -> Tensor:
        position = (torch.arange(n, dtype=torch.float32) + 1) / n * 2 * torch.pi
        frequency = 10_000 ** (torch.arange(0, width // 2, 2, dtype=torch.float32) / (width // 2))
        angle = position[:, None] / frequency
        return torch.stack([angle.sin(), angle.cos()], dim=2).flatten(1)  # (n, d / 2)

    row, col = axis(rows), axis(cols)
    return torch.cat([row[:, None].expand(-1, cols, -1), col[None].expand(rows, -1, -1)], dim=2).flatten(0, 1)


class OutputHeads(nn.Module):
    """Output networks of one category: a three-layer network for nine features, and a linear layer for existence."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.features = nn.Sequential(
            nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, FEATURES)
        )
        self.existence = nn.Linear(width, 1)


class ObjectDecoder(nn.Module):
    """Decode an object latent to normalised features in [0, 1] and an existence logit per slot (DETR)."""

    def __init__(self, slots: tuple[int, ...], latent_channels: int, latent_size: int, config: ObjectConfig) -> None:
        super().__init__()
        width, heads, hidden = config.width, config.heads, config.hidden
        self.proposals = tuple(slots)
        self.match_weights = MatchWeights()
        self.project_in = nn.Linear(latent_channels, width)  # patch size 1
        self.queries = nn.Parameter(torch.randn(sum(slots), width))
        self.layers = nn.ModuleList(DecoderLayer(width, heads, hidden) for _ in range(config.layers))
        self.heads = nn.ModuleList(OutputHeads(width, config.head_hidden) for _ in slots)
        self.latent_size = latent_size
        register_computed_buffers(self)

    def compute_buffers(self) -> dict[str, Tensor]:
        """Return the position embeddings of the latent cells."""
        require_within("model_buffers", self.latent_size**2 * self.queries.shape[1], "positions of the cells")
        return {"positions": make_sine_positions(self.latent_size, self.latent_size, self.queries.shape[1])}

    def forward(
        self, latent: Float[Tensor, "batch c h w"]
    ) -> tuple[Float[Tensor, "batch n features"], Float[Tensor, "batch n"]]:
        """Decode object latents.

        Args:
            latent: Object latents.

        Returns:
            Normalised features and existence logits of all slots.
        """
        memory = apply_in_float32(self.project_in, latent.flatten(2).transpose(1, 2))  # (b, hw, d)
        memory_key = memory + cast(Tensor, self.positions)
        x = torch.zeros_like(self.queries).expand(len(latent), -1, -1)  # (b, n, d): DETR starts from zeros
        for layer in self.layers:
            x = layer(x, self.queries, memory, memory_key)
        groups = list(zip(self._list_heads(), x.split(self.proposals, dim=1), strict=True))
        features = torch.cat([apply_in_float32(head.features, group) for head, group in groups], dim=1).sigmoid()
        existence = torch.cat([apply_in_float32(head.existence, group) for head, group in groups], dim=1).squeeze(-1)
        return features, existence

    def _list_heads(self) -> list[OutputHeads]:
        return [cast(OutputHeads, head) for head in self.heads]

    def init_from_data(
        self, feature_logit: Float[Tensor, "categories features"], count: Float[Tensor, " categories"]
    ) -> None:
        """Set the output biases to the mean features and the mean existence of each category.

        Args:
            feature_logit: Logits of the mean normalised features of each category.
            count: Mean number of primitives of each category in a scene.
        """
        for head, mean, expected, offered in zip(self._list_heads(), feature_logit, count, self.proposals, strict=True):
            cast(Tensor, head.features[-1].bias).copy_(mean)
            head.existence.bias.copy_((expected / offered).clamp(0.01, 0.99).logit())
