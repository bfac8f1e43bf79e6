"""Training of both stages in torch: optimisation steps, EMA, learning-rate schedule and checkpoints.

This module does not use Ray, so it can also train in a single process. Random numbers depend only on the seed, the step
and the position of the sample in the global batch. The random numbers are therefore the same in a resumed run and for
any number of workers.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from models.base import ConfiguredModel
from models.batch import LayoutBatch
from models.diffusion_model import DiffusionModel
from models.dit import DiT
from models.execution import require_bf16
from models.labels import PART_DROPOUT, list_dropped_labels
from models.layout import FEATURES, LayoutSpec
from models.lvae import LayoutVAE
from models.presets import DiTPreset, LVAEPreset
from models.sampling.diffusion import (
    InpaintCondition,
    finish_drawing,
    join_known,
    make_keyed_generator,
    start_drawing,
)
from models.vae.losses import compute_lvae_loss
from models.vae.matching import NonFiniteCostError


@dataclass(frozen=True)
class OptimizerConfig:
    """Options of AdamW. The learning rate is constant or decays, after an optional linear warm-up.

    Attributes:
        steps: Number of training steps.
        learning_rate: Learning rate at the start of the decay. During a warm-up, it rises to this value.
        weight_decay: Weight decay.
        final_learning_rate: Learning rate of the last step; None: the learning rate does not decay towards one.
        decay: Shape of the decay towards the final learning rate, "cosine" or "linear".
        milestones: Steps from which the learning rate is multiplied by a factor, as pairs (step, factor).
        warmup_steps: Number of initial steps during which the learning rate rises linearly.
        betas: beta1 and beta2 of AdamW.
        cycle_momentum: beta1 at the first step and at the last step. In between, beta1 follows a cosine. None: beta1 is
            constant.
        grad_clip: Largest gradient norm; None: gradients are not clipped.
        ema_decay: Decay of the exponential moving average of the weights; None: no moving average.
        amsgrad: Whether AdamW uses the maximum of past squared gradients (AMSGrad).
        seed: Seed of all random numbers.
    """

    steps: int
    learning_rate: float
    weight_decay: float
    final_learning_rate: float | None = None
    decay: Literal["cosine", "linear"] = "cosine"
    milestones: tuple[tuple[int, float], ...] = ()
    warmup_steps: int = 0
    betas: tuple[float, float] = (0.9, 0.999)
    cycle_momentum: tuple[float, float] | None = None
    grad_clip: float | None = None
    ema_decay: float | None = None
    amsgrad: bool = False
    seed: int = 0

    def to_record(self) -> dict[str, Any]:
        """Return the options by name, without defaults of options that records of earlier versions lack.

        Returns:
            Options.
        """
        later = {"decay": "cosine", "milestones": (), "amsgrad": False}
        return {name: value for name, value in asdict(self).items() if name not in later or value != later[name]}

    def at(self, step: int) -> tuple[float, float]:
        """Return the learning rate and beta1 of a step.

        Args:
            step: Index of the step, starting at 0.

        Returns:
            Learning rate and beta1.
        """
        rate, beta1 = self.learning_rate, self.betas[0]
        if self.final_learning_rate is not None:
            fall = min(step / max(self.steps - 1, 1), 1)
            if self.decay == "cosine":
                fall = (1 - math.cos(math.pi * fall)) / 2
            rate += fall * (self.final_learning_rate - rate)
            if self.cycle_momentum:
                beta1 = self.cycle_momentum[0] + fall * (self.cycle_momentum[1] - self.cycle_momentum[0])
        for start, factor in self.milestones:
            rate *= factor if step >= start else 1
        if step < self.warmup_steps:
            rate *= (step + 1) / self.warmup_steps
        return rate, beta1


@dataclass(frozen=True)
class ExecutionConfig:
    """Options of how a training step is computed. They change the result only by rounding.

    Attributes:
        accumulate: Number of parts into which a batch is split. The parts are computed one after another to save
            memory.
        precision: "fp32", "bf16" or "auto". "auto" selects bf16 if the hardware supports it, otherwise fp32.
        compile: Whether torch compiles the parts of the network that take the most time, in place.

    Raises:
        ValueError: A value is out of range or unknown.
    """

    accumulate: int = 1
    precision: str = "auto"
    compile: bool = False

    def __post_init__(self) -> None:
        if self.accumulate < 1 or self.precision not in ("auto", "fp32", "bf16"):
            raise ValueError(
                f"accumulate is {self.accumulate}, precision {self.precision!r}; "
                "expected 1 or more, and auto, fp32 or bf16"
            )

    def autocast(self, device: torch.device) -> torch.autocast:
        """Return the autocast context for a device.

        Args:
            device: Device of the training.

        Returns:
            Autocast context, which has no effect for fp32.
        """
        fast = device.type == "cuda" and torch.cuda.is_bf16_supported(including_emulation=False)
        wanted = self.precision == "bf16" or (self.precision == "auto" and fast)
        return torch.autocast(device.type, torch.bfloat16, enabled=wanted)


def make_lvae_settings(preset: LVAEPreset, seed: int = 0) -> OptimizerConfig:
    """Return the optimiser options of a preset of the layout VAE.

    Args:
        preset: Preset.
        seed: Seed of all random numbers.

    Returns:
        Options; beta1 has the defaults of torch's OneCycleLR, as in SLEDGE.
    """
    return OptimizerConfig(
        steps=preset.steps,
        learning_rate=preset.learning_rate,
        final_learning_rate=preset.final_learning_rate,
        weight_decay=preset.weight_decay,
        warmup_steps=preset.warmup_steps,
        cycle_momentum=(0.85, 0.95),
        grad_clip=preset.grad_clip or None,
        ema_decay=preset.ema_decay,
        seed=seed,
    )


def make_dit_settings(preset: DiTPreset, seed: int = 0) -> OptimizerConfig:
    """Return the optimiser options of a preset of the diffusion transformer.

    Args:
        preset: Preset.
        seed: Seed of all random numbers.

    Returns:
        Options; the betas are those of SLEDGE.
    """
    return OptimizerConfig(
        steps=preset.steps,
        learning_rate=preset.learning_rate,
        weight_decay=preset.weight_decay,
        betas=(0.95, 0.999),
        grad_clip=preset.grad_clip,
        ema_decay=preset.ema_decay,
        seed=seed,
    )


class NonFiniteLossError(ValueError):
    """Raised when a loss is not finite.

    Attributes:
        step: Index of the step.
        positions: Positions (in the global batch) of the samples whose loss is not finite. If this is the case for all
            samples, the list is empty.
    """

    def __init__(self, step: int, positions: list[int]) -> None:
        which = f"samples {positions} of the batch" if positions else "all samples, because the weights are invalid"
        super().__init__(f"step {step}: the loss is not finite for {which}; lower the learning rate")
        self.step, self.positions = step, positions


LossFunction = Callable[[Callable[..., Any], dict[str, Tensor], list[torch.Generator]], dict[str, Tensor]]


def sample_noise(
    generators: list[torch.Generator], shape: tuple[int, ...], device: torch.device, count: int = 1
) -> Tensor:
    """Draw standard normal noise with one generator per sample.

    Args:
        generators: One generator per sample.
        shape: Shape of the noise of one sample.
        device: Device of the result.
        count: Number of draws of each sample, one after another.

    Returns:
        (count, b, *shape) noise.
    """
    if device.type == "cuda":  # For large batches, one thread would need longer than the GPU for the step.
        return finish_drawing(*start_drawing(generators, shape, device, count), device)
    drawn = [[torch.randn(shape, generator=generator) for generator in generators] for _ in range(count)]
    return torch.stack([torch.stack(one) for one in drawn]).to(device)


def sample_uniform(generators: list[torch.Generator], count: int, device: torch.device) -> Tensor:
    """Draw random numbers between 0 and 1 with one generator per sample.

    Args:
        generators: One generator per sample.
        count: Number of random numbers per sample.
        device: Device of the result.

    Returns:
        (b, count) random numbers.
    """
    return copy_without_waiting(torch.stack([torch.rand(count, generator=g) for g in generators]), device)


def copy_without_waiting(values: Tensor, device: torch.device) -> Tensor:
    """Copy a tensor to a device. A copy from memory that is not pinned would wait for earlier work of a GPU.

    Args:
        values: Tensor on any device.
        device: Device of the result.

    Returns:
        Tensor on the device.
    """
    if device.type == "cuda" and values.device.type == "cpu":
        values = values.pin_memory()
    return values.to(device, non_blocking=True)


def sample_corruption(
    generators: list[torch.Generator], shape: tuple[int, ...], spread: float, device: torch.device
) -> Tensor:
    """Draw normal noise. Each sample has a random standard deviation |s|, where s is drawn from N(0, spread^2).

    Args:
        generators: One generator per sample.
        shape: Shape of the noise of one sample.
        spread: Scale of the standard deviations.
        device: Device of the result.

    Returns:
        (b, *shape) noise.
    """
    drawn = [torch.randn(shape, generator=g) * torch.randn((), generator=g).abs() * spread for g in generators]
    return copy_without_waiting(torch.stack(drawn), device)


def make_layout_loss(
    spec: LayoutSpec,
    latent_shape: tuple[int, int, int],
    kl_weight: float,
    latent_noise: float = 0.0,
    denoising_groups: int = 0,
) -> LossFunction:
    """Return the loss function of stage 1 (training of the layout VAE).

    Args:
        spec: Layout of the scenes.
        latent_shape: Shape (c, h, w) of a latent.
        kl_weight: Weight of the KL loss.
        latent_noise: Scale of the noise that is added to training latents (`sample_corruption`); 0: no noise.
        denoising_groups: Number of groups of denoising queries (`ObjectConfig.denoising_groups`).

    Returns:
        A function that computes the parts of the objective from compact layouts (`tensors.encode_layout`).
    """

    def loss(
        model: Callable[..., Any], arrays: dict[str, Tensor], generators: list[torch.Generator]
    ) -> dict[str, Tensor]:
        device = arrays["real"].device
        batch = LayoutBatch.from_compact(arrays)
        (noise,) = sample_noise(generators, latent_shape, device)
        corruption = sample_corruption(generators, latent_shape, latent_noise, device) if latent_noise else None
        query_shape = (denoising_groups, spec.num_slots, FEATURES)
        query_noise = sample_noise(generators, query_shape, device)[0] if denoising_groups else None
        output, posterior = model(batch, noise, corruption, query_noise)
        with torch.autocast(device.type, enabled=False):  # Losses and matching costs are computed in float32.
            output, posterior = output.float(), posterior.float()
            parts = compute_lvae_loss(output, posterior, batch, spec, kl_weight).items()
        return parts | {"latent_std": posterior.mean.std(), "latent_sigma": (0.5 * posterior.logvar).exp().mean()}

    return loss


TimestepSampling = Literal["uniform", "logit_normal"]
LossWeighting = Literal["uniform", "min_snr"]
MIN_SNR_GAMMA = 5.0  # Value of Hang et al. (2023).
# Mean and standard deviation of logit(t / 1000). Half of the timesteps lie between 196 and 552.
LOGIT_NORMAL = (-0.6, 1.2)
# Compiled layers of the object encoder are compiled for each number of slots, of which the paper's 514 slots give five.
# With symbolic sizes, they exceeded dynamo's limit of eight versions on an H200.
COMPILED_SLOT_MULTIPLE = 128


def sample_timesteps(uniform: Float[Tensor, " b"], density: TimestepSampling, num_timesteps: int) -> Int[Tensor, " b"]:
    """Convert uniform random numbers to training timesteps.

    The paper uses "uniform". "logit_normal" prefers middle timesteps, as in SD3 (Esser et al., 2024). The existence of
    objects is decided between timesteps 126 and 467. With "uniform", a third of all timesteps lies between 126 and 467.
    With "logit_normal", half of all timesteps lie between 126 and 467.

    Args:
        uniform: Random numbers between 0 and 1.
        density: Density of the timesteps.
        num_timesteps: Number of timesteps of the noise schedule.

    Returns:
        Timesteps.
    """
    if density == "logit_normal":
        uniform = torch.sigmoid(LOGIT_NORMAL[0] + LOGIT_NORMAL[1] * torch.special.ndtri(uniform))
    return (uniform * num_timesteps).long().clamp(max=num_timesteps - 1)


def compute_loss_weight(
    dit: DiffusionModel, timestep: Int[Tensor, " b"], weighting: LossWeighting
) -> Float[Tensor, " b"]:
    """Return the weight of the squared noise error in the training loss.

    The paper uses "uniform": the squared error of the network output has the same weight at every timestep. "min_snr"
    is the weighting of Hang et al. (2023): the squared error of the clean latent has the weight min(SNR, 5), where SNR
    is the ratio of signal and noise variance. Timesteps with little noise thus do not dominate the training.

    Args:
        dit: Model, which defines the noise schedule.
        timestep: Timesteps.
        weighting: Weighting of the timesteps.

    Returns:
        One weight per sample.
    """
    if weighting == "uniform":
        return dit.loss_weight(timestep)
    noise, signal = (dit.noise_shares[timestep] ** 2).unbind(1)
    return (signal / noise).clamp(max=MIN_SNR_GAMMA) * noise / signal


@dataclass(frozen=True)
class DiffusionLossConfig:
    """Options of the loss of stage 2; the defaults are those of the paper.

    Attributes:
        timestep_sampling: Density of the timesteps (`sample_timesteps`).
        loss_weighting: Weighting of the timesteps (`compute_loss_weight`).
        sample_posterior: Whether each step draws latents from the posteriors of the layout VAE. If False, the latents
            are the means of the posteriors.
        known_streets_share: Share of samples that also know the ground of all streets, as blocks that follow a street
            plan. The batches then need the arrays `street_ground` (b, channels / 2, h, w), the latents of scenes
            without other content than streets, and `street_cells` (b, h, w).
    """

    timestep_sampling: TimestepSampling = "uniform"
    loss_weighting: LossWeighting = "uniform"
    sample_posterior: bool = True
    known_streets_share: float = 0.0


def make_diffusion_loss(
    dit: DiffusionModel, label_dropout: float, config: DiffusionLossConfig | None = None
) -> LossFunction:
    """Return the loss function of stage 2 (training of the DiT): mean squared error of the noise (Eq. "LDM").

    With v-prediction, the error is weighted (`compute_loss_weight`). Labels are dropped once per sample. Before, a
    partial label loses each density with the probability PART_DROPOUT.

    Args:
        dit: Model on its device, which defines the noise schedule.
        label_dropout: Probability that a training sample gets the null label.
        config: Options; None: those of the paper.

    Returns:
        A function that computes the losses from a batch of posteriors (`mean`, `logvar`) and labels (`label`). An
        inpainting model receives random known parts (`DiffusionModel.make_known_masks`), which have no error.
    """
    config = config or DiffusionLossConfig()
    diffusion = dit.diffusion
    shape = dit.latent_shape
    shift = torch.tensor(dit.config.shift or [0.0] * shape[0], device=dit.device)[:, None, None]
    scale = torch.tensor(dit.config.scale or [1.0] * shape[0], device=dit.device)[:, None, None]
    parts = list_dropped_labels(dit.config.label)
    remaining = None if parts is None else torch.tensor(parts, device=dit.device)
    num_mask = dit.num_mask_uniform
    share = config.known_streets_share if num_mask else 0.0

    def loss(
        model: Callable[..., Any], arrays: dict[str, Tensor], generators: list[torch.Generator]
    ) -> dict[str, Tensor]:
        mean, label = arrays["mean"].float(), arrays["label"]
        device = mean.device
        # No line below waits for a GPU. Random numbers are thus drawn during the backward pass of the previous step.
        *posterior_noise, noise = sample_noise(generators, shape, device, count=1 + config.sample_posterior)
        count = 2 if remaining is None else 4
        uniform = sample_uniform(generators, count + num_mask + (share > 0), device)
        drawn = mean + (0.5 * arrays["logvar"].float()).exp() * posterior_noise[0] if posterior_noise else mean
        latent = (drawn - shift) / scale
        if num_mask:
            mask = dit.make_known_masks(uniform[:, count : count + num_mask], mean)
        if share:
            half = shape[0] // 2
            streets = (arrays["street_ground"].float() - shift[:half]) / scale[:half]
            is_street = (arrays["street_cells"] > 0) & (uniform[:, -1] < share)[:, None, None]
            follows = is_street[:, None] & (mask[:, :half] > 0)
            latent = torch.cat([torch.where(follows, streets, latent[:, :half]), latent[:, half:]], dim=1)
            mask = torch.cat([mask[:, :half] * ~follows, mask[:, half:]], dim=1)
        timestep = sample_timesteps(uniform[:, 0], config.timestep_sampling, diffusion.num_timesteps)
        if remaining is not None:
            dropped = (uniform[:, 2:4] < PART_DROPOUT).long()
            label = remaining[label, dropped[:, 0] + 2 * dropped[:, 1]]
        label = torch.where(uniform[:, 1] < label_dropout, dit.null_label, label)
        noisy = diffusion.add_noise(latent, noise, timestep)
        if num_mask:
            noisy = join_known(noisy, InpaintCondition(latent, mask))
        error = F.mse_loss(model(noisy, timestep, label).float(), noise, reduction="none")
        error = (error * mask if num_mask else error).flatten(1).mean(1)
        weight = compute_loss_weight(dit, timestep, config.loss_weighting)
        return {"loss": (weight * error).mean(), "noise_error": error.mean()}

    return loss


class Trainer:
    """Train a model step by step and save checkpoints.

    Saving, loading and resuming does not change the result of a run.

    Args:
        model: Model whose weights are saved.
        loss: Loss function.
        settings: Options of the optimizer.
        device: Device of the training.
        wrapped: Module that is called instead of `model`, such as `model` wrapped in DistributedDataParallel. None:
            `model`.
        execution: Options of the execution; None: the defaults of `ExecutionConfig`.

    Raises:
        ValueError: The options ask for bfloat16, but the GPU has none.
    """

    def __init__(
        self,
        model: ConfiguredModel,
        loss: LossFunction,
        settings: OptimizerConfig,
        device: torch.device,
        wrapped: nn.Module | None = None,
        execution: ExecutionConfig | None = None,
    ) -> None:
        self.model, self.wrapped, self.loss = model, model if wrapped is None else wrapped, loss
        self.settings, self.device, self.execution = settings, device, execution or ExecutionConfig()
        if self.execution.precision == "bf16":
            require_bf16(device)
        self.parameters = {name: p for name, p in model.named_parameters() if p.requires_grad}
        # Maps prefixes of parameter names to factors of the learning rate.
        rates = getattr(model, "learning_rate_factors", dict)()
        share = {n: next((v for part, v in rates.items() if n.startswith(part)), 1.0) for n in self.parameters}
        groups = [
            {"params": [p for n, p in self.parameters.items() if share[n] == value], "share": value}
            for value in sorted(set(share.values()))
        ]
        self.optimiser = torch.optim.AdamW(
            groups,
            settings.learning_rate,
            settings.betas,
            weight_decay=settings.weight_decay,
            amsgrad=settings.amsgrad,
            fused=True,
        )
        self.ema = {n: p.detach().clone() for n, p in self.parameters.items()} if settings.ema_decay else None
        self.steps_done = 0

    def step(self, arrays: dict[str, Tensor], positions: Iterable[int], weight: float = 1.0) -> dict[str, Tensor]:
        """Perform one optimisation step on a local batch.

        Args:
            arrays: Batch of this worker.
            positions: Position in the global batch of each sample in `arrays`.
            weight: Factor of the gradient: the size of this batch, divided by the mean size over all workers.

        Returns:
            Detached losses by name. `grad_norm` is the gradient norm.

        Raises:
            NonFiniteLossError: The loss is not finite. The weights are not changed.
        """
        rate, beta1 = self.settings.at(self.steps_done)
        for group in self.optimiser.param_groups:
            group["lr"], group["betas"] = group["share"] * rate, (beta1, self.settings.betas[1])
        positions = list(positions)
        arrays = {name: copy_without_waiting(value, self.device) for name, value in arrays.items()}
        self.optimiser.zero_grad(set_to_none=True)
        totals: dict[str, Tensor] = {}
        size = -(-len(positions) // self.execution.accumulate)
        for first in range(0, len(positions), size):
            part = slice(first, first + size)
            share = len(positions[part]) / len(positions)
            more = first + size < len(positions)
            no_sync = getattr(self.wrapped, "no_sync", nullcontext)  # Method of DistributedDataParallel.
            with no_sync() if more else nullcontext():
                losses = self._compute_losses(self.wrapped, {k: v[part] for k, v in arrays.items()}, positions[part])
                if losses is None:
                    raise NonFiniteLossError(self.steps_done, self._find_nonfinite_samples(arrays, positions))
                (share * weight * losses["loss"]).backward()
            for name, value in losses.items():
                totals[name] = totals.get(name, 0) + share * value.detach()
        norm = nn.utils.clip_grad_norm_(self.parameters.values(), self.settings.grad_clip or math.inf)
        self.optimiser.step()
        self.steps_done += 1
        self.update_ema()
        return totals | {"grad_norm": norm}

    def _compute_losses(
        self, network: Callable[..., Any], arrays: dict[str, Tensor], positions: list[int]
    ) -> dict[str, Tensor] | None:
        """Return the losses of `network`, or None if the loss is not finite.

        Each sample has its own random generator.
        """
        generators = [make_keyed_generator(self.settings.seed, self.steps_done, position) for position in positions]
        try:
            with self.execution.autocast(self.device):
                losses = self.loss(network, arrays, generators)
        except NonFiniteCostError:
            return None
        return losses if torch.isfinite(losses["loss"]) else None

    @torch.no_grad()
    def _find_nonfinite_samples(self, arrays: dict[str, Tensor], positions: list[int]) -> list[int]:
        """Return the positions of the samples whose loss is not finite. If all losses are non-finite, the list is
        empty.

        The model is called without its wrapper, because DistributedDataParallel would wait for the other workers.
        """
        with self.run_uncompiled():
            bad = [
                position
                for k, position in enumerate(positions)
                if self._compute_losses(self.model, {name: v[k : k + 1] for name, v in arrays.items()}, [position])
                is None
            ]
        return bad if len(bad) < len(positions) else []

    def run_uncompiled(self) -> AbstractContextManager:
        """Return a context in which the network runs without compiled code, for batches of other sizes."""
        return torch.compiler.set_stance("force_eager") if self.execution.compile else nullcontext()

    @torch.no_grad()
    def update_ema(self) -> None:
        """Update the exponential moving average of the weights.

        The decay is min(ema_decay, 1 - (1 + step)^(-3/4)), as in diffusers.
        """
        if self.ema is None or self.settings.ema_decay is None:
            return
        decay = min(self.settings.ema_decay, 1 - (1 + self.steps_done) ** -0.75)
        parameters: list[Tensor] = list(self.parameters.values())
        lerp = torch._foreach_lerp_  # pyright: ignore[reportPrivateImportUsage]
        lerp(list(self.ema.values()), parameters, 1 - decay)

    @torch.no_grad()
    def ema_model(self) -> ConfiguredModel:
        """Return a copy of the model with EMA weights, or the model itself if EMA is off."""
        if not self.ema:
            return self.model
        copy = type(self.model).from_config(self.model.config)
        copy.load_state_dict({**self.model.state_dict(), **self.ema})
        return copy.to(self.device).eval()

    def save(self, directory: str | Path) -> None:
        """Save everything that is needed to resume training exactly, as safetensors and JSON (no pickles).

        `state.json` is written last.

        Args:
            directory: Output directory. The directory is created if it does not exist.
        """
        directory = Path(directory)
        directory.mkdir(parents=True, exist_ok=True)
        tensors = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        tensors |= {f"ema.{name}": value for name, value in (self.ema or {}).items()}
        for name, parameter in self.parameters.items():
            for key, value in self.optimiser.state[parameter].items():
                tensors[f"optimiser.{key}.{name}"] = value
        save_file(
            {name: value.contiguous().cpu() for name, value in tensors.items()}, directory / "training.safetensors"
        )
        state = {"steps_done": self.steps_done, "settings": self.settings.to_record()}
        temporary = directory / "state.json.tmp"
        temporary.write_text(json.dumps(state, indent=1))
        os.replace(temporary, directory / "state.json")

    def load(self, directory: str | Path) -> None:
        """Load a checkpoint written by `save`.

        Args:
            directory: Directory of the checkpoint.

        Raises:
            ValueError: The settings of the checkpoint differ from those of this trainer.
        """
        directory = Path(directory)
        state = json.loads((directory / "state.json").read_text())
        mine = json.loads(json.dumps(self.settings.to_record()))
        for name in sorted(mine.keys() | state["settings"].keys()):
            stored, value = state["settings"].get(name), mine.get(name)
            if stored != value:
                raise ValueError(
                    f"{directory}: the checkpoint was trained with {name}={stored}, "
                    f"asked for {value}; "
                    "use the same options to resume, or another --name for a new run"
                )
        optimiser: dict[str, dict[str, Tensor]] = {name: {} for name in self.parameters}
        model = {}
        for path, value in load_file(directory / "training.safetensors", device=str(self.device)).items():
            kind, name = path.split(".", 1)
            if kind == "model":
                model[name] = value
            elif kind == "ema" and self.ema is not None:
                self.ema[name].copy_(value)
            else:
                key, name = name.split(".", 1)
                optimiser[name][key] = value
        self.model.load_state_dict(model)
        for name, parameter in self.parameters.items():
            self.optimiser.state[parameter] = optimiser[name]
        self.steps_done = state["steps_done"]


Wrap = Callable[[nn.Module], nn.Module]


def make_lvae_trainer(
    model: LayoutVAE,
    settings: OptimizerConfig,
    kl_weight: float,
    device: torch.device,
    wrap: Wrap = lambda m: m,
    execution: ExecutionConfig | None = None,
    latent_noise: float = 0.0,
) -> Trainer:
    """Return a trainer of a layout VAE.

    Args:
        model: Model; it is moved to `device`.
        settings: Options of the optimizer.
        kl_weight: Weight of the KL loss.
        device: Device of the training.
        wrap: Function that wraps the model, for example with DistributedDataParallel; None: no wrapper.
        execution: Options of the execution; None: the defaults of `ExecutionConfig`.
        latent_noise: Scale of the noise that is added to training latents (`sample_corruption`); 0: no noise.

    Returns:
        The trainer.
    """
    execution = execution or ExecutionConfig()
    model = model.to(device)
    groups = model.config.objects["denoising_groups"]
    loss = make_layout_loss(model.spec, model.latent_shape, kl_weight, latent_noise, groups)
    if execution.compile:
        if model.object_encoder:
            model.object_encoder.slot_multiple = COMPILED_SLOT_MULTIPLE
        for part in model.list_parts_to_compile():
            part.compile(dynamic=False)
    return Trainer(model, loss, settings, device, wrap(model), execution)


def make_dit_trainer(
    model: DiffusionModel,
    settings: OptimizerConfig,
    label_dropout: float,
    device: torch.device,
    wrap: Wrap = lambda m: m,
    execution: ExecutionConfig | None = None,
    loss_config: DiffusionLossConfig | None = None,
) -> Trainer:
    """Return a trainer of a diffusion transformer, or of a street planner, which is not compiled.

    Args:
        model: Model; it is moved to `device`.
        settings: Options of the optimizer.
        label_dropout: Probability that a training sample gets the null label.
        device: Device of the training.
        wrap: Function that wraps the model, for example with DistributedDataParallel; None: no wrapper.
        execution: Options of the execution; None: the defaults of `ExecutionConfig`.
        loss_config: Options of the loss; None: those of the paper.

    Returns:
        The trainer.
    """
    execution = execution or ExecutionConfig()
    model = model.to(device)
    loss = make_diffusion_loss(model, label_dropout, loss_config)
    if execution.compile and isinstance(model, DiT):
        for block in model.blocks:  # All blocks share the compiled code.
            block.compile(dynamic=False)
    return Trainer(model, loss, settings, device, wrap(model), execution)


def count_flops(call: Callable[[], object]) -> float:
    """Count the floating-point operations of a call.

    Args:
        call: Function without arguments that runs networks.

    Returns:
        Number of operations; a multiply-add counts as two. The counter of torch does not know the attention kernel of
        CPUs, so attention runs as matrix products (MATH) meanwhile.
    """
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        call()
    return float(counter.get_total_flops())
