"""Tests of the web export: the web viewer receives the same scene as in the tables."""

import base64
import io

import numpy as np
from PIL import Image

from pipelines.io.web_export import export_web_scene
from pipelines.schema.palette import CLASS_COLORS, list_ground_ids


def test_web_scene_equals_scene(gallery_scenes):
    scene, content = gallery_scenes[0], export_web_scene(gallery_scenes[0])
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
    assert np.array_equal(pixels[winner >= 0][:, :3], CLASS_COLORS[list_ground_ids(scene)[winner[winner >= 0]]])
