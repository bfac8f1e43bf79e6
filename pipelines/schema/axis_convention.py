"""Name the directions of the axes of another method's files: "x+" is forward, "x-" back, "y+" left, "z+" up."""

from __future__ import annotations

import numpy as np

Axes = tuple[str, str, str]  # of the file's first, second and third axis


def compute_scene_from_axes(axes: Axes) -> np.ndarray:
    """(3, 3) signed permutation; column k is the direction of the file's axis k in the scene frame.

    Raises ValueError unless each of x, y and z is named once, with a sign.
    """
    if sorted(word[:1] for word in axes) != ["x", "y", "z"] or any(word[1:] not in ("+", "-") for word in axes):
        raise ValueError(
            f"axes {' '.join(axes)!r}: name x (forward), y (left) and z (up) once each, with the way each axis of the"
            " file points, as in: x+ y- z-"
        )
    matrix = np.zeros((3, 3))
    for k, (letter, sign) in enumerate(axes):
        matrix["xyz".index(letter), k] = 1.0 if sign == "+" else -1.0
    return matrix
