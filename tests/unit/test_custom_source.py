"""Tests of custom drives: content of scenes, ground in comparison with shapely, and errors for invalid files."""

import hashlib
import json
import re
from pathlib import Path

import duckdb
import numpy as np
import pandas
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely
from helpers import ROOT
from scipy.spatial.transform import Rotation

from models.limits import LimitError
from models.scene import CATEGORIES, CATEGORY_INDEX, GROUND_CLASSES, Grid
from pipelines.preprocess.sources import custom, custom_tables
from pipelines.preprocess.sources.custom import list_drives, read_drive, read_ground_classes, read_poses, read_splits
from pipelines.preprocess.sources.drive import STATIC, Drive, Pose
from pipelines.preprocess.sources.town.generator import generate_town
from pipelines.schema.tables import Shard, read_scenes

DOCUMENT = ROOT / "docs/how_to/own_drives.md"
ORIGIN = np.array([456_789.25, 5_432_100.5, 115.0])  # position in UTM (m)
YAW = 0.7
Tables = dict[str, list[dict]]


def transform_to_world(x: float, y: float, z: float = 0.0) -> np.ndarray:
    """Transform a point from the ego frame of the first pose to the world frame."""
    return Pose(ORIGIN, YAW).to_world([x, y, z])


def make_position(point_m: np.ndarray) -> dict:
    return dict(zip(("x_m", "y_m", "z_m"), np.asarray(point_m).tolist(), strict=True))


def make_box(category: str, x: float, y: float, z: float, size=(4.0, 2.0, 1.5), yaw: float = 0.0, **more) -> dict:
    sizes = dict(zip(("length_m", "width_m", "height_m"), size, strict=True))
    return {"category": category} | make_position(transform_to_world(x, y, z)) | sizes | {"yaw_rad": YAW + yaw} | more


def make_outline(*xy: tuple[float, float], z: float = -1.0) -> list[list[float]]:
    return [transform_to_world(x, y, z).tolist() for x, y in xy]


def make_street() -> Tables:
    """Return the tables of a street with two poses that are 2 m apart.

    The street contains a parked car, a tree, a pole, a house, a pedestrian and a truck. The truck moves by 3 m.
    """
    return {
        "boxes": [
            make_box("vehicle_small", 20, -6, 0, yaw=3.0, label="Parked", instance_id=7),
            make_box("vegetation_ellipsoid", 30, 9, 3, (5, 4, 8)),
            make_box("pole", 12, 8, 2, (0.2, 0.2, 6), instance_id=None),
            make_box("construction_big", 40, 20, 4, (8, 14, 9), heading_known=True),
            make_box("vehicle_big", 25, 0, 0.5, (9, 2.5, 3), yaw=0.1, frame=10, instance_id=8),
            make_box("vehicle_big", 28, 0, 0.5, (9, 2.5, 3), yaw=0.1, frame=20, instance_id=8),
            make_box("human", 15, -9, 0, (0.5, 0.6, 1.8), heading_known=False, frame=20),
        ],
        "polygons": [
            {"class": "road", "outline": make_outline((-50, -4), (150, -4), (150, 4), (-50, 4))},
            {"class": "sidewalk", "outline": make_outline((-50, 4), (150, 4), (150, 7), (-50, 7), (-50, 4), z=-0.9)},
        ],
        "poses": [
            {"frame": frame, "yaw_rad": YAW} | make_position(transform_to_world(x, 0))
            for frame, x in ((10, 0.0), (20, 2.0))
        ],
    }


def write_drive(tables: Tables, root: Path, name: str = "street", parquet: bool = False) -> Path:
    """Write each table to root/name as JSON or Parquet and return root."""
    folder = root / name
    folder.mkdir(parents=True, exist_ok=True)
    for table, rows in tables.items():
        if parquet:
            columns = dict.fromkeys(column for row in rows for column in row)
            pq.write_table(pa.table({c: [row.get(c) for row in rows] for c in columns}), folder / f"{table}.parquet")
        else:
            (folder / f"{table}.json").write_text(json.dumps(rows))
    return root


def write_and_read_drive(tables: Tables, root: Path, **how) -> Drive:
    return read_drive(write_drive(tables, root, **how), how.get("name", "street"))


def assert_same_drive(a: Drive, b: Drive, tolerance: float = 0.0):
    names = ("category", "label", "instance_id", "timestamp", "frame")
    assert (a.source, a.sequence, a.ground_classes) == (b.source, b.sequence, b.ground_classes)
    for name in names:
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    for name in ("center_m", "rotation", "size_m", "heading_rad", "world_from_imu"):
        assert np.allclose(getattr(a, name), getattr(b, name), rtol=0, atol=tolerance, equal_nan=True), name
    assert np.array_equal(a.ground.triangles_m, b.ground.triangles_m)
    assert np.array_equal(a.ground.triangle_class, b.ground.triangle_class)


# ------------------------------------------------------------------------------------------------- file formats


def test_custom_source_reads_json_and_parquet_equally(tmp_path):
    a, b = (
        write_and_read_drive(make_street(), tmp_path / "a"),
        write_and_read_drive(make_street(), tmp_path / "b", parquet=True),
    )
    assert_same_drive(a, b)
    assert a.source == "own" and a.sequence == "street" and len(a) == 2 and len(a.category) == 7


def test_custom_source_reads_pandas_frame_with_gaps_and_index(tmp_path):
    """pandas converts an integer column with gaps to floats. After filtering, pandas also writes the index as a
    column."""
    a = write_and_read_drive(make_street(), tmp_path / "a")
    folder = write_drive(make_street(), tmp_path / "b", parquet=True) / "street"
    rows = make_street()["boxes"]
    frame = pandas.DataFrame([*rows[:2], {"category": "pole"}, *rows[2:]])
    frame[frame.x_m > 0].to_parquet(folder / "boxes.parquet")
    stored = pq.read_schema(folder / "boxes.parquet")
    assert custom_tables.PANDAS_INDEX in stored.names and stored.field("frame").type == pa.float64()
    assert_same_drive(a, read_drive(tmp_path / "b", "street"))


