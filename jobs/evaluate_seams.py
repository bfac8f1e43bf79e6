#!/usr/bin/env python3
"""Measure how visible the seams of outpainted scenes are.

    jobs/evaluate_seams.py --generated DIR                               scenes of jobs/outpaint_scenes.py
    jobs/evaluate_seams.py --generated DIR --rows-m 32 96 --cols-m 32 96
    jobs/evaluate_seams.py --generated DIR --real DIR --real-rows-m 16 32 48

Each score is a ratio between the seam and parallel lines 4 to 16 m away: changes of class, steps of height, cut
objects and duplicate objects. A ratio of 1 means that the seam does not show. Lines across the street in real scenes
give the level to compare with. Lines along the street are not comparable: the borders of a street run along it.

Writes metrics.json, metrics.parquet, seams.parquet (a row per scene) and seams.html; the scores also go to MLflow. A
result needs at least 200 seams.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import run


@dataclass(frozen=True)
class Config:
    generated: str = ""
    """Dataset directory of the outpainted scenes (default: $PRITTI_HOME/outpainted)."""
    run: str = ""
    """Read only outpainted scenes of source generated-<run> (default: all sources)."""
    rows_m: tuple[float, ...] = ()
    """Seams across the street: metres from a scene's far edge (default: the borders of its middle 64 m)."""
    cols_m: tuple[float, ...] = ()
    """Seams along the street: metres from a scene's left edge (default: the borders of its middle 64 m)."""
    real: str = ""
    """Dataset directory of the real scenes (default: $PRITTI_HOME/datasets/town)."""
    real_split: str = "test"
    """Split of the real scenes."""
    real_rows_m: tuple[float, ...] = (16.0, 32.0, 48.0)
    """Lines across the street in real scenes: distances in metres from a scene's far edge."""
    max_scenes: int | None = None
    """Maximum number of scenes on each side, evenly over each (default: all)."""
    output: str = ""
    """Directory to write to (default: $PRITTI_HOME/evaluations/seams)."""
    num_actors: int = 2
    """Number of actors that run in parallel."""


if __name__ == "__main__":
    run("evaluate_seams")
