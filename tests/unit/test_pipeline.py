"""Tests of PrITTIPipeline without Ray: samplers, seeds, conventions of diffusers and inpainting."""

import json
from dataclasses import replace

import numpy as np
import pytest
import shapely
import torch
from diffusers import DPMSolverMultistepScheduler, UniPCMultistepScheduler
from helpers import LATENT_SHAPE, QUICK, random_scene, scenes_equal, small_spec, tiny_pipeline

from models.composition.extend import inpaint_blocks
from models.composition.inpaint import (
    composite_scenes,
    find_region_cells,
    make_latent_mask,
    select_around_objects,
    select_half_plane,
    select_kept_pixels,
    select_polygon,
)
from models.composition.seam_blending import blend_ground
from models.dit import DiT
from models.lvae import LayoutVAE
from models.pipeline import PrITTIPipeline
from models.presets import LVAE_PRESETS
from models.sampling.diffusion import (
    Diffusion,
    InpaintCondition,
    SamplingSchedule,
    SceneNoise,
    sample,
    sample_with_scheduler,
    scale_noise,
)
from models.sampling.repaint import RePaintConfig, TrainedInpainting
from models.sampling.schedulers import SAMPLERS, SchedulerConfig, list_schedule_options
from models.scene import CATEGORY_INDEX, Grid
from models.training import make_diffusion_loss

SPEC = small_spec()


def build_sampler(name: str):
    return SchedulerConfig.ddpm().with_sampler(name).build()


# --------------------------------------------------------------------------------------------------------- samplers


@pytest.mark.parametrize(
    ("name", "steps", "tolerance"),
    [("ddpm", 250, 0.03), ("ddim", 250, 0.03), ("dpm++", 20, 0.01), ("dpm++", 10, 0.02), ("sde-dpm++", 20, 0.02)],
)
def test_samplers_reproduce_gaussian_with_exact_denoiser(name, steps, tolerance):
    """With the exact denoiser for data from N(mean, std^2), samples have the mean and the standard deviation of the
    data."""
    mean, std, alpha_bar = 1.5, 0.5, torch.from_numpy(Diffusion().alpha_bar).float()

    def model(latent, timestep, label):
        a = alpha_bar[timestep][:, None, None, None]
        return (1 - a).sqrt() * (latent - a.sqrt() * mean) / (a * std**2 + 1 - a)

    noise, label = SceneNoise(0, range(64), LATENT_SHAPE, "cpu"), torch.zeros(64, dtype=torch.long)
    if name == "ddpm":
        drawn = sample(model, SamplingSchedule(Diffusion(), steps), noise, label)
    else:
        solver = build_sampler(name)
        solver.set_timesteps(steps)
        drawn = sample_with_scheduler(model, solver, noise, label)
    assert abs(drawn.mean() - mean) < 0.02 and abs(drawn.std() - std) < tolerance


def test_samplers_are_independent_of_batch_composition(pipeline):
    labels, drawn = ["low", "medium", "high"], {}
    for name in SAMPLERS:
        pipeline.use_sampler(name)
        together = drawn[name] = pipeline.sample_latents(labels, 3, range(3), 10)
        alone = torch.cat([pipeline.sample_latents([label], 3, [k], 10) for k, label in enumerate(labels)])
        assert torch.allclose(together, alone, atol=1e-4), name
        again = pipeline.sample_latents(labels, 3, range(3), 10)
        assert torch.equal(together, again), name  # a scheduler keeps no state of the previous run
    assert len({round(float(latents.abs().sum()), 3) for latents in drawn.values()}) == len(SAMPLERS)
    pipeline.use_sampler("dpm++")  # the previous sampler (sde-dpm++) draws noise, but dpm++ draws no noise
    assert torch.equal(pipeline.sample_latents(labels, 3, range(3), 10), drawn["dpm++"])
    with pytest.raises(ValueError, match="num_inference_steps is 600"):
        pipeline.sample_latents(labels, 3, range(3), 600)
    with pytest.raises(ValueError, match="sampler 'euler' is unknown, expected one of: ddpm, ddim, dpm"):
        pipeline.use_sampler("euler")
    pipeline.use_sampler("ddpm")


