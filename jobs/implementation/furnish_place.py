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
from models.layout import LayoutSpec
from pipelines.generation.inpaint import InpaintRequest, RegionConfig, inpaint_scenes
from pipelines.generation.sample import load_pipeline
from pipelines.preprocess.places import PlaceOptions, read_place
from pipelines.preprocess.sources.opendrive import reader as opendrive
from pipelines.preprocess.sources.opendrive.file import SUFFIXES
from pipelines.preprocess.sources.osm import reader as osm
from pipelines.rendering.render import arrange_contact_sheet, encode_png, render_3d
from pipelines.runtime import storage
from pipelines.schema.attribution import find_attribution
from pipelines.schema.file_names import make_file_name
from pipelines.schema.ground_surface import from_model_surface
from pipelines.schema.run_guard import guard_run
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import Shard, find_unwritten

EVERYWHERE = RegionConfig(half_plane=(1.0, 0.0, -1e6))
WIDTH_PX, HEIGHT_PX, AZIMUTH_DEG, ELEVATION_DEG = 800, 600, 30.0, 50.0


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
    source = opendrive.SOURCE if path.endswith(SUFFIXES) else osm.SOURCE
    guard_run(directory, source, config.run, options | {"resolution_m": resolution_m})
    shard = Shard(directory, source, "unused", 0)
    if find_unwritten({shard: len(places)}):
        shard.write([read_place(path, place, resolution_m, number) for number, place in enumerate(places)])
    return SceneSubset(directory, source)


def write_pictures(output: str, run: str, selection: SceneSubset, request: InpaintRequest, spec: LayoutSpec) -> str:
    """Draw each place before and after, write PNG files, and return their directory."""
    directory = storage.join_uri(output, "pictures", run)
    given = [shard.scenes([row])[0] for shard, rows in selection.shards() for row in rows]
    for number, scene in enumerate(given):
        notice = f" {scene.attribution.split(', ')[0]}" if scene.attribution else ""
        made = [from_model_surface(one, scene, spec) for one in request.shard(number).scenes()]
        pictures = [render_3d(one, WIDTH_PX, HEIGHT_PX, AZIMUTH_DEG, ELEVATION_DEG) for one in (scene, *made)]
        captions = [f"map{notice}", *(f"furnished map{notice}" for _ in made)]
        data = encode_png(arrange_contact_sheet(pictures, 2, captions))
        path = storage.join_uri(directory, f"{make_file_name(scene.scene_id)}.png")
        storage.write_whole(path, lambda stream, data=data: stream.write(data))
    return directory


def main(config: Config) -> None:
    check_furnish_place(config)
    model, output = find_pipeline_directory(config.model), resolve_path(config.output, "furnished")
    pipeline, way = load_pipeline(model), RePaintOptions()
    kind, grid = pipeline.dit.config.label, pipeline.spec.grid
    block_m, cell_m = (grid.rows * grid.resolution_m / n for n in (1, pipeline.latent_shape[-1]))
    if config.size_m < block_m or config.size_m % cell_m:
        raise ValueError(
            f"--size-m is {config.size_m:g}, expected at least {block_m:g}, the size of a scene of the model, and a "
            f"multiple of {cell_m:g}"
        )
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
        pictures = write_pictures(output, config.run, selection, request, pipeline.spec)
    print(f"scenes, source {request.source}, and {config.run}.html in {output}")
    print(f"GLB files in {storage.join_uri(output, 'glb', config.run)}, pictures in {pictures}")
    print(f"scenes of the map in {maps}")
    if notice := find_attribution(selection.shards()[0][0].source):
        print(f"licence of the data, which publications and exports must state: {notice}")
