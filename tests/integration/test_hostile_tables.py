"""Tests that hostile ids and damaged shards in tables of others cannot harm jobs that read them."""

import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from helpers import studio_scene

from pipelines.runtime import storage
from pipelines.schema.conversion import make_scene_tables
from pipelines.schema.tables import Shard

ESCAPE = "../../../escaped"
SCRIPT = "<!--<script>alert(1)</script>"


def list_files(root: Path) -> set[str]:
    return {str(Path(folder, name).relative_to(root)) for folder, _, names in os.walk(root) for name in names}


@pytest.fixture
def hostile(tmp_path) -> Path:
    """Dataset in a deep folder with three scenes with hostile ids, one per shard, and one damaged shard."""
    root = tmp_path / "a/b/c/tables"
    for number, scene_id in enumerate((ESCAPE, SCRIPT, "/etc/cron.d/x")):
        Shard(str(root), "town", "test", number).write([replace(studio_scene(number), scene_id=scene_id)])
    damaged = Shard(str(root), "town", "test", 3)
    damaged.write([studio_scene(3)])
    primitives = make_scene_tables([studio_scene(3)])["primitives"].slice(1)
    storage.write_parquet(primitives, damaged.path("primitives"))
    return root


def test_ids_of_scenes_write_no_file_outside_output(hostile, tmp_path, cluster, capsys):
    from jobs.implementation.inspect_scenes import draw_scenes
    from jobs.inspect_scenes import OneScene
    from pipelines.io.export import export_scenes
    from pipelines.schema.scene_subset import SceneSubset

    before = list_files(tmp_path)
    output = tmp_path / "a/b/c/out/deep"
    written = draw_scenes(OneScene(dataset=str(hostile), max_scenes=4, output=str(output), glb=True))
    assert len(written) == 6 and "left out: " in (shown := capsys.readouterr().err) and "part-00003" in shown
    for number in range(3):
        shard = Shard(str(hostile), "town", "test", number)
        for table in ("scenes", "primitives", "rasters"):
            one = Shard(str(tmp_path / f"a/b/c/one-{number}"), "town", "test", 0)
            Path(one.path(table)).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(shard.path(table), one.path(table))
        counts, _ = export_scenes(SceneSubset(one.root), ["glb", "npz"], str(output / "exports"))
        assert counts["glb"] == 1
    made = list_files(tmp_path) - before
    assert {name.split("/")[3] for name in made} <= {"out", "one-0", "one-1", "one-2"}
    assert sum(name.endswith(".glb") for name in made) == 6


def test_gallery_shows_valid_scenes_with_any_id(hostile, tmp_path, cluster, capsys):
    from jobs.implementation.inspect_scenes import write_gallery
    from jobs.inspect_scenes import Gallery

    page = Path(write_gallery(Gallery(dataset=str(hostile), output=str(tmp_path / "gallery.html")))).read_text()
    assert "part-00003" in capsys.readouterr().err
    data = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)
    assert data is not None and "<" not in data[1]
    ids = {entry["values"]["scene_id"] for entry in json.loads(data[1])["scenes"]}
    assert ids == {ESCAPE, SCRIPT, "/etc/cron.d/x"}
    assert page.count("<script") == 2


def test_gallery_of_only_damaged_shards_is_an_error(hostile, cluster):
    from jobs.implementation.inspect_scenes import write_gallery
    from jobs.inspect_scenes import Gallery

    for number in range(3):
        os.remove(Shard(str(hostile), "town", "test", number).path("scenes"))
    with pytest.raises(
        ValueError, match=r"part-00003\.parquet: primitives has 2 rows, but the scenes of the shard have 3"
    ):
        write_gallery(Gallery(dataset=str(hostile)))
