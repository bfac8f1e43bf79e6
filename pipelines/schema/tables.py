"""Read and write scenes in the Parquet tables of a dataset directory.

A dataset directory holds the tables `scenes/`, `primitives/`, `rasters/`, `latents/` and `rejects/`. Each table is
partitioned in Hive style: `source=.../split=.../part-<shard>.parquet`. Part k of every table holds the same scenes in
the same order. A reader therefore needs no join. docs/reference/tables.md documents the tables for users.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import pyarrow as pa

from models.limits import LimitError
from models.scene import Scene
from models.uris import split_options
from pipelines.runtime import storage
from pipelines.schema.columns import (
    EDITS,
    PRIMITIVES,
    RASTERS,
    REJECTS,
    SCENE_TABLES,
    SCENES,
    TEXTS,
    TRACKS,
    TRAFFIC,
    VOXELS,
)
from pipelines.schema.conversion import make_scene_tables, parse_scenes
from pipelines.schema.validation import validate_shard, validate_table

logger = logging.getLogger(__name__)


@dataclass(frozen=True, order=True)
class Shard:
    """One shard of a dataset directory.

    A shard has one Parquet file per table; all these files have the same number.

    Attributes:
        root: Dataset directory.
        source: Value of the source column.
        split: Value of the split column.
        number: Number of the part, from 0.
    """

    root: str
    source: str
    split: str
    number: int

    def path(self, table: str) -> str:
        """Return the path of the shard's file in a table.

        Args:
            table: Name of the table, such as scenes.

        Returns:
            Path or URI of the Parquet file.
        """
        return storage.join_uri(self.place(table), f"part-{self.number:05d}.parquet")

    def place(self, table: str) -> str:
        """Return the directory of a table's files for this source and split.

        Args:
            table: Name of the table, such as scenes.

        Returns:
            Path or URI of the directory.
        """
        return storage.join_uri(self.root, table, f"source={self.source}", f"split={self.split}")

    def read(self, table: str, columns: list[str] | None = None, encoded: Sequence[str] = ()) -> pa.Table:
        """Read the shard's rows of a table, and validate each column.

        Args:
            table: Name of the table, such as scenes.
            columns: Names of the columns to read (default: all).
            encoded: Names of text columns to return with dictionary encoding, which is faster (default: plain texts).

        Returns:
            The rows.

        Raises:
            ValueError: The file is missing or damaged, or a value is invalid. The message names the file, the row and
                the column.
        """
        schema = {
            "scenes": SCENES,
            "primitives": PRIMITIVES,
            "rasters": RASTERS,
            "edits": EDITS,
            "rejects": REJECTS,
            "tracks": TRACKS,
            "traffic": TRAFFIC,
            "voxels": VOXELS,
        }.get(table)
        content = storage.read_parquet(self.path(table), columns, schema, encoded)
        with self._naming(table):
            validate_table(table, content)
        return content

    def read_tables(self) -> tuple[pa.Table, pa.Table, pa.Table]:
        """Read the tables scenes, primitives and rasters, and validate that they belong together.

        Returns:
            The three tables. The texts of `primitives` have dictionary encoding.

        Raises:
            ValueError: A file is missing or damaged, or a value is invalid. The message names the file, the row and the
                column.
        """
        tables = self.read("scenes"), self.read("primitives", encoded=TEXTS), self.read("rasters")
        with self._naming("scenes"):
            validate_shard(*tables)
        return tables

    @contextmanager
    def _naming(self, table: str) -> Iterator[None]:
        """Put the name of a table's file in front of an error."""
        try:
            yield
        except LimitError as error:
            raise LimitError(f"{self.path(table)}: {error}") from error
        except ValueError as error:
            raise ValueError(
                f"{self.path(table)}: {error}; restore the shard or run the job that wrote it again"
            ) from error

    def scenes(self, rows: Sequence[int] | None = None) -> list[Scene]:
        """Read Scenes of the shard.

        Args:
            rows: Row numbers of the scenes, in this order (default: all).

        Returns:
            The Scenes.

        Raises:
            ValueError: A file is missing or damaged, or a value is invalid. The message names the file, the row and the
                column.
        """
        return list(parse_scenes(*self.read_tables(), self.source, self.split, rows))

    def write(self, scenes: Sequence[Scene]) -> None:
        """Write the tables scenes, primitives and rasters of the shard.

        Args:
            scenes: All scenes of the shard.
        """
        for table, content in make_scene_tables(scenes).items():
            storage.write_parquet(content, self.path(table))

    def find_fault(self, num_scenes: int | None = None) -> str:
        """Compare the files of the tables scenes, primitives and rasters with each other.

        The function reads the footers of the files and one column of `scenes`; it does not validate the other values.

        Args:
            num_scenes: Expected number of scenes (default: the number in `scenes`).

        Returns:
            Description of a missing file, a damaged file or a wrong number of rows; "" if there is none.
        """
        try:
            counts = storage.read_parquet(self.path("scenes"), ["num_primitives"])["num_primitives"]
            scenes = len(counts) if num_scenes is None else num_scenes
            expected = {"scenes": scenes, "rasters": scenes, "primitives": sum(counts.to_pylist())}
            found = {"scenes": len(counts)} | {
                table: storage.read_num_rows(self.path(table)) for table in ("primitives", "rasters")
            }
        except ValueError as error:
            return str(error)
        for table, rows in expected.items():
            if found[table] != rows:
                return f"{self.path(table)}: {found[table]:,} rows, expected {rows:,}"
        return ""


