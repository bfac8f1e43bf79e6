"""Tests of the networks: sizes, masks, equivariance, losses and training."""

import itertools
import re
from functools import partial

import numpy as np
import pytest
import torch
from diffusers.models.attention_processor import Attention, PAGIdentitySelfAttnProcessor2_0
from helpers import random_scene, small_spec
from safetensors.torch import load_file
from scipy import ndimage
from scipy.optimize import linear_sum_assignment
from torch import nn
from torch.nn import functional as F

from models.batch import LayoutBatch
from models.dit import DiT, DiTBlock
from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.presets import DIT_PRESETS, LVAE_PRESETS, find_preset
from models.tensors import encode_layout, make_layout_batch
from models.training import ExecutionConfig, OptimizerConfig, Trainer, make_lvae_trainer, sample_corruption
from models.vae.config import nest_flat_options, override_options
from models.vae.detr_decoder import ConditionalAttention, DecoderLayer, embed_positions
from models.vae.ground import (
    HEIGHT_WEIGHT,
    LOGITS_PER_PX,
    compute_edge_reach_px,
    compute_signed_distance_px,
    compute_smooth_maps,
)
from models.vae.losses import (
    compute_height_loss,
    compute_kl_loss,
    compute_lvae_loss,
    compute_object_losses,
    compute_occupancy_loss,
)
from models.vae.matching import MatchWeights, match_primitives
from models.vae.objects import count_earlier_in_cell
from models.vae.outputs import Posterior
from models.vae.transformer import EncoderLayer


def count_million_parameters(model) -> float:
    return sum(p.numel() for p in model.parameters()) / 1e6


def make_small_lvae(seed: int = 0, **options) -> LayoutVAE:
    torch.manual_seed(seed)
    options = override_options(LVAE_PRESETS["smoke"].architecture(), nest_flat_options(options))
    return LayoutVAE(layout=small_spec().to_dict(), **options)


def test_presets_have_parameter_counts_of_paper():
    with torch.device("meta"):
        row = LVAE_PRESETS["kitti360"]
        lvae = LayoutVAE(layout=LayoutSpec().with_resolution(row.raster_px).to_dict(), **row.architecture())
        assert lvae.latent_shape == (64, 32, 32)
        assert abs(count_million_parameters(lvae) - 93.1) < 0.1
        for name, count in (("kitti360", 130), ("kitti360-l", 458), ("kitti360-xl", 675)):
            assert abs(count_million_parameters(DiT(**DIT_PRESETS[name].architecture())) / count - 1) < 0.005


def test_presets_error_lists_known_names():
    with pytest.raises(
        ValueError, match="unknown preset 'tiny', expected one of: smoke, demo, town, town-pixels, kitti360, av2"
    ):
        find_preset(LVAE_PRESETS, "tiny")


def test_object_encoder_ignores_padding_and_order():
    lvae, spec = make_small_lvae(), small_spec()
    batch = make_layout_batch([random_scene(0), random_scene(1, n=0)], spec)
    latent = lvae.object_encoder(batch.features, batch.real)
    assert torch.isfinite(latent).all()
    assert torch.equal(latent[1], lvae.object_encoder.grid)  # an empty scene gives the learnable grid
    noisy = torch.where(batch.real[..., None], batch.features, torch.rand_like(batch.features))
    assert torch.allclose(lvae.object_encoder(noisy, batch.real), latent, atol=1e-5)
    order = torch.cat([torch.randperm(6) + 6 * k for k in range(11)])
    permuted = lvae.object_encoder(batch.features[:, order], batch.real[:, order])
    assert torch.allclose(permuted, latent, atol=1e-5)


def test_object_encoder_writes_to_cell_under_center():
    lvae, spec = make_small_lvae(), small_spec()
    scene = random_scene(0, n=1, center_m=np.array([[63.0, 31.0, 0.0]], np.float32))  # the far left corner of the crop
    batch = make_layout_batch([scene], spec)
    change = (lvae.object_encoder(batch.features, batch.real)[0] - lvae.object_encoder.grid).abs().sum(0)
    assert change[0, 0] > 0 and change.sum() == change[0, 0]


