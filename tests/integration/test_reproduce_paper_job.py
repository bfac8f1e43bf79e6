"""Rehearsal of jobs/reproduce_paper.py on the town, written as files of KITTI-360."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import ROOT

from pipelines.preprocess.sources.town.generator import generate_town, write_kitti360

SMALL = {"scale": "mini", "lvae-steps": 4, "dit-steps": 4, "num-scenes": 12, "num-inference-steps": 3}


def reproduce(raw: Path, output: Path, *more: str) -> str:
    words = [sys.executable, "jobs/reproduce_paper.py", "kitti360", "--input", raw, "--output", output, *more]
    words += [word for name, value in SMALL.items() for word in (f"--{name}", str(value))]
    done = subprocess.run(words, cwd=ROOT, env=os.environ | {"PYTHONPATH": ""}, text=True, capture_output=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return done.stdout


def test_dry_run_prints_commands_and_writes_nothing(tmp_path):
    write_kitti360(generate_town(3), tmp_path / "raw")
    printed = reproduce(tmp_path / "raw", tmp_path / "out", "--dry-run")
    assert "jobs/train_lvae.py kitti360-mini" in printed and "train DiT-B" in printed
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_rehearsal_writes_tables_and_second_call_repeats_nothing(tmp_path):
    for seed in (3, 4):
        write_kitti360(generate_town(seed), tmp_path / "raw", seed=seed)
    output = tmp_path / "out"
    assert "[8/8] write the tables" in reproduce(tmp_path / "raw", output)
    rows = {row["name"]: row for row in json.loads((output / "tables.json").read_text())}
    found = rows["AP3D (%)"]
    assert found["paper"] == 62.12 and found["ceiling"] > 90 > found["control"] and found["ours"] is not None
    classifier = rows["AUC of a classifier, 0.5 is perfect, DiT-B"]
    assert rows["FID, DiT-B"]["note"] == "needs --inception FILE" and 0.4 < classifier["ours"] <= 1
    assert "| AP3D (%) | 62.12 |" in (output / "tables.md").read_text()
    assert "rehearsal" in (output / "tables.html").read_text()
    paths = [path for path in output.rglob("*") if path.suffix in (".safetensors", ".parquet")]
    again = {"metrics.parquet", "reconstruction.parquet", "diffusion_pytorch_model.safetensors"}  # Written at each end.
    written = {path: path.stat().st_mtime_ns for path in paths if path.name not in again}
    assert len(written) > 20
    reproduce(tmp_path / "raw", output)
    assert {path: path.stat().st_mtime_ns for path in written} == written
