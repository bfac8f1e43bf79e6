#!/usr/bin/env python3
"""Train the diffusion transformer (stage 2) on latents.

    jobs/train_dit.py                       the town preset on $PRITTI_HOME/datasets/town
    jobs/train_dit.py smoke                 seconds; generates its own data, layout VAE and latents
    jobs/train_dit.py kitti360-xl --dataset DIR --label-kind joint --num-workers 8
    jobs/train_dit.py town --start-from town --label-kind partial --learning-rate 4e-4      continue with the weights
    jobs/train_dit.py town --add-datasets OSM --dataset-weights 2 1      mix datasets that one layout VAE encoded

The job writes a complete pipeline to $PRITTI_HOME/models/pritti-<preset>. The job logs losses and sampled scenes to
MLflow ($MLFLOW_TRACKING_URI, by default an sqlite file under $PRITTI_HOME). Run the same command again to resume.
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
    """Preset: smoke, demo, town, kitti360-mini, kitti360, kitti360-l, kitti360-xl or av2."""
    dataset: str = ""
    """Dataset directory (default: $PRITTI_HOME/datasets/<the preset's source>)."""
    add_datasets: AddDatasetsOption = ()
    dataset_weights: DatasetWeightsOption = ()
    latents: str = ""
    """Directory with latents.json (default: the dataset directory)."""
    add_latents: tuple[str, ...] = ()
    """Directories with latents.json of --add-datasets, encoded by the same layout VAE (default: the dataset
    directories)."""
    label_kind: Literal["vegetation", "vehicle", "joint", "partial", "none"] | None = None
    """Kind of label that the model is conditioned on (default: as in the paper, vegetation density, or vehicle density
    if the dataset has no vegetation, such as Argoverse 2). joint: both. partial: both, either alone or none, and
    whether a scene is a view of a vehicle or a crop at any place."""
    name: str = ""
    """Name of the run; a run name is bound to its options (default: dit-<preset>)."""
    output: str = ""
    """Directory to write the trained pipeline to (default: $PRITTI_HOME/models/pritti-<name or preset>)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    num_workers: int = 1
    """Number of Ray Train workers; use one per GPU."""
    min_workers: int | None = None
    """Number of workers with which training continues if nodes are lost; it grows again to --num-workers when nodes
    return (default: --num-workers)."""
    gpus: GpusOption = None
    wait_for_resources_s: WaitForResourcesOption = 0.0
    start_from: str = ""
    """Initialise with the weights of this pipeline; all values that --model of other jobs accepts are valid (default:
    random weights)."""
    average_with: str = ""
    """Return the mean of the trained weights and those of this pipeline, which has the same layout VAE and size. If the
    training continued these weights, the mean often keeps more of their abilities (Wortsman et al., CVPR 2022). The
    logged scenes are those of the trained weights (default: the trained weights)."""
    steps: int | None = None
    """Number of training steps (default: as in the preset)."""
    batch_size: int | None = None
    """Global batch size over all workers (default: as in the preset)."""
    learning_rate: float | None = None
    """Peak learning rate (default: as in the preset)."""
    final_learning_rate: float | None = None
    """Learning rate at the last step of a cosine schedule (default: a constant learning rate, as in the paper)."""
    warmup_steps: int | None = None
    """Number of warm-up steps with a linear increase of the learning rate (default: as in the preset)."""
    prediction_type: Literal["epsilon", "v_prediction"] | None = None
    """Target that the network predicts (default: as in the preset; paper: epsilon)."""
    inpainting: bool | None = None
    """Train the network to continue random known parts of a scene, which makes inpainting and outpainting better and
    faster (default: as in the preset; paper: False)."""
    crop_repeats: int = 1
    """Number of times that each crop at any place is used per epoch; each view of a vehicle is used once. Far blocks of
    large scenes are such crops."""
    known_streets_share: float | None = None
    """Share of training samples that know the ground of all streets, as blocks that follow a street plan. It needs
    latents of encode_latents.py --streets (default: as in the preset; paper: 0)."""
    normalise_latents: bool | None = None
    """Normalise each latent channel to mean 0 and standard deviation 1 (default: as in the preset; paper: False)."""
    sample_posterior: bool | None = None
    """Draw training latents from the posteriors of the layout VAE; if False, use the means (default: as in the preset;
    paper: True)."""
    timestep_sampling: Literal["uniform", "logit-normal"] = "uniform"
    """Distribution of training timesteps: uniform (the paper), or logit-normal, which prefers middle timesteps."""
    loss_weighting: Literal["uniform", "min-snr"] = "uniform"
    """Weighting of the timesteps in the loss: uniform (the paper), or min-snr (Hang et al., 2023)."""
    ema_decay: float | None = None
    """Decay of the exponential moving average of the weights (default: as in the preset)."""
    gradient_accumulation_steps: int = 1
    """Divide each worker's batch into this number of parts, which are processed in sequence to save memory."""
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    """Floating-point precision; auto is bf16 on GPUs that support it, else fp32. On CPUs with AVX-512 BF16, bf16 halves
    the time."""
    compile: bool = False
    """Compile the transformer's block with torch.compile, which takes some seconds; useful on GPUs."""
    checkpoint_every: int | None = None
    """Number of steps between checkpoints (default: a twentieth of the run, at least four steps)."""
    round_weights: bool = False
    """Round the weights of the result to float16, so its files need half the space."""
    seed: int = 0
    """Random seed."""


if __name__ == "__main__":
    run("train_dit")
