"""Tests of the studio without Ray: access control, malformed requests, budgets, the task queue and bounded sessions."""

import asyncio
import shutil
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from helpers import random_scene, studio_scene
from starlette.testclient import TestClient

from pipelines.runtime import storage
from pipelines.schema.conversion import make_scene_tables
from pipelines.schema.tables import Shard
from pipelines.studio.access import COOKIE, COOKIE_AGE_S, Gate
from pipelines.studio.api import build_studio_app
from pipelines.studio.limits import StudioError, StudioLimits
from pipelines.studio.sessions import Session, SessionStore
from pipelines.studio.studio import Answer, Studio
from pipelines.studio.tasks import BackgroundTask, Cancelled, TaskQueue

POST = {"x-studio": "1", "content-type": "application/json"}
TOKEN = "a-token-of-at-least-16-letters"
ADDRESS = "http://studio.example"


class LocalBackend:
    """Answers requests in threads of this process instead of a Ray actor."""

    def __init__(self, studio: Studio) -> None:
        self.studio = studio

    async def answer(self, operation: str, visitor: str, request=None) -> Answer:
        return await asyncio.to_thread(self.studio.answer, operation, visitor, request)


@pytest.fixture(scope="module")
def studio(studio_files) -> Studio:
    limits = StudioLimits(request_evaluations=100, max_primitives=20, max_edits=10)
    return Studio(str(studio_files / "model"), [str(studio_files / "tables")], limits)


def make_client(studio: Studio, gate: Gate | None = None) -> TestClient:
    gate = gate or Gate(hosts=("studio.example",))
    return TestClient(build_studio_app(LocalBackend(studio), gate), base_url=ADDRESS, raise_server_exceptions=False)


@pytest.fixture
def client(studio) -> TestClient:
    client = make_client(studio)
    assert client.get("/").status_code == 200
    return client


# -------------------------------------------------------------------------------------------------- access control


def test_token_is_exchanged_for_cookie_by_redirect(studio):
    client = make_client(studio, Gate(TOKEN, ()))
    for path in ("/", "/studio.js", "/api/about", "/-/routes", "/-/healthz"):
        assert client.get(path).status_code == 401
    assert client.get("/?token=wrong").status_code == 401
    assert client.get(f"/api/about?token={TOKEN}").status_code == 401
    moved = client.get(f"/?token={TOKEN}", follow_redirects=False)
    assert (moved.status_code, moved.headers["location"]) == (303, "/")
    cookie = moved.headers["set-cookie"]
    assert TOKEN not in cookie and "HttpOnly" in cookie and "SameSite=lax" in cookie and "Secure" not in cookie
    assert client.get("/").status_code == 200 and client.get("/api/about").json()["labels"] == ["low", "medium", "high"]
    assert "Secure" in make_client(studio, Gate(is_encrypted=True, hosts=())).get("/").headers["set-cookie"]
    with pytest.raises(ValueError, match="has 5 characters; write at least 16"):
        Gate("short")


def test_request_overrides_constraints_of_studio(studio_files):
    for default, wanted, expected in (
        (None, None, False),
        (True, None, True),
        (True, False, False),
        (None, True, True),
    ):
        studio = Studio(str(studio_files / "model"), [str(studio_files / "tables")], constraints=default)
        client = make_client(studio)
        client.get("/")
        assert client.get("/api/about").json()["constraints"] is bool(default)
        assert client.post("/api/generate", json={"steps": 4, "constraints": wanted}, headers=POST).status_code == 200
        wait_until(lambda client=client: client.get("/api/work").json()["finished"])
        assert (studio.pipeline.guidance is not None) is expected
    assert client.post("/api/generate", json={"steps": 4, "constraints": "lanes"}, headers=POST).status_code == 422