def test_pipeline_round_trip_keeps_sampler(pipeline, tmp_path):
    pipeline.use_sampler("dpm++")
    pipeline.save_pretrained(tmp_path)
    again = PrITTIPipeline.from_pretrained(tmp_path)
    again.set_progress_bar_config(disable=True)
    pipeline.use_sampler("ddpm")
    assert isinstance(again.scheduler, DPMSolverMultistepScheduler) and again.diffusion == pipeline.diffusion
    for name in ("dpm++", "ddpm"):
        again.use_sampler(name)
        pipeline.use_sampler(name)
        pair = [p.generate(["high"], seed=1, num_inference_steps=5)[0] for p in (pipeline, again)]
        assert scenes_equal(*pair)


def test_stored_sampler_and_steps_are_the_defaults(pipeline, tmp_path):
    assert (pipeline.scheduler_config.sampler, pipeline.config.num_inference_steps) == ("ddpm", 250)  # the paper
    pipeline.use_sampler("sde-dpm++")
    assert pipeline.config.num_inference_steps == 20
    pipeline.register_to_config(num_inference_steps=6)
    pipeline.use_sampler("sde-dpm++")  # the same sampler keeps its number of steps
    pipeline.save_pretrained(tmp_path)
    made = pipeline.generate(["high"], seed=1, num_inference_steps=6)[0]
    pipeline.use_sampler("ddpm")
    assert pipeline.config.num_inference_steps == 250
    again = PrITTIPipeline.from_pretrained(tmp_path)
    again.set_progress_bar_config(disable=True)
    assert again.scheduler_config.sampler == "sde-dpm++" and scenes_equal(again.generate(["high"], seed=1)[0], made)
    again.scheduler = UniPCMultistepScheduler(**list_schedule_options(again.diffusion))
    assert again.scheduler_config.sampler == "UniPCMultistepScheduler" and again.config.num_inference_steps == 6
    again.use_sampler("UniPCMultistepScheduler")  # the name of the current scheduler changes nothing
    assert again.config.num_inference_steps == 6
    released = PrITTIPipeline.from_pretrained("town")
    assert (released.scheduler_config.sampler, released.config.num_inference_steps) == ("sde-dpm++", 20)


def test_pipeline_noise_scaling_skips_ddpm_of_paper(pipeline, tmp_path):

    def sample_with(sampler, pipe=pipeline, **options):
        pipe.use_sampler(sampler)
        return pipe.sample_latents(["low", "high"], 3, range(2), 10, **options)

    plain = {name: sample_with(name) for name in ("ddpm", "dpm++")}
    assert torch.equal(sample_with("dpm++", noise_scaling=1.0), plain["dpm++"])
    more = sample_with("dpm++", noise_scaling=1.01)
    assert not torch.allclose(more, plain["dpm++"], rtol=1e-4)
    pipeline.register_to_config(noise_scaling=1.01)
    pipeline.save_pretrained(tmp_path)
    pipeline.register_to_config(noise_scaling=1.0)
    again = PrITTIPipeline.from_pretrained(tmp_path)
    again.set_progress_bar_config(disable=True)
    assert torch.equal(sample_with("dpm++", again), more) and torch.equal(sample_with("ddpm", again), plain["ddpm"])
    with pytest.raises(ValueError, match=r"noise_scaling is 2.0, expected 0.9 to 1.1"):
        sample_with("dpm++", noise_scaling=2.0)
    pipeline.use_sampler("ddpm")


def test_pipeline_refuses_wrong_labels_and_guidance_scale(pipeline):
    for labels in ("low", []):
        with pytest.raises(ValueError, match="expected a list with one label per scene"):
            pipeline.generate(labels, num_inference_steps=10)
    for scale in (-1.0, 101.0, float("nan")):
        with pytest.raises(ValueError, match=rf"guidance_scale is {scale}, expected 0 to 100"):
            pipeline.generate(["low"], num_inference_steps=10, guidance_scale=scale)


