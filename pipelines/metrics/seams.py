"""Measure the visibility of seams between the known and generated parts of a scene, relative to nearby lines.

A score is the rate across seams divided by the rate across nearby lines. A score of 1 means that seams are invisible. A
line is the border between two adjacent pixel rows or pixel columns. Each seam is compared with its neighbouring lines.
The neighbouring lines are parallel to the seam. A neighbouring line is NEAR_M to FAR_M away from this seam, and at
least NEAR_M away from all other seams. Neighbouring lines therefore do not depend on the seam, but cross similar
streets.

Each scene is summarised by a float64 record of shape (measures, 2, 2). Along the second axis, seams come first, then
neighbouring lines. Along the last axis, the numerator comes first, then the denominator. Records can be added, and a
stack of records can be resampled for confidence intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from models.geometry.iou3d import compute_iou3d_matrix, extract_boxes
from models.scene import Scene, concatenate_primitives
from pipelines.metrics.intervals import Estimate, compute_weights, make_estimate

MEASURES = (
    "class_changes",  # Share of pixel pairs across the line that differ in class, among pairs with ground.
    "height_step",  # Mean height difference across the line (m), over pixel pairs with ground in both pixels.
    "cut_objects",  # Share of the objects near the line that end at the line and do not cross it.
    "doubled_objects",  # Share of objects at the line that overlap an object of their category on the other side.
)
NEAR_M, FAR_M = 4.0, 16.0
END_M = 0.25  # An object ends at a line if the distance between its end and the line is at most END_M (m).
DOUBLE_IOU3D = 0.05


def measure_scene_seams(
    scene: Scene,
    rows: Sequence[int] = (),
    cols: Sequence[int] = (),
    other_rows: Sequence[int] = (),
    other_cols: Sequence[int] = (),
) -> np.ndarray:
    """Measure the seams of one scene and the lines next to them.

    Args:
        scene: Scene with seams.
        rows: Pixel rows; a seam lies before each of these rows.
        cols: Pixel columns; a seam lies before each of these columns.
        other_rows: Rows of seams that are not measured. Neighbouring lines are not close to them either.
        other_cols: Columns of such seams.

    Returns:
        (4, 2, 2) record with the axes MEASURES, (seams, neighbouring lines), (numerator, denominator).

    Raises:
        ValueError: A seam lies on or beyond the edge of the scene.
    """
    grid = scene.grid
    height_m, ground_class = scene.surface()
    total = np.zeros((len(MEASURES), 2, 2))
    corners_m = compute_footprint_ranges(scene)
    doubles = find_doubled_objects(scene)
    for axis, seams, others, count in ((0, rows, other_rows, grid.rows), (1, cols, other_cols, grid.cols)):
        if not seams:
            continue
        if bad := [line for line in seams if not 0 < line < count]:
            raise ValueError(
                f"scene {scene.scene_id}: there is a seam before pixel {bad[0]}, but seams must lie before pixels"
                f" 1 to {count - 1}"
            )
        edge_m = grid.front_m if axis == 0 else grid.left_m
        # Positions are measured from the front or left edge of the scene. They therefore grow with the pixel index.
        low_m, high_m = edge_m - corners_m[:, axis, 1], edge_m - corners_m[:, axis, 0]
        center_m = edge_m - scene.center_m[:, axis]
        pixels = ground_class.swapaxes(0, axis), height_m.swapaxes(0, axis)
        across = np.stack([measure_line(*pixels, line) for line in range(1, count)])
        at_m = grid.resolution_m * np.arange(1, count)
        objects = measure_objects(at_m, low_m, high_m, center_m, doubles)
        every = np.concatenate([across, objects], axis=1)  # Shape (lines, measures, 2).
        for line, near in list_parallel_lines(seams, count, grid.resolution_m, others).items():
            total[:, 0] += every[line - 1]
            total[:, 1] += every[near - 1].mean(axis=0) if len(near) else 0
    return total


def join_unrelated_scenes(far: Scene, near: Scene, row: int) -> Scene:
    """Join the far part of one scene and the near part of another scene, as a control with a visible seam.

    Args:
        far: Scene that provides the ground of the pixel rows before `row`, and the objects with their centre there.
        near: Scene that provides the rest. It has the same ground classes.
        row: Pixel row; the seam lies before this row.

    Returns:
        Copy of `far` with the ground and the objects of both scenes.

    Raises:
        ValueError: The scenes have different grids.
    """
    if far.grid != near.grid:
        raise ValueError(f"{far.scene_id} and {near.scene_id} have different grids: {far.grid} and {near.grid}")
    line_m = far.grid.front_m - row * far.grid.resolution_m
    parts = far.select(far.center_m[:, 0] >= line_m), near.select(near.center_m[:, 0] < line_m)
    return replace(
        far,
        height_m=np.concatenate([far.height_m[..., :row, :], near.height_m[..., row:, :]], axis=-2),
        occupied=np.concatenate([far.occupied[:, :row], near.occupied[:, row:]], axis=1),
        **concatenate_primitives(parts),
    )


def list_parallel_lines(
    seams: Sequence[int], count: int, resolution_m: float, others: Sequence[int] = ()
) -> dict[int, np.ndarray]:
    """List the lines with which each seam is compared.

    Args:
        seams: Index of the pixel after each seam.
        count: Number of pixel rows or columns.
        resolution_m: Pixel size (m).
        others: Index of the pixel after each seam that has no neighbouring lines itself.

    Returns:
        Indices of the neighbouring lines, for each seam.
    """
    lines = np.arange(1, count)
    every = np.array([*seams, *others], int)
    nearest_m = np.abs(lines[:, None] - every.reshape(1, -1)).min(axis=1, initial=count) * resolution_m
    free = lines[nearest_m >= NEAR_M]
    return {seam: free[np.abs(free - seam) * resolution_m <= FAR_M] for seam in seams}


def measure_line(ground_class: np.ndarray, height_m: np.ndarray, line: int) -> np.ndarray:
    """Count class changes and sum height differences across a line.

    Args:
        ground_class: (H, W) index of the ground class; -1 means no ground.
        height_m: (H, W) height of the ground (m).
        line: Index of the row after the line.

    Returns:
        (2, 2) array with the axes (class changes, height differences), (numerator, denominator).
    """
    before, after = ground_class[line - 1], ground_class[line]
    either, both = (before >= 0) | (after >= 0), (before >= 0) & (after >= 0)
    step = np.abs(height_m[line - 1] - height_m[line])[both]
    return np.array([[(before != after).sum(), either.sum()], [step.sum(), both.sum()]], float)


def measure_objects(
    at_m: np.ndarray, low_m: np.ndarray, high_m: np.ndarray, center_m: np.ndarray, doubles: np.ndarray
) -> np.ndarray:
    """Count the cut objects and the doubled objects at lines. Positions are measured along the normal of the lines.

    Args:
        at_m: (l,) positions of the lines (m).
        low_m: (n,) lower ends of the objects along the normal (m).
        high_m: (n,) upper ends of the objects along the normal (m).
        center_m: (n,) centres of the objects along the normal (m).
        doubles: (p, 2) index pairs of objects that overlap and have the same category.

    Returns:
        (l, 2, 2) array with the axes lines, (cut objects, doubled objects), (numerator, denominator).
    """
    at = at_m[:, None]
    ends = (np.abs(low_m - at) <= END_M) | (np.abs(high_m - at) <= END_M)
    crosses = (low_m < at - END_M) & (high_m > at + END_M)
    touches = ends | crosses
    beyond = center_m[None] > at  # Shape (l, n).
    a, b = doubles.T
    parted = (beyond[:, a] != beyond[:, b]) & touches[:, a] & touches[:, b]
    doubled = np.zeros_like(touches)
    for column, pair in enumerate(doubles):
        doubled[np.ix_(parted[:, column], pair)] = True
    number = touches.sum(axis=1)
    return np.stack(
        [np.stack([(ends & ~crosses).sum(axis=1), number], 1), np.stack([doubled.sum(axis=1), number], 1)], 1
    ).astype(float)


def compute_footprint_ranges(scene: Scene) -> np.ndarray:
    """Compute the ranges of x and y that the box of each primitive covers.

    Args:
        scene: Scene with n primitives.

    Returns:
        (n, 2, 2) array with the axes primitives, (x, y), (minimum, maximum) (m, scene frame).
    """
    reach = 0.5 * (np.abs(scene.rotation) * scene.size_m[:, None, :]).sum(axis=2)[:, :2]
    return np.stack([scene.center_m[:, :2] - reach, scene.center_m[:, :2] + reach], axis=2)


def find_doubled_objects(scene: Scene) -> np.ndarray:
    """Find pairs of objects that have the same category and an IoU3D above DOUBLE_IOU3D.

    Args:
        scene: Scene.

    Returns:
        (p, 2) indices of the two objects of each pair.
    """
    boxes = extract_boxes(scene)
    iou = np.triu(compute_iou3d_matrix(boxes, boxes), 1)
    iou[scene.category[:, None] != scene.category] = 0
    return np.argwhere(iou > DOUBLE_IOU3D)


def estimate_seam_ratios(records: np.ndarray, key: int = 0) -> dict[str, Estimate | None]:
    """Estimate the ratio of the rate across seams to the rate across neighbouring lines.

    Args:
        records: (scenes, 4, 2, 2) records of `measure_scene_seams`.
        key: Part of the seed of the bootstrap.

    Returns:
        Ratio with its 95 % interval, for each measure. None: the ratio is undefined because a denominator is 0.
    """
    drawn = np.tensordot(compute_weights(len(records), key), records, axes=1)  # Shape (1 + draws, 4, 2, 2).
    with np.errstate(divide="ignore", invalid="ignore"):
        rates = drawn[..., 0] / drawn[..., 1]
        ratios = rates[..., 0] / rates[..., 1]
    return {
        name: make_estimate(ratios[:, index]) if np.isfinite(ratios[0, index]) else None
        for index, name in enumerate(MEASURES)
    }
