"""Render a gallery of scenes as one self-contained HTML page, with a 3D view and filters.

The page needs no download and no installation. The page can be published as one file or sent by mail.
"""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Callable
from dataclasses import asdict
from html import escape
from importlib.resources import files
from itertools import chain

import numpy as np
import pyarrow as pa

from models.scene import CATEGORIES, GROUND_CLASSES
from pipelines.io.web_export import export_web_scene
from pipelines.rendering.render import render_bev
from pipelines.reporting.contact_sheet import CHUNK
from pipelines.reporting.report import encode_data_uri
from pipelines.reporting.report_style import STYLE
from pipelines.reporting.scene_index import Catalogue
from pipelines.schema.tables import Shard

THUMBNAIL_PX = 256
CHOICES = ("source", "split", "vegetation_density", "vehicle_density")
NUMBERS = ("num_primitives", "vegetation_volume_m3", "vehicle_volume_m3", *(f"num_{name}" for name in CATEGORIES))
NUMBERS += tuple(f"{name}_area_m2" for name in GROUND_CLASSES)
CAPTIONS = ("vegetation_density", "vehicle_density", "num_primitives")


def pack_scenes(row: dict) -> list[dict]:
    """Render the scenes that an input row lists, and pack them for the viewer.

    Args:
        row: Dictionary with a shard, rows of the shard, and the positions of the scenes in the result.

    Returns:
        One row per scene, with its position in the result, its picture and its viewer content.
    """
    shard = Shard(row["root"], row["source"], row["split"], row["number"])
    out = []
    for place, scene in zip(row["places"], shard.scenes(list(row["rows"])), strict=True):
        content = gzip.compress(json.dumps(export_web_scene(scene), separators=(",", ":")).encode(), mtime=0)
        out.append({"place": place, "picture": encode_data_uri(render_bev(scene, THUMBNAIL_PX, 2)), "packed": content})
    return out


def render_gallery_html(
    catalogue: Catalogue, indices: np.ndarray, title: str, on_scene: Callable[[], None] | None = None
) -> str:
    """Render the page; its size is about 35 kB per scene. Each Ray task converts up to CHUNK scenes of a shard."""
    from pipelines.runtime.ray_tasks import map_tasks

    tasks = [
        {**asdict(shard), "rows": rows, "places": places} for shard, rows, places in catalogue.chunks(indices, CHUNK)
    ]
    values = list_scene_values(catalogue, indices)
    scenes: list[dict] = [{}] * len(indices)
    for row in chain.from_iterable(map_tasks(pack_scenes, tasks)):
        scenes[row["place"]] = {
            "values": values[row["place"]],
            "picture": row["picture"],
            "packed": base64.b64encode(row["packed"]).decode(),
        }
        if on_scene:
            on_scene()
    order = [name for name in ("scene_id", *NUMBERS) if any(value[name] is not None for value in values)]
    choices = {name: sorted({value[name] for value in values} - {None}) for name in CHOICES}
    data = {
        "scenes": scenes,
        "order": order,
        "choices": {name: found for name, found in choices.items() if len(found) > 1},
        "captions": CAPTIONS,
    }
    return _render_page(title, f"{len(indices)} scenes", data)


def list_scene_values(catalogue: Catalogue, indices: np.ndarray) -> list[dict]:
    """Return the values that the page shows and uses as filters: a number, word or null per scene and column."""
    table = catalogue.scenes.take(pa.array(indices))
    names = [name for name in ("scene_id", *CHOICES, *NUMBERS) if name in table.column_names]
    rows = table.select(names).to_pylist()
    return [{k: round(v, 1) if isinstance(v, float) else v for k, v in row.items()} for row in rows]


def read_script(name: str) -> str:
    """Return a script of pipelines/web for use in an inline module."""
    return files("pipelines").joinpath("web", name).read_text(encoding="utf-8").replace("export class", "class")


def _render_page(title: str, subtitle: str, data: dict) -> str:
    content = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")  # No tag can begin or end.
    return f"""<!doctype html><html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>{escape(title)}</title>
<style>{STYLE}{GALLERY_STYLE}</style></head><body>
<header><h1>{escape(title)}</h1><p>{escape(subtitle)}</p></header>
<main><section id="filters">
<label>scene id <input id="text" type="search" placeholder="part of the id"></label><div id="choices"></div>
<label>filter by value <select id="number"></select></label>
<label>minimum <input id="low" type="number"></label><label>maximum <input id="high" type="number"></label>
<label>sort by <select id="sort"></select></label><button id="down" title="ascending or descending">↑</button>
<button id="clear">clear filters</button><strong id="count"></strong></section>
<div id="cards"></div></main>
<dialog id="dialog"><div class="bar"><strong id="name"></strong><span></span>
<button id="previous" title="previous scene">←</button><button id="next" title="next scene">→</button>\
<button id="close" title="close">✕</button></div>
<div class="both"><canvas id="view"></canvas><dl id="values"></dl></div><p id="picked"></p></dialog>
<script type="application/json" id="data">{content}</script>
<script type="module">{read_script("viewer.js")}
{read_script("gallery.js")}</script></body></html>"""


GALLERY_STYLE = """
#filters { display: flex; flex-wrap: wrap; gap: 12px 18px; align-items: end; padding: 18px 22px; }
#choices { display: contents; } #filters label { display: grid; gap: 2px; font-size: 13px; color: var(--soft); }
input, select, button { font: inherit; font-size: 15px; padding: 5px 10px; border: 1px solid var(--line); \
border-radius: 8px;
  background: var(--page); color: var(--ink); }
input[type=number] { width: 7em; } button { cursor: pointer; } button:hover { border-color: var(--accent); }
#count { margin-left: auto; font-weight: 500; color: var(--soft); }
#cards { display: grid; grid-template-columns: repeat(auto-fill, minmax(190px, 1fr)); gap: 16px; padding-bottom: 60px; }
.card { display: grid; gap: 4px; padding: 10px; text-align: left; background: var(--card); \
border-radius: 12px; overflow: hidden; }
.card[hidden] { display: none; } .card img { width: 100%; border-radius: 6px; background: white; }
.card span { font-size: 13px; overflow-wrap: anywhere; } .card small { color: var(--soft); }
dialog { width: min(1300px, 96vw); height: 92vh; padding: 0; border: 1px solid var(--line); border-radius: 16px;
  background: var(--card); color: var(--ink); overflow: hidden; }
dialog[open] { display: flex; flex-direction: column; } dialog::backdrop { background: #0008; }
.bar { display: flex; gap: 10px; align-items: center; padding: 10px 16px; } .bar span { flex: 1; }
.both { flex: 1; display: flex; min-height: 0; } \
#view { flex: 1; min-width: 0; width: 100%; height: 100%; cursor: grab; }
#values { width: 250px; margin: 0; padding: 0 18px; overflow: auto; font-size: 14px; }
#values dt { color: var(--soft); } \
#values dd { margin: 0 0 8px; font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
#picked { margin: 0; padding: 10px 16px; min-height: 2.6em; font-size: 14px; max-width: none; }
@media (max-width: 720px) { #values { display: none; } }
"""
