"""Tests of transformers that read the known part of a scene: masks, training, sampling and outpainting."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from helpers import QUICK, random_scene, small_spec, tiny_pipeline
from torch import Tensor

from models.composition.block_grid import choose_arrangement
from models.composition.infinite import InfiniteScene
from models.composition.inpaint import make_latent_mask
from models.composition.road_sketch import RoadMap
from models.dit import DiT
from models.pipeline import PrITTIPipeline
from models.presets import DIT_PRESETS
from models.sampling.diffusion import (
    Diffusion,
    InpaintCondition,
    SamplingSchedule,
    SceneNoise,
    join_known,
    make_keyed_generator,
    sample,
    with_known,
)
from models.sampling.known_regions import NUM_UNIFORM, SHARE_BAND, SHARE_ONE_CONTENT, make_training_masks
from models.sampling.repaint import RePaintConfig, TrainedInpainting
from models.training import DiffusionLossConfig, make_diffusion_loss, make_dit_settings, make_dit_trainer

SIZE = 8


def make_inpainting(pipeline: PrITTIPipeline) -> PrITTIPipeline:
    """Return the same pipeline with random weights for the known part."""
    dit = DiT(**(dict(pipeline.dit.config) | {"inpainting": True, "schedule": pipeline.dit.diffusion}))
    torch.manual_seed(1)
    state = pipeline.dit.state_dict() | {"known_in.weight": 0.05 * torch.randn(32, 2 * dit.config.channels, 2, 2)}
    dit.load_state_dict(state)
    made = PrITTIPipeline(pipeline.lvae, dit, num_inference_steps=10)
    made.set_progress_bar_config(disable=True)
    return made


@pytest.fixture(scope="module")
def pipeline():
    return make_inpainting(tiny_pipeline(small_spec()))


def draw_condition(shape, known_cols: int, count: int = 2) -> InpaintCondition:
    generator = torch.Generator().manual_seed(4)
    mask = torch.ones(count, *shape)
    mask[..., :known_cols] = 0
    return InpaintCondition(torch.randn(mask.shape, generator=generator), mask)


# ------------------------------------------------------------------------------------------------------------- masks


def test_training_masks_have_the_known_regions_of_their_uses():
    uniform = torch.rand(4000, NUM_UNIFORM, generator=torch.Generator().manual_seed(0))
    known = 1 - make_training_masks(uniform, 6, SIZE)
    ground, objects = known[:, 0], known[:, -1]
    banded = ((ground == 1) & (objects == 0)).flatten(1).any(1) & (ground == 0).flatten(1).any(1)
    assert float(banded.float().mean()) == pytest.approx(0.8 * SHARE_BAND, abs=0.04)
    assert torch.equal(known, torch.cat([ground[:, None].expand(-1, 3, -1, -1)] + 3 * [objects[:, None]], dim=1))
    shares = {
        "nothing": (known == 0).flatten(1).all(1),
        "all ground": (ground == 1).flatten(1).all(1) & ~(objects == 1).flatten(1).all(1),
        "all objects": (objects == 1).flatten(1).all(1) & ~(ground == 1).flatten(1).all(1),
        "four sides": (ground[:, [0, -1]] == 1).all(2).all(1) & (ground[:, :, [0, -1]] == 1).all(2).all(1),
        "one side": (ground[:, 0] == 1).all(1) & (ground[:, -1] == 0).any(1),
    }
    share = {name: float(of.float().mean()) for name, of in shares.items()}
    assert share["nothing"] == pytest.approx(0.35 * (1 - 2 * SHARE_ONE_CONTENT) * (1 - SHARE_BAND), abs=0.03)
    assert all(
        0.8 * SHARE_ONE_CONTENT < share[name] <= 1.1 * SHARE_ONE_CONTENT for name in ("all ground", "all objects")
    ), share
    assert share["four sides"] > 0.1 and share["one side"] > 0.05


# ---------------------------------------------------------------------------------------------------------- training


def test_network_starts_without_regard_to_the_known_part():
    made = DiT(channels=2, size=SIZE, width=32, depth=1, heads=2, inpainting=True)
    torch.nn.init.normal_(made.patch_out.weight)
    latent, timestep, label = torch.randn(2, 2, SIZE, SIZE), torch.tensor([5, 900]), torch.tensor([0, 1])
    joined = join_known(latent, draw_condition((2, SIZE, SIZE), 4))
    assert torch.equal(made(joined, timestep, label), made(latent, timestep, label))
    torch.nn.init.normal_(made.known_in.weight)
    assert not torch.allclose(made(joined, timestep, label), made(latent, timestep, label))
    with pytest.raises(ValueError, match="without --inpainting"):
        DiT(channels=2, size=SIZE, width=32, depth=1, heads=2)(joined, timestep, label)


def test_trained_network_continues_the_known_part():
    """In the data, all cells of a latent are equal. A network with half of the cells known must find the other half."""
    torch.manual_seed(0)
    dit = DiT(channels=2, size=SIZE, width=32, depth=1, heads=2, prediction="v_prediction", inpainting=True)
    settings = replace(make_dit_settings(DIT_PRESETS["smoke"], 0), steps=250, learning_rate=3e-3, warmup_steps=10)
    trainer = make_dit_trainer(dit, settings, 0.1, torch.device("cpu"), loss_config=DiffusionLossConfig())
    draws = torch.Generator().manual_seed(0)
    for step in range(250):
        mean = torch.randn(32, 2, 1, 1, generator=draws).expand(-1, -1, SIZE, SIZE).contiguous()
        arrays = {"mean": mean, "logvar": torch.full_like(mean, -20.0), "label": torch.zeros(32, dtype=torch.long)}
        trainer.step(arrays, range(32 * step, 32 * (step + 1)))
    truth = torch.randn(16, 2, 1, 1, generator=draws).expand(-1, -1, SIZE, SIZE)
    mask = torch.ones(16, 2, SIZE, SIZE)
    mask[..., :4] = 0
    schedule, label = SamplingSchedule(dit.diffusion, 50), torch.zeros(16, dtype=torch.long)
    errors = {}
    for name, condition in {"known": InpaintCondition(truth, mask), "nothing": None}.items():
        model = with_known(dit, condition, dit.diffusion) if condition else dit
        noise = SceneNoise(0, range(16), (2, SIZE, SIZE), "cpu")
        errors[name] = float((sample(model, schedule, noise, label) - truth)[..., 4:].square().mean())
    assert errors["known"] < 0.4 and errors["nothing"] > 1.2, errors


# ---------------------------------------------------------------------------------------------------------- sampling


@pytest.mark.parametrize("sampler", ["ddpm", "ddim", "dpm++", "sde-dpm++"])
def test_every_sampler_keeps_the_known_part(pipeline, sampler):
    pipeline.use_sampler(sampler)
    condition = draw_condition(pipeline.latent_shape, 3)
    arguments = ["low", "high"], 5, [0, 1]
    made = pipeline.inpaint_latents(condition, *arguments, TrainedInpainting(10))
    assert torch.equal(made[..., :3], condition.latent[..., :3])
    other = InpaintCondition(condition.latent * 2, condition.mask)
    changed = pipeline.inpaint_latents(other, *arguments, TrainedInpainting(10))
    assert not torch.allclose(made[..., 3:], changed[..., 3:])
    one = InpaintCondition(condition.latent[1:], condition.mask[1:])
    alone = pipeline.inpaint_latents(one, ["high"], 5, [1], TrainedInpainting(10))
    assert torch.allclose(alone[0], made[1], atol=1e-4)


def test_known_guidance_extrapolates_at_noisy_timesteps():
    """A network that returns the sum of the known latent adds scale times this sum at noisy timesteps only."""
    condition = draw_condition((2, SIZE, SIZE), 3)
    diffusion, label = Diffusion(), torch.zeros(2, dtype=torch.long)
    latent = torch.randn(2, 2, SIZE, SIZE, generator=torch.Generator().manual_seed(1))

    def model(joined: Tensor, timestep: Tensor, label: Tensor) -> Tensor:
        noisy, known, _ = joined.split(2, dim=1)
        return noisy + known.sum((1, 2, 3), keepdim=True)

    total = (condition.latent * (1 - condition.mask)).sum((1, 2, 3), keepdim=True)
    for timestep, factor in ((299, 1.0), (300, 2.5), (999, 2.5)):
        predict = with_known(model, condition, diffusion, 2.5)
        made = predict(latent, torch.full((2,), timestep), label)
        assert torch.allclose(made[..., 3:], (latent + factor * total)[..., 3:], atol=1e-4), timestep
    plain = with_known(model, condition, diffusion)(latent, torch.full((2,), 999), label)
    assert torch.allclose(plain[..., 3:], (latent + total)[..., 3:], atol=1e-4)


def test_known_guidance_moves_samples_and_keeps_the_known_part(pipeline):
    pipeline.use_sampler("dpm++")
    condition = draw_condition(pipeline.latent_shape, 3)
    arguments = ["low", "high"], 5, [0, 1]
    plain, guided = (
        pipeline.inpaint_latents(condition, *arguments, TrainedInpainting(6, scale)) for scale in (1.0, 2.0)
    )
    assert torch.equal(guided[..., :3], condition.latent[..., :3])
    assert not torch.allclose(plain[..., 3:], guided[..., 3:], atol=1e-3)
    nothing = draw_condition(pipeline.latent_shape, 0)
    alone = pipeline.inpaint_latents(nothing, *arguments, TrainedInpainting(6, 2.0))
    assert torch.allclose(alone, pipeline.sample_latents(*arguments, 6), atol=1e-5)
    with pytest.raises(ValueError, match=r"known_guidance_scale is -1, expected 0 to 100"):
        TrainedInpainting(6, -1)
    with pytest.raises(ValueError, match=r"pag_factor is 1\.5, expected 0 to 1"):
        TrainedInpainting(6, pag_factor=1.5)


def test_empty_known_part_is_ordinary_sampling(pipeline):
    pipeline.use_sampler("dpm++")
    condition = draw_condition(pipeline.latent_shape, 0)
    made = pipeline.inpaint_latents(condition, ["low", "high"], 5, [0, 1], TrainedInpainting(8))
    assert torch.allclose(made, pipeline.sample_latents(["low", "high"], 5, [0, 1], 8), atol=1e-5)


def test_default_of_inpainting_depends_on_the_model(pipeline):
    plain = tiny_pipeline(small_spec())
    assert plain.resolve_inpainting(None) == RePaintConfig.guided()
    plain.register_to_config(neighbour_latents="paper")
    assert plain.resolve_inpainting(None) == RePaintConfig() and plain.resolve_inpainting(QUICK) == QUICK
    assert pipeline.resolve_inpainting(None) == TrainedInpainting(pipeline.config.num_inference_steps, pag_factor=1.0)
    assert pipeline.resolve_inpainting(TrainedInpainting(7)).num_evaluations == 7
    with pytest.raises(ValueError, match="no inpainting model"):
        plain.inpaint_latents(draw_condition(plain.latent_shape, 3), ["low", "low"], 0, [0, 1], TrainedInpainting(5))


def test_known_streets_reduce_the_attention_guidance(monkeypatch):
    pipeline = make_inpainting(tiny_pipeline(small_spec()))
    pipeline.register_to_config(pag_scale=2.0, street_pag_factor=0.5)
    pipeline.use_pag(None)
    pipeline.use_sampler("dpm++")
    scales, make = [], pipeline.make_denoiser

    def record(timesteps, label, guidance_scale=1.0, pag_scale=None):
        scales.append(pag_scale)
        return make(timesteps, label, guidance_scale, pag_scale)

    monkeypatch.setattr(pipeline, "make_denoiser", record)
    streets = RoadMap.from_classes(np.zeros((256, 256), np.uint8), 1.0)
    scene, one_ahead = random_scene(2, grid=pipeline.spec.grid), {"num_blocks": (1, 0, 0, 0)}
    few = TrainedInpainting(4)
    pipeline.outpaint(scene, "low", repaint=few, **one_ahead)
    pipeline.outpaint(scene, "low", repaint=few, roads=[streets], **one_ahead)
    pipeline.outpaint(scene, "low", repaint=replace(few, pag_factor=0.25), roads=[streets], **one_ahead)
    pipeline.use_pag(1.5)
    pipeline.outpaint(scene, "low", repaint=few, roads=[streets], **one_ahead)
    assert scales == [2.0, 1.0, 0.5, 0.75]


def test_pipeline_with_inpainting_survives_saving(pipeline, tmp_path):
    pipeline.save_pretrained(tmp_path)
    loaded = PrITTIPipeline.from_pretrained(tmp_path)
    assert loaded.dit.config.inpainting
    assert torch.equal(loaded.dit.known_in.weight, pipeline.dit.known_in.weight)


def test_region_is_inpainted_around_known_objects(pipeline):
    pipeline.use_sampler("dpm++")
    scene = random_scene(2, grid=pipeline.spec.grid)
    region = scene.grid.x_m()[:, None] + 0 * scene.grid.y_m() > 32
    (made,) = pipeline.inpaint([scene], [region], ["low"], repaint=TrainedInpainting(6))
    assert (made.occupied[:, ~region] == scene.occupied[:, ~region]).all()
    mask = make_latent_mask([region], pipeline.latent_shape, "both")
    assert 0 < float(mask.mean()) < 1


# ------------------------------------------------------------------------------------------------------- outpainting


def test_arrangement_changes_with_the_distance():
    assert choose_arrangement((1, 1, 1, 1)) == ("outward", 0.5, "none", 0.0)
    assert choose_arrangement((2, 0, 0, 0)) == ("colours", 0.25, "all", 0.0)
    assert choose_arrangement((2, 0, 0, 0), "outward", margin=0.1) == ("outward", 0.5, "all", 0.1)
    assert choose_arrangement((1, 1, 1, 1), overlap=0.25, free_blocks="all") == ("outward", 0.25, "all", 0.0)
    with pytest.raises(ValueError, match="order is 'spiral', expected one of: outward, colours"):
        choose_arrangement((1, 1, 1, 1), "spiral")


@pytest.mark.parametrize(("order", "overlap"), [("colours", 0.25), ("outward", 0.25), ("outward", 0.5)])
def test_infinite_scene_has_the_blocks_of_the_large_scene(pipeline, order, overlap):
    """The blocks at the border of the large scene are equal too, because its numbers of blocks are even."""
    pipeline.use_sampler("dpm++")
    scene = random_scene(2, grid=pipeline.spec.grid)
    steps, options = (2, 0, 0, 2), {"repaint": TrainedInpainting(4), "mode": "reencode"}
    large = pipeline.outpaint(scene, "low", seed=3, index=1, num_blocks=steps, order=order, overlap=overlap, **options)
    assert large.grid.rows == 32 + 2 * 32 * (1 - overlap)
    options |= {"order": order, "overlap": overlap}
    infinite = InfiniteScene(pipeline, "low", seed=3, scene=scene, scene_index=1, **options)
    infinite.drop_block((0, 0))
    whole = infinite.composer.stitch(
        {index: infinite.get_block(index) for index in product(range(3), range(-2, 1))}, scene
    )
    # The large scene is generated in batches, which changes the rounding.
    assert np.mean(whole.occupied != large.occupied) < 1e-3 and len(whole) == len(large)
    assert np.abs(whole.center_m - large.center_m).max() < 0.01


def test_far_blocks_of_an_infinite_scene_are_crops(pipeline):
    config = {**pipeline.dit.config, "label": "partial", "schedule": pipeline.dit.diffusion}
    model = PrITTIPipeline(pipeline.lvae, DiT(**config))
    for free_blocks, ahead, left in (("all", "-free", "-free"), ("off-street", "", "-free"), ("none", "", "")):
        infinite = InfiniteScene(model, "low-any", free_blocks=free_blocks)
        found = [infinite.label_of(index) for index in ((0, 0), (2, 0), (0, 1))]
        assert found == ["low-any", "low-any" + ahead, "low-any" + left]
    assert InfiniteScene(model, lambda index: "any-high").label_of((3, 3)) == "any-high"
    with pytest.raises(ValueError, match="free_blocks is 'some', expected one of: none, off-street, all"):
        InfiniteScene(model, "low-any", free_blocks="some")


def test_known_streets_hold_latents_of_streets_only():
    """The loss passes the ground of streets to the network, and has no error there."""
    torch.manual_seed(0)
    dit = DiT(channels=2, size=SIZE, width=32, depth=1, heads=2, prediction="v_prediction", inpainting=True)
    count = 64
    arrays = {"mean": torch.zeros(count, 2, SIZE, SIZE), "label": torch.zeros(count, dtype=torch.long)}
    cells = torch.zeros(count, SIZE, SIZE, dtype=torch.uint8)
    cells[:, 2] = 1
    arrays |= {"street_ground": torch.full((count, 1, SIZE, SIZE), 7.0), "street_cells": cells}
    seen = []

    def network(noisy, timestep, label):
        seen.append(noisy)
        return torch.zeros_like(noisy[:, :2])

    config = DiffusionLossConfig(sample_posterior=False, known_streets_share=0.5)
    loss = make_diffusion_loss(dit, 0.0, config)
    first = loss(network, arrays, [make_keyed_generator(0, k) for k in range(count)])["noise_error"]
    _, _, known_ground, known_objects, is_ground, is_objects = seen[0].unbind(1)
    streets = (known_ground == 7).flatten(1).any(1)
    assert 0.3 < float(streets.float().mean()) < 0.7
    assert not (known_ground == 7)[cells == 0].any() and not known_objects.any()
    assert (is_ground[streets][:, 2] == 1).all() and not torch.equal(is_ground, is_objects)
    without = replace(config, known_streets_share=0.0)
    second = make_diffusion_loss(dit, 0.0, without)(network, arrays, [make_keyed_generator(0, k) for k in range(count)])
    assert not (seen[1][:, 2] == 7).any() and float(first) < float(second["noise_error"])
