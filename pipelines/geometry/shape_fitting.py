"""Fit boxes and ellipsoids to the vertices of their meshes."""

from __future__ import annotations

import numpy as np

FIT_M = 0.01  # Maximum distance of a vertex from the fitted box or ellipsoid.
LIMITS_M = (1e-3, 1e3)  # Smallest and largest valid size.
SIGNS = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3, indexing="ij")).reshape(3, 8)  # Corners of the unit box.

# center_m (n, 3), rotation (n, 3, 3), size_m (n, 3); axes in any order
Shapes = tuple[np.ndarray, np.ndarray, np.ndarray]


def fit_boxes_to_edges(edges_m: np.ndarray, center_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit boxes to edge vectors.

    The longest edge determines the first axis of the box. A short edge is unsuitable, because rounding errors change
    the direction of a short edge more. With a wrong direction, the corners of a long box would be displaced.

    Args:
        edges_m: (n, 3, 3); columns are the edge vectors of a box (m).
        center_m: (n, 3) centres for error messages (m).

    Returns:
        rotation (n, 3, 3) and size_m (n, 3).

    Raises:
        ValueError: A corner of the fitted box deviates by more than FIT_M, or a size lies outside LIMITS_M.
    """
    order = np.argsort(-np.linalg.norm(edges_m, axis=1), axis=1, kind="stable")[:, None, :]
    first, second, third = np.moveaxis(np.take_along_axis(edges_m, order, axis=2), 2, 0)
    # An edge of length 0 gives NaN, which the check below rejects.
    with np.errstate(invalid="ignore", divide="ignore"):
        u = first / np.linalg.norm(first, axis=1, keepdims=True)
        second = second - (second * u).sum(axis=1, keepdims=True) * u
        v = second / np.linalg.norm(second, axis=1, keepdims=True)
    w = np.cross(u, v)
    w = np.where((w * third).sum(axis=1, keepdims=True) < 0, -w, w)
    rotation = np.empty_like(edges_m, dtype=float)
    np.put_along_axis(rotation, np.broadcast_to(order, rotation.shape), np.stack([u, v, w], axis=2), axis=2)
    size_m = (rotation * edges_m).sum(axis=1)
    off_m = np.linalg.norm(edges_m - rotation * size_m[:, None], axis=1).sum(axis=1) / 2
    _refuse(~(off_m <= FIT_M), center_m, "is not a box, because its edges are not perpendicular")
    _refuse_sizes(size_m, center_m)
    return rotation, size_m


def fit_boxes_to_corners(corners_m: np.ndarray) -> Shapes:
    """Fit boxes to their eight corners.

    The two shortest vectors from a corner to the other corners are edges. The third edge is the difference between the
    vector to the opposite corner and the sum of these two edges.

    Args:
        corners_m: (n, 8, 3) corners of each box in any order (m).

    Returns:
        Centre, rotation and size of each box.

    Raises:
        ValueError: The points of an entry are not the corners of a box.
    """
    center_m, start_m = corners_m.mean(axis=1), corners_m[:, 0]
    ways_m = corners_m[:, 1:] - start_m[:, None]
    shortest = np.argsort(np.linalg.norm(ways_m, axis=2), axis=1)[:, :2, None]
    edges_m = np.take_along_axis(ways_m, shortest, axis=1)
    third_m = 2 * (center_m - start_m) - edges_m.sum(axis=1)
    edges_m = np.swapaxes(np.concatenate([edges_m, third_m[:, None]], axis=1), 1, 2)
    built_m = center_m[:, None] + np.swapaxes(edges_m @ SIGNS, 1, 2)
    apart_m = np.linalg.norm(corners_m[:, :, None] - built_m[:, None], axis=3)
    off_m = np.maximum(apart_m.min(axis=1).max(axis=1), apart_m.min(axis=2).max(axis=1))
    _refuse(~(off_m <= FIT_M), center_m, "has eight vertices that are not the corners of a box")
    return center_m, *fit_boxes_to_edges(edges_m, center_m)


def fit_ellipsoids(clouds: list[np.ndarray]) -> Shapes:
    """Fit an ellipsoid to each point cloud.

    Args:
        clouds: Points (k, 3) of each ellipsoid, k >= 9 (m).

    Returns:
        Centre, rotation and size of each ellipsoid.

    Raises:
        ValueError: No ellipsoid fits a cloud within FIT_M.
    """
    fits = [_fit_ellipsoid(points) for points in clouds]
    center_m, rotation, size_m = (
        np.array([fit[k] for fit in fits]).reshape(shape) for k, shape in enumerate([(-1, 3), (-1, 3, 3), (-1, 3)])
    )
    _refuse_sizes(size_m, center_m)
    return center_m, rotation, size_m


def _fit_ellipsoid(points_m: np.ndarray) -> Shapes:
    """Fit the quadric x^T M x + 2 b^T x = 1 to points.

    The fit uses coordinates in which the points have the same spread along all axes.
    """
    mean_m = points_m.mean(axis=0)
    _, spread, axes = np.linalg.svd(points_m - mean_m, full_matrices=False)
    if not spread[-1] > 1e-9 * spread[0]:
        raise _make_refusal(mean_m, "is flat and therefore not an ellipsoid")
    world_from_local = axes.T * (spread / np.sqrt(len(points_m) / 3))
    local = np.linalg.solve(world_from_local, (points_m - mean_m).T).T
    x, y, z = local.T
    terms = np.stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z], axis=1)
    (xx, yy, zz, xy, xz, yz, *b), _, rank, _ = np.linalg.lstsq(terms, np.ones(len(local)))
    quadric, b = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), np.array(b)
    if rank == 9 and (np.linalg.eigvalsh(quadric) > 0).all():
        center = -np.linalg.solve(quadric, b)
        quadric = quadric / (1 - b @ center)  # (x - center)^T quadric (x - center) = 1
        beyond = np.sqrt(np.einsum("ki,ij,kj->k", local - center, quadric, local - center)) - 1
        scatter_m2 = world_from_local @ np.linalg.inv(quadric) @ world_from_local.T
        square_m2, rotation = np.linalg.eigh(scatter_m2)
        if np.abs(beyond).max() * np.sqrt(square_m2.mean()) <= FIT_M:
            return mean_m + world_from_local @ center, rotation, 2 * np.sqrt(square_m2)
    raise _make_refusal(mean_m, f"has {len(points_m)} vertices that lie neither on a box nor on an ellipsoid")


def _refuse_sizes(size_m: np.ndarray, center_m: np.ndarray) -> None:
    beyond = ~np.all((size_m >= LIMITS_M[0]) & (size_m <= LIMITS_M[1]), axis=1)
    _refuse(beyond, center_m, "is thinner than 1 mm or longer than 1 km")


def _refuse(bad: np.ndarray, center_m: np.ndarray, what: str) -> None:
    if bad.any():
        raise _make_refusal(center_m[bad][0], what, int(bad.sum()))


def _make_refusal(center_m: np.ndarray, what: str, count: int = 1) -> ValueError:
    """Return the error for the piece at center_m (3,), which is one of `count` pieces with the same defect."""
    x, y, z = center_m
    return ValueError(
        f"the piece at x {x:.2f}, y {y:.2f}, z {z:.2f} m {what} ({count} such pieces); export primitives as"
        " separate boxes and spheres"
    )
