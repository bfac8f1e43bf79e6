"""Tests of preprocessing with killed workers, killed drivers, full disks and 260 damaged files."""

import hashlib
import io
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.feather
import pyarrow.parquet as pq
import pytest
from helpers import ROOT

from jobs.implementation.preprocess_scenes import main as preprocess
from jobs.preprocess_scenes import Kitti360, Town
from models.scene import CATEGORIES, Grid
from pipelines.preprocess import ingest, sharding
from pipelines.preprocess.shard_writer import write_shard
from pipelines.preprocess.sharding import ShardTask, plan_argoverse2, plan_custom, plan_kitti360
from pipelines.preprocess.sources import argoverse2, custom
from pipelines.preprocess.sources.kitti360 import GROUND_LABELS, read_poses
from pipelines.preprocess.sources.town import kitti360_writer
from pipelines.preprocess.sources.town.generator import generate_town, write_kitti360
from pipelines.runtime import storage

import psutil  # isort: skip # Ray bundles this module; import ray first

CROP = Grid(front_m=16.0, left_m=8.0, resolution_m=0.5, rows=32, cols=32)
TABLES = ("scenes", "primitives", "rasters", "rejects")
TOWN = Town(num_train=48, num_test=8)  # twelve shards
TOWN_WORDS = ("jobs/preprocess_scenes.py", "town", "--num-train", "48", "--num-test", "8", "--output")


def read_directory(root: Path) -> dict[str, Any]:
    """Return the content of all files in a directory, by path: tables of Parquet files and values of JSON files.

    Records of leases are left out, because they count the jobs that wrote to the directory.
    """
    files = {str(path.relative_to(root)): path for path in sorted(root.rglob("*")) if path.is_file()}
    files = {name: path for name, path in files.items() if not name.startswith(".leases/")}
    return {
        name: pq.read_table(path, partitioning=None) if name.endswith(".parquet") else json.loads(path.read_text())
        for name, path in files.items()
    }


def assert_same(root: Path, undisturbed: Path) -> None:
    ours, theirs = read_directory(root), read_directory(undisturbed)
    assert ours.keys() == theirs.keys()
    assert [name for name in ours if ours[name] != theirs[name]] == []


def find_partial_shards(root: Path, seen: set[tuple[str, int]]) -> list[str]:
    """Return the faults that a query over the tables finds now; skip files that are in `seen`."""
    wrong = []
    for path in [path for table in TABLES for path in (root / table).rglob("*.parquet")]:
        with suppress(FileNotFoundError):
            if (state := (str(path), path.stat().st_mtime_ns)) not in seen:
                seen.add(state)
                try:
                    pq.read_table(path, partitioning=None)
                except (OSError, pa.ArrowException) as error:
                    wrong.append(f"{path}: {error}")
                if path.parts[len(root.parts)] == "scenes":
                    others = [Path(str(path).replace("/scenes/", f"/{name}/")) for name in ("primitives", "rasters")]
                    wrong += [f"{path} without {other}" for other in others if not other.exists()]
    return wrong


@contextmanager
def assert_no_partial_shards(root: Path) -> Iterator[None]:
    """Assert that no partial shard is visible while the body runs."""
    wrong, seen, stop = [], set(), threading.Event()

    def watch() -> None:
        while not stop.wait(0.02):
            wrong.extend(find_partial_shards(root, seen))

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
    assert wrong + find_partial_shards(root, set()) == []


@pytest.fixture(scope="module")
def town(cluster, tmp_path_factory) -> Path:
    """Output of a run without faults."""
    root = tmp_path_factory.mktemp("undisturbed") / "town"
    preprocess(replace(TOWN, output=str(root)))
    assert len(list((root / "scenes").rglob("*.parquet"))) == 12
    return root


# ------------------------------------------------------------------------------------------------- killed workers


@pytest.fixture(scope="module")
def shards(cluster, tmp_path_factory) -> tuple[list[ShardTask], Path]:
    """Tasks for eleven shards of one drive, and the output of a run without faults.

    A separate Ray task reads the drive once for all shards.
    """
    root = tmp_path_factory.mktemp("shards")
    write_kitti360(generate_town(7).at(np.arange(40, 84), CROP), root / "raw")
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(sharding, "SHARD_SCENES", 4)
        tasks = plan_kitti360(str(root / "raw"), split=False)
    made = ingest.ingest_drives(tasks, str(root / "undisturbed"), {}, grid=CROP)
    assert len(tasks) == 11 and made.scenes == {"train": 44} and made.duplicates > 5
    return tasks, root / "undisturbed"


@contextmanager
def kill_workers(quota: dict[str, int], seed: int) -> Iterator[list[str]]:
    """Kill Ray workers while the body runs and yield the names of the killed tasks.

    The dictionary `quota` contains the number of kills for each task name.
    """
    rng, killed, stop = np.random.default_rng(seed), [], threading.Event()

    def kill() -> None:
        # The wait is shorter than each delayed task, so a kill hits every kind of task.
        while not stop.wait(rng.uniform(0.05, 0.4)) and len(killed) < sum(quota.values()):
            for process in rng.permutation(psutil.Process().children(recursive=True)):
                with suppress(psutil.Error, IndexError):
                    title = process.cmdline()[0].removeprefix("ray::")
                    if killed.count(title) < quota.get(title, 0):
                        process.kill()
                        killed.append(title)
                        break

    thread = threading.Thread(target=kill)
    thread.start()
    try:
        yield killed
    finally:
        stop.set()
        thread.join()


def add_delay(function: Callable, seconds: float) -> Callable:
    def run_with_delay(*arguments: Any) -> Any:
        time.sleep(seconds)
        result = function(*arguments)
        time.sleep(seconds)
        return result

    run_with_delay.__qualname__ = function.__name__  # Ray uses this attribute as the name of the task
    return run_with_delay


