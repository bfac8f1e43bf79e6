"""Implementation of jobs/train_lvae.py."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, is_dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from jobs.implementation.checks import (
    check_train_lvae,
    find_start,
    find_training_dataset,
    needs_smoke_inputs,
    open_mixture,
)
from jobs.implementation.smoke_inputs import make_smoke_dataset
from jobs.support import trainer
from jobs.support.callbacks import ReconstructionCheck
from jobs.support.cli import home_path, resolve_path
from jobs.support.model_directories import find_pipeline_directory
from jobs.support.model_files import write_pipeline
from jobs.support.outputs import hold_training
from jobs.support.tracking import Tracker
from jobs.support.trainer import TrainingRun, convert_to_tensors
from jobs.train_lvae import Config
from models.augment import Augmentation
from models.batch import LayoutBatch
from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.presets import LVAE_PRESETS, LVAEPreset, find_preset
from models.training import (
    ExecutionConfig,
    OptimizerConfig,
    Trainer,
    Wrap,
    make_lvae_settings,
    make_lvae_trainer,
)
from pipelines.generation.sample import load_pipeline
from pipelines.runtime import storage
from pipelines.schema.tables import find_shards
from pipelines.training.data_loader import LayoutReader, Stream, read_samples
from pipelines.training.latents import digest_weights, load_lvae
from pipelines.training.mixed_stream import MixedStream, mix_streams

# Options of the object branch that concern the decoder.
OF_OBJECT_DECODER = (
    "decoder",
    "head_hidden",
    "min_proposals_per_cell",
    "loss_unit",
    "queries",
    "learned_content",
    "position_unit",
    "auxiliary_losses",
    "denoising_groups",
)
# Options that change no weights. With another frame, the encoder and the decoder only see other yaws and heights.
MAY_CHANGE = ("loss_unit", "auxiliary_losses", "local_frame")
START_SCENES, START_SHARDS = 96, 16  # numbers of training scenes and shards from which the model is initialised


def prepare(config: Config) -> TrainingRun:
    """Return the training run that the options describe; generate the smoke preset's dataset if it is missing."""
    check_train_lvae(config)
    row = resolve_preset(config)
    root = find_training_dataset(config, row.source)
    if needs_smoke_inputs(config):
        make_smoke_dataset(root)
    mixture = open_mixture(config, row.source)
    dataset = mixture.datasets[0]
    settings = make_optimizer_config(config, row)
    streams = []
    for one in mixture.datasets:
        shards = find_shards(one.root, source=one.source, split="train")
        counts = tuple(shard.read("scenes", ["scene_id"]).num_rows for shard in shards)
        streams.append(Stream(tuple(shards), counts, row.batch_size, config.seed))
    stream = mix_streams(streams, mixture.weights)
    name = find_run_name(config)
    kept = start = None
    spec = mixture.layout.with_resolution(row.raster_px)
    if config.start_from:
        start = load_start(config.start_from, row.architecture(), spec)
        spec = start.spec
    if config.train_object_decoder_of:
        kept = load_kept_weights(config.train_object_decoder_of, row.architecture())
        spec = kept.spec
        require_replaceable(name, kept)
    for note in mixture.require_cover(spec):
        print(f"note: {note}")
    # The ground branch extrapolates beyond its bounds. Clipped heights would teach it to flatten hills.
    clip_heights = all(spec.covers_heights(one.spec) for one in mixture.datasets)
    augment = Augmentation(config.flip, *((1.0, np.radians(2.5)) if config.jitter else (0.0, 0.0)), config.seed)
    identity = make_run_identity(config, row, settings, spec, root, augment) | mixture.identity()
    if start:
        identity |= {"start_from": digest_weights(start)}
    if kept:
        identity |= {"start_from": kept.digest}
    record = trainer.guard_run_name(name, home_path("runs"), identity)
    tracker = Tracker.start("pritti-lvae", name, identity | {"architecture": row.architecture()}, record)
    execution = ExecutionConfig(config.gradient_accumulation_steps, config.precision, config.compile)
    sample = sample_layouts(stream, spec)
    return TrainingRun(
        name=name,
        round_weights=config.round_weights,
        storage_path=home_path("runs"),
        build=partial(
            build,
            row.architecture(),
            spec.to_dict(),
            settings,
            row.kl_weight,
            row.latent_noise,
            execution,
            sample if row.init_from_data and start is None else None,
            kept,
            start and start.state_dict(),
        ),
        stream=stream,
        reader=LayoutReader(spec, augment if config.flip or config.jitter else None, clip_heights),
        settings=settings,
        identity=identity,
        tracker=tracker,
        checkpoint_every=config.checkpoint_every or max(4, settings.steps // 20),
        log_every=max(1, min(50, settings.steps // 50)),
        validate=ReconstructionCheck(root, dataset.source, row.kl_weight),
    )


def resolve_preset(config: Config) -> LVAEPreset:
    """Return the preset with the options that override it."""
    row = find_preset(LVAE_PRESETS, config.preset)
    names = ("batch_size", "kl_weight", "latent_noise", "warmup_steps", "grad_clip", "init_from_data")
    row = replace(row, **{name: value for name in names if (value := getattr(config, name)) is not None})
    if row.kl_weight < 0:
        raise ValueError(f"--kl-weight is {row.kl_weight}, expected 0 or more")
    for name in ("latent_noise", "warmup_steps", "grad_clip"):
        if (value := getattr(row, name) or 0) < 0:
            raise ValueError(f"--{name.replace('_', '-')} is {value}, expected 0 or more")
    return row


def make_optimizer_config(config: Config, row: LVAEPreset) -> OptimizerConfig:
    """Return the optimizer settings of the preset with the options that override them."""
    return trainer.override_settings(
        make_lvae_settings(row, config.seed),
        steps=config.steps,
        learning_rate=config.learning_rate,
    )


def make_run_identity(
    config: Config, row: LVAEPreset, settings: OptimizerConfig, spec: LayoutSpec, root: str, augment: Augmentation
) -> dict:
    """Return the options that must not change when a run is resumed."""
    identity = trainer.make_run_identity(
        settings,
        stage="lvae",
        preset=config.preset,
        batch_size=row.batch_size,
        kl_weight=row.kl_weight,
        latent_noise=row.latent_noise,
        layout=spec.fingerprint(),
        dataset=root,
    )
    if config.flip or config.jitter:
        identity |= {"augmentation": asdict(augment)}
    if not row.init_from_data:  # earlier versions always did
        identity |= {"init_from_data": False}
    if (least := row.model.objects.min_proposals_per_cell) != 1:  # earlier versions did not record this option
        identity |= {"least_per_cell": least}
    if row.model.objects.order_in_cell:
        identity |= {"order_in_cell": True}
    if row.model.local_frame:
        identity |= {"local_frame": True}
    if config.round_weights:
        identity |= {"round_weights": True}
    return identity


def train(config: Config) -> str:
    """Train a model and return its directory; with --train-object-decoder-of, return the directory of the pipeline."""
    name = find_run_name(config)
    output = resolve_path(config.output, "models", name)
    with hold_training(name, output, config):
        training = prepare(config)
        trainer.fit(training, config.num_workers, output, config.min_workers)
        if config.train_object_decoder_of:
            return write_updated_pipeline(config.train_object_decoder_of, output, training)
        return output


def find_run_name(config: Config) -> str:
    """Return the name of the training run."""
    return config.name or f"lvae-{config.preset}"


@dataclass(frozen=True)
class Kept:
    """Weights of a trained layout VAE that provides the encoders, and the digest of the pipeline's transformer."""

    digest: str
    transformer: str
    state: dict[str, Tensor]
    spec: LayoutSpec


def load_kept_weights(model: str, architecture: dict) -> Kept:
    """Return the layout VAE of a trained pipeline.

    Raises:
        ValueError: The encoders of the pipeline differ from those of this run.
    """
    pipeline = load_pipeline(find_pipeline_directory(model))
    lvae = pipeline.lvae
    for (key, built), (_, wanted) in zip(list_kept_options(lvae.config), list_kept_options(architecture), strict=True):
        if built != wanted:
            raise ValueError(
                f"--train-object-decoder-of {model}: its {key} is {built}, but that of this preset is {wanted}; "
                "use the preset of this pipeline"
            )
    return Kept(digest_weights(lvae), digest_weights(pipeline.dit), lvae.state_dict(), lvae.spec)


def load_start(model: str, architecture: dict, spec: LayoutSpec) -> LayoutVAE:
    """Return the trained layout VAE from which a run starts.

    The run has the layout of these weights. The networks of the decoder "cells" do not depend on the number of slots,
    so each category gets at least the slots of the datasets.

    Args:
        model: Directory of a layout VAE, or any value that --model accepts.
        architecture: Options of the preset.
        spec: Layout of the datasets.

    Raises:
        ValueError: The networks or the grid differ from those of this run.
    """
    directory, is_lvae = find_start(model)
    lvae = load_lvae(directory) if is_lvae else load_pipeline(directory).lvae
    for (key, built), (_, wanted) in zip(list_options(lvae.config), list_options(architecture), strict=True):
        if built != wanted and key not in MAY_CHANGE:
            raise ValueError(
                f"--start-from {model}: its {key} is {built}, but that of this preset is {wanted}; use the preset with"
                " which it was trained"
            )
    own, slots = lvae.spec, dict(zip(spec.categories, spec.slots, strict=True))
    if own.grid != spec.grid:
        raise ValueError(
            f"--start-from {model}: its grid is {own.grid}, but that of this preset is {spec.grid}; use the preset with"
            " which it was trained"
        )
    if lvae.config.objects["decoder"] == "cells":
        wanted = [max(count, slots.get(name, 0)) for name, count in zip(own.categories, own.slots, strict=True)]
        own = replace(own, slots=tuple(wanted))
    if own == lvae.spec:
        return lvae
    resized = LayoutVAE.from_config({**lvae.config, "layout": own.to_dict()})
    try:
        resized.load_state_dict(lvae.state_dict())
    except RuntimeError as error:
        raise ValueError(
            f"--start-from {model}: with the slots of this dataset {own.slots}, the decoder has another size than with"
            f" {lvae.spec.slots}; preprocess the dataset with the same --slots"
        ) from error
    return resized.requires_grad_(False)


def list_kept_options(options: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """List the options of a LayoutVAE by name, without the layout and the options of the object decoder."""
    return [entry for entry in list_options(options) if entry[0] not in OF_OBJECT_DECODER]


def list_options(options: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """List the options of a LayoutVAE by name, without the layout."""
    found: list[tuple[str, Any]] = []
    for name, option in options.items():
        value = asdict(option) if is_dataclass(option) and not isinstance(option, type) else option
        entries = list(value.items()) if isinstance(value, Mapping) else [(name, value)]
        found += [entry for entry in entries if name != "layout"]
    return found


def require_replaceable(name: str, kept: Kept) -> None:
    """Raise an error if the updated pipeline would overwrite the initial pipeline or an unrelated pipeline.

    Raises:
        ValueError: The updated pipeline would overwrite a pipeline.
    """
    place = home_path("models", f"pritti-{name}")
    if not storage.exists(storage.join_uri(place, "model_index.json")):
        return
    there = load_pipeline(place)
    if digest_weights(there.lvae) == kept.digest or digest_weights(there.dit) != kept.transformer:
        raise ValueError(f"--name {name}: {place} holds a pipeline that would be replaced; choose another name")


def write_updated_pipeline(model: str, lvae: str, training: TrainingRun) -> str:
    """Copy a trained pipeline, replace the layout VAE by one that has the same latents, and return the directory.

    Raises:
        ValueError: The pipeline has changed since the training started.
    """

    pipeline = load_pipeline(find_pipeline_directory(model))
    if digest_weights(pipeline.lvae) != training.identity["start_from"]:
        raise ValueError(
            f"--train-object-decoder-of {model} was replaced during training; the trained layout VAE is in {lvae}"
        )
    pipeline.register_modules(lvae=load_lvae(lvae))
    output = home_path("models", f"pritti-{training.name}")
    write_pipeline(pipeline, output)
    return output


def sample_layouts(stream: Stream | MixedStream, spec: LayoutSpec) -> dict:
    """Return compact layouts of up to START_SCENES training scenes for `init_from_data`.

    The scenes are selected evenly from a dataset. Those of a mixture are the first samples of the training.
    """
    read, parts = LayoutReader(spec), []
    if isinstance(stream, MixedStream):
        return read_samples(stream, read, 0, 1, START_SCENES, 0, 1)
    shards, counts = stream.shards, stream.counts
    for k in np.unique(np.linspace(0, len(shards) - 1, START_SHARDS).round().astype(int)):
        take = min(counts[k], START_SCENES // START_SHARDS)
        parts.append(read(shards[k], np.linspace(0, counts[k] - 1, take).round().astype(int)))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def build(
    architecture: dict,
    layout: dict,
    settings: OptimizerConfig,
    kl_weight: float,
    latent_noise: float,
    execution: ExecutionConfig,
    sample: dict | None,
    kept: Kept | None,
    start: dict[str, Tensor] | None,
    device: torch.device,
    wrap: Wrap,
) -> Trainer:
    """Return the Trainer of stage 1, with the same initial weights on every worker."""
    torch.manual_seed(settings.seed)
    model = LayoutVAE(layout=layout, **architecture)
    if sample is not None:
        model.init_from_data(LayoutBatch.from_compact(convert_to_tensors(sample)))
    if start:
        model.load_state_dict(start)
    if kept:
        model.freeze_all_but_object_decoder(kept.state)
    return make_lvae_trainer(model, settings, kl_weight, device, wrap, execution, latent_noise)


def main(config: Config) -> None:
    print(f"trained: {train(config)}")
