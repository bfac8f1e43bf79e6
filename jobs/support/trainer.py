"""Train with Ray Train: read batches with Ray Data, save checkpoints, resume runs, and log to MLflow from rank 0.

The same command resumes a run, because Ray Train finds the run of the same name and returns its last checkpoint.
"""

from __future__ import annotations

import copy
import logging
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import ray.train
import ray.train.torch
import torch
from ray import cloudpickle
from ray.exceptions import RayActorError
from ray.experimental.internal_kv import _internal_kv_get, _internal_kv_put
from ray.train import Checkpoint, CheckpointConfig, FailureConfig, RunConfig, ScalingConfig
from ray.train.v2._internal.execution import context as reporting
from ray.train.v2.api.exceptions import WorkerGroupError

from jobs.support.cli import find_root_cause
from jobs.support.log import print_event
from jobs.support.model_files import publish_directory
from jobs.support.progress import JobProgress
from jobs.support.ray_session import run_packed, start_ray
from jobs.support.tracking import Tracker
from models.base import ConfiguredModel
from models.training import NonFiniteLossError, OptimizerConfig, Trainer
from pipelines.runtime import storage
from pipelines.runtime.resources import count_gpus_per_model, count_room, find_device, require_room
from pipelines.schema.run_guard import guard_options
from pipelines.training.data_loader import READER_CPUS, Reader, SampleOrder, iterate_batches, split_batch
from pipelines.training.latents import digest_weights

Wrap = Callable[[torch.nn.Module], torch.nn.Module]
RETRIES = 2  # maximum number of restarts without a new checkpoint between them
REPORT_S = 1.0  # time between two messages of rank 0 to the driver
LINE_S = 60.0  # longest time between two lines of the log, if steps are slower than `log_every` expects


@dataclass(frozen=True)
class TrainingRun:
    """Description of a training run for its workers. All fields can be pickled.

    The function `build(device, wrap)` returns the Trainer. The function `validate(trainer)` returns metrics and
    pictures (arrays by name); it runs on rank 0 at every checkpoint. The field `identity` holds the options that must
    not change when a run is resumed. Error messages name samples by `id_column`, a table and a column. With
    `average_with`, results have the mean of the trained weights and these weights. With `round_weights`, weights of
    results are rounded to float16. Neither changes the training itself.
    """

    name: str
    storage_path: str
    build: Callable[[torch.device, Wrap], Trainer]
    stream: SampleOrder
    reader: Reader
    settings: OptimizerConfig
    identity: dict
    tracker: Tracker
    checkpoint_every: int
    log_every: int
    validate: Callable[[Trainer], tuple[dict[str, float], dict[str, np.ndarray]]] | None = None
    average_with: Mapping[str, torch.Tensor] | None = None
    round_weights: bool = False
    id_column: tuple[str, str] = ("scenes", "scene_id")


