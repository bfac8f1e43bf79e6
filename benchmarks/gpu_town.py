"""Train both networks of the town model on one machine with a GPU, without Ray and without internet access.

    python benchmarks/gpu_town.py --output DIR --start-from LVAE --lvae-seconds 180 --dit-seconds 360
    python benchmarks/gpu_town.py --output DIR --start-from LVAE --cpu --towns 2 --test-towns 1 --scenes-per-town 8

Processes make town scenes while the layout VAE trains. Then the scenes are encoded, and the diffusion transformer
trains on the latents. Models, losses and optimisers are those of jobs/train_lvae.py and jobs/train_dit.py, and the
scenes are those of jobs/preprocess_scenes.py with --town-version 2. For speed, four things differ:

* all scenes and latents are kept in GPU memory
* random numbers are drawn on the GPU, so they differ between devices
* primitives are matched by the auction algorithm of Bertsekas on the GPU, almost optimally (`match_by_auction`)
* learning rates follow the clock, so a training ends in time

The layout with its slots and bounds is that of the layout VAE of --start-from. The thresholds of the density labels are
those of a dataset.json (--thresholds) or of the training scenes. DIR/latents.json and the files DIR/lvae-*.safetensors
and DIR/dit-*.safetensors hold the results, in files of at most 15 MB.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from models import training
from models.batch import LayoutBatch
from models.dit import DiT
from models.labels import LABELS, compose_label, find_label_index
from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.presets import DIT_PRESETS, LVAE_PRESETS
from models.scene import VEGETATION, VEHICLES
from models.tensors import encode_layout
from models.training import DiffusionLossConfig, ExecutionConfig, OptimizerConfig, make_dit_settings, make_lvae_settings
from models.vae import losses
from models.vae.matching import PAPER_WEIGHTS, MatchWeights, compute_match_cost
from pipelines.metrics.frechet import Moments, compute_frechet_distance, compute_moments
from pipelines.preprocess.sources.town.generator import (
    TEST_SEEDS_START,
    TRAIN_SEEDS_START,
    generate_town,
    select_town_poses,
)
from pipelines.schema.density_labels import DensityThresholds, classify_density, compute_density_thresholds

FREE_POSE_SHARE = 0.25
HEIGHT_OFFSET = 32768  # Heights are stored as (height + offset) / 2, from 0.5 below the bounds to 0.5 above them.
AUCTION_STEP = 0.01
AUCTION_CANDIDATES = 24  # Cheapest proposals of each primitive that take part in the auction.
AUCTION_ROUNDS = 200
AUCTION_GROWTH = 1.05  # Growth of the step per round, without which a few primitives would bid for thousands of rounds.
NOMINAL_STEPS = 10_000  # Steps of the schedules, which are stretched over the time of a training.
SAVE_SECONDS = 60.0
NO_LOGVAR = -60.0  # Log-variance of posteriors that are replaced by their means.


# ------------------------------------------------------------------------------------------------------- scenes


@dataclass(frozen=True)
class PackedTown:
    """The scenes of a town in little memory: bits of the masks, and heights of the occupied pixels."""

    bits: np.ndarray  # (n, pixels / 8) uint8
    heights: np.ndarray  # (occupied pixels of all scenes,) uint16
    occupied: np.ndarray  # (n,) number of occupied pixels
    features: np.ndarray  # (n, slots, 9) float32
    real: np.ndarray  # (n, slots) bool
    free_pose: np.ndarray  # (n,) bool
    groups: np.ndarray  # (n, 4): count and volume (m3) of vegetation, count and volume of vehicles


def pack_town(task: tuple[int, int, dict[str, Any]]) -> PackedTown:
    """Make and encode the scenes of a town: (seed, number of scenes, layout)."""
    seed, scenes, layout = task
    spec, num_free = LayoutSpec.from_dict(layout), round(FREE_POSE_SHARE * scenes)
    drive = generate_town(seed, 2, num_free)
    drive = drive.at(select_town_poses(len(drive), scenes, num_free))
    bits, heights, features, real, groups = [], [], [], [], []
    for k in range(len(drive)):
        scene = drive.scene(k, grid=spec.grid)
        found = encode_layout(scene, spec, clip_heights=False)
        bits.append(np.packbits(found["occupied"].reshape(-1)))
        stored = (found["height"][found["occupied"]] + HEIGHT_OFFSET) >> 1
        heights.append(stored.clip(0, 65535).astype(np.uint16))
        features.append(found["features"])
        real.append(found["real"])
        members = [np.isin(scene.category, group) for group in (VEGETATION, VEHICLES)]
        groups.append([value for m in members for value in (m.sum(), scene.volume_m3[m].sum())])
    free = np.arange(len(drive)) >= len(drive) - num_free
    return PackedTown(
        np.stack(bits),
        np.concatenate(heights),
        np.array([len(one) for one in heights]),
        np.stack(features),
        np.stack(real),
        free,
        np.array(groups, np.float64),
    )


class Pool:
    """Scenes of several towns in the memory of the device."""

    def __init__(self, spec: LayoutSpec, capacity: int, device: torch.device) -> None:
        self.device, self.capacity = device, capacity
        self.shape = (len(spec.ground_classes), spec.grid.rows, spec.grid.cols)
        pixels = int(np.prod(self.shape))
        self.bits = torch.zeros(self.capacity, pixels // 8, dtype=torch.uint8, device=device)
        self.heights = torch.zeros(
            int(self.capacity * 1.1 * spec.grid.rows * spec.grid.cols), dtype=torch.int16, device=device
        )
        self.features = torch.zeros(self.capacity, spec.num_slots, 9, device=device)
        self.real = torch.zeros(self.capacity, spec.num_slots, dtype=torch.bool, device=device)
        self.offset = torch.zeros(self.capacity, dtype=torch.long, device=device)
        self.free_pose, self.groups = np.zeros(self.capacity, bool), np.zeros((self.capacity, 4))
        self.shifts = torch.arange(7, -1, -1, dtype=torch.uint8, device=device)
        self.size = self.filled = 0

    def add(self, town: PackedTown) -> None:
        here = slice(self.size, self.size + len(town.bits))
        end = self.filled + len(town.heights)
        if end > len(self.heights):
            raise ValueError(f"the scenes have more than {len(self.heights)} occupied pixels")
        self.bits[here] = torch.from_numpy(town.bits).to(self.device)
        self.heights[self.filled : end] = torch.from_numpy(town.heights.view(np.int16)).to(self.device)
        self.features[here] = torch.from_numpy(town.features).to(self.device)
        self.real[here] = torch.from_numpy(town.real).to(self.device)
        first = self.filled + np.cumsum(town.occupied) - town.occupied
        self.offset[here] = torch.from_numpy(first).to(self.device)
        self.free_pose[here], self.groups[here] = town.free_pose, town.groups
        self.size, self.filled = here.stop, end

    def unpack(self, index: Tensor, clip: bool) -> dict[str, Tensor]:
        """Return compact arrays like `encode_layout`, with int32 heights."""
        mask = (self.bits[index][..., None] >> self.shifts).bitwise_and(1).flatten(1).bool()
        place = mask.cumsum(1, dtype=torch.int32).clamp(min=1) - 1
        stored = self.heights[self.offset[index][:, None] + place].int() & 0xFFFF
        height = (2 * stored - HEIGHT_OFFSET) * mask
        height = height.clamp(0, 65535) if clip else height
        return {
            "height": height.unflatten(1, self.shape),
            "occupied": mask.unflatten(1, self.shape),
            "features": self.features[index],
            "real": self.real[index],
        }

    def labels(self, thresholds: list[DensityThresholds]) -> Tensor:
        """Return the index of each scene's partial label."""
        vegetation, vehicle = (
            classify_density(self.groups[: self.size, 2 * k], self.groups[: self.size, 2 * k + 1], limits)
            for k, limits in enumerate(thresholds)
        )
        names = [
            str(compose_label("partial", str(first), str(second), bool(free)))
            for first, second, free in zip(vegetation, vehicle, self.free_pose[: self.size], strict=True)
        ]
        return torch.tensor([find_label_index("partial", name) for name in names], device=self.device)


