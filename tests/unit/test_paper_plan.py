"""Tests of the plan of jobs/reproduce_paper.py and of the paper's tables."""

import shlex
import subprocess
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
import tyro
from helpers import ROOT

from jobs.implementation.paper_plan import Counts, check_counts, count_poses, find_presets, make_plan
from jobs.implementation.reproduce_paper import check_networks, check_options, guard_scale, require_space
from jobs.reproduce_paper import Av2, Kitti360
from models.presets import DIT_PRESETS, LVAE_PRESETS
from pipelines.preprocess.sources.town.generator import generate_town, write_kitti360
from pipelines.reporting.paper_tables import (
    PAPER_NUMBERS,
    Reproduced,
    build_paper_tables,
    compare_with_paper,
    find_score,
    format_paper_tables,
)

FULL = Counts(61_913, 1_233)
PLANS = [
    Kitti360("/data", transformers=("b", "l", "xl"), inception="w.pth", num_workers=4),
    Kitti360("/data", scale="mini", lvae_steps=10, dit_steps=20, num_scenes=8, num_inference_steps=5, seed=3),
    Kitti360("/data", ablations=True, vgg16="v.pth", dit_steps=7),
    Av2("/data", gpus=0.0, wait_for_resources_s=60.0, skip_unreadable=True),
]


@pytest.mark.parametrize("config", PLANS)
def test_commands_of_plan_have_the_options_of_its_stages(config):
    """The printed commands are parsed as a shell and the jobs would parse them."""
    for stage in make_plan(config, FULL):
        script, *words = shlex.split(stage.command)
        job = script.removeprefix("jobs/").removesuffix(".py")
        parsed = tyro.cli(import_module(f"jobs.{job}").Config, args=words)
        assert parsed == stage.config and job == stage.job
        assert stage.hours >= 0 and stage.gigabytes >= 0 and stage.basis


def test_plan_of_the_paper_has_its_presets_and_numbers():
    stages = {stage.name: stage for stage in make_plan(PLANS[0], FULL)}
    assert len(stages) == 4 + 3 * 4
    assert stages["train the layout VAE"].hours == 72 / 4 and stages["train DiT-B"].hours == 288 / 4
    assert stages["sample scenes of DiT-L"].config.num_scenes == 61_913
    assert stages["sample scenes of DiT-L"].hours == pytest.approx(61_913 * 1.78 / 4 / 3600)
    assert stages["evaluate the scenes of DiT-B"].config.protocol == "paper-pr"
    assert stages["compute FID of DiT-XL over all scenes"].config.protocol == "paper-fid"
    assert stages["preprocess the drives"].config.slots == "paper"
    nearest = make_plan(PLANS[2], FULL)[-1]
    assert nearest.name == "find the nearest training scenes of DiT-B" and nearest.config.protocol == "paper-nearest"
    assert nearest.config.vgg16 == "v.pth" and not nearest.config.inception
    config = Kitti360("/data", transformers=("l", "xl"), vgg16="v.pth")
    assert not any("nearest" in stage.name for stage in make_plan(config, FULL))
    for config in PLANS:
        for size in config.transformers:
            lvae, dit = find_presets(config, size)
            assert lvae in LVAE_PRESETS and dit in DIT_PRESETS


def test_poses_of_town_drive_are_counted_before_preprocessing(tmp_path):
    write_kitti360(generate_town(3), tmp_path)
    config = Kitti360(str(tmp_path), scale="mini")
    counts = count_poses(config)
    lines = sum(len(path.read_text().splitlines()) for path in tmp_path.rglob("poses.txt"))
    assert counts.train > counts.test > 0 and counts.train + counts.test <= lines
    with pytest.raises(ValueError, match="training scenes, but the paper's protocol compares 1,000; use --scale mini"):
        count_poses(replace(config, scale="paper"))


def test_too_few_generated_scenes_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("jobs.implementation.paper_plan.PAPER_SCENES", 10)
    write_kitti360(generate_town(3), tmp_path)
    with pytest.raises(ValueError, match=r"--num-scenes is 20, but .*as many generated scenes as training scenes"):
        count_poses(Kitti360(str(tmp_path), num_scenes=20))


def test_missing_parts_of_datasets_are_found_first(tmp_path):
    for name in ("train", "val"):
        (tmp_path / name).mkdir()
    with pytest.raises(ValueError, match=r"data_3d_bboxes"):
        count_poses(Kitti360(str(tmp_path), scale="mini"))
    with pytest.raises(ValueError, match=str(tmp_path)):
        count_poses(Av2(str(tmp_path), scale="mini"))
    log = tmp_path / "train" / "log"
    log.mkdir()
    (log / "annotations.feather").touch()
    with pytest.raises(ValueError, match=r"has no test poses.* add val/ with at least one log"):
        count_poses(Av2(str(tmp_path), scale="mini"))


def test_impossible_options_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"--inception /nowhere/w\.pth does not exist"):
        check_options(Kitti360("/data", inception="/nowhere/w.pth"))
    with pytest.raises(ValueError, match="on Argoverse 2, the paper has only DiT-B"):
        check_options(Av2("/data", transformers=("b", "xl")))
    with pytest.raises(ValueError, match="expected different sizes"):
        check_options(Kitti360("/data", transformers=("b", "b")))
    with pytest.raises(ValueError, match="--ablations: the paper has these rows only for KITTI-360"):
        check_options(Av2("/data", ablations=True))
    for name, value in (("num_workers", 0), ("lvae_steps", 0), ("num_scenes", -1)):
        with pytest.raises(ValueError, match=rf"--{name.replace('_', '-')} is {value}, expected 1 or more"):
            check_options(Kitti360("/data", **{name: value}))
    with pytest.raises(ValueError, match="there are 3 test scenes, but the evaluation needs at least 4"):
        check_counts(Kitti360("/data", scale="mini"), Counts(50, 3))
    huge = [replace(stage, gigabytes=1e9) for stage in make_plan(PLANS[0], FULL)]
    with pytest.raises(ValueError, match="choose another --output"):
        require_space(huge, str(tmp_path / "new"))


