"""Make a town of version 2: streets of several widths, rows of houses, and crops at any place and heading.

Compared with version 1, houses stand on building lines on all sides of a block, most objects stand near the street, and
the annotated ground ends behind the houses. Buildings overlap neither streets nor each other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from models.geometry.iou3d import make_boxes
from models.geometry.suppression import find_suppressed
from models.scene import CATEGORY_INDEX, KITTI_GROUND_CLASSES, Grid, Scene, make_yaw_rotation
from pipelines.preprocess.sources.drive import STATIC, Drive, SlabGround
from pipelines.preprocess.sources.town.districts import TOWN_KINDS
from pipelines.preprocess.sources.town.land import Land, draw_land
from pipelines.preprocess.sources.town.streets import (
    CityBlock,
    Streets,
    lay_streets,
    list_blocks,
    pave_streets,
    plan_route,
)
from pipelines.preprocess.sources.town.version2.assets import Site, StreetSheet
from pipelines.preprocess.sources.town.version2.blocks import furnish_block
from pipelines.preprocess.sources.town.version2.districts import DISTRICTS, Variation, draw_variation
from pipelines.preprocess.sources.town.version2.footprints import compute_corners, find_covered, separate_buildings
from pipelines.preprocess.sources.town.world import (
    IMU_HEIGHT_M,
    METRES_PER_FRAME,
    collect_boxes,
    collect_ground,
    make_poses,
    measure_travel,
    place_traffic,
    sample_poses,
)

SPACING_M = {"centre": (45, 61), "suburb": (48, 66), "green": (58, 90)}
OUTSKIRTS_M = 48.0
MISSING = 0.2  # Share of inner streets that are omitted. Their ends become T-junctions.
# Share and range of the half width of each class of streets.
STREET_CLASSES = (("residential", 0.51, (2.4, 2.9)), ("collector", 0.33, (3.0, 3.7)), ("main", 0.16, (4.0, 5.0)))
CORNER_M = (3.5, 7.5)  # Radius of kerbs.
SKEWED = 0.7  # Share of towns whose streets do not cross at right angles.
MAX_SKEW = 0.3  # Largest tangent of the deviation from a right angle.
SKEW_WAVE_M = 4000.0
SUNK_M = 0.1  # Least depth of a building below the lowest surface under its corners.
# Depth of static objects below the surface (m): mean, standard deviation, and limits. Source: first half of the
# KITTI-360 excerpt. Its cars vary by 2 cm, apart from one that floats. It has no people, two-wheelers and trucks; their
# values are assumed.
DEPTH_M = {
    "vegetation_cuboid": (0.2, 0.3, (-0.2, 1.2)),
    "construction_big": (0.25, 0.35, (0.0, 1.5)),
    "construction_small": (0.3, 0.3, (0.0, 1.2)),
    "pole": (0.14, 0.05, (0.0, 0.3)),
    "object": (0.12, 0.12, (0.0, 0.45)),
    "two_wheelers": (0.03, 0.03, (0.0, 0.1)),
    "human": (0.03, 0.03, (0.0, 0.1)),
    "vehicle_small": (0.0, 0.02, (-0.03, 0.03)),
    "vehicle_big": (0.0, 0.02, (-0.03, 0.03)),
}
# Categories whose objects do not overlap, as in KITTI-360.
APART = [CATEGORY_INDEX[name] for name in ("construction_small", "human", "two_wheelers", "object")]
APART_IOU3D = np.full(len(CATEGORY_INDEX), 0.15)  # Largest IoU3D of two objects of the same category.
FREE_CROP_M = 64.0  # Side of the crop ahead of a free pose.
FREE_MARGIN_M = 14.0  # Largest distance of the corners of a free crop from the outermost streets.
MAX_TRIES = 10_000
STREET_CLASS = [KITTI_GROUND_CLASSES.index(name) for name in ("road", "sidewalk")]
FREE_FRAMES_START = 1_000_000  # Frame number of the first free pose.


def make_town(seed: int, num_free_poses: int = 0) -> Drive:
    """Make one town, and one drive through its streets with up to 256 poses.

    Args:
        seed: Seed of the town. Seed modulo 4 determines the districts.
        num_free_poses: Number of poses at any place and heading. They follow the poses of the vehicle.

    Returns:
        The drive.
    """
    drive, streets, land = _make_drive(seed)
    free = _draw_free_poses(np.random.default_rng([7303, seed]), streets, land, num_free_poses)
    return replace(
        drive,
        frame=np.concatenate([drive.frame, FREE_FRAMES_START + np.arange(len(free))]),
        world_from_imu=np.concatenate([drive.world_from_imu, free]),
        free_pose=np.arange(len(drive) + len(free)) >= len(drive),
    )


def make_large_scene(seed: int, extent_m: float, resolution_m: float = 0.25) -> Scene:
    """Make a square scene of a town with as many streets as its extent needs, to compare it with generated cities.

    The middle of the scene is the crop ahead of a pose of a vehicle, as in a city that outpainting extends. As in crops
    at free poses, there are no moving objects.

    Args:
        seed: Seed of the town.
        extent_m: Side of the scene (m).
        resolution_m: Side of a pixel (m).

    Returns:
        The scene, in the frame of the pose, whose crop spans x from 0 to FREE_CROP_M.

    Raises:
        ValueError: The side is smaller than a crop, or no whole number of pixels.
        RuntimeError: No pose lies so that the scene fits into the town.
    """
    pixels, margin_m = round(extent_m / resolution_m), (extent_m - FREE_CROP_M) / 2
    if margin_m < 0 or abs(pixels * resolution_m - extent_m) > 1e-6:
        raise ValueError(
            f"extent_m is {extent_m:g}, expected at least {FREE_CROP_M:g} m and a multiple of {resolution_m:g} m"
        )
    grid = Grid(FREE_CROP_M + margin_m, extent_m / 2, resolution_m, pixels, pixels)
    drive, streets, land = _make_drive(seed, _count_blocks(seed, np.sqrt(2) * extent_m + FREE_CROP_M))
    low, high = _find_built_area(streets)
    middle = (low + high) / 2
    side = np.linspace(-1, 1, 9)
    outline = np.concatenate(
        [np.column_stack([side, np.full(9, end)]) for end in (-1, 1)]
        + [np.column_stack([np.full(9, end), side]) for end in (-1, 1)]
    )
    outline_m = outline * extent_m / 2 + [FREE_CROP_M / 2, 0]
    places = land.uv(drive.world_from_imu[:, :2, 3])
    for index in np.argsort(np.linalg.norm(places - middle, axis=1)):
        pose = drive.pose(int(index))
        edge_m = outline_m @ make_yaw_rotation(pose.yaw_rad)[:2, :2].T + pose.xyz_m[:2]
        inside = land.uv(edge_m)
        if (inside >= low).all() and (inside <= high).all():
            still = replace(drive, frame=np.full(len(drive), FREE_FRAMES_START))  # No moving box belongs to this frame.
            return still.scene(int(index), "test", grid)
    raise RuntimeError(f"no crop of {extent_m:g} m fits into town {seed}")


def make_large_crops(seed: int, count: int, grid: Grid) -> Iterator[Scene]:
    """Make crops of any size at any place and heading of one town, without moving objects.

    Args:
        seed: Seed of the town.
        count: Number of crops.
        grid: Grid of the crops.

    Yields:
        Crops, in the frames of their poses.
    """
    length_m, width_m = grid.front_m - grid.back_m, grid.left_m - grid.right_m
    extent_m = float(np.hypot(length_m, width_m)) + max(length_m, width_m)
    drive, streets, land = _make_drive(seed, _count_blocks(seed, extent_m))
    poses = _draw_free_poses(np.random.default_rng([7305, seed]), streets, land, count, grid)
    frame = FREE_FRAMES_START + np.arange(count)
    drive = replace(drive, frame=frame, world_from_imu=poses, free_pose=np.ones(count, bool))
    for index in range(count):
        yield drive.at(np.array([index]), grid).scene(0, "unused", grid)


def _count_blocks(seed: int, extent_m: float) -> tuple[int, int]:
    """Return the number of blocks along u and v of a town that is wider than extent_m. Streets may have any direction,
    so this should be the diagonal of a scene.
    """
    main, _ = TOWN_KINDS[seed % len(TOWN_KINDS)]
    count = 2 + int(np.ceil(extent_m / SPACING_M[main][0]))
    return count, count


def _find_built_area(streets: Streets) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and the upper corner (u, v) of the area in which crops may lie."""
    low = np.array([streets.u_m[0], streets.v_m[0]]) - FREE_MARGIN_M
    high = np.array([streets.u_m[-1], streets.v_m[-1]]) + FREE_MARGIN_M
    return low, high


