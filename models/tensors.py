"""Convert scenes to layout tensors as defined by a LayoutSpec, and convert decoded layouts back to scenes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from models.batch import LayoutBatch
from models.geometry.cholesky import compute_cholesky_parameters, decode_cholesky_boxes
from models.layout import FEATURES, LayoutSpec
from models.scene import CATEGORY_INDEX, UNSET, Grid, Scene, canonicalize_boxes

EXISTENCE_THRESHOLD = 0.3  # paper, supplement B.2, Implementation Details


def resample_scene_ground(scene: Scene, ground_classes: tuple[str, ...], grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Resample the ground of a scene to another grid that covers the same area (see `resample_ground`).

    Args:
        scene: Scene.
        ground_classes: Names of the ground classes of the result.
        grid: Grid of the result.

    Returns:
        Height (G, H, W) in metres and mask (G, H, W) of these classes.

    Raises:
        ValueError: The grids cover different areas, or neither resolution is a whole multiple of the other.
    """
    return resample_ground(*select_ground_classes(scene, ground_classes), scene.grid, grid)


def select_ground_classes(scene: Scene, ground_classes: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the rasters of some ground classes. Rasters of classes that the scene does not have are empty.

    Args:
        scene: Scene.
        ground_classes: Names of the ground classes of the result, in this order.

    Returns:
        Height (G, H, W) in metres and mask (G, H, W) of these classes.
    """
    if ground_classes == scene.ground_classes:
        return scene.height_m, scene.occupied
    shape = (len(ground_classes), scene.grid.rows, scene.grid.cols)
    height, occupied = np.zeros(shape, np.float32), np.zeros(shape, bool)
    for k, name in enumerate(ground_classes):
        if name in scene.ground_classes:
            own = scene.ground_classes.index(name)
            height[k], occupied[k] = scene.height_m[own], scene.occupied[own]
    return height, occupied


def resample_ground(height: np.ndarray, occupied: np.ndarray, own: Grid, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Resample rasters to another grid that covers the same area.

    On a coarser grid, a pixel is occupied if at least half of its area is occupied. The height of an occupied coarse
    pixel is the mean height of its occupied part. On a finer grid, each pixel has the value of the nearest input pixel.

    Args:
        height: (G, H, W) heights, in metres or as integers.
        occupied: (G, H, W) masks.
        own: Grid of the input rasters.
        grid: Grid of the result.

    Returns:
        Heights and masks on `grid`; the data types are those of the inputs.

    Raises:
        ValueError: The grids cover different areas, or neither resolution is a whole multiple of the other.
    """
    covered, wanted = ((g.front_m, g.left_m, g.back_m, g.right_m) for g in (own, grid))
    if not np.allclose(covered, wanted):
        raise ValueError(f"the scene must cover the same area as {grid}, got {own}")
    if grid.rows == own.rows:
        return height, occupied
    if own.rows % grid.rows == 0:
        f = own.rows // grid.rows
        wide = {"u": np.uint32, "i": np.int64}.get(height.dtype.kind, height.dtype)
        count, total = _sum_blocks(occupied.view(np.uint8), f, np.uint8), _sum_blocks(height, f, wide)
        keep = 2 * count.astype(np.int16) >= f * f
        mean = total / np.maximum(count, 1).astype(np.float32)
        mean = np.rint(mean) if height.dtype.kind in "ui" else mean
        return np.where(keep, mean, 0).astype(height.dtype), keep
    if grid.rows % own.rows == 0:
        f = grid.rows // own.rows
        height, occupied = (a.repeat(f, axis=1).repeat(f, axis=2) for a in (height, occupied))
        return height, occupied
    raise ValueError(f"cannot resample {own.rows} rows to {grid.rows} rows: one number must be a multiple of the other")


def _sum_blocks(values: np.ndarray, f: int, dtype: np.typing.DTypeLike) -> np.ndarray:
    """Return sums (G, H / f, W / f) over blocks of f x f pixels.

    Rows are added first, because rows are contiguous in memory and columns are not.
    """
    rows = sum(
        (values[:, i::f].astype(dtype, copy=False) for i in range(1, f)), values[:, ::f].astype(dtype, copy=False)
    )
    return sum((rows[:, :, j::f] for j in range(1, f)), rows[:, :, ::f])


def assign_slots(category: np.ndarray, center_m: np.ndarray, spec: LayoutSpec) -> tuple[np.ndarray, np.ndarray]:
    """Assign primitives to slots.

    If a category has more primitives than slots, the primitives nearest to the ego vehicle are kept (supplement A).

    Args:
        category: (n,) categories.
        center_m: (n, 3) centres (metres, scene frame).
        spec: LayoutSpec that defines the slots.

    Returns:
        Indices (m,) of the occupied slots, and indices (m,) of the primitives in these slots.
    """
    position = np.full(len(CATEGORY_INDEX), -1)
    position[[CATEGORY_INDEX[name] for name in spec.categories]] = np.arange(len(spec.categories))
    position = position[category]
    order = np.lexsort((np.linalg.norm(center_m, axis=1), position))
    order = order[np.searchsorted(position[order], 0) :]  # Drop categories that the spec does not have.
    group = position[order]
    rank = np.arange(len(order)) - np.searchsorted(group, group)
    slots = np.array(spec.slots)
    kept = rank < slots[group]
    return ((np.cumsum(slots) - slots)[group] + rank)[kept], order[kept]


def encode_layout(scene: Scene, spec: LayoutSpec, clip_heights: bool = True) -> dict[str, np.ndarray]:
    """Encode a scene as compact arrays, which are small enough to send between processes.

    `LayoutBatch.from_compact` converts these arrays to a batch.

    Args:
        scene: Scene that covers the area of `spec.grid`, with any resolution.
        spec: LayoutSpec that defines the encoding.
        clip_heights: Whether to clip ground heights to the bounds of the spec.

    Returns:
        Dictionary with height (G, H, W), occupied (G, H, W) bool, features (N, 9) float32 and real (N,) bool. Heights
        are uint16 if clipped, otherwise int32. A height of 65535 stands for the upper bound.

    Raises:
        ValueError: The scene covers a different area than `spec.grid`, or neither resolution is a whole multiple of the
            other.
    """
    parameters = compute_cholesky_parameters(scene.rotation, scene.size_m)
    primitives = encode_primitives(scene.category, scene.center_m, parameters, spec)
    return encode_ground(scene, spec, clip_heights) | primitives


def encode_ground(scene: Scene, spec: LayoutSpec, clip_heights: bool = True) -> dict[str, np.ndarray]:
    """Encode the rasters of a scene.

    Args:
        scene: Scene that covers the area of `spec.grid`, with any resolution.
        spec: LayoutSpec that defines the encoding.
        clip_heights: Whether to clip heights to the bounds of the spec.

    Returns:
        The entries `height` and `occupied` of `encode_layout`.

    Raises:
        ValueError: The scene covers a different area than `spec.grid`, or neither resolution is a whole multiple of the
            other.
    """
    height_m, occupied = select_ground_classes(scene, spec.ground_classes)
    height = np.zeros(height_m.shape, np.uint16 if clip_heights else np.int32)
    height[occupied] = encode_height(height_m[occupied], spec, clip_heights)
    height, occupied = resample_ground(height, occupied, scene.grid, spec.grid)
    return {"height": height, "occupied": occupied}


def encode_height(height_m: np.ndarray, spec: LayoutSpec, clip_heights: bool = True) -> np.ndarray:
    """Quantise heights in steps of 1/65535 of the interval between the height bounds.

    Args:
        height_m: Heights (metres, scene frame), any shape.
        spec: LayoutSpec with the height bounds, which are mapped to 0 and 65535.
        clip_heights: Whether to clip heights to the bounds.

    Returns:
        Array of the same shape: uint16 if heights are clipped, otherwise int32. Both have the same values within the
        bounds.
    """
    (low,), (high,) = spec.height_bounds_m.low, spec.height_bounds_m.high
    scaled = (height_m - np.float32(low)) * np.float32(65535 / (high - low))
    return np.rint(scaled.clip(0, 65535)).astype(np.uint16) if clip_heights else np.rint(scaled).astype(np.int32)


def encode_primitives(
    category: np.ndarray, center_m: np.ndarray, parameters: np.ndarray, spec: LayoutSpec
) -> dict[str, np.ndarray]:
    """Encode primitives as slots.

    Args:
        category: (n,) categories.
        center_m: (n, 3) centres (metres, scene frame).
        parameters: (n, 6) Cholesky parameters (sqrt(metres)).
        spec: LayoutSpec that defines the slots and the bounds.

    Returns:
        The entries `features` and `real` of `encode_layout`.
    """
    features = np.zeros((spec.num_slots, FEATURES), np.float32)
    real = np.zeros(spec.num_slots, bool)
    slots, primitives = assign_slots(category, center_m, spec)
    features[slots, :3] = spec.center_bounds_m.normalise(center_m[primitives])
    features[slots, 3:] = spec.cholesky_bounds.normalise(parameters[primitives])
    real[slots] = True
    return {"features": features, "real": real}


def make_layout_batch(scenes: list[Scene], spec: LayoutSpec) -> LayoutBatch:
    """Encode scenes as one batch on the CPU.

    Ground heights are not clipped, because the ground branch extrapolates beyond its height bounds. With clipped
    heights, all ground above the upper bound is flattened (docs/experiments/town_model_on_kitti360.md).

    Args:
        scenes: Scenes that cover the area of `spec.grid`.
        spec: LayoutSpec that defines the encoding.

    Returns:
        The batch.

    Raises:
        ValueError: A scene covers a different area than `spec.grid`, or neither resolution is a whole multiple of the
            other.
    """
    layouts = [encode_layout(scene, spec, clip_heights=False) for scene in scenes]
    stacked = {name: np.stack([layout[name] for layout in layouts]) for name in layouts[0]}
    return LayoutBatch.from_compact({name: torch.from_numpy(value) for name, value in stacked.items()})


@dataclass(frozen=True, eq=False)
class DecodedLayout:
    """One decoded layout as numpy arrays, before thresholds are applied.

    Attributes:
        occupancy: (G, H, W) probability that a pixel is occupied.
        height: (G, H, W) normalised heights.
        features: (n, 9) normalised features of the proposals.
        existence: (n,) existence probabilities.
        category: (n,) category of each proposal, as an index into `LayoutSpec.categories`.
    """

    occupancy: np.ndarray
    height: np.ndarray
    features: np.ndarray
    existence: np.ndarray
    category: np.ndarray


def decode_layout(
    layout: DecodedLayout, spec: LayoutSpec, identity: Scene, threshold: float = EXISTENCE_THRESHOLD
) -> Scene:
    """Convert a decoded layout to a Scene (supplement B.2, Layout Reconstruction).

    A pixel is occupied if its occupancy exceeds 0.5.

    Args:
        layout: Output of a decoder.
        spec: LayoutSpec that defines the encoding.
        identity: Scene whose ids, pose and labels are copied to the result.
        threshold: Only primitives with a higher existence probability are kept.

    Returns:
        The scene on `spec.grid`.
    """
    occupied = layout.occupancy > 0.5
    height = np.zeros(occupied.shape, np.float32)
    height[occupied] = spec.height_bounds_m.restore(layout.height[occupied][:, None])[:, 0]
    kept = np.flatnonzero(layout.existence > threshold)
    rotation, size = decode_cholesky_boxes(spec.cholesky_bounds.restore(layout.features[kept, 3:]))
    rotation, size = canonicalize_boxes(rotation, size)
    category = np.array([CATEGORY_INDEX[name] for name in spec.categories], np.int8)[layout.category[kept]]
    return replace(
        identity,
        category=category,
        center_m=spec.center_bounds_m.restore(layout.features[kept, :3]).astype(np.float32),
        rotation=rotation.astype(np.float32),
        size_m=size.astype(np.float32),
        existence=layout.existence[kept].astype(np.float32),
        heading_rad=UNSET,
        instance_id=UNSET,
        label=UNSET,
        ground_classes=spec.ground_classes,
        height_m=height,
        occupied=occupied,
        grid=spec.grid,
    )


def make_empty_scene(scene_id: str, source: str, sequence: str, frame: int, spec: LayoutSpec, **fields: Any) -> Scene:
    """Make an empty generated Scene, for example as the identity for `decode_layout`.

    Args:
        scene_id: Unique id.
        source: Name of the source.
        sequence: Name of the sequence.
        frame: Index within the sequence.
        spec: LayoutSpec with the grid and the ground classes.
        **fields: Other fields of `Scene`.

    Returns:
        A scene that has neither primitives nor ground.
    """
    shape = (len(spec.ground_classes), spec.grid.rows, spec.grid.cols)
    return Scene(
        scene_id=scene_id,
        source=source,
        sequence=sequence,
        frame=frame,
        split="generated",
        category=np.zeros(0, np.int8),
        center_m=np.zeros((0, 3), np.float32),
        rotation=np.zeros((0, 3, 3), np.float32),
        size_m=np.zeros((0, 3), np.float32),
        ground_classes=spec.ground_classes,
        height_m=np.zeros(shape, np.float32),
        occupied=np.zeros(shape, bool),
        grid=spec.grid,
        **fields,
    )
