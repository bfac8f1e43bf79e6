"""Tests of PDD: the network, the condition, the training loss and the sampler."""

import pytest
import torch

from models.base import SkipInitialValues
from models.baselines.base import coarsen_grids, repeat_grids
from models.baselines.pdd.network import PyramidDenoiser
from models.baselines.pdd.pipeline import (
    LEVELS,
    PRESETS,
    Pipeline,
    generate_level,
    make_condition,
    make_level_loss,
    make_stages,
    mirror_neighbors,
    upsample_classes,
)
from models.training import OptimizerConfig, Trainer, make_keyed_generator
from models.voxel_grids import FINE_SHAPE, NUM_CLASSES, coarsen_shape, name_voxel_column

CPU = torch.device("cpu")
COUNTS = [1000] * NUM_CLASSES
# Stages of small networks for scenes of 32 x 32 x 32 voxels.
STAGES = make_stages(
    ((4, 8),) * 3, 4, 16, (4, 4, 4), (8, 8, 8), OptimizerConfig(8, 4e-3, 0.01, ema_decay=0.9), 2, (32, 32, 32)
)


def make_networks(**changes) -> dict[str, PyramidDenoiser]:
    """Return networks with random weights in float64, so that rounding does not change classes."""
    torch.manual_seed(0)
    return {
        stage.name: PyramidDenoiser(**stage.architecture | changes.get(stage.name, {})).double() for stage in STAGES
    }


def make_generators(*keys: int) -> list[torch.Generator]:
    return [make_keyed_generator(key) for key in keys]


def make_town(num_classes: int = 6) -> torch.Tensor:
    """Return four scenes (4, 16, 16, 4) of a ground, a street, buildings and a car."""
    voxels = torch.zeros(4, 16, 16, 4, dtype=torch.uint8)
    voxels[..., 0] = 1
    for k in range(4):
        street, row = 3 + 2 * k, (5 * k + 1) % 10
        voxels[k, :, street : street + 3, 0] = 2
        voxels[k, row : row + 5, :3, :3] = 3
        voxels[k, (row + 3) % 10 : (row + 3) % 10 + 3, 13:] = 4
        voxels[k, 8:10, street + 1, 1:3] = num_classes - 1
    return voxels


def measure_miou(found: torch.Tensor, expected: torch.Tensor) -> float:
    """Return the mean IoU of the classes in `expected` that are not empty."""
    present = [k for k in expected.unique().tolist() if k]
    pairs = [(found == k, expected == k) for k in present]
    return sum(((a & b).sum() / (a | b).sum()).item() for a, b in pairs) / len(pairs)


def make_arrays(batch: int) -> dict[str, torch.Tensor]:
    """Return random training samples of all levels."""
    generator = torch.Generator().manual_seed(4)
    arrays = {}
    for stage in STAGES:
        shape = (batch, *stage.architecture["shape"])
        name = name_voxel_column(stage.factors[-1])
        arrays[name] = torch.randint(0, NUM_CLASSES, shape, generator=generator, dtype=torch.uint8)
    return arrays


@pytest.mark.parametrize("number", range(3))
def test_paper_preset_has_the_size_of_the_original(number):
    stage = PRESETS["paper"][number]
    with torch.device("meta"), SkipInitialValues():
        network = PyramidDenoiser.from_config(stage.architecture)
    assert network.num_parameters() == pytest.approx(57.3e6, rel=0.02)
    assert stage.batch_size == (16, 16, 4)[number] and stage.optimizer.learning_rate == 4e-3


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_have_the_levels_of_the_paper(preset):
    stages = PRESETS[preset]
    assert tuple(stage.name for stage in stages) == LEVELS
    shapes = [stage.architecture["shape"] for stage in stages]
    assert shapes == [(32, 32, 4), (64, 64, 8), (256, 256, 16)]
    assert [coarsen_shape(FINE_SHAPE, stage.factors[-1]) for stage in stages] == shapes
    assert [len(stage.factors) for stage in stages] == [1, 2, 2]
    block = {"smoke": 32, "town": 64, "paper": 128}[preset]
    assert stages[2].architecture["block"] == (block, block) and stages[2].architecture["strip"] == block // 16


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_classes": 1}, "num_classes is 1, expected an integer from 2 to 256"),
        ({"has_coarse": 1}, "has_coarse is 1, expected true or false"),
        ({"shape": [32, 32]}, "shape is .*, expected a list of 3 entries"),
        ({"shape": [4096, 4096, 4096]}, "PRITTI_MAX_SCENE_VOXELS"),
        ({"block": [24, 32]}, "whole blocks whose rows, columns and levels are multiples of"),
        ({"shape": [48, 32, 4]}, "whole blocks"),
        ({"shape": [32, 32, 6]}, "multiples of \\(16, 16, 4\\) for 5 widths"),
        ({"strip": 33}, "strip is 33, expected at most the size of a block, 32"),
        ({"heads": 24}, "a last width that is a multiple of heads, 24"),
        ({"widths": [33, 64, 128, 256, 512]}, "an even first width"),
        ({"depth": 4}, "no option depth"),
    ],
)
def test_config_with_wrong_values_is_rejected(changes, message):
    with pytest.raises(ValueError, match=message), torch.device("meta"), SkipInitialValues():
        PyramidDenoiser.from_config(changes)


