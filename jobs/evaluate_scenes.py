#!/usr/bin/env python3
"""Evaluate generated scenes against real scenes, and layout-VAE reconstruction.

    jobs/evaluate_scenes.py --real DIR --generated DIR
    jobs/evaluate_scenes.py --real DIR --generated DIR --inception weights-inception-2015-12-05-6726825d.pth
    jobs/evaluate_scenes.py --real DIR --generated DIR --max-scenes 10000 --reference min-distance --min-distance-m 10
    jobs/evaluate_scenes.py --real DIR --generated samples.npz --inception FILE
    jobs/evaluate_scenes.py --real DIR --lvae MODEL

Reads the scene tables only; with --lvae and without --generated, --run and --generated-source, only reconstruction is
evaluated. Of an .npz file, the first --max-scenes pictures count. The defaults are those of the paper: at most 1,000
training scenes chosen by farthest point sampling of their poses, equally many generated scenes with labels in equal
parts, k = 3. Every score has a 95 % confidence interval over scenes.

Writes metrics.json, metrics.parquet and evaluation.html; with --lvae also reconstruction.html, with the best and
worst scenes, and reconstruction.parquet, a row per scene. All results also go to MLflow. FID, sFID, KID, IS,
precision and recall need local Inception weights; without them the job reports distances of layout statistics and of
a fixed random network under separate names. Run the same command again to resume after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jobs.support.cli import run


@dataclass(frozen=True)
class Config:
    real: str = ""
    """Dataset directory of the real scenes, or .npz in ADM's format (default: $PRITTI_HOME/datasets/town)."""
    real_split: str = "train"
    """Split of the real scenes that generated scenes are compared with, as in the paper."""
    generated: str = ""
    """Dataset directory of the generated scenes, or .npz in ADM's format (default: $PRITTI_HOME/generated)."""
    generated_split: str = ""
    """Read only generated scenes of this split (default: all splits)."""
    run: str = ""
    """Read only generated scenes of source generated-<run> (default: all sources)."""
    generated_source: str = ""
    """Read only generated scenes of this source, such as edited-<run> or imported-<name> (default: all sources)."""
    max_scenes: int = 1000
    """Maximum number of scenes on each side; both sides get equally many. The paper uses 1000, 5000 and 10000."""
    reference: Literal["farthest-point", "min-distance", "uniform"] = "farthest-point"
    """Choice of real scenes: farthest point sampling of poses, poses at least --min-distance-m apart, or evenly."""
    min_distance_m: float = 10.0
    """Minimum distance of poses in metres for --reference min-distance."""
    balance_labels: bool = True
    """Take equally many generated scenes of each label, as far as there are enough."""
    k: tuple[int, ...] = (3,)
    """Numbers of nearest neighbours for precision, recall, density and coverage."""
    supersample: int = 1
    """Draw each pixel of a picture as the mean of N x N samples."""
    inception: str = ""
    """File of Inception weights for FID, sFID, KID, IS, precision and recall (default: none)."""
    lvae: str = ""
    """Also evaluate the reconstruction of real scenes by this layout VAE (default: none)."""
    lvae_split: str = "test"
    """Split of the real scenes to reconstruct."""
    max_reconstructed_scenes: int | None = None
    """Maximum number of scenes to reconstruct, evenly over the split (default: all)."""
    voxel_range_m: tuple[float, float] = (-1.5, 6.5)
    """Lowest and highest z in metres of the 256 x 256 x 32 voxels."""
    num_examples: int = 3
    """Number of best and of worst reconstructed scenes to show."""
    output: str = ""
    """Directory to write to (default: $PRITTI_HOME/evaluations/<run>, or evaluations/latest without --run)."""
    num_actors: int = 2
    """Number of models that run in parallel; use one per GPU."""


if __name__ == "__main__":
    run("evaluate_scenes")
