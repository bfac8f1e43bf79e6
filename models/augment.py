"""Augment training scenes: mirror a scene, or view it from a slightly moved vehicle.

The paper does not augment scenes. The paper builds on SLEDGE, which moves the vehicle by up to 1 m and rotates it by up
to 2.5 degrees. A moved crop includes an area outside the stored crop. The area outside the stored crop is empty, so
moves should be small.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from models.scene import Scene, canonicalize_boxes, make_yaw_rotation


@dataclass(frozen=True)
class Augmentation:
    """Random changes to training scenes; each change depends only on `seed` and the position in the sample stream.

    Attributes:
        flip: If True, half of the scenes are mirrored left to right.
        move_m: Largest translation of the vehicle along x and along y (metres).
        turn_rad: Largest rotation of the vehicle about z (radians).
        seed: Seed of the random changes.
    """

    flip: bool = False
    move_m: float = 0.0
    turn_rad: float = 0.0
    seed: int = 0

    def __call__(self, scene: Scene, place: int) -> Scene:
        """Return a randomly mirrored and moved copy of a scene.

        Args:
            scene: Stored scene.
            place: Position in the sample stream; the random change depends on it.

        Returns:
            The changed scene, or `scene` itself if nothing changes.
        """
        rng = np.random.default_rng([7303, self.seed, place])
        flip, dx, dy, turn = rng.random(), *rng.uniform(-1, 1, 3)
        if self.move_m or self.turn_rad:
            scene = move_vehicle(scene, dx * self.move_m, dy * self.move_m, turn * self.turn_rad)
        return mirror_scene(scene) if self.flip and flip < 0.5 else scene


def mirror_scene(scene: Scene) -> Scene:
    """Mirror a scene left to right, without resampling.

    Args:
        scene: Scene on a grid that is symmetric about the x axis.

    Returns:
        The mirrored scene on the same grid.

    Raises:
        ValueError: The grid is not symmetric about the x axis.
    """
    if not np.isclose(scene.grid.left_m, -scene.grid.right_m):
        raise ValueError(
            f"scene {scene.scene_id}: {scene.grid} is not symmetric about the x axis, so the scene cannot be mirrored"
        )
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
    """Transform a scene into the frame of a vehicle that moves by (dx, dy) and then turns left by `turn_rad`.

    Primitives are transformed exactly. Rasters are resampled by nearest neighbour. The area outside the stored crop is
    empty.

    Args:
        scene: Scene in the frame of the vehicle before the move.
        dx_m: Forward translation (metres, frame of `scene`).
        dy_m: Translation to the left (metres, frame of `scene`).
        turn_rad: Rotation to the left about z (radians).

    Returns:
        The scene in the frame of the moved vehicle, on the same grid.
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
