"""Tests of the Argoverse 2 reader: plausibility of two real logs, frames of a synthetic log, and broken files."""

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pytest

from models.limits import LimitError
from models.scene import CATEGORIES
from pipelines.preprocess.sources.argoverse2 import CATEGORY_OF, list_logs, read_drive

LOG = "00000000-aaaa-bbbb-cccc-000000000001"
SWEEPS = np.array([315969904359876000, 315969904459712000, 315969904559845000])
ORIGIN = np.array([1000.25, -2000.5, 12.0])  # position of the ego vehicle at the first sweep, city frame (m)
YAW = 0.6


def make_quaternion(yaw_rad: float) -> tuple[float, float, float, float]:
    return np.cos(yaw_rad / 2), 0.0, 0.0, np.sin(yaw_rad / 2)


def make_pose_table() -> pa.Table:
    """Return poses at and between the sweeps for an ego vehicle that drives straight ahead, 1 m per sweep."""
    time = np.sort(np.concatenate([SWEEPS, SWEEPS + 50_000_000]))
    ahead = np.array([np.cos(YAW), np.sin(YAW), 0.0])
    at = ORIGIN + ((time - SWEEPS[0]) / 1e8).round(1)[:, None] * ahead
    q = np.tile(make_quaternion(YAW), (len(time), 1))
    names = ["qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"]
    return pa.table({"timestamp_ns": time} | dict(zip(names, np.hstack([q, at]).T, strict=True)))


# track, category, sweep, x, y, z, yaw in the ego frame of the sweep, length, width, height
ROWS = [
    ("car", "REGULAR_VEHICLE", 0, 20.0, 4.0, 0.5, 0.3, 4.5, 2.0, 1.6),
    ("car", "REGULAR_VEHICLE", 1, 21.0, 4.0, 0.5, 0.3, 4.5, 2.0, 1.6),
    ("cone", "CONSTRUCTION_CONE", 0, 30.0, -5.0, 0.1, 0.0, 0.4, 0.4, 0.8),
    ("cone", "CONSTRUCTION_CONE", 1, 29.0, -5.0, 0.1, 0.0, 0.4, 0.4, 0.8),
    ("me", "EGO_VEHICLE", 2, 1.4, 0.0, 0.6, 0.0, 4.9, 2.0, 1.7),
]


def make_annotation_table(rows=ROWS) -> pa.Table:
    track, category, sweep, x, y, z, yaw, length, width, height = zip(*rows, strict=True)
    q = np.array([make_quaternion(v) for v in yaw])
    floats = [length, width, height, *q.T, x, y, z]
    names = ["length_m", "width_m", "height_m", "qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"]
    columns = {"timestamp_ns": SWEEPS[list(sweep)], "track_uuid": list(track), "category": list(category)}
    columns |= {name: np.array(values, float) for name, values in zip(names, floats, strict=True)}
    return pa.table(columns | {"num_interior_pts": np.zeros(len(rows), np.int64)})


def make_points(*xy: tuple[float, float]) -> list[dict]:
    return [{"x": float(ORIGIN[0] + x), "y": float(ORIGIN[1] + y), "z": 11.7} for x, y in xy]


def make_map_json() -> dict:
    """Return a map with a crossing of 3 x 10 m and a road that covers all points within 40 m of the origin.

    The two edges of the crossing have opposite directions.
    """
    return {
        "drivable_areas": {"1": {"id": 1, "area_boundary": make_points((-40, -40), (40, -40), (40, 40), (-40, 40))}},
        "lane_segments": {},
        "pedestrian_crossings": {
            "2": {"id": 2, "edge1": make_points((10, 0), (10, 10)), "edge2": make_points((13, 10), (13, 0))}
        },
    }


def make_sim2_json() -> dict:
    return {"R": [1.0, 0.0, 0.0, 1.0], "t": [100 - ORIGIN[0], 100 - ORIGIN[1]], "s": 10 / 3}


def make_heights() -> np.ndarray:
    """Return float16 heights (rows = y, cols = x) in pixels of 0.3 m.

    The heights rise by 1 % eastward and are unknown in the far south.
    """
    height = np.tile(11.7 + 0.003 * (np.arange(667) - 333), (667, 1)).astype(np.float16)
    height[:200] = np.nan
    return height


