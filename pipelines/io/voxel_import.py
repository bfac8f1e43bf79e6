"""Read and write voxel grids of any method as .npz files, and draw them from above.

A file holds one scene as an array of integer class ids. The array is named `voxels` or is the only array in the file.
The ids are those of the authors (docs/how_to/import_scenes.md; palette.py): 0 empty, 1 ground, 2 terrain, 3 sidewalk, 4
parking, 5 road, 6 vegetation_cuboid, 7 vegetation_ellipsoid, 8 vehicle_big, 9 vehicle_small, 10 two_wheelers, 11 human,
12 construction_big, 13 construction_small, 14 pole, 15 traffic_control, 16 object. This project adds the id 17 for
crossing. An array has one of the shapes of SHAPES and covers the crop of 64 x 64 m: 256 x 256 x 32 voxels, the coarser
grids of SemCity and XCube (128 x 128 x 16 and 64 x 64 x 8), or the other two grids of PDD (256 x 256 x 16 and 32 x 32 x
4). Coarse voxels are upsampled by repetition (nearest neighbour), as in the paper's evaluation of baselines.

In this project's axis order, row 0 is farthest ahead and rows continue backwards. Column 0 is leftmost and columns
continue to the right. Levels continue upwards.
"""

from __future__ import annotations

import io
from typing import Any, cast

import numpy as np

from models.scene import Scene
from pipelines.geometry.voxels import NUM_CLASSES, VoxelGrid, voxelize
from pipelines.runtime import storage
from pipelines.runtime.npz import ArrayHeader, open_npz
from pipelines.schema.axis_convention import Axes, compute_scene_from_axes
from pipelines.schema.palette import CLASS_COLORS, EMPTY

VOXEL_AXES: Axes = ("x-", "y-", "z+")
ARRAY = "voxels"
FULL = VoxelGrid().shape
SHAPES = (FULL, (256, 256, 16), (128, 128, 16), (64, 64, 8), (32, 32, 4))
MAX_BYTES = 8 * int(np.prod(FULL))  # Size in bytes of the largest array, which holds 64-bit numbers.
SHOWN = 5  # Maximum number of names in an error message.


def read_voxels(uri: str, axes: Axes = VOXEL_AXES) -> np.ndarray:
    """Read the voxels of one scene from an .npz file.

    Args:
        uri: Path or URI of the file.
        axes: Directions of the axes of the array in the file.

    Returns:
        (256, 256, 32) uint8 class ids in this project's axis order.

    Raises:
        ValueError: The file is invalid. The message names the file, its content and the expected content.
    """
    shown = " or ".join(" x ".join(map(str, shape)) for shape in SHAPES)
    try:
        voxels = convert_axes(_read_only_array(uri), axes)
    except ValueError as error:
        named = str(error).removeprefix(f"{uri}: ")
        raise ValueError(f"{uri}: {named}; expected one scene of {shown} integers as {ARRAY!r} in an .npz") from error
    if voxels.shape not in SHAPES:
        found = " x ".join(map(str, voxels.shape))
        raise ValueError(f"{uri}: holds {found} of {voxels.dtype}; expected {shown} integers in axes {' '.join(axes)}")
    if voxels.min() < 0 or voxels.max() >= NUM_CLASSES:
        wrong = np.unique(voxels[(voxels < 0) | (voxels >= NUM_CLASSES)])[:5].tolist()
        raise ValueError(
            f"{uri}: holds the class ids {wrong}; expected 0 (empty) to {NUM_CLASSES - 1},"
            " as in docs/how_to/import_scenes.md"
        )
    voxels = voxels.astype(np.uint8)
    for axis, factor in enumerate(np.array(FULL) // voxels.shape):
        voxels = voxels.repeat(factor, axis=axis)
    return voxels


def _read_only_array(uri: str) -> np.ndarray:
    with open_npz(uri) as archive:
        name = ARRAY if ARRAY in archive.names else next(iter(archive.names), "")
        if name != ARRAY and len(archive.names) != 1:
            raise ValueError(f"holds {', '.join(archive.names[:SHOWN]) or 'nothing'}")
        return archive.read(name, _check_header)


def _check_header(header: ArrayHeader) -> None:
    if header.dtype.kind not in "iu" or header.nbytes > MAX_BYTES:
        found = " x ".join(map(str, header.shape))
        raise ValueError(f"holds {found[:80]} of {header.dtype}, {header.nbytes:,} bytes")


def convert_axes(voxels: np.ndarray, axes: Axes) -> np.ndarray:
    """Reorder voxels to this project's axis order: rows backwards, columns to the right, levels upwards.

    Args:
        voxels: Three-dimensional array in the axis order of a file.
        axes: Directions of the axes of `voxels`.

    Returns:
        A view of `voxels` in this project's axis order.

    Raises:
        ValueError: The array is not three-dimensional, or the axes are invalid.
    """
    ours_from_file = compute_scene_from_axes(VOXEL_AXES).T @ compute_scene_from_axes(axes)
    if voxels.ndim != 3:
        raise ValueError(f"holds an array of shape {voxels.shape}")
    turned = voxels.transpose(np.abs(ours_from_file).argmax(axis=1))
    return turned[tuple(slice(None, None, int(step)) for step in ours_from_file.sum(axis=1))]


def export_voxels_npz(scene: Scene, grid: VoxelGrid | None = None) -> bytes:
    """Export the voxels of a scene in the format that `read_voxels` reads.

    Args:
        scene: Scene.
        grid: Voxel grid (default: 256 x 256 x 32).

    Returns:
        Content of a compressed .npz file. The same input always gives the same bytes.

    Raises:
        ValueError: `read_voxels` does not accept the shape of the grid.
    """
    voxels = voxelize(scene, grid or VoxelGrid())
    if voxels.shape not in SHAPES:
        raise ValueError(f"a voxel grid of shape {voxels.shape} cannot be read back; expected one of {SHAPES}")
    content = io.BytesIO()
    # Without the cast, the type checker compares the array with the keyword `allow_pickle` in numpy's annotation.
    np.savez_compressed(content, **cast("dict[str, Any]", {ARRAY: voxels}))
    return content.getvalue()


def write_voxels(uri: str, scene: Scene, grid: VoxelGrid | None = None) -> None:
    """Write the voxels of a scene to an .npz file.

    Args:
        uri: Path or URI of the file.
        scene: Scene.
        grid: Voxel grid (default: 256 x 256 x 32).
    """
    content = export_voxels_npz(scene, grid)
    storage.write_whole(uri, lambda stream: stream.write(content))


def draw_voxels(voxels: np.ndarray) -> np.ndarray:
    """Draw voxels from above.

    Each pixel has the colour of the topmost filled voxel in the column.

    Args:
        voxels: (rows, cols, levels) uint8 class ids.

    Returns:
        (rows, cols, 3) uint8 sRGB, white for empty columns.
    """
    filled = voxels != EMPTY
    # In an empty column, `top` is the highest level, and the class id there is EMPTY.
    top = voxels.shape[2] - 1 - filled[:, :, ::-1].argmax(axis=2)
    return CLASS_COLORS[np.take_along_axis(voxels, top[:, :, None], axis=2)[:, :, 0]]
