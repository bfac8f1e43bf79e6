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