def test_pipeline_stores_pag_scale_and_guides_noisy_timesteps(tmp_path):
    stored = tiny_pipeline(SPEC)
    stored.register_to_config(pag_scale=2.0)
    stored.save_pretrained(tmp_path)
    loaded = PrITTIPipeline.from_pretrained(tmp_path)
    assert loaded.pag_scale == 2.0 and loaded.resolve_pag_scale(None) == 2.0
    with torch.no_grad():
        for parameter in loaded.dit.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1)))
    latent, label = torch.randn(2, *loaded.latent_shape), torch.tensor([0, 1])
    noises = {}
    for scale in (2.0, 0.0):
        loaded.use_pag(scale)
        denoise = loaded.make_denoiser(torch.tensor([900, 200, 199, 5]), label)
        noises[scale] = [denoise(latent, torch.full((2,), timestep), label) for timestep in (900, 200, 199, 5)]
    alike = [torch.allclose(*pair, atol=1e-5) for pair in zip(*noises.values(), strict=True)]
    assert alike == [False, False, True, True]
    loaded.use_pag(2.0)
    loaded.register_to_config(pag_drops_label=True)
    denoise = loaded.make_denoiser(torch.tensor([900, 200, 199, 5]), label)
    dropped = [denoise(latent, torch.full((2,), timestep), label) for timestep in (900, 200, 199, 5)]
    alike = [torch.allclose(*pair, atol=1e-5) for pair in zip(dropped, noises[2.0], strict=True)]
    assert alike == [False, False, True, True]
    found = []
    known = InpaintCondition(torch.zeros(1, *loaded.latent_shape), torch.ones(1, *loaded.latent_shape))
    for scale in (2.0, 0.0):
        loaded.use_pag(scale)
        found.append(loaded.inpaint_latents(known, ["low"], 0, [0], QUICK))
    assert torch.equal(*found)  # Inpainting does not use the guidance.
    for scale in (-1.0, 21.0):
        with pytest.raises(ValueError, match=rf"pag_scale is {scale}, expected 0 to 20"):
            loaded.use_pag(scale)
    loaded.register_to_config(pag_scale=-1.0)
    with pytest.raises(ValueError, match="pag_scale is -1"):
        loaded.use_pag(None)
    index = json.loads((tmp_path / "model_index.json").read_text())
    (tmp_path / "model_index.json").write_text(json.dumps(index | {"pag_scale": -1}))
    with pytest.raises(ValueError, match="pag_scale"):
        PrITTIPipeline.from_pretrained(tmp_path)


def test_pipeline_decodes_objects_above_its_threshold(pipeline, tmp_path):
    latents, identities = torch.zeros(1, *pipeline.lvae.latent_shape), [pipeline.new_identity("run", 0, 0, "low")]
    (everything,) = pipeline.decode(latents, identities, 1e-6)
    existence = np.sort(everything.existence)
    # The threshold is in a gap between probabilities, because rounding may change the probabilities after loading.
    gap = np.argmax(np.diff(existence))
    middle = float(existence[gap : gap + 2].mean())
    (probable,) = pipeline.decode(latents, identities, middle)
    assert 0 < len(probable) < len(everything) and probable.existence.min() > middle
    pipeline.register_to_config(existence_threshold=middle)
    pipeline.save_pretrained(tmp_path)
    pipeline.register_to_config(existence_threshold=0.3)  # threshold of the paper
    again = PrITTIPipeline.from_pretrained(tmp_path)
    again.set_progress_bar_config(disable=True)
    assert scenes_equal(again.decode(latents, identities)[0], probable)
    options = {"seed": 1, "num_inference_steps": 2}
    drawn = again.generate(["low"], **options)[0], pipeline.generate(["low"], **options, existence_threshold=middle)[0]
    assert scenes_equal(*drawn)
    with pytest.raises(ValueError, match="existence_threshold is 30, expected between 0 and 1"):
        pipeline.generate(["low"], **options, existence_threshold=30)


def test_guided_inpainting_scales_noise_and_repaint_does_not(pipeline):
    mask = torch.zeros(1, *pipeline.lvae.latent_shape)
    mask[..., :4] = 1

    def run_inpainting(resampling, scaling):
        pipeline.register_to_config(noise_scaling=scaling)
        made = pipeline.inpaint_latents(InpaintCondition(torch.ones_like(mask), mask), ["low"], 0, [0], resampling)
        pipeline.register_to_config(noise_scaling=1.0)
        return made

    assert torch.equal(run_inpainting(QUICK, 1.0), run_inpainting(QUICK, 1.01))
    assert not torch.equal(run_inpainting(RePaintConfig.guided(6), 1.0), run_inpainting(RePaintConfig.guided(6), 1.01))
    assert RePaintConfig.guided().num_evaluations == 50
    with pytest.raises(ValueError, match="eta is 2, expected a number from 0"):
        RePaintConfig(eta=2)


