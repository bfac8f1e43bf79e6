#!/usr/bin/env python3
"""Train the layout VAE (stage 1) on scene tables.

    jobs/train_lvae.py                      the town preset on $PRITTI_HOME/datasets/town
    jobs/train_lvae.py smoke                seconds; generates its own data
    jobs/train_lvae.py kitti360 --dataset DIR --num-workers 4
    jobs/train_lvae.py kitti360-mini --dataset DIR --start-from MODEL --name longer     continue with trained weights
    jobs/train_lvae.py town --add-datasets OSM KITTI-360 --dataset-weights 2 1 1     mix three datasets
    jobs/train_lvae.py demo --train-object-decoder-of town --name lvae-decoder     a new object decoder for a pipeline

--train-object-decoder-of keeps the encoders and the ground decoder of a pipeline. The latents do not change, so the
transformer of the pipeline remains valid. The job writes the pipeline with the new decoder to
$PRITTI_HOME/models/pritti-<name>.

The job writes the trained model to $PRITTI_HOME/models/lvae-<preset>. The job logs losses and pictures to MLflow
($MLFLOW_TRACKING_URI, by default an sqlite file under $PRITTI_HOME). Run the same command again to resume.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import tyro

from jobs.support.cli import run
from jobs.support.options import (
    AddDatasetsOption,
    DatasetWeightsOption,
    GpusOption,
    IfBusyOption,
    LogFormatOption,
    WaitForResourcesOption,
)


@dataclass(frozen=True)
class Config:
    """Options of a training run; options that are not given have the values of the preset (models/presets.py)."""

    preset: tyro.conf.Positional[str] = "town"
    """Preset: smoke, demo, town, town-pixels, kitti360, kitti360-mini, kitti360-light or av2."""
    dataset: str = ""
    """Dataset directory (default: $PRITTI_HOME/datasets/<the preset's source>)."""
    add_datasets: AddDatasetsOption = ()
    dataset_weights: DatasetWeightsOption = ()
    name: str = ""
    """Name of the run; a run name is bound to its options (default: lvae-<preset>)."""
    output: str = ""
    """Directory to write the trained model to (default: $PRITTI_HOME/models/<name>)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    train_object_decoder_of: str = ""
    """Train only a new object decoder, for this pipeline; all values that --model of other jobs accepts are valid
    (default: train all parts)."""
    start_from: str = ""
    """Initialise with the weights of this layout VAE: its directory, or a pipeline as --model of other jobs accepts it
    (default: new weights)."""
    num_workers: int = 1
    """Number of Ray Train workers; use one per GPU."""
    min_workers: int | None = None
    """Number of workers with which training continues if nodes are lost; it grows again to --num-workers when nodes
    return (default: --num-workers)."""
    gpus: GpusOption = None
    wait_for_resources_s: WaitForResourcesOption = 0.0
    steps: int | None = None
    """Number of training steps (default: as in the preset)."""
    batch_size: int | None = None
    """Global batch size over all workers (default: as in the preset)."""
    learning_rate: float | None = None
    """Peak learning rate (default: as in the preset)."""
    kl_weight: float | None = None
    """Weight of the KL divergence, summed over the latent (default: as in the preset; paper: 1e-6)."""
    latent_noise: float | None = None
    """Noise on latents during training, in channel standard deviations (default: as in the preset; paper: 0)."""
    warmup_steps: int | None = None
    """Number of initial steps during which the learning rate rises linearly (default: as in the preset; paper: 0)."""
    grad_clip: float | None = None
    """Largest gradient norm; 0 switches clipping off (default: as in the preset; the paper does not mention it)."""
    init_from_data: bool | None = None
    """Start from the means of the data and a small posterior variance (default: as in the preset; paper: no)."""
    gradient_accumulation_steps: int = 1
    """Divide each worker's batch into this number of parts, which are processed in sequence to save memory."""
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    """Floating-point precision; auto is bf16 on GPUs that support it, else fp32. On CPUs with AVX-512 BF16, bf16 saves
    a fifth of the time."""
    compile: bool = False
    """Compile the convolutional networks and transformer layers with torch.compile; not yet measured on a GPU."""
    checkpoint_every: int | None = None
    """Number of steps between checkpoints (default: a twentieth of the run, at least four steps)."""
    flip: bool = False
    """Augmentation: mirror half of the scenes left to right."""
    jitter: bool = False
    """Augmentation: move the vehicle by up to 1 m and rotate it by up to 2.5 degrees, as in SLEDGE."""
    round_weights: bool = False
    """Round the weights of the result to float16, so its files need half the space."""
    seed: int = 0
    """Random seed."""


if __name__ == "__main__":
    run("train_lvae")
