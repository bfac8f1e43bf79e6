"""Implementation of jobs/ablate_lvae.py."""

from __future__ import annotations

import io
import os
import platform
import re
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from statistics import median

import numpy as np
import pyarrow as pa
import torch

from jobs.ablate_lvae import Augmentation, Branches, Decoders, Detr, Encoding, Ground
from jobs.implementation.train_lvae import prepare
from jobs.support.cli import resolve_path
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from jobs.support.terminal import print_table
from jobs.support.tracking import Tracker
from jobs.support.trainer import TrainingRun, fit
from jobs.train_lvae import Config
from models.batch import LayoutBatch
from models.lvae import LayoutVAE
from models.presets import LVAE_PRESETS, find_preset
from models.studies.orientation_study import StudyConfig
from models.tensors import make_layout_batch
from models.training import count_flops
from models.vae.config import override_options
from pipelines.evaluation import ablation
from pipelines.evaluation.ablation import Variant
from pipelines.evaluation.reconstruction import evaluate_reconstruction, score_ceiling_and_control
from pipelines.reporting.chart import Chart, make_standalone_svg
from pipelines.reporting.report import Table
from pipelines.runtime import storage
from pipelines.schema.dataset import Dataset
from pipelines.schema.run_guard import guard_options
from pipelines.schema.scene_subset import SceneSubset
from pipelines.training.latents import load_lvae

TIMING_STEPS = 60
# Options that may change between runs of a study.
NOT_RECORDED = (
    "num_seeds",
    "only_variants",
    "num_workers",
    "gpus",
    "wait_for_resources_s",
    "output",
    "if_busy",
    "log_format",
)
RECORDED_AS = {"max_scenes": "limit", "num_checkpoints": "checks"}  # keys in study.json


# ---------------------------------------------------------------------------------------------------- encoding


def compare_encodings(config: Encoding) -> str:
    """Train missing trials, write the tables, figures and page, and return the directory."""
    output = resolve_path(config.output, "ablations", "encoding")
    settings = StudyConfig(config.epochs, config.batch_size, config.learning_rate)
    trials = plan_trials(config)
    guard_study(output, asdict(settings) | {"test": config.num_test_boxes})
    record = storage.join_uri(output, "mlflow.json")
    with (
        hold_output(output, "ablation", config),
        Tracker.start("pritti-ablation", "encoding", asdict(config), record).end_on_error() as tracker,
    ):
        with JobProgress() as bar:
            shown = bar.add_task("train autoencoders", total=len(trials))
            scores = ablation.reconstruct_boxes(
                trials,
                storage.join_uri(output, "trials"),
                settings,
                config.num_test_boxes,
                config.max_concurrent_trials,
                lambda: bar.advance(shown),
            )
            bar.add_task("measure yaw errors", total=None)
            losses = ablation.compute_yaw_losses(config.num_noisy_boxes)
        rows = ablation.average_by_size(scores)
        for row in rows:
            name = f"{row['boxes']}.{row['numbers']}.{row['encoding']}.iou3d"
            tracker.metrics({name: row["iou3d_mean"]}, row["training_size"])
        notes = [
            f"{config.num_seeds} seeds, {config.epochs} epochs, batches of {config.batch_size}, learning rate "
            f"{config.learning_rate:g}, {config.num_test_boxes} test boxes, at most "
            f"{max(r['parameters'] for r in scores):,} parameters; the networks of all encodings differ only in "
            "their first and last layer.",
            describe_machine(),
        ]
        write_encoding_report(config, output, rows, losses, notes, tracker)
        return output


def plan_trials(config: Encoding) -> list:
    """Return the trials of all three kinds of boxes."""
    trials = ablation.list_trials("vehicle", config.train_sizes, config.num_seeds)
    if config.yaw_only_train_sizes:
        trials += ablation.list_trials("vehicle", config.yaw_only_train_sizes, config.num_seeds, "varying")
    if config.any_footprint_train_sizes:
        trials += ablation.list_trials("any", config.any_footprint_train_sizes, config.num_seeds)
    return trials