@pytest.mark.slow  # test_ingest_is_unchanged_by_worker_kill_during_write kills one worker.
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_ingest_is_unchanged_by_random_worker_kills(shards, tmp_path, monkeypatch, seed):
    (tasks, undisturbed), quota = (
        shards,
        {"_read_drive_or_reason": 1, "Map(write)": 3, "compute_training_statistics": 1, "Map(publish)": 2},
    )
    for name, seconds in (
        ("_read_drive_or_reason", 0.6),
        ("write_shard", 0.2),
        ("compute_training_statistics", 0.6),
        ("label_scenes", 0.2),
    ):
        monkeypatch.setattr(ingest, name, add_delay(getattr(ingest, name), seconds))
    with kill_workers(quota, seed=seed) as killed:
        ingest.ingest_drives(tasks, str(tmp_path), {}, grid=CROP)
    assert Counter(killed) == quota
    assert_same(tmp_path, undisturbed)


def test_ingest_is_unchanged_by_worker_kill_during_write(shards, tmp_path, monkeypatch):
    """The test kills the first writer of each kind of file: staged table, manifest and published table."""
    (tasks, undisturbed), root, died = shards, tmp_path / "out", tmp_path / "died"
    died.mkdir()
    doomed = (
        "out/rasters/source=kitti360/split=train/part-00001.parquet",
        ".staging/manifest/kitti360-train-00003.json",
        "out/scenes/source=kitti360/split=train/part-00002.parquet",
    )

    def arm_writers(function: Callable) -> Callable:
        def call(*arguments: Any) -> Any:
            whole = storage.write_whole

            def write_whole(uri: str, write: Callable) -> None:
                marker = died / str(len(uri))

                def die(stream: Any) -> None:
                    stream.write(b"PAR1 and no more")
                    stream.flush()
                    marker.touch()
                    os.kill(os.getpid(), signal.SIGKILL)

                whole(uri, die if uri.endswith(doomed) and not marker.exists() else write)

            if not hasattr(storage, "armed"):
                storage.write_whole, storage.armed = write_whole, True
            return function(*arguments)

        return call

    monkeypatch.setattr(ingest, "write_shard", arm_writers(ingest.write_shard))
    monkeypatch.setattr(ingest, "label_scenes", arm_writers(ingest.label_scenes))
    with assert_no_partial_shards(root):
        ingest.ingest_drives(tasks, str(root), {}, grid=CROP)
    assert len(list(died.iterdir())) == len(doomed)
    assert_same(root, undisturbed)


# ------------------------------------------------------------------------------------------------- killed drivers


def run_and_kill_job(root: Path, log: Path, when: Callable[[], bool]) -> None:
    """Run the job in a separate process and kill the process as soon as `when` is true.

    The Ray processes of the job have ended when this function returns.
    """
    with log.open("w") as output:
        job = subprocess.Popen(
            [sys.executable, *TOWN_WORDS, str(root)],
            cwd=ROOT,
            stdout=output,
            stderr=output,
            start_new_session=True,
        )
    try:
        while not when():
            assert job.poll() is None, log.read_text()
            time.sleep(0.01)
    finally:
        with suppress(psutil.NoSuchProcess):  # the process ended before the kill
            family = psutil.Process(job.pid).children(recursive=True)
            job.kill()
            job.wait()
            _, alive = psutil.wait_procs(family, timeout=2)
            for process in alive:
                with suppress(psutil.NoSuchProcess):
                    process.kill()
            psutil.wait_procs(alive, timeout=5)


@pytest.mark.slow  # test_preprocess_job.py resumes an interrupted run without killing a driver.
def test_preprocess_resumes_after_driver_kills(town, tmp_path):
    root, log = tmp_path / "out", tmp_path / "log"
    staging = root / ".staging"
    with assert_no_partial_shards(root):
        run_and_kill_job(root, log, lambda: any(staging.glob("manifest/*.json")))
        done = sorted(path.stem for path in staging.glob("manifest/*.json"))
        assert 1 <= len(done) < 12 and not any((root / name).exists() for name in ("scenes", "dataset.json"))
        _, split, number = done[0].split("-")
        kept = f"rasters/source=town/split={split}/part-{number}.parquet"
        stamp = (root / kept).stat().st_mtime_ns

        run_and_kill_job(root, log, lambda: any(root.glob("scenes/*/*/*.parquet")))
        assert len(list(staging.glob("manifest/*.json"))) == 12 and not (root / "dataset.json").exists()
        preprocess(replace(TOWN, output=str(root)))
    assert (root / kept).stat().st_mtime_ns == stamp
    assert_same(root, town)


def test_preprocess_removes_staging_of_killed_driver(town, tmp_path):
    shutil.copytree(town, tmp_path / "out")
    storage.write_json({}, str(tmp_path / "out/.staging/manifest/town-train-00000.json"))
    preprocess(replace(TOWN, output=str(tmp_path / "out")))
    assert_same(tmp_path / "out", town)


def test_write_whole_hides_unfinished_file_from_queries(tmp_path):
    table = pa.table({"value": [1]})
    storage.write_parquet(table, str(tmp_path / "part-00000.parquet"))

    def query(stream: Any) -> None:
        stream.write(b"PAR1")
        stream.flush()
        assert len(list(tmp_path.iterdir())) == 2
        assert duckdb.sql(f"select count(*) from '{tmp_path}/**/*.parquet'").fetchall() == [(1,)]

    storage.write_whole(str(tmp_path / "part-00001.parquet"), query)


# ------------------------------------------------------------------------------------------------------ full disks


@pytest.mark.slow  # test_write_shard_names_failed_file_and_cleans_up limits the size of a file instead.
def test_preprocess_reports_full_disk_and_resumes(town, tmp_path):
    """The full disk is a small tmpfs in a separate mount namespace."""
    full, left = tmp_path / "full", tmp_path / "left"
    full.mkdir()
    mount = 'mount -t tmpfs -o size=250k none "$0"'
    probe = subprocess.run(["unshare", "-rm", "sh", "-c", mount, str(full)], capture_output=True)
    if probe.returncode:
        pytest.skip("no tmpfs can be mounted here")
    script = f'{mount} && {{ "$@"; code=$?; cp -a "$0" "{left}"; exit $code; }}'
    words = ["unshare", "-rm", "sh", "-c", script, str(full), sys.executable, *TOWN_WORDS, str(full)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=300)
    lines = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert done.returncode == 2 and len(lines) == 1, done.stderr[-3000:]
    assert re.fullmatch(
        rf"error: {full}/\S+: cannot be written \(No space left on device\); free disk space.*", lines[0]
    )
    assert not (left / "dataset.json").exists() and find_partial_shards(left, set()) == []
    preprocess(replace(TOWN, output=str(left)))
    assert_same(left, town)
    if "Traceback" in done.stderr:
        pytest.xfail("a worker's traceback is still logged above that line")


