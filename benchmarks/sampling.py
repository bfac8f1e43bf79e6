"""Measure the time of sampling, decoding and writing scenes, and the peak memory.

    python benchmarks/sampling.py                       # the untrained town presets, which need the same time
    python benchmarks/sampling.py --model DIRECTORY     # a trained pipeline

Times are CPU seconds of one thread. Target: all work after sampling takes at most a tenth of the time for sampling with
50 steps. The benchmark reports two memory figures. The first is the peak of the whole process. The second is the memory
for Python, torch and the weights alone.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import resource
import tempfile
import time
from dataclasses import dataclass

import torch
import tyro
from common import describe_machine, spread

from models.dit import DiT
from models.labels import LABELS
from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.pipeline import PrITTIPipeline
from models.presets import DIT_PRESETS, LVAE_PRESETS
from models.sampling.schedulers import SchedulerConfig
from pipelines.generation.sample import load_pipeline
from pipelines.schema.tables import Shard


@dataclass(frozen=True)
class Config:
    model: str = ""
    preset: str = "town"
    steps: int = 50
    batch: int = 8
    rounds: int = 3


def build_untrained_pipeline(preset: str) -> PrITTIPipeline:
    row = DIT_PRESETS[preset]
    vae = LVAE_PRESETS[row.lvae]
    torch.manual_seed(0)
    lvae = LayoutVAE(layout=LayoutSpec().with_resolution(vae.raster_px).to_dict(), **vae.architecture())
    channels, size, _ = lvae.latent_shape
    dit = DiT(**row.architecture(), channels=channels, size=size, layout=dict(lvae.config.layout))
    pipeline = PrITTIPipeline(lvae, dit, SchedulerConfig.ddpm())
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


def read_peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # Linux reports this value in KiB


def main(config: Config) -> None:
    pipeline = load_pipeline(config.model) if config.model else build_untrained_pipeline(config.preset)
    print(describe_machine(), f"latents {pipeline.lvae.latent_shape}")
    known = LABELS[pipeline.dit.config.label]
    labels = [known[k % len(known)] for k in range(config.batch)]
    loaded_mib = read_peak_mib()
    seconds: dict[str, list[float]] = {"sampling": [], "decoding": [], "writing": []}
    clock = time.process_time
    for number in range(config.rounds + 1):
        marks = [clock()]
        latents = pipeline.sample_latents(labels, number, range(config.batch), config.steps)
        marks.append(clock())
        identities = [pipeline.new_identity("run", number, k, label) for k, label in enumerate(labels)]
        scenes = pipeline.decode(latents, identities)
        marks.append(clock())
        with tempfile.TemporaryDirectory() as directory:
            Shard(directory, "generated-run", "generated", 0).write(scenes)
        marks.append(clock())
        if number:  # the first round warms up
            for name, start, end in zip(seconds, marks, marks[1:], strict=False):
                seconds[name].append((end - start) / config.batch)
    for name, found in seconds.items():
        print(f"{name}: {spread(found, 1e3, 1)} ms per scene")
    after = [(d + w) / s for s, d, w in zip(*seconds.values(), strict=True)]
    print(f"after sampling / sampling, {config.steps} steps: {spread(after, 100, 1)} %; {len(scenes[0])} primitives")
    print(f"memory: {read_peak_mib():.0f} MiB at most, {loaded_mib:.0f} of it before the first scene")


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