def write_encoding_report(
    config: Encoding, output: str, rows: list[dict], losses: list[dict], notes: list[str], tracker: Tracker
) -> None:
    """Write tables, figures and the page of the encoding study."""
    table, footprints, angles = (
        ablation.build_encoding_table(rows),
        ablation.build_share_table(rows),
        ablation.build_yaw_table(losses),
    )
    figure, cost = ablation.draw_size_chart(rows, "vehicle"), ablation.draw_yaw_chart(losses)
    charts = [figure, cost]
    if config.yaw_only_train_sizes:
        charts.append(ablation.draw_size_chart(rows, "vehicle", "varying"))
    if config.any_footprint_train_sizes:
        charts.append(ablation.draw_share_chart(rows, "any", max(config.any_footprint_train_sizes)))
    tables = [table, *([footprints] if footprints else []), angles]
    write_tables(output, "encodings", rows, tables[:-1], figure)
    write_tables(output, "yaw_loss", losses, [angles], cost)
    html = ablation.render_page(
        "Encodings of a box", "Reconstruction with Cholesky, quaternion and octahedral encodings", tables, charts, notes
    )
    write_page(output, html, tables, tracker)


# ---------------------------------------------------------------------------------------------------- variants


def compare_variants(config: Branches) -> str:
    """Train and score missing variants, write the table, curves and page, and return the directory."""
    output = resolve_path(config.output, "ablations", config.name)
    if config.minutes <= 0 or config.num_seeds < 1:
        raise ValueError(f"--minutes is {config.minutes}, --num-seeds is {config.num_seeds}: both must be more than 0")
    if config.max_scenes is not None and config.max_scenes < 2:
        raise ValueError(
            f"--max-scenes is {config.max_scenes}, expected 2 or more: scenes are also decoded from latents of others"
        )
    find_preset(LVAE_PRESETS, config.preset)
    chosen = select_variants(config)
    guard_study(output, {RECORDED_AS.get(k, k): v for k, v in asdict(config).items() if k not in NOT_RECORDED})
    record = storage.join_uri(output, "mlflow.json")
    with (
        hold_output(output, "ablation", config, training=True),
        Tracker.start("pritti-ablation", config.name, asdict(config), record).end_on_error() as tracker,
    ):
        scores = []
        for seed in range(config.num_seeds):
            for variant in chosen:
                path = storage.join_uri(output, "runs", f"{make_slug(variant)}-seed{seed}.json")
                if not storage.exists(path):
                    storage.write_json(train_variant(config, variant, seed, output), path)
                scores.append(storage.read_json(path))
                require_same_scenes(scores[-1], select_held_out(config, scores[-1]["dataset"]))
                kept = {f"{make_slug(variant)}.{name}": scores[-1].get(name) for name in ablation.MEASURES}
                tracker.metrics({name: value for name, value in kept.items() if value is not None}, seed)
        rows, curves = ablation.group_by_variant(scores), ablation.draw_curve_chart(scores)
        table = ablation.build_variant_table(rows, score_held_out(config, scores[0]["dataset"], output))
        write_tables(output, config.name, rows, [table], curves)
        is_timed = is_at_equal_time(config) and not config.steps
        equal = "the same training time" if is_timed else "the same number of steps"
        how = [f"Preset {config.preset}, dataset {scores[0]['dataset']}, {equal} for all variants.", describe_machine()]
        html = ablation.render_page("Ablations of the layout VAE", config.name, [table], [curves], how)
        write_page(output, html, [table], tracker)
        return output


def select_held_out(config: Branches, root: str) -> SceneSubset:
    """Return the held-out scenes of a dataset that a study scores."""
    return SceneSubset(root, Dataset.open(root).source, "test", config.max_scenes)


