"""Measure what the validation of tables costs when a shard is read.

    python benchmarks/validation.py --dataset DIR       20 s

Each round reads the first shard of the dataset and takes the CPU time of four parts in turn: reading the tables (with
the checks of sizes and page checksums), validating them, building Scenes from them, and, as a reference, reading the
same files by pyarrow alone, which checks nothing. Target: validation takes at most 5 % of the time to read the Scenes.
The share does not include the checks of sizes and checksums: compare `read tables` with `pyarrow alone` for these.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import time
from collections import defaultdict
from dataclasses import dataclass

import pyarrow.parquet as pq
import tyro
from common import describe_machine, spread

from pipelines.runtime import storage
from pipelines.schema.columns import PRIMITIVES, RASTERS, SCENES, TEXTS
from pipelines.schema.conversion import parse_scenes
from pipelines.schema.tables import Shard, find_shards
from pipelines.schema.validation import validate_shard, validate_table

SCHEMAS = {"scenes": SCENES, "primitives": PRIMITIVES, "rasters": RASTERS}


@dataclass(frozen=True)
class Config:
    dataset: str
    """Dataset directory on a local disk."""
    split: str | None = None
    """Split of the shard (default: the first split)."""
    rounds: int = 100
    """Number of rounds."""


def measure_parts(shard: Shard) -> dict[str, float]:
    """Return the CPU seconds of each part of reading a shard once, in the order of `Shard.scenes`."""
    seconds: defaultdict[str, float] = defaultdict(float)
    last = time.process_time()

    def stop(part: str) -> None:
        nonlocal last
        seconds[part] += (now := time.process_time()) - last
        last = now

    tables = []
    for name, schema in SCHEMAS.items():
        tables.append(
            storage.read_parquet(shard.path(name), schema=schema, encoded=TEXTS if name == "primitives" else ())
        )
        stop("read tables")
        validate_table(name, tables[-1])
        stop("validate")
    validate_shard(*tables)
    stop("validate")
    scenes = list(parse_scenes(*tables, shard.source, shard.split))
    stop("build Scenes")
    del tables, scenes
    stop("delete")
    for name in SCHEMAS:
        pq.ParquetFile(shard.path(name)).read()
    stop("pyarrow alone")
    return dict(seconds)


def main(config: Config) -> None:
    shard = find_shards(config.dataset, split=config.split)[0]
    measure_parts(shard)
    rounds = [measure_parts(shard) for _ in range(config.rounds)]
    print(describe_machine())
    scenes = shard.scenes()
    print(f"{len(scenes)} scenes with {sum(map(len, scenes)):,} primitives, {config.rounds} rounds, CPU time")
    for part in ("pyarrow alone", "read tables", "validate", "build Scenes"):
        print(f"{part:14} {spread([one[part] for one in rounds], 1000, 1)} ms")
    whole = [one["read tables"] + one["validate"] + one["build Scenes"] for one in rounds]
    shares = [100 * one["validate"] / total for one, total in zip(rounds, whole, strict=True)]
    print(f"share of validation in reading Scenes: {spread(shares, digits=1)} %")


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
