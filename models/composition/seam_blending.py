"""Blend generated ground into known ground at seams.

The decoder reconstructs the known part together with the generated part. The final scene, however, contains the
original known part instead of its reconstruction. Differences between the original and its reconstruction would make
the seam visible. The difference at the seam is therefore added to the generated side, with a weight that decreases with
distance.

The decoder may also produce a height step at the seam between known and generated latent cells. If the slope at the
seam exceeds both MAX_SLOPE and the slope of the known ground, the slope at the seam is reduced in the same way.

The paper pastes the generated part without blending.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import cast

import numpy as np
from scipy.ndimage import distance_transform_edt

from models.composition.deduplicate import find_regenerated_objects
from models.scene import Scene, merge_scenes

BLEND_M = 8.0  # Largest distance from the seam at which generated ground is changed.
MAX_EDGE_SHIFT_M = 2.0  # Largest shift of the edge of a ground class.
MAX_SLOPE = 0.08  # Largest slope across the seam, unless the known ground is steeper.


def blend_ground(generated: Scene, known: Scene, new: np.ndarray) -> Scene:
    """Blend generated ground into the known ground at seams; objects keep their height above the ground.

    Near known pixels of a ground class, the height of the class and the signed distance from its edge are corrected.
    The correction is the difference at the nearest known pixel. Elsewhere, the height is corrected by the difference
    between the fused surfaces of both scenes. This difference is taken at the nearest known pixel where both surfaces
    have the same class.

    Args:
        generated: Scene on the grid of `known`.
        known: Scene with the original content outside `new`.
        new: (rows, cols) bool mask of the generated pixels. All other pixels of `generated` remain unchanged.

    Returns:
        `generated` with blended ground in `new`.
    """
    if new.all() or not new.any():
        return generated
    resolution_m = generated.grid.resolution_m
    window = _find_bounding_window(new, math.ceil(BLEND_M / resolution_m))
    new = new[window]
    given = ~new
    limit_px = MAX_EDGE_SHIFT_M / resolution_m
    distance, nearest = _find_nearest(given)
    weight = _compute_falloff(distance * resolution_m)
    lift_m = _compute_surface_difference(generated, known, window, given)
    occupied, height_m = generated.occupied.copy(), generated.height_m.copy()
    for c in range(len(generated.ground_classes)):
        known_mask, new_mask, known_m, new_m = (
            of[c][window] for of in (known.occupied, generated.occupied, known.height_m, generated.height_m)
        )
        known_mask = known_mask & given
        if not known_mask.any() and not new_mask.any():
            continue
        shift_px = _compute_edge_distance(known_mask, given, limit_px) - _compute_edge_distance(
            new_mask, given, limit_px
        )
        inside = _compute_edge_distance(new_mask, np.ones_like(new), limit_px) + weight * shift_px[nearest] > 0
        # Set the height of the class at every pixel to the height of the nearest generated pixel of the class. If the
        # class has no generated pixel, use the nearest known pixel.
        away, place = _find_nearest(known_mask) if known_mask.any() else (np.full(new.shape, np.inf), nearest)
        level_m = new_m[_find_nearest(new_mask)[1]] if new_mask.any() else known_m[place]
        own = _compute_falloff(away * resolution_m)
        max_step_m = np.maximum(MAX_SLOPE * resolution_m, _compute_largest_steps(known_m, known_mask))
        difference_m = known_m - _limit_step(new_m, level_m, new_mask & new, max_step_m)
        blended_m = level_m + own * difference_m[place] + (1 - own) * lift_m
        occupied[c][window] = np.where(new, inside, new_mask)
        height_m[c][window] = np.where(new, np.where(inside, blended_m, 0), new_m)
    blended = replace(generated, occupied=occupied, height_m=height_m)
    (before_m, class_before), (after_m, class_after) = generated.ground_under(), blended.ground_under()
    center_m = generated.center_m.copy()
    center_m[:, 2] += np.where((class_before >= 0) & (class_after == class_before), after_m - before_m, 0)
    return replace(blended, center_m=center_m)


def extract_new_part(
    generated: Scene, known: Scene, new: np.ndarray, blend: bool = True, kept: np.ndarray | None = None
) -> Scene:
    """Return the generated part of a scene.

    Args:
        generated: Decoded scene on the grid of `known`.
        known: Known part.
        new: (rows, cols) bool mask of the generated pixels.
        blend: If True, blend the ground into the known ground, and remove copies of known objects. If False, leave the
            decoded content as it is, as in the paper.
        kept: (rows, cols) bool mask of those pixels of `new` that the result contains; None: all.

    Returns:
        The scene, which contains only the content of `kept`.
    """
    kept = new if kept is None else kept
    if not blend:
        return merge_scenes([generated], [kept], generated)
    fresh = generated.select(~find_regenerated_objects(generated, known))
    return merge_scenes([blend_ground(fresh, known, new)], [kept], generated)


def extrapolate_ground(known: Scene, unknown: np.ndarray) -> Scene:
    """Fill unknown pixels with the ground of the nearest known pixel before the scene is encoded.

    The receptive field of the encoder extends beyond a cell, so the encoder would interpret empty pixels as an edge of
    the ground.

    Args:
        known: Known part of a scene.
        unknown: (rows, cols) bool mask of the pixels to fill.

    Returns:
        The scene with filled ground.
    """
    if unknown.all() or not unknown.any():
        return known
    row, col = _find_nearest(~unknown)[1]
    return replace(known, occupied=known.occupied[:, row, col], height_m=known.height_m[:, row, col])


def _find_bounding_window(mask: np.ndarray, margin: int) -> tuple[slice, slice]:
    """Return the bounding rectangle of a non-empty mask, enlarged by a margin in pixels."""
    rows, cols = (
        slice(max(0, span[0] - margin), span[-1] + 1 + margin)
        for span in (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    )
    return rows, cols


def _find_nearest(mask: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return the distance in pixels to the nearest pixel of a non-empty mask, and the (row, col) of this pixel."""
    distance, (row, col) = cast(tuple, distance_transform_edt(~mask, return_indices=True))
    return distance, (row, col)


