"""Functions that both versions of the town share: poses, traffic, and the conversion from the board to the world."""

from __future__ import annotations

import numpy as np

from models.scene import CATEGORY_INDEX, KITTI_GROUND_CLASSES
from pipelines.preprocess.sources.drive import STATIC, SlabGround
from pipelines.preprocess.sources.town.assets import draw_sizes
from pipelines.preprocess.sources.town.land import (
    SLAB_THICKNESS_M,
    Land,
    LocalFrame,
    Sheet,
    clip_ears,
    subdivide_outline,
)
from pipelines.preprocess.sources.town.streets import Route

MAX_POSES = 256
POSE_SPACING_M = 10.0
IMU_HEIGHT_M = 0.93  # Height above the real road surface, as in KITTI-360.
METRES_PER_FRAME = 0.7

# Category of each KITTI-360 label; labels are spelled as in the XML. The shape determines the category of vegetation.
LABEL_CATEGORY = {
    "vegetation": "vegetation_cuboid",
    "truck": "vehicle_big",
    "bus": "vehicle_big",
    "car": "vehicle_small",
    "motorcycle": "two_wheelers",
    "bicycle": "two_wheelers",
    "pedestrian": "human",
    "building": "construction_big",
    "garage": "construction_big",
    "wall": "construction_small",
    "fence": "construction_small",
    "guardrail": "construction_small",
    "gate": "construction_small",
    "smallPole": "pole",
    "bigPole": "pole",
    "trafficLight": "traffic_control",
    "trafficSign": "traffic_control",
    "lamp": "traffic_control",
    "trashbin": "object",
    "box": "object",
}


# ---------------------------------------------------------------- the drive