def test_layout_vae_ground_reads_first_half_of_latent():
    lvae, batch = make_small_lvae(), make_layout_batch([random_scene(0)], small_spec())
    latent = lvae.encode(batch).mean
    changed = latent.clone()
    changed[:, latent.shape[1] // 2 :] += 1
    a, b = lvae.decode(latent), lvae.decode(changed)
    assert torch.equal(a.height, b.height) and torch.equal(a.occupancy_logit, b.occupancy_logit)
    assert not torch.allclose(a.features, b.features)


def compute_literal_cost(features, logit, truth, real, columns) -> float:
    """Compute the matching cost of the paper for one category, term by term."""
    p = torch.sigmoid(logit.double())
    total = 0.0
    for i, j in enumerate(columns):
        target = 1.0 if real[i] else 0.0
        total += MatchWeights().existence * float(-(target * p[j].log() + (1 - target) * (1 - p[j]).log()))
        if real[i]:
            total += MatchWeights().center * float((truth[i, :3] - features[j, :3]).abs().sum())
            total += MatchWeights().cholesky * float((truth[i, 3:] - features[j, 3:]).abs().sum())
    return total


def test_matching_reaches_optimum_of_padded_square_problem():
    generator = torch.Generator().manual_seed(0)
    slots = (9, 1, 6)
    n = sum(slots)
    for trial in range(20):
        features, truth = (torch.rand(1, n, 9, generator=generator) for _ in range(2))
        logit = 3 * torch.randn(1, n, generator=generator)
        counts = [int(torch.randint(0, s + 1, (), generator=generator)) for s in slots]
        real = torch.cat([torch.arange(s) < c for s, c in zip(slots, counts, strict=True)])[None]
        assignment = match_primitives(features, logit, truth, real, slots, slots)[0]
        start = 0
        for s, count in zip(slots, counts, strict=True):
            here = slice(start, start + s)
            part = (features[0, here], logit[0, here], truth[0, here], real[0, here])
            square = np.array(
                [
                    [compute_literal_cost(*part[:2], part[2][i : i + 1], part[3][i : i + 1], [j]) for j in range(s)]
                    for i in range(s)
                ]
            )
            rows, cols = linear_sum_assignment(square)
            mine = assignment[here]
            taken = [int((mine == start + i).nonzero()) for i in range(count)]
            free = [j for j in range(s) if mine[j] < 0]
            assert len(taken) + len(free) == s
            assert abs(compute_literal_cost(*part, taken + free) - square[rows, cols].sum()) < 1e-5, trial
            start += s


def test_matching_of_surplus_proposals_is_optimal():
    """The reference is a search over a rectangular cost matrix, because there are more proposals than slots."""
    generator = torch.Generator().manual_seed(3)
    slots, proposals, weights = (3, 2), (7, 5), MatchWeights(1.0, 24.0, 3.0)
    features, truth = torch.rand(1, 12, 9, generator=generator), torch.rand(1, 5, 9, generator=generator)
    logit = torch.randn(1, 12, generator=generator)
    real = torch.tensor([[True, True, True, True, False]])
    assignment = match_primitives(features, logit, truth, real, slots, proposals, weights)[0]
    scale = torch.tensor([24.0] * 3 + [3.0] * 6)
    for mine, theirs in ((range(7), (0, 1, 2)), (range(7, 12), (3,))):

        def cost(chosen, theirs=theirs):
            return sum(
                float(((features[0, j] - truth[0, i]).abs() * scale).sum() - logit[0, j])
                for i, j in zip(theirs, chosen, strict=True)
            )

        best = min(itertools.permutations(mine, len(theirs)), key=cost)
        got = [int((assignment == i).nonzero()) for i in theirs]
        assert np.isclose(cost(got), cost(best), atol=1e-5)
    assert (assignment >= 0).sum() == 4
    with pytest.raises(ValueError, match="not finite"):
        match_primitives(features * float("nan"), logit, truth, real, slots, proposals)


def test_cell_decoder_proposals_lie_around_their_cell():
    decoder = make_small_lvae(decoder="cells").object_decoder
    features, existence, *_ = decoder(torch.randn(1, 4, 8, 8) * 10)
    assert features.shape == (1, sum(decoder.proposals), 9) and existence.shape == features.shape[:2]
    first = features[0, : decoder.proposals[0]].view(-1, 8, 8, 9)  # proposal, row, column, feature
    middle = 1 - (torch.arange(8) + 0.5) / 8
    assert (first[..., 0] - middle[:, None]).abs().max() <= 1 / 8 + 1e-6
    assert (first[..., 1] - middle[None, :]).abs().max() <= 1 / 8 + 1e-6


def test_object_shortcut_is_equivariant_to_cell_shift():
    encoder = make_small_lvae(shortcut=True).object_encoder
    torch.nn.init.zeros_(encoder.project_out.weight)
    features = torch.full((2, sum(small_spec().slots), 9), 0.3)
    features[1, 0, :2] += torch.tensor(
        [2 / 8, -1 / 8]
    )  # the object moves two cells to the front (lower row) and one cell to the right (higher column)
    real = torch.zeros(features.shape[:2], dtype=torch.bool)
    real[:, 0] = True
    with torch.no_grad():
        here, there = encoder(features, real)[:, :4] - encoder.grid[:4]
    assert here[:, 5, 5].abs().max() > 0.01 and here.count_nonzero() == 4 == there.count_nonzero()
    assert torch.allclose(here[:, 5, 5], there[:, 3, 6], atol=1e-5)


def test_order_in_cell_separates_primitives_of_a_cell():
    """Without the order, the value of a cell is a mean; with it, it is a sum that depends on the order."""
    cell = torch.tensor([[3, 5, 3, 3, 5, 3]])
    real = torch.tensor([[True, True, False, True, True, True]])
    assert count_earlier_in_cell(cell, real).tolist() == [[0, 0, 1, 1, 1, 2]]
    features = torch.full((2, sum(small_spec().slots), 9), 0.3)
    real = torch.zeros(features.shape[:2], dtype=torch.bool)
    real[0, 0] = True
    real[1, :2] = True  # The second scene has a copy of the primitive in the same cell.
    for ordered in (False, True):
        encoder = make_small_lvae(shortcut=True, objects={"order_in_cell": ordered}).object_encoder
        for layer in encoder.layers:  # Without attention, the value of a primitive does not depend on the other one.
            torch.nn.init.zeros_(layer.attention.out.weight)
            torch.nn.init.zeros_(layer.attention.out.bias)
        with torch.no_grad():
            one, two = (encoder(features, real) - encoder.grid)[:, :4, 5, 5]
        if ordered:
            assert (two - one).norm() > 0.1 * one.norm() and not torch.allclose(two, 2 * one, rtol=0.05)
        else:
            assert torch.allclose(one, two, atol=1e-5)


def test_init_from_data_starts_outputs_at_means():
    batch = make_layout_batch([random_scene(i) for i in range(8)], small_spec())
    for decoder in ("detr", "cells"):
        lvae = make_small_lvae(decoder=decoder)
        before = lvae.decode(lvae.encode(batch).mean)
        lvae.init_from_data(batch)
        after = lvae.decode(lvae.encode(batch).mean)
        mean = batch.occupied.mean(dim=(0, 2, 3))
        errors = [(o.occupancy_logit.sigmoid().mean(dim=(0, 2, 3)) - mean).abs().mean() for o in (before, after)]
        assert errors[1] < 0.5 * errors[0]
        expected = batch.real.sum() / len(batch)
        assert float(after.existence_logit.sigmoid().sum() / len(batch)) == pytest.approx(float(expected), rel=0.1)


def test_distance_transform_equals_scipy():
    rng = np.random.default_rng(0)
    inside = np.stack([rng.random((40, 30)) < share for share in (0.02, 0.5, 0.9, 0.0, 1.0)])
    inside[1] = ndimage.binary_opening(inside[1], iterations=1)
    for most in (1, 3, 6):
        found = compute_signed_distance_px(torch.from_numpy(inside), most).numpy()
        for mask, distance in zip(inside, found, strict=True):
            border = np.pad(mask, 50, mode="edge")  # ground outside the crop is unknown
            to = [
                ndimage.distance_transform_edt(side) if not side.all() else np.full(side.shape, 99.0)
                for side in (border, ~border)
            ]
            want = np.where(border, to[0] - 0.5, 0.5 - to[1])[50:-50, 50:-50].clip(-most, most)
            inner = (
                slice(most, -most),
                slice(most, -most),
            )  # exclude the border of the crop, where edge padding creates boundaries
            assert np.allclose(distance[inner], want[inner], atol=1e-5)


def test_linear_init_is_optimal_with_unit_variance_codes():
    batch = make_layout_batch([random_scene(i) for i in range(12)], small_spec())
    lvae = make_small_lvae(shortcut=True, latent_channels=16)
    lvae.init_from_data(batch)
    cell = lvae.ground_encoder.shortcut.stride[0]
    maps = compute_smooth_maps(batch.height, batch.occupied, cell)
    with torch.no_grad():
        code = lvae.ground_encoder.shortcut(maps)
        rebuilt = lvae.ground_decoder.shortcut(code)
    classes, pixels = batch.occupied.shape[1], maps.shape[1] * cell**2
    slope = torch.linalg.lstsq(maps[:, classes:].flatten()[:, None], rebuilt[:, classes:].flatten()[:, None]).solution
    best = min(LOGITS_PER_PX, key=lambda logit: abs(logit * compute_edge_reach_px(cell) - float(slope)))
    assert abs(float(slope) / (best * compute_edge_reach_px(cell)) - 1) < 0.1
    unit = torch.tensor([1.0, best * compute_edge_reach_px(cell)]).repeat_interleave(classes)[:, None, None]
    weight = torch.tensor([HEIGHT_WEIGHT, 1.0]).repeat_interleave(classes)[:, None, None]
    cells = (
        F.pixel_unshuffle(m * weight, cell).permute(0, 2, 3, 1).reshape(-1, pixels) for m in (maps, rebuilt / unit)
    )
    truth, ours = (part.double() for part in cells)
    centred = truth - truth.mean(dim=0)
    least = float((torch.linalg.svdvals(centred)[16:] ** 2).sum())  # minimum error for rank 16 (Eckart-Young)
    within = 0.02 * float(
        (centred**2).sum()
    )  # a tolerance is necessary because the decoder has one bias per map, not per pixel
    assert least <= float(((ours - truth) ** 2).sum()) < least + within
    deviation = code.transpose(0, 1).flatten(1).std(dim=1)
    assert (deviation < 1.01).all() and deviation.max() > 0.99


def test_linear_init_lowers_learning_rate():
    lvae = make_small_lvae(shortcut=True, decoder="cells")
    trainer = Trainer(
        lvae, lambda *_: {}, OptimizerConfig(steps=10, learning_rate=1e-2, weight_decay=0.0), torch.device("cpu")
    )
    share = {id(p): group["share"] for group in trainer.optimiser.param_groups for p in group["params"]}
    assert len(share) == len(list(lvae.parameters()))
    names = {name: share[id(p)] for name, p in lvae.named_parameters()}
    assert {v for n, v in names.items() if n.startswith(("ground_encoder.shortcut", "ground_decoder.shortcut"))} == {
        0.05
    }
    assert {v for n, v in names.items() if n.startswith("ground_") and ".shortcut" not in n} == {0.25}
    assert {v for n, v in names.items() if n.startswith("object_")} == {1.0}
    assert not make_small_lvae().learning_rate_factors()


def test_shortcuts_predict_ground_before_first_step():
    batch = make_layout_batch([random_scene(i) for i in range(12)], small_spec())
    iou = []
    for shortcut in (False, True):
        lvae = make_small_lvae(shortcut=shortcut, latent_channels=16)
        lvae.init_from_data(batch)
        with torch.no_grad():
            seen = lvae.decode(lvae.encode(batch).mean).occupancy_logit > 0
        truth = batch.occupied > 0.5
        iou.append(float((seen & truth).sum() / (seen | truth).sum()))
    assert iou[1] > 0.7 > iou[0] + 0.2


def test_losses_equal_their_equations():
    spec = small_spec(slots=3)
    generator = torch.Generator().manual_seed(1)
    n, b = spec.num_slots, 2
    features, truth = (torch.rand(b, n, 9, generator=generator) for _ in range(2))
    logit = torch.randn(b, n, generator=generator)
    real = torch.cat([torch.arange(3) < c for c in (3, 0, 1, 2, 0, 1, 3, 2, 1, 0, 2)])[None].repeat(b, 1)
    assignment = match_primitives(features, logit, truth, real, spec.slots, spec.slots)
    got = [float(v) for v in compute_object_losses(features, logit, truth, real, assignment, spec, spec.slots)]

    from models.vae.losses import OBJECT_WEIGHTS

    want = np.zeros(3)
    for sample in range(b):
        for c, name in enumerate(spec.categories):
            count = max(int(real[sample, 3 * c : 3 * c + 3].sum()), 1)
            for j in range(3 * c, 3 * c + 3):
                i = int(assignment[sample, j])
                p = float(torch.sigmoid(logit[sample, j]))
                terms = [-np.log(p if i >= 0 else 1 - p), 0, 0]
                if i >= 0:
                    gap = (features[sample, j] - truth[sample, i]).abs()
                    terms[1:] = float(gap[:3].sum()), float(gap[3:].sum())
                want += np.array(OBJECT_WEIGHTS[name]) * terms / count / b
    assert np.allclose(got, want, rtol=1e-4)

    occupied = (torch.rand(2, 5, 8, 8, generator=generator) < 0.5).float()
    occupied[1] = 0  # a sample without ground must not cause a division by zero
    height, true_height = (torch.rand(2, 5, 8, 8, generator=generator) for _ in range(2))
    want = float(((height - true_height).abs()[0] * occupied[0]).sum() / occupied[0].sum()) / 2
    assert np.isclose(float(compute_height_loss(height, true_height, occupied)), want, rtol=1e-5)
    p = torch.sigmoid(height)
    want = float(-(occupied * p.log() + (1 - occupied) * (1 - p).log()).mean())
    assert np.isclose(float(compute_occupancy_loss(height, occupied)), want, rtol=1e-5)
    posterior = Posterior(torch.randn(2, 4, 3, 3, generator=generator), torch.randn(2, 4, 3, 3, generator=generator))
    normal = torch.distributions.Normal
    sigma = (0.5 * posterior.logvar).exp()
    want = torch.distributions.kl_divergence(normal(posterior.mean, sigma), normal(0.0, 1.0)).sum() / 2
    assert np.isclose(float(compute_kl_loss(posterior)), float(want), rtol=1e-5)


@pytest.mark.parametrize(
    "decoder, steps, rate, clip",
    [pytest.param("detr", 400, 3e-3, 0.1, marks=pytest.mark.slow), ("cells", 350, 1e-2, np.inf)],
)
def test_lvae_overfits_one_batch(decoder, steps, rate, clip):
    """Both decoders find all 40 primitives of two scenes within 1 m, and no others. DETR's paper also clips at 0.1."""
    spec = small_spec()
    lvae = make_small_lvae(
        decoder=decoder, width=64, hidden=128, head_hidden=64, latent_channels=8, channels=(16, 32, 32), norm_groups=8
    )
    batch = make_layout_batch([random_scene(i, n=20) for i in range(2)], spec)
    lvae.init_from_data(batch)
    optimiser = torch.optim.AdamW(lvae.parameters(), rate)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: min((step + 1) / 50, 1 - step / steps))
    generator = torch.Generator().manual_seed(0)
    for _ in range(steps):
        noise = torch.randn(2, *lvae.latent_shape, generator=generator)
        output, posterior = lvae(batch, noise)
        optimiser.zero_grad()
        compute_lvae_loss(output, posterior, batch, spec).total.backward()
        torch.nn.utils.clip_grad_norm_(lvae.parameters(), clip)
        optimiser.step()
        schedule.step()
    right = (output.occupancy_logit > 0) == (batch.occupied > 0.5)
    assert right.float().mean() > 0.9
    extent_m = torch.tensor(spec.center_bounds_m.high) - torch.tensor(spec.center_bounds_m.low)
    truths = zip(batch.features.split(spec.slots, 1), batch.real.split(spec.slots, 1), strict=True)
    proposals = zip(
        output.features.split(output.proposals, 1), output.existence_logit.split(output.proposals, 1), strict=True
    )
    errors_m, counts = [], []
    for (truth, real), (features, logit) in zip(truths, proposals, strict=True):
        for k in range(2):
            found_m = features[k][logit[k].sigmoid() > 0.3][:, :3] * extent_m
            true_m = truth[k][real[k]][:, :3] * extent_m
            counts.append((len(found_m), len(true_m)))
            errors_m += (
                torch.cdist(true_m, found_m).min(dim=1).values.tolist() if len(found_m) else [99.0] * len(true_m)
            )
    assert len(errors_m) == 40 and max(errors_m) < 1
    assert all(number == true for number, true in counts)


