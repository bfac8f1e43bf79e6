"""Tests of drives that are damaged or written by an attacker: small files that ask for much memory or time."""

import io
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pyarrow.parquet as pq
import pytest
import shapely
from helpers import ROOT

from models.limits import LimitError
from models.scene import Grid
from pipelines.preprocess.sources import argoverse2, custom, kitti360
from pipelines.preprocess.sources import triangulation as triangulation_module
from pipelines.preprocess.sources.drive import MapGround, Pose, SurfaceGround
from pipelines.preprocess.sources.triangulation import triangulate_polygon
from pipelines.runtime.feather_sizes import measure_feather
from pipelines.runtime.parquet_sizes import measure_columns

BOX = {"category": "pole", "x_m": 10.0, "y_m": 0.0, "z_m": 0.0, "length_m": 1.0, "width_m": 1.0, "height_m": 1.0}
BOX |= {"yaw_rad": 0.0}
ROAD = {"class": "road", "outline": [[0, -5, 0], [80, -5, 0], [80, 5, 0], [0, 5, 0]]}
POSE = {"frame": 0, "x_m": 0.0, "y_m": 0.0, "z_m": 0.0, "yaw_rad": 0.0}


@pytest.fixture
def drives(tmp_path) -> Path:
    """Directory with one valid custom drive in JSON."""
    folder = tmp_path / "own" / "street"
    folder.mkdir(parents=True)
    for name, row in (("boxes", BOX), ("polygons", ROAD), ("poses", POSE)):
        (folder / f"{name}.json").write_text(json.dumps([row]))
    return tmp_path / "own"


def replace_table(drives: Path, name: str, table: pa.Table, **options: Any) -> Path:
    (drives / "street" / f"{name}.json").unlink()
    path = drives / "street" / f"{name}.parquet"
    pq.write_table(table, path, **options)
    return path


def measure_peak_gb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def refuse(drives: Path, message: str, seconds: float = 10.0) -> None:
    """Expect an error within a time and without much memory."""
    before, start = measure_peak_gb(), time.perf_counter()
    with pytest.raises(ValueError, match=message):
        custom.read_drive(drives, "street")
    assert time.perf_counter() - start < seconds and measure_peak_gb() - before < 0.3


# ---------------------------------------------------------------------------------------------------- own Parquet


def make_box_table(rows: int, **changes) -> pa.Table:
    columns = {name: pa.DictionaryArray.from_arrays(pa.array(np.zeros(rows, np.int32)), [v]) for name, v in BOX.items()}
    columns = {n: c if n == "category" else c.dictionary_decode() for n, c in columns.items()}
    return pa.table(columns | changes)


def test_small_table_with_many_rows_is_refused(drives):
    path = replace_table(drives, "boxes", make_box_table(2_100_000), compression="zstd")
    assert path.stat().st_size < 1_000_000
    refuse(drives, "2,100,000 rows, objects")


def test_dictionary_of_long_texts_is_not_decoded(drives):
    rows = 60_000
    label = pa.DictionaryArray.from_arrays(pa.array(np.zeros(rows, np.int32)), ["x" * 100_000])
    path = replace_table(drives, "boxes", make_box_table(rows, label=label), compression="zstd")
    assert path.stat().st_size < 200_000  # Decoded, the labels have 6 GB.
    refuse(drives, "a text in column label: 100,000 characters")


def test_dictionary_of_short_texts_is_shared(drives):
    """146 kB of equal texts took 2.9 GB."""
    rows = 20_000
    label = pa.DictionaryArray.from_arrays(pa.array(np.zeros(rows, np.int32)), ["x" * 1_000])
    replace_table(drives, "boxes", make_box_table(rows, label=label), compression="zstd")
    drive = custom.read_drive(drives, "street")
    assert len(drive.label) == rows and len({id(text) for text in drive.label}) == 1


