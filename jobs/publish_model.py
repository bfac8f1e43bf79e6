#!/usr/bin/env python3
"""A trained and evaluated pipeline -> an entry of the zoo: weights, configuration, card, and a version in MLflow.

    jobs/sample_scenes.py --num-scenes 1000 --run judged --sampler dpm++ --steps 20
    jobs/evaluate_scenes.py --real-split test --run judged --lvae DIR/lvae
    jobs/publish_model.py --name town --evaluation $PRITTI_HOME/evaluations/judged

The card is written from the MLflow runs that trained these weights (for published weights that the training began with,
from what their entry says) and from the evaluation of scenes that they generated; without either, or with those of other
weights, nothing is published. Afterwards jobs take it as --model NAME, its
directory, models:/NAME/VERSION, or the id of its MLflow run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from jobs.support.cli import absolute, home, run
from jobs.support.options import ModelOption, pipeline_directory

if TYPE_CHECKING:
    import torch

    from pipelines.reporting.model_card import Training

SHOWN = 32  # scenes on the card, the first ones
JUDGED = 256  # of which the ones with most faults are shown
FAILURES = 8
CURVES = {"loss": "training loss", "validation_loss": "held-out loss"}


@dataclass(frozen=True)
class Config:
    model: ModelOption = ""
    evaluation: str = ""
    """Directory that jobs/evaluate_scenes.py wrote, with --lvae (default: $PRITTI_HOME/evaluations/latest)."""
    name: str = "town"
    """Of the entry and of the registered model."""
    output: str = ""
    """Where the entry goes (default: $PRITTI_HOME/zoo/<name>)."""
    register: bool = True
    """Also make it a version of a model in MLflow."""


def publish(config: Config) -> list[str]:
    """Write the entry; what --model takes for it: its directory, and if registered models:/NAME/VERSION and the run."""
    import tempfile

    from jobs.support.registry import EXPERIMENT, PIPELINE, registered
    from jobs.support.tracking import Tracker
    from jobs.support.trainer import publish_directory
    from models.labels import LABELS
    from models.pretrained import CHECKSUMS, TRAINING, checksums
    from models.tensors import EXISTENCE_THRESHOLD
    from pipelines.generation.sample import load_pipeline
    from pipelines.reporting.chart import standalone_svg
    from pipelines.reporting.model_card import Card
    from pipelines.runtime import storage
    from pipelines.training.latents import weights_digest

    pipeline = load_pipeline(pipeline_directory(config.model))
    weights = [weights_digest(pipeline.lvae), weights_digest(pipeline.dit)]
    directory = absolute(config.evaluation) if config.evaluation else home("evaluations", "latest")
    about, scores = evaluation_of(directory, weights)
    as_judged = {"existence_threshold": about["sampling"].get("existence_threshold", EXISTENCE_THRESHOLD)}
    if about["sampling"]["sampler"] != "ddpm":
        as_judged["noise_scaling"] = about["sampling"].get("noise_scaling", 1.0)
    pipeline.register_to_config(**as_judged)
    facts = storage.read_json(storage.join(about["real"], "dataset.json"))
    stages = [
        history("pritti-lvae", "Layout VAE", pipeline.lvae),
        history("pritti-dit", "Diffusion transformer", pipeline.dit),
    ]
    for *_, last in stages:
        require_data(last, about["real"], facts, directory)
    trainings = [training for stage in stages for training in stage]
    output = absolute(config.output) if config.output else home("zoo", config.name)
    kind = pipeline.dit.config.label
    with tempfile.TemporaryDirectory() as staging:
        pipeline.save_pretrained(staging)
        forget_paths(staging)
        sums = checksums(staging)
        card = Card(
            config.name,
            "-".join(weights),
            kind,
            LABELS[kind],
            trainings,
            facts,
            about["sampling"],
            about["real_split"],
            scores,
            sums,
        )
        storage.write_text(card.markdown(), f"{staging}/README.md")
        storage.write_json(sums, f"{staging}/{CHECKSUMS}")
        storage.write_json(scores, f"{staging}/metrics.json")
        storage.write_json([training.record(facts["options"]) for training in trainings], f"{staging}/{TRAINING}")
        for training in trainings:
            storage.write_text(standalone_svg(training.chart()), f"{staging}/{training.picture}")
        for name, image in pictures(about).items():
            storage.write_whole(f"{staging}/{name}.png", lambda stream, image=image: stream.write(image))
        publish_directory(staging, output)
        if not config.register:
            return [output]
        tracker = Tracker.start(EXPERIMENT, config.name, {"weights": card.version})
        tracker.artifacts(staging, PIPELINE)
        tracker.finish("FINISHED")
    return [output, registered(config.name, tracker.run_id), tracker.run_id]


def forget_paths(directory: str) -> None:
    """Drop what diffusers keeps of where a model was loaded from: a directory of this machine."""
    from pipelines.runtime import storage

    for path in storage.list_files(directory, ".json"):
        content = storage.read_json(path)
        storage.write_json({key: value for key, value in content.items() if key != "_name_or_path"}, path)


def evaluation_of(directory: str, weights: list[str]) -> tuple[dict, dict]:
    """What was evaluated, and its scores. Raises ValueError if that is missing or of other weights."""
    from pipelines.runtime import storage

    advice = "run jobs/sample_scenes.py and jobs/evaluate_scenes.py --lvae with this model first, and name its --output"
    if not storage.exists(storage.join(directory, "evaluation.json")):
        raise ValueError(f"--evaluation {directory}: no evaluation here; {advice}")
    about, scores = (storage.read_json(storage.join(directory, f"{name}.json")) for name in ("evaluation", "metrics"))
    for part in ("generation", "reconstruction"):
        if part not in scores:
            raise ValueError(f"--evaluation {directory} holds no scores of {part}; {advice}")
    judged = (about["sampling"] or {}).get("weights"), about["lvae_weights"]
    if judged != ("-".join(weights), weights[0]):
        raise ValueError(f"--evaluation {directory} is of other weights ({judged[0]}); {advice}")
    if "num_inference_steps" not in (about["sampling"] or {}):
        raise ValueError(f"--evaluation {directory} is not of scenes that jobs/sample_scenes.py made; {advice}")
    if about["sampling"].get("repair"):
        raise ValueError(f"--evaluation {directory} is of repaired scenes; sample without --repair to judge a model")
    return about, scores


def history(experiment: str, stage: str, model: torch.nn.Module) -> list[Training]:
    """The runs that made a model's weights, the first one first: a run may have begun with another one's.

    Raises ValueError if neither MLflow nor a published entry tells of one of them.
    """
    from dataclasses import replace

    from pipelines.training.latents import weights_digest

    parameters = sum(value.numel() for value in model.parameters())
    runs = [training_of(experiment, stage, weights_digest(model), parameters)]
    while start := runs[0].options.get("start_from"):
        runs.insert(0, training_of(experiment, stage, start, None))  # its network may have been another
    name = experiment.removeprefix("pritti-")
    later = [replace(run, name=f"{name}-{k}", stage=f"{stage}, run {k}") for k, run in enumerate(runs[1:], 2)]
    return [replace(runs[0], name=name), *later]


def training_of(experiment: str, stage: str, digest: str, parameters: int | None) -> Training:
    """The run that made the weights of a digest. Raises ValueError if nothing tells of it."""
    from jobs.support.tracking import Tracker, client, shown, tracking_uri
    from pipelines.reporting.model_card import Training

    uri = tracking_uri()
    api = client(uri)
    known = api.get_experiment_by_name(experiment)
    runs = api.search_runs([known.experiment_id], f"tags.weights = '{digest}'") if known else []
    if not runs:
        if record := recorded(digest):
            return Training(**record | {"stage": stage})
        raise ValueError(
            f"no MLflow run of {experiment} in {shown(uri)} made these weights ({digest}); set MLFLOW_TRACKING_URI"
        )
    found, tracker = runs[0], Tracker(uri, runs[0].info.run_id)
    return Training(
        experiment.removeprefix("pritti-"),
        stage,
        digest,
        parameters,
        int(found.data.tags["steps"]),
        hours_of_steps(tracker, int(found.data.params["batch_size"])),
        {name: value for name, value in found.data.params.items() if name != "architecture"},
        {name: found.data.tags.get(name, "not recorded") for name in ("command", "commit", "machine", "versions")},
        {words: axes(tracker.history(name)) for name, words in CURVES.items()},
    )


def recorded(digest: str) -> dict | None:
    """What a published entry of this machine, or of the package, says of the run that made these weights."""
    from models.pretrained import TRAINING, WEIGHTS
    from pipelines.runtime import storage

    for zoo in (str(WEIGHTS), home("zoo")):
        for path in storage.list_files(zoo, TRAINING):
            for record in storage.read_json(path):
                if record["weights"] == digest:
                    return record
    return None


def require_data(training: Training, real: str, facts: Mapping, evaluation: str) -> None:
    """Raises ValueError where an evaluation is against other data than a training's."""
    same = training.data == facts["options"] if training.data else training.options["dataset"] == real
    if not same:
        raise ValueError(
            f"--evaluation {evaluation} is against {real}, but the {training.stage} was trained on "
            f"{training.data or training.options['dataset']}; run jobs/evaluate_scenes.py with that as --real"
        )


