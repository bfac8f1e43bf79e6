"""Object encoder of the layout VAE (paper, supplement B.2).

A transformer encoder computes one feature per primitive and scatters these features onto the latent grid. The decoder
is in models/vae/detr_decoder.py or models/vae/cell_decoder.py.

In shapes, N is the number of slots of all categories, d the width, and (h, w) the size of the latent grid.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from models.base import apply_in_float32, register_computed_buffers
from models.layout import FEATURES
from models.limits import require_within
from models.vae.config import ObjectConfig
from models.vae.transformer import EncoderLayer

CATEGORY_EMBEDDING = 10  # 9 features + 10 embedding channels + 1 padding flag = 20 inputs (paper, Sec. 3.2).
ORDERS = 4  # Orders within a cell that `order_in_cell` distinguishes. Later primitives have the last order.


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


def count_earlier_in_cell(cell: Int[Tensor, "batch n"], real: Bool[Tensor, "batch n"]) -> Int[Tensor, "batch n"]:
    """Count the real primitives before each primitive that lie in the same cell.

    Args:
        cell: Index of the cell of each primitive.
        real: True for each slot that holds a primitive.

    Returns:
        Number of earlier primitives in the same cell.
    """
    earlier = (cell[:, :, None] == cell[:, None]) & real[:, None]
    return earlier.tril(-1).sum(dim=2)


class ObjectEncoder(nn.Module):
    """Encode primitives to mean and log-variance of the object latent.

    The value of a cell is a learned value plus the mean of the features of its primitives. Padded slots are masked in
    the attention and are not written to the latent grid.

    With `order_in_cell`, the value is the sum of the features, and the order of a primitive within its cell is an
    additional input. Primitives of the same cell can thus use different directions of the latent space. The mean of two
    primitives often decodes to one primitive between them. The paper uses the mean.

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
        self.slot_multiple = 1  # Compiled layers need few different numbers of slots.
        self.orders = ORDERS if config.order_in_cell else 0
        register_computed_buffers(self)
        self.category = nn.Embedding(len(slots), CATEGORY_EMBEDDING)
        self.project_in = nn.Linear(FEATURES + CATEGORY_EMBEDDING + 1 + self.orders, width)
        self.layers = nn.ModuleList(EncoderLayer(width, heads, hidden) for _ in range(config.layers))
        self.project_out = nn.Linear(width, 2 * latent_channels)
        self.grid = nn.Parameter(torch.zeros(2 * latent_channels, latent_size, latent_size))
        self.shortcut = None
        if shortcut:
            self.shortcut = nn.Sequential(
                nn.Linear(FEATURES + CATEGORY_EMBEDDING + self.orders, width),
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
        row, col = find_grid_cells(features[..., :3], rows, cols)
        cell = row * cols + col  # (b, n)
        known = self.category(category)  # (b, n, 10)
        if self.orders:
            order = count_earlier_in_cell(cell, real).clamp(max=self.orders - 1)
            known = torch.cat([known, F.one_hot(order, self.orders).to(known.dtype)], dim=-1)  # (b, n, 14)
        x = torch.cat([features, known, real[..., None].to(features.dtype)], dim=-1)  # (b, n, 20 or 24)
        x = apply_in_float32(self.project_in, x)  # (b, n, d)
        # Attention needs at least one visible token, also in a scene without primitives. The first slot is therefore
        # visible, but if it is padding, it is not written to the latent grid.
        visible = real.clone()
        visible[:, 0] |= ~real.any(dim=1)
        for layer in self.layers:
            x = layer(x, visible)
        x = apply_in_float32(self.project_out, x)  # (b, n, moments)
        if self.shortcut is not None:
            mean, logvar = x.chunk(2, dim=-1)
            added = apply_in_float32(self.shortcut, self.encode_in_cell(features, row, col, known))
            x = torch.cat([mean + added, logvar], dim=-1)
        x = x * real[..., None]
        total = x.new_zeros(batch, rows * cols, moments).scatter_add_(1, cell[..., None].expand(-1, -1, moments), x)
        if not self.orders:
            count = x.new_zeros(batch, rows * cols).scatter_add_(1, cell, real.to(x.dtype))
            total = total / count.clamp(min=1)[..., None]
        return self.grid + total.transpose(1, 2).unflatten(2, (rows, cols))

    def encode_in_cell(self, features: Tensor, row: Tensor, col: Tensor, known: Tensor) -> Tensor:
        """Compute the input of the shortcut.

        Args:
            features: (b, n, 9) normalised features.
            row: (b, n) row of each primitive's cell.
            col: (b, n) column of each primitive's cell.
            known: (b, n, k) category embeddings, and the order if the encoder knows it.

        Returns:
            (b, n, 9 + k): x and y relative to the cell centre (in cells), other features scaled to [-2, 2], `known`.
        """
        _, rows, cols = self.grid.shape
        down, right = (1 - features[..., 0]) * rows - row - 0.5, (1 - features[..., 1]) * cols - col - 0.5
        return torch.cat([down[..., None], right[..., None], 4 * features[..., 2:] - 2, known], dim=-1)

    def drop_padding(self, features: Tensor, real: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Move real primitives to the front, and remove trailing slots that are padding in all samples.

        Masked slots do not change the result, but they cost as much time as real primitives. On average, half of the
        paper's 514 slots are empty.

        Args:
            features: (b, N, 9) normalised features.
            real: (b, N) True for each slot that holds a primitive.

        Returns:
            Features, `real` and categories of n slots per sample, where n is the largest number of primitives in a
            scene of the batch, rounded up to a multiple of `slot_multiple`.
        """
        most = max(int(real.sum(dim=1).max()), 1)
        most = -(-most // self.slot_multiple) * self.slot_multiple
        order = real.to(torch.int8).argsort(dim=1, descending=True, stable=True)[:, :most]  # (b, most)
        picked = features.gather(1, order[..., None].expand(-1, -1, features.shape[-1]))
        return picked, real.gather(1, order), self.slot_category[order]
