#!/usr/bin/env python3
"""The paper's ablations of stage 1, each with a table (text, JSON, Parquet), figures (SVG) and a page (HTML).

    jobs/ablate_lvae.py encoding            Cholesky against quaternion against octahedral, on synthetic boxes
    jobs/ablate_lvae.py branches            without latent split, objects or ground, on $PRITTI_HOME/datasets/town
    jobs/ablate_lvae.py decoders            primitives read off cells against the paper's DETR, at equal time
    jobs/ablate_lvae.py ground              how small the ground branch can be, at equal time
    jobs/ablate_lvae.py augmentation        training scenes mirrored and moved
    jobs/ablate_lvae.py branches --dataset DIR --minutes 60 --seeds 5

Run it again with the same options to go on: finished trials are kept. Scores also go to MLflow.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from jobs.support.cli import absolute, home, print_table, run, start_ray

if TYPE_CHECKING:
    from jobs.support.tracking import Tracker
    from jobs.support.trainer import TrainingRun
    from models.batch import LayoutBatch
    from models.lvae import LayoutVAE
    from pipelines.evaluation.ablation import Variant
    from pipelines.reporting.chart import Chart
    from pipelines.reporting.report import Table

TIMING_STEPS = 60


@dataclass(frozen=True)
class Encoding:
    """How well a small object autoencoder rebuilds a box, by the numbers in which the box is written."""

    sizes: tuple[int, ...] = (1200, 2500, 5000, 10_000)
    """Training sizes of the paper's boxes: vehicles. Sets of a seed are nested."""
    any_sizes: tuple[int, ...] = (5000,)
    """Training sizes of boxes of any footprint up to square ones, where the scatter matrix has no yaw."""
    moving_sizes: tuple[int, ...] = (1200, 2500)
    """Training sizes of vehicles of which only those numbers are regressed that change as a box yaws."""
    seeds: int = 5
    epochs: int = 20
    batch_size: int = 32
    learning_rate: float = 5e-4
    test: int = 2000
    """Boxes of the shared test set."""
    noisy: int = 1000
    """Boxes per footprint and noise in the table of what the angle costs."""
    parallel: int | None = None
    """Trials at a time (default: one per CPU)."""
    output: str = ""
    """Where everything goes (default: $PRITTI_HOME/ablations/encoding)."""


@dataclass(frozen=True)
class Branches:
    """The layout VAE whole, without latent split, without objects and without ground: equally many steps each."""

    preset: tyro.conf.Positional[str] = "town"
    """smoke, demo, town, kitti360, kitti360-light or av2."""
    dataset: str = ""
    """Dataset directory (default: $PRITTI_HOME/datasets/<the preset's source>)."""
    minutes: float = 10.0
    """As many steps as fit so much time on this machine, measured once: of the first variant for studies at equal
    steps, of each for studies at equal time."""
    steps: int | None = None
    """So many steps instead."""
    seeds: int = 3
    """Every variant is trained with seed 0, then every variant with seed 1, and so on."""
    only: tuple[str, ...] = ()
    """Train and show only these variants, by name; the others can join later."""
    batch_size: int | None = None
    workers: int = 1
    """Ray Train workers."""
    limit: int | None = None
    """Score at most so many held-out scenes."""
    checks: int = 4
    """So many checkpoints and looks at held-out scenes per training: the points of the curves."""
    name: str = "branches"
    """Of the runs. Another name is another study."""
    output: str = ""
    """Where everything goes (default: $PRITTI_HOME/ablations/<name>)."""


@dataclass(frozen=True)
class Decoders(Branches):
    """Cells against the paper's DETR decoder, with and without the shortcuts of ground and objects: equally long each."""

    preset: tyro.conf.Positional[str] = "demo"
    """smoke, demo, town, kitti360, kitti360-light or av2."""
    checks: int = 12
    """So many checkpoints and looks at held-out scenes per training: the points of the curves."""
    name: str = "decoders"
    """Of the runs. Another name is another study."""


@dataclass(frozen=True)
class Ground(Branches):
    """The ground branch alone, from the paper's networks down to a hundredth of them: equally long each."""

    checks: int = 8
    """So many checkpoints and looks at held-out scenes per training: the points of the curves."""
    name: str = "ground"
    """Of the runs. Another name is another study."""


