"""LayoutSpec defines the meaning of the values of a LayoutBatch (batch.py).

pipelines/preprocess/ingest.py computes one LayoutSpec per dataset and writes it to dataset.json. Each checkpoint stores
a copy of the LayoutSpec. A model can therefore decode its outputs to scenes without the dataset.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from models.limits import require_within
from models.options import FINITE, LARGE, Choice, Integer, Number, Rule, Sequential, Text, check_entries, show_value
from models.scene import CATEGORIES, GROUND_CLASSES, KITTI_GROUND_CLASSES, Grid

FEATURES = 9  # 3 centre coordinates, 6 Cholesky parameters (paper, Sec. 3.1)

# Number of slots per category, N = 514 in total (paper, supplement Tab. "object categories").
PAPER_SLOTS = (178, 159, 2, 18, 6, 5, 16, 77, 19, 17, 17)

# Rules of the entries of a stored LayoutSpec, and number of entries of each bounds.
RULES: dict[str, Rule] = {
    "categories": Sequential(Choice(CATEGORIES), 1, len(CATEGORIES)),
    "slots": Sequential(Integer(0, 2**31), 1, len(CATEGORIES)),
    "ground_classes": Sequential(Choice(GROUND_CLASSES), 1, len(GROUND_CLASSES)),
    "surface": Text(),
}
GRID_RULES: dict[str, Rule] = {
    "front_m": FINITE,
    "left_m": FINITE,
    "resolution_m": Number(1e-4, LARGE),
    "rows": Integer(1, 2**16),
    "cols": Integer(1, 2**16),
}
SLAB_OFFSET_M = 0.3  # Height of slab tops above the surface (KITTI-360, town). Argoverse 2 has no slabs.
NUM_BOUNDS = {"center_bounds_m": 3, "cholesky_bounds": 6, "height_bounds_m": 1}


@dataclass(frozen=True)
class Bounds:
    """Lower and upper bound of each entry of a vector. Normalisation maps the interval between the bounds to [0, 1].

    Attributes:
        low: Lower bound of each entry.
        high: Upper bound of each entry; must be greater than `low`.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.low) != len(self.high) or any(not a < b for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError(f"each lower bound must be less than its upper bound, got low={self.low} high={self.high}")

    def normalise(self, value: np.ndarray) -> np.ndarray:
        """Map values linearly from the interval between their bounds to [0, 1]; clip values outside the bounds.

        Args:
            value: (..., k) values in the units of the bounds.

        Returns:
            (..., k) normalised values in [0, 1].
        """
        low, high = np.array(self.low), np.array(self.high)
        return ((value - low) / (high - low)).clip(0, 1)

    def restore(self, value: np.ndarray) -> np.ndarray:
        """Map normalised values from [0, 1] back to the interval between their bounds.

        Args:
            value: (..., k) normalised values.

        Returns:
            (..., k) values in the units of the bounds.
        """
        low, high = np.array(self.low), np.array(self.high)
        return value * (high - low) + low


@dataclass(frozen=True)
class LayoutSpec:
    """Meaning of a layout tensor: categories, slots, ground classes, grid and normalisation bounds.

    The slots of a category are consecutive. Within a category, primitives are sorted by distance from the ego vehicle.
    Bounds come from the training split.

    Attributes:
        categories: Names of the categories.
        slots: Number of slots per category.
        ground_classes: Names of the ground classes, in the order of the rasters.
        grid: Pixel grid of the rasters in the scene frame.
        center_bounds_m: Bounds of the centre x, y, z (metres, scene frame).
        cholesky_bounds: Bounds of the six Cholesky parameters (sqrt(metres)).
        height_bounds_m: Bounds of the ground height (metres, scene frame).
        surface: Reference surface of the ground heights. "top" is the top of the ground slabs in the authors' data, 0.3
            m above the true surface. With any other value, heights are those of the true surface.
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
        """Total number of slots over all categories."""
        return sum(self.slots)

    @property
    def slab_offset_m(self) -> float:
        """Height of the ground raster above the surface on which objects stand (m)."""
        return SLAB_OFFSET_M if self.surface == "top" else 0.0

    @property
    def slot_category(self) -> np.ndarray:
        """(N,) category of each slot, as an index into `categories`."""
        return np.repeat(np.arange(len(self.slots)), self.slots)

    @property
    def feature_bounds(self) -> Bounds:
        """Bounds of the nine features: centre, then Cholesky parameters."""
        center, cholesky = self.center_bounds_m, self.cholesky_bounds
        return Bounds((*center.low, *cholesky.low), (*center.high, *cholesky.high))

    def with_resolution(self, pixels: int) -> LayoutSpec:
        """Return a copy of this spec whose square pixel grid has a different resolution over the same area.

        Args:
            pixels: Number of rows and of columns.

        Returns:
            The new spec.
        """
        extent_m = self.grid.rows * self.grid.resolution_m
        return replace(self, grid=replace(self.grid, rows=pixels, cols=pixels, resolution_m=extent_m / pixels))

    def feature_unit(self, length_m: float) -> tuple[float, ...]:
        """Convert a length to normalised feature units.

        Cholesky parameters have the unit sqrt(metres), so the function uses sqrt(`length_m`) for them.

        Args:
            length_m: Length (metres).

        Returns:
            The length in the normalised unit of each feature: nine numbers (3 centre coordinates, 6 Cholesky
            parameters).
        """
        bounds, units = self.feature_bounds, (length_m,) * 3 + (length_m**0.5,) * 6
        return tuple(unit / (high - low) for low, high, unit in zip(bounds.low, bounds.high, units, strict=True))

    def to_dict(self) -> dict:
        """Return the spec as a dictionary that JSON can store."""
        return json.loads(json.dumps(asdict(self)))

    @classmethod
    def from_dict(cls, values: Any) -> LayoutSpec:
        """Build a spec from the output of `to_dict`.

        Args:
            values: Fields of the spec by name.

        Returns:
            The spec.

        Raises:
            ValueError: A field is missing or invalid.
        """
        try:
            return cls._parse(values)
        except ValueError as error:
            raise ValueError(f"not a LayoutSpec: {error}") from error

    @classmethod
    def _parse(cls, values: Any) -> LayoutSpec:
        check_entries(values, RULES, "layout", required=(*RULES, "grid", *NUM_BOUNDS), others=True)
        if unknown := sorted(set(values) - {*RULES, "grid", *NUM_BOUNDS}, key=str):
            raise ValueError(f"layout.{show_value(unknown[0])} is unknown")
        check_entries(values["grid"], GRID_RULES, "layout.grid")
        for name, count in NUM_BOUNDS.items():
            rules: dict[str, Rule] = {side: Sequential(FINITE, count, count) for side in ("low", "high")}
            check_entries(values[name], rules, f"layout.{name}", required=tuple(rules))
        for name in ("categories", "ground_classes"):
            if len(set(values[name])) != len(values[name]):
                raise ValueError(f"layout.{name} is {show_value(values[name])}, expected different names")
        grid, slots = Grid(**values["grid"]), tuple(values["slots"])
        require_within("scene_primitives", sum(slots), "layout.slots")
        require_within("raster_pixels", grid.rows * grid.cols * len(values["ground_classes"]), "layout.grid")
        return cls(
            categories=tuple(values["categories"]),
            slots=slots,
            ground_classes=tuple(values["ground_classes"]),
            grid=grid,
            surface=values["surface"],
            **{name: Bounds(tuple(values[name]["low"]), tuple(values[name]["high"])) for name in NUM_BOUNDS},
        )

    def fingerprint(self) -> str:
        """Return the first twelve hexadecimal digits of the SHA-256 digest of the spec."""
        return hashlib.sha256(json.dumps(self.to_dict(), sort_keys=True).encode()).hexdigest()[:12]

    @staticmethod
    def merge(specs: Sequence[LayoutSpec]) -> LayoutSpec:
        """Return the layout that covers the scenes of several datasets.

        Args:
            specs: Layouts of the datasets. The grid and the reference surface of the first are kept.

        Returns:
            Layout with the categories and ground classes of all, the largest number of slots per category and the
            widest bounds.

        Raises:
            ValueError: The grids cover different areas.
        """
        first = specs[0]
        if len(specs) == 1:
            return first
        for number, spec in enumerate(specs[1:], 2):
            first.require_same_area(spec, f"dataset {number}")
        moved = [spec.with_surface(first.surface) for spec in specs]

        def merge_bounds(name: str) -> Bounds:
            low = np.min([getattr(spec, name).low for spec in moved], axis=0)
            high = np.max([getattr(spec, name).high for spec in moved], axis=0)
            return Bounds(tuple(low.tolist()), tuple(high.tolist()))

        slots = {
            name: max(dict(zip(spec.categories, spec.slots, strict=True)).get(name, -1) for spec in specs)
            for name in CATEGORIES
        }
        classes = {name for spec in specs for name in spec.ground_classes}
        return replace(
            first,
            categories=tuple(name for name, count in slots.items() if count >= 0),
            slots=tuple(count for count in slots.values() if count >= 0),
            ground_classes=tuple(name for name in GROUND_CLASSES if name in classes),
            **{name: merge_bounds(name) for name in NUM_BOUNDS},
        )

    def require_same_area(self, other: LayoutSpec, what: str) -> None:
        """Raise an error if the grid of another spec covers another area.

        Args:
            other: Spec to compare.
            what: Name of the owner of `other` for the error message.

        Raises:
            ValueError: The areas differ.
        """
        mine, theirs = ((g.front_m, g.left_m, g.back_m, g.right_m) for g in (self.grid, other.grid))
        if not np.allclose(mine, theirs):
            raise ValueError(
                f"{what} covers x from {theirs[2]:g} to {theirs[0]:g} m and y from {theirs[3]:g} to {theirs[1]:g} m, "
                f"expected {mine[2]:g} to {mine[0]:g} m and {mine[3]:g} to {mine[1]:g} m"
            )

    def require_cover(self, other: LayoutSpec, what: str) -> list[str]:
        """Raise an error if this layout cannot represent the scenes of another one.

        Args:
            other: Layout of a dataset.
            what: Name of the dataset for messages.

        Returns:
            Notes: objects that this layout leaves out, and values outside its bounds. Positions and sizes of objects
            are clipped to the bounds.

        Raises:
            ValueError: A category or a ground class is missing, or the grids cover different areas.
        """
        self.require_same_area(other, what)
        for name in ("categories", "ground_classes"):
            if missing := [one for one in getattr(other, name) if one not in getattr(self, name)]:
                raise ValueError(
                    f"{what} has the {name} {', '.join(missing)}, which the layout of the model lacks; use a model "
                    "that was trained on such data"
                )
        notes = []
        own = dict(zip(self.categories, self.slots, strict=True))
        if fewer := [name for name, count in zip(other.categories, other.slots, strict=True) if own[name] < count]:
            notes.append(f"{what} has slots for more objects of {', '.join(fewer)}: the farthest ones are left out")
        theirs = other.with_surface(self.surface)
        if not self.covers_heights(other):
            notes.append(
                f"{what} has ground heights from {theirs.height_bounds_m.low[0]:.3g} to "
                f"{theirs.height_bounds_m.high[0]:.3g} m, but the bounds of the layout are "
                f"{self.height_bounds_m.low[0]:.3g} to {self.height_bounds_m.high[0]:.3g} m"
            )
        mine, wanted = self.center_bounds_m, theirs.center_bounds_m
        if wanted.low[2] < mine.low[2] or wanted.high[2] > mine.high[2]:
            notes.append(
                f"{what} has centres of objects at z from {wanted.low[2]:.3g} to {wanted.high[2]:.3g} m, but the "
                f"bounds of the layout are {mine.low[2]:.3g} to {mine.high[2]:.3g} m: z is clipped"
            )
        low, high = (np.array(side) for side in (self.cholesky_bounds.low, self.cholesky_bounds.high))
        margin = 0.02 * (high - low)  # Bounds of equal data also differ a little.
        low, high = low - margin, high + margin
        if (np.array(theirs.cholesky_bounds.low) < low).any() or (np.array(theirs.cholesky_bounds.high) > high).any():
            notes.append(f"{what} has larger or smaller objects than the bounds of the layout: sizes are clipped")
        return notes

    def covers_heights(self, other: LayoutSpec) -> bool:
        """Return whether the height bounds contain those of another layout.

        Args:
            other: Layout of a dataset.

        Returns:
            True if they do.
        """
        mine, theirs = self.height_bounds_m, other.with_surface(self.surface).height_bounds_m
        return mine.low[0] <= theirs.low[0] and theirs.high[0] <= mine.high[0]

    def with_surface(self, surface: str) -> LayoutSpec:
        """Return the layout of the same scenes with another reference surface of the ground heights.

        Args:
            surface: Reference surface.

        Returns:
            Layout with moved height bounds.
        """
        other = replace(self, surface=surface)
        shift = other.slab_offset_m - self.slab_offset_m
        (low,), (high,) = self.height_bounds_m.low, self.height_bounds_m.high
        return replace(other, height_bounds_m=Bounds((low + shift,), (high + shift,))) if shift else other

    def require(self, other: LayoutSpec, what: str) -> None:
        """Raise an error if another spec differs from this one.

        Args:
            other: Spec to compare.
            what: Name of the owner of `other` for the error message.

        Raises:
            ValueError: The specs differ. The message names the first different field.
        """
        if self == other:
            return
        mine, theirs = self.to_dict(), other.to_dict()
        name = next(key for key in mine if mine[key] != theirs[key])
        raise ValueError(
            f"{what} has another LayoutSpec: {name} is {theirs[name]}, expected {mine[name]}; "
            "use the dataset or checkpoint that belongs to it, or train again"
        )
