"""Tests of the readers with damaged files: a short version of benchmarks/fuzz.py, and all failures that it found."""

import signal
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import fuzz
import fuzz_formats

RUNS = 20
# Runs of benchmarks/fuzz.py that failed once: the seed and the number of the run, by format.
FOUND = {
    "adm": [(0, 9029)],
    "custom": [(0, 1296), (1, 3361)],
    "edits": [(0, 53)],
    "glb-own": [(0, 1048)],
    "voxels": [(0, 4513)],
}


@pytest.fixture(scope="module")
def drive():
    return fuzz_formats.make_town_drive()


@pytest.mark.parametrize("kind", fuzz_formats.FORMATS, ids=lambda kind: kind.name)
def test_damaged_files_are_refused_or_read_correctly(kind, drive, tmp_path):
    (tmp_path / "base").mkdir()
    form = kind(drive, tmp_path / "base")
    assert form.name in fuzz.NAMES and form.read_bases(tmp_path / "valid")
    before = signal.signal(signal.SIGALRM, fuzz.raise_hang)
    try:
        chosen = [*FOUND.get(form.name, []), *((0, number) for number in range(RUNS))]
        runs = [fuzz.judge_run(form, number, seed, tmp_path / "damaged", None) for seed, number in chosen]
    finally:
        signal.signal(signal.SIGALRM, before)
    failed = [run for run in runs if run.verdict not in ("refused", "accepted")]
    assert not failed, failed[0]
    assert {run.verdict for run in runs} == {"refused", "accepted"}


def test_fuzzer_notices_silent_damage(drive, tmp_path, monkeypatch):
    """The fuzzer itself must be able to fail: without validation, it reports other scenes, exceptions or memory."""
    (tmp_path / "base").mkdir()
    form = fuzz_formats.Tables(drive, tmp_path / "base")
    monkeypatch.setattr("pipelines.schema.tables.validate_table", lambda *_: None)
    monkeypatch.setattr("pipelines.schema.tables.validate_shard", lambda *_: None)
    before = signal.signal(signal.SIGALRM, fuzz.raise_hang)
    try:
        verdicts = {fuzz.judge_run(form, number, 0, tmp_path / "damaged", None).verdict for number in range(100)}
    finally:
        signal.signal(signal.SIGALRM, before)
    assert "different" in verdicts and "exception" in verdicts
