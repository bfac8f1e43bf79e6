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
    real: SceneSet, generated: SceneSet, described: Mapping[str, np.ndarray], memorised: Mapping
) -> ExamplePictures:
    """Select evenly spaced pictures, generated pictures closest to real pictures, and pictures with the most faults.

    Args:
        real: Real side.
        generated: Generated side.
        described: Features of the generated scenes.
        memorised: Result of `evaluate.compute_memorisation`.

    Returns:
        Pictures for the page.
    """
    count = len(described["scene_id"])
    even = select_evenly(count, min(SHOWN, count))
    alike = memorised["distance"][:, 0].argsort(kind="stable")[: SHOWN // 3]
    nearest = select_example_images(real, memorised["nearest"][alike].ravel())
    each = len(nearest) // len(alike)
    neighbours = [
        (picture, nearest[k * each : (k + 1) * each], memorised["distance"][index].tolist())
        for k, (index, picture) in enumerate(zip(alike, select_example_images(generated, alike), strict=True))
    ]
    worst = []
    if "validity" in described:
        # The last measure, road connectivity, does not count faults.
        faults = described["validity"][:, :-2:2].sum(axis=1)
        most = np.argsort(-faults, kind="stable")[: SHOWN // 2]
        reasons = [f"{faults[index]:.0f} faults" for index in most]
        worst = list(zip(select_example_images(generated, most), reasons, strict=True))
    return ExamplePictures(select_example_images(real, even), select_example_images(generated, even), neighbours, worst)
