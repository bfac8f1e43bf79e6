"""Tests of reconstruction scores from Ray tasks, and of their page."""

from pathlib import Path

import pytest

from pipelines.evaluation.evaluate import flatten_scores
from pipelines.evaluation.reconstruction import (
    Reconstruction,
    draw_scenes,
    evaluate_reconstruction,
    score_ceiling_and_control,
)
from pipelines.reporting.reconstruction_report import render_reconstruction_html, select_overall_scores
from pipelines.schema.scene_subset import SceneSubset
from pipelines.training.latents import load_lvae


def select_scenes(root: Path) -> SceneSubset:
    return SceneSubset(str(root), "town", "test")


@pytest.fixture(scope="module")
def reconstruction(reconstruction_dataset, cluster, tmp_path_factory) -> Reconstruction:
    lvae, records = str(reconstruction_dataset / "lvae"), str(tmp_path_factory.mktemp("records"))
    return evaluate_reconstruction(select_scenes(reconstruction_dataset), lvae, records)


@pytest.mark.slow  # tests/integration/test_evaluate_job.py resumes the same tasks for features.
def test_reconstruction_is_independent_of_chunks_and_workers(reconstruction_dataset, reconstruction, tmp_path):
    done: list[int] = []

    def evaluate() -> Reconstruction:
        done.clear()
        where = str(reconstruction_dataset / "lvae"), str(tmp_path / "records")
        return evaluate_reconstruction(
            select_scenes(reconstruction_dataset), *where, 2, batch_size=3, on_scenes=done.append
        )

    again = evaluate()
    assert done[0] == 0 and sum(done) == reconstruction.scores["scenes"] == len(reconstruction.scenes) == 11
    files = sorted((tmp_path / "records").glob("*.parquet"))
    kept = {path: path.stat().st_mtime_ns for path in files}
    files[0].unlink()
    files[1].write_bytes(b"damaged")
    resumed = evaluate()
    assert done[0] == 5 and sum(done) == 11  # two of five chunks, each of 3 scenes, are computed again
    assert all(path.stat().st_mtime_ns == kept[path] for path in files[2:])
    assert repr(resumed.scores) == repr(again.scores) and resumed.scenes == again.scenes
    first, second = flatten_scores(reconstruction.scores), flatten_scores(again.scores)
    different = [name for name in first if first[name] != pytest.approx(second[name], rel=1e-3, abs=1e-6)]
    assert first.keys() == second.keys() and not different


def test_reconstruction_lists_best_scene_first(reconstruction_dataset, reconstruction):
    scenes = reconstruction.scenes
    miou = scenes["voxel_miou"].to_pylist()
    assert miou == sorted(miou, reverse=True)
    ids = [shard.scenes(rows)[0].scene_id for shard, rows in reconstruction.places]
    assert scenes["scene_id"].to_pylist() == ids and len(set(ids)) == 11
    assert set(scenes["primitives"].to_pylist()) == {25}
    assert min(scenes["ground_iou"].to_pylist()) >= 0 and max(scenes["matched_recall"].to_pylist()) <= 1


def test_reconstruction_page_shows_truth_and_reconstruction(reconstruction_dataset, reconstruction):
    drawn = draw_scenes([reconstruction.places[0], reconstruction.places[-1]], str(reconstruction_dataset / "lvae"))
    assert [row["scene_id"] for row in drawn] == reconstruction.scenes["scene_id"].take([0, 10]).to_pylist()
    for row in drawn:
        for view in ("above", "oblique"):
            truth, again = row[f"truth_{view}"], row[f"rebuilt_{view}"]
            differs = bool((truth != again).any())
            assert truth.shape == again.shape == (480, 480, 3) and differs
    perfect = select_overall_scores(reconstruction.scores) | {"ap3d": 0.987654}
    scores = reconstruction.scores | {"sets": {"ceiling": perfect, "control": perfect | {"ap3d": 0.123456}}}
    html = render_reconstruction_html(scores, reconstruction.scenes, drawn[:1], drawn[1:])
    assert "0.9877" in html and "0.1235" in html
    counts = html.count("<img"), html.count('src="data:image/'), html.count("http")
    assert counts == (8, 8, 0)  # the page has no external links
    wanted = ("AP3D@50", "voxel mIoU", "Memory", "Content outside the voxel grid", "vegetation ellipsoid")
    missing = [words for words in (*wanted, *(row["scene_id"] for row in drawn)) if words not in html]
    assert not missing


def test_ceiling_is_nearly_perfect_and_control_is_damaged(reconstruction_dataset, reconstruction, tmp_path):
    scenes = select_scenes(reconstruction_dataset)
    spec = load_lvae(str(reconstruction_dataset / "lvae")).spec
    found = score_ceiling_and_control(scenes, spec, str(tmp_path))
    ceiling, control = found["ceiling"], found["control"]
    assert ceiling["scenes"] == 11 and ceiling.keys() == reconstruction.scores.keys() - {"label_existence_threshold"}
    assert ceiling["ap3d"] > 0.95 and ceiling["raster_ground_iou"] > 0.999
    assert control["ap3d"] < 0.6 * ceiling["ap3d"] and control["ground_iou"] < 0.95 * ceiling["ground_iou"]
    (lost,) = (tmp_path / "control").glob("chunk-00000.parquet")
    lost.unlink()
    written, done = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*.parquet")}, []
    resumed = score_ceiling_and_control(scenes, spec, str(tmp_path), on_scenes=done.append)
    assert resumed == found
    again = {p for p, time in written.items() if p.stat().st_mtime_ns != time}
    assert sum(done) == 11 and again == {tmp_path / "ceiling/chunk-00000.parquet"} and lost.exists()
    other = score_ceiling_and_control(scenes, spec.with_resolution(16), str(tmp_path))
    assert other["ceiling"]["raster_px"] == 16
