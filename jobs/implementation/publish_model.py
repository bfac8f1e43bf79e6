"""Implementation of jobs/publish_model.py."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from jobs.publish_model import Config
from jobs.support.cli import home_path, resolve_path
from jobs.support.model_directories import find_pipeline_directory
from jobs.support.model_files import publish_directory
from jobs.support.outputs import hold_lease
from jobs.support.registry import EXPERIMENT, PIPELINE, register_version
from jobs.support.tracking import Tracker, find_tracking_uri, hide_credentials, make_client
from models.labels import list_usual_labels
from models.pipeline import PrITTIPipeline
from models.pretrained import CHECKSUMS_NAME, TRAINING_NAME, WEIGHTS, compute_checksums
from models.tensors import EXISTENCE_THRESHOLD
from models.uris import split_name
from pipelines.generation.sample import load_pipeline
from pipelines.metrics.validity import compute_scene_validity
from pipelines.rendering.render import arrange_contact_sheet, encode_png, render_bev
from pipelines.reporting.chart import make_standalone_svg
from pipelines.reporting.model_card import ModelCard, TrainingRecord
from pipelines.runtime import storage
from pipelines.schema.dataset import Dataset
from pipelines.schema.tables import read_scenes
from pipelines.training.latents import digest_weights

SHOWN = 32  # Number of scenes on the card, from the first scene.
JUDGED = 256  # Number of scenes from which the scenes with the most faults are selected.
FAILURES = 8
CURVES = {"loss": "training loss", "validation_loss": "held-out loss"}


def publish(config: Config) -> list[str]:
    """Write the entry of the model zoo and register it in MLflow.

    Returns:
        Values of --model that select the entry: the directory and, for a registered entry, models:/NAME/VERSION and run
        id.
    """
    pipeline = load_pipeline(find_pipeline_directory(config.model))
    weights = [digest_weights(pipeline.lvae), digest_weights(pipeline.dit)]
    directory = resolve_path(config.evaluation, "evaluations", "latest")
    about, scores = read_evaluation(directory, weights)
    as_judged = {"existence_threshold": about["sampling"].get("existence_threshold", EXISTENCE_THRESHOLD)}
    as_judged["constraints"] = about["sampling"].get("constraints", False)
    as_judged["pag_scale"] = about["sampling"].get("pag_scale", 0.0)
    as_judged["pag_drops_label"] = about["sampling"].get("pag_drops_label", False)
    pipeline.use_sampler(about["sampling"]["sampler"])
    as_judged["num_inference_steps"] = about["sampling"]["num_inference_steps"]
    if about["sampling"]["sampler"] != "ddpm":
        as_judged["noise_scaling"] = about["sampling"].get("noise_scaling", 1.0)
    pipeline.register_to_config(**as_judged)
    facts = storage.read_json(storage.join_uri(about["real"], "dataset.json"))
    stages = [
        read_history("pritti-lvae", "Layout VAE", pipeline.lvae),
        read_history("pritti-dit", "Diffusion transformer", pipeline.dit),
    ]
    for *_, last in stages:
        require_data(last, about, facts, directory)
    if pipeline.street_planner is not None:
        stages.append(read_history("pritti-streets", "Street planner", pipeline.street_planner))
    trainings = [training for stage in stages for training in stage]
    output = resolve_path(config.output, "zoo", config.name)
    entry = {"trainings": trainings, "facts": facts, "scores": scores, "about": about}
    with hold_lease(*split_name(output), config.if_busy), tempfile.TemporaryDirectory() as staging:
        version = write_entry(staging, config.name, pipeline, "-".join(weights), **entry)
        publish_directory(staging, output)
        if not config.register:
            return [output]
        tracker = Tracker.start(EXPERIMENT, config.name, {"weights": version})
        tracker.artifacts(staging, PIPELINE)
        tracker.finish("FINISHED")
    return [output, register_version(config.name, tracker.run_id), tracker.run_id]


def write_entry(
    directory: str,
    name: str,
    pipeline: PrITTIPipeline,
    version: str,
    trainings: Sequence[TrainingRecord],
    facts: Mapping,
    scores: Mapping,
    about: Mapping,
) -> str:
    """Write weights, card, checksums, scores and pictures of an entry; return the card's version."""
    pipeline.save_pretrained(directory)
    sums, kind = compute_checksums(directory), pipeline.dit.config.label
    card = ModelCard(
        name,
        version,
        kind,
        list_usual_labels(kind),
        trainings,
        facts,
        about["sampling"],
        about["real_split"],
        scores,
        sums,
    )
    storage.write_text(card.markdown(), f"{directory}/README.md")
    storage.write_json(sums, f"{directory}/{CHECKSUMS_NAME}")
    storage.write_json(scores, f"{directory}/metrics.json")
    storage.write_json([training.record(facts["options"]) for training in trainings], f"{directory}/{TRAINING_NAME}")
    for training in trainings:
        storage.write_text(make_standalone_svg(training.chart()), f"{directory}/{training.picture}")
    for picture, image in draw_examples(about).items():
        storage.write_whole(f"{directory}/{picture}.png", lambda stream, image=image: stream.write(image))
    return card.version