DETR_OPTIONS = [
    {},
    {"auxiliary_losses": True, "learned_content": True},
    {"queries": "anchors", "position_unit": "cell", "auxiliary_losses": True, "denoising_groups": 2},
    {"queries": "conditional", "denoising_groups": 1},
]


@pytest.mark.parametrize("options", DETR_OPTIONS, ids=["paper", "auxiliary", "anchors", "conditional"])
def test_detr_options_add_losses_in_training_only(options):
    spec = small_spec()
    architecture = override_options(LVAE_PRESETS["smoke"].architecture(), {"objects": options | {"layers": 3}})
    lvae = LayoutVAE(layout=spec.to_dict(), **architecture)
    batch = make_layout_batch([random_scene(0, n=20), random_scene(1, n=0)], spec)
    lvae.init_from_data(batch)
    groups = options.get("denoising_groups", 0)
    query_noise = torch.randn(2, groups, spec.num_slots, 9) if groups else None
    noise = torch.randn(2, *lvae.latent_shape)
    output, posterior = lvae(batch, noise, query_noise=query_noise)
    assert len(output.auxiliary) == (2 if options.get("auxiliary_losses") else 0)
    assert [len(part.features) for part in output.denoised] == [2 * groups] * (3 if groups else 0)
    losses = compute_lvae_loss(output, posterior, batch, spec)
    assert torch.isfinite(losses.total) and (losses.auxiliary > 0) == bool(output.auxiliary or groups)
    losses.total.backward()
    unused = {name for name, p in lvae.object_decoder.named_parameters() if p.grad is None or not p.grad.any()}
    first = (
        "layers.0.self_attention.",
        "layers.0.norm1.weight",
    )  # The values of the paper's first attention are zeros.
    unused = {name for name in unused if not name.startswith("heads.")}  # The batch has not all categories.
    assert all(name.startswith(first) for name in unused) and bool(unused) == (options == {})
    lvae.eval()
    with torch.no_grad():
        again = lvae(batch, noise, query_noise=query_noise)[0]
    assert not again.auxiliary and torch.allclose(again.features, output.features, atol=1e-5)