def test_custom_source_reads_yaw_quaternion_and_matrix_equally(tmp_path):
    tables = make_street()
    a = write_and_read_drive(tables, tmp_path / "a")
    for row in [*tables["boxes"], *tables["poses"]]:
        q = Rotation.from_rotvec([0, 0, row.pop("yaw_rad")]).as_quat(scalar_first=True)
        row |= dict(zip(custom.QUATERNION, q.tolist(), strict=True))
    assert_same_drive(a, write_and_read_drive(tables, tmp_path / "b"), 1e-12)
    tables["poses"] = [
        {"frame": int(frame), "world_from_ego": matrix.ravel().tolist()}
        for frame, matrix in zip(a.frame, a.world_from_imu, strict=True)
    ]
    assert_same_drive(a, write_and_read_drive(tables, tmp_path / "c"), 1e-12)
    assert_same_drive(a, write_and_read_drive(tables, tmp_path / "d", parquet=True), 1e-12)


def test_custom_source_ignores_winding_and_closure_of_outline(tmp_path):
    shape = make_outline((5, -4), (40, -4), (40, 4), (20, 0), (5, 4))
    rasters = []
    for k, points in enumerate([shape, shape[::-1], [*shape, shape[0]], [*shape[2:], *shape[:2]], [shape[0], *shape]]):
        drive = write_and_read_drive(
            make_street() | {"polygons": [{"class": "road", "outline": points}]}, tmp_path / str(k)
        )
        rasters.append(drive.scene(0))
    for scene in rasters[1:]:
        assert np.array_equal(scene.occupied, rasters[0].occupied)
        assert np.array_equal(scene.height_m, rasters[0].height_m)


def test_custom_source_reads_drive_without_boxes_or_ground(tmp_path):
    empty = write_and_read_drive(make_street() | {"boxes": []}, tmp_path / "a")
    assert len(empty.category) == 0 and len(empty.scene(0)) == 0 and empty.scene(0).occupied.any()
    bare = read_drive(write_drive(make_street() | {"polygons": []}, tmp_path / "b"), "street", ("road", "terrain"))
    assert len(bare.scene(0)) == 5 and bare.scene(0).occupied.shape == (2, 256, 256)
    assert not bare.scene(0).occupied.any()
    folder = write_drive(make_street(), tmp_path / "c") / "street"
    (folder / "boxes.json").unlink()
    pandas.DataFrame({"category": []}).to_parquet(folder / "boxes.parquet")
    assert len(read_drive(tmp_path / "c", "street").category) == 0


# ------------------------------------------------------------------------------------------------ scene content


def test_custom_source_places_boxes_in_scene(tmp_path):
    drive = write_and_read_drive(make_street(), tmp_path)
    scene = drive.scene(0)
    assert scene.scene_id == "own-street-0000000010"
    assert [CATEGORIES[c] for c in scene.category] == [
        "vehicle_small",
        "vegetation_ellipsoid",
        "pole",
        "construction_big",
        "vehicle_big",
    ]
    expected = [[20, -6, 0], [30, 9, 3], [12, 8, 2], [40, 20, 4], [25, 0, 0.5]]
    assert np.allclose(scene.center_m, expected, atol=1e-5)
    assert np.allclose(drive.scene(1).center_m[:4], np.array(expected)[:4] - [2, 0, 0], atol=1e-5)
    assert np.allclose(scene.size_m[3], [14, 8, 9])  # the length is the longer side
    assert np.allclose(scene.yaw_rad[[0, 4]], [3.0 - np.pi, 0.1], atol=1e-5)
    assert np.allclose(scene.heading_rad, [3.0, np.nan, np.nan, 0.0, 0.1], atol=1e-5, equal_nan=True)
    assert scene.label.tolist()[:2] == ["Parked", "vegetation_ellipsoid"]
    assert scene.instance_id.tolist() == [7, -1, -1, -1, 8]


def test_custom_source_places_moving_box_in_its_frame_only(tmp_path):
    drive = write_and_read_drive(make_street(), tmp_path)
    moving = [scene.center_m[scene.instance_id == 8] for scene in (drive.scene(0), drive.scene(1))]
    assert np.allclose(moving, [[[25, 0, 0.5]], [[26, 0, 0.5]]], atol=1e-5)
    humans = [int((drive.scene(k).category == CATEGORY_INDEX["human"]).sum()) for k in range(2)]
    assert humans == [0, 1] and np.isnan(drive.heading_rad[6])
    assert drive.timestamp.tolist() == [STATIC] * 4 + [10, 20, 20]


def test_custom_source_keeps_lean_and_drops_upright_heading(tmp_path):
    turn = Rotation.from_euler("ZY", [[YAW + 0.4, 0.3], [YAW, np.pi / 2]])
    tables = make_street()
    tables["boxes"] = [
        {name: value for name, value in make_box("vehicle_small", 20, k, 0).items() if name != "yaw_rad"}
        | dict(zip(custom.QUATERNION, q.tolist(), strict=True))
        for k, q in enumerate(turn.as_quat(scalar_first=True))
    ]
    drive = write_and_read_drive(tables, tmp_path)
    assert np.allclose(drive.rotation, turn.as_matrix(), atol=1e-12)
    assert np.allclose(drive.heading_rad, [YAW + 0.4, np.nan], equal_nan=True)
    assert np.allclose(drive.scene(0).size_m[1], [2.0, 1.5, 4.0])  # the box stands upright: its length is along z


def test_custom_source_accepts_nanosecond_frames(tmp_path):
    tables, start = make_street(), 1_532_402_927_612_460_001
    for row in [*tables["boxes"], *tables["poses"]]:
        row |= {"frame": start + row["frame"]} if "frame" in row else {}
    for parquet in (False, True):
        drive = write_and_read_drive(tables, tmp_path / str(parquet), parquet=parquet)
        assert drive.frame.tolist() == [start + 10, start + 20]
        assert drive.scene(1).scene_id == f"own-street-{start + 20}" and len(drive.scene(1)) == 6


