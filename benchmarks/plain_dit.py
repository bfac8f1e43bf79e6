"""The original Diffusion Transformer, with one module per operation as in the code of the DiT paper.

The network loads the weights of `models.dit.DiT` by name. For comparison only.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from models.dit import DiT, embed_timesteps


class Attention(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv, self.proj = nn.Linear(width, 3 * width), nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        b, n, d = x.shape
        q, k, v = self.qkv(x).reshape(b, n, 3, self.heads, d // self.heads).permute(2, 0, 3, 1, 4).unbind(0)
        return self.proj(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(b, n, d))


class Block(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width, elementwise_affine=False, eps=1e-6)
        self.attn = Attention(width, heads)
        self.norm2 = nn.LayerNorm(width, elementwise_affine=False, eps=1e-6)
        self.fc1, self.act, self.fc2 = nn.Linear(width, 4 * width), nn.GELU("tanh"), nn.Linear(4 * width, width)
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(width, 6 * width))

    def forward(self, x: Tensor, c: Tensor) -> Tensor:
        shift1, scale1, gate1, shift2, scale2, gate2 = self.adaLN_modulation(c).chunk(6, dim=1)
        x = x + gate1.unsqueeze(1) * self.attn(modulate(self.norm1(x), shift1, scale1))
        hidden = self.act(self.fc1(modulate(self.norm2(x), shift2, scale2)))
        return x + gate2.unsqueeze(1) * self.fc2(hidden)


def modulate(x: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
    return x * (1 + scale.unsqueeze(1)) + shift.unsqueeze(1)


class PlainDiT(nn.Module):
    def __init__(self, ours: DiT) -> None:
        super().__init__()
        c = ours.config
        self.patch, self.tokens = c.patch, c.size // c.patch
        self.x_embedder, self.pos_embed = ours.patch_in, ours.positions
        self.t_mlp, self.y_embedder = ours.timestep_mlp, ours.label_embedding
        self.blocks = nn.ModuleList(Block(c.width, c.heads) for _ in range(c.depth))
        for block, other in zip(self.blocks, ours.blocks, strict=True):
            block.attn.qkv, block.attn.proj, block.fc1, block.fc2 = other.qkv, other.out, other.mlp_in, other.mlp_out
            block.adaLN_modulation[1] = other.modulation
        self.norm_final = nn.LayerNorm(c.width, elementwise_affine=False, eps=1e-6)
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), ours.modulation)
        self.linear = ours.patch_out

    def forward(self, x: Tensor, t: Tensor, y: Tensor) -> Tensor:
        x = self.x_embedder(x).flatten(2).transpose(1, 2) + self.pos_embed
        c = self.t_mlp(embed_timesteps(t)) + self.y_embedder(y)
        for block in self.blocks:
            x = block(x, c)
        shift, scale = self.adaLN_modulation(c).chunk(2, dim=1)
        x = self.linear(modulate(self.norm_final(x), shift, scale))
        x = x.reshape(len(x), self.tokens, self.tokens, self.patch, self.patch, -1)
        return torch.einsum("nhwpqc->nchpwq", x).reshape(len(x), -1, self.tokens * self.patch, self.tokens * self.patch)