def require_same_scenes(scores: dict, selection: SceneSubset) -> None:
    """Check that the scores of a variant describe the present scenes.

    Raises:
        ValueError: The held-out scenes were replaced after the scores were written.
    """
    recorded = scores.get("held_out_scenes")  # Missing in records of earlier versions.
    if recorded and recorded != selection.fingerprint():
        raise ValueError(
            f"the held-out scenes of {selection.root} have changed since {scores['variant']!r} was scored; "
            "use another --output (and another --name)"
        )


def score_held_out(config: Branches, root: str, output: str) -> dict[str, dict]:
    """Return the scores of the ceiling and the control on the held-out scenes of a dataset."""
    spec = Dataset.open(root).spec.with_resolution(find_preset(LVAE_PRESETS, config.preset).raster_px)
    return score_ceiling_and_control(select_held_out(config, root), spec, storage.join_uri(output, "sets"))


def select_variants(config: Branches) -> dict[str, Variant]:
    """Return the variants of --only-variants by name.

    Raises:
        ValueError: The study has no variant of that name.
    """
    studies = {
        Branches: ablation.BRANCH_VARIANTS,
        Decoders: ablation.DECODER_VARIANTS,
        Detr: ablation.DETR_VARIANTS,
        Ground: ablation.GROUND_VARIANTS,
        Augmentation: ablation.AUGMENTATION_VARIANTS,
    }
    known = studies[type(config)]
    if unknown := set(config.only_variants) - set(known):
        raise ValueError(f"--only-variants {sorted(unknown)}: expected some of {list(known)}")
    return {
        name: variant for name, variant in known.items() if not config.only_variants or name in config.only_variants
    }


def is_at_equal_time(config: Branches) -> bool:
    """Return True if the variants train for the same time, and False if they train for the same number of steps."""
    return isinstance(config, Decoders | Detr | Ground)


def make_slug(variant: str) -> str:
    """Return a variant's name in a form that is valid in file names and MLflow metric names."""
    return re.sub(r"\W+", "-", variant.replace("'", ""))


