"""Losses of the layout VAE: one function for each equation (paper, supplement B.2, Training)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from models.batch import LayoutBatch
from models.layout import LayoutSpec
from models.vae.matching import match_primitives
from models.vae.outputs import LayoutOutput, Posterior, Prediction

OCCUPANCY_WEIGHT, HEIGHT_WEIGHT, KL_WEIGHT = 1.0, 9.0, 1e-6
DISTANCE_WEIGHT = 2.0  # Weight of the signed distances of level sets, which the paper does not have.

# Weights of the losses of existence, centre and Cholesky parameters (paper, supplement B.2).
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
    """Weighted parts of the training objective of the layout VAE.

    Attributes:
        occupancy: Occupancy loss.
        height: Height loss.
        existence: Existence loss.
        center: Centre loss.
        cholesky: Cholesky loss.
        kl: KL loss.
        auxiliary: Object losses of the other layers and of the denoising queries, if the object decoder has them.
        distance: Loss of the signed distances, if the ground decoder has level sets.
    """

    occupancy: Tensor
    height: Tensor
    existence: Tensor
    center: Tensor
    cholesky: Tensor
    kl: Tensor
    auxiliary: Tensor
    distance: Tensor

    @property
    def total(self) -> Tensor:
        """Sum of all parts."""
        return sum(
            (self.occupancy, self.height, self.existence, self.center, self.cholesky, self.kl, self.auxiliary),
            self.distance,
        )

    def items(self) -> dict[str, Tensor]:
        """Return the parts by name, and the total as `loss`."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__} | {"loss": self.total}


def compute_occupancy_loss(logit: Float[Tensor, "b g h w"], occupied: Float[Tensor, "b g h w"]) -> Float[Tensor, ""]:
    """Compute the binary cross-entropy of the occupancy, averaged over pixels, classes and batch.

    Args:
        logit: Occupancy logits.
        occupied: Masks, 0 or 1.

    Returns:
        Scalar loss.
    """
    return F.binary_cross_entropy_with_logits(logit, occupied)


def compute_distance_loss(distance: Float[Tensor, "b g h w"], truth: Float[Tensor, "b g h w"]) -> Float[Tensor, ""]:
    """Compute the L1 loss of signed distances, averaged over pixels, classes and batch.

    The truth is clipped to [-1, 1]. Where it is clipped, only predictions nearer to the edge have a loss.

    Args:
        distance: Predicted signed distances.
        truth: True signed distances, clipped to [-1, 1].

    Returns:
        Scalar loss.
    """
    beyond = (truth.abs() >= 1) & (distance * truth.sign() >= 1)
    return ((distance - truth).abs() * ~beyond).mean()


def compute_height_loss(
    height: Float[Tensor, "b g h w"], truth: Float[Tensor, "b g h w"], occupied: Float[Tensor, "b g h w"]
) -> Float[Tensor, ""]:
    """Compute the L1 loss of the heights, averaged over the occupied pixels of each sample, then over the batch.

    Args:
        height: Predicted normalised heights.
        truth: True normalised heights.
        occupied: True masks, 0 or 1.

    Returns:
        Scalar loss.
    """
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
    """Compute the weighted existence, centre and Cholesky losses (supplement, Eq. 7 and 8).

    For each category c, each loss is summed over the proposals and divided by max(n_c, 1), where n_c is the number of
    primitives of category c. The results are then summed over categories and averaged over the batch.

    Args:
        features: Features of the proposals.
        existence_logit: Existence logits of the proposals.
        truth: Features of the true primitives.
        real: True for each slot that holds a primitive.
        assignment: Slot of each proposal; -1: padding (`match_primitives`).
        spec: LayoutSpec with the categories and slots.
        proposals: Number of proposals per category.

    Returns:
        Existence, centre and Cholesky loss.
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
    """Compute the KL divergence to the standard normal distribution, averaged over the batch.

    The divergence is summed over channels and cells. The paper does not specify the reduction over cells; latent
    diffusion also uses the sum.

    Args:
        posterior: Posterior of the encoders.

    Returns:
        Scalar loss.
    """
    mean, logvar = posterior.mean, posterior.logvar
    return -0.5 * (1 + logvar - mean.square() - logvar.exp()).sum(dim=(1, 2, 3)).mean()


def compute_lvae_loss(
    output: LayoutOutput, posterior: Posterior, batch: LayoutBatch, spec: LayoutSpec, kl_weight: float = KL_WEIGHT
) -> LVAELoss:
    """Compute the training objective of stage 1 and its parts.

    Args:
        output: Output of the decoders.
        posterior: Posterior of the encoders.
        batch: True layouts.
        spec: LayoutSpec with the categories and slots.
        kl_weight: Weight of the KL loss.

    Returns:
        The weighted parts. If the model has no ground branch, the ground parts are 0.
    """
    ground = float(output.branches != "objects")
    unit = batch.features.new_tensor(output.feature_unit)
    truth = batch.features / unit

    def compute_losses(prediction: Prediction, groups: int = 0) -> tuple[Tensor, Tensor, Tensor]:
        features = prediction.features / unit
        if groups:  # Slot k of a denoising query belongs to slot k of the truth.
            target, real = truth.repeat_interleave(groups, 0), batch.real.repeat_interleave(groups, 0)
            slot = torch.arange(real.shape[1], device=real.device).expand_as(real)
            assignment = torch.where(real, slot, -1)
        else:
            target, real = truth, batch.real
            assignment = match_primitives(
                features, prediction.existence_logit, target, real, spec.slots, output.proposals, output.match_weights
            )
        return compute_object_losses(
            features, prediction.existence_logit, target, real, assignment, spec, output.proposals
        )

    existence, center, cholesky = compute_losses(Prediction(output.features, output.existence_logit))
    auxiliary = existence.new_zeros(())
    for found in output.auxiliary:
        auxiliary = auxiliary + sum(compute_losses(found))
    for found in output.denoised:
        _, *distances = compute_losses(found, len(found.features) // len(batch))
        auxiliary = auxiliary + sum(distances)
    distance = existence.new_zeros(())
    if output.signed_distance is not None:
        target = batch.measure_distances_px(output.reach_px) / output.reach_px
        distance = DISTANCE_WEIGHT * compute_distance_loss(output.signed_distance, target)
    return LVAELoss(
        occupancy=ground * OCCUPANCY_WEIGHT * compute_occupancy_loss(output.occupancy_logit, batch.occupied),
        height=ground * HEIGHT_WEIGHT * compute_height_loss(output.height, batch.height, batch.occupied),
        existence=existence,
        center=center,
        cholesky=cholesky,
        kl=kl_weight * compute_kl_loss(posterior),
        auxiliary=auxiliary,
        distance=distance,
    )
