"""Tests of IoU3D against the volumes of polytopes from manifold3d and from intersections of half-spaces."""

import manifold3d
import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError
from scipy.spatial.transform import Rotation

from models.geometry import iou3d
from models.geometry.iou3d import (
    Boxes,
    compute_iou3d_matrix,
    compute_iou3d_pairs,
    find_intersecting_pairs,
    make_boxes,
)
from models.scene import make_yaw_rotation

TOLERANCE = 1e-4


def make_solid(center_m, rotation, size_m):
    return manifold3d.Manifold.cube(size_m.tolist(), True).transform(np.column_stack([rotation, center_m]))


def compute_manifold_iou(a: Boxes, b: Boxes) -> np.ndarray:
    solids_a, solids_b = ([make_solid(*box) for box in zip(*side, strict=True)] for side in (a, b))
    common = np.array([(x ^ y).volume() for x, y in zip(solids_a, solids_b, strict=True)])
    return common / (a.volume_m3 + b.volume_m3 - common)


def compute_halfspace_iou(a: Boxes, b: Boxes, i: int) -> float:
    """Return the IoU of pair i. The intersection of the boxes is the intersection of twelve half-spaces.

    The IoU is 0 if the intersection contains no ball of radius 1e-9 m.
    """
    normals, offsets = [], []
    for box in (a, b):
        axes = box.rotation[i].T
        for sign in (-1, 1):
            normals.append(sign * axes)
            offsets.append(-(sign * axes @ box.center_m[i] + box.size_m[i] / 2))
    normals, offsets = np.concatenate(normals), np.concatenate(offsets)
    inner = linprog(
        [0, 0, 0, -1],
        A_ub=np.column_stack([normals, np.ones(12)]),
        b_ub=-offsets,
        bounds=[(None, None)] * 3 + [(0, None)],
    )
    if inner.status != 0 or inner.x[3] < 1e-9:
        return 0.0
    try:
        halfspaces = np.column_stack([normals, offsets])
        common = ConvexHull(HalfspaceIntersection(halfspaces, inner.x[:3]).intersections, qhull_options="QJ").volume
    except QhullError:
        return np.nan
    return common / (a.volume_m3[i] + b.volume_m3[i] - common)


def draw_boxes(rng, n, spread_m=1.0, low_m=0.05, high_m=20.0) -> Boxes:
    size_m = np.exp(rng.uniform(np.log(low_m), np.log(high_m), (n, 3)))
    return make_boxes(rng.normal(0, spread_m, (n, 3)), Rotation.random(n, rng=rng).as_matrix(), size_m)


def disturb(rng, a: Boxes, noise: float) -> Boxes:
    """Return the boxes after random changes of centres and extents (`noise` in m) and of axes (`noise` in rad)."""
    turn = Rotation.from_rotvec(noise * rng.normal(size=(len(a.size_m), 3))).as_matrix()
    center_m = a.center_m + noise * rng.normal(size=a.center_m.shape)
    return make_boxes(center_m, turn @ a.rotation, np.maximum(a.size_m + noise * rng.normal(size=a.size_m.shape), 0.01))


def shift(a: Boxes, share: float, axis: int) -> Boxes:
    """Return the boxes after a shift along one of their axes by a fraction of their extent."""
    return a._replace(center_m=a.center_m + share * a.rotation[:, :, axis] * a.size_m[:, axis, None])


def permute_axes(a: Boxes, order: list[int]) -> Boxes:
    """Return the same solids with permuted axes; a permutation is a rotation by 90 degrees."""
    return make_boxes(a.center_m, a.rotation[:, :, order], a.size_m[:, order])


def draw_pairs(rng) -> dict[str, tuple[Boxes, Boxes]]:
    n = 800
    a, upright = draw_boxes(rng, n), draw_boxes(rng, n)
    yaw = rng.uniform(-np.pi, np.pi, n)
    upright = make_boxes(upright.center_m, make_yaw_rotation(yaw), upright.size_m)
    square = a._replace(size_m=np.repeat(a.size_m[:, :1], 3, axis=1))
    quarter = make_boxes(a.center_m, a.rotation @ make_yaw_rotation(np.pi / 2), a.size_m)
    inside = make_boxes(
        a.center_m, Rotation.random(n, rng=rng).as_matrix(), a.size_m.min(axis=1)[:, None] * np.full(3, 0.5)
    )
    return {
        "random": (a, draw_boxes(rng, n)),
        "random, alike in size": (draw_boxes(rng, n, 0.5, 1, 4), draw_boxes(rng, n, 0.5, 1, 4)),
        "upright": (upright, disturb(rng, upright, 0.3)),
        **{f"noise {noise}": (a, disturb(rng, a, noise)) for noise in (0, 1e-9, 1e-6, 1e-3, 0.01, 0.05)},
        "upright noise 0.03": (upright, disturb(rng, upright, 0.03)),
        "axes renamed": (a, permute_axes(a, [1, 2, 0])),
        "mirrored axes": (a, permute_axes(a, [1, 0, 2])),
        "cube turned by 90 degrees": (square, square._replace(rotation=quarter.rotation)),
        "turned by 90 degrees": (a, quarter),
        "sharing four faces": (a, shift(a, 0.4, 0)),
        "touching": (a, shift(a, 1.0, 1)),
        "contained": (a, inside),
        "half the size, sharing three faces": (a, shift(a._replace(size_m=a.size_m / [2, 1, 1]), 0.5, 0)),
        "float32": (a, make_boxes(*(part.astype(np.float32) for part in a))),
    }