def read_evaluation(directory: str, weights: list[str]) -> tuple[dict, dict]:
    """Return the evaluated inputs and the scores.

    Raises:
        ValueError: There is no complete evaluation, or the evaluation belongs to other weights.
    """
    advice = (
        "run jobs/sample_scenes.py and jobs/evaluate_scenes.py --lvae with this model, "
        "and pass the output directory of the evaluation"
    )
    if not storage.exists(storage.join_uri(directory, "evaluation.json")):
        raise ValueError(f"--evaluation {directory}: no evaluation here; {advice}")
    about, scores = (
        storage.read_json(storage.join_uri(directory, f"{name}.json")) for name in ("evaluation", "metrics")
    )
    for part in ("generation", "reconstruction"):
        if part not in scores:
            raise ValueError(f"--evaluation {directory} contains no {part} scores; {advice}")
    judged = (about["sampling"] or {}).get("weights"), about["lvae_weights"]
    if judged != ("-".join(weights), weights[0]):
        raise ValueError(f"--evaluation {directory} belongs to other weights ({judged[0]}); {advice}")
    if "num_inference_steps" not in (about["sampling"] or {}):
        raise ValueError(f"--evaluation {directory} does not evaluate scenes of jobs/sample_scenes.py; {advice}")
    if about["sampling"].get("repair"):
        raise ValueError(
            f"--evaluation {directory} evaluates repaired scenes; evaluate scenes that were sampled without --repair"
        )
    return about, scores


def read_history(experiment: str, stage: str, model: torch.nn.Module) -> list[TrainingRecord]:
    """Return the runs that trained a model's weights, oldest first.

        A run may start from the weights of an earlier run.

    Raises:
        ValueError: Neither MLflow nor a published entry has a record of one of the runs.
    """
    parameters = sum(value.numel() for value in model.parameters())
    runs = [find_training(experiment, stage, digest_weights(model), parameters)]
    while start := runs[0].options.get("start_from"):
        runs.insert(0, find_training(experiment, stage, start, None))  # None: the earlier network may have another size
    name = experiment.removeprefix("pritti-")
    later = [replace(run, name=f"{name}-{k}", stage=f"{stage}, run {k}") for k, run in enumerate(runs[1:], 2)]
    return [replace(runs[0], name=name), *later]


def find_training(experiment: str, stage: str, digest: str, parameters: int | None) -> TrainingRecord:
    """Return the run that trained the weights with the given digest.

    Raises:
        ValueError: Neither MLflow nor a published entry has a record of this run.
    """
    uri = find_tracking_uri()
    api = make_client(uri)
    known = api.get_experiment_by_name(experiment)
    runs = api.search_runs([known.experiment_id], f"tags.weights = '{digest}'") if known else []
    if not runs:
        if record := read_published_training(digest):
            return TrainingRecord(**{**record, "stage": stage})
        raise ValueError(
            f"no MLflow run of {experiment} in {hide_credentials(uri)} trained these weights ({digest}); "
            "set MLFLOW_TRACKING_URI"
        )
    found, tracker = runs[0], Tracker(uri, runs[0].info.run_id)
    return TrainingRecord(
        experiment.removeprefix("pritti-"),
        stage,
        digest,
        parameters,
        int(found.data.tags["steps"]),
        compute_hours(tracker, int(found.data.params["batch_size"])),
        {name: value for name, value in found.data.params.items() if name != "architecture"},
        {name: found.data.tags.get(name, "not recorded") for name in ("command", "commit", "machine", "versions")},
        {words: convert_axes(tracker.history(name)) for name, words in CURVES.items()},
    )


def read_published_training(digest: str) -> dict[str, Any] | None:
    """Return the record of a training run from a published entry of the package or of this machine."""
    for zoo in (str(WEIGHTS), home_path("zoo")):
        for path in storage.list_files(zoo, TRAINING_NAME):
            for record in storage.read_json(path):
                if record["weights"] == digest:
                    return record
    return None


def require_data(training: TrainingRecord, about: Mapping, facts: Mapping, evaluation: str) -> None:
    """Check that an evaluation used the data of a training run.

    If the evaluation used the test split, a recorded run may have another number of training scenes, because this
    number does not change the held-out scenes.

    Raises:
        ValueError: The evaluation used other data.
    """
    real = about["real"]
    if training.data:
        ignored = {"num_train": None} if about["real_split"] == "test" else {}
        same = {**training.data, **ignored} == {**facts["options"], **ignored}
    else:
        same = training.options["dataset"] == real
    if not same:
        raise ValueError(
            f"--evaluation {evaluation} uses the real scenes of {real}, but the {training.stage} was trained on "
            f"{training.data or training.options['dataset']}; run jobs/evaluate_scenes.py with this dataset as --real"
        )


def convert_axes(points: list[tuple[int, float]]) -> tuple[list[int], list[float]]:
    return [step for step, _ in points], [value for _, value in points]


def compute_hours(tracker, batch_size: int) -> float:
    """Return the training time in hours from the logged speeds, without the time for start-up, validation and
    pauses."""
    last, seconds = 0, 0.0
    for step, speed in tracker.history("scenes_per_second"):
        seconds += (step - last) * batch_size / speed
        last = step
    return seconds / 3600


def draw_examples(about: Mapping) -> dict[str, bytes]:
    """Return PNG pictures of the first SHOWN scenes, and of the worst scenes among the first JUDGED scenes."""
    offset_m = Dataset.open(about["real"]).spec.slab_offset_m
    scenes = list(read_scenes(about["generated"], about["source"], limit=JUDGED))
    faults = np.array([compute_scene_validity(scene, offset_m)[:-1, 0].sum() for scene in scenes])
    worst = [scenes[k] for k in np.argsort(-faults, kind="stable")[:FAILURES]]
    sides = {"samples": (scenes[:SHOWN], 8), "failures": (worst, FAILURES)}
    return {
        name: encode_png(arrange_contact_sheet([render_bev(scene, 192, supersample=2) for scene in chosen], columns))
        for name, (chosen, columns) in sides.items()
    }


def main(config: Config) -> None:
    print("published:", ", ".join(publish(config)))