def test_denoising_queries_know_their_primitive():
    """Queries without noise start at their primitive, so their centres are nearly right before training."""
    options = {"objects": {"queries": "anchors", "denoising_groups": 1}}
    spec = small_spec()
    lvae = LayoutVAE(layout=spec.to_dict(), **override_options(LVAE_PRESETS["smoke"].architecture(), options))
    batch = make_layout_batch([random_scene(i, n=20) for i in range(2)], spec)
    lvae.init_from_data(batch)
    silence = torch.zeros(2, 1, spec.num_slots, 9)
    output, _ = lvae(batch, torch.zeros(2, *lvae.latent_shape), query_noise=silence)
    found, truth = (part[batch.real][:, :3] for part in (output.denoised[-1].features, batch.features))
    assert (found - truth).abs().mean() < 0.1 < (output.features[batch.real][:, :3] - truth).abs().mean()


@pytest.mark.parametrize("is_first", [True, False])
def test_conditional_attention_is_local_at_first(is_first):
    """Before training, a query gets more than half of its values from the cells within 5 cells of its reference."""
    torch.manual_seed(0)
    attention = ConditionalAttention(64, 4, is_first)
    cells = torch.cartesian_prod(torch.arange(32.0), torch.arange(32.0)) + 0.5
    references = torch.rand(20, 2) * 32
    near = torch.cdist(references, cells) < 5
    with torch.no_grad():  # The output of each head is the share of its attention on near cells.
        attention.projections["key"].weight.zero_()
        attention.projections["value"].weight.copy_(torch.eye(64)[:1].expand(64, -1))
        attention.out.weight.copy_(torch.eye(64))
        sines = [embed_positions(points, 32, 64, "cell") for points in (references, cells)]
        memory = torch.zeros(20, 1024, 64)
        memory[..., 0] = near.float()
        share = attention(torch.randn(20, 1, 64), sines[0][:, None], memory, sines[1]).mean(dim=2)
    assert share.mean() > 0.5 > 0.1 > near.float().mean()


