"""Implementation of jobs/sample_scenes.py."""

from __future__ import annotations

from rich.progress import MofNCompleteColumn, Progress, TaskProgressColumn

from jobs.implementation.checks import check_sample_scenes
from jobs.sample_scenes import Config
from jobs.support.cli import resolve_path
from jobs.support.model_directories import find_pipeline_directory, read_label_kind
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from models.execution import SamplingExecution
from models.labels import list_usual_labels
from pipelines.generation.sample import SampleRequest, sample_scenes
from pipelines.io.mesh_export import export_glb
from pipelines.runtime import storage
from pipelines.schema.file_names import make_file_name
from pipelines.schema.tables import read_scenes


def sample(config: Config) -> str:
    """Generate scenes and return the dataset directory."""
    check_sample_scenes(config)
    model = find_pipeline_directory(config.model)
    output = resolve_path(config.output, "generated")
    request = SampleRequest(
        model=model,
        output=output,
        run=config.run,
        num_scenes=config.num_scenes,
        labels=config.labels or list_usual_labels(read_label_kind(model)),
        seed=config.seed,
        num_inference_steps=config.num_inference_steps,
        guidance_scale=config.guidance_scale,
        sampler=config.sampler,
        noise_scaling=config.noise_scaling,
        existence_threshold=config.existence_threshold,
        pag_scale=config.pag_scale,
        constraints=config.constraints,
        repair=config.repair,
        shard_scenes=min(64, max(1, -(-config.num_scenes // 8))),
        execution=SamplingExecution(config.precision, config.cuda_graphs, config.compile, config.decode_batch_size),
    )
    with hold_output(output, request.source, config):
        columns = (*Progress.get_default_columns(), MofNCompleteColumn(), TaskProgressColumn(show_speed=True))
        with JobProgress(*columns) as bar:
            shown = bar.add_task("sample scenes", total=config.num_scenes)

            def advance(row: dict) -> None:
                bar.advance(shown, row["scenes"])
                if row["fallbacks"]:
                    total = row["guided"] + row["fallbacks"]
                    print(
                        f"constraints: shard {row['id']}: {row['fallbacks']} of {total} guided steps had no finite"
                        " gradient and continued without guidance"
                    )

            sample_scenes(request, config.num_actors, config.batch_size, advance)
        for scene in read_scenes(output, f"generated-{config.run}", limit=config.num_glb) if config.num_glb else ():
            path = storage.join_uri(output, "glb", config.run, f"{make_file_name(scene.scene_id)}.glb")
            storage.write_whole(path, lambda stream, scene=scene: stream.write(export_glb(scene)))
        return output


def main(config: Config) -> None:
    print(f"{config.num_scenes} scenes of source generated-{config.run} in {sample(config)}")
