"""The name of a run is bound to its options as soon as the run has written scenes."""

import json

import pytest
from helpers import random_scene

from pipelines.runtime import storage
from pipelines.schema.run_guard import claim
from pipelines.schema.tables import Shard, rejects_table


def test_run_guard_releases_name_of_empty_run(tmp_path):
    root, first, second = str(tmp_path), {"steps": 0, "labels": ("low",)}, {"steps": 20, "labels": ("low",)}
    claim(root, "generated-a", "a", first)
    rejects = Shard(root, "generated-a", "generated", 0).path("rejects")
    storage.write_parquet(rejects_table([]), rejects)
    claim(root, "generated-a", "a", first)  # the same options keep everything
    assert storage.exists(rejects)
    claim(root, "generated-a", "a", second)
    assert not storage.exists(rejects)
    assert json.loads((tmp_path / "generated-a.json").read_text()) == {"steps": 20, "labels": ["low"]}


def test_run_guard_keeps_name_of_run_with_output(tmp_path):
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