def test_transformers_start_from_weights_of_torch_and_detr():
    """DETR applies Xavier's initialisation to all matrices of torch's decoder layers; the encoder is torch's."""
    torch.manual_seed(0)
    width, heads, hidden = 256, 8, 512
    theirs, encoder = nn.TransformerDecoderLayer(width, heads, hidden), nn.TransformerEncoderLayer(width, heads, hidden)
    for parameter in theirs.parameters():
        if parameter.dim() > 1:
            nn.init.xavier_uniform_(parameter)
    ours, our_encoder = DecoderLayer(width, heads, hidden), EncoderLayer(width, heads, hidden)
    pairs = [(our_encoder.attention, our_encoder.mlp, encoder.self_attn, encoder)]
    pairs += [(ours.self_attention, ours.mlp, theirs.self_attn, theirs)]
    pairs += [(ours.cross_attention, ours.mlp, theirs.multihead_attn, theirs)]
    for attention, mlp, their_attention, layer in pairs:
        chunks = (*their_attention.in_proj_weight.chunk(3), their_attention.out_proj.weight)
        projections = (attention.query, attention.key, attention.value, attention.out)
        linear = ((mlp[0].weight, layer.linear1.weight), (mlp[2].weight, layer.linear2.weight))
        weights = [(mine.weight, their) for mine, their in zip(projections, chunks, strict=True)] + list(linear)
        for mine, their in weights:
            assert mine.shape == their.shape
            for measure in (torch.std, lambda weight: weight.abs().max()):
                assert float((measure(mine) / measure(their)).detach()) == pytest.approx(1, abs=0.02)
        assert not any(bool(projection.bias.any()) for projection in projections)


