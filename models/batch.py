"""Batch of layouts as tensors. A LayoutSpec (layout.py) defines the meaning of the values.

This module is separate from layout.py because data jobs do not need torch.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class LayoutBatch:
    """A batch of normalised layouts L = {H, B, F} (paper, Sec. 3.1); masks and features lie in [0, 1].

    Attributes:
        height: Normalised ground heights H. Heights within the bounds of the LayoutSpec lie in [0, 1].
        occupied: Ground masks B with values 0 and 1.
        features: Normalised centres and Cholesky parameters F; 0 in padded slots.
        real: True for each slot that holds a primitive (padding flag p of the paper).
    """

    height: Float[Tensor, "batch ground rows cols"]
    occupied: Float[Tensor, "batch ground rows cols"]
    features: Float[Tensor, "batch slots 9"]
    real: Bool[Tensor, "batch slots"]

    def __len__(self) -> int:
        return len(self.real)

    def to(self, device: torch.device | str) -> LayoutBatch:
        """Copy the batch to a device.

        Args:
            device: Target device.

        Returns:
            The batch on that device.
        """
        return LayoutBatch(*(getattr(self, name).to(device, non_blocking=True) for name in self.__dataclass_fields__))

    @classmethod
    def from_compact(cls, arrays: dict[str, Tensor]) -> LayoutBatch:
        """Build a batch from the compact arrays of `tensors.encode_layout`.

        Args:
            arrays: Compact arrays with a leading batch axis, as tensors on any device.

        Returns:
            The batch on the same device, with float32 values.
        """
        return cls(
            height=arrays["height"].to(torch.float32) / 65535,
            occupied=arrays["occupied"].to(torch.float32),
            features=arrays["features"].to(torch.float32),
            real=arrays["real"].to(torch.bool),
        )
