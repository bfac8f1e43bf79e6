"""Tests of XCube: networks, losses, sampler, and the pipeline with tiny networks."""

from collections.abc import Callable
from functools import partial

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from models.base import ConfiguredModel, SkipInitialValues
from models.baselines.base import coarsen_grids, repeat_grids
from models.baselines.sparse import Sites
from models.baselines.unet3d import UNet3D
from models.baselines.xcube import PRESETS, Pipeline
from models.baselines.xcube import pipeline as xcube_pipeline
from models.baselines.xcube.diffusion import XCUBE_SCHEDULE, CoarseDiffusion, FineDiffusion, sample_latents
from models.baselines.xcube.losses import (
    COARSE,
    COARSE_DIFFUSION,
    COARSE_VAE,
    FINE_DIFFUSION,
    FINE_VAE,
    crop_grids,
    encode_scenes,
    make_coarse_diffusion_loss,
    make_fine_diffusion_loss,
    make_vae_loss,
    measure_latents,
)
from models.baselines.xcube.vae import VoxelVAE, mean_per_scene
from models.sampling.diffusion import SamplingSchedule
from models.training import OptimizerConfig, Trainer
from models.voxel_grids import EMPTY, FINE, NUM_CLASSES

SHAPE = (32, 32, 8)  # Of the tiny pipeline; its coarse level has 8 x 8 x 2 voxels, and coarse latents 4 x 4 x 1.
PAPER_PARAMETERS = {
    COARSE_VAE: 40_393_209,
    FINE_VAE: 2_500_817,
    COARSE_DIFFUSION: 638_198_600,
    FINE_DIFFUSION: 37_376_520,
}


def make_generators(*seeds: int) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in seeds]


def make_scenes(count: int, shape: tuple[int, int, int]) -> Tensor:
    """Return scenes of ground of two classes with boxes of four classes."""
    generator = torch.Generator().manual_seed(0)
    scenes = torch.zeros(count, *shape, dtype=torch.uint8)
    scenes[..., 0] = 1
    scenes[:, :, shape[1] // 3 : 2 * shape[1] // 3, 0] = 2
    for scene in scenes:
        for box in range(6):
            row, col = (int(torch.randint(0, side - 3, (1,), generator=generator)) for side in shape[:2])
            height, side = (int(torch.randint(2, n, (1,), generator=generator)) for n in (shape[2] + 1, 6))
            scene[row : row + side, col : col + side, :height] = 3 + box % 4
    return scenes


def compute_mean_iou(voxels: Tensor, expected: Tensor) -> float:
    classes = [c for c in expected.unique().tolist() if c != EMPTY]
    both = [((voxels == c) & (expected == c)).sum() / ((voxels == c) | (expected == c)).sum() for c in classes]
    return float(torch.stack(both).mean())


@torch.no_grad()
def randomize(network: ConfiguredModel, seed: int = 0, spread: float = 0.2) -> ConfiguredModel:
    """Replace weights, because the initial networks ignore parts of their inputs."""
    generator = torch.Generator().manual_seed(seed)
    for parameter in network.parameters():
        parameter.copy_(torch.randn(parameter.shape, generator=generator) * spread)
    return network


def make_networks(**changes: ConfiguredModel) -> dict[str, ConfiguredModel]:
    networks = {
        COARSE_VAE: VoxelVAE((4, 8), latent_channels=3),
        FINE_VAE: VoxelVAE((4, 4, 8), latent_channels=3, condition_channels=4),
        COARSE_DIFFUSION: CoarseDiffusion(3, 8, (1, 2), 1, (1,), (4, 4, 1), 1.5, sampling_steps=4),
        FINE_DIFFUSION: FineDiffusion(3, 8, (1, 2), 1, 4, scale=0.7, sampling_steps=4),
    }
    return {name: randomize(network, k) for k, (name, network) in enumerate((networks | changes).items())}


@pytest.fixture(scope="module")
def pipeline() -> Pipeline:
    return Pipeline(make_networks())


def make_arrays(fine: Tensor) -> dict[str, Tensor]:
    return {"voxels": fine, "voxels_4x4x4": coarsen_grids(fine, COARSE)}


# Presets and configs


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_have_four_stages(preset):
    stages = PRESETS[preset]
    assert [stage.name for stage in stages] == list(PAPER_PARAMETERS)
    assert [stage.factors for stage in stages] == [(COARSE,), (COARSE, FINE)] * 2
    assert [stage.needs for stage in stages] == [(), (), (COARSE_VAE,), (FINE_VAE,)]
    with torch.device("meta"), SkipInitialValues():
        Pipeline({stage.name: stage.model.from_config(stage.architecture) for stage in stages})


def test_paper_preset_has_the_published_sizes():
    stages = {stage.name: stage for stage in PRESETS["paper"]}
    with torch.device("meta"), SkipInitialValues():
        models = {name: stage.model(**stage.architecture) for name, stage in stages.items()}
    assert {name: model.num_parameters() for name, model in models.items()} == PAPER_PARAMETERS
    assert models[COARSE_VAE].config.widths == (64, 128, 256, 512) and models[FINE_VAE].config.widths == (32, 64, 128)
    assert [models[name].config.kl_weight for name in (COARSE_VAE, FINE_VAE)] == [0.03, 0.3]
    assert Pipeline(models).shape == (256, 256, 32) and models[COARSE_DIFFUSION].config.shape == (8, 8, 1)
    for name in (COARSE_VAE, FINE_VAE):
        options, samples = stages[name].optimizer, stages[name].batch_size
        assert options.amsgrad and options.grad_clip == 0.5 and options.at(0)[0] == 1e-4
        assert options.at(100_000 // samples)[0] == pytest.approx(1e-4 * 0.7**2)
    for name in (COARSE_DIFFUSION, FINE_DIFFUSION):
        options = stages[name].optimizer
        assert (options.learning_rate, options.ema_decay, models[name].config.sampling_steps) == (5e-5, 0.9999, 100)


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        (VoxelVAE, {"widths": (8,)}, "widths is \\(8,\\), expected a list of 2 to 8 entries"),
        (VoxelVAE, {"widths": (8, 0)}, "widths\\[1\\] is 0"),
        (VoxelVAE, {"kl_weight": -1.0}, "kl_weight is -1.0"),
        (VoxelVAE, {"num_classes": 1}, "num_classes is 1, expected an integer from 2 to 256"),
        (VoxelVAE, {"levels": 3}, "no option levels"),
        (CoarseDiffusion, {"shape": (8, 8)}, "shape is"),
        (CoarseDiffusion, {"attention": (4,)}, "attention contains level 4, expected levels below 4"),
        (CoarseDiffusion, {"width": 20}, "level 2 has 80 channels, expected a multiple of 32"),
        (CoarseDiffusion, {"sampling_steps": 600}, "num_inference_steps is 600"),
        (CoarseDiffusion, {"scale": 0.0}, "scale is 0.0"),
        (FineDiffusion, {"multipliers": ()}, "multipliers is"),
        (FineDiffusion, {"condition_channels": 0}, "condition_channels is 0"),
        (FineDiffusion, {"schedule": {"beta_start": 2.0}}, "schedule.beta_start is 2.0"),
    ],
)
def test_wrong_configs_give_clear_errors(kind, change, message):
    with torch.device("meta"), SkipInitialValues(), pytest.raises(ValueError, match=f"{kind.__name__}.*{message}"):
        kind.from_config(change)


