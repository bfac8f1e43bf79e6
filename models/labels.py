"""Classes that a diffusion transformer can be conditioned on."""

from __future__ import annotations

from collections.abc import Iterable

from models.scene import DENSITIES

# Names of the classes by kind of label; the index of a joint label is 3 * vegetation + vehicle.
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


def compose_label(kind: str, vegetation: str | None, vehicle: str | None) -> str | None:
    """The label of a kind from a scene's two densities; None if a density that it needs is unknown."""
    if kind == "joint":
        return None if vegetation is None or vehicle is None else f"{vegetation}-{vehicle}"
    return {"vegetation": vegetation, "vehicle": vehicle, "none": LABELS["none"][0]}[kind]


def split_label(kind: str, label: str) -> tuple[str | None, str | None]:
    """Vegetation and vehicle density that a label asks for; None for one that it leaves open."""
    if kind == "joint":
        vegetation, vehicle = label.split("-")
        return vegetation, vehicle
    return label if kind == "vegetation" else None, label if kind == "vehicle" else None


def require_labels(kind: str, names: Iterable[str]) -> None:
    """Raises ValueError for a label that is unknown to a model conditioned on `kind`."""
    for name in names:
        find_label_index(kind, name)
