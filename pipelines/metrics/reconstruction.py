"""Score reconstructions: ground, AP3D, IoU3D of matched primitives, voxels, memory (paper, Sec. 4.1, Tab. 1, 2).

Each scene gives one record; records can be added in any grouping. One function per table computes scores from the sum,
so that every ratio is one of sums over the whole dataset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from models.batch import LayoutBatch
from models.geometry.iou3d import compute_ellipsoid_iou3d_matrix, compute_iou3d_matrix, extract_boxes
from models.scene import CATEGORIES, ELLIPSOID, Scene
from pipelines.geometry.voxels import NUM_CLASSES
from pipelines.schema.palette import CLASS_ID, EMPTY

THRESHOLDS = np.linspace(0.05, 0.50, 10)  # IoU3D, Omni3D's ten steps
RECALL_POINTS = np.linspace(0.0, 1.0, 101)
MAX_DETECTIONS = 100  # per scene and category, Omni3D's default
SCORED = tuple(c for c in range(len(CATEGORIES)) if c != ELLIPSOID)  # paper: all categories but VE


# --------------------------------------------------------------------------------------------------------- ground


@dataclass(frozen=True)
class GroundSums:
    """What ground scores are made of, summed over scenes; all (G,), one entry per ground class."""

    intersection: np.ndarray  # pixels occupied in both
    union: np.ndarray  # pixels occupied in either
    pixels: np.ndarray  # pixels truly occupied
    absolute_m: np.ndarray  # sum of |height error| over truly occupied pixels
    squared_m2: np.ndarray  # sum of squared height errors over truly occupied pixels

    def __add__(self, other: GroundSums) -> GroundSums:
        return GroundSums(*(getattr(self, name) + getattr(other, name) for name in self.__dataclass_fields__))


def sum_ground(
    true_occupied: np.ndarray, true_height_m: np.ndarray, occupied: np.ndarray, height_m: np.ndarray
) -> GroundSums:
    """Sums of one scene (or a stack of scenes) from rasters (..., G, H, W): masks bool, heights in metres.

    Heights are compared wherever the truth is occupied, as in the paper's loss, whether or not the prediction says
    occupied: pass the decoder's heights. A Scene holds 0 m where it is not occupied, and then that 0 counts.
    """
    shapes = {np.shape(part) for part in (true_occupied, true_height_m, occupied, height_m)}
    if len(shapes) != 1:
        raise ValueError(f"ground rasters differ in shape: {sorted(shapes)}")
    error_m = np.where(true_occupied, np.asarray(height_m, np.float64) - true_height_m, 0.0)
    if not np.isfinite(error_m).all():
        raise ValueError("ground heights hold NaN or infinite numbers on truly occupied pixels")
    masks = (true_occupied & occupied, true_occupied | occupied, true_occupied, np.abs(error_m), error_m**2)
    num_classes = error_m.shape[-3]
    return GroundSums(*(np.moveaxis(part, -3, 0).reshape(num_classes, -1).sum(axis=1) for part in masks))


@dataclass(frozen=True)
class GroundScores:
    """Ground scores of a dataset. A class that neither side ever occupies has no entry."""

    iou: float  # intersection over union of all classes' pixels together
    mean_iou: float  # mean of the classes' own
    class_iou: dict[str, float]
    height_mae_m: float
    height_rmse_m: float
    height_mse: float  # the paper's: heights normalised to [0, 1] by the bounds
    class_height_mae_m: dict[str, float]  # of truly occupied classes, as are the next two
    class_height_rmse_m: dict[str, float]
    class_height_mse: dict[str, float]


def compute_ground_scores(
    sums: GroundSums, ground_classes: Sequence[str], height_bounds_m: np.ndarray | Sequence[Any]
) -> GroundScores:
    """Scores of the summed scenes; height_bounds_m is (2,) or (G, 2), lowest and highest height of the data.

    Raises ValueError if no pixel is occupied at all or if bounds are empty intervals.
    """
    low, high = np.broadcast_to(np.asarray(height_bounds_m, np.float64), (len(ground_classes), 2)).T
    if not (high > low).all():
        raise ValueError(f"height bounds must be (lowest, highest) in metres, got {height_bounds_m}")
    pixels = sums.pixels.sum()
    if pixels == 0:
        raise ValueError("ground scores need at least one truly occupied pixel; all scenes are empty")
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


# ----------------------------------------------------------------------------------------------------------- AP3D


@dataclass(frozen=True)
class Matches:
    """Matched detections of any number of scenes; per category sorted by score within a scene.

    `rank` is a detection's place in its scene and category (0 = best score): truncating to the best k after matching
    is the same as before, since greedy matching never looks at worse ones. So is a score threshold.
    """

    category: np.ndarray  # (d,) int8
    score: np.ndarray  # (d,) float32
    rank: np.ndarray  # (d,) int32
    hit: np.ndarray  # (d, 10) bool: true positive at each of THRESHOLDS
    truths: np.ndarray  # (11,) int64: number of true primitives per category


def join_matches(parts: Sequence[Matches]) -> Matches:
    """One record of all scenes' matches. Keep scenes in a fixed order: it decides between equal scores, as in COCO."""
    if not parts:
        raise ValueError("AP3D needs at least one scene's matches, got none")
    joined = [np.concatenate([getattr(p, name) for p in parts]) for name in ("category", "score", "rank", "hit")]
    return Matches(*joined, truths=np.sum([p.truths for p in parts], axis=0))


