"""Distinguish parked vehicles from vehicles in traffic."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import distance_transform_edt

from models.scene import ROAD_CLASSES, VEHICLES, Scene

KERB_M = 1.6  # A vehicle whose centre is at most this far from the border of the road is parked.


def select_road(scene: Scene) -> np.ndarray:
    """Select the road of a scene.

    Args:
        scene: Scene.

    Returns:
        (rows, cols) bool.
    """
    names = [k for k, name in enumerate(scene.ground_classes) if name in ROAD_CLASSES]
    return np.any(scene.occupied[names], axis=0)


def find_parked_vehicles(scene: Scene) -> np.ndarray:
    """Find the vehicles that stand outside of the road or at its border.

    Args:
        scene: Scene.

    Returns:
        (n,) bool. Other vehicles are in traffic.
    """
    # Beyond the border of the scene, the road continues.
    depth_m = np.asarray(distance_transform_edt(np.pad(select_road(scene), 16, mode="edge"))) * scene.grid.resolution_m
    row, col = scene.grid.pixel(scene.center_m[:, 0], scene.center_m[:, 1])
    row, col = np.clip(row, 0, scene.grid.rows - 1), np.clip(col, 0, scene.grid.cols - 1)
    return np.isin(scene.category, VEHICLES) & (depth_m[row + 16, col + 16] <= KERB_M)


def find_driving_vehicles(scene: Scene) -> np.ndarray:
    """Find the vehicles in traffic. Simulated traffic replaces them.

    Args:
        scene: Scene.

    Returns:
        (n,) bool; False for parked vehicles and for objects other than vehicles.
    """
    return np.isin(scene.category, VEHICLES) & ~find_parked_vehicles(scene)