# ----------------------------------------------------------------------------------------------------- training


@torch.no_grad()
def match_by_auction(
    features: Tensor,
    existence_logit: Tensor,
    truth: Tensor,
    real: Tensor,
    slots: tuple[int, ...],
    proposals: tuple[int, ...],
    weights: MatchWeights = PAPER_WEIGHTS,
) -> Tensor:
    """Assign each proposal to a true slot or to padding, like `match_primitives`, without leaving the device.

    Unassigned primitives bid for proposals at the same time. A bid raises the price of a proposal by the advantage over
    the second-best proposal, plus a growing step. Only the AUCTION_CANDIDATES cheapest proposals of a primitive take
    part. A primitive that has no proposal after AUCTION_ROUNDS is ignored.
    """
    batch, total = existence_logit.shape
    costs, places, owners = [], [], []
    first_slot, first_proposal = np.cumsum([0, *slots[:-1]]).tolist(), np.cumsum([0, *proposals[:-1]]).tolist()
    counts = torch.stack([group.sum(dim=1).max() for group in real.split(slots, dim=1)]).tolist()
    samples = torch.arange(batch, device=real.device)[:, None]
    for slot, proposal, most, width in zip(first_slot, first_proposal, counts, proposals, strict=True):
        if not most:
            continue
        mine = slice(proposal, proposal + width)
        theirs = slice(slot, slot + most)
        cost = compute_match_cost(features[:, mine], existence_logit[:, mine], truth[:, theirs], weights)
        cost, place = cost.topk(min(AUCTION_CANDIDATES, width), dim=2, largest=False)
        kept = real[:, theirs]
        pad = AUCTION_CANDIDATES - cost.shape[2]
        costs.append(torch.nn.functional.pad(cost[kept], (0, pad), value=torch.inf))
        places.append(
            torch.nn.functional.pad(
                (place + proposal + total * samples[..., None])[kept], (0, pad), value=batch * total
            )
        )
        owners.append((torch.arange(slot, slot + most, device=real.device) + 0 * samples)[kept])
    assignment = torch.full((batch * total + 1,), -1, dtype=torch.long, device=real.device)
    if not costs:
        return assignment[:-1].view(batch, total)
    cost, place, slot_of_row = torch.cat(costs), torch.cat(places), torch.cat(owners)
    price = torch.zeros(batch * total + 1, device=real.device)
    owner = torch.full_like(assignment, -1)
    waiting = torch.arange(len(cost), device=real.device)
    for number in range(AUCTION_ROUNDS):
        values, best = (cost[waiting] + price[place[waiting]]).topk(2, dim=1, largest=False)
        column = place[waiting].gather(1, best[:, :1])[:, 0]
        bid = price[column] + (values[:, 1] - values[:, 0]).clamp(max=1e3) + AUCTION_STEP * AUCTION_GROWTH**number
        highest = torch.full_like(price, -1).scatter_reduce_(0, column, bid, "amax")
        is_highest = bid >= highest[column]
        winner = torch.full_like(owner, -1).scatter_reduce_(0, column, torch.where(is_highest, waiting, -1), "amax")
        won = winner[column] == waiting
        column, rows = column[won], waiting[won]
        evicted = owner[column]
        owner[column], price[column] = rows, bid[won]
        waiting = torch.cat([waiting[~won], evicted[evicted >= 0]])
        if not len(waiting):
            break
    assignment = torch.where(owner >= 0, slot_of_row[owner.clamp(min=0)], -1)
    return assignment[:-1].view(batch, total)


