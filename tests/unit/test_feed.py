"""The stream of training samples: every scene once an epoch, the same whoever reads it; layouts are the tables'."""

import numpy as np
import pytest
from helpers import random_scene, small_spec

from jobs.support.trainer import with_scene_ids
from models.augment import Augmentation
from models.tensors import compact_layout
from models.training import NotFinite
from pipelines.schema.tables import Shard
from pipelines.training import data_loader
from pipelines.training.data_loader import LayoutReader, Stream, batches, read_samples

COUNTS = (5, 3, 7, 4, 6)


@pytest.fixture(scope="module")
def shards(tmp_path_factory) -> tuple[Shard, ...]:
    root, scenes = str(tmp_path_factory.mktemp("feed")), iter(range(100))
    found = tuple(Shard(root, "town", "train", k) for k in range(len(COUNTS)))
    for shard, count in zip(found, COUNTS, strict=True):
        shard.write([random_scene(next(scenes), n=30) for _ in range(count)])
    return found


def test_every_scene_comes_once_an_epoch_in_another_order(shards):
    stream = Stream(shards, COUNTS, 4, seed=0)
    epochs = [list(zip(*stream.positions(25 * e, 25), strict=True)) for e in range(3)]
    everything = {(k, row) for k, count in enumerate(COUNTS) for row in range(count)}
    assert all(set(epoch) == everything and len(epoch) == 25 for epoch in epochs)
    assert epochs[0] != epochs[1] != epochs[2]
    assert stream.positions(20, 10)[0].tolist() == [k for k, _ in (epochs[0] + epochs[1])[20:30]]


def test_samples_are_the_layouts_of_the_stored_scenes(shards):
    spec, stream = small_spec(32), Stream(shards, COUNTS, 4, seed=0)
    got = read_samples(stream, LayoutReader(spec), first=2, count=3, batch=4, rank=0, world=1)
    for k, (shard, row) in enumerate(zip(*stream.positions(8, 12), strict=True)):
        want = compact_layout(shards[shard].scenes([int(row)])[0], spec)
        for name, value in want.items():
            assert np.allclose(got[name][k], value, rtol=0, atol=1e-6 if name == "features" else 0), name


@pytest.mark.parametrize("augment", [None, Augmentation(flip=True, move_m=1.0, turn_rad=0.05, seed=1)])
def test_two_workers_read_what_one_would(shards, augment):
    reader, stream = LayoutReader(small_spec(32), augment), Stream(shards, COUNTS, 4, seed=0)
    one = read_samples(stream, reader, 5, 4, 4, 0, 1)
    two = [read_samples(stream, reader, 5, 4, 4, rank, 2) for rank in range(2)]
    for name, value in one.items():
        together = np.stack([part[name].reshape(4, 2, *value.shape[1:]) for part in two], axis=1)
        assert np.array_equal(together.reshape(value.shape), value), name


def test_batches_are_read_ahead_and_come_in_order(shards, cluster, monkeypatch):
    monkeypatch.setattr(data_loader, "SAMPLES_PER_TASK", 8)  # two steps a task
    reader, stream = LayoutReader(small_spec(32)), Stream(shards, COUNTS, 4, seed=0)
    got = list(batches(stream, reader, start_step=3, stop_step=14, rank=1, world=2))
    assert len(got) == 11
    for step, batch in enumerate(got, 3):
        for name, value in read_samples(stream, reader, step, 1, 4, 1, 2).items():
            assert np.array_equal(batch[name], value), (step, name)
    assert not list(batches(stream, reader, 5, 5))
    with pytest.raises(ValueError, match="batch size 4 does not divide by 3 workers"):
        next(batches(stream, reader, 0, 1, 0, 3))


def test_a_broken_loss_names_its_scenes(shards):
    stream = Stream(shards, COUNTS, 4, seed=0)
    shard, row = stream.positions(8, 4)
    ids = [shards[shard[k]].scenes([int(row[k])])[0].scene_id for k in (1, 3)]
    message = with_scene_ids(NotFinite(2, [1, 3]), stream)
    assert "step 2: the loss is not finite because of samples [1, 3]" in message
    assert f"Scenes: {ids[0]}, {ids[1]}; look at them" in message
    assert "every sample" in with_scene_ids(NotFinite(2, []), stream)
