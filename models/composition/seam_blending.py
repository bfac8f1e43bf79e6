"""What was made beside known ground goes on from it: near the border its ground is bent to meet the known.

A new part is decoded together with what is known, so the decoder draws both sides as one; but the known side is kept as
it was given, and where the two drawings of it differ, by a pixel of kerb or a centimetre of height, the border would show.
What the drawings differ by at the border is therefore added to the new side, less and less with distance. A decoder that
sees a latent half known and half new may also draw a step right at the border: what is steeper there than STEEPEST and
than the known ground beside it is taken out in the same way. Differs from the paper, which pastes.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.ndimage import distance_transform_edt

from models.composition.deduplicate import doubles
from models.scene import Scene, merge

REACH_M = 8.0  # how far from the border the new ground is bent
LIMIT_M = 2.0  # classes' edges are moved by no more
STEEPEST = 0.08  # rise per metre across the border where known ground is no steeper; more is a step that decoders draw


def continued(made: Scene, known: Scene, new: np.ndarray) -> Scene:
    """`made` with its pixels `new` (rows, cols) bent to meet those of `known`, both scenes of one grid; objects stand as
    high above the ground as before. Other pixels are as they were.

    Per class: its signed distance from the class's edge and its height take up the difference at the nearest known pixel.
    Far from the class's known pixels its height takes up what the surfaces differ by, where both are of one class.
    """
    if new.all() or not new.any():
        return made
    resolution_m = made.grid.resolution_m
    window = _around(new, math.ceil(REACH_M / resolution_m))
    new = new[window]
    given = ~new
    limit = LIMIT_M / resolution_m
    distance, nearest = _nearest(given)
    share = _falling(distance * resolution_m)
    lifted_m = _surface_difference(made, known, window, given)
    occupied, height_m = made.occupied.copy(), made.height_m.copy()
    for c in range(len(made.ground_classes)):
        was, is_made, was_m, is_made_m = (
            of[c][window] for of in (known.occupied, made.occupied, known.height_m, made.height_m)
        )
        was = was & given
        if not was.any() and not is_made.any():
            continue
        differs = _edge_distance(was, given, limit) - _edge_distance(is_made, given, limit)
        inside = _edge_distance(is_made, np.ones_like(new), limit) + share * differs[nearest] > 0
        # The class's height everywhere: that of its nearest pixel, of the known ones if none was made.
        away, place = _nearest(was) if was.any() else (np.full(new.shape, np.inf), nearest)
        level_m = is_made_m[_nearest(is_made)[1]] if is_made.any() else was_m[place]
        own = _falling(away * resolution_m)
        steepest_m = np.maximum(STEEPEST * resolution_m, _steps(was_m, was))
        differs_m = was_m - _across(is_made_m, level_m, is_made & new, steepest_m)
        risen_m = level_m + own * differs_m[place] + (1 - own) * lifted_m
        occupied[c][window] = np.where(new, inside, is_made)
        height_m[c][window] = np.where(new, np.where(inside, risen_m, 0), is_made_m)
    bent = replace(made, occupied=occupied, height_m=height_m)
    (before_m, class_before), (after_m, class_after) = made.ground_under(), bent.ground_under()
    center_m = made.center_m.copy()
    center_m[:, 2] += np.where((class_before >= 0) & (class_after == class_before), after_m - before_m, 0)
    return replace(bent, center_m=center_m)


def new_part(made: Scene, known: Scene, new: np.ndarray) -> Scene:
    """What was made in the pixels `new`, fit to be put beside `known`: its ground meets it, no object of it comes again."""
    fresh = made.select(~doubles(made, known))
    return merge([continued(fresh, known, new)], [new], made)


def spread(known: Scene, unknown: np.ndarray) -> Scene:
    """A scene to encode: its pixels `unknown` (rows, cols) bear the ground of the nearest known one.

    An encoder looks a little beyond a cell; left empty, what is merely not known yet would be an edge to it.
    """
    if unknown.all() or not unknown.any():
        return known
    row, col = _nearest(~unknown)[1]
    return replace(known, occupied=known.occupied[:, row, col], height_m=known.height_m[:, row, col])


def _around(mask: np.ndarray, margin: int) -> tuple[slice, slice]:
    """The rectangle of a mask that is not empty, with a margin."""
    spans = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return tuple(slice(max(0, span[0] - margin), span[-1] + 1 + margin) for span in spans)


def _nearest(mask: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Distance in pixels to the nearest pixel of a mask that is not empty, and which one that is."""
    distance, (row, col) = distance_transform_edt(~mask, return_indices=True)
    return distance, (row, col)


def _surface_difference(made: Scene, known: Scene, window: tuple[slice, slice], given: np.ndarray) -> np.ndarray:
    """Metres by which the known surface lies above the made one where both are of one class, less and less away from there."""
    (was_m, was), (is_made_m, is_made) = ([part[window] for part in scene.surface()] for scene in (known, made))
    alike = given & (was == is_made) & (was >= 0)
    if not alike.any():
        return np.zeros(given.shape, np.float32)
    distance, nearest = _nearest(alike)
    return _falling(distance * made.grid.resolution_m) * (was_m - is_made_m)[nearest]


def _steps(height_m: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The largest step of height from each pixel of a mask to those of its four neighbours that are in it; 0 if none is."""
    largest = np.zeros(mask.shape, np.float32)
    for axis in (0, 1):
        height, inside, out = (of.swapaxes(0, axis) for of in (height_m, mask, largest))
        step = np.where(inside[1:] & inside[:-1], np.abs(np.diff(height, axis=0)), 0)
        np.maximum(out[1:], step, out=out[1:])
        np.maximum(out[:-1], step, out=out[:-1])
    return largest


def _across(height_m: np.ndarray, level_m: np.ndarray, new: np.ndarray, steepest_m: np.ndarray) -> np.ndarray:
    """The level of a class as it is seen from its nearest new pixel: of a step between the two no more than steepest_m
    per pixel is the ground's, the rest is left out."""
    if not new.any():
        return level_m
    distance, nearest = _nearest(new)
    rise_m = height_m[nearest] - level_m
    return height_m[nearest] - np.clip(rise_m, -steepest_m * distance, steepest_m * distance)


def _falling(distance_m: np.ndarray) -> np.ndarray:
    """1 at the border, 0 from REACH_M on, smooth."""
    left = np.clip(1 - distance_m / REACH_M, 0, 1)
    return left * left * (3 - 2 * left)


def _edge_distance(mask: np.ndarray, domain: np.ndarray, limit: float) -> np.ndarray:
    """Signed distance in pixels from the edge of a mask inside a domain, positive in the mask, within +-limit."""
    inside, outside = (
        np.minimum(_nearest(side)[0] - 0.5, limit) if side.any() else np.full(mask.shape, limit)
        for side in (mask & domain, ~mask & domain)
    )
    return np.where(mask, outside, -inside)