@pytest.fixture
def root(tmp_path) -> Path:
    folder = tmp_path / "train" / LOG
    (folder / "map").mkdir(parents=True)
    pyarrow.feather.write_feather(make_annotation_table(), folder / "annotations.feather")
    pyarrow.feather.write_feather(make_pose_table(), folder / "city_SE3_egovehicle.feather")
    (folder / "map" / f"log_map_archive_{LOG}____PIT_city_1.json").write_text(json.dumps(make_map_json()))
    (folder / "map" / f"{LOG}___img_Sim2_city.json").write_text(json.dumps(make_sim2_json()))
    np.save(folder / "map" / f"{LOG}_ground_height_surface____PIT.npy", make_heights())
    return tmp_path


# ----------------------------------------------------------------------------------------------------- frames


def test_argoverse2_places_boxes_in_city_frame(root):
    drive = read_drive(root, "train", LOG)
    assert drive.source == "av2" and drive.sequence == LOG and len(drive) == 3
    assert drive.label.tolist() == ["REGULAR_VEHICLE"] * 2 + ["CONSTRUCTION_CONE"] * 2
    turn = np.array([[np.cos(YAW), -np.sin(YAW), 0], [np.sin(YAW), np.cos(YAW), 0], [0, 0, 1]])
    assert np.allclose(drive.center_m[0], ORIGIN + turn @ [20, 4, 0.5], atol=1e-9)
    assert np.allclose(drive.center_m[2], drive.center_m[3], atol=1e-9)  # the cone is static
    assert np.allclose(drive.heading_rad[:2], YAW + 0.3)
    assert drive.size_m[0].tolist() == [4.5, 2.0, 1.6]


def test_argoverse2_scene_has_boxes_of_its_sweep_in_ego_frame(root):
    drive = read_drive(root, "train", LOG)
    assert drive.frame.tolist() == SWEEPS.tolist()
    scenes = [drive.scene(k) for k in range(3)]
    assert [len(scene) for scene in scenes] == [2, 2, 0]  # the reader drops the box of the ego vehicle
    assert np.allclose(scenes[1].center_m, [[21, 4, 0.5], [29, -5, 0.1]], atol=1e-4)
    assert np.allclose(scenes[1].heading_rad[0], 0.3, atol=1e-6)
    assert scenes[2].scene_id == f"av2-{LOG}-{SWEEPS[2]}"


def test_argoverse2_reads_log_with_only_ego_box(root):
    ego_only = make_annotation_table(ROWS[-1:])
    pyarrow.feather.write_feather(ego_only, root / "train" / LOG / "annotations.feather")
    drive = read_drive(root, "train", LOG)
    assert len(drive) == 1 and len(drive.scene(0)) == 0


def test_argoverse2_ids_are_deterministic(root):
    drive = read_drive(root, "train", LOG)
    expected = int.from_bytes(hashlib.blake2b(b"car", digest_size=8).digest(), "big") >> 1
    assert drive.instance_id[0] == drive.instance_id[1] == expected
    assert drive.instance_id[2] == drive.instance_id[3] != expected


def test_argoverse2_ground_lies_on_height_raster(root):
    drive = read_drive(root, "train", LOG)
    scene = drive.scene(0)
    assert scene.ground_classes == ("road", "crossing")
    assert abs(scene.ground_area_m2()[1] - 30) < 1.5  # the crossing is a simple quadrilateral
    turn = np.array([[np.cos(YAW), -np.sin(YAW)], [np.sin(YAW), np.cos(YAW)]])
    for row, col in [(200, 128), (180, 90), (255, 10)]:
        east, north = turn @ [scene.grid.x_m()[row], scene.grid.y_m()[col]]
        on_map = max(abs(east), abs(north)) < 40 and north > -40
        assert scene.occupied[0, row, col] == on_map
        if on_map:
            expected = 11.7 + 0.003 * (int((100 + east) / 0.3) - 333) - 12.0
            assert abs(scene.height_m[0, row, col] - expected) < 0.01


def test_argoverse2_groups_every_category_of_taxonomy(root):
    assert len(CATEGORY_OF) == 30
    folder = root / "train" / LOG
    rows = [(f"t{k}", label, 0, 20.0, k - 15.0, 0, 0, 1, 1, 1) for k, label in enumerate(sorted(CATEGORY_OF))]
    pyarrow.feather.write_feather(make_annotation_table(rows), folder / "annotations.feather")
    counts = read_drive(root, "train", LOG).scene(0).counts()
    assert {name: count for name, count in zip(CATEGORIES, counts.tolist(), strict=True) if count} == {
        "vehicle_big": 8,
        "vehicle_small": 2,
        "two_wheelers": 3,
        "human": 5,
        "pole": 1,
        "traffic_control": 5,
        "object": 6,
    }


# -------------------------------------------------------------------------------------------------- real logs