def test_network_is_loaded_with_equal_outputs(tmp_path):
    torch.manual_seed(0)
    stage = STAGES[2]
    network = PyramidDenoiser.from_config(stage.architecture).eval()
    network.save_pretrained(tmp_path)
    loaded = PyramidDenoiser.from_pretrained(tmp_path)
    noisy = torch.randint(0, NUM_CLASSES, (2, 16, 16, 16))
    inputs = noisy, torch.tensor([0, 3]), torch.stack([noisy, noisy.flip(1)], 1)
    assert network(*inputs).shape == (2, NUM_CLASSES, 16, 16, 16)
    assert torch.equal(network(*inputs), loaded(*inputs))
    assert torch.equal(network.diffusion.log_total, loaded.diffusion.log_total)


def test_network_output_depends_on_all_inputs():
    network = make_networks()["level3"]
    noisy = torch.randint(0, NUM_CLASSES, (1, 16, 16, 16))
    condition = torch.stack([noisy, noisy], 1)
    inputs = [noisy, torch.tensor([1]), condition]
    output = network(*inputs)
    changed = condition.clone()
    changed[:, 1] = 0
    others = [(0, noisy.flip(1)), (1, torch.tensor([0])), (2, changed), (2, condition.flip(3))]
    for place, value in others:
        assert not torch.allclose(output, network(*inputs[:place], value, *inputs[place + 1 :]))


def test_upsampling_keeps_planar_borders():
    coarse = torch.zeros(1, 4, 4, 2, dtype=torch.int64)
    coarse[:, 2:], coarse[:, :, 3:] = 3, 5
    assert torch.equal(upsample_classes(coarse, (16, 16, 4), 6), repeat_grids(coarse, (4, 4, 2)))


def test_neighbors_are_mirrored_into_the_block():
    grid = torch.arange(1, 65).view(8, 8, 1)
    found = mirror_neighbors(grid, (2, 4), (4, 4), 1)[..., 0]
    assert found[0, 1:].tolist() == grid[1, 5:8, 0].tolist() and found[3, 1:].tolist() == grid[6, 5:8, 0].tolist()
    assert found[:, 0].tolist() == grid[2:6, 3, 0].tolist()
    assert not found[1:3, 1:].any()  # There is nothing to the right of the block.
    wide = mirror_neighbors(grid, (4, 0), (4, 8), 3, (True, False, False, False))[..., 0]
    assert wide[:, 0].tolist() == [25, 17, 9, 0]  # The nearest row comes first.
    assert not mirror_neighbors(grid, (2, 4), (4, 4), 2, (False,) * 4).any()
    both = mirror_neighbors(grid, (1, 0), (4, 8), 2, (True, True, False, False))[..., 0]
    assert both[:, 1].tolist() == [2, 0, 50, 42]  # One row above the block, and two rows below it.


