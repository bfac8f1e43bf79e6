"""Parts of the transformers of the object branch: multi-head attention, feed-forward network and encoder layer."""

from __future__ import annotations

import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

PACKED_GAIN = 0.5**0.5  # `nn.MultiheadAttention` initialises the three projections as one matrix (3 d, d).


class Attention(nn.Module):
    """Multi-head attention with separate projections, computed by the fused kernel of torch.

    The initial weights have the distribution of those of `nn.MultiheadAttention`.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query, self.key, self.value, self.out = (nn.Linear(width, width) for _ in range(4))
        for projection in (self.query, self.key, self.value):
            nn.init.xavier_uniform_(projection.weight, PACKED_GAIN)
        for projection in (self.query, self.key, self.value, self.out):
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