def find_faults(promised: Mapping[Shard, int]) -> dict[Shard, str]:
    """Find the shards that are missing, damaged or have another number of scenes than promised.

    Args:
        promised: Number of scenes of each shard.

    Returns:
        Description of the fault of each faulty shard (`Shard.find_fault`).
    """
    files = {shard: [shard.path(table) for table in SCENE_TABLES] for shard in promised}
    return storage.find_faults(files, lambda shard: shard.find_fault(promised[shard]))


def require_written(promised: Mapping[Shard, int]) -> None:
    """Check that a job has written the shards that it reports.

    Args:
        promised: Number of scenes of each shard.

    Raises:
        ValueError: A shard is missing, damaged or has another number of scenes.
    """
    storage.raise_faults(find_faults(promised), len(promised))


def find_unwritten(promised: Mapping[Shard, int]) -> list[Shard]:
    """Return the shards that a resumed job must write, in order. A damaged shard is reported as a warning.

    Args:
        promised: Number of scenes of each shard.

    Returns:
        Shards with a fault (`find_faults`).
    """
    faults = find_faults(promised)
    for fault in faults.values():
        if not fault.endswith(storage.MISSING):
            logger.warning("%s; the shard is written again", fault)
    return list(faults)


def find_shards(root: str, table: str = "scenes", source: str | None = None, split: str | None = None) -> list[Shard]:
    """Return the shards of a table, in order.

    Args:
        root: Dataset directory.
        table: Name of the table.
        source: Value of the source column (default: all sources).
        split: Value of the split column (default: all splits).

    Returns:
        The shards; the list is never empty.

    Raises:
        ValueError: The directory holds no matching shard.
    """
    shards = []
    for path in storage.list_files(storage.join_uri(root, table), ".parquet"):
        source_part, split_part, name = f"//{split_options(path)[0]}".rsplit("/", 3)[1:]
        found = (source_part.removeprefix("source="), split_part.removeprefix("split="))
        if (source or found[0], split or found[1]) == found:
            number = name.removeprefix("part-").removesuffix(".parquet")
            if not (source_part.startswith("source=") and split_part.startswith("split=") and number.isdecimal()):
                raise ValueError(
                    f"{path}: expected the name {table}/source=.../split=.../part-<number>.parquet; move other files"
                    " out of the dataset directory"
                )
            shards.append(Shard(str(root), *found, int(number)))
    if not shards:
        place, wanted = (
            storage.join_uri(root, table),
            "/".join(f"{k}={v}" for k, v in (("source", source), ("split", split)) if v),
        )
        there = sorted(
            {"/".join(split_options(path)[0].split("/")[-3:-1]) for path in storage.list_files(place, ".parquet")}
        )
        if there:
            raise ValueError(f"{place} holds no {wanted}; it holds {', '.join(there)}")
        raise ValueError(
            f"{place} holds no scenes; pass a directory that jobs/preprocess_scenes.py or another job wrote"
        )
    return shards


def read_scenes(
    root: str, source: str | None = None, split: str | None = None, limit: int | None = None
) -> Iterator[Scene]:
    """Yield the scenes of a dataset directory, shard by shard.

    Args:
        root: Dataset directory.
        source: Value of the source column (default: all sources).
        split: Value of the split column (default: all splits).
        limit: Maximum number of scenes (default: all).

    Yields:
        Each Scene, in the order of the shards.
    """
    left = limit
    for shard in find_shards(root, "scenes", source, split):
        for scene in shard.scenes():
            if left == 0:
                return
            yield scene
            left = None if left is None else left - 1
