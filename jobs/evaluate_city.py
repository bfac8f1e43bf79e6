#!/usr/bin/env python3
"""Compare large scenes with data, ring by ring from their centre.

    jobs/evaluate_city.py --generated DIR --run city --real DIR
    jobs/evaluate_city.py --generated DIR --run city --control-run outward --real DIR --num-towns 8

The job cuts each scene of jobs/outpaint_scenes.py into windows of 64 m. Ring 0 is the window of the first scene, ring 1
are the eight windows around it, and so on. For each ring, the job compares the windows with real scenes of the same
label: counts and ground shares per window, label fidelity, distances of distributions, and the classifier test. Street
directions, junctions, blocks and seams are measured on the whole scene.

The reference are scenes of --real with the label of the cities; crops at any place, if the dataset has such crops. The
ceiling are windows of large procedural towns with the same label, cut in the same way. The control is another run, for
example with another order of the blocks. Without --control-run, windows of the ceiling with moved objects take its
place.

The job writes metrics.json, metrics.parquet, windows.parquet (one row per window), the windows as scene tables and
city.html, and logs the scores to MLflow. Run the same command again to resume after an interruption.
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
    """Densities of vegetation and vehicles of the reference and of the ceiling, such as low-medium or any-any (default:
    the label of the cities)."""
    num_reference: int = 400
    """Maximum number of real scenes, selected evenly."""
    num_towns: int = 5
    """Number of procedural towns of the ceiling."""
    output: str = ""
    """Directory to write to (default: $PRITTI_HOME/evaluations/city)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    num_actors: int = 2
    """Number of tasks that run in parallel."""


if __name__ == "__main__":
    run("evaluate_city")
