"""Tests of the run guard: after a run has written scenes, its name can be reused only with the same options."""

import json

import pytest
from helpers import random_scene

from pipelines.runtime import storage
from pipelines.schema.conversion import make_rejects_table
from pipelines.schema.run_guard import guard_run
from pipelines.schema.tables import Shard


def test_run_guard_releases_name_of_empty_run(tmp_path):
    root, first, second = str(tmp_path), {"steps": 0, "labels": ("low",)}, {"steps": 20, "labels": ("low",)}
    guard_run(root, "generated-a", "a", first)
    rejects = Shard(root, "generated-a", "generated", 0).path("rejects")
    storage.write_parquet(make_rejects_table([]), rejects)
    guard_run(root, "generated-a", "a", first)  # with the same options, all files are kept
    assert storage.exists(rejects)
    guard_run(root, "generated-a", "a", second)
    assert not storage.exists(rejects)
    assert json.loads((tmp_path / "generated-a.json").read_text()) == {"steps": 20, "labels": ["low"]}


def test_run_guard_keeps_name_of_run_with_output(tmp_path):
    root = str(tmp_path)
    guard_run(root, "generated-a", "a", {"steps": 10})
    Shard(root, "generated-a", "generated", 0).write([random_scene()])
    with pytest.raises(
        ValueError, match=r"holds a run 'a' with steps=10, asked for 20; choose another --run or --output"
    ):
        guard_run(root, "generated-a", "a", {"steps": 20})
    guard_run(root, "generated-b", "b", {"edits": ["x" * 100]})
    parts = storage.join_uri(root, "blocks", "b")
    storage.write_text("half a scene", storage.join_uri(parts, "0000000", "block.bin"))
    with pytest.raises(ValueError, match="holds a run 'b' with other edits"):
        guard_run(root, "generated-b", "b", {"edits": []}, [parts])
    guard_run(root, "generated-b", "b", {"edits": []})
