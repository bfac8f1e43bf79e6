"""The studio: a real Ray Serve, a real model of random weights, and a browser that does what a person would."""

import io
import json
import socket
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import requests
from browser import faults, start_browser, wait_for
from PIL import Image
from scenes import random_scene, small_spec, tiny_pipeline

from models.composition.extend import extended, grown, inpainting, region_blocks, windows
from models.composition.inpaint import polygon_region
from models.pipeline import Resampling
from models.scene import CATEGORY_INDEX, Scene
from pipelines.io.mesh_import import scene_from_glb
from pipelines.schema.tables import Shard, read_scenes

SPEC = small_spec()
POST = {"x-studio": "1"}
CAR = CATEGORY_INDEX["vehicle_small"]


def given_scene(number: int) -> Scene:
    """Three cars on ground, on the model's grid."""
    scene = random_scene(number, 3, grid=SPEC.grid, tilt_rad=0, vegetation_density="low")
    center_m = np.array([[12, 0, 0.5], [30, 4, 0.5], [50, -6, 0.5]], np.float32)
    size_m = np.tile(np.array([[4.2, 1.8, 1.5]], np.float32), (3, 1))
    rotation = np.tile(np.eye(3, dtype=np.float32), (3, 1, 1))
    occupied = np.ones_like(scene.occupied)
    boxes = {"center_m": center_m, "size_m": size_m, "rotation": rotation, "category": np.full(3, CAR, np.int8)}
    return replace(scene, scene_id=f"given-{number}", occupied=occupied, label=None, **boxes)


# --------------------------------------------------------------------------------------------------- extended scenes


