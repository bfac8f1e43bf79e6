"""Implementation of jobs/reproduce_paper.py."""

from __future__ import annotations

import os
import shlex
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import ray
from rich.console import Console
from rich.table import Table as Columns

from jobs.implementation import preprocess_scenes, train_dit, train_lvae
from jobs.implementation.ablate_lvae import compare_variants
from jobs.implementation.encode_latents import encode
from jobs.implementation.evaluate_scenes import evaluate
from jobs.implementation.paper_plan import (
    NEAREST_SCENES,
    PAPER_SCENES,
    Counts,
    PaperConfig,
    Stage,
    check_counts,
    count_poses,
    find_presets,
    find_source,
    make_plan,
)
from jobs.implementation.sample_scenes import sample
from jobs.reproduce_paper import Av2
from jobs.support.cli import home_path, make_absolute, require_tracking_uri
from jobs.support.outputs import hold_output
from jobs.support.ray_session import start_ray
from jobs.support.stages import Stages
from jobs.support.terminal import print_table
from models.uris import is_uri
from pipelines.evaluation.features import load_cached_inception, load_cached_vgg16
from pipelines.metrics.controls import MOVE_M, RECONSTRUCTION_CONTROL
from pipelines.reporting.paper_tables import Reproduced, build_paper_tables, compare_with_paper, format_paper_tables
from pipelines.reporting.report import Table, Text, render_report_html
from pipelines.runtime import storage
from pipelines.schema.dataset import Dataset
from pipelines.schema.run_guard import find_changed_option

RUN: Mapping[str, Callable[[Any], Any]] = {
    "preprocess_scenes": preprocess_scenes.main,
    "train_lvae": train_lvae.train,
    "encode_latents": encode,
    "ablate_lvae": compare_variants,
    "train_dit": train_dit.train,
    "sample_scenes": sample,
    "evaluate_scenes": evaluate,
}
GPU_JOBS = ("train_lvae", "encode_latents", "ablate_lvae", "train_dit", "sample_scenes")
GIGABYTE = 1e9


def main(config: PaperConfig) -> None:
    source = find_source(config)
    mini = "-mini" if config.scale == "mini" else ""
    home = make_absolute(config.output) if config.output else home_path(f"paper-{source}{mini}")
    check_options(config)
    os.environ["PRITTI_HOME"] = home
    if not is_uri(home):  # The job writes all files under the output directory.
        os.environ.pop("MLFLOW_TRACKING_URI", None)
    require_tracking_uri()
    guard_scale(config, home)
    counts = count_poses(config)
    plan = make_plan(config, counts)
    about = "about " if isinstance(config, Av2) else ""
    print(f"{make_absolute(config.input)}: {about}{counts.train:,} training poses, {about}{counts.test:,} test poses")
    print_plan(plan, home, config.scale == "mini")
    if not config.inception:
        print("note: without --inception FILE, the tables have no FID, IS, precision and recall")
    if config.dry_run:
        return
    require_space(plan, home)
    check_networks(config)
    start_ray(training=True)
    require_gpus(config)
    storage.write_json({"scale": config.scale}, home_path("scale.json"))
    stages = Stages(home_path("stages.json"), total=len(plan) + 1)
    first = plan[0]
    stages.run(first.name, lambda: RUN[first.job](first.config))
    # Preprocessing rejects scenes, and the sweeps of Argoverse 2 were estimated.
    scenes = Dataset.open(home_path("datasets", source)).scenes
    counts = Counts(scenes.get("train", 0), scenes.get("test", 0))
    check_counts(config, counts)
    for stage in make_plan(config, counts)[1:]:
        stages.run(stage.name, lambda stage=stage: RUN[stage.job](stage.config))
    stages.run("write the tables", lambda: write_tables(config, stages.seconds))


def check_options(config: PaperConfig) -> None:
    """Check the numbers, the files of weights and the transformers before the first stage.

    Raises:
        ValueError: A number is not positive, a file is missing, or the paper has no such numbers on the dataset.
    """
    for name in ("num_workers", "lvae_steps", "dit_steps", "num_scenes", "num_inference_steps"):
        value = getattr(config, name)
        if value is not None and value < 1:
            raise ValueError(f"--{name.replace('_', '-')} is {value}, expected 1 or more")
    if isinstance(config, Av2) and (config.ablations or config.vgg16):
        option = "--ablations" if config.ablations else "--vgg16"
        raise ValueError(f"{option}: the paper has these rows only for KITTI-360; omit it")
    for option, path in (("--inception", config.inception), ("--vgg16", config.vgg16)):
        if path and not storage.exists(make_absolute(path)):
            raise ValueError(f"{option} {path} does not exist")
    if isinstance(config, Av2) and config.scale == "paper" and set(config.transformers) != {"b"}:
        raise ValueError(
            f"--transformers {' '.join(config.transformers)}: on Argoverse 2, the paper has only DiT-B; use"
            " --transformers b"
        )
    if not config.transformers or len(set(config.transformers)) != len(config.transformers):
        raise ValueError(f"--transformers {' '.join(config.transformers)}: expected different sizes of b, l and xl")