def test_write_shard_names_failed_file_and_cleans_up(raw, tmp_path):
    (task,) = plan_kitti360(str(raw["kitti360"]), split=False)
    staging = tmp_path / "staging"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, before[1]))
    try:
        with pytest.raises(
            OSError, match=r"staging/.*\.parquet: cannot be written \(File too large\); free disk space"
        ):
            write_shard(task, str(staging), str(staging), CROP)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert find_partial_shards(staging, set()) == [] and not list(staging.rglob(f"{storage.TEMPORARY}*"))
    assert write_shard(task, str(staging), str(staging), CROP)["scenes"] == 4


# ------------------------------------------------------------------------------------------------- unreadable drives


def test_preprocess_rejects_drive_without_poses(cluster, raw, tmp_path):
    """The XML file of drive 0003 exists, but its poses.txt is missing."""
    root = tmp_path / "raw"
    shutil.copytree(raw["kitti360"], root)
    (xml,) = root.glob("data_3d_bboxes/train_full/*.xml")
    shutil.copy(xml, xml.with_name(xml.name.replace("0007", "0003")))
    asked = Kitti360(input=str(root), output=str(tmp_path / "out"), make_split=False)
    with pytest.raises(ValueError, match=r"drive_0003_sync/poses\.txt.*Or add --skip-unreadable"):
        preprocess(asked)
    preprocess(replace(asked, skip_unreadable=True))
    made = read_directory(tmp_path / "out")
    (reject,) = made["rejects/source=kitti360/split=unused/part-00000.parquet"].to_pylist()
    assert reject["scene_id"] == "kitti360-0003" and reject["frame"] is None and "poses.txt" in reject["reason"]
    preprocess(replace(asked, input=str(raw["kitti360"]), output=str(tmp_path / "alone")))
    alone = read_directory(tmp_path / "alone")
    assert [name for name in alone if name != "dataset.json" and alone[name] != made[name]] == []


def test_read_poses_never_returns_truncated_pose(raw, tmp_path):
    root = tmp_path / "raw"
    shutil.copytree(raw["kitti360"], root)
    (path,) = root.glob("data_poses/*/poses.txt")
    whole, (frame, world_from_imu) = path.read_bytes(), read_poses(root, "0007")
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        try:
            got = read_poses(root, "0007")
        except ValueError:
            continue
        assert whole[:length].endswith(b"\n") and np.array_equal(got[0], frame[: len(got[0])])
        assert np.array_equal(got[1], world_from_imu[: len(got[1])])


def test_write_shard_detects_poses_changed_during_run(raw, tmp_path):
    root, staging = tmp_path / "raw", str(tmp_path / "staging")
    shutil.copytree(raw["kitti360"], root)
    (path,) = root.glob("data_poses/*/poses.txt")
    lines = path.read_text().splitlines(keepends=True)
    (task,) = plan_kitti360(str(root), split=False)
    path.write_text("".join(lines[:2]))
    manifest = write_shard(task, staging, staging, CROP)
    assert manifest["scenes"] == 0 and "the poses of 0007 changed after this run began" in manifest["unreadable"][0]
    path.write_text("".join([*lines[:3], lines[3].replace(str(task.parts[0].frames[3]), "99999", 1)]))
    assert write_shard(task, staging, staging, CROP)["unreadable"]


def test_write_shard_rewrites_staged_shard_of_another_plan(raw, tmp_path):
    """The poses change between an interrupted run and the next run."""
    root, staging = tmp_path / "raw", str(tmp_path / "staging")
    shutil.copytree(raw["kitti360"], root)
    (path,) = root.glob("data_poses/*/poses.txt")
    lines = path.read_text().splitlines(keepends=True)
    for kept in (lines[:2], lines[2:]):
        path.write_text("".join(kept))
        (task,) = plan_kitti360(str(root), split=False)
        write_shard(task, staging, staging, CROP)
        frames = pq.read_table(task.shard(staging).path("scenes"), partitioning=None)["frame"].to_pylist()
        assert frames == [int(line.split()[0]) for line in kept]


# --------------------------------------------------------------------- broken files in write_shard without Ray

CASE_SECONDS = 5.0  # processor time
Tables = dict[str, list[dict]]
Touches = Callable[[str, dict], bool]  # (table, row) -> True if a damaged file may change this row
PLANS = {
    "kitti360": lambda root: plan_kitti360(root, split=False),
    "av2": plan_argoverse2,
    "own": lambda root: plan_custom(root, split=False),
}


def write_all_shards(source: str, root: Path, staging: Path) -> tuple[Tables, list[dict]]:
    """Write all shards of a source, check them, and return the rows of every table and the manifests."""
    tasks = PLANS[source](str(root))
    manifests = [write_shard(task, str(staging), str(staging), CROP) for task in tasks]
    tables: Tables = {"scenes": [], "primitives": [], "rasters": [], "rejects": []}
    for task in tasks:
        paths = {name: Path(task.shard(str(staging)).path(name)) for name in tables}
        rows = {name: pq.read_table(p, partitioning=None).to_pylist() for name, p in paths.items() if p.exists()}
        check_sound(rows)
        for name in rows:
            tables[name] += rows[name]
    return tables, manifests


def check_sound(rows: Tables) -> None:
    """Assert that a shard has finite values, aligned tables and consistent counts."""
    scenes, primitives, rasters = (rows.get(name, []) for name in ("scenes", "primitives", "rasters"))
    names = [row["scene_id"] for row in scenes]
    assert len(set(names)) == len(names) and [row["scene_id"] for row in rasters] == names
    for row in scenes + primitives:
        values = [v for value in row.values() for v in (value if isinstance(value, list) else [value])]
        assert np.isfinite([v for v in values if isinstance(v, (int, float))]).all(), row
    offset = 0
    for row in scenes:
        here = primitives[offset : offset + row["num_primitives"]]
        assert row["primitive_offset"] == offset and {p["scene_id"] for p in here} <= {row["scene_id"]}
        counts = Counter(p["category"] for p in here)
        assert all(row[f"num_{name}"] == counts[name] for name in CATEGORIES)
        offset += len(here)
    assert offset == len(primitives)
    for row in primitives:
        assert 0 < row["width_m"] <= row["length_m"] <= 1000 and 0 < row["height_m"] <= 1000
        assert CROP.contains(row["x_m"], row["y_m"])
    for row in rasters:
        assert len(row["height"]) == 2 * np.unpackbits(np.frombuffer(row["occupied"], np.uint8)).sum()


