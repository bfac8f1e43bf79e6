"""Implementation of jobs/train_dit.py."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from jobs.encode_latents import Config as EncodeConfig
from jobs.implementation.checks import (
    find_latents,
    find_training_dataset,
    needs_smoke_inputs,
    open_mixture,
    resolve_label_kind,
)
from jobs.implementation.encode_latents import encode
from jobs.implementation.smoke_inputs import make_smoke_dataset
from jobs.implementation.train_lvae import train as train_lvae
from jobs.support import trainer
from jobs.support.callbacks import SamplingCheck
from jobs.support.cli import home_path, resolve_path
from jobs.support.model_directories import find_pipeline_directory
from jobs.support.model_files import write_pipeline
from jobs.support.outputs import hold_training
from jobs.support.tracking import Tracker
from jobs.support.trainer import TrainingRun
from jobs.support.value_names import RECORDED_PREDICTIONS, RECORDED_TIMESTEPS
from jobs.train_dit import Config
from jobs.train_lvae import Config as LVAEConfig
from models.dit import DiT
from models.labels import LABELS, list_usual_labels
from models.lvae import LayoutVAE
from models.pipeline import PrITTIPipeline
from models.presets import DIT_PRESETS, LVAE_PRESETS, DiTPreset, find_preset
from models.sampling.diffusion import PAPER_SCHEDULE
from models.training import (
    DiffusionLossConfig,
    ExecutionConfig,
    OptimizerConfig,
    Trainer,
    Wrap,
    make_dit_settings,
    make_dit_trainer,
)
from pipelines.generation.sample import load_pipeline
from pipelines.runtime import storage
from pipelines.schema.mixture import Mixture
from pipelines.schema.tables import Shard, find_shards
from pipelines.training.data_loader import LatentReader, Stream, Thresholds, read_label_indices, repeat_crops
from pipelines.training.latents import digest_weights, load_lvae
from pipelines.training.mixed_stream import mix_streams


def prepare(config: Config) -> tuple[TrainingRun, Callable[[str], str]]:
    """Prepare training; generate the inputs of the smoke preset if they are missing.

    Returns:
        The training run, and a function that adds the other components of a pipeline to the output directory.
    """
    row = resolve_preset(config)
    root = find_training_dataset(config, LVAE_PRESETS[row.lvae].source)
    if needs_smoke_inputs(config):
        make_smoke_dataset(root)
        make_smoke_latents(root)
    mixture = open_mixture(config, LVAE_PRESETS[row.lvae].source)
    dataset = mixture.datasets[0]
    label_kind = resolve_label_kind(config, mixture)
    latents_roots = find_latents(config, mixture)
    latents_root = latents_roots[0]
    encoded = [storage.read_json(storage.join_uri(one, "latents.json")) for one in latents_roots]
    latents = mix_statistics(encoded, mixture)
    for one, place, found in zip(mixture.datasets, latents_roots, encoded, strict=True):
        if row.known_streets_share and not found.get("streets"):
            raise ValueError(
                f"--known-streets-share {row.known_streets_share}: {place} has no latents of streets; run"
                f" jobs/encode_latents.py --streets --dataset {one.root} --output {place}"
            )
    architecture = make_dit_architecture(row, latents, load_encoder(latents, latents_root), label_kind)
    start = load_start(config.start_from, latents["lvae_digest"], architecture) if config.start_from else None
    architecture |= start.inherited if start else {}
    other = load_other(config.average_with, latents["lvae_digest"], architecture) if config.average_with else None
    settings = make_optimizer_config(config, row)
    identity = make_run_identity(config, row, settings, latents, root, start) | {"label": label_kind}
    identity |= mixture.identity()
    if other:
        identity |= {"average_with": other.digest}
    name = find_run_name(config)
    record = trainer.guard_run_name(name, home_path("runs"), identity)
    tracker = Tracker.start("pritti-dit", name, identity | {"architecture": row.architecture()}, record)
    execution = ExecutionConfig(config.gradient_accumulation_steps, config.precision, config.compile)
    loss_config = make_loss_config(config, row)
    shards = [find_shards(one.root, source=one.source, split="train") for one in mixture.datasets]
    stream = mix_streams(make_streams(config, shards, row.batch_size), mixture.weights)
    thresholds = (dataset.vegetation, dataset.vehicle) if config.add_datasets else None
    check_training_labels(stream.shards, label_kind, thresholds)
    latents_of = {one.root: place for one, place in zip(mixture.datasets, latents_roots, strict=True)}
    training = TrainingRun(
        name=name,
        average_with=other.state if other else None,
        round_weights=config.round_weights,
        storage_path=home_path("runs"),
        build=partial(build, architecture, settings, execution, row.label_dropout, start, loss_config),
        stream=stream,
        reader=LatentReader(latents_of, label_kind, row.known_streets_share > 0, thresholds),
        settings=settings,
        identity=identity,
        tracker=tracker,
        checkpoint_every=config.checkpoint_every or max(4, settings.steps // 20),
        log_every=max(1, min(50, settings.steps // 50)),
        validate=SamplingCheck(
            root, dataset.source, latents_root, latents["lvae"], label_kind, streets=row.known_streets_share > 0
        ),
    )
    sampling = (start.sampling if start else {}) | {"neighbour_latents": row.neighbour_latents, "attach": row.attach}
    return training, partial(complete_pipeline, latents["lvae"], sampling)


def mix_statistics(latents: list[dict], mixture: Mixture) -> dict:
    """Return the latents.json of the first dataset, with the channel statistics of the samples of the mixture."""
    if len(latents) == 1:
        return latents[0]
    shares = np.array(mixture.weights) / sum(mixture.weights)
    mean, std = (np.array([one[name] for one in latents]) for name in ("channel_mean", "channel_std"))
    mixed = shares @ mean
    variance = shares @ (std**2 + mean**2) - mixed**2
    return latents[0] | {"channel_mean": mixed.tolist(), "channel_std": np.sqrt(np.maximum(variance, 1e-12)).tolist()}


def make_streams(config: Config, shards: Sequence[Sequence[Shard]], batch_size: int) -> list[Stream]:
    """Return the order of the training samples of each dataset, with --crop-repeats.

    Raises:
        ValueError: --crop-repeats is below 1, or is above 1 although no dataset has crops.
    """
    if config.crop_repeats < 1:
        raise ValueError(f"--crop-repeats {config.crop_repeats}: use 1 or more")
    streams, crops = [], False
    for part in shards:
        scenes = [shard.read("scenes", ["free_pose"]) for shard in part]
        counts = tuple(table.num_rows for table in scenes)
        rows = tuple(repeat_crops(table, config.crop_repeats) for table in scenes) if config.crop_repeats > 1 else ()
        repeated = tuple(map(len, rows)) or counts
        crops = crops or repeated != counts
        streams.append(Stream(tuple(part), repeated, batch_size, config.seed, rows))
    if config.crop_repeats > 1 and not crops:
        raise ValueError(
            f"--crop-repeats {config.crop_repeats}: the dataset has no crops at any place; omit the option"
        )
    return streams


def check_training_labels(shards: Sequence[Shard], kind: str, thresholds: Thresholds = None) -> None:
    """Check that the training scenes differ in their labels, and print the labels that no scene has.

    Raises:
        ValueError: All scenes have the same label although this kind has several.
    """
    indices = np.concatenate([read_label_indices(shard, kind, thresholds) for shard in shards])
    counts = np.bincount(indices, minlength=len(LABELS[kind]))
    named = set(list_usual_labels(kind))
    missing = [name for name, count in zip(LABELS[kind], counts, strict=True) if count == 0 and name in named]
    if len(counts) > 1 and (counts > 0).sum() == 1:
        raise ValueError(
            f"--label-kind {kind}: all {counts.sum()} training scenes have the label"
            f" {LABELS[kind][counts.argmax()]!r}; use another kind, or none"
        )
    if missing:
        print(f"note: no training scene has the label {', '.join(missing)}; do not sample with it")


def make_loss_config(config: Config, row: DiTPreset) -> DiffusionLossConfig:
    """Return the options of the loss."""
    return DiffusionLossConfig(
        timestep_sampling="logit_normal" if config.timestep_sampling == "logit-normal" else "uniform",
        loss_weighting="min_snr" if config.loss_weighting == "min-snr" else "uniform",
        sample_posterior=row.sample_posterior,
        known_streets_share=row.known_streets_share,
    )


def make_smoke_latents(root: str) -> None:
    """Encode the smoke dataset with the smoke layout VAE, which is trained if it is missing."""
    lvae = home_path("models", "lvae-smoke")
    if not storage.exists(storage.join_uri(lvae, "config.json")):
        train_lvae(LVAEConfig(preset="smoke"))
    encode(EncodeConfig(dataset=root, lvae=lvae))


def resolve_preset(config: Config) -> DiTPreset:
    """Return the preset with the options that override it."""
    row = find_preset(DIT_PRESETS, config.preset)
    if config.batch_size is not None:
        row = replace(row, batch_size=config.batch_size)
    if config.prediction_type is not None:
        row = replace(row, model=replace(row.model, prediction=config.prediction_type))
    if config.inpainting is not None:
        row = replace(row, model=replace(row.model, inpainting=config.inpainting))
    if config.normalise_latents is not None:
        row = replace(row, normalise_latents=config.normalise_latents)
    if config.sample_posterior is not None:
        row = replace(row, sample_posterior=config.sample_posterior)
    if config.known_streets_share is not None:
        row = replace(row, known_streets_share=config.known_streets_share)
    if not 0 <= row.known_streets_share <= 1 or (row.known_streets_share and not row.model.inpainting):
        raise ValueError(
            f"--known-streets-share is {row.known_streets_share}, expected 0 to 1, and 0 without --inpainting"
        )
    return row


def load_encoder(latents: dict, latents_root: str) -> LayoutVAE:
    """Return the layout VAE that encoded the latents.

    Raises:
        ValueError: The weights of the layout VAE have changed since the latents were encoded.
    """
    lvae = load_lvae(latents["lvae"])
    if digest_weights(lvae) != latents["lvae_digest"]:
        raise ValueError(
            f"{latents['lvae']} has changed since it encoded {latents_root}; encode again to another --output"
        )
    return lvae


def make_optimizer_config(config: Config, row: DiTPreset) -> OptimizerConfig:
    """Return the optimizer settings of the preset with the options that override them."""
    return trainer.override_settings(
        make_dit_settings(row, config.seed),
        steps=config.steps,
        learning_rate=config.learning_rate,
        final_learning_rate=config.final_learning_rate,
        warmup_steps=config.warmup_steps,
        ema_decay=config.ema_decay,
    )


def make_dit_architecture(row: DiTPreset, latents: dict, lvae: LayoutVAE, label_kind: str) -> dict:
    """Return the keyword arguments of DiT from the preset, the latents and the labels."""
    channels, size, _ = latents["shape"]
    return row.architecture() | {
        "channels": channels,
        "size": size,
        "label": label_kind,
        "num_labels": len(LABELS[label_kind]),
        "layout": dict(lvae.config.layout),
        "shift": latents["channel_mean"] if row.normalise_latents else None,
        "scale": latents["channel_std"] if row.normalise_latents else None,
    }


def make_run_identity(
    config: Config, row: DiTPreset, settings: OptimizerConfig, latents: dict, root: str, start: Start | None
) -> dict:
    """Return the options that must not change when a run is resumed."""
    identity = trainer.make_run_identity(
        settings,
        stage="dit",
        preset=config.preset,
        batch_size=row.batch_size,
        prediction=RECORDED_PREDICTIONS[row.model.prediction],
        normalise_latents=row.normalise_latents,
        lvae=latents["lvae_digest"],
        dataset=root,
    )
    if start:
        identity |= {"start_from": start.digest}
    loss, paper = make_loss_config(config, row), DiffusionLossConfig()  # Earlier versions did not record these options.
    if loss.timestep_sampling != paper.timestep_sampling:
        identity |= {"timesteps": RECORDED_TIMESTEPS[loss.timestep_sampling]}
    if loss.loss_weighting != paper.loss_weighting:
        identity |= {"loss_weighting": loss.loss_weighting}
    if loss.sample_posterior != paper.sample_posterior:
        identity |= {"sample_posterior": loss.sample_posterior}
    if row.model.inpainting:
        identity |= {"inpainting": True}
    if row.known_streets_share:
        identity |= {"known_streets_share": row.known_streets_share}
    if config.crop_repeats != 1:
        identity |= {"crop_repeats": config.crop_repeats}
    if config.round_weights:
        identity |= {"round_weights": True}
    return identity


def train(config: Config) -> str:
    """Train and return the pipeline's directory."""
    output = resolve_path(config.output, "models", f"pritti-{config.name or config.preset}")
    with hold_training(find_run_name(config), output, config):
        training, complete = prepare(config)
        trainer.fit(training, config.num_workers, storage.join_uri(output, "dit"), config.min_workers)
        return complete(output)


