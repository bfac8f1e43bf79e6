#!/usr/bin/env python3
"""Compare generated scenes with real scenes, and evaluate layout-VAE reconstruction.

    jobs/evaluate_scenes.py --real DIR --generated DIR
    jobs/evaluate_scenes.py --real DIR --generated DIR --controls      which scores notice which damage
    jobs/evaluate_scenes.py --real DIR --generated DIR --inception weights-inception-2015-12-05-6726825d.pth
    jobs/evaluate_scenes.py --real DIR --generated DIR --max-scenes 10000 --reference min-distance --min-distance-m 10
    jobs/evaluate_scenes.py --real DIR --generated samples.npz --inception FILE
    jobs/evaluate_scenes.py --real DIR --generated DIR --inception FILE --protocol paper-pr
    jobs/evaluate_scenes.py --real DIR --generated DIR --inception FILE --protocol paper-fid
    jobs/evaluate_scenes.py --real DIR --generated DIR --inception FILE --protocol pdd --reference min-distance
    jobs/evaluate_scenes.py --real DIR --lvae MODEL

The job reads only the scene tables. If --lvae is given and none of --generated, --run and --generated-source is given,
the job evaluates only the reconstruction. From an .npz file, the job uses the first --max-scenes pictures. The defaults
are the paper's: k = 3, and at most 1,000 training scenes, selected by farthest point sampling of poses. Except
with --protocol pdd, the job compares N real scenes with N generated scenes. By default, all labels have equally many
generated scenes. Scores have 95 % confidence intervals over scenes; that of the two-sample AUC is over places.

Every score stands next to its ceiling: the same score of N other real scenes. With --controls, the job also scores
damaged copies of these scenes: objects moved, turned, permuted, dropped, duplicated or from another scene, and ground
shifted or roughened. A score is worth reading for a fault if it rates the damaged scenes worse than the ceiling.

A protocol sets the options that it fixes. It is an error to give another value for such an option. paper-pr compares
1,000 farthest training poses with 1,000 generated scenes (k = 3). paper-fid compares all training scenes with as many
generated scenes, by FID, sFID and IS only, and reads the features part by part. paper-nearest compares at most 50,000
training scenes with as many generated scenes, only by distances of VGG16 features (--vgg16 FILE). pdd compares at most
50,000 generated scenes with training poses, and drops white pictures and pictures with a black pixel on both sides.

The job writes metrics.json, metrics.parquet and evaluation.html, and logs all results to MLflow. With --lvae, the job
also writes reconstruction.html (the best and the worst scenes), reconstruction.parquet (one row per scene) and
reconstruction_sets.json, which holds the ceiling and the control of the reconstruction. FID, sFID, KID, IS, precision
and recall need a local file of Inception weights. Without Inception weights, the job reports distances of layout
statistics, of relations between objects and ground, and of features of EfficientNet-Lite0 (extra lite0) and of a fixed
random network, under separate names. Run the same command again to resume after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jobs.support.cli import run
from jobs.support.options import GpusOption, IfBusyOption, LogFormatOption, WaitForResourcesOption


@dataclass(frozen=True)
class Config:
    real: str = ""
    """Dataset directory of the real scenes, or an .npz file in ADM's format (default: $PRITTI_HOME/datasets/town)."""
    real_split: str = "train"
    """Split of the real scenes for the comparison with generated scenes, as in the paper."""
    generated: str = ""
    """Dataset directory of the generated scenes, or an .npz file in ADM's format (default: $PRITTI_HOME/generated)."""
    generated_split: str = ""
    """Read only generated scenes of this split (default: all splits)."""
    run: str = ""
    """Read only generated scenes of source generated-<run> (default: all sources)."""
    generated_source: str = ""
    """Read only generated scenes of this source, such as edited-<run> or imported-<name> (default: all sources)."""
    protocol: Literal["", "paper-pr", "paper-fid", "paper-nearest", "pdd"] = ""
    """Protocol that fixes the selection of scenes and the scores (default: none, the other options decide)."""
    max_scenes: int | None = None
    """Maximum number of real and of generated scenes; both numbers are equal. The paper uses 1000, 5000 and 10000
    (default: 1000)."""
    reference: Literal["farthest-point", "min-distance", "uniform"] | None = None
    """Rule that selects the real scenes: farthest point sampling of poses, a minimum distance of poses, or even
    spacing (default: farthest-point)."""
    min_distance_m: float = 10.0
    """Minimum distance of poses in metres for --reference min-distance."""
    balance_labels: bool = True
    """Use the same number of generated scenes for each label, if there are enough scenes."""
    controls: bool = False
    """Also score damaged copies of real scenes, to show which scores notice which damage."""
    ceiling_split: str = ""
    """Split of the other real scenes, the ceiling; halves takes two halves of --real-split at least 64 m apart
    (default: test for the real split train, otherwise train; halves if that gives more scenes)."""
    peers: tuple[str, ...] = ()
    """Dataset directories of other methods' scenes to show in the validity table, such as imported scenes (default:
    none)."""
    lite0: bool | None = None
    """Use the features of EfficientNet-Lite0 (default: if the extra lite0 is installed)."""
    k: tuple[int, ...] = ()
    """Numbers of nearest neighbours for precision, recall, density and coverage (default: 3)."""
    supersample: int = 1
    """Supersampling factor N: each pixel of a picture is the mean of N x N samples."""
    inception: str = ""
    """File of Inception weights for FID, sFID, KID, IS, precision and recall (default: none)."""
    vgg16: str = ""
    """File of VGG16 weights for the paper's analysis of memorisation, such as torchvision's vgg16-397923af.pth
    (default: none, distances to the nearest real scene use other features and are named nearest_distance)."""
    lvae: str = ""
    """Also evaluate the reconstruction of real scenes by this layout VAE (default: none)."""
    lvae_split: str = "test"
    """Split of the real scenes to reconstruct."""
    max_reconstructed_scenes: int | None = None
    """Maximum number of scenes to reconstruct, selected evenly from the split (default: all)."""
    voxel_range_m: tuple[float, float] = (-1.5, 6.5)
    """Lowest and highest z of the grid of 256 x 256 x 32 voxels, in metres."""
    num_examples: int = 3
    """Number of scenes to show in each of two groups: the best and the worst reconstructions."""
    guess_scenes: int = 0
    """Also write guess.html, on which a reader guesses which scenes are generated: number of real and of generated
    scenes."""
    output: str = ""
    """Directory to write to (default: $PRITTI_HOME/evaluations/<run>, or evaluations/latest without --run)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    num_actors: int = 2
    """Number of models that run in parallel; use one per GPU."""
    gpus: GpusOption = None
    wait_for_resources_s: WaitForResourcesOption = 0.0


if __name__ == "__main__":
    run("evaluate_scenes")
