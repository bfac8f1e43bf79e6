"""Implementation of jobs/furnish_place.py."""

from __future__ import annotations

from dataclasses import asdict

from jobs.furnish_place import Config
from jobs.implementation.checks import check_furnish_place
from jobs.support.cli import make_absolute, resolve_path
from jobs.support.inpainting_requests import make_execution, make_inpainting_config
from jobs.support.model_directories import find_pipeline_directory
from jobs.support.options import RePaintOptions
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from models.labels import ANY, mark_free
from pipelines.generation.inpaint import InpaintRequest, RegionConfig, inpaint_scenes
from pipelines.generation.sample import load_pipeline
from pipelines.preprocess.places import PlaceOptions, read_place
from pipelines.runtime import storage
from pipelines.schema.attribution import find_attribution
from pipelines.schema.run_guard import guard_run
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import Shard, find_unwritten

EVERYWHERE = RegionConfig(half_plane=(1.0, 0.0, -1e6))
SOURCES = {True: "opendrive", False: "osm"}


def list_places(config: Config) -> list[PlaceOptions]:
    """Return the places in the order of --origin."""
    pairs = list(zip(config.origin[::2], config.origin[1::2], strict=True)) or [None]
    return [PlaceOptions(pair, config.size_m, config.heading_deg, config.drive_on == "left") for pair in pairs]


def write_maps(config: Config, directory: str, resolution_m: float) -> SceneSubset:
    """Read the places and write their scenes.

    Args:
        config: Options of the job.
        directory: Dataset directory to write.
        resolution_m: Size of a pixel (m).

    Returns:
        The written scenes.
    """
    path, places = make_absolute(config.input), list_places(config)
    options = {"file": storage.fingerprint_files([path]), "places": [asdict(place) for place in places]}
    source = SOURCES[path.endswith((".xodr", ".xodr.gz"))]
    guard_run(directory, source, config.run, options | {"resolution_m": resolution_m})
    shard = Shard(directory, source, "unused", 0)
    if find_unwritten({shard: len(places)}):
        shard.write([read_place(path, place, resolution_m, number) for number, place in enumerate(places)])
    return SceneSubset(directory, source)


def main(config: Config) -> None:
    check_furnish_place(config)
    model, output = find_pipeline_directory(config.model), resolve_path(config.output, "furnished")
    pipeline, way = load_pipeline(model), RePaintOptions()
    kind, grid = pipeline.dit.config.label, pipeline.spec.grid
    block_m = grid.rows * grid.resolution_m
    if config.size_m < block_m:
        raise ValueError(f"--size-m is {config.size_m:g}, expected at least {block_m:g}, the size of a model's scene")
    request = InpaintRequest(
        model=model,
        output=output,
        run=config.run,
        where=EVERYWHERE,
        contents="objects",
        variants=config.num_variants,
        label=config.label or (mark_free(kind, f"{ANY}-{ANY}") if kind == "partial" else None),
        seed=config.seed,
        repaint=make_inpainting_config(way, model),
        execution=make_execution(way),
        guidance_scale=config.guidance_scale,
        constraints=config.constraints,
        keep=config.keep_categories,
    )
    with hold_output(output, request.source, config), JobProgress() as bar:
        maps = storage.join_uri(output, "maps", config.run)
        selection = write_maps(config, maps, grid.resolution_m)
        total = sum(len(rows) for _, rows in selection.shards())
        shown = bar.add_task("furnish", total=total)
        inpaint_scenes(request, selection, config.num_actors, total, lambda: bar.advance(shown))
    print(f"scenes, source {request.source}, and {config.run}.html in {output}")
    print(f"GLB files in {storage.join_uri(output, 'glb', config.run)}; the scenes of the map in {maps}")
    if notice := find_attribution(selection.shards()[0][0].source):
        print(f"licence of the data, which publications and exports must state: {notice}")
