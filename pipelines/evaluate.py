"""Scores of any source against any other, from the tables alone: a Ray Data graph over shards, finished in numpy.

`describe` turns every scene into statistics, validity records and picture features; `compare` sets two such sets
against each other. Reconstruction is scored by rebuild.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import ray.data
import torch

from models.scene import CATEGORIES, Scene
from models.tensors import ground_on_grid
from pipelines.dataset import Dataset
from pipelines.metrics import generation, inception, statistics, validity
from pipelines.scenes.render import bev_picture
from pipelines.scenes.tables import Shard, find_shards

READER_CPUS = 0.5


# ----------------------------------------------------------------------------------------------------- describe


@dataclass(frozen=True)
class Selection:
    """Which scenes of a dataset directory to take: a source, a split, and at most `limit` of them.

    `spread` takes them evenly from the whole selection, else the first ones.
    """

    root: str
    source: str | None = None
    split: str | None = None
    limit: int | None = None
    spread: bool = True

    def shards(self) -> list[tuple[Shard, list[int]]]:
        """Shards with the rows to take."""
        shards = find_shards(self.root, "scenes", self.source, self.split)
        counts = np.array([shard.read("scenes", ["scene_id"]).num_rows for shard in shards])
        total, starts = int(counts.sum()), np.cumsum(counts) - counts
        wanted = min(total, self.limit or total)
        chosen = np.floor((np.arange(wanted) + 0.5) * total / wanted).astype(int) if self.spread else np.arange(wanted)
        rows = [chosen[(chosen >= s) & (chosen < s + n)] - s for s, n in zip(starts, counts, strict=True)]
        return [(shard, r.tolist()) for shard, r in zip(shards, rows, strict=True) if len(r)]


class Describer:
    """Actor. Row in: number of a selected shard. Rows out: one per scene, everything that scores are made of."""

    def __init__(self, chosen: list[tuple[Shard, list[int]]], dataset: Dataset, inception_weights: str | None) -> None:
        torch.set_num_threads(1)
        self.chosen, self.dataset = chosen, dataset
        self.network = inception.load_inception(inception_weights) if inception_weights else None
        self.slab_offset_m = validity.SLAB_OFFSET_M if dataset.spec.surface == "top" else 0.0

    def __call__(self, row: dict) -> list[dict]:
        shard, rows = self.chosen[row["id"]]
        scenes = shard.scenes(rows)
        pictures = np.stack([bev_picture(scene) for scene in scenes])
        features = {"random_features": inception.random_features(pictures)}
        if self.network is not None:
            features["pool3"], features["logits"] = inception.inception_features(self.network, pictures)
        out = []
        for k, scene in enumerate(scenes):
            labelled = scene.vegetation_density is not None or scene.vehicle_density is not None
            fidelity = (
                validity.label_fidelity(scene, self.dataset.vegetation, self.dataset.vehicle)
                if labelled
                else np.zeros((len(validity.LABEL_MEASURES), 2))
            )
            out.append(
                {
                    "scene_id": scene.scene_id,
                    "statistics": scene_statistics(scene, self.dataset.spec.ground_classes),
                    "validity": validity.scene_validity(scene, self.slab_offset_m).ravel(),
                    "fidelity": fidelity.ravel(),
                }
                | {name: values[k] for name, values in features.items()}
            )
        return out


def scene_statistics(scene: Scene, ground_classes: tuple[str, ...]) -> np.ndarray:
    """`statistics.layout_statistics` over the dataset's own ground classes."""
    height, occupied = ground_on_grid(scene, ground_classes, scene.grid)
    return statistics.layout_statistics(
        replace(scene, ground_classes=ground_classes, height_m=height, occupied=occupied)
    )


