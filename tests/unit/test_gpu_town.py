"""Tests of benchmarks/gpu_town.py: the auction against scipy's assignment, and the scenes in the memory of a device."""

import sys

import numpy as np
import pytest
import torch
from helpers import ROOT
from scipy.optimize import linear_sum_assignment

sys.path.insert(0, str(ROOT / "benchmarks"))
import gpu_town

from models.layout import LayoutSpec
from models.scene import Grid
from models.tensors import encode_layout
from models.vae.matching import MatchWeights, compute_match_cost
from pipelines.preprocess.sources.town.generator import generate_town, select_town_poses


@pytest.mark.parametrize("spread", [0.02, 0.3])
def test_auction_finds_almost_the_cheapest_assignment(spread):
    slots, proposals, batch = (6, 10), (40, 90), 4
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(batch, sum(slots), 9, generator=generator)
    real = torch.zeros(batch, sum(slots), dtype=torch.bool)
    for sample, counts in enumerate([(6, 10), (0, 3), (2, 0), (0, 0)]):
        for first, count in zip((0, 6), counts, strict=True):
            real[sample, first : first + count] = True
    # All proposals lie close to a few primitives, so primitives compete for them.
    features = truth[:, torch.randint(16, (130,), generator=generator)]
    features = features + spread * torch.randn(features.shape, generator=generator)
    logit = torch.randn(batch, 130, generator=generator)
    weights = MatchWeights(existence=1.0)
    found = gpu_town.match_by_auction(features, logit, truth, real, slots, proposals, weights)
    cost = compute_match_cost(features, logit, truth, weights).double().numpy()
    for sample in range(batch):
        columns = np.flatnonzero(found[sample] >= 0)
        rows = found[sample, columns].numpy()
        assert sorted(rows) == np.flatnonzero(real[sample]).tolist()
        for first_slot, slot_count, first, count in ((0, 6, 0, 40), (6, 10, 40, 90)):
            mine = (rows >= first_slot) & (rows < first_slot + slot_count)
            assert ((columns[mine] >= first) & (columns[mine] < first + count)).all()
            n = int(real[sample, first_slot : first_slot + slot_count].sum())
            part = cost[sample, first_slot : first_slot + n, first : first + count]
            best = part[linear_sum_assignment(part)].sum()
            assert best - 1e-6 <= cost[sample, rows[mine], columns[mine]].sum() <= best + 0.5 * n


def test_pool_returns_encoded_scenes():
    spec = LayoutSpec().with_resolution(64)
    pool = gpu_town.Pool(spec, 8, torch.device("cpu"))
    for seed in (3, 1_000_000):
        pool.add(gpu_town.pack_town((seed, 4, spec.to_dict())))
    assert pool.size == 8
    drive = generate_town(1_000_000, 2, 1)
    drive = drive.at(select_town_poses(len(drive), 4, 1))
    for clip in (True, False):
        stored = pool.unpack(torch.tensor([7, 4]), clip)
        for k, pose in enumerate((3, 0)):
            wanted = encode_layout(drive.scene(pose, grid=Grid(64.0, 32.0, 1.0, 64, 64)), spec, clip_heights=clip)
            for name in ("occupied", "features", "real"):
                assert np.array_equal(stored[name][k].numpy(), wanted[name]), name
            assert np.abs(stored["height"][k].numpy() - wanted["height"].astype(np.int64)).max() <= 1
    assert pool.free_pose.tolist() == 2 * [False, False, False, True]