def check_networks(config: PaperConfig) -> None:
    """Load the files of weights, so that a wrong file stops the job before hours of training.

    Raises:
        ValueError: A file does not hold the weights of the network.
    """
    for path, load in ((config.inception, load_cached_inception), (config.vgg16, load_cached_vgg16)):
        if path:
            load(*storage.fingerprint_file(make_absolute(path)))
            load.cache_clear()


def guard_scale(config: PaperConfig, home: str) -> None:
    """Raise an error if the output directory belongs to a run with the other scale.

    Raises:
        ValueError: The scales differ.
    """
    if difference := find_changed_option(storage.join_uri(home, "scale.json"), {"scale": config.scale}):
        raise ValueError(f"{home} holds a run with {difference}; choose another --output")


def print_plan(plan: list[Stage], home: str, mini: bool) -> None:
    """Print the stages with their estimates and equivalent commands. The times of the mini scale are those of CPUs."""
    table = Columns("stage", "GPU hours", "CPU hours", "GB", "basis of the time")
    gpu_hours = 0.0
    for stage in plan:
        hours = [f"{stage.hours:,.2f}", ""]
        if mini or stage.job not in GPU_JOBS:
            hours.reverse()
        else:
            gpu_hours += stage.hours
        table.add_row(stage.name, *hours, f"{stage.gigabytes:,.2f}", stage.basis)
    cpu_hours, gigabytes = sum(s.hours for s in plan) - gpu_hours, sum(s.gigabytes for s in plan)
    table.add_row("total", f"{gpu_hours:,.1f}", f"{cpu_hours:,.1f}", f"{gigabytes:,.1f}", "")
    Console(width=max(100, Console().width)).print(table)
    print("All numbers are estimates. These commands do the same:")
    print(f"  export PRITTI_HOME={shlex.quote(home)}")
    for stage in plan:
        print(f"  {stage.command}")


def require_space(plan: list[Stage], home: str) -> None:
    """Raise an error if a local disk has less free space than the plan needs. Existing results count as free.

    Raises:
        ValueError: There is too little space.
    """
    if is_uri(home):
        return
    folder = next(parent for parent in (Path(home), *Path(home).parents) if parent.exists())
    used = sum(path.stat().st_size for path in Path(home).rglob("*") if path.is_file()) if folder == Path(home) else 0
    needed, free = sum(stage.gigabytes for stage in plan), (shutil.disk_usage(folder).free + used) / GIGABYTE
    if needed > free:
        raise ValueError(
            f"the results need about {needed:,.1f} GB, but {folder} has {free:,.1f} GB; choose another --output"
        )


def require_gpus(config: PaperConfig) -> None:
    """Raise an error if the networks of the paper would be trained on CPUs, or if there are too few GPUs.

    Raises:
        ValueError: The cluster has no GPU, or fewer than the workers need.
    """
    wants = config.gpus is None or config.gpus > 0
    if not wants or config.wait_for_resources_s:
        return
    found, needed = count_gpus(), config.num_workers * (config.gpus or 1)
    if 0 < found < needed:
        raise ValueError(
            f"--num-workers {config.num_workers} needs {needed:g} GPUs, but this cluster has {found:g}; use fewer"
            " workers, or --wait-for-resources if an autoscaler adds GPUs"
        )
    if config.scale == "paper" and not found:
        raise ValueError(
            "the networks of the paper need GPUs, but this cluster has none; use --scale mini for a rehearsal,"
            " --wait-for-resources if an autoscaler adds GPUs, or --gpus 0 to train on CPUs for months"
        )


def count_gpus() -> float:
    """Return the number of GPUs of the cluster."""
    return ray.cluster_resources().get("GPU", 0)


def write_tables(config: PaperConfig, seconds: Mapping[str, float]) -> list[dict]:
    """Compare all scores with the paper, and write tables.html, tables.md and tables.json."""
    source = find_source(config)
    found = collect_scores(config)
    rows = compare_with_paper(source, found)
    tables = build_paper_tables(rows)
    for table in tables:
        print_table(table)
    remarks = describe_run(config)
    durations = Table("Durations", ("stage", "minutes"), [(name, value / 60) for name, value in seconds.items()])
    html = render_report_html("The paper's tables", [Text("This run", remarks), *tables, durations], source)
    text = "\n".join(["# The paper's tables", "", *remarks, "", format_paper_tables(rows)])
    with hold_output(home_path("tables"), "tables", config):
        storage.write_text(html, home_path("tables.html"))
        storage.write_text(text, home_path("tables.md"))
        storage.write_json(rows, home_path("tables.json"))
    print(f"tables: {home_path('tables.html')}")
    return rows