def draw_on_device() -> None:
    """Replace the random numbers of `models.training` by those of the device, and the matching by the auction."""

    def sample_noise(generators: list, shape: tuple[int, ...], device: torch.device, count: int = 1) -> Tensor:
        return torch.randn(count, len(generators), *shape, device=device)

    def sample_uniform(generators: list, count: int, device: torch.device) -> Tensor:
        return torch.rand(len(generators), count, device=device)

    def sample_corruption(generators: list, shape: tuple[int, ...], spread: float, device: torch.device) -> Tensor:
        scale = torch.randn(len(generators), *[1] * len(shape), device=device).abs() * spread
        return torch.randn(len(generators), *shape, device=device) * scale

    training.sample_noise = sample_noise
    training.sample_uniform = sample_uniform
    training.sample_corruption = sample_corruption
    training.make_keyed_generator = lambda *key: None  # pyright: ignore[reportAttributeAccessIssue]
    losses.match_primitives = match_by_auction


CLOCK: dict[str, float] = {}


class TimedSettings(OptimizerConfig):
    """Options whose schedule follows the clock."""

    def at(self, step: int) -> tuple[float, float]:
        """Return the learning rate and beta1 at this time; `step` is ignored."""
        share = (time.perf_counter() - CLOCK["start"]) / CLOCK["seconds"]
        return super().at(min(int(share * NOMINAL_STEPS), NOMINAL_STEPS - 1))


