#!/usr/bin/env python3
"""Score cities, that is, large outpainted scenes, ring by ring against real scenes.

    jobs/evaluate_city.py --generated DIR --run city --real DIR
    jobs/evaluate_city.py --generated DIR --run city --control-run outward --real DIR --num-towns 8

The job cuts each scene of jobs/outpaint_scenes.py into windows of 64 m. Ring 0 is the window of the first scene, ring 1
consists of the eight windows around it, and so on. For each ring, the job compares the windows with real scenes of the
same label: counts and ground shares per window, label fidelity, distances of distributions, and the two-sample test.
Street directions, junctions, city blocks, traffic and seams are measured on the whole scene.

The reference consists of scenes of --real with the label of the cities. If the dataset has crops at free poses, only
these are used. For cities with --labels-map, each window has the label of the nearest block, reference and ceiling
contain all labels, and a further table compares the windows of each label with the reference. The ceiling consists of
windows of large procedural towns with the same label, cut in the same way. The control is another run, for example with
another order of the blocks. Without --control-run, the control consists of windows of the ceiling with moved objects.

The job writes metrics.json, metrics.parquet, windows.parquet (one row per window), the windows as scene tables and
city.html, and logs the scores to MLflow. An interrupted run starts again from the beginning.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import run
from jobs.support.options import IfBusyOption, LogFormatOption


@dataclass(frozen=True)
class Config:
    generated: str = ""
    """Dataset directory of the large scenes (default: $PRITTI_HOME/outpainted)."""
    run: str = "outpainted"
    """Read only scenes of source generated-<run>."""
    control_run: str = ""
    """Another run in the same directory, as the control (default: moved objects in windows of the ceiling)."""
    real: str = ""
    """Dataset directory of the real scenes (default: $PRITTI_HOME/datasets/town)."""
    real_split: str = "test"
    """Split of the real scenes."""
    label: str = ""
    """Density of vegetation, then of vehicles, of the reference and of the ceiling, such as low-medium; any-any selects
    all scenes (default: the label of the cities; any-any for cities with --labels-map)."""
    num_reference: int = 400
    """Maximum number of real scenes, selected evenly."""
    num_towns: int = 5
    """Number of procedural towns of the ceiling, at least 2."""
    rings_per_group: int | None = None
    """Number of rings that are scored together; ring 0 belongs to the first group (default: 1 for cities below 832 m,
    more for larger ones, so that there are at most five groups)."""
    traffic: bool = True
    """Simulate traffic on the streets with SUMO, if it is installed (extra traffic or $SUMO_HOME)."""
    output: str = ""
    """Directory to write to (default: $PRITTI_HOME/evaluations/city)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    num_actors: int = 2
    """Number of tasks that run in parallel."""


if __name__ == "__main__":
    run("evaluate_city")