def describe_run(config: PaperConfig) -> list[str]:
    """Return sentences that describe the run."""
    source = find_source(config)
    dataset = Dataset.open(home_path("datasets", source))
    presets = dict.fromkeys(name for size in list_evaluated_sizes(config) for name in find_presets(config, size))
    described = [
        f"Dataset {source}: {make_absolute(config.input)}, {dataset.spec.num_slots} slots per scene.",
        f"Presets {', '.join(presets)}; seed {config.seed}.",
        "The ceiling of a reconstruction converts the scenes to layout tensors and back, without a network; its control"
        f" does the same with {RECONSTRUCTION_CONTROL}. The ceiling of a generation score is the score of other real"
        f" scenes, its control that of real scenes with objects moved by up to {MOVE_M:g} m.",
    ]
    if config.ablations:
        described.append("The ablations of the layout VAE have seed 0.")
    if config.scale == "mini":
        described.insert(0, "This is a rehearsal with small networks. Its scores say nothing about the paper's model.")
    return described


def collect_scores(config: PaperConfig) -> Reproduced:
    """Read the scores of all evaluations."""
    ours = storage.read_json(home_path("evaluations", "reconstruction", "metrics.json"))["reconstruction"]
    sets = storage.read_json(home_path("evaluations", "reconstruction", "reconstruction_sets.json"))
    study = home_path("ablations", "branches", "branches.json")
    if storage.exists(study):
        ours |= {"ablation": {row["variant"]: row for row in storage.read_json(study)["rows"]}}
    notes: dict[str, str] = {}
    generation = {}
    for size in list_evaluated_sizes(config):
        scores = read_generation(f"{size}-precision")
        has_ceiling = "sets" in scores
        sides = scores.setdefault("sets", {})
        sides.setdefault("ceiling", {})["inception_score"] = scores.get("inception_score_real")
        scores["fid_small"] = scores.get("fid")
        for side in sides.values():
            side["fid_small"] = side.get("fid")
        whole = home_path("evaluations", f"{size}-fid", "metrics.json")
        if storage.exists(whole):
            names = ("fid", "inception_score")
            scores |= {name: value for name, value in read_generation(f"{size}-fid").items() if name in names}
            for side in sides.values():
                side.pop("fid", None)
            notes["fid"] = "all training scenes; the test split is too small for a ceiling of the same size"
            notes["inception_score"] = "of all generated scenes; ceiling: all training scenes"
            sides["ceiling"]["inception_score"] = read_generation(f"{size}-fid").get("inception_score_real")
        else:
            count = f"{scores['scenes']['generated']:,} scenes instead of"
            notes |= dict.fromkeys(("precision_k3", "recall_k3"), f"{count} {PAPER_SCENES:,}")
            notes |= dict.fromkeys(("fid", "inception_score"), f"{count} as many as the training split has")
        if not has_ceiling:
            notes |= dict.fromkeys(("precision_k3", "recall_k3", "fid_small"), "too few test scenes for a ceiling")
        nearest = f"{size}-precision" if config.scale == "mini" else f"{size}-nearest"
        if storage.exists(home_path("evaluations", nearest, "metrics.json")):
            compared = read_generation(nearest)
            scores |= {name: value for name, value in compared.items() if name == "memorisation"}
            notes |= describe_memorisation(compared)
        generation[size] = scores
    return Reproduced({"ours": ours} | sets, generation, notes)


def list_evaluated_sizes(config: PaperConfig) -> list[str]:
    """Return the transformers of this run and of earlier runs in the same output directory."""

    def is_evaluated(size: str) -> bool:
        return storage.exists(home_path("evaluations", f"{size}-precision", "metrics.json"))

    return [size for size in ("b", "l", "xl") if size in config.transformers or is_evaluated(size)]


def describe_memorisation(scores: Mapping[str, Any]) -> dict[str, str]:
    """Return the remarks of the rows of supplement G, in which the paper compares 50,000 scenes on each side."""
    generated, real = (scores["scenes"][side] for side in ("generated", "real"))
    note = (
        f"{generated:,} generated and {real:,} training scenes, paper: {NEAREST_SCENES:,} each; the distances between"
        " training scenes are the reference; features of fc7, the paper names no layer"
    )
    sides, values = ("generated", "real"), ("mean", "median", "minimum", "maximum")
    return {f"memorisation.{side}.{value}": note for side in sides for value in values}


def read_generation(name: str) -> dict:
    """Return the generation scores of an evaluation."""
    return storage.read_json(home_path("evaluations", name, "metrics.json"))["generation"]
