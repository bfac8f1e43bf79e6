"""Compare the relations of town scenes with those of real scenes.

    python benchmarks/town_realism.py --kitti360 DATASET --version 1 2 --towns 48
    python benchmarks/town_realism.py --kitti360 DATASET --half first       while a generator is tuned
    python benchmarks/town_realism.py --kitti360 DATASET --glb SCENE.glb    with the authors' scenes

DATASET is the output of `jobs/preprocess_scenes.py kitti360`. Each quantity has one value per scene. The distance
between two sets of scenes is the Wasserstein distance between the distributions of these values, divided by the
standard deviation of the values over all real scenes. A generator is tuned on the first half of the drive and judged on
the second half; scenes of different halves are at least 64 m apart. The column "ceiling" is the distance between the
two real halves. The column "control" is the distance of damaged town scenes of the last version.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
import tyro
from common import describe_machine
from scipy.stats import wasserstein_distance

from models.layout import SLAB_OFFSET_M
from models.scene import CATEGORY_INDEX, Scene
from pipelines.io.mesh_import import import_glb
from pipelines.metrics.controls import damage_scene
from pipelines.metrics.relations import GROUND_CLASSES, RELATIONS, compute_scene_relations
from pipelines.preprocess.sources.town.generator import TOWN_VERSIONS, generate_town, select_poses
from pipelines.schema.tables import read_scenes

APART_M = 64.0
# Quantities of the comparison, by the property of a street that they describe.
QUANTITIES = {
    "distance from the road": (
        "construction_big.road_edge_m",
        "construction_small.road_edge_m",
        "vehicle_small.road_edge_m",
        "pole.road_edge_m",
        "vegetation_ellipsoid.road_edge_m",
        "vegetation_cuboid.road_edge_m",
        "vehicle_small.on_road",
    ),
    "alignment": (
        "construction_big.square_to_edge",
        "construction_big.along_neighbour",
        "construction_small.along_neighbour",
        "vehicle_small.along_edge",
    ),
    "spacing": (
        "construction_big.neighbour_log_m",
        "construction_small.neighbour_log_m",
        "vehicle_small.neighbour_log_m",
        "pole.neighbour_log_m",
        "vegetation_ellipsoid.neighbour_log_m",
    ),
    "support and heights": (
        "construction_big.supported",
        "traffic_control.supported",
        "traffic_control.gap_m",
        "building_height_m",
        "building_width_m",
    ),
    "ground": (
        "road_width_m",
        "road_width_std_m",
        "road.perimeter_per_m",
        "sidewalk.perimeter_per_m",
        "terrain.perimeter_per_m",
        "small_parts",
        "unannotated_share",
    ),
}
NAMES = tuple(name for names in QUANTITIES.values() for name in names)
MEASURES = (*RELATIONS, "building_height_m", "building_width_m", "small_parts", "unannotated_share")


@dataclass(frozen=True)
class Config:
    kitti360: str
    """Dataset directory of KITTI-360 scenes."""
    version: Annotated[tuple[int, ...], tyro.conf.arg(metavar="VERSION ...")] = TOWN_VERSIONS
    """Versions of the town."""
    towns: int = 48
    """Number of towns per version."""
    scenes_per_town: int = 8
    first_seed: int = 2_000_000
    """Seed of the first town. The default lies outside the ranges of the training and test towns."""
    half: Literal["first", "second"] = "second"
    """Half of the drive with which the towns are compared."""
    control: Literal["moved", "turned", "permuted", "transplanted"] = "permuted"
    """Damage of the control (pipelines/metrics/controls.py)."""
    glb: tuple[str, ...] = field(default=())
    """GLB files of real scenes, as a second reference."""


def split_drive(xy_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split the scenes of a drive into two halves whose poses are at least APART_M apart.

    The first half is the beginning of the drive. The second half contains the later scenes that lie far from each scene
    of the first half. The drive is cut where the smaller half is largest.

    Args:
        xy_m: (n, 2) positions of the poses along the drive (m).

    Returns:
        Indices of the first and of the second half.

    Raises:
        ValueError: The drive is too short for two halves.
    """
    distance_m = np.linalg.norm(xy_m[:, None] - xy_m[None], axis=2)
    best = (np.zeros(0, int), np.zeros(0, int))
    for cut in range(1, len(xy_m)):
        far = cut + np.flatnonzero((distance_m[cut:, :cut] >= APART_M).all(axis=1))
        if min(cut, len(far)) > min(map(len, best)):
            best = (np.arange(cut), far)
    if not len(best[0]):
        raise ValueError(f"no two of the {len(xy_m)} scenes are {APART_M:g} m apart; pass a longer drive")
    return best


def measure_scene(scene: Scene, slab_offset_m: float = SLAB_OFFSET_M) -> np.ndarray:
    """Return the values of MEASURES of one scene; NaN where a value is undefined."""
    relations = compute_scene_relations(scene, slab_offset_m).vector
    size_m = scene.size_m[scene.category == CATEGORY_INDEX["construction_big"]]
    height_m, width_m = (size_m[:, axis].mean() if len(size_m) else np.nan for axis in (2, 1))
    parts = np.nansum([relations[RELATIONS.index(f"{name}.small_parts")] for name in GROUND_CLASSES])
    unannotated = 1 - scene.occupied.any(axis=0).mean()
    return np.array([*relations, height_m, width_m, parts, unannotated])