@dataclass(frozen=True)
class Augmentation(Branches):
    """Scenes mirrored, seen from a moved vehicle, or both: equally many steps each. Shows most on few training scenes."""

    name: str = "augmentation"
    """Of the runs. Another name is another study."""


Config = (
    Annotated[Encoding, tyro.conf.subcommand("encoding")]
    | Annotated[Branches, tyro.conf.subcommand("branches")]
    | Annotated[Decoders, tyro.conf.subcommand("decoders")]
    | Annotated[Ground, tyro.conf.subcommand("ground")]
    | Annotated[Augmentation, tyro.conf.subcommand("augmentation")]
)


# ---------------------------------------------------------------------------------------------------- encoding


def compare_encodings(config: Encoding) -> str:
    """Train what is missing, write the tables, figures and page, and return the directory."""
    from rich.progress import Progress

    from jobs.support.tracking import Tracker
    from models.studies.orientation_study import Settings
    from pipelines.evaluation import ablation
    from pipelines.runtime import storage

    output = absolute(config.output) if config.output else home("ablations", "encoding")
    settings = Settings(config.epochs, config.batch_size, config.learning_rate)
    wanted = ablation.trials("vehicle", config.sizes, config.seeds)
    if config.moving_sizes:
        wanted += ablation.trials("vehicle", config.moving_sizes, config.seeds, "moving")
    if config.any_sizes:
        wanted += ablation.trials("any", config.any_sizes, config.seeds)
    claim(output, asdict(settings) | {"test": config.test})
    start_ray()
    tracker = Tracker.start("pritti-ablation", "encoding", asdict(config), storage.join(output, "mlflow.json"))
    with Progress() as bar:
        shown = bar.add_task("train autoencoders", total=len(wanted))
        scores = ablation.rebuild_boxes(
            wanted,
            storage.join(output, "trials"),
            settings,
            config.test,
            config.parallel,
            lambda: bar.advance(shown),
        )
        bar.add_task("disturb numbers", total=None)
        lost = ablation.yaw_losses(config.noisy)
    rows = ablation.by_size(scores)
    for row in rows:
        name = f"{row['boxes']}.{row['numbers']}.{row['encoding']}.iou3d"
        tracker.metrics({name: row["iou3d_mean"]}, row["training_size"])
    table, footprints, angles = ablation.encoding_table(rows), ablation.share_table(rows), ablation.yaw_table(lost)
    figure, cost = ablation.size_chart(rows, "vehicle"), ablation.yaw_chart(lost)
    charts = [figure, cost]
    if config.moving_sizes:
        charts.append(ablation.size_chart(rows, "vehicle", "moving"))
    if config.any_sizes:
        charts.append(ablation.share_chart(rows, "any", max(config.any_sizes)))
    tables = [table, *([footprints] if footprints else []), angles]
    write_tables(output, "encodings", rows, tables[:-1], figure)
    write_tables(output, "yaw_loss", lost, [angles], cost)
    how = [
        f"{config.seeds} seeds, {config.epochs} epochs, batches of {config.batch_size}, learning rate "
        f"{config.learning_rate:g}, {config.test} test boxes, at most {max(r['parameters'] for r in scores):,} parameters; "
        "the same network for every encoding but for its first and last layer.",
        machine(),
    ]
    html = ablation.page("Encodings of a box", "Cholesky, quaternion and octahedral, rebuilt", tables, charts, how)
    publish(output, html, tables, tracker)
    return output


# ---------------------------------------------------------------------------------------------------- variants


