"""Tests of multinomial diffusion against enumerations of small state spaces."""

import math

import pytest
import torch
from scipy.stats import chi2

from models.baselines.discrete_diffusion import MultinomialDiffusion, make_log_one_hot, sample_categorical
from models.training import make_keyed_generator

SHARES = torch.tensor([0.6, 0.3, 0.1], dtype=torch.float64)
SIGNIFICANCE = 1e-3  # Probability that a correct sampler fails. Seeds are fixed, so the result is always the same.


def make_matrices(diffusion):
    """Return matrices (T, K, K) of the steps: row = class before, column = class after."""
    keep = diffusion.log_step[:, 0].exp()[:, None, None]
    classes = diffusion.num_classes
    return keep * torch.eye(classes, dtype=keep.dtype) + (1 - keep) / classes


def make_posterior(diffusion, clean, noisy, t):
    """Return q(x_{t-1} | x_t, x_0) by Bayes' rule; at t = 0, x_{t-1} is the clean class."""
    matrices = make_matrices(diffusion)
    before = torch.eye(diffusion.num_classes, dtype=matrices.dtype)
    for step in matrices[:t]:
        before = before @ step
    joint = before[clean] * matrices[t][:, noisy]
    return joint / joint.sum()


def test_schedule_is_the_cosine_schedule_of_pdd():
    diffusion = MultinomialDiffusion(5, 100)
    s, squares = 0.008, []
    for k in range(101):
        squares.append(math.cos((k / 100 + s) / (1 + s) * math.pi / 2) ** 2)
    expected = [math.sqrt(max(b / a, 0.001)) for a, b in zip(squares, squares[1:], strict=False)]
    assert torch.allclose(diffusion.log_step[:, 0].exp(), torch.tensor(expected, dtype=torch.float64), atol=1e-12)
    assert torch.allclose(diffusion.log_step.exp().sum(1), torch.ones(100, dtype=torch.float64), atol=1e-12)
    assert diffusion.log_total[0, 0] == 0 and diffusion.log_total[-1, 0].exp() < 1e-3


@pytest.mark.parametrize("t", [0, 1, 4, 6])
def test_posterior_equals_bayes_rule_by_enumeration(t):
    diffusion = MultinomialDiffusion(4, 7)
    for clean in range(4):
        for noisy in range(4):
            log_clean = make_log_one_hot(torch.tensor([[clean]]), 4, torch.float64)
            found = diffusion.compute_log_posterior(log_clean, torch.tensor([[noisy]]), torch.tensor([t]))
            assert torch.allclose(found.exp()[0, :, 0], make_posterior(diffusion, clean, noisy, t), atol=1e-12)


def test_kl_equals_enumeration_in_float64():
    diffusion, generator = MultinomialDiffusion(3, 6), torch.Generator().manual_seed(0)
    predicted = torch.rand(3, dtype=torch.float64, generator=generator) + 0.1
    predicted /= predicted.sum()
    for t in range(6):
        matrices = make_matrices(diffusion)
        before = torch.eye(3, dtype=torch.float64)
        for step in matrices[:t]:
            before = before @ step
        for clean in range(3):
            for noisy in range(3):
                model = predicted @ before * matrices[t][:, noisy]
                model /= model.sum()
                true = make_posterior(diffusion, clean, noisy, t)
                expected = torch.special.xlogy(true, true).sum() - (true * model.log()).sum()
                args = (
                    predicted.log().view(1, 3, 1),
                    torch.tensor([[clean]]),
                    torch.tensor([[noisy]]),
                    torch.tensor([t]),
                )
                assert diffusion.compute_kl(*args).item() == pytest.approx(expected.item(), abs=1e-12)


def test_kl_of_extreme_logits_is_finite_in_float32():
    diffusion = MultinomialDiffusion(18, 100)
    logits = torch.full((100, 18, 1), -80.0)
    logits[:, 3] = 80.0
    logits.requires_grad_()
    clean, noisy = torch.zeros(100, 1, dtype=torch.int64), torch.full((100, 1), 17)
    kl = diffusion.compute_kl(logits.log_softmax(1), clean, noisy, torch.arange(100))
    (gradient,) = torch.autograd.grad(kl.sum(), logits)
    assert torch.isfinite(kl).all() and torch.isfinite(gradient).all() and (kl > -1e-6).all()


def test_prior_kl_equals_enumeration():
    for steps in (2, 100):
        diffusion = MultinomialDiffusion(5, steps)
        total = torch.eye(5, dtype=torch.float64)
        for step in make_matrices(diffusion):
            total = total @ step
        expected = (total * (total * 5).log()).sum(1)
        assert torch.allclose(expected, expected[0].expand(5))
        assert diffusion.compute_prior_kl().item() == pytest.approx(expected[0].item(), abs=1e-14, rel=1e-9)


def test_gains_add_up_to_the_entropy_of_classes():
    diffusion = MultinomialDiffusion(3, 12)
    gains = diffusion.compute_gains(SHARES)
    total = torch.eye(3, dtype=torch.float64)
    for step in make_matrices(diffusion):
        total = total @ step
    last = SHARES @ total
    left = (SHARES[:, None] * total * (total / last).log()).sum()  # Information that is left in x_T.
    assert gains.shape == (12,) and (gains > 0).all()
    assert gains.sum().item() == pytest.approx((-(SHARES * SHARES.log()).sum() - left).item(), abs=1e-12)


