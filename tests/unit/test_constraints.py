"""Tests of the penalties on decoded layouts, and of the guidance that lowers them during sampling."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import small_spec, tiny_pipeline

from models.geometry.cholesky import compute_cholesky_parameters
from models.layout import LayoutSpec
from models.pipeline import PrITTIPipeline
from models.sampling import penalties
from models.sampling.constraints import ConstraintConfig, ConstraintGuidance, GuidanceReport
from models.sampling.diffusion import InpaintCondition
from models.sampling.penalties import Ground, Objects, compute_penalties, make_objects, select_constraints
from models.sampling.repaint import RePaintConfig
from models.scene import CATEGORIES, CATEGORY_INDEX, make_yaw_rotation

SPEC = LayoutSpec().with_resolution(128)  # Pixels of 0.5 m; slab tops lie 0.3 m above the surface.
FLAT_M = 0.3  # Height of the slab tops in `make_ground`, so the surface has height 0.


def make_ground(**classes: np.ndarray) -> Ground:
    """Return flat ground at height 0, with a mask (rows, cols) per class; the default is terrain everywhere."""
    grid = SPEC.grid
    probability = torch.zeros(1, len(SPEC.ground_classes), grid.rows, grid.cols)
    for name, mask in (classes or {"terrain": np.ones((grid.rows, grid.cols), bool)}).items():
        probability[0, SPEC.ground_classes.index(name)] = torch.from_numpy(mask).float()
    return Ground(probability, torch.full_like(probability, FLAT_M), SPEC)


def make_features(boxes, scenes=1):
    """Return normalised features, existence logits and proposals; a box is (category, centre, size, yaw, existence).

    Each category has as many proposals as boxes, and box k occupies proposal k of its category."""
    count = len(boxes)
    features = torch.full((scenes, len(CATEGORIES) * count, 9), 0.5, dtype=torch.float64)
    logit = torch.full((scenes, len(CATEGORIES) * count), -20.0, dtype=torch.float64)
    for k, (name, center_m, size_m, yaw_rad, existence) in enumerate(boxes):
        slot = CATEGORY_INDEX[name] * count + k
        parameters = compute_cholesky_parameters(make_yaw_rotation(yaw_rad), np.array(size_m))
        features[:, slot, :3] = torch.from_numpy(SPEC.center_bounds_m.normalise(np.array(center_m)))
        bounds = SPEC.cholesky_bounds
        scaled = (parameters - np.array(bounds.low)) / (np.array(bounds.high) - np.array(bounds.low))
        features[:, slot, 3:] = torch.from_numpy(scaled)
        logit[:, slot] = torch.tensor(existence).logit()
    return features.float(), logit.float(), (count,) * len(CATEGORIES)


def build_objects(*boxes) -> Objects:
    features, logit, proposals = make_features(boxes)
    chosen = penalties.find_objects(features, logit, proposals, SPEC)
    return make_objects(features, logit, proposals, SPEC, chosen)


def measure(ground, *boxes) -> dict[str, float]:
    found = compute_penalties(build_objects(*boxes), ground, tuple(penalties.CONSTRAINTS))
    return {name: float(value) for name, value in found.items()}


def require_guidance(pipeline: PrITTIPipeline) -> ConstraintGuidance:
    assert pipeline.guidance is not None
    return pipeline.guidance


def sum_all(found: dict) -> float:
    return float(torch.stack(list(found.values())).sum())


def column_mask(left_m: float, right_m: float) -> np.ndarray:
    """Return the mask of the pixels with y between `right_m` and `left_m`."""
    y_m = SPEC.grid.y_m()
    return np.broadcast_to((y_m > right_m) & (y_m < left_m), (SPEC.grid.rows, SPEC.grid.cols)).copy()


CAR = ("vehicle_small", (20, 0, 0.75), (4, 2, 1.5), 0.0, 0.999999)


# -------------------------------------------------------------------------------------------------------- closed forms


@pytest.mark.parametrize("yaw_rad", [0.0, 0.7])
def test_penetration_is_depth_times_existence(yaw_rad):
    """Two cars of 4 m, 3.5 m apart along their length, overlap by 0.5 m."""
    along = 3.5 * np.array([np.cos(yaw_rad), np.sin(yaw_rad), 0])
    first = ("vehicle_small", (20, 0, 0.75), (4, 2, 1.5), yaw_rad, 0.8)
    second = ("vehicle_small", tuple(np.array([20, 0, 0.75]) + along), (4, 2, 1.5), yaw_rad, 0.5)
    found = measure(make_ground(), first, second)["penetration"]
    assert found == pytest.approx(0.8 * 0.5 * (0.5 - penalties.PENETRATION_TOLERANCE_M), abs=1e-3)
    above = (*second[:1], (23.5, 0, 5.0), *second[2:])  # Above the first car.
    assert measure(make_ground(), first, above)["penetration"] == 0


def test_penetration_ignores_pairs_that_overlap_in_data():
    pole = ("pole", (20, 0, 2), (0.2, 0.2, 4), 0.0, 0.99)
    sign = ("traffic_control", (20, 0, 3), (0.6, 0.6, 0.6), 0.0, 0.99)
    tree = ("vegetation_cuboid", (20, 0, 2), (4, 4, 4), 0.0, 0.99)
    assert measure(make_ground(), pole, sign, tree)["penetration"] == 0
    house = ("construction_big", (20, 0, 2), (4, 4, 4), 0.0, 0.99)
    assert measure(make_ground(), pole, house)["penetration"] > 1


def test_penetration_has_larger_tolerance_for_walls_in_buildings():
    """A wall of 1 x 1 m reaches 0.9 or 1.5 m into a building whose side is at x = 18."""
    house = ("construction_big", (20, 0, 2), (4, 4, 4), 0.0, 0.999999)
    for depth_m, expected_m in ((0.9, 0.0), (1.5, 0.5)):
        wall = ("construction_small", (17 + depth_m, 0, 0.5), (2, 1, 1), 0.0, 0.999999)
        assert measure(make_ground(), house, wall)["penetration"] == pytest.approx(expected_m, abs=1e-3)


def test_footprint_of_building_half_on_road():
    """A square building of 10 m, half of it on the road, has a penalty of 5 m."""
    ground = make_ground(road=column_mask(32, 0), terrain=column_mask(0, -32))
    house = ("construction_big", (30, 0, 3), (10, 10, 6), 0.0, 0.999999)
    assert measure(ground, house)["footprint"] == pytest.approx(5, abs=0.05)
    walk = make_ground(sidewalk=column_mask(32, 0), terrain=column_mask(0, -32))
    allowed_m2 = penalties.SIDEWALK_TOLERANCE_M2["construction_big"]
    assert measure(walk, house)["footprint"] == pytest.approx((50 - allowed_m2) / 10, abs=0.05)
    car = (CAR[0], (30, 0, 0.75), *CAR[2:])
    assert measure(ground, car)["footprint"] == 0  # Cars belong on the road.


@pytest.mark.parametrize(("rise_m", "side"), [(1.0, 1), (-1.0, 0)])
def test_height_penalty_is_distance_from_surface(rise_m, side):
    limit_m = penalties.HEIGHT_TOLERANCE_M["vehicle_small"][side]
    car = (CAR[0], (20, 0, 0.75 + rise_m), *CAR[2:])
    assert measure(make_ground(), car)["height"] == pytest.approx(1 - limit_m, abs=1e-3)
    nowhere = make_ground(terrain=column_mask(32, 20))
    assert measure(nowhere, car)["height"] == 0  # There is no ground under the car.
    on_surface = replace(SPEC, surface="surface")
    ground = replace(make_ground(), spec=on_surface, height_m=torch.zeros_like(make_ground().height_m))
    assert measure(ground, car)["height"] == pytest.approx(1 - limit_m, abs=1e-3)


def test_height_penalty_accepts_sunk_buildings():
    house = ("construction_big", (30, 0, 2), (10, 10, 6), 0.0, 0.99)  # The bottom is 1 m below the surface.
    assert measure(make_ground(), house)["height"] == 0


def test_support_penalty_is_gap_to_pole():
    """A sign whose box is 2 m from the box of the pole must come 1.7 m nearer."""
    pole = ("pole", (20, 0, 2), (0.2, 0.2, 4), 0.0, 0.999999)
    sign = ("traffic_control", (20, 2.4, 3), (0.6, 0.6, 0.6), 0.0, 0.5)
    assert measure(make_ground(), pole, sign)["support"] == pytest.approx(0.5 * 1.7, abs=0.01)
    far = ("traffic_control", (20, 12, 3), (0.6, 0.6, 0.6), 0.0, 0.5)
    assert measure(make_ground(), pole, far)["support"] == 0  # No pole is in range.
    assert measure(make_ground(), sign)["support"] == 0


def test_heading_penalty_of_car_at_30_degrees():
    ground = make_ground(road=column_mask(4, -4))
    expected = penalties.LANE_LENGTH_M * (np.sin(np.pi / 6) ** 2 - np.sin(penalties.LANE_TOLERANCE_RAD) ** 2)
    for yaw_rad in (np.pi / 6, -np.pi / 6, np.pi / 6 + np.pi):
        car = (*CAR[:3], yaw_rad, 0.999999)
        assert measure(ground, car)["heading"] == pytest.approx(expected, rel=0.02)
    next_to_road = (CAR[0], (20, 10, 0.75), CAR[2], np.pi / 6, 0.99)  # Off the road.
    assert measure(ground, next_to_road)["heading"] == 0


def test_alignment_penalty_of_building_at_20_degrees():
    """The edges of the road run along x; a building may be parallel or perpendicular to them."""
    ground = make_ground(road=column_mask(4, -4))
    turned = np.radians(20)
    expected = np.sin(2 * turned) ** 2 - np.sin(2 * penalties.ALIGNMENT_TOLERANCE_RAD) ** 2
    for yaw_rad in (turned, -turned, np.pi / 2 + turned):
        house = ("construction_big", (20, 15, 3), (12, 6, 6), yaw_rad, 0.999999)
        assert measure(ground, house)["alignment"] == pytest.approx(penalties.ALIGNMENT_LENGTH_M * expected, rel=0.02)
        assert measure(make_ground(), house)["alignment"] == 0  # There is no road.
    person = ("human", (20, 15, 1), (0.6, 0.3, 1.8), turned, 0.999999)
    assert measure(ground, person)["alignment"] == 0


def test_alignment_follows_the_nearest_edge():
    """The road runs at 45 degrees to the x axis. A building next to the road is aligned if its yaw is 45 degrees."""
    x_m, y_m = SPEC.grid.x_m()[:, None], SPEC.grid.y_m()[None]
    ground = make_ground(road=np.abs(x_m - 32 - y_m) < 5)
    for yaw_rad, is_aligned in ((np.pi / 4, True), (0.0, False)):
        house = ("construction_big", (45, -5, 3), (12, 6, 6), yaw_rad, 0.999999)
        assert (measure(ground, house)["alignment"] < 0.01) == is_aligned


def test_valid_scene_has_no_penalty():
    ground = make_ground(road=column_mask(4, -4), terrain=column_mask(32, 6))
    boxes = [
        (CAR[0], (20, 2, 0.75), *CAR[2:]),
        (CAR[0], (26, 2, 0.75), *CAR[2:]),
        ("construction_big", (20, 15, 3), (10, 8, 6), 0.1, 0.99),
        ("pole", (30, 7, 2), (0.2, 0.2, 4), 0.0, 0.99),
        ("traffic_control", (30, 7.3, 3), (0.6, 0.6, 0.6), 0.0, 0.99),
    ]
    assert sum(measure(ground, *boxes).values()) < 1e-4


def test_duplicates_are_not_pushed_apart():
    features, logit, proposals = make_features([CAR, (CAR[0], (20.3, 0, 0.75), *CAR[2:4], 0.7)])
    both = penalties.find_objects(features, logit, proposals, SPEC)
    assert len(both[0]) == 2
    kept = penalties.find_objects(features, logit, proposals, SPEC, has_duplicates=True)
    assert kept[1].tolist() == [CATEGORY_INDEX["vehicle_small"] * 2]


# ----------------------------------------------------------------------------------------------------------- gradients


@pytest.mark.parametrize(
    ("name", "boxes", "classes"),
    [
        ("penetration", [CAR, (CAR[0], (22.5, 0.3, 0.75), *CAR[2:])], {}),
        ("footprint", [("construction_big", (30, -4, 3), (10, 10, 6), 0.2, 0.99)], {"road": column_mask(32, 0)}),
        ("height", [(CAR[0], (20, 0, 1.75), *CAR[2:])], {}),
        (
            "support",
            [
                ("pole", (20, 0, 2), (0.2, 0.2, 4), 0.0, 0.99),
                ("traffic_control", (20, 2.4, 3), (0.6, 0.6, 0.6), 0.0, 0.99),
            ],
            {},
        ),
        ("heading", [(CAR[0], (20, 0, 0.75), CAR[2], 0.5, 0.99)], {"road": column_mask(4, -4)}),
        ("alignment", [("construction_big", (20, 15, 3), (12, 6, 6), 0.4, 0.99)], {"road": column_mask(4, -4)}),
    ],
)
def test_gradient_descent_resolves_penalty(name, boxes, classes):
    ground = make_ground(**classes)
    features, logit, proposals = make_features(boxes)
    chosen = penalties.find_objects(features, logit, proposals, SPEC)
    features.requires_grad_()
    optimizer = torch.optim.Adam([features], lr=0.002)
    values = []
    for _ in range(300):
        objects = make_objects(features, logit, proposals, SPEC, chosen)
        penalty = compute_penalties(objects, ground, (name,))[name].sum()
        values.append(float(penalty))
        optimizer.zero_grad()
        penalty.backward()
        assert features.grad is not None and torch.isfinite(features.grad).all()
        optimizer.step()
    assert values[0] > 0.3 and values[-1] < 0.02 * values[0], values[:: len(values) // 10]
    assert logit.grad is None  # Descent moves objects and keeps their existence.


def test_gradient_is_finite_for_square_and_concentric_boxes():
    boxes = [("object", (20, 0, 0.5), (1, 1, 1), 0.3, 0.9), ("human", (20, 0, 0.5), (1, 1, 1), 0.3, 0.9)]
    features, logit, proposals = make_features(boxes)
    features.requires_grad_()
    chosen = penalties.find_objects(features, logit, proposals, SPEC)
    objects = make_objects(features, logit, proposals, SPEC, chosen)
    found = compute_penalties(objects, make_ground(), tuple(penalties.CONSTRAINTS))
    torch.stack(list(found.values())).sum().backward()
    assert features.grad is not None and torch.isfinite(features.grad).all()


# -------------------------------------------------------------------------------------------------------------- options


def test_constraints_need_categories_of_model():
    cars = LayoutSpec(categories=("vehicle_small", "human"), slots=(4, 4))
    assert select_constraints(cars) == ("penetration", "height", "heading", "alignment")
    assert select_constraints(LayoutSpec()) == tuple(penalties.CONSTRAINTS)
    with pytest.raises(ValueError, match="'support' needs at least one of traffic_control, but the model has only"):
        select_constraints(cars, ["support"])
    with pytest.raises(ValueError, match="'lanes' is unknown, expected some of: penetration"):
        select_constraints(cars, ["lanes"])
    terrain = LayoutSpec(ground_classes=("terrain",))
    assert "heading" not in select_constraints(terrain)
    with pytest.raises(ValueError, match="'heading' needs at least one of road, crossing"):
        select_constraints(terrain, ["heading"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"last": 0}, "last is 0, expected a share"),
        ({"every": 0}, "every is 0"),
        ({"step": float("nan")}, "step is nan"),
        ({"weights": {"lanes": 1.0}}, "weight of constraint 'lanes'"),
        ({"weights": {"height": -1.0}}, "'height' is -1.0"),
    ],
)
def test_constraint_config_rejects_invalid_options(options, message):
    with pytest.raises(ValueError, match=message):
        ConstraintConfig(**options)


def test_guided_timesteps_end_with_last_step():
    guided = ConstraintConfig(last=0.4, every=2).select_timesteps(range(0, 1000, 50))
    assert guided == {0, 100, 200, 300}
    assert ConstraintConfig(last=0.01).select_timesteps([7, 500]) == {7}


# ------------------------------------------------------------------------------------------------------------- sampling


@pytest.fixture(scope="module")
def constrained() -> PrITTIPipeline:
    pipeline = tiny_pipeline(small_spec())
    pipeline.set_constraints(ConstraintConfig())
    return pipeline


LABELS = ["low", "medium", "high"]


@pytest.mark.parametrize("sampler", ["ddpm", "ddim", "dpm++", "sde-dpm++"])
@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_guidance_is_independent_of_batch_composition(constrained, sampler, scale):
    """One gradient step per guided step: with more steps, rounding of the batched network grows at kinks of penalties.
    A change of the weights by 1e-7 then has the same effect."""
    constrained.use_sampler(sampler)
    constrained.set_constraints(ConstraintConfig(iterations=1))
    together = constrained.sample_latents(LABELS, 3, range(3), 10, scale)
    alone = torch.cat([constrained.sample_latents([label], 3, [k], 10, scale) for k, label in enumerate(LABELS)])
    constrained.set_constraints(ConstraintConfig())
    assert torch.allclose(together, alone, atol=1e-5 * float(together.abs().max()))
    guidance, constrained.guidance = constrained.guidance, None
    plain = constrained.sample_latents(LABELS, 3, range(3), 10, scale)
    constrained.guidance = guidance
    assert not torch.allclose(together, plain, atol=1e-2)
    before, after = (sum_all(require_guidance(constrained).measure_penalties(z)) for z in (plain, together))
    assert after < before


def test_displacement_of_scene_ignores_other_scenes(constrained):
    latents = torch.randn(4, *constrained.latent_shape, generator=torch.Generator().manual_seed(2))
    guidance = require_guidance(constrained)
    together = guidance.find_displacement(latents, 0.3)
    alone = torch.cat([guidance.find_displacement(latents[k : k + 1], 0.3) for k in range(4)])
    assert together.flatten(1).norm(dim=1).min() > 0.1
    assert torch.allclose(together, alone, atol=1e-4)
    large = torch.cat([latents[:1], 10 * latents[1:]])
    assert torch.allclose(guidance.find_displacement(large, 0.3)[0], together[0], atol=1e-4)


def test_guidance_runs_in_inference_mode(constrained):
    constrained.use_sampler("dpm++")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # The order in which threads add up gradients changes their rounding.
    try:
        usual = constrained.sample_latents(LABELS, 3, range(3), 10)
        with torch.inference_mode():
            assert torch.equal(constrained.sample_latents(LABELS, 3, range(3), 10), usual)
    finally:
        torch.set_num_threads(threads)


def test_displacement_has_full_precision_under_autocast(constrained):
    latents = torch.randn(2, *constrained.latent_shape, generator=torch.Generator().manual_seed(2))
    guidance = require_guidance(constrained)
    usual = guidance.find_displacement(latents, 0.3)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(guidance.find_displacement(latents, 0.3), usual)


def test_guided_inpainting_keeps_known_latents(constrained):
    mask = torch.zeros(1, *constrained.latent_shape)
    mask[..., :4] = 1
    known = torch.randn(mask.shape, generator=torch.Generator().manual_seed(0))
    for repaint in (RePaintConfig(10, 2, 2), RePaintConfig.guided(10)):
        arguments = InpaintCondition(known, mask), ["low"], 0, [0], repaint
        latents = constrained.inpaint_latents(*arguments)
        assert torch.equal(latents[..., 4:], known[..., 4:])
        guidance, constrained.guidance = constrained.guidance, None
        plain = constrained.inpaint_latents(*arguments)
        constrained.guidance = guidance
        assert not torch.allclose(latents[..., :4], plain[..., :4], atol=1e-3)


def test_step_without_finite_gradient_falls_back(constrained, monkeypatch, caplog):
    """Scene 1 has no finite gradient: it equals the unguided scene, is counted, and the others are guided."""
    from models.sampling import constraints

    pipeline = tiny_pipeline(small_spec())
    pipeline.use_sampler("dpm++")
    plain = pipeline.sample_latents(LABELS, 3, range(3), 10)
    pipeline.set_constraints(ConstraintConfig())
    guided = pipeline.sample_latents(LABELS, 3, range(3), 10)
    assert require_guidance(pipeline).report == GuidanceReport(9, 0)
    usual = constraints.sum_penalties

    def damage(found, weights):
        total = usual(found, weights)
        return total * torch.tensor([1.0, torch.nan, 1.0])

    monkeypatch.setattr(constraints, "sum_penalties", damage)
    pipeline.set_constraints(ConstraintConfig())
    with caplog.at_level(logging.WARNING):
        damaged = pipeline.sample_latents(LABELS, 3, range(3), 10)
    assert torch.allclose(damaged[1], plain[1], atol=1e-5)
    assert torch.allclose(damaged[[0, 2]], guided[[0, 2]], atol=1e-4)
    assert require_guidance(pipeline).report == GuidanceReport(6, 3)
    assert "3 of 9 guided steps had no finite gradient" in caplog.text


def test_nan_in_one_scene_leaves_others_unchanged(constrained):
    latents = torch.randn(3, *constrained.latent_shape, generator=torch.Generator().manual_seed(1))
    usual = constrained.guidance.find_displacement(latents, 1.0)
    latents[1] = torch.nan
    found = constrained.guidance.find_displacement(latents, 1.0)
    assert torch.allclose(found[[0, 2]], usual[[0, 2]], atol=1e-5) and usual[1].abs().sum() > 0
    assert not found[1].any()


def test_displacement_is_bounded_by_noise_level(constrained):
    latents = torch.randn(3, *constrained.latent_shape, generator=torch.Generator().manual_seed(1))
    for level in (0.01, 0.1):
        moved = constrained.guidance.find_displacement(latents, level).norm(dim=1)
        radius = ConstraintConfig().trust * level * constrained.latent_shape[0] ** 0.5
        assert 0.99 * radius < moved.max() < 1.001 * radius


def test_pipeline_stores_default_of_constraints(tmp_path):
    pipeline = tiny_pipeline(small_spec())
    assert pipeline.guidance is None and not pipeline.resolve_constraints(None)
    pipeline.register_to_config(constraints=True)
    pipeline.save_pretrained(tmp_path)
    again = PrITTIPipeline.from_pretrained(tmp_path)
    assert again.guidance is not None and again.resolve_constraints(None)
    again.use_constraints(False)
    assert again.guidance is None
    with pytest.raises(ValueError, match="'lanes' is unknown"):
        again.set_constraints(ConstraintConfig(names=("lanes",)))


def test_constraints_improve_scenes_of_released_weights():
    pipeline = PrITTIPipeline.from_pretrained("town")
    pipeline.set_progress_bar_config(disable=True)
    pipeline.use_sampler("dpm++")
    latents = {}
    for constraints in (False, True):
        pipeline.use_constraints(constraints)
        latents[constraints] = pipeline.sample_latents(["low-medium", "medium-low"], 5, range(2), 20)
    plain, guided = (require_guidance(pipeline).measure_penalties(latents[key]) for key in (False, True))
    assert sum_all(guided) < 0.5 * sum_all(plain)
    for name in ("penetration", "height"):
        assert guided[name].sum() < 0.6 * plain[name].sum(), name
