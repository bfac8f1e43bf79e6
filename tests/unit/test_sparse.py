"""Tests that compare sparse convolutions with dense convolutions, and structures with a test of every voxel."""

from itertools import product

import pytest
import torch
import torch.nn.functional as F

from models.baselines import sparse
from models.baselines.sparse import Sites, SparseConvolution, SparseDownsample, SparseUpsample

SHAPE = (2, 6, 4, 8)


def make_mask(seed: int = 0, shape: tuple[int, ...] = SHAPE, share: float = 0.4) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed)) < share


def draw_features(sites: Sites, channels: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.randn(len(sites), channels, dtype=torch.float64, generator=generator, requires_grad=True)


def to_channels_first(x: torch.Tensor, sites: Sites) -> torch.Tensor:
    return sites.to_dense(x).permute(0, 4, 1, 2, 3)


@pytest.mark.parametrize("rows", [1, 5, 10_000])
@pytest.mark.parametrize("shape", [SHAPE, (1, 5, 3, 1)])
def test_convolution_equals_dense_values_and_gradients(rows, shape, monkeypatch):
    monkeypatch.setitem(sparse.GATHER_VALUES, "cpu", rows * 27 * 3)
    sites = Sites.from_mask(make_mask(shape=shape))
    layer, x = SparseConvolution(3, 5).double(), draw_features(sites, 3)
    torch.nn.init.normal_(layer.bias)
    kernel = layer.weight.view(3, 3, 3, 3, 5).permute(4, 3, 0, 1, 2)
    dense = F.conv3d(to_channels_first(x, sites), kernel, layer.bias, padding=1)
    expected = dense.permute(0, 2, 3, 4, 1)[sites.mask]
    result = layer(x, sites)
    torch.testing.assert_close(result, expected)
    inputs, weights = (x, layer.weight, layer.bias), torch.randn_like(expected)
    for got, wanted in zip(
        torch.autograd.grad((result * weights).sum(), inputs),
        torch.autograd.grad((expected * weights).sum(), inputs),
        strict=True,
    ):
        torch.testing.assert_close(got, wanted)


def test_convolution_gradient_equals_finite_differences():
    sites = Sites.from_mask(make_mask(shape=(1, 3, 2, 2)))
    layer = SparseConvolution(2, 2).double()
    assert torch.autograd.gradcheck(lambda x: layer(x, sites), draw_features(sites, 2))


def test_downsample_equals_dense_stride_two():
    sites = Sites.from_mask(make_mask())
    coarse = sites.coarsen()
    layer, x = SparseDownsample(3, 5).double(), draw_features(sites, 3)
    kernel = layer.linear.weight.view(5, 2, 2, 2, 3).permute(0, 4, 1, 2, 3)
    dense = F.conv3d(to_channels_first(x, sites), kernel, layer.linear.bias, stride=2)
    expected, result = dense.permute(0, 2, 3, 4, 1)[coarse.mask], layer(x, sites, coarse)
    torch.testing.assert_close(result, expected)
    for got, wanted in zip(
        torch.autograd.grad(result.square().sum(), (x, layer.linear.weight)),
        torch.autograd.grad(expected.square().sum(), (x, layer.linear.weight)),
        strict=True,
    ):
        torch.testing.assert_close(got, wanted)


def test_upsample_equals_dense_transposed_convolution():
    sites = Sites.from_mask(make_mask())
    coarse = sites.coarsen()
    layer, x = SparseUpsample(3, 5).double(), draw_features(coarse, 3)
    torch.nn.init.zeros_(layer.linear.bias)
    kernel = layer.linear.weight.view(2, 2, 2, 5, 3).permute(4, 3, 0, 1, 2)
    dense = F.conv_transpose3d(to_channels_first(x, coarse), kernel, stride=2)
    expected, result = dense.permute(0, 2, 3, 4, 1)[sites.mask], layer(x, coarse, sites)
    torch.testing.assert_close(result, expected)
    (got,), (wanted,) = (torch.autograd.grad(y.square().sum(), x) for y in (result, expected))
    torch.testing.assert_close(got, wanted)


@pytest.mark.parametrize("shape", [SHAPE, (2, 5, 3, 1)])
def test_coarsen_and_find_children_equal_brute_force(shape):
    mask = make_mask(2, shape, 0.1)
    fine = Sites.from_mask(mask)
    coarse = fine.coarsen()
    children = coarse.find_children(fine)
    assert coarse.shape == (shape[0], *(-(-side // 2) for side in shape[1:]))
    for scene, row, col, level in product(*map(range, coarse.shape)):
        position = int(coarse.index[scene, row, col, level])
        within = [(2 * row + i, 2 * col + j, 2 * level + k) for i, j, k in product(range(2), repeat=3)]
        active = [all(map(int.__lt__, at, shape[1:])) and bool(mask[(scene, *at)]) for at in within]
        assert (position < len(coarse)) == any(active)
        if any(active):
            found = [fine.coords[c].tolist() if c < len(fine) else None for c in children[position].tolist()]
            assert found == [[scene, *at] if is_active else None for at, is_active in zip(within, active, strict=True)]


def test_refine_keeps_exactly_the_selected_children():
    coarse = Sites.from_mask(make_mask(3))
    keep = torch.rand(len(coarse), 8) < 0.5
    fine = coarse.refine(keep)
    expected = set()
    for (scene, row, col, level), kept in zip(coarse.coords.tolist(), keep.tolist(), strict=True):
        for (i, j, k), is_kept in zip(product(range(2), repeat=3), kept, strict=True):
            expected |= {(scene, 2 * row + i, 2 * col + j, 2 * level + k)} if is_kept else set()
    assert set(map(tuple, fine.coords.tolist())) == expected and len(fine) == len(expected)
    assert torch.equal(coarse.find_children(fine) < len(fine), keep)
    assert torch.equal(coarse.coords[fine.find_parents(coarse), 1:], fine.coords[:, 1:] // 2)


def test_sites_round_trip_and_keep_scenes_apart():
    mask = make_mask()
    sites = Sites.from_mask(mask)
    assert torch.equal(sites.mask, mask)
    values = torch.arange(1, len(sites) + 1)
    assert torch.equal(sites.to_dense(values, -1)[mask], values) and (sites.to_dense(values, -1)[~mask] == -1).all()
    found = sites.neighbours.long()
    scenes = torch.cat([sites.scene, torch.tensor([-1])])[found]
    assert ((scenes == -1) | (scenes == sites.scene[:, None])).all()
    assert torch.equal(found[:, 13], torch.arange(len(sites)))


def test_layers_accept_grids_without_active_voxels():
    sites = Sites.from_mask(torch.zeros(SHAPE, dtype=torch.bool))
    coarse = sites.coarsen()
    x = torch.zeros(0, 3, requires_grad=True)
    down = SparseDownsample(3, 4)
    convolution, up = SparseConvolution(3, 3), SparseUpsample(4, 3)
    y = up(down(convolution(x, sites), sites, coarse), coarse, coarse.refine(torch.zeros(0, 8, dtype=torch.bool)))
    assert y.shape == (0, 3)
    y.sum().backward()
    assert convolution.weight.grad is not None and not convolution.weight.grad.any()


def test_convolution_in_bfloat16_is_near_float32():
    sites = Sites.from_mask(make_mask())
    layer, x = SparseConvolution(4, 4), draw_features(sites, 4).detach().float().requires_grad_()
    expected = layer(x, sites)
    with torch.autocast("cpu", torch.bfloat16):
        result = layer(x, sites)
    (result.float() - expected).square().mean().backward()
    assert x.grad is not None and layer.weight.grad is not None and layer.weight.grad.dtype == torch.float32
    torch.testing.assert_close(result.float(), expected, rtol=0.05, atol=0.05)


def test_sites_of_too_many_voxels_give_an_error(monkeypatch):
    monkeypatch.setattr(sparse, "MAX_SITES", 100)
    with pytest.raises(ValueError, match="384 voxels, expected at most 100"):
        Sites.from_mask(make_mask())
