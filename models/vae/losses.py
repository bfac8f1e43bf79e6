"""Losses of the layout VAE, one function per equation (paper, supplement B.2, Training)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from models.batch import LayoutBatch
from models.layout import LayoutSpec
from models.vae.matching import match_primitives
from models.vae.outputs import LayoutOutput, Posterior

OCCUPANCY_WEIGHT, HEIGHT_WEIGHT, KL_WEIGHT = 1.0, 9.0, 1e-6

# Paper, supplement Tab. "object loss weights": existence, centre, Cholesky.
LOW, MEDIUM, HIGH = (1.0, 3.0, 2.0), (3.0, 9.0, 7.0), (5.0, 15.0, 12.0)
OBJECT_WEIGHTS = {
    "vehicle_big": LOW,
    "two_wheelers": LOW,
    "human": LOW,
    "vehicle_small": MEDIUM,
    "construction_big": MEDIUM,
    "pole": MEDIUM,
    "traffic_control": MEDIUM,
    "object": MEDIUM,
    "vegetation_cuboid": HIGH,
    "vegetation_ellipsoid": HIGH,
    "construction_small": HIGH,
}


@dataclass(frozen=True)
class LVAELoss:
    """The parts of the training objective, weighted as they enter the total."""

    occupancy: Tensor
    height: Tensor
    existence: Tensor
    center: Tensor
    cholesky: Tensor
    kl: Tensor

    @property
    def total(self) -> Tensor:
        return self.occupancy + self.height + self.existence + self.center + self.cholesky + self.kl

    def items(self) -> dict[str, Tensor]:
        return {name: getattr(self, name) for name in self.__dataclass_fields__} | {"loss": self.total}


def compute_occupancy_loss(logit: Float[Tensor, "b g h w"], occupied: Float[Tensor, "b g h w"]) -> Float[Tensor, ""]:
    """Binary cross-entropy, mean over pixels, classes and batch."""
    return F.binary_cross_entropy_with_logits(logit, occupied)


def compute_height_loss(
    height: Float[Tensor, "b g h w"], truth: Float[Tensor, "b g h w"], occupied: Float[Tensor, "b g h w"]
) -> Float[Tensor, ""]:
    """L1 over occupied pixels, per sample, mean over the batch."""
    total = ((height - truth).abs() * occupied).sum(dim=(1, 2, 3))
    return (total / occupied.sum(dim=(1, 2, 3)).clamp(min=1)).mean()


def compute_object_losses(
    features: Float[Tensor, "b n 9"],
    existence_logit: Float[Tensor, "b n"],
    truth: Float[Tensor, "b slots 9"],
    real: Bool[Tensor, "b slots"],
    assignment: Int[Tensor, "b n"],
    spec: LayoutSpec,
    proposals: tuple[int, ...],
) -> tuple[Tensor, Tensor, Tensor]:
    """Existence, centre and Cholesky terms after matching, weighted (supplement Eqs. "match", "line").

    Sums over proposals, divided per sample and category by max(n_c, 1), summed over categories, mean over the batch.
    """
    matched = assignment >= 0
    target = truth.gather(1, assignment.clamp(min=0)[..., None].expand(-1, -1, truth.shape[-1]))
    category = torch.repeat_interleave(torch.tensor(proposals)).to(features.device)  # (n,)
    category_weight = features.new_tensor([OBJECT_WEIGHTS[name] for name in spec.categories])  # (c, 3)
    count = torch.stack([group.sum(dim=1) for group in real.split(spec.slots, dim=1)], dim=1).clamp(min=1)  # (b, c)
    weight = (category_weight / count[..., None] / len(real))[:, category]  # (b, n, 3)
    existence = F.binary_cross_entropy_with_logits(existence_logit, matched.to(features.dtype), reduction="none")
    distance = (features - target).abs() * matched[..., None]
    return (
        (weight[..., 0] * existence).sum(),
        (weight[..., 1] * distance[..., :3].sum(dim=-1)).sum(),
        (weight[..., 2] * distance[..., 3:].sum(dim=-1)).sum(),
    )


def compute_kl_loss(posterior: Posterior) -> Float[Tensor, ""]:
    """KL to the standard normal: sum over channels and positions, mean over the batch.

    The paper leaves open what happens to the positions; they are summed, as latent diffusion does.
    """
    mean, logvar = posterior.mean, posterior.logvar
    return -0.5 * (1 + logvar - mean.square() - logvar.exp()).sum(dim=(1, 2, 3)).mean()


def compute_lvae_loss(
    output: LayoutOutput, posterior: Posterior, batch: LayoutBatch, spec: LayoutSpec, kl_weight: float = KL_WEIGHT
) -> LVAELoss:
    """The total objective of stage 1 and its parts; zero where the ground branch is left out."""
    ground = float(output.branches != "objects")
    unit = batch.features.new_tensor(output.feature_unit)
    proposed, truth = (output.features / unit, output.existence_logit), batch.features / unit
    assignment = match_primitives(*proposed, truth, batch.real, spec.slots, output.proposals, output.match_weights)
    existence, center, cholesky = compute_object_losses(
        *proposed, truth, batch.real, assignment, spec, output.proposals
    )
    return LVAELoss(
        occupancy=ground * OCCUPANCY_WEIGHT * compute_occupancy_loss(output.occupancy_logit, batch.occupied),
        height=ground * HEIGHT_WEIGHT * compute_height_loss(output.height, batch.height, batch.occupied),
        existence=existence,
        center=center,
        cholesky=cholesky,
        kl=kl_weight * compute_kl_loss(posterior),
    )