def test_iou3d_of_10000_pairs_is_within_1e_4_of_oracle():
    cases, total, off = draw_pairs(np.random.default_rng(0)), 0, []
    for name, (a, b) in cases.items():
        ours, oracle = compute_iou3d_pairs(a, b), compute_manifold_iou(a, b)
        assert (ours >= 0).all() and (ours <= 1).all(), name
        for i in np.flatnonzero(~(np.abs(ours - oracle) <= TOLERANCE)):
            if not abs(ours[i] - compute_halfspace_iou(a, b, i)) <= TOLERANCE:
                off.append((name, i, ours[i], oracle[i], compute_halfspace_iou(a, b, i)))
        total += len(ours)
    assert total >= 10_000
    assert not off, off


def test_iou3d_agrees_with_both_oracles_on_random_pairs():
    rng = np.random.default_rng(1)
    a, b = draw_boxes(rng, 60, 0.5, 0.5, 4), draw_boxes(rng, 60, 0.5, 0.5, 4)
    np.testing.assert_allclose(
        compute_iou3d_pairs(a, b), [compute_halfspace_iou(a, b, i) for i in range(60)], atol=1e-7
    )
    np.testing.assert_allclose(compute_iou3d_pairs(a, b), compute_manifold_iou(a, b), atol=1e-7)


def test_iou3d_equals_hand_computed_cases():
    unit = make_boxes(np.zeros((1, 3)), np.eye(3)[None], np.ones((1, 3)))
    assert compute_iou3d_pairs(unit, unit) == pytest.approx(1, abs=1e-12)
    assert compute_iou3d_pairs(unit, shift(unit, 0.5, 0)) == pytest.approx(1 / 3, abs=1e-8)
    assert compute_iou3d_pairs(unit, shift(unit, 1.0, 0)) == pytest.approx(0, abs=1e-8)
    assert compute_iou3d_pairs(unit, shift(unit, 5.0, 2)) == 0
    assert compute_iou3d_pairs(unit, unit._replace(size_m=np.full((1, 3), 0.5))) == pytest.approx(1 / 8, abs=1e-8)
    diagonal = make_yaw_rotation(np.array([np.pi / 4]))
    octagon = 2 * (np.sqrt(2) - 1)  # two unit squares with an angle of 45 degrees between them
    assert compute_iou3d_pairs(unit, unit._replace(rotation=diagonal)) == pytest.approx(
        octagon / (2 - octagon), abs=1e-8
    )


def test_iou3d_is_symmetric_and_invariant_to_pose_and_chunks(monkeypatch):
    rng = np.random.default_rng(2)
    a, b = draw_boxes(rng, 300), draw_boxes(rng, 300)
    iou = compute_iou3d_pairs(a, b)
    np.testing.assert_allclose(iou, compute_iou3d_pairs(b, a), atol=1e-6)
    turn, shift = Rotation.random(rng=rng).as_matrix(), rng.normal(0, 100, 3)
    moved = [make_boxes(x.center_m @ turn.T + shift, turn @ x.rotation, x.size_m) for x in (a, b)]
    np.testing.assert_allclose(iou, compute_iou3d_pairs(*moved), atol=1e-6)
    monkeypatch.setattr(iou3d, "PAIRS_PER_CHUNK", 7)
    np.testing.assert_array_equal(iou, compute_iou3d_pairs(a, b))


