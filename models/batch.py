"""LayoutBatch: what a LayoutSpec (layout.py) describes, as tensors. Apart from it, so that data jobs need no torch."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class LayoutBatch:
    """A batch of normalised layouts L = {H, B, F} (paper, Sec. 3.1), every value in [0, 1]."""

    height: Float[Tensor, "batch ground rows cols"]
    occupied: Float[Tensor, "batch ground rows cols"]
    features: Float[Tensor, "batch slots 9"]
    real: Bool[Tensor, "batch slots"]  # the padding flag p

    def __len__(self) -> int:
        return len(self.real)

    def to(self, device: torch.device | str) -> LayoutBatch:
        return LayoutBatch(*(getattr(self, name).to(device, non_blocking=True) for name in self.__dataclass_fields__))

    @classmethod
    def from_compact(cls, arrays: dict[str, Tensor]) -> LayoutBatch:
        """From stacked arrays of `tensors.encode_layout`, unpacked on whatever device they are on."""
        return cls(
            height=arrays["height"].to(torch.float32) / 65535,
            occupied=arrays["occupied"].to(torch.float32),
            features=arrays["features"].to(torch.float32),
            real=arrays["real"].to(torch.bool),
        )
