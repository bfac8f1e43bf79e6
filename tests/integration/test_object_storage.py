"""Tests of jobs whose inputs and outputs are in object storage (an S3 server of moto)."""

import json
import os
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pyarrow.fs as pafs
import pyarrow.parquet as pq
import pytest
from helpers import small_spec, tiny_pipeline
from s3_server import S3Server, run_s3_server

from models.local_copy import make_local_copy
from models.pipeline import PrITTIPipeline
from models.uris import join_uri, resolve_uri
from pipelines.preprocess import ingest
from pipelines.preprocess.sharding import plan_argoverse2, plan_custom, plan_kitti360, plan_town
from pipelines.runtime import storage
from pipelines.schema.lease import Lease, LeaseError, Owner
from pipelines.schema.tables import find_shards


@pytest.fixture(scope="module")
def s3(cluster) -> Iterator[S3Server]:
    with run_s3_server() as server:
        yield server


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    """An empty local cache."""
    monkeypatch.setenv("PRITTI_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def upload(directory: Path, uri: str) -> str:
    file_system, path = resolve_uri(uri)
    pafs.copy_files(str(directory), path, destination_filesystem=file_system)
    return uri


def read_tables(root: str) -> dict[str, object]:
    """Return the content of all Parquet files and of dataset.json, by relative path."""
    file_system, path = resolve_uri(root)
    found = file_system.get_file_info(pafs.FileSelector(path, recursive=True))
    names = {info.path[len(path) + 1 :]: info.path for info in found if info.is_file}
    assert not [name for name in names if name.startswith(".staging") or "/.tmp-" in name]
    kept = {name: place for name, place in names.items() if not name.startswith(".")}
    return {
        name: pq.read_table(place, filesystem=file_system, partitioning=None)
        if name.endswith(".parquet")
        else file_system.open_input_stream(place).read()
        for name, place in kept.items()
    }


def test_town_in_s3_equals_local_town(s3, tmp_path):
    tasks, options = plan_town(24, 8, 0), {"source": "town"}
    s3.requests.clear()
    ingest.ingest_drives(tasks, s3.uri("town"), options)
    writes = s3.list_writes()
    ingest.ingest_drives(tasks, str(tmp_path / "town"), options)
    local = read_tables(str(tmp_path / "town"))
    assert len(local) >= 10 and read_tables(s3.uri("town")) == local
    # Staged scenes, manifests and options are files, too. Each file is written once.
    assert len(writes) <= 1.5 * len(set(writes)) and len(writes) <= 2 * len(local)
    shard = find_shards(s3.uri("town"))[0]
    s3.requests.clear()
    shard.scenes()
    assert len(s3.requests) <= 12  # Three tables: the size, the head, the end and the columns of each.
    s3.requests.clear()
    assert ingest.ingest_drives(tasks, s3.uri("town"), options).already_complete
    assert not s3.list_writes()


@pytest.mark.parametrize("source", ["kitti360", "av2", "own"])
def test_raw_drives_in_s3_equal_local_drives(s3, request, source, cache, tmp_path):
    plan = {
        "kitti360": lambda root: plan_kitti360(root),
        "av2": plan_argoverse2,
        "own": lambda root: plan_custom(root, split=False),
    }[source]
    raw = write_own_drive(tmp_path / "raw") if source == "own" else request.getfixturevalue("real_data") / source
    made, options = {}, {"source": source}
    for name, root in (("local", str(raw)), ("s3", upload(raw, s3.uri("raw", source)))):
        ingest.ingest_drives(plan(root)[:2], str(tmp_path / name), options)
        made[name] = read_tables(str(tmp_path / name))
    assert len(made["local"]) >= 4 and made["s3"] == made["local"]


def write_own_drive(root: Path) -> Path:
    """Write a drive of two poses with one box and one road as JSON files."""
    box = {"category": "pole", "x_m": 5.0, "y_m": 1.0, "z_m": 1.0, "yaw_rad": 0.0, "frame": None}
    box |= {"length_m": 0.5, "width_m": 0.5, "height_m": 4.0}
    road = {"class": "road", "outline": [[-9.0, -4.0, 0.0], [80.0, -4.0, 0.0], [80.0, 4.0, 0.0], [-9.0, 4.0, 0.0]]}
    poses = [{"frame": k, "x_m": float(k), "y_m": 0.0, "z_m": 0.0, "yaw_rad": 0.0} for k in range(2)]
    (root / "drive").mkdir(parents=True)
    for name, rows in {"boxes": [box], "polygons": [road], "poses": poses}.items():
        (root / "drive" / f"{name}.json").write_text(json.dumps(rows))
    return root


def test_raw_drive_error_names_the_uri(s3, real_data, cache, tmp_path):
    copy = tmp_path / "raw"
    shutil.copytree(real_data / "kitti360", copy)
    (poses,) = copy.glob("data_poses/*/poses.txt")
    poses.write_text("1 2 3\n")
    given = upload(copy, s3.uri("damaged"))
    with pytest.raises(ValueError, match=r"s3://tests/damaged/data_poses/.*poses.txt.*, line 1: 3 numbers"):
        plan_kitti360(given, split=False)


def test_pipeline_loads_from_uri_without_other_files(s3, cache, tmp_path):
    pipeline = tiny_pipeline(small_spec())
    pipeline.save_pretrained(tmp_path / "model")
    (tmp_path / "model" / "notes.bin").write_bytes(b"x" * 1000)
    uri = upload(tmp_path / "model", s3.uri("model"))
    s3.requests.clear()
    loaded = PrITTIPipeline.from_pretrained(uri)
    assert all((loaded.dit.state_dict()[k] == v).all() for k, v in pipeline.dit.state_dict().items())
    read = [path for method, path, _ in s3.requests if method == "GET" and path != "/tests"]
    assert read and not any(path.endswith("notes.bin") for path in read)
    s3.requests.clear()
    PrITTIPipeline.from_pretrained(uri)
    assert not [path for method, path, _ in s3.requests if method == "GET" and path != "/tests"]


def test_local_copy_follows_source_and_repairs_damage(s3, cache):
    uri = s3.uri("copied", "a.bin")
    storage.write_whole(uri, lambda stream: stream.write(b"first"))
    copy = Path(make_local_copy(uri))
    assert copy.read_bytes() == b"first" and copy.is_relative_to(cache) and copy.name == "a.bin"
    copy.write_bytes(b"flipt")
    from models import local_copy

    local_copy._checked.clear()  # as in a new process
    assert Path(make_local_copy(uri)).read_bytes() == b"first"
    time.sleep(1.1)  # modification times of S3 have seconds
    storage.write_whole(uri, lambda stream: stream.write(b"other"))
    assert Path(make_local_copy(uri)).read_bytes() == b"other"
    with pytest.raises(ValueError, match=r"s3://tests/copied/absent.*: no such file or directory"):
        make_local_copy(s3.uri("copied", "absent"))


def test_local_copy_is_shared_by_concurrent_callers(s3, cache):
    uri = s3.uri("copied", "b.bin")
    content = os.urandom(3_000_000)
    storage.write_whole(uri, lambda stream: stream.write(content))
    found: list[str] = []
    threads = [threading.Thread(target=lambda: found.append(make_local_copy(uri))) for _ in range(8)]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    assert len(set(found)) == 1 and Path(found[0]).read_bytes() == content
    assert not list(cache.rglob(".tmp-*"))


def test_failed_write_sends_nothing(s3):
    def write(stream) -> None:
        stream.write(b"half")
        raise RuntimeError("stop")

    s3.requests.clear()
    with pytest.raises(RuntimeError, match="stop"):
        storage.write_whole(s3.uri("failed", "x"), write)
    assert not s3.list_writes() and not storage.exists(s3.uri("failed", "x"))


def test_small_and_large_files_are_written_whole(s3):
    for size in (0, 10, 20_000_000):
        content = os.urandom(size)
        s3.requests.clear()
        storage.write_whole(s3.uri("sizes", str(size)), lambda stream, content=content: stream.write(content))
        assert len(s3.list_writes()) == (1 if size < 10**7 else len(s3.list_writes()))
        assert storage.read_bytes(s3.uri("sizes", str(size))) == content


def test_create_file_has_one_winner(s3):
    wins: list[bool] = []
    uri = s3.uri("race", "record")
    threads = [threading.Thread(target=lambda k=k: wins.append(storage.create_file(uri, b"%d" % k))) for k in range(8)]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    assert sorted(wins) == [False] * 7 + [True]


def test_lease_in_s3_expires_by_the_clock_of_the_store(s3, monkeypatch):
    def make_lease(job: str, host: str) -> Lease:
        owner = replace(Owner.of_this_process(job), machine=host, host=host)
        return Lease(s3.uri("leased"), "run", owner, print, lifetime_s=3.0)

    silent, other = make_lease("job-1", "a"), make_lease("job-2", "b")
    monkeypatch.setattr(Lease, "_keep", lambda self: None)  # no heartbeats
    silent.acquire()
    with monkeypatch.context() as clock:
        clock.setattr(time, "time", lambda: 3600.0)  # The clock of this machine is wrong.
        with pytest.raises(LeaseError, match="job job-1 on a writes 'run' here"):
            other.acquire()
    lines: list[str] = []
    other.acquire("wait", lines.append)
    assert len(lines) == 1 and "waiting for job job-1 on a" in lines[0]
    assert "job job-2 on b has taken over" in silent._beat()
    with pytest.raises(LeaseError, match="job job-2 on b"):
        make_lease("job-3", "a").acquire()
    other.release("finished")


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("s3://absent-bucket/x", r"s3://absent-bucket/x.*: cannot be written .*"),
        ("s3://tests/x", r"s3://tests/x.*: cannot be written .*"),
    ],
)
def test_refused_write_is_one_clear_error(s3, uri, message, monkeypatch):
    if "absent" not in uri:
        s3.intercept = lambda method, path: 403 if method == "PUT" else 0
    options = s3.uri().partition("?")[2]
    try:
        with pytest.raises(OSError, match=message):
            storage.write_text("x", f"{uri}?{options}")
    finally:
        s3.intercept = lambda method, path: 0


