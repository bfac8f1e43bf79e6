"""Read the table tracks, and list the road users of a scene."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as compute

from pipelines.schema.tables import Shard

pc: Any = compute  # The type checker does not know the functions that pyarrow generates.


class RoadUser(NamedTuple):
    """A simulated vehicle or pedestrian at k times, in the scene frame.

    Attributes:
        object_id: Number in the simulation of the scene.
        category: Name of the category.
        size_m: (3,) length, width and height (m).
        time_s: (k,) times since the start of the simulation (s), ascending.
        center_m: (k, 3) centre at these times (m).
        yaw_rad: (k,) direction of travel.
        speed_mps: (k,) speed (m/s).
    """

    object_id: int
    category: str
    size_m: np.ndarray
    time_s: np.ndarray
    center_m: np.ndarray
    yaw_rad: np.ndarray
    speed_mps: np.ndarray

    @property
    def name(self) -> str:
        """Name of the road user in exported files."""
        return f"road_user_{self.object_id}"


def read_tracks(shard: Shard) -> pa.Table:
    """Read the trajectories of all scenes of a shard.

    Args:
        shard: Shard of the table tracks.

    Returns:
        Rows of the table tracks; names are encoded as dictionaries, because plain texts would need much memory.

    Raises:
        ValueError: The file is missing or damaged.
    """
    return shard.read("tracks", encoded=("scene_id", "category"))


def select_tracks(table: pa.Table, scene_id: str) -> pa.Table:
    """Select the trajectories of a scene.

    Args:
        table: Rows of the table tracks.
        scene_id: Name of the scene.

    Returns:
        Rows of the table tracks.
    """
    return table.filter(pc.equal(table["scene_id"].cast(pa.string()), scene_id))


def list_road_users(tracks: pa.Table) -> list[RoadUser]:
    """List the road users of a scene.

    Args:
        tracks: Rows of the table tracks of one scene, ordered by road user and time.

    Returns:
        One entry per road user.
    """
    columns = {name: tracks[name].to_numpy() for name in tracks.schema.names if name not in ("scene_id", "category")}
    center_m = np.stack([columns[name] for name in ("x_m", "y_m", "z_m")], axis=1)
    size_m = np.stack([columns[name] for name in ("length_m", "width_m", "height_m")], axis=1)
    category, number = tracks["category"].to_pylist(), columns["object_id"]
    starts = np.flatnonzero(np.diff(number, prepend=number[:1] - 1))
    users = []
    for first, last in zip(starts, [*starts[1:], len(number)], strict=False):
        rows = slice(first, last)
        time_s, yaw_rad, speed_mps = (columns[name][rows] for name in ("time_s", "yaw_rad", "speed_mps"))
        about = int(number[first]), category[first], size_m[first]
        users.append(RoadUser(*about, time_s, center_m[rows], yaw_rad, speed_mps))
    return users


def find_time_step(users: list[RoadUser]) -> float:
    """Return the smallest time between two positions of a road user (s); 1 if there are no two positions.

    Args:
        users: Road users of one simulation.

    Returns:
        Time (s).
    """
    steps_s = [float(np.diff(user.time_s).min()) for user in users if len(user.time_s) > 1]
    return min(steps_s, default=1.0)
