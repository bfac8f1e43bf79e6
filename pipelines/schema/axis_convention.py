"""Names of the axis directions of imported files: "x+" is forward, "x-" backward, "y+" left and "z+" up."""

from __future__ import annotations

import numpy as np

Axes = tuple[str, str, str]  # Directions of the file's first, second and third axis.


def compute_scene_from_axes(axes: Axes) -> np.ndarray:
    """Return the signed permutation that turns file coordinates into the scene frame.

    Args:
        axes: Direction of the file's first, second and third axis, such as ("x+", "y-", "z-").

    Returns:
        (3, 3) matrix; column k is the direction of file axis k in the scene frame.

    Raises:
        ValueError: `axes` does not contain each of x, y and z exactly once, with a sign.
    """
    if sorted(word[:1] for word in axes) != ["x", "y", "z"] or any(word[1:] not in ("+", "-") for word in axes):
        raise ValueError(
            f"axes {' '.join(axes)!r} are invalid; name x (forward), y (left) and z (up) once each with a sign,"
            " as in: x+ y- z-"
        )
    matrix = np.zeros((3, 3))
    for k, (letter, sign) in enumerate(axes):
        matrix["xyz".index(letter), k] = 1.0 if sign == "+" else -1.0
    return matrix