def test_list_column_with_many_entries_is_refused(drives, monkeypatch):
    monkeypatch.setenv("PRITTI_MAX_TABLE_BYTES", "50000000")
    outline = pa.ListArray.from_arrays([0, 7_000_000], pa.array(np.zeros(7_000_000, np.int8)))
    table = pa.table({"class": ["road"], "outline": outline})
    assert replace_table(drives, "polygons", table, compression="zstd").stat().st_size < 50_000
    refuse(drives, "bytes in memory of the columns")


def test_nested_lists_are_counted_before_they_become_objects(drives):
    point = pa.ListArray.from_arrays(np.arange(0, 36_003, 3).astype(np.int32), pa.array(np.zeros(36_000)))
    outline = pa.ListArray.from_arrays([0, 12_000], point)
    replace_table(drives, "polygons", pa.table({"class": ["road"], "outline": outline}))
    refuse(drives, "row 0, column outline: 12,000 points of a polygon; at most 10,000")


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (pa.struct([("a", pa.int64())]), {"a": 1}),
        (pa.list_(pa.string()), ["x"]),
        (pa.list_(pa.list_(pa.list_(pa.int8()))), [[[1]]]),
        (pa.list_(pa.int8(), 10_000), [1] * 10_000),
        (pa.map_(pa.int8(), pa.int8()), [(1, 2)]),
        (pa.binary(), b"x"),
    ],
    ids=str,
)
def test_column_of_other_type_is_named(kind, value, drives):
    replace_table(drives, "boxes", make_box_table(1, label=pa.array([value], kind)))
    refuse(drives, "column label (has the type|is unknown|of row 0)|label of row 0 is")


def encode_count(value: int) -> bytes:
    """Return a positive integer in Thrift's compact protocol."""
    value, out = 2 * value, b""
    while value > 127:
        value, out = value >> 7, out + bytes([value & 127 | 128])
    return out + bytes([value])


def test_page_with_more_values_than_metadata_is_refused():
    stream = io.BytesIO()
    pq.write_table(pa.table({"a": np.arange(5_000) / 7}), stream, use_dictionary=False, compression="zstd")
    rows, (size,) = measure_columns(stream)
    assert (rows, size.values, size.path, size.has_dictionary) == (5_000, 5_000, ("a",), False) and size.bytes > 40_000
    content = stream.getvalue()
    place = content.index(encode_count(5_000))  # The header of the first page precedes the metadata.
    changed = content[:place] + encode_count(8_000) + content[place + len(encode_count(5_000)) :]
    with pytest.raises(ValueError, match="a column has 8,000 values, but the metadata state 5,000"):
        measure_columns(io.BytesIO(changed))


def test_sizes_equal_those_of_pyarrow():
    table = pa.table({"t": ["a", "bb", None] * 1_000, "l": [[[1.0, 2.0]], [], None] * 1_000, "n": range(3_000)})
    options: Any
    for options in ({}, {"use_dictionary": False}, {"data_page_version": "2.0"}, {"data_page_size": 100}):
        stream = io.BytesIO()
        pq.write_table(table, stream, row_group_size=700, **options)
        rows, sizes = measure_columns(stream)
        assert measure_columns(stream, {"n"}) == (rows, sizes[2:])
        metadata = pq.read_metadata(stream)
        assert rows == len(table) and [size.path[0] for size in sizes] == ["t", "l", "n"]
        for k, size in enumerate(sizes):
            chunks = [metadata.row_group(g).column(k) for g in range(metadata.num_row_groups)]
            assert ".".join(size.path) == chunks[0].path_in_schema
            assert size.bytes == sum(chunk.total_uncompressed_size for chunk in chunks)
            assert size.values >= sum(chunk.num_values for chunk in chunks)


@pytest.mark.parametrize("content", [b"", b"PAR1", b"PAR1" * 3, b"PAR1" + b"\xff" * 20 + b"\x10\0\0\0PAR1"])
def test_no_parquet_file_is_refused(content):
    with pytest.raises(ValueError, match=r"footer|not a Parquet file|damaged|not part of the format"):
        measure_columns(io.BytesIO(content))