def test_weights_of_timesteps_keep_the_mean_of_the_loss():
    diffusion = MultinomialDiffusion(3, 12)
    weights = diffusion.weigh_timesteps(SHARES)
    assert weights.sum().item() == pytest.approx(1) and weights.min() >= 0.5 / 12 and weights.std() > 1e-3
    shape = (12, 2, 2, 2)
    generator = torch.Generator().manual_seed(1)
    clean, noisy = (torch.randint(0, 3, shape, generator=generator) for _ in range(2))
    logits = torch.randn(12, 3, 2, 2, 2, generator=generator, dtype=torch.float64)
    timestep = torch.arange(12)
    parts = [
        diffusion.compute_losses(logits[k, None], clean[k, None], noisy[k, None], timestep[k, None], weights[k, None])
        for k in range(12)
    ]
    bound, loss = (torch.stack([weights[k] * parts[k][name] for k in range(12)]).sum() for name in ("bound", "loss"))
    kl = diffusion.compute_kl(logits.log_softmax(1), clean, noisy, timestep).sum((1, 2, 3)) / 4  # Per column.
    assert bound.item() == pytest.approx((kl.sum() + 2 * diffusion.compute_prior_kl()).item())
    entropy = torch.nn.functional.cross_entropy(logits, clean, reduction="none").sum((1, 2, 3)) / 4
    entropy[0] = kl[0]
    assert (loss - bound).item() == pytest.approx((5e-4 * (2 - timestep / 12) * entropy).sum().item())


def test_noise_keeps_classes_with_the_right_probability():
    diffusion = MultinomialDiffusion(3, 10)
    clean = torch.full((2, 50_000), 1)
    timestep = torch.tensor([1, 6])
    noisy = diffusion.add_noise(clean, timestep, [make_keyed_generator(k) for k in range(2)])
    for k in range(2):
        keep = diffusion.log_total[timestep[k] + 1, 0].exp().item()
        expected = torch.full((3,), (1 - keep) / 3)
        expected[1] += keep
        assert_frequencies(torch.bincount(noisy[k], minlength=3), expected)


def assert_frequencies(counts, probabilities):
    """Compare counts with probabilities by a chi-square test."""
    expected = probabilities.double() * counts.sum()
    statistic = ((counts - expected) ** 2 / expected).sum().item()
    assert statistic < chi2.ppf(1 - SIGNIFICANCE, len(counts) - 1), (counts.tolist(), expected.tolist())


def test_categorical_frequencies_match_probabilities():
    log_probabilities = SHARES.log().view(1, 3, 1).expand(1, 3, 50_000)
    drawn = sample_categorical(log_probabilities, torch.rand(1, 50_000, generator=make_keyed_generator(3)))
    assert_frequencies(torch.bincount(drawn[0], minlength=3), SHARES)
    assert sample_categorical(log_probabilities[..., :2], torch.tensor([[0.0, 1 - 2**-24]])).tolist() == [[0, 2]]


@pytest.mark.parametrize("steps", [3, 20])
def test_sampler_reproduces_independent_classes(steps):
    """The network of independent voxels returns the prior, and the sampler is exact for any number of steps."""
    diffusion = MultinomialDiffusion(3, steps)

    def denoise(noisy, timestep):
        return SHARES.float().log().view(1, 3, 1).expand(len(noisy), 3, noisy.shape[1])

    drawn = diffusion.sample(denoise, (40_000,), [make_keyed_generator(7)])
    assert_frequencies(torch.bincount(drawn[0], minlength=3), SHARES)


def test_sampler_reproduces_correlated_pairs():
    """The exact distribution of a clean class given the other noisy voxel is the network of a pair of voxels."""
    joint = torch.tensor([[0.45, 0.05], [0.05, 0.45]], dtype=torch.float64)
    diffusion = MultinomialDiffusion(2, 100)
    pairs = 20_000

    def denoise(noisy, timestep):
        keep = diffusion.log_total[timestep[0] + 1, 0].exp()
        noise = keep * torch.eye(2, dtype=torch.float64) + (1 - keep) / 2  # [clean, noisy].
        first, second = noisy.view(pairs, 2).unbind(1)
        of_first, of_second = (joint @ noise)[:, second], (joint.T @ noise)[:, first]
        return torch.stack([of_first, of_second], 2).log().view(1, 2, 2 * pairs)

    drawn = diffusion.sample(denoise, (2 * pairs,), [make_keyed_generator(11)]).view(pairs, 2)
    shares = torch.bincount(2 * drawn[:, 0] + drawn[:, 1], minlength=4) / pairs
    assert (shares - joint.flatten()).abs().max() < 0.02  # Voxels are drawn independently within each of 100 steps.


def test_sampler_keeps_known_voxels_and_uses_them():
    diffusion, seen = MultinomialDiffusion(4, 30), []
    clean, known = torch.full((1, 64), 2), torch.arange(64)[None] < 32

    def denoise(noisy, timestep):
        seen.append((noisy[:, :32] == 2).double().mean().item())
        return torch.zeros(1, 4, 64)

    drawn = diffusion.sample(denoise, (64,), [make_keyed_generator(5)], clean, known)
    assert (drawn[:, :32] == 2).all() and not (drawn[:, 32:] == 2).all()
    assert seen[-1] > 0.9 and seen[0] < 0.6  # The network sees noised known voxels, not clean ones.


def test_samples_depend_only_on_their_generator():
    diffusion = MultinomialDiffusion(4, 8)

    def denoise(noisy, timestep):
        return torch.nn.functional.one_hot(noisy, 4).movedim(-1, 1).double()

    both = diffusion.sample(denoise, (3, 5), [make_keyed_generator(1), make_keyed_generator(2)])
    each = [diffusion.sample(denoise, (3, 5), [make_keyed_generator(k)]) for k in (1, 2)]
    assert torch.equal(both, torch.cat(each)) and not torch.equal(both[0], both[1])
