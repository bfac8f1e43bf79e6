"""Render layout-VAE reconstruction scores as one page: all scores, and the best and worst scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from operator import getitem
from typing import Any

import numpy as np
import pyarrow as pa

from models.scene import CATEGORIES, GROUND_CLASSES
from models.tensors import EXISTENCE_THRESHOLD
from pipelines.metrics.controls import RECONSTRUCTION_CONTROL
from pipelines.metrics.reconstruction import CEILING_AND_CONTROL, MAX_DETECTIONS
from pipelines.reporting.chart import Chart
from pipelines.reporting.dataset_charts import spell_name
from pipelines.reporting.report import Charts, Figure, KeyFigures, Picture, Pictures, Table, Text, render_report_html

MIB = 2**20  # The paper calls this number of bytes 1 MB.
# Scores of the paper (Tab. 1 and 2): KITTI-360, 1,233 test poses, three days of training on an A100.
PAPER = {
    "ground_iou": 0.9996,
    "height_mse_normalised": 0.0075,
    "ap3d": 0.6212,
    "ap3d_50": 0.4696,
    "voxels.iou": 0.9058,
    "voxels.miou": 0.7027,
    "MiB": 2.52,
}
# Names of the scores of all scenes, by their paths.
OVERALL = {
    "ground_iou": "ground IoU",
    "raster_ground_iou": "ground IoU, model resolution",
    "height_rmse_m": "height RMSE, m",
    "ground_outside_bounds": "ground outside the bounds",
    "objects_outside_bounds": "objects outside the bounds",
    "height_mae_m": "height MAE, m",
    "height_mse_normalised": "height MSE, normalised",
    "ap3d": "AP3D",
    "ap3d_50": "AP3D@50",
    "ap3d_ranked": "AP3D, ranked",
    "matched.mean_iou3d": "mean IoU3D",
    "matched.recall": "recall, matched",
    "matched.precision": "precision, matched",
    "voxels.iou": "voxel IoU",
    "voxels.miou": "voxel mIoU",
    "label_fidelity.joint_fidelity": "label fidelity",
}
# Scores without a ceiling and a control: they describe the true scenes, or need the thresholds of a dataset.
WITHOUT_CEILING = ("ground_outside_bounds", "objects_outside_bounds", "label_fidelity.joint_fidelity")
VARIANTS = {
    "ranked": ("all", "unlimited"),
    "ranked_100": ("all", str(MAX_DETECTIONS)),
    "threshold": (f"existence above {EXISTENCE_THRESHOLD}", "unlimited"),
    "threshold_100": (f"existence above {EXISTENCE_THRESHOLD}", str(MAX_DETECTIONS)),
}
MEMORY = {
    "rasters": "ground rasters as float32 tensors at the resolution of the model",
    "vectors": "primitives as float32 tensors with all slots",
    "vectors_filled": "primitives as float32 tensors with filled slots only",
    "tables": "Parquet files on disk: rasters, primitives and the row of the scene",
    "latent": "latent mean as a float32 tensor",
    "voxels": "256 x 256 x 32 voxels, one byte each",
    "voxels_32_bit": "256 x 256 x 32 voxels, four bytes each; the paper states 8.00 MB for SemCity",
}


def render_reconstruction_html(
    scores: Mapping, scenes: pa.Table, best: Sequence[Mapping], worst: Sequence[Mapping], subtitle: str = ""
) -> str:
    """Render the page.

    Args:
        scores: Scores of a `Reconstruction`.
        scenes: Scores of each scene; the best scene is first.
        best: Pictures of the best scenes, from `draw_scenes`.
        worst: Pictures of the worst scenes, from `draw_scenes`.
        subtitle: Text below the title.

    Returns:
        HTML page.
    """
    sections = [
        make_key_figures(scores),
        *(
            draw_scene_pictures(name, shown, scenes)
            for name, shown in (("Best reconstructions", best), ("Worst reconstructions", worst))
            if shown
        ),
        draw_curves(scores, scenes),
        build_overall_table(scores),
        build_category_table(scores),
        build_ground_class_table(scores),
        build_detection_table(scores),
        describe_voxel_range(scores),
        build_memory_table(scores),
        list_definitions(scores),
    ]
    return render_report_html("Reconstruction", sections, subtitle)


def make_key_figures(scores: Mapping) -> KeyFigures:
    """Make the key figures of the page."""
    voxels, matched = scores["voxels"], scores["matched"]
    return KeyFigures(
        "Summary",
        [
            Figure(scores["scenes"], "scenes", "encoded and decoded"),
            Figure(_format_percent(scores["ground_iou"]), "ground IoU"),
            Figure(
                f"{scores['height_rmse_m']:.3f} m",
                "ground height RMSE",
                f"{_format_percent(scores['ground_outside_bounds'])} of pixels outside the model's height bounds",
            ),
            Figure(_format_percent(scores["ap3d"]), "AP3D"),
            Figure(_format_percent(scores["ap3d_50"]), "AP3D@50"),
            Figure(
                _format_percent(matched["mean_iou3d"]),
                "mean IoU3D",
                f"{_format_percent(matched['recall'])} of objects matched",
            ),
            Figure(_format_percent(voxels["iou"]), "voxel IoU"),
            Figure(_format_percent(voxels["miou"]), "voxel mIoU"),
        ],
    )


def _format_percent(share: float | None, digits: int = 1) -> str:
    return "–" if share is None else f"{100 * share:.{digits}f} %"


def draw_scene_pictures(title: str, shown: Sequence[Mapping], scenes: pa.Table) -> Pictures:
    """Make one row of pictures per scene: true scene and reconstruction, first from above, then in an oblique view."""
    by_id, pictures = {row["scene_id"]: row for row in scenes.to_pylist()}, []
    for drawn in shown:
        row = by_id[drawn["scene_id"]]
        rmse = "–" if row["height_rmse_m"] is None else f"{row['height_rmse_m']:.2f} m"
        captions = {
            "truth_above": drawn["scene_id"],
            "rebuilt_above": f"ground IoU {_format_percent(row['ground_iou'], 0)} · RMSE {rmse}",
            "truth_oblique": f"{row['primitives']} primitives",
            "rebuilt_oblique": f"{row['rebuilt_primitives']} primitives · voxel mIoU "
            f"{_format_percent(row['voxel_miou'], 0)}",
        }
        for name, caption in captions.items():
            pictures.append(Picture(caption, drawn[name], "truth" if name.startswith("truth") else "reconstruction"))
    note = (
        "Scenes are ranked by voxel mIoU. In the views from above, the ego vehicle is at the bottom edge and faces "
        "upwards."
    )
    return Pictures(title, pictures, columns=4, note=note)


def draw_curves(scores: Mapping, scenes: pa.Table) -> Charts:
    thresholds = {
        label: (
            [float(t) for t in scores["detection"][name]["ap3d_at"]],
            list(scores["detection"][name]["ap3d_at"].values()),
        )
        for name, label in (("ranked", "all proposals"), ("threshold", f"existence above {EXISTENCE_THRESHOLD}"))
    }
    spread = {}
    for name, label in (
        ("voxel_miou", "voxel mIoU"),
        ("voxel_iou", "voxel IoU"),
        ("ground_iou", "ground IoU"),
        ("mean_iou3d", "mean IoU3D"),
    ):
        values = scenes[name].drop_null().to_numpy()
        if len(values):
            at = np.linspace(0, 100, min(len(values), 101))
            spread[label] = (at.tolist(), np.percentile(values, at).tolist())
    return Charts(
        "Score distributions",
        [
            Chart("Average precision by IoU3D threshold", thresholds, "IoU3D", "AP"),
            Chart("Percentiles of the scores over all scenes", spread, "percentile of scenes", "score"),
        ],
    )


def build_overall_table(scores: Mapping) -> Table:
    bounds = scores["height_bounds_m"]
    meanings = {
        "ground_iou": "intersection over union of occupied pixels, summed over all classes, at the resolution of the"
        " true scene",
        "raster_ground_iou": "ground IoU at the model resolution: the true scene is resampled to"
        f" {scores['raster_px']} x {scores['raster_px']} pixels, and resampling errors are excluded",
        "height_rmse_m": "over pixels that are occupied in the true scene",
        "ground_outside_bounds": "share of occupied pixels whose true height is outside the height bounds of this"
        f" model, {bounds['low']:.2f} to {bounds['high']:.2f} m; the model saw no such heights in training",
        "objects_outside_bounds": "share of true objects with a centre height or a Cholesky parameter outside the"
        " bounds of this model; these values are clipped before encoding",
        "height_mae_m": "over pixels that are occupied in the true scene",
        "height_mse_normalised": f"heights scaled to [0, 1] by the bounds of this model, {bounds['low']:.2f} to"
        f" {bounds['high']:.2f} m; the paper does not state its bounds",
        "ap3d": "mean over categories and ten IoU3D thresholds, 0.05 to 0.50, of the proposals above the paper's"
        " existence threshold of 0.3",
        "ap3d_50": "mean over categories at the IoU3D threshold 0.50",
        "ap3d_ranked": "the same over all proposals, ranked by existence probability",
        "matched.mean_iou3d": "over matched pairs of boxes",
        "matched.recall": "share of true boxes that are matched with an overlapping reconstructed box",
        "matched.precision": "share of reconstructed boxes that are matched with an overlapping true box",
        "voxels.iou": "filled against empty voxels",
        "voxels.miou": "mean over all classes except the empty class",
        "label_fidelity.joint_fidelity": "share of scenes whose reconstruction has both density labels of the true"
        f" scene, with existence probabilities above {scores['label_existence_threshold']:g}; generated scenes can"
        " hardly reach a higher share",
    }
    sets = [scores["sets"][name] for name in CEILING_AND_CONTROL]
    rows: list[tuple] = [
        (OVERALL[path], _get_score(scores, path), *(found.get(path) for found in sets), PAPER.get(path))
        for path in meanings
    ]
    memory = scores["memory_bytes"]
    rows.append(("size, MiB", (memory["rasters"] + memory["vectors"]) / MIB, None, None, PAPER["MiB"]))
    size = (
        f"tensors of one scene: rasters of {scores['raster_px']} x {scores['raster_px']} pixels and vectors; the"
        " rasters of the paper have 256 x 256 pixels"
    )
    return Table(
        "Overall scores",
        ("measure", "this model", *CEILING_AND_CONTROL, "paper, KITTI-360"),
        rows,
        meanings=[*meanings.values(), size],
        note=f"The ceiling converts each scene to layout tensors and back, without a network. The control does the same"
        f" with {RECONSTRUCTION_CONTROL}.",
    )


def _get_score(scores: Mapping, path: str) -> Any:
    """Return a score from nested scores. Dots separate the names of the path."""
    return reduce(getitem, path.split("."), scores)


def select_overall_scores(scores: Mapping) -> dict[str, float]:
    """Return the scores of a ceiling or a control that the table of overall scores shows.

    Args:
        scores: Nested scores of `score_ceiling_and_control`.

    Returns:
        Scores by their paths, such as "matched.recall", except WITHOUT_CEILING.
    """
    return {path: _get_score(scores, path) for path in OVERALL if path not in WITHOUT_CEILING}


def build_category_table(scores: Mapping) -> Table:
    ranked, kept, matched = scores["detection"]["ranked"], scores["detection"]["threshold"], scores["matched"]
    columns = {
        "AP3D": ranked["category_ap3d"],
        "AP3D@50": ranked["category_ap3d_50"],
        f"AP3D, existence above {EXISTENCE_THRESHOLD}": kept["category_ap3d"],
        "mean IoU3D": matched["category_mean_iou3d"],
        "recall": matched["category_recall"],
        "precision": matched["category_precision"],
        "voxel IoU": scores["voxels"]["class_iou"],
    }
    rows = [
        (spell_name(name), scores["truths"].get(name, 0), *(values.get(name) for values in columns.values()))
        for name in CATEGORIES
        if name in scores["truths"] or name in matched["category_precision"]
    ]
    note = (
        "Ellipsoids have no AP3D, as in the paper. The IoU3D of ellipsoids is computed by sampling. The overall "
        "mean excludes ellipsoids."
    )
    return Table("Scores by category", ("category", "true primitives", *columns), rows, note=note)


def build_ground_class_table(scores: Mapping) -> Table:
    columns = {
        "IoU": scores["ground_class_iou"],
        "RMSE, m": scores["class_height_rmse_m"],
        "MAE, m": scores["class_height_mae_m"],
        "MSE, normalised": scores["class_height_mse_normalised"],
        "voxel IoU": scores["voxels"]["class_iou"],
    }
    rows = [
        (spell_name(name), *(values.get(name) for values in columns.values()))
        for name in GROUND_CLASSES
        if name in scores["ground_class_iou"]
    ]
    return Table("Scores by ground class", ("ground class", *columns), rows)


def build_detection_table(scores: Mapping) -> Table:
    rows = [
        (*words, scores["detection"][name]["ap3d"], scores["detection"][name]["ap3d_50"])
        for name, words in VARIANTS.items()
    ]
    note = (
        "The protocol of Omni3D uses at most 100 detections per scene and category. The paper does not state which "
        "proposals count as detections."
    )
    columns = ("proposals", "detections per scene and category", "AP3D", "AP3D@50")
    return Table("AP3D by choice of detections", columns, rows, note=note)


def describe_voxel_range(scores: Mapping) -> Table:
    voxels = scores["voxels"]
    rows = [("ground pixels", voxels["ground_outside"], voxels["ground_outside"])]
    rows.append(("all objects", voxels["objects_partly_outside"], voxels["objects_outside"]))
    for name, partly in voxels["category_partly_outside"].items():
        rows.append((spell_name(name), partly, voxels["category_outside"][name]))
    note = (
        f"The voxel grid extends from {voxels['bottom_m']:g} to {voxels['top_m']:g} m in height. Voxel scores "
        "ignore everything outside this range. The table shows which shares of the true scenes are ignored."
    )
    columns = ("content", "partly outside", "completely outside")
    return Table("Content outside the voxel grid", columns, rows, note=note)


def build_memory_table(scores: Mapping) -> Table:
    found = scores["memory_bytes"]
    rows = [(name.replace("_", " "), round(found[name]), found[name] / MIB) for name in MEMORY]
    note = (
        "The values are means per scene. The paper states 2.50 MB for rasters and 0.02 MB for primitives, where 1 MB "
        "is 2^20 bytes."
    )
    return Table("Memory", ("representation", "bytes", "MiB"), rows, meanings=list(MEMORY.values()), note=note)


def list_definitions(scores: Mapping) -> Text:
    return Text(
        "Definitions",
        [
            "Scenes: The decoder receives the mean of the latent, without noise. Reconstructions are compared at the "
            "resolution of the true scene. The scores cover all true primitives, including those without a slot in "
            "the tensors.",
            "AP3D: The proposals of all scenes are ranked by existence probability. Each proposal is matched greedily "
            "with the unmatched true primitive of its scene and category that has the highest IoU3D. The average "
            "precision uses 101 recall points. The IoU3D of boxes is exact.",
            "Mean IoU3D: Reconstructed primitives above the existence threshold are matched one-to-one with true "
            "primitives of the same scene and category. The matching maximises the sum of IoU3D. Primitives that do "
            "not overlap are not matched.",
            "Voxels: A primitive fills each voxel whose centre lies inside the primitive. If primitives overlap, the "
            "finer category has priority. Ground fills the voxel that its highest surface crosses. One confusion "
            "matrix covers all scenes, and classes that do not occur are ignored.",
        ],
    )
