"""Implementation of jobs/inpaint_scenes.py."""

from __future__ import annotations

from jobs.implementation.checks import check_inpaint_scenes
from jobs.inpaint_scenes import Config
from jobs.support.inpainting_requests import make_execution, make_inpainting_config
from jobs.support.model_directories import find_pipeline_directory
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from jobs.support.scene_requests import select_scenes
from pipelines.generation.inpaint import InpaintRequest, RegionConfig, inpaint_scenes


def inpaint(config: Config) -> dict[str, float | None]:
    """Regenerate the region, write the scenes, and return the drift of the decoded scenes outside the region."""
    check_inpaint_scenes(config)
    selection = select_scenes(config)
    total = sum(len(rows) for _, rows in selection.shards())
    model = find_pipeline_directory(config.model)
    request = InpaintRequest(
        model=model,
        output=config.output_directory(),
        run=config.run,
        where=RegionConfig(
            config.polygon_m, config.half_plane, config.primitives, config.margin_m, config.invert_region
        ),
        contents=config.contents,
        variants=config.num_variants,
        label=config.label or None,
        seed=config.seed,
        repaint=make_inpainting_config(config, model),
        execution=make_execution(config),
        guidance_scale=config.guidance_scale,
        constraints=config.constraints,
        keep=config.keep_categories,
    )
    with hold_output(request.output, request.source, config), JobProgress() as bar:
        shown = bar.add_task("inpaint", total=total)
        return inpaint_scenes(request, selection, config.num_actors, config.num_examples, lambda: bar.advance(shown))


def main(config: Config) -> None:
    scores = inpaint(config)
    print(f"scenes, source generated-{config.run}, GLB files and {config.run}.html in {config.output_directory()}")
    values = {name: "–" if value is None else f"{value:.4g}" for name, value in scores.items()}
    print("drift outside the region:", ", ".join(f"{name} {value}" for name, value in values.items()))
