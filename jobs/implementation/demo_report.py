"""The demo's HTML page: real and generated scenes, training curves, and scores with their meaning."""

from __future__ import annotations

import os
import platform
from dataclasses import asdict
from itertools import islice

from jobs.run_demo import Config
from jobs.support.cli import home_path
from jobs.support.tracking import Tracker, find_tracking_uri, make_client
from models.scene import Scene
from pipelines.preprocess.sources.town.reference_statistics import measure_town
from pipelines.rendering.render import render_3d, render_bev
from pipelines.reporting.chart import Chart
from pipelines.reporting.evaluation_report import build_score_table, build_validity_table
from pipelines.reporting.report import (
    Charts,
    Figure,
    KeyFigures,
    Picture,
    Pictures,
    Section,
    Table,
    Text,
    render_report_html,
)
from pipelines.runtime import storage
from pipelines.schema.tables import read_scenes

SHOWN = 4

MEANINGS = {
    "ground_iou": "IoU of the ground classes over all pixels; 1 is perfect (paper, on KITTI-360: 0.9996)",
    "height_rmse_m": "root mean squared error of the ground height in metres, over pixels with ground",
    "height_mse_normalised": "mean squared error of heights scaled to [0, 1] by the data's range (paper: 0.0075)",
    "ap3d": "average precision of boxes over ten IoU thresholds, 0.05 to 0.50, without ellipsoids, above existence 0.3 "
    "(paper: 0.621)",
    "ap3d_50": "average precision at IoU 0.50 (paper: 0.470)",
}


def draw_scene_pair(scene: Scene, caption: str, tag: str) -> tuple[Picture, Picture]:
    """Return pictures of a scene in 3D and from above."""
    return (
        Picture(caption, render_3d(scene, 640, 480), tag),
        Picture("", render_bev(scene, 384, supersample=2), tag),
    )


def draw_scene_pictures(title: str, note: str, scenes: list[Scene], tag: str) -> Pictures:
    """Return two rows of pictures: scenes in 3D, and from above."""
    pairs = [draw_scene_pair(s, f"{s.vegetation_density} vegetation · {len(s)} objects", tag) for s in scenes]
    return Pictures(
        title, [first for first, _ in pairs] + [second for _, second in pairs], columns=len(pairs), note=note
    )


def select_one_per_label(scenes: list[Scene], count: int) -> list[Scene]:
    """Return up to `count` scenes, with low, medium and high vegetation in turn."""
    groups = {name: iter([s for s in scenes if s.vegetation_density == name]) for name in ("low", "medium", "high")}
    chosen: list[Scene] = []
    while len(chosen) < count and groups:
        for name in list(groups):
            scene = next(groups[name], None)
            if scene is None:
                del groups[name]
            else:
                chosen.append(scene)
    return chosen[:count] or scenes[:count]


def read_curves(experiment: str, names: dict[str, str]) -> dict[str, tuple[list[float], list[float]]]:
    """Return the metric histories of the last run of an experiment as label -> (steps, values)."""
    api = make_client(find_tracking_uri())
    found = api.get_experiment_by_name(experiment)
    if found is None:
        raise ValueError(f"MLflow has no experiment {experiment!r}; run the demo again")
    run_id = api.search_runs([found.experiment_id], max_results=1)[0].info.run_id
    tracker = Tracker(find_tracking_uri(), run_id)
    histories = {label: tracker.history(name) for name, label in names.items()}
    return {label: ([x for x, _ in points], [y for _, y in points]) for label, points in histories.items() if points}


def write_demo_report(path: str, config: Config, scores: dict, seconds: dict[str, float]) -> None:
    """Write one self-contained HTML page.

    Args:
        path: File to write.
        config: Options of the demo.
        scores: Nested scores of the evaluation.
        seconds: Duration of each stage.
    """
    data = home_path("datasets", "town")
    real = list(read_scenes(data, "town", "test"))
    generated = list(read_scenes(home_path("generated"), "generated-samples"))
    sections: list[Section] = [
        *make_introduction_sections(config, scores["reconstruction"], len(real), len(generated), sum(seconds.values())),
        *make_scene_sections(config, real, generated),
        draw_training_charts(),
        *score_sections(scores, data),
        *make_closing_sections(config, seconds),
    ]
    subtitle = "Primitive-based generation of 3D semantic urban scenes"
    storage.write_text(render_report_html("PrITTI on Ray: the demo", sections, subtitle), path)