def match_scene(truth: Scene, prediction: Scene) -> Matches:
    """Matches of one predicted scene, ranked by `existence`, with its truth, for every category in SCORED."""
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
    """(d, t) bool: is detection i, best score first, a true positive at threshold j, given iou (d, truths)?

    At each threshold on its own, each detection in turn takes the unmatched truth it overlaps most, if by at least
    the threshold; a later truth wins a tie (COCO).
    """
    num_detections, num_truths = iou.shape
    hit = np.zeros((num_detections, len(thresholds)), bool)
    if num_truths == 0:
        return hit
    backwards = iou[:, ::-1]  # argmax takes the first of equals
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
    """AP3D in [0, 1]. Categories without a single truth are left out; `table` holds them per threshold."""

    ap3d: float  # mean over categories and thresholds
    ap3d_50: float  # mean over categories at IoU3D 0.50
    category_ap3d: dict[str, float]
    category_ap3d_50: dict[str, float]
    table: dict[str, list[float]]  # (10,) average precision at each of THRESHOLDS

    @property
    def at_threshold(self) -> dict[str, float]:
        """Mean over categories at each of THRESHOLDS."""
        means = np.mean(list(self.table.values()), axis=0)
        return {f"{threshold:.2f}": float(mean) for threshold, mean in zip(THRESHOLDS, means, strict=True)}


def compute_detection_scores(
    matches: Matches, max_detections: int | None = None, min_score: float = -np.inf
) -> DetectionScores:
    """Compute AP3D and AP3D@50 as in Omni3D (paper, Sec. 4.1), over all scenes together.

    Args:
        matches: Matches of all scenes.
        max_detections: Number of best detections kept per scene and category (Omni3D: 100; default: all).
        min_score: Only detections with a higher score count.

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
    """(t,) mean over 101 recall points of the interpolated precision; hit (d, t), best score first, num_truths > 0.

    The precision at a recall is the highest one reached at that recall or beyond, 0 if it is never reached.
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
    """The sums from which mean IoU3D is computed, over scenes; all (11,), one entry per category."""

    truths: np.ndarray
    predictions: np.ndarray
    pairs: np.ndarray  # matched ones
    iou: np.ndarray  # sum of IoU3D over the pairs

    def __add__(self, other: PairSums) -> PairSums:
        return PairSums(*(getattr(self, name) + getattr(other, name) for name in self.__dataclass_fields__))


