"""Tests of the stream of training samples: the scenes of each epoch, with different numbers of workers."""

import numpy as np
import pyarrow as pa
import pytest
from helpers import SHARD_SIZES, small_spec

from jobs.implementation.train_dit import make_streams
from jobs.support.trainer import with_sample_ids
from jobs.train_dit import Config
from models.augment import Augmentation
from models.tensors import encode_layout
from models.training import NonFiniteLossError
from pipelines.training.data_loader import LayoutReader, Stream, read_samples, repeat_crops


def test_stream_visits_scenes_once_per_epoch_in_new_order(layout_shards):
    stream = Stream(layout_shards, SHARD_SIZES, 4, seed=0)
    epochs = [list(zip(*stream.positions(25 * e, 25), strict=True)) for e in range(3)]
    everything = {(k, row) for k, count in enumerate(SHARD_SIZES) for row in range(count)}
    assert all(set(epoch) == everything and len(epoch) == 25 for epoch in epochs)
    assert epochs[0] != epochs[1] != epochs[2]
    assert stream.positions(20, 10)[0].tolist() == [k for k, _ in (epochs[0] + epochs[1])[20:30]]


def test_repeated_rows_are_visited_that_often_per_epoch(layout_shards):
    crop = {2, 5, 9, 10, 24}  # Numbers of scenes over all shards.
    first = np.cumsum([0, *SHARD_SIZES])
    tables = [pa.table({"free_pose": [first[k] + row in crop for row in range(n)]}) for k, n in enumerate(SHARD_SIZES)]
    rows = tuple(repeat_crops(table, 3) for table in tables)
    stream = Stream(layout_shards, tuple(map(len, rows)), 4, 0, rows)
    shard, row = stream.positions(0, 25 + 2 * len(crop))
    visits = np.bincount(first[shard] + row, minlength=25)
    assert visits.tolist() == [3 if k in crop else 1 for k in range(25)]
    with pytest.raises(ValueError, match="rows has"):
        Stream(layout_shards, SHARD_SIZES, 4, 0, rows)


def test_crop_repeats_needs_crops(layout_shards):
    shards = list(layout_shards)
    assert make_streams(Config(), [shards], 4) == [Stream(layout_shards, SHARD_SIZES, 4, 0)]
    with pytest.raises(ValueError, match="--crop-repeats 2: the dataset has no crops"):
        make_streams(Config(crop_repeats=2), [shards], 4)
    with pytest.raises(ValueError, match="--crop-repeats 0: use 1 or more"):
        make_streams(Config(crop_repeats=0), [shards], 4)


def test_read_samples_equals_layouts_of_stored_scenes(layout_shards):
    spec, stream = small_spec(32), Stream(layout_shards, SHARD_SIZES, 4, seed=0)
    got = read_samples(stream, LayoutReader(spec), first=2, count=3, batch=4, rank=0, world=1)
    for k, (shard, row) in enumerate(zip(*stream.positions(8, 12), strict=True)):
        want = encode_layout(layout_shards[shard].scenes([int(row)])[0], spec)
        for name, value in want.items():
            assert np.allclose(got[name][k], value, rtol=0, atol=1e-6 if name == "features" else 0), name


@pytest.mark.parametrize("augment", [None, Augmentation(flip=True, move_m=1.0, turn_rad=0.05, seed=1)])
def test_read_samples_of_two_workers_equals_one(layout_shards, augment):
    reader, stream = LayoutReader(small_spec(32), augment), Stream(layout_shards, SHARD_SIZES, 4, seed=0)
    one = read_samples(stream, reader, 5, 4, 4, 0, 1)
    two = [read_samples(stream, reader, 5, 4, 4, rank, 2) for rank in range(2)]
    for name, value in one.items():
        together = np.stack([part[name].reshape(4, 2, *value.shape[1:]) for part in two], axis=1)
        assert np.array_equal(together.reshape(value.shape), value), name


def test_nonfinite_loss_names_its_scenes(layout_shards):
    stream = Stream(layout_shards, SHARD_SIZES, 4, seed=0)
    shard, row = stream.positions(8, 4)
    ids = [layout_shards[shard[k]].scenes([int(row[k])])[0].scene_id for k in (1, 3)]
    message = with_sample_ids(NonFiniteLossError(2, [1, 3]), stream)
    assert "step 2: the loss is not finite for samples [1, 3]" in message
    assert f"Samples: {ids[0]}, {ids[1]}; inspect them" in message
    assert "not finite for all samples" in with_sample_ids(NonFiniteLossError(2, []), stream)
