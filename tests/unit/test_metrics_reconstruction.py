"""Tests that compare AP3D with a COCO evaluation (as in Omni3D) and ground scores with loops."""

import dataclasses
from itertools import permutations

import numpy as np
import pytest
from helpers import random_scene

from models.geometry.iou3d import compute_ellipsoid_iou3d_matrix, compute_iou3d_matrix, extract_boxes
from models.layout import LayoutSpec
from models.scene import (
    CATEGORIES,
    CATEGORY_INDEX,
    ELLIPSOID,
    KITTI_GROUND_CLASSES,
    UNSET,
    Grid,
    Scene,
    make_yaw_rotation,
)
from models.tensors import make_layout_batch
from pipelines.geometry.voxels import NUM_CLASSES, VoxelGrid, voxelize
from pipelines.metrics.reconstruction import (
    MEMORY,
    SCORED,
    THRESHOLDS,
    compute_average_precision,
    compute_detection_scores,
    compute_ground_scores,
    compute_pair_scores,
    compute_voxel_confusion,
    compute_voxel_scores,
    join_matches,
    match_greedily,
    match_scene,
    measure_memory_bytes,
    sum_ground,
    sum_pairs,
)
from pipelines.schema.palette import CLASS_ID

GRID = Grid(front_m=2.0, left_m=1.0, resolution_m=0.5, rows=4, cols=4)
CAR, POLE, TREE = CATEGORY_INDEX["vehicle_small"], CATEGORY_INDEX["pole"], CATEGORY_INDEX["vegetation_cuboid"]


def make_scene(category, center_m, size_m=None, existence=None, yaw_rad=None) -> Scene:
    n = len(category)
    ground = np.zeros((5, 4, 4), np.float32)
    return Scene(
        "a", "town", "0", 0, "test",
        category=np.asarray(category, np.int8),
        center_m=np.asarray(center_m, np.float32).reshape(n, 3),
        rotation=make_yaw_rotation(np.zeros(n) if yaw_rad is None else yaw_rad).astype(np.float32),
        size_m=np.ones((n, 3), np.float32) if size_m is None else np.asarray(size_m, np.float32),
        ground_classes=KITTI_GROUND_CLASSES, height_m=ground, occupied=ground > 0, grid=GRID,
        existence=UNSET if existence is None else np.asarray(existence, np.float32),
    )  # fmt: skip


def compute_scores(truths: list[Scene], predictions: list[Scene], **options):
    parts = [match_scene(t, p) for t, p in zip(truths, predictions, strict=True)]
    return compute_detection_scores(join_matches(parts), **options)


# ------------------------------------------------------------------------------------------ literal version


def compute_literal_ap(
    truths: list[Scene], predictions: list[Scene], max_detections: int, threshold: float
) -> dict[str, float]:
    """Compute the AP per category with the steps of COCOeval.evaluateImg and COCOeval.accumulate.

    There is one IoU threshold, and every true object counts.
    """
    result = {}
    for c in SCORED:
        scored_hits, num_truths = [], 0
        for truth, prediction in zip(truths, predictions, strict=True):
            real, found = truth.select(truth.category == c), prediction.select(prediction.category == c)
            order = sorted(range(len(found)), key=lambda i: -found.existence[i])[:max_detections]
            iou = compute_iou3d_matrix(extract_boxes(found), extract_boxes(real))
            num_truths += len(real)
            taken = set()
            for d in order:
                best_iou, match = threshold, None
                for g in range(len(real)):
                    if g in taken or iou[d, g] < best_iou:
                        continue
                    best_iou, match = iou[d, g], g
                if match is not None:
                    taken.add(match)
                scored_hits.append((float(found.existence[d]), match is not None))
        if num_truths == 0:
            continue
        scored_hits.sort(key=lambda pair: -pair[0])
        points, true_positives, false_positives = [], 0, 0
        for _, hit in scored_hits:
            true_positives, false_positives = true_positives + hit, false_positives + (not hit)
            points.append((true_positives / num_truths, true_positives / (true_positives + false_positives)))
        precision_at = []
        for recall in np.linspace(0, 1, 101):
            beyond = [precision for reached, precision in points if reached >= recall]
            precision_at.append(max(beyond, default=0.0))
        result[CATEGORIES[c]] = float(np.mean(precision_at))
    return result