def convert_to_tensors(batch: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    """Convert a batch of arrays to tensors."""
    return {
        name: torch.from_numpy(np.array(value))  # a copy is necessary because Ray's arrays are read-only
        for name, value in batch.items()
    }


def count_threads(local_workers: int) -> int:
    """Return the number of threads for torch: the CPUs of this node on which this process may run, per worker."""
    node = ray.get_runtime_context().get_node_id()
    cpus = next(found["Resources"].get("CPU", 1.0) for found in ray.nodes() if found["NodeID"] == node)
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else int(cpus)  # Not on macOS.
    return max(1, min(int(cpus), allowed) // local_workers)


def train_worker(run: TrainingRun) -> None:
    """Train in one worker: read batches, take steps, and regularly log, save a checkpoint and validate."""
    for name in ("ray.train", "ray.data", reporting.__file__):  # The logger of reports is named after its file.
        logging.getLogger(name).setLevel(logging.WARNING)
    context = ray.train.get_context()
    rank, world = context.get_world_rank(), context.get_world_size()
    torch.set_num_threads(count_threads(context.get_local_world_size()))
    find_device()  # Raises an error if torch cannot use an assigned GPU; Ray Train would train on the CPU.
    device = ray.train.torch.get_device()
    wrap = ray.train.torch.prepare_model if world > 1 else lambda model: model
    trainer = run.build(device, wrap)
    if checkpoint := ray.train.get_checkpoint():
        with checkpoint.as_directory() as directory:
            trainer.load(directory)
    positions = split_batch(run.stream.batch_size, rank, world)
    weight = len(positions) * world / run.stream.batch_size
    started, logged, waited, saved = time.perf_counter(), trainer.steps_done, 0.0, False
    reported = -REPORT_S
    if rank == 0:
        print(f"{run.name}: {world} worker{'s' * (world != 1)}, from step {trainer.steps_done}", flush=True)
    feed = measure_waiting(iterate_batches(run.stream, run.reader, trainer.steps_done, run.settings.steps, rank, world))
    for batch, seconds in feed:
        waited += seconds
        is_memory_full = False
        try:
            losses = trainer.step(convert_to_tensors(batch), positions, weight)
        except NonFiniteLossError as error:
            raise ValueError(with_sample_ids(error, run.stream, run.id_column)) from error
        except torch.OutOfMemoryError:
            is_memory_full = True
        if is_memory_full:  # Here, the error no longer keeps the tensors of the failed step in memory.
            raise ValueError(describe_fitting_batch(trainer, batch, positions, world))
        step, last = trainer.steps_done, trainer.steps_done == run.settings.steps
        if rank == 0 and (last or time.perf_counter() - reported > REPORT_S):
            write_step(run, step)
            reported = time.perf_counter()
        is_late = time.perf_counter() - started > LINE_S
        if rank == 0 and (step % run.log_every == 0 or last or is_late):
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
        is_preempted = step % run.log_every == 0 and not saved and ray.train.get_preemption_info() is not None
        if step % run.checkpoint_every == 0 or last or is_preempted:  # The node will be preempted.
            saved = is_preempted
            report(run, trainer, rank, float(losses["loss"]))
            started, logged, waited = time.perf_counter(), step, 0.0


def describe_fitting_batch(trainer: Trainer, batch: dict[str, np.ndarray], positions: Sequence[int], world: int) -> str:
    """Find out with how many accumulated parts a batch fits into the memory of the GPU.

    Args:
        trainer: Trainer whose step ran out of memory. It cannot be used afterwards.
        batch: Batch of this worker.
        positions: Positions of its samples in the global batch.
        world: Number of workers. With several workers, smaller parts are not tried, because the others would wait.

    Returns:
        Message with the remedy.
    """
    parts = trainer.execution.accumulate
    message = f"{-(-len(positions) // parts)} samples do not fit into the memory of {trainer.device}"
    while parts < len(positions):
        parts *= 2
        trainer.execution = replace(trainer.execution, accumulate=parts)
        try:
            if world == 1:
                torch.cuda.empty_cache()
                trainer.step(convert_to_tensors(batch), positions)
        except torch.OutOfMemoryError:
            continue
        fit = f", {-(-len(positions) // parts)} fit" if world == 1 else ""
        return f"{message}{fit}; use --gradient-accumulation-steps {parts}"
    return f"{message}; use a smaller preset or a GPU with more memory"


def write_step(run: TrainingRun, step: int) -> None:
    """Report the number of finished steps to the driver."""
    _internal_kv_put(f"pritti-step-{run.tracker.run_id}", str(step), overwrite=True)


def read_step(run: TrainingRun) -> int:
    """Return the number of finished steps that a worker has reported, or 0."""
    return int(_internal_kv_get(f"pritti-step-{run.tracker.run_id}") or 0)


def with_sample_ids(
    error: NonFiniteLossError, stream: SampleOrder, id_column: tuple[str, str] = ("scenes", "scene_id")
) -> str:
    """Return the error message for a non-finite loss, with the ids of the samples that caused this loss.

    Args:
        error: Error with the positions of the samples.
        stream: Order of the training samples.
        id_column: Table and column of the ids.

    Returns:
        The message.
    """
    table, column = id_column
    shards, rows = stream.positions(error.step * stream.batch_size, stream.batch_size)
    ids = [stream.shards[shards[k]].read(table, [column])[column][int(rows[k])].as_py() for k in error.positions]
    if not ids:
        return str(error)
    hint = "; inspect them with jobs/inspect_scenes.py scene ID" if table == "scenes" else ""
    return f"{error}. Samples: {', '.join(ids)}{hint}"


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
        with trainer.run_uncompiled():
            values, pictures = run.validate(trainer)
        if values:
            run.tracker.metrics(values, trainer.steps_done)
        for name, image in pictures.items():
            run.tracker.picture(image, f"{name}/step-{trainer.steps_done:07d}.png")
    model = make_result(trainer, run.average_with, run.round_weights)
    tag_weights(run.tracker, model, trainer.steps_done)
    with tempfile.TemporaryDirectory() as directory:
        trainer.save(directory)
        model.save_pretrained(os.path.join(directory, "model"))
        ray.train.report(metrics, checkpoint=Checkpoint.from_directory(directory))


def make_result(
    trainer: Trainer, average_with: Mapping[str, torch.Tensor] | None, round_weights: bool
) -> ConfiguredModel:
    """Return the model that a run saves: with EMA weights if EMA is enabled, averaged and rounded on request."""
    model = trainer.ema_model()
    if average_with is None and not round_weights:
        return model
    model = copy.deepcopy(model)  # Without moving average, this is the model that is trained.
    own = model.state_dict()
    for name, value in (average_with or {}).items():  # The other weights may lack the layer for known parts.
        own[name].lerp_(value.to(own[name]), 0.5)
    if round_weights:
        model.round_to_float16()
    return model


def tag_weights(tracker: Tracker, model: torch.nn.Module, steps: int) -> None:
    """Tag an MLflow run with the digest of its weights; jobs/publish_model.py searches for this tag."""
    tracker.tag("weights", digest_weights(model))
    tracker.tag("steps", str(steps))


def fit(run: TrainingRun, num_workers: int, output: str, min_workers: int | None = None) -> str:
    """Train until the last step, and write the model to a directory.

    Args:
        run: Training run.
        num_workers: Maximum number of Ray Train workers.
        min_workers: Number of workers with which the training continues if nodes are lost. None: `num_workers`.
        output: Directory or URI for the model. The model has the EMA weights if EMA is enabled.

    Returns:
        `output`.

    Raises:
        ValueError: The cluster has no room for the workers, or a loss is not finite.
    """
    start_ray(training=True)
    try:
        least = num_workers if min_workers is None else min_workers
        scaling = make_scaling_config(num_workers, least, run.stream.batch_size)
        with JobProgress() as bar:
            bar.follow(run.name, run.settings.steps, partial(read_step, run))
            result = fit_with_retries(run, scaling)
        if result.checkpoint is None:
            raise ValueError(f"run {run.name!r} ended without a checkpoint; increase --steps")
        with result.checkpoint.as_directory() as directory:
            publish_directory(os.path.join(directory, "model"), output)
            run.tracker.artifacts(os.path.join(directory, "model"), "model")
    except KeyboardInterrupt:
        run.tracker.finish("KILLED")
        raise
    except Exception as error:
        run.tracker.finish("FAILED")
        for failure in getattr(error, "worker_failures", {}).values():
            if isinstance(cause := find_root_cause(failure), (ValueError, OSError)):
                raise cause from error
        raise
    run.tracker.finish("FINISHED")
    return output


def fit_with_retries(run: TrainingRun, scaling: ScalingConfig) -> ray.train.Result:
    """Run Ray Train; after more than RETRIES failures, continue if there is a new checkpoint since the first of them.

    If the process that controls the workers dies, the training starts again from its last checkpoint.

    Args:
        run: Training run.
        scaling: Number and resources of the workers.

    Returns:
        Result of Ray Train.
    """
    file_system, path = storage.resolve_uri(run.storage_path)
    packed = cloudpickle.dumps(partial(train_worker, run))  # pyright: ignore[reportPrivateImportUsage]
    lost_controllers = 0  # Since the last checkpoint.
    while True:
        before = find_last_checkpoint(run)
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
            return trainer.fit()
        except RayActorError:
            lost_controllers = lost_controllers + 1 if find_last_checkpoint(run) == before else 0
            if lost_controllers > RETRIES:
                raise
            print_event(f"{run.name}: the controller of the workers died; training continues", {"event": "retry"})
        except WorkerGroupError as error:
            is_bug = any(isinstance(find_root_cause(part), ValueError) for part in error.worker_failures.values())
            if is_bug or find_last_checkpoint(run) == before:
                raise
            print_event(
                f"{run.name}: workers failed {RETRIES + 1} times, but there is a new checkpoint; training continues",
                {"event": "retry"},
            )


def find_last_checkpoint(run: TrainingRun) -> str:
    """Return the name of the newest checkpoint of a run, or ""."""
    names = storage.list_names(storage.join_uri(run.storage_path, run.name), directories=True)
    return max((name for name in names if name.startswith("checkpoint_")), default="")


def make_scaling_config(num_workers: int, min_workers: int, batch_size: int) -> ScalingConfig:
    """Return the number and the resources of the workers; wait until the cluster has room for `min_workers`.

    The other CPUs are for the data readers.

    Args:
        num_workers: Maximum number of Ray Train workers.
        min_workers: Minimum number of workers.
        batch_size: Global batch size over all workers.

    Returns:
        Scaling configuration of Ray Train.

    Raises:
        ValueError: The cluster has no room for the workers, or the batch has fewer samples than there are workers.
    """
    if not 1 <= min_workers <= num_workers:
        raise ValueError(f"--min-workers {min_workers}, --num-workers {num_workers}: expected 1 <= minimum <= number")
    if batch_size < num_workers:
        raise ValueError(f"--batch-size {batch_size} is smaller than --num-workers {num_workers}")
    gpus, spare = count_gpus_per_model(), {"CPU": READER_CPUS}
    whole = {"CPU": 1.0} | ({"GPU": gpus} if gpus else {})
    # On small machines, two workers share a core.
    need = whole if gpus or count_room(whole, spare) >= num_workers else whole | {"CPU": 0.5}
    require_room(need, min_workers, f"a training worker (--num-workers {num_workers})", spare)
    return ScalingConfig(
        num_workers=num_workers if min_workers == num_workers else (min_workers, num_workers),
        use_gpu=gpus > 0,
        resources_per_worker=need,
    )


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
        ValueError: A change is not positive, or the decay of the moving average is not below 1.
    """
    changes = {name: value for name, value in changes.items() if value is not None}
    for name, value in changes.items():
        if value <= 0:
            raise ValueError(f"--{name.replace('_', '-')} is {value}, expected more than 0")
        if name == "ema_decay" and value >= 1:
            raise ValueError(f"--ema-decay is {value}, expected less than 1, such as 0.999")
    return replace(settings, **changes)


def make_run_identity(settings: OptimizerConfig, **more: Any) -> dict:
    """Return the options that determine a run's weights: its optimizer settings and `more`."""
    return {k: list(v) if isinstance(v, tuple) else v for k, v in settings.to_record().items()} | more
