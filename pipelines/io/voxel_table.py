"""Pack voxel grids for the table `voxels`, and unpack them.

Each grid is one zstd frame, so a reader decompresses only the scenes that it needs. Without this project,
`pyarrow.decompress(blob, rows * cols * levels, codec="zstd")` returns the bytes of a grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from models.scene import Grid
from models.voxel_grids import COARSE_FACTORS, FINE, NUM_CLASSES, Factor, coarsen_voxels, name_voxel_column
from pipelines.geometry.voxels import VoxelGrid
from pipelines.schema.columns import VOXELS

LEVEL = 9  # Level of the compression. Level 12 saves 8 % of the bytes and takes 1.5 times as long.
GRID_COLUMNS = ("rows", "cols", "levels", "resolution_m", "level_m", "front_m", "left_m", "bottom_m")


def make_voxel_row(
    scene_id: str, voxels: np.ndarray, grid: VoxelGrid, factors: Sequence[Factor] = COARSE_FACTORS
) -> dict[str, Any]:
    """Return the row of the table `voxels` of a scene.

    Args:
        scene_id: Name of the scene.
        voxels: (rows, cols, levels) uint8 class ids.
        grid: Grid of `voxels` in the scene frame.
        factors: Sizes of coarse voxels to store, too; some of COARSE_FACTORS.

    Returns:
        Values of the columns VOXELS.

    Raises:
        ValueError: The shape of `voxels` differs from that of the grid, a class id is unknown, or a side of the grid is
            no multiple of a factor. The message names the scene.
    """
    if voxels.shape != grid.shape or voxels.dtype != np.uint8:
        raise ValueError(f"scene {scene_id}: voxels are {voxels.dtype} of {voxels.shape}, expected uint8 {grid.shape}")
    if voxels.size and voxels.max() >= NUM_CLASSES:
        raise ValueError(f"scene {scene_id}: class id {voxels.max()}, expected 0 to {NUM_CLASSES - 1}")
    columns = grid.columns
    values = (*grid.shape, columns.resolution_m, grid.step_m, columns.front_m, columns.left_m, grid.bottom_m)
    row = {"scene_id": scene_id, **dict(zip(GRID_COLUMNS, values, strict=True))}
    row["num_voxels"] = np.bincount(voxels.reshape(-1), minlength=NUM_CLASSES)
    try:
        for factor in (FINE, *factors):
            coarse = voxels if factor == FINE else coarsen_voxels(voxels, factor)
            row[name_voxel_column(factor)] = pack_grid(coarse)
    except ValueError as error:
        raise ValueError(f"scene {scene_id}: {error}") from error
    return row


def make_voxel_table(rows: Sequence[dict[str, Any]]) -> pa.Table:
    """Return the table of rows of `make_voxel_row`.

    Args:
        rows: Rows.

    Returns:
        Table with the schema VOXELS.
    """
    return pa.Table.from_pylist(list(rows), schema=VOXELS)


def pack_grid(voxels: np.ndarray) -> bytes:
    """Compress a grid.

    Args:
        voxels: uint8 array.

    Returns:
        One zstd frame. Equal grids give equal bytes.
    """
    codec = pa.Codec("zstd", compression_level=LEVEL)
    return codec.compress(np.ascontiguousarray(voxels).data, asbytes=True)


def read_grid(table: pa.Table, row: int) -> VoxelGrid:
    """Return the fine grid of a row.

    Args:
        table: Rows with the columns GRID_COLUMNS.
        row: Number of the row.

    Returns:
        Grid in the scene frame.

    Raises:
        ValueError: The grid is invalid.
    """
    value = {name: table[name][row].as_py() for name in GRID_COLUMNS}
    columns = Grid(value["front_m"], value["left_m"], value["resolution_m"], value["rows"], value["cols"])
    top_m = value["bottom_m"] + value["levels"] * value["level_m"]
    return VoxelGrid(columns, value["bottom_m"], top_m, value["levels"])


def unpack_voxels(table: pa.Table, row: int, factor: Factor = FINE) -> np.ndarray:
    """Return the voxels of a row.

    Args:
        table: Rows of the table `voxels`, with the columns rows, cols, levels and that of the factor.
        row: Number of the row.
        factor: Edge lengths of a voxel in fine voxels.

    Returns:
        (rows, cols, levels) uint8 class ids, read-only.

    Raises:
        ValueError: The column is null, its bytes are damaged or have another size, or a class id is unknown. The
            message names the row and the column.
    """
    name = name_voxel_column(factor)
    shape = tuple(table[side][row].as_py() // step for side, step in zip(GRID_COLUMNS[:3], factor, strict=True))
    packed = table[name][row].as_buffer()
    if packed is None:
        raise ValueError(
            f"row {row}, column {name!r}: null; run jobs/voxelize_scenes.py with these voxels and another --output"
        )
    try:
        content = pa.Codec("zstd").decompress(packed, int(np.prod(shape)))
    except (pa.ArrowInvalid, OSError) as error:
        raise ValueError(f"row {row}, column {name!r}: damaged bytes ({error})") from error
    voxels = np.frombuffer(content, np.uint8)
    if voxels.size != np.prod(shape):
        raise ValueError(f"row {row}, column {name!r}: {voxels.size:,} voxels, expected {' x '.join(map(str, shape))}")
    if voxels.max() >= NUM_CLASSES:
        raise ValueError(f"row {row}, column {name!r}: class id {voxels.max()}, expected 0 to {NUM_CLASSES - 1}")
    return voxels.reshape(shape)
