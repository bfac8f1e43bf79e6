"""Scene <-> layout tensors under a LayoutSpec: normalise, keep the nearest, pad; and back with a threshold."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from models.batch import LayoutBatch
from models.geometry.cholesky import compute_cholesky_parameters, decode_cholesky_boxes
from models.layout import FEATURES, LayoutSpec
from models.scene import CATEGORY_INDEX, UNSET, Grid, Scene, canonicalize_boxes

EXISTENCE_THRESHOLD = 0.3  # paper, supplement B.2, Implementation Details


def resample_scene_ground(scene: Scene, ground_classes: tuple[str, ...], grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """height_m and occupied (G, H, W) of the named classes on a grid over the same ground (`resample_ground`)."""
    return resample_ground(*select_ground_classes(scene, ground_classes), scene.grid, grid)


def select_ground_classes(scene: Scene, ground_classes: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """height_m and occupied of the named classes; those that the scene does not have are empty."""
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
    """Heights (G, H, W), metres or whole numbers, and masks on another grid over the same ground.

    Coarser: a pixel is occupied where at least half of it is, its height the mean over the occupied part. Finer:
    nearest. Raises ValueError if the grids do not cover the same ground, or if the ratio of pixels is not whole.
    """
    covered, wanted = ((g.front_m, g.left_m, g.back_m, g.right_m) for g in (own, grid))
    if not np.allclose(covered, wanted):
        raise ValueError(f"the scene covers {own}, wanted is {grid}")
    if grid.rows == own.rows:
        return height, occupied
    if own.rows % grid.rows == 0:
        f = own.rows // grid.rows
        wide = np.uint32 if height.dtype.kind == "u" else height.dtype
        count, total = _sum_blocks(occupied.view(np.uint8), f, np.uint8), _sum_blocks(height, f, wide)
        keep = 2 * count.astype(np.int16) >= f * f
        mean = total / np.maximum(count, 1).astype(np.float32)
        mean = np.rint(mean) if height.dtype.kind == "u" else mean
        return np.where(keep, mean, 0).astype(height.dtype), keep
    if grid.rows % own.rows == 0:
        f = grid.rows // own.rows
        height, occupied = (a.repeat(f, axis=1).repeat(f, axis=2) for a in (height, occupied))
        return height, occupied
    raise ValueError(f"{own.rows} pixels do not divide into {grid.rows}")


def _sum_blocks(values: np.ndarray, f: int, dtype: np.typing.DTypeLike) -> np.ndarray:
    """(G, H / f, W / f) sums over f x f blocks: whole rows first, then strided columns of what is left."""
    rows = sum(
        (values[:, i::f].astype(dtype, copy=False) for i in range(1, f)), values[:, ::f].astype(dtype, copy=False)
    )
    return sum((rows[:, :, j::f] for j in range(1, f)), rows[:, :, ::f])


def assign_slots(category: np.ndarray, center_m: np.ndarray, spec: LayoutSpec) -> tuple[np.ndarray, np.ndarray]:
    """Which primitive sits in which slot: (m,) slots and (m,) primitive indices.

    A category with more primitives than slots keeps those nearest to the ego vehicle (supplement A).
    """
    position = np.full(len(CATEGORY_INDEX), -1)
    position[[CATEGORY_INDEX[name] for name in spec.categories]] = np.arange(len(spec.categories))
    position = position[category]
    order = np.lexsort((np.linalg.norm(center_m, axis=1), position))
    order = order[np.searchsorted(position[order], 0) :]  # categories that the spec does not have
    group = position[order]
    rank = np.arange(len(order)) - np.searchsorted(group, group)
    slots = np.array(spec.slots)
    kept = rank < slots[group]
    return ((np.cumsum(slots) - slots)[group] + rank)[kept], order[kept]


def encode_layout(scene: Scene, spec: LayoutSpec) -> dict[str, np.ndarray]:
    """The layout of one scene as small arrays, cheap to send between processes: `LayoutBatch.from_compact` unpacks.

    height (G, H, W) uint16 in 65535ths of the bounds, occupied (G, H, W) bool, features (N, 9) float32, real (N,).
    """
    parameters = compute_cholesky_parameters(scene.rotation, scene.size_m)
    return encode_ground(scene, spec) | encode_primitives(scene.category, scene.center_m, parameters, spec)


def encode_ground(scene: Scene, spec: LayoutSpec) -> dict[str, np.ndarray]:
    """height and occupied of `encode_layout`."""
    height_m, occupied = select_ground_classes(scene, spec.ground_classes)
    height = np.zeros(height_m.shape, np.uint16)
    height[occupied] = encode_height(height_m[occupied], spec)
    height, occupied = resample_ground(height, occupied, scene.grid, spec.grid)
    return {"height": height, "occupied": occupied}


def encode_height(height_m: np.ndarray, spec: LayoutSpec) -> np.ndarray:
    """Heights in 65535ths of the spec's bounds, uint16, clipped."""
    (low,), (high,) = spec.height_bounds_m.low, spec.height_bounds_m.high
    scaled = (height_m - np.float32(low)) * np.float32(65535 / (high - low))
    return np.rint(scaled.clip(0, 65535)).astype(np.uint16)


def encode_primitives(
    category: np.ndarray, center_m: np.ndarray, parameters: np.ndarray, spec: LayoutSpec
) -> dict[str, np.ndarray]:
    """features and real of `encode_layout` from categories (n,), centres (n, 3) and Cholesky parameters (n, 6)."""
    features = np.zeros((spec.num_slots, FEATURES), np.float32)
    real = np.zeros(spec.num_slots, bool)
    slots, primitives = assign_slots(category, center_m, spec)
    features[slots, :3] = spec.center_bounds_m.normalise(center_m[primitives])
    features[slots, 3:] = spec.cholesky_bounds.normalise(parameters[primitives])
    real[slots] = True
    return {"features": features, "real": real}


def make_layout_batch(scenes: list[Scene], spec: LayoutSpec) -> LayoutBatch:
    """Scenes as one batch on the CPU."""
    layouts = [encode_layout(scene, spec) for scene in scenes]
    stacked = {name: np.stack([layout[name] for layout in layouts]) for name in layouts[0]}
    return LayoutBatch.from_compact({name: torch.from_numpy(value) for name, value in stacked.items()})


@dataclass(frozen=True, eq=False)
class DecodedLayout:
    """One decoded layout, as numpy: probabilities and normalised values, before any threshold."""

    occupancy: np.ndarray  # (G, H, W) probability
    height: np.ndarray  # (G, H, W) normalised
    features: np.ndarray  # (n, 9) normalised
    existence: np.ndarray  # (n,) probability
    category: np.ndarray  # (n,) position in the spec's categories


def decode_layout(
    layout: DecodedLayout, spec: LayoutSpec, identity: Scene, threshold: float = EXISTENCE_THRESHOLD
) -> Scene:
    """The Scene a decoder means (supplement B.2, Layout Reconstruction); ids, pose and labels from `identity`.

    Primitives with existence probability above `threshold` are kept, ground where occupancy exceeds one half.
    """
    occupied = layout.occupancy > 0.5
    height = spec.height_bounds_m.restore(layout.height[..., None])[..., 0]
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
        height_m=np.where(occupied, height, 0).astype(np.float32),
        occupied=occupied,
        grid=spec.grid,
    )


def make_empty_scene(scene_id: str, source: str, sequence: str, frame: int, spec: LayoutSpec, **fields) -> Scene:
    """An empty generated Scene to hand to `decode_layout` as its identity."""
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
