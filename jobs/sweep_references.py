#!/usr/bin/env python3
"""Sweep the reference set of precision and recall: its size and the distance of its poses.

    jobs/sweep_references.py --real DIR --generated DIR
    jobs/sweep_references.py --real DIR --generated DIR --reference-sizes 1000 5000 --min-distances-m 1 2 5 10 --k 3 5
    jobs/sweep_references.py --real DIR --generated DIR --inception weights-inception-2015-12-05-6726825d.pth

Reproduces the paper's figure. The job extracts the features of all scenes once, then compares each reference set with
equally many generated scenes, labels in equal parts. Reference sets larger than the generated side are left out.
Writes sweep.json, sweep.parquet, two figures (SVG) and sweep.html. Run the same command again to resume after an
interruption.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import run


@dataclass(frozen=True)
class Config:
    real: str = ""
    """Dataset directory of the real scenes (default: $PRITTI_HOME/datasets/town)."""
    real_split: str = "train"
    """Split of the real scenes."""
    generated: str = ""
    """Dataset directory of the generated scenes (default: $PRITTI_HOME/generated)."""
    run: str = ""
    """Read only generated scenes of source generated-<run> (default: all sources)."""
    reference_sizes: tuple[int, ...] = (250, 500, 1000, 2500, 5000, 10_000)
    """Sizes of reference sets chosen by farthest point sampling of poses; the paper uses 1000, 5000 and 10000."""
    min_distances_m: tuple[float, ...] = (1, 2, 5, 10, 20, 50)
    """Minimum distances of poses in metres of the other reference sets; the paper uses 1 to 10."""
    k: tuple[int, ...] = (3, 5)
    """Numbers of nearest neighbours, as in the paper."""
    supersample: int = 1
    """Draw each pixel of a picture as the mean of N x N samples."""
    inception: str = ""
    """File of Inception weights; without it, features come from an untrained network (default: none)."""
    output: str = ""
    """Directory to write to (default: $PRITTI_HOME/evaluations/sweep)."""
    num_actors: int = 2
    """Number of models that run in parallel; use one per GPU."""


if __name__ == "__main__":
    run("sweep_references")