def _make_drive(seed: int, num_blocks: tuple[int, int] | None = None) -> tuple[Drive, Streets, Land]:
    """Make a town and the poses of a vehicle.

    Args:
        seed: Seed of the town.
        num_blocks: Number of blocks along u and v. None: those of a usual town.
    """
    rng = np.random.default_rng([7302, seed])
    main, edge = TOWN_KINDS[seed % len(TOWN_KINDS)]
    land = _skew_land(rng, draw_land(rng))
    columns, rows = num_blocks or ((4, 5) if main != "green" else (4, 4))
    split = 3 if rng.random() < 0.5 else columns - 1
    spacing_u = [rng.uniform(*SPACING_M[main if i < split else edge]) for i in range(columns)]
    spacing_v = [rng.uniform(*SPACING_M[main]) for _ in range(rows)]
    streets, cells = lay_streets(rng, spacing_u, spacing_v, MISSING)
    streets = _widen_streets(rng, streets)
    border = streets.u_m[split]

    sheet = StreetSheet()
    pave_streets(streets, sheet)
    of_town = np.exp(rng.normal(0, [0.0, 0.08, 0.08, 0.08, 0.04, 0.08, 0.1, 0.1, 0.1, 0.15, 0.15]))
    for block in list_blocks(streets, cells, lambda u, v: main if u < border else edge, OUTSKIRTS_M):
        variation = Variation(*(np.array(list(vars(draw_variation(rng)).values())) * of_town).tolist())
        furnish_block(Site(sheet, rng, DISTRICTS[block.kind], variation), block, _find_half_widths(streets, block))

    route = plan_route(rng, streets)
    at = sample_poses(rng, route, land)
    frame = np.round(measure_travel(route, land)[at] / METRES_PER_FRAME).astype(np.int64)
    place_traffic(sheet, rng, route, at, frame)
    ground = collect_ground(sheet, land)
    boxes = _settle_boxes(collect_boxes(sheet, rng, land), ground, land)
    boxes = _remove_overlapping(_sink_boxes(boxes, np.random.default_rng([7304, seed])))
    drive = Drive(
        source="town",
        sequence=f"{seed:05d}",
        **boxes,
        ground_classes=KITTI_GROUND_CLASSES,
        ground=ground,
        frame=frame,
        world_from_imu=make_poses(rng, route, at, land),
    )
    return drive, streets, land