def test_noise_scaling_corrects_overestimated_noise():
    """For Gaussian data, the exact noise is known.

    If a model overestimates the noise by 1 %, the standard deviation of the samples is too small.
    """
    alpha_bar = torch.from_numpy(Diffusion().alpha_bar).float()

    def model(excess):
        def predict(latent, timestep, label):
            a = alpha_bar[timestep][:, None, None, None]
            return excess * (1 - a).sqrt() * latent / (a * 0.25 + 1 - a)

        return predict

    solver, label = build_sampler("dpm++"), torch.zeros(64, dtype=torch.long)

    def compute_deviation(denoiser):
        solver.set_timesteps(20)
        return float(
            sample_with_scheduler(denoiser, solver, SceneNoise(0, range(64), LATENT_SHAPE, "cpu"), label).std()
        )

    assert compute_deviation(model(1.01)) < 0.49
    assert abs(compute_deviation(scale_noise(model(1.01), 1.01)) - compute_deviation(model(1.0))) < 1e-6


# ------------------------------------------------------------------------------------------------------ conventions


def test_pipeline_draws_seeds_from_generator(pipeline):
    def generate(**options):
        return pipeline.generate(["low", "high"], num_inference_steps=4, **options)

    def make_generator(seed):
        return torch.Generator().manual_seed(seed)

    one, again, other = (generate(generator=make_generator(seed)) for seed in (7, 7, 8))
    assert [s.scene_id for s in one] == [s.scene_id for s in again] != [s.scene_id for s in other]
    assert scenes_equal(one[0], again[0]) and not scenes_equal(one[0], other[0])
    each = generate(generator=[make_generator(7), make_generator(8)])
    assert [s.scene_id for s in each] == [one[0].scene_id, other[1].scene_id]
    assert scenes_equal(each[0], one[0]) and scenes_equal(each[1], other[1])
    with pytest.raises(ValueError, match="3 generators for 2 scenes: expected one, or one per scene"):
        generate(generator=[make_generator(0)] * 3)


def test_pipeline_callback_sees_steps_and_may_change_latents(pipeline):
    seen = []

    def watch(pipe, step, timestep, inputs):
        seen.append((step, timestep))
        return inputs

    def erase(pipe, step, timestep, inputs):
        return {"latents": torch.zeros_like(inputs["latents"])}

    pipeline.sample_latents(["low"], 0, [0], 5, callback_on_step_end=watch)
    assert seen == [(0, 800), (1, 600), (2, 400), (3, 200), (4, 0)]
    assert not pipeline.sample_latents(["low"], 0, [0], 5, callback_on_step_end=erase).any()
    seen.clear()
    whole = np.ones((32, 32), bool)
    pipeline.inpaint([random_scene(0, grid=SPEC.grid)], [whole], ["low"], repaint=QUICK, callback_on_step_end=watch)
    assert [step for step, _ in seen] == list(range(10))  # 6 steps, and two jumps of 2 steps back


# ------------------------------------------------------------------------------------------------------- inpainting


def test_polygon_region_equals_shapely():
    grid = Grid(rows=64, cols=64, resolution_m=1.0)
    x, y = np.meshgrid(grid.x_m(), grid.y_m(), indexing="ij")
    for corners in ([(10, -20), (50, 0), (30, 25)], [(5, -30), (60, -30), (20, 0), (60, 30), (5, 30)]):
        want = shapely.contains_xy(shapely.Polygon(corners), x, y)
        assert np.array_equal(select_polygon(grid, corners), want) and 0.05 < want.mean() < 0.9
        assert np.array_equal(select_polygon(grid, corners[::-1]), want)
    for bad in ([(0, 0), (1, 1)], [(0, 0), (1, np.nan), (2, 2)], [1, 2, 3]):
        with pytest.raises(ValueError, match="three or more corners"):
            select_polygon(grid, bad)


