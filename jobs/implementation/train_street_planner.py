"""Implementation of jobs/train_street_planner.py."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from jobs.implementation.checks import check_train_street_planner
from jobs.support import trainer
from jobs.support.callbacks import StreetPlanCheck
from jobs.support.cli import home_path, resolve_path
from jobs.support.model_directories import find_pipeline_directory
from jobs.support.model_files import write_pipeline
from jobs.support.outputs import hold_output, hold_training
from jobs.support.progress import JobProgress
from jobs.support.ray_session import start_ray
from jobs.support.tracking import Tracker
from jobs.support.trainer import TrainingRun
from jobs.train_street_planner import Config
from models.presets import STREET_PLANNER_PRESETS, StreetPlannerPreset, find_preset
from models.street_planner import StreetPlanner
from models.training import DiffusionLossConfig, ExecutionConfig, OptimizerConfig, Trainer, Wrap, make_dit_trainer
from pipelines.generation.sample import load_pipeline
from pipelines.preprocess.street_maps import MAP_PX, compute_map_thresholds, make_street_maps, plan_street_maps
from pipelines.runtime import storage
from pipelines.schema.tables import Shard
from pipelines.training.data_loader import Stream
from pipelines.training.latents import digest_weights
from pipelines.training.street_map_reader import StreetMapReader


def prepare(config: Config) -> TrainingRun:
    """Make the street maps if they are missing, and prepare training."""
    check_train_street_planner(config)
    row = resolve_preset(config)
    start = load_start(config.start_from, row) if config.start_from else None
    root = resolve_path(config.dataset, "datasets", "streets-smoke" if config.preset == "smoke" else "streets")
    shards, held_out = make_maps(config, row, root)
    counts = [shard.read("street_maps", ["map_id"]).num_rows for shard in shards]
    reader = StreetMapReader(tuple(compute_map_thresholds(shards).items()), config.seed)
    architecture = make_architecture(row, reader, shards[0])
    settings = trainer.override_settings(
        OptimizerConfig(
            steps=row.steps,
            learning_rate=row.learning_rate,
            weight_decay=row.weight_decay,
            final_learning_rate=row.learning_rate / 20,
            warmup_steps=row.warmup_steps,
            betas=(0.95, 0.999),
            grad_clip=1.0,
            ema_decay=row.ema_decay,
            seed=config.seed,
        ),
        steps=config.steps,
        learning_rate=config.learning_rate,
    )
    identity = trainer.make_run_identity(
        settings,
        stage="streets",
        preset=config.preset,
        batch_size=row.batch_size,
        num_maps=row.num_maps,
        dataset=root,
    )
    if start is not None:
        identity |= {"start_from": digest_weights(start)}
    if config.round_weights:
        identity |= {"round_weights": True}
    name = find_run_name(config)
    record = trainer.guard_run_name(name, home_path("runs"), identity)
    tracker = Tracker.start("pritti-streets", name, identity | {"architecture": row.architecture()}, record)
    loss_config = DiffusionLossConfig(sample_posterior=False)
    execution = ExecutionConfig(precision=config.precision)
    state = start and start.state_dict()
    return TrainingRun(
        name=name,
        round_weights=config.round_weights,
        storage_path=home_path("runs"),
        build=partial(build, architecture, settings, execution, row.label_dropout, state, loss_config),
        stream=Stream(tuple(shards), tuple(counts), row.batch_size, config.seed),
        reader=reader,
        settings=settings,
        identity=identity,
        tracker=tracker,
        checkpoint_every=config.checkpoint_every or max(4, settings.steps // 20),
        log_every=max(1, min(50, settings.steps // 50)),
        validate=StreetPlanCheck(held_out, replace(reader, seed=None)),
        id_column=("street_maps", "map_id"),
    )


def resolve_preset(config: Config) -> StreetPlannerPreset:
    """Return the preset with the options that override it."""
    row = find_preset(STREET_PLANNER_PRESETS, config.preset)
    names = ("batch_size", "num_maps")
    return replace(row, **{name: value for name in names if (value := getattr(config, name)) is not None})


def make_maps(config: Config, row: StreetPlannerPreset, root: str) -> tuple[list[Shard], list[Shard]]:
    """Make the street maps that are missing, and return the shards of the training and of the test split."""
    plan = plan_street_maps(root, row.num_maps, row.num_test_maps)
    with hold_output(root, "street maps", config), JobProgress() as bar:
        start_ray(training=True)
        shown = bar.add_task("make street maps", total=sum(town.count for town in plan))
        make_street_maps(plan, lambda count: bar.advance(shown, count))
    split = {name: [town.shard for town in plan if town.shard.split == name] for name in ("train", "test")}
    return split["train"], split["test"]


def make_architecture(row: StreetPlannerPreset, reader: StreetMapReader, shard: Shard) -> dict:
    """Return the keyword arguments of the network. Its distances are normalised by those of the first shard."""
    first = shard.read("street_maps", ["map_id"]).num_rows
    distance_m = replace(reader, seed=None)(shard, np.arange(first))["mean"].astype(np.float64)
    return row.architecture() | {
        "size": MAP_PX,
        "shift": distance_m.mean(axis=(0, 2, 3)).tolist(),
        "scale": distance_m.std(axis=(0, 2, 3)).tolist(),
    }


def load_start(model: str, row: StreetPlannerPreset) -> StreetPlanner:
    """Return the street planner of a pipeline.

    Raises:
        ValueError: The pipeline has no street planner, or its architecture differs from that of the preset.
    """
    planner = load_pipeline(find_pipeline_directory(model)).street_planner
    if planner is None:
        raise ValueError(f"--start-from {model}: this pipeline has no street planner; omit the option")
    for key, wanted in row.architecture().items():
        if planner.config[key] != wanted:
            raise ValueError(
                f"--start-from {model}: its {key} is {planner.config[key]}, but that of this preset is {wanted}; use"
                " the preset with which it was trained"
            )
    return planner


def build(
    architecture: dict,
    settings: OptimizerConfig,
    execution: ExecutionConfig,
    label_dropout: float,
    start: dict[str, Tensor] | None,
    loss_config: DiffusionLossConfig,
    device: torch.device,
    wrap: Wrap,
) -> Trainer:
    """Return the Trainer, with the same initial weights on every worker."""
    torch.manual_seed(settings.seed)
    model = StreetPlanner(**architecture)
    if start:
        model.load_state_dict(start)
    return make_dit_trainer(model, settings, label_dropout, device, wrap, execution, loss_config)


def train(config: Config) -> str:
    """Train and return the directory of the pipeline."""
    name = find_run_name(config)
    model = find_pipeline_directory(config.model)
    output = resolve_path(config.output, "models", f"pritti-{name}")
    with hold_training(name, output, config):
        training = prepare(config)
        trainer.fit(training, config.num_workers, storage.join_uri(output, "street_planner"), config.min_workers)
        return complete_pipeline(model, output)


def find_run_name(config: Config) -> str:
    """Return the name of the training run."""
    return config.name or f"streets-{config.preset}"


def complete_pipeline(model: str, output: str) -> str:
    """Write a copy of a pipeline next to a trained street planner.

    Args:
        model: Directory of the pipeline.
        output: Directory that contains street_planner/. This directory is also returned.
    """
    pipeline = load_pipeline(model)
    pipeline.register_modules(street_planner=StreetPlanner.from_pretrained(storage.join_uri(output, "street_planner")))
    write_pipeline(pipeline, output)
    return output


def main(config: Config) -> None:
    print(f"trained: {train(config)}")
