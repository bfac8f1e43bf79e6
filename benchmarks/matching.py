"""Compare two versions of matching on the same inputs: costs of real primitives only, and padded square costs.

    python benchmarks/matching.py

The times are CPU seconds of one thread, and wall-clock seconds on all cores.
"""

from __future__ import annotations

import os
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import plain
import torch
from common import describe_machine, format_ratios, spread, time_interleaved

from models.layout import LayoutSpec
from models.scene import Grid
from models.tensors import make_layout_batch
from models.vae.matching import PAPER_WEIGHTS, match_primitives
from pipelines.preprocess.sources.town.generator import generate_town

BATCH = 32


def make_town_batch(spec: LayoutSpec, batch: int):
    """Return layouts of `batch` scenes from several districts of the town."""
    scenes = []
    for seed in range(4):
        drive = generate_town(seed)
        poses = np.linspace(0, len(drive) - 1, batch // 4).astype(int)
        scenes += [drive.scene(int(k), "train", Grid()) for k in poses]
    return make_layout_batch(scenes, spec)


def main() -> None:
    torch.set_num_threads(1)
    spec = LayoutSpec()
    truth = make_town_batch(spec.with_resolution(32), BATCH)
    print(describe_machine())
    print(
        f"batch {BATCH}, {spec.num_slots} slots in {len(spec.slots)} categories, "
        f"{float(truth.real.sum(1).float().mean()):.0f} real primitives a scene"
    )
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(truth.features.shape, generator=generator)
    for name, features in (
        ("untrained", torch.rand(truth.features.shape, generator=generator)),
        (
            "like trained (shuffled truth with noise of 0.02)",
            shuffle_slots(truth.features + 0.02 * noise, spec, generator),
        ),
    ):
        logit = torch.randn(truth.real.shape, generator=generator)
        given = (features, logit, truth.features, truth.real, spec.slots, spec.slots, PAPER_WEIGHTS)
        found: dict[str, torch.Tensor] = {}
        ways = {
            "padded": lambda _, given=given, found=found: found.update(padded=plain.match_primitives(*given)),
            "ours": lambda _, given=given, found=found: found.update(ours=match_primitives(*given)),
        }
        torch.set_num_threads(1)
        seconds = time_interleaved(ways, 7)
        cost = {k: plain.sum_cost(*given[:4], a, *given[4:]) for k, a in found.items()}
        difference = abs(cost["ours"] - cost["padded"]) / cost["padded"]
        print(
            f"{name}: padded {spread(seconds['padded'], 1e3, 0)} ms, ours {spread(seconds['ours'], 1e3, 1)} ms: "
            f"{format_ratios(seconds['padded'], seconds['ours'])}; total costs differ by {difference:.1e}"
        )
        torch.set_num_threads(os.cpu_count())
        seconds = time_interleaved(ways, 7, time.perf_counter)
        print(
            f"  wall-clock time on all cores: padded {spread(seconds['padded'], 1e3, 0)} ms, "
            f"ours {spread(seconds['ours'], 1e3, 1)} ms: {format_ratios(seconds['padded'], seconds['ours'])}"
        )


def shuffle_slots(features: torch.Tensor, spec: LayoutSpec, generator: torch.Generator) -> torch.Tensor:
    """Permute slots within their categories."""
    groups = features.split(spec.slots, dim=1)
    return torch.cat([g[:, torch.randperm(g.shape[1], generator=generator)] for g in groups], dim=1)


if __name__ == "__main__":
    main()
