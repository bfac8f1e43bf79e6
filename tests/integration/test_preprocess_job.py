"""Tests of preprocessing on Ray: real excerpts, town files, broken input and resuming."""

import json
import shutil
from pathlib import Path

import duckdb
import numpy as np
import pytest
from osm_map import make_town_street

from jobs.implementation.preprocess_scenes import SLOTS, main
from jobs.preprocess_scenes import Osm
from models.scene import CATEGORIES, Grid
from pipelines.io.export import export_scenes
from pipelines.preprocess import ingest
from pipelines.preprocess.shard_writer import ShardCut, write_shard
from pipelines.preprocess.sharding import plan_argoverse2, plan_kitti360, plan_town
from pipelines.preprocess.sources.drive import Drive
from pipelines.preprocess.sources.town.generator import generate_town, select_poses, write_kitti360
from pipelines.runtime import storage
from pipelines.runtime.machines import identify_machine
from pipelines.schema.attribution import ATTRIBUTIONS
from pipelines.schema.dataset import Dataset
from pipelines.schema.density_labels import classify_density, compute_density_thresholds
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import find_shards, read_scenes


def query_table(root: Path, query: str, name: str = "scenes") -> list[tuple]:
    return duckdb.sql(query.replace("TABLE", f"'{root}/{name}/**/*.parquet'")).fetchall()


