"""Tests of the gallery page, which contains the data of all its scenes."""

import base64
import gzip
import json
import re

from pipelines.io.web_export import export_web_scene
from pipelines.schema.tables import read_scenes


def test_gallery_page_holds_all_its_data(gallery_page, gallery_scenes):
    text = gallery_page.read_text()
    assert "Three &lt;scenes&gt;" in text
    assert not re.search(r'(src|href)="(?!data:)', text) and "http" not in re.sub(r"http://www.w3.org\S*", "", text)
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)[1])
    assert [entry["values"]["scene_id"] for entry in data["scenes"]] == [scene.scene_id for scene in gallery_scenes]
    for entry, scene in zip(data["scenes"], read_scenes(str(gallery_page.parent)), strict=True):
        assert entry["values"]["num_primitives"] == len(scene)
        assert json.loads(gzip.decompress(base64.b64decode(entry["packed"]))) == export_web_scene(scene)
        assert entry["picture"].startswith("data:image/")
    assert data["order"][0] == "scene_id" and "num_pole" in data["order"] and "source" not in data["choices"]
