"""A run's name stands for one set of options, unless nothing has come of it."""

import json

import pytest
from helpers import random_scene

from pipelines.runtime import storage
from pipelines.schema.run_guard import claim
from pipelines.schema.tables import Shard, rejects_table


def test_a_run_that_wrote_nothing_gives_its_name_free(tmp_path):
    root, first, second = str(tmp_path), {"steps": 0, "labels": ("low",)}, {"steps": 20, "labels": ("low",)}
    claim(root, "generated-a", "a", first)
    rejects = Shard(root, "generated-a", "generated", 0).path("rejects")
    storage.write_parquet(rejects_table([]), rejects)
    claim(root, "generated-a", "a", first)  # the same again keeps all
    assert storage.exists(rejects)
    claim(root, "generated-a", "a", second)
    assert not storage.exists(rejects)
    assert json.loads((tmp_path / "generated-a.json").read_text()) == {"steps": 20, "labels": ["low"]}


def test_a_run_with_scenes_or_parts_of_them_keeps_its_name(tmp_path):
    root = str(tmp_path)
    claim(root, "generated-a", "a", {"steps": 10})
    Shard(root, "generated-a", "generated", 0).write([random_scene()])
    with pytest.raises(
        ValueError, match=r"holds a run 'a' with steps=10, asked for 20; choose another --run or --output"
    ):
        claim(root, "generated-a", "a", {"steps": 20})
    claim(root, "generated-b", "b", {"edits": ["x" * 100]})
    parts = storage.join(root, "blocks", "b")
    storage.write_text("half a scene", storage.join(parts, "0000000", "block.bin"))
    with pytest.raises(ValueError, match="holds a run 'b' with other edits"):
        claim(root, "generated-b", "b", {"edits": []}, [parts])
    claim(root, "generated-b", "b", {"edits": []})