def start_clock(settings: OptimizerConfig, seconds: float) -> TimedSettings:
    CLOCK.update(start=time.perf_counter(), seconds=seconds)
    return TimedSettings(**{name: getattr(settings, name) for name in OptimizerConfig.__dataclass_fields__})


def is_running() -> bool:
    return time.perf_counter() - CLOCK["start"] < CLOCK["seconds"]


def log(*text: object) -> None:
    print(f"{time.perf_counter() - START:7.1f} s ", *text, flush=True)


START = time.perf_counter()


def save_parts(state: dict[str, Tensor], path: Path, dtype: torch.dtype) -> None:
    """Write weights in files of at most 15 MB."""
    parts, size = [{}], 0
    for name, value in state.items():
        value = value.detach().to("cpu", dtype).contiguous()
        size += value.numel() * value.element_size()
        if size > 15e6:
            parts.append({})
            size = value.numel() * value.element_size()
        parts[-1][name] = value
    for k, part in enumerate(parts):
        save_file(part, f"{path}-{k}.safetensors")


def train_lvae(setup: argparse.Namespace, model: LayoutVAE, pool: Pool, towns: Iterator[PackedTown | None]) -> None:
    """Train the layout VAE on the scenes that are finished."""
    preset = LVAE_PRESETS["town"]
    settings = replace(
        make_lvae_settings(preset),
        steps=NOMINAL_STEPS,
        learning_rate=setup.lvae_rate,
        final_learning_rate=preset.final_learning_rate,
        warmup_steps=NOMINAL_STEPS // 100,
    )
    model.train().requires_grad_(True)
    trainer = training.make_lvae_trainer(
        model,
        start_clock(settings, setup.lvae_seconds),
        preset.kl_weight,
        pool.device,
        execution=ExecutionConfig(precision="fp32"),
        latent_noise=preset.latent_noise,
    )
    found: dict[str, list[float]] = {}
    while is_running():
        for _ in range(setup.towns):
            if pool.size < pool.capacity and (town := next(towns)) is not None:
                pool.add(town)
            else:
                break
        index = torch.randint(pool.size, (setup.lvae_batch,), device=pool.device)
        losses_ = trainer.step(pool.unpack(index, clip=True), range(setup.lvae_batch))
        if trainer.steps_done % 20 == 0:
            for name, value in losses_.items():
                found.setdefault(name, []).append(float(value))
        if trainer.steps_done % setup.log_every == 0 and found:
            text = "  ".join(f"{name} {np.mean(values):.4f}" for name, values in found.items())
            log(f"layout VAE, step {trainer.steps_done}, {pool.size} scenes:", text)
            found.clear()
    log(f"layout VAE: {trainer.steps_done} steps of {setup.lvae_batch}")
    model.eval().requires_grad_(False)
    save_parts(dict(model.state_dict()), setup.output / "lvae", torch.float32)


