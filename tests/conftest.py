"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Real excerpts (kitti360/, av2/): $PRITTI_TEST_DATA, or if unset shared/data beside the checkout."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    path = Path(os.environ.get("PRITTI_TEST_DATA") or beside)
    if not path.is_dir():
        pytest.skip(
            f"no real data: {path} does not exist; set PRITTI_TEST_DATA to a folder with kitti360/ and av2/"
        )
    return path
