"""Tests of scenes outside the bounds of a model: heights are not clipped, and the share outside is reported."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import random_scene, small_spec

from models.layout import Bounds, LayoutSpec
from models.lvae import LayoutVAE
from models.pretrained import find_pipeline_path
from models.scene import Scene
from models.tensors import encode_layout, make_layout_batch, resample_scene_ground
from pipelines.evaluation.reconstruction import compute_reconstruction_scores, make_scene_record, make_voxel_grid
from pipelines.metrics.reconstruction import count_outside_bounds
from pipelines.preprocess.sources.kitti360 import list_sequences, read_drive
from pipelines.preprocess.sources.town.generator import generate_town

NARROW = replace(small_spec(64), height_bounds_m=Bounds((-0.5,), (0.5,)))


@pytest.fixture(scope="module")
def town_lvae() -> LayoutVAE:
    return LayoutVAE.from_pretrained(f"{find_pipeline_path('town')}/lvae").requires_grad_(False)


def score(scenes: list[Scene], lvae: LayoutVAE) -> dict:
    """Return the reconstruction scores of scenes."""
    voxels, records = make_voxel_grid(lvae.spec), []
    for scene in scenes:
        latent = lvae.encode(make_layout_batch([scene], lvae.spec)).mean
        layout = lvae.decode(latent).layouts()[0]
        records.append(make_scene_record(scene, layout, latent[0].numpy(), lvae.spec, voxels))
    return compute_reconstruction_scores(records, lvae.spec, voxels)


def compute_clipped_rmse_m(scenes: list[Scene], spec: LayoutSpec) -> float:
    """Return the height RMSE that clipping to the bounds causes without any other error."""
    height_m = np.concatenate([scene.height_m[scene.occupied] for scene in scenes])
    clipped_m = np.clip(height_m, spec.height_bounds_m.low[0], spec.height_bounds_m.high[0])
    return float(np.sqrt(((clipped_m - height_m) ** 2).mean()))


@pytest.mark.parametrize("pixels", [32, 64, 128])
def test_layout_batch_keeps_heights_outside_bounds(pixels):
    scene, spec = random_scene(0), NARROW.with_resolution(pixels)
    batch = make_layout_batch([scene], spec)
    want, occupied = resample_scene_ground(scene, spec.ground_classes, spec.grid)
    got = spec.height_bounds_m.restore(batch.height[0].numpy()[..., None])[..., 0]
    assert np.abs(want[occupied]).max() > 1 and (batch.height.numpy()[0][occupied] > 1).any()
    np.testing.assert_array_equal(batch.occupied[0].numpy() > 0, occupied)
    np.testing.assert_allclose(got[occupied], want[occupied], atol=2 / 65535)
    assert (batch.height[0].numpy()[~occupied] == 0).all()


@pytest.mark.parametrize("pixels", [32, 64, 128])
def test_layout_batch_within_bounds_equals_encoding_for_training(pixels):
    scene, spec = random_scene(1), small_spec(pixels)
    clipped = encode_layout(scene, spec)
    assert clipped["height"].dtype == np.uint16 and count_outside_bounds(scene, spec).ground[1] == 0
    np.testing.assert_array_equal(
        make_layout_batch([scene], spec).height[0].numpy(), clipped["height"].astype(np.float32) / np.float32(65535)
    )


def test_bounds_counts_are_those_of_pixels_and_objects():
    scene = random_scene(2, n=20)
    heights = scene.height_m[scene.occupied]
    spec = replace(NARROW, center_bounds_m=Bounds((0, -32, -100), (64, 32, 100)))
    spec = replace(spec, cholesky_bounds=Bounds((-100,) * 6, (100,) * 6))
    counts = count_outside_bounds(scene, spec)
    assert counts.ground.tolist() == [len(heights), (np.abs(heights) > 0.5).sum()] and counts.ground[1] > 0
    assert counts.objects.tolist() == [20, 0]
    raised, large = scene.center_m.copy(), scene.size_m.copy()
    raised[3, 2], large[[3, 5]] = 101, 1e5
    assert count_outside_bounds(replace(scene, center_m=raised, size_m=large), spec).objects.tolist() == [20, 2]
    both = counts + counts
    assert both.ground.tolist() == (2 * counts.ground).tolist() and both.objects.tolist() == [40, 0]


def test_released_lvae_extrapolates_heights_of_raised_town(town_lvae):
    drive = generate_town(0)
    scenes = [drive.scene(k, "test") for k in (0, len(drive) // 2)]
    raised = [replace(s, height_m=np.where(s.occupied, s.height_m + 3, 0).astype(np.float32)) for s in scenes]
    exact, got = score(scenes, town_lvae), score(raised, town_lvae)
    assert exact["height_rmse_m"] < 0.02 and exact["ground_outside_bounds"] < 0.01
    assert got["ground_outside_bounds"] > 0.8 and compute_clipped_rmse_m(raised, town_lvae.spec) > 0.8
    assert got["height_rmse_m"] < 0.35


def test_released_lvae_extrapolates_heights_of_real_hill(real_data, town_lvae):
    root = real_data / "kitti360"
    drive, _ = read_drive(root, list_sequences(root)[0])
    scenes = [drive.scene(k) for k in range(0, len(drive), 100)]
    got = score(scenes, town_lvae)
    assert got["ground_outside_bounds"] > 0.1 and got["objects_outside_bounds"] < 0.05
    assert got["height_rmse_m"] < 0.5 < 0.7 < compute_clipped_rmse_m(scenes, town_lvae.spec)
