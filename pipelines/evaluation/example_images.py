"""Select the pictures that the page shows for both sides of a comparison, from scenes or from an .npz."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice

import numpy as np

from pipelines.evaluation.features import SceneSet, load_scenes
from pipelines.metrics.adm_npz import iterate_pictures
from pipelines.rendering.render import render_bev
from pipelines.reporting.evaluation_report import ExamplePictures
from pipelines.schema.scene_subset import SceneSubset, select_evenly

SHOWN = 12  # Number of pictures per side on the page.


def select_example_images(side: SceneSet, indices: np.ndarray) -> list[np.ndarray]:
    """Return antialiased pictures, (H, W, 3) uint8, of the scenes at `indices`."""
    if isinstance(side, SceneSubset):
        return [render_bev(scene, supersample=2) for scene in load_scenes(side.shards(), indices)]
    wanted = set(indices.tolist())
    batches = enumerate(islice(iterate_pictures(side.path, 1), max(wanted) + 1))
    found = {index: batch[0] for index, batch in batches if index in wanted}
    return [found[index] for index in indices.tolist()]


def select_shown_images(
    real: SceneSet, generated: SceneSet, sides: Mapping[str, Mapping[str, np.ndarray]], nearest_distance: Mapping
) -> ExamplePictures:
    """Select evenly spaced pictures, generated pictures closest to real pictures, and pictures with the most faults.

    Args:
        real: Real side.
        generated: Generated side.
        sides: Features of the scenes of "real" and "generated". If scenes were dropped, the column `row` holds the
            position of each scene in its side.
        nearest_distance: Result of `evaluate.compute_nearest_distances`.

    Returns:
        Pictures for the page.
    """
    described = sides["generated"]

    def draw(name: str, indices: np.ndarray) -> list[np.ndarray]:
        rows = sides[name]["row"][indices] if "row" in sides[name] else indices
        return select_example_images(real if name == "real" else generated, rows)

    def draw_evenly(name: str) -> list[np.ndarray]:
        count = len(sides[name]["scene_id"])
        return draw(name, select_evenly(count, min(SHOWN, count)))

    alike = nearest_distance["distance"][:, 0].argsort(kind="stable")[: SHOWN // 3]
    nearest = draw("real", nearest_distance["nearest"][alike].ravel())
    each = len(nearest) // len(alike)
    neighbours = [
        (picture, nearest[k * each : (k + 1) * each], nearest_distance["distance"][index].tolist())
        for k, (index, picture) in enumerate(zip(alike, draw("generated", alike), strict=True))
    ]
    worst = []
    if "validity" in described:
        # The last measure, road connectivity, does not count faults.
        faults = described["validity"][:, :-2:2].sum(axis=1)
        most = np.argsort(-faults, kind="stable")[: SHOWN // 2]
        reasons = [f"{faults[index]:.0f} faults" for index in most]
        worst = list(zip(draw("generated", most), reasons, strict=True))
    return ExamplePictures(draw_evenly("real"), draw_evenly("generated"), neighbours, worst)


def select_even_images(side: SceneSet, count: int) -> list[np.ndarray]:
    """Return at most SHOWN evenly spaced pictures of the first `count` scenes of a side."""
    return select_example_images(side, select_evenly(count, min(SHOWN, count)))