def test_networks_are_equal_after_save_and_load(tmp_path, pipeline):
    for name, network in pipeline.networks.items():
        network.save_pretrained(tmp_path / name)
    loaded = Pipeline({name: type(n).from_pretrained(tmp_path / name) for name, n in pipeline.networks.items()})
    (first, again) = (p.sample(make_generators(3)) for p in (pipeline, loaded))
    assert torch.equal(first[FINE], again[FINE])


# VAE


def test_mean_per_scene_equals_brute_force():
    sites = Sites.from_mask(
        torch.rand(3, 4, 4, 4, generator=make_generators(0)[0]) < torch.tensor([0.5, 0, 0.9])[:, None, None, None]
    )
    values = torch.randn(len(sites))
    expected = [values[sites.scene == k].mean() if (sites.scene == k).any() else torch.tensor(0.0) for k in range(3)]
    torch.testing.assert_close(mean_per_scene(values, sites), torch.stack(expected))


def test_vae_losses_equal_a_loop_over_voxels():
    fine = make_scenes(2, (8, 8, 4))
    coarse = coarsen_grids(fine, COARSE).long()
    vae = VoxelVAE((4, 4, 8), latent_channels=3, condition_channels=4, kl_weight=0.3)
    randomize(vae)
    noise = torch.randn(2, 2, 2, 1, 3, generator=make_generators(0)[0])
    losses = vae(fine.long(), noise, coarse)
    for k in range(2):
        voxels, one = fine[k : k + 1].long(), coarse[k : k + 1]
        sites = vae.find_sites(voxels, one)
        posterior = vae.encode(voxels, sites)
        latent = posterior.mean + (posterior.logvar / 2).exp() * noise[k][one[0] != EMPTY]
        decoded = vae.decode(latent, sites[-1], one, sites)
        structure = torch.tensor(0.0)
        for logits, size in zip(decoded.structure, (4, 2), strict=True):
            occupied = F.max_pool3d((voxels != EMPTY).float(), size // 2)[0]
            parents, entropies = F.max_pool3d(occupied[None], 2)[0].nonzero().tolist(), []
            for of_parent, (row, col, level) in zip(logits, parents, strict=True):
                children = occupied[2 * row : 2 * row + 2, 2 * col : 2 * col + 2, 2 * level : 2 * level + 2]
                entropies.append(F.binary_cross_entropy(of_parent.sigmoid(), children.flatten()))
            structure = structure + torch.stack(entropies).mean()
        at = voxels[0].nonzero().tolist()
        probability = decoded.semantic.softmax(1)
        semantic = [-probability[n, int(voxels[0, r, c, z]) - 1].log() for n, (r, c, z) in enumerate(at)]
        prior = torch.distributions.Normal(0.0, 1.0)
        normal = torch.distributions.Normal(posterior.mean, (posterior.logvar / 2).exp())
        kl = torch.distributions.kl_divergence(normal, prior).sum(1).mean()
        expected = {"structure": structure, "semantic": torch.stack(semantic).mean(), "kl": kl}
        expected["loss"] = 20 * structure + 20 * expected["semantic"] + 0.3 * kl
        for name, value in expected.items():
            torch.testing.assert_close(losses[name][k], value, rtol=1e-4, atol=1e-5)


def test_decoder_prunes_by_the_predicted_structure():
    vae = VoxelVAE((4, 4, 8), latent_channels=3)
    randomize(vae)
    top = Sites.from_mask(torch.ones(1, 3, 2, 2, dtype=torch.bool))
    decoded = vae.decode(torch.randn(12, 3, generator=make_generators(1)[0]), top)
    kept = top
    for logits in decoded.structure:
        assert 0 < (logits > 0).float().mean() < 1
        kept = kept.refine(logits > 0)
    assert torch.equal(kept.coords, decoded.sites.coords)
    voxels = decoded.to_voxels()
    assert voxels.shape == (1, 12, 8, 8) and torch.equal(voxels != EMPTY, kept.mask)
    with torch.no_grad():
        for layer in vae.structure:
            layer.weight.zero_()  # pyright: ignore
            layer.bias.fill_(-1)  # pyright: ignore
    assert not vae.decode(torch.randn(12, 3), top).to_voxels().any()


def test_vae_rejects_grids_of_wrong_sizes():
    coarse, fine = VoxelVAE((4, 8)), VoxelVAE((4, 4, 8), condition_channels=4)
    voxels = torch.ones(1, 8, 8, 4, dtype=torch.long)
    with pytest.raises(ValueError, match="no whole number of blocks"):
        coarse.find_sites(voxels[:, :7], None)
    with pytest.raises(ValueError, match="got coarse None"):
        fine.find_sites(voxels, None)
    with pytest.raises(ValueError, match="has the size \\(1, 2, 1\\), expected \\(2, 2, 1\\)"):
        fine.find_sites(voxels, voxels[:, :1, :2, :1])


@torch.no_grad()
def reconstruct(vae: VoxelVAE, voxels: Tensor, coarse: Tensor | None, order: list[int] | None = None) -> Tensor:
    """Decode the posterior means of scenes, or those of scenes in another order."""
    mean, _, sites = encode_scenes(vae, voxels, coarse)
    latent = sites.to_dense(mean)[order or list(range(len(voxels)))][sites.coords.unbind(1)]
    return vae.decode(latent, sites, None if coarse is None else coarse.long()).to_voxels()


def train_vae(vae: VoxelVAE, arrays: dict[str, Tensor], is_fine: bool, most_steps: int) -> float:
    """Train until the mean IoU of the reconstructed scenes reaches 0.9, and return it."""
    settings = OptimizerConfig(most_steps, 5e-3, 0.01, amsgrad=True, grad_clip=0.5)
    trainer = Trainer(vae, make_vae_loss(vae, {}, [], is_fine), settings, torch.device("cpu"))
    scenes, coarse = arrays["voxels" if is_fine else "voxels_4x4x4"], arrays["voxels_4x4x4"] if is_fine else None
    score = 0.0
    while score < 0.9 and trainer.steps_done < most_steps:
        for _ in range(15):
            trainer.step(arrays, range(len(scenes)))
        score = compute_mean_iou(reconstruct(vae, scenes, coarse), scenes)
    return score


def test_coarse_vae_reconstructs_four_scenes():
    torch.manual_seed(0)
    vae, scenes = VoxelVAE((16, 32)), make_scenes(4, (12, 12, 4))
    assert train_vae(vae, {"voxels_4x4x4": scenes}, False, 300) >= 0.9
    assert compute_mean_iou(reconstruct(vae, scenes, None, [1, 2, 3, 0]), scenes) < 0.7


def make_equal_coarse_scenes() -> Tensor:
    """Return four scenes with equal coarse levels, so only the fine latents can tell them apart."""
    scenes = torch.ones(4, 8, 8, 4, dtype=torch.uint8)
    classes = torch.randint(0, 5, (4, 4, 4, 1), generator=make_generators(0)[0])
    scenes[..., 3:] = repeat_grids(classes, (2, 2, 1)).to(torch.uint8)
    return scenes


def test_fine_vae_reconstructs_four_scenes():
    torch.manual_seed(0)
    scenes = make_equal_coarse_scenes()
    arrays = make_arrays(scenes)
    coarse = arrays["voxels_4x4x4"]
    assert (coarse == 1).all()
    vae = VoxelVAE((16, 16, 32), condition_channels=8, kl_weight=0.3)
    assert train_vae(vae, arrays, True, 450) >= 0.9
    assert compute_mean_iou(reconstruct(vae, scenes, coarse, [1, 2, 3, 0]), scenes) < 0.6


@pytest.mark.slow
@pytest.mark.parametrize("is_fine", [False, True])
def test_vaes_of_the_town_preset_reconstruct_scenes(is_fine):
    torch.manual_seed(0)
    stage = PRESETS["town"][int(is_fine)]
    scenes = make_scenes(4, (32, 32, 32) if is_fine else (32, 32, 8))
    arrays = make_arrays(scenes) if is_fine else {"voxels_4x4x4": scenes}
    vae = stage.model(**stage.architecture)
    assert isinstance(vae, VoxelVAE)
    assert train_vae(vae, arrays, is_fine, 150) >= 0.9


# Diffusion


def test_velocity_identities():
    network = FineDiffusion(3, 8, (1,), 1)
    timestep = torch.tensor([0, 1, 500, 998, 999])
    alpha_bar = torch.from_numpy(XCUBE_SCHEDULE.alpha_bar)[timestep]
    for shape in ((5, 3), (5, 3, 2, 2, 1)):
        clean, noise = torch.randn(shape), torch.randn(shape)
        noisy, velocity = network.noise_and_velocity(clean, noise, timestep)
        signal, spread = (
            value.float().view(5, *(1,) * (len(shape) - 1)) for value in (alpha_bar.sqrt(), (1 - alpha_bar).sqrt())
        )
        torch.testing.assert_close(noisy, signal * clean + spread * noise)
        torch.testing.assert_close(velocity, signal * noise - spread * clean)
        torch.testing.assert_close(signal * noisy - spread * velocity, clean)
        torch.testing.assert_close(signal * velocity + spread * noisy, noise)


def make_gaussian_velocity(mean: float, deviation: float) -> Callable[[Tensor, int], Tensor]:
    """Return the best prediction of v for data from a normal distribution."""

    def predict(latent: Tensor, timestep: int) -> Tensor:
        alpha_bar = float(XCUBE_SCHEDULE.alpha_bar[timestep])
        variance = alpha_bar * deviation**2 + 1 - alpha_bar
        clean = mean + alpha_bar**0.5 * deviation**2 / variance * (latent - alpha_bar**0.5 * mean)
        noise = (latent - alpha_bar**0.5 * clean) / (1 - alpha_bar) ** 0.5
        return alpha_bar**0.5 * noise - (1 - alpha_bar) ** 0.5 * clean

    return predict


@pytest.mark.parametrize(("mean", "deviation"), [(1.5, 0.4), (-0.3, 1.0), (0.0, 2.0)])
def test_sampler_has_the_moments_of_gaussian_data(mean, deviation):
    schedule, (generator,) = CoarseDiffusion(8, 8, (1,), 1, ()).make_sampling_schedule(), make_generators(0)
    assert (len(schedule), schedule.eta) == (100, 0.0)
    draw = partial(torch.randn, 50_000, generator=generator)
    latent = sample_latents(make_gaussian_velocity(mean, deviation), schedule, draw)
    assert float(latent.mean()) == pytest.approx(mean, abs=0.02)
    assert float(latent.std()) == pytest.approx(deviation, rel=0.04)


def test_sampler_renoises_and_keeps_known_latents():
    schedule, (generator,) = SamplingSchedule(XCUBE_SCHEDULE, 20, 0.0), make_generators(0)
    known, unknown = torch.full((20_000, 2), 3.0), torch.arange(2) == 0
    seen = {}

    def predict(latent: Tensor, timestep: int) -> Tensor:
        seen[timestep] = latent[:, 1]
        return make_gaussian_velocity(0.0, 1.0)(latent, timestep)

    latent = sample_latents(predict, schedule, partial(torch.randn, 20_000, 2, generator=generator), known, unknown)
    assert torch.equal(latent[:, 1], known[:, 1]) and latent[:, 0].mean().abs() < 0.1
    first, *later = seen
    assert first == 950 and len(later) == 19
    for timestep in later:
        alpha_bar = float(XCUBE_SCHEDULE.alpha_bar[timestep])
        assert float(seen[timestep].mean()) == pytest.approx(3 * alpha_bar**0.5, abs=0.03)
        assert float(seen[timestep].std()) == pytest.approx((1 - alpha_bar) ** 0.5, rel=0.03)


@pytest.mark.parametrize("shape", [(4, 4, 1), (5, 3, 2)])
def test_unet_keeps_shapes_and_reads_all_inputs(shape):
    torch.manual_seed(0)
    unet = UNet3D(2, 3, 8, (1, 2, 2), 1, (1,))
    with torch.no_grad():
        for parameter in unet.parameters():
            parameter.normal_(0, 0.3)
    x = torch.randn(2, 2, *shape, requires_grad=True)
    y = unet(x, torch.tensor([1, 900]))
    assert unet(x[:1, :, :1, :1, :1], torch.tensor([1])).shape == (1, 3, 1, 1, 1)
    assert y.shape == (2, 3, *shape)
    (grad,) = torch.autograd.grad(y[0, :, 0, 0, 0].sum(), x)
    assert grad[0].all() and not grad[1].any()
    assert not torch.allclose(unet(x, torch.tensor([2, 900]))[0], y[0], atol=1e-4)


def test_fine_diffusion_reads_condition_and_timestep():
    network = randomize(FineDiffusion(3, 8, (1, 2), 1, 4))
    assert isinstance(network, FineDiffusion)
    sites = network.find_sites(Sites.from_mask(torch.rand(2, 4, 4, 3, generator=make_generators(0)[0]) < 0.5))
    latent, classes = torch.randn(len(sites[0]), 3), torch.ones(len(sites[0]), dtype=torch.long)
    first = network(latent, torch.tensor([5, 5]), classes, sites)
    of_second = sites[0].scene == 1
    for other in (
        network(latent, torch.tensor([5, 900]), classes, sites),
        network(latent, torch.tensor([5, 5]), classes + of_second, sites),
    ):
        torch.testing.assert_close(other[~of_second], first[~of_second])
        assert ((other - first)[of_second].abs().amax(1) > 1e-4).all()


# Losses


def list_losses(networks: dict[str, ConfiguredModel], crop: int = 0):
    return {
        COARSE_VAE: make_vae_loss(networks[COARSE_VAE], {}, [], False),
        FINE_VAE: make_vae_loss(networks[FINE_VAE], {}, [], True, crop),
        COARSE_DIFFUSION: make_coarse_diffusion_loss(networks[COARSE_DIFFUSION], networks, []),
        FINE_DIFFUSION: make_fine_diffusion_loss(networks[FINE_DIFFUSION], networks, [], crop),
    }


@pytest.mark.parametrize("stage", PAPER_PARAMETERS)
def test_losses_depend_only_on_the_generator_of_samples(stage):
    networks = make_networks()
    loss, arrays = list_losses(networks, 4)[stage], make_arrays(make_scenes(3, SHAPE))
    arrays = {name: value[[0, 1, 2]] for name, value in arrays.items()}
    arrays["voxels"][1], arrays["voxels_4x4x4"][1] = EMPTY, EMPTY
    together = loss(networks[stage], arrays, make_generators(5, 6, 7))
    apart = [
        loss(networks[stage], {name: value[k : k + 1] for name, value in arrays.items()}, make_generators(5 + k))
        for k in range(3)
    ]
    for name, value in together.items():
        torch.testing.assert_close(value, torch.stack([one[name] for one in apart]).mean(), rtol=1e-4, atol=1e-5)
    other = loss(networks[stage], arrays, make_generators(5, 6, 8))
    assert not torch.equal(other["loss"], together["loss"])


@pytest.mark.parametrize("empty", [False, True])
@pytest.mark.parametrize("stage", PAPER_PARAMETERS)
def test_all_parameters_get_finite_gradients(stage, empty):
    networks = make_networks()
    scenes = torch.zeros(2, *SHAPE, dtype=torch.uint8) if empty else make_scenes(2, SHAPE)
    losses = list_losses(networks)[stage](networks[stage], make_arrays(scenes), make_generators(0, 1))
    losses["loss"].backward()
    grads = {name: parameter.grad for name, parameter in networks[stage].named_parameters()}
    assert [name for name, grad in grads.items() if grad is None or not grad.isfinite().all()] == []
    assert empty or [name for name, grad in grads.items() if grad is not None and not grad.any()] == []
    others = [name for name, n in networks.items() if name != stage and any(p.grad is not None for p in n.parameters())]
    assert others == []


def find_velocity(latent: Tensor, clean: Tensor, alpha_bar: Tensor) -> Tensor:
    """Return v of noisy latents whose clean latents are known."""
    noise = (latent - alpha_bar.sqrt() * clean) / (1 - alpha_bar).sqrt()
    return alpha_bar.sqrt() * noise - (1 - alpha_bar).sqrt() * clean


@pytest.mark.parametrize("is_fine", [False, True])
def test_diffusion_losses_are_zero_for_the_true_velocity(is_fine):
    networks, arrays = make_networks(), make_arrays(make_scenes(2, SHAPE))
    coarse, vae = arrays["voxels_4x4x4"], networks[FINE_VAE if is_fine else COARSE_VAE]
    assert isinstance(vae, VoxelVAE)
    torch.nn.init.constant_(vae.moments[1].bias[3:], -30.0)  # pyright: ignore
    torch.nn.init.zeros_(vae.moments[1].weight[3:])  # pyright: ignore
    mean, _, sites = encode_scenes(vae, arrays["voxels"] if is_fine else coarse, coarse if is_fine else None)
    shares = torch.from_numpy(XCUBE_SCHEDULE.alpha_bar).float()

    def predict(scale: float, latent: Tensor, timestep: Tensor, *condition) -> Tensor:
        if is_fine:
            assert torch.equal(condition[0], coarse[coarse != EMPTY].long()) and len(condition[1]) == 2
            return find_velocity(latent, mean / scale, shares[timestep][sites.scene][:, None])
        clean = sites.to_dense(mean).movedim(-1, 1) / scale
        return find_velocity(latent, clean, shares[timestep].view(-1, 1, 1, 1, 1))

    loss = list_losses(networks)[FINE_DIFFUSION if is_fine else COARSE_DIFFUSION]
    scale = networks[FINE_DIFFUSION if is_fine else COARSE_DIFFUSION].config.scale
    assert scale != 1.0
    assert float(loss(partial(predict, scale), arrays, make_generators(0, 1))["loss"].detach()) < 1e-5
    assert float(loss(partial(predict, 1.0), arrays, make_generators(0, 1))["loss"].detach()) > 1e-4


@pytest.mark.parametrize("stage", PAPER_PARAMETERS)
def test_losses_in_bfloat16_are_near_float32(stage):
    networks, arrays = make_networks(), make_arrays(make_scenes(2, SHAPE))
    loss = list_losses(networks)[stage]
    expected = loss(networks[stage], arrays, make_generators(0, 1))["loss"]
    with torch.autocast("cpu", torch.bfloat16):
        result = loss(networks[stage], arrays, make_generators(0, 1))["loss"]
    result.backward()
    assert result.dtype == torch.float32
    torch.testing.assert_close(result, expected, rtol=0.05, atol=0)


def test_crops_of_both_levels_are_the_same_ground():
    fine = make_scenes(64, SHAPE)
    coarse, uniform = coarsen_grids(fine, COARSE), torch.rand(64, 2, generator=make_generators(0)[0])
    fine_crop, coarse_crop = crop_grids(fine, coarse, uniform, 3)
    assert fine_crop.shape == (64, 12, 12, 8) and torch.equal(coarsen_grids(fine_crop, COARSE), coarse_crop)
    places = set()
    for k, (u, v) in enumerate(uniform.tolist()):
        row, col = int(u * 6), int(v * 6)
        places.add((row, col))
        assert torch.equal(coarse_crop[k], coarse[k, row : row + 3, col : col + 3])
    assert len(places) > 20
    for crop in (0, 99):
        assert torch.equal(crop_grids(fine, coarse, uniform, crop)[0], fine)


@pytest.mark.parametrize("is_fine", [False, True])
def test_measured_scale_is_the_deviation_of_latents(is_fine):
    networks, arrays = make_networks(), make_arrays(make_scenes(3, SHAPE))
    measured = measure_latents(networks, arrays, is_fine)
    voxels, coarse = arrays["voxels"].long(), arrays["voxels_4x4x4"].long()
    vae = networks[FINE_VAE if is_fine else COARSE_VAE]
    assert isinstance(vae, VoxelVAE)
    levels = (voxels, coarse) if is_fine else (coarse, None)
    posterior = vae.encode(levels[0], vae.find_sites(*levels))
    latents = [posterior.mean + (posterior.logvar / 2).exp() * torch.randn(posterior.mean.shape) for _ in range(200)]
    assert measured.pop("scale") == pytest.approx(float(torch.stack(latents).detach().std()), rel=0.02)
    assert measured == ({} if is_fine else {"shape": (4, 4, 1)})
    empty = measure_latents(networks, make_arrays(torch.zeros(1, *SHAPE, dtype=torch.uint8)), is_fine)
    assert 1e-6 <= empty["scale"] <= 1e6


def test_smoke_preset_trains_and_generates():
    arrays, networks = make_arrays(make_scenes(2, (64, 64, 32))), {}
    for stage in PRESETS["smoke"]:
        measured = stage.measure(networks, arrays) if stage.measure else {}
        network = stage.model.from_config(stage.architecture | measured)
        trainer = Trainer(network, stage.make_loss(network, networks, []), stage.optimizer, torch.device("cpu"))
        for _ in range(2):
            trainer.step(arrays, range(stage.batch_size))
        networks[stage.name] = trainer.ema_model().eval()
    trained = Pipeline(networks)
    assert trained.shape == (64, 64, 32)
    assert {f: grid.shape for f, grid in trained.sample(make_generators(0)).items()} == {
        COARSE: (1, 16, 16, 8),
        FINE: (1, 64, 64, 32),
    }


# Pipeline


def test_scenes_depend_only_on_their_generators(pipeline):
    both = pipeline.sample(make_generators(1, 2))
    for k, seed in enumerate((1, 2)):
        alone = pipeline.sample(make_generators(seed))
        assert list(alone) == [COARSE, FINE] == list(pipeline.factors)
        for factor, grids in alone.items():
            assert grids.dtype == torch.uint8 and torch.equal(grids[0], both[factor][k])
    assert both[FINE].shape == (2, *SHAPE) and 0 < (both[FINE] != EMPTY).float().mean() < 1
    assert both[FINE].max() < NUM_CLASSES and not torch.equal(both[FINE][0], both[FINE][1])
    outside = repeat_grids(both[COARSE], COARSE) == EMPTY
    assert outside.any() and not both[FINE][outside].any()


def test_perfect_denoisers_generate_the_encoded_scenes(monkeypatch):
    """With denoisers that know the clean latents, both levels are those of the VAEs."""
    pipeline, voxels = Pipeline(make_networks()), make_scenes(2, SHAPE)
    shares = torch.from_numpy(XCUBE_SCHEDULE.alpha_bar).float()
    coarse = pipeline.reconstruct(voxels)[COARSE]
    mean, _, sites = encode_scenes(pipeline.coarse_vae, coarsen_grids(voxels, COARSE), None)
    dense = sites.to_dense(mean).movedim(-1, 1) / pipeline.coarse_diffusion.config.scale
    fine_latent = torch.randn(int((coarse != EMPTY).sum()), 3, generator=make_generators(3)[0])

    def predict_coarse(latent: Tensor, timestep: Tensor) -> Tensor:
        return find_velocity(latent, dense, shares[timestep].view(-1, 1, 1, 1, 1))

    def predict_fine(latent: Tensor, timestep: Tensor, classes: Tensor, sites: list[Sites]) -> Tensor:
        assert torch.equal(classes, coarse[coarse != EMPTY].long())
        clean = fine_latent / pipeline.fine_diffusion.config.scale
        return find_velocity(latent, clean, shares[timestep][sites[0].scene][:, None])

    monkeypatch.setattr(pipeline.coarse_diffusion, "forward", predict_coarse)
    monkeypatch.setattr(pipeline.fine_diffusion, "forward", predict_fine)
    grids = pipeline.sample(make_generators(0, 1))
    assert torch.equal(grids[COARSE], coarse)
    expected = pipeline.fine_vae.decode(fine_latent, Sites.from_mask(coarse != EMPTY), coarse.long()).to_voxels()
    assert expected.any() and torch.equal(grids[FINE], expected)


def test_inpaint_keeps_known_columns(pipeline):
    voxels, unknown = make_scenes(2, SHAPE), torch.zeros(2, *SHAPE[:2], dtype=torch.bool)
    unknown[0, 13:, :], unknown[1, :9, 5:30] = True, True  # The borders cut coarse voxels.
    result = pipeline.inpaint(voxels, unknown, make_generators(1, 2))
    assert torch.equal(result[~unknown], voxels[~unknown]) and result.dtype == torch.uint8
    assert not torch.equal(result[unknown], voxels[unknown]) and result[unknown].any()
    hidden = torch.where(unknown[..., None], 7, voxels)
    assert torch.equal(pipeline.inpaint(hidden, unknown, make_generators(1, 2)), result)
    for k in range(2):
        alone = pipeline.inpaint(voxels[k : k + 1], unknown[k : k + 1], make_generators(1 + k))
        assert torch.equal(alone[0], result[k])


def test_inpaint_conditions_both_levels_on_known_latents(monkeypatch):
    networks, voxels = make_networks(), make_scenes(1, SHAPE)
    unknown = torch.zeros(1, *SHAPE[:2], dtype=torch.bool)
    unknown[:, 13:, :8] = True  # The first coarse row of the unknown part has one known fine row.
    known = torch.where(unknown[..., None], EMPTY, voxels)
    coarse_known, conditions, levels = coarsen_grids(known, COARSE), [], []
    for layer in networks[COARSE_VAE].structure:  # pyright: ignore
        torch.nn.init.constant_(layer.bias, -100.0)
    pipeline = Pipeline(networks)
    sample_fine = pipeline._sample_fine

    def spy(*args):
        conditions.append(args[3:])
        return sample_latents(*args)

    def spy_fine(coarse: Tensor, *args) -> Tensor:
        levels.append(coarse)
        return sample_fine(coarse, *args)

    monkeypatch.setattr(xcube_pipeline, "sample_latents", spy)
    monkeypatch.setattr(pipeline, "_sample_fine", spy_fine)
    pipeline.inpaint(voxels, unknown, make_generators(0))
    assert torch.equal(levels[0], coarse_known)  # The generated coarse part is empty, but known content is kept.
    (latent, mask), (fine_latent, fine_mask) = conditions
    mean, _, sites = encode_scenes(pipeline.coarse_vae, coarse_known, None)
    torch.testing.assert_close(latent, sites.to_dense(mean) / 1.5)
    assert mask[0, ..., 0, 0].nonzero().tolist() == [[1, 0], [2, 0], [3, 0]]
    mean, _, sites = encode_scenes(pipeline.fine_vae, known, coarse_known)
    torch.testing.assert_close(fine_latent, mean / 0.7)
    assert torch.equal(fine_mask[:, 0], (sites.coords[:, 1] >= 3) & (sites.coords[:, 2] < 2))


def test_inpaint_reads_known_columns(pipeline):
    """Unknown columns next to known ground depend on it."""
    voxels, unknown = make_scenes(1, SHAPE), torch.zeros(1, *SHAPE[:2], dtype=torch.bool)
    unknown[:, 16:] = True
    first = pipeline.inpaint(voxels, unknown, make_generators(1))
    other = pipeline.inpaint(torch.full_like(voxels, 9), unknown, make_generators(1))
    assert not torch.equal(first[unknown], other[unknown])


def test_inpaint_without_known_or_unknown_columns(pipeline):
    voxels = make_scenes(1, SHAPE)
    nothing = torch.zeros(1, *SHAPE[:2], dtype=torch.bool)
    assert torch.equal(pipeline.inpaint(voxels, nothing, make_generators(1)), voxels)
    result = pipeline.inpaint(voxels, ~nothing, make_generators(1))
    assert torch.equal(result, pipeline.inpaint(torch.zeros_like(voxels), ~nothing, make_generators(1)))


def test_inpaint_rejects_scenes_of_other_sizes(pipeline):
    with pytest.raises(ValueError, match="expected scenes of \\(32, 32, 8\\)"):
        pipeline.inpaint(make_scenes(1, (16, 32, 8)), torch.ones(1, 16, 32, dtype=torch.bool), make_generators(1))


def test_outpaint_continues_scenes(pipeline):
    voxels = make_scenes(1, SHAPE)
    result = pipeline.outpaint(voxels, 3, 1, make_generators(4))
    assert result.shape == (1, 64, 32, 8) and torch.equal(result[:, 16:48], voxels)


def test_reconstruct_gives_both_levels(pipeline):
    voxels = make_scenes(2, SHAPE)
    levels = pipeline.reconstruct(voxels)
    assert levels[FINE].shape == voxels.shape
    assert levels[COARSE].shape == (2, 8, 8, 2)
    coarse = coarsen_grids(voxels, COARSE)
    assert torch.equal(levels[FINE], reconstruct(pipeline.fine_vae, voxels, coarse))
    assert torch.equal(levels[COARSE], reconstruct(pipeline.coarse_vae, coarse, None))
    assert torch.equal(pipeline.reconstruct(voxels[1:])[FINE][0], levels[FINE][1])


def test_empty_scenes_are_valid(pipeline):
    empty = torch.zeros(1, *SHAPE, dtype=torch.uint8)
    assert not pipeline.reconstruct(empty)[FINE].any()
    unknown = torch.zeros(1, *SHAPE[:2], dtype=torch.bool)
    unknown[:, :16] = True
    assert not pipeline.inpaint(empty, unknown, make_generators(1))[:, 16:].any()


@pytest.mark.parametrize(("bias", "is_full"), [(-100.0, False), (100.0, True)])
def test_empty_and_full_coarse_levels_give_valid_scenes(bias, is_full):
    networks = make_networks()
    for name in (COARSE_VAE, FINE_VAE):
        vae = networks[name]
        assert isinstance(vae, VoxelVAE)
        for layer in vae.structure:
            torch.nn.init.constant_(layer.bias, bias)  # pyright: ignore
    grids = Pipeline(networks).sample(make_generators(0, 1))
    assert all(bool((grid != EMPTY).all()) == is_full and bool(grid.any()) == is_full for grid in grids.values())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({COARSE_VAE: VoxelVAE((4, 8), latent_channels=5)}, "coarse_diffusion has 3 channels, expected .* 5"),
        ({FINE_VAE: VoxelVAE((4, 8), latent_channels=3, condition_channels=4)}, "expected three widths"),
        ({FINE_VAE: VoxelVAE((4, 4, 8), latent_channels=3)}, "expected three widths and a condition"),
        ({COARSE_VAE: VoxelVAE((4, 8), latent_channels=3, condition_channels=4)}, "coarse VAE has a condition"),
    ],
)
def test_pipeline_rejects_networks_that_do_not_fit(changes, message):
    with pytest.raises(ValueError, match=message):
        Pipeline(make_networks(**changes))


def test_pipeline_names_the_missing_stage():
    networks = make_networks()
    del networks[FINE_DIFFUSION]
    with pytest.raises(ValueError, match="network of the stage fine_diffusion is missing"):
        Pipeline(networks)
