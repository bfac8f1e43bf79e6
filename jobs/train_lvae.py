#!/usr/bin/env python3
"""Train the layout VAE (stage 1): scene tables -> $PRITTI_HOME/models/lvae-<preset>.

    jobs/train_lvae.py                      the town preset on $PRITTI_HOME/datasets/town
    jobs/train_lvae.py smoke                seconds; makes its own data
    jobs/train_lvae.py kitti360 --dataset DIR --workers 4
    jobs/train_lvae.py demo --keep-latents-of town --name lvae-decoder     another object decoder for a trained pipeline

Run it again with the same options to resume. Losses and pictures go to MLflow ($MLFLOW_TRACKING_URI, default an
sqlite file under $PRITTI_HOME).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import tyro

from jobs.support.cli import absolute, home, run
from jobs.support.options import pipeline_directory

if TYPE_CHECKING:
    from torch import Tensor

    from jobs.support.trainer import TrainingRun
    from models.layout import LayoutSpec

OF_OBJECT_DECODER = ("decoder", "head_hidden", "least_per_cell")  # parts of an architecture
START_SCENES, START_SHARDS = 96, 16  # the sample of training scenes that says where outputs start


@dataclass(frozen=True)
class Config:
    """Options of a training run; what is left out comes from the preset (models/presets.py)."""

    preset: tyro.conf.Positional[str] = "town"
    """smoke, demo, town, kitti360, kitti360-light or av2."""
    dataset: str = ""
    """Dataset directory (default: $PRITTI_HOME/datasets/<the preset's source>)."""
    name: str = ""
    """Name of the run (default: lvae-<preset>). Another name is another run."""
    output: str = ""
    """Where the trained model goes (default: $PRITTI_HOME/models/<name>)."""
    keep_latents_of: str = ""
    """A trained pipeline, named as for --model: its encoders and ground decoder stay what they are and only the object
    decoder is trained, anew. Its transformer knows the latents still: with the new decoder it goes to
    $PRITTI_HOME/models/pritti-<name>."""
    workers: int = 1
    """Ray Train workers; with GPUs, one each."""
    steps: int | None = None
    batch_size: int | None = None
    """Global batch size over all workers."""
    learning_rate: float | None = None
    kl_weight: float | None = None
    """Of the KL divergence, summed over the latent; the paper's 1e-6 unless the preset says otherwise."""
    latent_noise: float | None = None
    """Spread of the noise on latents that decoders learn to bear, in deviations of each channel (default: as the preset
    says; the paper: none)."""
    accumulate: int = 1
    """Cut each worker's batch into this many parts, one after another, where it does not fit memory."""
    precision: str = "auto"
    """fp32, bf16, or auto: bf16 where the GPU has it."""
    compile: bool = False
    """torch.compile the model: worth its minute on a GPU."""
    checkpoint_every: int | None = None
    """Steps between checkpoints (default: a twentieth of the run, at least four)."""
    flip: bool = False
    """Augmentation: mirror half of the scenes left to right."""
    jitter: bool = False
    """Augmentation: move the vehicle by up to 1 m and turn it by up to 2.5 degrees, as SLEDGE does."""
    seed: int = 0


def prepare(config: Config) -> TrainingRun:
    """The run that the options mean; makes the smoke preset's data."""
    from jobs.support.smoke_inputs import smoke_dataset
    from models.presets import LVAE_PRESETS, preset
    from pipelines.schema.dataset import Dataset

    row = preset(LVAE_PRESETS, config.preset)
    root = (
        absolute(config.dataset)
        if config.dataset
        else home("datasets", "smoke" if config.preset == "smoke" else row.source)
    )
    if config.preset == "smoke" and not config.dataset:
        smoke_dataset(root)
    dataset = Dataset.open(root)

    from dataclasses import asdict
    from functools import partial

    import numpy as np

    from jobs.support.callbacks import ReconstructionCheck
    from jobs.support.tracking import Tracker
    from jobs.support.trainer import TrainingRun, claim, identity_of, settings_with
    from models.augment import Augmentation
    from models.training import Execution, Optimisation
    from pipelines.schema.tables import find_shards
    from pipelines.training.data_loader import LayoutReader, Stream

    spec = dataset.spec.with_resolution(row.raster_px)
    name = config.name or f"lvae-{config.preset}"
    settings = settings_with(
        Optimisation(
            steps=row.steps,
            learning_rate=row.learning_rate,
            final_learning_rate=row.final_learning_rate,
            weight_decay=row.weight_decay,
            warmup_steps=row.warmup_steps,
            cycle_momentum=(0.85, 0.95),  # OneCycleLR's defaults, as in SLEDGE
            grad_clip=row.grad_clip,
            ema_decay=row.ema_decay,
            seed=config.seed,
        ),
        steps=config.steps,
        learning_rate=config.learning_rate,
    )
    execution = Execution(config.accumulate, config.precision, config.compile)
    batch_size = row.batch_size if config.batch_size is None else config.batch_size
    kl_weight = row.kl_weight if config.kl_weight is None else config.kl_weight
    if kl_weight < 0:
        raise ValueError(f"--kl-weight is {kl_weight}, expected 0 or more")
    latent_noise = row.latent_noise if config.latent_noise is None else config.latent_noise
    if latent_noise < 0:
        raise ValueError(f"--latent-noise is {latent_noise}, expected 0 or more")
    shards = find_shards(root, source=dataset.source, split="train")
    counts = [shard.read("scenes", ["scene_id"]).num_rows for shard in shards]
    augment = Augmentation(config.flip, *((1.0, np.radians(2.5)) if config.jitter else (0.0, 0.0)), config.seed)
    identity = identity_of(
        settings,
        stage="lvae",
        preset=config.preset,
        batch_size=batch_size,
        kl_weight=kl_weight,
        latent_noise=latent_noise,
        layout=spec.fingerprint(),
        dataset=root,
    ) | ({"augmentation": asdict(augment)} if config.flip or config.jitter else {})
    if row.least_per_cell != 1:  # runs of before cells had more go on
        identity |= {"least_per_cell": row.least_per_cell}
    kept = kept_latents(config.keep_latents_of, row.architecture(), spec) if config.keep_latents_of else None
    if kept:
        identity |= {"start_from": kept.digest}
        require_place(name, kept)
    record = claim(name, home("runs"), identity)
    parameters = identity | {"architecture": row.architecture()}
    tracker = Tracker.start("pritti-lvae", name, parameters, record)
    return TrainingRun(
        name=name,
        storage_path=home("runs"),
        build=partial(
            build,
            row.architecture(),
            spec.to_dict(),
            settings,
            kl_weight,
            latent_noise,
            execution,
            sample_layouts(shards, counts, spec),
            kept,
        ),
        stream=Stream(tuple(shards), tuple(counts), batch_size, config.seed),
        reader=LayoutReader(spec, augment if config.flip or config.jitter else None),
        settings=settings,
        identity=identity,
        tracker=tracker,
        checkpoint_every=config.checkpoint_every or max(4, settings.steps // 20),
        log_every=max(1, min(50, settings.steps // 50)),
        validate=ReconstructionCheck(root, dataset.source, kl_weight),
    )


def train(config: Config) -> str:
    """Train and return the directory of the model, of the pipeline where one was given."""
    training = prepare(config)
    from jobs.support.trainer import fit

    output = absolute(config.output) if config.output else home("models", training.name)
    fit(training, config.workers, output)
    return renewed_pipeline(config.keep_latents_of, output, training) if config.keep_latents_of else output


@dataclass(frozen=True)
class Kept:
    """The weights of a trained layout VAE whose latents stay, and the digest of the transformer that knows them."""

    digest: str
    transformer: str
    state: dict[str, Tensor]


def kept_latents(model: str, architecture: dict, spec: LayoutSpec) -> Kept:
    """The layout VAE of a trained pipeline. Raises ValueError if its encoders or its layout are not this run's."""
    from pipelines.generation.sample import load_pipeline
    from pipelines.training.latents import weights_digest

    pipeline = load_pipeline(pipeline_directory(model))
    lvae = pipeline.lvae
    for key, wanted in architecture.items():
        built = lvae.config[key]
        if key not in OF_OBJECT_DECODER and (tuple(built) if isinstance(built, list) else built) != wanted:
            raise ValueError(
                f"--keep-latents-of {model}: its {key} is {built}, this preset's {wanted}; choose its own preset"
            )
    if lvae.spec.fingerprint() != spec.fingerprint():
        raise ValueError(
            f"--keep-latents-of {model}: it knows another layout than this dataset; choose its own dataset"
        )
    return Kept(weights_digest(lvae), weights_digest(pipeline.dit), lvae.state_dict())


def require_place(name: str, kept: Kept) -> None:
    """Raises ValueError where the renewed pipeline would take the place of another one, or of the one it begins with."""
    from pipelines.generation.sample import load_pipeline
    from pipelines.runtime import storage
    from pipelines.training.latents import weights_digest

    place = home("models", f"pritti-{name}")
    if not storage.exists(storage.join(place, "model_index.json")):
        return
    there = load_pipeline(place)
    if weights_digest(there.lvae) == kept.digest or weights_digest(there.dit) != kept.transformer:
        raise ValueError(f"--name {name}: {place} holds a pipeline that would be replaced; choose another name")


def renewed_pipeline(model: str, lvae: str, training: TrainingRun) -> str:
    """Put a trained pipeline with another layout VAE, of the same latents, where pipelines are; its directory.

    Raises ValueError if the pipeline is not any more what the training began with.
    """
    import tempfile

    from jobs.support.trainer import publish_directory
    from pipelines.generation.sample import load_pipeline
    from pipelines.training.latents import load_lvae, weights_digest

    pipeline = load_pipeline(pipeline_directory(model))
    if weights_digest(pipeline.lvae) != training.identity["start_from"]:
        raise ValueError(f"--keep-latents-of {model} was replaced during training; what was trained is in {lvae}")
    pipeline.register_modules(lvae=load_lvae(lvae))
    output = home("models", f"pritti-{training.name}")
    with tempfile.TemporaryDirectory() as directory:
        pipeline.save_pretrained(directory)
        publish_directory(directory, output)
    return output


def sample_layouts(shards: list, counts: list[int], spec) -> dict:
    """Compact layouts of up to START_SCENES training scenes from all over the dataset (LayoutVAE.start_at)."""
    import numpy as np

    from pipelines.training.data_loader import LayoutReader

    read, parts = LayoutReader(spec), []
    for k in np.unique(np.linspace(0, len(shards) - 1, START_SHARDS).round().astype(int)):
        take = min(counts[k], START_SCENES // START_SHARDS)
        parts.append(read(shards[k], np.linspace(0, counts[k] - 1, take).round().astype(int)))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def build(
    architecture: dict,
    layout: dict,
    settings,
    kl_weight: float,
    latent_noise: float,
    execution,
    sample: dict,
    kept: Kept | None,
    device,
    wrap,
):
    """The Trainer of stage 1, with the same initial weights on every worker."""
    import torch

    from jobs.support.trainer import as_tensors
    from models.batch import LayoutBatch
    from models.lvae import LayoutVAE
    from models.training import lvae_trainer

    torch.manual_seed(settings.seed)
    model = LayoutVAE(layout=layout, **architecture)
    model.start_at(LayoutBatch.from_compact(as_tensors(sample)))
    if kept:
        model.keep_latents_of(kept.state)
    return lvae_trainer(model, settings, kl_weight, device, wrap, execution, latent_noise)


def main(config: Config) -> None:
    print(f"trained: {train(config)}")


if __name__ == "__main__":
    run(main, Config, description=__doc__)
