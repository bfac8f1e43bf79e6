"""Tests of model names, of recorded commands and of the checksums of released weights."""

import json

import pytest

from models.pretrained import CHECKSUMS_NAME, WEIGHTS, compute_checksums, find_pipeline_path, list_released


def test_tracking_hides_password_of_uri():
    from jobs.support.tracking import hide_credentials as shown

    assert shown("no answer from https://me:secret@host:5000/x") == "no answer from https://host:5000/x"
    assert shown("sqlite:////home/me/mlflow.db") == "sqlite:////home/me/mlflow.db"


def test_pipeline_directory_default_is_only_trained_or_released(tmp_path, monkeypatch):
    from jobs.support.model_directories import find_pipeline_directory

    monkeypatch.setenv("PRITTI_HOME", str(tmp_path))
    assert find_pipeline_directory("") == find_pipeline_path("town")
    for name, expected in (("demo", "pritti-demo"), ("smoke", None), ("town", "pritti-town")):
        directory = tmp_path / f"models/pritti-{name}"
        directory.mkdir(parents=True)
        (directory / "model_index.json").write_text("{}")
        if expected:
            assert find_pipeline_directory("") == str(tmp_path / "models" / expected)
            continue
        with pytest.raises(
            ValueError, match=r"several pipelines were trained here; specify one of: .*pritti-demo, .*pritti-smoke"
        ):
            find_pipeline_directory("")


def test_provenance_command_hides_machine_paths(monkeypatch):
    from pipelines.runtime import provenance

    monkeypatch.setenv("PRITTI_HOME", "/data")
    typed = ["jobs/train_dit.py", "demo", "--dataset", "/data/sets/town", "--output=/data2/a b", "--name", "x y"]
    monkeypatch.setattr(provenance.sys, "argv", [str(provenance.ROOT / typed[0]), *typed[1:]])
    assert (
        provenance.format_command()
        == "jobs/train_dit.py demo --dataset $PRITTI_HOME/sets/town '--output=.../a b' --name 'x y'"
    )


def test_released_weights_match_checksums():
    for name in list_released():
        assert json.loads((WEIGHTS / name / CHECKSUMS_NAME).read_text()) == compute_checksums(find_pipeline_path(name))