def test_custom_source_text_ids_are_deterministic(tmp_path):
    tables = make_street()
    for row in tables["boxes"]:
        row["instance_id"] = "ab12"
    tables["boxes"][0]["instance_id"] = None
    expected = int.from_bytes(hashlib.blake2b(b"ab12", digest_size=8).digest(), "big") >> 1
    assert write_and_read_drive(tables, tmp_path).instance_id.tolist() == [-1] + [expected] * 6


# ------------------------------------------------------------------------------------------------------ ground


def compute_pixel_centers(pose: Pose, grid: Grid) -> np.ndarray:
    """Return the world points (H, W, 3) of the pixel centres."""
    x, y = np.meshgrid(grid.x_m(), grid.y_m(), indexing="ij")
    return pose.to_world(np.stack([x, y, np.zeros_like(x)], axis=-1))


def draw_polygon(rng: np.random.Generator, points: int) -> list[tuple[float, float]]:
    """Return a random simple polygon, mostly non-convex and partly outside the crop."""
    angle = (np.arange(points) + rng.uniform(0, 0.9, points)) * 2 * np.pi / points
    radius = rng.uniform(3, 40, points)
    x, y = rng.uniform([5, -25], [60, 25])
    return list(zip(x + radius * np.cos(angle), y + radius * np.sin(angle), strict=True))


COMB = [
    (0, -20),
    *[(x, y) for k in range(12) for x, y in ((4 * k + 2, 15), (4 * k + 3, 15), (4 * k + 4, -18))],
    (60, -20),
]
SPIRAL = [
    (10, 0),
    (50, 0),
    (50, 30),
    (5, 30),
    (5, -25),
    (60, -25),
    (60, -20),
    (9, -20),
    (9, 25),
    (45, 25),
    (45, 5),
    (10, 5),
]


@pytest.mark.parametrize("shape", ["comb", "spiral", *range(8)])
def test_custom_source_ground_covers_pixel_centers_in_outline(tmp_path, shape):
    rng = np.random.default_rng([3, shape if isinstance(shape, int) else 99])
    xy = {"comb": COMB, "spiral": SPIRAL}.get(shape) or draw_polygon(rng, int(rng.integers(3, 40)))
    points = np.array(make_outline(*xy))
    points[:, 2] = ORIGIN[2] + 0.02 * (points[:, 0] - ORIGIN[0]) - 0.03 * (points[:, 1] - ORIGIN[1])
    drive = write_and_read_drive(
        make_street() | {"polygons": [{"class": "terrain", "outline": points.tolist()}]}, tmp_path
    )
    triangles = drive.ground.triangles_m
    polygon = shapely.Polygon(points[:, :2] - ORIGIN[:2])
    assert len(triangles) == len(xy) - 2
    assert np.isclose(sum(shapely.area(shapely.polygons(triangles[..., :2] - ORIGIN[:2]))), polygon.area)

    pose, grid = drive.pose(1), Grid()
    height, occupied = drive.ground.rasterise(pose, grid, 1)
    at = compute_pixel_centers(pose, grid) - ORIGIN
    inside = shapely.contains_xy(polygon, at[..., 0], at[..., 1])
    on_edge = shapely.distance(polygon.boundary, shapely.points(at[..., :2])) < 1e-6
    assert inside.any() and np.array_equal(occupied[0] & ~on_edge, inside & ~on_edge)
    plane = 0.02 * at[..., 0] - 0.03 * at[..., 1]
    assert np.abs(height[0] - plane)[occupied[0]].max() < 1e-4


def test_custom_source_abutting_polygons_leave_no_gap(tmp_path):
    """Zigzag lines cut a hilly square of 50 m into strips."""
    rng = np.random.default_rng(5)
    along = np.linspace(5, 55, 12)
    cuts = [np.full(12, -25.0), *[y + rng.uniform(-3, 3, 12) for y in (-15, -5, 5, 15)], np.full(12, 25.0)]
    z = [rng.uniform(-1, 1, 12) for _ in cuts]
    lines = [
        [transform_to_world(*p).tolist() for p in zip(along, y, h, strict=True)] for y, h in zip(cuts, z, strict=True)
    ]
    polygons = [
        {"class": ("road", "sidewalk")[k % 2], "outline": [*low, *high[::-1]]}
        for k, (low, high) in enumerate(zip(lines[:-1], lines[1:], strict=True))
    ]
    drive = write_and_read_drive(make_street() | {"polygons": polygons}, tmp_path)
    height, occupied = drive.ground.rasterise(drive.pose(0), Grid(), 2)
    x, y = np.meshgrid(Grid().x_m(), Grid().y_m(), indexing="ij")
    square = (x > 5) & (x < 55) & (abs(y) < 25)
    assert np.array_equal(occupied.any(axis=0), square) and not occupied.all(axis=0).any()
    edges = {
        tuple(sorted(e))
        for t in drive.ground.triangles_m.tolist()
        for e in zip(map(tuple, t), map(tuple, t[1:] + t[:1]), strict=True)
    }
    for line in lines:  # the surfaces on both sides of a line share the edges of the line
        assert all(tuple(sorted((tuple(a), tuple(b)))) in edges for a, b in zip(line[:-1], line[1:], strict=True))
    seam = occupied[0][:, :-1] & occupied[1][:, 1:]
    step = np.abs(height[0][:, :-1] - height[1][:, 1:])[seam]
    assert seam.sum() > 100 and np.median(step) < 0.1


def test_custom_source_keeps_height_of_points_on_edge(tmp_path):
    """The outline of a straight road with a crest has three points on each side."""
    side = [(10, 4, 0), (30, 4, 2), (50, 4, 0)]
    points = [transform_to_world(x, y, z).tolist() for x, y, z in [*side, *[(x, -y, z) for x, y, z in side[::-1]]]]
    drive = write_and_read_drive(make_street() | {"polygons": [{"class": "road", "outline": points}]}, tmp_path)
    height, occupied = drive.ground.rasterise(drive.pose(0), Grid(), 1)
    expected = 2 - np.abs(Grid().x_m()[:, None] - 30) / 10
    assert occupied[0].sum() == 160 * 32 and np.abs(height[0] - expected)[occupied[0]].max() < 1e-4


