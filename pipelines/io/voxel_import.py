"""Voxel grids of any method <-> .npz files, and their pictures from above.

One scene per file: the array `voxels`, or the only one, of integer class ids, the authors' (docs/imports.md; our
palette.py): 0 empty, 1 ground, 2 terrain, 3 sidewalk, 4 parking, 5 road, 6 vegetation_cuboid, 7 vegetation_ellipsoid,
8 vehicle_big, 9 vehicle_small, 10 two_wheelers, 11 human, 12 construction_big, 13 construction_small, 14 pole,
15 traffic_control, 16 object; 17, crossing, is ours. 256 x 256 x 32 over the 64 x 64 m of the crop, or 128 x 128 x 16,
or 64 x 64 x 8: coarse voxels are repeated (nearest neighbour), as the paper does with its baselines.

Our axes: rows backwards (row 0 farthest ahead), columns to the right (column 0 leftmost), levels upwards.
"""

from __future__ import annotations

import io
import zipfile
from typing import Any, cast

import numpy as np

from models.scene import Scene
from pipelines.geometry.voxels import NUM_CLASSES, VoxelGrid, voxelize
from pipelines.runtime import storage
from pipelines.schema.axis_convention import Axes, compute_scene_from_axes
from pipelines.schema.palette import CLASS_COLORS, EMPTY

VOXEL_AXES: Axes = ("x-", "y-", "z+")
ARRAY = "voxels"
FULL = VoxelGrid().shape
SHAPES = tuple(tuple(n // factor for n in FULL) for factor in (1, 2, 4))
MAX_BYTES = 8 * int(np.prod(FULL)) + 4096  # of 64-bit numbers, and the array's header


def read_voxels(uri: str, axes: Axes = VOXEL_AXES) -> np.ndarray:
    """(256, 256, 32) uint8 class ids of one scene, in our axes, from an .npz file whose axes point as `axes` says.

    Raises ValueError that names the file, what was found and what is expected.
    """
    shown = " or ".join(" x ".join(map(str, shape)) for shape in SHAPES)
    try:
        voxels = convert_axes(_read_only_array(storage.read_bytes(uri)), axes)
    except (ValueError, zipfile.BadZipFile, EOFError, OSError, NotImplementedError) as error:
        named = str(error).removeprefix(f"{uri}: ")
        raise ValueError(f"{uri}: {named}; expected one scene of {shown} integers as {ARRAY!r} in an .npz") from error
    if voxels.shape not in SHAPES or voxels.dtype.kind not in "iu":
        found = " x ".join(map(str, voxels.shape))
        raise ValueError(f"{uri}: holds {found} of {voxels.dtype}; expected {shown} integers in axes {' '.join(axes)}")
    if voxels.min() < 0 or voxels.max() >= NUM_CLASSES:
        wrong = np.unique(voxels[(voxels < 0) | (voxels >= NUM_CLASSES)])[:5].tolist()
        raise ValueError(f"{uri}: class ids {wrong}; expected 0 (empty) to {NUM_CLASSES - 1}, as in docs/imports.md")
    voxels = voxels.astype(np.uint8)
    for axis, factor in enumerate(np.array(FULL) // voxels.shape):
        voxels = voxels.repeat(factor, axis=axis)
    return voxels


def _read_only_array(content: bytes) -> np.ndarray:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        sizes = {entry.filename.removesuffix(".npy"): entry.file_size for entry in archive.infolist()}
    name = ARRAY if ARRAY in sizes else next(iter(sizes), "")
    if name != ARRAY and len(sizes) != 1:
        raise ValueError(f"holds {', '.join(sizes) or 'nothing'}")
    if sizes[name] > MAX_BYTES:
        raise ValueError(f"{name!r} takes {sizes[name]} bytes, more than one scene")
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        return arrays[name]


def convert_axes(voxels: np.ndarray, axes: Axes) -> np.ndarray:
    """A view of voxels with rows backwards, columns to the right and levels upwards. Raises ValueError."""
    ours_from_file = compute_scene_from_axes(VOXEL_AXES).T @ compute_scene_from_axes(axes)
    if voxels.ndim != 3:
        raise ValueError(f"holds an array of shape {voxels.shape}")
    turned = voxels.transpose(np.abs(ours_from_file).argmax(axis=1))
    return turned[tuple(slice(None, None, int(step)) for step in ours_from_file.sum(axis=1))]


def export_voxels_npz(scene: Scene, grid: VoxelGrid | None = None) -> bytes:
    """The scene's voxels as `read_voxels` takes them: a compressed .npz, the same bytes on every call.

    Raises ValueError if the grid's shape is none of SHAPES.
    """
    voxels = voxelize(scene, grid or VoxelGrid())
    if voxels.shape not in SHAPES:
        raise ValueError(f"a voxel grid of {voxels.shape} cannot be read back, expected one of {SHAPES}")
    content = io.BytesIO()
    np.savez_compressed(
        content, **cast("dict[str, Any]", {ARRAY: voxels})
    )  # the annotation covers allow_pickle as well
    return content.getvalue()


def write_voxels(uri: str, scene: Scene, grid: VoxelGrid | None = None) -> None:
    """Writes `export_voxels_npz`."""
    content = export_voxels_npz(scene, grid)
    storage.write_whole(uri, lambda stream: stream.write(content))


def draw_voxels(voxels: np.ndarray) -> np.ndarray:
    """(rows, cols, 3) uint8 sRGB from above: the colour of each column's topmost filled voxel, white where none is."""
    filled = voxels != EMPTY
    top = voxels.shape[2] - 1 - filled[:, :, ::-1].argmax(axis=2)  # the highest level, empty, where nothing is
    return CLASS_COLORS[np.take_along_axis(voxels, top[:, :, None], axis=2)[:, :, 0]]
