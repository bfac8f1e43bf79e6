"""Extending and inpainting of scenes larger than a block, and the studio without Ray."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import small_spec, studio_scene, tiny_pipeline

from models.composition.extend import extended, grown, inpainting, region_blocks, windows
from models.composition.inpaint import polygon_region
from models.pipeline import Resampling

SPEC = small_spec()


@pytest.mark.parametrize("side", ["ahead", "behind", "left", "right"])
def test_extend_scene_grows_to_side_and_keeps_given_part(side):
    pipeline, scene, quick = tiny_pipeline(SPEC), studio_scene(1), Resampling(4, 2, 1)
    once = extended(pipeline, scene, side, "low", resampling=quick)
    assert once.grid == grown(scene.grid, side, SPEC.grid.rows // 2)
    twice = extended(pipeline, once, side, "low", seed=1, resampling=quick)
    turned = extended(pipeline, twice, "left" if side in ("ahead", "behind") else "ahead", "low", resampling=quick)
    assert len(list(windows(turned.grid, side, SPEC.grid, 16))) == 2
    for larger in (once, twice, turned):
        kept = larger.cropped(scene.grid)
        assert np.array_equal(kept.occupied, scene.occupied) and np.array_equal(kept.height_m, scene.height_m)
        assert np.array_equal(larger.center_m[:3], scene.center_m)
    again = extended(pipeline, scene, side, "low", resampling=quick)
    assert np.array_equal(again.center_m, once.center_m) and np.array_equal(again.height_m, once.height_m)
    with pytest.raises(ValueError, match="side 'up', expected one of: ahead"):
        extended(pipeline, scene, "up", "low")
    with pytest.raises(ValueError, match="is smaller than a block"):
        extended(pipeline, scene.cropped(replace(SPEC.grid, rows=16)), "ahead", "low")


@pytest.mark.parametrize("contents", ["both", "objects", "ground"])
def test_inpaint_regenerates_only_region_of_large_scene(contents):
    pipeline, quick = tiny_pipeline(SPEC), Resampling(4, 2, 1)
    scene = extended(pipeline, studio_scene(1), "ahead", "low", resampling=quick)
    scene = extended(pipeline, scene, "left", "low", resampling=quick)
    for corners_m, least in (
        ([(70, 20), (80, 20), (80, 30), (70, 30)], 1),
        ([(2, -30), (94, -30), (94, 60), (2, 60)], 4),
    ):
        region = polygon_region(scene.grid, corners_m)
        parts = region_blocks(pipeline, scene, region)
        count, inside = np.zeros(region.shape, int), np.zeros_like(region)
        for window, part in parts:
            count[scene.grid.shared(window)[0]] += part
        inside[count > 0] = True
        assert len(parts) >= least and count.max() == 1 and (inside | ~region).all()
        calls = []
        *_, last = inpainting(
            pipeline, scene, region, "low", contents, indices=(0, 7), resampling=quick,
            callback_on_step_end=lambda _, number, __, kept, calls=calls: calls.append(number) or kept,
        )  # fmt: skip
        new, other = last.canvases
        assert len(calls) == len(parts) * quick.evaluations
        changed = (new.height_m != scene.height_m) | (new.occupied != scene.occupied)
        assert not changed[:, ~inside].any() and changed.any() == (contents != "objects")
        assert (new.height_m != other.height_m).any() == (contents != "objects")
        row, col = scene.grid.pixel(*scene.center_m[:, :2].T)
        kept = scene.center_m[~inside[row, col] | (contents == "ground")]
        assert np.array_equal(new.center_m[: len(kept)], kept)
    # On a scene of the size of a block it equals the inpainting of the pipeline.
    scene = studio_scene(2)
    region = polygon_region(scene.grid, [(20, -10), (40, -10), (40, 10), (20, 10)])
    *_, last = inpainting(pipeline, scene, region, "low", contents, resampling=quick)
    one = last.canvases[0]
    assert np.array_equal(
        one.height_m, pipeline.inpaint([scene], [region], ["low"], contents, resampling=quick)[0].height_m
    )


def test_studio_requires_its_token(studio_files):
    """The same interface without Ray, on any host name."""
    from starlette.testclient import TestClient

    from pipelines.studio.session import Studio, studio_app

    studio = Studio(str(studio_files / "model"), [])
    client = TestClient(studio_app(lambda: studio, "secret", ()), base_url="http://studio.example")
    assert client.get("/").status_code == 401 and client.get("/?token=wrong").status_code == 401
    assert client.get("/?token=secret").status_code == 200
    assert client.get("/api/about").json()["labels"] == [
        "low",
        "medium",
        "high",
    ]  # the cookie holds the token from now on