# ---------------------------------------------------------------- streets


def _skew_land(rng: np.random.Generator, land: Land) -> Land:
    """Turn the u-streets of some towns, so that junctions have no right angles."""
    skew = rng.uniform(-MAX_SKEW, MAX_SKEW) * (rng.random() < SKEWED)
    wave = 2 * np.pi / SKEW_WAVE_M
    return replace(land, bend_u=np.vstack([land.bend_u * [0.8, 1, 1], [skew / wave, wave, 0.0]]))


def _widen_streets(rng: np.random.Generator, streets: Streets) -> Streets:
    """Sample the class and the width of each street, and the radii of the kerbs."""
    names = np.arange(len(STREET_CLASSES))

    def draw(count: int) -> np.ndarray:
        drawn = rng.choice(names, count, p=[share for _, share, _ in STREET_CLASSES])
        return np.array([rng.uniform(*STREET_CLASSES[k][2]) for k in drawn])

    corner = {node: float(rng.uniform(*CORNER_M)) for node in streets.corner_m}
    return replace(streets, half_u_m=draw(len(streets.u_m)), half_v_m=draw(len(streets.v_m)), corner_m=corner)


def _find_half_widths(streets: Streets, block: CityBlock) -> tuple[float, float, float, float]:
    """Return the half widths of the streets at the sides south, east, north and west of a block."""
    sides = (
        (streets.v_m + streets.half_v_m, streets.half_v_m, block.v0),
        (streets.u_m - streets.half_u_m, streets.half_u_m, block.u1),
        (streets.v_m - streets.half_v_m, streets.half_v_m, block.v1),
        (streets.u_m + streets.half_u_m, streets.half_u_m, block.u0),
    )
    south, east, north, west = (float(half[np.abs(edge - place).argmin()]) for edge, half, place in sides)
    return south, east, north, west


# ---------------------------------------------------------------- boxes in the world