def test_half_plane_and_object_regions_contain_stated_pixels():
    grid = Grid(rows=64, cols=64, resolution_m=1.0)
    ahead = select_half_plane(grid, (2, 0), 40)
    assert np.array_equal(ahead, np.broadcast_to(grid.x_m()[:, None] >= 40, ahead.shape))
    assert not (ahead & select_half_plane(grid, (-1, 0), -39.9)).any()
    with pytest.raises(ValueError, match="length above 0"):
        select_half_plane(grid, (0, 0), 1)
    scene = random_scene(1, n=30, grid=grid)
    region = select_around_objects(scene, [4, 9], margin_m=0.5)
    for k in (4, 9):
        corners = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T * scene.size_m[k]
        rows, cols = grid.pixel(*(corners @ scene.rotation[k].T + scene.center_m[k])[:, :2].T)
        inside = (rows >= 0) & (rows < 64) & (cols >= 0) & (cols < 64)
        assert inside.any() and region[rows[inside], cols[inside]].all()
    assert region.mean() < 0.1
    with pytest.raises(IndexError):
        select_around_objects(scene, [30])


def test_region_grows_to_whole_cells():
    region = np.zeros((32, 32), bool)
    region[5, 30] = True
    assert np.argwhere(find_region_cells(region, 8)).tolist() == [[1, 7]]
    mask = make_latent_mask([region], (6, 8, 8), "objects")
    assert mask.sum() == 3 and mask[0, 3:, 1, 7].all()
    assert make_latent_mask([region], (6, 8, 8), "both").sum() == 6
    with pytest.raises(ValueError, match="does not divide into 5 x 5 latent cells"):
        find_region_cells(region, 5)
    with pytest.raises(ValueError, match="contents 'cars', expected one of: both, ground, objects"):
        make_latent_mask([region], (6, 8, 8), "cars")


@pytest.mark.parametrize("contents", ["both", "ground", "objects"])
def test_inpaint_keeps_known_region(pipeline, contents):
    scene = random_scene(2, n=30, grid=SPEC.grid)
    region = select_half_plane(SPEC.grid, (1, 0), 32.0)
    (made,) = pipeline.inpaint([scene], [region], ["high"], contents, seed=4, repaint=QUICK)
    (raw,) = pipeline.inpaint([scene], [region], ["high"], contents, seed=4, repaint=QUICK, composite=False)
    new_ground, new_objects = (contents in ("both", what) for what in ("ground", "objects"))
    bent = blend_ground(raw, scene, region)
    for name in ("height_m", "occupied"):
        got, kept, new = (getattr(s, name) for s in (made, scene, bent))
        assert np.array_equal(got[:, ~region], kept[:, ~region])
        assert np.array_equal(got[:, region], (new if new_ground else kept)[:, region])
    centers = {tuple(c) for c in made.center_m.tolist()}
    behind = {tuple(c) for c in scene.center_m.tolist() if c[0] < 32}
    lifted = bent if new_ground else raw
    ahead = {tuple(c) for c in (lifted if new_objects else scene).center_m.tolist() if c[0] >= 32}
    assert behind and centers == behind | ahead


def test_inpaint_decodes_given_ground_exactly(pipeline):
    """If the pipeline inpaints only objects, the ground decoder reads only known channels of the latent."""
    scene = random_scene(5, n=30, grid=SPEC.grid)
    whole = np.ones((32, 32), bool)
    (raw,) = pipeline.inpaint([scene], [whole], ["low"], "objects", repaint=QUICK, composite=False)
    (rebuilt,) = pipeline.decode(pipeline.encode([scene]), [scene])
    assert np.array_equal(raw.height_m, rebuilt.height_m) and np.array_equal(raw.occupied, rebuilt.occupied)
    assert not scenes_equal(raw, rebuilt)


def test_inpaint_returns_known_latent_exactly(pipeline):
    scene = random_scene(6, n=30, grid=SPEC.grid)
    known = pipeline.encode([scene])
    mask = make_latent_mask(
        [select_polygon(SPEC.grid, [(10, -20), (50, 0), (30, 25)])], pipeline.lvae.latent_shape, "both"
    )
    latents = pipeline.inpaint_latents(InpaintCondition(known, mask), ["low"], 0, [0], QUICK)
    kept = mask == 0
    assert torch.equal(latents[kept], known[kept]) and kept.any()
    assert (latents[~kept] != known[~kept]).all()


