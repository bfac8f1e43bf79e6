"""Tests of attachments: signs move to their most plausible supporter, and poles stand on the ground."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import random_scene, scenes_equal, small_spec, tiny_pipeline

from models.composition.attachments import (
    GOAL_M,
    POLE,
    RANGE_M,
    SIGN,
    STEP_M,
    AttachmentReport,
    resolve_attachments,
)
from models.composition.generator import SceneGenerator
from models.layout import SLAB_OFFSET_M, LayoutSpec
from models.pipeline import PrITTIPipeline
from models.scene import CATEGORY_INDEX, Grid, Scene
from pipelines.metrics.relations import UNSUPPORTED, fuse_ground, measure_objects

GRID = Grid(resolution_m=0.5, rows=128, cols=128)
POLE_SIZE, SIGN_SIZE = (0.2, 0.2, 4.0), (0.6, 0.6, 0.6)


def build_scene(*objects, slope: float = 0.0, ground=None) -> Scene:
    """Return a scene on terrain of height slope * x; an object is (category, centre, size, existence)."""
    height = np.broadcast_to(SLAB_OFFSET_M + slope * GRID.x_m()[:, None], (GRID.rows, GRID.cols))
    occupied = np.ones_like(height, bool) if ground is None else ground
    count = len(objects)
    return Scene(
        scene_id="a",
        source="a",
        sequence="a",
        frame=0,
        split="test",
        category=np.array([one[0] for one in objects], np.int8).reshape(count),
        center_m=np.array([one[1] for one in objects], np.float32).reshape(count, 3),
        rotation=np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)),
        size_m=np.array([one[2] for one in objects], np.float32).reshape(count, 3),
        existence=np.array([one[3] for one in objects], np.float32).reshape(count),
        ground_classes=("terrain",),
        height_m=np.where(occupied, height, 0).astype(np.float32)[None],
        occupied=occupied[None],
        grid=GRID,
    )


def pole(x_m, y_m, bottom_m=0.0, existence=0.9):
    return POLE, (x_m, y_m, bottom_m + 2), POLE_SIZE, existence


def sign(x_m, y_m, z_m=3.0):
    return SIGN, (x_m, y_m, z_m), SIGN_SIZE, 0.9


def find_supports(scene: Scene) -> np.ndarray:
    return measure_objects(scene, SLAB_OFFSET_M, *fuse_ground(scene)).support


NOTHING = build_scene()


def test_sign_moves_no_farther_than_contact_with_pole():
    """The gap between the boxes is 0.6 m, so the sign moves until the gap is GOAL_M."""
    scene, report = build_scene(pole(20, 0), sign(20, 1.0)), AttachmentReport()
    assert find_supports(scene)[1] == UNSUPPORTED
    after = resolve_attachments(scene, NOTHING, SLAB_OFFSET_M, report)
    assert np.allclose(after.center_m[1], [20, 0.4 + GOAL_M, 3], atol=2e-3)
    assert find_supports(after)[1] != UNSUPPORTED and report == AttachmentReport(moved=1)
    assert np.array_equal(after.center_m[0], scene.center_m[0])
    again = resolve_attachments(after, NOTHING, SLAB_OFFSET_M)
    assert scenes_equal(after, again)


def test_supported_sign_does_not_move():
    scene = build_scene(pole(20, 0), sign(20, 0.6))
    assert scenes_equal(resolve_attachments(scene, NOTHING, SLAB_OFFSET_M), scene)


def test_sign_moves_down_to_low_pole():
    scene = build_scene(pole(20, 0), sign(20, 0.2, 5.5))
    after = resolve_attachments(scene, NOTHING, SLAB_OFFSET_M)
    assert after.center_m[1, 2] < 5 and find_supports(after)[1] != UNSUPPORTED


def test_scene_without_any_pole_keeps_and_counts_signs():
    scene, report = build_scene(sign(20, 0), sign(30, 0)), AttachmentReport()
    assert scenes_equal(resolve_attachments(scene, NOTHING, SLAB_OFFSET_M, report), scene)
    assert report == AttachmentReport(unsupported=2)
    far, report = build_scene(pole(20, 0), sign(20, RANGE_M + 1)), AttachmentReport()
    assert scenes_equal(resolve_attachments(far, NOTHING, SLAB_OFFSET_M, report), far) and report.unsupported == 1
    assert len(resolve_attachments(NOTHING, NOTHING, SLAB_OFFSET_M)) == 0


def test_sign_is_assigned_to_nearest_supporter_and_ties_to_first():
    scene = build_scene(pole(20, 0), pole(20, 2.5), sign(20, 1.5))
    assert resolve_attachments(scene, NOTHING, SLAB_OFFSET_M).center_m[2, 1] > 1.5
    tie = build_scene(pole(20, 0), pole(20, 2), sign(20, 1))
    assert resolve_attachments(tie, NOTHING, SLAB_OFFSET_M).center_m[2, 1] < 1
    less = build_scene(pole(20, 0, existence=0.5), pole(20, 2), sign(20, 1))
    assert resolve_attachments(less, NOTHING, SLAB_OFFSET_M).center_m[2, 1] > 1


def test_sign_is_attached_to_wall():
    wall = CATEGORY_INDEX["construction_small"], (20, 0, 1.5), (10, 0.3, 3), 0.9
    after = resolve_attachments(build_scene(wall, sign(22, 1.2, 2)), NOTHING, SLAB_OFFSET_M)
    assert after.center_m[1] == pytest.approx([22, 0.45 + GOAL_M, 2], abs=2e-3)  # Straight towards the wall.


def test_sign_adds_improbable_pole():
    kept = build_scene(sign(20, 0.8), pole(50, 0))
    spare = build_scene(pole(20, 0, existence=0.2), pole(21, 0, existence=0.1), pole(40, 0, existence=0.4))
    report = AttachmentReport()
    after = resolve_attachments(kept, spare, SLAB_OFFSET_M, report)
    assert after.category.tolist() == [SIGN, POLE, POLE] and after.center_m[2, 0] == 20
    assert report == AttachmentReport(moved=1, added=1) and find_supports(after)[0] != UNSUPPORTED


def test_floating_pole_is_lowered_to_ground_on_slope():
    """On a slope of 10 %, the ground under the pole at x = 20.25 is 2.025 m high."""
    scene, report = build_scene(pole(20.25, 0.25, bottom_m=3.0), slope=0.1), AttachmentReport()
    after = resolve_attachments(scene, NOTHING, SLAB_OFFSET_M, report)
    assert after.bottom_m[0] == pytest.approx(2.025, abs=1e-4) and report.lowered == 1
    sunk = build_scene(pole(20.25, 0.25, bottom_m=1.5), slope=0.1)
    assert scenes_equal(resolve_attachments(sunk, NOTHING, SLAB_OFFSET_M), sunk)  # Poles only move down.
    attached = build_scene(
        pole(20.25, 0.25, bottom_m=1.0), (CATEGORY_INDEX["construction_big"], (24, 0, 3), (7, 8, 6), 0.9)
    )
    assert scenes_equal(resolve_attachments(attached, NOTHING, SLAB_OFFSET_M), attached)  # It hangs on the building.


def test_spare_poles_do_not_support_floating_pole():
    scene, spare = build_scene(pole(20, 0, bottom_m=1.0), sign(23, 0)), build_scene(pole(20, 0.3, existence=0.1))
    after = resolve_attachments(scene, spare, SLAB_OFFSET_M)
    assert after.bottom_m[0] == pytest.approx(0, abs=1e-4) and len(after) == 2


def test_pole_without_ground_moves_to_nearest_ground():
    ground = np.broadcast_to(GRID.y_m() < 0, (GRID.rows, GRID.cols))
    scene = build_scene(pole(20.25, 1.25, bottom_m=1.0), pole(40.25, STEP_M + 3), ground=ground)
    after = resolve_attachments(scene, NOTHING, SLAB_OFFSET_M)
    assert after.center_m[0] == pytest.approx([20.25, -0.25, 2], abs=1e-4)
    assert np.array_equal(after.center_m[1], scene.center_m[1])


def test_sign_follows_lowered_pole():
    scene = build_scene(pole(20, 0, bottom_m=1.0), sign(20, 0.4, 5.2))
    after = resolve_attachments(scene, NOTHING, SLAB_OFFSET_M)
    assert after.bottom_m[0] == pytest.approx(0, abs=1e-4) and find_supports(after)[1] != UNSUPPORTED


def test_attachments_reduce_unsupported_signs_of_random_scenes():
    for seed in range(5):
        scene = random_scene(seed, 60)
        counts = scene.counts()
        before = find_supports(scene)[scene.category == SIGN]
        after = resolve_attachments(scene, scene.select([]), SLAB_OFFSET_M)
        now = find_supports(after)[after.category == SIGN]
        assert np.array_equal(after.counts(), counts)
        assert (now == UNSUPPORTED).sum() <= (before == UNSUPPORTED).sum()
        others = ~np.isin(scene.category, (SIGN, POLE))
        assert np.array_equal(after.center_m[others], scene.center_m[others])


def test_slab_offset_depends_on_surface():
    assert LayoutSpec(surface="top").slab_offset_m == SLAB_OFFSET_M
    assert replace(LayoutSpec(), surface="surface").slab_offset_m == 0


def test_pipeline_attaches_by_default():
    assert isinstance(tiny_pipeline(small_spec()), SceneGenerator)
    pipeline = PrITTIPipeline.from_pretrained("town")
    pipeline.set_progress_bar_config(disable=True)
    pipeline.use_sampler("dpm++")
    labels = ["low-low", "medium-medium", "high-low", "low-high"]
    latents = pipeline.sample_latents(labels, 2, range(4), 10)
    identities = [pipeline.new_identity("run", 0, k, label) for k, label in enumerate(labels)]
    plain = pipeline.decode(latents, identities, attach=False)
    assert pipeline.attachments == AttachmentReport()
    attached = pipeline.decode(latents, identities)
    report, threshold = pipeline.attachments, pipeline.config.existence_threshold
    for before, after in zip(plain, attached, strict=True):
        added = after.select(np.arange(len(after)) >= len(before))
        assert (added.category == POLE).all() and (added.existence <= threshold).all()
        assert np.array_equal(after.category[: len(before)], before.category)
    assert sum(map(len, attached)) - sum(map(len, plain)) == report.added
    hanging = [
        sum((find_supports(one)[np.isin(one.category, (SIGN, POLE))] == UNSUPPORTED).sum() for one in scenes)
        for scenes in (plain, attached)
    ]
    assert report.lowered > 0 and report.moved > 0 and hanging[1] < 0.5 * hanging[0]
    pipeline.register_to_config(attach=False)  # As pipelines of the paper's presets.
    for before, after in zip(plain, pipeline.decode(latents, identities), strict=True):
        assert scenes_equal(before, after)