def test_custom_source_polygon_larger_than_crop_fills_it(tmp_path):
    """One polygon has no point in the crop, and a second polygon has only a few points in the crop."""
    huge = [[*(ORIGIN[:2] + 2000 * np.array(d)), 113.0] for d in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    polygons = [{"class": "terrain", "outline": huge}, make_street()["polygons"][0]]
    drive = write_and_read_drive(make_street() | {"polygons": polygons}, tmp_path)
    scene = drive.scene(0)
    assert scene.ground_classes == ("road", "terrain") and scene.occupied[1].all()
    assert np.allclose(scene.height_m[1], -2, atol=1e-4)
    assert scene.ground_area_m2()[0] == 64 * 8


def test_custom_source_uses_upper_surface_of_class(tmp_path):
    bridge = {"class": "road", "outline": make_outline((20, -20), (30, -20), (30, 20), (20, 20), z=5.0)}
    scene = write_and_read_drive(make_street() | {"polygons": [make_street()["polygons"][0], bridge]}, tmp_path).scene(
        0
    )
    on = (Grid().x_m() > 20) & (Grid().x_m() < 30)
    assert np.allclose(scene.height_m[0, on, 128], 5.0, atol=1e-4)
    assert np.allclose(scene.height_m[0, ~on, 128], -1.0, atol=1e-4)


def test_custom_source_drive_at_some_poses_has_same_scenes(tmp_path):
    tables = make_street()
    tables["poses"] = [
        {"frame": k, "yaw_rad": YAW + 0.1 * k} | make_position(transform_to_world(15 * k, 0)) for k in range(8)
    ]
    for row in tables["boxes"]:
        row |= {"frame": 5} if "frame" in row else {}
    drive = write_and_read_drive(tables, tmp_path)
    for chosen in ([0], [5, 7]):
        for k, pose in enumerate(chosen):
            a, b = drive.scene(pose), drive.at(np.array(chosen)).scene(k)
            assert a.scene_id == b.scene_id and np.array_equal(a.center_m, b.center_m)
            assert np.array_equal(a.height_m, b.height_m) and np.array_equal(a.occupied, b.occupied)


# ------------------------------------------------------------------------------------------- a drive of another source


def convert_drive(drive: Drive) -> Tables:
    """Convert a town to the custom format.

    The result contains quaternions, pose matrices (y to the left, z up), and the tops of ground slabs as polygons.
    """
    quaternion = Rotation.from_matrix(drive.rotation).as_quat(scalar_first=True)
    columns = {
        "category": [CATEGORIES[c] for c in drive.category],
        **dict(zip(("x_m", "y_m", "z_m"), drive.center_m.T.tolist(), strict=True)),
        **dict(zip(("length_m", "width_m", "height_m"), drive.size_m.T.tolist(), strict=True)),
        **dict(zip(custom.QUATERNION, quaternion.T.tolist(), strict=True)),
        "frame": [None if t == STATIC else t for t in drive.timestamp.tolist()],
        "instance_id": drive.instance_id.tolist(),
        "label": drive.label.tolist(),
        "heading_known": np.isfinite(drive.heading_rad).tolist(),
    }
    world_from_ego = drive.world_from_imu.copy()
    world_from_ego[:, :, :3] = world_from_ego[:, :, :3] @ np.diag([1.0, -1.0, -1.0])
    slabs = [drive.ground.vertices_m[drive.ground.vertex_slab == k] for k in range(len(drive.ground.slab_class))]
    return {
        "boxes": [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)],
        "polygons": [
            {"class": drive.ground_classes[c], "outline": slab[: len(slab) // 2].tolist()}
            for c, slab in zip(drive.ground.slab_class, slabs, strict=True)
        ],
        "poses": [
            {"frame": int(f), "world_from_ego": m.ravel().tolist()}
            for f, m in zip(drive.frame, world_from_ego, strict=True)
        ],
    }


def test_custom_source_round_trips_town(tmp_path):
    town = generate_town(3)
    mine = write_and_read_drive(convert_drive(town), tmp_path, parquet=True)
    assert len(mine) == len(town) and (town.timestamp != STATIC).sum() > 10
    seen_moving = 0
    for k in range(0, len(town), 30):
        a, b = town.scene(k), mine.scene(k)
        for name in ("category", "instance_id", "label"):
            assert np.array_equal(getattr(a, name), getattr(b, name)), name
        for name in ("center_m", "rotation", "size_m"):
            assert np.allclose(getattr(a, name), getattr(b, name), atol=1e-4), name
        assert np.array_equal(np.isnan(a.heading_rad), np.isnan(b.heading_rad))
        turned = (a.heading_rad - b.heading_rad + np.pi) % (2 * np.pi) - np.pi
        assert np.nanmax(np.abs(turned), initial=0) < 0.01  # boxes of the town follow the slope of the ground
        assert np.isclose(a.world_yaw_rad, b.world_yaw_rad) and np.allclose(a.world_xyz_m, b.world_xyz_m)
        seen_moving += int(np.isin(town.timestamp, town.frame[k]).sum())
        common = [a.ground_classes.index(name) for name in b.ground_classes]
        assert (b.occupied | ~a.occupied[common]).all()  # the town drops slabs without a vertex in the crop
        difference = np.abs(a.height_m[common] - b.height_m)[a.occupied[common]]
        assert difference.max() < 0.05 and np.median(difference) < 0.002  # the triangulations differ
    assert seen_moving > 3


# ----------------------------------------------------------------------------------------------------- document


def find_code_blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)


@pytest.fixture(scope="module")
def document_variables(tmp_path_factory) -> dict:
    """Variables that exist after all Python blocks of the document have run in an empty folder."""
    folder = tmp_path_factory.mktemp("example")
    names = {"folder": folder}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for block in find_code_blocks("python"):
            exec(block, names)
    return names


def test_custom_source_document_example_writes_street(document_variables, capsys):
    root = document_variables["folder"] / "my_drives"
    assert list_drives(root) == ["first_street"] and read_splits(root) is None
    assert read_ground_classes(root) == ("road", "sidewalk", "terrain")
    drive = read_drive(root, "first_street")
    assert len(drive) == 110
    scenes = [drive.scene(k) for k in range(0, 110, 17)]
    for scene in scenes:
        assert (scene.label == "car").any() and (scene.label == "tree").any() and (scene.label == "house").any()
        assert np.allclose(scene.center_m[scene.instance_id >= 0], [[20, 0, 0.45]], atol=1e-5)
        bottom = (scene.center_m - scene.size_m / 2)[:, 2]
        assert np.allclose(bottom, -0.3, atol=1e-5) and np.allclose(scene.height_m[0][scene.occupied[0]], -0.3)
        assert scene.occupied.any(axis=0)[:, 20:200].all()
    assert (document_variables["folder"] / "first_scene.png").stat().st_size > 500


def test_custom_source_document_query_runs(document_variables):
    drive = read_drive(document_variables["folder"] / "my_drives", "first_street")
    tables = document_variables["folder"] / "my_scenes"
    Shard(str(tables), "own", "train", 0).write([drive.scene(k, "train") for k in range(3)])
    assert [scene.source for scene in read_scenes(str(tables))] == ["own"] * 3
    (query,) = find_code_blocks("sql")
    found = {row[0]: row[1:] for row in duckdb.sql(query.replace("my_scenes", str(tables))).fetchall()}
    assert set(found) == {"vehicle_small", "vegetation_ellipsoid", "construction_big"}
    assert found["construction_big"][1] == pytest.approx(14)


def test_custom_source_document_world_transform_is_right(document_variables):
    seen = {"x_m": 20.0, "y_m": -6.0, "z_m": 0.5, "yaw_rad": 3.0}
    pose = {"frame": 4, "yaw_rad": YAW} | make_position(ORIGIN)
    there = document_variables["to_world"](seen, pose)
    assert np.allclose([there[axis] for axis in ("x_m", "y_m", "z_m")], transform_to_world(20, -6, 0.5))
    assert np.isclose(np.cos(there["yaw_rad"]), np.cos(YAW + 3)) and there["frame"] == 4
    assert -np.pi <= there["yaw_rad"] < np.pi


def test_custom_source_document_names_all_columns_and_classes():
    text = DOCUMENT.read_text()
    tables = {title: body for title, body in re.findall(r"## (boxes|polygons|poses)\n(.*?)(?=\n## )", text, re.DOTALL)}
    known = {"boxes": custom.BOX_COLUMNS, "polygons": custom.POLYGON_COLUMNS, "poses": custom.POSE_COLUMNS}
    for title, body in tables.items():
        cells = [line.split("|")[1] for line in body.splitlines() if line.startswith("| `")]
        assert set(re.findall(r"`(\w+)`", " ".join(cells))) == set(known[title])
    for title, names in (("boxes", CATEGORIES), ("polygons", GROUND_CLASSES)):
        assert ", ".join(f"`{name}`" for name in names) in tables[title]
    assert len(tables) == 3


# ---------------------------------------------------------------------------------------------------- folder of drives


def test_custom_source_ground_classes_cover_all_drives(tmp_path):
    write_drive(make_street(), tmp_path, "a")
    crossing = [{"class": "crossing", "outline": make_outline((5, -4), (9, -4), (9, 4))}]
    write_drive(make_street() | {"polygons": crossing}, tmp_path, "b")
    (tmp_path / "c").mkdir()  # read_drive reports this empty folder
    (tmp_path / ".cache").mkdir()
    assert list_drives(tmp_path) == ["a", "b", "c"]
    assert read_ground_classes(tmp_path) == ("road", "sidewalk", "crossing")
    scene = read_drive(tmp_path, "b", read_ground_classes(tmp_path)).scene(0)
    assert scene.ground_classes == ("road", "sidewalk", "crossing")
    assert scene.occupied.any(axis=(1, 2)).tolist() == [False, False, True]
    (tmp_path / ".cache" / "broken").mkdir()
    with pytest.raises(ValueError, match=r"broken/polygons.parquet and polygons.json are missing"):
        read_ground_classes(tmp_path / ".cache")
    with pytest.raises(ValueError, match="no drive has a ground polygon; add at least the road"):
        read_ground_classes(write_drive({"polygons": []}, tmp_path / ".bare"))


def test_custom_source_reads_splits_of_file(tmp_path):
    for name in ("a", "b"):
        write_drive(make_street(), tmp_path, name)
    assert read_splits(tmp_path) is None
    sides = {"a": "train", "b": "test"}
    (tmp_path / "splits.json").write_text(json.dumps(sides))
    assert read_splits(tmp_path) == sides


BROKEN_SPLITS = {
    "cut off": ('{"a": "tr', "broken JSON"),
    "list": ("[]", "holds a list"),
    "stranger": ('{"a": "train", "z": "test"}', "folder 'z' does not exist next to this file"),
    "forgotten": ("{}", "has no entry for the folder a"),
    "side": ('{"a": "val"}', "a is 'val', expected 'train' or 'test'"),
    "number": ('{"a": 1}', "a is 1"),
}


@pytest.mark.parametrize("name", BROKEN_SPLITS)
def test_custom_source_names_broken_splits(tmp_path, name):
    text, reason = BROKEN_SPLITS[name]
    write_drive(make_street(), tmp_path, "a")
    (tmp_path / "splits.json").write_text(text)
    with pytest.raises(ValueError, match=re.escape(reason)) as error:
        read_splits(tmp_path)
    assert "splits.json" in str(error.value)


def test_custom_source_error_states_where_drives_belong(tmp_path):
    with pytest.raises(ValueError, match="holds no folder; --input must name the folder of all drives"):
        list_drives(tmp_path)
    write_drive(make_street(), tmp_path, "my street")
    with pytest.raises(ValueError, match="rename the folder"):
        list_drives(tmp_path)
    with pytest.raises(ValueError, match=r"no such drive; the drives are b"):
        read_drive(write_drive(make_street(), tmp_path / "other", "b"), "a")


# ------------------------------------------------------------------------------------------------------ mistakes


def change_row(table: str, row: int, **values):
    """Return a function that replaces values in one row of the street.

    The value `...` removes the key.
    """

    def change(tables: Tables) -> None:
        tables[table][row] |= values
        for name in [name for name, value in values.items() if value is ...]:
            del tables[table][row][name]

    return change


def change_all_rows(table: str, **values):
    def change(tables: Tables) -> None:
        for row in range(len(tables[table])):
            change_row(table, row, **values)(tables)

    return change


def replace_outline(*points):
    return change_row("polygons", 1, outline=list(points))


def make_corner(x: float, y: float, z: float = -1.0) -> list[float]:
    return transform_to_world(x, y, z).tolist()


LEVEL = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 115]
NAN, INF = float("nan"), float("inf")
# name -> (change of the street, file in the error, message)
MISTAKES = {
    "category": (
        change_row("boxes", 2, category="tree"),
        "boxes",
        "category of row 2 is 'tree', expected one of vegetation_cuboid, ",
    ),
    "category null": (change_row("boxes", 2, category=None), "boxes", "category of row 2 is null, expected a text"),
    "category number": (change_row("boxes", 2, category=3), "boxes", "category of row 2 is 3, expected a text"),
    "no category": (change_all_rows("boxes", category=...), "boxes", "column category is missing"),
    "no size": (change_all_rows("boxes", width_m=...), "boxes", "column width_m is missing"),
    "zero size": (
        change_row("boxes", 1, height_m=0),
        "boxes",
        "height_m of row 1 is 0, expected a number of 0.001..1000 m",
    ),
    "negative size": (change_row("boxes", 1, width_m=-2.0), "boxes", "width_m of row 1 is -2.0"),
    "huge size": (change_row("boxes", 1, length_m=5000), "boxes", "length_m of row 1 is 5000"),
    "nan": (change_row("boxes", 3, x_m=NAN), "boxes", "x_m of row 3 is nan"),
    "inf": (change_row("boxes", 3, z_m=-INF), "boxes", "z_m of row 3 is -inf"),
    "null": (change_row("boxes", 3, y_m=None), "boxes", "y_m of row 3 is null"),
    "absent": (change_row("boxes", 3, y_m=...), "boxes", "y_m of row 3 is null"),
    "text": (change_row("boxes", 3, y_m="3"), "boxes", "y_m of row 3 is '3', expected a number"),
    "true": (change_row("boxes", 3, y_m=True), "boxes", "y_m of row 3 is True"),
    "far": (
        change_row("boxes", 3, x_m=1e8),
        "boxes",
        "x_m of row 3 is 100000000.0, expected a number of -1e+07..1e+07 m",
    ),
    "high": (
        change_row("boxes", 3, z_m=5e6),
        "boxes",
        "z_m of row 3 is 5000000.0, expected a number of -10000..10000 m (z up)",
    ),
    "endless integer": (
        change_row("boxes", 3, x_m=10**4000),
        "boxes",
        "x_m of row 3 is an integer of more than 40 digits",
    ),
    "degrees": (
        change_row("boxes", 0, yaw_rad=90),
        "boxes",
        "yaw_rad of row 0 is 90, expected a number of -6.2832..6.2832 (radians)",
    ),
    "no orientation": (
        change_all_rows("boxes", yaw_rad=...),
        "boxes",
        "no orientation; give either yaw_rad or qw, qx, qy, qz",
    ),
    "two orientations": (change_row("boxes", 0, qw=1.0), "boxes", "both yaw_rad and a quaternion"),
    "half a quaternion": (change_all_rows("boxes", yaw_rad=..., qw=1.0, qz=0.0), "boxes", "column qx is missing"),
    "quaternion in some rows": (
        lambda tables: [
            change_all_rows("boxes", yaw_rad=..., qw=1, qx=0, qy=0, qz=0)(tables),
            change_row("boxes", 5, qy=...)(tables),
        ],
        "boxes",
        "qy of row 5 is null",
    ),
    "norm": (
        change_all_rows("boxes", yaw_rad=..., qw=0.5, qx=0, qy=0, qz=0),
        "boxes",
        "quaternion of row 0 has norm 0.5, expected 1; normalise it",
    ),
    "frame text": (
        change_row("boxes", 4, frame="10"),
        "boxes",
        "frame of row 4 is '10', expected a whole number of 0 or more; null means",
    ),
    "frame -1": (
        change_row("boxes", 4, frame=-1),
        "boxes",
        "frame of row 4 is -1, expected a whole number of 0 or more; null means that a box is static",
    ),
    "frame 1.5": (change_row("boxes", 4, frame=1.5), "boxes", "frame of row 4 is 1.5"),
    "frame nan": (change_row("boxes", 4, frame=NAN), "boxes", "frame of row 4 is nan"),
    "frame true": (change_row("boxes", 4, frame=True), "boxes", "frame of row 4 is True"),
    "frame too large": (change_row("boxes", 4, frame=2**63), "boxes", "frame of row 4 is 9223372036854775808"),
    "rounded time": (
        change_row("boxes", 4, frame=1.5e18),
        "boxes",
        "frame of row 4 is 1.5e+18, a float that cannot hold all digits",
    ),
    "other frames": (
        lambda tables: [change_row("boxes", row, frame=1000 + row)(tables) for row in (4, 5, 6)],
        "boxes",
        "the frame of no moving box, such as 1004, is a frame of the poses (10..20)",
    ),
    "id": (change_row("boxes", 4, instance_id=-3), "boxes", "instance_id of row 4 is -3"),
    "id list": (
        change_row("boxes", 4, instance_id=[1]),
        "boxes",
        "instance_id of row 4 is [1], expected a whole number of 0 or more, a text or null",
    ),
    "label": (change_row("boxes", 4, label=4), "boxes", "label of row 4 is 4, expected a text"),
    "heading": (
        change_row("boxes", 4, heading_known="yes"),
        "boxes",
        "heading_known of row 4 is 'yes', expected true, false or null",
    ),
    "typing error": (
        change_row("boxes", 4, frames=3),
        "boxes",
        "column 'frames' is unknown (meant frame?); drop it, or rename it to one of category, ",
    ),
    "boxes of elsewhere": (
        lambda tables: [change_row("boxes", row, x_m=row, y_m=0.0)(tables) for row in range(7)],
        "boxes",
        "lies more than 100 m from every pose",
    ),
    "class": (
        change_row("polygons", 0, **{"class": "grass"}),
        "polygons",
        "class of row 0 is 'grass', expected one of road, sidewalk, parking, terrain, ground, crossing; map",
    ),
    "no class": (change_all_rows("polygons", **{"class": ...}), "polygons", "column class is missing"),
    "no outline": (
        change_row("polygons", 1, outline=None),
        "polygons",
        "outline of row 1 is null, expected a list of points",
    ),
    "wkt": (
        change_row("polygons", 1, outline="POLYGON ((0 0, 1 1, 1 0))"),
        "polygons",
        "outline of row 1 is 'POLYGON ((0 0, 1 1, 1 0))'",
    ),
    "flat point": (
        replace_outline(make_corner(0, 0), make_corner(9, 0)[:2], make_corner(9, 9)),
        "polygons",
        "point 1 of the outline of row 1 is [45",
    ),
    "no points": (replace_outline(), "polygons", "outline of row 1 has 0 distinct points"),
    "two points": (
        replace_outline(make_corner(0, 0), make_corner(9, 0), make_corner(0, 0)),
        "polygons",
        "outline of row 1 has 2 distinct points, expected at least 3",
    ),
    "one point": (replace_outline(*[make_corner(0, 0)] * 4), "polygons", "outline of row 1 has 0 distinct points"),
    "nan point": (
        replace_outline(make_corner(0, 0), make_corner(9, 0), [NAN, 0, 0]),
        "polygons",
        "point 2 of the outline of row 1 is [nan, 0, 0], expected [x, y, z]",
    ),
    "text point": (
        replace_outline(make_corner(0, 0), make_corner(9, 0), "far"),
        "polygons",
        "point 2 of the outline of row 1 is 'far'",
    ),
    "high point": (
        replace_outline(make_corner(0, 0), make_corner(9, 0), make_corner(9, 9, 2e4)),
        "polygons",
        "point 2 of the outline of row 1 is 20115 m high",
    ),
    "on a line": (
        replace_outline([0, 0, 115], [9, 9, 115], [4, 4, 115]),
        "polygons",
        "outline of row 1 is no simple polygon",
    ),
    "bow tie": (
        replace_outline(make_corner(0, 0), make_corner(9, 9), make_corner(9, 0), make_corner(0, 9)),
        "polygons",
        "outline of row 1 is no simple polygon, Self-intersection[",
    ),
    "touches itself": (
        replace_outline(
            make_corner(0, 0),
            make_corner(9, 0),
            make_corner(9, 9),
            make_corner(4, 4),
            make_corner(0, 9),
            make_corner(4, 4),
        ),
        "polygons",
        "no simple polygon",
    ),
    "cliff": (
        replace_outline(make_corner(0, 0), make_corner(9, 0), make_corner(9, 0, 4), make_corner(9, 9)),
        "polygons",
        "point 1 of the outline of row 1 lies directly above or below the next point",
    ),
    "open cliff": (
        replace_outline(make_corner(0, 0), make_corner(9, 0), make_corner(9, 9), make_corner(0, 0, 4)),
        "polygons",
        "point 3 of the outline of row 1 lies directly above or below",
    ),
    "ground at 0": (
        lambda tables: [point.__setitem__(2, 0.0) for row in tables["polygons"] for point in row["outline"]],
        "polygons",
        "lies more than 100 m from every pose; the first pose is",
    ),
    "no pose": (lambda tables: tables["poses"].clear(), "poses", "holds no pose"),
    "no frame": (change_all_rows("poses", frame=...), "poses", "column frame is missing"),
    "null frame": (
        change_row("poses", 1, frame=None),
        "poses",
        "frame of row 1 is null, expected a whole number of 0 or more",
    ),
    "frame twice": (
        change_row("poses", 1, frame=10),
        "poses",
        "frame of row 1 is 10 after 10; sort the poses by frame without repeated frames",
    ),
    "unsorted": (change_row("poses", 1, frame=3), "poses", "frame of row 1 is 3 after 10"),
    "no place": (change_all_rows("poses", z_m=...), "poses", "column z_m is missing"),
    "pose nan": (change_row("poses", 1, yaw_rad=NAN), "poses", "yaw_rad of row 1 is nan"),
    "pose unturned": (change_all_rows("poses", yaw_rad=...), "poses", "no orientation"),
    "matrix and place": (
        change_row("poses", 1, world_from_ego=LEVEL),
        "poses",
        "has world_from_ego and x_m; keep only one form of the pose",
    ),
}


