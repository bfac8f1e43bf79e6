"""Tests that extend and inpaint scenes larger than a block, and tests of the studio without Ray."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import small_spec, studio_scene, tiny_pipeline

from models.composition.extend import expand_grid, extend_scene, inpaint_blocks, split_region, tile_side
from models.composition.inpaint import select_polygon
from models.sampling.repaint import RePaintConfig

SPEC = small_spec()


@pytest.mark.parametrize("side", ["ahead", "behind", "left", "right"])
def test_extend_scene_grows_to_side_and_keeps_given_scene(side):
    pipeline, scene, quick = tiny_pipeline(SPEC), studio_scene(1), RePaintConfig(4, 2, 1)
    once = extend_scene(pipeline, scene, side, "low", repaint=quick)
    assert once.grid == expand_grid(scene.grid, side, SPEC.grid.rows // 2)
    twice = extend_scene(pipeline, once, side, "low", seed=1, repaint=quick)
    turned = extend_scene(pipeline, twice, "left" if side in ("ahead", "behind") else "ahead", "low", repaint=quick)
    assert len(list(tile_side(turned.grid, side, SPEC.grid, 16))) == 2
    for larger in (once, twice, turned):
        kept = larger.crop(scene.grid)
        assert np.array_equal(kept.occupied, scene.occupied) and np.array_equal(kept.height_m, scene.height_m)
        assert np.array_equal(larger.center_m[:3], scene.center_m)
    again = extend_scene(pipeline, scene, side, "low", repaint=quick)
    assert np.array_equal(again.center_m, once.center_m) and np.array_equal(again.height_m, once.height_m)
    with pytest.raises(ValueError, match="side 'up', expected one of: ahead"):
        extend_scene(pipeline, scene, "up", "low")
    with pytest.raises(ValueError, match="is smaller than a block"):
        extend_scene(pipeline, scene.crop(replace(SPEC.grid, rows=16)), "ahead", "low")


@pytest.mark.parametrize("contents", ["both", "objects", "ground"])
def test_inpaint_regenerates_only_region_of_large_scene(contents):
    pipeline, quick = tiny_pipeline(SPEC), RePaintConfig(4, 2, 1)
    scene = extend_scene(pipeline, studio_scene(1), "ahead", "low", repaint=quick)
    scene = extend_scene(pipeline, scene, "left", "low", repaint=quick)
    for corners_m, least in (
        ([(70, 20), (80, 20), (80, 30), (70, 30)], 1),
        ([(2, -30), (94, -30), (94, 60), (2, 60)], 4),
    ):
        region = select_polygon(scene.grid, corners_m)
        parts = split_region(pipeline, scene, region)
        count, inside = np.zeros(region.shape, int), np.zeros_like(region)
        for window, part in parts:
            count[scene.grid.intersect(window)[0]] += part
        inside[count > 0] = True
        assert len(parts) >= least and count.max() == 1 and (inside | ~region).all()
        calls = []
        *_, last = inpaint_blocks(
            pipeline, scene, region, "low", contents, indices=(0, 7), repaint=quick,
            callback_on_step_end=lambda _, number, __, kept, calls=calls: calls.append(number) or kept,
        )  # fmt: skip
        new, other = last.canvases
        assert len(calls) == len(parts) * quick.num_evaluations
        changed = (new.height_m != scene.height_m) | (new.occupied != scene.occupied)
        assert not changed[:, ~inside].any() and changed.any() == (contents != "objects")
        assert (new.height_m != other.height_m).any() == (contents != "objects")
        row, col = scene.grid.pixel(*scene.center_m[:, :2].T)
        kept = scene.center_m[~inside[row, col] | (contents == "ground")]
        assert np.array_equal(new.center_m[: len(kept)], kept)
    # If the scene has the size of a block, the result equals the result of the pipeline.
    scene = studio_scene(2)
    region = select_polygon(scene.grid, [(20, -10), (40, -10), (40, 10), (20, 10)])
    *_, last = inpaint_blocks(pipeline, scene, region, "low", contents, repaint=quick)
    one = last.canvases[0]
    assert np.array_equal(
        one.height_m, pipeline.inpaint([scene], [region], ["low"], contents, repaint=quick)[0].height_m
    )
