#!/usr/bin/env python3
"""Compute precision and recall for reference sets of different size and pose spacing.

    jobs/sweep_references.py --real DIR --generated DIR
    jobs/sweep_references.py --real DIR --generated DIR --reference-sizes 1000 5000 --min-distances-m 1 2 5 10 --k 3 5
    jobs/sweep_references.py --real DIR --generated DIR --inception weights-inception-2015-12-05-6726825d.pth

The job reproduces the paper's figure of precision and recall over reference sets. The job extracts the features of all
scenes once. Then it compares each reference set with the same number of generated scenes. Each label has the same share
of these scenes. The job omits a reference set if there are fewer generated scenes than reference scenes. The job writes
sweep.json, sweep.parquet, two figures (SVG) and sweep.html. Run the same command again to resume after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import run
from jobs.support.options import GpusOption, IfBusyOption, LogFormatOption, WaitForResourcesOption


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
    """Sizes of reference sets from farthest point sampling of poses; the paper uses 1000, 5000 and 10000."""
    min_distances_m: tuple[float, ...] = (1, 2, 5, 10, 20, 50)
    """Minimum distances in metres between the poses of the other reference sets; the paper uses 1 to 10."""
    k: tuple[int, ...] = (3, 5)
    """Numbers of nearest neighbours, as in the paper."""
    supersample: int = 1
    """Supersampling factor N: each pixel of a picture is the mean of N x N samples."""
    inception: str = ""
    """File of Inception weights; without this file, features come from an untrained network (default: none)."""
    output: str = ""
    """Directory to write to (default: $PRITTI_HOME/evaluations/sweep)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    num_actors: int = 2
    """Number of models that run in parallel; use one per GPU."""
    gpus: GpusOption = None
    wait_for_resources_s: WaitForResourcesOption = 0.0


if __name__ == "__main__":
    run("sweep_references")
