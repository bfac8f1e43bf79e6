"""Trajectories of the road users of a scene."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipelines.traffic.demand import KINDS


@dataclass(frozen=True, eq=False)
class Tracks:
    """Positions of n road users and times, in the scene frame.

    Attributes:
        object_id: (n,) number of the road user in the scene.
        kind: (n,) key of KINDS.
        time_s: (n,) time since the start of the simulation (s).
        center_m: (n, 3) centre (m).
        yaw_rad: (n,) direction of travel, in [-pi, pi).
        speed_mps: (n,) speed (m/s).
    """

    object_id: np.ndarray
    kind: np.ndarray
    time_s: np.ndarray
    center_m: np.ndarray
    yaw_rad: np.ndarray
    speed_mps: np.ndarray

    @property
    def size_m(self) -> np.ndarray:
        """(n, 3) length, width and height (m)."""
        return np.array([KINDS[kind].size_m for kind in self.kind]).reshape(-1, 3)

    @property
    def is_vehicle(self) -> np.ndarray:
        """(n,) bool; False for pedestrians."""
        return self.kind != "pedestrian"

    def __len__(self) -> int:
        """Return the number of positions."""
        return len(self.object_id)

    def select(self, chosen: np.ndarray) -> Tracks:
        """Select positions.

        Args:
            chosen: (n,) bool.

        Returns:
            The selected positions.
        """
        names = ("object_id", "kind", "time_s", "center_m", "yaw_rad", "speed_mps")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})
