"""Compare two ways to obtain the known part of a block's latent.

The way `copy` copies this part from the latent of the neighbouring block, as in the paper. The way `reencode` encodes
the known scene again.

    python benchmarks/overlap.py --lvae DIRECTORY

The two blocks of a pair are cut from the same town, 32 m apart along the street. The known half of the second latent
comes from the first block. The other half comes from the true scene. The benchmark decodes the second latent and
compares the known half of the result with the true scene. The case "own latent" decodes the latent of the whole second
block. Its result is an upper bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import tyro
from common import describe_machine

from models.composition.block_grid import BlockGrid
from models.composition.outpaint import BlockComposer, SceneBlock, find_ground_height
from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.scene import Grid, Scene
from models.tensors import decode_layout, make_empty_scene, make_layout_batch
from pipelines.generation.inpaint import compute_drift, compute_drift_scores
from pipelines.generation.sample import resample_to_model_grid
from pipelines.preprocess.sources.town.generator import generate_town
from pipelines.training.latents import load_lvae

STEP_M = 32.0


@dataclass(frozen=True)
class Config:
    lvae: str
    """Directory of a trained layout VAE of the town."""
    seeds: tuple[int, ...] = tuple(range(10_000, 10_016))
    """Towns; none that training has seen."""
    make_pairs: int = 4
    """Of each town."""


def make_pairs(seed: int, count: int, spec: LayoutSpec) -> list[tuple[Scene, Scene]]:
    """Return pairs of scenes in a town, 32 m apart; each scene has a separate frame with the same heading and
    height."""
    drive, grid = generate_town(seed), Grid()
    large = replace(grid, front_m=grid.front_m + STEP_M, rows=grid.rows + round(STEP_M / grid.resolution_m))
    found = []
    for pose in np.linspace(0, len(drive) - 1, count).astype(int):
        scene = drive.scene(pose, "test", large)
        ahead = scene.crop(replace(grid, front_m=large.front_m)).translate(-STEP_M, 0)
        found.append(tuple(resample_to_model_grid(part, spec) for part in (scene.crop(grid), ahead)))
    return found


@torch.inference_mode()
def compare(lvae: LayoutVAE, first: Scene, second: Scene) -> dict[str, dict[str, float]]:
    """Print the drift of the known half of the second block for each kind of latents."""
    spec = lvae.spec

    def encode(scenes: Sequence[Scene]) -> torch.Tensor:
        return lvae.encode(make_layout_batch(list(scenes), spec)).mean

    def decode_latent(latent: torch.Tensor) -> Scene:
        return decode_layout(lvae.decode(latent[None]).layouts()[0], spec, empty)

    empty = make_empty_scene(second.scene_id, second.source, second.sequence, second.frame, spec)
    block_grid = BlockGrid.from_overlap(lvae.latent_shape[-1], STEP_M / 64.0)
    composer = BlockComposer(block_grid, spec, encode, find_ground_height(first, 0.0, 0.0))
    blocks, found = {(0, 0): SceneBlock(first, encode([first])[0])}, {}
    for mode in ("copy", "reencode"):
        condition = composer.condition_block((1, 0), blocks, empty, mode)
        truth = second.translate(0, 0, -condition.datum_m)
        latent = torch.where(condition.mask.bool(), encode([truth])[0], condition.latent)
        found[mode] = compute_drift(truth, decode_latent(latent), condition.new_pixels)
        if mode == "reencode":
            found["own latent"] = compute_drift(truth, decode_latent(encode([truth])[0]), condition.new_pixels)
    return found


def main(config: Config) -> None:
    lvae = load_lvae(config.lvae)
    print(describe_machine())
    sums: dict[str, list] = {}
    for seed in config.seeds:
        for first, second in make_pairs(seed, config.pairs, lvae.spec):
            for way, found in compare(lvae, first, second).items():
                sums.setdefault(way, []).append(found)
    print(f"{len(sums['copy'])} pairs of blocks in {len(config.seeds)} towns; known half of the second block")
    for way, found in sums.items():
        print(f"{way}:", ", ".join(f"{name} {value:.4g}" for name, value in compute_drift_scores(found).items()))


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