def test_run_in_the_directory_of_the_other_scale_is_refused(tmp_path):
    (tmp_path / "scale.json").write_text('{"scale": "mini"}')
    guard_scale(Kitti360("/data", scale="mini"), str(tmp_path))
    with pytest.raises(ValueError, match='holds a run with scale="mini", asked for "paper"; choose another --output'):
        guard_scale(Kitti360("/data"), str(tmp_path))


def test_wrong_file_of_weights_is_found_before_the_first_stage(tmp_path):
    (tmp_path / "w.pth").write_bytes(b"no weights")
    for option in ("inception", "vgg16"):
        with pytest.raises(ValueError, match=r"w\.pth"):
            check_networks(Kitti360("/data", **{option: str(tmp_path / "w.pth")}))


def make_scores(value: float) -> dict:
    """Return scores that all have one value."""
    names = ("precision_k3", "recall_k3", "fid", "inception_score", "fid_small", "two_sample_auc", "relation_frechet")
    return {name: {"value": value, "low": value, "high": value} for name in names}


def test_tables_show_each_number_of_the_paper():
    reconstruction = {
        name: {"ap3d": ap, "ap3d_50": ap, "ground_iou": ap, "height_mse_normalised": 0.01, "voxels": {"iou": ap}}
        for name, ap in (("ours", 0.5), ("ceiling", 0.9), ("control", 0.1))
    }
    reconstruction["ours"]["ablation"] = {"without objects": {"ground_iou_mean": 0.8}}
    generation = {"b": make_scores(0.25) | {"sets": {"ceiling": make_scores(0.75), "moved": make_scores(0.05)}}}
    generation["b"]["memorisation"] = {"generated": {"mean": {"value": 50.0}, "median": 49.0}}
    rows = compare_with_paper("kitti360", Reproduced(reconstruction, generation, {"fid": "96 scenes"}))
    numbers = [n for n in PAPER_NUMBERS if n.source == "kitti360" and (n.value is not None or n.transformer == "b")]
    assert len(rows) == len(numbers) > 30
    found = {row["name"]: row for row in rows}
    assert found["AP3D (%)"] | {"note": ""} == {
        "table": "Tab. 2, layout VAE", "name": "AP3D (%)", "paper": 62.12, "ours": 50.0, "ceiling": 90.0,
        "control": 10.0, "note": "",
    }  # fmt: skip
    assert found["height MSE (0.01)"]["ours"] == 1.0
    assert found["FID, DiT-B"]["note"] == "96 scenes" and found["FID, DiT-B"]["ceiling"] == 0.75
    assert found["FID, DiT-L"]["ours"] is None and found["FID, DiT-L"]["note"] == "not trained; add --transformers l"
    assert found["mIoU (%)"]["note"] == "not computed"
    ablation = found["ground IoU (%), without objects"]
    assert (ablation["ours"], ablation["ceiling"], ablation["control"]) == (80.0, 90.0, 10.0)
    assert found["AP3D (%), without ground"]["note"] == "needs --ablations"
    assert (found["generated scenes, mean"]["paper"], found["generated scenes, mean"]["ours"]) == (52.2, 50.0)
    assert found["generated scenes, median"]["ours"] == 49.0
    assert found["training scenes, mean"]["note"] == "needs --vgg16 FILE"
    assert found["rasters of a scene (MB)"]["note"] == "a size has no ceiling"
    text = format_paper_tables(rows)
    assert "| AP3D (%) | 62.12 | 50 | 90 | 10 |  |" in text and text.count("\n## ") == 3
    assert sum(len(table.rows) for table in build_paper_tables(rows)) == len(rows)


def test_rows_without_weights_say_so():
    rows = compare_with_paper("av2", Reproduced({}, {"b": {"two_sample_auc": {"value": 0.6}}}, {}))
    found = {row["name"]: row for row in rows}
    assert found["FID, DiT-B"]["note"] == "needs --inception FILE"
    name = "AUC of a classifier, 0.5 is perfect, DiT-B"
    assert found[name]["ours"] == 0.6
    rows = compare_with_paper("av2", Reproduced({}, {"b": {"relation_frechet": {"value": 9.0}}}, {}))
    assert {row["name"]: row for row in rows}[name]["note"] == "needs 10 scenes and 5 places per side"


def test_scores_are_found_by_path():
    scores = {"voxels": {"iou": 0.5}, "fid": {"value": np.float64(3.0)}, "label": "low"}
    assert find_score(scores, "voxels.iou") == 0.5 and find_score(scores, "fid") == 3.0
    assert find_score(scores, "voxels.miou") is None and find_score(scores, "label") is None


@pytest.mark.parametrize("name", ["kitti360", "av2"])
def test_make_target_runs_the_job_with_its_arguments(name):
    words = ["make", "-n", f"paper-{name}", "ROOT=/data", "ARGS=--dry-run"]
    printed = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert f'/runs" .venv/bin/python jobs/reproduce_paper.py {name} --input "/data" --dry-run' in printed