@pytest.fixture(scope="session")
def town(cluster, tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("town")
    result = ingest.ingest_drives(plan_town(24, 8, 0), str(root), {"source": "town"})
    assert result.scenes == {"train": 24, "test": 8} and not result.rejects
    return root


def test_preprocess_aligns_shards_and_labels_by_training_split(town):
    for shard in find_shards(str(town)):
        ids = [shard.read(name, ["scene_id"])["scene_id"].to_pylist() for name in ("scenes", "rasters")]
        assert ids[0] == ids[1]
        counts = dict(query_table(town, f"select scene_id, num_primitives from TABLE where split = '{shard.split}'"))
        assert {s.scene_id: len(s) for s in shard.scenes()}.items() <= counts.items()
    dataset = Dataset.open(str(town))
    rows = query_table(
        town,
        "select split, num_vegetation_cuboid + num_vegetation_ellipsoid, vegetation_volume_m3, vegetation_density "
        "from TABLE",
    )
    training = [row for row in rows if row[0] == "train"]
    count, volume = (np.array([row[k] for row in training], float) for k in (1, 2))
    assert dataset.vegetation == compute_density_thresholds(count, volume)
    for _, n, v, label in rows:
        assert classify_density(np.array([n]), np.array([v]), dataset.vegetation)[0] == label
    p95 = np.percentile(
        [
            [row[k] for k in range(11)]
            for row in query_table(
                town, f"select {', '.join(f'num_{c}' for c in CATEGORIES)} from TABLE where split = 'train'"
            )
        ],
        95,
        axis=0,
    )
    expected = {c: max(1, int(np.ceil(n))) for c, n in zip(CATEGORIES, p95, strict=True)}
    assert all(expected[c] == n for c, n in zip(dataset.spec.categories, dataset.spec.slots, strict=True))
    assert not (town / ".staging").exists()


def test_slots_follow_the_chosen_percentile(cluster, tmp_path):
    ingest.ingest_drives(plan_town(8, 8, 5), str(tmp_path), {"source": "town"}, SLOTS["p99.5"])
    columns = ", ".join(f"num_{category}" for category in CATEGORIES)
    counts = query_table(tmp_path, f"select {columns} from TABLE where split = 'train'")
    expected = np.ceil(np.percentile(np.array(counts, float), 99.5, axis=0)).astype(int)
    spec = Dataset.open(str(tmp_path)).spec
    assert spec.slots == tuple(int(n) for n in expected if n) and len(counts) == 8


def test_preprocess_tables_equal_drive(town):
    (seed,) = query_table(town, "select min(sequence) from TABLE where split = 'train'")[0]
    drive = generate_town(int(seed))
    stored = {s.frame: s for s in read_scenes(str(town), "town", "train") if s.sequence == seed}
    frames = drive.frame[select_poses(len(drive), len(stored))]
    assert set(frames.tolist()) == set(stored)
    for index in select_poses(len(drive), len(stored)):
        scene = drive.scene(int(index), "train")
        assert np.array_equal(stored[scene.frame].center_m, scene.center_m)
        assert np.array_equal(stored[scene.frame].occupied, scene.occupied)


def test_preprocess_keeps_finished_run_and_rejects_other_options(town):
    stamp = (town / "dataset.json").stat().st_mtime_ns
    again = ingest.ingest_drives(plan_town(24, 8, 0), str(town), {"source": "town"})
    assert again.already_complete and (town / "dataset.json").stat().st_mtime_ns == stamp
    with pytest.raises(ValueError, match="choose another --output"):
        ingest.ingest_drives(plan_town(8, 8, 0), str(town), {"source": "town", "num_train": 8})


def test_preprocess_resumes_interrupted_run_to_same_tables(cluster, town, tmp_path):
    tasks, root = plan_town(24, 8, 0), str(tmp_path)
    staging = storage.join_uri(root, ingest.STAGING)
    storage.write_json({"source": "town"}, storage.join_uri(staging, "options.json"))
    done = write_shard(tasks[0], root, staging, Grid())
    stamp = Path(tasks[0].shard(root).path("rasters")).stat().st_mtime_ns
    stale = tmp_path / "rasters" / f"{storage.TEMPORARY}part-{identify_machine()}-{2**31 - 1}-1"
    stale.write_text("half")
    assert done["scenes"] > 0 and not (tmp_path / "scenes").exists()
    ingest.ingest_drives(tasks, root, {"source": "town"})
    assert Path(tasks[0].shard(root).path("rasters")).stat().st_mtime_ns == stamp
    assert not stale.exists()
    for name in ("scenes", "primitives", "rasters"):
        paths = [
            sorted(str(p.relative_to(root)) for p in (root / name).rglob("*.parquet")) for root in (town, tmp_path)
        ]
        assert paths[0] == paths[1] and len(paths[0]) > 1
        rows = [query_table(root, "select * from TABLE order by all", name) for root in (town, tmp_path)]
        assert rows[0] == rows[1] and len(rows[0]) >= 32
    assert json.loads((town / "dataset.json").read_text()) == json.loads((tmp_path / "dataset.json").read_text())


def test_preprocess_reads_real_kitti360_excerpt(cluster, real_data, tmp_path):
    result = ingest.ingest_drives(plan_kitti360(str(real_data / "kitti360")), str(tmp_path), {"source": "kitti360"})
    assert sum(result.scenes.values()) + sum(result.rejects.values()) == 500 and result.duplicates == 133
    assert set(result.scenes) == {"train", "test", "unused"}
    rows = query_table(
        tmp_path, "select count(*), count(distinct scene_id), max(crossing_area_m2), min(x_m) from TABLE"
    )
    assert rows[0][:3] == (sum(result.scenes.values()),) * 2 + (None,)
    cars = query_table(
        tmp_path,
        "select median(length_m), median(width_m), median(height_m) from TABLE where label = 'car'",
        "primitives",
    )[0]
    assert np.allclose(cars, (4.4, 2.0, 1.5), atol=0.9)
    ellipsoids = query_table(tmp_path, "select distinct category from TABLE where kind = 'ellipsoid'", "primitives")
    assert ellipsoids == [("vegetation_ellipsoid",)]


def test_preprocess_reads_real_argoverse2_logs(cluster, real_data, tmp_path):
    result = ingest.ingest_drives(plan_argoverse2(str(real_data / "av2")), str(tmp_path), {"source": "av2"})
    assert set(result.scenes) == {"train", "test"} and min(result.scenes.values()) > 150
    dataset = Dataset.open(str(tmp_path))
    assert dataset.spec.ground_classes == ("road", "crossing") and len(dataset.spec.categories) <= 7
    road, crossing, sidewalk = query_table(
        tmp_path, "select avg(road_area_m2), avg(crossing_area_m2), max(sidewalk_area_m2) from TABLE"
    )[0]
    assert road > 300 and crossing > 0 and sidewalk is None


def test_preprocess_reads_town_in_kitti360_format_equally(cluster, tmp_path):
    drive = generate_town(7)
    write_kitti360(drive, tmp_path / "raw")
    result = ingest.ingest_drives(
        plan_kitti360(str(tmp_path / "raw"), split=False), str(tmp_path / "out"), {"source": "kitti360"}
    )
    assert result.scenes == {"train": len(drive)} and result.duplicates > 50
    stored = {s.frame: s for s in read_scenes(str(tmp_path / "out"))}
    for index in range(0, len(drive), 25):
        want = drive.scene(index)
        got = stored[want.frame]
        assert (got.counts() == want.counts()).all()
        assert (got.occupied == want.occupied).mean() > 0.9999


def test_preprocess_stops_at_broken_drive_and_keeps_finished(cluster, real_data, tmp_path):
    raw = tmp_path / "av2"
    shutil.copytree(real_data / "av2", raw)
    log = next((raw / "val").iterdir())
    for path in (*raw.rglob("*"), raw, *raw.iterdir()):
        path.chmod(0o755)
    broken = log / "annotations.feather"
    whole = broken.read_bytes()
    broken.write_bytes(whole[:1000])
    out = str(tmp_path / "out")
    with pytest.raises(
        ValueError, match=r"annotations.feather.*All other drives are in the staging directory. Repair the file"
    ):
        ingest.ingest_drives(plan_argoverse2(str(raw)), out, {"source": "av2"})
    assert not (tmp_path / "out/scenes").exists() and not (tmp_path / "out/dataset.json").exists()
    skipped = ingest.ingest_drives(
        plan_argoverse2(str(raw)), str(tmp_path / "skip"), {"source": "av2"}, skip_unreadable=True
    )
    assert set(skipped.scenes) == {"test", "train"} and skipped.scenes["test"] == 0
    reasons = query_table(tmp_path / "skip", "select scene_id, reason from TABLE", "rejects")
    assert len(reasons) == 1 and "annotations.feather" in reasons[0][1]
    broken.write_bytes(whole)
    assert ingest.ingest_drives(plan_argoverse2(str(raw)), out, {"source": "av2"}).scenes["test"] > 150


def test_preprocess_rejects_bad_scene_and_keeps_others(cluster, tmp_path, monkeypatch):
    task = plan_town(24, 8, 0)[0]
    real = Drive.scene

    def scene(self, index, split, grid):
        if index == 1:
            raise ValueError("no ground here")
        return real(self, index, split, grid)

    monkeypatch.setattr(Drive, "scene", scene)
    cuts = ShardCut(task, Grid())
    assert len(list(cuts)) == task.parts[0].key[1] - 1 and not cuts.unreadable
    assert [r["reason"] for r in cuts.rejects] == ["no ground here"] and cuts.rejects[0]["frame"] is not None


def test_preprocess_rejects_empty_training_split(cluster, tmp_path):
    with pytest.raises(ValueError, match="no drive was found"):
        ingest.ingest_drives([], str(tmp_path), {})
    only_test = [task for task in plan_town(24, 8, 0) if task.split == "test"]
    with pytest.raises(ValueError, match="the training split is empty"):
        ingest.ingest_drives(only_test, str(tmp_path), {})


def test_preprocess_reads_openstreetmap_and_exports_notice(cluster, tmp_path):
    path = make_town_street().write(tmp_path / "place.osm")
    root = str(tmp_path / "osm")
    job = Osm(input=(path,), output=root, furnish=True, test_share=0.0)
    main(job)
    description = storage.read_json(storage.join_uri(root, "dataset.json"))
    assert description["attribution"] == ATTRIBUTIONS["osm"] and description["reports"]["place"]["buildings"] == 40
    marked, mapped = query_table(
        tmp_path / "osm",
        "select count(*) filter (label like 'furnished %'), count(*) filter (label = 'building') from TABLE",
        "primitives",
    )[0]
    assert marked > 500 and mapped > 100
    splits = dict(query_table(tmp_path / "osm", "select split, count(*) from TABLE group by split"))
    assert set(splits) == {"train"} and splits["train"] > 80
    (notice,) = query_table(tmp_path / "osm", "select distinct attribution from TABLE")[0]
    assert notice == ATTRIBUTIONS["osm"]
    counts, refused = export_scenes(SceneSubset(root, limit=2), ["glb", "npz"], str(tmp_path / "files"))
    assert counts == {"glb": 2, "npz": 2} and not refused
    assert (tmp_path / "files" / "NOTICE.txt").read_text() == f"{ATTRIBUTIONS['osm']}\n"
