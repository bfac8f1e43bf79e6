"""Tests of pictures and of the dataset report from Ray tasks."""

import base64
import io
from pathlib import Path

import numpy as np
from helpers import SvgPage
from PIL import Image

from jobs.implementation.inspect_scenes import draw_sheet, write_dataset_report
from jobs.inspect_scenes import Report, Sheet
from pipelines.rendering.render import render_3d, render_bev
from pipelines.reporting.contact_sheet import View, paint_scene
from pipelines.reporting.scene_index import Catalogue
from pipelines.schema.tables import Shard


def test_paint_tasks_equal_direct_rendering(cluster, town_dataset, tmp_path):
    catalogue = Catalogue.read(town_dataset)
    chosen = np.array([11, 0, 4, 6])
    painted = paint_scene(catalogue, chosen, (View("bev", 96), View("3d", 80)))
    names = catalogue.column("scene_id")
    scenes = {s.scene_id: s for shard in catalogue.shards for s in shard.scenes()}
    for k, (above, oblique) in zip(chosen, painted, strict=True):
        assert np.array_equal(above, render_bev(scenes[names[k]], 96, supersample=2))
        assert np.array_equal(oblique, render_3d(scenes[names[k]], 80, 60))
    config = Sheet(
        dataset=town_dataset, split="train", sort="vegetation", size_px=96, output=str(tmp_path / "sheet.png")
    )
    sheet = np.asarray(Image.open(draw_sheet(config)))
    order = Catalogue.read(town_dataset, split="train").choose(8, "vegetation")
    picture = render_bev(
        scenes[Catalogue.read(town_dataset, split="train").column("scene_id")[order[0]]], 96, supersample=2
    )
    inside = np.lib.stride_tricks.sliding_window_view(sheet[:, :, 0], (94, 94))[:200, :60]
    assert (
        (inside == picture[1:-1, 1:-1, 0]).all(axis=(2, 3)).any()
    )  # the first picture of the sheet, without its frame


def test_report_job_shows_scenes(cluster, town_dataset, tmp_path):
    path = write_dataset_report(
        Report(dataset=town_dataset, source="town", split="test", num_examples=2, output=str(tmp_path / "p.html"))
    )
    page = SvgPage(Path(path).read_text("utf-8"))
    images = page.all("img")
    assert len(images) == 4 and all(image["src"].startswith("data:image/") for image in images)
    shown = np.asarray(Image.open(io.BytesIO(base64.b64decode(images[2]["src"].split(",")[1]))).convert("RGB"))
    catalogue = Catalogue.read(town_dataset, "town", "test")
    k = catalogue.choose(2, "vegetation")[0]
    want = render_bev(Shard(town_dataset, "town", "test", 0).scenes([int(catalogue.row[k])])[0], 384, supersample=2)
    assert shown.shape == want.shape and np.abs(shown.astype(int) - want).mean() < 4