def test_condition_shows_the_coarse_voxels_of_the_block():
    network = make_networks()["level3"]
    fine = torch.randint(1, NUM_CLASSES, (2, 32, 32, 16))
    coarse = torch.arange(64).view(1, 8, 8, 1).expand(2, 8, 8, 8) % NUM_CLASSES
    starts = [(4, 8), (16, 0)]
    found = make_condition(network, coarse, fine, starts, [(True,) * 4] * 2)
    assert found.shape == (2, 2, 16, 16, 16)
    for k, (row, col) in enumerate(starts):
        part = coarse[k : k + 1, row // 4 : row // 4 + 4, col // 4 : col // 4 + 4]
        assert torch.equal(found[k, 0, 2::4, 2::4, 1::2], part[0])  # Voxels in the middle of coarse voxels.
        assert torch.equal(found[k, 1], mirror_neighbors(fine[k], (row, col), (16, 16), 1))


@pytest.mark.parametrize("number", range(3))
def test_loss_of_each_sample_depends_only_on_its_generator(number):
    stage = STAGES[number]
    network = make_networks()[stage.name]
    loss, arrays = stage.make_loss(network, {}, COUNTS), make_arrays(3)
    together = loss(network, arrays, make_generators(1, 2, 3))
    each = [
        loss(network, {name: value[k : k + 1] for name, value in arrays.items()}, make_generators(k + 1))
        for k in range(3)
    ]
    values = [part["loss"].item() for part in each]
    assert together["loss"].item() == pytest.approx(sum(values) / 3, rel=1e-6) and len(set(values)) == 3


def test_loss_trains_the_block_of_the_scene_that_it_noises():
    """A network that sees only unmixed scenes returns the clean classes, so its loss is almost zero."""
    stage = STAGES[2]
    network = make_networks()["level3"]
    arrays = {
        name: torch.full((2, *shape), 7, dtype=torch.uint8)
        for name, shape in (("voxels_4x4x4", (8, 8, 8)), ("voxels_1x1x2", (32, 32, 16)))
    }
    conditions = []

    def answer(noisy, timestep, condition):
        conditions.append(condition)
        return 50.0 * torch.nn.functional.one_hot(condition[:, 0], NUM_CLASSES).movedim(-1, 1)

    losses = stage.make_loss(network, {}, COUNTS)(answer, arrays, make_generators(1, 2))
    prior = 16 * network.diffusion.compute_prior_kl().item()
    assert losses["loss"].item() == pytest.approx(prior, abs=1e-5)
    assert conditions[0].shape == (2, 2, 16, 16, 16) and conditions[0].unique().tolist() == [0, 7]


def test_training_resumes_exactly(tmp_path):
    stage, arrays = STAGES[1], make_arrays(2)

    def make_trainer() -> Trainer:
        torch.manual_seed(0)
        network = PyramidDenoiser.from_config(stage.architecture)
        return Trainer(network, stage.make_loss(network, {}, COUNTS), stage.optimizer, CPU)

    whole, first, second = make_trainer(), make_trainer(), make_trainer()
    for _ in range(3):
        whole.step(arrays, range(2))
    first.step(arrays, range(2))
    first.save(tmp_path)
    second.load(tmp_path)
    for _ in range(2):
        second.step(arrays, range(2))
    assert all(torch.equal(a, b) for a, b in zip(whole.model.parameters(), second.model.parameters(), strict=True))


def train_level(steps: int, num_timesteps: int) -> tuple[float, float]:
    """Train level 2 with four scenes.

    Returns the mean IoU of samples given the true coarse level, and of the repeated coarse level.
    """
    torch.manual_seed(0)
    voxels, factors = make_town(), ((2, 2, 2), (1, 1, 1))
    coarse = coarsen_grids(voxels, factors[0])
    network = PyramidDenoiser(
        (16, 16, 4), (16, 16), True, widths=(8, 16, 32), heads=4, num_classes=6, num_timesteps=num_timesteps
    )
    counts = torch.bincount(voxels.flatten().long(), minlength=6).tolist()
    settings = OptimizerConfig(steps, 4e-3, 0.01, ema_decay=0.95, grad_clip=1.0)
    trainer = Trainer(network, make_level_loss(network, {}, counts, factors), settings, CPU)
    arrays = {name_voxel_column(factors[0]): coarse, "voxels": voxels}
    for _ in range(steps):
        trainer.step(arrays, range(4))
    model = trainer.ema_model()
    assert isinstance(model, PyramidDenoiser)
    found = generate_level(model, coarse.long(), make_generators(1, 2, 3, 4))
    return measure_miou(found, voxels), measure_miou(repeat_grids(coarse, factors[0]), voxels)


def test_level_2_reproduces_four_scenes():
    found, repeated = train_level(steps=90, num_timesteps=10)
    assert found >= 0.9 > repeated, (found, repeated)


@pytest.mark.slow
def test_level_2_reproduces_four_scenes_in_100_steps():
    found, repeated = train_level(steps=400, num_timesteps=100)
    assert found >= 0.98 and repeated < 0.9, (found, repeated)


def test_pipeline_samples_all_levels():
    pipeline = Pipeline(make_networks())
    grids = pipeline.sample(make_generators(1))
    assert pipeline.shape == (32, 32, 16) and tuple(grids) == pipeline.factors
    assert [tuple(grid.shape) for grid in grids.values()] == [(1, 4, 4, 4), (1, 8, 8, 8), (1, 32, 32, 16)]
    assert all(grid.dtype == torch.uint8 and grid.max() < NUM_CLASSES for grid in grids.values())


def test_scenes_depend_only_on_their_generator():
    pipeline = Pipeline(make_networks())
    both = pipeline.sample(make_generators(1, 2))
    each = [pipeline.sample(make_generators(key)) for key in (1, 2)]
    for factor, grids in both.items():
        assert torch.equal(grids, torch.cat([one[factor] for one in each])) and not torch.equal(grids[0], grids[1])


def test_inpainting_keeps_known_columns_and_scenes_apart():
    """Scenes with other unknown columns need other blocks. The columns to generate are not read."""
    pipeline = Pipeline(make_networks())
    voxels = torch.randint(0, NUM_CLASSES, (2, 32, 32, 16), generator=make_keyed_generator(1), dtype=torch.uint8)
    unknown = torch.zeros(2, 32, 32, dtype=torch.bool)
    unknown[0, 3:9, 5:30], unknown[1, :, 16:] = True, True
    found = pipeline.inpaint(voxels, unknown, make_generators(1, 2))
    assert torch.equal(found[~unknown], voxels[~unknown])
    assert (found[unknown] != voxels[unknown]).double().mean() > 0.5
    hidden = voxels.masked_fill(unknown[..., None], 3)
    each = [pipeline.inpaint(hidden[k : k + 1], unknown[k : k + 1], make_generators(k + 1)) for k in range(2)]
    assert torch.equal(found, torch.cat(each))


def test_inpainting_conditions_all_levels(monkeypatch):
    pipeline = Pipeline(make_networks())
    voxels = torch.full((1, 32, 32, 16), 5, dtype=torch.uint8)
    unknown = torch.zeros(1, 32, 32, dtype=torch.bool)
    unknown[:, :, 10:] = True
    calls = []

    def record(network, coarse, generators, given=None, known=None):
        calls.append((given, known))
        return generate_level(network, coarse, generators, given, known)

    monkeypatch.setattr("models.baselines.pdd.pipeline.generate_level", record)
    pipeline.inpaint(voxels, unknown, make_generators(1))
    for (given, known), cols in zip(calls, (1, 2, 10), strict=True):
        assert known[:, :, :cols].all() and not known[:, :, cols:].any()
        assert (given[:, :, :cols] == 5).all() and not given[:, :, cols + 1 :].any()


def test_blocks_see_blocks_that_were_generated_before():
    network, seen = make_networks()["level3"], []
    network.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[2][0, 1]))
    grid = generate_level(network, torch.ones(1, 8, 8, 8, dtype=torch.int64), make_generators(1))[0]
    steps = network.config.num_timesteps
    first, second, third, last = seen[::steps]
    assert not first.any()
    assert torch.equal(second[:, 0], grid[:16, 15]) and not second[:, 1:].any()
    assert torch.equal(third[0], grid[15, :16]) and not third[1:].any()
    assert torch.equal(last[0, 1:], grid[15, 17:]) and torch.equal(last[1:, 0], grid[17:, 15])