def compare_variants(config: Branches) -> str:
    """Train and score what is missing, write the table, curves and page, and return the directory."""
    from jobs.support.tracking import Tracker
    from models.presets import LVAE_PRESETS, preset
    from pipelines.evaluation import ablation
    from pipelines.runtime import storage

    output = absolute(config.output) if config.output else home("ablations", config.name)
    if config.minutes <= 0 or config.seeds < 1:
        raise ValueError(f"--minutes is {config.minutes}, --seeds {config.seeds}: expected more than 0")
    preset(LVAE_PRESETS, config.preset)
    chosen = variants(config)
    options = {k: v for k, v in asdict(config).items() if k not in ("seeds", "only", "workers", "output")}
    claim(output, options)
    start_ray()
    tracker = Tracker.start("pritti-ablation", config.name, asdict(config), storage.join(output, "mlflow.json"))
    scores = []
    for seed in range(config.seeds):
        for variant in chosen:
            path = storage.join(output, "runs", f"{slug(variant)}-seed{seed}.json")
            if not storage.exists(path):
                storage.write_json(train_variant(config, variant, seed, output), path)
            scores.append(storage.read_json(path))
            kept = {f"{slug(variant)}.{name}": scores[-1][name] for name in ablation.MEASURES}
            tracker.metrics({name: value for name, value in kept.items() if value is not None}, seed)
    rows, curves = ablation.by_variant(scores), ablation.curve_chart(scores)
    table = ablation.variant_table(rows)
    write_tables(output, config.name, rows, [table], curves)
    equal = "equal time" if at_equal_time(config) and not config.steps else "equally many steps"
    how = [f"Preset {config.preset}, dataset {scores[0]['dataset']}, {equal} for all.", machine()]
    html = ablation.page("Ablations of the layout VAE", config.name, [table], [curves], how)
    publish(output, html, [table], tracker)
    return output


def variants(config: Branches) -> dict[str, Variant]:
    """By name, those of `--only`. Raises ValueError for a name that the study lacks."""
    from pipelines.evaluation import ablation

    studies = {
        Branches: ablation.BRANCHES,
        Decoders: ablation.DECODERS,
        Ground: ablation.GROUND,
        Augmentation: ablation.AUGMENTATIONS,
    }
    known = studies[type(config)]
    if unknown := set(config.only) - set(known):
        raise ValueError(f"--only {sorted(unknown)}: expected some of {list(known)}")
    return {name: variant for name, variant in known.items() if not config.only or name in config.only}


def at_equal_time(config: Branches) -> bool:
    return isinstance(config, Decoders | Ground)


def slug(variant: str) -> str:
    """A variant's name as part of a file's or an MLflow metric's."""
    return re.sub(r"\W+", "-", variant.replace("'", ""))