def test_node_without_keys_is_one_clear_error(s3):
    """Neither the marker of the node nor its deletion is allowed."""
    from pipelines.runtime.shared_storage import require_shared_storage

    s3.intercept = lambda method, path: 403
    try:
        with pytest.raises(
            ValueError, match=r"node \S+ \(.*\): s3://tests/x/.*cannot be written .*; check that the buck"
        ):
            require_shared_storage(s3.uri("x"))
    finally:
        s3.intercept = lambda method, path: 0


def test_workers_send_artifacts_to_the_endpoint_of_the_home(s3, tmp_path, monkeypatch):
    """Ray's workers do not have the variables that the driver sets."""
    import numpy as np
    import ray

    from jobs.support.tracking import Tracker

    monkeypatch.setenv("PRITTI_HOME", s3.uri("home"))
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path}/mlflow.db")
    for name in ("MLFLOW_S3_ENDPOINT_URL", "AWS_DEFAULT_REGION", "AWS_ENDPOINT_URL"):
        monkeypatch.delenv(name, raising=False)

    @ray.remote
    def log_picture(tracker: Tracker, name: str) -> None:
        tracker.picture(np.zeros((8, 8, 3), np.uint8), name)

    for name in ("new.png", "again.png"):  # The second run finds the experiment.
        monkeypatch.delenv("MLFLOW_S3_ENDPOINT_URL", raising=False)
        tracker = Tracker.start("pictures", name, {})
        s3.requests.clear()
        ray.get(log_picture.remote(tracker, name))
        assert [path for path in s3.list_writes() if path.endswith(name) and "/home/mlartifacts/" in path]
        assert "testing" not in json.dumps(tracker.settings)  # no keys
    with pytest.raises(
        OSError, match=r"^MLflow \(sqlite:.*\) or the storage .* \(KeyError: 'gone'\); check MLFLOW_TRA"
    ):
        monkeypatch.setattr(type(tracker.client), "set_tag", lambda *_: {}["gone"])
        tracker.tag("key", "value")


