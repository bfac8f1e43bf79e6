"""Lovasz-Softmax loss (Berman et al., CVPR 2018), a convex surrogate of 1 - mean IoU."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor


def compute_lovasz_gradient(foreground: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Return the gradient of the Lovasz extension of the Jaccard loss for errors in descending order.

    Args:
        foreground: 1 for each sample of the class, else 0, in the order of the errors.

    Returns:
        Change of the Jaccard loss when the first k errors become the first k + 1 errors.
    """
    total = foreground.sum()
    intersection = total - foreground.cumsum(0)
    union = total + (1 - foreground).cumsum(0)
    jaccard = 1 - intersection / union
    return torch.cat([jaccard[:1], jaccard[1:] - jaccard[:-1]])


def compute_lovasz_softmax(probabilities: Float[Tensor, "n classes"], labels: Int[Tensor, " n"]) -> Float[Tensor, ""]:
    """Compute the loss over all samples, averaged over the classes that occur in the labels.

    Args:
        probabilities: Predicted probabilities.
        labels: True classes.

    Returns:
        Loss.
    """
    losses = []
    for class_id in labels.unique().tolist():
        foreground = (labels == class_id).to(probabilities.dtype)
        errors, order = (foreground - probabilities[:, class_id]).abs().sort(descending=True)
        losses.append(errors @ compute_lovasz_gradient(foreground[order]))
    return torch.stack(losses).mean()