def find_run_name(config: Config) -> str:
    """Return the name of the training run."""
    return config.name or f"dit-{config.preset}"


@dataclass(frozen=True)
class Start:
    """Trained weights from which a run starts."""

    digest: str
    inherited: dict  # Shift and scale of the latents, and noise schedule, for these weights.
    sampling: dict  # Arguments of the pipeline: sampler, number of steps, noise scaling, guidance, street planner.
    state: dict[str, Tensor]


def load_other(model: str, lvae_digest: str, architecture: dict) -> Start:
    """Return the transformer of --average-with.

    Raises:
        ValueError: See `load_start`; or the shift or the scale of the latents, or the noise schedule, differs.
    """
    other = load_start(model, lvae_digest, architecture, "--average-with")
    own = {"schedule": PAPER_SCHEDULE} | architecture
    for key, value in other.inherited.items():
        if own[key] != value:
            raise ValueError(
                f"--average-with {model}: its {key} differs; use --start-from {model}, or a pipeline whose training"
                " started from it"
            )
    return other


def load_start(model: str, lvae_digest: str, architecture: dict, option: str = "--start-from") -> Start:
    """Return the transformer of a trained pipeline; error messages name the option.

    Raises:
        ValueError: The transformer was trained on latents of another layout VAE, or its architecture differs.
    """
    directory = find_pipeline_directory(model)
    pipeline = load_pipeline(directory)
    if digest_weights(pipeline.lvae) != lvae_digest:
        raise ValueError(
            f"{option} {model}: its transformer was trained on latents of another layout VAE; "
            "encode latents with that layout VAE first: jobs/encode_latents.py --lvae "
            f"{storage.join_uri(directory, 'lvae')}"
        )
    built = pipeline.dit.config
    if built["inpainting"] and not architecture["inpainting"]:
        raise ValueError(f"{option} {model} is an inpainting model; add --inpainting")
    for key in ("patch", "depth", "width", "heads", "prediction", "label"):
        if built[key] != architecture[key]:
            raise ValueError(
                f"{option} {model}: its {key} is {built[key]}, but that of this run is {architecture[key]}; "
                "use equal values"
            )
    inherited = {"shift": built["shift"], "scale": built["scale"], "schedule": pipeline.dit.diffusion}
    names = (
        "num_inference_steps",
        "noise_scaling",
        "existence_threshold",
        "constraints",
        "pag_scale",
        "pag_drops_label",
        "street_pag_factor",
    )
    parts = {"scheduler": pipeline.scheduler_config, "street_planner": pipeline.street_planner}
    sampling = parts | {name: pipeline.config[name] for name in names}
    return Start(digest_weights(pipeline.dit), inherited, sampling, pipeline.dit.state_dict())


