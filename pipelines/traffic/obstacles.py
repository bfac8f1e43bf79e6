"""Parked vehicles of a scene as obstacles: the road that remains free between them, and contacts of moving vehicles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely
from scipy.ndimage import binary_opening, distance_transform_edt
from skimage.draw import polygon

from models.scene import ROAD_CLASSES, Scene
from pipelines.geometry.parked_vehicles import select_road

CLEARANCE_M = 0.1  # Distance that moving vehicles keep from parked ones.
GAP_M = 2.0  # Narrower gaps between parked vehicles are not part of the free road.
CLOSURES, CLOSURE_M = 4, 10.0  # Number and radius of the circles without road in the control (m).


def remove_occupied_road(scene: Scene, parked: np.ndarray) -> Scene:
    """Remove the parts of the road on which vehicles cannot drive because of parked ones.

    Args:
        scene: Scene.
        parked: (n,) bool mask of the parked vehicles.

    Returns:
        The scene with less road. The ground elsewhere is unchanged.
    """
    road = select_road(scene)
    taken = select_footprints(scene, parked, CLEARANCE_M) & road
    if not taken.any():
        return scene
    radius = round(GAP_M / 2 / scene.grid.resolution_m)
    y, x = np.ogrid[-radius : radius + 1, -radius : radius + 1]
    wide = np.pad(road & ~taken, radius, mode="edge")
    opened = np.asarray(binary_opening(wide, x * x + y * y <= radius * radius))
    free = opened[radius : radius + road.shape[0], radius : radius + road.shape[1]]
    # Narrow parts of the road that no parked vehicle touches are kept.
    others = np.logical_not(taken)
    near = np.asarray(distance_transform_edt(others)) * scene.grid.resolution_m <= GAP_M
    lost = road & (taken | near & np.logical_not(free))
    names = np.isin(scene.ground_classes, ROAD_CLASSES)
    return replace(scene, occupied=scene.occupied & ~(names[:, None, None] & lost))


def select_footprints(scene: Scene, chosen: np.ndarray, margin_m: float = 0.0) -> np.ndarray:
    """Select the pixels in the footprints of objects.

    Args:
        scene: Scene.
        chosen: (n,) bool mask of the objects.
        margin_m: Margin around each footprint (m).

    Returns:
        (rows, cols) bool.
    """
    found = np.zeros((scene.grid.rows, scene.grid.cols), bool)
    some = scene.select(chosen)
    for shape in make_footprints(some.center_m[:, :2], some.yaw_rad, some.size_m[:, :2] + 2 * margin_m):
        x_m, y_m = shapely.get_coordinates(shape).T
        row, col = (
            (scene.grid.front_m - x_m) / scene.grid.resolution_m,
            (scene.grid.left_m - y_m) / scene.grid.resolution_m,
        )
        found[polygon(row - 0.5, col - 0.5, found.shape)] = True
    return found


def make_footprints(xy_m: np.ndarray, yaw_rad: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """Make the footprints of boxes.

    Args:
        xy_m: (n, 2) centres (m).
        yaw_rad: (n,) directions of the length axes.
        size_m: (n, 2) lengths and widths (m).

    Returns:
        (n,) shapely polygons.
    """
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / 2
    local = signs * size_m[:, None]
    cos, sin = np.cos(yaw_rad)[:, None], np.sin(yaw_rad)[:, None]
    x, y = local[..., 0], local[..., 1]
    corners = np.stack([cos * x - sin * y, sin * x + cos * y], axis=2) + xy_m[:, None]
    return np.array(shapely.polygons(corners), object).reshape(len(xy_m))


def find_contacts(footprints: np.ndarray, obstacles: np.ndarray) -> np.ndarray:
    """Find the footprints that overlap an obstacle.

    Args:
        footprints: (n,) polygons.
        obstacles: (m,) polygons.

    Returns:
        (n,) bool.
    """
    found = np.zeros(len(footprints), bool)
    if len(obstacles) and len(footprints):
        found[shapely.STRtree(obstacles).query(footprints, predicate="intersects")[0]] = True
    return found


def close_roads(scene: Scene, seed: int) -> Scene:
    """Close roads: the control of simulations of traffic.

    Args:
        scene: Scene.
        seed: Seed of the places.

    Returns:
        The scene without road in CLOSURES circles of radius CLOSURE_M around random points of the road.
    """
    rng = np.random.default_rng([7412, seed])
    row, col = np.nonzero(select_road(scene))
    if not len(row):
        return scene
    centers = rng.choice(len(row), CLOSURES)
    y, x = np.ogrid[: scene.grid.rows, : scene.grid.cols]
    radius = CLOSURE_M / scene.grid.resolution_m
    closed = np.any([(y - row[k]) ** 2 + (x - col[k]) ** 2 <= radius**2 for k in centers], axis=0)
    names = np.isin(scene.ground_classes, ROAD_CLASSES)
    return replace(scene, occupied=scene.occupied & ~(names[:, None, None] & closed))
