"""Tests of seam scores on hand-computed cases and on scenes with visible or invisible seams."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import random_scene

from models.sampling.repaint import RePaintConfig
from models.scene import CATEGORY_INDEX, Grid
from pipelines.evaluation.seam_sweep import (
    build_seam_table,
    count_objects_per_ha,
    make_seam_row,
    render_seam_sweep_html,
)
from pipelines.metrics.intervals import Estimate
from pipelines.metrics.seams import (
    MEASURES,
    compute_footprint_ranges,
    estimate_seam_ratios,
    join_unrelated_scenes,
    list_parallel_lines,
    measure_scene_seams,
)

GRID = Grid(64.0, 32.0, 0.25, 256, 256)


def make_random_ground(seed: int, block_px: int = 8):
    """Return a scene with a random ground class per square of pixels and a random height per pixel.

    All lines of such a scene have the same statistics.
    """
    rng = np.random.default_rng(seed)
    scene = random_scene(seed, 0)
    blocks = 256 // block_px
    winner = np.roll(
        rng.integers(0, 5, (blocks, blocks)).repeat(block_px, 0).repeat(block_px, 1), rng.integers(0, 8, 2), (0, 1)
    )
    occupied = np.arange(5)[:, None, None] == winner
    return replace(
        scene, occupied=occupied, height_m=np.where(occupied, rng.normal(0, 0.1, (256, 256)), 0).astype(np.float32)
    )


def replace_objects_by_cars(scene, centers_xy_m, size_m=(4.0, 2.0, 1.5)):
    n = len(centers_xy_m)
    center = np.zeros((n, 3), np.float32)
    center[:, :2] = centers_xy_m
    empty = scene.select(np.zeros(len(scene), bool))
    return replace(
        empty,
        category=np.full(n, CATEGORY_INDEX["vehicle_small"], np.int8),
        center_m=center,
        rotation=np.tile(np.eye(3, dtype=np.float32), (n, 1, 1)),
        size_m=np.tile(np.float32(size_m), (n, 1)),
        existence=np.ones(n, np.float32),
        heading_rad=np.full(n, np.nan, np.float32),
        instance_id=np.full(n, -1),
        label=np.full(n, "car", object),
    )


def compute_ratios(scenes, **lines) -> dict:
    return estimate_seam_ratios(np.stack([measure_scene_seams(scene, **lines) for scene in scenes]))


def test_seam_ratio_of_invisible_seam_is_one():
    got = compute_ratios([make_random_ground(seed, block_px=1) for seed in range(60)], rows=[64, 130], cols=[100])
    for name in ("class_changes", "height_step"):
        assert got[name].low < 1.02 and got[name].high > 0.98
        assert got[name].high - got[name].low < 0.1
    assert got["cut_objects"] is None  # a scene without objects has no score


def test_seam_ratio_shows_change_of_scene():
    scenes = []
    for seed in range(20):
        near, far = make_random_ground(seed), make_random_ground(seed + 100)
        height = near.height_m.copy()
        occupied = near.occupied.copy()
        occupied[:, :128] = far.occupied[:, :128]
        height[:, :128] = np.where(far.occupied[:, :128], far.height_m[:, :128] + 1, 0)  # a height step of 1 m
        scenes.append(replace(near, occupied=occupied, height_m=height.astype(np.float32)))
    got = compute_ratios(scenes, rows=[128])
    assert got["class_changes"].low > 3 and got["height_step"].low > 3
    got = compute_ratios(scenes, rows=[64])
    assert got["class_changes"].low < 1 < got["class_changes"].high


def test_unrelated_halves_have_visible_seam():
    scenes = [make_random_ground(seed) for seed in range(20)]
    joined = [
        join_unrelated_scenes(
            scene, replace(other, height_m=np.where(other.occupied, other.height_m + 1, 0).astype(np.float32)), 128
        )
        for scene, other in zip(scenes, scenes[1:] + scenes[:1], strict=True)
    ]
    got = compute_ratios(joined, rows=[128])
    assert got["class_changes"].low > 3 and got["height_step"].low > 3
    far, near = (replace_objects_by_cars(scenes[0], [(10, 0), (x, 3)]) for x in (50, 51))
    both = join_unrelated_scenes(far, near, 128)
    assert both.center_m[:, 0].tolist() == [50, 10] and np.array_equal(both.occupied[:, :128], far.occupied[:, :128])
    with pytest.raises(ValueError, match="have different grids"):
        join_unrelated_scenes(far, far.crop(Grid(64.0, 32.0, 0.25, 128, 128)), 64)


@pytest.mark.parametrize("axis", [0, 1])
def test_seam_scores_count_cut_and_duplicate_objects(axis):
    def make_position(offset_m, along_m=0.0):
        at = np.array([32.0, 0.0])
        at[axis] += offset_m
        at[1 - axis] += along_m
        return at

    size = (4.0, 2.0) if axis == 0 else (2.0, 4.0)
    lines = {"rows": [128]} if axis == 0 else {"cols": [128]}
    ends = replace_objects_by_cars(
        make_random_ground(0), [make_position(2.0), make_position(-2.1, 3)], (*size, 1.5)
    )  # both cars end within 0.25 m of the line
    assert measure_scene_seams(ends, **lines)[2, 0].tolist() == [2, 2]
    crosses = replace_objects_by_cars(make_random_ground(0), [make_position(0.5)], (*size, 1.5))
    assert measure_scene_seams(crosses, **lines)[2, 0].tolist() == [0, 1]
    twice = replace_objects_by_cars(
        make_random_ground(0), [make_position(0.6), make_position(-0.6), make_position(0.0, 8)], (*size, 1.5)
    )
    assert measure_scene_seams(twice, **lines)[3, 0].tolist() == [2, 3]
    same_side = replace_objects_by_cars(make_random_ground(0), [make_position(0.6), make_position(0.7)], (*size, 1.5))
    assert measure_scene_seams(same_side, **lines)[3, 0].tolist() == [0, 2]


def test_footprint_of_rotated_box_contains_corners():
    scene = random_scene(3, 50)
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    corners = scene.center_m[:, None] + (0.5 * signs[None] * scene.size_m[:, None]) @ scene.rotation.transpose(0, 2, 1)
    ranges = compute_footprint_ranges(scene)
    np.testing.assert_allclose(ranges[:, :, 0], corners.min(axis=1)[:, :2], atol=1e-4)
    np.testing.assert_allclose(ranges[:, :, 1], corners.max(axis=1)[:, :2], atol=1e-4)


def test_reference_lines_avoid_every_seam():
    near = list_parallel_lines([100, 130], 256, 0.25)  # the lines are 7.5 m apart
    assert 115 not in near[100] and 84 in near[100] and 85 not in near[100] and 146 in near[100]
    assert min(abs(line - seam) for line in near[130] for seam in (100, 130)) == 16
    assert near[100].min() == 36


def test_seam_scores_reject_edge_seam_and_skip_empty_scene():
    with pytest.raises(ValueError, match="a seam before pixel 256, but seams must lie before pixels 1 to 255"):
        measure_scene_seams(make_random_ground(0), rows=[256])
    empty = replace(make_random_ground(0), occupied=np.zeros((5, 256, 256), bool))
    assert set(estimate_seam_ratios(measure_scene_seams(empty, rows=[128])[None]).values()) == {None}
    assert len(MEASURES) == 4


def test_seam_sweep_row_has_cost_and_visibility():
    ratios = {name: None for name in MEASURES} | {"height_step": Estimate(1.2, 1.0, 1.5)}
    cars = replace_objects_by_cars(make_random_ground(0), [(10, 0), (20, 3)])
    assert count_objects_per_ha([cars, make_random_ground(1)]) == pytest.approx(2 / 0.8192)  # two scenes of 64 m x 64 m
    row = make_seam_row("paper", RePaintConfig(), 200, 12.3, ratios)
    assert row["evaluations"] == 2410 and row["height_step_high"] == 1.5 and row["cut_objects"] is None
    (cells,) = build_seam_table([row]).rows
    assert cells[:9] == ("paper", 250, 10, 10, 0.0, 1.0, 2410, 12, 200)
    assert cells[10] == "1.20 (1.00 to 1.50)" and cells[11] is None
    assert "2410" in render_seam_sweep_html([row], [], ["how"]).replace(",", "").replace("\u202f", "")
