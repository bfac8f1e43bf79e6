"""Damage real scenes in a known way, to test whether a score rates damaged scenes worse than real scenes.

Each control (CONTROLS) is one kind of damage. A score is worth reporting only if it rates each control that it claims
to measure worse than the real scenes. Some controls damage the objects and keep the ground; the others damage the
ground and keep the objects. Scene id, density labels, pose and grid of a scene are always kept.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from models.scene import Grid, Scene, canonicalize_boxes, concatenate_primitives, make_yaw_rotation

MOVE_M = 4.0  # Maximum displacement of an object.
TURN_RAD = np.pi / 4
DROP_SHARE, DUPLICATE_SHARE = 0.3, 0.1
DUPLICATE_M = 0.25  # Distance between an object and its duplicate.
GROUND_SHIFT_M = 4.0
# Damage of the control of reconstructions.
RECONSTRUCTION_CONTROL = f"objects moved by up to {MOVE_M:g} m and the ground shifted by {GROUND_SHIFT_M:g} m"
ROUGH_AMPLITUDE_M, ROUGH_PERIOD_M = 0.5, 2.0
INSET_M = 0.01  # Minimum distance of a clipped centre from the border of the grid.

# Scores that are read first. At least two of them must notice each control.
HEADLINES = ("two_sample_auc", "relation_frechet", "lite0_frechet", "lite0_coverage_k3")
# Descriptions of the controls for reports.
CONTROLS = {
    "moved": "each object moves horizontally by up to 4 m and keeps its height above ground",
    "turned": "each object turns by 45 degrees about its vertical axis",
    "permuted": "the objects of the scene swap their horizontal positions and keep their height above ground",
    "transplanted": "the objects of another scene stand on the ground of this scene",
    "dropped": "30 % of the objects are removed",
    "duplicated": "10 % of the objects have a duplicate at a distance of 0.25 m",
    "ground_shifted": "the ground is shifted by 4 m, and the objects are not",
    "ground_roughened": "the borders of the ground classes are wavy, with an amplitude of 0.5 m and a period of 2 m",
}


def damage_scene(control: str, scene: Scene, donor: Scene, key: Sequence[int]) -> Scene:
    """Return a damaged copy of a scene.

    Objects that keep their height above ground move vertically with the fused ground surface under their centre. If
    there is no ground at the old or the new position, z is kept. A control that finds nothing to damage returns an
    equal scene: for example, a scene without objects or ground.

    Args:
        control: Name of the control (CONTROLS).
        scene: Scene to damage.
        donor: Scene whose objects `transplanted` takes; the other controls ignore it.
        key: Non-negative integers that seed the random generator. Equal arguments give equal results.

    Returns:
        The damaged scene. It may share arrays with `scene` and `donor`.

    Raises:
        ValueError: The control is unknown.
    """
    if control not in CONTROLS:
        raise ValueError(f"control {control!r} is unknown, expected one of: {', '.join(CONTROLS)}")
    return _DAMAGES[control](scene, donor, np.random.default_rng(list(key)))


def _move_objects(scene: Scene, donor: Scene, rng: np.random.Generator) -> Scene:
    """Move each object horizontally by a random distance of at most MOVE_M in a random direction."""
    before_m = scene.center_m[:, :2].astype(float)
    after_m = before_m + rng.uniform(0, MOVE_M, (len(scene), 1)) * _sample_directions(len(scene), rng)
    low_m, high_m = _find_limits(scene.grid)
    # An object outside the grid may stay there. Otherwise, clipping could move it farther than MOVE_M.
    return _set_positions(scene, after_m.clip(np.minimum(low_m, before_m), np.maximum(high_m, before_m)))


def _turn_objects(scene: Scene, donor: Scene, rng: np.random.Generator) -> Scene:
    """Turn each object by TURN_RAD about the vertical axis through its centre."""
    turned = make_yaw_rotation(TURN_RAD) @ scene.rotation.astype(float)
    rotation, size_m = canonicalize_boxes(turned, scene.size_m)
    heading_rad = (scene.heading_rad.astype(float) + TURN_RAD + np.pi) % (2 * np.pi) - np.pi
    return replace(
        scene, rotation=rotation.astype(np.float32), size_m=size_m, heading_rad=heading_rad.astype(np.float32)
    )


def _permute_objects(scene: Scene, donor: Scene, rng: np.random.Generator) -> Scene:
    """Assign the horizontal positions of the objects to the objects in a random order."""
    return _set_positions(scene, scene.center_m[rng.permutation(len(scene)), :2])


def _transplant_objects(scene: Scene, donor: Scene, rng: np.random.Generator) -> Scene:
    """Replace the objects by the objects of `donor`, at the same x and y and the same height above ground."""
    result = replace(scene, **concatenate_primitives([donor]))
    return _raise_objects(result, donor.ground_under()[0])


def _drop_objects(scene: Scene, donor: Scene, rng: np.random.Generator) -> Scene:
    """Remove a random DROP_SHARE of the objects."""
    keep = np.ones(len(scene), bool)
    keep[_choose_objects(scene, DROP_SHARE, rng)] = False
    return scene.select(keep)


def _duplicate_objects(scene: Scene, donor: Scene, rng: np.random.Generator) -> Scene:
    """Append duplicates of a random DUPLICATE_SHARE of the objects, displaced horizontally by DUPLICATE_M."""
    copies = scene.select(_choose_objects(scene, DUPLICATE_SHARE, rng))
    by_m = DUPLICATE_M * _sample_directions(len(copies), rng)
    before_m = copies.center_m[:, :2].astype(float)
    low_m, high_m = _find_limits(scene.grid)
    # Along each axis, a duplicate that would leave the grid moves the opposite way. The distance is kept.
    leaves = (before_m + by_m < low_m) | (before_m + by_m > high_m)
    center_m = copies.center_m.copy()
    center_m[:, :2] = before_m + np.where(leaves, -by_m, by_m)
    first_id = scene.instance_id.max(initial=-1) + 1
    instance_id = first_id + np.arange(len(copies), dtype=np.int64)
    copies = replace(copies, center_m=center_m, instance_id=instance_id)
    return replace(scene, **concatenate_primitives([scene, copies]))


def _shift_ground(scene: Scene, donor: Scene, rng: np.random.Generator) -> Scene:
    """Shift the rasters by GROUND_SHIFT_M along +x, -x, +y or -y; border pixels fill the gap."""
    axis, sign = divmod(int(rng.integers(4)), 2)
    pixels = round(GROUND_SHIFT_M / scene.grid.resolution_m) * (1 if sign else -1)
    count = (scene.grid.rows, scene.grid.cols)[axis]
    source = (np.arange(count) + pixels).clip(0, count - 1)
    return replace(
        scene, height_m=scene.height_m.take(source, axis + 1), occupied=scene.occupied.take(source, axis + 1)
    )


def _roughen_ground(scene: Scene, donor: Scene, rng: np.random.Generator) -> Scene:
    """Sample the rasters at positions with a wavy displacement, which makes the borders of the classes wavy.

    The pixel at p = (x, y) takes the value of the pixel nearest to p + A (sin(2 pi y / T + a), sin(2 pi x / T + b)),
    with A = ROUGH_AMPLITUDE_M, T = ROUGH_PERIOD_M and random phases a and b. A displacement below half a pixel has no
    effect; therefore, pixels must be smaller than 2 A.
    """
    grid = scene.grid
    phase = rng.uniform(0, 2 * np.pi, 2)
    # The x displacement depends on the column only, and the y displacement on the row only.
    dx_m = ROUGH_AMPLITUDE_M * np.sin(2 * np.pi / ROUGH_PERIOD_M * grid.y_m() + phase[0])
    dy_m = ROUGH_AMPLITUDE_M * np.sin(2 * np.pi / ROUGH_PERIOD_M * grid.x_m() + phase[1])
    row = np.arange(grid.rows)[:, None] - np.rint(dx_m / grid.resolution_m).astype(np.int64)
    col = np.arange(grid.cols) - np.rint(dy_m / grid.resolution_m).astype(np.int64)[:, None]
    source = row.clip(0, grid.rows - 1) * grid.cols + col.clip(0, grid.cols - 1)
    flat = (len(scene.ground_classes), grid.rows * grid.cols)
    return replace(
        scene,
        height_m=scene.height_m.reshape(flat).take(source, axis=1),
        occupied=scene.occupied.reshape(flat).take(source, axis=1),
    )


_DAMAGES: dict[str, Callable[[Scene, Scene, np.random.Generator], Scene]] = {
    "moved": _move_objects,
    "turned": _turn_objects,
    "permuted": _permute_objects,
    "transplanted": _transplant_objects,
    "dropped": _drop_objects,
    "duplicated": _duplicate_objects,
    "ground_shifted": _shift_ground,
    "ground_roughened": _roughen_ground,
}


def _find_limits(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and the largest (x, y) of a clipped centre (metres, scene frame)."""
    low_m, high_m = np.array([grid.back_m, grid.right_m]), np.array([grid.front_m, grid.left_m])
    return low_m + INSET_M, high_m - INSET_M


