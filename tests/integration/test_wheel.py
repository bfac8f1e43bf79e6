"""Tests of the wheel: it is built, installed and used outside the repository."""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from helpers import ROOT

GENERATE = """
import jobs, models, pipelines, pritti
from pritti import PrITTIPipeline

for package in (jobs, models, pipelines, pritti):
    assert package.__file__.startswith({site!r}), package.__file__
(scene,) = PrITTIPipeline.from_pretrained("town").generate(["low-medium"], seed=0, num_inference_steps=2)
print(len(scene), "primitives")
"""
PACKAGES = ("pritti", "models", "pipelines", "jobs")


def run_program(*words: str | Path, cwd: Path, **environment: str) -> str:
    """Run a command without the Python path and the settings of this process, and return the output."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "PRITTI"))}
    done = subprocess.run(words, cwd=cwd, env=kept | environment, text=True, capture_output=True, timeout=1500)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Path of a wheel that is built without network access.

    The build uses a copy of the sources because setuptools writes the folder build/ next to them.
    """
    source, output = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    run_program(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", output, cwd=source)
    (path,) = output.glob("*.whl")
    return path


def test_wheel_holds_weights_web_files_and_type_markers(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    assert {f"{package}/py.typed" for package in PACKAGES} <= names
    data = {path for folder in ("models/weights/town", "pipelines/web") for path in (ROOT / folder).rglob("*")}
    modules = {path for package in PACKAGES for path in (ROOT / package).rglob("*.py")}
    assert {path.relative_to(ROOT).as_posix() for path in data | modules if path.is_file()} <= names
    assert not [name for name in names if name.startswith(("tests", "docs", "benchmarks", "infra"))]


def test_wheel_generates_scene_outside_repository(wheel, tmp_path):
    site = tmp_path / "site"
    words = ("install", "--quiet", "--disable-pip-version-check", "--no-deps", "--no-compile", "--target", site, wheel)
    run_program(sys.executable, "-m", "pip", *words, cwd=tmp_path)
    python = (sys.executable, "-P")  # with -P, sys.path does not contain the working directory
    assert re.search(
        r"\d+ primitives",
        run_program(*python, "-c", GENERATE.format(site=str(site)), cwd=tmp_path, PYTHONPATH=str(site)),
    )
    usage = run_program(*python, "-m", "pritti.cli", "--help", cwd=tmp_path, PYTHONPATH=str(site))
    assert "sample-scenes" in usage


@pytest.mark.slow
def test_wheel_with_dependencies_runs_console_script(wheel, tmp_path):
    """The environment of the test is empty, so the test fails if pyproject.toml lacks a dependency."""
    bin_ = tmp_path / "venv/bin"
    run_program(sys.executable, "-m", "venv", tmp_path / "venv", cwd=tmp_path)
    words = ("install", "--quiet", "--disable-pip-version-check", "--no-compile", wheel)
    run_program(bin_ / "pip", *words, cwd=tmp_path, PIP_CONSTRAINT=str(ROOT / "infra/constraints.txt"))
    assert "--num-scenes" in run_program(bin_ / "pritti", "sample-scenes", "--help", cwd=tmp_path)
    words = ("--model", "town", "--num-scenes", "1", "--num-inference-steps", "2", "--output", "scenes")
    run_program(
        bin_ / "pritti", "sample-scenes", *words, cwd=tmp_path, RAY_AUTH_MODE="disabled", PRITTI_HOME=str(tmp_path)
    )
    assert list(tmp_path.glob("scenes/scenes/source=generated-samples/split=generated/*.parquet"))