def test_only_studio_issues_sessions(studio, client):
    """Invented, foreign and expired cookies open no session and delete none."""
    client.post("/api/open", json={"scene_id": "given-1"}, headers=POST)
    valid = client.cookies[COOKIE]
    before = len(studio.sessions.sessions)
    name, issued, signature = valid.split(".")
    now = [time.time()]
    other = make_client(studio, Gate(hosts=(), clock=lambda: now[0]))
    other.get("/")
    foreign = other.cookies[COOKIE]
    for invented in ("x", "a.1.b", f"{name}x.{issued}.{signature}", f"{name}.{int(issued) + 1}.{signature}", foreign):
        answer = make_client(studio).get("/api/state", headers={"cookie": f"{COOKIE}={invented}"})
        assert answer.status_code == 401
    assert len(studio.sessions.sessions) == before
    assert client.get("/api/state").json()["scene"]["scene_id"] == "given-1"
    assert other.get("/api/state").status_code == 200
    now[0] += COOKIE_AGE_S + 1
    assert other.get("/api/state").status_code == 401


def test_every_response_has_security_headers(client):
    for answer in (client.get("/"), client.get("/api/state"), client.get("/missing"), client.post("/api/undo")):
        policy = answer.headers["content-security-policy"]
        assert "default-src 'self'" in policy and "frame-ancestors 'none'" in policy
        wanted = {"x-content-type-options": "nosniff", "referrer-policy": "no-referrer", "cache-control": "no-store"}
        assert wanted.items() <= dict(answer.headers).items()


@pytest.mark.parametrize(
    ("method", "path", "options", "status"),
    [
        ("GET", "/", {"headers": {"host": "rebound.example"}}, 421),
        ("GET", "/", {"headers": {"host": "[::1"}}, 400),
        ("PUT", "/", {}, 405),
        ("OPTIONS", "/api/open", {}, 405),
        ("POST", "/api/undo", {}, 403),
        ("POST", "/api/undo", {"headers": POST | {"content-length": "x"}}, 400),
        ("POST", "/api/undo", {"headers": POST | {"transfer-encoding": "chunked"}}, 411),
        ("POST", "/api/open", {"headers": POST, "content": b"x" * 300_000}, 413),
        ("GET", "/api/scenes?start=abc", {}, 422),
        ("GET", "/api/scenes?start=-1", {}, 422),
        ("GET", "/api/scenes?start=99999999999999999999", {}, 422),
        ("GET", "/api/scenes?text=" + "x" * 200, {}, 422),
        ("GET", "/scene.exe", {}, 404),
        ("GET", "/scene.glb", {}, 400),
        ("GET", "/..%2f..%2fetc/passwd", {}, 404),
        ("POST", "/api/open", {"headers": POST, "content": b"{"}, 422),
        ("POST", "/api/open", {"headers": POST, "content": b"[" * 100_000}, 400),
        ("POST", "/api/open", {"headers": POST, "content": b"\xff\xfe"}, 422),
        ("POST", "/api/open", {"headers": POST, "json": {"scene_id": "\x00../../etc"}}, 400),
        ("POST", "/api/generate", {"headers": POST, "content": b'{"steps": NaN}'}, 422),
        ("POST", "/api/generate", {"headers": POST, "content": b'{"seed": 1e400}'}, 422),
        ("POST", "/api/generate", {"headers": POST, "json": {"steps": 101}}, 400),
        ("POST", "/api/inpaint", {"headers": POST, "content": b'{"polygon_m": [[0,0],[1,NaN],[2,2]]}'}, 422),
        ("POST", "/api/inpaint", {"headers": POST, "json": {"polygon_m": [[0, 0], [1e300, 1], [2, 2]]}}, 400),
        ("POST", "/api/edit", {"headers": POST, "content": b'{"edits": [{"edit": "snap", "x": NaN}]}'}, 400),
    ],
)  # fmt: skip
def test_malformed_request_is_client_error(client, studio_files, method, path, options, status):
    answer = client.request(method, path, **options)
    assert answer.status_code == status, answer.text
    assert str(studio_files) not in answer.text and "Traceback" not in answer.text