def make_matrix_poses(values) -> list[dict]:
    return [{"frame": 10, "world_from_ego": values}]


BROKEN_MATRICES = {
    "16 numbers": ([*LEVEL, 0, 0, 0, 1], "expected 12 numbers (3 x 4, row by row)"),
    "nested": ([LEVEL[:4], LEVEL[4:8], LEVEL[8:]], "expected 12 numbers"),
    "nan": ([NAN, *LEVEL[1:]], "world_from_ego of row 0 is [nan, 0, 0"),
    "scaled": ([2 * v for v in LEVEL], "holds no rotation"),
    "mirrored": ([-1.0, *LEVEL[1:]], "holds no rotation"),
    "transposed": (np.array([[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 115]]).T.ravel().tolist(), "holds no rotation"),
    "high": ([*LEVEL[:-1], 6e6], "z of row 0 is 6e+06 m"),
    "z down": (np.hstack([np.diag([1, -1, -1]), ORIGIN[:, None]]).ravel().tolist(), "the z axis of row 0 points down"),
    "camera": (
        [0, 0, 1, 5, -1, 0, 0, 6, 0, -1, 0, 115],
        "the z axis of row 0 points sideways; write the pose of a vehicle",
    ),
}


def assert_refused(root: Path, file: str, reason: str) -> None:
    with pytest.raises(ValueError) as error:
        read_drive(root, "street")
    message = str(error.value)
    assert type(error.value) is ValueError and reason in message and "\n" not in message
    assert message.startswith(str(root / "street" / file))