def prepare_variant(config: Branches, variant: str, name: str, seed: int, steps: int) -> TrainingRun:
    """`train_lvae`'s run of the preset, with the switches of a variant in its architecture."""
    from dataclasses import replace
    from functools import partial

    from jobs.train_lvae import Config, prepare

    switched = variants(config)[variant]
    training = prepare(
        Config(
            preset=config.preset,
            dataset=config.dataset,
            name=name,
            steps=steps,
            batch_size=config.batch_size,
            seed=seed,
            checkpoint_every=max(1, steps // config.checks),
            **switched.options,
        )
    )
    architecture, *rest = training.build.args
    return replace(training, build=partial(training.build.func, architecture | switched.architecture, *rest))


def train_variant(config: Branches, variant: str, seed: int, output: str) -> dict:
    """Train one variant with one seed, rebuild the held-out scenes, and return its scores."""
    import time
    from dataclasses import replace

    from jobs.support.trainer import fit
    from models.tensors import layout_batch
    from pipelines.evaluation import ablation
    from pipelines.evaluation.reconstruction import rebuild
    from pipelines.runtime import storage
    from pipelines.schema.scene_subset import Selection
    from pipelines.training.latents import load_lvae

    timed = variant if at_equal_time(config) else next(iter(variants(replace(config, only=()))))
    steps = config.steps or affordable_steps(config, timed, output)
    name = f"{config.name}-{slug(variant)}-seed{seed}"
    training, started = prepare_variant(config, variant, name, seed, steps), time.perf_counter()
    model = fit(training, config.workers, storage.join(output, "models", f"{slug(variant)}-seed{seed}"))
    seconds = time.perf_counter() - started
    root = training.identity["dataset"]
    source = training.stream.shards[0].source
    reconstruction = rebuild(Selection(root, source, "test", config.limit), model).scores
    described = {"variant": variant, "seed": seed, "steps": steps, "dataset": root}
    trained, example = load_lvae(model), training.stream.shards[0].scenes([0])
    described |= {"parameters": trained.num_parameters(), "training_seconds": seconds}
    described |= {"gflops": giga_operations(trained, layout_batch(example, trained.spec))}
    described |= {"curve": training.tracker.history("validation_ap3d"), "scenes": reconstruction["scenes"]}
    return described | ablation.measured(variants(config)[variant], reconstruction)


def giga_operations(model: LayoutVAE, batch: LayoutBatch) -> float:
    """1e9 floating-point operations of encoding and decoding a batch, as torch counts them."""
    import torch
    from torch.utils.flop_counter import FlopCounterMode

    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        model.decode(model.encode(batch).mean)
    return counter.get_total_flops() / 1e9


def affordable_steps(config: Branches, variant: str, output: str) -> int:
    """Steps that a variant makes in `config.minutes`: timed once, then read from the study's timing-<variant>.json."""
    from dataclasses import replace
    from statistics import median

    from jobs.support.trainer import fit
    from pipelines.runtime import storage

    record = storage.join(output, f"timing-{slug(variant)}.json")
    if not storage.exists(record):
        name = f"timing-{slug(variant)}"
        training = prepare_variant(config, variant, f"{config.name}-{name}", 0, TIMING_STEPS)
        training = replace(training, validate=None, log_every=1)
        fit(training, config.workers, storage.join(output, "models", name))
        rates = [value for _, value in training.tracker.history("scenes_per_second")]
        per_second = median(rates[len(rates) // 2 :]) / training.stream.batch_size  # the first steps are slow
        storage.write_json(
            {"steps_per_second": per_second, "steps": max(1, int(60 * config.minutes * per_second))}, record
        )
    return storage.read_json(record)["steps"]


# ------------------------------------------------------------------------------------------------- what both write


def claim(output: str, options: dict) -> None:
    """Keep a directory for one set of options. Raises ValueError if it holds the trials of another."""
    from pipelines.runtime import storage

    record = storage.join(output, "study.json")
    kept = [path for path in storage.list_files(output, ".json") if not path.endswith(("/study.json", "/mlflow.json"))]
    if kept and storage.exists(record) and (made := storage.read_json(record)) != options:
        key = next(key for key in sorted(made | options) if made.get(key) != options.get(key))
        raise ValueError(
            f"{output} holds a study with {key}={made.get(key)}, asked for {options.get(key)}; "
            "use the same options to go on, or another --output for a new study"
        )
    storage.write_json(options, record)


def write_tables(
    output: str, name: str, rows: list[dict], tables: Sequence[Table], figure: Chart | None = None
) -> None:
    """NAME.json and NAME.parquet with every number, NAME.txt with the tables as shown, NAME.svg with the figure."""
    import pyarrow as pa

    from pipelines.reporting.chart import standalone_svg
    from pipelines.runtime import storage

    storage.write_json({"machine": machine(), "rows": rows}, storage.join(output, f"{name}.json"))
    storage.write_parquet(pa.Table.from_pylist(rows), storage.join(output, f"{name}.parquet"))
    text = io.StringIO()
    for table in tables:
        print_table(table, text)
    files = {"txt": text.getvalue()} | ({"svg": standalone_svg(figure)} if figure else {})
    for kind, content in files.items():
        path = storage.join(output, f"{name}.{kind}")
        storage.write_text(content, path)


def publish(output: str, html: str, tables: Sequence[Table], tracker: Tracker) -> None:
    """Write the page, hand it to MLflow, print the tables."""
    from pipelines.runtime import storage

    path = storage.join(output, "report.html")
    storage.write_text(html, path)
    tracker.client.log_text(tracker.run_id, html, "report.html")
    tracker.finish("FINISHED")
    for table in tables:
        print_table(table)


def machine() -> str:
    """Machine and versions in one line."""
    import os
    import platform

    import torch

    return f"{platform.machine()}, {os.cpu_count()} CPUs, Python {platform.python_version()}, torch {torch.__version__}"


def main(config: Encoding | Branches) -> None:
    print(compare_encodings(config) if isinstance(config, Encoding) else compare_variants(config))


if __name__ == "__main__":
    run(main, Config, description=__doc__)
