"""Train with Ray Train: read batches with Ray Data, save checkpoints, resume runs, and log to MLflow from rank 0.

The same command resumes a run, because Ray Train finds the run of the same name and returns its last checkpoint.
"""

from __future__ import annotations

import logging
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import ray.train
import ray.train.torch
import torch
from ray import cloudpickle
from ray.train import Checkpoint, CheckpointConfig, FailureConfig, RunConfig, ScalingConfig

from jobs.support.cli import find_root_cause
from jobs.support.model_directories import publish_directory
from jobs.support.ray_session import run_packed, start_ray
from jobs.support.tracking import Tracker
from models.training import NonFiniteLossError, OptimizerConfig, Trainer
from pipelines.runtime import storage
from pipelines.schema.run_guard import guard_options
from pipelines.training.data_loader import READER_CPUS, Reader, Stream, iterate_batches
from pipelines.training.latents import digest_weights

Wrap = Callable[[torch.nn.Module], torch.nn.Module]
RETRIES = 2  # maximum number of restarts from the last checkpoint after worker failures


@dataclass(frozen=True)
class TrainingRun:
    """Description of a training run for its workers. All fields can be pickled.

    The function `build(device, wrap)` returns the Trainer. The function `validate(trainer)` returns metrics and
    pictures (arrays by name); it runs on rank 0 at every checkpoint. The field `identity` holds the options that must
    not change when a run is resumed.
    """

    name: str
    storage_path: str
    build: Callable[[torch.device, Wrap], Trainer]
    stream: Stream
    reader: Reader
    settings: OptimizerConfig
    identity: dict
    tracker: Tracker
    checkpoint_every: int
    log_every: int
    validate: Callable[[Trainer], tuple[dict[str, float], dict[str, np.ndarray]]] | None = None


