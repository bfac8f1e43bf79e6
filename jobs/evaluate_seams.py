#!/usr/bin/env python3
"""Measure how visible the seams of outpainted scenes are.

    jobs/evaluate_seams.py --generated DIR                               scenes of jobs/outpaint_scenes.py
    jobs/evaluate_seams.py --generated DIR --rows-m 32 96 --cols-m 32 96
    jobs/evaluate_seams.py --generated DIR --real DIR --real-rows-m 16 32 48

The job counts class changes, height steps, cut objects and duplicate objects at each seam. Each score is the ratio
of the count at the seam to the count at parallel lines 4 to 16 m away. A ratio of 1 means that the seam is invisible.
For comparison, the job also scores lines across the street in real scenes. Lines along the street are not comparable,
because the borders of a street are parallel to such lines. A control shows that the scores can fail: the halves of
different real scenes, joined across the street.

The job writes metrics.json, metrics.parquet, seams.parquet (one row per scene) and seams.html, and logs the scores to
MLflow. A reliable result needs at least 200 seams.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import run
from jobs.support.options import IfBusyOption, LogFormatOption


@dataclass(frozen=True)
class Config:
    generated: str = ""
    """Dataset directory of the outpainted scenes (default: $PRITTI_HOME/outpainted)."""
    run: str = ""
    """Read only outpainted scenes of source generated-<run> (default: all sources)."""
    rows_m: tuple[float, ...] = ()
    """Seams across the street, as distances from the far edge of a scene in metres (default: borders of the middle 64
    m)."""
    cols_m: tuple[float, ...] = ()
    """Seams along the street, as distances from the left edge of a scene in metres (default: borders of the middle 64
    m)."""
    real: str = ""
    """Dataset directory of the real scenes (default: $PRITTI_HOME/datasets/town)."""
    real_split: str = "test"
    """Split of the real scenes."""
    real_rows_m: tuple[float, ...] = (16.0, 32.0, 48.0)
    """Lines across the street in real scenes, as distances from the far edge of a scene in metres."""
    max_scenes: int | None = None
    """Maximum number of scenes of each kind (generated, real), selected evenly (default: all)."""
    output: str = ""
    """Directory to write to (default: $PRITTI_HOME/evaluations/seams)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    num_actors: int = 2
    """Number of actors that run in parallel."""


if __name__ == "__main__":
    run("evaluate_seams")