@pytest.mark.slow  # The connection times out after half a minute.
def test_hung_endpoint_ends_with_an_error(s3):
    with socket.create_server(("127.0.0.1", 0)) as server:
        uri = f"s3://tests/x?endpoint_override=http://127.0.0.1:{server.getsockname()[1]}&region=x"
        started = time.monotonic()
        with pytest.raises((OSError, ValueError), match="s3://tests/x"):
            storage.write_text("x", uri)
    assert time.monotonic() - started < 60


def test_missing_model_is_named(s3, cache, monkeypatch):
    from jobs.support.model_directories import find_pipeline_directory

    monkeypatch.setenv("PRITTI_HOME", s3.uri("home"))
    with pytest.raises(ValueError, match=r"^s3://tests/no-model.*: no"):
        find_pipeline_directory(s3.uri("no-model"))


def test_missing_bucket_is_named_when_scenes_are_read(s3):
    root = join_uri("s3://absent-bucket/town?" + s3.uri().partition("?")[2])
    with pytest.raises(ValueError, match="s3://absent-bucket/town/scenes"):
        find_shards(root)


@pytest.mark.slow
def test_generated_and_edited_scenes_in_s3_equal_local(s3, cache, tmp_path):
    from jobs.edit_scenes import Translate
    from jobs.implementation.edit_scenes import edit_scenes
    from jobs.implementation.sample_scenes import sample
    from jobs.sample_scenes import Config

    tiny_pipeline(small_spec()).save_pretrained(tmp_path / "model")
    model = upload(tmp_path / "model", s3.uri("tiny"))
    places = {"local": (str(tmp_path / "model"), str(tmp_path / "made")), "s3": (model, s3.uri("made"))}
    tables = {}
    for name, (given, output) in places.items():
        options = {"num_scenes": 3, "num_inference_steps": 2, "existence_threshold": 0.01, "num_glb": 1}
        s3.requests.clear()
        sample(Config(model=given, output=output, **options))
        edited = storage.join_uri(output, "moved")
        edit_scenes(Translate(input=output, output=edited, where="true", offset_m=(1.0, 0.0, 0.0), num_examples=1))
        tables[name] = {key: value for key, value in read_tables(output).items() if key.endswith(".parquet")}
    assert len(tables["local"]) >= 16 and tables["s3"] == tables["local"]
    files = [path for path in s3.list_writes() if "/.leases/" not in path and "/.node-" not in path]
    assert len(files) <= 1.5 * len(set(files))
    s3.requests.clear()
    sample(Config(model=model, output=places["s3"][1], **options))  # everything is there
    assert not [path for path in s3.list_writes() if path.endswith(".parquet")]
    assert not list(Path.cwd().glob("s3:*"))


@pytest.mark.slow  # tests/faults/test_cluster_storage.py evaluates scenes in object storage.
def test_evaluation_of_scenes_in_s3_equals_local(s3, cache, tmp_path, monkeypatch):
    from jobs.evaluate_scenes import Config
    from jobs.implementation.evaluate_scenes import evaluate

    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path}/mlflow.db")
    monkeypatch.setenv("PRITTI_HOME", str(tmp_path / "home"))
    ingest.ingest_drives(plan_town(24, 8, 0), str(tmp_path / "real"), {"source": "town"})
    real = upload(tmp_path / "real", s3.uri("real"))
    scores = {}
    for name, root in (("local", str(tmp_path / "real")), ("s3", real)):
        output = storage.join_uri(root, "evaluation")
        asked = Config(
            real=root, real_split="test", generated=root, generated_split="train", output=output, lite0=False
        )
        scores[name] = evaluate(replace(asked, num_examples=2, ceiling_split="train"))
    assert repr(scores["s3"]) == repr(scores["local"]) and scores["s3"]["generation"]
    assert storage.exists(storage.join_uri(real, "evaluation", "metrics.json"))
