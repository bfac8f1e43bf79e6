"""Compare ways to obtain the known part of a block's latent.

The way `copy` copies this part from the latent of the neighbouring block, as in the paper. The way `reencode` encodes
the known scene again; the unknown pixels then have the ground of the nearest known pixel. The way `empty surroundings`
does the same, but the unknown pixels are empty.

    python benchmarks/overlap.py --lvae DIRECTORY

The two blocks of a pair are cut from the same town, 32 m apart along the street. The known half of the second latent
comes from the first block. The other half comes from the true scene. The benchmark decodes the second latent and
compares the known half of the result with the true scene. The case "own latent" decodes the latent of the whole second
block. Its result is an upper bound. The benchmark also prints the root mean square difference between the known latent
cells and those of the whole second block, by distance from the unknown part.
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
EMPTY, OWN = "empty surroundings", "own latent"


@dataclass(frozen=True)
class Config:
    lvae: str
    """Directory of a trained layout VAE of the town."""
    seeds: tuple[int, ...] = tuple(range(10_000, 10_016))
    """Towns; none that training has seen."""
    pairs: int = 4
    """Number of pairs of blocks in each town."""


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
def compare(
    lvae: LayoutVAE, first: Scene, second: Scene
) -> tuple[dict[str, dict[str, float]], dict[str, torch.Tensor]]:
    """Measure the known half of the second block for each way.

    Returns:
        Drift by way, and the mean squared differences (channels, cells) of latents by way and distance in cells from
        the unknown part.
    """
    spec = lvae.spec

    def encode(scenes: Sequence[Scene]) -> torch.Tensor:
        return lvae.encode(make_layout_batch(list(scenes), spec)).mean

    def decode_latent(latent: torch.Tensor) -> Scene:
        return decode_layout(lvae.decode(latent[None]).layouts()[0], spec, empty)

    empty = make_empty_scene(second.scene_id, second.source, second.sequence, second.frame, spec)
    block_grid = BlockGrid.from_overlap(lvae.latent_shape[-1], STEP_M / 64.0)
    composer = BlockComposer(block_grid, spec, encode, find_ground_height(first, 0.0, 0.0))
    blocks, found, errors = {(0, 0): SceneBlock(first, encode([first])[0])}, {}, {}
    for mode in ("copy", "reencode"):
        condition = composer.condition_block((1, 0), blocks, empty, mode)
        truth = second.translate(0, 0, -condition.datum_m)
        own = encode([truth])[0]
        ways = {mode: condition.latent}
        if mode == "reencode":
            ways |= {EMPTY: encode([condition.known])[0], OWN: own}
        for way, known in ways.items():
            latent = torch.where(condition.mask.bool(), own, known)
            found[way] = compute_drift(truth, decode_latent(latent), condition.new_pixels)
            # Block (1, 0) lies ahead of block (0, 0): its known half consists of the last rows of cells.
            errors[way] = (latent - own)[:, latent.shape[1] // 2 :].square().mean(dim=2)
    return found, errors


def main(config: Config) -> None:
    lvae = load_lvae(config.lvae)
    print(describe_machine())
    sums: dict[str, list] = {}
    squares: dict[str, list[torch.Tensor]] = {}
    for seed in config.seeds:
        for first, second in make_pairs(seed, config.pairs, lvae.spec):
            drifts, errors = compare(lvae, first, second)
            for way, found in drifts.items():
                sums.setdefault(way, []).append(found)
                squares.setdefault(way, []).append(errors[way])
    print(f"{len(sums['copy'])} pairs of blocks in {len(config.seeds)} towns; known half of the second block")
    for way, found in sums.items():
        print(f"{way}:", ", ".join(f"{name} {value:.4g}" for name, value in compute_drift_scores(found).items()))
        by_row = torch.stack(squares[way]).mean(dim=(0, 1)).sqrt()
        print("  difference by distance from the unknown part:", ", ".join(f"{value:.3f}" for value in by_row.tolist()))


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