def _compute_surface_difference(
    generated: Scene, known: Scene, window: tuple[slice, slice], given: np.ndarray
) -> np.ndarray:
    """Return the height of the known surface above the generated surface in metres.

    If the two surfaces have different classes at a pixel, the value comes from the nearest pixel where the classes
    agree. This value decreases with the distance to that pixel.
    """
    known_m, known_class = (part[window] for part in known.surface())
    new_m, new_class = (part[window] for part in generated.surface())
    alike = given & (known_class == new_class) & (known_class >= 0)
    if not alike.any():
        return np.zeros(given.shape, np.float32)
    distance, nearest = _find_nearest(alike)
    return _compute_falloff(distance * generated.grid.resolution_m) * (known_m - new_m)[nearest]


def _compute_largest_steps(height_m: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the largest height step between each pixel of a mask and its four neighbours inside the mask.

    The step is 0 for pixels outside the mask and for pixels without such neighbours.
    """
    largest = np.zeros(mask.shape, np.float32)
    for axis in (0, 1):
        height, out = height_m.swapaxes(0, axis), largest.swapaxes(0, axis)
        inside = mask.swapaxes(0, axis)
        step = np.where(inside[1:] & inside[:-1], np.abs(np.diff(height, axis=0)), 0)
        np.maximum(out[1:], step, out=out[1:])
        np.maximum(out[:-1], step, out=out[:-1])
    return largest


def _limit_step(height_m: np.ndarray, level_m: np.ndarray, new: np.ndarray, max_step_m: np.ndarray) -> np.ndarray:
    """Return the expected height of a class at known pixels, extrapolated from the nearest generated pixel.

    The height changes by at most `max_step_m` per pixel.
    """
    if not new.any():
        return level_m
    distance, nearest = _find_nearest(new)
    rise_m = height_m[nearest] - level_m
    return height_m[nearest] - np.clip(rise_m, -max_step_m * distance, max_step_m * distance)


def _compute_falloff(distance_m: np.ndarray) -> np.ndarray:
    """Return a smooth weight that is 1 at the seam and 0 at distances of at least BLEND_M."""
    left = np.clip(1 - distance_m / BLEND_M, 0, 1)
    return left * left * (3 - 2 * left)


def _compute_edge_distance(mask: np.ndarray, domain: np.ndarray, limit: float) -> np.ndarray:
    """Return the signed distance to the edge of a mask in pixels, positive inside, clipped to [-limit, limit]."""
    inside, outside = (
        np.minimum(_find_nearest(side)[0] - 0.5, limit) if side.any() else np.full(mask.shape, limit)
        for side in (mask & domain, ~mask & domain)
    )
    return np.where(mask, outside, -inside)
