"""Roads of an extract: cross-sections, poses of a vehicle, and the nearest road of a point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import shapely

from pipelines.preprocess.sources.maps import order_by_squares
from pipelines.preprocess.sources.osm.extract import Extract
from pipelines.preprocess.sources.osm.tags import STREETS, Profile, Tags, find_profile, is_underground
from pipelines.schema.splits import CROP_AHEAD_M

FREE_OFFSET_M = 30.0  # Largest distance of the middle of a free crop from a pose on a road.


@dataclass(frozen=True, eq=False)
class Road:
    """A way for vehicles.

    Attributes:
        id: Number of the way.
        tags: Tags.
        profile: Cross-section.
        line: Line of the way (m).
        nodes: Numbers of its nodes.
    """

    id: int
    tags: Tags
    profile: Profile
    line: Any
    nodes: tuple[int, ...]


class StreetPoses(NamedTuple):
    """Poses along the streets of an extract.

    Attributes:
        xy_m: Positions (m).
        yaw_rad: Headings.
        is_free: Whether a pose lies at any place and heading instead of being that of a vehicle.
    """

    xy_m: np.ndarray  # (p, 2)
    yaw_rad: np.ndarray  # (p,)
    is_free: np.ndarray  # (p,) bool


def list_roads(extract: Extract) -> list[Road]:
    """Return the roads of an extract, except those in tunnels."""
    found = []
    for way in extract.lines:
        profile = None if is_underground(way.tags) else find_profile(way.tags)
        if profile is not None and way.geometry.length > 0:
            found.append(Road(way.id, way.tags, profile, way.geometry, way.nodes))
    return found


def sample_line(line: Any, distance_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 2) on a line and the directions (n, 2) there.

    Args:
        line: Line (m).
        distance_m: (n,) distances from the start of the line (m).

    Returns:
        Points and unit directions.
    """
    points = shapely.get_coordinates(line)
    steps = np.diff(points, axis=0)
    length = np.linalg.norm(steps, axis=1)
    points, steps, length = points[:-1][length > 0], steps[length > 0], length[length > 0]
    start = np.concatenate([[0.0], np.cumsum(length)])
    segment = np.searchsorted(start, distance_m, side="right").clip(1, len(length)) - 1
    direction = steps[segment] / length[segment, None]
    return points[segment] + direction * (distance_m - start[segment])[:, None], direction


def make_street_poses(
    extract: Extract, spacing_m: float, free_share: float, drive_on_left: bool, seed: int
) -> StreetPoses:
    """Return poses along the streets, in each direction of travel.

    The poses of a vehicle lie in the middle of the carriageway's half on its side. The crops of free poses lie within
    FREE_OFFSET_M of them along each axis. All poses are ordered by squares, so that consecutive poses see the same part
    of the extract.

    Args:
        extract: Extract.
        spacing_m: Distance between successive poses of a street and direction (m).
        free_share: Share of free poses.
        drive_on_left: Whether vehicles drive on the left.
        seed: Seed of the free poses.

    Returns:
        Poses of vehicles inside the region of the extract, and free poses near them.
    """
    parts, rotations = [], []
    for road in list_roads(extract):
        profile = road.profile
        if profile.highway not in STREETS:
            continue
        distance = np.arange(spacing_m / 2, road.line.length, spacing_m)
        points, along = sample_line(road.line, distance)
        for way in (1, -1):
            if profile.oneway == -way:
                continue
            right = way * np.stack([along[:, 1], -along[:, 0]], axis=1)
            kerb = profile.right_m if (way == 1) != drive_on_left else profile.left_m
            aside = kerb / 2 if profile.oneway == 0 else (profile.right_m - profile.left_m) * way / 2
            parts.append(points + right * (-aside if drive_on_left and profile.oneway == 0 else aside))
            rotations.append(np.arctan2(way * along[:, 1], way * along[:, 0]))
    xy = np.concatenate([np.zeros((0, 2)), *parts])
    yaw = np.concatenate([np.zeros(0), *rotations])
    low, high = extract.box_m
    inside = ((xy >= low) & (xy <= high)).all(axis=1)
    xy, yaw = xy[inside], yaw[inside]
    free_xy, free_yaw = _draw_free_poses(xy, free_share, seed)
    is_free = np.arange(len(xy) + len(free_xy)) >= len(xy)
    xy, yaw = np.concatenate([xy, free_xy]), np.concatenate([yaw, free_yaw])
    order = order_by_squares(xy)
    return StreetPoses(xy[order], yaw[order], is_free[order])


def _draw_free_poses(xy: np.ndarray, share: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and headings of poses whose crops lie about FREE_OFFSET_M around the given positions."""
    count = round(len(xy) * share / (1 - share))
    rng = np.random.default_rng([7307, seed])
    yaw = rng.uniform(-np.pi, np.pi, count)
    middle = xy[rng.integers(0, max(1, len(xy)), count)] + rng.uniform(-FREE_OFFSET_M, FREE_OFFSET_M, (count, 2))
    return middle - CROP_AHEAD_M * np.stack([np.cos(yaw), np.sin(yaw)], axis=1), yaw


class NearestRoads:
    """Index of roads by place."""

    def __init__(self, roads: list[Road]) -> None:
        self.roads = roads
        self.tree = shapely.STRtree([road.line for road in roads])

    def find(self, xy_m: np.ndarray, reach_m: float) -> tuple[Road, np.ndarray, np.ndarray] | None:
        """Find the nearest road.

        Args:
            xy_m: (2,) point (m).
            reach_m: Largest distance (m).

        Returns:
            Road, nearest point (2,) on its line, and direction (2,) of the line there; None if no road is near.
        """
        point = shapely.Point(xy_m)
        index = self.tree.query_nearest(point, max_distance=reach_m, all_matches=False)
        if not len(index):
            return None
        road = self.roads[int(index[0])]
        foot, along = sample_line(road.line, np.array([road.line.project(point)]))
        return road, foot[0], along[0]