def axes(points: list[tuple[int, float]]) -> tuple[list[int], list[float]]:
    return [step for step, _ in points], [value for _, value in points]


def hours_of_steps(tracker, batch_size: int) -> float:
    """From the logged speeds: what was between sessions, start-ups and validations do not count."""
    last, seconds = 0, 0.0
    for step, speed in tracker.history("scenes_per_second"):
        seconds += (step - last) * batch_size / speed
        last = step
    return seconds / 3600


def pictures(about: Mapping) -> dict[str, bytes]:
    """PNGs of the first scenes of those that were evaluated, and of those with most faults among the first JUDGED."""
    import numpy as np

    from pipelines.metrics.validity import scene_validity, slab_offset_m
    from pipelines.rendering.render import bev_picture, contact_sheet, png
    from pipelines.schema.dataset import Dataset
    from pipelines.schema.tables import read_scenes

    offset_m = slab_offset_m(Dataset.open(about["real"]).spec.surface)
    scenes = list(read_scenes(about["generated"], about["source"], limit=JUDGED))
    faults = np.array([scene_validity(scene, offset_m)[:-1, 0].sum() for scene in scenes])
    worst = [scenes[k] for k in np.argsort(-faults, kind="stable")[:FAILURES]]
    sides = {"samples": (scenes[:SHOWN], 8), "failures": (worst, FAILURES)}
    return {
        name: png(contact_sheet([bev_picture(scene, 192, supersample=2) for scene in chosen], columns))
        for name, (chosen, columns) in sides.items()
    }


def main(config: Config) -> None:
    print("published:", ", ".join(publish(config)))


if __name__ == "__main__":
    run(main, Config, description=__doc__)
