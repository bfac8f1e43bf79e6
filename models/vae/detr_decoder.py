"""Object decoder of the paper: a DETR transformer predicts primitives from the latent (paper, supplement B.2).

With the default options, the decoder is DETR (Carion et al., ECCV 2020) without dropout, as in the paper. The paper
mentions neither DETR's auxiliary losses (off by default) nor its normalisation after the last layer (not implemented).
These options of `ObjectConfig` are changes from the literature that were proposed to speed up training:

* `queries="anchors"`: each query has a learned reference point, as in Anchor DETR (Wang et al., AAAI 2022). The
  position embedding of a query is a function of its point. A layer predicts offsets from the points, and the next layer
  starts from the moved points, as in Deformable DETR (Zhu et al., ICLR 2021).
* `queries="conditional"`: anchors and the cross-attention of Conditional DETR (Meng et al., ICCV 2021), in which
  contents and positions have separate products.
* `learned_content`: the contents of queries start from learned values and not from zeros.
* `auxiliary_losses`: each layer predicts primitives and has a loss, as in DETR.
* `denoising_groups`: in training, additional queries start from true primitives with noise, as in DN-DETR (Li et al.,
  CVPR 2022). Their targets need no matching.

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
from models.vae.outputs import Prediction, Proposals
from models.vae.transformer import Attention, make_feed_forward

CENTER = 3  # The first three features are the centre.
WAVELENGTH_RATIO = {"map": 10_000, "cell": 20}  # Longest wavelength of position embeddings divided by the shortest.
POSITION_GAIN = 2.5  # Gain of the initial projections of positions in conditional attention.
ANCHOR_MARGIN = 0.02  # Smallest distance of an initial anchor from the border of the area, normalised.


def embed_positions(
    row_col: Float[Tensor, "*batch 2"], size: int, width: int, unit: str = "map"
) -> Float[Tensor, "*batch d"]:
    """Compute the sine position embeddings of DETR.

    Args:
        row_col: Row and column in latent cells. The middle of the first cell is at 0.5.
        size: Number of rows and of columns of the latent grid.
        width: Number of channels. One half encodes the row, the other half the column.
        unit: "map": wavelengths from 1 to 10,000 times the side of the grid, as in the settings of DETR. "cell":
            wavelengths from 2 pi cells to 20 times as much, so that neighbouring cells differ. The ratio is that of
            DAB-DETR (Liu et al., ICLR 2022).

    Returns:
        Position embeddings.
    """
    position = row_col + 0.5  # DETR counts cells from 1.
    if unit == "map":
        position = position / size * 2 * torch.pi
    wavelength = WAVELENGTH_RATIO[unit] ** (
        torch.arange(0, width // 2, 2, dtype=torch.float32, device=row_col.device) / (width // 2)
    )
    angle = position[..., None] / wavelength  # (..., 2, d / 4)
    return torch.stack([angle.sin(), angle.cos()], dim=-1).flatten(-3)


class ConditionalAttention(nn.Module):
    """Cross-attention whose logits are the sum of a product of contents and a product of positions (Meng et al.).

    Except in the first layer, a network scales the position embedding of each query, depending on its content.

    Unlike in Conditional DETR, the projections of both positions start with equal orthogonal weights, and the scales
    start near 1. Each query therefore attends to the cells around its reference point from the first step.
    """

    def __init__(self, width: int, heads: int, is_first: bool = False) -> None:
        super().__init__()
        self.heads = heads
        names = ("query", "key", "value", "query_position", "key_position")
        self.projections = nn.ModuleDict({name: nn.Linear(width, width) for name in names})
        self.scale = None if is_first else make_feed_forward(width, width)
        self.out = nn.Linear(width, width)
        for projection in self.projections.values():
            nn.init.xavier_uniform_(cast(nn.Linear, projection).weight)
            nn.init.zeros_(cast(nn.Linear, projection).bias)
        of_query, of_key = (cast(nn.Linear, self.projections[f"{side}_position"]).weight for side in ("query", "key"))
        nn.init.orthogonal_(of_query, POSITION_GAIN)
        with torch.no_grad():
            of_key.copy_(of_query)
        if self.scale is not None:
            nn.init.ones_(cast(nn.Linear, self.scale[2]).bias)

    def forward(self, query: Tensor, query_position: Tensor, memory: Tensor, memory_position: Tensor) -> Tensor:
        """Attend from queries to cells.

        Args:
            query: (b, n, d) contents of the queries.
            query_position: (b, n, d) sine embeddings of the reference points.
            memory: (b, hw, d) contents of the cells.
            memory_position: (hw, d) position embeddings of the cells.

        Returns:
            (b, n, d) tokens.
        """

        def split(name: str, x: Tensor) -> Tensor:
            return self.projections[name](x).unflatten(-1, (self.heads, -1)).transpose(1, 2)

        place = split("key_position", memory_position[None]).expand(len(memory), -1, -1, -1)
        if self.scale is not None:
            query_position = query_position * self.scale(query)
        q = torch.cat([split("query", query), split("query_position", query_position)], dim=-1)
        k = torch.cat([split("key", memory), place], dim=-1)
        value = split("value", memory)
        channels = value.shape[-1]
        padded = F.pad(value, (0, channels))  # The fused kernels need as many channels as queries and keys have.
        mixed = F.scaled_dot_product_attention(q, k, padded)[..., :channels]
        return self.out(mixed.transpose(1, 2).flatten(2))


class DecoderLayer(nn.Module):
    """DETR decoder layer with post-norm. Positions are added to queries and keys but not to values.

    The initial weights have the distribution of DETR's.
    """

    def __init__(self, width: int, heads: int, hidden: int, conditional: bool = False, is_first: bool = False) -> None:
        super().__init__()
        self.self_attention = Attention(width, heads)
        self.cross_attention = ConditionalAttention(width, heads, is_first) if conditional else Attention(width, heads)
        self.mlp = make_feed_forward(width, hidden)
        self.norm1, self.norm2, self.norm3 = nn.LayerNorm(width), nn.LayerNorm(width), nn.LayerNorm(width)
        for linear in (self.self_attention.out, self.cross_attention.out, self.mlp[0], self.mlp[2]):
            nn.init.xavier_uniform_(cast(nn.Linear, linear).weight)

    def forward(
        self,
        x: Tensor,
        query_position: Tensor,
        sine: Tensor | None,
        memory: Tensor,
        memory_position: Tensor,
        visible: Tensor | None = None,
    ) -> Tensor:
        """Apply the layer.

        Args:
            x: (b, n, d) contents of the queries.
            query_position: (n, d) or (b, n, d) position embedding of each query.
            sine: (b, n, d) sine embeddings of the reference points, only for conditional cross-attention.
            memory: (b, hw, d) projected latent cells.
            memory_position: (hw, d) position embeddings of the cells.
            visible: (b, n); True marks the queries that other queries see. None: all queries.

        Returns:
            (b, n, d) tokens.
        """
        placed = x + query_position
        x = self.norm1(x + self.self_attention(placed, placed, x, visible))
        if isinstance(self.cross_attention, ConditionalAttention):
            mixed = self.cross_attention(x, cast(Tensor, sine), memory, memory_position)
        else:
            mixed = self.cross_attention(x + query_position, memory + memory_position, memory)
        x = self.norm2(x + mixed)
        return self.norm3(x + self.mlp(x))


class OutputHeads(nn.Module):
    """Output networks of one category: a three-layer network for nine features, and a linear layer for existence."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.features = nn.Sequential(
            nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, FEATURES)
        )
        self.existence = nn.Linear(width, 1)