def test_outpainting_keeps_the_given_scene():
    pipeline = Pipeline(make_networks())
    voxels = torch.randint(0, NUM_CLASSES, (1, 32, 32, 16), generator=make_keyed_generator(1), dtype=torch.uint8)
    found = pipeline.outpaint(voxels, 1, 3, make_generators(1))
    step = round(32 * (1 - 0.1875))
    assert found.shape == (1, 32, 32 + 2 * step, 16)
    assert torch.equal(found[:, :, step : step + 32], voxels)
    assert found[:, :, :step].unique().numel() > 3 and found[:, :, step + 32 :].unique().numel() > 3


def test_pipeline_rejects_networks_and_grids_that_do_not_fit():
    networks = make_networks()
    with pytest.raises(ValueError, match="level2 is missing"):
        Pipeline({name: network for name, network in networks.items() if name != "level2"})
    with pytest.raises(ValueError, match=r"level1 has the shape \(8, 4, 4\), expected \(4, 4, 4\)"):
        Pipeline(make_networks(level1={"shape": (8, 4, 4), "block": (8, 4)}))
    pipeline = Pipeline(networks)
    with pytest.raises(ValueError, match="expected \\(32, 32, 16\\)"):
        pipeline.inpaint(
            torch.zeros(1, 8, 8, 8, dtype=torch.uint8), torch.ones(1, 8, 8, dtype=torch.bool), make_generators(1)
        )
    with pytest.raises(ValueError, match="pdd has no autoencoder"):
        pipeline.reconstruct(torch.zeros(1, 32, 32, 16, dtype=torch.uint8))
