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
    uneven = [next(iterate_batches(stream, reader, 3, 4, rank, 3)) for rank in range(3)]
    whole = read_samples(stream, reader, 3, 1, 4, 0, 1)
    assert [len(part["real"]) for part in uneven] == [1, 1, 2]
    assert all(np.array_equal(np.concatenate([part[name] for part in uneven]), whole[name]) for name in whole)
    with pytest.raises(ValueError, match="batch size 4 is smaller than the number of workers, 5"):
        next(iterate_batches(stream, reader, 0, 1, 0, 5))


def test_worker_reads_samples_itself_if_tasks_have_no_room(layout_shards, cluster, monkeypatch):
    monkeypatch.setattr(data_loader, "READER_CPUS", 100)  # no node has so many CPUs
    monkeypatch.setattr(data_loader, "READ_HERE_AFTER_S", 0.2)
    reader, stream = LayoutReader(small_spec(32)), Stream(layout_shards, SHARD_SIZES, 4, seed=0)
    got = list(iterate_batches(stream, reader, 0, 3))
    assert np.array_equal(got[2]["real"], read_samples(stream, reader, 2, 1, 4, 0, 1)["real"])
