"""Tests of the conventions for the folders of test modules and the names of test functions."""

import ast
from collections import Counter

import pytest
from helpers import ROOT

FOLDERS = ("unit", "integration", "faults", "browser")
MODULES = sorted((ROOT / "tests").rglob("test_*.py"))


def test_modules_lie_in_known_folders_with_unique_names():
    assert {path.parent.relative_to(ROOT / "tests").as_posix() for path in MODULES} == set(FOLDERS)
    assert (
        max(Counter(path.name for path in MODULES).values()) == 1
    )  # pytest imports a test module by its file name, without the name of its folder


@pytest.mark.parametrize("folder", FOLDERS)
def test_names_are_at_most_60_characters(folder):
    paths = [path for path in MODULES if path.parent.name == folder]
    functions = [
        node for path in paths for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef)
    ]
    names = [node.name for node in functions if node.name.startswith("test_")]
    assert names and [name for name in names if len(name) > 60 or name.startswith(("test_a_", "test_the_"))] == []


def test_jobs_are_executable():
    paths = sorted((ROOT / "jobs").glob("[!_]*.py"))
    assert len(paths) > 20 and [path.name for path in paths if not path.stat().st_mode & 0o111] == []


def test_jobs_that_train_start_ray_with_a_dashboard():
    """Without one, Ray Train may ask the dashboard of another Ray on the machine, and restart the training."""
    texts = {path.name: path.read_text() for path in (ROOT / "jobs/implementation").glob("*.py")}
    training = {name: text for name, text in texts.items() if "fit(training" in text}
    assert len(training) >= 3
    assert [name for name, t in training.items() if "training=True" not in t and "hold_training(" not in t] == []