@pytest.fixture(scope="module", params=["train", "val"])
def real_drive(real_data, request):
    (log,) = [log for split, log in list_logs(real_data / "av2") if split == request.param]
    return read_drive(real_data / "av2", request.param, log)


def sample_surface(drive, points_m: np.ndarray) -> np.ndarray:
    """Return the raster heights at world points in m; an unknown height is NaN."""
    ground = drive.ground
    col, row = (points_m[:, :2] @ ground.raster_from_world[:2, :2].T + ground.raster_from_world[:2, 2]).astype(int).T
    rows, cols = ground.raster_m.shape
    inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
    return np.where(inside, ground.raster_m[row.clip(0, rows - 1), col.clip(0, cols - 1)], np.nan)


def test_argoverse2_real_ego_origin_is_wheel_radius_above_ground(real_drive):
    position = real_drive.world_from_imu[:, :, 3]
    assert abs(np.nanmedian(position[:, 2] - sample_surface(real_drive, position)) - 0.31) < 0.05


def test_argoverse2_real_cars_stand_on_ground(real_drive):
    cars = real_drive.category == CATEGORIES.index("vehicle_small")
    bottom = real_drive.center_m[cars, 2] - real_drive.size_m[cars, 2] / 2
    above = bottom - sample_surface(real_drive, real_drive.center_m[cars])
    assert np.isfinite(above).sum() > 1000
    assert abs(np.nanmedian(above)) < 0.05 and np.nanpercentile(np.abs(above), 90) < 0.2


def test_argoverse2_real_bollards_do_not_move(real_drive):
    """Bollards are static only if the reader applies the ego pose of each sweep, because the ego vehicle moves."""
    bollards = real_drive.label == "BOLLARD"
    for track in np.unique(real_drive.instance_id[bollards]):
        places = real_drive.center_m[real_drive.instance_id == track]
        assert np.linalg.norm(places - places.mean(axis=0), axis=1).max() < 0.25


