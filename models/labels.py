"""Labels on which a diffusion transformer can be conditioned."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

from models.scene import DENSITIES

ANY = "any"  # A density that a partial label does not specify.
FREE = "-free"  # End of the partial labels of crops at any place and heading; the others are views of a vehicle.
PART_DROPOUT = 0.25  # Probability that a training sample with a partial label loses one of its two densities.


def _list_partial_labels() -> tuple[str, ...]:
    """Return all partial labels; their index is 16 * free pose + 4 * vegetation + vehicle, where any is 3."""
    densities = (*DENSITIES, ANY)
    return tuple(f"{first}-{second}{pose}" for pose in ("", FREE) for first in densities for second in densities)


# Names of the labels for each kind of label. The index of a joint label is 3 * vegetation + vehicle.
LABELS = {
    "vegetation": DENSITIES,
    "vehicle": DENSITIES,
    "joint": tuple(f"{vegetation}-{vehicle}" for vegetation in DENSITIES for vehicle in DENSITIES),
    "partial": _list_partial_labels(),
    "none": (ANY,),
}


def list_usual_labels(kind: str) -> tuple[str, ...]:
    """Return the labels with which scenes are generated if the user requests no labels.

    Args:
        kind: Kind of label, a key of `LABELS`.

    Returns:
        Names of the labels. For partial labels, views of a vehicle that specify both densities.
    """
    return LABELS["joint" if kind == "partial" else kind]


def list_dropped_labels(kind: str) -> list[list[int]] | None:
    """List the labels that remain of each label if parts of it are dropped.

    Args:
        kind: Kind of label, a key of `LABELS`.

    Returns:
        For each label, the indices of four labels: the label, the label without its vegetation density, without its
        vehicle density, and without both. None: labels of this kind have no parts.
    """
    if kind != "partial":
        return None
    names = LABELS[kind]

    def drop(name: str, vegetation: bool, vehicle: bool) -> int:
        first, second = split_label(kind, name)
        free = name.endswith(FREE)
        return names.index(str(compose_label(kind, None if vegetation else first, None if vehicle else second, free)))

    return [[drop(name, bool(k & 1), bool(k & 2)) for k in range(4)] for name in names]


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
        expected = f"one of: {', '.join(LABELS[kind])}"
        if kind == "partial":
            near = get_close_matches(str(name), LABELS[kind], 1, 0.0)[0]
            expected = (
                f"the densities of vegetation and of vehicles, such as {near!r}; a density is {', '.join(DENSITIES)} "
                f"or {ANY!r} if it is left open, and {FREE!r} at the end selects crops at any place"
            )
        raise ValueError(f"label {name!r} is unknown to a {kind} model, expected {expected}")
    return LABELS[kind].index(name)


def compose_label(kind: str, vegetation: str | None, vehicle: str | None, free_pose: bool = False) -> str | None:
    """Return the label of a scene from its two density labels.

    Args:
        kind: Kind of label, a key of `LABELS`.
        vegetation: Density label of the vegetation; None: unknown.
        vehicle: Density label of the vehicles; None: unknown.
        free_pose: Whether the scene is a crop at any place and heading. Only partial labels hold this.

    Returns:
        Name of the label; None if this kind needs a density label that is None.
    """
    if kind == "partial":
        return f"{vegetation or ANY}-{vehicle or ANY}{FREE if free_pose else ''}"
    if kind == "joint":
        return None if vegetation is None or vehicle is None else f"{vegetation}-{vehicle}"
    return {"vegetation": vegetation, "vehicle": vehicle, "none": LABELS["none"][0]}[kind]


def mark_free(kind: str, label: str) -> str:
    """Return the label of crops at any place and heading that has the same densities.

    Args:
        kind: Kind of label, a key of `LABELS`.
        label: Name of the label.

    Returns:
        Name of the label; the same label if labels of this kind do not distinguish crops from views of a vehicle.
    """
    return label if kind != "partial" or label.endswith(FREE) else label + FREE


def split_label(kind: str, label: str) -> tuple[str | None, str | None]:
    """Return the density labels of vegetation and vehicles that belong to a label.

    Args:
        kind: Kind of label, a key of `LABELS`.
        label: Name of the label.

    Returns:
        Density label of the vegetation, then of the vehicles; None if the label does not specify this density.
    """
    if kind in ("joint", "partial"):
        vegetation, vehicle = (None if part == ANY else part for part in label.removesuffix(FREE).split("-"))
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
