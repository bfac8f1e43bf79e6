"""Implementation of jobs/train_baseline.py."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from jobs.implementation.smoke_inputs import make_smoke_dataset
from jobs.support import trainer
from jobs.support.callbacks import HeldOutLoss
from jobs.support.cli import home_path, resolve_path
from jobs.support.model_files import publish_directory
from jobs.support.outputs import hold_training
from jobs.support.tracking import Tracker
from jobs.support.trainer import TrainingRun, convert_to_tensors
from jobs.train_baseline import Config
from models.baselines.base import Networks, Stage
from models.baselines.directory import find_stage, find_stages, load_networks, write_index
from models.baselines.training import make_baseline_trainer, measure_sample_bytes
from models.training import ExecutionConfig, OptimizerConfig, Trainer, Wrap
from models.voxel_grids import FINE_SHAPE
from pipelines.preprocess.voxel_tables import VoxelRequest, voxelize_dataset
from pipelines.runtime import storage
from pipelines.runtime.machines import find_available_bytes
from pipelines.schema.dataset import Dataset
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import Shard, find_shards
from pipelines.training.data_loader import Stream
from pipelines.training.latents import digest_weights
from pipelines.training.voxel_reader import VoxelReader

MEASURED_SCENES = 64  # Number of training scenes from which `Stage.measure` computes options, such as scales.
HELD_OUT_SCENES = 16
STEP_COPIES = 5  # Parameters, gradients, two moments of AdamW and the moving average.


def find_voxel_shards(root: str, split: str) -> list[Shard]:
    """Return the shards of the table voxels of a dataset.

    Raises:
        ValueError: The dataset has no voxels.
    """
    source = Dataset.open(root).source
    try:
        return find_shards(root, "voxels", source, split)
    except ValueError as error:
        raise ValueError(f"{error}; run jobs/voxelize_scenes.py --input {root} first") from error


def make_smoke_voxels(root: str) -> None:
    """Generate the smoke dataset and its voxels if they are missing."""
    make_smoke_dataset(root)
    voxelize_dataset(VoxelRequest(root), SceneSubset(root))


def prepare(config: Config, stage: Stage, root: str, output: str) -> TrainingRun:
    """Return the training run of a stage."""
    shards = find_voxel_shards(root, "train")
    tables = [shard.read("voxels", ["num_voxels"]) for shard in shards]
    class_counts = np.sum([row for table in tables for row in table["num_voxels"].to_pylist()], axis=0).tolist()
    batch_size = config.batch_size or stage.batch_size
    settings = trainer.override_settings(
        replace(stage.optimizer, seed=config.seed), steps=config.steps, learning_rate=config.learning_rate
    )
    stream = Stream(tuple(shards), tuple(len(table) for table in tables), batch_size, config.seed)
    reader = VoxelReader(FINE_SHAPE, stage.factors)
    needed = [find_stage(config.method, config.preset, name) for name in stage.needs]
    networks = load_networks(output, config.method, needed)
    name = find_run_name(config, stage)
    identity = trainer.make_run_identity(
        settings,
        method=config.method,
        preset=config.preset,
        stage=stage.name,
        batch_size=batch_size,
        dataset=root,
        networks={need: digest_weights(network) for need, network in networks.items()},
    )
    if config.round_weights:
        identity |= {"round_weights": True}
    record = trainer.guard_run_name(name, home_path("runs"), identity)
    architecture = measure_architecture(stage, networks, stream, reader, home_path("runs", name))
    tracker = Tracker.start("pritti-baselines", name, identity | {"architecture": architecture}, record)
    execution = ExecutionConfig(config.gradient_accumulation_steps, config.precision)
    local_batch = -(-batch_size // config.num_workers // config.gradient_accumulation_steps)
    first = convert_to_tensors(reader(shards[0], np.array([0])))
    return TrainingRun(
        name=name,
        round_weights=config.round_weights,
        storage_path=home_path("runs"),
        build=partial(
            build, config, stage.name, architecture, output, class_counts, settings, execution, first, local_batch
        ),
        stream=stream,
        reader=reader,
        settings=settings,
        identity=identity,
        tracker=tracker,
        checkpoint_every=config.checkpoint_every or max(4, settings.steps // 20),
        log_every=max(1, min(50, settings.steps // 50)),
        validate=HeldOutLoss(find_voxel_shards(root, "test"), reader, HELD_OUT_SCENES, local_batch),
        id_column=("voxels", "scene_id"),
    )


def measure_architecture(stage: Stage, networks: Networks, stream: Stream, reader: VoxelReader, run: str) -> dict:
    """Return the arguments of the network, with those that follow from data.

    The first call of a run records them, so a resumed run has equal values.
    """
    if stage.measure is None:
        return stage.architecture
    place = storage.join_uri(run, "measured.json")
    if not storage.exists(place):
        shard, row = stream.positions(0, min(MEASURED_SCENES, sum(stream.counts)))
        parts = [reader(stream.shards[k], row[shard == k]) for k in np.unique(shard)]
        arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        storage.write_json(stage.measure(networks, convert_to_tensors(arrays)), place)
    return stage.architecture | storage.read_json(place)


def build(
    config: Config,
    stage_name: str,
    architecture: dict,
    output: str,
    class_counts: Sequence[int],
    settings: OptimizerConfig,
    execution: ExecutionConfig,
    first: dict[str, torch.Tensor],
    local_batch: int,
    device: torch.device,
    wrap: Wrap,
) -> Trainer:
    """Return the Trainer of a stage on a worker.

    Raises:
        ValueError: A batch does not fit into the memory of this machine.
    """
    stage = find_stage(config.method, config.preset, stage_name)
    needed = [find_stage(config.method, config.preset, name) for name in stage.needs]
    networks = load_networks(output, config.method, needed)
    made = make_baseline_trainer(stage, architecture, networks, class_counts, settings, device, wrap, execution)
    if device.type == "cpu":
        require_memory(made, first, local_batch, f"{config.method}, stage {stage_name}")
    return made


def require_memory(made: Trainer, first: dict[str, torch.Tensor], local_batch: int, place: str) -> None:
    """Check that a batch fits into the memory of this machine. A GPU reports this itself.

    Raises:
        ValueError: The batch does not fit.
    """
    free = find_available_bytes()
    fixed = STEP_COPIES * 4 * made.model.num_parameters()
    try:
        sample = measure_sample_bytes(made, first)
    except RuntimeError as error:
        if "allocate" not in str(error):
            raise
        raise ValueError(f"{place}: one sample does not fit into {free / 1e9:.1f} GB of free memory") from error
    if fixed + local_batch * sample > free:
        fitting = max(int((free - fixed) // sample), 0)
        advice = (
            f"use --gradient-accumulation-steps {-(-local_batch // fitting)} or a smaller --batch-size"
            if fitting
            else "use a smaller --preset or a machine with more memory"
        )
        raise ValueError(
            f"{place}: {local_batch} samples need {(fixed + local_batch * sample) / 1e9:.1f} GB, but"
            f" {free / 1e9:.1f} GB are free on this machine; {advice}"
        )


def find_run_name(config: Config, stage: Stage) -> str:
    """Return the name of the training run of a stage."""
    return f"{find_model_name(config)}-{stage.name}"


def find_model_name(config: Config) -> str:
    """Return the name of the model."""
    return config.name or f"{config.method}-{config.preset}"


def train(config: Config) -> str:
    """Train the stages and return the directory of the model."""
    stages = find_stages(config.method, config.preset)
    if config.stage:
        stages = (find_stage(config.method, config.preset, config.stage),)
    smoke = config.preset == "smoke" and not config.dataset
    root = resolve_path(config.dataset, "datasets", "smoke" if smoke else "town")
    output = resolve_path(config.output, "models", find_model_name(config))
    with hold_training(find_model_name(config), output, config):
        if smoke:
            make_smoke_voxels(root)
        with tempfile.TemporaryDirectory() as directory:
            write_index(directory, config.method, config.preset)
            publish_directory(directory, output)
        for stage in stages:
            training = prepare(config, stage, root, output)
            trainer.fit(training, config.num_workers, storage.join_uri(output, stage.name), config.min_workers)
    return output


def main(config: Config) -> None:
    print(f"trained: {train(config)}")