def measure_travel(route: Route, land: Land) -> np.ndarray:
    steps = np.linalg.norm(np.diff(land.xy(route.uv), axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def sample_poses(rng: np.random.Generator, route: Route, land: Land) -> np.ndarray:
    """Return the route samples that become poses. Any two poses are at least POSE_SPACING_M apart."""
    xy = land.xy(route.uv)
    kept: list[int] = []
    points = np.empty((0, 2))
    distance, wait = measure_travel(route, land), 0.0
    for k in range(len(xy)):
        if distance[k] < wait or len(kept) == MAX_POSES:
            continue
        if len(kept) and np.square(points - xy[k]).sum(axis=1).min() < (POSE_SPACING_M + 0.05) ** 2:
            continue
        kept.append(k)
        points = np.vstack([points, xy[k]])
        wait = distance[k] + POSE_SPACING_M + rng.exponential(0.6)
    return np.array(kept)


def make_poses(rng: np.random.Generator, route: Route, at: np.ndarray, land: Land) -> np.ndarray:
    """Return world_from_imu (p, 3, 4), with the axes x forward, y right and z down.

    The poses are tilted by about 3 degrees, as the IMU of a real car is.
    """
    xy = land.xy(route.uv[at])
    ahead = land.direction(route.uv[at], route.heading[at])
    z = land.surface_m(xy) + IMU_HEIGHT_M
    mount = rng.normal(0, 0.03, 2)
    climb = (land.grade(xy) * ahead).sum(axis=1)
    pitch = (mount[0] + 0.01 * rng.standard_normal(len(at))).clip(-0.06, 0.06) - climb
    roll = (mount[1] + 0.012 * rng.standard_normal(len(at))).clip(-0.06, 0.06)
    forward = np.column_stack([ahead * np.cos(pitch)[:, None], -np.sin(pitch)])
    level_right = np.column_stack([ahead[:, 1], -ahead[:, 0], np.zeros(len(at))])
    level_down = np.cross(forward, level_right)
    right = level_right * np.cos(roll)[:, None] + level_down * np.sin(roll)[:, None]
    down = np.cross(forward, right)
    return np.stack([forward, right, down, np.column_stack([xy, z])], axis=2)


def place_traffic(sheet: Sheet, rng: np.random.Generator, route: Route, at: np.ndarray, frame: np.ndarray) -> None:
    """Add moving boxes: cars in both directions, a few trucks and bicycles, and pedestrians on the sidewalk.

    A track has boxes at a few successive poses. Each box belongs to the frame of one pose.
    """
    vehicles = np.array([label in ("car", "truck", "bus") for label in sheet.box_label])
    parked = np.concatenate(sheet.box_rows)[vehicles, :2]
    moving: dict[int, list[np.ndarray]] = {}
    first, track = 0, 0
    while first < len(at):
        what = str(rng.choice(["car", "bicycle", "pedestrian", "truck"], p=[0.84, 0.05, 0.08, 0.03]))
        oncoming = rng.random() < 0.6
        count = int(rng.integers(1, 3) if oncoming else rng.integers(2, 6))
        size = draw_sizes(rng, what, 1)[0]
        ahead = float(rng.uniform(12, 55))
        for k in range(first, min(first + count, len(at))):
            sample = at[k] + int(ahead)
            if 2 < ahead < 62 and sample < len(route.uv):
                heading, lane = route.heading[sample], route.lane_m[sample]
                left = np.array([-heading[1], heading[0]])
                aside = {"pedestrian": -2.4 * lane, "bicycle": -1.2 * lane}.get(what, 2 * lane * oncoming)
                place = route.uv[sample] + aside * left
                others = np.vstack([parked, *moving.setdefault(int(frame[k]), [])]) - place
                if not ((np.abs(others @ heading) < 5.6) & (np.abs(others @ left) < 2.0)).any():
                    moving[int(frame[k])].append(place[None])
                    yaw = (np.pi if oncoming else 0.0) + rng.normal(0, 0.02)
                    here = LocalFrame(tuple(place.tolist()), tuple(heading.tolist()), tuple(left.tolist()))
                    sheet.boxes(here, what, 0.0, 0.0, size, yaw, timestamp=frame[k], track=track)
            step = at[min(k + 1, len(at) - 1)] - at[k]
            ahead -= step * {"pedestrian": 0.85, "bicycle": 0.5}.get(what, 1.8 if oncoming else rng.uniform(-0.2, 0.2))
        track += 1
        first += int(rng.geometric(0.5)) - 1 + (rng.random() < 0.5)


# ---------------------------------------------------------------- board -> world


def collect_boxes(sheet: Sheet, rng: np.random.Generator, land: Land) -> dict[str, np.ndarray]:
    """Return the per-box arrays of a Drive. Boxes stand on the surface and are rotated with the streets."""
    rows, label = np.concatenate(sheet.box_rows), np.array(sheet.box_label, dtype=object)
    category = np.array([CATEGORY_INDEX[LABEL_CATEGORY[name]] for name in label], np.int8)
    category[rows[:, 8] > 0] = CATEGORY_INDEX["vegetation_ellipsoid"]
    xy = land.xy(rows[:, :2])
    along = sheet.find_directions(rows, land)
    grade = land.grade(xy)

    # Low objects follow the slope, and tall objects are upright. A few objects are tilted, as in real annotations.
    leans = np.isin(label, ["car", "truck", "bus", "bicycle", "motorcycle", "wall", "fence", "gate", "guardrail"])
    leans |= np.isin(category, CATEGORY_INDEX["vegetation_cuboid"])
    tilt = np.where(leans[:, None], -grade, 0.0)
    careless = (rng.random(len(label)) < 0.015) & ~np.isin(label, sheet.upright)
    tilt[careless] += rng.normal(0, 0.1, (careless.sum(), 2)).clip(-0.24, 0.24)
    normal = np.column_stack([tilt, np.ones(len(label))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    side = np.cross(normal, np.column_stack([along, np.zeros(len(label))]))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    rotation = np.stack([np.cross(side, normal), side, normal], axis=2)

    size = rows[:, 4:7]
    foot = np.column_stack([xy, land.surface_m(xy) + rows[:, 7]])
    center = foot + normal * size[:, 2:] / 2
    directed = np.isin(label, ["car", "truck", "bus", "bicycle", "motorcycle"])
    heading = np.where(directed, np.arctan2(along[:, 1], along[:, 0]), np.nan)
    timestamp, track = rows[:, 9].astype(np.int64), rows[:, 10].astype(np.int64)
    static = timestamp == STATIC
    # Static and moving objects are numbered separately, as in KITTI-360.
    instance = np.where(static, np.arange(len(label)) + 1, track)
    return {
        "category": category,
        "center_m": center,
        "rotation": rotation,
        "size_m": size,
        "heading_rad": heading,
        "instance_id": instance.astype(np.int64),
        "label": label,
        "timestamp": timestamp,
    }


def collect_ground(sheet: Sheet, land: Land) -> SlabGround:
    """Return closed slabs: n top vertices, then n bottom vertices.

    The tops lie SLAB_THICKNESS_M / 2 above the surface.
    """
    outlines = [subdivide_outline(outline) for _, outline in sheet.slabs]
    xy = land.xy(np.concatenate(outlines))
    middle = land.surface_m(xy)
    vertices, owner, triangles, done, written = [], [], [], 0, 0
    for index, outline in enumerate(outlines):
        n = len(outline)
        here = slice(done, done + n)
        done += n
        top = np.column_stack([xy[here], middle[here] + SLAB_THICKNESS_M / 2])
        vertices += [top, top - [0.0, 0.0, SLAB_THICKNESS_M]]
        owner.append(np.full(2 * n, index))
        triangles.append(list_slab_faces(clip_ears(xy[here] - xy[here][0]), n) + written)
        written += 2 * n
    slab_class = np.array([KITTI_GROUND_CLASSES.index(name) for name, _ in sheet.slabs])
    return SlabGround(slab_class, np.concatenate(vertices), np.concatenate(owner), np.concatenate(triangles))


def list_slab_faces(top: list[tuple[int, int, int]], n: int) -> np.ndarray:
    """Return the faces (4 n - 4, 3) of a slab in KITTI-360's order: top, bottom, then two faces per side."""
    upper = np.array(top)
    ring = np.arange(n - 1)
    first = np.stack([ring, ring + 1, n + ring], axis=1)
    second = np.stack([ring + 1, n + ring + 1, n + ring], axis=1)
    sides = np.stack([first, second], axis=1).reshape(-1, 3)
    return np.concatenate([upper, upper + n, sides, [[0, n - 1, n], [n - 1, n, 2 * n - 1]]])
