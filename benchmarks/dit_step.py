"""Measure the time of a denoising step of the diffusion transformer on the CPU.

The benchmark compares this project's DiT, the original code with the same weights, and the DiT class of the library
`diffusers`.

    python benchmarks/dit_step.py                      # DiT-B, batch sizes 1 and 8; some minutes
    python benchmarks/dit_step.py --preset kitti360-l --batches 1

Times are wall-clock seconds; the implementations are measured in turn. The benchmark also measures the matrix products
alone. Their time is a lower bound. The benchmark also compares guidance at scale 1 with an implementation that always
doubles the batch.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
import tyro
from common import describe_machine, format_ratios, spread, time_interleaved
from diffusers import DiTTransformer2DModel
from plain_dit import PlainDiT

from models.dit import DiT
from models.presets import DIT_PRESETS
from models.sampling.diffusion import Diffusion, with_guidance


@dataclass(frozen=True)
class Config:
    preset: Literal["kitti360", "kitti360-l", "kitti360-xl"] = "kitti360"
    """DiT-B, L or XL."""
    batches: tuple[int, ...] = (1, 8)
    rounds: int = 9
    threads: int = 2


def make_matrix_products(dit: DiT, batch: int) -> Callable[[], None]:
    """Return a function that runs only the matrix products of a step; their time is a lower bound for the step."""
    c, tokens = dit.config, (dit.config.size // dit.config.patch) ** 2
    wide, deep = torch.randn(batch * tokens, c.width), torch.randn(batch * tokens, 4 * c.width)
    q = torch.randn(batch, c.heads, tokens, c.width // c.heads)

    def run() -> None:
        for block in dit.blocks:
            F.linear(wide, block.qkv.weight, block.qkv.bias)
            F.scaled_dot_product_attention(q, q, q)
            F.linear(wide, block.out.weight, block.out.bias)
            F.linear(wide, block.mlp_in.weight, block.mlp_in.bias)
            F.linear(deep, block.mlp_out.weight, block.mlp_out.bias)

    return run


@torch.inference_mode()
def compare(name: str, ours: DiT, plain: PlainDiT, theirs: DiTTransformer2DModel, batch: int, rounds: int) -> None:
    """Print the time of a step for each implementation."""
    c, timesteps = ours.config, Diffusion().select_timesteps(250).tolist()
    latent, label = torch.randn(batch, c.channels, c.size, c.size), torch.arange(batch) % 3
    at = [torch.full((batch,), t) for t in timesteps]
    start = time.perf_counter()
    prepared = ours.precompute_conditioning(timesteps, label.tolist())
    print(f"{name}, batch {batch}: all modulations of 250 steps: {time.perf_counter() - start:.2f} s, once")
    for same in (plain, prepared):
        assert torch.allclose(same(latent, at[9], label), ours(latent, at[9], label), atol=1e-3)
    gemm, doubled = make_matrix_products(ours, batch), with_guidance(ours, ours.null_label, 1.0 + 1e-9)
    ways = {
        "ours": lambda k: prepared(latent, at[k], label),
        "ours, modulations in the step": lambda k: ours(latent, at[k], label),
        "the original": lambda k: plain(latent, at[k], label),
        "diffusers": lambda k: theirs(latent, at[k], label, return_dict=False),
        "the matrix products alone": lambda k: gemm(),
        "a batch that is always doubled": lambda k: doubled(latent, at[k], label),
    }
    for way in ways.values():
        way(0)
    seconds = time_interleaved(ways, rounds, time.perf_counter)
    for way, found in seconds.items():
        print(f"{name}, batch {batch}, {way}: {spread(found, 1e3, 0)} ms")
    for way in list(ways)[1:]:
        print(
            f"{name}, batch {batch}: time of ours / time of {way} = {format_ratios(seconds['ours'], seconds[way], 2)}"
        )


def main(config: Config) -> None:
    torch.set_num_threads(config.threads)
    print(describe_machine(), f"{config.threads} threads")
    torch.manual_seed(0)
    ours = DiT(**DIT_PRESETS[config.preset].architecture()).eval().requires_grad_(False)
    for parameter in ours.parameters():  # the initial zeros would disable most of the network
        if not parameter.any():
            torch.nn.init.normal_(parameter, std=0.02)
    c = ours.config
    theirs = DiTTransformer2DModel(
        num_attention_heads=c.heads,
        attention_head_dim=c.width // c.heads,
        in_channels=c.channels,
        out_channels=c.channels,
        num_layers=c.depth,
        sample_size=c.size,
        patch_size=c.patch,
        num_embeds_ada_norm=1000,
        norm_type="ada_norm_zero",
    ).eval()
    for batch in config.batches:
        compare(config.preset, ours, PlainDiT(ours).eval(), theirs, batch, config.rounds)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