class DETRDecoder(nn.Module):
    """Decode an object latent to normalised features in [0, 1] and an existence logit per slot.

    Args:
        slots: Number of slots per category.
        latent_channels: Number of channels of the latent.
        latent_size: Number of rows and of columns of the latent.
        config: Options of the object branch.
    """

    def __init__(self, slots: tuple[int, ...], latent_channels: int, latent_size: int, config: ObjectConfig) -> None:
        super().__init__()
        width, heads, hidden, count = config.width, config.heads, config.hidden, sum(slots)
        self.proposals = tuple(slots)
        self.match_weights = MatchWeights()
        self.latent_size, self.width, self.unit = latent_size, width, config.position_unit
        self.auxiliary_losses, self.groups = config.auxiliary_losses, config.denoising_groups
        self.project_in = nn.Linear(latent_channels, width)  # patch size 1
        self.queries = self.anchors = self.content = self.embed_noised = None
        conditional = config.queries == "conditional"
        if config.queries == "learned":
            self.queries = nn.Parameter(torch.randn(count, width))
        else:
            share = torch.rand(count, CENTER) * (1 - 2 * ANCHOR_MARGIN) + ANCHOR_MARGIN
            self.anchors = nn.Parameter(share.logit())
            self.embed_anchor = make_feed_forward(width, width)
        if config.learned_content:
            self.content = nn.Parameter(torch.randn(count, width))
        if self.groups:
            self.embed_noised = nn.Linear(FEATURES, width)
            self.embed_noised_category = nn.Parameter(torch.randn(len(slots), width))
        layers = (DecoderLayer(width, heads, hidden, conditional, is_first=k == 0) for k in range(config.layers))
        self.layers = nn.ModuleList(layers)
        self.heads = nn.ModuleList(OutputHeads(width, config.head_hidden) for _ in slots)
        register_computed_buffers(self)

    def compute_buffers(self) -> dict[str, Tensor]:
        """Return the position embeddings of the latent cells, in row-major order."""
        require_within("model_buffers", self.latent_size**2 * self.width, "positions of the cells")
        middle = torch.arange(self.latent_size, dtype=torch.float32) + 0.5
        return {
            "positions": embed_positions(torch.cartesian_prod(middle, middle), self.latent_size, self.width, self.unit)
        }

    def forward(
        self,
        latent: Float[Tensor, "batch c h w"],
        noised: Float[Tensor, "batch groups n 9"] | None = None,
        real: Bool[Tensor, "batch n"] | None = None,
    ) -> Proposals:
        """Decode object latents.

        Args:
            latent: Object latents.
            noised: Features of the true primitives with noise, for denoising queries; None: no denoising queries.
            real: True for each slot that holds a primitive.

        Returns:
            Normalised features and existence logits of all slots. In training, the predictions of the other layers and
            of the denoising queries are added if the options ask for them.
        """
        memory = apply_in_float32(self.project_in, latent.flatten(2).transpose(1, 2))  # (b, hw, d)
        shape = (len(latent), sum(self.proposals), self.width)
        start = memory.new_zeros(1) if self.content is None else self.content  # DETR starts from zeros.
        x = start.expand(shape)
        anchors = None if self.anchors is None else self.anchors.expand(len(latent), -1, -1)
        *others, last = self._run_layers(x, anchors, memory)
        denoised = []
        if self.embed_noised is not None and noised is not None and real is not None:
            groups = noised.shape[1]
            truth, visible = noised.flatten(0, 1), real.repeat_interleave(groups, 0)
            visible = visible | ~visible.any(dim=1, keepdim=True)  # Attention needs at least one visible token.
            content = apply_in_float32(self.embed_noised, truth)
            sizes = torch.tensor(self.proposals, device=latent.device)
            content = content + self.embed_noised_category.repeat_interleave(sizes, 0, output_size=shape[1])
            anchors = None if self.anchors is None else truth[..., :CENTER].clamp(1e-4, 1 - 1e-4).logit()
            cells = memory.repeat_interleave(groups, 0)
            denoised = self._run_layers(content, anchors, cells, visible)
        return Proposals(*last, tuple(others), tuple(denoised))

    def _run_layers(
        self, x: Tensor, anchors: Tensor | None, memory: Tensor, visible: Tensor | None = None
    ) -> list[Prediction]:
        """Return the predictions of the last layer, preceded by those of the other layers if they have losses."""
        wanted = self.training and (self.auxiliary_losses or visible is not None)
        is_denoising, found, sine = visible is not None, [], None
        place: Tensor = x if self.queries is None else self.queries
        if is_denoising and self.queries is not None:
            x, place = torch.zeros_like(x), x
        positions = cast(Tensor, self.positions)
        for k, layer in enumerate(self.layers):
            if anchors is not None:
                # x points ahead and y to the left; row 0 lies farthest ahead and column 0 farthest left.
                row_col = (1 - anchors[..., :2].sigmoid()) * self.latent_size
                sine = embed_positions(row_col, self.latent_size, self.width, self.unit)
                place = self.embed_anchor(sine)
            x = layer(x, place, sine, memory, positions, visible)
            if k == len(self.layers) - 1 or wanted or anchors is not None:
                logits, existence = self._apply_heads(x)
                if anchors is not None:
                    center = logits[..., :CENTER] + anchors
                    logits, anchors = torch.cat([center, logits[..., CENTER:]], dim=-1), center.detach()
                found.append(Prediction(logits.sigmoid(), existence))
        return found if wanted else found[-1:]

    def _apply_heads(self, x: Tensor) -> tuple[Tensor, Tensor]:
        groups = list(zip(self._list_heads(), x.split(self.proposals, dim=1), strict=True))
        features = torch.cat([apply_in_float32(head.features, group) for head, group in groups], dim=1)
        existence = torch.cat([apply_in_float32(head.existence, group) for head, group in groups], dim=1).squeeze(-1)
        return features, existence

    def _list_heads(self) -> list[OutputHeads]:
        return [cast(OutputHeads, head) for head in self.heads]

    def init_from_data(
        self, feature_logit: Float[Tensor, "categories features"], count: Float[Tensor, " categories"]
    ) -> None:
        """Set the output biases to the mean features and the mean existence of each category.

        With anchors, the centres start at the anchors, and the height of the anchors is the mean.

        Args:
            feature_logit: Logits of the mean normalised features of each category.
            count: Mean number of primitives of each category in a scene.
        """
        for head, mean, expected, offered in zip(self._list_heads(), feature_logit, count, self.proposals, strict=True):
            bias = cast(Tensor, head.features[-1].bias)
            bias.copy_(mean)
            if self.anchors is not None:
                bias[:CENTER] = 0
            head.existence.bias.copy_((expected / offered).clamp(0.01, 0.99).logit())
        if self.anchors is not None:
            sizes = torch.tensor(self.proposals, device=self.anchors.device)
            self.anchors[:, 2] = feature_logit[:, 2].repeat_interleave(sizes)