def test_inpaint_rejects_scenes_off_model_grid(pipeline):
    scene = random_scene(0, grid=replace(SPEC.grid, front_m=70.0))
    with pytest.raises(ValueError, match=r"scene test-0000 has .* the model needs"):
        pipeline.inpaint([scene], [np.ones((32, 32), bool)], ["low"])


def test_inpaint_rejects_objects_only_for_mixed_latent():
    architecture = LVAE_PRESETS["smoke"].architecture() | {"split_latent": False}
    lvae = LayoutVAE(layout=SPEC.to_dict(), **architecture)
    channels, size, _ = lvae.latent_shape
    mixed = PrITTIPipeline(lvae, DiT(channels=channels, size=size, width=32, depth=1, heads=2))
    with pytest.raises(ValueError, match="mixes ground and objects, so it cannot regenerate only objects"):
        mixed.inpaint([random_scene(0, grid=SPEC.grid)], [np.ones((32, 32), bool)], ["low"], "objects")


def test_inpaint_generates_around_kept_objects(pipeline):
    big, small = CATEGORY_INDEX["construction_big"], CATEGORY_INDEX["pole"]
    given = random_scene(5, n=30, grid=SPEC.grid)
    category = np.where(np.arange(30) < 4, big, np.where(np.arange(30) < 8, small, given.category))
    given = replace(given, category=category.astype(given.category.dtype))
    whole, keep = np.ones((32, 32), bool), ("construction_big",)
    (free,) = pipeline.inpaint([given], [whole], ["low"], "objects", repaint=QUICK)
    (made,) = pipeline.inpaint([given], [whole], ["low"], "objects", repaint=QUICK, keep=keep)
    kept = given.select(given.category == big)
    assert (free.category == big).any() and len(kept) >= 4
    assert np.array_equal(made.center_m[made.category == big], kept.center_m)
    pixels = select_kept_pixels(given, keep, 4)
    others = made.select(made.category != big)
    assert len(others) and not pixels[SPEC.grid.pixel(others.center_m[:, 0], others.center_m[:, 1])].any()
    assert pixels[SPEC.grid.pixel(kept.center_m[:, 0], kept.center_m[:, 1])].all()
    *_, last = inpaint_blocks(pipeline, given, whole, "low", "objects", repaint=QUICK, keep=keep)
    assert scenes_equal(last.canvases[0], made)
    with pytest.raises(ValueError, match="category 'tree', expected some of: "):
        pipeline.inpaint([given], [whole], ["low"], "objects", repaint=QUICK, keep=("tree",))


def test_kept_pixels_are_footprints_and_cells_of_centers():
    scene = random_scene(0, n=2, grid=SPEC.grid)  # Pixels of 2 m, cells of 4 pixels.
    scene = replace(
        scene,
        category=np.array([CATEGORY_INDEX["construction_big"], CATEGORY_INDEX["pole"]], scene.category.dtype),
        center_m=np.array([[16.0, 0.0, 2.0], [50.5, 20.5, 2.0]], np.float32),
        rotation=np.tile(np.eye(3, dtype=np.float32), (2, 1, 1)),
        size_m=np.array([[24.0, 12.0, 4.0], [0.2, 0.2, 4.0]], np.float32),
    )
    pixels = select_kept_pixels(scene, ("construction_big", "pole"), 4)
    x_m, y_m = SPEC.grid.x_m()[:, None], SPEC.grid.y_m()[None, :]
    footprint = (np.abs(x_m - 16) < 12) & (np.abs(y_m) < 6)
    of_center = (np.abs(x_m - 12) < 4) & (np.abs(y_m + 4) < 4) | (np.abs(x_m - 20) < 4) & (np.abs(y_m + 4) < 4)
    of_pole = (np.abs(x_m - 52) < 4) & (np.abs(y_m - 20) < 4)
    assert (pixels[footprint | of_pole]).all() and not (pixels & ~(footprint | of_center | of_pole)).any()
    mask = make_latent_mask([np.ones((32, 32), bool)], (6, 8, 8), "both", [footprint | of_pole])
    known = mask[0] == 0  # Cells of 8 m that lie inside of the footprint, and that of the pole.
    assert not known[:3].any() and known[3:].sum() == 3 * (np.sum(footprint.reshape(8, 4, 8, 4).all(axis=(1, 3))) + 1)


