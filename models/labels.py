"""What a diffusion transformer may be conditioned on."""

from __future__ import annotations

from collections.abc import Iterable

from models.scene import DENSITIES

# What a DiT may be conditioned on; the joint label is 3 * vegetation + vehicle.
LABELS = {
    "vegetation": DENSITIES,
    "vehicle": DENSITIES,
    "joint": tuple(f"{vegetation}-{vehicle}" for vegetation in DENSITIES for vehicle in DENSITIES),
    "none": ("any",),
}


def find_label_index(kind: str, name: str) -> int:
    """Index of a label's name; ValueError lists the names of this kind."""
    if name not in LABELS[kind]:
        raise ValueError(f"label {name!r} is unknown to a {kind} model, expected one of: {', '.join(LABELS[kind])}")
    return LABELS[kind].index(name)


def require_labels(kind: str, names: Iterable[str]) -> None:
    """Raises ValueError for a label that is unknown to a model conditioned on `kind`."""
    for name in names:
        find_label_index(kind, name)