@pytest.mark.parametrize("side", ["ahead", "behind", "left", "right"])
def test_a_scene_grows_to_a_side_and_what_was_there_stays(side):
    pipeline, scene, quick = tiny_pipeline(SPEC), given_scene(1), Resampling(4, 2, 1)
    once = extended(pipeline, scene, side, "low", resampling=quick)
    assert once.grid == grown(scene.grid, side, SPEC.grid.rows // 2)
    twice = extended(pipeline, once, side, "low", seed=1, resampling=quick)
    turned = extended(pipeline, twice, "left" if side in ("ahead", "behind") else "ahead", "low", resampling=quick)
    assert len(list(windows(turned.grid, side, SPEC.grid, 16))) == 2
    for larger in (once, twice, turned):
        kept = larger.cropped(scene.grid)
        assert np.array_equal(kept.occupied, scene.occupied) and np.array_equal(kept.height_m, scene.height_m)
        assert np.array_equal(larger.center_m[:3], scene.center_m)
    again = extended(pipeline, scene, side, "low", resampling=quick)
    assert np.array_equal(again.center_m, once.center_m) and np.array_equal(again.height_m, once.height_m)
    with pytest.raises(ValueError, match="side 'up', expected one of: ahead"):
        extended(pipeline, scene, "up", "low")
    with pytest.raises(ValueError, match="is smaller than a block"):
        extended(pipeline, scene.cropped(replace(SPEC.grid, rows=16)), "ahead", "low")


@pytest.mark.parametrize("contents", ["both", "objects", "ground"])
def test_a_region_of_a_larger_scene_is_made_anew_and_nothing_else(contents):
    pipeline, quick = tiny_pipeline(SPEC), Resampling(4, 2, 1)
    scene = extended(pipeline, given_scene(1), "ahead", "low", resampling=quick)
    scene = extended(pipeline, scene, "left", "low", resampling=quick)
    for corners_m, least in (
        ([(70, 20), (80, 20), (80, 30), (70, 30)], 1),
        ([(2, -30), (94, -30), (94, 60), (2, 60)], 4),
    ):
        region = polygon_region(scene.grid, corners_m)
        parts = region_blocks(pipeline, scene, region)
        count, inside = np.zeros(region.shape, int), np.zeros_like(region)
        for window, part in parts:
            count[scene.grid.shared(window)[0]] += part
        inside[count > 0] = True
        assert len(parts) >= least and count.max() == 1 and (inside | ~region).all()
        calls = []
        *_, last = inpainting(
            pipeline, scene, region, "low", contents, indices=(0, 7), resampling=quick,
            callback_on_step_end=lambda _, number, __, kept, calls=calls: calls.append(number) or kept,
        )  # fmt: skip
        new, other = last.canvases
        assert len(calls) == len(parts) * quick.evaluations
        changed = (new.height_m != scene.height_m) | (new.occupied != scene.occupied)
        assert not changed[:, ~inside].any() and changed.any() == (contents != "objects")
        assert (new.height_m != other.height_m).any() == (contents != "objects")
        row, col = scene.grid.pixel(*scene.center_m[:, :2].T)
        kept = scene.center_m[~inside[row, col] | (contents == "ground")]
        assert np.array_equal(new.center_m[: len(kept)], kept)
    # On a scene of the model's own size it is the pipeline's inpainting.
    scene = given_scene(2)
    region = polygon_region(scene.grid, [(20, -10), (40, -10), (40, 10), (20, 10)])
    *_, last = inpainting(pipeline, scene, region, "low", contents, resampling=quick)
    one = last.canvases[0]
    assert np.array_equal(
        one.height_m, pipeline.inpaint([scene], [region], ["low"], contents, resampling=quick)[0].height_m
    )


# ----------------------------------------------------------------------------------------------------------- served


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


@pytest.fixture(scope="module")
def tables(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("studio")
    Shard(str(root / "tables"), "town", "test", 0).write([given_scene(k) for k in range(3)])
    tiny_pipeline(SPEC).save_pretrained(root / "model")
    return root


@pytest.fixture(scope="module")
def address(tables, cluster) -> str:
    from ray import serve as ray_serve

    from jobs.implementation.serve_studio import serve
    from jobs.serve_studio import Config

    yield serve(Config(str(tables / "model"), (str(tables / "tables"),), port=free_port(), num_threads=1))
    ray_serve.shutdown()


def visitor(address: str) -> requests.Session:
    session = requests.Session()
    assert session.get(address).status_code == 200 and "studio" in session.cookies
    return session


def finished(session: requests.Session, address: str) -> dict:
    for _ in range(600):
        work = session.get(f"{address}api/work").json()
        if work["finished"]:
            return work
        time.sleep(0.05)
    raise AssertionError(work)


def post(session: requests.Session, address: str, path: str, body: dict) -> requests.Response:
    return session.post(f"{address}api/{path}", json=body, headers=POST)


def test_visitors_have_scenes_of_their_own_and_every_step_back(address):
    one, other = visitor(address), visitor(address)
    state = post(one, address, "open", {"scene_id": "given-1"}).json()
    assert state["scene"]["scene_id"] == "given-1" and len(state["scene"]["primitives"]) == 3
    assert other.get(f"{address}api/state").json()["scene"] is None
    move = {"edit": "translate", "select": {"primitives": [1]}, "by_m": [2, 0, 0]}
    state = post(one, address, "edit", {"edits": [move, {"edit": "remove", "select": {"primitives": [0]}}]}).json()
    assert [p["center_m"][0] for p in state["scene"]["primitives"]] == [32, 50] and len(state["edits"]) == 2
    assert one.get(f"{address}scene.json").json() == state["edits"]
    assert len(post(one, address, "undo", {}).json()["scene"]["primitives"]) == 3
    assert len(post(one, address, "redo", {}).json()["scene"]["primitives"]) == 2
    glb = one.get(f"{address}scene.glb")
    assert "given-1.glb" in glb.headers["content-disposition"] and glb.content[:4] == b"glTF"
    assert one.get(f"{address}api/scenes?text=given-2").json()["total"] == 1


def test_long_work_says_how_far_it_is_and_can_be_cancelled(address):
    session = visitor(address)
    state = post(session, address, "generate", {"label": "high", "seed": 3, "steps": 5, "sampler": "ddpm"}).json()
    assert state["work"]["total"] == 5
    assert finished(session, address)["done"] == 5
    first = session.get(f"{address}api/state").json()["scene"]
    post(session, address, "generate", {"steps": 1000, "sampler": "ddpm"})
    busy = post(session, address, "edit", {"edits": [{"edit": "remove", "select": {"primitives": [0]}}]})
    assert busy.status_code == 409 and "is at work" in busy.json()["detail"]
    assert post(session, address, "generate", {}).status_code == 429
    post(session, address, "cancel", {})
    work = finished(session, address)
    assert work["cancelled"] and work["done"] < 1000 and not work["error"]
    assert session.get(f"{address}api/state").json()["scene"] == first
    square = {"polygon_m": [[10, -10], [40, -10], [40, 10], [10, 10]], "steps": 4, "resamplings": 1}
    post(session, address, "inpaint", square | {"contents": "objects"})
    assert not finished(session, address)["error"]
    made = session.get(f"{address}api/state").json()
    assert made["undo"] == "generate high, seed 3" or made["undo"] == "inpaint objects"
    assert made["scene"]["ground"] == first["ground"]  # objects only
    post(session, address, "extend", {"side": "ahead", "steps": 4, "resamplings": 1})
    assert not finished(session, address)["error"]
    assert session.get(f"{address}api/state").json()["scene"]["grid"]["rows"] == 48


@pytest.mark.parametrize(
    "path, body, status, said",
    [
        ("open", {"scene_id": "../../etc"}, 400, "no scene"),
        ("generate", {"label": "dense"}, 400, "label 'dense' is unknown"),
        ("generate", {"steps": 0}, 422, "greater than or equal to 1"),
        ("generate", {"step": 5}, 422, "Extra inputs"),
        ("edit", {"edits": [{"edit": "explode"}]}, 400, "expected one of: remove"),
        ("edit", {"edits": [{"edit": "remove", "select": {"where": "true"}}]}, 400, "conditions in SQL are for jobs"),
        ("edit", {"edits": [{"edit": "remove", "select": {"primitives": [99]}}]}, 400, "has 3 primitives"),
        ("inpaint", {"polygon_m": [[900, 0], [901, 0], [900, 1]]}, 400, "holds no pixel"),
        ("extend", {"side": "up"}, 422, "ahead"),
        ("edit", {"edits": [{"edit": "remove", "x": "y" * 300_000}]}, 413, "too large"),
    ],
)
def test_what_cannot_be_done_is_said(address, path, body, status, said):
    session = visitor(address)
    post(session, address, "open", {"scene_id": "given-0"})
    answer = post(session, address, path, body)
    assert answer.status_code == status and said in answer.text


def test_other_pages_and_other_names_get_nothing(address):
    session = visitor(address)
    assert session.post(f"{address}api/undo", json={}).status_code == 403  # no page elsewhere can set our header
    assert requests.get(address, headers={"host": "rebound.example"}).status_code == 421
    assert requests.get(f"{address}api/state").status_code == 400  # no cookie
    policy = session.get(address).headers["content-security-policy"]
    assert "default-src 'self'" in policy


def test_with_a_token_nobody_enters_without_it(tables):
    """The same interface without Ray, on any address."""
    from starlette.testclient import TestClient

    from pipelines.studio.session import Studio, studio_app

    studio = Studio(str(tables / "model"), [])
    client = TestClient(studio_app(lambda: studio, "secret", ()), base_url="http://studio.example")
    assert client.get("/").status_code == 401 and client.get("/?token=wrong").status_code == 401
    assert client.get("/?token=secret").status_code == 200
    assert client.get("/api/about").json()["labels"] == ["low", "medium", "high"]  # the cookie bears it from now on


def test_a_taken_port_and_a_missing_model_are_said_at_once(tables, tmp_path):
    from jobs.implementation.serve_studio import serve
    from jobs.serve_studio import Config

    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        port = listener.getsockname()[1]
        with pytest.raises(ValueError, match=rf"--port {port}: .*choose another --port"):
            serve(Config(str(tables / "model"), (str(tables / "tables"),), port=port))
    with pytest.raises(ValueError, match="no PrITTI pipeline here"):
        serve(Config(str(tmp_path)))
    with pytest.raises(ValueError, match="no scenes there"):
        serve(Config(str(tables / "model"), (str(tmp_path),)))


def test_a_person_generates_moves_inpaints_undoes_and_downloads(address, tables):
    browser = start_browser()
    try:
        browser.get(address)
        wait_for(browser, "document.body.dataset.ready === 'yes'")
        assert len(browser.find_elements("css selector", "#list button")) == 3
        browser.find_element("css selector", "#list button").click()
        wait_for(browser, "document.body.dataset.shown.startsWith('given-')")
        time.sleep(0.5)
        shown = np.asarray(Image.open(io.BytesIO(browser.find_element("id", "view").screenshot_as_png)).convert("RGB"))
        assert len(np.unique(shown.reshape(-1, 3), axis=0)) > 100

        view = browser.find_element("id", "view")
        from selenium.webdriver.common.action_chains import ActionChains

        picked = ""
        for y in range(-200, 250, 25):  # look for a car
            for x in range(-300, 300, 30):
                ActionChains(browser).move_to_element_with_offset(view, x, y).click().perform()
                picked = browser.find_element("id", "picked").text
                if ": vehicle small" in picked:
                    break
            if ": vehicle small" in picked:
                break
        number = int(picked.split(":")[0])
        browser.find_element("css selector", "[data-edit=ahead]").click()
        wait_for(browser, "document.body.dataset.shown.endsWith('/open given-0') === false")
        wait_for(browser, "document.getElementById('undo').title === 'translate'")
        moved = json.loads(browser.execute_script("return (await (await fetch('/api/state')).text())"))
        (given,) = [s for s in read_scenes(str(tables / "tables")) if s.scene_id == moved["scene"]["scene_id"]]
        assert moved["scene"]["primitives"][number]["center_m"][0] == pytest.approx(given.center_m[number, 0] + 1)

        browser.execute_script("document.getElementById('steps').value = 3")
        drawn = browser.find_element("id", "map")
        browser.execute_script("arguments[0].scrollIntoView()", drawn)
        way = ActionChains(browser).move_to_element_with_offset(drawn, -60, -60).click_and_hold()
        for x, y in ((60, -60), (60, 60), (-60, 60)):
            way = way.move_to_element_with_offset(drawn, x, y)
        way.release().perform()
        wait_for(browser, "!document.getElementById('inpaint').disabled")
        browser.find_element("id", "inpaint").click()
        wait_for(browser, "document.body.dataset.work === 'done'")
        wait_for(browser, "document.getElementById('undo').title === 'inpaint both'")
        browser.find_element("id", "undo").click()
        wait_for(browser, "document.getElementById('redo').title === 'inpaint both'")
        glb = bytes(
            browser.execute_script(
                "return Array.from(new Uint8Array(await (await fetch(document.getElementById('glb').href)).arrayBuffer()))"
            )
        )
        path = tables / "downloaded.glb"
        path.write_bytes(glb)
        scene = scene_from_glb(str(path), "downloaded")
        assert len(scene) == 3 and scene.center_m[number, 0] == pytest.approx(given.center_m[number, 0] + 1, abs=1e-4)
        assert not faults(browser)
    finally:
        browser.quit()
