"""One optimisation step, EMA, schedule and checkpoint of both stages, in plain torch.

No Ray here: the same code trains alone on a GPU box. Randomness is keyed by (seed, step, position of the sample in
the global batch), so that a resumed run and a run on more workers draw the same numbers.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, cast

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from models.base import ConfiguredModel
from models.batch import LayoutBatch
from models.dit import DiT
from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.sampling.diffusion import Diffusion, make_keyed_generator
from models.vae.losses import compute_lvae_loss
from models.vae.matching import NonFiniteCostError


@dataclass(frozen=True)
class OptimizerConfig:
    """AdamW with a cosine (OneCycle without warm-up) or constant learning rate."""

    steps: int
    learning_rate: float
    weight_decay: float
    final_learning_rate: float | None = None  # None: constant
    warmup_steps: int = 0
    betas: tuple[float, float] = (0.9, 0.999)
    cycle_momentum: tuple[float, float] | None = None  # beta1 from the first to the second as the rate falls
    grad_clip: float | None = None
    ema_decay: float | None = None
    seed: int = 0

    def at(self, step: int) -> tuple[float, float]:
        """Learning rate and beta1 of a step, counted from 0."""
        rate, beta1 = self.learning_rate, self.betas[0]
        if self.final_learning_rate is not None:
            fall = (1 - math.cos(math.pi * min(step / max(self.steps - 1, 1), 1))) / 2
            rate += fall * (self.final_learning_rate - rate)
            if self.cycle_momentum:
                beta1 = self.cycle_momentum[0] + fall * (self.cycle_momentum[1] - self.cycle_momentum[0])
        if step < self.warmup_steps:
            rate *= (step + 1) / self.warmup_steps
        return rate, beta1


@dataclass(frozen=True)
class ExecutionConfig:
    """How steps are computed, not what: the same weights come out, up to rounding."""

    accumulate: int = 1  # parts into which a batch is cut, one after another, where it does not fit memory
    precision: str = "auto"  # fp32, bf16, or auto: bf16 where the device has it in hardware
    compile: bool = False  # torch.compile

    def __post_init__(self) -> None:
        if self.accumulate < 1 or self.precision not in ("auto", "fp32", "bf16"):
            raise ValueError(
                f"accumulate is {self.accumulate}, precision {self.precision!r}; "
                "expected 1 or more, and auto, fp32 or bf16"
            )

    def autocast(self, device: torch.device) -> torch.autocast:
        fast = device.type == "cuda" and torch.cuda.is_bf16_supported(including_emulation=False)
        wanted = self.precision == "bf16" or (self.precision == "auto" and fast)
        return torch.autocast(device.type, torch.bfloat16, enabled=wanted)


class NonFiniteLossError(ValueError):
    """A loss is not finite. `positions` are the samples of the global batch that are to blame, empty if all are."""

    def __init__(self, step: int, positions: list[int]) -> None:
        which = f"of samples {positions} of its batch" if positions else "of every sample: the weights are broken"
        super().__init__(f"step {step}: the loss is not finite because {which}; lower the learning rate")
        self.step, self.positions = step, positions


LossFunction = Callable[[Callable[..., Any], dict[str, Tensor], list[torch.Generator]], dict[str, Tensor]]


def sample_noise(generators: list[torch.Generator], shape: tuple[int, ...], device: torch.device) -> Tensor:
    """(len(generators), *shape) standard normal numbers, one generator per sample."""
    return torch.stack([torch.randn(shape, generator=generator) for generator in generators]).to(device)


def sample_corruption(
    generators: list[torch.Generator], shape: tuple[int, ...], spread: float, device: torch.device
) -> Tensor:
    """(len(generators), *shape) normal numbers, each sample's as large as |N(0, spread^2)| says."""
    drawn = [torch.randn(shape, generator=g) * torch.randn((), generator=g).abs() * spread for g in generators]
    return torch.stack(drawn).to(device)


def make_layout_loss(
    spec: LayoutSpec, latent_shape: tuple[int, int, int], kl_weight: float, latent_noise: float = 0.0
) -> LossFunction:
    """Stage 1: compact layouts (tensors.encode_layout) -> the parts of the LVAE objective."""

    def loss(
        model: Callable[..., Any], arrays: dict[str, Tensor], generators: list[torch.Generator]
    ) -> dict[str, Tensor]:
        device = arrays["real"].device
        batch = LayoutBatch.from_compact(arrays)
        noise = sample_noise(generators, latent_shape, device)
        corruption = sample_corruption(generators, latent_shape, latent_noise, device) if latent_noise else None
        output, posterior = model(batch, noise, corruption)
        output, posterior = output.float(), posterior.float()
        parts = compute_lvae_loss(output, posterior, batch, spec, kl_weight).items()
        return parts | {"latent_std": posterior.mean.std(), "latent_sigma": (0.5 * posterior.logvar).exp().mean()}

    return loss


