"""Tests of the conversion between scenes and layout tensors."""

import numpy as np
import pytest
import torch
from helpers import random_scene, small_spec

from models.geometry.cholesky import compute_scatter_matrix
from models.layout import Bounds, LayoutSpec
from models.scene import CATEGORIES, Grid
from models.tensors import DecodedLayout, decode_layout, encode_layout, make_layout_batch, resample_scene_ground

WIDE = Bounds((-40.0,) * 6, (40.0,) * 6)


def round_trip(scene, spec):
    layout = encode_layout(scene, spec)
    decoded = DecodedLayout(
        layout["occupied"].astype(np.float32),
        (layout["height"] / 65535).astype(np.float32),
        layout["features"],
        layout["real"].astype(np.float32),
        spec.slot_category,
    )
    return decode_layout(decoded, spec, scene)


def test_layout_round_trip_keeps_primitives_and_pixels():
    scene = random_scene(0, n=60)
    spec = LayoutSpec(slots=(20,) * len(CATEGORIES), cholesky_bounds=WIDE)
    back = round_trip(scene, spec)
    assert (back.counts() == scene.counts()).all()
    order = np.lexsort((np.linalg.norm(scene.center_m, axis=1), scene.category))
    assert np.array_equal(back.category, scene.category[order])
    assert np.allclose(back.center_m, scene.center_m[order], atol=1e-4)
    # Compare scatter matrices instead of rotations, because the yaw of a square footprint is ambiguous.
    want = compute_scatter_matrix(scene.rotation[order], scene.size_m[order])
    assert np.allclose(compute_scatter_matrix(back.rotation, back.size_m), want, atol=1e-3)
    assert np.array_equal(back.occupied, scene.occupied)
    assert np.abs(back.height_m - scene.height_m).max() < 16 / 65535
    assert (back.size_m[:, 0] >= back.size_m[:, 1]).all()


def test_layout_round_trips_empty_scene():
    scene = random_scene(0, n=0)
    layout = encode_layout(scene, small_spec(256))
    assert not layout["real"].any()
    assert len(round_trip(scene, small_spec(256))) == 0


def test_layout_keeps_nearest_of_overfull_category():
    scene = random_scene(1, n=100, category=np.full(100, 3, np.int8))
    layout = encode_layout(scene, small_spec(32, slots=7))
    assert layout["real"].sum() == 7 and layout["real"][21:28].all()
    spec = small_spec(32, slots=7)
    centers = spec.center_bounds_m.restore(layout["features"][21:28, :3])
    distance = np.sort(np.linalg.norm(scene.center_m, axis=1))
    assert np.allclose(np.linalg.norm(centers, axis=1), distance[:7], atol=1e-3)


def test_layout_coarse_ground_is_majority():
    scene = random_scene(2)
    height, occupied = resample_scene_ground(scene, scene.ground_classes, Grid(rows=128, cols=128, resolution_m=0.5))
    count = scene.occupied.reshape(5, 128, 2, 128, 2).sum(axis=(2, 4))
    assert np.array_equal(occupied, count >= 2)
    block = scene.height_m[1, :2, :2][scene.occupied[1, :2, :2]]
    if occupied[1, 0, 0]:
        assert np.isclose(height[1, 0, 0], block.mean())
    fine, mask = resample_scene_ground(scene, scene.ground_classes, Grid(rows=512, cols=512, resolution_m=0.125))
    assert np.array_equal(mask[:, ::2, 1::2], scene.occupied) and np.array_equal(fine[:, ::2, ::2], scene.height_m)


def test_layout_missing_ground_class_is_empty():
    spec = LayoutSpec(ground_classes=("road", "crossing"))
    layout = encode_layout(random_scene(3), spec)
    assert layout["occupied"][0].any() and not layout["occupied"][1].any()


def test_layout_batch_is_normalized():
    batch = make_layout_batch([random_scene(i) for i in range(3)], small_spec())
    assert batch.height.shape == (3, 5, 32, 32) and batch.features.shape == (3, 66, 9)
    for value in (batch.height, batch.occupied, batch.features):
        assert value.dtype == torch.float32 and value.min() >= 0 and value.max() <= 1


def test_layout_spec_round_trips_json_and_names_difference():
    spec = small_spec()
    assert LayoutSpec.from_dict(spec.to_dict()) == spec
    other = LayoutSpec.from_dict(spec.to_dict() | {"slots": [7] * len(CATEGORIES)})
    assert other.fingerprint() != spec.fingerprint()
    with pytest.raises(ValueError, match=r"the checkpoint has another LayoutSpec: slots"):
        spec.require(other, "the checkpoint")
    with pytest.raises(ValueError, match="not a LayoutSpec"):
        LayoutSpec.from_dict({"slots": [1]})
    with pytest.raises(ValueError, match="each lower bound must be less"):
        Bounds((1.0,), (1.0,))