def test_request_beyond_budget_is_refused(client):
    client.post("/api/open", json={"scene_id": "given-0"}, headers=POST)
    square = {"polygon_m": [[10, -10], [40, -10], [40, 10], [10, 10]]}
    answer = client.post(
        "/api/inpaint", json=square | {"steps": 1000, "jump_length": 100, "resamplings": 20}, headers=POST
    )
    assert answer.status_code == 400 and "network evaluations, and the studio accepts 100 per request" in answer.text
    copy = {"edit": "duplicate", "select": {"category": ["vehicle_small"]}, "by_m": [0, 1, 0]}
    answer = client.post("/api/edit", json={"edits": [copy] * 10}, headers=POST)
    assert answer.status_code == 400 and "would have 24 primitives, and the studio accepts 20" in answer.text
    turn = {"edit": "rotate", "select": {"primitives": [0]}, "by_deg": 15}
    assert client.post("/api/edit", json={"edits": [turn] * 10}, headers=POST).status_code == 200
    answer = client.post("/api/edit", json={"edits": [turn]}, headers=POST)
    assert answer.status_code == 400 and "has 10 edits, and the studio accepts 10" in answer.text


def test_studio_returns_the_tracks_of_the_open_scene(studio, client):
    assert client.get("/api/tracks").json() == {"objects": [], "driving": []}
    client.post("/api/open", json={"scene_id": "given-1"}, headers=POST)
    assert client.get("/api/tracks").json()["objects"] == []
    client.post("/api/open", json={"scene_id": "given-0"}, headers=POST)
    (one,) = client.get("/api/tracks").json()["objects"]
    assert one["category"] == "vehicle_small" and one["places"][2] == [12.0, 0.0, 0.75, 0.0] and one["time_s"][2] == 1.0


def test_damaged_shard_does_not_hide_other_scenes(studio_files, tmp_path):
    """One shard has an infinite pose, another one a damaged raster: the list shows the other scenes."""
    Shard(str(tmp_path), "town", "test", 0).write([studio_scene(0)])
    Shard(str(tmp_path), "town", "test", 1).write([replace(studio_scene(1), world_yaw_rad=float("inf"))])
    damaged = Shard(str(tmp_path), "town", "test", 2)
    damaged.write([studio_scene(2)])
    tables = make_scene_tables([studio_scene(2)])
    index = tables["rasters"].column_names.index("resolution_m")
    storage.write_parquet(
        tables["rasters"].set_column(index, tables["rasters"].schema.field(index), [[0.0]]), damaged.path("rasters")
    )
    client = make_client(Studio(str(studio_files / "model"), [str(tmp_path)]))
    client.get("/")
    page = client.get("/api/scenes").json()
    assert [one["scene_id"] for one in page["scenes"]] == ["given-0", "given-2"] and page["scenes"][1]["picture"] == ""
    answer = client.post("/api/open", json={"scene_id": "given-2"}, headers=POST)
    assert answer.status_code == 400 and "damaged" in answer.text and str(tmp_path) not in answer.text
    assert client.post("/api/open", json={"scene_id": "given-0"}, headers=POST).status_code == 200


# -------------------------------------------------------------------------------------------------------- tasks


def wait_until(condition) -> None:
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def test_studio_refuses_two_scenes_with_one_id(studio_files, tmp_path):
    shutil.copytree(studio_files / "tables", tmp_path / "copy")
    with pytest.raises(ValueError, match=r"scene 'given-0' is in .*tables and in .*copy; give one of these"):
        Studio(str(studio_files / "model"), [str(studio_files / "tables"), str(tmp_path / "copy")])


def test_queue_runs_visitor_with_least_use_first():
    queue, gate, order = TaskQueue(StudioLimits(max_waiting=3, visitor_evaluations=1000)), threading.Event(), []

    def run(task: BackgroundTask) -> None:
        order.append(task.name)
        while not gate.is_set():
            task.step(None, 0, 0, {})
            time.sleep(0.001)

    def put(visitor: str, name: str, total: int = 10) -> BackgroundTask:
        queue.put(task := BackgroundTask(visitor, name, total, run))
        return task

    queue.used["busy"].append((time.monotonic(), 500))
    first = put("a", "first")
    wait_until(lambda: queue.running is first)
    second, third, fourth = put("busy", "second"), put("b", "third"), put("c", "fourth")
    assert [queue.describe(task)["position"] for task in (first, second, third, fourth)] == [0, 3, 1, 2]
    with pytest.raises(StudioError, match="3 tasks are waiting") as refused:
        put("d", "fifth")
    assert refused.value.status == 429 and refused.value.retry_after_s > 0
    with pytest.raises(StudioError, match="your last task is still running"):
        put("b", "again")
    queue.cancel(fourth)
    assert fourth.finished and queue.describe(fourth)["cancelled"] and queue.describe(fourth)["estimate_s"] is None
    start = time.monotonic()
    queue.cancel(first)
    wait_until(lambda: first.finished)
    assert time.monotonic() - start < 1
    wait_until(lambda: queue.running is third)
    assert queue.describe(second)["estimate_s"] > 0
    gate.set()
    wait_until(lambda: second.finished)
    assert order == ["first", "third", "second"]
    with pytest.raises(StudioError, match=r"you used .* of 1,000 network evaluations per hour"):
        put("busy", "sixth", 600)


