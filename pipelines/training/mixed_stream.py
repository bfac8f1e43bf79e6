"""Mix the samples of several datasets for training, with a fixed share of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.schema.tables import Shard
from pipelines.training.data_loader import Stream

BLOCK = 1000  # The shares of the datasets are exact in each block of this number of samples.


@dataclass(frozen=True)
class MixedStream:
    """The endless, seeded order of the samples of several datasets.

    Each block of BLOCK samples has the datasets' shares, in random order. Within a dataset, the samples have the order
    of its own stream; each of its epochs visits all its scenes.

    Attributes:
        streams: Order of the samples of each dataset.
        weights: Share of each dataset, up to a common factor.

    Raises:
        ValueError: A share is less than one sample per block.
    """

    streams: tuple[Stream, ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        if min(self.quotas) < 1:
            raise ValueError(f"the weights {self.weights} differ by more than a factor of {BLOCK}")

    @property
    def batch_size(self) -> int:
        """Global batch size."""
        return self.streams[0].batch_size

    @property
    def shards(self) -> tuple[Shard, ...]:
        """Shards of all datasets."""
        return tuple(shard for stream in self.streams for shard in stream.shards)

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of samples of each shard in an epoch of its dataset."""
        return tuple(count for stream in self.streams for count in stream.counts)

    @property
    def quotas(self) -> tuple[int, ...]:
        """Number of samples of each dataset in a block; they sum to BLOCK."""
        exact = BLOCK * np.array(self.weights) / sum(self.weights)
        quotas = np.floor(exact).astype(int)
        largest = np.argsort(quotas - exact, kind="stable")[: BLOCK - quotas.sum()]
        quotas[largest] += 1
        return tuple(quotas.tolist())

    def positions(self, first: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the shard and the row of each of the samples first .. first + count - 1 of the stream.

        Args:
            first: Number of the first sample.
            count: Number of samples.

        Returns:
            Index into `shards` and row, each (count,).
        """
        wanted = np.arange(first, first + count)
        source, place = np.empty(count, np.int64), np.empty(count, np.int64)
        for block in np.unique(wanted // BLOCK):
            here = wanted // BLOCK == block
            sources, places = self._order_block(int(block))
            source[here], place[here] = sources[wanted[here] % BLOCK], places[wanted[here] % BLOCK]
        shard, row = np.empty(count, np.int64), np.empty(count, np.int64)
        start = 0
        for k, stream in enumerate(self.streams):
            mine = source == k
            if mine.any():  # The places of a dataset are consecutive.
                shards, rows = stream.positions(int(place[mine][0]), int(mine.sum()))
                shard[mine], row[mine] = start + shards, rows
            start += len(stream.shards)
        return shard, row

    def _order_block(self, block: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the dataset of each sample of a block, and its place in the stream of the dataset, each (BLOCK,)."""
        quotas = np.array(self.quotas)
        source = np.repeat(np.arange(len(quotas)), quotas)
        np.random.default_rng([self.streams[0].seed, block]).shuffle(source)
        place = np.empty(BLOCK, np.int64)
        for k, quota in enumerate(quotas):
            place[source == k] = block * quota + np.arange(quota)
        return source, place


def mix_streams(streams: list[Stream], weights: tuple[float, ...]) -> Stream | MixedStream:
    """Return the order of samples of several datasets.

    Args:
        streams: Order of the samples of each dataset.
        weights: Share of the samples from each dataset, up to a common factor.

    Returns:
        A mixture of the streams with a weight above 0, or the only one.
    """
    used = [(stream, weight) for stream, weight in zip(streams, weights, strict=True) if weight > 0]
    if len(used) == 1:
        return used[0][0]
    return MixedStream(tuple(stream for stream, _ in used), tuple(weight for _, weight in used))
