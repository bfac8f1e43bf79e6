"""The demo's page: real and generated scenes side by side, curves, metrics and what each number means."""

from __future__ import annotations

import os
import platform
from dataclasses import asdict
from itertools import islice
from typing import TYPE_CHECKING

from jobs.support.cli import home
from jobs.support.tracking import Tracker, client, tracking_uri
from models.scene import Scene
from pipelines.preprocess.sources.town.reference_statistics import measure
from pipelines.rendering.render import bev_picture, picture_3d
from pipelines.reporting.chart import Chart
from pipelines.reporting.evaluation_report import score_table, validity_table
from pipelines.reporting.report import Charts, Figure, KeyFigures, Picture, Pictures, Section, Table, Text, write_report
from pipelines.schema.tables import read_scenes

if TYPE_CHECKING:
    from jobs.run_demo import Config

SHOWN = 4

MEANINGS = {
    "ground_iou": "pixels on which truth and reconstruction agree that a ground class is there, over all that either claims; 1 is perfect (the paper on KITTI-360: 0.9996)",
    "height_rmse_m": "typical error of the reconstructed ground height, in metres, where there is ground",
    "height_mse_normalised": "the same squared, heights scaled to [0, 1] by the data's range (the paper: 0.0075)",
    "ap3d": "average precision of reconstructed boxes over ten IoU thresholds 0.05 to 0.50, all categories but ellipsoids (the paper: 0.621)",
    "ap3d_50": "the same at IoU 0.50 (the paper: 0.470)",
}


def pair_of_pictures(scene: Scene, caption: str, tag: str) -> tuple[Picture, Picture]:
    return (
        Picture(caption, picture_3d(scene, 640, 480), tag),
        Picture("", bev_picture(scene, 384, supersample=2), tag),
    )


def scene_pictures(title: str, note: str, scenes: list[Scene], tag: str) -> Pictures:
    """Two rows: 3D above, from above below."""
    pairs = [pair_of_pictures(s, f"{s.vegetation_density} vegetation · {len(s)} objects", tag) for s in scenes]
    return Pictures(
        title, [first for first, _ in pairs] + [second for _, second in pairs], columns=len(pairs), note=note
    )


def one_per_label(scenes: list[Scene], count: int) -> list[Scene]:
    """`count` scenes, low, medium and high vegetation in turn as far as there are."""
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


def curves(experiment: str, names: dict[str, str]) -> dict[str, tuple[list[float], list[float]]]:
    """Metric histories of an experiment's last run: label -> (steps, values)."""
    api = client(tracking_uri())
    found = api.get_experiment_by_name(experiment)
    run_id = api.search_runs([found.experiment_id], max_results=1)[0].info.run_id
    tracker = Tracker(tracking_uri(), run_id)
    histories = {label: tracker.history(name) for name, label in names.items()}
    return {label: tuple(map(list, zip(*h, strict=True))) for label, h in histories.items() if h}


def write_demo_report(path: str, config: Config, scores: dict, seconds: dict[str, float]) -> None:
    """One self-contained page at `path`."""
    data, generated = home("datasets", "town"), home("generated")
    real = list(read_scenes(data, "town", "test"))
    made = list(read_scenes(generated, "generated-samples"))
    outpainted = next(read_scenes(home("outpainted"), "generated-outpainted"))
    rebuilt, made_of = scores["reconstruction"], scores["generation"]
    total = sum(seconds.values())
    sections: list[Section] = [
        Text(
            "What this is",
            [
                "A layout VAE and a diffusion transformer were trained from nothing on a procedural town, on this "
                f"machine, in {total / 60:.1f} minutes. What you see below the real scenes was generated. The mechanism is "
                "the paper's; the models are small and the training short: longer runs of the same command are better.",
            ],
        ),
        KeyFigures(
            "In short",
            [
                Figure(
                    f"{total / 60:.1f} min",
                    "from raw drives to generated scenes",
                    f"{os.cpu_count()} cores, {platform.machine()}",
                ),
                Figure(sum(1 for _ in real) + config.num_train, "town scenes"),
                Figure(rebuilt["ground_iou"], "ground IoU", "reconstruction of held-out scenes"),
                Figure(rebuilt["ap3d"], "AP3D", "reconstruction of held-out scenes"),
                Figure(len(made), "generated scenes", f"{config.sampling_steps} denoising steps each"),
            ],
        ),
        *(
            [
                scene_pictures(
                    "Scenes of the released model",
                    "Weights that come with the package, trained for longer than a demo lasts (models/weights/town).",
                    one_per_label(list(read_scenes(home("released"), "generated-samples")), SHOWN),
                    "generated",
                )
            ]
            if config.num_released
            else []
        ),
        scene_pictures(
            "Real scenes",
            "Held-out scenes of the town, 64 x 64 m, seen from above and from the side. The car stands at the bottom edge, looking up.",
            one_per_label(real, SHOWN),
            "real",
        ),
        scene_pictures(
            "Generated scenes",
            "Sampled by the diffusion transformer that was trained just now, for the vegetation label under each picture.",
            one_per_label(made, SHOWN),
            "generated",
        ),
        Pictures(
            "An outpainted scene",
            [
                Picture("128 x 128 m", picture_3d(outpainted, 960, 720), "generated"),
                Picture(
                    "the middle quarter was there, four sides and four corners were added",
                    bev_picture(outpainted, 720, supersample=2),
                    "generated",
                ),
            ],
            columns=2,
            note="One generated scene extended to all sides in two passes: four sides, then four corners, each overlapping what is known by half.",
        ),
        Charts(
            "Training",
            [
                Chart(
                    "Layout VAE: total loss",
                    curves("pritti-lvae", {"loss": "training", "validation_loss": "held out"}),
                    "step",
                    "loss",
                    log_y=True,
                ),
                Chart(
                    "Layout VAE: held-out ground IoU",
                    curves("pritti-lvae", {"validation_ground_iou": "held out"}),
                    "step",
                    "IoU",
                ),
                Chart(
                    "Diffusion transformer: noise error",
                    curves("pritti-dit", {"loss": "training", "validation_loss": "held out"}),
                    "step",
                    "mean squared error",
                    log_y=True,
                ),
            ],
        ),
        Table(
            "Reconstruction",
            ("measure", "value"),
            [(name.replace("_", " "), rebuilt[name]) for name in MEANINGS],
            meanings=list(MEANINGS.values()),
        ),
        score_table(made_of),
        validity_table(made_of["validity"]),
        Table(
            "The town against KITTI-360",
            ("what", "vegetation", "target", "measured", "within tolerance"),
            [tuple(row) for row in measure(islice(read_scenes(data, "town", "train"), 1000))],
            note="The procedural town is held to published statistics of KITTI-360; on 1,000 scenes by a test, here on the demo's own.",
        ),
        Table(
            "Where the time went",
            ("stage", "seconds"),
            [(name, round(value, 1)) for name, value in seconds.items()],
        ),
        Text("How to repeat it", ["make demo", ", ".join(f"{name}={value}" for name, value in asdict(config).items())]),
    ]
    write_report(path, "PrITTI on Ray: the demo", sections, "Primitive-based generation of 3D semantic urban scenes")
