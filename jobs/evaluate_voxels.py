#!/usr/bin/env python3
"""Evaluate voxel reconstructions of any method: IoU, mIoU, IoU per class, size on disk.

    jobs/evaluate_voxels.py --ground-truth TRUTH --reconstructed DIR           two directories of .npz, same names
    jobs/evaluate_voxels.py --ground-truth DATASET --split test --reconstructed DIR    files named by scene_id
    jobs/evaluate_voxels.py --ground-truth DATASET --reconstructed DIR --compressed 'LATENTS/*.npy' --allow-missing

Files hold 256 x 256 x 32, 128 x 128 x 16 or 64 x 64 x 8 class ids; coarse grids are upsampled by repetition
(docs/imports.md). Every voxel of the full grid counts, in one confusion matrix over all scenes. Writes metrics.json,
metrics.parquet and voxels.parquet, a row per scene; the scores also go to MLflow.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import run


@dataclass(frozen=True)
class Config:
    ground_truth: str
    """Directory of ground-truth voxels, .npz, or a dataset directory, whose scenes are voxelised."""
    reconstructed: str
    """Directory or quoted pattern of the reconstructed voxels, .npz."""
    compressed: str = ""
    """Directory or pattern of the method's compressed scenes, any files, whose size is reported (default: none)."""
    split: str = ""
    """Read only scenes of this split of the dataset (default: all splits)."""
    axes: tuple[str, str, str] | None = None
    """Directions of the reconstructions' three axes: x forward, y left, z up, each with + or - (default: x- y- z+)."""
    ground_truth_axes: tuple[str, str, str] | None = None
    """Directions of the ground-truth files' three axes (default: x- y- z+)."""
    voxel_range_m: tuple[float, float] = (-1.5, 6.5)
    """Lowest and highest z in metres of a dataset's voxels; the reconstructions must have the same."""
    allow_missing: bool = False
    """Evaluate the scenes that all sides have instead of stopping at a missing counterpart."""
    output: str = ""
    """Directory to write to (default: $PRITTI_HOME/evaluations/voxels)."""


if __name__ == "__main__":
    run("evaluate_voxels")