def test_queue_survives_failure_and_forgets_use_after_hour():
    now = [0.0]
    queue = TaskQueue(StudioLimits(), lambda: now[0])

    def fail(task: BackgroundTask) -> None:
        task.step(None, 0, 0, {})
        raise OSError("/secret/path")

    queue.put(task := BackgroundTask("a", "fail", 3, fail))
    wait_until(lambda: task.finished)
    assert "secret" not in task.error and "the log of the studio" in task.error
    assert queue._count_used("a") == 1
    now[0] += 3601
    assert queue._count_used("a") == 0 and "a" not in queue.used
    queue.put(other := BackgroundTask("a", "next", 3, lambda task: None))
    wait_until(lambda: other.finished)
    assert not other.error
    assert issubclass(Cancelled, Exception)


# ------------------------------------------------------------------------------------------------------ sessions


def test_undo_history_is_bounded_in_bytes():
    scene, session = random_scene(0, n=100), Session()
    bytes_of_one = scene.height_m.nbytes + scene.occupied.nbytes + 300 * len(scene)
    most = 3 * bytes_of_one
    for number in range(10):  # each scene has its own ground
        own = replace(scene, height_m=scene.height_m.copy(), occupied=scene.occupied.copy())
        session.put(f"open {number}", own, (), most)
        assert session.size <= most
    assert 1 <= len(session.past) <= 2
    shared = Session()
    for number in range(50):  # edits share the ground
        shared.put(f"edit {number}", scene.select(np.arange(100)), (), most)
    assert len(shared.past) > 10 and shared.size <= most
    with pytest.raises(StudioError, match="a session has 0 MiB"):
        shared.put("large", scene, (), 1000)


def test_sessions_are_bounded_in_number_age_and_bytes():
    now, scene = [0.0], random_scene(0, n=10)
    limits = StudioLimits(max_sessions=3, total_bytes=3 * scene.height_m.nbytes)
    store = SessionStore(limits, lambda: now[0])
    for name in "abc":
        store.open(name).put("open", scene.select(np.arange(5)), (), limits.session_bytes)
    with pytest.raises(StudioError, match="the studio is full") as refused:
        store.open("d")
    assert refused.value.status == 429
    now[0] += limits.protected_s
    store.open("a")
    store.open("d")  # replaces b, the least recently used
    assert set(store.sessions) == {"a", "c", "d"}
    store.sessions["c"].task = BackgroundTask("c", "runs", 1, lambda task: None)
    now[0] += limits.idle_s
    store.open("e")
    assert set(store.sessions) == {"c", "e"}  # c has a task
    for name in "ce":
        for _ in range(3):
            own = replace(scene, height_m=scene.height_m.copy(), occupied=scene.occupied.copy())
            store.sessions[name].put("open", own, (), limits.session_bytes)
    store.trim(store.sessions["e"])
    assert sum(session.size for session in store.sessions.values()) <= limits.total_bytes
    assert not store.sessions["c"].past and store.sessions["c"].state.scene is not None
    kept = store.sessions["e"].state.scene
    own = replace(scene, height_m=scene.height_m.copy(), occupied=scene.occupied.copy())
    store.open("f").put("open", own, (), limits.session_bytes)
    with pytest.raises(StudioError, match="the memory of the studio is full") as refused:
        store.trim(store.sessions["f"])
    assert refused.value.status == 429 and store.sessions["f"].state.scene is None
    assert store.sessions["e"].state.scene is kept  # Active visitors keep their scenes.
    assert sum(session.size for session in store.sessions.values()) <= limits.total_bytes
