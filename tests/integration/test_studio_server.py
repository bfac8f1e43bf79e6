"""Tests of the HTTP interface of the studio in a Ray actor, with a model that has random weights."""

import socket
import time

import pytest
import requests

POST = {"x-studio": "1"}


def open_session(address: str) -> requests.Session:
    session = requests.Session()
    assert session.get(address).status_code == 200 and "studio" in session.cookies
    return session


def wait_for_work(session: requests.Session, address: str) -> dict:
    for _ in range(600):
        work = session.get(f"{address}api/work").json()
        if work["finished"]:
            return work
        time.sleep(0.05)
    raise AssertionError(work)


def post_request(session: requests.Session, address: str, path: str, body: dict) -> requests.Response:
    return session.post(f"{address}api/{path}", json=body, headers=POST)


def test_studio_keeps_scene_and_history_per_visitor(studio_url):
    one, other = open_session(studio_url), open_session(studio_url)
    state = post_request(one, studio_url, "open", {"scene_id": "given-1"}).json()
    assert state["scene"]["scene_id"] == "given-1" and len(state["scene"]["primitives"]) == 3
    assert other.get(f"{studio_url}api/state").json()["scene"] is None
    move = {"edit": "translate", "select": {"primitives": [1]}, "by_m": [2, 0, 0]}
    state = post_request(
        one, studio_url, "edit", {"edits": [move, {"edit": "remove", "select": {"primitives": [0]}}]}
    ).json()
    assert [p["center_m"][0] for p in state["scene"]["primitives"]] == [32, 50] and len(state["edits"]) == 2
    assert one.get(f"{studio_url}scene.json").json() == state["edits"]
    assert len(post_request(one, studio_url, "undo", {}).json()["scene"]["primitives"]) == 3
    assert len(post_request(one, studio_url, "redo", {}).json()["scene"]["primitives"]) == 2
    glb = one.get(f"{studio_url}scene.glb")
    assert "given-1.glb" in glb.headers["content-disposition"] and glb.content[:4] == b"glTF"
    assert one.get(f"{studio_url}api/scenes?text=given-2").json()["total"] == 1


def test_studio_reports_progress_and_cancels(studio_url):
    session = open_session(studio_url)
    state = post_request(
        session, studio_url, "generate", {"label": "high", "seed": 3, "steps": 5, "sampler": "ddpm"}
    ).json()
    assert state["work"]["total"] == 5
    assert wait_for_work(session, studio_url)["done"] == 5
    first = session.get(f"{studio_url}api/state").json()["scene"]
    post_request(session, studio_url, "generate", {"steps": 1000, "sampler": "ddpm"})
    busy = post_request(session, studio_url, "edit", {"edits": [{"edit": "remove", "select": {"primitives": [0]}}]})
    assert busy.status_code == 409 and "is still running" in busy.json()["detail"]
    assert post_request(session, studio_url, "generate", {}).status_code == 429
    post_request(session, studio_url, "cancel", {})
    work = wait_for_work(session, studio_url)
    assert work["cancelled"] and work["done"] < 1000 and not work["error"]
    assert session.get(f"{studio_url}api/state").json()["scene"] == first
    square = {"polygon_m": [[10, -10], [40, -10], [40, 10], [10, 10]], "steps": 4, "resamplings": 1}
    post_request(session, studio_url, "inpaint", square | {"contents": "objects"})
    assert not wait_for_work(session, studio_url)["error"]
    made = session.get(f"{studio_url}api/state").json()
    assert made["undo"] == "generate high, seed 3" or made["undo"] == "inpaint objects"
    assert made["scene"]["ground"] == first["ground"]  # only objects are inpainted
    post_request(session, studio_url, "extend", {"side": "ahead", "steps": 4, "resamplings": 1})
    assert not wait_for_work(session, studio_url)["error"]
    assert session.get(f"{studio_url}api/state").json()["scene"]["grid"]["rows"] == 48


@pytest.mark.parametrize(
    "path, body, status, message",
    [
        ("open", {"scene_id": "../../etc"}, 400, "no scene"),
        ("generate", {"label": "dense"}, 400, "label 'dense' is unknown"),
        ("generate", {"steps": 0}, 422, "greater than or equal to 1"),
        ("generate", {"step": 5}, 422, "Extra inputs"),
        ("edit", {"edits": [{"edit": "explode"}]}, 400, "expected one of: remove"),
        ("edit", {"edits": [{"edit": "remove", "select": {"where": "true"}}]}, 400, "the studio accepts no SQL"),
        ("edit", {"edits": [{"edit": "remove", "select": {"primitives": [99]}}]}, 400, "has 3 primitives"),
        ("inpaint", {"polygon_m": [[900, 0], [901, 0], [900, 1]]}, 400, "contains no pixel"),
        ("extend", {"side": "up"}, 422, "ahead"),
        ("edit", {"edits": [{"edit": "remove", "x": "y" * 300_000}]}, 413, "larger than 262,144 bytes"),
    ],
)
def test_studio_rejects_invalid_requests(studio_url, path, body, status, message):
    session = open_session(studio_url)
    post_request(session, studio_url, "open", {"scene_id": "given-0"})
    answer = post_request(session, studio_url, path, body)
    assert answer.status_code == status and message in answer.text


def test_studio_rejects_foreign_pages_and_hosts(studio_url):
    session = open_session(studio_url)
    assert (
        session.post(f"{studio_url}api/undo", json={}).status_code == 403
    )  # a page of another origin cannot set this header
    assert requests.get(studio_url, headers={"host": "rebound.example"}).status_code == 421
    assert requests.get(f"{studio_url}api/state").status_code == 401  # the request has no cookie
    policy = session.get(studio_url).headers["content-security-policy"]
    assert "default-src 'self'" in policy


def test_studio_rejects_taken_port_and_missing_inputs(studio_files, tmp_path):
    from jobs.implementation.serve_studio import serve_studio
    from jobs.serve_studio import Config

    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        port = listener.getsockname()[1]
        with pytest.raises(ValueError, match=rf"--port {port}: .*choose another --port"):
            serve_studio(Config(str(studio_files / "model"), (str(studio_files / "tables"),), port=port))
    with pytest.raises(ValueError, match="no PrITTI pipeline here"):
        serve_studio(Config(str(tmp_path)))
    with pytest.raises(ValueError, match="holds no scenes"):
        serve_studio(Config(str(studio_files / "model"), (str(tmp_path),)))


def test_studio_names_unusable_datasets(studio_files, cluster):
    from jobs.implementation.serve_studio import serve_studio
    from jobs.serve_studio import Config

    tables = str(studio_files / "tables")
    with pytest.raises(ValueError, match=r"^scene 'given-0' is in \S+tables and in \S+tables; give one of these"):
        serve_studio(Config(str(studio_files / "model"), (tables, tables), port=0))