def test_position_embedding_equals_formula_of_detr():
    """Carion et al.: sine and cosine of 2 pi y / h (then x / w), divided by 10000^(2 floor(k / 2) / (d / 2)).

    For the unit "cell", the angles are y and x, divided by powers of 20 as in DAB-DETR.
    """
    size, width = 5, 16
    middle = torch.arange(size) + 0.5
    for unit, scale, ratio in (("map", 2 * np.pi / size, 10_000), ("cell", 1.0, 20)):
        found = embed_positions(torch.cartesian_prod(middle, middle), size, width, unit).numpy()
        for cell in (0, 7, 24):
            want = []
            for position in (cell // size + 1, cell % size + 1):
                for k in range(width // 2):
                    angle = position * scale / ratio ** (2 * (k // 2) / (width // 2))
                    want.append(np.cos(angle) if k % 2 else np.sin(angle))
            assert np.allclose(found[cell], want, atol=1e-5)


def test_loss_units_are_lengths():
    spec, units = small_spec(), {}
    for unit in ("normalised", "metres", "cells"):
        options = override_options(LVAE_PRESETS["smoke"].architecture(), {"objects": {"loss_unit": unit}})
        lvae = LayoutVAE(layout=spec.to_dict(), **options)
        units[unit] = np.array(lvae.feature_unit)
    extent_m = np.subtract(spec.center_bounds_m.high, spec.center_bounds_m.low)
    cell_m = spec.grid.rows * spec.grid.resolution_m / lvae.latent_shape[1]
    assert (units["normalised"] == 1).all()
    assert np.allclose(units["metres"][:3], 1 / extent_m)
    assert np.allclose(units["cells"] / units["metres"], [cell_m] * 3 + [cell_m**0.5] * 6)


@pytest.mark.parametrize(
    "execution",
    [ExecutionConfig(precision="bf16"), ExecutionConfig(accumulate=2), ExecutionConfig(accumulate=4, precision="bf16")],
)
def test_lvae_step_is_equal_in_halves_and_bf16(execution):
    """The test compares the loss for the same weights, and the decrease of the loss after 20 training steps."""
    spec = small_spec()
    layouts = [encode_layout(random_scene(i, n=20), spec) for i in range(4)]
    arrays = {name: torch.from_numpy(np.stack([part[name] for part in layouts])) for name in layouts[0]}
    losses = {}
    for way in (ExecutionConfig(precision="fp32"), execution):
        lvae = make_small_lvae(decoder="cells", shortcut=True)
        lvae.init_from_data(LayoutBatch.from_compact(arrays))
        settings = OptimizerConfig(steps=20, learning_rate=3e-3, weight_decay=0.0)
        trainer = make_lvae_trainer(lvae, settings, 1e-6, torch.device("cpu"), lambda model: model, way)
        losses[way] = [float(trainer.step(arrays, range(4))["loss"]) for _ in range(20)]
        assert all(p.dtype == torch.float32 for p in lvae.parameters())
    plain, other = losses.values()
    assert np.isclose(other[0], plain[0], rtol=1e-2 if execution.precision == "bf16" else 1e-5)
    assert plain[-1] < 0.9 * plain[0] and np.isclose(other[-1], plain[-1], rtol=0.1)


@pytest.mark.parametrize(("decoder", "shortcut"), [("detr", False), ("cells", True)])
def test_bf16_leaves_coordinates_and_heights_in_float32(decoder, shortcut):
    """Layers that read or output features compute in float32: a bf16 number near 60 m is a multiple of 25 cm."""
    lvae, outer = (
        make_small_lvae(decoder=decoder, shortcut=shortcut),
        r"conv_in|conv_out|project_in|project_out|shortcut",
    )
    outer = re.compile(rf"(^|\.)({outer}|head|features|existence)$")
    layers = {name: layer for name, layer in lvae.named_modules() if outer.search(name)}
    seen = {}
    for name, layer in layers.items():
        layer.register_forward_hook(lambda _, inputs, output, name=name: seen.update({name: (inputs[0], output)}))
    layouts = [encode_layout(random_scene(i, n=20), lvae.spec) for i in range(2)]
    arrays = {name: torch.from_numpy(np.stack([part[name] for part in layouts])) for name in layouts[0]}
    batch, noise = LayoutBatch.from_compact(arrays), torch.randn(2, *lvae.latent_shape)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        output, posterior = lvae(batch, noise)
    assert len(layers) >= 8 and set(seen) == set(layers)
    for name, (given, got) in seen.items():
        assert got.dtype == torch.float32, name
        with torch.no_grad():
            assert torch.equal(got, layers[name](given.float())), name
    assert {output.features.dtype, output.height.dtype, posterior.mean.dtype} == {torch.float32}
    read = seen["object_encoder.project_in"][0][..., :3]  # the centres, in the order of `drop_padding`
    assert torch.equal(read, lvae.object_encoder.drop_padding(batch.features, batch.real)[0][..., :3])


def test_bf16_computes_losses_and_matching_in_float32(monkeypatch):
    seen = []

    def record(truth, features, p):
        seen.append((torch.is_autocast_enabled("cpu"), truth.dtype, features.dtype))
        return cdist(truth, features, p)

    cdist = torch.cdist
    monkeypatch.setattr(torch, "cdist", record)
    layouts = [encode_layout(random_scene(i, n=20), small_spec()) for i in range(2)]
    arrays = {name: torch.from_numpy(np.stack([part[name] for part in layouts])) for name in layouts[0]}
    settings = OptimizerConfig(steps=20, learning_rate=3e-3, weight_decay=0.0)
    way = ExecutionConfig(precision="bf16")
    trainer = make_lvae_trainer(make_small_lvae(), settings, 1e-6, torch.device("cpu"), lambda model: model, way)
    trainer.step(arrays, range(2))
    assert seen and set(seen) == {(False, torch.float32, torch.float32)}


def test_latent_noise_is_per_sample_with_stated_scale():
    generators = [torch.Generator().manual_seed(k) for k in range(400)]
    drawn = sample_corruption(generators, (4, 8, 8), 0.2, torch.device("cpu"))
    alone = sample_corruption([torch.Generator().manual_seed(7)], (4, 8, 8), 0.2, torch.device("cpu"))
    assert torch.equal(drawn[7], alone[0])
    sizes = drawn.std(dim=(1, 2, 3))
    assert (
        np.isclose(float(sizes.pow(2).mean() ** 0.5), 0.2, rtol=0.1) and float(sizes.min()) < 0.02
    )  # sizes have the distribution |N(0, 0.2)|
    lvae, spec = make_small_lvae(decoder="cells", shortcut=True), small_spec()
    batch = make_layout_batch([random_scene(i, n=20) for i in range(2)], spec)
    noise = torch.zeros(2, *lvae.latent_shape)
    with torch.no_grad():
        plain, posterior = lvae(batch, noise)
        for size in (0.0, 0.5):
            noisy, _ = lvae(batch, noise, torch.full_like(noise, size))
            moved = posterior.mean + size * posterior.mean.std(dim=(2, 3), keepdim=True)
            assert torch.allclose(noisy.height, lvae.decode(moved).height, atol=1e-5)
            assert torch.equal(noisy.height, plain.height) == (size == 0)


def test_lvae_retrains_more_proposals_on_same_latents():
    old, new = (
        make_small_lvae(shortcut=True, objects={"decoder": "cells", "min_proposals_per_cell": least})
        for least in (1, 3)
    )
    batch = make_layout_batch([random_scene(i, n=20) for i in range(2)], small_spec())
    new.freeze_all_but_object_decoder(old.state_dict())
    with torch.no_grad():
        latents = [lvae.encode(batch).mean for lvae in (old, new)]
        assert torch.equal(*latents)
        before, after = (lvae.decode(latents[0]) for lvae in (old, new))
    assert torch.equal(before.height, after.height) and before.features.shape != after.features.shape
    trained = {name for name, parameter in new.named_parameters() if parameter.requires_grad}
    assert trained and all(name.startswith("object_decoder.") for name in trained)


def test_dit_is_conditioned_and_starts_at_zero():
    torch.manual_seed(0)
    dit = DiT(channels=4, size=8, width=32, depth=2, heads=2)
    latent, time, label = torch.randn(3, 4, 8, 8), torch.tensor([0, 500, 999]), torch.tensor([0, 1, 3])
    assert dit(latent, time, label).shape == latent.shape
    assert (dit(latent, time, label) == 0).all()  # adaLN-Zero and the output layer start at 0
    for parameter in dit.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    base = dit(latent, time, label)
    assert not torch.allclose(base, dit(latent, time, torch.tensor([1, 2, 0])))
    assert not torch.allclose(base, dit(latent, time.flip(0), label))
    with pytest.raises(ValueError, match="patch 2 must divide size 9"):
        DiT(size=9)
    prepared = dit.precompute_conditioning([999, 500, 0, 4], [3, 1, 0, 1])
    assert torch.allclose(prepared(latent, time, label), base, atol=1e-4)
    for other in ((torch.tensor([0, 5, 999]), label), (time, torch.tensor([0, 2, 3])), (time + 1, label)):
        with pytest.raises(IndexError):
            prepared(latent, *other)


def test_perturbed_block_attends_like_pag_of_diffusers():
    block, x = DiTBlock(32, 2), torch.randn(3, 7, 32)
    theirs = Attention(32, heads=2, dim_head=16, bias=True, processor=PAGIdentitySelfAttnProcessor2_0())
    with torch.no_grad():
        for layer, rows in zip((theirs.to_q, theirs.to_k, theirs.to_v), block.qkv.weight.chunk(3), strict=True):
            layer.weight.copy_(rows)
        for layer, rows in zip((theirs.to_q, theirs.to_k, theirs.to_v), block.qkv.bias.chunk(3), strict=True):
            layer.bias.copy_(rows)
        theirs.to_out[0].load_state_dict(block.out.state_dict())
        block.mlp_out.weight.zero_()  # Only the attention remains: no shift and scale, all gates 1.
        block.mlp_out.bias.zero_()
    modulation = torch.tensor([0.0, 0, 1, 0, 0, 1]).repeat_interleave(32).repeat(3, 1)
    y = torch.nn.functional.layer_norm(x, (32,), eps=1e-6)
    plain, perturbed = theirs(torch.cat([y, y])).chunk(2)
    assert torch.allclose(block(x, modulation) - x, plain, atol=1e-5)
    assert torch.allclose(block(x, modulation, perturb=True) - x, perturbed, atol=1e-5)
    assert not torch.allclose(plain, perturbed, atol=1e-2)


def test_pag_moves_noise_away_from_perturbed_network():
    torch.manual_seed(0)
    dit = DiT(channels=4, size=8, width=32, depth=4, heads=2, prediction="v_prediction")
    for parameter in dit.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    latent, time, label = torch.randn(3, 4, 8, 8), torch.tensor([0, 500, 999]), torch.tensor([0, 1, 3])
    plain = dit(latent, time, label)

    def predict(pag_scale):
        return dit.precompute_conditioning(time.tolist(), label.tolist(), pag_scale)(latent, time, label)

    guided = {scale: predict(scale) for scale in (0.0, 1.0, 3.0)}
    two = dit.precompute_conditioning(time.tolist(), label.tolist(), 2.0, pag_drops_label=True)(latent, time, label)
    assert torch.allclose(guided[0.0], plain, atol=1e-5)
    middle = dit.blocks[2]
    original, middle.forward = middle.forward, partial(middle.forward, perturb=True)
    perturbed = dit(latent, time, label)
    null = dit.modulations(time, torch.full_like(label, dit.null_label))
    mixed = [*dit.modulations(time, label)[:2], *null[2:]]  # The null label from the perturbed block on.
    unlabelled = dit.apply_modulations(latent, mixed)
    middle.forward = original
    assert (perturbed - plain).abs().max() > 1e-3
    for scale in (1.0, 3.0):
        assert torch.allclose(guided[scale], plain + scale * (plain - perturbed), atol=1e-5)
    assert torch.allclose(two, plain + 2 * (plain - unlabelled), atol=1e-5)
    assert (unlabelled - perturbed).abs().max() > 1e-3


def test_dit_unpatchify_inverts_patchify():
    """The patch embedding, followed by its transpose, returns the normalised input."""
    dit = DiT(channels=3, size=8, width=12, depth=1, heads=1)
    with torch.no_grad():
        dit.patch_in.weight.copy_(torch.eye(12).view(12, 3, 2, 2))
        dit.positions.zero_()
        dit.patch_out.weight.copy_(torch.eye(12).view(12, 3, 2, 2).permute(2, 3, 1, 0).reshape(12, 12))
        dit.patch_out.bias.zero_()
    latent = torch.randn(1, 3, 8, 8)
    out = dit(latent, torch.tensor([1]), torch.tensor([0]))
    tokens = torch.nn.functional.unfold(latent, 2, stride=2)  # (1, c p p, n)
    normal = torch.nn.functional.layer_norm(tokens.transpose(1, 2), (12,), eps=1e-6).transpose(1, 2)
    assert torch.allclose(out, torch.nn.functional.fold(normal, (8, 8), 2, stride=2), atol=1e-5)


def test_rounded_weights_need_half_the_space(tmp_path):
    plain, rounded = make_small_lvae(), make_small_lvae()
    rounded.round_to_float16()
    for name, model in (("plain", plain), ("rounded", rounded)):
        model.save_pretrained(tmp_path / name)
    files = [tmp_path / name / "diffusion_pytorch_model.safetensors" for name in ("plain", "rounded")]
    types = [{part.dtype for part in load_file(file).values()} for file in files]
    assert types == [{torch.float32}, {torch.float16}]
    loaded = LayoutVAE.from_pretrained(tmp_path / "rounded").state_dict()
    for name, value in rounded.state_dict().items():
        assert value.dtype == torch.float32 and torch.equal(loaded[name], value)
        assert torch.allclose(value, plain.state_dict()[name], rtol=1e-3, atol=1e-6)
    next(rounded.parameters()).data.flatten()[0] = 1e5
    with pytest.raises(ValueError, match=r"contains a weight of 100000; float16 ends at 65504"):
        rounded.round_to_float16()
