"""Augmentation of training scenes: the same place seen in a mirror, or from a slightly moved vehicle.

Not in the paper; SLEDGE, its forerunner, moves the vehicle by up to a metre and 2.5 degrees. What a moved crop would
see beyond the border of the old one is unknown and stays empty, so moves are small.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from models.scene import Scene, canonicalize_boxes, make_yaw_rotation


@dataclass(frozen=True)
class Augmentation:
    """Which scenes training sees instead of the stored ones. The draw depends on (seed, place in the stream) alone."""

    flip: bool = False  # half of the scenes mirrored left to right
    move_m: float = 0.0  # the vehicle moved by up to this along x and along y
    turn_rad: float = 0.0  # and turned by up to this
    seed: int = 0

    def __call__(self, scene: Scene, place: int) -> Scene:
        rng = np.random.default_rng([7303, self.seed, place])
        flip, dx, dy, turn = rng.random(), *rng.uniform(-1, 1, 3)
        if self.move_m or self.turn_rad:
            scene = move_vehicle(scene, dx * self.move_m, dy * self.move_m, turn * self.turn_rad)
        return mirror_scene(scene) if self.flip and flip < 0.5 else scene


def mirror_scene(scene: Scene) -> Scene:
    """The scene with left and right exchanged; exact. Raises ValueError if its grid is not symmetric."""
    if not np.isclose(scene.grid.left_m, -scene.grid.right_m):
        raise ValueError(f"scene {scene.scene_id}: {scene.grid} is not symmetric about the vehicle, cannot mirror")
    mirror = np.array([1, -1, 1], np.float32)
    rotation, size = canonicalize_boxes(scene.rotation * mirror[:, None], scene.size_m)
    return replace(
        scene,
        center_m=scene.center_m * mirror,
        rotation=rotation,
        size_m=size,
        heading_rad=-scene.heading_rad,
        height_m=scene.height_m[:, :, ::-1],
        occupied=scene.occupied[:, :, ::-1],
    )


def move_vehicle(scene: Scene, dx_m: float, dy_m: float, turn_rad: float) -> Scene:
    """The scene as seen from a vehicle moved by (dx, dy) and then turned to the left by `turn_rad`.

    Primitives are exact, rasters take the nearest pixel; what lies beyond the old crop is empty.
    """
    new_from_old = make_yaw_rotation(-turn_rad)
    center = (scene.center_m - np.array([dx_m, dy_m, 0.0])) @ new_from_old.T
    inside = scene.grid.contains(center[:, 0], center[:, 1])
    seen = scene.select(inside)
    rotation, size = canonicalize_boxes(new_from_old @ seen.rotation, seen.size_m)
    x, y = np.meshgrid(scene.grid.x_m(), scene.grid.y_m(), indexing="ij")
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    row, col = scene.grid.pixel(cos * x - sin * y + dx_m, sin * x + cos * y + dy_m)
    known = (row >= 0) & (row < scene.grid.rows) & (col >= 0) & (col < scene.grid.cols)
    occupied = np.where(
        known, scene.occupied[:, row.clip(0, scene.grid.rows - 1), col.clip(0, scene.grid.cols - 1)], False
    )
    height = scene.height_m[:, row.clip(0, scene.grid.rows - 1), col.clip(0, scene.grid.cols - 1)]
    return replace(
        seen,
        center_m=center[inside].astype(np.float32),
        rotation=rotation.astype(np.float32),
        size_m=size.astype(np.float32),
        heading_rad=((seen.heading_rad - turn_rad + np.pi) % (2 * np.pi) - np.pi).astype(np.float32),
        height_m=np.where(occupied, height, 0).astype(np.float32),
        occupied=occupied,
    )
