"""The contract between scenes and networks: LayoutSpec says what the numbers of a LayoutBatch (batch.py) mean.

A LayoutSpec is made once per dataset (pipelines/preprocess/ingest.py writes it to dataset.json), travels inside every
checkpoint and inverts a network's outputs without the data.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from models.scene import CATEGORIES, GROUND_CLASSES, KITTI_GROUND_CLASSES, Grid

FEATURES = 9  # 3 centre coordinates, 6 Cholesky parameters (paper, Sec. 3.1)

# Paper, supplement Tab. "object categories": predicted count per category, N = 514.
PAPER_SLOTS = (178, 159, 2, 18, 6, 5, 16, 77, 19, 17, 17)


@dataclass(frozen=True)
class Bounds:
    """Affine normalisation of each entry to [0, 1]; values outside are clipped."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.low) != len(self.high) or any(not a < b for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError(f"bounds need low < high entry by entry, got low={self.low} high={self.high}")

    def normalise(self, value: np.ndarray) -> np.ndarray:
        """value (..., k) -> [0, 1], clipped."""
        low, high = np.array(self.low), np.array(self.high)
        return ((value - low) / (high - low)).clip(0, 1)

    def restore(self, value: np.ndarray) -> np.ndarray:
        low, high = np.array(self.low), np.array(self.high)
        return value * (high - low) + low


@dataclass(frozen=True)
class LayoutSpec:
    """What a layout tensor means: categories and their slots, ground classes, grid and normalisation bounds.

    `slots[k]` queries predict `categories[k]`; slots are ordered by category, nearest primitive first. Bounds come
    from the training split. `surface` says what ground heights are: `top` of the slabs (0.3 m above the true
    surface, as in the authors' data) or the surface itself.
    """

    categories: tuple[str, ...] = CATEGORIES
    slots: tuple[int, ...] = PAPER_SLOTS
    ground_classes: tuple[str, ...] = KITTI_GROUND_CLASSES
    grid: Grid = field(default_factory=Grid)
    center_bounds_m: Bounds = Bounds((0.0, -32.0, -8.0), (64.0, 32.0, 16.0))
    cholesky_bounds: Bounds = Bounds((0.1, -4.0, 0.1, -3.0, -3.0, 0.1), (7.0, 4.0, 7.0, 3.0, 3.0, 6.0))
    height_bounds_m: Bounds = Bounds((-8.0,), (8.0,))
    surface: str = "top"

    def __post_init__(self) -> None:
        if len(self.slots) != len(self.categories):
            raise ValueError(f"LayoutSpec: {len(self.categories)} categories but {len(self.slots)} slot counts")
        for name, known in ((self.categories, CATEGORIES), (self.ground_classes, GROUND_CLASSES)):
            if unknown := set(name) - set(known):
                raise ValueError(f"LayoutSpec: unknown {sorted(unknown)}, expected a subset of {known}")

    @property
    def num_slots(self) -> int:
        return sum(self.slots)

    @property
    def slot_category(self) -> np.ndarray:
        """(N,) position in `categories` of each slot."""
        return np.repeat(np.arange(len(self.slots)), self.slots)

    def with_resolution(self, pixels: int) -> LayoutSpec:
        """The same layout on a square grid of `pixels` rows over the same ground."""
        extent_m = self.grid.rows * self.grid.resolution_m
        return replace(self, grid=replace(self.grid, rows=pixels, cols=pixels, resolution_m=extent_m / pixels))

    def feature_unit(self, length_m: float) -> tuple[float, ...]:
        """(9,) a length in normalised features, those of the centre and of the Cholesky entries (roots of metres)."""
        return tuple(
            unit / (high - low)
            for bounds, unit in ((self.center_bounds_m, length_m), (self.cholesky_bounds, length_m**0.5))
            for low, high in zip(bounds.low, bounds.high, strict=True)
        )

    def to_dict(self) -> dict:
        return json.loads(json.dumps(asdict(self)))

    @classmethod
    def from_dict(cls, values: dict) -> LayoutSpec:
        """Raises ValueError if a field is missing or makes no sense."""
        try:
            bounds = {
                name: Bounds(tuple(values[name]["low"]), tuple(values[name]["high"]))
                for name in ("center_bounds_m", "cholesky_bounds", "height_bounds_m")
            }
            return cls(
                categories=tuple(values["categories"]),
                slots=tuple(int(n) for n in values["slots"]),
                ground_classes=tuple(values["ground_classes"]),
                grid=Grid(**values["grid"]),
                surface=values["surface"],
                **bounds,
            )
        except (KeyError, TypeError) as error:
            raise ValueError(f"not a LayoutSpec: {error!r} in {sorted(values) if values else values}") from error

    def fingerprint(self) -> str:
        """Twelve hex digits that agree exactly when two specs do."""
        return hashlib.sha256(json.dumps(self.to_dict(), sort_keys=True).encode()).hexdigest()[:12]

    def require(self, other: LayoutSpec, what: str) -> None:
        """Raises ValueError naming the first difference if `other` (of `what`) is not this spec."""
        if self == other:
            return
        mine, theirs = self.to_dict(), other.to_dict()
        name = next(key for key in mine if mine[key] != theirs[key])
        raise ValueError(
            f"{what} has another LayoutSpec: {name} is {theirs[name]}, expected {mine[name]}; "
            "use the dataset or checkpoint that belongs to it, or train again"
        )