def convert_to_tensors(batch: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    """Convert a batch of arrays to tensors."""
    return {
        name: torch.from_numpy(np.array(value))  # a copy is necessary because Ray's arrays are read-only
        for name, value in batch.items()
    }


def train_worker(run: TrainingRun, threads: int) -> None:
    """Train in one worker: read batches, take steps, and regularly log, save a checkpoint and validate."""
    logging.getLogger("ray.train").setLevel(logging.WARNING)
    logging.getLogger("ray.data").setLevel(logging.WARNING)
    context = ray.train.get_context()
    rank, world = context.get_world_rank(), context.get_world_size()
    torch.set_num_threads(threads)
    device = ray.train.torch.get_device()
    wrap = ray.train.torch.prepare_model if world > 1 else lambda model: model
    trainer = run.build(device, wrap)
    if checkpoint := ray.train.get_checkpoint():
        with checkpoint.as_directory() as directory:
            trainer.load(directory)
    local = run.stream.batch_size // world
    positions = range(rank * local, (rank + 1) * local)
    started, logged, waited = time.perf_counter(), trainer.steps_done, 0.0
    feed = measure_waiting(iterate_batches(run.stream, run.reader, trainer.steps_done, run.settings.steps, rank, world))
    for batch, seconds in feed:
        waited += seconds
        try:
            losses = trainer.step(convert_to_tensors(batch), positions)
        except NonFiniteLossError as error:
            raise ValueError(with_scene_ids(error, run.stream)) from error
        step, last = trainer.steps_done, trainer.steps_done == run.settings.steps
        if rank == 0 and (step % run.log_every == 0 or last):
            elapsed, done = time.perf_counter() - started, step - logged
            metrics = {name: float(value) for name, value in losses.items()} | {
                "learning_rate": run.settings.at(step - 1)[0],
                "scenes_per_second": done * run.stream.batch_size / elapsed,
                "waiting_for_data": waited / elapsed,
            }
            run.tracker.metrics(metrics, step)
            left = (run.settings.steps - step) * elapsed / done
            print(
                f"{run.name}: step {step}/{run.settings.steps}  loss {metrics['loss']:.4g}  "
                f"{metrics['scenes_per_second']:.1f} scenes/s  {left / 60:.1f} min left",
                flush=True,
            )
            started, logged, waited = time.perf_counter(), step, 0.0
        if step % run.checkpoint_every == 0 or last:
            report(run, trainer, rank, float(losses["loss"]))
            started, logged, waited = time.perf_counter(), step, 0.0


def with_scene_ids(error: NonFiniteLossError, stream: Stream) -> str:
    """Return the error message for a non-finite loss, with the ids of the scenes that caused this loss.

    Args:
        error: Error with the positions of the samples.
        stream: Order of the training scenes.

    Returns:
        The message.
    """
    shards, rows = stream.positions(error.step * stream.batch_size, stream.batch_size)
    ids = [
        stream.shards[shards[k]].read("scenes", ["scene_id"])["scene_id"][int(rows[k])].as_py() for k in error.positions
    ]
    return (
        f"{error}. Scenes: {', '.join(ids)}; inspect them with jobs/inspect_scenes.py scene ID" if ids else str(error)
    )


def measure_waiting(iterator: Iterator) -> Iterator[tuple[Any, float]]:
    """Yield each item with the time in seconds that the iterator needed to return the item."""
    while True:
        started = time.perf_counter()
        try:
            item = next(iterator)
        except StopIteration:
            return
        yield item, time.perf_counter() - started


def report(run: TrainingRun, trainer: Trainer, rank: int, loss: float) -> None:
    """Save a checkpoint (rank 0) and report it to Ray Train; every worker must call this function.

    Args:
        run: Training run.
        trainer: Trainer of this worker.
        rank: Rank of this worker.
        loss: Loss of the last step.
    """
    metrics = {"step": trainer.steps_done, "loss": loss}
    if rank != 0:
        ray.train.report(metrics)
        return
    if run.validate:
        values, pictures = run.validate(trainer)
        if values:
            run.tracker.metrics(values, trainer.steps_done)
        for name, image in pictures.items():
            run.tracker.picture(image, f"{name}/step-{trainer.steps_done:07d}.png")
    model = trainer.ema_model()
    tag_weights(run.tracker, model, trainer.steps_done)
    with tempfile.TemporaryDirectory() as directory:
        trainer.save(directory)
        model.save_pretrained(os.path.join(directory, "model"))
        ray.train.report(metrics, checkpoint=Checkpoint.from_directory(directory))


def tag_weights(tracker: Tracker, model: torch.nn.Module, steps: int) -> None:
    """Tag an MLflow run with the digest of its weights; jobs/publish_model.py searches for this tag."""
    tracker.tag("weights", digest_weights(model))
    tracker.tag("steps", str(steps))


def fit(run: TrainingRun, num_workers: int, output: str) -> str:
    """Train until the last step, and write the model to a directory.

    Args:
        run: Training run.
        num_workers: Number of Ray Train workers.
        output: Directory or URI for the model. The model has the EMA weights if EMA is enabled.

    Returns:
        `output`.

    Raises:
        ValueError: The cluster is too small for this number of workers, or a loss is not finite.
    """
    start_ray(training=True)
    scaling = make_scaling_config(num_workers, run.stream.batch_size)
    threads = max(1, int(ray.cluster_resources()["CPU"]) // num_workers)
    work = partial(train_worker, run, threads)
    file_system, path = storage.resolve_uri(run.storage_path)
    packed = cloudpickle.dumps(work)  # pyright: ignore[reportPrivateImportUsage]
    trainer = ray.train.torch.TorchTrainer(
        run_packed,
        train_loop_config={"packed": packed},
        scaling_config=scaling,
        run_config=RunConfig(
            name=run.name,
            storage_path=path,
            storage_filesystem=file_system,
            checkpoint_config=CheckpointConfig(num_to_keep=2),
            failure_config=FailureConfig(max_failures=RETRIES),
        ),
    )
    try:
        result = trainer.fit()
    except KeyboardInterrupt:
        run.tracker.finish("KILLED")
        raise
    except Exception as error:
        run.tracker.finish("FAILED")
        for failure in getattr(error, "worker_failures", {}).values():
            if isinstance(find_root_cause(failure), ValueError):
                raise find_root_cause(failure) from error
        raise
    if result.checkpoint is None:
        raise ValueError(f"run {run.name!r} ended without a checkpoint; increase --steps")
    with result.checkpoint.as_directory() as directory:
        publish_directory(os.path.join(directory, "model"), output)
        run.tracker.artifacts(os.path.join(directory, "model"), "model")
    run.tracker.finish("FINISHED")
    return output


def make_scaling_config(num_workers: int, batch_size: int) -> ScalingConfig:
    """Return the resources of the workers; the other CPUs are for the data readers.

    Args:
        num_workers: Number of Ray Train workers.
        batch_size: Global batch size over all workers.

    Returns:
        Scaling configuration of Ray Train.

    Raises:
        ValueError: The cluster has too few CPUs for the workers, or the batch size is not a multiple of `num_workers`.
    """
    cpus, gpus = (float(ray.cluster_resources().get(kind, 0)) for kind in ("CPU", "GPU"))
    per_worker = 1.0 if cpus > 2 * num_workers else 0.5
    most = int((cpus - READER_CPUS) // per_worker)
    if not 1 <= num_workers <= most:
        raise ValueError(f"--num-workers is {num_workers}: this cluster of {cpus:.0f} CPUs can run 1 to {most} workers")
    if batch_size < 1 or batch_size % num_workers:
        raise ValueError(f"--batch-size {batch_size} is not a multiple of --num-workers {num_workers}")
    return ScalingConfig(num_workers=num_workers, use_gpu=gpus >= num_workers, resources_per_worker={"CPU": per_worker})


def guard_run_name(name: str, storage_path: str, identity: dict) -> str:
    """Bind a run's name to one set of options.

    Args:
        name: Name of the run.
        storage_path: Directory of all runs.
        identity: Options that must not change when the run is resumed.

    Returns:
        Path of the file with the id of the MLflow run.

    Raises:
        ValueError: A run of this name has checkpoints and was started with other options.
    """
    directory = storage.join_uri(storage_path, name)
    guard_options(
        storage.join_uri(directory, "identity.json"),
        identity,
        is_in_use=lambda: any("/checkpoint_" in path for path in storage.list_files(directory, ".json")),
        discard=lambda: storage.delete_directory(directory),
        describe=lambda difference: (
            f"run {name!r} was started with {difference}; "
            "use the same options to resume, or another --name for a new run"
        ),
    )
    return storage.join_uri(directory, "mlflow.json")


def override_settings(settings: OptimizerConfig, **changes: Any) -> OptimizerConfig:
    """Return the settings after all changes that are not None.

    Args:
        settings: Settings of the preset.
        **changes: New value for each setting; None keeps the value of the preset.

    Returns:
        The changed settings.

    Raises:
        ValueError: A change is not positive.
    """
    changes = {name: value for name, value in changes.items() if value is not None}
    for name, value in changes.items():
        if value <= 0:
            raise ValueError(f"--{name.replace('_', '-')} is {value}, expected more than 0")
    return replace(settings, **changes)


def make_run_identity(settings: OptimizerConfig, **more: Any) -> dict:
    """Return the options that determine a run's weights: its optimizer settings and `more`."""
    return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(settings).items()} | more