TimestepSampling = Literal["uniform", "logit_normal"]
LOGIT_NORMAL = (-0.6, 1.2)  # mean and deviation of the logit of t / 1000: half of the timesteps lie between 196 and 552


def sample_timesteps(uniform: Float[Tensor, " b"], density: TimestepSampling, num_timesteps: int) -> Int[Tensor, " b"]:
    """Timesteps of training from numbers between 0 and 1: all alike (the paper), or the middle ones more often.

    Whether an object is there is decided between timesteps 126 and 467, a third of all and half of these.
    Logit-normal, as in SD3 (Esser et al., 2024).
    """
    if density == "logit_normal":
        uniform = torch.sigmoid(LOGIT_NORMAL[0] + LOGIT_NORMAL[1] * torch.special.ndtri(uniform))
    return (uniform * num_timesteps).long().clamp(max=num_timesteps - 1)


def make_diffusion_loss(
    dit: DiT, diffusion: Diffusion, label_dropout: float, timestep_sampling: TimestepSampling = "uniform"
) -> LossFunction:
    """Stage 2: latents {mean, logvar, label} -> mean squared error of the predicted noise (Eq. "LDM"), or velocity.

    Latents are sampled from the cached posterior at every step; one label-dropout mask per sample.
    """
    shape = (dit.config.channels, dit.config.size, dit.config.size)
    shift = torch.tensor(dit.config.shift or [0.0] * shape[0])[:, None, None]
    scale = torch.tensor(dit.config.scale or [1.0] * shape[0])[:, None, None]

    def loss(
        model: Callable[..., Any], arrays: dict[str, Tensor], generators: list[torch.Generator]
    ) -> dict[str, Tensor]:
        mean, logvar, label = arrays["mean"].float(), arrays["logvar"].float(), arrays["label"]
        device = mean.device
        latent = mean + (0.5 * logvar).exp() * sample_noise(generators, shape, device)
        latent = (latent - shift.to(device)) / scale.to(device)
        noise = sample_noise(generators, shape, device)
        uniform = torch.stack([torch.rand(2, generator=generator) for generator in generators]).to(device)
        timestep = sample_timesteps(uniform[:, 0], timestep_sampling, diffusion.num_timesteps)
        label = torch.where(uniform[:, 1] < label_dropout, dit.null_label, label)
        predicted = model(diffusion.add_noise(latent, noise, timestep), timestep, label)
        error = F.mse_loss(predicted.float(), noise, reduction="none").flatten(1).mean(1)
        return {"loss": (dit.loss_weight(timestep) * error).mean(), "noise_error": error.mean()}

    return loss