def prepare_variant(config: Branches, variant: str, name: str, seed: int, steps: int) -> TrainingRun:
    """Return the training run of the preset with the architecture and options of a variant."""
    switched = select_variants(config)[variant]
    training = prepare(
        Config(
            preset=config.preset,
            dataset=config.dataset,
            name=name,
            steps=steps,
            batch_size=config.batch_size,
            seed=seed,
            checkpoint_every=max(1, steps // config.num_checkpoints),
            **dict(switched.options),
        )
    )
    architecture, *rest = training.build.args
    return replace(
        training, build=partial(training.build.func, override_options(architecture, switched.architecture), *rest)
    )


def train_variant(config: Branches, variant: str, seed: int, output: str) -> dict:
    """Train one variant with one seed, reconstruct the held-out scenes, and return its scores."""
    timed = variant if is_at_equal_time(config) else next(iter(select_variants(replace(config, only_variants=()))))
    steps = config.steps or measure_steps(config, timed, output)
    name = f"{config.name}-{make_slug(variant)}-seed{seed}"
    training = prepare_variant(config, variant, name, seed, steps)
    model = fit(training, config.num_workers, storage.join_uri(output, "models", f"{make_slug(variant)}-seed{seed}"))
    seconds = sum_training_seconds(training.tracker.history("scenes_per_second"), training.stream.batch_size)
    root = training.identity["dataset"]
    records = storage.join_uri(output, "reconstructed", f"{make_slug(variant)}-seed{seed}")
    selection = select_held_out(config, root)
    reconstruction = evaluate_reconstruction(selection, model, records).scores
    described = {"variant": variant, "seed": seed, "steps": steps, "dataset": root}
    described |= {"held_out_scenes": selection.fingerprint()}
    trained, example = load_lvae(model), training.stream.shards[0].scenes([0])
    described |= {"parameters": trained.num_parameters(), "training_seconds": seconds}
    described |= {"gflops": count_gflops(trained, make_layout_batch(example, trained.spec))}
    described |= {"curve": training.tracker.history("validation_ap3d"), "scenes": reconstruction["scenes"]}
    scores = dict(reconstruction)
    if trained.config["branches"] != "ground":
        scores |= ablation.measure_accuracy(trained, selection)
    return described | ablation.select_measures(select_variants(config)[variant], scores)


def sum_training_seconds(rates: Sequence[tuple[int, float]], batch_size: int) -> float:
    """Return the time of all training steps (s), also of a run that was interrupted and resumed.

    Args:
        rates: Step and scenes per second since the entry before.
        batch_size: Samples per step.
    """
    steps = np.diff([0, *(step for step, _ in rates)])
    return float(sum(steps * batch_size / np.array([rate for _, rate in rates])))


def count_gflops(model: LayoutVAE, batch: LayoutBatch) -> float:
    """Return the number of floating-point operations that encode and decode a batch, divided by 1e9."""
    with torch.no_grad():
        return count_flops(lambda: model.decode(model.encode(batch).mean)) / 1e9


def measure_steps(config: Branches, variant: str, output: str) -> int:
    """Return the number of steps that a variant completes in --minutes.

    The speed is measured once and then read from timing-<variant>.json.
    """
    record = storage.join_uri(output, f"timing-{make_slug(variant)}.json")
    if not storage.exists(record):
        name = f"timing-{make_slug(variant)}"
        training = prepare_variant(config, variant, f"{config.name}-{name}", 0, TIMING_STEPS)
        training = replace(training, validate=None, log_every=1)
        fit(training, config.num_workers, storage.join_uri(output, "models", name))
        rates = [value for _, value in training.tracker.history("scenes_per_second")]
        # The first half is skipped, because the first steps are slow.
        per_second = median(rates[len(rates) // 2 :]) / training.stream.batch_size
        storage.write_json(
            {"steps_per_second": per_second, "steps": max(1, int(60 * config.minutes * per_second))}, record
        )
    return storage.read_json(record)["steps"]


# ------------------------------------------------------------------------------------------------- both


def guard_study(output: str, options: dict) -> None:
    """Bind a directory to one set of options.

    Raises:
        ValueError: The directory holds trials with other options.
    """
    records = ("/study.json", "/mlflow.json")
    guard_options(
        storage.join_uri(output, "study.json"),
        options,
        is_in_use=lambda: any(not path.endswith(records) for path in storage.list_files(output, ".json")),
        discard=lambda: None,
        describe=lambda difference: (
            f"{output} holds a study with {difference}; "
            "use the same options to resume, or another --output for a new study (and another --name, if it has one)"
        ),
    )


def write_tables(
    output: str, name: str, rows: list[dict], tables: Sequence[Table], figure: Chart | None = None
) -> None:
    """Write all rows to NAME.json and NAME.parquet, the tables to NAME.txt, and the figure to NAME.svg."""
    storage.write_json({"machine": describe_machine(), "rows": rows}, storage.join_uri(output, f"{name}.json"))
    storage.write_parquet(pa.Table.from_pylist(rows), storage.join_uri(output, f"{name}.parquet"))
    text = io.StringIO()
    for table in tables:
        print_table(table, text)
    files = {"txt": text.getvalue()} | ({"svg": make_standalone_svg(figure)} if figure else {})
    for kind, content in files.items():
        path = storage.join_uri(output, f"{name}.{kind}")
        storage.write_text(content, path)


def write_page(output: str, html: str, tables: Sequence[Table], tracker: Tracker) -> None:
    """Write the page, log it to MLflow, and print the tables."""
    path = storage.join_uri(output, "report.html")
    storage.write_text(html, path)
    tracker.client.log_text(tracker.run_id, html, "report.html")
    tracker.finish("FINISHED")
    for table in tables:
        print_table(table)


def describe_machine() -> str:
    """Return a description of machine and versions in one line."""
    return f"{platform.machine()}, {os.cpu_count()} CPUs, Python {platform.python_version()}, torch {torch.__version__}"


def main(config: Encoding | Branches) -> None:
    print(compare_encodings(config) if isinstance(config, Encoding) else compare_variants(config))
