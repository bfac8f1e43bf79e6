"""Implementation of jobs/sweep_samplers.py."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import pyarrow as pa

from jobs.support.cli import require_positive, resolve_path
from jobs.support.lite0 import prepare_lite0
from jobs.support.model_directories import find_pipeline_directory, read_label_kind
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from jobs.support.terminal import print_table
from jobs.sweep_samplers import Config
from models.configured_pipeline import check_noise_scaling
from models.labels import list_usual_labels
from models.sampling.diffusion import Diffusion
from models.sampling.schedulers import SAMPLERS
from pipelines.evaluation.evaluate import compare_datasets
from pipelines.evaluation.features import FeatureConfig, compute_scene_features, count_scenes
from pipelines.evaluation.sampler_sweep import (
    build_sampler_table,
    draw_sampler_charts,
    make_sampler_row,
    render_sampler_html,
)
from pipelines.generation.sample import SampleRequest, sample_scenes
from pipelines.metrics.controls import CONTROLS
from pipelines.rendering.render import render_bev
from pipelines.reporting.chart import make_standalone_svg
from pipelines.reporting.report import Picture
from pipelines.runtime import storage
from pipelines.schema.dataset import Dataset
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import read_scenes

CONTROL = "moved"  # Damage of the row that shows whether a score can fail.


def sweep_samplers(config: Config) -> list[dict]:
    """Generate and score every setting, write all files, and return a row per setting."""
    model = find_pipeline_directory(config.model)
    require_positive(config, "num_actors", "batch_size")
    if config.num_scenes < 5 or config.num_examples < 0:
        raise ValueError(
            f"--num-scenes is {config.num_scenes}, --num-examples is {config.num_examples}: "
            "expected at least 5 scenes and at least 0 examples"
        )
    if not (config.samplers and config.num_inference_steps and config.guidance_scale):
        raise ValueError(
            "--samplers, --num-inference-steps or --guidance-scale is empty: expected at least one value of each"
        )

    if unknown := set(config.samplers) - set(SAMPLERS):
        raise ValueError(f"--samplers {' '.join(sorted(unknown))}: expected some of {', '.join(SAMPLERS)}")
    for steps in config.num_inference_steps:  # raise an error for an invalid number before hours of sampling
        Diffusion().select_timesteps(steps)
    for scaling in config.noise_scalings:
        check_noise_scaling(scaling)
    dataset = Dataset.open(resolve_path(config.real, "datasets", "town"))
    output = resolve_path(config.output, "evaluations", "samplers")
    real = SceneSubset(dataset.root, dataset.source, config.real_split, config.num_scenes, "spread")
    count = count_scenes(real)
    others = replace(real, split=config.ceiling_split or ("train" if config.real_split == "test" else "test"))
    if count_scenes(others) < count:
        raise ValueError(
            f"--ceiling-split {others.split} of {dataset.root} has {count_scenes(others)} scenes, but the ceiling needs"
            f" {count}: give another split, or fewer --num-scenes"
        )
    others = replace(others, limit=count)
    labels = list_usual_labels(read_label_kind(model))
    rows, pictures = [], []
    with hold_output(output, "evaluation", config):
        with JobProgress() as bar:
            looks = FeatureConfig(lite0=prepare_lite0())

            def described(side: SceneSubset, name: str, control: str = "") -> dict:
                task = bar.add_task(f"describe {name}", total=count)
                directory = storage.join_uri(output, "described", name)
                how = replace(looks, control=control)
                return compute_scene_features(
                    side, dataset, how, directory, config.num_actors, lambda n: bar.advance(task, n)
                ).read()

            truth = described(real, "real")
            for sampler, steps, scaling, guidance in product(
                config.samplers, config.num_inference_steps, config.noise_scalings or (None,), config.guidance_scale
            ):
                request = SampleRequest(
                    model=model,
                    output=output,
                    run=name_run(config, sampler, steps, scaling, guidance),
                    num_scenes=config.num_scenes,
                    labels=labels,
                    seed=config.seed,
                    num_inference_steps=steps,
                    guidance_scale=guidance,
                    sampler=sampler,
                    noise_scaling=scaling,
                    pag_scale=config.pag_scale,
                    constraints=config.constraints,
                    # The shard size does not depend on the number of actors, so this number may change on resumption.
                    shard_scenes=max(1, config.num_scenes // 8),
                )
                seconds_per_scene = sample_and_time(config, request, bar)
                made = described(SceneSubset(output, request.source, None, count, "spread"), request.run)
                scores = compare_datasets(truth, made, dataset.spec.ground_classes)
                used = storage.read_json(storage.join_uri(output, f"{request.source}.json"))["noise_scaling"]
                rows.append(make_sampler_row(sampler, steps, used, seconds_per_scene, scores, guidance))
                scenes = read_scenes(output, request.source, limit=config.num_examples) if config.num_examples else ()
                pictures += [Picture(f"{request.run}, {s.frame}", render_bev(s, supersample=2)) for s in scenes]
            for name, control in (("other real scenes (ceiling)", ""), (f"control: {CONTROLS[CONTROL]}", CONTROL)):
                found = described(others, control or "ceiling", control)
                scores = compare_datasets(truth, found, dataset.spec.ground_classes)
                rows.append(make_sampler_row(name, None, None, None, scores))
        how = [
            f"Real: {count} scenes of {dataset.root}, split {config.real_split}, selected evenly. Model: {model}.",
            f"Ceiling and control: {count_scenes(others)} scenes of split {others.split}, selected evenly.",
            f"Seed {config.seed}, guidance scale {', '.join(f'{scale:g}' for scale in config.guidance_scale)},"
            f" labels in turn: {', '.join(labels)}.",
        ]
        write_report(output, rows, pictures, max(1, config.num_examples), how)
        return rows


def name_run(config: Config, sampler: str, steps: int, scaling: float | None, guidance: float) -> str:
    """Return the name of the run of a setting."""
    name = f"{sampler}-{steps}" + (f"-{scaling:g}" if scaling else "")
    return name + (f"-guidance-{guidance:g}" if len(config.guidance_scale) > 1 else "")


def sample_and_time(config: Config, request: SampleRequest, bar: JobProgress) -> float | None:
    """Generate missing scenes; return the seconds that one actor needs per scene (None if no shard was timed)."""
    record = storage.join_uri(request.output, "times", f"{request.run}.json")
    times = storage.read_json(record) if storage.exists(record) else {}
    shown = bar.add_task(request.run, total=request.num_scenes)

    def advance(row: dict) -> None:
        bar.advance(shown, row["scenes"])
        if row["seconds"]:  # the time is 0 if an earlier, interrupted run wrote the shard
            times[str(row["id"])] = [row["seconds"], row["scenes"]]
            storage.write_json(times, record)

    sample_scenes(request, config.num_actors, config.batch_size, advance)
    if not times:
        return None
    seconds, scenes = map(sum, zip(*times.values(), strict=True))
    return seconds / scenes


def write_report(output: str, rows: list[dict], pictures: list[Picture], columns: int, how: list[str]) -> None:
    """Write the rows, the figures and the page."""
    storage.write_json(rows, storage.join_uri(output, "samplers.json"))
    storage.write_parquet(pa.Table.from_pylist(rows), storage.join_uri(output, "samplers.parquet"))
    storage.write_text(render_sampler_html(rows, pictures, columns, how), storage.join_uri(output, "samplers.html"))
    for name, chart in draw_sampler_charts(rows).items():
        storage.write_text(make_standalone_svg(chart), storage.join_uri(output, f"samplers-{name}.svg"))


def main(config: Config) -> None:
    print_table(build_sampler_table(sweep_samplers(config)))