@pytest.mark.parametrize("name", MISTAKES)
def test_custom_source_names_mistake(tmp_path, name):
    change, file, reason = MISTAKES[name]
    tables = make_street()
    change(tables)
    assert_refused(write_drive(tables, tmp_path), f"{file}.json", reason)


@pytest.mark.parametrize("name", BROKEN_MATRICES)
def test_custom_source_names_broken_matrix(tmp_path, name):
    values, reason = BROKEN_MATRICES[name]
    assert_refused(write_drive(make_street() | {"poses": make_matrix_poses(values)}, tmp_path), "poses.json", reason)


BROKEN_FILES = {
    "empty": ("boxes.json", b"", "broken JSON"),
    "cut off": ("boxes.json", b'[{"category": "po', "broken JSON"),
    "object": ("boxes.json", b'{"boxes": []}', "holds a dict, expected a list of objects, one per row"),
    "columns": ("boxes.json", b"[[1, 2]]", "row 0 is [1, 2], expected an object of columns"),
    "deep": ("boxes.json", b"[" * 100_000, "broken JSON"),
    "latin": ("boxes.json", b'[{"label": "\xe4"}]', "broken JSON"),
    "digits": ("boxes.json", b'[{"x_m": ' + b"9" * 5000 + b"}]", "broken JSON"),
    "lines": ("boxes.json", b'[{"a\\nb": 1}]', "column 'a\\nb' is unknown"),
    "no parquet": ("boxes.parquet", b"category,x_m\npole,1\n", "broken Parquet file"),
}


