"""Implementation of jobs/run_demo.py."""

from __future__ import annotations

import os

from jobs.encode_latents import Config as EncodeConfig
from jobs.evaluate_scenes import Config as EvaluateConfig
from jobs.implementation import preprocess_scenes, train_dit, train_lvae
from jobs.implementation.demo_report import write_demo_report
from jobs.implementation.encode_latents import encode
from jobs.implementation.evaluate_scenes import evaluate
from jobs.implementation.outpaint_scenes import outpaint
from jobs.implementation.sample_scenes import sample
from jobs.outpaint_scenes import Config as OutpaintConfig
from jobs.preprocess_scenes import Town
from jobs.run_demo import Config
from jobs.sample_scenes import Config as SampleConfig
from jobs.support.cli import home_path, make_absolute
from jobs.support.ray_session import start_ray
from jobs.support.stages import Stages
from jobs.train_dit import Config as DiTConfig
from jobs.train_lvae import Config as LVAEConfig
from models.uris import is_uri
from pipelines.rendering.render import arrange_contact_sheet, encode_png, render_3d
from pipelines.runtime import storage
from pipelines.schema.tables import read_scenes

RELEASED = "town"
CHECKPOINTS = 8  # number of checkpoints per training run; a validation with pictures runs at each checkpoint


def show_released(config: Config) -> None:
    """Generate scenes with the released weights, and draw the scenes."""
    sample(
        SampleConfig(
            model=RELEASED,
            output=home_path("released"),
            num_scenes=config.num_released_scenes,
            seed=config.seed,
            num_glb=1,
        )
    )
    scenes = read_scenes(home_path("released"), "generated-samples")
    sheet = arrange_contact_sheet([render_3d(scene, 480, 360) for scene in scenes], columns=4)
    path = home_path("released.png")
    storage.write_whole(path, lambda stream: stream.write(encode_png(sheet)))
    print(f"pictures: {shorten_path(path)}; the next stages train a model of this kind")


def shorten_path(path: str) -> str:
    """Return a local path relative to the working directory, or a URI as it is."""
    return path if is_uri(path) else os.path.relpath(path)


def main(config: Config) -> None:
    os.environ["PRITTI_HOME"] = make_absolute(config.output)
    if not is_uri(config.output):  # The demo writes all files under the output directory.
        os.environ.pop("MLFLOW_TRACKING_URI", None)
    stages = Stages(home_path("stages.json"), total=9 if config.num_released_scenes else 8)
    start_ray(training=True)
    if config.num_released_scenes:
        stages.run("sample scenes of the released model", lambda: show_released(config))
    run_training_stages(config, stages)
    scores = run_generation_stages(config, stages)
    report = home_path("report.html")
    stages.run("write the report", lambda: write_demo_report(report, config, scores, stages.seconds))
    print(f"\nreport: {shorten_path(report)}")


def run_training_stages(config: Config, stages: Stages) -> None:
    """Preprocess the town, train the layout VAE, encode latents, train the diffusion transformer."""
    data = home_path("datasets", "town")
    town = Town(output=data, num_train=config.num_train, num_test=config.num_test, seed=config.seed)
    stages.run("preprocess the town", lambda: preprocess_scenes.main(town))
    lvae = LVAEConfig(
        config.preset,
        data,
        steps=config.lvae_steps,
        batch_size=config.lvae_batch_size,
        checkpoint_every=-(-config.lvae_steps // CHECKPOINTS),
        seed=config.seed,
    )
    stages.run("train the layout VAE", lambda: train_lvae.train(lvae))
    latents = EncodeConfig(dataset=data, lvae=find_lvae_directory(config), num_actors=config.num_actors)
    stages.run("encode latents", lambda: encode(latents))
    dit = DiTConfig(
        config.preset,
        data,
        steps=config.dit_steps,
        batch_size=config.dit_batch_size,
        checkpoint_every=-(-config.dit_steps // CHECKPOINTS),
        seed=config.seed,
    )
    stages.run("train the diffusion transformer", lambda: train_dit.train(dit))


def run_generation_stages(config: Config, stages: Stages) -> dict:
    """Sample scenes, outpaint one scene, evaluate, and return the scores."""
    model = home_path("models", f"pritti-{config.preset}")
    sampling = SampleConfig(
        model=model,
        num_scenes=config.num_scenes,
        seed=config.seed,
        num_inference_steps=config.num_inference_steps,
        num_actors=config.num_actors,
        num_glb=1,
    )
    stages.run("sample scenes", lambda: sample(sampling))
    outpainting = OutpaintConfig(
        model=model,
        source="generated-samples",
        max_scenes=1,
        seed=config.seed,
        num_inference_steps=config.outpaint_inference_steps,
        inpainting="guided",
    )
    stages.run("outpaint a scene", lambda: outpaint(outpainting))
    evaluation = EvaluateConfig(
        real=home_path("datasets", "town"),
        generated=home_path("generated"),
        run="samples",
        lvae=find_lvae_directory(config),
        max_reconstructed_scenes=config.num_test,
        num_actors=config.num_actors,
    )
    return stages.run("evaluate", lambda: evaluate(evaluation))


def find_lvae_directory(config: Config) -> str:
    """Return the directory of the trained layout VAE."""
    return home_path("models", f"lvae-{config.preset}")