def test_composite_of_empty_region_keeps_scene():
    scene, other = random_scene(0, n=20, grid=SPEC.grid), random_scene(1, n=20, grid=SPEC.grid)
    nothing, everything = np.zeros((32, 32), bool), np.ones((32, 32), bool)
    assert scenes_equal(composite_scenes(scene, other, nothing, "both"), scene)
    assert scenes_equal(composite_scenes(scene, other, everything, "both"), other)
    both = composite_scenes(composite_scenes(scene, other, everything, "ground"), other, everything, "objects")
    assert scenes_equal(both, other)


def test_composite_does_not_repeat_object_across_border():
    scene = random_scene(0, n=1, grid=SPEC.grid)
    region = select_half_plane(SPEC.grid, (1, 0), 32.0)
    scene = replace(scene, center_m=np.array([[31.95, 0, 0]], np.float32))
    again = replace(scene, center_m=np.array([[32.05, 0, 0]], np.float32))
    far = replace(scene, center_m=np.array([[50, 0, 0]], np.float32))
    for contents in ("both", "objects"):
        assert np.array_equal(composite_scenes(scene, again, region, contents).center_m, scene.center_m)
        assert len(composite_scenes(scene, far, region, contents)) == 2


def test_one_noise_schedule_for_training_sampling_and_scheduler(tmp_path):
    """The DiT defines the schedule; a pipeline refuses a scheduler with another one."""
    other = Diffusion(1000, 0.0001, 0.02)
    torch.manual_seed(0)
    dit = DiT(channels=8, size=8, width=32, depth=1, heads=2, prediction="v_prediction", schedule=other)
    lvae = LayoutVAE(layout=small_spec().to_dict(), **LVAE_PRESETS["smoke"].architecture())
    pipeline = PrITTIPipeline(lvae, dit)
    assert pipeline.diffusion == other and pipeline.scheduler.config.beta_end == 0.02
    assert torch.allclose(dit.noise_shares[:, 1].square().double(), torch.from_numpy(other.alpha_bar), atol=1e-6)
    pipeline.save_pretrained(tmp_path)
    assert PrITTIPipeline.from_pretrained(tmp_path).diffusion == other
    with pytest.raises(ValueError, match=r"beta_start is 0\.0015, but the DiT was trained with 0\.0001"):
        pipeline.scheduler = SchedulerConfig.ddpm()
    with pytest.raises(ValueError, match=r"beta_start is 0\.00085"):
        pipeline.scheduler = DPMSolverMultistepScheduler(beta_start=0.00085, beta_schedule="scaled_linear")
    pipeline.use_sampler("dpm++")
    assert pipeline.scheduler.config.beta_end == 0.02

    seen = []  # training adds the noise of the same schedule
    loss = make_diffusion_loss(dit, 0.0)
    mean = torch.full((1, 8, 8, 8), 3.0)
    arrays = {"mean": mean, "logvar": torch.full_like(mean, -60.0), "label": torch.zeros(1, dtype=torch.long)}

    def model(noisy, timestep, label):
        seen.append((noisy.mean().item(), timestep.item()))
        return noisy

    for seed in range(5):
        loss(model, arrays, [torch.Generator().manual_seed(seed)])
    for value, timestep in seen:
        assert abs(value - 3 * other.alpha_bar[timestep] ** 0.5) < 0.2


def test_studio_uses_eta_of_guided_options():
    from pipelines.studio.requests import RepaintRequest

    guided = RePaintConfig.guided(20)
    assert RepaintRequest().repaint(trained=False) == replace(guided, jump_length=1)
    assert RepaintRequest().repaint(trained=True) == TrainedInpainting(20)
    assert RepaintRequest(eta=0.5).repaint(trained=True) == replace(guided, jump_length=1, eta=0.5)