def describe(
    selection: Selection,
    dataset: Dataset,
    inception_weights: str | None = None,
    num_actors: int = 1,
    on_scene: Callable[[], None] | None = None,
) -> dict[str, np.ndarray]:
    """Per-scene arrays of a selection, ordered by scene id: statistics (n, s), validity (n, 7, 2), features (n, d)."""
    chosen = selection.shards()
    graph = ray.data.range(len(chosen), override_num_blocks=len(chosen)).flat_map(
        Describer,
        fn_constructor_args=(chosen, dataset, inception_weights),
        compute=ray.data.ActorPoolStrategy(size=min(num_actors, len(chosen))),
        num_cpus=READER_CPUS,
    )
    rows = []
    for row in graph.iter_rows():
        rows.append(row)
        if on_scene:
            on_scene()
    rows.sort(key=lambda row: row["scene_id"])
    arrays = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    arrays["validity"] = arrays["validity"].reshape(len(rows), -1, 2)
    arrays["fidelity"] = arrays["fidelity"].reshape(len(rows), -1, 2)
    return arrays


def compare(
    real: dict[str, np.ndarray], generated: dict[str, np.ndarray], dataset: Dataset, k: tuple[int, ...] = (3,)
) -> dict:
    """Scores of `generated` against `real`, both from `describe`, as nested plain numbers.

    With Inception features: FID, IS, precision, recall. Without: distances of layout statistics and of a fixed
    random network's features, under their own names.
    """
    names = statistics.statistic_names(dataset.spec.ground_classes)
    scores: dict = {"scenes": {"real": len(real["statistics"]), "generated": len(generated["statistics"])}}
    scores["layout_frechet"] = statistics.layout_frechet(real["statistics"], generated["statistics"])
    scores["random_frechet"] = features_frechet(real["random_features"], generated["random_features"])
    scores |= neighbourhood(real["random_features"], generated["random_features"], k, "random_")
    if "pool3" in real:
        scores["fid"] = features_frechet(real["pool3"], generated["pool3"])
        scores["inception_score"] = generation.inception_score(generated["logits"])
        scores |= neighbourhood(real["pool3"], generated["pool3"], k, "")
    num = len(CATEGORIES)
    divergence = statistics.count_divergence(
        real["statistics"][:, :num].astype(int), generated["statistics"][:, :num].astype(int)
    )
    scores["count_divergence_bits"] = divergence
    scores["statistics"] = {
        name: {"real": None if np.isnan(a) else float(a), "generated": None if np.isnan(b) else float(b)}
        for name, a, b in zip(names, _means(real["statistics"]), _means(generated["statistics"]), strict=True)
    }
    rates = [validity.validity_rates(side["validity"]) for side in (real, generated)]
    scores["validity"] = {name: {"real": rates[0][name], "generated": rates[1][name]} for name in rates[0]}
    scores["label_fidelity"] = validity.validity_rates(generated["fidelity"], validity.LABEL_MEASURES)
    return scores


def _means(values: np.ndarray) -> np.ndarray:
    """Column means over the scenes that have a value; NaN where none has."""
    known = np.isfinite(values)
    total = np.where(known, values, 0).sum(axis=0)
    return np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan)


def features_frechet(real: np.ndarray, generated: np.ndarray) -> float:
    return generation.frechet_distance(generation.moments(real), generation.moments(generated))


def neighbourhood(real: np.ndarray, generated: np.ndarray, k: tuple[int, ...], prefix: str) -> dict[str, float]:
    """Improved precision and recall at equal numbers on both sides, evenly spread over the larger one."""
    n = min(len(real), len(generated))
    if n <= max(k):
        return {}
    real, generated = (side[np.arange(n) * len(side) // n] for side in (real, generated))
    found = generation.precision_recall(real, generated, k)
    return {
        f"{prefix}{name}_k{r.k}": value
        for r in found
        for name, value in (("precision", r.precision), ("recall", r.recall))
    }


def flattened(scores: dict, prefix: str = "") -> dict[str, float]:
    """Nested scores as one level, names joined by dots; None left out."""
    flat: dict[str, float] = {}
    for name, value in scores.items():
        if isinstance(value, dict):
            flat |= flattened(value, f"{prefix}{name}.")
        elif value is not None and np.isfinite(value):
            flat[prefix + name] = float(value)
    return flat
