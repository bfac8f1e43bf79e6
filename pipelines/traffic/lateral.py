"""Move vehicles sideways within the road, so that they keep clear of parked vehicles and other obstacles.

SUMO drives in the middle of lanes. Drivers swerve around parked vehicles, and use the middle of narrow roads.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter1d

from models.scene import Scene
from pipelines.geometry.parked_vehicles import select_road
from pipelines.traffic.obstacles import select_footprints
from pipelines.traffic.tracks import Tracks

LARGEST_M = 1.8  # Largest displacement.
STEP_M = 0.1
CLEARANCE_M = 0.4  # Wanted distance from obstacles.
KERB_CLEARANCE_M = 0.1  # Wanted distance from the border of the road.
LEAST_CLEARANCE_M = 0.15  # Least distance from obstacles, where there is room.
SMOOTH_S = 0.35  # Standard deviation of the Gaussian of each round of smoothing.
ROUNDS = 8  # Number of times that displacements are smoothed and limited to the room between obstacles.
# Costs of a displacement: per metre, per metre of missing clearance to obstacles, and to the border of the road.
COSTS = 1.0, 20.0, 4.0


def swerve(tracks: Tracks, scene: Scene, obstacles: np.ndarray, time_step_s: float) -> Tracks:
    """Move vehicles sideways.

    Each vehicle gets the displacement of least cost at each time. Displacements are then smoothed over time, within the
    room between obstacles.

    Args:
        tracks: Trajectories, ordered by road user and time.
        scene: Scene.
        obstacles: (n,) bool mask of the objects of the scene that are obstacles.
        time_step_s: Time step of the trajectories (s).

    Returns:
        Trajectories. Pedestrians are not changed.
    """
    size_m, grid = scene.grid.resolution_m, scene.grid
    taken = select_footprints(scene, obstacles)
    free_m = np.asarray(distance_transform_edt(~taken)) * size_m if taken.any() else np.full(taken.shape, np.inf)
    # Beyond the border of the scene, the road continues.
    road_m = np.asarray(distance_transform_edt(np.pad(select_road(scene), 16, mode="edge")))[16:-16, 16:-16] * size_m
    ahead = np.stack([np.cos(tracks.yaw_rad), np.sin(tracks.yaw_rad)], axis=1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    offsets_m = np.arange(-LARGEST_M, LARGEST_M + STEP_M / 2, STEP_M)
    half_m = tracks.size_m[:, :2] / 2
    missing = np.zeros((2, len(tracks), len(offsets_m)))
    for along in (-0.8, 0.0, 0.8):
        middle = tracks.center_m[:, :2] + along * half_m[:, :1] * ahead
        points = middle[:, None] + offsets_m[:, None] * left[:, None]
        row, col = grid.pixel(points[..., 0], points[..., 1])
        at = np.clip(row, 0, grid.rows - 1), np.clip(col, 0, grid.cols - 1)
        for k, (distance_m, wanted_m) in enumerate(((free_m, CLEARANCE_M), (road_m, KERB_CLEARANCE_M))):
            lacking = half_m[:, 1:] + wanted_m - distance_m[at]
            missing[k] = np.maximum(missing[k], lacking.clip(0.0))
    cost = COSTS[0] * np.abs(offsets_m) + COSTS[1] * missing[0] + COSTS[2] * missing[1]
    chosen = cost.argmin(axis=1)
    low, high = _find_intervals(missing[0] <= CLEARANCE_M - LEAST_CLEARANCE_M, chosen)
    chosen_m, low_m, high_m = (np.where(tracks.is_vehicle, offsets_m[index], 0.0) for index in (chosen, low, high))
    smooth_m, turn = np.zeros(len(tracks)), np.zeros(len(tracks))
    for part in np.split(np.arange(len(tracks)), np.flatnonzero(np.diff(tracks.object_id)) + 1):
        if not len(part):
            continue
        line = chosen_m[part]
        for _ in range(ROUNDS):
            line = gaussian_filter1d(line, SMOOTH_S / time_step_s, mode="nearest").clip(low_m[part], high_m[part])
        smooth_m[part] = line
        if len(part) > 1:
            turn[part] = np.arctan2(np.gradient(line, time_step_s), np.maximum(tracks.speed_mps[part], 1.0))
    center_m = tracks.center_m.copy()
    center_m[:, :2] += smooth_m[:, None] * left
    return replace(tracks, center_m=center_m, yaw_rad=(tracks.yaw_rad + turn + np.pi) % (2 * np.pi) - np.pi)


def _find_intervals(is_clear: np.ndarray, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and the last column (n,) of the run of clear columns around a chosen column of each row."""
    low, high, row = chosen.copy(), chosen.copy(), np.arange(len(chosen))
    for _ in range(is_clear.shape[1]):
        low -= is_clear[row, np.maximum(low - 1, 0)] & (low > 0)
        high += is_clear[row, np.minimum(high + 1, is_clear.shape[1] - 1)] & (high < is_clear.shape[1] - 1)
    return low, high
