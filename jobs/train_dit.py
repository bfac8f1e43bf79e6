#!/usr/bin/env python3
"""Train the diffusion transformer (stage 2): latents -> $PRITTI_HOME/models/pritti-<preset>, a complete pipeline.

    jobs/train_dit.py                       the town preset on $PRITTI_HOME/datasets/town
    jobs/train_dit.py smoke                 seconds; makes its own data, LVAE and latents
    jobs/train_dit.py kitti360-xl --dataset DIR --label joint --workers 8
    jobs/train_dit.py demo --start-from town --learning-rate 5e-4 --name more      more steps for released weights

Run it again with the same options to resume. Losses and sampled scenes go to MLflow ($MLFLOW_TRACKING_URI, default
an sqlite file under $PRITTI_HOME).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import tyro

from jobs.support.cli import absolute, home, run

if TYPE_CHECKING:
    from collections.abc import Callable

    from torch import Tensor

    from jobs.support.trainer import TrainingRun


@dataclass(frozen=True)
class Config:
    """Options of a training run; what is left out comes from the preset (models/presets.py)."""

    preset: tyro.conf.Positional[str] = "town"
    """smoke, demo, town, kitti360, kitti360-l, kitti360-xl or av2."""
    dataset: str = ""
    """Dataset directory (default: $PRITTI_HOME/datasets/<the preset's source>)."""
    latents: str = ""
    """Directory with latents.json (default: the dataset directory)."""
    label: Literal["vegetation", "vehicle", "joint", "none"] = "vegetation"
    """What the model is conditioned on."""
    name: str = ""
    """Name of the run (default: dit-<preset>). Another name is another run."""
    output: str = ""
    """Where the trained pipeline goes (default: $PRITTI_HOME/models/pritti-<name or preset>)."""
    workers: int = 1
    """Ray Train workers; with GPUs, one each."""
    start_from: str = ""
    """Begin with the weights of this trained pipeline (a directory, name, models:/NAME/VERSION or MLflow run), not random ones."""
    steps: int | None = None
    batch_size: int | None = None
    """Global batch size over all workers."""
    learning_rate: float | None = None
    final_learning_rate: float | None = None
    """Let the rate fall to this by the last step, as a cosine (default: constant, as in the paper)."""
    warmup_steps: int | None = None
    """Steps in which the rate rises from zero."""
    prediction: Literal["noise", "velocity"] | None = None
    """What the network puts out (default: as the preset says; the paper: noise)."""
    normalise_latents: bool | None = None
    """Give each channel of the latents mean 0 and deviation 1 (default: as the preset says; the paper: no)."""
    timesteps: Literal["even", "middle"] = "even"
    """Noise levels to train on: all alike (the paper), or more often the middle ones, where it is decided what stands where."""
    accumulate: int = 1
    """Cut each worker's batch into this many parts, one after another, where it does not fit memory."""
    precision: str = "auto"
    """fp32, bf16, or auto: bf16 where the GPU has it."""
    compile: bool = False
    """torch.compile the model: worth its minute on a GPU."""
    checkpoint_every: int | None = None
    """Steps between checkpoints (default: a twentieth of the run, at least four)."""
    seed: int = 0


def prepare(config: Config) -> tuple[TrainingRun, Callable[[str], str]]:
    """The run that the options mean, and what makes a pipeline of its results; makes the smoke preset's inputs."""
    from jobs.support.smoke_inputs import smoke_dataset, smoke_latents
    from models.presets import DIT_PRESETS, LVAE_PRESETS, preset
    from pipelines.runtime import storage
    from pipelines.schema.dataset import Dataset

    row = preset(DIT_PRESETS, config.preset)
    smoke = config.preset == "smoke" and not config.dataset
    default = home("datasets", "smoke" if smoke else LVAE_PRESETS[row.lvae].source)
    root = absolute(config.dataset) if config.dataset else default
    if smoke:
        smoke_dataset(root)
        smoke_latents(root)
    dataset = Dataset.open(root)
    latents_root = absolute(config.latents) if config.latents else root
    if not storage.exists(storage.join(latents_root, "latents.json")):
        raise ValueError(f"{latents_root}: no latents.json here; run jobs/encode_latents.py --dataset {root} first")
    latents = storage.read_json(storage.join(latents_root, "latents.json"))
    if not latents["complete"]:
        raise ValueError(f"{latents_root}: latents are incomplete; run jobs/encode_latents.py --dataset {root} again")

    from functools import partial

    from jobs.support.callbacks import SamplingCheck
    from jobs.support.tracking import Tracker
    from jobs.support.trainer import TrainingRun, claim, identity_of, settings_with
    from models.labels import LABELS
    from models.training import Execution, Optimisation
    from pipelines.schema.tables import find_shards
    from pipelines.training.data_loader import LatentReader, Stream
    from pipelines.training.latents import load_lvae, weights_digest

    lvae = load_lvae(latents["lvae"])
    if weights_digest(lvae) != latents["lvae_digest"]:
        raise ValueError(
            f"{latents['lvae']} has changed since {latents_root} was encoded with it; encode anew into another --output"
        )

    name = config.name or f"dit-{config.preset}"
    settings = settings_with(
        Optimisation(
            steps=row.steps,
            learning_rate=row.learning_rate,
            weight_decay=row.weight_decay,
            betas=(0.95, 0.999),  # as in SLEDGE
            grad_clip=row.grad_clip,
            ema_decay=row.ema_decay,
            seed=config.seed,
        ),
        steps=config.steps,
        learning_rate=config.learning_rate,
        final_learning_rate=config.final_learning_rate,
        warmup_steps=config.warmup_steps,
    )
    if config.prediction is not None:
        row = replace(row, prediction=config.prediction)
    if config.normalise_latents is not None:
        row = replace(row, normalise_latents=config.normalise_latents)
    channels, size, _ = latents["shape"]
    architecture = row.architecture() | {
        "channels": channels,
        "size": size,
        "label": config.label,
        "num_labels": len(LABELS[config.label]),
        "layout": dict(lvae.config.layout),
        "shift": latents["channel_mean"] if row.normalise_latents else None,
        "scale": latents["channel_std"] if row.normalise_latents else None,
    }
    start = starting_weights(config.start_from, latents["lvae_digest"], architecture) if config.start_from else None
    architecture |= start.normalisation if start else {}
    execution = Execution(config.accumulate, config.precision, config.compile)
    batch_size = row.batch_size if config.batch_size is None else config.batch_size
    shards = find_shards(root, source=dataset.source, split="train")
    counts = [shard.read("scenes", ["scene_id"]).num_rows for shard in shards]
    identity = identity_of(
        settings,
        stage="dit",
        preset=config.preset,
        batch_size=batch_size,
        label=config.label,
        prediction=row.prediction,
        normalise_latents=row.normalise_latents,
        lvae=latents["lvae_digest"],
        dataset=root,
        **({"start_from": start.digest} if start else {}),
        **({"timesteps": config.timesteps} if config.timesteps != "even" else {}),
    )
    record = claim(name, home("runs"), identity)
    tracker = Tracker.start("pritti-dit", name, identity | {"architecture": row.architecture()}, record)
    training = TrainingRun(
        name=name,
        storage_path=home("runs"),
        build=partial(build, architecture, settings, execution, row.label_dropout, start, config.timesteps),
        stream=Stream(tuple(shards), tuple(counts), batch_size, config.seed),
        reader=LatentReader(latents_root, config.label),
        settings=settings,
        identity=identity,
        tracker=tracker,
        checkpoint_every=config.checkpoint_every or max(4, settings.steps // 20),
        log_every=max(1, min(50, settings.steps // 50)),
        validate=SamplingCheck(root, dataset.source, latents_root, latents["lvae"], config.label),
    )
    return training, partial(complete_pipeline, latents["lvae"], start.sampling if start else {})


def train(config: Config) -> str:
    """Train and return the pipeline's directory."""
    training, complete = prepare(config)
    from jobs.support.trainer import fit
    from pipelines.runtime import storage

    output = absolute(config.output) if config.output else home("models", f"pritti-{config.name or config.preset}")
    fit(training, config.workers, storage.join(output, "dit"))
    return complete(output)


@dataclass(frozen=True)
class Start:
    """Trained weights that a run begins with."""

    digest: str
    normalisation: dict  # of latents, as these weights know them
    sampling: dict  # what their pipeline was published with: noise scaling, existence threshold
    state: dict[str, Tensor]


def starting_weights(model: str, lvae_digest: str, architecture: dict) -> Start:
    """The transformer of a trained pipeline. Raises ValueError if it knows other latents or is built otherwise."""
    from jobs.support.options import pipeline_directory
    from pipelines.generation.sample import load_pipeline
    from pipelines.training.latents import weights_digest

    directory = pipeline_directory(model)
    pipeline = load_pipeline(directory)
    if weights_digest(pipeline.lvae) != lvae_digest:
        raise ValueError(
            f"--start-from {model}: its transformer knows the latents of another layout VAE; "
            f"encode with its own first: jobs/encode_latents.py --lvae {directory}/lvae"
        )
    built = pipeline.dit.config
    for key in ("patch", "depth", "width", "heads", "prediction", "label"):
        if built[key] != architecture[key]:
            raise ValueError(
                f"--start-from {model}: its {key} is {built[key]}, this run's {architecture[key]}; choose them alike"
            )
    normalisation = {"shift": built["shift"], "scale": built["scale"]}
    sampling = {key: pipeline.config[key] for key in ("noise_scaling", "existence_threshold")}
    return Start(weights_digest(pipeline.dit), normalisation, sampling, pipeline.dit.state_dict())


def build(
    architecture: dict, settings, execution, label_dropout: float, start: Start | None, timesteps: str, device, wrap
):
    """The Trainer of stage 2, with the same initial weights on every worker."""
    import torch

    from models.dit import DiT
    from models.training import dit_trainer

    torch.manual_seed(settings.seed)
    model = DiT(**architecture)
    if start:
        model.load_state_dict(start.state)
    return dit_trainer(model, settings, label_dropout, device, wrap, execution, timesteps)


def complete_pipeline(lvae: str, sampling: dict, output: str) -> str:
    """Put the LVAE and the noise schedule beside a trained DiT: `output` is then a PrITTIPipeline directory.

    `sampling` holds its `noise_scaling` and `existence_threshold`, where these are not the paper's.
    """
    import tempfile

    from jobs.support.trainer import publish_directory
    from models.dit import DiT
    from models.pipeline import PrITTIPipeline, scheduler
    from pipelines.runtime import storage
    from pipelines.training.latents import load_lvae

    dit = DiT.from_pretrained(storage.join(output, "dit"), low_cpu_mem_usage=False)
    pipeline = PrITTIPipeline(load_lvae(lvae), dit, scheduler(), **sampling)
    with tempfile.TemporaryDirectory() as directory:
        pipeline.save_pretrained(directory)
        publish_directory(directory, output)
    return output


def main(config: Config) -> None:
    print(f"trained: {train(config)}")


if __name__ == "__main__":
    run(main, Config, description=__doc__)
