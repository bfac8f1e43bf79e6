"""Implementation of jobs/encode_latents.py."""

from __future__ import annotations

from jobs.encode_latents import Config
from jobs.support.cli import make_absolute, resolve_path
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from pipelines.schema.dataset import Dataset
from pipelines.training.latents import encode_latents


def encode(config: Config) -> dict:
    """Encode the scenes of a dataset and return the content of latents.json."""
    dataset = Dataset.open(resolve_path(config.dataset, "datasets", "town"))
    lvae = resolve_path(config.lvae, "models", "lvae-town")
    output = make_absolute(config.output) if config.output else dataset.root
    with hold_output(output, "latents", config), JobProgress() as bar:
        shown = bar.add_task("encode latents", total=sum(dataset.scenes.values()))
        return encode_latents(
            dataset,
            lvae,
            output,
            config.num_actors,
            config.batch_size,
            lambda row: bar.advance(shown, int(row["count"])),
            config.streets,
        )


def main(config: Config) -> None:
    content = encode(config)
    print(f"latents of {sum(content['scenes'].values())} scenes, shape {content['shape']}")
