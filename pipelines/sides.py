"""A side of a comparison: scenes of tables, or pictures of an .npz. What is known of it, and its pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import islice

import numpy as np

from pipelines.dataset import Dataset
from pipelines.describe import Looks, chosen_scenes, describe, describe_pictures
from pipelines.evaluation_report import Shown
from pipelines.metrics.adm_npz import pictures_in_npz
from pipelines.scenes.render import bev_picture
from pipelines.selection import Selection, evenly

SHOWN = 12  # pictures of either side on the page


@dataclass(frozen=True)
class PictureFile:
    """The first `limit` pictures of an .npz in ADM's form."""

    path: str
    limit: int

    @property
    def root(self) -> str:
        return self.path


Side = Selection | PictureFile


def describe_side(
    side: Side,
    dataset: Dataset | None,
    looks: Looks,
    directory: str,
    num_actors: int = 1,
    on_scenes: Callable[[int], None] | None = None,
) -> dict[str, np.ndarray]:
    """`describe` or `describe_pictures`, whichever it takes."""
    if isinstance(side, PictureFile):
        return describe_pictures(side.path, side.limit, looks, directory, num_actors, on_scenes)
    return describe(side, dataset, looks, directory, num_actors, on_scenes)


def pictures_of(side: Side, indices: np.ndarray) -> list[np.ndarray]:
    """Pictures (H, W, 3) uint8 of a side's scenes by their number in what is described, drawn smoothly."""
    if isinstance(side, Selection):
        return [bev_picture(scene, supersample=2) for scene in chosen_scenes(side.shards(), indices)]
    wanted = set(indices.tolist())
    batches = enumerate(islice(pictures_in_npz(side.path, 1), max(wanted) + 1))
    found = {index: batch[0] for index, batch in batches if index in wanted}
    return [found[index] for index in indices.tolist()]


def pictures_shown(
    real: Side, generated: Side, described: Mapping[str, np.ndarray], memorised: Mapping | None
) -> Shown:
    """Evenly chosen pictures, generated ones nearest to real ones, and those with most faults.

    `described` are the generated scenes; `memorised` is what `evaluate.memorisation` found, if it was asked.
    """
    count = len(described["scene_id"])
    even = evenly(count, min(SHOWN, count))
    neighbours, worst = [], []
    if memorised:
        alike = memorised["distance"][:, 0].argsort(kind="stable")[: SHOWN // 3]
        for index, picture in zip(alike, pictures_of(generated, alike), strict=True):
            nearest = pictures_of(real, memorised["nearest"][index])
            neighbours.append((picture, nearest, memorised["distance"][index].tolist()))
    if "validity" in described:
        faults = described["validity"][:, :-2:2].sum(axis=1)  # the last, road connectivity, is no fault
        most = np.argsort(-faults, kind="stable")[: SHOWN // 2]
        reasons = [f"{faults[index]:.0f} faults" for index in most]
        worst = list(zip(pictures_of(generated, most), reasons, strict=True))
    return Shown(pictures_of(real, even), pictures_of(generated, even), neighbours, worst)
