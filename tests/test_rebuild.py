"""Reconstruction scored scene by scene and by the Ray graph, with a model that changes nothing and one that knows nothing."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from scenes import random_scene, small_spec

from models.layout import Bounds, LayoutSpec
from models.scene import CATEGORIES, Scene
from models.tensors import DecodedLayout, compact_layout, layout_batch
from pipelines.evaluation.evaluate import flattened
from pipelines.evaluation.reconstruction import (
    Rebuilt,
    SceneRecord,
    chunks_of,
    draw,
    rebuild,
    reconstruction_scores,
    scene_record,
    table_bytes,
    voxel_grid,
)
from pipelines.metrics.intervals import Estimate
from pipelines.reporting.reconstruction_report import reconstruction_html
from pipelines.runtime import storage
from pipelines.schema.scene_subset import Selection
from pipelines.schema.tables import Shard

LATENT = np.zeros((4, 8, 8), np.float32)
SPEC = replace(
    LayoutSpec(slots=(30,) * len(CATEGORIES)),
    cholesky_bounds=Bounds((0, -4, 0, -3, -3, 0), (4.0, 4.0, 4.0, 3.0, 3.0, 4.0)),
    height_bounds_m=Bounds((-3.0,), (3.0,)),
)


def perfect(scene: Scene, spec: LayoutSpec) -> DecodedLayout:
    """What a decoder without fault would say."""
    layout = compact_layout(scene, spec)
    return DecodedLayout(
        occupancy=layout["occupied"].astype(np.float32),
        height=layout["height"].astype(np.float32) / 65535,
        features=layout["features"],
        existence=layout["real"].astype(np.float32),
        category=spec.slot_category,
    )


def record(scene: Scene, layout: DecodedLayout, spec: LayoutSpec = SPEC) -> SceneRecord:
    return scene_record(scene, layout, LATENT, spec, voxel_grid(spec))


def test_a_perfect_decoder_scores_one():
    scenes = [random_scene(k, n=60, tilt_rad=0.1) for k in range(2)]
    got = reconstruction_scores([record(s, perfect(s, SPEC)) for s in scenes], SPEC, voxel_grid(SPEC))
    assert got["ground_iou"] == got["ground_mean_iou"] == 1 and got["height_rmse_m"] < 1e-4
    for variant in got["detection"].values():
        assert variant["ap3d"] > 0.99 and variant["ap3d_50"] > 0.99
    # Equal extents leave the axes of a scatter matrix open, but random ones differ.
    assert got["matched"]["found"] == got["matched"]["right"] == 1 and got["matched"]["mean_iou3d"] > 0.99
    assert got["matched"]["category_mean_iou3d"]["vegetation_ellipsoid"] > 0.98
    assert got["voxels"]["iou"] > 0.995 and got["voxels"]["miou"] > 0.99
    assert got["height_bounds_m"] == {"low": -3.0, "high": 3.0} and got["scenes"] == 2
    assert got["truths"] == {k: v for k, v in got["truths"].items() if v} and sum(got["truths"].values()) == 120


def test_what_a_coarse_raster_costs_is_told_apart():
    coarse, scenes = SPEC.with_resolution(SPEC.grid.rows // 2), [random_scene(k, n=30) for k in range(2)]
    records = [record(s, perfect(s, coarse), coarse) for s in scenes]
    got = reconstruction_scores(records, coarse, voxel_grid(coarse))
    assert got["raster_px"] == coarse.grid.rows and got["raster_ground_iou"] == 1 > got["ground_iou"] > 0.5
    assert got["raster_height_rmse_m"] < 1e-4


def test_ground_errors_are_metres_over_truly_occupied_pixels():
    scene = random_scene(0, n=30)
    exact = perfect(scene, SPEC)
    raised = replace(exact, height=exact.height + 0.3 / 6.0, occupancy=np.zeros_like(exact.occupancy))
    got = reconstruction_scores([record(scene, raised)], SPEC, voxel_grid(SPEC))
    assert got["ground_iou"] == 0  # nothing claimed, and heights count all the same
    assert got["height_rmse_m"] == pytest.approx(0.3, abs=1e-4) and got["height_mae_m"] == pytest.approx(0.3, abs=1e-4)
    assert got["height_mse_normalised"] == pytest.approx((0.3 / 6) ** 2, rel=1e-3)


def test_primitives_without_a_slot_count_as_missed():
    scene = random_scene(1, n=60, tilt_rad=0.1)
    few = replace(SPEC, slots=(1,) * 11)
    got = reconstruction_scores([record(scene, perfect(scene, few), few)], few, voxel_grid(few))
    boxes = scene.category != 1
    assert got["matched"]["found"] == pytest.approx(len(set(scene.category[boxes])) / boxes.sum())
    assert got["matched"]["right"] == 1


def test_a_record_survives_its_row():
    scene = random_scene(2, n=20)
    one = record(scene, perfect(scene, SPEC))
    again = SceneRecord.from_row(one.to_row())
    for name in ("ground", "matches", "pairs", "outside"):
        first, second = getattr(one, name), getattr(again, name)
        for field in first.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(first, field), getattr(second, field))
    np.testing.assert_array_equal(one.confusion, again.confusion)
    np.testing.assert_array_equal(one.memory, again.memory)


def test_a_scene_without_anything_is_scored(tmp_path):
    scene = random_scene(3, n=0)
    empty = replace(scene, occupied=np.zeros_like(scene.occupied), height_m=np.zeros_like(scene.height_m))
    full = random_scene(4, n=30)
    records = [record(s, perfect(s, SPEC)) for s in (empty, full)]
    assert reconstruction_scores(records, SPEC, voxel_grid(SPEC))["ground_iou"] == 1


# ------------------------------------------------------------------------------------------------- the Ray graph


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    """Two shards of 7 and 4 scenes, and an LVAE that only knows their means."""
    import torch

    from models.lvae import LayoutVAE

    root = tmp_path_factory.mktemp("rebuild")
    scenes = [random_scene(k, n=25, split="test") for k in range(11)]
    for number, part in enumerate((scenes[:7], scenes[7:])):
        Shard(str(root), "town", "test", number).write(part)
    torch.manual_seed(0)
    spec = small_spec(pixels=64)
    model = LayoutVAE(
        spec.to_dict(), latent_channels=4, channels=(8, 16, 16), norm_groups=4, width=32, layers=1, heads=2,
        hidden=32, head_hidden=32,
    )  # fmt: skip
    model.start_at(layout_batch(scenes, spec))
    model.save_pretrained(root / "lvae")
    return root


def selection(root: Path) -> Selection:
    return Selection(str(root), "town", "test")


def test_chunks_cover_a_selection_once(dataset):
    chunks = chunks_of(selection(dataset), 3)
    assert [rows for _, rows in chunks] == [[0, 1, 2], [3, 4, 5], [6], [0, 1, 2], [3]]
    assert [shard.number for shard, _ in chunks] == [0, 0, 0, 1, 1]


def test_bytes_of_tables_are_those_on_disk(dataset):
    files = [p for p in dataset.rglob("*.parquet")]
    assert table_bytes(chunks_of(selection(dataset), 3)) == pytest.approx(sum(p.stat().st_size for p in files) / 11)


@pytest.fixture(scope="module")
def rebuilt(dataset, cluster) -> Rebuilt:
    return rebuild(selection(dataset), str(dataset / "lvae"))


def test_scores_do_not_depend_on_chunks_and_workers(dataset, rebuilt):
    done = []
    again = rebuild(selection(dataset), str(dataset / "lvae"), 2, batch_size=3, on_scene=lambda: done.append(1))
    assert len(done) == rebuilt.scores["scenes"] == len(rebuilt.scenes) == 11
    first, second = flattened(rebuilt.scores), flattened(again.scores)
    different = [name for name in first if first[name] != pytest.approx(second[name], rel=1e-3, abs=1e-6)]
    assert first.keys() == second.keys() and not different


def test_scenes_are_listed_best_first(dataset, rebuilt):
    scenes = rebuilt.scenes
    miou = scenes["voxel_miou"].to_pylist()
    assert miou == sorted(miou, reverse=True)
    ids = [shard.scenes(rows)[0].scene_id for shard, rows in rebuilt.places]
    assert scenes["scene_id"].to_pylist() == ids and len(set(ids)) == 11
    assert set(scenes["primitives"].to_pylist()) == {25}
    assert min(scenes["ground_iou"].to_pylist()) >= 0 and max(scenes["found"].to_pylist()) <= 1


def test_the_page_shows_truth_beside_reconstruction(dataset, rebuilt):
    drawn = draw([rebuilt.places[0], rebuilt.places[-1]], str(dataset / "lvae"))
    assert [row["scene_id"] for row in drawn] == rebuilt.scenes["scene_id"].take([0, 10]).to_pylist()
    for row in drawn:
        for view in ("above", "oblique"):
            truth, again = row[f"truth_{view}"], row[f"rebuilt_{view}"]
            differs = bool((truth != again).any())
            assert truth.shape == again.shape == (480, 480, 3) and differs
    html = reconstruction_html(rebuilt.scores, rebuilt.scenes, drawn[:1], drawn[1:])
    counts = html.count("<img"), html.count('src="data:image/'), html.count("http")
    assert counts == (8, 8, 0)  # self-contained
    wanted = ("AP3D@50", "voxel mIoU", "Memory", "What the voxels leave out", "vegetation ellipsoid")
    missing = [words for words in (*wanted, *(row["scene_id"] for row in drawn)) if words not in html]
    assert not missing


def test_one_mlflow_run_per_output_directory(tmp_path, monkeypatch):
    from jobs.support.scores import publish_scores
    from jobs.support.tracking import client, tracking_uri

    monkeypatch.setenv("PRITTI_HOME", str(tmp_path / "home"))
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    output = str(tmp_path / "scores")
    many = {str(k): 0.5 for k in range(1200)}  # more than one call takes
    for value, lvae in ((0.25, "one"), (0.75, "two")):
        scores = {"reconstruction": {"ap3d": Estimate(value, 0.1, 0.9), "many": many, "absent": None}}
        assert publish_scores(output, scores, {"lvae": lvae}) == storage.read_json(f"{output}/metrics.json")
    rows = {row["metric"]: row for row in pq.read_table(f"{output}/metrics.parquet").to_pylist()}
    assert rows["reconstruction.ap3d"] == {"metric": "reconstruction.ap3d", "value": 0.75, "low": 0.1, "high": 0.9}
    assert rows["reconstruction.many.7"]["value"] == 0.5 and len(rows) == 1201
    api = client(tracking_uri())
    (run,) = api.search_runs([api.get_experiment_by_name("pritti-evaluation").experiment_id])
    assert run.data.metrics["reconstruction.ap3d"] == 0.75 and len(run.data.metrics) == 1203
    assert run.data.metrics["reconstruction.ap3d.high"] == 0.9
    assert run.data.tags["lvae"] == "two" and run.info.status == "FINISHED"
    assert [file.path for file in api.list_artifacts(run.info.run_id)] == ["metrics.json"]