@pytest.mark.parametrize("name", BROKEN_FILES)
def test_custom_source_names_broken_file(tmp_path, name):
    file, content, reason = BROKEN_FILES[name]
    write_drive(make_street(), tmp_path)
    (tmp_path / "street" / "boxes.json").unlink()
    (tmp_path / "street" / file).write_bytes(content)
    assert_refused(tmp_path, file, reason)


@pytest.mark.parametrize("table", ["boxes", "polygons", "poses"])
def test_custom_source_names_missing_and_surplus_table(tmp_path, table):
    folder = write_drive(make_street(), tmp_path) / "street"
    write_drive({table: make_street()[table]}, tmp_path, parquet=True)
    assert_refused(tmp_path, f"{table}.parquet", f"{table}.json both exist; keep one of the two")
    (folder / f"{table}.json").unlink()
    (folder / f"{table}.parquet").unlink()
    assert_refused(tmp_path, f"{table}.parquet", f"{table}.json are missing")


BROKEN_COLUMNS = {
    "strings": ({"x_m": ["far"] * 7}, "x_m of row 0 is 'far', expected a number"),
    "time": ({"frame": pa.array([1] * 7, pa.timestamp("ns"))}, "column frame has the type timestamp["),
    "decimals": ({"z_m": pa.array([1] * 7, pa.decimal128(5, 2))}, "column z_m has the type decimal128(5, 2)"),
    "score": ({"score": [0.5] * 7}, "column 'score' is unknown; drop it"),
    "flag as number": ({"heading_known": [1] * 7}, "heading_known of row 0 is 1"),
    "infinite": ({"width_m": [1.0] * 6 + [INF]}, "width_m of row 6 is inf"),
}


