"""Pictures of the sides of a comparison, scenes of tables or an .npz: which of them the page shows."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice

import numpy as np

from pipelines.evaluation.features import Side, chosen_scenes
from pipelines.metrics.adm_npz import pictures_in_npz
from pipelines.rendering.render import bev_picture
from pipelines.reporting.evaluation_report import Shown
from pipelines.schema.scene_subset import Selection, evenly

SHOWN = 12  # pictures of either side on the page


def pictures_of(side: Side, indices: np.ndarray) -> list[np.ndarray]:
    """Pictures (H, W, 3) uint8 of a side's scenes by their number in what is described, drawn smoothly."""
    if isinstance(side, Selection):
        return [bev_picture(scene, supersample=2) for scene in chosen_scenes(side.shards(), indices)]
    wanted = set(indices.tolist())
    batches = enumerate(islice(pictures_in_npz(side.path, 1), max(wanted) + 1))
    found = {index: batch[0] for index, batch in batches if index in wanted}
    return [found[index] for index in indices.tolist()]


def pictures_shown(real: Side, generated: Side, described: Mapping[str, np.ndarray], memorised: Mapping) -> Shown:
    """Evenly chosen pictures, generated ones nearest to real ones, and those with most faults.

    `described` are the generated scenes; `memorised` is what `evaluate.memorisation` found.
    """
    count = len(described["scene_id"])
    even = evenly(count, min(SHOWN, count))
    alike = memorised["distance"][:, 0].argsort(kind="stable")[: SHOWN // 3]
    nearest = pictures_of(real, memorised["nearest"][alike].ravel())
    each = len(nearest) // len(alike)
    neighbours = [
        (picture, nearest[k * each : (k + 1) * each], memorised["distance"][index].tolist())
        for k, (index, picture) in enumerate(zip(alike, pictures_of(generated, alike), strict=True))
    ]
    worst = []
    if "validity" in described:
        faults = described["validity"][:, :-2:2].sum(axis=1)  # the last, road connectivity, is no fault
        most = np.argsort(-faults, kind="stable")[: SHOWN // 2]
        reasons = [f"{faults[index]:.0f} faults" for index in most]
        worst = list(zip(pictures_of(generated, most), reasons, strict=True))
    return Shown(pictures_of(real, even), pictures_of(generated, even), neighbours, worst)
