#!/usr/bin/env python3
"""How many steps are enough? Scenes by every sampler with few and many steps, all scored against the same real ones.

    jobs/sweep_samplers.py                                             256 town scenes each, 10 to 250 steps
    jobs/sweep_samplers.py --samplers ddpm dpm++ --steps 10 250 --num-scenes 64
    jobs/sweep_samplers.py --samplers dpm++ --steps 20 --noise-scalings 1 1.005 1.01        which of them a new model wants

Writes the scenes (source=generated-<sampler>-<steps>), samplers.json, samplers.parquet, figures (SVG) and samplers.html.
Run it again with the same options to go on after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

from jobs.support.cli import absolute, home, print_table, require_positive, run, start_ray
from jobs.support.options import ModelOption, model_label_kind, pipeline_directory

if TYPE_CHECKING:
    from rich.progress import Progress

    from pipelines.generation.sample import SampleRequest
    from pipelines.reporting.report import Picture


@dataclass(frozen=True)
class Config:
    model: ModelOption = ""
    real: str = ""
    """Dataset directory of the real scenes (default: $PRITTI_HOME/datasets/town)."""
    real_split: str = "test"
    samplers: tuple[str, ...] = ("ddpm", "ddim", "dpm++")
    steps: tuple[int, ...] = (10, 20, 50, 100, 250)
    noise_scalings: tuple[float, ...] = ()
    """Divide the network's noise by each of these (default: what the model comes with, nothing for ddpm)."""
    num_scenes: int = 256
    """Of each sampler and number of steps; as many real ones."""
    seed: int = 0
    guidance: float = 1.0
    batch_size: int = 8
    pictures: int = 4
    """So many scenes of each on the page."""
    output: str = ""
    """Where everything goes (default: $PRITTI_HOME/evaluations/samplers)."""
    actors: int = 1
    """Pipelines at work at once; one per GPU."""


def sweep_samplers(config: Config) -> list[dict]:
    """Generate, score, write and return a row per sampler and number of steps."""
    model = pipeline_directory(config.model)
    require_positive(config, "actors", "batch_size")
    if config.num_scenes < 5 or config.pictures < 0:
        raise ValueError(f"--num-scenes is {config.num_scenes}, --pictures {config.pictures}: expected 5 and 0 or more")
    if not config.samplers or not config.steps:
        raise ValueError("no --samplers or no --steps: expected one or more of each")
    from rich.progress import Progress

    from models.labels import LABELS
    from models.sampling.schedulers import SAMPLERS
    from models.pipeline import require_scaling
    from models.sampling.diffusion import Diffusion
    from pipelines.evaluation.evaluate import compare
    from pipelines.evaluation.features import Looks, describe
    from pipelines.evaluation.sampler_sweep import sampler_row
    from pipelines.generation.sample import SampleRequest
    from pipelines.rendering.render import bev_picture
    from pipelines.reporting.report import Picture
    from pipelines.runtime import storage
    from pipelines.schema.dataset import Dataset
    from pipelines.schema.scene_subset import Selection
    from pipelines.schema.tables import read_scenes

    if unknown := set(config.samplers) - set(SAMPLERS):
        raise ValueError(f"--samplers {' '.join(sorted(unknown))}: expected some of {', '.join(SAMPLERS)}")
    for steps in config.steps:  # numbers that cannot be had are said before hours of the others
        Diffusion().visited(steps)
    for scaling in config.noise_scalings:
        require_scaling(scaling)
    dataset = Dataset.open(absolute(config.real) if config.real else home("datasets", "town"))
    output = absolute(config.output) if config.output else home("evaluations", "samplers")
    real = Selection(dataset.root, dataset.source, config.real_split, config.num_scenes, "spread")
    count = sum(len(rows) for _, rows in real.shards())
    labels = LABELS[model_label_kind(model)]
    rows, pictures = [], []
    start_ray()
    with Progress() as bar:

        def described(side: Selection, name: str) -> dict:
            task = bar.add_task(f"describe {name}", total=count)
            directory = storage.join(output, "described", name)
            return describe(side, dataset, Looks(), directory, config.actors, lambda n: bar.advance(task, n))

        truth = described(real, "real")
        for sampler, steps, scaling in product(config.samplers, config.steps, config.noise_scalings or (None,)):
            request = SampleRequest(
                model=model,
                output=output,
                run=f"{sampler}-{steps}" + (f"-{scaling:g}" if scaling else ""),
                num_scenes=config.num_scenes,
                labels=labels,
                seed=config.seed,
                num_inference_steps=steps,
                guidance_scale=config.guidance,
                sampler=sampler,
                noise_scaling=scaling,
                shard_scenes=max(1, config.num_scenes // 8),  # whatever the actors: another number of them goes on
            )
            seconds_per_scene = timed_sampling(config, request, bar)
            made = described(Selection(output, request.source, None, count, "spread"), request.run)
            scores = compare(truth, made, dataset.spec.ground_classes)
            used = storage.read_json(storage.join(output, f"{request.source}.json"))["noise_scaling"]
            rows.append(sampler_row(sampler, steps, used, seconds_per_scene, scores))
            scenes = read_scenes(output, request.source, limit=config.pictures) if config.pictures else ()
            pictures += [Picture(f"{request.run}, {s.frame}", bev_picture(s, supersample=2)) for s in scenes]
    how = [
        f"Real: {count} scenes of {dataset.root}, split {config.real_split}, evenly spread. Model: {model}.",
        f"Seed {config.seed}, guidance scale {config.guidance:g}, labels in turn: {', '.join(labels)}.",
    ]
    publish(output, rows, pictures, max(1, config.pictures), how)
    return rows


def timed_sampling(config: Config, request: SampleRequest, bar: Progress) -> float | None:
    """Generate what is missing; an actor's seconds a scene, over the shards whose time was seen; None of none."""
    from pipelines.generation.sample import sample_scenes
    from pipelines.runtime import storage

    record = storage.join(request.output, "times", f"{request.run}.json")
    times = storage.read_json(record) if storage.exists(record) else {}
    shown = bar.add_task(request.run, total=request.num_scenes)

    def advance(row: dict) -> None:
        bar.advance(shown, row["scenes"])
        if row["seconds"]:  # not of a shard that an interrupted run left
            times[str(row["id"])] = [row["seconds"], row["scenes"]]
            storage.write_json(times, record)

    sample_scenes(request, config.actors, config.batch_size, advance)
    if not times:
        return None
    seconds, scenes = map(sum, zip(*times.values(), strict=True))
    return seconds / scenes


def publish(output: str, rows: list[dict], pictures: list[Picture], columns: int, how: list[str]) -> None:
    """Write rows, figures and the page."""
    import pyarrow as pa

    from pipelines.evaluation.sampler_sweep import CHARTED, sampler_charts, sampler_html
    from pipelines.reporting.chart import standalone_svg
    from pipelines.runtime import storage

    storage.write_json(rows, storage.join(output, "samplers.json"))
    storage.write_parquet(pa.Table.from_pylist(rows), storage.join(output, "samplers.parquet"))
    storage.write_text(sampler_html(rows, pictures, columns, how), storage.join(output, "samplers.html"))
    for name, chart in zip(CHARTED, sampler_charts(rows), strict=True):
        storage.write_text(standalone_svg(chart), storage.join(output, f"samplers-{name}.svg"))


def main(config: Config) -> None:
    from pipelines.evaluation.sampler_sweep import sampler_table

    print_table(sampler_table(sweep_samplers(config)))


if __name__ == "__main__":
    run(main, Config, description=__doc__)
