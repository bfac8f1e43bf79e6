#!/usr/bin/env python3
"""The main job on the built-in town, start to finish: scenes of the released model, then preprocess -> train LVAE ->
encode -> train DiT -> sample -> outpaint once -> evaluate -> report.html. No data, no GPU, no network.

    jobs/run_demo.py                        15 minutes on two cores, everything under runs/demo
    jobs/run_demo.py --lvae-steps 20000 --dit-steps 50000 --output DIR       longer is better

Run it again to go on after an interruption.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from jobs.support.cli import absolute, run, start_ray

RELEASED = "town"
CHECKPOINTS = 8  # per training run: each also validates and draws


@dataclass(frozen=True)
class Config:
    output: str = "runs/demo"
    """Where everything goes: data, runs, models, MLflow, report.html."""
    preset: str = "demo"
    """Model preset; smoke shows the mechanism in two minutes."""
    num_train: int = 1200
    num_test: int = 200
    lvae_steps: int = 500
    lvae_batch_size: int = 8
    dit_steps: int = 1700
    dit_batch_size: int = 8
    """Many small steps show something sooner than few large ones."""
    num_released: int = 12
    """Scenes to generate with the released model, before anything is trained; 0 for none."""
    num_scenes: int = 48
    """Scenes to generate with the model that was trained."""
    sampling_steps: int = 100
    """Denoising steps (the paper: 250)."""
    outpaint_steps: int = 50
    """Denoising steps of outpainting, guided by what is known (the paper: 250, ten times over)."""
    actors: int = 2
    """Models at work at once when encoding, sampling and evaluating."""
    seed: int = 0


class Stages:
    """Runs stages one after the other, says so, and keeps their times over interruptions."""

    def __init__(self, path: str, total: int) -> None:
        from pipelines.runtime import storage

        self.path, self.total, self.started = path, total, time.perf_counter()
        self.seconds: dict[str, float] = storage.read_json(path) if storage.exists(path) else {}
        self.done = 0

    def run(self, name: str, work: Callable[[], Any]) -> Any:
        from pipelines.runtime import storage

        self.done += 1
        print(f"\n[{self.done}/{self.total}] {name}", flush=True)
        started = time.perf_counter()
        result = work()
        # A stage that was complete already takes a moment: keep what it took when it did the work.
        self.seconds[name] = max(self.seconds.get(name, 0.0), time.perf_counter() - started)
        storage.write_json(self.seconds, self.path)
        return result


def show_released(config: Config) -> None:
    """Scenes of the weights that come with the package, and a picture of them to look at while the rest trains."""
    from jobs import sample_scenes
    from jobs.support.cli import home
    from pipelines.rendering.render import contact_sheet, picture_3d, png
    from pipelines.runtime import storage
    from pipelines.schema.tables import read_scenes

    sample_scenes.sample(
        sample_scenes.Config(
            model=RELEASED,
            output=home("released"),
            num_scenes=config.num_released,
            seed=config.seed,
            sampler="dpm++",
            steps=20,
            glb=1,
        )
    )
    scenes = read_scenes(home("released"), "generated-samples")
    sheet = contact_sheet([picture_3d(scene, 480, 360) for scene in scenes], columns=4)
    path = home("released.png")
    storage.write_whole(path, lambda stream: stream.write(png(sheet)))
    print(f"pictures: {os.path.relpath(path)}; now to train such a model")


def main(config: Config) -> None:
    output = absolute(config.output)
    os.environ["PRITTI_HOME"] = output
    os.environ.pop("MLFLOW_TRACKING_URI", None)  # everything stays under the output directory
    from jobs import (
        encode_latents,
        evaluate_scenes,
        outpaint_scenes,
        preprocess_scenes,
        sample_scenes,
        train_dit,
        train_lvae,
    )
    from jobs.support.cli import home
    from jobs.support.demo_report import write_demo_report

    data, lvae, model = (
        home("datasets", "town"),
        home("models", f"lvae-{config.preset}"),
        home("models", f"pritti-{config.preset}"),
    )
    stages = Stages(home("stages.json"), total=9 if config.num_released else 8)
    start_ray(training=True)
    if config.num_released:
        stages.run("sample scenes of the released model", lambda: show_released(config))
    stages.run(
        "preprocess the town",
        lambda: preprocess_scenes.main(
            preprocess_scenes.Town(output=data, num_train=config.num_train, num_test=config.num_test, seed=config.seed)
        ),
    )
    stages.run(
        "train the layout VAE",
        lambda: train_lvae.train(
            train_lvae.Config(
                config.preset,
                data,
                steps=config.lvae_steps,
                batch_size=config.lvae_batch_size,
                checkpoint_every=-(-config.lvae_steps // CHECKPOINTS),
                seed=config.seed,
            )
        ),
    )
    stages.run(
        "encode latents",
        lambda: encode_latents.encode(encode_latents.Config(dataset=data, lvae=lvae, actors=config.actors)),
    )
    stages.run(
        "train the diffusion transformer",
        lambda: train_dit.train(
            train_dit.Config(
                config.preset,
                data,
                steps=config.dit_steps,
                batch_size=config.dit_batch_size,
                checkpoint_every=-(-config.dit_steps // CHECKPOINTS),
                seed=config.seed,
            )
        ),
    )
    stages.run(
        "sample scenes",
        lambda: sample_scenes.sample(
            sample_scenes.Config(
                model=model,
                num_scenes=config.num_scenes,
                seed=config.seed,
                steps=config.sampling_steps,
                actors=config.actors,
                glb=1,
            )
        ),
    )
    stages.run(
        "outpaint a scene",
        lambda: outpaint_scenes.outpaint(
            outpaint_scenes.Config(
                model=model,
                source="generated-samples",
                limit=1,
                seed=config.seed,
                steps=config.outpaint_steps,
                guided=True,
            )
        ),
    )
    scores = stages.run(
        "evaluate",
        lambda: evaluate_scenes.evaluate(
            evaluate_scenes.Config(
                real=data,
                generated=home("generated"),
                run="samples",
                lvae=lvae,
                limit=config.num_test,
                actors=config.actors,
            )
        ),
    )
    report = home("report.html")
    stages.run("write the report", lambda: write_demo_report(report, config, scores, stages.seconds))
    print(f"\nreport: {os.path.relpath(report)}")


if __name__ == "__main__":
    run(main, Config, description=__doc__)