def measure_scenes(scenes: Iterable[Scene]) -> np.ndarray:
    """Return the values (n, len(NAMES)) of NAMES of n scenes."""
    columns = [MEASURES.index(name) for name in NAMES]
    return np.array([measure_scene(scene)[columns] for scene in scenes]).reshape(-1, len(NAMES))


def compute_distances(values: np.ndarray, reference: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return the Wasserstein distance of each column, in units of `spread`; NaN where a side has no value.

    Args:
        values: (n, q) values of n scenes; NaN marks undefined values.
        reference: (m, q) values of the reference.
        spread: (q,) unit of each column.

    Returns:
        (q,) distances.
    """
    distances = np.full(len(spread), np.nan)
    for k, unit in enumerate(spread):
        a, b = (column[np.isfinite(column)] for column in (values[:, k], reference[:, k]))
        if len(a) and len(b) and unit > 0:
            distances[k] = wasserstein_distance(a, b) / unit
    return distances


def generate_scenes(version: int, config: Config) -> list[Scene]:
    """Return scenes of a vehicle from several towns of one version."""
    scenes = []
    for seed in range(config.first_seed, config.first_seed + config.towns):
        drive = generate_town(seed, version)
        scenes += [drive.scene(int(k)) for k in select_poses(len(drive), config.scenes_per_town)]
    return scenes


def damage_scenes(scenes: Sequence[Scene], control: str) -> list[Scene]:
    """Return damaged copies of scenes."""
    return [damage_scene(control, scene, scenes[k - 1], (0, k)) for k, scene in enumerate(scenes)]


def compare_pair(first: np.ndarray, last: np.ndarray) -> str:
    """Say for how many quantities the last version is nearer, and how much smaller its mean distance is."""
    both = np.isfinite(first) & np.isfinite(last)
    nearer, a, b = (last < first)[both].sum(), first[both].mean(), last[both].mean()
    return (
        f"nearer in {nearer} of {both.sum()} quantities; mean distance {a:.3f} -> {b:.3f}, "
        f"{100 * (1 - b / a):.1f} % smaller"
    )


def report_nearer(distances: dict[str, np.ndarray], config: Config) -> None:
    """Print the comparison of the last version with the first one, if there are two."""
    if len(distances) > 1:
        first, last = (f"town {config.version[k]}" for k in (0, -1))
        print(f"{last} against {first}: {compare_pair(distances[first], distances[last])}")


def print_table(reference: np.ndarray, columns: dict[str, np.ndarray], distances: dict[str, np.ndarray]) -> None:
    """Print one row per quantity: the mean of each set of scenes, then the distances."""
    heads = [f"distance {name}" for name in distances]
    print(f"| quantity | real | {' | '.join(columns)} | {' | '.join(heads)} |")
    print("|" + "---|" * (2 + len(columns) + len(distances)))
    for k, name in enumerate(NAMES):
        means = [np.nanmean(values[:, k]) for values in (reference, *columns.values())]
        cells = [f"{mean:.3f}" for mean in means] + [f"{values[k]:.2f}" for values in distances.values()]
        print(f"| {name} | {' | '.join(cells)} |")
    cells = [f"{np.nanmean(values):.3f}" for values in distances.values()]
    print(f"| mean distance | {' | '.join([''] * (1 + len(columns)) + cells)} |")


def main(config: Config) -> None:
    real = sorted(read_scenes(config.kitti360, "kitti360"), key=lambda scene: (scene.sequence, scene.frame))
    sequences = {scene.sequence for scene in real}
    if len(sequences) > 1:
        raise ValueError(f"{config.kitti360} holds the drives {sorted(sequences)}; pass a dataset with one drive")
    halves = split_drive(np.array([scene.world_xyz_m[:2] for scene in real]))
    first, second = (measure_scenes(real[k] for k in half) for half in halves)
    spread = np.nanstd(np.concatenate([first, second]), axis=0)
    reference, other = (first, second) if config.half == "first" else (second, first)
    print(f"{describe_machine()}\nreal halves: {len(first)} and {len(second)} scenes; compared with the {config.half}")

    scenes = {f"town {version}": generate_scenes(version, config) for version in config.version}
    columns = {name: measure_scenes(found) for name, found in scenes.items()}
    distances = {name: compute_distances(values, reference, spread) for name, values in columns.items()}
    control = measure_scenes(damage_scenes(list(scenes.values())[-1], config.control))
    extra = {"ceiling": compute_distances(other, reference, spread)}
    extra |= {"control": compute_distances(control, reference, spread)}
    print_table(reference, columns, distances | extra)
    report_nearer(distances, config)
    if config.glb:
        published = measure_scenes(import_glb(path) for path in config.glb)
        distances = {name: compute_distances(values, published, spread) for name, values in columns.items()}
        print(f"\n{len(published)} scenes from GLB files; unit: standard deviation over the scenes of KITTI-360")
        print_table(published, columns, distances)
        report_nearer(distances, config)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
