"""Tests of the city page in a browser: tiles near the camera are loaded, and those far away are removed."""

import io

import numpy as np
from helpers import random_scene
from PIL import Image

from models.scene import Grid
from pipelines.reporting.city_page import pack_overview, pack_tile, render_city_html

SIDE_M = 128.0


def write_city(directory, count: int) -> None:
    """Write a page with a row of `count` tiles ahead of each other."""
    (directory / "tiles").mkdir()
    grids = {}
    for k in range(count):
        grid = Grid(front_m=(k + 1) * SIDE_M, left_m=SIDE_M / 2, resolution_m=2.0, rows=64, cols=64)
        scene = random_scene(k, n=60, grid=Grid(resolution_m=2.0, rows=64, cols=64, front_m=SIDE_M, left_m=SIDE_M / 2))
        name = f"{k:03d}-000"
        (directory / "tiles" / f"{name}.js").write_text(pack_tile(name, scene.translate(k * SIDE_M, 0)))
        (directory / "tiles" / f"{name}-far.js").write_text(pack_overview(name, scene.translate(k * SIDE_M, 0)))
        grids[name] = grid
    (directory / "index.html").write_text(render_city_html("A <long> city", grids))


def test_city_page_loads_near_tiles_and_flies(tmp_path, browser):
    write_city(tmp_path, 8)
    browser.set_window_size(500, 400)  # Software rendering of large pages is slow.
    browser.get((tmp_path / "index.html").as_uri())
    count = "document.getElementById('count').textContent"
    # The camera starts in the middle, at 512 m, with a reach of 360 m: all tiles but the first and the last.
    browser.wait_for(f"{count} === '6 of 8 tiles'")
    canvas = browser.find_element("id", "view")
    far = "document.getElementById('view').dataset.far"
    browser.wait_for(f"{far} === '2'")  # The first and the last tile are seen from afar.
    shown = np.asarray(Image.open(io.BytesIO(canvas.screenshot_as_png)).convert("RGB"))
    assert len(np.unique(shown.reshape(-1, 3), axis=0)) > 500  # the view shows a shaded scene
    browser.execute_script("document.getElementById('fly').click()")
    # The camera looks ahead and flies to the front border. There, it sees fewer tiles.
    browser.wait_for(f"parseInt({count}) < 6", 120)
    browser.wait_for(f"parseInt({far}) === 8 - parseInt({count})", 60)
    assert browser.execute_script("return document.getElementById('fly').textContent") == "stop"
    assert not browser.console_errors()
    assert browser.title == "A <long> city"
