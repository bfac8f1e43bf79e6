"""The gallery: one file that holds everything it shows, and says of each scene what the tables say."""

import base64
import gzip
import io
import json
import re
import time
from pathlib import Path

import numpy as np
import pytest
from browser import faults, start_browser, wait_for
from PIL import Image

from models.scene import Scene
from pipelines.io.web_export import web_scene
from pipelines.preprocess.sources.town.generator import town_drive
from pipelines.schema.palette import CLASS_COLORS, ground_ids
from pipelines.schema.tables import Shard, read_scenes


@pytest.fixture(scope="module")
def town_scenes() -> list[Scene]:
    drive = town_drive(3)
    return [drive.scene(k, "test") for k in (0, 20, 40)]


@pytest.fixture(scope="module")
def page(town_scenes, tmp_path_factory, cluster) -> Path:
    from jobs.implementation.inspect_scenes import write_gallery
    from jobs.inspect_scenes import Gallery

    root = tmp_path_factory.mktemp("gallery")
    Shard(str(root), "town", "test", 0).write(town_scenes)
    return Path(write_gallery(Gallery(dataset=str(root), title="Three <scenes>", output=str(root / "gallery.html"))))


def test_the_viewer_gets_the_scene(town_scenes):
    scene, content = town_scenes[0], web_scene(town_scenes[0])
    assert len(content["primitives"]) == len(scene)
    for index, primitive in enumerate(content["primitives"]):
        assert np.allclose(primitive["center_m"], scene.center_m[index], atol=1e-3)
        assert np.allclose(np.reshape(primitive["rotation"], (3, 3)), scene.rotation[index], atol=1e-5)
        assert np.allclose(primitive["size_m"], scene.size_m[index], atol=1e-3)
    ground = content["ground"]
    height_m, winner = scene.surface()
    assert len(ground["height_cm"]) == ground["rows"] * ground["cols"] == 65 * 65
    nodes_m = np.reshape(ground["height_cm"], (65, 65)) / 100
    inner = nodes_m[1:-1, 1:-1]
    known = winner[3::4, 3::4][: inner.shape[0], : inner.shape[1]] >= 0
    assert np.median(np.abs(inner - height_m[3::4, 3::4][:63, :63])[known]) < 0.03
    picture = Image.open(io.BytesIO(base64.b64decode(ground["picture"].split(",")[1]))).convert("RGBA")
    pixels = np.asarray(picture)
    assert np.array_equal(pixels[..., 3] > 0, winner >= 0)
    assert np.array_equal(pixels[winner >= 0][:, :3], CLASS_COLORS[ground_ids(scene)[winner[winner >= 0]]])


def test_the_page_holds_all_it_shows(page, town_scenes):
    text = page.read_text()
    assert "Three &lt;scenes&gt;" in text
    assert not re.search(r'(src|href)="(?!data:)', text) and "http" not in re.sub(r"http://www.w3.org\S*", "", text)
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)[1])
    assert [entry["values"]["scene_id"] for entry in data["scenes"]] == [scene.scene_id for scene in town_scenes]
    for entry, scene in zip(data["scenes"], read_scenes(str(page.parent)), strict=True):
        assert entry["values"]["num_primitives"] == len(scene)
        assert json.loads(gzip.decompress(base64.b64decode(entry["packed"]))) == web_scene(scene)
        assert entry["picture"].startswith("data:image/")
    assert data["order"][0] == "scene_id" and "num_pole" in data["order"] and "source" not in data["choices"]


@pytest.fixture(scope="module")
def browser():
    driver = start_browser()
    yield driver
    driver.quit()


def test_a_reader_filters_opens_and_picks(page, town_scenes, browser):
    browser.get(page.as_uri())
    assert browser.execute_script("return document.getElementById('count').textContent") == "3 of 3 scenes"
    fewest = min(len(scene) for scene in town_scenes)
    browser.execute_script(
        "const set = (id, value, event) => { const e = document.getElementById(id); e.value = value; e['on' + event](); };"
        "set('number', 'num_primitives', 'change'); set('high', arguments[0], 'input');",
        str(fewest),
    )
    assert browser.execute_script("return document.getElementById('count').textContent") == "1 of 3 scenes"
    browser.execute_script("document.querySelector('.card:not([hidden])').click()")
    scene = next(scene for scene in town_scenes if len(scene) == fewest)
    wait_for(browser, f"document.body.dataset.shown === '{scene.scene_id}'")
    time.sleep(0.5)
    canvas = browser.find_element("id", "view")
    shown = np.asarray(Image.open(io.BytesIO(canvas.screenshot_as_png)).convert("RGB"))
    assert len(np.unique(shown.reshape(-1, 3), axis=0)) > 500  # a lit scene, not a plain field
    picked = browser.execute_script(
        "const v = document.getElementById('view'), r = v.getBoundingClientRect();"
        "for (let y = 0.3; y < 0.9; y += 0.05) for (let x = 0.1; x < 0.9; x += 0.05) {"
        "  for (const kind of ['pointerdown', 'pointerup']) v.dispatchEvent(new PointerEvent(kind,"
        "    {pointerId: 1, button: 0, clientX: r.left + x * r.width, clientY: r.top + y * r.height}));"
        "  const said = document.getElementById('picked').textContent; if (/^[0-9]+:/.test(said)) return said; } return '';"
    )
    number = int(picked.split(":")[0])
    assert scene.label[number] in picked
    assert not [said for said in faults(browser) if "setPointerCapture" not in said]
