"""Tests of street plans: signed distances, known parts, sections, and outpainting along a plan."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import QUICK, random_scene, scenes_equal, small_spec, tiny_pipeline, tiny_planner
from scipy.ndimage import label

from models.composition.infinite import InfiniteScene
from models.composition.outpaint import uses_street_plan
from models.composition.road_sketch import RoadMap, SketchedRoad, draw_roads
from models.composition.street_distances import (
    REACH_M,
    StreetDistances,
    measure_street_distances,
    read_street_masks,
)
from models.composition.street_plan import StreetPlan, convert_label
from models.pipeline import PrITTIPipeline
from models.sampling.known_regions import NUM_STREET_UNIFORM, STREET_SHARES, make_street_masks
from models.scene import KITTI_GROUND_CLASSES, Grid
from models.street_planner import StreetPlanner, measure_border_distances
from pipelines.preprocess.sources.town.version2.town import make_large_crops
from pipelines.preprocess.street_maps import make_row
from pipelines.training.street_map_reader import NUM_TURNS, turn_map

FEW = {"num_inference_steps": 3}
AREA = Grid(front_m=128.0, left_m=128.0, resolution_m=0.5, rows=512, cols=512)
SMALL = Grid(rows=32, cols=32, resolution_m=2.0)
ROAD, SIDEWALK, TERRAIN = (KITTI_GROUND_CLASSES.index(name) for name in ("road", "sidewalk", "terrain"))


def make_street(grid: Grid = SMALL):
    """Return a scene with a road of 8 m along y = 0, sidewalks of 2 m, and no objects."""
    scene = random_scene(0, n=0, grid=grid)
    distance_m = np.abs(grid.y_m())[None, :] + np.zeros((grid.rows, 1))
    occupied = np.zeros_like(scene.occupied)
    occupied[ROAD], occupied[SIDEWALK], occupied[TERRAIN] = distance_m < 4, (distance_m >= 4) & (distance_m < 6), 0
    return replace(scene, occupied=occupied, height_m=np.where(occupied, 1.5, 0).astype(np.float32))


# ------------------------------------------------------------------------------------------------------- distances


@pytest.mark.parametrize("turn_deg", [0, 17, 45, 80])
def test_coarse_distances_give_the_width_of_streets(turn_deg):
    turn = np.radians(turn_deg)
    ends = np.array([[-400.0, 0.0], [400.0, 0.0]]) @ np.array(
        [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    )
    street = SketchedRoad(tuple(map(tuple, ends + [1.3, 0.7])), width_m=6.0, sidewalk_m=2.0)
    road, sidewalk = draw_roads([street], AREA)
    distance_m = measure_street_distances(road, road | sidewalk, AREA.resolution_m)
    assert distance_m.shape == (2, 64, 64) and np.abs(distance_m).max() == REACH_M
    drawn, paved = StreetDistances(AREA.front_m, AREA.left_m, distance_m).draw(AREA)
    # True distance of the centres of the pixels to the border.
    to_line_m = street.measure_distance(AREA.x_m()[:, None], AREA.y_m()[None, :])
    inner = np.zeros_like(road)
    inner[16:-16, 16:-16] = True  # The road of other pixels ends outside of the area.
    for found, half_m in ((drawn, 3.0), (paved, 5.0)):
        wrong = (found != (to_line_m <= half_m)) & inner
        assert np.abs(to_line_m - half_m)[wrong].max(initial=0.0) < 0.6
        assert found[inner].sum() == pytest.approx((to_line_m <= half_m)[inner].sum(), rel=0.03)


def test_distances_agree_with_shapely():
    shapely = pytest.importorskip("shapely")
    outline = [(-60.0, -40.0), (70.0, -55.0), (80.0, 60.0), (-20.0, 20.0)]
    polygon = shapely.Polygon(outline)
    x, y = np.meshgrid(AREA.x_m(), AREA.y_m(), indexing="ij")
    inside = shapely.contains_xy(polygon, x, y)
    found = measure_street_distances(inside, inside, AREA.resolution_m)[0]
    coarse = Grid(128.0, 128.0, 4.0, 64, 64)
    at = shapely.points(*np.meshgrid(coarse.x_m(), coarse.y_m(), indexing="ij"))
    truth = shapely.distance(polygon.exterior, at) * np.where(shapely.contains(polygon, at), 1, -1)
    assert np.abs(found - truth.clip(-REACH_M, REACH_M)).max() < AREA.resolution_m


def test_areas_without_borders_have_the_largest_distances():
    full = np.ones((64, 64), bool)
    assert (measure_street_distances(full, ~full, 0.5) == np.array([REACH_M, -REACH_M])[:, None, None]).all()
    with pytest.raises(ValueError, match=r"masks of \(60, 64\) pixels of 0.5 m cannot be divided"):
        measure_street_distances(full[:60], full[:60], 0.5)
    with pytest.raises(ValueError, match=r"pixels of 3.0 m cannot be divided"):
        measure_street_distances(full, full, 3.0)


def test_gaps_between_roads_are_closed():
    main, broken = SketchedRoad(((-300.0, 40.0), (300.0, 40.0))), SketchedRoad(((0.0, 44.0), (0.0, -300.0)))
    road, sidewalk = draw_roads([main, broken], AREA)
    for first_m, is_closed in ((-6.0, True), (-24.0, False)):
        gap = (AREA.y_m() < 0) & (AREA.y_m() > first_m)
        masks = road & ~gap, (road | sidewalk) & ~gap
        distance_m = measure_street_distances(*masks, AREA.resolution_m)
        drawn, paved = StreetDistances(AREA.front_m, AREA.left_m, distance_m).draw(AREA)
        assert (label(drawn)[1] == 1) == is_closed and label(masks[0])[1] == 2
        away = np.abs(AREA.y_m() - first_m / 2) > 20
        assert (drawn != road)[:, away].mean() < 0.002 and (paved | ~drawn).all()


def test_map_of_a_town_shows_its_streets():
    scene = next(make_large_crops(7, 1, AREA))
    row = make_row(scene)
    masks = StreetDistances(AREA.front_m, AREA.left_m, row["distance_m"].astype(np.float32)).draw(AREA)
    for found, truth in zip(masks, read_street_masks(scene), strict=True):
        assert (found & truth).sum() > 0.94 * (found | truth).sum()
    assert row["num_vehicle"] == np.isin(scene.category, (2, 3)).sum() > 20
    assert scene.free_pose


# --------------------------------------------------------------------------------------------------------- training


def test_street_masks_are_those_of_planning():
    uniform = torch.rand(4000, NUM_STREET_UNIFORM, generator=torch.Generator().manual_seed(0))
    distance_m = torch.full((4000, 2, 16, 16), -8.0)
    distance_m[:, :, 8] = 2.0  # A road across all columns.
    border_m = torch.zeros(16, 16)
    border_m[6:10, 6:10] = torch.from_numpy(measure_border_distances(4, 4)).float()
    known = make_street_masks(uniform, distance_m, border_m) == 0
    assert (known[:, 0] == known[:, 1]).all()
    count = known[:, 0].flatten(1).sum(1)
    scene = torch.zeros(16, 16, dtype=torch.bool)
    scene[8, 6:10] = True  # Distances of 2 m at 6 m or 2 m from the border; -8 m would depend on the surroundings.
    rows, cols = known[:, 0].all(2).sum(1), known[:, 0].all(1).sum(1)
    halves = (rows + cols > 0) & (count == 16 * (rows + cols))
    corners = (rows > 0) & (cols > 0) & (count == 16 * rows + 16 * cols - rows * cols)
    shares = [
        float(kind.float().mean())
        for kind in (count == 0, (known[:, 0] == scene).all((1, 2)), halves & ~corners, corners)
    ]
    assert shares[1:] == pytest.approx(STREET_SHARES[1:4], abs=0.03)
    assert shares[0] == pytest.approx(STREET_SHARES[0], abs=0.08)  # Some rectangles contain no road.
    of_roads = ~halves & ~corners & (count > 0)
    assert not known[of_roads][:, 0][:, torch.arange(16) != 8].any()
    assert 0.3 < float((count[halves & ~corners] == 128).float().mean()) < 0.7


def test_turned_maps_are_all_symmetries():
    values = np.arange(2 * 9).reshape(2, 3, 3)
    turned = [turn_map(values, turn) for turn in range(NUM_TURNS)]
    assert len({one.tobytes() for one in turned}) == NUM_TURNS
    assert all(np.array_equal(np.sort(one, axis=None), np.sort(values, axis=None)) for one in turned)
    assert np.array_equal(turned[0], values) and np.array_equal(turned[4], values[..., ::-1])


# ------------------------------------------------------------------------------------------------------------- plan


def test_plan_continues_the_given_scene():
    street = make_street()
    plan = StreetPlan(tiny_planner(), street, **FEW)
    assert plan.section_m == 128.0
    road, paved = plan.draw(street.grid)
    inner = slice(8, -8)  # Nearer to the border, gaps to other roads may be closed.
    assert np.array_equal(road[inner, inner], read_street_masks(street)[0][inner, inner])
    assert np.array_equal(paved[inner, inner], read_street_masks(street)[1][inner, inner])
    assert plan.find_contradiction(street) is None


def test_plan_is_independent_of_the_order_of_requests():
    planner, street = tiny_planner(), make_street()
    far, near = Grid(300.0, -100.0, 1.0, 40, 30), Grid(100.0, 60.0, 0.5, 80, 90)
    one, two = (StreetPlan(planner, street, seed=3, **FEW) for _ in range(2))
    first = one.draw(far), one.draw(near)
    second = two.draw(near), two.draw(far)
    assert all(np.array_equal(a, b) for a, b in zip((*first[0], *first[1]), (*second[1], *second[0]), strict=True))
    other = StreetPlan(planner, street, seed=4, **FEW)
    assert not all(np.array_equal(a, b) for a, b in zip(other.draw(far), first[0], strict=True))
    wider = one.draw(replace(near, rows=240, cols=200))
    assert all(np.array_equal(a[:80, :90], b) for a, b in zip(wider, first[1], strict=True))


def test_sections_keep_what_their_predecessors_planned():
    plan = StreetPlan(tiny_planner(), make_street(), **FEW)
    for index in ((0, 0), (1, 0), (0, 1), (1, 1), (2, 1)):
        section = plan.get_section(index)
        assert np.isfinite(section).all() and np.abs(section).max() <= REACH_M
        for other in plan.list_predecessors(index):
            here, there = plan.section_grid.overlap_cells(index, other), plan.section_grid.overlap_cells(other, index)
            assert np.array_equal(section[:, *here], plan.get_section(other)[:, *there])
    assert set(plan.list_predecessors((2, 1))) == {(1, 0), (1, 1), (2, 0)}
    # A process that has only the predecessors of a section generates the same section.
    again = StreetPlan(plan.planner, make_street(), **FEW)
    for other in plan.list_predecessors((2, 1)):
        again.put_section(other, plan.sections[other])
    assert np.array_equal(again.get_section((2, 1)), plan.sections[2, 1]) and len(again.sections) == 4


def test_plan_contains_sketched_roads():
    sketch = SketchedRoad(((70.0, 40.0), (200.0, 40.0)), width_m=8.0)
    plan = StreetPlan(tiny_planner(), make_street(), sketches=[sketch], **FEW)
    grid = Grid(180.0, 60.0, 1.0, 100, 40)
    road, _ = plan.draw(grid)
    assert road[draw_roads([replace(sketch, width_m=6.0)], grid)[0]].mean() > 0.99


def test_plan_asks_for_the_label_of_each_place():
    asked = []

    def label_at(x_m: float, y_m: float) -> str:
        asked.append((x_m, y_m))
        return convert_label("joint", "low-high")

    plan = StreetPlan(tiny_planner(), make_street(), label_at, **FEW)
    plan.get_section((1, 0))
    assert asked == [(32.0, 0.0), (128.0, 0.0)]
    assert convert_label("joint", "low-high") == "low-high-free" == convert_label("partial", "low-high")
    assert convert_label("vegetation", "low") == "low-any-free" and convert_label("none", "any") == "any-any-free"


def test_scenes_that_a_plan_cannot_continue_are_refused():
    street = make_street()
    with pytest.raises(ValueError, match="a street plan continues scenes of at most 128 m whose borders lie"):
        StreetPlan(tiny_planner(), street.translate(1.0, 0.0))
    with pytest.raises(ValueError, match="has no class sidewalk, so it has no street plan"):
        kept = [k for k in range(len(KITTI_GROUND_CLASSES)) if k != SIDEWALK]
        names = tuple(KITTI_GROUND_CLASSES[k] for k in kept)
        parts = {name: getattr(street, name)[kept] for name in ("occupied", "height_m")}
        StreetPlan(tiny_planner(), replace(street, ground_classes=names, **parts))
    with pytest.raises(ValueError, match="5000"):
        StreetPlan(tiny_planner(), street, num_inference_steps=5000)


# --------------------------------------------------------------------------------------------------------- pipeline


@pytest.fixture(scope="module")
def pipeline():
    made = tiny_pipeline(small_spec())
    made.register_modules(street_planner=tiny_planner())
    return made


def test_pipeline_keeps_its_street_planner(pipeline, tmp_path):
    pipeline.save_pretrained(tmp_path)
    again = PrITTIPipeline.from_pretrained(tmp_path)
    assert again.plans_streets and isinstance(again.components["street_planner"], StreetPlanner)
    label_at = lambda x_m, y_m: "low"  # noqa: E731
    grid = Grid(100.0, 60.0, 1.0, 200, 120)
    plans = [one.plan_streets(make_street(), label_at, 5).draw(grid) for one in (pipeline, again)]
    assert all(np.array_equal(a, b) for a, b in zip(*plans, strict=True))
    plain = tiny_pipeline(small_spec())
    assert not plain.plans_streets and "street_planner" not in plain.components
    with pytest.raises(ValueError, match="this pipeline has no street planner; add one with train_street_planner"):
        plain.plan_streets(make_street(), label_at)


def test_far_blocks_follow_the_plan(pipeline):
    street = make_street()
    options = {"seed": 3, "num_blocks": (2, 0, 0, 0), "repaint": QUICK, "overlap": 0.25}
    planned = pipeline.outpaint(street, "low", **options)
    assert not scenes_equal(planned, pipeline.outpaint(street, "low", plan_streets=False, **options))
    infinite = InfiniteScene(pipeline, "low", seed=3, repaint=QUICK, scene=street)
    block = infinite.get_block((2, 0))
    last = planned.crop(replace(street.grid, front_m=planned.grid.front_m)).translate(-96.0, 0.0, -block.datum_m)
    assert np.array_equal(block.scene.occupied, last.occupied) and block.scene.occupied[ROAD].any()
    one_block = options | {"num_blocks": (1, 0, 0, 0)}
    without = pipeline.outpaint(street, "low", plan_streets=False, **one_block)
    assert scenes_equal(pipeline.outpaint(street, "low", **one_block), without)


def test_plan_is_made_where_it_is_possible(pipeline):
    map_of_roads = RoadMap.from_classes(np.ones((8, 8), np.uint8), 1.0)
    assert uses_street_plan(pipeline, (), "reencode", True, None)
    assert not uses_street_plan(pipeline, (), "reencode", False, None)
    assert uses_street_plan(pipeline, (), "reencode", False, True)
    assert not uses_street_plan(pipeline, (), "reencode", True, False)
    for model, roads, mode, fault in (
        (pipeline, (map_of_roads,), "reencode", "the map of the roads already is a plan"),
        (pipeline, (), "paper", "a plan needs the mode reencode, not paper"),
        (tiny_pipeline(small_spec()), (), "reencode", "this model has no street planner"),
    ):
        assert not uses_street_plan(model, roads, mode, True, None)
        with pytest.raises(ValueError, match=f"streets cannot be planned: {fault}"):
            uses_street_plan(model, roads, mode, True, True)
