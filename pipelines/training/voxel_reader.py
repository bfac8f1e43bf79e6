"""Read voxel grids of the table `voxels` as training samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pyarrow as pa

from models.voxel_grids import Factor, name_voxel_column
from pipelines.io.voxel_table import unpack_voxels
from pipelines.schema.tables import Shard
from pipelines.training.data_loader import CACHED_SHARDS, Arrays


@dataclass(frozen=True)
class VoxelReader:
    """Read samples: one array (n, rows, cols, levels) uint8 for each size of voxels.

    The arrays have the names of the columns, such as voxels_2x2x2. A cache holds compressed grids, so each sample is
    decompressed when it is read.

    Attributes:
        shape: Number of rows, columns and levels of the fine grid.
        factors: Edge lengths of the voxels of each array in fine voxels.
    """

    shape: tuple[int, int, int]
    factors: tuple[Factor, ...]

    def __call__(self, shard: Shard, rows: np.ndarray, places: np.ndarray | None = None) -> Arrays:
        table = _read_voxels(shard, tuple(map(name_voxel_column, self.factors)))
        try:
            found = [tuple(table[name][int(row)].as_py() for name in ("rows", "cols", "levels")) for row in rows]
            for row, shape in zip(rows, found, strict=True):
                if shape != self.shape:
                    sides, wanted = (" x ".join(map(str, values)) for values in (shape, self.shape))
                    raise ValueError(f"row {row}: a grid of {sides} voxels, but the model reads {wanted}")
            return {
                name_voxel_column(factor): np.stack([unpack_voxels(table, int(row), factor) for row in rows])
                for factor in self.factors
            }
        except ValueError as error:
            raise ValueError(f"{shard.path('voxels')}: {error}") from error


@lru_cache(maxsize=CACHED_SHARDS)
def _read_voxels(shard: Shard, columns: Sequence[str]) -> pa.Table:
    return shard.read("voxels", ["rows", "cols", "levels", *columns])
