"""Scene <-> layout tensors under a LayoutSpec: normalise, keep the nearest, pad; and back with a threshold."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from models.cholesky import boxes_from_cholesky, cholesky_parameters
from models.layout import FEATURES, LayoutBatch, LayoutSpec
from models.scene import CATEGORY_INDEX, Grid, Scene, canonical_boxes

EXISTENCE_THRESHOLD = 0.3  # paper, supplement B.2, Implementation Details


def ground_on_grid(scene: Scene, ground_classes: tuple[str, ...], grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """height_m (G, H, W) and occupied (G, H, W) of the named classes on a grid over the same ground.

    Raises ValueError if the grids do not cover the same ground. Coarser: a pixel is occupied where at least half of it is, its height the mean over the occupied part. Finer:
    nearest. Classes that the scene does not have are empty. The ratio of pixels must be whole (ValueError).
    """
    covers = [(g.front_m, g.left_m, g.back_m, g.right_m) for g in (scene.grid, grid)]
    if not np.allclose(*covers):
        raise ValueError(f"scene {scene.scene_id} covers {scene.grid}, wanted is {grid}")
    shape = (len(ground_classes), scene.grid.rows, scene.grid.cols)
    height, occupied = np.zeros(shape, np.float32), np.zeros(shape, bool)
    for k, name in enumerate(ground_classes):
        if name in scene.ground_classes:
            own = scene.ground_classes.index(name)
            height[k], occupied[k] = scene.height_m[own], scene.occupied[own]
    if grid.rows == scene.grid.rows:
        return height, occupied
    if scene.grid.rows % grid.rows == 0:
        f = scene.grid.rows // grid.rows
        # Adding f x f strided views is six times as fast as one reduction over block axes.
        corners = [(slice(None), slice(i, None, f), slice(j, None, f)) for i in range(f) for j in range(f)]
        count = sum(occupied[corner].astype(np.int16) for corner in corners)
        total = sum(height[corner] for corner in corners)
        keep = 2 * count >= f * f
        return np.where(keep, total / np.maximum(count, 1), 0).astype(np.float32), keep
    if grid.rows % scene.grid.rows == 0:
        f = grid.rows // scene.grid.rows
        return tuple(a.repeat(f, axis=1).repeat(f, axis=2) for a in (height, occupied))
    raise ValueError(f"scene {scene.scene_id}: {scene.grid.rows} pixels do not divide into {grid.rows}")


def slot_primitives(scene: Scene, spec: LayoutSpec) -> tuple[np.ndarray, np.ndarray]:
    """Which primitive sits in which slot: (m,) slots and (m,) primitive indices.

    A category with more primitives than slots keeps those nearest to the ego vehicle (supplement A).
    """
    distance = np.linalg.norm(scene.center_m, axis=1)
    first = np.cumsum(spec.slots) - spec.slots
    slots, primitives = [], []
    for name, start, capacity in zip(spec.categories, first, spec.slots, strict=True):
        members = np.flatnonzero(scene.category == CATEGORY_INDEX[name])
        members = members[np.argsort(distance[members], kind="stable")][:capacity]
        slots.append(start + np.arange(len(members)))
        primitives.append(members)
    return np.concatenate(slots), np.concatenate(primitives)


def compact_layout(scene: Scene, spec: LayoutSpec) -> dict[str, np.ndarray]:
    """The layout of one scene as small arrays, cheap to send between processes: `LayoutBatch.from_compact` unpacks.

    height (G, H, W) uint16 in 65535ths of the bounds, occupied (G, H, W) bool, features (N, 9) float32, real (N,).
    """
    height_m, occupied = ground_on_grid(scene, spec.ground_classes, spec.grid)
    height = spec.height_bounds_m.normalise(height_m[..., None])[..., 0] * occupied
    features = np.zeros((spec.num_slots, FEATURES), np.float32)
    real = np.zeros(spec.num_slots, bool)
    slots, primitives = slot_primitives(scene, spec)
    features[slots, :3] = spec.center_bounds_m.normalise(scene.center_m[primitives])
    parameters = cholesky_parameters(scene.rotation[primitives], scene.size_m[primitives])
    features[slots, 3:] = spec.cholesky_bounds.normalise(parameters)
    real[slots] = True
    return {
        "height": np.round(height * 65535).astype(np.uint16),
        "occupied": occupied,
        "features": features,
        "real": real,
    }


def layout_batch(scenes: list[Scene], spec: LayoutSpec) -> LayoutBatch:
    """Scenes as one batch on the CPU."""
    layouts = [compact_layout(scene, spec) for scene in scenes]
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


def scene_from_layout(
    layout: DecodedLayout, spec: LayoutSpec, identity: Scene, threshold: float = EXISTENCE_THRESHOLD
) -> Scene:
    """The Scene a decoder means (supplement B.2, Layout Reconstruction); ids, pose and labels from `identity`.

    Primitives with existence probability above `threshold` are kept, ground where occupancy exceeds one half.
    """
    occupied = layout.occupancy > 0.5
    height = spec.height_bounds_m.restore(layout.height[..., None])[..., 0]
    kept = np.flatnonzero(layout.existence > threshold)
    rotation, size = boxes_from_cholesky(spec.cholesky_bounds.restore(layout.features[kept, 3:]))
    rotation, size = canonical_boxes(rotation, size)
    category = np.array([CATEGORY_INDEX[name] for name in spec.categories], np.int8)[layout.category[kept]]
    return replace(
        identity,
        category=category,
        center_m=spec.center_bounds_m.restore(layout.features[kept, :3]).astype(np.float32),
        rotation=rotation.astype(np.float32),
        size_m=size.astype(np.float32),
        existence=layout.existence[kept].astype(np.float32),
        heading_rad=None,
        instance_id=None,
        label=None,
        ground_classes=spec.ground_classes,
        height_m=np.where(occupied, height, 0).astype(np.float32),
        occupied=occupied,
        grid=spec.grid,
    )


def new_scene(scene_id: str, source: str, sequence: str, frame: int, spec: LayoutSpec, **fields) -> Scene:
    """An empty generated Scene to hand to `scene_from_layout` as its identity."""
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