def test_iou3d_matrix_equals_pairs_and_accepts_empty_sides():
    rng = np.random.default_rng(3)
    a, b = draw_boxes(rng, 40, 10), draw_boxes(rng, 30, 10)
    i, j = np.indices((40, 30)).reshape(2, -1)
    np.testing.assert_array_equal(compute_iou3d_matrix(a, b), compute_iou3d_pairs(a.take(i), b.take(j)).reshape(40, 30))
    wanted = rng.random((40, 30)) < 0.5
    np.testing.assert_array_equal(compute_iou3d_matrix(a, b, wanted), compute_iou3d_matrix(a, b) * wanted)
    empty = a.take(np.arange(0))
    assert compute_iou3d_matrix(empty, b).shape == (0, 30) and compute_iou3d_matrix(a, empty).shape == (40, 0)


def test_iou3d_of_boxes_without_volume_is_zero():
    flat = make_boxes(np.zeros((1, 3)), np.eye(3)[None], np.array([[1.0, 1.0, 0.0]]))
    assert compute_iou3d_pairs(flat, flat) == 0


@pytest.mark.parametrize(
    ("part", "value", "message"),
    [(0, np.nan, "NaN"), (2, -1.0, "negative extents"), (1, 2 * np.eye(3), "orthonormal")],
)
def test_iou3d_rejects_invalid_boxes(part, value, message):
    parts = [np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)), np.ones((2, 3))]
    parts[part][1] = value
    with pytest.raises(ValueError, match=message):
        make_boxes(*parts)


def test_ellipsoid_iou3d_keeps_stated_error():
    """The reference is the closed form for two spheres. A linear map of both spheres does not change the IoU."""
    rng = np.random.default_rng(4)
    n = 200
    radius, distance = rng.uniform(0.5, 2, (2, n)), rng.uniform(0, 3, n)
    a = make_boxes(np.zeros((n, 3)), Rotation.random(n, rng=rng).as_matrix(), 2 * radius[0][:, None] * np.ones(3))
    b = make_boxes(
        distance[:, None] * [0, 0.6, 0.8], Rotation.random(n, rng=rng).as_matrix(), 2 * radius[1][:, None] * np.ones(3)
    )
    lens = compute_sphere_intersection(*radius, distance)
    exact = lens / (4 / 3 * np.pi * (radius**3).sum(axis=0) - lens)
    stretch = np.array([4.0, 1.0, 0.5])  # the map preserves the IoU and turns spheres into aligned ellipsoids
    stretched = [make_boxes(x.center_m * stretch, np.tile(np.eye(3), (n, 1, 1)), x.size_m * stretch) for x in (a, b)]
    for pair in ((a, b), stretched):
        error = iou3d.compute_ellipsoid_iou3d_pairs(*pair) - exact
        assert np.abs(error).max() <= 0.01
        assert np.sqrt(np.mean(error**2)) <= 0.002
    assert (iou3d.compute_ellipsoid_iou3d_pairs(a, a) > 1 - 1e-9).all()


def compute_sphere_intersection(r: np.ndarray, s: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return the volume of the intersection of two spheres with radii r and s at distance d."""
    small = np.minimum(r, s)
    d_safe = np.maximum(d, 1e-9)
    lens = np.pi * (r + s - d) ** 2 * (d**2 + 2 * d * (r + s) - 3 * (r - s) ** 2) / (12 * d_safe)
    lens = np.where(d <= np.abs(r - s), 4 / 3 * np.pi * small**3, lens)
    return np.where(d >= r + s, 0, lens)


def test_ball_points_are_uniform():
    points = iou3d.sample_ball_points(4096)
    radius = np.linalg.norm(points, axis=1)
    assert radius.max() <= 1
    assert (radius <= 0.5).mean() == pytest.approx(1 / 8, abs=2e-3)
    octant = (points > 0) @ [1, 2, 4]
    np.testing.assert_allclose(np.bincount(octant) / 4096, 1 / 8, atol=3e-3)


def test_separating_axes_agree_with_manifold():
    rng, n = np.random.default_rng(5), 2000
    rotations = Rotation.random(2 * n, random_state=5).as_matrix()
    a, b = (
        make_boxes(rng.uniform(-1.5, 1.5, (n, 3)), part, rng.uniform(0.2, 2.5, (n, 3)))
        for part in (rotations[:n], rotations[n:])
    )
    found, iou = find_intersecting_pairs(a, b), compute_manifold_iou(a, b)
    assert 0.2 < found.mean() < 0.9 and not (iou[~found] > 1e-9).any()
    assert (iou[found] > 0).mean() > 0.995  # the others touch almost without volume
    cubes = np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)), np.ones((2, 3))
    moved = make_boxes(np.array([[0.99, 0, 0], [1.01, 0, 0]]), *cubes[1:])
    assert find_intersecting_pairs(make_boxes(*cubes), moved).tolist() == [True, False]