@torch.no_grad()
def measure_lvae(model: LayoutVAE, pool: Pool, size: int) -> dict[str, float]:
    """Return the mean losses of all scenes of a pool, without noise."""
    total: dict[str, float] = {}
    count = 0
    for index in torch.arange(pool.size, device=pool.device).split(size):
        batch = LayoutBatch.from_compact(pool.unpack(index, clip=True))
        noise = torch.zeros(len(index), *model.latent_shape, device=pool.device)
        output, posterior = model(batch, noise, None, None)
        parts = losses.compute_lvae_loss(output.float(), posterior.float(), batch, model.spec, 0.0).items()
        for name, value in parts.items():
            total[name] = total.get(name, 0.0) + float(value) * len(index)
        count += len(index)
    return {name: value / count for name, value in total.items()}


@torch.no_grad()
def encode(model: LayoutVAE, pool: Pool, size: int) -> tuple[Tensor, Tensor]:
    """Return the means and log-variances of the latents of all scenes, in float16."""
    mean = torch.empty(pool.size, *model.latent_shape, dtype=torch.float16, device=pool.device)
    logvar = torch.empty_like(mean)
    for index in torch.arange(pool.size, device=pool.device).split(size):
        posterior = model.encode(LayoutBatch.from_compact(pool.unpack(index, clip=False)))
        mean[index], logvar[index] = posterior.mean.half(), posterior.logvar.half()
    return mean, logvar


@torch.no_grad()
def compute_channel_statistics(mean: Tensor) -> tuple[list[float], list[float]]:
    """Return mean and standard deviation of each channel."""
    parts = mean.split(4096)
    cells = len(mean) * mean.shape[2] * mean.shape[3]
    total = sum(part.double().sum(dim=(0, 2, 3)) for part in parts)
    square = sum((part.double() ** 2).sum(dim=(0, 2, 3)) for part in parts)
    shift = torch.as_tensor(total) / cells
    return shift.tolist(), (torch.as_tensor(square) / cells - shift**2).clamp(min=1e-12).sqrt().tolist()


def draw_latents(model: DiT, data: dict[str, Tensor], index: Tensor) -> Tensor:
    """Return normalised latents of scenes, drawn from their posteriors like those of the training."""
    statistics = (model.config.shift, model.config.scale)
    shift, scale = (torch.tensor(values, device=model.device)[:, None, None] for values in statistics)
    mean, sigma = data["mean"][index].float(), (0.5 * data["logvar"][index].float()).exp()
    return (mean + sigma * torch.randn_like(mean) - shift) / scale


@torch.no_grad()
def measure_dit(model: DiT, data: dict[str, Tensor], scenes: int) -> list[float]:
    """Return the mean squared error of v for each of ten timesteps; it is 1 for a network that returns zero."""
    errors = []
    for step in range(50, 1000, 100):
        total = 0.0
        for index in torch.arange(scenes, device=model.device).split(256):
            clean = draw_latents(model, data, index)
            noise = torch.randn_like(clean)
            timestep = torch.full((len(index),), step, device=model.device)
            noise_share, signal = model.noise_shares[step]
            with torch.autocast(model.device.type, torch.bfloat16):
                noisy = signal * clean + noise_share * noise
                estimate = model(noisy, timestep, data["label"][index]).float()
            # The network returns the noise. The error of v is the error of the noise divided by the signal.
            total += float((((noise - estimate) / signal) ** 2).flatten(1).mean(1).sum())
        errors.append(total / scenes)
    return errors