def build(
    architecture: dict,
    settings: OptimizerConfig,
    execution: ExecutionConfig,
    label_dropout: float,
    start: Start | None,
    loss_config: DiffusionLossConfig,
    device: torch.device,
    wrap: Wrap,
) -> Trainer:
    """Return the Trainer of stage 2, with the same initial weights on every worker."""
    torch.manual_seed(settings.seed)
    model = DiT(**architecture)
    if start:
        new = model.load_state_dict(start.state, strict=False)
        # Weights for the known part, which older models lack, start at zero.
        if new.unexpected_keys or set(new.missing_keys) - {"known_in.weight"}:
            raise ValueError(f"the weights to start from do not fit: {new}")
    return make_dit_trainer(model, settings, label_dropout, device, wrap, execution, loss_config)


def complete_pipeline(lvae: str, sampling: dict, output: str) -> str:
    """Write the layout VAE and the scheduler next to a trained DiT. Then `output` is a directory for PrITTIPipeline.

    Args:
        lvae: Directory of the layout VAE.
        sampling: Arguments of the pipeline, such as `noise_scaling`.
        output: Directory that contains dit/. This directory is also returned.
    """
    dit = DiT.from_pretrained(storage.join_uri(output, "dit"))
    pipeline = PrITTIPipeline(load_lvae(lvae), dit, **sampling)
    write_pipeline(pipeline, output)
    return output


def main(config: Config) -> None:
    print(f"trained: {train(config)}")
