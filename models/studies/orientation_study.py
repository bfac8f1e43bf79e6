"""Measure how well a small autoencoder reconstructs one box (paper, supplement, "Cholesky vs. quaternion").

The study compares encodings of the box (models/geometry/encodings.py). The autoencoder is a small object branch of the
layout VAE with one slot and one query. The autoencoder is trained with an L1 loss to reconstruct the code of a box. The
networks of different encodings differ only in their first and last linear layers. Boxes are centred at the origin, and
the centre is not predicted.

If boxes are upright, some entries of their codes are constant: 2 of 6 (Cholesky), 2 of 7 (quaternion) and 9 of 15
(octahedral). The L1 gradient of an entry does not shrink with its error, so constant entries disturb the training. The
study therefore has two variants. The networks regress either all entries, as in the paper, or only entries that vary.

The paper does not specify the box sizes, the network, the batch size or the learning rate.
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
from models.vae.detr_decoder import DETRDecoder, OutputHeads
from models.vae.losses import KL_WEIGHT, MEDIUM, compute_kl_loss
from models.vae.objects import CATEGORY_EMBEDDING, ObjectEncoder
from models.vae.outputs import Posterior

GRID, LATENT_CHANNELS = 2, 16
NETWORK = ObjectConfig(width=128, layers=1, heads=4, hidden=256, head_hidden=128)
MARGIN = 0.05  # Margin at both ends of an encoded number's range, because a sigmoid does not reach 0 and 1.
STILL, LEAST_RANGE = 1e-6, 1.0  # A range of an encoded number below STILL becomes LEAST_RANGE.


# ------------------------------------------------------------------------------------------------------- boxes


class CenteredBoxes(NamedTuple):
    """A set of n boxes centred at the origin.

    Attributes:
        rotation: (n, 3, 3) matrices; their columns are the axes of the boxes.
        size_m: (n, 3) full extents along the axes (metres).
    """

    rotation: np.ndarray
    size_m: np.ndarray


@dataclass(frozen=True)
class BoxDistribution:
    """Uniform distributions of box sizes.

    Attributes:
        length_m: Range of the length (metres).
        width_share: Range of the ratio of width to length.
        height_m: Range of the height (metres).
    """

    length_m: tuple[float, float]
    width_share: tuple[float, float]
    height_m: tuple[float, float]


BOX_DISTRIBUTIONS = {
    "vehicle": BoxDistribution((3.3, 5.6), (0.35, 0.6), (1.2, 2.2)),  # The paper's study.
    # This distribution includes square footprints, for which the scatter matrix does not determine the yaw.
    "any": BoxDistribution((1.0, 6.0), (0.4, 1.0), (0.5, 4.0)),
}


def draw_boxes(distribution: BoxDistribution, count: int, *key: int) -> CenteredBoxes:
    """Draw upright boxes with yaw in [-pi, pi).

    With the same key, a larger `count` only adds boxes at the end.

    Args:
        distribution: Distribution of the box sizes.
        count: Number of boxes.
        *key: Integers that determine the random numbers.

    Returns:
        The boxes.
    """
    unit = torch.rand(count, 4, generator=make_keyed_generator(*key), dtype=torch.float64).numpy()
    low, high = np.array([distribution.length_m, distribution.width_share, distribution.height_m, (-np.pi, np.pi)]).T
    length, share, height, yaw = (low + unit * (high - low)).T
    return CenteredBoxes(make_yaw_rotation(yaw), np.stack([length, share * length, height], axis=1))


def compute_code_bounds(code: np.ndarray) -> Bounds:
    """Compute lower and upper bounds of each entry of training codes, including a margin.

    Args:
        code: (n, entries) codes.

    Returns:
        Bounds.
    """
    low, high = code.min(axis=0), code.max(axis=0)
    middle, reach = (low + high) / 2, (0.5 + MARGIN) * (high - low)
    reach = np.where(high - low < STILL, LEAST_RANGE / 2, reach)
    return Bounds(tuple((middle - reach).tolist()), tuple((middle + reach).tolist()))


# -------------------------------------------------------------------------------------------------- autoencoder


class OneObjectAutoencoder(nn.Module):
    """Autoencoder of the normalised code of one box, with a latent similar to that of the layout VAE.

    Args:
        entries: Number of entries of the code.
    """

    def __init__(self, entries: int) -> None:
        super().__init__()
        self.encoder = ObjectEncoder((1,), LATENT_CHANNELS, GRID, NETWORK)
        self.decoder = DETRDecoder((1,), LATENT_CHANNELS, GRID, NETWORK)
        self.encoder.project_in = nn.Linear(3 + entries + CATEGORY_EMBEDDING + 1, NETWORK.width)
        heads = cast(OutputHeads, self.decoder.heads[0])
        heads.features[-1] = nn.Linear(NETWORK.head_hidden, entries)
        with torch.no_grad():
            self.encoder.grid[LATENT_CHANNELS:] = INITIAL_LOGVAR

    def encode(self, code: Float[Tensor, "batch entries"]) -> Posterior:
        """Encode normalised codes.

        Args:
            code: Codes, normalised to [0, 1].

        Returns:
            Posterior.
        """
        features = torch.cat([code.new_full((len(code), 3), 0.5), code], dim=1)  # normalised centre first
        real = torch.ones(len(code), 1, dtype=torch.bool)
        mean, logvar = self.encoder(features[:, None], real).chunk(2, dim=1)
        return Posterior(mean, logvar)

    def decode(self, latent: Float[Tensor, "batch c h w"]) -> Float[Tensor, "batch entries"]:
        """Decode latents.

        Args:
            latent: Latents.

        Returns:
            Codes, normalised to [0, 1].
        """
        return self.decoder(latent).features[:, 0]


@dataclass(frozen=True)
class StudyConfig:
    """Training options of the autoencoders; all encodings use the same options.

    The batch size is the same as for the layout VAE of the paper. The learning rate was selected on 1,200 vehicles from
    a seed that the study does not use. The mean IoU3D at learning rates 5e-4 / 1e-3 is 0.968 / 0.964 (Cholesky), 0.871
    / 0.876 (quaternion) and 0.938 / 0.849 (octahedral).

    Attributes:
        epochs: Passes over the training boxes.
        batch_size: Boxes per step.
        learning_rate: Initial learning rate.
        weight_decay: Weight decay of AdamW.
    """

    epochs: int = 20
    batch_size: int = 32
    learning_rate: float = 5e-4
    weight_decay: float = 5e-4

    def make_optimizer_config(self, count: int) -> OptimizerConfig:
        """Return the learning-rate schedule of the layout VAE: a cosine that ends at a tenth of the initial rate.

        Args:
            count: Number of training boxes.

        Returns:
            Options of the optimizer.
        """
        return OptimizerConfig(
            steps=self.epochs * -(-count // self.batch_size),
            learning_rate=self.learning_rate,
            weight_decay=self.weight_decay,
            final_learning_rate=self.learning_rate / 10,
            cycle_momentum=(0.85, 0.95),
        )


class TrainedStudy(NamedTuple):
    """A trained autoencoder and its box encoding.

    Attributes:
        model: Autoencoder.
        bounds: Bounds of all entries of the code.
        encoding: Encoding of the boxes.
        kept: (entries,) bool; True marks entries that the autoencoder reconstructs. All other entries have the constant
            value of the training boxes.
    """

    model: OneObjectAutoencoder
    bounds: Bounds
    encoding: Encoding
    kept: np.ndarray

    @torch.no_grad()
    def rebuild(self, boxes: CenteredBoxes) -> tuple[CenteredBoxes, float]:
        """Reconstruct boxes from the latent mean.

        Args:
            boxes: Boxes.

        Returns:
            Reconstructed boxes, and the mean absolute error of the normalised entries.
        """
        code = self.bounds.normalise(self.encoding.encode(*boxes))
        given = torch.from_numpy(code[:, self.kept]).float()
        out = self.model.decode(self.model.encode(given).mean)
        code[:, ~self.kept], code[:, self.kept] = 0.5, out.double().numpy()
        return CenteredBoxes(*self.encoding.decode(self.bounds.restore(code))), float((out - given).abs().mean())


def train_autoencoder(
    encoding: Encoding, boxes: CenteredBoxes, settings: StudyConfig, seed: int, moving_only: bool = False
) -> TrainedStudy:
    """Train an autoencoder on boxes.

    For the same seed, all encodings have the same initial weights of the shared layers, the same order of samples and
    the same noise.

    Args:
        encoding: Encoding of the boxes.
        boxes: Training boxes.
        settings: Training options.
        seed: Seed of weights, order and noise.
        moving_only: If True, process only entries that vary over the training boxes.

    Returns:
        The trained autoencoder.
    """
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