@torch.no_grad()
def sample_latents(model: DiT, labels: Tensor, steps: int = 25, seed: int = 0) -> Tensor:
    """Sample normalised latents with DDIM, without guidance."""
    generator = torch.Generator(model.device).manual_seed(seed)
    channels, size = model.config.channels, model.config.size
    path = torch.linspace(999, 0, steps + 1).long().tolist()
    parts = []
    for label in labels.split(500):
        latent = torch.randn(len(label), channels, size, size, generator=generator, device=model.device)
        for start, end in pairwise(path):
            timestep = torch.full((len(label),), start, device=model.device)
            with torch.autocast(model.device.type, torch.bfloat16):
                estimate = model(latent, timestep, label).float()
            noise_share, signal = model.noise_shares[start]
            clean = (latent - noise_share * estimate) / signal
            latent = clean if end == 0 else model.noise_shares[end, 1] * clean + model.noise_shares[end, 0] * estimate
        parts.append(latent)
    return torch.cat(parts)


class LatentDistance:
    """Frechet distance of features of latents, for comparisons of trainings with the same layout VAE.

    A random convolutional network computes the features: the mean of each channel over the latent. The ceiling is the
    distance of the test split.
    """

    def __init__(self, data: dict[str, Tensor], test: dict[str, Tensor], model: DiT) -> None:
        generator = torch.Generator().manual_seed(0)
        channels, device = model.config.channels, model.device
        self.first = (torch.randn(96, channels, 3, 3, generator=generator) / (9 * channels) ** 0.5).to(device)
        self.second = (torch.randn(192, 96, 3, 3, generator=generator) / (9 * 48) ** 0.5).to(device)
        chosen = torch.randperm(len(data["mean"]), device=device)[:20_000]
        self.real = self.summarise(draw_latents(model, data, part) for part in chosen.split(1000))
        some = torch.arange(len(test["mean"]), device=device)
        self.ceiling = self.measure(draw_latents(model, test, part) for part in some.split(1000))

    @torch.no_grad()
    def summarise(self, latents: Iterable[Tensor]) -> Moments:
        """Return the moments of the features of normalised latents, which come in parts."""
        found = []
        for x in latents:
            x = torch.nn.functional.conv2d(x, self.first, stride=1).relu()
            x = torch.nn.functional.conv2d(x, self.second, stride=2).relu()
            found.append(x.mean(dim=(2, 3)).double().cpu().numpy())
        return compute_moments(np.concatenate(found))

    def measure(self, latents: Iterable[Tensor]) -> float:
        """Return the Frechet distance between latents and those of the training split."""
        return compute_frechet_distance(self.real, self.summarise(latents))


@dataclass(frozen=True)
class Variant:
    """Options of a training of the transformer."""

    name: str
    seconds: float
    batch: int
    loss: DiffusionLossConfig = field(default_factory=DiffusionLossConfig)


