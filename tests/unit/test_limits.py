"""Tests of limits and of file names made from ids."""

import os
from pathlib import PurePosixPath, PureWindowsPath

import pytest

from models.limits import LIMITS, find_limit, require_within
from pipelines.schema.file_names import make_file_name


def test_limit_names_number_limit_and_variable(monkeypatch):
    require_within("polygon_points", LIMITS["polygon_points"].value)
    with pytest.raises(
        ValueError, match=r"a\.json: 10,001 points of a polygon; at most 10,000 .*PRITTI_MAX_POLYGON_POINTS=10001"
    ):
        require_within("polygon_points", 10_001, "a.json")
    monkeypatch.setenv("PRITTI_MAX_POLYGON_POINTS", "20000")
    require_within("polygon_points", 10_001, "a.json")
    for number in (float("nan"), float("inf"), 10**400, 10**5000):
        with pytest.raises(ValueError, match="at most 20,000"):
            require_within("polygon_points", number)
    monkeypatch.setenv("PRITTI_MAX_POLYGON_POINTS", "-1")
    with pytest.raises(ValueError, match="PRITTI_MAX_POLYGON_POINTS is '-1', expected a positive integer"):
        find_limit("polygon_points")


HOSTILE = [
    "../../x",
    "/etc/passwd",
    "..",
    ".",
    "",
    "a/b",
    "a\\b",
    "C:x",
    "x\0y",
    "\n",
    "é",
    ".hidden",
    "a" * 500,
    "\ud800",
]


@pytest.mark.parametrize("name", HOSTILE)
def test_file_name_stays_in_its_directory(name, tmp_path):
    made = make_file_name(name)
    assert PurePosixPath(made).name == PureWindowsPath(made).name == made and not made.startswith(".")
    (tmp_path / f"{made}.png").write_bytes(b"")
    assert os.listdir(tmp_path) == [f"{made}.png"]


def test_file_names_of_different_ids_differ():
    names = [*HOSTILE, "a-b", make_file_name("a/b")]
    assert len(set(map(make_file_name, names))) == len(names)
    assert make_file_name("kitti360-0000_000123.v2") == "kitti360-0000_000123.v2"
