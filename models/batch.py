"""Batch of layouts as tensors. A LayoutSpec (layout.py) defines the meaning of the values.

This module is separate from layout.py because data jobs do not need torch.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from models.geometry.signed_distance import compute_signed_distance_px


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
    _distances_px: dict[int, Tensor] = field(default_factory=dict, repr=False, init=False)

    def __len__(self) -> int:
        return len(self.real)

    def to(self, device: torch.device | str) -> LayoutBatch:
        """Copy the batch to a device.

        Args:
            device: Target device.

        Returns:
            The batch on that device.
        """
        parts = (self.height, self.occupied, self.features, self.real)
        return LayoutBatch(*(part.to(device, non_blocking=True) for part in parts))

    def measure_distances_px(self, reach_px: int) -> Float[Tensor, "batch ground rows cols"]:
        """Return the signed distances of pixel centres from the edges of the masks. The batch keeps the result.

        Args:
            reach_px: Largest distance (pixels); larger distances are clipped to this value.

        Returns:
            Signed distances in pixels, positive inside the masks.
        """
        if reach_px not in self._distances_px:
            self._distances_px[reach_px] = compute_signed_distance_px(self.occupied > 0.5, reach_px)
        return self._distances_px[reach_px]

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