class DiTRun:
    """Trainings of the same transformer on latents in the memory of the device, and their comparison."""

    def __init__(self, setup: argparse.Namespace, dit: DiT, data: dict[str, Tensor], test: dict[str, Tensor]) -> None:
        self.setup, self.dit, self.data, self.test = setup, dit, data, test
        self.distance = LatentDistance(data, test, dit)
        self.labels = test["label"]
        self.copy = DiT.from_config(dit.config).to(dit.device).eval()

    def train(self, variant: Variant, start: dict[str, Tensor], save: bool = False) -> tuple[dict[str, Tensor], float]:
        """Train from `start`. Return the averaged weights, and the distance of samples."""
        setup, preset, size = self.setup, DIT_PRESETS["town"], variant.batch
        dit = DiT.from_config(self.dit.config).to(self.dit.device)
        dit.load_state_dict({**dit.state_dict(), **start})
        settings = replace(
            make_dit_settings(preset),
            steps=NOMINAL_STEPS,
            learning_rate=setup.dit_rate,
            final_learning_rate=1e-5,
            warmup_steps=NOMINAL_STEPS // 50,
        )
        trainer = training.make_dit_trainer(
            dit,
            start_clock(settings, variant.seconds),
            preset.label_dropout,
            torch.device(self.data["mean"].device),
            execution=ExecutionConfig(precision="bf16", compile=setup.compile),
            loss_config=variant.loss,
        )
        found: list[float] = []
        saved = time.perf_counter()
        order = torch.zeros(0, dtype=torch.long, device=dit.device)
        while is_running():
            if len(order) < size:
                order = torch.cat([order, torch.randperm(len(self.data["mean"]), device=order.device)])
            index, order = order[:size], order[size:]
            result = trainer.step({name: value[index] for name, value in self.data.items()}, range(size))
            if trainer.steps_done % 20 == 0:
                found.append(float(result["noise_error"]))
            if trainer.steps_done % setup.log_every == 0 and found:
                rate = trainer.settings.at(0)[0]
                log(f"{variant.name}, step {trainer.steps_done}: noise error {np.mean(found):.4f}, rate {rate:.1e}")
                found.clear()
            if save and time.perf_counter() - saved > SAVE_SECONDS:
                save_parts(trainer.ema or {}, setup.output / "dit", torch.float16)
                saved = time.perf_counter()
        log(f"{variant.name}: {trainer.steps_done} steps of {size}")
        weights = trainer.ema or {}
        if save:
            save_parts(weights, setup.output / "dit", torch.float16)
        distance = self.measure(weights)
        scenes = len(self.test["mean"])
        for split, data in (("test", self.test), ("train", self.data)):
            error = measure_dit(self.copy, data, min(scenes, len(data["mean"])))
            log(f"{variant.name}: error of v, {split}: {np.mean(error):.4f} {np.round(error, 3).tolist()}")
        log(f"{variant.name}: distance {distance:.4f} (test split: {self.distance.ceiling:.4f})")
        return weights, distance

    def measure(self, weights: dict[str, Tensor]) -> float:
        """Return the distance of samples of a network with these weights, which `self.copy` keeps."""
        self.copy.load_state_dict({**self.dit.state_dict(), **weights})
        return self.distance.measure(sample_latents(self.copy, self.labels).split(1000))


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--output", type=Path, required=True, help="directory of the weights")
    add("--start-from", required=True, help="layout VAE whose layout and weights are used")
    add("--thresholds", default="", help="dataset.json with the thresholds of the labels")
    add("--towns", type=int, default=600, help="towns of the training split")
    add("--test-towns", type=int, default=4, help="towns of the test split")
    add("--scenes-per-town", type=int, default=200, help="scenes of each town, at most 200")
    add("--processes", type=int, default=max((os.cpu_count() or 1) - 2, 1), help="processes that make scenes")
    add("--first-towns", type=int, default=32, help="towns that the training of the layout VAE waits for")
    add("--lvae-seconds", type=float, default=180.0, help="time of the training of the layout VAE")
    add("--lvae-batch", type=int, default=32)
    add("--lvae-rate", type=float, default=2e-3)
    add("--dit-seconds", type=float, default=360.0, help="time of the training of the transformer")
    add("--compare-seconds", type=float, default=0.0, help="time of each short training before it; 0: none")
    add("--dit-batch", type=int, default=256)
    add("--dit-rate", type=float, default=1e-3)
    add("--sample-posterior", action="store_true", help="draw latents from the posteriors, instead of their means")
    add("--timestep-sampling", choices=("uniform", "logit_normal"), default="uniform")
    add("--no-compile", dest="compile", action="store_false")
    add("--log-every", type=int, default=200)
    add("--cpu", action="store_true", help="rehearsal without a GPU")
    add("--seed", type=int, default=0)
    return parser.parse_args()


