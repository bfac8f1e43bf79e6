"""Tests of the ground decoder with level sets: splines, resolutions, start values and losses."""

import numpy as np
import pytest
import torch
from helpers import random_scene, small_spec
from scipy import ndimage
from scipy.interpolate import BSpline

from models.dit import DiT
from models.lvae import LayoutVAE
from models.pipeline import PrITTIPipeline
from models.presets import LVAE_PRESETS
from models.tensors import make_layout_batch
from models.vae.config import override_options
from models.vae.ground import compute_edge_reach_px
from models.vae.level_sets import make_spline_matrix
from models.vae.losses import compute_distance_loss, compute_lvae_loss


def make_level_set_lvae(**ground) -> LayoutVAE:
    torch.manual_seed(0)
    changes = {
        "ground": {"channels": (8, 16), "pixel_unshuffle": 2, "level_sets": True} | ground,
        "latent_channels": 8,
        "shortcut": True,
    }
    options = override_options(LVAE_PRESETS["smoke"].architecture(), changes)
    return LayoutVAE(layout=small_spec().to_dict(), **options)


def test_spline_matrix_equals_scipy():
    nodes, points = 7, 28
    values = np.random.default_rng(0).random(nodes)
    ours = make_spline_matrix(nodes, points).numpy() @ values
    padded = np.pad(values, 3, mode="edge")  # Repeated end nodes.
    spline = BSpline(np.arange(-5, nodes + 5), padded, 3)
    assert np.allclose(ours, spline((np.arange(points) + 0.5) * nodes / points - 0.5), atol=1e-6)


def test_averaged_splines_keep_slopes_and_remove_alternation():
    mean, plain = (make_spline_matrix(32, 128, average=average).numpy() for average in (True, False))
    inside = slice(12, -12)  # The outermost coefficients are repeated beyond the border.
    node = np.arange(32)
    assert np.allclose((mean @ node)[inside], (plain @ node)[inside], atol=1e-5)
    assert np.abs(plain @ (-1.0) ** node)[inside].max() > 0.3
    assert np.abs(mean @ (-1.0) ** node)[inside].max() < 1e-6


def test_level_sets_have_same_shape_at_any_resolution():
    lvae = make_level_set_lvae()
    batch = make_layout_batch([random_scene(i) for i in range(8)], small_spec())
    lvae.init_from_data(batch)
    latent = lvae.encode(batch).mean
    own, fine = lvae.decode(latent), lvae.decode(latent, raster_px=3 * batch.occupied.shape[-1])
    centre = slice(1, None, 3)  # The centre of every third fine pixel is the centre of a coarse pixel.
    assert torch.allclose(own.occupancy_logit, fine.occupancy_logit[..., centre, centre], atol=1e-4)
    assert torch.allclose(own.height, fine.height[..., centre, centre], atol=1e-5)
    share, finer = ((o.occupancy_logit > 0).float().mean() for o in (own, fine))
    assert 0 < share < 1 and abs(share - finer) < 0.02


def test_only_level_sets_decode_other_resolutions():
    lvae = make_level_set_lvae(level_sets=False)
    with pytest.raises(ValueError, match="raster_px is 99, but this model decodes rasters of 32 pixels"):
        lvae.decode(torch.zeros(1, *lvae.latent_shape), raster_px=99)


def test_level_sets_start_as_signed_distances():
    lvae = make_level_set_lvae()
    batch = make_layout_batch([random_scene(i) for i in range(12)], small_spec())
    lvae.init_from_data(batch)
    output = lvae.decode(lvae.encode(batch).mean)
    truth = batch.measure_distances_px(output.reach_px)
    assert output.reach_px == compute_edge_reach_px(4) == 2
    assert (output.signed_distance - truth / output.reach_px).abs().mean() < 0.25
    seen, occupied = output.occupancy_logit > 0, batch.occupied > 0.5
    assert (seen & occupied).sum() / (seen | occupied).sum() > 0.8
    assert torch.allclose(output.occupancy_logit, output.signed_distance * lvae.ground_decoder.log_slope.exp())


def test_distances_of_batches_equal_scipy():
    batch = make_layout_batch([random_scene(3)], small_spec())
    mask = batch.occupied[0, 0].numpy() > 0.5
    wide = np.pad(mask, 9, mode="edge")
    outside, inside = (ndimage.distance_transform_edt(side)[9:-9, 9:-9] for side in (wide, ~wide))
    truth = np.where(mask, outside - 0.5, 0.5 - inside).clip(-3, 3)
    found = batch.measure_distances_px(3)
    assert found is batch.measure_distances_px(3)
    assert np.allclose(found[0, 0, 3:-3, 3:-3], truth[3:-3, 3:-3], atol=1e-5)


def test_distance_loss_ignores_distances_beyond_reach():
    truth = torch.tensor([[[[1.0, -1.0, 1.0, 0.5, -1.0]]]])
    distance = torch.tensor([[[[7.0, -3.0, 0.5, 0.25, 0.0]]]])
    assert float(compute_distance_loss(distance, truth)) == pytest.approx((0 + 0 + 0.5 + 0.25 + 1) / 5)


def test_level_sets_learn_and_have_gradients():
    lvae = make_level_set_lvae()
    spec = small_spec()
    batch = make_layout_batch([random_scene(i) for i in range(4)], spec)
    lvae.init_from_data(batch)
    optimiser = torch.optim.AdamW([p for n, p in lvae.named_parameters() if n.startswith("ground")], 3e-3)
    losses = []
    for step in range(60):
        output, posterior = lvae(batch, torch.zeros(4, *lvae.latent_shape))
        parts = compute_lvae_loss(output, posterior, batch, spec)
        losses.append(float((parts.occupancy + parts.distance).detach()))
        optimiser.zero_grad()
        (parts.occupancy + parts.distance + parts.height).backward()
        if step == 0:
            assert (lvae.ground_decoder.log_slope.grad != 0).all()
        optimiser.step()
    assert losses[-1] < 0.6 * losses[0]


def test_pipeline_decodes_other_resolutions():
    lvae = make_level_set_lvae()
    lvae.init_from_data(make_layout_batch([random_scene(i) for i in range(8)], small_spec()))
    channels, size, _ = lvae.latent_shape
    pipeline = PrITTIPipeline(lvae, DiT(channels=channels, size=size, width=16, depth=1, heads=2))
    latents, identity = pipeline.encode([random_scene(1)]), [pipeline.new_identity("run", 0, 0, "low")]
    own, fine = pipeline.decode(latents, identity)[0], pipeline.decode(latents, identity, raster_px=128)[0]
    assert fine.grid.rows == 128 and fine.grid.resolution_m == own.grid.resolution_m / 4
    assert own.ground_area_m2().sum() > 500
    assert fine.ground_area_m2() == pytest.approx(own.ground_area_m2(), abs=0.02 * 64**2)
    assert np.array_equal(own.center_m, fine.center_m)
    with pytest.raises(ValueError, match="raster_px"):
        pipeline.decode(latents, identity, raster_px=10**6)


def test_level_sets_survive_saving(tmp_path):
    lvae = make_level_set_lvae().eval()
    lvae.save_pretrained(tmp_path)
    loaded = LayoutVAE.from_pretrained(tmp_path).eval()
    latent = torch.randn(1, *lvae.latent_shape)
    with torch.no_grad():
        assert torch.equal(lvae.decode(latent).occupancy_logit, loaded.decode(latent).occupancy_logit)