@pytest.mark.parametrize("name", BROKEN_COLUMNS)
def test_custom_source_names_parquet_column_of_wrong_type(tmp_path, name):
    columns, reason = BROKEN_COLUMNS[name]
    root = write_drive(make_street(), tmp_path, parquet=True)
    path = root / "street" / "boxes.parquet"
    table = pq.read_table(path)
    for column, values in columns.items():
        table = table.drop_columns([column] if column in table.column_names else []).append_column(column, [values])
    pq.write_table(table, path)
    assert_refused(root, "boxes.parquet", reason)


def test_custom_source_rejects_duplicate_column(tmp_path):
    path = write_drive(make_street(), tmp_path, parquet=True) / "street" / "boxes.parquet"
    table = pq.read_table(path)
    pq.write_table(table.append_column("x_m", table["y_m"]), path)
    assert_refused(tmp_path, "boxes.parquet", "column 'x_m' occurs twice")


def test_custom_source_reads_any_number_width_and_dictionaries(tmp_path):
    a = write_and_read_drive(make_street(), tmp_path / "a")
    path = write_drive(make_street(), tmp_path / "b", parquet=True) / "street" / "boxes.parquet"
    table = pq.read_table(path)
    for name, kind in (
        ("category", pa.dictionary(pa.int8(), pa.string())),
        ("label", pa.large_string()),
        ("frame", pa.uint16()),
    ):
        index = table.schema.get_field_index(name)
        column = table[name].dictionary_encode() if name == "category" else table[name].cast(kind)
        table = table.set_column(index, name, column)
    size = table.schema.get_field_index("length_m")
    pq.write_table(table.set_column(size, "length_m", table["length_m"].cast(pa.float32())), path)
    assert_same_drive(a, read_drive(tmp_path / "b", "street"), 1e-6)


def test_custom_source_raises_only_named_errors_for_mutations(tmp_path):
    rng = np.random.default_rng(0)
    folder = write_drive(make_street(), tmp_path, parquet=True) / "street"
    paths, refused = sorted(folder.iterdir()), 0
    for k in range(150):
        path = paths[k % len(paths)]
        good = path.read_bytes()
        bad = bytearray(good)
        for at in rng.integers(0, len(bad), rng.integers(1, 6)):
            bad[at] = rng.integers(256)
        path.write_bytes(bad)
        try:
            drive = read_drive(tmp_path, "street")
        except ValueError as error:
            refused += 1
            assert type(error) in (ValueError, LimitError) and path.name in str(error) and "\n" not in str(error)
        else:
            assert np.isfinite(drive.center_m).all() and (drive.size_m > 0).all()
        path.write_bytes(good)
    assert refused > 50


def test_custom_source_reads_poses_alone(tmp_path):
    write_drive({"poses": make_street()["poses"]}, tmp_path)
    frame, world_from_ego = read_poses(tmp_path, "street")
    assert frame.tolist() == [10, 20] and np.allclose(world_from_ego[0, :, 3], ORIGIN)
