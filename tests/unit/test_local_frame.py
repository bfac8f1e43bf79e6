"""Tests of the local frame: directions of streets, heights of the ground, and conversions of primitives."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import random_scene, small_spec
from scipy.spatial.transform import Rotation

from models.dit import DiT
from models.geometry.cholesky import compute_cholesky_parameters
from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.pipeline import PrITTIPipeline
from models.presets import LVAE_PRESETS
from models.sampling.penalties import compute_penalties, find_objects, make_ground, make_objects
from models.scene import Scene, canonicalize_boxes, make_yaw_rotation
from models.tensors import assign_slots, make_layout_batch
from models.vae.config import override_options
from models.vae.local_frame import LocalFrame, find_pooling_factor, rotate_cholesky, sample_field, sum_weighted
from pipelines.training.latents import digest_weights

SPEC = LayoutSpec().with_resolution(256)
MIDDLE_M = 32.0


def make_street(yaw_rad: float, height_m: float = 0.0, slope: float = 0.0) -> Scene:
    """Return a street of 8 m through the middle of a scene, with 30 boxes whose yaw is relative to the street."""
    rng = np.random.default_rng(0)
    grid, cos, sin = SPEC.grid, np.cos(yaw_rad), np.sin(yaw_rad)
    x_m, y_m = grid.x_m()[:, None] - MIDDLE_M, grid.y_m()[None, :]
    along_m, across_m = cos * x_m + sin * y_m, cos * y_m - sin * x_m
    occupied = np.zeros((len(SPEC.ground_classes), grid.rows, grid.cols), bool)
    occupied[SPEC.ground_classes.index("road")] = abs(across_m) < 4
    occupied[SPEC.ground_classes.index("terrain")] = abs(across_m) >= 4
    surface_m = height_m + slope * along_m
    place_m, turn_rad = rng.uniform(-12, 12, (30, 2)), rng.uniform(-1, 1, 30)
    center_m = np.stack([cos * place_m[:, 0] - sin * place_m[:, 1], sin * place_m[:, 0] + cos * place_m[:, 1]], axis=1)
    z_m = height_m + slope * place_m[:, 0] + rng.uniform(0, 3, 30)
    rotation, size_m = canonicalize_boxes(make_yaw_rotation(turn_rad + yaw_rad), rng.uniform(0.5, 4, (30, 3)))
    return replace(
        random_scene(0, n=30, grid=grid),
        center_m=np.column_stack([center_m[:, 0] + MIDDLE_M, center_m[:, 1], z_m]).astype(np.float32),
        rotation=rotation.astype(np.float32),
        size_m=size_m.astype(np.float32),
        category=np.zeros(30, np.int8),
        occupied=occupied,
        height_m=np.where(occupied, surface_m, 0).astype(np.float32),
    )


def find_local_features(scene: Scene) -> torch.Tensor:
    """Return the features (n, 9) of the boxes of a scene in the local frame, in the order of the scene."""
    batch, frame = make_layout_batch([scene], SPEC), LocalFrame(SPEC)
    local = frame.to_local(batch.features, frame.compute_field(batch.height, batch.occupied > 0.5))
    slots, primitives = assign_slots(scene.category, scene.center_m, SPEC)
    found = torch.zeros(30, 9)
    found[primitives] = local[0, slots]
    return found


def test_rotated_cholesky_parameters_equal_numpy():
    rng = np.random.default_rng(0)
    rotation, size_m = Rotation.random(50, random_state=0).as_matrix(), rng.uniform(0.1, 9, (50, 3))
    yaw_rad = rng.uniform(-7, 7, 50)
    turned = Rotation.from_euler("z", yaw_rad[:, None]).as_matrix() @ rotation
    parameters = torch.from_numpy(compute_cholesky_parameters(rotation, size_m))
    expected = compute_cholesky_parameters(turned, size_m)
    assert np.allclose(rotate_cholesky(parameters, torch.from_numpy(yaw_rad)).numpy(), expected, atol=1e-9)


def test_weighted_sum_equals_direct_sum():
    values = np.random.default_rng(0).normal(size=(1, 2, 7, 9))
    row, col = np.indices((7, 9)) * 0.5
    squared = (row[..., None, None] - row) ** 2 + (col[..., None, None] - col) ** 2
    expected = np.einsum("ijkl,bckl->bcij", 1 / (squared + 1) ** 2, values)
    assert np.allclose(sum_weighted(torch.from_numpy(values), 0.5).numpy(), expected)


@pytest.mark.parametrize("yaw_rad", [0.0, 0.3, 0.8, 1.5, 2.4, -0.7])
def test_field_has_direction_and_height_of_street(yaw_rad):
    scene = make_street(yaw_rad, height_m=1.5)
    batch = make_layout_batch([scene], SPEC)
    field = LocalFrame(SPEC).compute_field(batch.height, batch.occupied > 0.5)
    cos, sin, height = sample_field(field, torch.from_numpy(scene.center_m[None, :, :2]), SPEC.grid)[0]
    found = 0.5 * torch.atan2(sin, cos).numpy()
    deviation = (found - yaw_rad + np.pi / 2) % np.pi - np.pi / 2
    assert np.abs(deviation).max() < np.deg2rad(3)
    over_all = 0.5 * torch.atan2(field[0, 1], field[0, 0]).numpy()  # Including the border of the scene.
    deviation = (over_all - yaw_rad + np.pi / 2) % np.pi - np.pi / 2
    assert np.abs(deviation).max() < np.deg2rad(3)
    low, high = SPEC.height_bounds_m.low[0], SPEC.height_bounds_m.high[0]
    assert np.allclose(height.numpy() * (high - low) + low, 1.5, atol=1e-3)


def test_local_features_do_not_depend_on_street():
    """Yaw and height of boxes relative to the street determine their features, not those of the street."""
    reference = find_local_features(make_street(0.0))
    for yaw_rad, height_m, slope in ((0.5, 0.0, 0.0), (2.0, 2.0, 0.0), (-1.2, -1.0, 0.05)):
        found = find_local_features(make_street(yaw_rad, height_m, slope))
        assert torch.allclose(found[:, 3:], reference[:, 3:], atol=0.02), yaw_rad
        assert torch.allclose(found[:, 2], reference[:, 2], atol=0.1 / 24), height_m  # 0.1 m of 24 m
    in_scene = [make_layout_batch([make_street(*options)], SPEC).features[0, :30] for options in ((0.0,), (2.0, 2.0))]
    assert (in_scene[0] - in_scene[1])[:, 2:].abs().max() > 0.05


def test_conversion_to_local_frame_and_back():
    batch, frame = make_layout_batch([random_scene(i, grid=SPEC.grid) for i in range(3)], SPEC), LocalFrame(SPEC)
    field = frame.compute_field(batch.height, batch.occupied > 0.5)
    local = frame.to_local(batch.features, field)
    assert (local - batch.features)[batch.real].abs().max() > 0.1
    kept = batch.real & ((local > 0) & (local < 1)).all(dim=2)  # `to_local` clips the others.
    assert kept.sum() > 0.9 * batch.real.sum()
    assert torch.allclose(frame.to_scene(local, field)[kept], batch.features[kept], atol=1e-5)


def test_local_frame_without_ground_is_scene_frame():
    batch, frame = make_layout_batch([random_scene(0, grid=SPEC.grid)], SPEC), LocalFrame(SPEC)
    field = frame.compute_field(batch.height, torch.zeros_like(batch.occupied, dtype=torch.bool))
    assert torch.allclose(frame.to_local(batch.features, field)[batch.real], batch.features[batch.real], atol=1e-5)


def make_lvae(**changes) -> LayoutVAE:
    torch.manual_seed(0)
    options = override_options(
        LVAE_PRESETS["smoke"].architecture(),
        {"ground": {"channels": (8, 16), "pixel_unshuffle": 2, "level_sets": True}, "latent_channels": 8}
        | {"shortcut": True, "local_frame": True, "objects": {"decoder": "cells"}}
        | changes,
    )
    return LayoutVAE(layout=small_spec().to_dict(), **options)


def test_object_latents_do_not_depend_on_height_of_scene():
    lvae, scene = make_lvae(), random_scene(0)
    raised = replace(
        scene,
        center_m=scene.center_m + np.array([0, 0, 1.5], np.float32),
        height_m=np.where(scene.occupied, scene.height_m + 1.5, 0).astype(np.float32),
    )
    batches = [make_layout_batch([one], small_spec()) for one in (scene, raised)]
    for model, same in ((lvae, True), (make_lvae(local_frame=False), False)):
        low, high = (model.encode(batch).mean for batch in batches)
        assert torch.allclose(low[:, 8:], high[:, 8:], atol=1e-4) == same
        assert not torch.allclose(low[:, :8], high[:, :8], atol=1e-2)


def test_object_latents_of_turned_street_are_equal():
    """Only x and y, but not yaw, differ between a street along x and the same street along y."""
    lvae = make_lvae(objects={"decoder": "cells"})
    frame = LocalFrame(SPEC)
    boxes = []
    for yaw_rad in (0.0, np.pi / 2):
        batch = make_layout_batch([make_street(yaw_rad)], SPEC)
        field = frame.compute_field(batch.height, batch.occupied > 0.5)
        boxes.append(frame.to_local(batch.features, field)[batch.real])
    assert torch.allclose(*(torch.sort(part[:, 3:], dim=0).values for part in boxes), atol=5e-3)
    batch = make_layout_batch([random_scene(0)], small_spec())
    with torch.autocast("cpu", torch.bfloat16):
        latent = lvae.encode(batch).mean
        output = lvae.decode(latent)
    exact = lvae.decode(lvae.encode(batch).mean)
    assert output.features.dtype == torch.float32
    assert ((output.features - exact.features).abs() < 0.1).float().mean() > 0.9  # Random ground has no clear streets.


def test_start_from_data_uses_local_features():
    lvae, batch = make_lvae(), make_layout_batch([random_scene(i, n=60) for i in range(8)], small_spec())
    lvae.init_from_data(batch)
    local = lvae.convert_to_local(batch.features, batch.real, lvae.measure_local_field(batch))
    slots = slice(0, small_spec().slots[0])  # Slots of the first category.
    expected = local[:, slots][batch.real[:, slots]].mean(dim=0)
    decoder = lvae.object_decoder
    assert decoder is not None
    bias = decoder.head.bias.reshape(-1, 10)[0]
    assert torch.allclose(bias[3:].sigmoid(), expected[2:].clamp(0.01, 0.99), atol=1e-5)
    assert not torch.allclose(expected, batch.features[:, slots][batch.real[:, slots]].mean(dim=0), atol=1e-3)


def test_empty_batch_and_odd_rasters():
    frame = LocalFrame(SPEC)
    field = frame.compute_field(torch.zeros(0, 5, 256, 256), torch.zeros(0, 5, 256, 256, dtype=torch.bool))
    assert frame.to_scene(torch.zeros(0, 4, 9), field).shape == (0, 4, 9)
    assert [find_pooling_factor((250, 250), ratio) for ratio in (2.0, 4.0, 0.3)] == [2, 2, 1]


def test_constraints_measure_objects_in_scene_frame():
    lvae = make_lvae()
    channels, size, _ = lvae.latent_shape
    dit = DiT(channels=channels, size=size, width=32, depth=1, heads=2, layout=small_spec().to_dict())
    pipeline = PrITTIPipeline(lvae, dit)
    pipeline.use_constraints(True)
    guidance = pipeline.guidance
    assert guidance is not None
    latent = 2 * torch.randn(2, *lvae.latent_shape, generator=torch.Generator().manual_seed(0))
    output = lvae.decode(latent)
    chosen = find_objects(output.features, output.existence_logit, output.proposals, lvae.spec, True)
    objects = make_objects(output.features, output.existence_logit, output.proposals, lvae.spec, chosen)
    expected = compute_penalties(objects, make_ground(output, lvae.spec), guidance.names)
    measured = guidance.measure_penalties(latent)
    assert measured.keys() == expected.keys() and sum(float(value.sum()) for value in expected.values()) > 0
    for name, value in expected.items():
        assert torch.allclose(measured[name], value, rtol=1e-4), name
    with pytest.raises(ValueError, match="a model with a local frame needs local_field"):
        lvae.decode_objects(lvae.split(latent)[1])


def test_local_frame_changes_digest_of_weights():
    one, other = make_lvae(), make_lvae(local_frame=False)
    other.load_state_dict(one.state_dict())
    assert digest_weights(one) != digest_weights(other)


def test_decoded_objects_do_not_depend_on_resolution():
    lvae = make_lvae()
    latent = torch.randn(2, *lvae.latent_shape)
    own, fine = lvae.decode(latent), lvae.decode(latent, raster_px=96)
    assert torch.equal(own.features, fine.features) and fine.occupancy_logit.shape[2] == 96
    plain = make_lvae(local_frame=False)
    plain.load_state_dict(lvae.state_dict())
    assert torch.equal(plain.decode(latent).features[..., :2], own.features[..., :2])
    assert (plain.decode(latent).features - own.features)[..., 2:].abs().max() > 0.05


def test_training_uses_field_of_true_ground():
    lvae, batch = make_lvae(), make_layout_batch([random_scene(0), random_scene(1)], small_spec())
    output, posterior = lvae(batch, torch.zeros(2, *lvae.latent_shape))
    field = lvae.measure_local_field(batch)
    assert torch.equal(output.features, lvae.decode(posterior.mean, local_field=field).features)
    assert not torch.allclose(output.features, lvae.decode(posterior.mean).features, atol=1e-3)
    assert make_lvae(local_frame=False).measure_local_field(batch) is None


@pytest.mark.parametrize("changes", [{"branches": "objects"}, {"objects": {"decoder": "detr"}}])
def test_local_frame_needs_ground_and_cells(changes):
    with pytest.raises(ValueError, match="local_frame needs both branches and the decoder 'cells'"):
        make_lvae(**changes)


def test_local_frame_needs_road():
    with pytest.raises(ValueError, match=r"local_frame: the ground classes \('terrain',\) contain no road"):
        LocalFrame(replace(SPEC, ground_classes=("terrain",)))
