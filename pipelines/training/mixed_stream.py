"""Mix the samples of several datasets for training, with a fixed share of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.schema.tables import Shard
from pipelines.training.data_loader import Stream

CYCLE = 1000  # The shares of the datasets are exact in each cycle of this number of samples.


@dataclass(frozen=True)
class MixedStream:
    """The endless, seeded order of the samples of several datasets.

    Each cycle of CYCLE samples has the datasets' shares, in random order. Samples of a dataset keep the order of its
    stream; each of its epochs visits all its scenes.

    Attributes:
        streams: Order of the samples of each dataset.
        weights: Relative sampling weights.

    Raises:
        ValueError: A dataset gets less than one sample per cycle.
    """

    streams: tuple[Stream, ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        if min(self.quotas) < 1:
            root = self.streams[int(np.argmin(self.quotas))].shards[0].root
            raise ValueError(
                f"{root} gets less than one of {CYCLE} samples; use more even --dataset-weights than {self.weights}"
            )

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
        """Number of samples of each dataset in a cycle; they sum to CYCLE."""
        exact = CYCLE * np.array(self.weights) / sum(self.weights)
        quotas = np.floor(exact).astype(int)
        largest = np.argsort(quotas - exact, kind="stable")[: CYCLE - quotas.sum()]
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
        source, position = np.empty(count, np.int64), np.empty(count, np.int64)
        for cycle in np.unique(wanted // CYCLE):
            here = wanted // CYCLE == cycle
            sources, positions = self._order_cycle(int(cycle))
            source[here], position[here] = sources[wanted[here] % CYCLE], positions[wanted[here] % CYCLE]
        shard, row = np.empty(count, np.int64), np.empty(count, np.int64)
        start = 0
        for k, stream in enumerate(self.streams):
            mine = source == k
            if mine.any():  # Positions of a dataset are consecutive.
                shards, rows = stream.positions(int(position[mine][0]), int(mine.sum()))
                shard[mine], row[mine] = start + shards, rows
            start += len(stream.shards)
        return shard, row

    def _order_cycle(self, cycle: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the dataset of each sample of a cycle, and its position in the stream of the dataset (CYCLE,)."""
        quotas = np.array(self.quotas)
        source = np.repeat(np.arange(len(quotas)), quotas)
        np.random.default_rng([self.streams[0].seed, cycle]).shuffle(source)
        position = np.empty(CYCLE, np.int64)
        for k, quota in enumerate(quotas):
            position[source == k] = cycle * quota + np.arange(quota)
        return source, position


def mix_streams(streams: list[Stream], weights: tuple[float, ...]) -> Stream | MixedStream:
    """Return the order of samples of several datasets.

    Args:
        streams: Order of the samples of each dataset.
        weights: Relative sampling weights.

    Returns:
        A mixture of the streams with a weight above 0, or the only one.
    """
    used = [(stream, weight) for stream, weight in zip(streams, weights, strict=True) if weight > 0]
    if len(used) == 1:
        return used[0][0]
    return MixedStream(tuple(stream for stream, _ in used), tuple(weight for _, weight in used))
