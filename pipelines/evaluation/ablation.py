"""Ablation studies as Ray graphs, with tables and charts.

Two studies of boxes use random boxes and read no dataset: `reconstruct_boxes` compares the encodings of a box, and
`compute_yaw_losses` measures the loss of IoU3D that yaw errors cause. Dictionaries of `Variant` describe the studies of
the layout VAE: branches, decoders, changes of DETR, sizes of the ground branch, and augmentations. The encodings and
the branches are ablations of the paper.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from itertools import chain, groupby, product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from models.geometry.encodings import ENCODINGS
from models.geometry.iou3d import compute_iou3d_pairs, make_boxes
from models.lvae import LayoutVAE
from models.studies.orientation_study import (
    BOX_DISTRIBUTIONS,
    CenteredBoxes,
    StudyConfig,
    draw_boxes,
    train_autoencoder,
)
from models.tensors import make_layout_batch
from models.vae.accuracy import Accuracy, compute_accuracy, join_pairs, pair_primitives
from pipelines.metrics.controls import RECONSTRUCTION_CONTROL
from pipelines.reporting.chart import Chart, draw_chart_svg
from pipelines.reporting.drawings_page import CaptionedSvg, DrawingsSection, render_page_html
from pipelines.reporting.report import Table, Text
from pipelines.runtime import storage
from pipelines.runtime.ray_tasks import map_tasks
from pipelines.schema.scene_subset import SceneSubset

TEST_COUNT = 2000
TRAIN_KEY, TEST_KEY, NOISE_KEY = 0, 1, 2
# Edges of the bins of width / length. Boxes of the distribution "any" also get one score per bin.
SHARE_EDGES = np.linspace(0.4, 1.0, 7)


def compute_mean_iou3d(truth: CenteredBoxes, other: CenteredBoxes) -> np.ndarray:
    """Return the exact IoU3D (n,) of pairs of boxes that are centred at the origin."""
    center = np.zeros_like(truth.size_m)
    return compute_iou3d_pairs(make_boxes(center, *truth), make_boxes(center, *other))


# ---------------------------------------------------------------------------------------------------- encodings


@dataclass(frozen=True)
class Trial:
    """Settings of one trained autoencoder.

    Attributes:
        kind: Distribution of the boxes.
        encoding: Encoding of a box.
        count: Number of training boxes.
        seed: Seed of boxes and weights.
        numbers: Numbers that the autoencoder regresses. If "all", all numbers. If "varying", only the numbers that vary
            between boxes.
    """

    kind: str
    encoding: str
    count: int
    seed: int
    numbers: str = "all"

    @property
    def name(self) -> str:
        """Return the name of the trial and of its score file."""
        return f"{self.kind}-{self.encoding}-{self.numbers}-{self.count:05d}-seed{self.seed}"


def list_trials(kind: str, counts: Sequence[int], seeds: int, numbers: str = "all") -> list[Trial]:
    """List the trials of each encoding and training size, by seed and then by decreasing training size.

    Raises:
        ValueError: A training size is less than 2, there is no training size, or there is no seed.
    """
    if not counts or min(counts) < 2 or seeds < 1:
        raise ValueError(
            f"training sizes {list(counts)} and {seeds} seeds; expected sizes of at least 2 and at least 1 seed"
        )
    sizes = sorted(set(counts), reverse=True)
    return [Trial(kind, e, count, seed, numbers) for seed in range(seeds) for count in sizes for e in ENCODINGS]


def draw_training_boxes(trial: Trial) -> CenteredBoxes:
    """Draw the training boxes of a trial. For the same seed, a larger set begins with the boxes of a smaller set."""
    return draw_boxes(BOX_DISTRIBUTIONS[trial.kind], trial.count, TRAIN_KEY, trial.seed)


def run_trial(trial: Trial, directory: str, settings: StudyConfig, test_count: int) -> None:
    """Train one trial, score it on the shared test set and write DIRECTORY/<name>.json."""
    torch.set_num_threads(1)
    started = time.perf_counter()
    varying_only = trial.numbers == "varying"
    boxes = draw_training_boxes(trial)
    fitted = train_autoencoder(ENCODINGS[trial.encoding], boxes, settings, trial.seed, varying_only)
    seconds = time.perf_counter() - started
    truth = draw_boxes(BOX_DISTRIBUTIONS[trial.kind], test_count, TEST_KEY)
    rebuilt, error = fitted.rebuild(truth)
    iou = compute_mean_iou3d(truth, rebuilt)
    bins = np.digitize(truth.size_m[:, 1] / truth.size_m[:, 0], SHARE_EDGES[1:-1])
    scores = {
        "iou": float(iou.mean()),
        "iou_worst_tenth": float(np.sort(iou)[: max(1, len(iou) // 10)].mean()),
        "iou_per_share": [float(iou[bins == k].mean()) if (bins == k).any() else None for k in range(6)],
        "number_error": error,
        "parameters": sum(p.numel() for p in fitted.model.parameters()),
        "seconds": seconds,
    }
    storage.write_json(asdict(trial) | scores, storage.join_uri(directory, f"{trial.name}.json"))


def reconstruct_boxes(
    wanted: Sequence[Trial],
    directory: str,
    settings: StudyConfig,
    test_count: int = TEST_COUNT,
    parallel: int | None = None,
    on_trial: Callable[[], None] | None = None,
) -> list[dict]:
    """Return the scores of all trials. If `directory` contains the scores of a trial, the scores are read. All other
    trials are trained.

    Args:
        wanted: Trials.
        directory: Directory with one JSON file of scores per trial.
        settings: Options of the training.
        test_count: Number of test boxes.
        parallel: Maximum number of concurrent tasks (default: no limit). Each trial is one task on one CPU.
        on_trial: Called after each trial.

    Returns:
        Scores in the order of the trials.
    """
    paths = {trial: storage.join_uri(directory, f"{trial.name}.json") for trial in wanted}
    missing = [trial for trial in wanted if not storage.exists(paths[trial])]
    for trial in wanted:
        if on_trial and trial not in missing:
            on_trial()

    def train_and_score(trial: Trial) -> None:
        run_trial(trial, directory, settings, test_count)

    for _ in map_tasks(train_and_score, missing, at_once=parallel):
        if on_trial:
            on_trial()
    return [storage.read_json(path) for path in paths.values()]


def average_by_size(scores: Iterable[dict]) -> list[dict]:
    """Return the mean IoU3D and its variation over seeds.

    The result has one row for each combination of boxes, numbers, encoding and training size.
    """

    def key(row: dict) -> tuple:
        return (
            list(BOX_DISTRIBUTIONS).index(row["kind"]),
            row["numbers"],
            list(ENCODINGS).index(row["encoding"]),
            row["count"],
        )

    rows = []
    for (kind, numbers, encoding, count), found in groupby(sorted(scores, key=key), key):
        found = list(found)
        iou = np.array([row["iou"] for row in found])
        per_share = np.array([row["iou_per_share"] for row in found], float).mean(axis=0)
        rows.append(
            {
                "boxes": list(BOX_DISTRIBUTIONS)[kind],
                "numbers": numbers,
                "encoding": list(ENCODINGS)[encoding],
                "training_size": count,
                "seeds": len(found),
                "iou3d_mean": float(iou.mean()),
                "iou3d_std": float(iou.std(ddof=1)) if len(iou) > 1 else None,
                "iou3d_min": float(iou.min()),
                "iou3d_max": float(iou.max()),
                "iou3d_worst_tenth": float(np.mean([row["iou_worst_tenth"] for row in found])),
                "number_error": float(np.mean([row["number_error"] for row in found])),
                "seconds": float(np.mean([row["seconds"] for row in found])),
                "iou3d_per_share": [None if np.isnan(v) else float(v) for v in per_share],
            }
        )
    return rows


# ----------------------------------------------------------------------------------------------------- lost yaw

NOISES = (0.001, 0.003, 0.01, 0.03)  # Noise relative to the range of each entry.
SHARES = (0.4, 0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 0.98, 1.0)
LOST_YAW_IOU3D = np.sqrt(8) / np.pi * np.arcsinh(1)  # Mean IoU of a square and its copy with a random yaw: 0.7935.


def compute_square_iou(turn_rad: np.ndarray | float) -> np.ndarray:
    """Return the IoU of a square and its copy that is rotated by t in [0, pi/2]: 1 / (sin t + cos t).

    If an upright box has a square footprint, the same formula gives the IoU3D of the box and its rotated copy. The mean
    over all rotations is LOST_YAW_IOU3D.
    """
    return 1 / (np.sin(turn_rad) + np.cos(turn_rad))


@cache
def find_ranges(encoding: str) -> np.ndarray:
    """Return the range (entries,) of each number of an encoding, measured on boxes of the distribution "any"."""
    return np.ptp(ENCODINGS[encoding].encode(*draw_boxes(BOX_DISTRIBUTIONS["any"], 10_000, TRAIN_KEY, 0)), axis=0)


def compute_yaw_loss(name: str, width_share: float, noise: float, count: int) -> dict:
    """Add noise to the encoding of `count` boxes, and compute the resulting loss of IoU3D.

    The result contains the first three arguments and the scores. The noise is Gaussian. The standard deviation of the
    noise is `noise` times the range of the entry over boxes of the distribution "any". Constant entries therefore get
    no noise. `iou3d_lost_with_yaw` is the loss that the yaw error alone causes. This loss is a difference: the IoU3D of
    a box with the true axes minus the IoU3D of the decoded box. The extents along the true axes are computed from the
    decoded scatter matrix.
    """
    torch.set_num_threads(1)
    encoding, scale = ENCODINGS[name], find_ranges(name)
    truth = draw_boxes(BOX_DISTRIBUTIONS["any"], count, NOISE_KEY)
    truth.size_m[:, 1] = width_share * truth.size_m[:, 0]
    rng = np.random.default_rng(0)
    noisy = encoding.encode(*truth) + noise * scale * rng.standard_normal((count, encoding.entries))
    decoded = CenteredBoxes(*encoding.decode(noisy))
    turned = np.swapaxes(truth.rotation, 1, 2) @ decoded.rotation  # Decoded axes in the frame of the true box.
    along = np.einsum("nij,nj,nij->ni", turned, decoded.size_m, turned)
    iou, iou_aligned = (
        compute_mean_iou3d(truth, decoded),
        compute_mean_iou3d(truth, CenteredBoxes(truth.rotation, along)),
    )
    flat = np.abs(turned[:, 2, :]).argmin(axis=1)  # Index of the most horizontal axis.
    x, y = (turned[np.arange(count), k, flat] for k in (0, 1))
    error = np.abs((np.arctan2(y, x) + np.pi / 4) % (np.pi / 2) - np.pi / 4)
    return {"encoding": name, "width_share": width_share, "noise": noise} | {
        "iou3d": float(iou.mean()),
        "iou3d_lost_with_yaw": float((iou_aligned - iou).mean()),
        "yaw_error_deg": float(np.degrees(error).mean()),
    }


def compute_yaw_losses(count: int, shares: Sequence[float] = SHARES, noises: Sequence[float] = NOISES) -> list[dict]:
    """Run `compute_yaw_loss` for each encoding, footprint and noise, with one task per encoding and footprint."""

    def compute_losses(item: tuple[str, float]) -> list[dict]:
        return [compute_yaw_loss(*item, noise, count) for noise in noises]

    found = chain.from_iterable(map_tasks(compute_losses, list(product(ENCODINGS, shares))))
    return sorted(found, key=lambda r: (list(ENCODINGS).index(r["encoding"]), r["width_share"], r["noise"]))


# ----------------------------------------------------------------------------------------------------- branches


@dataclass(frozen=True)
class Variant:
    """Differences between a variant and the preset.

    Attributes:
        architecture: Changed entries of `LayoutVAEConfig`. The entries of a branch form a nested dictionary: {"ground":
            {"channels": (16,)}}.
        options: Changed options of the training (jobs/train_lvae.py).
    """

    architecture: Mapping[str, object] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)


# A local frame needs both branches and the cell decoder, so no variant of these studies has one.
SCENE_FRAME: dict[str, object] = {"local_frame": False}
BRANCH_VARIANTS = {
    name: Variant(SCENE_FRAME | changes)
    for name, changes in {
        "full model": {},
        "without latent split": {"split_latent": False},
        "without objects": {"branches": "ground"},
        "without ground": {"branches": "objects"},
    }.items()
}
# Both decoders have the same ground branch, latents and unit of the losses (cells).
DECODER_VARIANTS = {
    "cells": Variant(SCENE_FRAME | {"objects": {"decoder": "cells"}}),
    "DETR": Variant(SCENE_FRAME | {"objects": {"decoder": "detr"}}, {"learning_rate": 5e-4}),
    "DETR, no shortcuts": Variant(
        SCENE_FRAME | {"objects": {"decoder": "detr"}, "shortcut": False}, {"learning_rate": 5e-4}
    ),
}
COMBINED: dict[str, object] = {
    "loss_unit": "metres",
    "position_unit": "cell",
    "queries": "conditional",
    "auxiliary_losses": True,
}
# Changes of the DETR decoder or of its training: each alone, four of them combined, and variants of the combination,
# which lack one of the four changes or have another one. The models have only the object branch: with the latent split,
# the branches share no weights and no losses.
_DETR_CHANGES = {
    "baseline": Variant(),
    "loss in metres": Variant({"objects": {"loss_unit": "metres"}}),
    "loss in cells": Variant({"objects": {"loss_unit": "cells"}}),
    "learning rate 2.5e-4": Variant(options={"learning_rate": 2.5e-4}),
    "learning rate 1e-3": Variant(options={"learning_rate": 1e-3}),
    "warm-up": Variant(options={"warmup_steps": 200}),
    "auxiliary losses": Variant({"objects": {"auxiliary_losses": True}}),
    "learned contents": Variant({"objects": {"learned_content": True}}),
    "positions per cell": Variant({"objects": {"position_unit": "cell"}}),
    "anchors": Variant({"objects": {"queries": "anchors"}}),
    "conditional attention": Variant({"objects": {"queries": "conditional"}}),
    "denoising queries": Variant({"objects": {"denoising_groups": 1}}),
    "random start": Variant(options={"init_from_data": False}),
    "combined": Variant({"objects": COMBINED}),
    "combined, normalised loss": Variant({"objects": COMBINED | {"loss_unit": "normalised"}}),
    "combined, loss in cells": Variant({"objects": COMBINED | {"loss_unit": "cells"}}),
    "combined, positions of the map": Variant({"objects": COMBINED | {"position_unit": "map"}}),
    "combined, learned queries": Variant({"objects": COMBINED | {"queries": "learned"}}),
    "combined, no auxiliary losses": Variant({"objects": COMBINED | {"auxiliary_losses": False}}),
    "combined, learned contents": Variant({"objects": COMBINED | {"learned_content": True}}),
}
DETR_VARIANTS = {
    name: Variant(SCENE_FRAME | {"branches": "objects"} | dict(change.architecture), change.options)
    for name, change in _DETR_CHANGES.items()
}
# Variants with only the ground branch. The preset `town-pixels` has `pixel_unshuffle=8` and `channels=(32,)`.
# With the option `shortcut`, the initial weights are a linear map from a principal component analysis of the data
# (models/vae/ground.py).
GROUND_VARIANTS = {
    name: Variant(SCENE_FRAME | {"branches": "ground"} | changes)
    for name, changes in {
        "as the preset": {},
        "without the linear start": {"shortcut": False},
        "half as wide": {"ground": {"channels": (16,)}},
        "one more level, pixel unshuffle 4": {"ground": {"channels": (32, 32), "pixel_unshuffle": 4}},
        "an eighth of the paper's widths": {
            "ground": {"channels": (8, 16, 32, 64), "pixel_unshuffle": 1, "attention": True}
        },
        "the paper's networks": {
            "ground": {"channels": (64, 128, 256, 512), "norm_groups": 32, "pixel_unshuffle": 1, "attention": True},
            "shortcut": False,
        },
    }.items()
}
AUGMENTATION_VARIANTS = {
    "scenes as they are": Variant(),
    "mirrored": Variant(options={"flip": True}),
    "moved": Variant(options={"jitter": True}),
    "mirrored and moved": Variant(options={"flip": True, "jitter": True}),
}
MEASURES = {"ground_iou": "ground", "height_mse_normalised": "ground", "height_rmse_m": "ground"}
ACCURACY_SCENES = 128  # The driver holds these scenes in memory.
OBJECT_MEASURES = ("ap3d", "ap3d_50", "recall_1m", "median_center_error_m", "other_latent_center_error_m")
MEASURES |= dict.fromkeys(OBJECT_MEASURES, "objects")


def select_measures(variant: Variant, scores: Mapping[str, float]) -> dict[str, float | None]:
    """Return the scores of a variant that tables show; the scores of a missing branch are None.

    Args:
        variant: Variant.
        scores: Scores of `evaluate_reconstruction` and of `measure_accuracy`.
    """
    kept = variant.architecture.get("branches", "both")
    return {name: scores[name] if kept in ("both", side) else None for name, side in MEASURES.items()}


@torch.no_grad()
def measure_accuracy(model: LayoutVAE, selection: SceneSubset, batch_size: int = 8) -> dict[str, float]:
    """Return the accuracy of the primitives that a model decodes from the latent means of selected scenes.

    Args:
        model: Layout VAE with the object branch.
        selection: Scenes, at least two. At most ACCURACY_SCENES of them are scored, evenly selected.
        batch_size: Number of scenes per forward pass.

    Returns:
        The scores of `Accuracy` by name, and `other_latent_center_error_m`: the median centre error if each scene is
        decoded from the latent of another selected scene. A decoder that ignores the latent has the same error with
        both latents.
    """
    few = replace(selection, limit=min(selection.limit or ACCURACY_SCENES, ACCURACY_SCENES))
    scenes = [scene for shard, rows in few.shards() for scene in shard.scenes(rows)]
    batches = [make_layout_batch(scenes[k : k + batch_size], model.spec) for k in range(0, len(scenes), batch_size)]
    latents = torch.cat([model.encode(batch).mean for batch in batches])

    def score(latents: Tensor) -> Accuracy:
        parts = zip(batches, latents.split(batch_size), strict=True)
        return compute_accuracy(join_pairs([pair_primitives(model.decode(z), batch, model.spec) for batch, z in parts]))

    other = score(latents.roll(len(scenes) // 2, dims=0))
    return asdict(score(latents)) | {"other_latent_center_error_m": other.median_center_error_m}


def group_by_variant(scores: Iterable[dict]) -> list[dict]:
    """Return the mean, minimum and maximum over seeds of each measure, for each variant."""
    rows, scores = [], list(scores)
    for variant in dict.fromkeys(row["variant"] for row in scores):
        found = [row for row in scores if row["variant"] == variant]
        out: dict = {"variant": variant, "seeds": len(found), "steps": found[0]["steps"]}
        out |= {name: found[0][name] for name in ("parameters", "gflops")}
        out["training_seconds"] = float(np.mean([row["training_seconds"] for row in found]))
        for name in MEASURES:
            values = [row[name] for row in found if row.get(name) is not None]  # Old studies lack some measures.
            for way, f in (("mean", np.mean), ("min", np.min), ("max", np.max)):
                out[f"{name}_{way}"] = float(f(values)) if values else None
        rows.append(out)
    return rows


# --------------------------------------------------------------------------------------------- tables, drawings


def build_encoding_table(rows: Sequence[dict]) -> Table:
    columns = ("boxes", "numbers", "encoding", "training size", "seeds")
    columns += ("mean IoU3D", "± std", "minimum", "maximum", "worst tenth")
    names = ("boxes", "numbers", "encoding", "training_size", "seeds")
    names += ("iou3d_mean", "iou3d_std", "iou3d_min", "iou3d_max", "iou3d_worst_tenth")
    note = (
        "The IoU3D on the shared test set is averaged over all boxes, and over the worst tenth of the boxes. Mean, "
        "standard deviation, minimum and maximum are taken over seeds."
    )
    return Table("Encodings", columns, [[_round_values(row[name]) for name in names] for row in rows], note=note)


def build_share_table(rows: Sequence[dict]) -> Table | None:
    """Tabulate the mean IoU3D for each bin of width / length.

    Rows that lack a value in a bin are omitted. The result is None if no row remains.
    """
    kept = [row for row in rows if None not in row["iou3d_per_share"]]
    if not kept:
        return None
    bins = [f"{a:.1f} to {b:.1f}" for a, b in zip(SHARE_EDGES[:-1], SHARE_EDGES[1:], strict=True)]
    cells = [
        [row["boxes"], row["encoding"], row["training_size"], *map(_round_values, row["iou3d_per_share"])]
        for row in kept
    ]
    columns = ("boxes", "encoding", "training size", *bins)
    note = "The table shows the mean IoU3D for each range of width / length of the true box."
    return Table("Encodings by footprint", columns, cells, note=note)


def build_yaw_table(rows: Sequence[dict]) -> Table:
    """Tabulate the mean yaw error and the IoU3D loss that it causes, per encoding, footprint and noise."""
    noises = sorted({row["noise"] for row in rows})
    columns = ["encoding", "width / length"]
    columns += [f"IoU3D loss, {100 * n:g} % noise" for n in noises]
    columns += [f"yaw error (deg), {100 * n:g} % noise" for n in noises]
    cells = []
    for (encoding, share), found in groupby(rows, lambda row: (row["encoding"], row["width_share"])):
        found = list(found)
        lost = [_round_values(row["iou3d_lost_with_yaw"]) for row in found]
        cells.append([encoding, share, *lost, *(round(row["yaw_error_deg"], 2) for row in found)])
    note = (
        "The noise is relative to the range of each encoded number. The loss is the IoU3D with the true axes minus the "
        f"IoU3D of the decoded box. With a random yaw, a square has a mean IoU3D of {LOST_YAW_IOU3D:.4f}, which is a "
        f"loss of {1 - LOST_YAW_IOU3D:.4f}."
    )
    return Table("IoU3D loss by yaw error", columns, cells, note=note)


def build_variant_table(rows: Sequence[dict], sets: Mapping[str, Mapping]) -> Table:
    """Make the table of variants.

    Args:
        rows: Rows of `group_by_variant`.
        sets: Scores of the ceiling and of the control on the same scenes (`score_ceiling_and_control`), by name.

    Returns:
        The table; its last rows are the ceiling and the control.
    """
    names = {
        "ground_iou": "ground IoU, %",
        "height_mse_normalised": "height MSE x 100",
        "height_rmse_m": "height RMSE, cm",
        "ap3d": "AP3D, %",
        "ap3d_50": "AP3D@50, %",
        "recall_1m": "recall within 1 m, %",
    }
    names = {name: text for name, text in names.items() if any(row[f"{name}_mean"] is not None for row in rows)}
    columns = ["variant", "parameters", "GFLOP", "seeds", "steps", "minutes", *names.values()]
    error, other = "median_center_error_m_mean", "other_latent_center_error_m_mean"
    if has_errors := any(row[error] is not None for row in rows):
        columns.append("centre error (other latent), m")
    cells = []
    for row in rows:
        cell: list = [row["variant"], f"{row['parameters']:,}", round(row["gflops"], 2), row["seeds"], row["steps"]]
        cell.append(round(row["training_seconds"] / 60, 1))
        for name in names:
            values = [row[f"{name}_{way}"] for way in ("mean", "min", "max")]
            digits = ".2g" if name == "height_mse_normalised" else ".2f"
            known = None not in values
            cell.append("{} ({} to {})".format(*(format(100 * v, digits) for v in values)) if known else None)
        if has_errors:
            cell.append(None if row[error] is None else f"{row[error]:.2f} ({row[other]:.2f})")
        cells.append(cell)
    for name, found in sets.items():
        known = {key: None if found.get(key) is None else f"{100 * found[key]:.3g}" for key in names}
        cells.append([f"{name}, no network", *[None] * 5, *known.values(), *[None] * has_errors])
    note = (
        "Scores are given as mean (minimum to maximum) over seeds. Scenes are reconstructed from the latent mean. "
        "GFLOP is the cost to encode and decode one scene. Minutes are those of the training steps. "
        f"Recall and centre error are those of at most {ACCURACY_SCENES} scenes. Recall: the share of primitives whose "
        "matched proposal has an existence probability above the threshold and lies within 1 m. The centre error is "
        "the median distance between a primitive and its matched proposal of any existence probability; in brackets, "
        "if each scene is decoded from the latent of another scene. A decoder that ignores the latent has the same "
        "error with both latents. The last two rows need no network: the ceiling converts each scene to layout tensors "
        f"and back; the control does the same with {RECONSTRUCTION_CONTROL}."
    )
    return Table("Variants of the layout VAE", columns, cells, note=note)


def draw_curve_chart(scores: Sequence[dict]) -> Chart:
    """Draw AP3D on the first held-out scenes against the training time (minutes), with a line per variant and seed."""
    series = {}
    for row in scores:
        per_step = row["training_seconds"] / 60 / row["steps"]
        steps, values = zip(*row["curve"], strict=True) if row["curve"] else ((), ())
        series[f"{row['variant']}, seed {row['seed']}"] = ([per_step * step for step in steps], values)
    return Chart("AP3D during training", series, "minutes", "AP3D of 32 held-out scenes")


def _round_values(value: float | str | None) -> float | str | None:
    return round(value, 4) if isinstance(value, float) else value


def draw_size_chart(rows: Sequence[dict], kind: str, numbers: str = "all") -> Chart:
    """Draw the mean IoU3D against the training size (paper's figure), with a line per encoding. Whiskers show the
    minimum and the maximum over seeds."""
    rows = [row for row in rows if (row["boxes"], row["numbers"]) == (kind, numbers)]
    series = {}
    for k, encoding in enumerate(ENCODINGS):
        chosen = [row for row in rows if row["encoding"] == encoding]
        aside = 1 + 0.012 * (k - 1)  # Each encoding is shifted slightly, because whiskers would overlap otherwise.
        points = [p for row in chosen for p in _draw_whisker(row["training_size"] * aside, row)]
        series[encoding] = tuple(zip(*points, strict=True)) if points else ((), ())
    title = f"IoU3D of reconstructed boxes ({kind}, {numbers} numbers): mean, minimum and maximum over seeds"
    return Chart(title, series, "training samples", "mean IoU3D")


def _draw_whisker(x: float, row: dict) -> Iterator[tuple[float, float]]:
    """Yield the points of a whisker: mean, maximum, minimum, mean. The chart line continues from the last point."""
    yield from ((x, row[f"iou3d_{way}"]) for way in ("mean", "max", "min", "mean"))


def draw_share_chart(rows: Sequence[dict], kind: str, count: int) -> Chart:
    middle = ((SHARE_EDGES[1:] + SHARE_EDGES[:-1]) / 2).tolist()
    chosen = [row for row in rows if row["boxes"] == kind and row["training_size"] == count]
    series = {row["encoding"]: (middle, [np.nan if v is None else v for v in row["iou3d_per_share"]]) for row in chosen}
    return Chart(
        f"Mean IoU3D of reconstructed boxes ({kind}, {count:,} samples) by footprint",
        series,
        "width / length",
        "mean IoU3D",
    )


def draw_yaw_chart(rows: Sequence[dict]) -> Chart:
    """Draw the IoU3D loss from yaw errors.

    The chart shows the encoding Cholesky at each noise level, and the other encodings only at the largest noise level.
    """
    noises = sorted({row["noise"] for row in rows})
    shown = [("cholesky", noise) for noise in reversed(noises)] + [
        (e, noises[-1]) for e in ENCODINGS if e != "cholesky"
    ]
    series = {}
    for encoding, noise in shown:
        chosen = [row for row in rows if row["encoding"] == encoding and row["noise"] == noise]
        label = f"{encoding}, {100 * noise:g} % noise"
        series[label] = ([row["width_share"] for row in chosen], [row["iou3d_lost_with_yaw"] for row in chosen])
    return Chart("IoU3D loss by yaw error and footprint", series, "width / length", "IoU3D loss")


def render_page(
    title: str, subtitle: str, tables: Sequence[Table], charts: Sequence[Chart], text: Sequence[str] = ()
) -> str:
    """Render a self-contained page with charts, tables and a description of the method."""
    sections: list = (
        [DrawingsSection("Figures", [CaptionedSvg(draw_chart_svg(c), c.title) for c in charts], "pairs")]
        if charts
        else []
    )
    sections += list(tables)
    return render_page_html(title, [*sections, *([Text("Method", list(text))] if text else [])], subtitle)
