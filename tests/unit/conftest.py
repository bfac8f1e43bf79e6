"""Fixtures for tests that run without Ray."""

import pytest
from helpers import small_spec, tiny_pipeline

from models.pipeline import PrITTIPipeline


@pytest.fixture(scope="module")
def pipeline() -> PrITTIPipeline:
    return tiny_pipeline(small_spec())
