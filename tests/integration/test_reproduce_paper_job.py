"""Rehearsal of jobs/reproduce_paper.py on the town, written as files of KITTI-360."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import ROOT

from pipelines.preprocess.sources.town.generator import generate_town, write_kitti360

SMALL = {"scale": "mini", "lvae-steps": 7, "dit-steps": 4, "num-scenes": 12, "num-inference-steps": 3}


def start_reproduction(raw: Path, output: Path, *more: str) -> subprocess.Popen[str]:
    words = [sys.executable, "jobs/reproduce_paper.py", "kitti360", "--input", raw, "--output", output, *more]
    words += [word for name, value in SMALL.items() for word in (f"--{name}", str(value))]
    env = os.environ | {"PYTHONPATH": "", "PYTHONUNBUFFERED": "1"}
    return subprocess.Popen(words, cwd=ROOT, env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def reproduce(raw: Path, output: Path, *more: str) -> str:
    process = start_reproduction(raw, output, *more)
    printed = process.communicate()[0]
    assert process.returncode == 0, printed[-6000:]
    return printed


def stop_at_line(text: str, raw: Path, output: Path) -> list[str]:
    """Send SIGTERM to the job when it prints a line with a text, and return the lines before it."""
    process, before = start_reproduction(raw, output), []
    assert process.stdout is not None
    for line in process.stdout:
        if text in line:
            break
        before.append(line)
    else:
        pytest.fail(f"no line has {text!r}:\n" + "".join(before[-50:]))
    process.terminate()
    assert "run the same command again to resume" in process.communicate()[0] and process.returncode != 0
    return before


def read_times(output: Path) -> dict[Path, int]:
    paths = [path for path in output.rglob("*") if path.suffix in (".safetensors", ".parquet")]
    return {path: path.stat().st_mtime_ns for path in paths}


def test_dry_run_prints_commands_and_writes_nothing(tmp_path):
    write_kitti360(generate_town(3), tmp_path / "raw")
    printed = reproduce(tmp_path / "raw", tmp_path / "out", "--dry-run")
    assert "jobs/train_lvae.py kitti360-mini" in printed and "train DiT-B" in printed
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_rehearsal_resumes_and_second_call_repeats_nothing(tmp_path):
    for seed in (3, 4):
        write_kitti360(generate_town(seed), tmp_path / "raw", seed=seed)
    output = tmp_path / "out"
    stop_at_line("[1/8]", tmp_path / "raw", output)
    stop_at_line("step 5/7", tmp_path / "raw", output)  # Checkpoints are written after 4 and 7 steps.
    tables = read_times(output / "datasets")
    assert any("1 worker, from step 4" in line for line in stop_at_line("[5/8]", tmp_path / "raw", output))
    weights = read_times(output / "runs")
    assert tables and weights
    assert "[8/8] write the tables" in reproduce(tmp_path / "raw", output)
    rows = {row["name"]: row for row in json.loads((output / "tables.json").read_text())}
    found = rows["AP3D (%)"]
    assert found["paper"] == 62.12 and found["ceiling"] > 90 > found["control"] and found["ours"] is not None
    classifier = rows["AUC of a classifier, 0.5 is perfect, DiT-B"]
    assert rows["FID, DiT-B"]["note"] == "needs --inception FILE" and 0.4 < classifier["ours"] <= 1
    assert "| AP3D (%) | 62.12 |" in (output / "tables.md").read_text()
    assert "rehearsal" in (output / "tables.html").read_text()
    again = {"metrics.parquet", "reconstruction.parquet", "diffusion_pytorch_model.safetensors"}  # Written at each end.
    written = {path: time for path, time in read_times(output).items() if path.name not in again}
    assert len(written) > 20
    assert tables.items() <= written.items()
    assert {path: time for path, time in weights.items() if path.name not in again}.items() <= written.items()
    reproduce(tmp_path / "raw", output)
    assert written.items() <= read_times(output).items()
