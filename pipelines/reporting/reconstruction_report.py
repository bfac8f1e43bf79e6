"""Render the scores of layout-VAE reconstruction as one page, by category and class, with best and worst scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pyarrow as pa

from models.scene import CATEGORIES, GROUND_CLASSES
from models.tensors import EXISTENCE_THRESHOLD
from pipelines.metrics.reconstruction import MAX_DETECTIONS
from pipelines.reporting.chart import Chart
from pipelines.reporting.dataset_charts import spell_name
from pipelines.reporting.report import Charts, Figure, KeyFigures, Picture, Pictures, Table, Text, render_report_html

MIB = 2**20  # the paper's MB
# Paper, Tab. 1 and 2: KITTI-360, 1,233 test poses, three days of training on an A100.
PAPER = {
    "ground_iou": 0.9996,
    "height_mse_normalised": 0.0075,
    "ap3d": 0.6212,
    "ap3d_50": 0.4696,
    "voxel_iou": 0.9058,
    "voxel_miou": 0.7027,
    "MiB": 2.52,
}
VARIANTS = {
    "ranked": ("every proposal", "unlimited"),
    "ranked_100": ("every proposal", str(MAX_DETECTIONS)),
    "threshold": (f"above {EXISTENCE_THRESHOLD}", "unlimited"),
    "threshold_100": (f"above {EXISTENCE_THRESHOLD}", str(MAX_DETECTIONS)),
}
MEMORY = {
    "rasters": "ground rasters as float32 tensors, in the model's resolution",
    "vectors": "primitives as float32 tensors, slots padded",
    "vectors_filled": "primitives without the padding",
    "tables": "rasters, primitives and the scene's row as Parquet on disk",
    "latent": "latent mean, float32",
    "voxels": "256 x 256 x 32 voxels of one byte",
    "voxels_32_bit": "256 x 256 x 32 voxels of four bytes, as the paper counts SemCity's 8.00 MB",
}


def render_reconstruction_html(
    scores: Mapping, scenes: pa.Table, best: Sequence[Mapping], worst: Sequence[Mapping], subtitle: str = ""
) -> str:
    """Render the page from a `Reconstruction` and the pictures of its first and last scenes (`draw_scenes`)."""
    sections = [
        make_key_figures(scores),
        *(
            draw_scene_pictures(name, shown, scenes)
            for name, shown in (("Best scenes", best), ("Worst scenes", worst))
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
    voxels, matched = scores["voxels"], scores["matched"]
    return KeyFigures(
        "In short",
        [
            Figure(scores["scenes"], "scenes", "encoded and decoded"),
            Figure(_format_percent(scores["ground_iou"]), "ground IoU"),
            Figure(f"{scores['height_rmse_m']:.3f} m", "ground height RMSE"),
            Figure(_format_percent(scores["ap3d"]), "AP3D"),
            Figure(_format_percent(scores["ap3d_50"]), "AP3D@50"),
            Figure(
                _format_percent(matched["mean_iou3d"]),
                "mean IoU3D",
                f"{_format_percent(matched['found'])} of objects matched",
            ),
            Figure(_format_percent(voxels["iou"]), "voxel IoU"),
            Figure(_format_percent(voxels["miou"]), "voxel mIoU"),
        ],
    )


def _format_percent(share: float | None, digits: int = 1) -> str:
    return "–" if share is None else f"{100 * share:.{digits}f} %"


def draw_scene_pictures(title: str, shown: Sequence[Mapping], scenes: pa.Table) -> Pictures:
    """A row per scene: truth and reconstruction from above, then both oblique."""
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
    note = "By the mIoU of their voxels. The car stands at the bottom edge, looking up."
    return Pictures(title, pictures, columns=4, note=note)


def draw_curves(scores: Mapping, scenes: pa.Table) -> Charts:
    thresholds = {
        label: (
            [float(t) for t in scores["detection"][name]["ap3d_at"]],
            list(scores["detection"][name]["ap3d_at"].values()),
        )
        for name, label in (("ranked", "every proposal"), ("threshold", f"existence above {EXISTENCE_THRESHOLD}"))
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
        "How scores spread",
        [
            Chart("Average precision by IoU3D threshold", thresholds, "IoU3D", "AP"),
            Chart("Scenes from worst to best, each score on its own", spread, "percentile of scenes", "score"),
        ],
    )


def build_overall_table(scores: Mapping) -> Table:
    voxels, matched, memory = scores["voxels"], scores["matched"], scores["memory_bytes"]
    bounds = scores["height_bounds_m"]
    rows = [
        (
            "ground IoU",
            scores["ground_iou"],
            PAPER["ground_iou"],
            "the truth's pixels on which both sides have a class, over those on which either has; all classes together",
        ),
        (
            "ground IoU on the model's pixels",
            scores["raster_ground_iou"],
            None,
            f"the truth resampled to the model's rasters of {scores['raster_px']} x {scores['raster_px']}: what "
            "their resolution costs is left out",
        ),
        ("height RMSE, m", scores["height_rmse_m"], None, "over truly occupied pixels"),
        ("height MAE, m", scores["height_mae_m"], None, "over truly occupied pixels"),
        (
            "height MSE, normalised",
            scores["height_mse_normalised"],
            PAPER["height_mse_normalised"],
            f"heights scaled to [0, 1] by this model's bounds, {bounds['low']:.2f} to {bounds['high']:.2f} m; the "
            "paper's bounds are not known",
        ),
        ("AP3D", scores["ap3d"], PAPER["ap3d"], "mean over categories and ten IoU3D thresholds, 0.05 to 0.50"),
        ("AP3D@50", scores["ap3d_50"], PAPER["ap3d_50"], "mean over categories at IoU3D 0.50"),
        ("mean IoU3D", matched["mean_iou3d"], None, "over matched pairs of boxes"),
        (
            "found",
            matched["found"],
            None,
            "share of true boxes that overlap the reconstructed one they are matched with",
        ),
        (
            "right",
            matched["right"],
            None,
            "share of reconstructed boxes that overlap the true one they are matched with",
        ),
        ("voxel IoU", voxels["iou"], PAPER["voxel_iou"], "filled against empty"),
        ("voxel mIoU", voxels["miou"], PAPER["voxel_miou"], "mean over classes, empty left out"),
        (
            "density labels kept",
            scores["label_fidelity"]["joint_fidelity"],
            None,
            "share of scenes whose reconstruction has both density labels of the truth: what generated scenes can "
            "reach",
        ),
        (
            "size, MiB",
            (memory["rasters"] + memory["vectors"]) / MIB,
            PAPER["MiB"],
            f"rasters of {scores['raster_px']} x {scores['raster_px']} pixels and vectors of one scene, as tensors; "
            "the paper's rasters have 256 x 256",
        ),
    ]
    return Table(
        "Overall",
        ("measure", "here", "the paper, KITTI-360"),
        [row[:3] for row in rows],
        meanings=[row[3] for row in rows],
    )


def build_category_table(scores: Mapping) -> Table:
    ranked, kept, matched = scores["detection"]["ranked"], scores["detection"]["threshold"], scores["matched"]
    columns = {
        "AP3D": ranked["category_ap3d"],
        "AP3D@50": ranked["category_ap3d_50"],
        f"AP3D above {EXISTENCE_THRESHOLD}": kept["category_ap3d"],
        "mean IoU3D": matched["category_mean_iou3d"],
        "found": matched["category_found"],
        "right": matched["category_right"],
        "voxel IoU": scores["voxels"]["class_iou"],
    }
    rows = [
        (spell_name(name), scores["truths"].get(name, 0), *(values.get(name) for values in columns.values()))
        for name in CATEGORIES
        if name in scores["truths"] or name in matched["category_right"]
    ]
    note = (
        "Ellipsoids have no AP3D, as in the paper; their IoU3D is that of ellipsoids, by sampling, and not part of "
        "the overall mean."
    )
    return Table("Categories", ("category", "in truth", *columns), rows, note=note)


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
    return Table("Ground", ("class", *columns), rows)


def build_detection_table(scores: Mapping) -> Table:
    rows = [
        (*words, scores["detection"][name]["ap3d"], scores["detection"][name]["ap3d_50"])
        for name, words in VARIANTS.items()
    ]
    note = (
        "Omni3D's protocol takes at most 100 detections per scene and category. The paper does not say what it takes."
    )
    return Table("AP3D by what counts as a detection", ("proposals", "at most", "AP3D", "AP3D@50"), rows, note=note)


def describe_voxel_range(scores: Mapping) -> Table:
    voxels = scores["voxels"]
    rows = [("ground pixels", voxels["ground_outside"], voxels["ground_outside"])]
    rows.append(("all objects", voxels["objects_partly_outside"], voxels["objects_outside"]))
    for name, partly in voxels["category_partly_outside"].items():
        rows.append((spell_name(name), partly, voxels["category_outside"][name]))
    note = (
        f"Voxels reach from {voxels['bottom_m']:g} to {voxels['top_m']:g} m. Shares of the true scenes that lie "
        "beyond and do not count."
    )
    return Table("What the voxels leave out", ("of", "partly outside", "wholly outside"), rows, note=note)


def build_memory_table(scores: Mapping) -> Table:
    found = scores["memory_bytes"]
    rows = [(name.replace("_", " "), round(found[name]), found[name] / MIB) for name in MEMORY]
    note = "Mean per scene. The paper gives 2.50 MB for rasters and 0.02 MB for primitives, in units of 2^20 bytes."
    return Table("Memory", ("form", "bytes", "MiB"), rows, meanings=list(MEMORY.values()), note=note)


def list_definitions(scores: Mapping) -> Text:
    return Text(
        "What is measured",
        [
            "Scenes are decoded from the mean of their latent, without noise, and compared on the truth's own pixels. "
            "Every true primitive counts, those too that the tensors had no slot for.",
            "AP3D: proposals of all scenes ranked by existence, greedily given the free truth of their scene and "
            "category "
            "that they overlap most, 101 recall points. IoU3D of boxes is exact.",
            "Mean IoU3D: within a scene and category, reconstructed primitives above the existence threshold and "
            "true ones "
            "are matched one to one such that the sum of their IoU3D is greatest; pairs that do not overlap are no "
            "pairs.",
            "Voxels: a primitive fills a voxel whose centre lies in it, the finer category wins, and ground is the "
            "voxel that "
            "the highest surface passes through. One confusion matrix over all scenes; a class on neither side does "
            "not count.",
        ],
    )
