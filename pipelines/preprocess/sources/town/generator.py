"""The built-in source: a procedural town from a seed, fitted to statistics of KITTI-360 (reference_statistics.py).

    drive = generate_town(7)       # one town and one drive through its streets
    scene = drive.scene(0)         # the scene ahead of the first pose

The module depends only on numpy. The same seed, version and numpy version give the same town. Version 2
(town/version2) is nearer to real streets. A change of the output of a version needs a new version.
"""

from __future__ import annotations

import numpy as np

from models.scene import KITTI_GROUND_CLASSES
from pipelines.preprocess.sources.drive import Drive
from pipelines.preprocess.sources.town.assets import Site
from pipelines.preprocess.sources.town.blocks import furnish_block
from pipelines.preprocess.sources.town.districts import DISTRICTS, TOWN_KINDS, Mood, draw_mood
from pipelines.preprocess.sources.town.kitti360_writer import write_kitti360
from pipelines.preprocess.sources.town.land import Sheet, draw_land
from pipelines.preprocess.sources.town.reference_statistics import TARGETS
from pipelines.preprocess.sources.town.streets import lay_streets, list_blocks, pave_streets, plan_route
from pipelines.preprocess.sources.town.version2 import town as version2
from pipelines.preprocess.sources.town.world import (
    METRES_PER_FRAME,
    collect_boxes,
    collect_ground,
    make_poses,
    measure_travel,
    place_traffic,
    sample_poses,
)

__all__ = [
    "TARGETS",
    "TEST_SEEDS_START",
    "TOWN_VERSION",
    "TOWN_VERSIONS",
    "TRAIN_SEEDS_START",
    "generate_town",
    "plan_town_parts",
    "select_poses",
    "select_town_poses",
    "write_kitti360",
]

TOWN_VERSION = 1  # Default version of `generate_town`; that of the job is 2.
TOWN_VERSIONS = (1, 2)
TRAIN_SEEDS_START = 0
TEST_SEEDS_START = 1_000_000
SCENES_PER_TOWN = 200  # Every town has at least this number of poses.
SPACING_M = {"centre": (54, 69), "suburb": (54, 71), "green": (70, 98)}


def generate_town(seed: int, version: int = TOWN_VERSION, num_free_poses: int = 0) -> Drive:
    """Generate one town, and one drive through its streets with up to 256 poses.

    Poses of the vehicle are at least 10 m apart. Frame numbers ascend along the drive. Each moving box belongs to one
    frame. Seed modulo 4 determines the districts. The seed determines all other properties.

    Args:
        seed: Seed of the town.
        version: Version of the town (TOWN_VERSIONS).
        num_free_poses: Number of additional poses at any place and heading of the built area. They follow the poses of
            the vehicle, and no moving box belongs to their frames. Version 1 has no free poses.

    Returns:
        The drive.

    Raises:
        ValueError: The version is unknown, or free poses are requested from version 1.
    """
    if version not in TOWN_VERSIONS:
        raise ValueError(f"town_version is {version}, expected one of {', '.join(map(str, TOWN_VERSIONS))}")
    if version == 2:
        return version2.make_town(seed, num_free_poses)
    if num_free_poses:
        raise ValueError(
            f"{num_free_poses} free poses are requested, but version 1 of the town has none; use version 2"
        )
    return _make_town_version_1(seed)


def _make_town_version_1(seed: int) -> Drive:
    rng = np.random.default_rng([7301, seed])
    main, edge = TOWN_KINDS[seed % len(TOWN_KINDS)]
    land = draw_land(rng)
    columns, rows = (4, 5) if main != "green" else (4, 4)
    split = 3 if rng.random() < 0.5 else columns - 1
    spacing_u = [rng.uniform(*SPACING_M[main if i < split else edge]) for i in range(columns)]
    spacing_v = [rng.uniform(*SPACING_M[main]) for _ in range(rows)]
    streets, cells = lay_streets(rng, spacing_u, spacing_v, missing=0.12 if main != "green" else 0.2)
    border = streets.u_m[split]

    sheet = Sheet()
    pave_streets(streets, sheet)
    mood_of_town = np.exp(rng.normal(0, [0.04, 0.0, 0.1, 0.1, 0.1, 0.05, 0.08, 0.1, 0.1, 0.1, 0.15, 0.15]))
    for block in list_blocks(streets, cells, lambda u, v: main if u < border else edge, outskirts_m=48.0):
        mood = draw_mood(rng)
        mood = Mood(*(np.array(list(vars(mood).values())) * mood_of_town).tolist())
        furnish_block(Site(sheet, rng, DISTRICTS[block.kind], mood), block)

    route = plan_route(rng, streets)
    at = sample_poses(rng, route, land)
    frame = np.round(measure_travel(route, land)[at] / METRES_PER_FRAME).astype(np.int64)
    place_traffic(sheet, rng, route, at, frame)
    return Drive(
        source="town",
        sequence=f"{seed:05d}",
        **collect_boxes(sheet, rng, land),
        ground_classes=KITTI_GROUND_CLASSES,
        ground=collect_ground(sheet, land),
        frame=frame,
        world_from_imu=make_poses(rng, route, at, land),
    )


def plan_town_parts(num_train: int = 10_000, num_test: int = 1_000, seed: int = 0) -> list[tuple[int, str, int]]:
    """Return (town seed, split, number of scenes) of every town.

    The totals are num_train and num_test scenes. Training and test scenes come from different towns. Even a small
    number of scenes comes from several towns. `select_poses` selects the poses of a town. Another `seed` gives other
    towns.
    """
    plan = []
    for split, wanted, start in (("train", num_train, TRAIN_SEEDS_START), ("test", num_test, TEST_SEEDS_START)):
        if wanted < 0:
            raise ValueError(f"the number of {split} scenes is {wanted}, expected 0 or more")
        towns = max(-(-wanted // SCENES_PER_TOWN), min(24, -(-wanted // 6)))
        towns = -(-towns // len(TOWN_KINDS)) * len(TOWN_KINDS) if wanted >= len(TOWN_KINDS) else wanted
        share = np.diff(np.linspace(0, wanted, towns + 1).round().astype(int)) if towns else []
        first = start + seed * 10_000
        plan += [(first + k, split, int(n)) for k, n in enumerate(share)]
    return plan


def select_poses(num_poses: int, num_scenes: int) -> np.ndarray:
    """Select num_scenes evenly spaced poses of a drive.

    Args:
        num_poses: Number of poses of the drive.
        num_scenes: Number of poses to select.

    Returns:
        (num_scenes,) indices of the poses.

    Raises:
        ValueError: The drive has too few poses.
    """
    if num_scenes > num_poses:
        raise ValueError(f"{num_scenes} scenes are requested, but the drive has {num_poses} poses; plan more towns")
    return ((np.arange(num_scenes) + 0.5) * num_poses / max(1, num_scenes)).astype(np.int64)


def select_town_poses(num_poses: int, num_scenes: int, num_free: int) -> np.ndarray:
    """Select all free poses of a town, and evenly spaced poses of its vehicle.

    Args:
        num_poses: Number of poses of the drive; the last num_free poses are free.
        num_scenes: Number of poses to select.
        num_free: Number of free poses.

    Returns:
        (num_scenes,) indices of the poses.

    Raises:
        ValueError: The drive has too few poses.
    """
    first = num_poses - num_free
    return np.concatenate([select_poses(first, num_scenes - num_free), np.arange(first, num_poses)])
