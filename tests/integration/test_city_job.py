"""Tests of jobs/evaluate_city.py on towns, which must score as well as other towns, and on damaged towns."""

import json
from dataclasses import replace

import duckdb
import numpy as np
import pytest

from jobs.evaluate_city import Config
from jobs.implementation.evaluate_city import evaluate_city
from jobs.implementation.preprocess_scenes import main as preprocess
from jobs.preprocess_scenes import Town
from models.scene import CATEGORY_INDEX
from pipelines.preprocess.sources.town.version2.town import make_large_scene
from pipelines.schema.tables import Shard

EXTENT_M = 192.0  # 3 x 3 windows.
BUILDING = CATEGORY_INDEX["construction_big"]


@pytest.fixture(scope="module")
def real(tmp_path_factory, cluster) -> str:
    root = tmp_path_factory.mktemp("town")
    preprocess(Town(num_train=24, num_test=48, town_version=2, free_pose_share=0.5, output=str(root)))
    return str(root)


def write_cities(root, run: str, damaged: bool) -> None:
    source = f"generated-{run}"
    for number in range(2):
        city = make_large_scene(500 + number, EXTENT_M)
        if damaged:  # Objects are 5 m away from their places, and buildings end 32 m from the centre.
            far = np.abs(city.center_m[:, :2] - [32, 0]).max(axis=1) > 32
            city = city.select(~(far & (city.category == BUILDING)))
            city = replace(city, center_m=city.center_m + np.array([5, 3, 0], np.float32))
        city = replace(city, scene_id=f"{run}-{number}", source=source, split="generated")
        Shard(str(root), source, "generated", number).write([city])
    record = {"overlap": 0.25, "num_blocks": [1, 1, 1, 1], "order": "colours"}
    (root / f"{source}.json").write_text(json.dumps(record))


@pytest.mark.slow
def test_towns_score_like_towns_and_damaged_ones_worse(real, tmp_path):
    for run, damaged in (("towns", False), ("bare", True)):
        write_cities(tmp_path / "cities", run, damaged)
    config = Config(
        generated=str(tmp_path / "cities"),
        run="towns",
        control_run="bare",
        real=real,
        num_towns=2,
        traffic=False,  # tests/unit/test_traffic.py runs SUMO.
        output=str(tmp_path / "city"),
    )
    scores = evaluate_city(config)
    assert scores["windows_per_set"] == 18 and list(scores["rings"]["generated"]) == ["0-1"]
    buildings = {side: found["all"]["construction_big_per_ha"]["value"] for side, found in scores["quantities"].items()}
    assert buildings["generated"] == pytest.approx(buildings["ceiling"], rel=0.35)
    assert buildings["control"] < 0.25 * buildings["generated"]
    frechet = {
        side: scores["rings"][side][group]["relation_frechet"]["value"]
        for side, group in (("generated", "0-1"), ("control", "0-1"), ("ceiling", "all"))
    }
    assert frechet["generated"] < 1.5 * frechet["ceiling"] and frechet["control"] > 1.5 * frechet["ceiling"]
    whole = scores["whole"]["generated"]
    assert whole["road_connectivity"]["value"] > 0.99 and whole["city_blocks_per_ha"] > 0.5
    assert 0 < whole["street_distance"]["all"]["value"] < 0.6
    assert set(whole["seams"]["all"]) == {"class_changes", "height_step", "cut_objects", "doubled_objects"}
    assert 0.7 < whole["seams"]["all"]["class_changes"]["value"] < 1.4  # A town has no seams there.
    page = (tmp_path / "city/city.html").read_text()
    assert "Whole cities" in page and page.count("<img") >= 25
    query = f"select side, count(*), avg(road_share) from '{tmp_path}/city/windows.parquet' group by side"
    counted = {side: (count, share) for side, count, share in duckdb.sql(query).fetchall()}
    assert counted["generated"][0] == 18 and 0.1 < counted["reference"][1] < 0.35


def test_unsuitable_cities_are_refused(real, tmp_path):
    with pytest.raises(ValueError, match="expected at least 2"):
        evaluate_city(Config(real=real, num_towns=1))
    with pytest.raises(ValueError, match="holds no scenes"):
        evaluate_city(Config(generated=str(tmp_path), run="none", real=real))
    small = replace(make_large_scene(500, 128.0), source="generated-small", split="generated")
    Shard(str(tmp_path), "generated-small", "generated", 0).write([small])
    with pytest.raises(ValueError, match=r"side of 128 m, expected at least 192 m, which hold rings 0 and 1"):
        evaluate_city(Config(generated=str(tmp_path), run="small", real=real, label="any-any"))
    for number, density in enumerate(("low", "high")):
        city = replace(small, scene_id=f"mixed-{number}", source="generated-mixed", vegetation_density=density)
        Shard(str(tmp_path), "generated-mixed", "generated", number).write([city])
    with pytest.raises(ValueError, match="cities have the labels high-any, low-any"):
        evaluate_city(Config(generated=str(tmp_path), run="mixed", real=real))
    with pytest.raises(ValueError, match="density 'lots' is unknown"):
        evaluate_city(Config(generated=str(tmp_path), run="mixed", real=real, label="lots-any"))
