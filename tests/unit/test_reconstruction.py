"""Tests of reconstruction scores of single scenes, with a perfect decoder and an untrained model."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from helpers import random_scene

from jobs.implementation.evaluate_scenes import read_existence_threshold
from models.layout import Bounds, LayoutSpec
from models.pretrained import find_pipeline_path
from models.scene import CATEGORIES, VEGETATION, Scene
from models.tensors import DecodedLayout, encode_layout
from pipelines.evaluation.reconstruction import (
    SceneRecord,
    compute_reconstruction_scores,
    make_scene_record,
    make_voxel_grid,
    measure_table_bytes,
    split_chunks,
)
from pipelines.metrics.intervals import Estimate
from pipelines.runtime import storage
from pipelines.schema.scene_subset import SceneSubset

LATENT = np.zeros((4, 8, 8), np.float32)
SPEC = replace(
    LayoutSpec(slots=(30,) * len(CATEGORIES)),
    cholesky_bounds=Bounds((0, -4, 0, -3, -3, 0), (4.0, 4.0, 4.0, 3.0, 3.0, 4.0)),
    height_bounds_m=Bounds((-3.0,), (3.0,)),
)


def encode_perfectly(scene: Scene, spec: LayoutSpec) -> DecodedLayout:
    """Return the output of a perfect decoder for a scene."""
    layout = encode_layout(scene, spec)
    return DecodedLayout(
        occupancy=layout["occupied"].astype(np.float32),
        height=layout["height"].astype(np.float32) / 65535,
        features=layout["features"],
        existence=layout["real"].astype(np.float32),
        category=spec.slot_category,
    )


def make_record(scene: Scene, layout: DecodedLayout, spec: LayoutSpec = SPEC) -> SceneRecord:
    return make_scene_record(scene, layout, LATENT, spec, make_voxel_grid(spec))


def test_reconstruction_removes_duplicates_as_generation_does():
    """Every primitive is proposed twice; the second proposal is less likely."""
    scene = random_scene(0, n=20)
    spec = replace(SPEC, slots=tuple(max(slots, 40) for slots in SPEC.slots))
    once = encode_perfectly(scene, spec)
    twice = replace(
        once,
        features=np.concatenate([once.features, once.features]),
        existence=np.concatenate([once.existence, 0.8 * once.existence]),
        category=np.concatenate([once.category, once.category]),
    )
    solid = ~np.isin(scene.category, VEGETATION)
    counts = {}
    for deduplicate in (False, True):
        made = make_scene_record(scene, twice, LATENT, spec, make_voxel_grid(spec), deduplicate=deduplicate)
        counts[deduplicate] = made.pairs.predictions.sum()
    assert solid.sum() > 5 and counts[False] == 2 * len(scene)
    assert counts[True] == 2 * len(scene) - solid.sum()  # tree crowns overlap in reality, so they are kept


def test_labels_of_reconstruction_use_threshold_of_generation(monkeypatch, tmp_path):
    """Half of the primitives have existence 0.4: they count for the scores, and not for labels above 0.5."""
    scene, judged = random_scene(0, n=20), []
    layout = encode_perfectly(scene, SPEC)
    real = np.flatnonzero(layout.existence)
    layout.existence[real[::2]] = 0.4
    monkeypatch.setattr("pipelines.evaluation.reconstruction.judge_labels", lambda scene, _: judged.append(len(scene)))
    for threshold in (0.3, 0.5):
        made = make_scene_record(scene, layout, LATENT, SPEC, make_voxel_grid(SPEC), label_threshold=threshold)
        assert made.pairs.predictions.sum() == len(scene)
    assert judged == [20, 10]
    assert read_existence_threshold(str(tmp_path / "lvae")) == 0.3  # The paper's threshold, without a pipeline.
    index = json.loads(Path(find_pipeline_path("town"), "model_index.json").read_text())
    (tmp_path / "model_index.json").write_text(json.dumps(index | {"existence_threshold": 0.5}))
    assert read_existence_threshold(str(tmp_path / "lvae")) == 0.5


def test_reconstruction_of_perfect_decoder_scores_one():
    scenes = [random_scene(k, n=60, tilt_rad=0.1) for k in range(2)]
    got = compute_reconstruction_scores(
        [make_record(s, encode_perfectly(s, SPEC)) for s in scenes], SPEC, make_voxel_grid(SPEC)
    )
    assert got["ground_iou"] == got["ground_mean_iou"] == 1 and got["height_rmse_m"] < 1e-4
    for variant in got["detection"].values():
        assert variant["ap3d"] > 0.99 and variant["ap3d_50"] > 0.99
    # The random extents of a box differ, so the scatter matrix determines the axes of the box.
    assert got["matched"]["recall"] == got["matched"]["precision"] == 1 and got["matched"]["mean_iou3d"] > 0.99
    assert got["matched"]["category_mean_iou3d"]["vegetation_ellipsoid"] > 0.98
    assert got["voxels"]["iou"] > 0.995 and got["voxels"]["miou"] > 0.99
    assert got["height_bounds_m"] == {"low": -3.0, "high": 3.0} and got["scenes"] == 2
    assert got["truths"] == {k: v for k, v in got["truths"].items() if v} and sum(got["truths"].values()) == 120


def test_reconstruction_separates_cost_of_coarse_raster():
    coarse, scenes = SPEC.with_resolution(SPEC.grid.rows // 2), [random_scene(k, n=30) for k in range(2)]
    records = [make_record(s, encode_perfectly(s, coarse), coarse) for s in scenes]
    got = compute_reconstruction_scores(records, coarse, make_voxel_grid(coarse))
    assert got["raster_px"] == coarse.grid.rows and got["raster_ground_iou"] == 1 > got["ground_iou"] > 0.5
    assert got["raster_height_rmse_m"] < 1e-4


def test_reconstruction_ground_errors_are_in_meters():
    scene = random_scene(0, n=30)
    exact = encode_perfectly(scene, SPEC)
    raised = replace(exact, height=exact.height + 0.3 / 6.0, occupancy=np.zeros_like(exact.occupancy))
    got = compute_reconstruction_scores([make_record(scene, raised)], SPEC, make_voxel_grid(SPEC))
    assert got["ground_iou"] == 0  # the prediction contains no occupied pixel, but height errors count
    assert got["height_rmse_m"] == pytest.approx(0.3, abs=1e-4) and got["height_mae_m"] == pytest.approx(0.3, abs=1e-4)
    assert got["height_mse_normalised"] == pytest.approx((0.3 / 6) ** 2, rel=1e-3)


def test_reconstruction_counts_primitives_without_slot_as_missed():
    scene = random_scene(1, n=60, tilt_rad=0.1)
    few = replace(SPEC, slots=(1,) * 11)
    got = compute_reconstruction_scores(
        [make_record(scene, encode_perfectly(scene, few), few)], few, make_voxel_grid(few)
    )
    boxes = scene.category != 1
    assert got["matched"]["recall"] == pytest.approx(len(set(scene.category[boxes])) / boxes.sum())
    assert got["matched"]["precision"] == 1


def test_reconstruction_record_round_trips():
    scene = random_scene(2, n=20)
    one = make_record(scene, encode_perfectly(scene, SPEC))
    again = SceneRecord.from_row(one.to_row())
    for name in ("ground", "matches", "pairs", "outside", "bounds"):
        first, second = getattr(one, name), getattr(again, name)
        for field in first.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(first, field), getattr(second, field))
    np.testing.assert_array_equal(one.confusion, again.confusion)
    np.testing.assert_array_equal(one.memory, again.memory)


def test_reconstruction_scores_empty_scene(tmp_path):
    scene = random_scene(3, n=0)
    empty = replace(scene, occupied=np.zeros_like(scene.occupied), height_m=np.zeros_like(scene.height_m))
    full = random_scene(4, n=30)
    records = [make_record(s, encode_perfectly(s, SPEC)) for s in (empty, full)]
    assert compute_reconstruction_scores(records, SPEC, make_voxel_grid(SPEC))["ground_iou"] == 1


# --------------------------------------------------------------------------------------------- chunks, sizes and MLflow


def select_scenes(root: Path) -> SceneSubset:
    return SceneSubset(str(root), "town", "test")


def test_reconstruction_chunks_cover_selection_once(reconstruction_dataset):
    chunks = split_chunks(select_scenes(reconstruction_dataset), 3)
    assert [rows for _, rows in chunks] == [[0, 1, 2], [3, 4, 5], [6], [0, 1, 2], [3]]
    assert [shard.number for shard, _ in chunks] == [0, 0, 0, 1, 1]


def test_reconstruction_table_bytes_equal_disk_usage(reconstruction_dataset):
    files = [p for p in reconstruction_dataset.rglob("*.parquet")]
    assert measure_table_bytes(split_chunks(select_scenes(reconstruction_dataset), 3)) == pytest.approx(
        sum(p.stat().st_size for p in files) / 11
    )


def test_publish_scores_uses_one_mlflow_run_per_directory(tmp_path, monkeypatch):
    from jobs.support.scores import publish_scores
    from jobs.support.tracking import find_tracking_uri, make_client

    monkeypatch.setenv("PRITTI_HOME", str(tmp_path / "home"))
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    output = str(tmp_path / "scores")
    many = {str(k): 0.5 for k in range(1200)}  # more metrics than one call accepts
    for value, lvae in ((0.25, "one"), (0.75, "two")):
        scores = {"reconstruction": {"ap3d": Estimate(value, 0.1, 0.9), "many": many, "absent": None}}
        assert publish_scores(output, scores, {"lvae": lvae}) == storage.read_json(f"{output}/metrics.json")
    rows = {row["metric"]: row for row in pq.read_table(f"{output}/metrics.parquet").to_pylist()}
    assert rows["reconstruction.ap3d"] == {"metric": "reconstruction.ap3d", "value": 0.75, "low": 0.1, "high": 0.9}
    assert rows["reconstruction.many.7"]["value"] == 0.5 and len(rows) == 1201
    api = make_client(find_tracking_uri())
    (run,) = api.search_runs([api.get_experiment_by_name("pritti-evaluation").experiment_id])
    assert run.data.metrics["reconstruction.ap3d"] == 0.75 and len(run.data.metrics) == 1203
    assert run.data.metrics["reconstruction.ap3d.high"] == 0.9
    assert run.data.tags["lvae"] == "two" and run.info.status == "FINISHED"
    assert [file.path for file in api.list_artifacts(run.info.run_id)] == ["metrics.json"]