def test_argoverse2_real_cars_move_along_their_heading(real_drive):
    agreement = []
    for track in np.unique(real_drive.instance_id[real_drive.label == "REGULAR_VEHICLE"]):
        rows = np.flatnonzero(real_drive.instance_id == track)
        way = real_drive.center_m[rows[-1], :2] - real_drive.center_m[rows[0], :2]
        if np.linalg.norm(way) > 10:
            middle = real_drive.heading_rad[rows[len(rows) // 2]]
            agreement.append(way @ [np.cos(middle), np.sin(middle)] / np.linalg.norm(way))
    assert len(agreement) >= 3 and np.median(agreement) > 0.9


def test_argoverse2_real_scene_has_road_below_ego_and_no_ego_box(real_drive):
    assert "EGO_VEHICLE" not in set(real_drive.label)
    for k in range(0, len(real_drive), 39):
        scene = real_drive.scene(k)
        assert scene.occupied[0][-8:, 120:136].mean() > 0.9
        assert abs(np.median(scene.height_m[0][-8:, 120:136]) + 0.31) < 0.1


# ----------------------------------------------------------------------------------------------- broken files


def rewrite(table: pa.Table, **columns) -> pa.Table:
    for name, values in columns.items():
        values = values(table[name].to_pylist()) if callable(values) else values
        table = table.set_column(table.schema.get_field_index(name), name, pa.array(values))
    return table


def replace_first_value(value):
    return lambda values: [value, *values[1:]]


BROKEN_ANNOTATIONS = {
    "no column": (lambda t: t.drop_columns(["qx"]), "column qx is missing"),
    "text for number": (lambda t: rewrite(t, tx_m=["far"] * 5), "tx_m is string, expected float"),
    "number for text": (lambda t: rewrite(t, category=[1] * 5), "category is int64, expected text"),
    "float time": (lambda t: rewrite(t, timestamp_ns=[1.0] * 5), "timestamp_ns is double, expected int64"),
    "nulls": (lambda t: rewrite(t, tx_m=replace_first_value(None)), "tx_m has 1 nulls"),
    "null track": (lambda t: rewrite(t, track_uuid=replace_first_value(None)), "track_uuid has 1 nulls"),
    "nan": (lambda t: rewrite(t, tz_m=replace_first_value(float("nan"))), "tz_m of row 0 is nan"),
    "inf": (lambda t: rewrite(t, length_m=replace_first_value(float("inf"))), "length_m of row 0 is inf"),
    "huge": (lambda t: rewrite(t, tx_m=replace_first_value(1e30)), "tx_m of row 0 is 1e+30"),
    "huge size": (lambda t: rewrite(t, width_m=replace_first_value(1e6)), "width_m of row 0 is 1e+06"),
    "negative size": (lambda t: rewrite(t, height_m=replace_first_value(-1.0)), "height_m of row 0 is -1"),
    "zero quaternion": (lambda t: rewrite(t, qw=[0.0] * 5, qz=[0.0] * 5), "quaternion of row 0 has norm 0"),
    "unknown category": (
        lambda t: rewrite(t, category=replace_first_value("SPACESHIP")),
        "unknown category 'SPACESHIP'",
    ),
    "unknown sweep": (
        lambda t: rewrite(t, timestamp_ns=replace_first_value(17)),
        "no pose at the annotated timestamp 17",
    ),
    "no rows": (lambda t: t.slice(0, 0), "holds no box"),
}


@pytest.mark.parametrize("name", BROKEN_ANNOTATIONS)
def test_argoverse2_names_broken_annotations(root, name):
    breaks, reason = BROKEN_ANNOTATIONS[name]
    pyarrow.feather.write_feather(breaks(make_annotation_table()), root / "train" / LOG / "annotations.feather")
    assert_refused(root, reason, LOG)


BROKEN_POSES = {
    "no column": (lambda t: t.drop_columns(["tz_m"]), "column tz_m is missing"),
    "nan": (lambda t: rewrite(t, tx_m=replace_first_value(float("nan"))), "tx_m of row 0 is nan"),
    "huge": (lambda t: rewrite(t, ty_m=replace_first_value(1e9)), "ty_m of row 0 is 1e+09"),
    "no rows": (lambda t: t.slice(0, 0), "no pose at the annotated timestamp"),
    "quaternion": (lambda t: rewrite(t, qw=replace_first_value(1.5)), "quaternion of row 0"),
    "huge quaternion": (lambda t: rewrite(t, qw=replace_first_value(1e300)), "qw of row 0 is 1e+300"),
}


@pytest.mark.parametrize("name", BROKEN_POSES)
def test_argoverse2_names_broken_poses(root, name):
    breaks, reason = BROKEN_POSES[name]
    pyarrow.feather.write_feather(breaks(make_pose_table()), root / "train" / LOG / "city_SE3_egovehicle.feather")
    assert_refused(root, reason, "city_SE3_egovehicle.feather")


def edit_json(content: dict, **values) -> str:
    return json.dumps(content | values)


EDGE = [(0, 0), (1, 1)]
BROKEN_MAPS = {
    "empty": ("", "broken JSON"),
    "truncated": (json.dumps(make_map_json())[:100], "broken JSON"),
    "a list": ("[1, 2]", "holds a list"),
    "deep": ("[" * 100_000, "broken JSON"),
    "not utf-8": (b"\xff\xfe{", "broken JSON"),
    "no areas": (edit_json(make_map_json(), drivable_areas=None), "drivable_areas is missing"),
    "areas are a list": (edit_json(make_map_json(), drivable_areas=[1]), "drivable_areas is missing"),
    "area is a number": (edit_json(make_map_json(), drivable_areas={"1": 1}), "drivable_areas is missing"),
    "two corners": (
        edit_json(make_map_json(), drivable_areas={"1": {"area_boundary": make_points(*EDGE)}}),
        "area_boundary",
    ),
    "no edge": (edit_json(make_map_json(), pedestrian_crossings={"1": {"edge1": make_points(*EDGE)}}), "edge2 of None"),
    "three points": (
        edit_json(make_map_json(), pedestrian_crossings={"1": {"edge1": make_points(*EDGE, (2, 2)), "edge2": []}}),
        "edge1 of None",
    ),
    "nan": (json.dumps(make_map_json()).replace("1040.25", "NaN"), "without valid x, y"),
    "huge": (json.dumps(make_map_json()).replace("1040.25", "1e999"), "without valid x, y"),
    "text": (json.dumps(make_map_json()).replace("1040.25", '"east"'), "without valid x, y"),
    "true": (json.dumps(make_map_json()).replace("1040.25", "true"), "without valid x, y"),
}


@pytest.mark.parametrize("name", BROKEN_MAPS)
def test_argoverse2_names_broken_map(root, name):
    content, reason = BROKEN_MAPS[name]
    path = root / "train" / LOG / "map" / f"log_map_archive_{LOG}____PIT_city_1.json"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert_refused(root, reason, path.name)


BROKEN_SIM2 = {
    "no R": {"R": None},
    "short t": {"t": [1.0]},
    "nan s": {"s": float("nan")},
    "zero s": {"s": 0},
    "sheared R": {"R": [1, 1, 0, 1]},
    "text t": {"t": ["a", "b"]},
}


@pytest.mark.parametrize("name", BROKEN_SIM2)
def test_argoverse2_names_broken_sim2(root, name):
    path = root / "train" / LOG / "map" / f"{LOG}___img_Sim2_city.json"
    path.write_text(edit_json(make_sim2_json(), **BROKEN_SIM2[name]))
    assert_refused(root, "download the log again", path.name)


BROKEN_HEIGHTS = {
    "integers": np.ones((5, 5), np.int32),
    "one row": np.ones(5, np.float16),
    "nothing known": np.full((5, 5), np.nan, np.float16),
    "inf": np.full((5, 5), np.inf, np.float16),
    "objects": np.array([[{}]]),
    "huge": np.full((5, 5), 1e30),
}


@pytest.mark.parametrize("name", BROKEN_HEIGHTS)
def test_argoverse2_names_broken_height_raster(root, name):
    path = root / "train" / LOG / "map" / f"{LOG}_ground_height_surface____PIT.npy"
    np.save(path, BROKEN_HEIGHTS[name], allow_pickle=True)
    assert_refused(root, "download the log again", path.name)


@pytest.mark.parametrize("size", [0, 5, 60, 1000])
@pytest.mark.parametrize("pattern", ["*.feather", "map/*.npy", "map/log_map*.json"])
def test_argoverse2_names_truncated_file(root, pattern, size):
    path = sorted((root / "train" / LOG).glob(pattern))[0]
    path.write_bytes(path.read_bytes()[:size] if size < path.stat().st_size else path.read_bytes()[:-7])
    assert_refused(root, "broken", path.name)


def test_argoverse2_names_truncated_npy_header(root):
    path = root / "train" / LOG / "map" / f"{LOG}_ground_height_surface____PIT.npy"
    path.write_bytes(path.read_bytes().replace(b"), }", b"(((("))
    assert_refused(root, "broken npy", path.name)


def test_argoverse2_allocates_nothing_for_oversized_npy_header(root):
    path = root / "train" / LOG / "map" / f"{LOG}_ground_height_surface____PIT.npy"
    good = path.read_bytes()
    promise = good.replace(b"(667, 667), }          ", b"(9999999, 9999999), }  ")
    assert promise != good
    path.write_bytes(promise)
    assert_refused(root, "broken npy", path.name)


@pytest.mark.parametrize(
    "pattern",
    ["annotations.feather", "city_SE3_egovehicle.feather", "map/*.npy", "map/*Sim2*", "map/log_map*", "map"],
)
def test_argoverse2_names_missing_file(root, pattern):
    (path,) = (root / "train" / LOG).glob(pattern)
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    assert_refused(root, "download the log again", LOG)


def test_argoverse2_lists_logs_with_annotations(root, tmp_path):
    (tmp_path / "val" / "b").mkdir(parents=True)
    (tmp_path / "val" / "a").mkdir()
    (tmp_path / "test" / "c").mkdir(parents=True)
    assert list_logs(root) == [("train", LOG), ("val", "a"), ("val", "b")]
    with pytest.raises(ValueError, match="test split has no annotations"):
        read_drive(root, "test", "c")
    with pytest.raises(ValueError, match="no such log"):
        read_drive(root, "val", "zzz")
    with pytest.raises(ValueError, match="test split has no annotations"):
        list_logs(tmp_path / "test")


def test_argoverse2_raises_only_named_errors_for_mutated_files(root):
    rng = np.random.default_rng(0)
    paths = sorted(p for p in (root / "train" / LOG).rglob("*") if p.is_file())
    refused = 0
    for k in range(200):
        path = paths[k % len(paths)]
        good = path.read_bytes()
        bad = bytearray(good)
        for at in rng.integers(0, min(len(bad), 4000), rng.integers(1, 6)):
            bad[at] = rng.integers(256)
        path.write_bytes(bad)
        try:
            drive = read_drive(root, "train", LOG)
        except ValueError as error:
            refused += 1
            assert type(error) in (ValueError, LimitError) and path.name in str(error) and "\n" not in str(error)
        else:
            assert np.isfinite(drive.center_m).all() and (drive.size_m > 0).all()
        path.write_bytes(good)
    assert refused > 50


def assert_refused(root: Path, reason: str, file: str) -> None:
    with pytest.raises(ValueError) as error:
        read_drive(root, "train", LOG)
    assert type(error.value) is ValueError
    assert reason in str(error.value) and file in str(error.value) and "\n" not in str(error.value)