def main() -> None:
    setup = parse_arguments()
    if not setup.cpu and not torch.cuda.is_available():
        raise SystemExit("error: this machine has no GPU; add --cpu for a rehearsal")
    try:
        model = LayoutVAE.from_pretrained(setup.start_from)
    except (OSError, ValueError) as error:
        raise SystemExit(f"error: --start-from {setup.start_from}: no layout VAE here ({error})") from error
    setup.output.mkdir(parents=True, exist_ok=True)
    device = torch.device("cpu" if setup.cpu else "cuda")
    torch.manual_seed(setup.seed)
    torch.backends.cudnn.allow_tf32 = False  # Positions need the precision of float32.
    draw_on_device()
    layout = dict(model.config.layout)
    spec = model.spec
    with multiprocessing.get_context("spawn").Pool(setup.processes, os.nice, (10,)) as workers:
        seeds = [*range(TEST_SEEDS_START, TEST_SEEDS_START + setup.test_towns)]
        seeds += range(TRAIN_SEEDS_START, TRAIN_SEEDS_START + setup.towns)
        made = workers.imap(pack_town, [(seed, setup.scenes_per_town, layout) for seed in seeds], chunksize=1)
        pool, test = (Pool(spec, n * setup.scenes_per_town, device) for n in (setup.towns, setup.test_towns))
        for _ in range(setup.test_towns):
            test.add(next(made))
        for _ in range(min(setup.first_towns, setup.towns)):
            pool.add(next(made))
        log(f"{pool.size} scenes")

        def poll() -> Iterator[PackedTown | None]:
            while True:
                try:
                    yield made.next(timeout=0.001)  # pyright: ignore[reportAttributeAccessIssue]
                except multiprocessing.TimeoutError:
                    yield None

        model.to(device)
        log("test losses before the training", measure_lvae(model, test, setup.lvae_batch))
        if setup.lvae_seconds:
            train_lvae(setup, model, pool, poll())
            log("test losses", measure_lvae(model, test, setup.lvae_batch))
        while pool.size < pool.capacity:
            pool.add(next(made))
    log(f"{pool.size} scenes")
    if setup.thresholds:
        stored = json.loads(Path(setup.thresholds).read_text())
        thresholds = [DensityThresholds(**stored[f"{name}_thresholds"]) for name in ("vegetation", "vehicle")]
    else:
        groups = pool.groups[: pool.size]
        thresholds = [compute_density_thresholds(groups[:, k], groups[:, k + 1]) for k in (0, 2)]
    names = ("mean", "logvar")
    data = dict(zip(names, encode(model, pool, 256), strict=True)) | {"label": pool.labels(thresholds)}
    tested = dict(zip(names, encode(model, test, 256), strict=True)) | {"label": test.labels(thresholds)}
    if not setup.sample_posterior:
        for part in (data, tested):
            part["logvar"].fill_(NO_LOGVAR)
    shift, scale = compute_channel_statistics(data["mean"])
    (setup.output / "latents.json").write_text(json.dumps({"channel_mean": shift, "channel_std": scale}))
    del pool, test
    log(f"{len(data['mean'])} latents; labels", torch.bincount(data["label"], minlength=32).tolist())
    channels, size, _ = model.latent_shape
    dit = DiT(
        channels=channels,
        size=size,
        layout=layout,
        label="partial",
        num_labels=len(LABELS["partial"]),
        shift=shift,
        scale=scale,
        **DIT_PRESETS["town"].architecture(),
    ).to(device)
    log(f"transformer with {sum(p.numel() for p in dit.parameters()) / 1e6:.2f} million parameters")
    run = DiTRun(setup, dit, data, tested)
    start = dict(dit.state_dict())
    chosen = Variant("chosen", setup.dit_seconds, setup.dit_batch, DiffusionLossConfig(setup.timestep_sampling))
    if setup.compare_seconds:
        losses_of = {
            "uniform": DiffusionLossConfig(),
            "min-snr": DiffusionLossConfig(loss_weighting="min_snr"),
            "logit-normal": DiffusionLossConfig("logit_normal"),
        }
        variants = [Variant(k, setup.compare_seconds, setup.dit_batch, loss) for k, loss in losses_of.items()]
        variants.append(Variant("uniform, small batch", setup.compare_seconds, setup.dit_batch // 4))
        results = [run.train(variant, start) for variant in variants]
        number = int(np.argmin([distance for _, distance in results[:3]]))
        start, chosen = results[number][0], replace(variants[number], seconds=setup.dit_seconds)
        log("continue with", chosen)
    run.train(chosen, start, save=True)


if __name__ == "__main__":
    main()
