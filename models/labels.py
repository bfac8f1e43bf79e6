"""Labels on which a diffusion transformer can be conditioned."""

from __future__ import annotations

from collections.abc import Iterable

from models.scene import DENSITIES

# Names of the labels for each kind of label. The index of a joint label is 3 * vegetation + vehicle.
LABELS = {
    "vegetation": DENSITIES,
    "vehicle": DENSITIES,
    "joint": tuple(f"{vegetation}-{vehicle}" for vegetation in DENSITIES for vehicle in DENSITIES),
    "none": ("any",),
}


def find_label_index(kind: str, name: str) -> int:
    """Return the index of a label's name.

    Args:
        kind: Kind of label, a key of `LABELS`.
        name: Name of the label.

    Returns:
        Index of the class.

    Raises:
        ValueError: The name is unknown. The message lists the valid names.
    """
    if name not in LABELS[kind]:
        raise ValueError(f"label {name!r} is unknown to a {kind} model, expected one of: {', '.join(LABELS[kind])}")
    return LABELS[kind].index(name)


def compose_label(kind: str, vegetation: str | None, vehicle: str | None) -> str | None:
    """Return the label of a scene from its two density labels.

    Args:
        kind: Kind of label, a key of `LABELS`.
        vegetation: Density label of the vegetation; None: unknown.
        vehicle: Density label of the vehicles; None: unknown.

    Returns:
        Name of the label; None if this kind needs a density label that is None.
    """
    if kind == "joint":
        return None if vegetation is None or vehicle is None else f"{vegetation}-{vehicle}"
    return {"vegetation": vegetation, "vehicle": vehicle, "none": LABELS["none"][0]}[kind]


def split_label(kind: str, label: str) -> tuple[str | None, str | None]:
    """Return the density labels of vegetation and vehicles that belong to a label.

    Args:
        kind: Kind of label, a key of `LABELS`.
        label: Name of the label.

    Returns:
        Density label of the vegetation, then of the vehicles; None if the label does not specify this density.
    """
    if kind == "joint":
        vegetation, vehicle = label.split("-")
        return vegetation, vehicle
    return label if kind == "vegetation" else None, label if kind == "vehicle" else None


def require_labels(kind: str, names: Iterable[str]) -> None:
    """Raise an error if a label is unknown to a model that is conditioned on `kind`.

    Args:
        kind: Kind of label, a key of `LABELS`.
        names: Names of labels.

    Raises:
        ValueError: A name is unknown.
    """
    for name in names:
        find_label_index(kind, name)
