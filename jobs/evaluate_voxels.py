#!/usr/bin/env python3
"""Evaluate voxel reconstructions of any method: IoU, mIoU, IoU per class, and size on disk.

    jobs/evaluate_voxels.py --ground-truth TRUTH --reconstructed DIR           two directories of .npz, same names
    jobs/evaluate_voxels.py --ground-truth DATASET --split test --reconstructed DIR    files named by scene_id
    jobs/evaluate_voxels.py --ground-truth DATASET --reconstructed DIR --compressed 'LATENTS/*.npy' --allow-missing

A file holds class ids on a grid of 256 x 256 x 32, or on a coarser grid of SemCity, XCube or PDD. Coarse grids are
upsampled by repetition (docs/how_to/import_scenes.md). The scores come from one confusion matrix of all voxels of all
scenes. The job writes metrics.json, metrics.parquet and voxels.parquet (one row per scene), and logs the scores to
MLflow.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import run
from jobs.support.options import IfBusyOption, LogFormatOption


@dataclass(frozen=True)
class Config:
    ground_truth: str
    """Directory of ground-truth voxels (.npz), or a dataset directory; its scenes are then voxelised."""
    reconstructed: str
    """Directory or quoted pattern of the reconstructed voxels (.npz)."""
    compressed: str = ""
    """Directory or pattern of the method's compressed scenes; the job reports their file sizes (default: none)."""
    split: str = ""
    """Read only scenes of this split of the dataset (default: all splits)."""
    axes: tuple[str, str, str] | None = None
    """Directions of the three axes of the reconstructions: x (forward), y (left) or z (up), each with + or - (default:
    x- y- z+)."""
    ground_truth_axes: tuple[str, str, str] | None = None
    """Directions of the three axes of the ground-truth files (default: x- y- z+)."""
    voxel_range_m: tuple[float, float] = (-1.5, 6.5)
    """Lowest and highest z in metres of a dataset's voxels; the reconstructions must have the same."""
    allow_missing: bool = False
    """Evaluate only the scenes for which all files exist, instead of stopping at a missing file."""
    output: str = ""
    """Directory to write to (default: $PRITTI_HOME/evaluations/voxels)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"


if __name__ == "__main__":
    run("evaluate_voxels")