def find_changed_rows(before: list[dict], after: list[dict]) -> list[dict]:
    """Return the rows that only one of two tables contains."""
    rows, counts = {}, Counter()
    for sign, side in ((1, before), (-1, after)):
        for row in side:
            key = repr(sorted((name, value) for name, value in row.items() if name != "primitive_offset"))
            rows[key] = row
            counts[key] += sign
    return [rows[key] for key, count in counts.items() if count]


def classify_outcome(source: str, root: Path, path: Path, staging: Path, whole: Tables, touches: Touches) -> str:
    """Assert that the effect of a broken file on the tables is allowed, and return the effect.

    Returns: "refused" if a reason names the file, "same" if all rows are equal, or "changed" if only affected rows
    differ.
    """
    try:
        tables, manifests = write_all_shards(source, root, staging)
    except ValueError as error:
        check_reason(str(error), path)
        return "refused"
    unreadable = [reason for manifest in manifests for reason in manifest["unreadable"]]
    for reason in unreadable:
        check_reason(reason, path)
    left_out = {row["sequence"] for row in tables["rejects"] if row["reason"] in unreadable}
    assert bool(left_out) == bool(unreadable) and not {row["sequence"] for row in tables["scenes"]} & left_out

    def may_differ(table: str, row: dict) -> bool:
        return any(f"-{name}-" in row["scene_id"] for name in left_out) or touches(table, row)

    scenes = set()
    for table in ("primitives", "rasters"):
        for row in find_changed_rows(whole[table], tables[table]):
            assert may_differ(table, row), (table, row)
            scenes.add(row["scene_id"])
    for row in find_changed_rows(whole["scenes"], tables["scenes"]):
        assert row["scene_id"] in scenes or may_differ("scenes", row), row
    for report in [r for manifest in manifests for r in manifest["reports"].values() if r and path.suffix == ".xml"]:
        kept = report["boxes"] + report["slabs"] + report["duplicates"]
        dropped = len(report["defects"]) + sum((report["dropped"] | report["unknown"]).values())
        assert kept + dropped == len(ElementTree.parse(path).getroot())
    return "refused" if unreadable else "changed" if scenes else "same"


def check_reason(reason: str, path: Path) -> None:
    """Assert that the reason is one line and names a file in the folder of `path`."""
    assert any(file.name in reason for file in path.parent.iterdir()), reason
    assert "\n" not in reason and len(reason) < 700, reason
    reason.encode()  # the tables store the reason as UTF-8


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    def stop(*_: object) -> None:
        pytest.fail(f"took more than {seconds:g} s")

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def choose(rng: np.random.Generator, choices: Sequence) -> Any:
    return choices[int(rng.integers(len(choices)))]


GARBAGE = (b"", b" \n", bytes(64), bytes(range(256)) * 8, b"\x89PNG\r\n\x1a\n" + bytes(99), b"PK\x03\x04" + bytes(60))


