#!/usr/bin/env python3
"""Scenes -> latents with a trained LVAE: DIR/latents/..., aligned with DIR/scenes, and DIR/latents.json.

    jobs/encode_latents.py                                     the town dataset with the town LVAE
    jobs/encode_latents.py --dataset DIR --lvae MODEL --actors 8

Run it again with the same options to go on after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import absolute, home, run, start_ray


@dataclass(frozen=True)
class Config:
    dataset: str = ""
    """Dataset directory (default: $PRITTI_HOME/datasets/town)."""
    lvae: str = ""
    """Trained LVAE (default: $PRITTI_HOME/models/lvae-town)."""
    output: str = ""
    """Where latents/ and latents.json go (default: the dataset directory)."""
    actors: int = 1
    """Models at work at once; one per GPU."""
    batch_size: int = 16


def encode(config: Config) -> dict:
    """Encode and return the content of latents.json."""
    from pipelines.schema.dataset import Dataset

    dataset = Dataset.open(absolute(config.dataset) if config.dataset else home("datasets", "town"))
    from rich.progress import Progress

    from pipelines.training.latents import encode_latents

    lvae = absolute(config.lvae) if config.lvae else home("models", "lvae-town")
    output = absolute(config.output) if config.output else dataset.root
    start_ray()
    with Progress() as bar:
        shown = bar.add_task("encode latents", total=sum(dataset.scenes.values()))
        return encode_latents(
            dataset, lvae, output, config.actors, config.batch_size, lambda row: bar.advance(shown, int(row["count"]))
        )


def main(config: Config) -> None:
    content = encode(config)
    print(f"latents of {sum(content['scenes'].values())} scenes, shape {content['shape']}")


if __name__ == "__main__":
    run(main, Config, description=__doc__)
