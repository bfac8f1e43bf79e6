"""Tests of the gallery page in a browser: filters, the 3D view and picking of objects."""

import io
import time

import numpy as np
from PIL import Image


def test_gallery_page_filters_opens_and_picks(gallery_page, gallery_scenes, browser):
    browser.get(gallery_page.as_uri())
    assert browser.execute_script("return document.getElementById('count').textContent") == "3 of 3 scenes"
    fewest = min(len(scene) for scene in gallery_scenes)
    browser.execute_script(
        "const set = (id, value, event) => {"
        " const e = document.getElementById(id); e.value = value; e['on' + event](); };"
        "set('number', 'num_primitives', 'change'); set('high', arguments[0], 'input');",
        str(fewest),
    )
    assert browser.execute_script("return document.getElementById('count').textContent") == "1 of 3 scenes"
    browser.execute_script("document.querySelector('.card:not([hidden])').click()")
    scene = next(scene for scene in gallery_scenes if len(scene) == fewest)
    browser.wait_for(f"document.body.dataset.shown === '{scene.scene_id}'")
    time.sleep(0.5)
    canvas = browser.find_element("id", "view")
    shown = np.asarray(Image.open(io.BytesIO(canvas.screenshot_as_png)).convert("RGB"))
    assert len(np.unique(shown.reshape(-1, 3), axis=0)) > 500  # the view shows a shaded scene
    picked = browser.execute_script(
        "const v = document.getElementById('view'), r = v.getBoundingClientRect();"
        "for (let y = 0.3; y < 0.9; y += 0.05) for (let x = 0.1; x < 0.9; x += 0.05) {"
        "  for (const kind of ['pointerdown', 'pointerup']) v.dispatchEvent(new PointerEvent(kind,"
        "    {pointerId: 1, button: 0, clientX: r.left + x * r.width, clientY: r.top + y * r.height}));"
        "  const text = document.getElementById('picked').textContent;"
        "  if (/^[0-9]+:/.test(text)) return text; } return '';"
    )
    number = int(picked.split(":")[0])
    assert scene.label[number] in picked
    assert not [message for message in browser.console_errors() if "setPointerCapture" not in message]