def damage_bytes(rng: np.random.Generator, whole: bytes) -> bytes:
    """Return damaged content of a file: truncated, overwritten, shifted or replaced."""
    at, length = int(rng.integers(len(whole))), int(rng.integers(1, 200))
    flipped = bytearray(whole)
    for place in rng.integers(len(whole), size=rng.integers(1, 9)):
        flipped[place] = rng.integers(256)
    hole = whole[:at] + bytes(length) + whole[at + length :]
    noise = whole[: length // 5] + rng.bytes(300)
    return choose(
        rng, [whole[:at], bytes(flipped), hole, whole[:at] + whole[at + length :], noise, choose(rng, GARBAGE)]
    )


# ----------------------------------------------------------------------------------------------- KITTI-360 files

BAD_NUMBERS = ("nan", "inf", "-inf", "1e308", "-1e30", "9e5", "four", "", "0x10", "1,5", "9" * 400, "0", "-1", "1e-300")
BAD_TEXTS = ("", " ", "-1", "-2", "9" * 18, "9" * 5000, "1.5", "car", "road", "tunnel", "spaceship", "\u0663", "&amp;")
FIELDS = ("index", "label", "category", "dynamicSeq", "timestamp", "transform", "vertices", "faces", "transform_plane")
ENCODINGS = ("klingon", "utf-16", "shift_jis", "utf-7", "idna", "undefined", "hex", "latin-1", "cp037")
BOMB = '<!ENTITY a "ha">' + "".join(f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in pairwise("abcdefghi"))
EXTERNAL = '<!ENTITY i SYSTEM "file:///etc/hostname">'
GROUND_NAMES = {label for labels in GROUND_LABELS.values() for label in labels}


def write_kitti360_excerpt(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write four poses of a town and the objects near them, in two annotation windows that share objects."""
    monkeypatch.setattr(kitti360_writer, "WINDOW_POSES", 2)
    write_kitti360(generate_town(7).at(np.arange(60, 64), Grid(4.0, 4.0, 0.5, 16, 16)), root)


def find_objects(xml: bytes) -> list[str]:
    return re.findall(r"<object\d+>.*?</object\d+>", xml.decode("utf-8", "replace"), re.S)


def read_field(block: str, tag: str) -> str:
    """Return the content of a field, or an empty text if the field is missing."""
    found = re.search(rf"<{tag}(?: [^>]*)?>(.*?)</{tag}>", block, re.S)
    return found[1] if found else ""


def replace_field(block: str, tag: str, content: str | None) -> str:
    def put(found: re.Match) -> str:
        return "" if content is None else f"{found[1]}{content}</{tag}>"

    return re.sub(rf"(<{tag}(?: [^>]*)?>).*?</{tag}>", put, block, count=1, flags=re.S)


def break_object(rng: np.random.Generator, block: str) -> str:
    tag, other = choose(rng, FIELDS), choose(rng, FIELDS)
    match choose(rng, ["number", "number", "digit", "missing", "text", "swap", "size", "deep", "twice"]):
        case "number":
            tag = choose(rng, ["transform", "vertices", "faces"])
            head, data = read_field(block, tag).split("<data>")
            words = data.removesuffix("</data>").split()
            words[int(rng.integers(len(words)))] = choose(rng, BAD_NUMBERS)
            return replace_field(block, tag, f"{head}<data>{' '.join(words)}</data>")
        case "digit":
            at = choose(rng, [m.start() for m in re.finditer(r"(?<=[ .\d])\d", block)])
            return block[:at] + str(rng.integers(10)) + block[at + 1 :]
        case "missing":
            return replace_field(block, tag, None)
        case "text":
            return replace_field(
                block, choose(rng, ["index", "label", "dynamicSeq", "timestamp"]), choose(rng, BAD_TEXTS)
            )
        case "swap":
            return replace_field(replace_field(block, tag, read_field(block, other)), other, read_field(block, tag))
        case "size":
            bad = choose(rng, ["-4", "5", "9" * 18, "9" * 5000, "four", ""])
            return re.sub(rf"<{choose(rng, ['rows', 'cols'])}>\d+", lambda m: m[0][:6] + bad, block, count=2)
        case "deep":
            depth = choose(rng, [50, 900, 20_000])
            return replace_field(block, tag, "<a>" * depth + "</a>" * depth)
        case _:
            return block.replace(f"</{tag}>", f"</{tag}><{tag}>{choose(rng, BAD_TEXTS)}</{tag}>", 1)


def break_xml(rng: np.random.Generator, whole: bytes) -> bytes:
    text, blocks = whole.decode(), find_objects(whole)
    if rng.random() < 0.6:
        for k in rng.choice(len(blocks), int(rng.integers(1, 4)), replace=False):
            text = text.replace(blocks[k], break_object(rng, blocks[k]))
        return text.encode()
    root, block = "<opencv_storage>", choose(rng, blocks)
    return choose(
        rng,
        [
            *[damage_bytes(rng, whole) for _ in range(4)],
            *[
                text.replace(root, f"<!DOCTYPE b [{entities}]>{root}").replace(">car<", ">&i;<").encode()
                for entities in (BOMB, EXTERNAL)
            ],
            text.replace('"1.0"', f'"1.0" encoding="{choose(rng, ENCODINGS)}"').encode(),
            text.replace("opencv_storage", choose(rng, ["kml", "a" * 9999])).encode(),
            text.replace(f"</{root[1:]}", "<a>" * 20_000 + "</a>" * 20_000 + f"</{root[1:]}").encode(),
            text.replace(block, "").encode(),
            text.replace(block, block * 2).encode(),
            text.replace("><", ">\n\n <").replace("\n", "\r\n").encode(),
        ],
    )


def find_rows_of_xml(whole: bytes, broken: bytes) -> Touches:
    """Return the rows that a broken XML file may change.

    The result contains the primitives of changed objects and of the copies of these objects in other windows. The
    result also contains the rasters if a changed object is ground before or after the change.
    """
    before, after = ([" ".join(b.replace("><", "> <").split()) for b in find_objects(xml)] for xml in (whole, broken))
    places = {read_field(block, "transform") for block in set(before) - set(after)}
    involved = (set(after) - set(before)) | {block for block in before if read_field(block, "transform") in places}
    ids = {int(n) for b in involved for n in re.findall(r"<(?:index|dynamicSeq)>\s*(-?\d{1,18})\s*<", b)}
    ground = any(read_field(block, "label").lower() in GROUND_NAMES for block in involved)
    return lambda table, row: row["instance_id"] in ids if table == "primitives" else ground and table == "rasters"


def break_poses(rng: np.random.Generator, whole: bytes) -> bytes:
    lines = whole.decode().splitlines()
    k, i, j = int(rng.integers(len(lines))), int(rng.integers(13)), int(rng.integers(13))
    words = lines[k].split()
    bad = [*words[:i], choose(rng, BAD_NUMBERS), *words[i + 1 :]]
    swapped = [words[j if n == i else i if n == j else n] for n in range(13)]
    digits = choose(rng, [m.start() for m in re.finditer(r"\d", lines[k])])
    digit = lines[k][:digits] + str(rng.integers(10)) + lines[k][digits + 1 :]
    frame = choose(rng, ["-1", "9" * 30, "1e3", "0.5", "x", "9" * 18])
    new = choose(
        rng,
        [
            *[[" ".join(w)] for w in (bad, bad, swapped, words[:i], words * 2, [frame, *words[1:]])],
            *([digit], [digit], [], [lines[k], lines[k]], [lines[k - 1]], ["\t".join(words) + "\r\n"]),
        ],
    )
    return choose(rng, [damage_bytes(rng, whole), *["\n".join([*lines[:k], *new, *lines[k + 1 :], ""]).encode()] * 3])


def find_rows_of_poses(whole: bytes, broken: bytes) -> Touches:
    before, after = ({" ".join(n.split()) for n in x.decode("ascii", "replace").splitlines()} for x in (whole, broken))
    frames = {line.split()[0] for line in before ^ after if line}
    return lambda table, row: str(int(row["scene_id"].rsplit("-", 1)[1])) in {f.lstrip("0") or "0" for f in frames}


# ----------------------------------------------------------------------------------------------- Argoverse 2 files

AV2_LOGS = ("broken", "intact")  # two logs of one shard: faults of the first log must not affect the second log
SWEEPS = 315969904359876000 + 100_000_000 * np.arange(3)


def write_av2(root: Path) -> None:
    """Write two logs, each with three sweeps and six boxes per sweep. The map is a square of road with a crossing."""
    rng = np.random.default_rng(0)
    for log in AV2_LOGS:
        folder = root / "train" / log
        (folder / "map").mkdir(parents=True)
        n = 6 * len(SWEEPS)
        yaw, spans = rng.uniform(-3, 3, n), ((1, 15), (-7, 7), (0, 1))
        categories = ("REGULAR_VEHICLE", "BUS", "DOG", "SIGN", "PEDESTRIAN", "EGO_VEHICLE")
        boxes = {
            "timestamp_ns": np.repeat(SWEEPS, 6),
            "track_uuid": [f"{log}-{k % 6}" for k in range(n)],
            "category": [categories[k % 6] for k in range(n)],
            **{name: rng.uniform(1, 4, n) for name in argoverse2.SIZE},
            **dict(zip(argoverse2.QUATERNION, [np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], strict=True)),
            **{name: rng.uniform(*span, n) for name, span in zip(argoverse2.TRANSLATION, spans, strict=True)},
        }  # fmt: skip
        time = np.concatenate([SWEEPS, SWEEPS + 50_000_000])
        poses = {"timestamp_ns": time} | {name: np.zeros(len(time)) for name in argoverse2.QUATERNION}
        poses |= {"qw": np.ones(len(time))}
        poses |= dict(
            zip(argoverse2.TRANSLATION, [1e3 + np.arange(6.0), np.full(6, -2e3), np.full(6, 12.0)], strict=True)
        )
        pyarrow.feather.write_feather(pa.table(boxes), folder / "annotations.feather")
        pyarrow.feather.write_feather(pa.table(poses), folder / "city_SE3_egovehicle.feather")

        def points(*xy: tuple[float, float]) -> list[dict]:
            return [{"x": 1e3 + x, "y": -2e3 + y, "z": 11.7} for x, y in xy]

        area = {"id": 1, "area_boundary": points((-20, -20), (40, -20), (40, 20), (-20, 20))}
        crossing = {"id": 2, "edge1": points((10, 0), (10, 5)), "edge2": points((13, 5), (13, 0))}
        content = {"drivable_areas": {"1": area}, "pedestrian_crossings": {"2": crossing}}
        sim2 = {"R": [1.0, 0.0, 0.0, 1.0], "t": [-940.0, 2060.0], "s": 0.5}
        (folder / "map" / f"log_map_archive_{log}____PIT_city_1.json").write_text(json.dumps(content))
        (folder / "map" / f"{log}___img_Sim2_city.json").write_text(json.dumps(sim2))
        np.save(folder / "map" / f"{log}_ground_height_surface____PIT.npy", rng.uniform(11, 12, (60, 60)).astype("f2"))


BAD_VALUES: dict[str, tuple] = {
    "int": (0, -1, 2**63 - 1, int(SWEEPS[1]), None),
    "text": ("", "SPACESHIP", "x" * 5000, "EGO_VEHICLE", "DOG", "a\nb", None),
    "float": (float("nan"), float("inf"), -float("inf"), 1e300, -1e30, 1e7, 0.0, -1.0, 3.0, None),
}


def break_table(rng: np.random.Generator, table: pa.Table) -> pa.Table:
    """Return a copy of a table with a fault in its cells, types, columns or rows."""
    k, j = int(rng.integers(table.num_columns)), int(rng.integers(table.num_columns))
    name, column, names = table.column_names[k], table.column(k), table.column_names
    kind = "int" if pa.types.is_integer(column.type) else "float" if pa.types.is_floating(column.type) else "text"
    match choose(rng, ["cell"] * 6 + ["drop", "type", "type", "names", "names", "order", "rows", "rows", "twice"]):
        case "cell":
            values = column.to_pylist()
            if pa.types.is_nested(column.type):
                value = choose(rng, [None, [], [[1.0, 2.0]], [[float("nan")] * 3] * 3, [[0.0, 0.0, 0.0]] * 3])
            else:
                value = choose(rng, BAD_VALUES[kind])
            values[int(rng.integers(len(values)))] = value
            return table.set_column(k, name, pa.array(values, column.type))
        case "drop":
            return table.drop_columns([name])
        case "type":
            n = len(table)
            bad = [
                [None] * n,
                ["far"] * n,
                [[1.0]] * n,
                [True] * n,
                np.arange(n, dtype="u8"),
                [{"a": 1}] * n,
                [b"\xff"] * n,
            ]
            same = [column.dictionary_encode(), column.cast(pa.float32())] if kind == "float" else []
            return table.set_column(k, name, choose(rng, [*map(pa.array, bad), *same]))
        case "names":
            names[k], names[j] = names[j], names[k]
            return table.rename_columns(names)
        case "order":
            return table.select([names[n] for n in rng.permutation(len(names))])
        case "rows":
            some = rng.integers(len(table), size=len(table))
            return choose(
                rng, [table.slice(0, 0), table.slice(2), table.take(some), table.take(rng.permutation(len(table)))]
            )
        case _:
            return table.append_column(choose(rng, [name, "__index_level_0__", "\x00", "x" * 999]), column)


def break_feather(rng: np.random.Generator, whole: bytes) -> bytes:
    if rng.random() < 0.4:
        return damage_bytes(rng, whole)
    sink, table = io.BytesIO(), break_table(rng, pyarrow.feather.read_table(io.BytesIO(whole)))
    if rng.random() < 0.1:
        pq.write_table(table.drop_columns(["track_uuid"] if "track_uuid" in table.column_names else []), sink)
    else:
        pyarrow.feather.write_feather(table, sink, compression=choose(rng, ["lz4", "zstd", "uncompressed"]))
    return sink.getvalue()


def find_differing_rows(read: Callable[[bytes], list[dict]], whole: bytes, broken: bytes) -> list[dict]:
    """Return the rows that only one of two files contains; return no rows if one file is unreadable.

    The reader must refuse an unreadable file, so no row may differ.
    """
    try:
        return find_changed_rows(read(whole), read(broken))
    except Exception:
        return []


def is_of_broken_log(row: dict) -> bool:
    return "-broken-" in row["scene_id"]


def parse_frame(row: dict) -> int:
    return int(row["scene_id"].rsplit("-", 1)[1])


def make_instance_id(given: Any) -> Any:
    """Return an instance id in the form that tables store: the hash of a text, or the number itself."""
    if not isinstance(given, str):
        return -1 if given is None else given
    return int.from_bytes(hashlib.blake2b(given.encode(errors="replace"), digest_size=8).digest(), "big") >> 1


def read_feather_rows(content: bytes) -> list[dict]:
    return pyarrow.feather.read_table(io.BytesIO(content)).to_pylist()


def find_rows_of_annotations(whole: bytes, broken: bytes) -> Touches:
    rows = find_differing_rows(read_feather_rows, whole, broken)
    ids = [make_instance_id(row.get("track_uuid")) for row in rows]
    sweeps = [{row["timestamp_ns"] for row in read_feather_rows(c)} for c in (whole, broken)] if ids else [set(), set()]
    alone = sweeps[0] ^ sweeps[1]  # only one file contains boxes for these sweeps
    return lambda table, row: (
        is_of_broken_log(row) and (row["instance_id"] in ids if table == "primitives" else parse_frame(row) in alone)
    )


def find_rows_of_av2_poses(whole: bytes, broken: bytes) -> Touches:
    sweeps = [row.get("timestamp_ns") for row in find_differing_rows(read_feather_rows, whole, broken)]
    return lambda table, row: is_of_broken_log(row) and parse_frame(row) in sweeps


HEADERS = (
    "{'descr': '<f2', 'fortran_order': False, 'shape': (60, 61)}",
    "{'descr': '<f2', 'fortran_order': False, 'shape': (999999999, 999999999)}",
    "{'descr': '<f2', 'fortran_order': False, 'shape': (-60, -60)}",
    "{'descr': '<f2', 'fortran_order': False, 'shape': (True, 3600.0)}",
    "{'descr': ('<f2',), 'fortran_order': False, 'shape': (60, 60)}",
    "{'descr': [('a', 5)], 'fortran_order': False, 'shape': (60, 60)}",
    "{'descr': '|O', 'fortran_order': False, 'shape': (60, 60)}",
    "{[]: 1}",
    "{1: 2, 'shape': 3}",
    "-" * 5000 + "1",
    "(" * 5000,
    "",
)


def break_heights(rng: np.random.Generator, whole: bytes) -> bytes:
    height_m = np.load(io.BytesIO(whole))
    match choose(rng, ["bytes", "header", "array"]):
        case "bytes":
            return damage_bytes(rng, whole)
        case "header":
            text = choose(rng, HEADERS).encode() + b"\n"
            return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + height_m.tobytes()
    spiked = height_m.astype("f8")
    spiked[int(rng.integers(60)), int(rng.integers(60))] = choose(rng, [np.nan, np.inf, 1e30, 1e300, 900.0, 5.0])
    kinds = ["f8", ">f4", "i4", "c8", "?", "O", [("a", "f4")]]
    arrays = [
        spiked,
        spiked,
        np.asfortranarray(height_m),
        height_m[None],
        height_m[:0],
        height_m[:30],
        height_m * np.nan,
    ]
    sink = io.BytesIO()
    np.save(sink, choose(rng, [*arrays, *[height_m.astype(kind) for kind in kinds]]), allow_pickle=True)
    return sink.getvalue()


def find_rows_of_heights(whole: bytes, broken: bytes) -> Touches:
    try:
        same = np.array_equal(np.load(io.BytesIO(whole)), np.load(io.BytesIO(broken)))
    except Exception:
        same = True
    return lambda table, row: table == "rasters" and is_of_broken_log(row) and not same


BAD_JSON = (
    None,
    True,
    "text",
    "",
    "\ud800",
    "a\nb",
    [],
    {},
    float("nan"),
    float("inf"),
    1e308,
    -1e9,
    10**30,
    0,
    -1,
    0.5,
)


def break_json(rng: np.random.Generator, whole: bytes) -> bytes:
    if rng.random() < 0.2:
        return damage_bytes(rng, whole)
    content = json.loads(whole)
    for _ in range(int(rng.integers(1, 4))):
        change_json_value(rng, content)
    deep = "[" * 3000 + "]" * 3000 if rng.random() < 0.2 else "[" * (n := int(rng.integers(500, 1000))) + "]" * n
    text = json.dumps(choose(rng, [content] * 8 + [[content], {"a": content}])).replace('"@deep@"', deep)
    return text.replace('"@long@"', "9" * 5000).encode(choose(rng, ["utf-8"] * 8 + ["utf-8-sig", "utf-16"]))


def change_json_value(rng: np.random.Generator, inside: dict | list) -> None:
    """Change one value or key at a random position of a JSON value."""
    while inside:
        key = choose(rng, list(inside) if isinstance(inside, dict) else range(len(inside)))
        child = inside[key]
        if isinstance(child, dict | list) and child and rng.random() < 0.8:
            inside = child
            continue
        match choose(rng, ["value"] * 6 + ["near"] * 4 + ["gone", "other", "key"]):
            case "value":
                inside[key] = choose(rng, [*BAD_JSON, "@deep@", "@deep@", "@long@"])
            case "near" if isinstance(child, int | float):
                inside[key] = child + float(rng.normal())
            case "gone":
                del inside[key]
            case "other":
                other = choose(rng, list(inside) if isinstance(inside, dict) else range(len(inside)))
                inside[key], inside[other] = inside[other], child
            case "key" if isinstance(inside, dict):
                inside[key.upper()] = child
        return


def find_rows_of_map(whole: bytes, broken: bytes) -> Touches:
    try:
        same = json.loads(whole) == json.loads(broken)
    except (ValueError, RecursionError):
        same = True
    return lambda table, row: table == "rasters" and is_of_broken_log(row) and not same


# -------------------------------------------------------------------------------------------------- custom drives


def write_custom(root: Path, suffix: str) -> None:
    """Write two drives of three poses, each with four polygons and twenty boxes; six of the boxes move."""
    rng = np.random.default_rng(1)
    x0, y0, z0 = 456_789.0, 5_432_100.0, 115.0
    for name in AV2_LOGS:
        boxes = [
            {
                "category": CATEGORIES[k % len(CATEGORIES)],
                **dict(zip(custom.PLACE, (rng.uniform([1, -7, 0], [20, 7, 2]) + [x0, y0, z0]).tolist(), strict=True)),
                **dict(zip(custom.SIZE, rng.uniform(0.5, 4, 3).tolist(), strict=True)),
                "yaw_rad": float(rng.uniform(-3, 3)),
                "frame": None if k < 14 else k % 3,
                "instance_id": 100 + k,
                "label": f"object {k}",
            }
            for k in range(20)
        ]
        classes = {"road": (-4, 4), "sidewalk": (4, 7), "terrain": (7, 14), "ground": (-14, -4)}
        polygons = [
            {
                "class": c,
                "outline": [[x0 + x, y0 + y, z0 - 1] for x, y in ((-9, a), (50, a), (50, b), (20, b), (-9, b))],
            }
            for c, (a, b) in classes.items()
        ]
        poses = [
            {"frame": k, "yaw_rad": 0.1 * k} | dict(zip(custom.PLACE, (x0 + 3 * k, y0, z0), strict=True))
            for k in range(3)
        ]
        folder = root / name
        folder.mkdir(parents=True)
        for table, rows in {"boxes": boxes, "polygons": polygons, "poses": poses}.items():
            if suffix == "parquet":
                pq.write_table(pa.Table.from_pylist(rows), folder / f"{table}.parquet")
            else:
                (folder / f"{table}.json").write_text(json.dumps(rows))


def break_parquet(rng: np.random.Generator, whole: bytes) -> bytes:
    if rng.random() < 0.4:
        return damage_bytes(rng, whole)
    sink, table = io.BytesIO(), break_table(rng, pq.read_table(io.BytesIO(whole)))
    if rng.random() < 0.1:
        pyarrow.feather.write_feather(table.drop_columns(table.column_names[1:]), sink)
    else:
        pq.write_table(table, sink, compression=choose(rng, ["snappy", "zstd", "none"]))
    return sink.getvalue()


def read_custom_rows(content: bytes) -> list[dict]:
    if content.startswith(b"PAR1"):
        return pq.read_table(io.BytesIO(content)).to_pylist()
    return json.loads(content)


def find_rows_of_boxes(whole: bytes, broken: bytes) -> Touches:
    ids = [make_instance_id(row.get("instance_id")) for row in find_differing_rows(read_custom_rows, whole, broken)]
    return lambda table, row: table == "primitives" and is_of_broken_log(row) and row["instance_id"] in ids


def find_rows_of_polygons(whole: bytes, broken: bytes) -> Touches:
    rows = find_differing_rows(read_custom_rows, whole, broken)
    return lambda table, row: table == "rasters" and is_of_broken_log(row) and bool(rows)


def find_rows_of_custom_poses(whole: bytes, broken: bytes) -> Touches:
    frames = [row.get("frame") for row in find_differing_rows(read_custom_rows, whole, broken)]
    return lambda table, row: is_of_broken_log(row) and parse_frame(row) in frames


# ------------------------------------------------------------------------------------------------ damaged files


@dataclass(frozen=True)
class Format:
    source: str
    file: str  # glob pattern below the root
    breaks: Callable[[np.random.Generator, bytes], bytes]
    touched: Callable[[bytes, bytes], Touches]
    count: int  # number of mutations


KITTI360_XML = Format("kitti360", "data_3d_bboxes/train_full/*.xml", break_xml, find_rows_of_xml, 35)
FORMATS = {
    "kitti360 objects": KITTI360_XML,
    "kitti360 objects again": KITTI360_XML,
    "kitti360 poses": Format("kitti360", "data_poses/*/poses.txt", break_poses, find_rows_of_poses, 25),
    "av2 boxes": Format("av2", "train/broken/annotations.feather", break_feather, find_rows_of_annotations, 25),
    "av2 poses": Format("av2", "train/broken/city*.feather", break_feather, find_rows_of_av2_poses, 15),
    "av2 heights": Format("av2", "train/broken/map/*.npy", break_heights, find_rows_of_heights, 20),
    "av2 map": Format("av2", "train/broken/map/log*.json", break_json, find_rows_of_map, 15),
    "av2 raster frame": Format("av2", "train/broken/map/*Sim2*.json", break_json, find_rows_of_map, 10),
    "own boxes, Parquet": Format("own parquet", "broken/boxes.*", break_parquet, find_rows_of_boxes, 20),
    "own polygons, Parquet": Format("own parquet", "broken/polygons.*", break_parquet, find_rows_of_polygons, 10),
    "own poses, Parquet": Format("own parquet", "broken/poses.*", break_parquet, find_rows_of_custom_poses, 10),
    "own boxes, JSON": Format("own json", "broken/boxes.*", break_json, find_rows_of_boxes, 20),
    "own polygons, JSON": Format("own json", "broken/polygons.*", break_json, find_rows_of_polygons, 10),
    "own poses, JSON": Format("own json", "broken/poses.*", break_json, find_rows_of_custom_poses, 10),
}


@pytest.fixture(scope="module")
def raw(tmp_path_factory) -> dict[str, Path]:
    """Folders with small undamaged drives of every source."""
    root = tmp_path_factory.mktemp("raw")
    with pytest.MonkeyPatch.context() as monkeypatch:
        write_kitti360_excerpt(root / "kitti360", monkeypatch)
    write_av2(root / "av2")
    write_custom(root / "own parquet", "parquet")
    write_custom(root / "own json", "json")
    return {path.name: path for path in root.iterdir()}


@pytest.mark.slow  # tests/unit/test_fuzz.py damages the same files in a shorter time.
@pytest.mark.parametrize("name", FORMATS)
def test_write_shard_rejects_or_contains_damaged_file(raw, tmp_path, name):
    chosen, chunk = FORMATS[name], list(FORMATS).index(name)
    source, root = chosen.source.split()[0], tmp_path / "raw"
    shutil.copytree(raw[chosen.source], root)
    whole_tables, manifests = write_all_shards(source, root, tmp_path / "whole")
    assert len(whole_tables["scenes"]) >= 4 and len(whole_tables["primitives"]) > 20 and not manifests[0]["unreadable"]
    (path,) = root.glob(chosen.file)
    whole, outcomes = path.read_bytes(), Counter()
    for k in range(chosen.count):
        broken = chosen.breaks(np.random.default_rng([chunk, k]), whole)
        path.write_bytes(broken)
        try:
            with time_limit(CASE_SECONDS):
                touches = chosen.touched(whole, broken)
                outcomes[classify_outcome(source, root, path, tmp_path / str(k), whole_tables, touches)] += 1
        except BaseException as error:
            error.add_note(f"{name}: mutation {k}, {len(broken)} bytes of {len(whole)}")
            raise
    assert outcomes["refused"] >= chosen.count / 5 and len(outcomes) > 1, outcomes
