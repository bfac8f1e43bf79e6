#!/usr/bin/env python3
"""Simulate traffic on the streets of scenes with SUMO, and score their road networks.

    jobs/simulate_traffic.py --input DIR                              all scenes, 120 s of traffic each
    jobs/simulate_traffic.py --input DIR --vehicles-per-min 60 --max-scenes 10
    jobs/simulate_traffic.py --input DIR --reference OTHER            next to scenes that were simulated before

The job needs the extra traffic (SUMO). It exports the roads of each scene as OpenDRIVE and lets vehicles drive from one
border of the scene to another, and pedestrians walk on sidewalks. Parked vehicles are obstacles. Scenes of 128 m or
more have several roads that meet; in smaller ones, there is little to drive on.

The job writes the tables tracks (positions of all road users) and traffic (what happened to them) next to the scenes,
traffic.html, and moving pictures in traffic_videos/. The traffic of a scene depends only on the seed, the scene and the
options. With each scene, the job simulates a damaged copy with closed roads as a control. Run the same command again to
resume after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import run
from jobs.support.options import IfBusyOption, LogFormatOption, SceneOptions


@dataclass(frozen=True)
class Config(SceneOptions):
    duration_s: float = 120.0
    """Time in seconds in which vehicles enter the scene; the simulation ends when all have left, or 120 s later."""
    vehicles_per_min: float = 20.0
    """Number of vehicles that enter each scene per minute."""
    pedestrians_per_min: float = 6.0
    """Number of pedestrians per minute and scene."""
    time_step_s: float = 0.5
    """Time between two positions of the table tracks in seconds, a multiple of 0.25."""
    seed: int = 0
    """Random seed."""
    control: bool = True
    """Also simulate a copy of each scene with closed roads."""
    reference: str = ""
    """Dataset directory with the table traffic of other scenes, such as real ones, to show next to the scores
    (default: none)."""
    slab_offset_m: float | None = None
    """Height of the ground rasters above the surface on which objects stand, in metres (default: 0 for av2, osm,
    opendrive, own and py123d, and 0.3 for all other sources)."""
    num_examples: int = 3
    """Number of scenes with a moving picture."""
    output: str = ""
    """Dataset directory to write (default: --input)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"


if __name__ == "__main__":
    run("simulate_traffic")