ABORT = """
import io, sys
import pyarrow as pa, pyarrow.parquet as pq
from pathlib import Path
from pipelines.preprocess.sources import custom
path = Path(sys.argv[1], "street", "poses.parquet")
good = path.read_bytes()
size = int.from_bytes(good[-8:-4], "little")
refused = 0
for place in range(len(good) - 8 - size, len(good) - 8):
    for bit in range(0, 8, 3):
        bad = bytearray(good)
        bad[place] ^= 1 << bit
        path.write_bytes(bad)
        try:
            custom.read_poses(sys.argv[1], "street")
        except ValueError:
            refused += 1
print("refused", refused)
"""


def test_damaged_footer_does_not_end_process(drives):
    """pyarrow ends the process (SIGABRT) if some bits of the metadata change."""
    table = pa.table({name: [value] for name, value in POSE.items()})
    replace_table(drives, "poses", table, store_schema=False, write_statistics=False)
    run = subprocess.run(
        [sys.executable, "-c", ABORT, str(drives)], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False
    )
    assert run.returncode == 0 and int(run.stdout.split()[1]) > 300, run.stderr[-2000:]


# ------------------------------------------------------------------------------------------------------- own JSON


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[" * 100_000, "nested too deeply"),
        ("[" + "[]," * 9_000_000 + "[]]", "commas, colons and opening brackets"),
        ('[{"frame": 1, "frame": 2}]', "'frame' occurs twice"),
        ('[{"frame": ' + "9" * 5_000 + "}]", "broken JSON"),
        ('[{"frame": [' + "[" * 300 + "]" * 301 + "}]", r"frame of row 0 is \[\[\["),
        (b"\xff\xff", "broken JSON"),
        (b"", "broken JSON"),
    ],
    ids=["deep", "many", "twice", "digits", "nested value", "encoding", "empty"],
)
def test_json_of_drive_is_strict(content, message, drives):
    content = content if isinstance(content, bytes) else content.encode()
    (drives / "street" / "poses.json").write_bytes(content)
    refuse(drives, message)


def test_named_pipe_is_not_read(drives, tmp_path):
    (drives / "street" / "poses.json").unlink()
    os.mkfifo(drives / "street" / "poses.json")
    refuse(drives, r"poses.parquet and poses.json are missing")
    folder = tmp_path / "data_poses" / "2013_05_28_drive_0003_sync"
    folder.mkdir(parents=True)
    os.mkfifo(folder / "poses.txt")
    with pytest.raises(ValueError, match="no regular file"):
        kitti360.read_poses(tmp_path, "0003")


# ------------------------------------------------------------------------------------------------------- polygons


