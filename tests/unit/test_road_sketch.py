"""Tests of sketched roads: geometry, given ground, and the known part of blocks."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from helpers import random_scene, small_spec, tiny_pipeline
from PIL import Image
from scipy.ndimage import distance_transform_edt

from jobs.implementation.outpaint_scenes import read_road_sketch
from models.composition.block_grid import BlockGrid
from models.composition.outpaint import BlockComposer, SceneBlock, check_roads
from models.composition.road_sketch import (
    RoadMap,
    SketchedRoad,
    add_sketched_ground,
    check_sketch,
    draw_roads,
    keep_streets,
)
from models.layout import LayoutSpec
from models.pipeline import PrITTIPipeline
from models.scene import KITTI_GROUND_CLASSES, Grid
from models.tensors import make_empty_scene

FINE = Grid(rows=256, cols=256, resolution_m=0.25)
SMALL = Grid(rows=32, cols=32, resolution_m=2.0)
ROAD, SIDEWALK = (KITTI_GROUND_CLASSES.index(name) for name in ("road", "sidewalk"))


def make_street(grid: Grid):
    """Return a scene with a road along y = 0 on terrain, without objects."""
    scene = random_scene(0, n=0, grid=grid)
    road = np.abs(grid.y_m())[None, :] < 4
    occupied = np.zeros_like(scene.occupied)
    occupied[ROAD] = road
    occupied[KITTI_GROUND_CLASSES.index("terrain")] = ~road
    return replace(scene, occupied=occupied, height_m=np.where(occupied, 1.5, 0).astype(np.float32))


def test_drawn_roads_have_the_area_of_their_shape():
    bend = SketchedRoad(((-20.0, 0.0), (32.0, 0.0), (32.0, 80.0)), width_m=8.0, sidewalk_m=2.0)
    road, sidewalk = draw_roads([bend], FINE)
    pixel_m2 = FINE.resolution_m**2
    # Inside of the grid: 32 m ahead and 32 m to the left, and a quarter of a disc around the bend.
    assert road.sum() * pixel_m2 == pytest.approx(2 * 32 * 8 - 4 * 4 + np.pi * 16 / 4, rel=0.02)
    assert not (road & sidewalk).any()
    assert sidewalk[FINE.pixel(np.array([16.0]), np.array([5.0]))].all()
    assert not draw_roads([bend], replace(FINE, front_m=-64.0))[0].any()


def test_distance_to_a_centreline_agrees_with_shapely():
    shapely = pytest.importorskip("shapely")
    rng = np.random.default_rng(0)
    points = rng.uniform(-50, 50, (6, 2))
    x, y = rng.uniform(-80, 80, (2, 200))
    truth = shapely.distance(shapely.LineString(points), shapely.points(x, y))
    assert np.allclose(SketchedRoad(tuple(map(tuple, points))).measure_distance(x, y), truth)


def test_wrong_roads_are_refused():
    for points in ([(0.0, 0.0)], [(0.0, 0.0), (float("nan"), 1.0)]):
        with pytest.raises(ValueError, match="expected two or more points"):
            SketchedRoad(tuple(points))
    with pytest.raises(ValueError, match=r"width_m is 0\.5"):
        SketchedRoad(((0.0, 0.0), (9.0, 0.0)), width_m=0.5)


def test_sketch_must_not_contradict_given_ground():
    street = make_street(SMALL)
    check_sketch([SketchedRoad(((40.0, 0.0), (200.0, 0.0)))], street)  # It continues the street.
    check_sketch([SketchedRoad(((-80.0, 50.0), (200.0, 50.0)))], street)  # It does not touch the scene.
    with pytest.raises(ValueError, match=r"road 2 of the sketch runs over terrain of scene test-0000 at \(40"):
        check_sketch([SketchedRoad(((64.0, 0.0), (90.0, 0.0))), SketchedRoad(((40.0, 20.0), (90.0, 20.0)))], street)


def test_map_of_roads_draws_the_roads_it_was_drawn_from():
    road = SketchedRoad(((-100.0, -30.0), (90.0, 40.0), (160.0, 40.0)), width_m=9.0, sidewalk_m=3.0)
    area = Grid(rows=480, cols=320, resolution_m=1.0, front_m=32 + 240.0, left_m=160.0)
    of_road, sidewalk = draw_roads([road], area)
    made = RoadMap.from_classes(of_road + 2 * sidewalk.astype(np.uint8), 1.0, (32.0, 0.0))
    for x_m, y_m in ((0.0, 0.0), (60.0, 30.0), (-96.0, -64.0), (230.0, 140.0), (900.0, 0.0)):
        grid = replace(FINE, front_m=FINE.front_m + x_m, left_m=FINE.left_m + y_m)
        for truth, found in zip(draw_roads([road], grid), draw_roads([made], grid), strict=True):
            away_px = np.maximum(distance_transform_edt(truth), distance_transform_edt(~truth))
            # A pixel of the map is four pixels of the grid long.
            assert away_px[truth != found].max(initial=0) <= 3 and truth.any() == found.any()
    assert draw_roads([made], FINE)[0].any() and not draw_roads([made], replace(FINE, front_m=-900.0))[1].any()
    assert json.loads(json.dumps(asdict(made)))["packed"] == made.packed  # As in the record of a run.
    assert (made.classes == of_road + 2 * sidewalk).all()
    with pytest.raises(ValueError, match=r"pixel_m is 0\.0"):
        RoadMap.from_classes(of_road.astype(np.uint8), 0.0)
    with pytest.raises(ValueError, match="classes 0"):
        RoadMap.from_classes(of_road * np.uint8(3), 1.0)


def test_map_of_roads_must_not_contradict_given_ground():
    street = make_street(FINE)  # Its road has a width of 8 m and lies along y = 0.
    cols = np.arange(400) + np.zeros((400, 1))
    for shift_m, name in ((0, None), (1, None), (20, "terrain")):
        roads = np.abs(199.5 - cols - shift_m) < 4
        made = RoadMap.from_classes(roads.astype(np.uint8), 1.0, (32.0, 0.0))
        if name:
            with pytest.raises(ValueError, match=rf"road 1 of the sketch runs over {name} of scene test-0000"):
                check_sketch([made], street)
        else:
            check_sketch([made], street)


def test_map_of_roads_is_read_from_a_picture(tmp_path):
    picture = np.zeros((300, 200), np.uint8)
    picture[:, 90:110], picture[:, 110:115] = 255, 128
    Image.fromarray(picture).convert("RGB").save(tmp_path / "roads.png")
    (made,) = read_road_sketch(str(tmp_path / "roads.png"), 0.5)
    assert made.pixel_m == 0.5 and made.center_m == (32.0, 0.0)
    road, sidewalk = draw_roads([made], FINE)
    assert road[:, np.abs(FINE.y_m()) < 4.9].all() and not road[:, np.abs(FINE.y_m()) > 5.1].any()
    assert sidewalk[:, np.abs(FINE.y_m() + 6.25) < 1].all()  # Right in the picture is right of the scene.
    Image.fromarray(0 * picture).save(tmp_path / "dark.png")
    (tmp_path / "text.png").write_text("no picture")
    for name, message in (("dark.png", "shows no road"), ("text.png", "cannot identify image")):
        with pytest.raises(ValueError, match=rf"--road-sketch .*{name}: .*{message}"):
            read_road_sketch(str(tmp_path / name), 1.0)


def test_sketched_ground_takes_the_height_of_its_surroundings():
    street = make_street(SMALL)
    road = SketchedRoad(((100.0, -32.0), (100.0, 32.0)))  # It crosses the scene, which is shifted by 64 m.
    made, drawn = add_sketched_ground(street, [road], np.ones((32, 32), bool), (64.0, 0.0), 9.0)
    assert drawn.any() and (made.occupied.sum(axis=0) == 1).all()
    assert np.allclose(made.height_m[made.occupied], 1.5) and not made.height_m[~made.occupied].any()
    assert (made.occupied[SIDEWALK] == (drawn & ~made.occupied[ROAD])).all() and made.occupied[SIDEWALK].any()
    assert not (made.occupied != street.occupied)[:, ~drawn].any()
    bare = make_empty_scene("a", "town", "0", 0, LayoutSpec(grid=SMALL))
    made, drawn = add_sketched_ground(bare, [road], np.ones((32, 32), bool), (64.0, 0.0), 9.0)
    assert (made.occupied.sum(axis=0) == 1).all() and np.allclose(made.height_m[made.occupied], 9.0)


def test_blocks_know_the_ground_of_sketched_roads():
    seen = []

    def encode(scenes):
        seen.extend(scenes)
        return torch.zeros(len(scenes), 4, 8, 8)

    road = SketchedRoad(((40.0, 0.0), (300.0, 0.0)), width_m=20.0)
    composer = BlockComposer(BlockGrid(8, 6, num_blocks=None), LayoutSpec(grid=SMALL), encode, 1.5, [road])
    street = make_street(SMALL)
    blocks = {(0, 0): SceneBlock(street, torch.zeros(4, 8, 8))}
    empty = make_empty_scene("a", "town", "0", 0, LayoutSpec(grid=SMALL))
    condition = composer.condition_block((1, 0), blocks, empty, "reencode")
    ground, objects = condition.mask[0] == 0, condition.mask[-1] == 0
    # The block starts at x = 48 m. Its rear quarter is known; ahead of it, the sketch covers 24 of 64 m in width.
    assert objects[6:].all() and not objects[:6].any()
    assert ground[:6, 3:5].all() and not ground[:6, :2].any() and not ground[:6, 6:].any()
    assert condition.new_pixels[:24].all() and not condition.new_pixels[24:].any() and condition.known_ground == 1
    assert seen[-1].occupied[ROAD][:, 16].all()


def test_roads_need_a_model_that_can_follow_them():
    pipeline = tiny_pipeline(small_spec())
    street, road = make_street(pipeline.spec.grid), SketchedRoad(((64.0, 0.0), (99.0, 0.0)))
    check_roads([], street, "copy", False)
    with pytest.raises(ValueError, match="need the mode reencode, not copy"):
        check_roads([road], street, "copy", True)
    with pytest.raises(ValueError, match="mix ground and objects"):
        check_roads([road], street, "reencode", False)


@pytest.mark.slow
def test_released_model_builds_the_sketched_road():
    pipeline = PrITTIPipeline.from_pretrained("town")
    pipeline.set_progress_bar_config(disable=True)
    (scene,) = pipeline.generate(["medium-medium"], seed=3)
    sketched = SketchedRoad(((66.0, 0.0), (110.0, 20.0), (158.0, 20.0)), width_m=8.0, sidewalk_m=2.0)
    shares = []
    for roads in ([sketched], []):
        whole = pipeline.outpaint(scene, "medium-medium", num_blocks=(2, 0, 0, 0), roads=roads)
        shares.append(float(whole.occupied[ROAD][draw_roads([sketched], whole.grid)[0]].mean()))
    assert shares[0] > 0.95 and shares[1] < 0.7, shares


def test_kept_streets_are_those_of_the_scene():
    scene = random_scene(1, n=5, grid=SMALL)
    kept, paved = keep_streets(scene)
    surface_m, classes = scene.surface()
    assert np.array_equal(paved, np.isin(classes, (ROAD, SIDEWALK))) and paved.any() and len(kept) == 0
    for number in (ROAD, SIDEWALK):
        assert np.array_equal(kept.occupied[number], classes == number)
        assert np.allclose(kept.height_m[number][classes == number], surface_m[classes == number])
    terrain = KITTI_GROUND_CLASSES.index("terrain")
    assert np.array_equal(kept.occupied[terrain], ~paved) and kept.occupied.sum() == paved.size
    nearest = distance_transform_edt(~paved, return_distances=False, return_indices=True)
    assert np.allclose(kept.height_m.sum(axis=0), surface_m[tuple(nearest)])
    bare, nothing = keep_streets(replace(scene, occupied=np.zeros_like(scene.occupied)))
    assert not nothing.any() and not bare.occupied.any()
