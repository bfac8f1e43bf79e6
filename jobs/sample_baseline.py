#!/usr/bin/env python3
"""Generate, reconstruct, inpaint or outpaint scenes with a voxel method.

    jobs/sample_baseline.py --model $PRITTI_HOME/models/semcity-town --num-scenes 64
    jobs/sample_baseline.py --model DIR --task reconstruct --input $PRITTI_HOME/datasets/town --split test
    jobs/sample_baseline.py --model DIR --task inpaint --input DATASET --half left
    jobs/sample_baseline.py --model DIR --task outpaint --input DATASET --windows 3 3 --num-scenes 4

The model is a directory of train_baseline.py. The job writes the table voxels with source=generated-<run>, and one
source per coarser level of PDD and XCube, all with voxels of 0.25 m. It also writes <run>.png, a contact sheet, and
<run>.npz, pictures for evaluate_scenes.py. Scene i depends only on --seed and i. Run the same command again to resume
after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jobs.support.cli import run
from jobs.support.options import GpusOption, IfBusyOption, LogFormatOption, WaitForResourcesOption


@dataclass(frozen=True)
class Config:
    model: str
    """Directory of a trained method."""
    task: Literal["sample", "reconstruct", "inpaint", "outpaint"] = "sample"
    """What to do: sample new scenes, or reconstruct, inpaint or outpaint given scenes."""
    input: str = ""
    """Dataset directory with the table voxels of the given scenes (default: none, for new scenes)."""
    split: str = "test"
    """Split of the given scenes."""
    half: Literal["front", "back", "left", "right"] = "front"
    """Part of each scene that inpainting generates."""
    windows: tuple[int, int] = (3, 3)
    """Odd numbers of windows along x and y of an outpainted scene; windows overlap by half, those of PDD by less."""
    output: str = ""
    """Dataset directory to write (default: $PRITTI_HOME/generated-voxels)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    run: str = ""
    """Name of the run: scenes get source=generated-<run> (default: <method>-<task>)."""
    num_scenes: int = 16
    """Number of scenes."""
    seed: int = 0
    """Random seed."""
    num_actors: int = 1
    """Number of copies of the networks that run in parallel; use one per GPU."""
    gpus: GpusOption = None
    wait_for_resources_s: WaitForResourcesOption = 0.0
    batch_size: int = 4
    """Number of scenes per batch."""


if __name__ == "__main__":
    run("sample_baseline")
