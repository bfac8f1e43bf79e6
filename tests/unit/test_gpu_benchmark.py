"""Tests of benchmarks/gpu.py: the rehearsal without Ray and without a network, and the file of scenes."""

import json
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))
import gpu

from models.batch import LayoutBatch
from models.layout import LayoutSpec
from models.scene import Grid
from models.tensors import encode_layout
from models.vae.matching import MatchWeights
from models.vae.outputs import LayoutOutput
from pipelines.preprocess.sources.town.generator import generate_town

# Neither Ray nor the packages of pipelines/ and jobs/ can be imported, and no connection can be opened.
ISOLATED = """
import runpy, socket, sys
for name in ("ray", "pipelines", "jobs", "pyarrow", "mlflow", "tyro"):
    sys.modules[name] = None
def refuse(*_):
    raise OSError("no network")
socket.socket.connect = refuse
sys.argv = ["gpu.py", *sys.argv[1:]]
runpy.run_path("benchmarks/gpu.py", run_name="__main__")
"""


def run_isolated(*words: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-c", ISOLATED, *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)


@pytest.mark.slow
def test_rehearsal_needs_only_models_and_sections_merge(tmp_path):
    done = run_isolated("--cpu", "--output", str(tmp_path))
    assert done.returncode == 0, done.stderr[-3000:]
    results = json.loads((tmp_path / "gpu.json").read_text())
    assert list(results) == list(gpu.SECTIONS) and all(section["rows"] for section in results.values())
    values = [row["value"] for section in results.values() for row in section["rows"]]
    assert np.isfinite(values).all() and min(values) >= 0
    assert (tmp_path / "learn/model/config.json").exists()
    learned = gpu.find_checkpoint(tmp_path / "learn")
    assert learned == tmp_path / "learn/step-4"
    again = run_isolated("--cpu", "--output", str(tmp_path), "--only", "train_dit", "learn")
    assert again.returncode == 0, again.stderr[-3000:]
    merged = json.loads((tmp_path / "gpu.json").read_text())
    assert {name: merged[name] for name in ("latency", "precision")} == {
        n: results[n] for n in ("latency", "precision")
    }
    assert gpu.find_checkpoint(tmp_path / "learn") == learned  # All steps were done.
    table = (tmp_path / "gpu.md").read_text()
    rows = sum(len(section["rows"]) for section in merged.values())
    assert table.count("\n| tiny ") == rows


def test_without_gpu_the_error_says_what_to_do(tmp_path):
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    done = run_isolated("--output", str(tmp_path / "none"))
    assert done.returncode == 2 and "error: torch finds no GPU; check nvidia-smi" in done.stderr
    assert not (tmp_path / "none").exists()


def test_files_that_cannot_be_used_are_errors_before_any_section(tmp_path, monkeypatch, capsys):
    broken = tmp_path / "broken.safetensors"
    broken.write_text("no scenes")
    for path in (tmp_path / "missing.safetensors", broken):
        monkeypatch.setattr(sys, "argv", ["gpu.py", "--cpu", "--output", str(tmp_path / "out"), "--scenes", str(path)])
        with pytest.raises(ValueError, match=f"--scenes {path}: .*; make this file with --write-scenes FILE"):
            gpu.main()
    monkeypatch.setattr(sys, "argv", ["gpu.py", "--write-scenes", str(tmp_path / "none" / "x.safetensors")])
    assert gpu.main() == 2 and "none/x.safetensors: its directory does not exist" in capsys.readouterr().err
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(gpu, "require_bf16", lambda device: None)
    monkeypatch.setattr(sys, "argv", ["gpu.py", "--output", str(tmp_path / "out")])
    with pytest.raises(ValueError, match="learn needs --scenes FILE"):
        gpu.main()
    assert not (tmp_path / "out").exists()


def test_scenes_travel_without_loss_and_are_small(tmp_path):
    path = tmp_path / "town.safetensors"
    gpu.write_scenes(path, 6)
    arrays, drive = gpu.load_scenes(str(path)), generate_town(1000)
    for k, pose in enumerate(np.linspace(0, len(drive) - 1, 6).astype(int)):
        expected = encode_layout(drive.scene(int(pose), "train", Grid()), LayoutSpec())
        for name in gpu.FIELDS:
            assert arrays[name].dtype == expected[name].dtype and np.array_equal(arrays[name][k], expected[name])
    assert path.stat().st_size / 6 * 256 < gpu.MAX_SCENES_BYTES


def test_scenes_that_are_too_large_are_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr(gpu, "MAX_SCENES_BYTES", 1000)
    with pytest.raises(ValueError, match=r"2 scenes need .* bytes, more than 1,000; lower --num-scenes"):
        gpu.write_scenes(tmp_path / "town.safetensors", 2)
    assert not list(tmp_path.iterdir())


def test_batch_that_fits_is_found():
    tried = []

    def attempt(batch: int) -> None:
        tried.append(batch)
        if batch > 32:
            raise torch.OutOfMemoryError("CUDA out of memory")

    assert gpu.find_fitting_batch(256, attempt) == 32 and tried == [256, 128, 64, 32]
    assert gpu.describe_fit(256, 32) == "; batch 256 does not fit in the memory, 32 fits"

    def fail(batch: int) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    with pytest.raises(ValueError, match="one sample does not fit"):
        gpu.find_fitting_batch(4, fail)


def test_failed_section_does_not_stop_the_others(tmp_path, monkeypatch, capsys):
    def fail(setup):
        yield gpu.Row("first", 1.0, "s")
        raise RuntimeError("CUDA error: an illegal memory access")

    monkeypatch.setitem(gpu.SECTIONS, "latency", fail)
    monkeypatch.setitem(gpu.SECTIONS, "throughput", lambda setup: iter([gpu.Row("second", 2.0, "s", "<= 3")]))
    setup = gpu.Setup(torch.device("cpu"), False, 989.0, tmp_path, "", 1)
    assert gpu.run_sections(setup, ["latency", "throughput"]) == 1
    assert "error: latency: CUDA error" in capsys.readouterr().err
    table = (tmp_path / "gpu.md").read_text()
    assert "| first | 1 s |" in table and "| second | 2 s | <= 3 |" in table
    complete = iter([gpu.Row("first", 3.0, "s"), gpu.Row("last", 4.0, "s")])
    monkeypatch.setitem(gpu.SECTIONS, "latency", lambda setup: complete)
    assert gpu.run_sections(setup, ["latency"]) == 0
    monkeypatch.setitem(gpu.SECTIONS, "latency", fail)
    assert gpu.run_sections(setup, ["latency"]) == 1
    table = (tmp_path / "gpu.md").read_text()
    assert "| first | 3 s |" in table and "| last | 4 s |" in table  # The rows of the complete run are kept.


def test_rows_of_a_stopped_section_are_kept(tmp_path, monkeypatch):
    def stop(setup):
        yield gpu.Row("first", 1.0, "s")
        raise KeyboardInterrupt

    monkeypatch.setitem(gpu.SECTIONS, "latency", stop)
    monkeypatch.setitem(gpu.SECTIONS, "throughput", lambda setup: iter([gpu.Row("second", 2.0, "s")]))
    setup = gpu.Setup(torch.device("cpu"), False, 989.0, tmp_path, "", 1)
    assert gpu.run_sections(setup, ["latency", "throughput"]) == 1
    table = (tmp_path / "gpu.md").read_text()
    assert "| first | 1 s |" in table and "second" not in table  # The sections after it do not run.


def test_primitives_of_a_perfect_decoder_are_all_found():
    """A decoder that returns the truth has no error; one that is 2 m off finds nothing within 1 m."""
    spec = LayoutSpec()
    rows = [encode_layout(generate_town(1000).scene(k, "train", Grid()), spec) for k in (0, 9)]
    arrays = {name: torch.from_numpy(np.stack([row[name] for row in rows])) for name in rows[0]}
    batch = LayoutBatch.from_compact(arrays)
    offset_m = torch.zeros(9)
    logit = torch.where(batch.real, 9.0, -9.0)

    def decode(_: object) -> LayoutOutput:
        features = batch.features + offset_m / 64
        return LayoutOutput(batch.height, batch.occupied, features, logit, spec.slots, MatchWeights())

    model = SimpleNamespace(spec=spec, encode=lambda _: SimpleNamespace(mean=None), decode=decode)
    measured = list(gpu.measure_primitives(model, arrays).values())
    assert np.allclose(measured, [0, 100, 100, 100], atol=0.1)
    offset_m[0] = 2
    error_m, recall, precision, _ = gpu.measure_primitives(model, arrays).values()
    assert 1 < error_m <= 2.01 and recall < 60 and precision < 60


def test_scenes_of_a_file_are_held_out(tmp_path):
    path = tmp_path / "town.safetensors"
    gpu.write_scenes(path, 8)
    layouts = gpu.Layouts(gpu.Setup(torch.device("cpu"), False, 1.0, tmp_path, str(path), 1), LayoutSpec())
    held = layouts.select(slice(len(layouts), None))["features"]
    drawn = layouts.draw(0, len(layouts))["features"]
    assert (len(layouts), len(held)) == (6, 2)
    assert not any(torch.equal(one, other) for one in held for other in drawn)


def test_interrupted_checkpoint_is_ignored(tmp_path):
    for step in (50, 100, 1000):
        (tmp_path / f"step-{step}").mkdir()
    assert gpu.find_checkpoint(tmp_path) is None
    for step in (50, 100):
        (tmp_path / f"step-{step}/state.json").touch()
    assert gpu.find_checkpoint(tmp_path) == tmp_path / "step-100"
