"""Measure the time of sampling, decoding and writing scenes, and the peak memory.

    python benchmarks/sampling.py                                     # the untrained town presets: equal times
    python benchmarks/sampling.py --model DIRECTORY                   # a trained pipeline
    python benchmarks/sampling.py --preset kitti360 --steps 250       # the paper's model and steps, on a GPU

The paper reports seconds per scene and GPU memory, averaged over 100 scenes. With a GPU, the benchmark therefore
reports wall-clock seconds per scene over --scenes scenes, and torch's peak of allocated GPU memory, which includes the
weights. Without a GPU, times are wall-clock seconds of one thread. Memory is then the growth of the process since the
start of `main`. It includes the weights, but not Python and torch. Do not compare figures of a GPU with figures of
a CPU. Target: all work after sampling takes at most a tenth of the time for sampling with 50 steps.
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
from models.labels import list_usual_labels
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
    scenes: int = 100


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
    before_mib = read_peak_mib()
    pipeline = load_pipeline(config.model) if config.model else build_untrained_pipeline(config.preset)
    has_gpu = torch.cuda.is_available()
    if has_gpu:
        pipeline.to("cuda")
    weights_mib = (
        sum(p.numel() * p.element_size() for m in (pipeline.lvae, pipeline.dit) for p in m.parameters()) / 2**20
    )
    print(describe_machine(), f"latents {pipeline.lvae.latent_shape}")
    known = list_usual_labels(pipeline.dit.config.label)
    labels = [known[k % len(known)] for k in range(config.batch)]
    seconds: dict[str, list[float]] = {"sampling": [], "decoding": [], "writing": []}

    def clock() -> float:
        if has_gpu:
            torch.cuda.synchronize()
        return time.perf_counter()

    rounds = -(-config.scenes // config.batch)
    for number in range(rounds + 1):
        if number == 1 and has_gpu:
            torch.cuda.reset_peak_memory_stats()
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
    print(f"{sum(map(sum, seconds.values())) / rounds:.3f} s per scene, mean of {rounds * config.batch} scenes")
    for name, found in seconds.items():
        print(f"{name}: {spread(found, 1e3, 1)} ms per scene")
    after = [(d + w) / s for s, d, w in zip(*seconds.values(), strict=True)]
    print(f"after sampling / sampling, {config.steps} steps: {spread(after, 100, 1)} %; {len(scenes[0])} primitives")
    if has_gpu:
        peak_mib = torch.cuda.max_memory_allocated() / 2**20
        print(
            f"GPU memory: {peak_mib:.0f} MiB at most with batch {config.batch}, of which weights {weights_mib:.0f} MiB"
        )
    else:
        grown_mib = read_peak_mib() - before_mib
        print(f"memory: {grown_mib:.0f} MiB at most with batch {config.batch}, of which weights {weights_mib:.0f} MiB")


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