def make_introduction_sections(
    config: Config, reconstruction: dict, num_real: int, num_generated: int, total_seconds: float
) -> list[Section]:
    """Return an introduction of the page and its key figures."""
    minutes = total_seconds / 60
    return [
        Text(
            "About this page",
            [
                "This demo trained a layout VAE and a diffusion transformer from random weights on a procedural "
                f"town. The whole run took {minutes:.1f} minutes on this machine. The page shows real scenes, and "
                "generated scenes below them. The method follows the paper, but the models are small and the "
                "training is short. Longer training gives better scenes.",
            ],
        ),
        KeyFigures(
            "Key figures",
            [
                Figure(
                    f"{minutes:.1f} min",
                    "from raw drives to generated scenes",
                    f"{os.cpu_count()} cores, {platform.machine()}",
                ),
                Figure(num_real + config.num_train, "town scenes"),
                Figure(reconstruction["ground_iou"], "ground IoU", "reconstruction of held-out scenes"),
                Figure(reconstruction["ap3d"], "AP3D", "reconstruction of held-out scenes"),
                Figure(num_generated, "generated scenes", f"{config.num_inference_steps} denoising steps each"),
            ],
        ),
    ]


def make_scene_sections(config: Config, real: list[Scene], generated: list[Scene]) -> list[Section]:
    """Return pictures of real, generated and outpainted scenes, and of scenes from the released weights."""
    released = []
    if config.num_released_scenes:
        released = [
            draw_scene_pictures(
                "Scenes of the released model",
                "These weights are included in the package (models/weights/town). "
                "The training of these weights took longer than the training of this demo.",
                select_one_per_label(list(read_scenes(home_path("released"), "generated-samples")), SHOWN),
                "generated",
            )
        ]
    return [
        *released,
        draw_scene_pictures(
            "Real scenes",
            "Held-out scenes of the town, 64 m x 64 m, in 3D and from above. "
            "The ego vehicle is at the bottom and faces up.",
            select_one_per_label(real, SHOWN),
            "real",
        ),
        draw_scene_pictures(
            "Generated scenes",
            "The diffusion transformer of this demo sampled each scene for the vegetation label under its picture.",
            select_one_per_label(generated, SHOWN),
            "generated",
        ),
        draw_outpainting_pictures(next(read_scenes(home_path("outpainted"), "generated-outpainted"))),
    ]


def draw_outpainting_pictures(scene: Scene) -> Pictures:
    """Return pictures of an outpainted scene in 3D and from above."""
    return Pictures(
        "An outpainted scene",
        [
            Picture("128 x 128 m", render_3d(scene, 960, 720), "generated"),
            Picture(
                "the middle quarter is the input scene; four sides and four corners are generated",
                render_bev(scene, 720, supersample=2),
                "generated",
            ),
        ],
        columns=2,
        note="A generated scene is extended in two passes: four sides, then four corners. Each block overlaps the "
        "known region by half.",
    )


def draw_training_charts() -> Charts:
    """Return the loss and validation curves of both stages."""
    losses = {"loss": "training", "validation_loss": "held out"}
    return Charts(
        "Training",
        [
            Chart("Layout VAE: total loss", read_curves("pritti-lvae", losses), "step", "loss", log_y=True),
            Chart(
                "Layout VAE: held-out ground IoU",
                read_curves("pritti-lvae", {"validation_ground_iou": "held out"}),
                "step",
                "IoU",
            ),
            Chart(
                "Diffusion transformer: noise error",
                read_curves("pritti-dit", losses),
                "step",
                "mean squared error",
                log_y=True,
            ),
        ],
    )


def score_sections(scores: dict, data: str) -> list[Section]:
    """Return tables of reconstruction, generation and validity scores, and of the town's statistics."""
    reconstruction, generation = scores["reconstruction"], scores["generation"]
    return [
        Table(
            "Reconstruction",
            ("measure", "value"),
            [(name.replace("_", " "), reconstruction[name]) for name in MEANINGS],
            meanings=list(MEANINGS.values()),
        ),
        build_score_table(generation),
        build_validity_table(generation["validity"]),
        Table(
            "The town against KITTI-360",
            ("what", "vegetation", "target", "measured", "within tolerance"),
            [tuple(row) for row in measure_town(islice(read_scenes(data, "town", "train"), 1000))],
            note="The targets are published statistics of KITTI-360. A test checks the town on 1,000 scenes. "
            "This table uses the scenes of the demo.",
        ),
    ]


def make_closing_sections(config: Config, seconds: dict[str, float]) -> list[Section]:
    """Return the durations of the stages and the options of the run."""
    return [
        Table(
            "Duration of the stages",
            ("stage", "seconds"),
            [(name, round(value, 1)) for name, value in seconds.items()],
        ),
        Text(
            "How to repeat the demo",
            ["make demo", ", ".join(f"{name}={value}" for name, value in asdict(config).items())],
        ),
    ]
