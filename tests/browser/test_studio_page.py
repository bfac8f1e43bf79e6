"""Tests of the studio in a browser."""

import io
import json
import time

import numpy as np
import pytest
from PIL import Image
from selenium.webdriver.common.action_chains import ActionChains

from pipelines.io.mesh_import import import_glb
from pipelines.schema.tables import read_scenes


def test_studio_page_edits_inpaints_undoes_and_downloads(studio_url, studio_files, browser, tmp_path):
    browser.get(studio_url)
    browser.wait_for("document.body.dataset.ready === 'yes'")
    assert len(browser.find_elements("css selector", "#list button")) == 3
    browser.find_element("css selector", "#list button").click()
    browser.wait_for("document.body.dataset.shown.startsWith('given-')")
    time.sleep(0.5)
    shown = np.asarray(Image.open(io.BytesIO(browser.find_element("id", "view").screenshot_as_png)).convert("RGB"))
    assert len(np.unique(shown.reshape(-1, 3), axis=0)) > 100

    browser.wait_for("!document.getElementById('play').hidden")
    frozen = browser.find_element("id", "view").screenshot_as_png
    browser.find_element("id", "play").click()
    browser.wait_for("Number(document.body.dataset.time) > 1 && Number(document.body.dataset.time) < 5")
    assert browser.find_element("id", "view").screenshot_as_png != frozen
    browser.find_element("id", "play").click()
    browser.wait_for("document.getElementById('play').textContent.includes('Traffic')")

    view = browser.find_element("id", "view")
    picked = ""
    for y in range(-200, 250, 25):  # click until a car is selected
        for x in range(-300, 300, 30):
            ActionChains(browser).move_to_element_with_offset(view, x, y).click().perform()
            picked = browser.find_element("id", "picked").text
            if ": vehicle small" in picked:
                break
        if ": vehicle small" in picked:
            break
    number = int(picked.split(":")[0])
    browser.find_element("css selector", "[data-edit=ahead]").click()
    browser.wait_for("document.body.dataset.shown.endsWith('/open given-0') === false")
    browser.wait_for("document.getElementById('undo').title === 'translate'")
    moved = json.loads(browser.execute_script("return (await (await fetch('/api/state')).text())"))
    (given,) = [s for s in read_scenes(str(studio_files / "tables")) if s.scene_id == moved["scene"]["scene_id"]]
    assert moved["scene"]["primitives"][number]["center_m"][0] == pytest.approx(given.center_m[number, 0] + 1)

    browser.execute_script("document.getElementById('steps').value = 3")
    drawn = browser.find_element("id", "map")
    browser.execute_script("arguments[0].scrollIntoView()", drawn)
    way = ActionChains(browser).move_to_element_with_offset(drawn, -60, -60).click_and_hold()
    for x, y in ((60, -60), (60, 60), (-60, 60)):
        way = way.move_to_element_with_offset(drawn, x, y)
    way.release().perform()
    browser.wait_for("!document.getElementById('inpaint').disabled")
    browser.find_element("id", "inpaint").click()
    browser.wait_for("document.body.dataset.work === 'done'")
    browser.wait_for("document.getElementById('undo').title === 'inpaint both'")
    browser.find_element("id", "undo").click()
    browser.wait_for("document.getElementById('redo').title === 'inpaint both'")
    glb = bytes(
        browser.execute_script(
            "return Array.from(new Uint8Array(await (await fetch(document.getElementById('glb').href)).arrayBuffer()))"
        )
    )
    path = tmp_path / "downloaded.glb"
    path.write_bytes(glb)
    scene = import_glb(str(path), "downloaded")
    assert len(scene) == 3 and scene.center_m[number, 0] == pytest.approx(given.center_m[number, 0] + 1, abs=1e-4)
    assert not browser.console_errors()