def sum_pairs(truth: Scene, prediction: Scene) -> PairSums:
    """Match the primitives of one scene with their predictions and sum the pairs.

    Matching is one to one within each category and maximises the sum of IoU3D; two primitives that do not overlap are
    not a pair. IoU3D of boxes is exact, that of ellipsoids is sampled (iou3d.py). Every prediction counts, regardless
    of its existence, so pass only those to keep.
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
    """IoU3D of matched primitives in [0, 1], over all SCORED categories together and by category, VE among them.

    A category without a truth, or without a pair, has no entry where its share or mean is undefined.
    """

    mean_iou3d: float | None  # over matched pairs; None if there are none
    truth_iou3d: float  # over truths, those without a partner as 0
    found: float  # share of truths with a partner
    right: float | None  # share of predictions with a partner
    category_mean_iou3d: dict[str, float]
    category_truth_iou3d: dict[str, float]
    category_found: dict[str, float]
    category_right: dict[str, float]


def compute_pair_scores(sums: PairSums) -> PairScores:
    """Scores of the summed scenes. Raises ValueError if no scored category has a truth."""
    truths, predictions, pairs, iou = (getattr(sums, name) for name in PairSums.__dataclass_fields__)
    total = [part[list(SCORED)].sum() for part in (truths, predictions, pairs, iou)]
    if total[0] == 0:
        raise ValueError("IoU3D of matched primitives is undefined: no scored category has a true primitive")

    def by_category(part: np.ndarray, whole: np.ndarray) -> dict[str, float]:
        return {CATEGORIES[c]: float(part[c] / whole[c]) for c in np.flatnonzero(whole)}

    return PairScores(
        mean_iou3d=float(total[3] / total[2]) if total[2] else None,
        truth_iou3d=float(total[3] / total[0]),
        found=float(total[2] / total[0]),
        right=float(total[2] / total[1]) if total[1] else None,
        category_mean_iou3d=by_category(iou, pairs),
        category_truth_iou3d=by_category(iou, truths),
        category_found=by_category(pairs, truths),
        category_right=by_category(pairs, predictions),
    )


# --------------------------------------------------------------------------------------------------------- voxels


def compute_voxel_confusion(truth: np.ndarray, prediction: np.ndarray) -> np.ndarray:
    """(classes, classes) int64 voxels by true class (rows) and predicted class, from class ids of equal shape.

    Confusion matrices add up over scenes. Raises ValueError if the shapes differ.
    """
    if truth.shape != prediction.shape:
        raise ValueError(f"voxel grids differ in shape: {truth.shape} and {prediction.shape}")
    filled = np.flatnonzero((truth | prediction).reshape(-1) != EMPTY)  # half of a scene and more is air
    pair = truth.reshape(-1).take(filled).astype(np.int16) * np.int16(NUM_CLASSES) + prediction.reshape(-1).take(filled)
    confusion = np.bincount(pair, minlength=NUM_CLASSES**2).reshape(NUM_CLASSES, NUM_CLASSES)
    confusion[EMPTY, EMPTY] = truth.size - len(filled)
    return confusion


@dataclass(frozen=True)
class VoxelScores:
    """Voxel scores of a dataset (paper, Tab. 1). A class that neither side ever has, has no entry."""

    iou: float  # of occupancy: any class against empty
    miou: float  # mean of the classes' own, empty left out
    class_iou: dict[str, float]


def compute_voxel_scores(confusion: np.ndarray) -> VoxelScores:
    """Scores of a dataset's summed confusion matrix. Raises ValueError if no voxel is filled on either side."""
    hit, either = np.diag(confusion), confusion.sum(axis=0) + confusion.sum(axis=1) - np.diag(confusion)
    class_iou = {name: float(hit[k] / either[k]) for name, k in CLASS_ID.items() if either[k]}
    if not class_iou:
        raise ValueError("voxel scores need at least one filled voxel; all scenes are empty within the voxel grid")
    occupied = np.arange(NUM_CLASSES) != EMPTY
    both = confusion[np.ix_(occupied, occupied)].sum()
    return VoxelScores(
        iou=float(both / (confusion.sum() - confusion[EMPTY, EMPTY])),
        miou=float(np.mean(list(class_iou.values()))),
        class_iou=class_iou,
    )


# --------------------------------------------------------------------------------------------------------- memory


MEMORY = (
    "rasters",  # float32 tensors of heights and masks, the paper's count (its MB are 2^20 bytes)
    "vectors",  # float32 features and flags of all slots, the paper's count
    "vectors_filled",  # the same without empty slots
    "latent",
    "voxels",  # a byte per voxel
    "voxels_32_bit",  # four, the paper's count for SemCity
)


def measure_memory_bytes(layout: LayoutBatch, latent: np.ndarray, voxels: np.ndarray) -> np.ndarray:
    """(6,) int64 bytes of the forms MEMORY that one scene takes (paper, Tab. 1); layout is a batch of one."""
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
