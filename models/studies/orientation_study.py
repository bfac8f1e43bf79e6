"""The paper's Cholesky-versus-quaternion study (supplement, "Cholesky vs. quaternion"): how well a small object
autoencoder rebuilds one box, by the numbers in which the box is written (encodings.py).

The autoencoder is the object branch of the layout VAE made small, with one slot and one query: a box's numbers in, the
same numbers out, L1. Whatever the encoding, only the first and the last linear layer differ. The box is centred at
zero and its centre is not predicted.

Boxes that only yaw leave some numbers of every encoding still (2 of 6, 2 of 7, 9 of 15), and L1 pulls as hard at a
number that is right but for rounding as at one that is wrong: they disturb what is to be learned. Either all are
regressed, as in the paper, or only the moving ones.

The paper leaves open: the ranges of the sizes, the network, batch size and learning rate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.geometry.encodings import Encoding
from models.layout import Bounds
from models.lvae import INITIAL_LOGVAR, compute_clamped_logit
from models.sampling.diffusion import make_keyed_generator
from models.scene import make_yaw_rotation
from models.training import OptimizerConfig
from models.vae.config import ObjectConfig
from models.vae.losses import KL_WEIGHT, MEDIUM, compute_kl_loss
from models.vae.objects import CATEGORY_EMBEDDING, ObjectDecoder, ObjectEncoder, OutputHeads
from models.vae.outputs import Posterior

GRID, LATENT_CHANNELS = 2, 16
NETWORK = ObjectConfig(width=128, layers=1, heads=4, hidden=256, head_hidden=128)
MARGIN = 0.05  # of an entry's training range, on both sides: a sigmoid does not reach 0 and 1
STILL, LEAST_RANGE = 1e-6, 1.0  # an entry that changes by less stands still, and is given this range


# ------------------------------------------------------------------------------------------------------- boxes


class CenteredBoxes(NamedTuple):
    """n boxes centred at zero: axes as columns of `rotation` (n, 3, 3), full extents `size_m` (n, 3)."""

    rotation: np.ndarray
    size_m: np.ndarray


@dataclass(frozen=True)
class BoxDistribution:
    """Ranges of uniform draws: length and height in metres, width as a share of the length."""

    length_m: tuple[float, float]
    width_share: tuple[float, float]
    height_m: tuple[float, float]


THINGS = {
    "vehicle": BoxDistribution((3.3, 5.6), (0.35, 0.6), (1.2, 2.2)),  # the paper's study
    "any": BoxDistribution(
        (1.0, 6.0), (0.4, 1.0), (0.5, 4.0)
    ),  # up to square footprints, where the scatter matrix has no yaw
}


def draw_boxes(things: BoxDistribution, count: int, *key: int) -> CenteredBoxes:
    """Upright boxes with yaw anywhere in [-pi, pi). The first n of a larger draw of the same key are the draw of n."""
    unit = torch.rand(count, 4, generator=make_keyed_generator(*key), dtype=torch.float64).numpy()
    low, high = np.array([things.length_m, things.width_share, things.height_m, (-np.pi, np.pi)]).T
    length, share, height, yaw = (low + unit * (high - low)).T
    return CenteredBoxes(make_yaw_rotation(yaw), np.stack([length, share * length, height], axis=1))


def compute_code_bounds(code: np.ndarray) -> Bounds:
    """Bounds of each entry of (n, entries) training codes, with a margin."""
    low, high = code.min(axis=0), code.max(axis=0)
    middle, reach = (low + high) / 2, (0.5 + MARGIN) * (high - low)
    reach = np.where(high - low < STILL, LEAST_RANGE / 2, reach)
    return Bounds(tuple((middle - reach).tolist()), tuple((middle + reach).tolist()))


# -------------------------------------------------------------------------------------------------- autoencoder


class OneObjectAutoencoder(nn.Module):
    """Normalised numbers of one box (batch, entries) -> the same, through a latent as the layout VAE has it."""

    def __init__(self, entries: int) -> None:
        super().__init__()
        self.encoder = ObjectEncoder((1,), LATENT_CHANNELS, GRID, NETWORK)
        self.decoder = ObjectDecoder((1,), LATENT_CHANNELS, GRID, NETWORK)
        self.encoder.project_in = nn.Linear(3 + entries + CATEGORY_EMBEDDING + 1, NETWORK.width)
        heads = cast(OutputHeads, self.decoder.heads[0])
        heads.features[-1] = nn.Linear(NETWORK.head_hidden, entries)
        with torch.no_grad():
            self.encoder.grid[LATENT_CHANNELS:] = INITIAL_LOGVAR

    def encode(self, code: Float[Tensor, "batch entries"]) -> Posterior:
        features = torch.cat([code.new_full((len(code), 3), 0.5), code], dim=1)  # the centre, normalised
        real = torch.ones(len(code), 1, dtype=torch.bool)
        mean, logvar = self.encoder(features[:, None], real).chunk(2, dim=1)
        return Posterior(mean, logvar)

    def decode(self, latent: Float[Tensor, "batch c h w"]) -> Float[Tensor, "batch entries"]:
        return self.decoder(latent)[0][:, 0]


@dataclass(frozen=True)
class StudyConfig:
    """How an autoencoder is trained, the same for every encoding.

    The batch is the paper's for the layout VAE. On 1,200 vehicles of a seed that the study does not use, mean IoU3D at
    learning rates 5e-4 / 1e-3: Cholesky 0.968 / 0.964, quaternion 0.871 / 0.876, octahedral 0.938 / 0.849.
    """

    epochs: int = 20
    batch_size: int = 32
    learning_rate: float = 5e-4
    weight_decay: float = 5e-4

    def make_optimizer_config(self, count: int) -> OptimizerConfig:
        """The layout VAE's schedule for `count` samples: the rate falls to a tenth along a cosine."""
        return OptimizerConfig(
            steps=self.epochs * -(-count // self.batch_size),
            learning_rate=self.learning_rate,
            weight_decay=self.weight_decay,
            final_learning_rate=self.learning_rate / 10,
            cycle_momentum=(0.85, 0.95),
        )


class TrainedStudy(NamedTuple):
    """A trained autoencoder, with what its numbers mean."""

    model: OneObjectAutoencoder
    bounds: Bounds
    encoding: Encoding
    kept: np.ndarray  # (entries,) bool: what the autoencoder sees; the rest stays where it was in training

    @torch.no_grad()
    def rebuild(self, boxes: CenteredBoxes) -> tuple[CenteredBoxes, float]:
        """The boxes that come out (from the latent mean), and the mean error of a normalised number."""
        code = self.bounds.normalise(self.encoding.encode(*boxes))
        given = torch.from_numpy(code[:, self.kept]).float()
        out = self.model.decode(self.model.encode(given).mean)
        code[:, ~self.kept], code[:, self.kept] = 0.5, out.double().numpy()
        return CenteredBoxes(*self.encoding.decode(self.bounds.restore(code))), float((out - given).abs().mean())


def train_autoencoder(
    encoding: Encoding, boxes: CenteredBoxes, settings: StudyConfig, seed: int, moving_only: bool = False
) -> TrainedStudy:
    """An autoencoder trained on the boxes. Same seed, same initial body, order of samples and noise."""
    numbers = encoding.encode(*boxes)
    bounds = compute_code_bounds(numbers)
    kept = (np.ptp(numbers, axis=0) >= STILL) | (not moving_only)
    code = torch.from_numpy(bounds.normalise(numbers)[:, kept]).float()
    torch.manual_seed(seed)
    model = OneObjectAutoencoder(code.shape[1])
    with torch.no_grad():
        model.decoder.init_from_data(compute_clamped_logit(code.mean(dim=0))[None], torch.ones(1))
    schedule = settings.make_optimizer_config(len(code))
    optimiser = torch.optim.AdamW(
        model.parameters(), settings.learning_rate, weight_decay=settings.weight_decay, fused=True
    )
    generator, step = make_keyed_generator(seed, len(code)), 0
    for _ in range(settings.epochs):
        for batch in code[torch.randperm(len(code), generator=generator)].split(settings.batch_size):
            rate, beta1 = schedule.at(step)
            for group in optimiser.param_groups:
                group["lr"], group["betas"] = rate, (beta1, schedule.betas[1])
            posterior = model.encode(batch)
            noise = torch.randn(posterior.mean.shape, generator=generator)
            distance = (model.decode(posterior.sample(noise)) - batch).abs().sum(dim=1).mean()
            loss = MEDIUM[2] * distance + KL_WEIGHT * compute_kl_loss(posterior)
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
            step += 1
    return TrainedStudy(model, bounds, encoding, kept)