class Trainer:
    """A model in training: `step` advances it; a run that resumes with `save` and `load` equals an uninterrupted one.

    `wrapped` is what is called (for instance the model under DistributedDataParallel); `model` is what is saved.
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
        self.model, self.wrapped, self.loss = model, wrapped or model, loss
        self.settings, self.device, self.execution = settings, device, execution or ExecutionConfig()
        self.parameters = {name: p for name, p in model.named_parameters() if p.requires_grad}
        rates = getattr(
            model, "learning_rate_factors", dict
        )()  # of parts whose rate is not everybody's, by name's beginning
        share = {n: next((v for part, v in rates.items() if n.startswith(part)), 1.0) for n in self.parameters}
        groups = [
            {"params": [p for n, p in self.parameters.items() if share[n] == value], "share": value}
            for value in sorted(set(share.values()))
        ]
        self.optimiser = torch.optim.AdamW(
            groups, settings.learning_rate, settings.betas, weight_decay=settings.weight_decay, fused=True
        )
        self.ema = {n: p.detach().clone() for n, p in self.parameters.items()} if settings.ema_decay else None
        self.steps_done = 0

    def step(self, arrays: dict[str, Tensor], positions: Iterable[int]) -> dict[str, Tensor]:
        """One optimisation step on a (local) batch; `positions` are its samples' places in the global batch.

        Returns detached losses and the gradient norm. Raises NotFinite, a ValueError, if the loss is not finite,
        before weights change.
        """
        rate, beta1 = self.settings.at(self.steps_done)
        for group in self.optimiser.param_groups:
            group["lr"], group["betas"] = group["share"] * rate, (beta1, self.settings.betas[1])
        positions = list(positions)
        arrays = {k: v.to(self.device, non_blocking=True) for k, v in arrays.items()}
        self.optimiser.zero_grad(set_to_none=True)
        totals: dict[str, Tensor] = {}
        size = -(-len(positions) // self.execution.accumulate)
        for first in range(0, len(positions), size):
            part = slice(first, first + size)
            share = len(positions[part]) / len(positions)
            more = first + size < len(positions)
            no_sync = getattr(self.wrapped, "no_sync", nullcontext)  # of DistributedDataParallel
            with no_sync() if more else nullcontext():
                losses = self._compute_losses(self.wrapped, {k: v[part] for k, v in arrays.items()}, positions[part])
                if losses is None:
                    raise NonFiniteLossError(self.steps_done, self._find_nonfinite_samples(arrays, positions))
                (share * losses["loss"]).backward()
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
        """The parts of the loss of `network`, or None if it is not finite. Each sample has its own noise."""
        generators = [make_keyed_generator(self.settings.seed, self.steps_done, position) for position in positions]
        try:
            with self.execution.autocast(self.device):
                losses = self.loss(network, arrays, generators)
        except NonFiniteCostError:
            return None
        return losses if torch.isfinite(losses["loss"]) else None

    @torch.no_grad()
    def _find_nonfinite_samples(self, arrays: dict[str, Tensor], positions: list[int]) -> list[int]:
        """The positions whose own loss is not finite; empty if that is all of them.

        By the model itself: a wrapped one would wait here for the other workers, who are elsewhere.
        """
        bad = [
            position
            for k, position in enumerate(positions)
            if self._compute_losses(self.model, {name: value[k : k + 1] for name, value in arrays.items()}, [position])
            is None
        ]
        return bad if len(bad) < len(positions) else []

    @torch.no_grad()
    def update_ema(self) -> None:
        """Exponential moving average with warm-up: decay = min(ema_decay, 1 - (1 + step)^-3/4), as diffusers does."""
        if self.ema is None or self.settings.ema_decay is None:
            return
        decay = min(self.settings.ema_decay, 1 - (1 + self.steps_done) ** -0.75)
        parameters: list[Tensor] = list(self.parameters.values())
        lerp = torch._foreach_lerp_  # pyright: ignore[reportPrivateImportUsage]
        lerp(list(self.ema.values()), parameters, 1 - decay)

    @torch.no_grad()
    def ema_model(self) -> ConfiguredModel:
        """The model to use: a copy with EMA weights, or the model itself where there is no EMA."""
        if not self.ema:
            return self.model
        copy = type(self.model).from_config(self.model.config)
        copy.load_state_dict({**self.model.state_dict(), **self.ema})
        return copy.to(self.device).eval()

    def save(self, directory: str | Path) -> None:
        """Everything needed to resume exactly: safetensors and JSON, no pickles. `state.json` is written last."""
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
        state = {"steps_done": self.steps_done, "settings": asdict(self.settings)}
        temporary = directory / "state.json.tmp"
        temporary.write_text(json.dumps(state, indent=1))
        os.replace(temporary, directory / "state.json")

    def load(self, directory: str | Path) -> None:
        """Resume from `save`. Raises ValueError if the checkpoint was made with other settings."""
        directory = Path(directory)
        state = json.loads((directory / "state.json").read_text())
        mine = json.loads(json.dumps(asdict(self.settings)))
        for name, value in mine.items():
            if state["settings"].get(name) != value:
                raise ValueError(
                    f"{directory}: was trained with {name}={state['settings'].get(name)}, asked for {value}; "
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
    execution = execution or ExecutionConfig()
    model = model.to(device)
    loss = make_layout_loss(model.spec, model.latent_shape, kl_weight, latent_noise)
    return Trainer(model, loss, settings, device, wrap(_compile_model(model, execution)), execution)


def make_dit_trainer(
    model: DiT,
    settings: OptimizerConfig,
    label_dropout: float,
    device: torch.device,
    wrap: Wrap = lambda m: m,
    execution: ExecutionConfig | None = None,
    timestep_sampling: TimestepSampling = "uniform",
) -> Trainer:
    execution = execution or ExecutionConfig()
    model = model.to(device)
    loss = make_diffusion_loss(model, Diffusion(), label_dropout, timestep_sampling)
    return Trainer(model, loss, settings, device, wrap(_compile_model(model, execution)), execution)


def _compile_model(model: nn.Module, execution: ExecutionConfig) -> nn.Module:
    return cast(nn.Module, torch.compile(model)) if execution.compile else model
