"""Implementation of jobs/outpaint_scenes.py."""

from __future__ import annotations

import io
from dataclasses import fields
from math import ceil

import numpy as np
from PIL import Image, UnidentifiedImageError
from rich.progress import MofNCompleteColumn, Progress

from jobs.implementation.checks import check_outpaint_scenes
from jobs.outpaint_scenes import Config
from jobs.support.cli import make_absolute
from jobs.support.inpainting_requests import make_execution, make_inpainting_config
from jobs.support.model_directories import find_pipeline_directory, read_label_kind
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from jobs.support.scene_requests import select_scenes
from models.composition.block_grid import Arrangement, choose_arrangement, label_blocks
from models.composition.outpaint import MIN_KNOWN_GROUND
from models.composition.road_sketch import RoadMap, SketchedRoad
from pipelines.generation.outpaint import OutpaintRequest, outpaint_scenes
from pipelines.runtime import storage

BLOCK_M = 64.0  # size of the scenes in every dataset (paper, Sec. 3.1)
WHITE, GREY = 192, 64  # Lowest brightness of roads and of sidewalks in a map.
MAX_MAP_PX = 20_000


def arrange_blocks(config: Config) -> tuple[tuple[int, int, int, int], Arrangement]:
    """Return the numbers of blocks ahead, behind, left and right of the scene, and their arrangement.

    Raises:
        ValueError: A number is negative, or all numbers are 0.
    """
    chosen = config.order, config.overlap, config.free_blocks, config.margin
    if config.extent_m is None:
        counts = config.blocks_ahead, config.blocks_behind, config.blocks_left, config.blocks_right
        arrangement = choose_arrangement(counts, *chosen)
    else:
        is_far = max(config.extent_m) > 2 * BLOCK_M  # The paper's blocks on each side add half a block.
        arrangement = choose_arrangement((2 if is_far else 1, 0, 0, 0), *chosen)
        step_m = BLOCK_M * (1 - arrangement.overlap)
        if not 0 < step_m <= BLOCK_M or min(config.extent_m) < BLOCK_M:
            raise ValueError(
                f"--extent-m is {config.extent_m}, --overlap is {arrangement.overlap}: "
                f"expected an extent of at least {BLOCK_M} m and an overlap in [0, 1)"
            )
        sides = [ceil((extent - BLOCK_M) / 2 / step_m - 1e-9) for extent in config.extent_m]
        counts = sides[0], sides[0], sides[1], sides[1]
    if min(counts) < 0 or not any(counts):
        raise ValueError(
            f"--blocks-ahead, --blocks-behind, --blocks-left and --blocks-right are {counts}: "
            "expected numbers of at least 0, and at least one block"
        )
    return counts, arrangement


def report_extent(config: Config, counts: tuple[int, int, int, int], overlap: float) -> None:
    """Print the size of the result if it differs from --extent-m."""
    step_m = BLOCK_M * (1 - overlap)
    actual = tuple(BLOCK_M + (a + b) * step_m for a, b in (counts[:2], counts[2:]))
    if config.extent_m and max(abs(a - b) for a, b in zip(actual, config.extent_m, strict=True)) > 1e-6:
        wanted, made = (" x ".join(f"{length:g}" for length in size) for size in (config.extent_m, actual))
        print(f"--extent-m: {wanted} m is no whole number of blocks; the result is {made} m")


def read_labels_map(path: str, kind: str, counts: tuple[int, int, int, int]) -> tuple[tuple[str, ...], ...]:
    """Return the labels of a map, row by row.

    Raises:
        ValueError: The file does not hold lists of labels, a label is unknown to models with this kind of label, or the
            map has another size than the city.
    """
    rows = storage.read_json(make_absolute(path))
    if not isinstance(rows, list) or not all(
        isinstance(row, list) and all(isinstance(name, str) for name in row) for row in rows
    ):
        raise ValueError(f'--labels-map {path}: expected lists of labels, such as [["low-low", "low-high"]]')
    try:
        label_blocks(kind, rows, counts)
    except ValueError as error:
        raise ValueError(f"--labels-map {path}: {error}") from error
    return tuple(tuple(row) for row in rows)


