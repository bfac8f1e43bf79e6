#!/usr/bin/env python3
"""Generate scenes with a trained pipeline -> the same Parquet tables, source=generated-<run>.

    jobs/sample_scenes.py                                           64 town scenes, labels in equal parts
    jobs/sample_scenes.py --num-scenes 1000 --labels low --seed 7 --actors 2
    jobs/sample_scenes.py --num-scenes 4 --glb 4                    with GLB files of the first four
    jobs/sample_scenes.py --sampler dpm++ --steps 20                eleven times as fast

Scene i depends on --seed and i only, whatever the number of actors or the batch. Run it again with the same options
to go on after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jobs.support.cli import absolute, home, require_positive, run, start_ray
from jobs.support.options import ModelOption, model_label_kind, pipeline_directory, require_model_labels


@dataclass(frozen=True)
class Config:
    model: ModelOption = ""
    output: str = ""
    """Dataset directory (default: $PRITTI_HOME/generated)."""
    run: str = "samples"
    """Name of the run: scenes get source=generated-<run>."""
    num_scenes: int = 64
    labels: tuple[str, ...] = ()
    """Labels, in turn over the scenes (default: all that the model knows, balanced)."""
    seed: int = 0
    """Scene i depends on the seed, i and its label alone."""
    sampler: Literal["ddpm", "ddim", "dpm++", "sde-dpm++"] = "ddpm"
    """The paper's, DDIM, or DPM-Solver++, which needs the fewest steps; sde-: with noise on the way."""
    steps: int = 250
    """Denoising steps; the paper takes 250."""
    guidance: float = 1.0
    """Classifier-free guidance scale; 1 is none (the paper's metrics), 4 the paper's pictures."""
    noise_scaling: float | None = None
    """Divide the network's noise by this: a little above 1 brings back small and rare things that sampling loses (default: what
    the model was published with; 1 with ddpm)."""
    existence_threshold: float | None = None
    """Primitives that are more probable than this are in a scene (default: what the model was published with; the paper's is 0.3)."""
    repair: bool = False
    """Put what floats or is sunken onto the ground and push apart what overlaps; nothing is taken out (as jobs/edit_scenes.py
    repair --no-drop)."""
    actors: int = 1
    """Pipelines at work at once; one per GPU."""
    batch_size: int = 8
    """Scenes at once in each pipeline; changes no scene beyond rounding."""
    glb: int = 0
    """Also export the first N scenes as GLB under <output>/glb/<run>."""


def sample(config: Config) -> str:
    """Generate and return the dataset directory."""
    require_positive(config, "num_scenes", "steps", "actors", "batch_size")
    model = pipeline_directory(config.model)
    require_model_labels(model, config.labels)
    from rich.progress import MofNCompleteColumn, Progress, TaskProgressColumn

    from models.labels import LABELS
    from pipelines.generation.sample import SampleRequest, sample_scenes
    from pipelines.io.mesh_export import scene_glb
    from pipelines.runtime import storage
    from pipelines.schema.tables import read_scenes

    output = absolute(config.output) if config.output else home("generated")
    request = SampleRequest(
        model=model,
        output=output,
        run=config.run,
        num_scenes=config.num_scenes,
        labels=config.labels or LABELS[model_label_kind(model)],
        seed=config.seed,
        num_inference_steps=config.steps,
        guidance_scale=config.guidance,
        sampler=config.sampler,
        noise_scaling=config.noise_scaling,
        existence_threshold=config.existence_threshold,
        repair=config.repair,
        shard_scenes=min(64, max(1, -(-config.num_scenes // 8))),
    )
    start_ray()
    columns = (*Progress.get_default_columns(), MofNCompleteColumn(), TaskProgressColumn(show_speed=True))
    with Progress(*columns) as bar:
        shown = bar.add_task("sample scenes", total=config.num_scenes)
        sample_scenes(request, config.actors, config.batch_size, lambda row: bar.advance(shown, row["scenes"]))
    for scene in read_scenes(output, f"generated-{config.run}", limit=config.glb) if config.glb else ():
        path = storage.join(output, "glb", config.run, f"{scene.scene_id}.glb")
        storage.write_whole(path, lambda stream, scene=scene: stream.write(scene_glb(scene)))
    return output


def main(config: Config) -> None:
    print(f"{config.num_scenes} scenes of source generated-{config.run} in {sample(config)}")


if __name__ == "__main__":
    run(main, Config, description=__doc__)
