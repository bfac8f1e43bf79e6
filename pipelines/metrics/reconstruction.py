"""Score reconstructed scenes by ground, AP3D, IoU3D of matches, voxels and memory (paper, Sec. 4.1, Tab. 1 and 2).

Each scene is summarised by one record, and records can be added in any order. For each kind of score, one function
computes the scores from the sum of all records. Each ratio is therefore a ratio of sums over the whole dataset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from models.batch import LayoutBatch
from models.geometry.cholesky import compute_cholesky_parameters
from models.geometry.iou3d import compute_ellipsoid_iou3d_matrix, compute_iou3d_matrix, extract_boxes
from models.layout import Bounds, LayoutSpec
from models.scene import CATEGORIES, CATEGORY_INDEX, ELLIPSOID, Scene
from models.tensors import select_ground_classes
from pipelines.geometry.voxels import NUM_CLASSES
from pipelines.schema.palette import CLASS_ID, EMPTY

THRESHOLDS = np.linspace(0.05, 0.50, 10)  # The ten IoU3D thresholds of Omni3D.
RECALL_POINTS = np.linspace(0.0, 1.0, 101)
CEILING_AND_CONTROL = ("ceiling", "control")  # Scores without a network that stand next to those of a model.
MAX_DETECTIONS = 100  # Maximum number of detections per scene and category, as in Omni3D.
SCORED = tuple(c for c in range(len(CATEGORIES)) if c != ELLIPSOID)  # The paper does not score ellipsoids.


# --------------------------------------------------------------------------------------------------------- ground


@dataclass(frozen=True)
class GroundSums:
    """Sums over scenes, from which ground scores are computed. Each array is (G,), with one entry per ground class.

    Attributes:
        intersection: Number of pixels that are occupied in both scenes.
        union: Number of pixels that are occupied in at least one of the two scenes.
        pixels: Number of pixels that are occupied in the true scene.
        absolute_m: Sum of |height error| over the pixels that are occupied in the true scene (m).
        squared_m2: Sum of squared height errors over the pixels that are occupied in the true scene (m^2).
    """

    intersection: np.ndarray
    union: np.ndarray
    pixels: np.ndarray
    absolute_m: np.ndarray
    squared_m2: np.ndarray

    def __add__(self, other: GroundSums) -> GroundSums:
        return GroundSums(*(getattr(self, name) + getattr(other, name) for name in self.__dataclass_fields__))


def sum_ground(
    true_occupied: np.ndarray, true_height_m: np.ndarray, occupied: np.ndarray, height_m: np.ndarray
) -> GroundSums:
    """Sum the ground errors of one scene or of a stack of scenes.

    Heights are compared on the pixels of the true mask, as in the paper's loss. The predicted mask has no influence.
    Therefore pass the heights of the decoder instead of the heights of a Scene. A Scene holds 0 m at unoccupied pixels,
    and this 0 would count as a prediction.

    Args:
        true_occupied: (..., G, H, W) bool true mask.
        true_height_m: (..., G, H, W) true height (m).
        occupied: (..., G, H, W) bool predicted mask.
        height_m: (..., G, H, W) predicted height (m).

    Returns:
        Sums per ground class.

    Raises:
        ValueError: The rasters differ in shape, or a compared height is not finite.
    """
    shapes = {np.shape(part) for part in (true_occupied, true_height_m, occupied, height_m)}
    if len(shapes) != 1:
        raise ValueError(f"ground rasters differ in shape: {sorted(shapes)}")
    error_m = np.where(true_occupied, np.asarray(height_m, np.float64) - true_height_m, 0.0)
    if not np.isfinite(error_m).all():
        raise ValueError("ground heights hold NaN or infinite numbers on pixels that are occupied in the true scene")
    masks = (true_occupied & occupied, true_occupied | occupied, true_occupied, np.abs(error_m), error_m**2)
    num_classes = error_m.shape[-3]
    return GroundSums(*(np.moveaxis(part, -3, 0).reshape(num_classes, -1).sum(axis=1) for part in masks))


@dataclass(frozen=True)
class GroundScores:
    """Ground scores of a dataset. A class that does not occur in any true or predicted scene has no entry.

    Attributes:
        iou: Intersection over union, summed over the pixels of all classes, in [0, 1].
        mean_iou: Mean over the classes of `class_iou`.
        class_iou: IoU per ground class.
        height_mae_m: Mean absolute height error (m).
        height_rmse_m: Root mean squared height error (m).
        height_mse: Mean squared error of the heights after normalisation to [0, 1] by the height bounds, as in the
            paper.
        class_height_mae_m: Mean absolute height error for each class of the true scenes (m).
        class_height_rmse_m: Root mean squared height error for each class of the true scenes (m).
        class_height_mse: Normalised mean squared height error for each class of the true scenes.
    """

    iou: float
    mean_iou: float
    class_iou: dict[str, float]
    height_mae_m: float
    height_rmse_m: float
    height_mse: float
    class_height_mae_m: dict[str, float]
    class_height_rmse_m: dict[str, float]
    class_height_mse: dict[str, float]


def compute_ground_scores(
    sums: GroundSums, ground_classes: Sequence[str], height_bounds_m: np.ndarray | Sequence[Any]
) -> GroundScores:
    """Compute the ground scores of a dataset from the sums over its scenes.

    Args:
        sums: Sums over all scenes.
        ground_classes: Names of the G classes.
        height_bounds_m: (2,) or (G, 2), lowest and highest height of the data (m).

    Returns:
        Scores of the dataset.

    Raises:
        ValueError: No true pixel is occupied, or a lower bound is not less than its upper bound.
    """
    low, high = np.broadcast_to(np.asarray(height_bounds_m, np.float64), (len(ground_classes), 2)).T
    if not (high > low).all():
        raise ValueError(f"height bounds must be (lowest, highest) in metres, got {height_bounds_m}")
    pixels = sums.pixels.sum()
    if pixels == 0:
        raise ValueError("ground scores need at least one occupied pixel, but all true scenes are empty")
    seen = sums.union > 0
    names = np.asarray(ground_classes)
    iou = sums.intersection[seen] / sums.union[seen]
    truly = sums.pixels > 0
    mae_m, squared_m2 = (part[truly] / sums.pixels[truly] for part in (sums.absolute_m, sums.squared_m2))

    def by_class(values: np.ndarray) -> dict[str, float]:
        return dict(zip(names[truly].tolist(), values.tolist(), strict=True))

    return GroundScores(
        iou=float(sums.intersection.sum() / sums.union.sum()),
        mean_iou=float(iou.mean()),
        class_iou=dict(zip(names[seen].tolist(), iou.tolist(), strict=True)),
        height_mae_m=float(sums.absolute_m.sum() / pixels),
        height_rmse_m=float(np.sqrt(sums.squared_m2.sum() / pixels)),
        height_mse=float((sums.squared_m2 / (high - low) ** 2).sum() / pixels),
        class_height_mae_m=by_class(mae_m),
        class_height_rmse_m=by_class(np.sqrt(squared_m2)),
        class_height_mse=by_class(squared_m2 / (high - low)[truly] ** 2),
    )


@dataclass(frozen=True)
class BoundsCounts:
    """Numbers of ground pixels and of primitives outside the bounds of a LayoutSpec. The numbers can be added.

    Attributes:
        ground: (2,) int64: number of occupied pixels, and number of occupied pixels whose height is outside the bounds.
        objects: (2,) int64: number of primitives, and number of primitives with a centre height or a Cholesky parameter
            outside the bounds.
    """

    ground: np.ndarray
    objects: np.ndarray

    def __add__(self, other: BoundsCounts) -> BoundsCounts:
        return BoundsCounts(self.ground + other.ground, self.objects + other.objects)


def count_outside_bounds(scene: Scene, spec: LayoutSpec) -> BoundsCounts:
    """Count the ground pixels and the primitives that a model with these bounds never saw in training.

    Args:
        scene: Scene.
        spec: LayoutSpec of the model. Ground classes and categories that the spec does not have are not counted.

    Returns:
        The counts of one scene.
    """
    height_m, occupied = select_ground_classes(scene, spec.ground_classes)
    known = np.isin(scene.category, [CATEGORY_INDEX[name] for name in spec.categories])
    parameters = compute_cholesky_parameters(scene.rotation[known], scene.size_m[known])
    center_z_m = Bounds(spec.center_bounds_m.low[2:], spec.center_bounds_m.high[2:])
    beyond = _exceeds(scene.center_m[known, 2:], center_z_m) | _exceeds(parameters, spec.cholesky_bounds)
    ground = _exceeds(height_m[occupied][:, None], spec.height_bounds_m)
    return BoundsCounts(np.array([len(ground), ground.sum()]), np.array([len(beyond), beyond.sum()]))


def _exceeds(values: np.ndarray, bounds: Bounds) -> np.ndarray:
    """Return (n,) bool: whether a row of `values` (n, k) has an entry outside its bounds."""
    return np.any((values < np.array(bounds.low)) | (values > np.array(bounds.high)), axis=1)


# ----------------------------------------------------------------------------------------------------------- AP3D


@dataclass(frozen=True)
class Matches:
    """Detections of one or more scenes after matching, sorted by score within each scene and category.

    Greedy matching processes detections in order of score. It is therefore correct to select the k highest scores after
    matching. A minimum score can also be applied after matching.

    Attributes:
        category: (d,) int8 category of each detection.
        score: (d,) float32 score of each detection.
        rank: (d,) int32 rank of each detection within its scene and category; rank 0 has the highest score.
        hit: (d, 10) bool, whether the detection is a true positive at each of THRESHOLDS.
        truths: (11,) int64 number of true primitives per category.
    """

    category: np.ndarray
    score: np.ndarray
    rank: np.ndarray
    hit: np.ndarray
    truths: np.ndarray


def join_matches(parts: Sequence[Matches]) -> Matches:
    """Join the matches of all scenes into one record.

    Detections with equal scores are ranked in the order of the scenes, as in COCO. Pass the scenes in a fixed order.

    Args:
        parts: Matches per scene.

    Returns:
        Matches of all scenes.

    Raises:
        ValueError: `parts` is empty.
    """
    if not parts:
        raise ValueError("AP3D needs the matches of at least one scene, got none")
    joined = [np.concatenate([getattr(p, name) for p in parts]) for name in ("category", "score", "rank", "hit")]
    return Matches(*joined, truths=np.sum([p.truths for p in parts], axis=0))


def match_scene(truth: Scene, prediction: Scene) -> Matches:
    """Match the primitives of a predicted scene with the primitives of the true scene, for each category in SCORED.

    Args:
        truth: True scene.
        prediction: Predicted scene; its `existence` holds the scores of the primitives.

    Returns:
        Matches of the scene.

    Raises:
        ValueError: An existence probability is not finite.
    """
    if not np.isfinite(prediction.existence).all():
        raise ValueError(f"scene {prediction.scene_id}: existence holds NaN or infinite numbers")
    same_category = prediction.category[:, None] == truth.category
    scored = np.isin(prediction.category, SCORED)
    iou = compute_iou3d_matrix(extract_boxes(prediction), extract_boxes(truth), wanted=same_category & scored[:, None])
    category, score, rank, hit = [], [], [], []
    truths = np.zeros(len(CATEGORIES), np.int64)
    for c in SCORED:
        true_index, index = np.flatnonzero(truth.category == c), np.flatnonzero(prediction.category == c)
        index = index[np.argsort(-prediction.existence[index], kind="stable")]
        truths[c] = len(true_index)
        category.append(np.full(len(index), c, np.int8))
        score.append(prediction.existence[index])
        rank.append(np.arange(len(index), dtype=np.int32))
        hit.append(match_greedily(iou[np.ix_(index, true_index)]))
    return Matches(*map(np.concatenate, (category, score, rank, hit)), truths=truths)


def match_greedily(iou: np.ndarray, thresholds: np.ndarray = THRESHOLDS) -> np.ndarray:
    """Decide for each detection and threshold whether the detection is a true positive.

    Each threshold is matched separately. Detections are processed in order of score. A detection is matched with the
    unmatched true primitive of highest IoU3D, if the IoU3D reaches the threshold. If several true primitives have the
    same highest IoU3D, the last is matched, as in COCO.

    Args:
        iou: (d, truths) IoU3D; the rows are in order of decreasing score.
        thresholds: (t,) minimum IoU3D of a true positive.

    Returns:
        (d, t) bool.
    """
    num_detections, num_truths = iou.shape
    hit = np.zeros((num_detections, len(thresholds)), bool)
    if num_truths == 0:
        return hit
    backwards = iou[:, ::-1]  # argmax returns the first maximum, but the last maximum is needed.
    free = np.ones((len(thresholds), num_truths), bool)
    rows = np.arange(len(thresholds))
    for i in np.flatnonzero(iou.max(axis=1) >= thresholds.min()):
        candidate = np.where(free, backwards[i], -1.0)
        best = candidate.argmax(axis=1)
        hit[i] = candidate[rows, best] >= thresholds
        free[rows[hit[i]], best[hit[i]]] = False
    return hit


@dataclass(frozen=True)
class DetectionScores:
    """AP3D in [0, 1]. Categories without a true primitive have no entry.

    Attributes:
        ap3d: Mean over categories and thresholds.
        ap3d_50: Mean over categories at the threshold IoU3D = 0.50.
        category_ap3d: Mean over thresholds, per category.
        category_ap3d_50: Average precision per category at the threshold IoU3D = 0.50.
        table: (10,) average precision at each of THRESHOLDS, per category.
    """

    ap3d: float
    ap3d_50: float
    category_ap3d: dict[str, float]
    category_ap3d_50: dict[str, float]
    table: dict[str, list[float]]

    @property
    def at_threshold(self) -> dict[str, float]:
        """Return the mean over categories at each threshold; keys are the thresholds with two decimals."""
        means = np.mean(list(self.table.values()), axis=0)
        return {f"{threshold:.2f}": float(mean) for threshold, mean in zip(THRESHOLDS, means, strict=True)}


def compute_detection_scores(
    matches: Matches, max_detections: int | None = None, min_score: float = -np.inf
) -> DetectionScores:
    """Compute AP3D and AP3D@50 as in Omni3D (paper, Sec. 4.1), over all scenes together.

    Args:
        matches: Matches of all scenes.
        max_detections: Number of highest-scoring detections that are kept per scene and category (Omni3D: 100). None:
            all detections are kept.
        min_score: Detections with this score or a lower score are ignored.

    Returns:
        Scores of the dataset.

    Raises:
        ValueError: No category has a true primitive.
    """
    keep = matches.score > min_score
    if max_detections is not None:
        keep &= matches.rank < max_detections
    table = {}
    for c in np.flatnonzero(matches.truths):
        of_category = np.flatnonzero(keep & (matches.category == c))
        order = of_category[np.argsort(-matches.score[of_category], kind="stable")]
        table[CATEGORIES[c]] = compute_average_precision(matches.hit[order], int(matches.truths[c]))
    if not table:
        raise ValueError("AP3D is undefined: no scored category has a true primitive")
    means = {name: float(values.mean()) for name, values in table.items()}
    at_50 = {name: float(values[-1]) for name, values in table.items()}
    return DetectionScores(
        ap3d=float(np.mean(list(means.values()))),
        ap3d_50=float(np.mean(list(at_50.values()))),
        category_ap3d=means,
        category_ap3d_50=at_50,
        table={name: values.tolist() for name, values in table.items()},
    )


def compute_average_precision(hit: np.ndarray, num_truths: int) -> np.ndarray:
    """Compute the mean of the interpolated precision over 101 recall points.

    The interpolated precision at recall r is the highest precision at any recall of at least r. At a recall that
    the detections do not reach, the precision is 0.

    Args:
        hit: (d, t) bool true positives, in order of decreasing score.
        num_truths: Number of true primitives, > 0.

    Returns:
        (t,) average precision in [0, 1].
    """
    if len(hit) == 0:
        return np.zeros(hit.shape[1])
    found = hit.cumsum(axis=0)
    recall = found / num_truths
    precision = found / np.arange(1, len(hit) + 1)[:, None]
    precision = np.maximum.accumulate(precision[::-1], axis=0)[::-1]
    average = np.empty(hit.shape[1])
    for t in range(hit.shape[1]):
        first = np.searchsorted(recall[:, t], RECALL_POINTS, side="left")
        reached = first < len(hit)
        average[t] = precision[first[reached], t].sum() / len(RECALL_POINTS)
    return average


# ------------------------------------------------------------------------------------- IoU3D of matched primitives


@dataclass(frozen=True)
class PairSums:
    """Sums over scenes, from which the mean IoU3D is computed. Each array is (11,), with one entry per category.

    Attributes:
        truths: Number of true primitives.
        predictions: Number of predicted primitives.
        pairs: Number of matched pairs.
        iou: Sum of IoU3D over the matched pairs.
    """

    truths: np.ndarray
    predictions: np.ndarray
    pairs: np.ndarray
    iou: np.ndarray

    def __add__(self, other: PairSums) -> PairSums:
        return PairSums(*(getattr(self, name) + getattr(other, name) for name in self.__dataclass_fields__))


def sum_pairs(truth: Scene, prediction: Scene) -> PairSums:
    """Match the true and predicted primitives of one scene and sum the IoU3D of the pairs.

    Matching is one-to-one within each category and maximises the sum of IoU3D. Primitives that do not overlap are not
    matched. The IoU3D of boxes is exact, and the IoU3D of ellipsoids is sampled (iou3d.py). All predictions count, and
    existence probabilities are ignored. Remove improbable predictions before the call.

    Args:
        truth: True scene.
        prediction: Predicted scene.

    Returns:
        Sums of the scene.
    """
    sums = PairSums(truth.counts(), prediction.counts(), *np.zeros((2, len(CATEGORIES))))
    for c in np.flatnonzero((sums.truths > 0) & (sums.predictions > 0)):
        matrix = compute_ellipsoid_iou3d_matrix if c == ELLIPSOID else compute_iou3d_matrix
        iou = matrix(
            extract_boxes(prediction.select(prediction.category == c)), extract_boxes(truth.select(truth.category == c))
        )
        matched = iou[linear_sum_assignment(iou, maximize=True)]
        sums.pairs[c], sums.iou[c] = (matched > 0).sum(), matched.sum()
    return sums


@dataclass(frozen=True)
class PairScores:
    """IoU3D of matched primitives in [0, 1].

    Scores over all categories use the categories in SCORED; scores per category also include VE. A category whose score
    would be 0 / 0 has no entry.

    Attributes:
        mean_iou3d: Mean over matched pairs. None: there are no pairs.
        truth_iou3d: Mean over true primitives; a true primitive without a partner counts as 0.
        recall: Share of true primitives that are matched.
        precision: Share of predictions that are matched. None: there are no predictions.
        category_mean_iou3d: `mean_iou3d` per category.
        category_truth_iou3d: `truth_iou3d` per category.
        category_recall: `recall` per category.
        category_precision: `precision` per category.
    """

    mean_iou3d: float | None
    truth_iou3d: float
    recall: float
    precision: float | None
    category_mean_iou3d: dict[str, float]
    category_truth_iou3d: dict[str, float]
    category_recall: dict[str, float]
    category_precision: dict[str, float]


def compute_pair_scores(sums: PairSums) -> PairScores:
    """Compute the IoU3D scores of a dataset from the sums over its scenes.

    Args:
        sums: Sums over all scenes.

    Returns:
        Scores of the dataset.

    Raises:
        ValueError: No scored category has a true primitive.
    """
    truths, predictions, pairs, iou = (getattr(sums, name) for name in PairSums.__dataclass_fields__)
    total = [part[list(SCORED)].sum() for part in (truths, predictions, pairs, iou)]
    if total[0] == 0:
        raise ValueError("IoU3D of matched primitives is undefined: no scored category has a true primitive")

    def by_category(part: np.ndarray, whole: np.ndarray) -> dict[str, float]:
        return {CATEGORIES[c]: float(part[c] / whole[c]) for c in np.flatnonzero(whole)}

    return PairScores(
        mean_iou3d=float(total[3] / total[2]) if total[2] else None,
        truth_iou3d=float(total[3] / total[0]),
        recall=float(total[2] / total[0]),
        precision=float(total[2] / total[1]) if total[1] else None,
        category_mean_iou3d=by_category(iou, pairs),
        category_truth_iou3d=by_category(iou, truths),
        category_recall=by_category(pairs, truths),
        category_precision=by_category(pairs, predictions),
    )


# --------------------------------------------------------------------------------------------------------- voxels


def compute_voxel_confusion(truth: np.ndarray, prediction: np.ndarray) -> np.ndarray:
    """Count voxels by true and predicted class. Confusion matrices can be added over scenes.

    Args:
        truth: Class ids of the true voxel grid.
        prediction: Class ids of the predicted voxel grid, which has the same shape.

    Returns:
        (classes, classes) int64 number of voxels; rows are true classes, and columns are predicted classes.

    Raises:
        ValueError: The shapes differ.
    """
    if truth.shape != prediction.shape:
        raise ValueError(f"voxel grids differ in shape: {truth.shape} and {prediction.shape}")
    # Only filled voxels are counted here, because at least half of a scene is empty.
    filled = np.flatnonzero((truth | prediction).reshape(-1) != EMPTY)
    pair = truth.reshape(-1).take(filled).astype(np.int16) * np.int16(NUM_CLASSES) + prediction.reshape(-1).take(filled)
    confusion = np.bincount(pair, minlength=NUM_CLASSES**2).reshape(NUM_CLASSES, NUM_CLASSES)
    confusion[EMPTY, EMPTY] = truth.size - len(filled)
    return confusion


@dataclass(frozen=True)
class VoxelScores:
    """Voxel scores of a dataset (paper, Tab. 1). A class that occurs in no true or predicted voxel has no entry.

    Attributes:
        iou: IoU of occupied voxels, regardless of their class.
        miou: Mean of `class_iou`.
        class_iou: IoU per class, without the empty class.
    """

    iou: float
    miou: float
    class_iou: dict[str, float]


def compute_voxel_scores(confusion: np.ndarray) -> VoxelScores:
    """Compute voxel scores from the summed confusion matrix of a dataset.

    Args:
        confusion: (classes, classes) number of voxels; rows are true classes, and columns are predicted classes.

    Returns:
        Scores of the dataset.

    Raises:
        ValueError: All voxels are empty, both true and predicted.
    """
    hit, either = np.diag(confusion), confusion.sum(axis=0) + confusion.sum(axis=1) - np.diag(confusion)
    class_iou = {name: float(hit[k] / either[k]) for name, k in CLASS_ID.items() if either[k]}
    if not class_iou:
        raise ValueError("voxel scores need at least one filled voxel, but all scenes are empty within the voxel grid")
    occupied = np.arange(NUM_CLASSES) != EMPTY
    both = confusion[np.ix_(occupied, occupied)].sum()
    return VoxelScores(
        iou=float(both / (confusion.sum() - confusion[EMPTY, EMPTY])),
        miou=float(np.mean(list(class_iou.values()))),
        class_iou=class_iou,
    )


# --------------------------------------------------------------------------------------------------------- memory


MEMORY = (
    "rasters",  # Height and mask, both float32, as in the paper. In the paper, 1 MB is 2^20 bytes.
    "vectors",  # Features (float32) and flags of all slots, as in the paper.
    "vectors_filled",  # Features of the filled slots only.
    "latent",
    "voxels",  # One byte per voxel.
    "voxels_32_bit",  # Four bytes per voxel, as in the paper for SemCity.
)


def measure_memory_bytes(layout: LayoutBatch, latent: np.ndarray, voxels: np.ndarray) -> np.ndarray:
    """Measure the memory of one scene in each representation of MEMORY (paper, Tab. 1).

    Args:
        layout: Batch of one scene.
        latent: Latent of the scene.
        voxels: Voxel grid of the scene, one byte per voxel.

    Returns:
        (6,) int64 bytes.
    """
    return np.array(
        [
            layout.height.nbytes + layout.occupied.nbytes,
            layout.features.nbytes + layout.real.nbytes,
            layout.features[layout.real].nbytes,
            latent.nbytes,
            voxels.nbytes,
            voxels.astype(np.int32).nbytes,
        ]
    )