def read_road_sketch(path: str, pixel_m: float) -> tuple[SketchedRoad | RoadMap, ...]:
    """Return the roads of a sketch, a JSON or PNG file.

    Raises:
        ValueError: The file does not hold roads.
    """
    if path.lower().endswith(".png"):
        return (read_road_map(path, pixel_m),)
    roads = storage.read_json(make_absolute(path))
    names = {field.name for field in fields(SketchedRoad)}
    if not isinstance(roads, list) or not all(isinstance(road, dict) and road.keys() <= names for road in roads):
        raise ValueError(f'--road-sketch {path}: expected a list such as [{{"points_m": [[64, 0], [200, 40]]}}]')
    try:
        return tuple(SketchedRoad(**road | {"points_m": tuple(map(tuple, road["points_m"]))}) for road in roads)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"--road-sketch {path}: {error}") from error


def read_road_map(path: str, pixel_m: float) -> RoadMap:
    """Return the map of a PNG file: white roads, grey sidewalks, black elsewhere.

    Raises:
        ValueError: The file is no picture or too large, or shows no road.
    """
    try:
        with Image.open(io.BytesIO(storage.read_bytes(make_absolute(path)))) as picture:
            if max(picture.size) > MAX_MAP_PX:
                raise ValueError(f"the picture has {picture.size} pixels, at most {MAX_MAP_PX} per side are allowed")
            brightness = np.asarray(picture.convert("L"))
        classes = np.where(brightness >= WHITE, 1, np.where(brightness >= GREY, 2, 0)).astype(np.uint8)
        if not (classes == 1).any():
            raise ValueError(f"the picture shows no road; roads are white (brightness of at least {WHITE})")
        return RoadMap.from_classes(classes, pixel_m, (BLOCK_M / 2, 0.0))
    except (UnidentifiedImageError, ValueError) as error:
        raise ValueError(f"--road-sketch {path}: {error}") from error


def outpaint(config: Config) -> list[str]:
    """Extend scenes and write them; return the path of each scene's table with the known ground in each block."""
    counts, arrangement = arrange_blocks(config)
    report_extent(config, counts, arrangement.overlap)
    check_outpaint_scenes(config)
    selection, model = select_scenes(config), find_pipeline_directory(config.model)
    count = sum(len(rows) for _, rows in selection.shards())
    request = OutpaintRequest(
        model=model,
        output=config.output_directory(),
        run=config.run,
        label=config.label or None,
        labels_map=read_labels_map(config.labels_map, read_label_kind(model), counts) if config.labels_map else None,
        free_blocks=arrangement.free_blocks,
        tile_m=config.tile_m,
        roads=read_road_sketch(config.road_sketch, config.sketch_pixel_m) if config.road_sketch else (),
        seed=config.seed,
        overlap=arrangement.overlap,
        margin=config.margin,
        plan_streets=config.plan_streets,
        mode=config.neighbour_latents,
        repaint=make_inpainting_config(config, model),
        execution=make_execution(config),
        guidance_scale=config.guidance_scale,
        constraints=config.constraints,
        num_blocks=counts,
        order=arrangement.order,
        batch_size=config.batch_size,
    )
    with hold_output(request.output, request.source, config):
        ahead, behind, left, right = counts
        with JobProgress(*Progress.get_default_columns(), MofNCompleteColumn()) as bar:
            shown = bar.add_task("outpaint, blocks", total=count * ((ahead + behind + 1) * (left + right + 1) - 1))
            return outpaint_scenes(request, selection, config.num_actors, lambda blocks: bar.advance(shown, blocks))


def main(config: Config) -> None:
    tables, output = outpaint(config), config.output_directory()
    known = [storage.read_parquet(path, ["known_ground"])["known_ground"].to_numpy() for path in tables]
    bare, count = sum(int((share < MIN_KNOWN_GROUND).sum()) for share in known), sum(map(len, known))
    print(f"outpainted scenes, source generated-{config.run}, and GLB files in {output}")
    if config.tile_m is not None:
        print(f"pages that show the cities in 3D: {output}/pages/{config.run}/*/index.html")
    if bare:
        print(
            f"{bare} of {count} blocks had almost no known ground (known_ground below {MIN_KNOWN_GROUND} in "
            f"{output}/block_tables/{config.run}/*.parquet). They were generated without their surroundings; with "
            "--neighbour-latents paper, they failed, as in the paper"
        )
