"""Test of jobs/simulate_traffic.py on Ray with SUMO."""

import json
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest

from models.scene import Grid
from pipelines.preprocess.sources.town.version2.town import make_large_crops
from pipelines.schema.tables import Shard
from pipelines.traffic.sumo import find_sumo

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(find_sumo() is None, reason="needs SUMO (extra traffic)"),
]


def test_job_writes_tables_page_and_videos_and_resumes(cluster, tmp_path):
    from jobs.implementation.simulate_traffic import main
    from jobs.simulate_traffic import Config

    grid = Grid(128.0, 64.0, 0.5, 256, 256)
    scenes = [replace(scene, split="test") for scene in make_large_crops(1_000_001, 2, grid)]
    empty = replace(scenes[0], scene_id="no-road", occupied=np.zeros_like(scenes[0].occupied))
    Shard(str(tmp_path), "town", "test", 0).write([*scenes, empty])
    config = Config(input=str(tmp_path), duration_s=40.0, num_examples=1)
    main(config)
    shard = Shard(str(tmp_path), "town", "test", 0)
    tracks, traffic = (pq.ParquetFile(shard.path(table)).read() for table in ("tracks", "traffic"))
    rows = traffic.to_pylist()
    assert [(row["scene_id"], row["control"]) for row in rows] == [
        (scene.scene_id, control) for scene in (*scenes, empty) for control in (False, True)
    ]
    assert all(row["failure"] and row["inserted"] is None for row in rows[4:])
    for row in rows[:4:2]:
        assert row["failure"] is None and row["arrived"] >= 0.95 * row["inserted"] > 10 and row["collisions"] == 0
    assert set(tracks["scene_id"].to_pylist()) == {scene.scene_id for scene in scenes}
    x_m, y_m = (tracks[name].to_numpy() for name in ("x_m", "y_m"))
    assert x_m.min() > -10 and x_m.max() < 138 and np.abs(y_m).max() < 74
    page = (tmp_path / "traffic.html").read_text()
    assert "Health of the road network" in page and "has no road" in page
    assert len(list((tmp_path / "traffic_videos").iterdir())) == 1
    main(replace(config, num_examples=0))  # Without moving pictures, the job still writes its page.
    assert json.loads((tmp_path / "traffic-town-test.json").read_text())["seed"] == 0
    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.parquet")}
    main(config)
    assert times == {path: path.stat().st_mtime_ns for path in times}
    with pytest.raises(ValueError, match="holds traffic with seed=0, asked for 1; choose another --output"):
        main(replace(config, seed=1))
    Shard(str(tmp_path), "generated-other", "generated", 0).write([replace(scenes[0], scene_id="other")])
    main(replace(config, source="generated-other", seed=1, control=False))  # Other sources have their own options.
    assert Shard(str(tmp_path), "generated-other", "generated", 0).read("traffic").num_rows == 1