def draw_dataset(rng, num_scenes=6):
    truths, predictions = [], []
    for _ in range(num_scenes):
        n = rng.integers(0, 30)
        category = rng.choice([CAR, POLE, TREE, ELLIPSOID], n)
        center_m, size_m, yaw = rng.uniform(-6, 6, (n, 3)), rng.uniform(1, 4, (n, 3)), rng.uniform(-1.5, 1.5, n)
        truths.append(make_scene(category, center_m, size_m, yaw_rad=yaw))
        again = np.concatenate([np.arange(n), rng.choice(n, n // 2)]) if n else np.arange(0)
        kept = again[rng.random(len(again)) < 0.8]
        m = len(kept)
        predictions.append(
            make_scene(
                category[kept],
                center_m[kept] + rng.normal(0, 0.4, (m, 3)),
                size_m[kept] * rng.uniform(0.7, 1.4, (m, 3)),
                existence=rng.integers(0, 8, m) / 8,  # many detections have equal scores
                yaw_rad=yaw[kept] + rng.normal(0, 0.2, m),
            )
        )
    return truths, predictions


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("max_detections", [3, 100])
def test_ap3d_equals_literal_version(seed, max_detections):
    truths, predictions = draw_dataset(np.random.default_rng(seed))
    got = compute_scores(truths, predictions, max_detections=max_detections)
    for t, threshold in enumerate(THRESHOLDS):
        literal = compute_literal_ap(truths, predictions, max_detections, threshold)
        assert {name: values[t] for name, values in got.table.items()} == pytest.approx(literal, abs=1e-12)
    assert got.category_ap3d_50 == {name: values[-1] for name, values in got.table.items()}
    assert got.ap3d == pytest.approx(np.mean(list(got.table.values())))
    assert 0 < got.ap3d_50 < got.ap3d < 1


def test_ap3d_records_join_in_any_grouping():
    truths, predictions = draw_dataset(np.random.default_rng(7))
    parts = [match_scene(t, p) for t, p in zip(truths, predictions, strict=True)]
    grouped = join_matches([join_matches(parts[:2]), parts[2], join_matches(parts[3:])])
    assert compute_detection_scores(grouped) == compute_detection_scores(join_matches(parts))


# -------------------------------------------------------------------------------------------------- hand-computed cases


CENTERS = [[0, 0, 0], [10, 0, 0], [20, 0, 0], [30, 0, 0]]


def test_ap3d_of_perfect_is_one_and_of_empty_is_zero():
    truth, nothing = make_scene([CAR, CAR, POLE, TREE], CENTERS), make_scene([], [])
    assert compute_scores([truth], [truth]).ap3d == 1
    assert compute_scores([truth], [nothing]).ap3d == 0
    assert compute_scores([truth, nothing], [truth, nothing]).ap3d == 1


def test_ap3d_penalizes_duplicates_by_rank():
    truth = make_scene([CAR, CAR], CENTERS[:2])
    behind = make_scene([CAR] * 3, [*CENTERS[:2], CENTERS[0]], existence=[0.9, 0.8, 0.1])
    assert compute_scores([truth], [behind]).ap3d == 1
    between = make_scene([CAR] * 3, [CENTERS[0], CENTERS[0], CENTERS[1]], existence=[0.9, 0.8, 0.1])
    # The precision is 1 at recalls 0 to 0.50 (51 points) and 2/3 at recalls 0.51 to 1 (50 points).
    assert compute_scores([truth], [between]).ap3d == pytest.approx((51 + 50 * 2 / 3) / 101)


def test_ap3d_of_half_the_truths_is_51_of_101_points():
    truth = make_scene([CAR, CAR], CENTERS[:2])
    assert compute_scores([truth], [truth.select(np.array([0]))]).ap3d == pytest.approx(51 / 101)


def test_ap3d_counts_shifted_box_up_to_its_iou():
    truth = make_scene([CAR], CENTERS[:1])
    shifted = make_scene([CAR], [[0.5, 0, 0]])  # the IoU3D is 1/3, a hit at thresholds up to 0.30
    got = compute_scores([truth], [shifted])
    assert got.ap3d == pytest.approx(0.6)
    assert got.ap3d_50 == 0


def test_ap3d_ignores_ellipsoids_and_absent_categories():
    truth = make_scene([CAR, ELLIPSOID], CENTERS[:2])
    got = compute_scores([truth], [make_scene([CAR, POLE], CENTERS[:2])])
    assert set(got.table) == {"vehicle_small"} and got.ap3d == 1
    with pytest.raises(ValueError, match="no scored category"):
        compute_scores([make_scene([ELLIPSOID], CENTERS[:1])], [make_scene([], [])])


def test_ap3d_truncates_per_scene_and_category():
    cars = make_scene([CAR] * 150, [[10 * i, 0, 0] for i in range(150)])
    assert compute_scores([cars], [cars]).ap3d == 1
    assert compute_scores([cars], [cars], max_detections=100).ap3d == pytest.approx(67 / 101)  # the recall is 100/150


def test_ap3d_score_threshold_equals_dropping_detections():
    truths, predictions = draw_dataset(np.random.default_rng(3))
    dropped = [p.select(p.existence > 0.375) for p in predictions]  # decode_layout also drops these objects
    got = compute_scores(truths, predictions, min_score=0.375)
    assert got == compute_scores(truths, dropped)
    assert list(got.at_threshold) == [f"{t:.2f}" for t in THRESHOLDS]
    assert np.mean(list(got.at_threshold.values())) == pytest.approx(got.ap3d)


def test_ap3d_matches_best_free_truth_and_later_of_ties():
    iou = np.array([[0.4, 0.6, 0.0], [0.5, 0.7, 0.0], [0.5, 0.0, 0.5], [0.5, 0.0, 0.5]])
    hit = match_greedily(iou, np.array([0.3, 0.55]))
    np.testing.assert_array_equal(hit[:, 0], [True, True, True, False])
    np.testing.assert_array_equal(hit[:, 1], [True, False, False, False])
    leaves_the_first_free = np.array([[0.5, 0.5], [0.6, 0.2]])
    np.testing.assert_array_equal(match_greedily(leaves_the_first_free, np.array([0.3])), [[True], [True]])
    assert match_greedily(np.zeros((2, 0))).shape == (2, 10)
    assert compute_average_precision(np.zeros((0, 10), bool), 3).tolist() == [0] * 10


def test_ap3d_rejects_nan_existence():
    with pytest.raises(ValueError, match="existence"):
        match_scene(make_scene([CAR], CENTERS[:1]), make_scene([CAR], CENTERS[:1], existence=[np.nan]))


# ------------------------------------------------------------------------------------------ ground


def draw_rasters(rng, shape=(3, 2, 5, 6)):
    true_height_m, height_m = rng.normal(0, 2, (2, *shape)).astype(np.float32)
    true_occupied, occupied = rng.random((2, *shape)) < 0.4
    return true_occupied, true_height_m, occupied, height_m


def test_ground_scores_equal_plain_loops():
    true_occupied, true_height_m, occupied, height_m = draw_rasters(np.random.default_rng(0))
    bounds_m = np.array([[-5.0, 5.0], [-2.0, 8.0]])
    got = compute_ground_scores(
        sum_ground(true_occupied, true_height_m, occupied, height_m), ("road", "terrain"), bounds_m
    )
    both, either, errors, normalised = [0, 0], [0, 0], [[], []], []
    for s, c, row, col in np.ndindex(true_occupied.shape):
        real, found = true_occupied[s, c, row, col], occupied[s, c, row, col]
        both[c] += real and found
        either[c] += real or found
        if real:
            low, high = bounds_m[c]
            true, predicted = float(true_height_m[s, c, row, col]), float(height_m[s, c, row, col])
            errors[c].append(predicted - true)
            normalised.append(((predicted - low) / (high - low) - (true - low) / (high - low)) ** 2)
    together = np.array(errors[0] + errors[1])
    assert got.class_iou == pytest.approx({"road": both[0] / either[0], "terrain": both[1] / either[1]})
    assert got.mean_iou == pytest.approx(np.mean([both[0] / either[0], both[1] / either[1]]))
    assert got.iou == pytest.approx(sum(both) / sum(either))
    assert got.height_mae_m == pytest.approx(np.abs(together).mean())
    assert got.height_rmse_m == pytest.approx(np.sqrt((together**2).mean()))
    for c, name in enumerate(("road", "terrain")):
        low, high = bounds_m[c]
        assert got.class_height_mae_m[name] == pytest.approx(np.abs(errors[c]).mean())
        assert got.class_height_rmse_m[name] == pytest.approx(np.sqrt(np.mean(np.square(errors[c]))))
        assert got.class_height_mse[name] == pytest.approx(np.mean(np.square(errors[c])) / (high - low) ** 2)
    assert got.height_mse == pytest.approx(np.mean(normalised))


def test_ground_sums_of_scenes_equal_those_of_stack():
    rasters = draw_rasters(np.random.default_rng(1))
    one_by_one = [sum_ground(*(part[s] for part in rasters)) for s in range(3)]
    total, stacked = one_by_one[0] + one_by_one[1] + one_by_one[2], sum_ground(*rasters)
    for field in dataclasses.fields(total):
        np.testing.assert_allclose(getattr(total, field.name), getattr(stacked, field.name), rtol=1e-12)


def test_ground_scores_of_perfect_ground_and_absent_class():
    true_occupied, true_height_m, _, _ = draw_rasters(np.random.default_rng(2))
    true_occupied[:, 1] = False
    got = compute_ground_scores(
        sum_ground(true_occupied, true_height_m, true_occupied, true_height_m), ("road", "terrain"), (-5, 5)
    )
    assert got.class_iou == {"road": 1.0} and got.mean_iou == got.iou == 1 and got.height_mse == 0


def test_ground_scores_reject_missing_truth_bad_bounds_and_nan():
    rasters = draw_rasters(np.random.default_rng(3))
    empty = sum_ground(np.zeros_like(rasters[0]), *rasters[1:])
    with pytest.raises(ValueError, match="at least one occupied pixel"):
        compute_ground_scores(empty, ("road", "terrain"), (-5, 5))
    with pytest.raises(ValueError, match="bounds"):
        compute_ground_scores(sum_ground(*rasters), ("road", "terrain"), (5, 5))
    rasters[3][rasters[0]] = np.nan
    with pytest.raises(ValueError, match="NaN"):
        sum_ground(*rasters)
    with pytest.raises(ValueError, match="differ in shape"):
        sum_ground(*rasters[:3], rasters[3][:2])


# ------------------------------------------------------------------------------------------ matched primitives


def find_best_pairs(iou: np.ndarray) -> tuple[int, float]:
    """Return the number of pairs and the total IoU of the best one-to-one assignment, found by exhaustive search."""
    if iou.shape[0] > iou.shape[1]:
        iou = iou.T
    ways = [iou[np.arange(iou.shape[0]), list(way)] for way in permutations(range(iou.shape[1]), iou.shape[0])]
    best = max(ways, key=lambda found: found.sum())
    return int((best > 0).sum()), float(best.sum())


@pytest.mark.parametrize("seed", range(4))
def test_pairs_equal_best_assignment(seed):
    rng = np.random.default_rng(seed)
    category = np.repeat([CAR, POLE, ELLIPSOID], 5)
    truth = make_scene(
        category, rng.uniform(-3, 3, (15, 3)), rng.uniform(1, 4, (15, 3)), yaw_rad=rng.uniform(-1, 1, 15)
    )
    kept = rng.permutation(15)[:12]
    found = dataclasses.replace(
        truth.select(kept), center_m=truth.center_m[kept] + rng.normal(0, 0.5, (12, 3)).astype(np.float32)
    )
    got = sum_pairs(truth, found)
    for c in (CAR, POLE, ELLIPSOID):
        sides = [extract_boxes(side.select(side.category == c)) for side in (found, truth)]
        iou = (compute_ellipsoid_iou3d_matrix if c == ELLIPSOID else compute_iou3d_matrix)(*sides)
        pairs, total = find_best_pairs(iou) if iou.size else (0, 0.0)
        assert got.pairs[c] == pairs and got.iou[c] == pytest.approx(total)
        assert (got.truths[c], got.predictions[c]) == (len(iou.T), len(iou))


def test_pair_scores_equal_hand_computed():
    truth = make_scene([CAR, CAR, POLE, ELLIPSOID], CENTERS)
    found = make_scene([CAR, CAR, ELLIPSOID], [[0.5, 0, 0], [50, 0, 0], CENTERS[3]])  # IoU3D: 1/3, 0, 1
    sums = sum_pairs(truth, found)
    got = compute_pair_scores(sums + sums)
    assert got.mean_iou3d == pytest.approx(1 / 3) and got.truth_iou3d == pytest.approx(1 / 9)
    assert got.recall == pytest.approx(1 / 3) and got.precision == pytest.approx(
        1 / 2
    )  # there are three true boxes and two predicted boxes
    assert got.category_mean_iou3d == pytest.approx({"vehicle_small": 1 / 3, "vegetation_ellipsoid": 1})
    assert got.category_recall == pytest.approx({"vehicle_small": 0.5, "pole": 0, "vegetation_ellipsoid": 1})
    assert got.category_precision == pytest.approx({"vehicle_small": 0.5, "vegetation_ellipsoid": 1})


def test_pair_scores_without_pairs_or_truths_are_undefined():
    nothing = make_scene([], [])
    got = compute_pair_scores(sum_pairs(make_scene([CAR], CENTERS[:1]), nothing))
    assert got.mean_iou3d is None and got.precision is None and got.recall == got.truth_iou3d == 0
    with pytest.raises(ValueError, match="no scored category"):
        compute_pair_scores(sum_pairs(nothing, make_scene([CAR], CENTERS[:1])))


# ------------------------------------------------------------------------------------------ voxels


def test_voxel_scores_equal_plain_counting():
    rng = np.random.default_rng(0)
    truth, found = rng.choice([0, 0, 0, 1, 5, 9, 17], (2, 3, 12, 11, 10)).astype(np.uint8)
    confusion = sum(compute_voxel_confusion(t, f) for t, f in zip(truth, found, strict=True))
    np.testing.assert_array_equal(confusion, compute_voxel_confusion(truth, found))
    assert confusion.shape == (NUM_CLASSES, NUM_CLASSES) and confusion.sum() == truth.size
    assert confusion[5, 9] == ((truth == 5) & (found == 9)).sum()
    got = compute_voxel_scores(confusion)
    assert got.iou == pytest.approx(((truth > 0) & (found > 0)).sum() / ((truth > 0) | (found > 0)).sum())
    names = {name: k for name, k in CLASS_ID.items() if k in (1, 5, 9, 17)}
    literal = {n: ((truth == k) & (found == k)).sum() / ((truth == k) | (found == k)).sum() for n, k in names.items()}
    assert got.class_iou == pytest.approx(literal)
    assert got.miou == pytest.approx(np.mean(list(literal.values())))


def test_voxel_scores_of_equal_voxels_are_one_and_ignore_air():
    space = VoxelGrid(GRID, -2, 2, 8)
    voxels = voxelize(make_scene([CAR, POLE], [[1, 0, 0], [0.5, 0.5, 1]]), space)
    got = compute_voxel_scores(compute_voxel_confusion(voxels, voxels))
    assert got.iou == got.miou == 1 and set(got.class_iou) == {"vehicle_small", "pole"}
    nothing = np.zeros_like(voxels)
    assert compute_voxel_scores(compute_voxel_confusion(voxels, nothing)).iou == 0
    with pytest.raises(ValueError, match="at least one filled voxel"):
        compute_voxel_scores(compute_voxel_confusion(nothing, nothing))
    with pytest.raises(ValueError, match="differ in shape"):
        compute_voxel_confusion(voxels, nothing[:2])


# ------------------------------------------------------------------------------------------ memory


def test_layout_memory_equals_paper():
    """Rasters need 2.50 MB, primitives 0.02 MB and voxels of four bytes 8.00 MB (paper, Sec. 4.2 and Tab. 1)."""
    truth, spec = random_scene(0, n=40), LayoutSpec()
    latent = np.zeros((64, 32, 32), np.float32)
    got = measure_memory_bytes(make_layout_batch([truth], spec), latent, voxelize(truth, VoxelGrid()))
    found = dict(zip(MEMORY, (got / 2**20).round(2), strict=True))
    assert found["rasters"] == 2.50 and found["vectors"] == 0.02
    assert found["voxels_32_bit"] == 8.00 and found["voxels"] == 2.00 and found["latent"] == 0.25
    filled = sum(min(n, slots) for n, slots in zip(truth.counts(), spec.slots, strict=True))
    assert dict(zip(MEMORY, got, strict=True))["vectors_filled"] == filled * 9 * 4
