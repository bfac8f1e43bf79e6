"""Tests of reading ranges of remote files."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipelines.runtime import remote_file
from pipelines.runtime.parquet_sizes import measure_columns
from pipelines.runtime.remote_file import RemoteFile


class CountingFile(pa.BufferReader):
    """A file in memory that lists its requests."""

    def __init__(self, content: bytes) -> None:
        super().__init__(content)
        self.requests: list[tuple[int, int]] = []

    def read_at(self, nbytes: int, offset: int) -> bytes:
        self.requests.append((offset, nbytes))
        return super().read_at(nbytes, offset)


@pytest.fixture
def content() -> bytes:
    return np.random.default_rng(0).bytes(10_000)


def test_reads_equal_those_of_a_plain_file(content, monkeypatch):
    monkeypatch.setattr(remote_file, "TAIL_BYTES", 100)
    monkeypatch.setattr(remote_file, "GAP_BYTES", 50)
    file = CountingFile(content)
    remote = RemoteFile(file)
    remote.prefetch([(10, 200), (240, 300), (5_000, 6_000), (-5, 3), (9_950, 20_000), (7, 7)])
    assert sorted(file.requests) == [(0, 16), (10, 290), (5_000, 1_000), (9_900, 100)]
    rng, direct = np.random.default_rng(1), 0
    for _ in range(300):
        first, count = rng.integers(0, 10_050), rng.integers(0, 400)
        remote.seek(first)
        before = len(file.requests)
        assert remote.read(count) == content[first : first + count]
        assert remote.tell() == max(first, min(first + count, 10_000))
        direct += len(file.requests) > before
    assert 0 < direct < 300
    assert remote.seek(-4, 2) == 9_996 and remote.read() == content[-4:] and remote.read(3) == b""


def test_wanted_columns_are_read_by_one_request():
    table = pa.table({name: np.random.default_rng(k).normal(size=50_000) for k, name in enumerate("abcd")})
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, data_page_size=4_096, use_dictionary=False)
    file = CountingFile(sink.getvalue().to_pybytes())
    remote = RemoteFile(file)
    metadata = pq.read_metadata(remote)
    measure_columns(remote, ("b", "c"))
    assert len(file.requests) == 3  # The head, the tail, and both columns.
    with pq.ParquetFile(remote, metadata=metadata) as opened:
        assert opened.read(["b", "c"]).equals(table.select(["b", "c"]))
    assert len(file.requests) == 3


def test_stated_sizes_beyond_the_limit_are_not_read(content, monkeypatch):
    for name, value in (("TAIL_BYTES", 100), ("GAP_BYTES", 50), ("MAX_BYTES", 1_000)):
        monkeypatch.setattr(remote_file, name, value)
    file = CountingFile(content)
    remote = RemoteFile(file)
    remote.prefetch([(0, 5_000)])
    assert len(file.requests) == 2 and remote.read(40) == content[:40]