def make_spiral(count: int, turns: int) -> np.ndarray:
    share = np.linspace(0.2, 1, count // 2)
    angle, radius = 2 * np.pi * turns * share, 40 * share
    arms = [np.column_stack([r * np.cos(angle), r * np.sin(angle)]) for r in (radius, radius - 0.3 * 40 / turns)]
    return np.concatenate([arms[0], arms[1][::-1]])


def make_zigzag(count: int) -> np.ndarray:
    x = np.linspace(0, 60, count // 2)
    y = np.where(np.arange(count // 2) % 2, 20.0, 0.0)
    return np.concatenate([np.column_stack([x, y]), np.column_stack([x, y + 1])[::-1]])


def make_star(count: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    angle, radius = np.sort(rng.random(count)) * 2 * np.pi, rng.uniform(10, 40, count)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])


def make_comb(count: int) -> np.ndarray:
    x = 2.0 * np.arange(count // 4)
    teeth = np.stack([x, x, x + 1, x + 1], axis=1).reshape(-1)
    heights = np.tile([10.0, 0.0, 0.0, 10.0], len(x))
    points = np.column_stack([teeth, heights])
    return np.concatenate([points, [[x[-1] + 2, 20.0], [0.0, 20.0]]]) * [0.01, 1]


def make_circle(count: int) -> np.ndarray:
    angle = np.arange(count) / count * 2 * np.pi
    return 40 * np.column_stack([np.cos(angle), np.sin(angle)])


SHAPES = {
    "spiral": lambda n: make_spiral(n, 10),
    "tight spiral": lambda n: make_spiral(n, 60),
    "zigzag": make_zigzag,
    "turned zigzag": lambda n: make_zigzag(n)[:, ::-1],
    "star": make_star,
    "comb": make_comb,
    "turned comb": lambda n: make_comb(n)[:, ::-1],
    "circle": make_circle,
}


@pytest.mark.parametrize("shape", ["tight spiral", "zigzag", "star", "comb"])
def test_polygon_of_10_000_points_is_read_quickly(shape, drives):
    """shapely needs up to 6 s for the triangulation of these polygons."""
    points = SHAPES[shape](9_996 if "comb" in shape else 10_000)
    outline = [[x, y, 0.1 * x] for x, y in points.tolist()]
    (drives / "street" / "polygons.json").write_text(json.dumps([{"class": "road", "outline": outline}]))
    start = time.process_time()
    drive = custom.read_drive(drives, "street")
    height_m, occupied = drive.ground.rasterise(drive.pose(0), Grid(), 1)
    assert time.process_time() - start < 2
    grid = Grid()
    x, y = np.meshgrid(grid.x_m(), grid.y_m(), indexing="ij")
    inside = shapely.contains_xy(shapely.Polygon(points), x, y)
    assert (inside != occupied[0]).mean() < 5e-3
    assert np.abs(height_m[0] - 0.1 * x)[occupied[0]].max() < 1e-3


@pytest.mark.parametrize("shape", [name for name in SHAPES if name != "tight spiral"])
def test_fast_triangulation_is_constrained_delaunay(shape, monkeypatch):
    points = SHAPES[shape](1_400)
    fast = triangulate_polygon(points)
    monkeypatch.setattr(triangulation_module, "FEW_POINTS", 10**9)
    slow = triangulate_polygon(points)
    assert len(fast) == len(slow) == len(points) - 2
    if shape not in ("circle", "comb", "turned comb"):  # Points on one circle have several such triangulations.
        assert {tuple(sorted(t)) for t in fast.tolist()} == {tuple(sorted(t)) for t in slow.tolist()}


def test_polygon_with_too_many_points_is_refused(drives):
    outline = np.column_stack([make_spiral(120_000, 10), np.zeros(120_000)]).tolist()
    (drives / "street" / "polygons.json").write_text(json.dumps([{"class": "road", "outline": outline}]))
    refuse(drives, "outline of row 0: 120,000 points of a polygon; at most 10,000")


def test_ground_with_many_layers_needs_little_memory(monkeypatch):
    """1,000 triangles above each other took 2.3 GB."""
    corners = np.array([[-10.0, -200, 0], [300, 0, 0], [-10, 200, 0]])
    triangles = np.tile(corners, (1_000, 1, 1)) + np.arange(1_000)[:, None, None] * [0, 0, 1e-3]
    ground, pose = SurfaceGround(triangles, np.zeros(1_000, np.int64)), Pose(np.zeros(3), 0.0)
    before = measure_peak_gb()
    height_m, occupied = ground.rasterise(pose, Grid(), 1)
    assert measure_peak_gb() - before < 0.4
    assert occupied.any() and np.allclose(height_m[occupied], 0.999)
    monkeypatch.setenv("PRITTI_MAX_SCENE_COVERAGE", "10000000")
    with pytest.raises(LimitError, match=r"ground triangles: .* pixels visited"):
        ground.rasterise(pose, Grid(), 1)
    polygon = corners[:, :2] * 0.1
    many = MapGround([0] * 500, [polygon] * 500, np.zeros((10, 10)), np.eye(3))
    with pytest.raises(LimitError, match="ground polygons"):
        many.rasterise(pose, Grid(), 1)


# ---------------------------------------------------------------------------------------------------- KITTI-360

NAME = "2013_05_28_drive_0003_sync"
POSES = "0 1 0 0 0 0 -1 0 0 0 0 -1 0\n"


def write_kitti360(root: Path, xml: str, poses: str = POSES) -> Path:
    for path, text in (
        (root / "data_3d_bboxes" / "train_full" / f"{NAME}.xml", xml),
        (root / "data_poses" / NAME / "poses.txt", poses),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


def format_matrix(tag: str, words: str, cols: int) -> str:
    rows = len(words.split()) // cols
    return f"<{tag}><rows>{rows}</rows><cols>{cols}</cols><data>{words}</data></{tag}>"


def format_box(shift: float) -> str:
    transform = format_matrix("transform", f"1 0 0 {shift:.9f} 0 1 0 0 0 0 1 0 0 0 0 1", 4)
    corners = " ".join(f"{x} {y} {z}" for x in (0, 1) for y in (0, 1) for z in (0, 1))
    fields = "<index>1</index><label>car</label><timestamp>-1</timestamp>"
    return f"<object1>{fields}{transform}{format_matrix('vertices', corners, 3)}</object1>"


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("<object1>" + "<a/>" * 100_000 + "</object1>", "an object has more than 1,000 elements"),
        ("<object1>" * 5_000, "an object has more than 1,000 elements"),
        ("<object1><data>" + "0 " * 3_000_000 + "</data></object1>", "a tag or a text has more than 4,194,304 bytes"),
        (f'<object1 a="{"x" * 5_000_000}"/>', "a tag or a text has more than 4,194,304 bytes"),
        ("".join(f"<o><label>l{k}</label></o>" for k in range(1_100)), "more than 1,000 labels are unknown"),
        ("<object1><label>car</label></object1>" * 10_100, "more than 10,000 objects are defective"),
    ],
    ids=["elements", "depth", "text", "attribute", "labels", "defects"],
)
def test_xml_within_limits(body, message, tmp_path):
    write_kitti360(tmp_path, f"<opencv_storage>{body}</opencv_storage>")
    before = measure_peak_gb()
    with pytest.raises(ValueError, match=message) as error:
        kitti360.read_drive(tmp_path, "0003")
    assert NAME in str(error.value) and measure_peak_gb() - before < 0.3


def test_large_xml_is_refused_by_size(tmp_path, monkeypatch):
    write_kitti360(tmp_path, "<opencv_storage>" + " " * 2_000 + "</opencv_storage>")
    monkeypatch.setenv("PRITTI_MAX_JSON_BYTES", "1000")
    with pytest.raises(ValueError, match="bytes of a JSON or XML file"):
        kitti360.read_drive(tmp_path, "0003")


def test_objects_in_one_place_do_not_take_quadratic_time(tmp_path):
    boxes = "".join(format_box(0.9 * k / 500) for k in range(500))
    boxes = boxes.replace("<label>car</label>", "<label>{}</label>")
    # Boxes of growing size are no copies of each other.
    for k in range(500):
        boxes = boxes.replace("<label>{}</label>", "<label>car </label>", 1).replace(
            "<data>1 0 0", f"<data>{1 + k / 100} 0 0", 1
        )
    write_kitti360(tmp_path, f"<opencv_storage>{boxes}</opencv_storage>")
    start = time.process_time()
    _, report = kitti360.read_drive(tmp_path, "0003")
    assert time.process_time() - start < 3
    assert any("other objects of this label" in defect.reason for defect in report.defects)


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        ("0 " + "1 " * 100_000 + "\n", "line 1: 200,002 letters"),
        ("\n" * 2_100_000, "2,100,000 rows, objects"),
        (POSES.replace("1", "nan"), "is not a pose"),
        (POSES.replace("-1", "1e308"), "is not a pose"),
        (POSES + "1" * 400 + POSES[1:], "is not a whole number"),
    ],
    ids=["words", "lines", "nan", "large", "frame"],
)
def test_poses_within_limits(poses, message, tmp_path):
    write_kitti360(tmp_path, "<opencv_storage/>", poses)
    with pytest.raises(ValueError, match=message):
        kitti360.read_poses(tmp_path, "0003")


# --------------------------------------------------------------------------------------------------- Argoverse 2


def write_feather_bytes(table: pa.Table, **options: Any) -> bytes:
    stream = io.BytesIO()
    pyarrow.feather.write_feather(table, stream, **options)
    return stream.getvalue()


def test_feather_sizes_equal_those_of_arrow():
    table = pa.table({"a": np.zeros(5_000), "b": ["x", "y"] * 2_500})
    table = table.append_column("c", table["b"].dictionary_encode())
    for options in ({"compression": "uncompressed"}, {"compression": "zstd"}, {"compression": "lz4", "chunksize": 999}):
        rows, size = measure_feather(write_feather_bytes(table, **options))
        assert rows == 5_000 and table.nbytes * 0.9 < size < table.nbytes * 1.3 + 2_000


@pytest.fixture
def log(tmp_path) -> Path:
    folder = tmp_path / "train" / "log"
    (folder / "map").mkdir(parents=True)
    return folder


def make_annotations(rows: int) -> dict:
    names = ("length_m", "width_m", "height_m", "qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    columns: dict = {name: np.ones(rows) for name in names}
    return columns | {"timestamp_ns": np.zeros(rows, np.int64)}


def test_small_feather_file_with_large_columns_is_refused(log):
    columns = make_annotations(7_000_000) | {"extra": np.zeros(7_000_000)}
    columns = {name: columns[name] for name in ("timestamp_ns", "extra")}
    path = log / "annotations.feather"
    pyarrow.feather.write_feather(pa.table(columns), path, compression="zstd")
    assert path.stat().st_size < 100_000
    del columns
    before = measure_peak_gb()
    with pytest.raises(LimitError, match=r"annotations.feather: 7,000,000 rows, objects"):
        argoverse2.read_drive(log.parents[1], "train", "log")
    assert measure_peak_gb() - before < 0.1


def test_long_texts_of_feather_file_are_not_decoded(log):
    rows = 20_000
    text = pa.DictionaryArray.from_arrays(pa.array(np.zeros(rows, np.int32)), ["x" * 100_000])
    table = pa.table(make_annotations(rows) | {"track_uuid": text, "category": text})
    pyarrow.feather.write_feather(table, log / "annotations.feather")
    before = measure_peak_gb()
    with pytest.raises(LimitError, match="a text in column track_uuid: 100,000 characters"):
        argoverse2.read_drive(log.parents[1], "train", "log")
    assert measure_peak_gb() - before < 0.2


def test_null_in_dictionary_is_refused(log):
    rows = 3
    text = pa.DictionaryArray.from_arrays(pa.array([0, 1, 0], pa.int32()), pa.array(["BUS", None]))
    table = pa.table(make_annotations(rows) | {"track_uuid": text, "category": text})
    pyarrow.feather.write_feather(table, log / "annotations.feather")
    with pytest.raises(ValueError, match="column track_uuid has"):
        argoverse2.read_drive(log.parents[1], "train", "log")


@pytest.mark.parametrize("content", [b"", b"FEA1" * 10, b"ARROW1\0\0" + b"\xff" * 40 + b"ARROW1", b"ARROW1" * 9])
def test_no_feather_file_is_refused(content, log):
    (log / "annotations.feather").write_bytes(content)
    with pytest.raises(ValueError, match=r"annotations.feather: broken feather file"):
        argoverse2.read_drive(log.parents[1], "train", "log")


def test_map_and_raster_within_limits(log):
    path = log / "map" / "log_map_archive_log.json"
    for content, message in (
        ("[" * 100_000, "nested too deeply"),
        ('{"a": 1, "a": 2}', "'a' occurs twice"),
        (
            json.dumps({"drivable_areas": {"1": {"area_boundary": [0] * 10_001}}, "pedestrian_crossings": {}}),
            "10,001 points of a polygon",
        ),
    ):
        path.write_text(content)
        with pytest.raises(ValueError, match=message):
            argoverse2._read_ground(log / "map")
    heights = log / "map" / "heights.npy"
    np.lib.format.open_memmap(heights, "w+", np.float16, (10_000, 10_000)).flush()  # A sparse file.
    with pytest.raises(LimitError, match=r"heights.npy: 100,000,000 pixels"):
        argoverse2._read_heights(heights)