def _sample_directions(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return n random horizontal unit vectors (n, 2)."""
    angle_rad = rng.uniform(-np.pi, np.pi, n)
    return np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=1)


def _choose_objects(scene: Scene, share: float, rng: np.random.Generator) -> np.ndarray:
    """Return the sorted indices of a random share of the objects: at least one object if there are any."""
    n = len(scene)
    return np.sort(rng.choice(n, min(n, max(1, round(share * n))), replace=False))


def _set_positions(scene: Scene, xy_m: np.ndarray) -> Scene:
    """Return the scene with its objects at xy_m (n, 2), at the same height above ground."""
    center_m = scene.center_m.copy()
    center_m[:, :2] = xy_m
    return _raise_objects(replace(scene, center_m=center_m), scene.ground_under()[0])


def _raise_objects(scene: Scene, ground_m: np.ndarray) -> Scene:
    """Raise each object by the height of its ground above ground_m (n,); NaN on either side: no change."""
    center_m = scene.center_m.copy()
    center_m[:, 2] += np.nan_to_num(scene.ground_under()[0] - ground_m)
    return replace(scene, center_m=center_m)


def list_headline_scores(scores: Mapping[str, object]) -> list[str]:
    """Return the headline scores; without EfficientNet-Lite0, those of the untrained network take their places.

    Args:
        scores: Scores of a set.

    Returns:
        Names of HEADLINES that exist in `scores`.
    """
    names = (name if name in scores else name.replace("lite0_", "random_") for name in HEADLINES)
    return [name for name in names if name in scores]
