"""Tests of jobs/run_demo.py, from the first stage to the report."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import ROOT

from pipelines.schema.tables import read_scenes

SMALL = {
    "preset": "smoke",
    "num-train": 16,
    "num-test": 8,
    "lvae-steps": 4,
    "dit-steps": 4,
    "num-released-scenes": 2,
    "num-scenes": 4,
}


def run_demo(output: Path) -> str:
    words = [sys.executable, "jobs/run_demo.py", "--output", output]
    words += [word for name, value in SMALL.items() for word in (f"--{name}", str(value))]
    done = subprocess.run(words, cwd=ROOT, env=os.environ | {"PYTHONPATH": ""}, text=True, capture_output=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return done.stdout


def read_times(output: Path) -> dict[str, int]:
    """Return the modification time of each checkpoint and Parquet file by path (ns)."""
    paths = [path for folder in ("runs", "datasets", "generated") for path in (output / folder).rglob("*")]
    return {str(path): path.stat().st_mtime_ns for path in paths if path.suffix in (".safetensors", ".parquet")}


@pytest.mark.slow
def test_demo_writes_report_and_second_call_changes_no_file(tmp_path):
    assert "[9/9] write the report" in run_demo(tmp_path)
    assert len(list(read_scenes(str(tmp_path / "generated")))) == 4
    assert (tmp_path / "report.html").read_text().count("data:image/png") > 5
    written = read_times(tmp_path)
    assert sum("checkpoint_" in path for path in written) >= 4
    run_demo(tmp_path)
    assert read_times(tmp_path) == written
