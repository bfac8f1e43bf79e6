"""Tests of the noise schedule, samplers, RePaint and the trainer; some tests compare with diffusers and torch."""

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, DDPMScheduler, RePaintScheduler
from diffusers.training_utils import compute_snr
from helpers import LATENT_SHAPE

from models.dit import DiT
from models.sampling.diffusion import Diffusion, InpaintCondition, SamplingSchedule, SceneNoise, sample, with_guidance
from models.sampling.repaint import repaint_transitions
from models.sampling.schedulers import SchedulerConfig
from models.training import (
    DiffusionLossConfig,
    ExecutionConfig,
    NonFiniteLossError,
    OptimizerConfig,
    compute_loss_weight,
    make_diffusion_loss,
    make_dit_trainer,
)


def make_random_dit(seed: int = 0, **options) -> DiT:
    torch.manual_seed(seed)
    dit = DiT(channels=4, size=8, width=32, depth=2, heads=2, **options)
    for parameter in dit.parameters():
        torch.nn.init.normal_(parameter, std=0.05)
    return dit.eval()


@pytest.mark.parametrize("steps", [1000, 250, 50, 7])
def test_ddpm_step_equals_diffusers(steps):
    reference, schedule = SchedulerConfig.ddpm().build(), SamplingSchedule(Diffusion(), steps)
    reference.set_timesteps(steps)
    assert reference.timesteps.tolist() == schedule.timesteps[::-1].tolist()
    latent, predicted = torch.randn(2, *LATENT_SHAPE), torch.randn(2, *LATENT_SHAPE)
    for state, to in schedule.descending_transitions()[:: max(1, steps // 25)] + [(0, -1)]:
        assert to == state - 1
        t = int(schedule.timesteps[state])
        noise = torch.randn(2, *LATENT_SHAPE, generator=torch.Generator().manual_seed(state))
        want = reference.step(predicted, t, latent, generator=torch.Generator().manual_seed(state)).prev_sample
        assert torch.allclose(schedule.step_down(latent, predicted, noise, state), want, atol=2e-5), state
    assert schedule.timesteps[-1] == (996 if steps == 250 else schedule.timesteps[-1])


def test_ddpm_step_with_large_variance_equals_diffusers():
    small = SchedulerConfig.ddpm().build()
    reference = type(small).from_config(small.config, variance_type="fixed_large")
    schedule = SamplingSchedule(Diffusion(), 250, large_variance=True)
    reference.set_timesteps(250)
    latent, predicted = torch.randn(2, *LATENT_SHAPE), torch.randn(2, *LATENT_SHAPE)
    for state, _ in schedule.descending_transitions()[::25] + [(0, -1)]:
        t = int(schedule.timesteps[state])
        noise = torch.randn(2, *LATENT_SHAPE, generator=torch.Generator().manual_seed(state))
        want = reference.step(predicted, t, latent, generator=torch.Generator().manual_seed(state)).prev_sample
        assert torch.allclose(schedule.step_down(latent, predicted, noise, state), want, atol=2e-5), state


@pytest.mark.parametrize("eta", [0.0, 0.3, 1.0])
def test_ddim_step_equals_diffusers(eta):
    reference, schedule = (
        DDIMScheduler.from_config(SchedulerConfig.ddpm().config),
        SamplingSchedule(Diffusion(), 50, eta),
    )
    reference.set_timesteps(50)
    latent, predicted, noise = torch.randn(3, 2, *LATENT_SHAPE)
    for state, _ in schedule.descending_transitions()[:-1]:
        t = int(schedule.timesteps[state])
        want = reference.step(predicted, t, latent, eta=eta, variance_noise=noise if eta else None).prev_sample
        assert torch.allclose(schedule.step_down(latent, predicted, noise, state), want, atol=2e-5), state


def test_add_noise_equals_diffusers():
    clean, noise, t = torch.randn(3, *LATENT_SHAPE), torch.randn(3, *LATENT_SHAPE), torch.tensor([0, 500, 999])
    want = SchedulerConfig.ddpm().build().add_noise(clean, noise, t)
    assert torch.allclose(Diffusion().add_noise(clean, noise, t), want, atol=1e-5)
    schedule = SamplingSchedule(Diffusion(), 1000)
    for k, state in enumerate(t.tolist()):
        assert torch.allclose(schedule.noise_to_state(clean[k], noise[k], state), want[k], atol=1e-5)
    assert schedule.noise_to_state(clean, noise, -1) is clean


def test_add_noise_in_two_steps_has_variance_of_one():
    schedule = SamplingSchedule(Diffusion(), 250)
    for low, high in ((0, 10), (100, 110), (239, 249)):
        ratio = schedule.alpha_bar[high] / schedule.alpha_bar[low]
        assert np.isclose(ratio * (1 - schedule.alpha_bar[low]) + 1 - ratio, 1 - schedule.alpha_bar[high])
    zero, one = torch.zeros(1), torch.ones(1)
    assert torch.isclose(schedule.step_up(one, zero, 3, 9) ** 2 + schedule.step_up(zero, one, 3, 9) ** 2, one)


def test_velocity_converts_to_epsilon():
    """A DiT with v-prediction converts the velocity of diffusers to noise."""
    clean, noise, t = torch.randn(4, *LATENT_SHAPE), torch.randn(4, *LATENT_SHAPE), torch.tensor([0, 250, 600, 999])
    latent, velocity = (
        SchedulerConfig.ddpm().build().add_noise(clean, noise, t),
        SchedulerConfig.ddpm().build().get_velocity(clean, noise, t),
    )
    of_latent, of_velocity = (
        make_random_dit(prediction="v_prediction").noise_shares[t][:, :, None, None, None].unbind(1)
    )
    assert torch.allclose(of_latent * latent + of_velocity * velocity, noise, atol=1e-5)


def test_velocity_dit_equals_weighted_epsilon_dit():
    noise_dit, velocity_dit = make_random_dit(), make_random_dit(prediction="v_prediction")
    latent, t, label = torch.randn(4, *LATENT_SHAPE), torch.tensor([0, 250, 600, 999]), torch.tensor([0, 1, 2, 3])
    alpha_bar = torch.from_numpy(Diffusion().alpha_bar[t]).float()[:, None, None, None]
    velocity = noise_dit(latent, t, label)
    expected = (1 - alpha_bar).sqrt() * latent + alpha_bar.sqrt() * velocity
    assert torch.allclose(velocity_dit(latent, t, label), expected, atol=1e-6)
    assert torch.allclose(
        velocity_dit.precompute_conditioning(t.tolist(), [0, 1, 2, 3])(latent, t, label), expected, atol=1e-5
    )
    assert (noise_dit.loss_weight(t) == 1).all()
    other = torch.randn(4, *LATENT_SHAPE)  # the weighted error of epsilon equals the error of the velocity
    wrong = (1 - alpha_bar).sqrt() * latent + alpha_bar.sqrt() * other
    weighted = velocity_dit.loss_weight(t) * ((wrong - expected) ** 2).mean((1, 2, 3))
    assert torch.allclose(weighted, ((other - velocity) ** 2).mean((1, 2, 3)), rtol=1e-3)
    with pytest.raises(ValueError, match="'x0', expected one of: epsilon, v_prediction"):
        DiT(prediction="x0")


def test_sample_depends_only_on_seed_and_index():
    dit, schedule = make_random_dit(), SamplingSchedule(Diffusion(), 20)
    labels = torch.arange(8) % 3
    together = sample(dit, schedule, SceneNoise(5, range(8), LATENT_SHAPE, "cpu"), labels)
    alone = torch.cat(
        [sample(dit, schedule, SceneNoise(5, [i], LATENT_SHAPE, "cpu"), labels[i : i + 1]) for i in range(8)]
    )
    assert torch.allclose(together, alone, atol=1e-4)
    other = sample(dit, schedule, SceneNoise(6, range(8), LATENT_SHAPE, "cpu"), labels)
    assert (together - other).abs().mean() > 0.1
    assert (together[0] - together[1]).abs().mean() > 0.1


def test_guidance_at_scale_one_adds_no_evaluation():
    calls = []

    def model(latent, timestep, label):
        calls.append(len(latent))
        return latent * label[:, None, None, None].float()

    latent, label = torch.randn(2, *LATENT_SHAPE), torch.tensor([1, 2])
    plain = with_guidance(model, 3, 1.0)(latent, torch.zeros(2), label)
    assert calls == [2] and torch.equal(plain, model(latent, None, label))
    doubled = with_guidance(model, 3, 4.0)(latent, torch.zeros(2), label)
    assert torch.allclose(doubled, latent * (3 + 4 * (label[:, None, None, None] - 3.0)), atol=1e-5)


def test_repaint_timesteps_equal_diffusers():
    """The timesteps equal the timesteps of diffusers, which contains code by the RePaint authors."""
    reference = RePaintScheduler(num_train_timesteps=250)
    for jump, resamplings in ((10, 10), (5, 3), (10, 1), (1, 2)):
        reference.set_timesteps(250, jump_length=jump, jump_n_sample=resamplings)
        transitions = repaint_transitions(250, jump, resamplings)
        walked = [transitions[0][0]] + [to for _, to in transitions[:-1]]
        assert walked == reference.timesteps.tolist()
        assert transitions[-1] == (0, -1)
        assert all(a[1] == b[0] and abs(a[0] - a[1]) == 1 for a, b in zip(transitions, transitions[1:], strict=False))
    assert sum(to < state for state, to in repaint_transitions(250)) == 2410
    assert repaint_transitions(50, 10, 1) == SamplingSchedule(Diffusion(), 50).descending_transitions()
    with pytest.raises(ValueError, match="at least 1"):
        repaint_transitions(10, 0)


def test_repaint_returns_known_part_exactly():
    dit, schedule = make_random_dit(), SamplingSchedule(Diffusion(), 20)
    clean = torch.randn(2, *LATENT_SHAPE)
    mask = torch.zeros(2, *LATENT_SHAPE)
    mask[:, :, :4] = 1
    known = InpaintCondition(clean, mask)
    transitions = repaint_transitions(20, 4, 3)
    noise, label = SceneNoise(0, [0, 1], LATENT_SHAPE, "cpu"), torch.tensor([0, 1])
    out = sample(dit, schedule, noise, label, transitions, known)
    assert torch.equal(out[:, :, 4:], clean[:, :, 4:])
    assert (out[:, :, :4] - clean[:, :, :4]).abs().mean() > 0.1


def test_repaint_noises_known_part_to_reached_state():
    schedule, seen = SamplingSchedule(Diffusion(), 50), []

    def model(latent, timestep, label):
        seen.append((int(timestep[0]), float(latent[:, :, 4:].std())))
        return torch.zeros_like(latent)

    shape = (64, 8, 8)
    mask = torch.zeros(4, *shape)
    mask[:, :, :4] = 1
    sample(
        model,
        schedule,
        SceneNoise(0, range(4), shape, "cpu"),
        torch.zeros(4, dtype=torch.long),
        None,
        InpaintCondition(torch.zeros(4, *shape), mask),
    )
    for t, std in seen[1:]:
        assert np.isclose(std, (1 - Diffusion().alpha_bar[t]) ** 0.5, rtol=0.05)


def test_sampler_rejects_invalid_step_counts():
    with pytest.raises(ValueError, match="num_inference_steps is 0, expected 1 to 1000"):
        SamplingSchedule(Diffusion(), 0)
    with pytest.raises(
        ValueError, match="600: with a spacing of 1, sampling would begin at timestep 599 of 1000; expected 500 or 1000"
    ):
        SamplingSchedule(Diffusion(), 600)
    with pytest.raises(
        ValueError, match="334: with a spacing of 2, sampling would begin at timestep 666 of 1000; expected 333 or 500"
    ):
        SamplingSchedule(Diffusion(), 334)
    assert all(
        Diffusion().select_timesteps(steps)[-1] >= 850 for steps in (7, 10, 20, 25, 50, 100, 250, 300, 500, 1000)
    )


def make_dit_batch(n: int = 8) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    mean = torch.randn(n, *LATENT_SHAPE, generator=generator)
    return {"mean": mean, "logvar": torch.full_like(mean, -6.0), "label": torch.arange(n) % 3}


def make_trainer(execution: ExecutionConfig | None = None, prediction: str = "epsilon", **changes):
    torch.manual_seed(0)
    settings = OptimizerConfig(
        **({"steps": 300, "learning_rate": 2e-3, "weight_decay": 0.0, "ema_decay": 0.99} | changes)
    )
    dit = DiT(channels=4, size=8, width=64, depth=2, heads=2, prediction=prediction)
    return make_dit_trainer(dit, settings, 0.1, torch.device("cpu"), execution=execution)


@pytest.mark.parametrize("prediction", ["epsilon", "v_prediction"])
def test_dit_overfits_one_batch(prediction):
    trainer, batch = make_trainer(prediction=prediction), make_dit_batch(2)
    losses = [trainer.step(batch, range(2)) for _ in range(300)]
    assert np.mean([float(loss["loss"]) for loss in losses[:5]]) > 0.9
    assert np.mean([float(loss["noise_error"]) for loss in losses[-50:]]) < 0.35


def test_diffusion_loss_uses_means_of_posteriors():
    # With v-prediction, the noise estimate of an untrained network depends on the latents.
    trainer, batch = make_trainer(prediction="v_prediction"), make_dit_batch()
    wide = batch | {"logvar": torch.full_like(batch["logvar"], 2.0)}
    generators = [[torch.Generator().manual_seed(k) for k in range(8)] for _ in range(4)]
    mean_loss = make_diffusion_loss(trainer.model, 0.0, DiffusionLossConfig(sample_posterior=False))
    drawn_loss = make_diffusion_loss(trainer.model, 0.0)
    losses = [
        float(loss(trainer.model.eval(), arrays, generator)["loss"].detach())
        for (loss, arrays), generator in zip(
            [(mean_loss, batch), (mean_loss, wide), (drawn_loss, batch), (drawn_loss, wide)], generators, strict=True
        )
    ]
    assert losses[0] == losses[1]
    assert losses[2] != losses[3]


def test_trainer_resumes_exactly(tmp_path):
    batch = make_dit_batch()
    straight = make_trainer()
    curve = [float(straight.step(batch, range(8))["loss"]) for _ in range(8)]
    first = make_trainer()
    for _ in range(4):
        first.step(batch, range(8))
    first.save(tmp_path)
    second = make_trainer()
    second.load(tmp_path)
    assert [float(second.step(batch, range(8))["loss"]) for _ in range(4)] == curve[4:]
    for name, value in straight.model.state_dict().items():
        assert torch.equal(value, second.model.state_dict()[name]), name
    for name, value in straight.ema.items():
        assert torch.equal(value, second.ema[name]), name
    assert {p.suffix for p in tmp_path.iterdir()} == {".json", ".safetensors"}
    with pytest.raises(ValueError, match=r"was trained with learning_rate=0.002, asked for 0.1"):
        make_trainer(learning_rate=0.1).load(tmp_path)


def test_trainer_half_batches_have_losses_of_whole_batch():
    """Two workers with four samples each compute the same losses as one worker with eight samples."""
    batch = make_dit_batch()
    whole = float(make_trainer().step(batch, range(8))["loss"])
    halves = []
    for rank in range(2):
        here = slice(4 * rank, 4 * rank + 4)
        halves.append(float(make_trainer().step({k: v[here] for k, v in batch.items()}, range(8)[here])["loss"]))
    assert np.isclose(np.mean(halves), whole, rtol=1e-6)


@pytest.mark.parametrize("parts", [2, 3, 8])
def test_trainer_accumulated_parts_equal_whole_step(parts):
    batch = make_dit_batch()
    whole, cut = make_trainer(), make_trainer(execution=ExecutionConfig(accumulate=parts))
    for _ in range(3):
        losses = [trainer.step(batch, range(8)) for trainer in (whole, cut)]
    assert np.isclose(*(float(part["loss"]) for part in losses), rtol=1e-5)
    assert np.isclose(*(float(part["grad_norm"]) for part in losses), rtol=1e-4)
    for name, value in whole.model.state_dict().items():
        assert torch.allclose(value, cut.model.state_dict()[name], atol=2e-5), name


def test_trainer_in_bf16_computes_the_same_loss():
    batch = make_dit_batch()
    plain = float(make_trainer().step(batch, range(8))["loss"])
    half = make_trainer(execution=ExecutionConfig(precision="bf16"))
    assert np.isclose(float(half.step(batch, range(8))["loss"]), plain, rtol=2e-2)
    assert all(p.dtype == torch.float32 for p in half.model.parameters())
    with pytest.raises(ValueError, match="expected 1 or more, and auto, fp32 or bf16"):
        ExecutionConfig(precision="fp16")


def test_trainer_stops_at_nonfinite_loss_before_update():
    trainer, batch, calls = make_trainer(), make_dit_batch(), []
    before = {k: v.clone() for k, v in trainer.model.state_dict().items()}
    trainer.wrapped = lambda *inputs: calls.append(1) or trainer.model(*inputs)
    batch["mean"][3] = float("nan")
    with pytest.raises(NonFiniteLossError, match=r"step 0: the loss is not finite for samples \[11\]") as caught:
        trainer.step(batch, range(8, 16))
    assert (
        caught.value.positions == [11] and len(calls) == 1
    )  # The wrapped model would wait for other workers, so `find_nonfinite_samples` calls the inner model.
    batch["mean"][:] = float("nan")
    with pytest.raises(NonFiniteLossError, match="for all samples, because the weights are invalid"):
        trainer.step(batch, range(8))
    assert all(torch.equal(v, before[k]) for k, v in trainer.model.state_dict().items())


def test_trainer_drops_labels_of_a_tenth_of_samples():
    trainer, labels = make_trainer(), []
    real = trainer.wrapped.forward

    def record_labels(latent, timestep, label):
        labels.extend(label.tolist())
        return real(latent, timestep, label)

    trainer.wrapped.forward = record_labels
    batch = {name: value.repeat(16, *[1] * (value.ndim - 1)) for name, value in make_dit_batch().items()}
    for _ in range(8):
        trainer.step(batch, range(128))
    dropped = np.mean(np.array(labels) == trainer.model.null_label)
    assert len(labels) == 1024 and 0.06 < dropped < 0.14


def test_learning_rate_is_one_cycle_without_warm_up():
    """The learning rate equals that of torch's CosineAnnealingLR from 1e-4 to 1e-5, without warm-up."""
    settings = OptimizerConfig(100, 1e-4, 0.0, final_learning_rate=1e-5, cycle_momentum=(0.85, 0.95))
    rates, betas = zip(*(settings.at(k) for k in range(100)), strict=True)
    assert (
        np.isclose(rates[0], 1e-4)
        and np.isclose(rates[-1], 1e-5)
        and np.isclose(betas[0], 0.85)
        and np.isclose(betas[-1], 0.95)
    )
    optimiser = torch.optim.AdamW([torch.zeros(1, requires_grad=True)], 1e-4)
    reference = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, T_max=99, eta_min=1e-5)
    for rate in rates:
        assert np.isclose(rate, reference.get_last_lr()[0], rtol=1e-5)
        optimiser.step()
        reference.step()


@pytest.mark.parametrize(
    ("options", "make_reference"),
    [
        (
            {"final_learning_rate": 0.0, "decay": "linear"},
            lambda optimiser: torch.optim.lr_scheduler.PolynomialLR(optimiser, total_iters=99, power=1.0),
        ),
        (
            {"milestones": ((30, 0.5), (40, 0.5))},
            lambda optimiser: torch.optim.lr_scheduler.MultiStepLR(optimiser, [30, 40], gamma=0.5),
        ),
    ],
)
def test_learning_rate_equals_that_of_torch(options, make_reference):
    settings = OptimizerConfig(100, 1e-3, 0.0, **options)
    optimiser = torch.optim.AdamW([torch.zeros(1, requires_grad=True)], 1e-3)
    reference = make_reference(optimiser)
    for step in range(100):
        assert np.isclose(settings.at(step)[0], reference.get_last_lr()[0], rtol=1e-5, atol=1e-12), step
        optimiser.step()
        reference.step()


def test_records_lack_defaults_of_later_options():
    """Records of earlier versions therefore equal those of this version."""
    later = {"decay", "milestones", "amsgrad"}
    assert not later & OptimizerConfig(10, 1e-3, 0.0).to_record().keys()
    assert (
        later <= OptimizerConfig(10, 1e-3, 0.0, decay="linear", milestones=((1, 0.5),), amsgrad=True).to_record().keys()
    )


def test_trainer_with_amsgrad_resumes_exactly(tmp_path):
    options, batch = {"amsgrad": True, "milestones": ((2, 0.5),)}, make_dit_batch()
    straight = make_trainer(**options)
    curve = [float(straight.step(batch, range(8))["loss"]) for _ in range(6)]
    first = make_trainer(**options)
    for _ in range(3):
        first.step(batch, range(8))
    first.save(tmp_path)
    second = make_trainer(**options)
    second.load(tmp_path)
    assert [float(second.step(batch, range(8))["loss"]) for _ in range(3)] == curve[3:]
    with pytest.raises(ValueError, match="trained with amsgrad=True, asked for None"):
        make_trainer(milestones=((2, 0.5),)).load(tmp_path)


def test_pseudoinverse_guidance_halves_error():
    """All data lie on the line z_1 = z_0, and the denoiser is exact. The generated values must therefore equal the
    known values."""
    schedule, covariance = SamplingSchedule(Diffusion(), 50), torch.ones(2, 2, dtype=torch.float64)

    def denoise(latent, timestep, label):
        a = Diffusion().alpha_bar[int(timestep[0])]
        posterior = a**0.5 * covariance @ torch.linalg.inv(a * covariance + (1 - a) * torch.eye(2, dtype=torch.float64))
        clean = (latent.double().flatten(1) @ posterior.T).view_as(latent)
        return ((latent - a**0.5 * clean) / (1 - a) ** 0.5).to(latent.dtype)

    count = 64
    given = torch.linspace(-2, 2, count)[:, None, None, None].expand(count, 2, 1, 1).clone()
    mask = torch.tensor([0.0, 1.0])[None, :, None, None].expand_as(given)
    label = torch.zeros(count, dtype=torch.long)
    errors = {}
    for weight in (0.0, 1.0):
        noise = SceneNoise(0, range(count), (2, 1, 1), "cpu")
        made = sample(denoise, schedule, noise, label, None, InpaintCondition(given, mask), guidance_weight=weight)
        assert torch.equal(made[:, 0], given[:, 0])
        errors[weight] = (made[:, 1] - given[:, 1]).abs().mean().item()
    assert errors[1.0] < 0.5 * errors[0.0], errors


@pytest.mark.parametrize("prediction", ["epsilon", "v_prediction"])
def test_min_snr_weight_agrees_with_diffusers(prediction):
    dit = DiT(channels=8, size=8, patch=2, width=32, depth=1, heads=2, prediction=prediction)
    scheduler = DDPMScheduler(beta_start=dit.diffusion.beta_start, beta_end=dit.diffusion.beta_end)
    timestep = torch.tensor([0, 50, 126, 467, 999])
    snr = compute_snr(scheduler, timestep)
    # The weight that diffusers' training scripts give the squared error of the output, times the output's error for a
    # noise error of 1 (v = noise / sqrt(alpha_bar) if the noisy latent is known).
    output_weight = snr.clamp(max=5) / (snr if prediction == "epsilon" else snr + 1)
    output_error = torch.ones(5) if prediction == "epsilon" else 1 / scheduler.alphas_cumprod[timestep]
    weight = compute_loss_weight(dit, timestep, "min_snr")
    assert torch.allclose(weight, output_weight * output_error, rtol=1e-3)
    assert weight[0] < 0.01 and weight[3:].allclose(torch.ones(2))
    assert torch.equal(compute_loss_weight(dit, timestep, "uniform"), dit.loss_weight(timestep))
