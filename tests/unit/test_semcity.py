"""Tests of SemCity: its losses, networks, queries and sampler against literal versions and toy distributions."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt

from models.baselines.directory import find_stages
from models.baselines.lovasz import compute_lovasz_softmax
from models.baselines.semcity import PRESETS, Pipeline
from models.baselines.semcity.autoencoder import TriplaneAutoencoder, find_positions
from models.baselines.semcity.losses import make_autoencoder_loss, weigh_classes
from models.baselines.semcity.queries import find_near_empty, select_queries
from models.baselines.semcity.triplane import Planes, PlaneSizes, join_planes, project_unknown, split_planes
from models.baselines.semcity.unet import RolloutConv, TriplaneUNet
from models.baselines.training import make_baseline_trainer, measure_sample_bytes
from models.sampling.diffusion import make_keyed_generator
from models.training import OptimizerConfig, Trainer

SHAPE = (16, 16, 4)


def make_blocks(count: int, num_classes: int = 5, seed: int = 0) -> torch.Tensor:
    """Return scenes (count, 16, 16, 4) with a ground of two classes and random boxes."""
    rng = np.random.default_rng(seed)
    voxels = np.zeros((count, *SHAPE), np.uint8)
    for scene in voxels:
        scene[:, :, 0] = 1
        scene[:, rng.integers(3, 13) :, 0] = 2
        for class_id in range(3, num_classes):
            row, col = rng.integers(0, 10, 2)
            scene[row : row + 5, col : col + 4, 1 : rng.integers(2, 5)] = class_id
    return torch.from_numpy(voxels)


def measure_miou(truth: torch.Tensor, made: torch.Tensor) -> float:
    """Return the mean IoU over the classes of the truth that are not empty."""
    scores = []
    for class_id in truth.unique().tolist():
        if class_id:
            inside, outside = truth == class_id, made == class_id
            scores.append(float((inside & outside).sum() / (inside | outside).sum()))
    return float(np.mean(scores))


def make_pipeline(seed: int = 0) -> Pipeline:
    torch.manual_seed(seed)
    autoencoder = TriplaneAutoencoder(SHAPE, 5, channels=4, kernel=(3, 3, 3), plane_channels=8, width=16, layers=2)
    unet = TriplaneUNet((8, 8, 4), channels=4, width=8, multipliers=(1, 2), num_timesteps=8)
    for parameter in unet.parameters():  # The last layers start at zero, which would hide errors.
        torch.nn.init.normal_(parameter, std=0.1)
    return Pipeline({"autoencoder": autoencoder, "diffusion": unet})


# ------------------------------------------------------------------------------------------------------------ losses


def compute_literal_lovasz(probabilities: np.ndarray, labels: np.ndarray) -> float:
    """Return the loss by its definition: the Lovasz extension of the Jaccard loss of sets of wrong samples."""
    losses = []
    for class_id in np.unique(labels):
        truth = labels == class_id
        errors = np.abs(truth - probabilities[:, class_id])
        order = np.argsort(-errors, kind="stable")

        def jaccard_loss(wrong: set, truth: np.ndarray = truth) -> float:
            predicted = {k for k in range(len(truth)) if truth[k] != (k in wrong)}
            there = set(np.flatnonzero(truth).tolist())
            return 1 - len(there & predicted) / len(there | predicted)

        levels = [jaccard_loss(set(order[:k].tolist())) for k in range(len(order) + 1)]
        losses.append(sum(errors[order[k]] * (levels[k + 1] - levels[k]) for k in range(len(order))))
    return float(np.mean(losses))


@pytest.mark.parametrize("seed", range(4))
def test_lovasz_softmax_equals_its_definition(seed):
    rng = np.random.default_rng(seed)
    probabilities, labels = rng.dirichlet(np.ones(4), 40), rng.integers(0, 4 - seed % 2, 40)
    got = compute_lovasz_softmax(torch.from_numpy(probabilities), torch.from_numpy(labels))
    assert float(got) == pytest.approx(compute_literal_lovasz(probabilities, labels), abs=1e-12)


def test_lovasz_softmax_is_one_minus_miou_at_corners():
    """For hard predictions, the extension equals the Jaccard loss."""
    labels = torch.tensor([0, 0, 1, 1, 1, 2])
    predicted = torch.tensor([0, 1, 1, 1, 2, 2])
    loss = compute_lovasz_softmax(torch.nn.functional.one_hot(predicted, 3).double(), labels)
    assert float(loss) == pytest.approx(1 - np.mean([1 / 2, 2 / 4, 1 / 2]))


def test_class_weights_are_cube_roots_of_ratios():
    weights = weigh_classes([8000, 1000, 0, 8])
    assert torch.allclose(weights, torch.tensor([1.0, 2.0, 0.0, 10.0]))


def test_autoencoder_loss_reads_the_queried_voxels():
    """A network that knows the class at each position has no loss; one that is shifted by a voxel has one."""
    voxels = make_blocks(2)
    loss = make_autoencoder_loss((8, 8, 8), 300)(make_pipeline().autoencoder, {}, [10] * 5)

    def answer(shift: int):
        def model(flipped: torch.Tensor, position: torch.Tensor) -> torch.Tensor:
            place = ((position + 1) * torch.tensor(SHAPE) / 2 - 0.5).round().long()
            place[..., 0] = (place[..., 0] + shift).clamp(0, SHAPE[0] - 1)
            labels = torch.stack([one[tuple(at.T)] for one, at in zip(flipped, place, strict=True)])
            return 50.0 * torch.nn.functional.one_hot(labels.long(), 5)

        return model

    arrays = {"voxels_8x8x8": voxels}
    for shift, low, high in ((0, 0.0, 1e-6), (3, 0.5, 100.0)):
        found = loss(answer(shift), arrays, [make_keyed_generator(k) for k in range(2)])
        assert low <= float(found["loss"]) <= high


# ----------------------------------------------------------------------------------------------------------- queries


def test_near_empty_voxels_agree_with_distance_transform():
    voxels = make_blocks(1)[0]
    distance = distance_transform_edt(voxels.numpy() == 0)
    assert np.array_equal(find_near_empty(voxels).numpy(), (distance > 0) & (distance <= 2))


def test_queries_contain_all_filled_and_near_voxels_once():
    voxels = make_blocks(1)[0]
    wanted = set(torch.nonzero(((voxels > 0) | find_near_empty(voxels)).flatten()).flatten().tolist())
    got = select_queries(voxels, len(wanted) + 50, make_keyed_generator(0)).tolist()
    assert wanted <= set(got) and len(set(got)) == len(got) == len(wanted) + 50
    everything = select_queries(voxels, 2 * voxels.numel(), make_keyed_generator(0)).tolist()
    assert sorted(everything) == sorted(2 * list(range(voxels.numel())))


def test_class_order_drops_late_classes_and_empty_voxels():
    voxels = make_blocks(1)[0]
    filled = int((voxels > 0).sum())
    count = filled - int((voxels == 4).sum())
    labels = voxels.flatten()
    ordered = labels[select_queries(voxels, count, make_keyed_generator(0), class_order=True)]
    assert set(ordered.tolist()) == {1, 2, 3}
    assert set(labels[select_queries(voxels, count, make_keyed_generator(0))].tolist()) == {0, 1, 2, 3, 4}


# ---------------------------------------------------------------------------------------------------------- networks


def test_planes_survive_joining_and_splitting():
    planes = [torch.randn(2, 3, *shape) for shape in ((4, 6), (4, 5), (6, 5))]
    joined = join_planes(planes)
    assert joined.shape == (2, 3, 1, 4 * 6 + 4 * 5 + 6 * 5)
    assert all(torch.equal(a, b) for a, b in zip(split_planes(joined, PlaneSizes(4, 6, 5)), planes, strict=True))


def test_unknown_cells_depend_on_unknown_columns():
    unknown = torch.zeros(1, 8, 12, dtype=torch.bool)
    unknown[0, 3, 5:] = True
    xy, xz, yz = split_planes(project_unknown(unknown, PlaneSizes(4, 6, 3)), PlaneSizes(4, 6, 3))
    assert xy[0, 0].nonzero().tolist() == [[1, 2], [1, 3], [1, 4], [1, 5]]
    assert xz[0, 0, :, 0].tolist() == [0, 1, 0, 0] and yz[0, 0, :, 0].tolist() == [0, 0, 1, 1, 1, 1]


def test_rollout_convolution_sees_means_of_other_planes():
    """A change of one cell of the plane xz changes row means of xy and level means of yz, but not other rows."""
    torch.manual_seed(0)
    conv = RolloutConv(2, 3)
    xy, xz, yz = torch.randn(1, 2, 9, 8), torch.randn(1, 2, 9, 7), torch.randn(1, 2, 8, 7)
    changed = xz.clone()
    changed[:, :, 4, 3] += 1
    before, after = conv(Planes(xy, xz, yz)), conv(Planes(xy, changed, yz))
    different = (before[0] - after[0]).abs().amax(dim=(0, 1)) > 1e-6
    assert different.any(dim=1).tolist() == [False] * 3 + [True] * 3 + [False] * 3 and different[4].all()
    different = (before[2] - after[2]).abs().amax(dim=(0, 1)) > 1e-6
    assert different.any(dim=0).tolist() == [False] * 2 + [True] * 3 + [False] * 2


def test_published_sizes_of_networks():
    with torch.device("meta"):
        sizes = [stage.model(**stage.architecture).num_parameters() for stage in PRESETS["paper"]]
    assert sizes[0] == pytest.approx(0.8e6, rel=0.02) and sizes[1] == pytest.approx(59.8e6, rel=0.02)


def test_decode_voxels_equals_decode_at_centres():
    autoencoder = make_pipeline().autoencoder
    triplane = autoencoder.encode(make_blocks(2))
    index = torch.arange(math.prod(SHAPE)).expand(2, -1)
    logits = autoencoder.decode(triplane, find_positions(index, SHAPE))
    assert torch.equal(autoencoder.decode_voxels(triplane).flatten(1), logits.argmax(2).to(torch.uint8))


def test_decoder_output_is_local_in_all_planes():
    """A distant cell of a plane does not change a voxel; a cell at the place of the voxel does."""
    torch.manual_seed(0)
    autoencoder = make_pipeline().autoencoder
    planes = [torch.randn(1, 4, *shape) for shape in autoencoder.sizes.shapes]
    position = find_positions(torch.tensor([[0]]), SHAPE)  # First row, column and level.
    block = autoencoder.plane_blocks[0]
    for module in autoencoder.plane_blocks:  # Instance normalisation would spread each change over the whole plane.
        module.norm = torch.nn.Identity()
    assert block.norm is not None
    logits = autoencoder.decode(join_planes(planes), position)
    for k in range(3):
        for place, changes in ((0, True), (-1, False)):
            moved = [plane.clone() for plane in planes]
            moved[k][:, :, place, place] += 5
            differs = not torch.allclose(autoencoder.decode(join_planes(moved), position), logits)
            assert differs == changes, (k, place)


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("shape", (15, 16, 4), "even numbers"),
        ("kernel", (2, 3, 3), "odd sizes"),
        ("channels", 0, "channels is 0, expected an integer from 1"),
        ("layers", 3, "even numbers"),
    ],
)
def test_invalid_config_of_autoencoder_is_named(option, value, message):
    config = make_pipeline().autoencoder.config | {option: value}
    with pytest.raises(ValueError, match=message):
        TriplaneAutoencoder.from_config(config)


def test_invalid_config_of_unet_is_named():
    config = make_pipeline().unet.config
    for option, value, message in (("sizes", (7, 8, 4), "multiples of 2"), ("beta_end", 1e-9, "above beta_end")):
        with pytest.raises(ValueError, match=message):
            TriplaneUNet.from_config(config | {option: value})


# --------------------------------------------------------------------------------------------------------- sampling


def test_sampler_reproduces_moments_of_toy_distribution():
    """With the optimal clean estimate of normal data, samples have the moments that the recursion of DDPM gives."""
    pipeline = make_pipeline()
    mean, deviation = 0.3, 0.2
    unet = TriplaneUNet((8, 8, 4), channels=4, width=8, multipliers=(1,), num_timesteps=100)
    alpha_bar = torch.from_numpy(unet.diffusion.alpha_bar).float()

    class Optimal(torch.nn.Module):
        config, diffusion, sizes, device = unet.config, unet.diffusion, unet.sizes, torch.device("cpu")

        def forward(self, latent, timestep):
            a = alpha_bar[timestep][:, None, None, None]
            gain = a.sqrt() * deviation**2 / (a * deviation**2 + 1 - a)
            return mean + gain * (latent - a.sqrt() * mean)

    pipeline.unet = Optimal()
    made = pipeline._sample_triplanes([make_keyed_generator(k) for k in range(40)])
    # Recursion of the variance, with the coefficients of the posterior mean (Ho et al., 2020, Eq. 7).
    beta = np.linspace(0.001, 0.2, 100)
    a, variance = np.cumprod(1 - beta), 1.0
    for t in reversed(range(100)):
        before = a[t - 1] if t else 1.0
        gain = a[t] ** 0.5 * deviation**2 / (a[t] * deviation**2 + 1 - a[t])
        slope = before**0.5 * beta[t] / (1 - a[t]) * gain + (1 - beta[t]) ** 0.5 * (1 - before) / (1 - a[t])
        variance = slope**2 * variance + (beta[t] if t else 0)
    assert float(made.mean()) == pytest.approx(mean, abs=0.01)
    assert float(made.std()) == pytest.approx(variance**0.5, rel=0.02)
    assert variance**0.5 == pytest.approx(deviation, rel=0.1)


def test_each_sample_depends_on_its_generator_only():
    pipeline = make_pipeline()
    (both,) = pipeline.sample([make_keyed_generator(0), make_keyed_generator(1)]).values()
    (last,) = pipeline.sample([make_keyed_generator(1)]).values()
    assert both.shape == (2, *SHAPE) and both.dtype == torch.uint8
    assert torch.equal(both[1], last[0]) and not torch.equal(both[0], both[1])


def test_inpainting_keeps_known_columns():
    pipeline, voxels = make_pipeline(), make_blocks(2)
    unknown = torch.zeros(2, 16, 16, dtype=torch.bool)
    unknown[:, :8] = True
    made = pipeline.inpaint(voxels, unknown, [make_keyed_generator(k) for k in range(2)])
    assert torch.equal(made[:, 8:], voxels[:, 8:]) and not torch.equal(made[:, :8], voxels[:, :8])
    hidden = voxels.clone()
    hidden[:, :8] = 4
    again = pipeline.inpaint(hidden, unknown, [make_keyed_generator(k) for k in range(2)])
    assert torch.equal(made, again)  # Voxels of unknown columns are not read.


def test_outpainting_keeps_scene_in_the_middle():
    pipeline, voxels = make_pipeline(), make_blocks(1)
    made = pipeline.outpaint(voxels, 3, 3, [make_keyed_generator(0)])
    assert made.shape == (1, 32, 32, 4) and torch.equal(made[:, 8:24, 8:24], voxels)
    with pytest.raises(ValueError, match="odd numbers"):
        pipeline.outpaint(voxels, 2, 3, [make_keyed_generator(0)])


def test_planes_of_another_autoencoder_are_refused():
    networks = make_pipeline().networks
    other = TriplaneUNet((4, 4, 4), channels=4, width=8, multipliers=(1, 2))
    with pytest.raises(ValueError, match="train the stage diffusion with this autoencoder"):
        Pipeline(networks | {"diffusion": other})


# --------------------------------------------------------------------------------------------------------- training


def train(trainer: Trainer, arrays: dict, count: int, steps: int) -> dict:
    losses = {}
    for _ in range(steps):
        losses = trainer.step(arrays, range(count))
    return losses


def test_autoencoder_overfits_four_scenes():
    voxels = make_blocks(4)
    torch.manual_seed(0)
    model = TriplaneAutoencoder(SHAPE, 5, channels=8, kernel=(3, 3, 3), plane_channels=16, width=32, layers=2)
    counts = torch.bincount(voxels.flatten().long(), minlength=5).tolist()
    loss = make_autoencoder_loss((8, 8, 8), 600)(model, {}, counts)
    trainer = Trainer(model, loss, OptimizerConfig(150, 5e-3, 0.0), torch.device("cpu"))
    train(trainer, {"voxels_8x8x8": voxels}, 4, 150)
    assert measure_miou(voxels, model.decode_voxels(model.encode(voxels))) >= 0.9


def test_diffusion_loss_falls_and_measures_memory():
    stages = find_stages("semcity", "smoke")
    voxels = torch.nn.functional.pad(make_blocks(2), (0, 0, 0, 16, 0, 16))
    arrays = {"voxels_8x8x8": voxels}
    autoencoder = make_baseline_trainer(
        stages[0], stages[0].architecture, {}, [1] * 18, stages[0].optimizer, torch.device("cpu")
    )
    networks = {"autoencoder": autoencoder.model}
    settings = OptimizerConfig(60, 2e-3, 0.0)
    trainer = make_baseline_trainer(
        stages[1], stages[1].architecture, networks, [1] * 18, settings, torch.device("cpu")
    )
    first = float(train(trainer, arrays, 2, 1)["loss"])
    assert float(train(trainer, arrays, 2, 59)["loss"]) < 0.5 * first
    used = measure_sample_bytes(trainer, {name: value[:1] for name, value in arrays.items()})
    planes = autoencoder.model.latent_shape[2]
    assert 4 * 8 * planes < used < 4 * 8 * planes * 1000  # At least one tensor of 8 channels.
