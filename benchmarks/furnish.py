"""Score objects on the ground of real maps by relation statistics.

    python benchmarks/furnish.py EXTRACT.osm.gz ... --num-scenes 150

The poses lie on the streets of the extracts. Each is furnished by the model (jobs/furnish_place.py), by the rules of
the town (preprocess_scenes.py osm --furnish), and not at all. All sets, and other scenes of the town (the ceiling),
are compared with scenes of the town. The control moves the objects of the model.

The score is the Jensen-Shannon divergence of the histograms of relations (pipelines/metrics/relations.py), averaged
over the histograms of the generated categories that have MIN_OBJECTS objects in both sets. It does not depend on the
numbers of objects, which stand next to it. Buildings and walls are left out, because the map gives them. Data of
OpenStreetMap: (c) OpenStreetMap contributors, ODbL.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import tyro
from common import describe_machine

from models.composition.extend import inpaint_blocks
from models.pipeline import PrITTIPipeline
from models.pretrained import find_pipeline_path
from models.scene import CATEGORIES, Scene
from pipelines.generation.sample import resample_to_model_grid
from pipelines.metrics.controls import damage_scene
from pipelines.metrics.distributions import compute_jensen_shannon, normalize_histogram
from pipelines.metrics.intervals import Estimate, compute_weights, make_estimate
from pipelines.metrics.relations import RELATION_HISTOGRAMS, compute_scene_relations
from pipelines.preprocess.sources.osm.reader import OsmOptions, read_drive
from pipelines.preprocess.sources.town.generator import generate_town
from pipelines.schema.ground_surface import SURFACE, to_model_surface

KEPT = ("construction_big", "construction_small")
GENERATED = tuple(name for name in CATEGORIES if name not in KEPT)
MIN_OBJECTS = 30
GROUPS = {
    "vehicles": ("vehicle_big", "vehicle_small"),
    "vegetation": ("vegetation_cuboid", "vegetation_ellipsoid"),
    "poles, signs": ("pole", "traffic_control"),
    "other": ("two_wheelers", "human", "object"),
}
TOWN_SEED = 3_000_000


@dataclass(frozen=True)
class Config:
    files: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Extracts of OpenStreetMap."""
    num_scenes: int = 150
    """Number of scenes of each set."""
    model: str = "town"
    """Pipeline."""
    label: str = "any-any"
    """Density label."""


def read_maps(config: Config, furnish: bool) -> list[Scene]:
    """Return scenes of all extracts, evenly spaced over their poses."""
    scenes = []
    share = -(-config.num_scenes // len(config.files))
    for path in config.files:
        drive, _ = read_drive(path, OsmOptions(furnish=furnish, unmapped_ground="terrain", free_pose_share=0.0))
        scenes += [drive.scene(k) for k in np.linspace(0, len(drive) - 1, share).astype(int)]
    return scenes[: config.num_scenes]


def make_town_scenes(count: int) -> list[Scene]:
    """Return scenes of many towns. Even and odd scenes come from different towns."""
    towns = [generate_town(TOWN_SEED + k) for k in range(8)]
    poses = [np.linspace(0, len(town) - 1, -(-count // len(towns))).astype(int) for town in towns]
    return [towns[k % 8].scene(poses[k % 8][k // 8]) for k in range(count)]


def furnish_scenes(config: Config, pipeline: PrITTIPipeline, maps: list[Scene], knows_kept: bool) -> list[Scene]:
    """Return maps with generated objects. If `knows_kept` is false, the model does not see the kept objects."""
    found = []
    for number, scene in enumerate(maps):
        given = resample_to_model_grid(to_model_surface(scene, pipeline.spec), pipeline.spec)
        everywhere = np.ones((given.grid.rows, given.grid.cols), bool)
        keep = KEPT if knows_kept else ()
        if not knows_kept:
            given = given.select(np.zeros(len(given), bool))
        *_, last = inpaint_blocks(pipeline, given, everywhere, config.label, "objects", 0, [number], keep=keep)
        found.append(last.canvases[0])
    return found


def measure(scenes: list[Scene], slab_offset_m: float) -> tuple[np.ndarray, dict[str, float]]:
    """Return the counts (n, bins) of the relation histograms, and the mean numbers of objects per scene."""
    rows = np.stack([compute_scene_relations(scene, slab_offset_m).histograms for scene in scenes])
    counts = np.mean([scene.counts() for scene in scenes], axis=0)
    return rows, {name: sum(counts[CATEGORIES.index(k)] for k in members) for name, members in GROUPS.items()}


def compare(reference: np.ndarray, rows: np.ndarray) -> tuple[Estimate | None, int]:
    """Return the mean divergence (bits) of the histograms of generated categories, and their number."""
    drawn = [compute_weights(len(side), key) for key, side in enumerate((reference, rows))]
    ends, found = np.cumsum([len(histogram) for histogram in RELATION_HISTOGRAMS]), []
    for histogram, end in zip(RELATION_HISTOGRAMS, ends, strict=True):
        columns = slice(end - len(histogram), end)
        sides = reference[:, columns], rows[:, columns]
        if histogram.name.split(".")[0] in GENERATED and min(side.sum() for side in sides) >= MIN_OBJECTS:
            sums = (weights @ side.astype(float) for weights, side in zip(drawn, sides, strict=True))
            found.append(compute_jensen_shannon(*map(normalize_histogram, sums)))
    return make_estimate(np.mean(found, axis=0)) if found else None, len(found)


def main(config: Config) -> None:
    pipeline = PrITTIPipeline.from_pretrained(find_pipeline_path(config.model))
    pipeline.set_progress_bar_config(disable=True)
    offset_m, on_maps = pipeline.spec.slab_offset_m, 0.0 if SURFACE["osm"] == "surface" else pipeline.spec.slab_offset_m
    towns = make_town_scenes(2 * config.num_scenes)
    maps = read_maps(config, False)
    furnished = furnish_scenes(config, pipeline, maps, True)
    moved = [damage_scene("moved", scene, furnished[k - 1], (0, k)) for k, scene in enumerate(furnished)]
    sets = {
        "town, other scenes (ceiling)": (towns[1::2], offset_m),
        "map, furnished by rules": (read_maps(config, True), on_maps),
        "map, furnished by the model": (furnished, offset_m),
        "the same, kept objects unknown": (furnish_scenes(config, pipeline, maps, False), offset_m),
        "the same, objects moved (control)": (moved, offset_m),
        "map alone": (maps, on_maps),
    }
    reference, counts = measure(towns[::2], offset_m)
    print(describe_machine())
    print("| set | divergence from the town (bits) | " + " | ".join(f"{name} per scene" for name in GROUPS) + " |")
    print("|---" * (2 + len(GROUPS)) + "|")
    print("| town (reference) | – | " + " | ".join(f"{value:.1f}" for value in counts.values()) + " |")
    for name, (scenes, slab_m) in sets.items():
        rows, counts = measure(scenes, slab_m)
        value, number = compare(reference, rows)
        shown = " | ".join(f"{count:.1f}" for count in counts.values())
        distance = "–" if value is None else f"{value.value:.3f} ({value.low:.3f}–{value.high:.3f})"
        print(f"| {name} | {distance}, {number} histograms | {shown} |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