def _list_street_triangles(ground: SlabGround) -> np.ndarray:
    """Return the tops of roads and sidewalks as triangles (t, 3, 2)."""
    slab = ground.vertex_slab[ground.triangles[:, 0]]
    corners = np.bincount(ground.vertex_slab, minlength=len(ground.slab_class)) // 2
    start = np.searchsorted(slab, np.arange(len(ground.slab_class)))
    is_top = np.arange(len(slab)) - start[slab] < corners[slab] - 2
    return ground.vertices_m[ground.triangles[is_top & np.isin(ground.slab_class[slab], STREET_CLASS)], :2]


def _settle_boxes(boxes: dict[str, np.ndarray], ground: SlabGround, land: Land) -> dict[str, np.ndarray]:
    """Separate the buildings, let them stand on the surface, and remove objects inside buildings."""
    center, size = boxes["center_m"].copy(), boxes["size_m"].copy()
    built = np.flatnonzero(boxes["category"] == CATEGORY_INDEX["construction_big"])
    axis = boxes["rotation"][built, :2, 0]
    axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    center[built, :2], size[built, :2], kept = separate_buildings(
        center[built, :2], axis, size[built, :2], _list_street_triangles(ground)
    )
    # The bottom lies SUNK_M below the lowest surface under the corners.
    corners = compute_corners(center[built, :2], axis, size[built, :2])
    center[built, 2] = land.surface_m(corners).min(axis=1) - SUNK_M + size[built, 2] / 2
    keep = np.ones(len(center), bool)
    keep[built[~kept]] = False
    standing = built[kept]
    loose = np.flatnonzero(boxes["category"] != CATEGORY_INDEX["construction_big"])
    keep[loose[find_covered(center[loose, :2], center[standing, :2], axis[kept], size[standing, :2])]] = False
    boxes = boxes | {"center_m": center, "size_m": size}
    return {name: values[keep] for name, values in boxes.items()}


def _remove_overlapping(boxes: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Remove static objects of APART that overlap earlier objects of their category."""
    index = np.flatnonzero(np.isin(boxes["category"], APART) & (boxes["timestamp"] == STATIC))
    shapes = make_boxes(*(boxes[name][index] for name in ("center_m", "rotation", "size_m")))
    keep = np.ones(len(boxes["category"]), bool)
    keep[index[find_suppressed(shapes, boxes["category"][index], -np.arange(len(index)), APART_IOU3D)]] = False
    return {name: values[keep] for name, values in boxes.items()}


def _sink_boxes(boxes: dict[str, np.ndarray], rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Lower static objects by random depths (DEPTH_M)."""
    center_m = boxes["center_m"].copy()
    for name, (mean, spread, limits) in DEPTH_M.items():
        chosen = (boxes["category"] == CATEGORY_INDEX[name]) & (boxes["timestamp"] == STATIC)
        center_m[chosen, 2] -= rng.normal(mean, spread, chosen.sum()).clip(*limits)
    return boxes | {"center_m": center_m}


# ---------------------------------------------------------------- free poses


def _draw_free_poses(
    rng: np.random.Generator, streets: Streets, land: Land, count: int, grid: Grid | None = None
) -> np.ndarray:
    """Return poses (count, 3, 4) whose crops lie in the built area at any place and heading.

    The first poses do not depend on `count`. The crops have the size of scenes, or that of a grid.
    """
    grid = grid or Grid()
    low, high = _find_built_area(streets)
    poses = np.empty((count, 3, 4))
    ends = (grid.back_m, grid.left_m), (grid.front_m, grid.left_m), (grid.front_m, grid.right_m)
    square = np.array([*ends, (grid.back_m, grid.right_m)])
    found = 0
    for _ in range(MAX_TRIES):
        if found == count:
            return poses
        middle, yaw = land.xy(rng.uniform(low, high)), rng.uniform(-np.pi, np.pi)
        forward, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
        origin = middle - forward * (grid.back_m + grid.front_m) / 2
        corners = land.uv(origin + square @ np.stack([forward, left]))
        if (corners < low).any() or (corners > high).any():
            continue
        z = land.surface_m(origin) + IMU_HEIGHT_M
        poses[found, :, 0], poses[found, :, 1] = [*forward, 0.0], [*-left, 0.0]
        poses[found, :, 2], poses[found, :, 3] = [0.0, 0.0, -1.0], [*origin, z]
        found += 1
    raise RuntimeError(f"only {found} of {count} free crops fit into the town; request fewer free poses")
