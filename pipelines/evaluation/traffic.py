"""Simulate traffic on the streets of a scene with SUMO, to find out whether vehicles can drive through it.

The scene is exported as OpenDRIVE, which SUMO's netconvert reads. Trips start and end on random streets.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import NamedTuple

from models.scene import Scene
from pipelines.io.opendrive import export_opendrive
from pipelines.traffic.sumo import read_xml, require_sumo, run_program

DEPARTURE_S = 1.0  # Time between two departures.
HORIZON_S = 900.0  # End of the simulation.


class Traffic(NamedTuple):
    """Result of a simulation.

    Attributes:
        requested: Number of vehicles that should drive from one random street to another.
        routed: Number of vehicles with a way to their goal.
        arrived: Number of vehicles that arrived before the end of the simulation.
    """

    requested: int
    routed: int
    arrived: int

    @property
    def arrived_share(self) -> float:
        """Share of the vehicles with a way to their goal that arrived; NaN if there is none."""
        return self.arrived / self.routed if self.routed else float("nan")


def simulate_traffic(scene: Scene, num_vehicles: int = 300, seed: int = 0) -> Traffic:
    """Let vehicles drive on the streets of a scene.

    One vehicle departs per DEPARTURE_S. Vehicles that wait are never removed, so a street that leads nowhere fills up.
    The simulation ends after HORIZON_S.

    Args:
        scene: Scene with a road class.
        num_vehicles: Number of vehicles.
        seed: Seed of the trips and of the drivers.

    Returns:
        Numbers of vehicles.

    Raises:
        RuntimeError: SUMO is not installed, or one of its programs fails.
        ValueError: The scene has no road.
    """
    home = require_sumo()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "scene.xodr").write_bytes(export_opendrive(scene))
        run_program(home, "bin/netconvert", "--opendrive", folder / "scene.xodr", "--output-file", folder / "net.xml")
        trips = ("--net-file", folder / "net.xml", "--output-trip-file", folder / "trips.xml")
        times = ("--end", num_vehicles * DEPARTURE_S, "--period", DEPARTURE_S, "--seed", seed)
        routes = folder / "routes.xml"
        run_program(home, "tools/randomTrips.py", *trips, *times, "--route-file", routes, "--validate")
        options = ("--end", HORIZON_S, "--time-to-teleport", -1, "--seed", seed, "--no-step-log")
        files = ("--net-file", folder / "net.xml", "--route-files", routes)
        run_program(home, "bin/sumo", *files, *options, "--statistic-output", folder / "statistics.xml")
        counts = read_xml(folder / "statistics.xml").find("vehicles")
        if counts is None:
            raise RuntimeError(f"scene {scene.scene_id}: SUMO wrote no statistics of vehicles")
        loaded, running, waiting = (int(counts.get(key, "0")) for key in ("loaded", "running", "waiting"))
    return Traffic(num_vehicles, loaded, loaded - running - waiting)
