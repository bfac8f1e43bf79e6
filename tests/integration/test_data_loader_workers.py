"""Tests of the data loader, which prefetches batches in a Ray task."""

import numpy as np
import pytest
from helpers import SHARD_SIZES, small_spec

from pipelines.training import data_loader
from pipelines.training.data_loader import LayoutReader, Stream, iterate_batches, read_samples


def test_batches_are_prefetched_in_order(layout_shards, cluster, monkeypatch):
    monkeypatch.setattr(data_loader, "SAMPLES_PER_TASK", 8)  # one task reads two steps
    reader, stream = LayoutReader(small_spec(32)), Stream(layout_shards, SHARD_SIZES, 4, seed=0)
    got = list(iterate_batches(stream, reader, start_step=3, stop_step=14, rank=1, world=2))
    assert len(got) == 11
    for step, batch in enumerate(got, 3):
        for name, value in read_samples(stream, reader, step, 1, 4, 1, 2).items():
            assert np.array_equal(batch[name], value), (step, name)
    assert not list(iterate_batches(stream, reader, 5, 5))
    with pytest.raises(ValueError, match="batch size 4 is not a multiple of 3 workers"):
        next(iterate_batches(stream, reader, 0, 1, 0, 3))
