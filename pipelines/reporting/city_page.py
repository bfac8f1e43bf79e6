"""Render a city of tiles as an HTML page that loads the tiles near the point at which the camera looks.

The page needs no server and no installation: it opens as a file. Tiles are scripts in the directory `tiles` next to it,
and so are their views from afar, which the page shows where no tile is loaded.
"""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Mapping
from html import escape

from models.scene import Grid, Scene
from pipelines.io.web_export import export_web_overview, export_web_scene
from pipelines.rendering.render import render_bev
from pipelines.reporting.gallery_page import read_script
from pipelines.reporting.report_style import STYLE

MAX_REACH_M = 600.0  # Greatest distance from this point up to which tiles are loaded.
OVERVIEW_PIXEL_M = 2.0  # Side of a pixel of these pictures.


def pack_tile(name: str, scene: Scene) -> str:
    """Return the script of a tile.

    Args:
        name: Name of the tile.
        scene: Content of the tile in the frame of the city.

    Returns:
        Content of tiles/<name>.js.
    """
    return _pack_script("tile", name, export_web_scene(scene))


def pack_overview(name: str, scene: Scene) -> str:
    """Return the script with the view of a tile from afar.

    Args:
        name: Name of the tile.
        scene: Content of the tile in the frame of the city.

    Returns:
        Content of tiles/<name>-far.js.
    """
    grid = scene.grid
    picture = render_bev(scene, round(max(grid.rows, grid.cols) * grid.resolution_m / OVERVIEW_PIXEL_M))
    return _pack_script("overview", name, export_web_overview(scene, picture))


def _pack_script(function: str, name: str, content: dict) -> str:
    """Return a script that calls a function of city.js with a name and with packed JSON."""
    packed = base64.b64encode(gzip.compress(json.dumps(content, separators=(",", ":")).encode(), mtime=0)).decode()
    return f'{function}({json.dumps(name)}, "{packed}");\n'


def render_city_html(title: str, tiles: Mapping[str, Grid]) -> str:
    """Render the page.

    Args:
        title: Title of the page.
        tiles: Area of each tile in the frame of the city, by name.

    Returns:
        Content of the HTML file.

    Raises:
        ValueError: There is no tile.
    """
    if not tiles:
        raise ValueError("a page of a city needs at least one tile")
    bounds = {name: [grid.back_m, grid.right_m, grid.front_m, grid.left_m] for name, grid in tiles.items()}
    low = [min(box[k] for box in bounds.values()) for k in (0, 1)]
    high = [max(box[k] for box in bounds.values()) for k in (2, 3)]
    data = {
        "tiles": [{"name": name, "bounds_m": box} for name, box in bounds.items()],
        "bounds_m": [*low, *high],
        "start_m": [(a + b) / 2 for a, b in zip(low, high, strict=True)],
        "max_reach_m": MAX_REACH_M,
    }
    content = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")  # No tag can begin or end.
    return f"""<!doctype html><html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>{escape(title)}</title>
<style>{STYLE}{CITY_STYLE}</style></head><body>
<canvas id="view"></canvas>
<div id="bar"><strong>{escape(title)}</strong> {high[0] - low[0]:g} x {high[1] - low[1]:g} m, <span id="count"></span>
<button id="fly">fly</button>
<small>W A S D or arrows: move; Q, E: turn; drag: rotate; right button: shift; wheel: zoom</small></div>
<script type="application/json" id="data">{content}</script>
<script type="module">{read_script("viewer.js")}
{read_script("city.js")}</script></body></html>"""


CITY_STYLE = """
html, body { margin: 0; height: 100%; overflow: hidden; }
#view { width: 100%; height: 100%; display: block; cursor: grab; }
#bar { position: fixed; top: 12px; left: 12px; padding: 8px 14px; border-radius: 10px; background: var(--card); \
color: var(--ink); font-size: 14px; }
#bar button { font: inherit; padding: 2px 12px; } #bar small { color: var(--soft); }
"""
