"""Read street maps for the training of a street planner."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from models.labels import compose_label, find_label_index
from models.street_planner import LABEL_KIND
from pipelines.preprocess.street_maps import label_street_maps
from pipelines.schema.density_labels import DensityThresholds
from pipelines.schema.tables import Shard
from pipelines.training.data_loader import WINDOW_SHARDS, Arrays

NUM_TURNS = 8  # Rotations by right angles, with and without a reflection.


@dataclass(frozen=True)
class StreetMapReader:
    """Read street maps and their labels; turn and mirror each map at random.

    Attributes:
        thresholds: Thresholds of the density labels, by group.
        seed: Seed of the turns; None: the maps are not turned.
    """

    thresholds: tuple[tuple[str, DensityThresholds], ...]
    seed: int | None = None

    def __call__(self, shard: Shard, rows: np.ndarray, places: np.ndarray | None = None) -> Arrays:
        """Return the arrays `mean` (n, 2, h, w) float16 (m) and `label` (n,)."""
        distance_m, labels = _read_maps(shard, self.thresholds)
        maps = distance_m[rows]
        if self.seed is not None:
            if places is None:
                raise ValueError("turning maps needs the position of each sample in the stream")
            turns = [int(np.random.default_rng([self.seed, int(place)]).integers(NUM_TURNS)) for place in places]
            maps = np.stack([turn_map(one, turn) for one, turn in zip(maps, turns, strict=True)])
        return {"mean": maps, "label": labels[rows]}


def turn_map(values: np.ndarray, turn: int) -> np.ndarray:
    """Turn and mirror a map.

    Args:
        values: (..., size, size) values of the pixels.
        turn: Number below NUM_TURNS: the number of right angles, plus 4 for a reflection.

    Returns:
        The turned map.
    """
    turned = np.rot90(values, turn % 4, axes=(-2, -1))
    return turned[..., ::-1] if turn >= 4 else turned


@lru_cache(maxsize=2 * WINDOW_SHARDS)
def _read_maps(shard: Shard, thresholds: tuple[tuple[str, DensityThresholds], ...]) -> tuple[np.ndarray, np.ndarray]:
    table = shard.read("street_maps")
    names = [compose_label(LABEL_KIND, *label, True) for label in label_street_maps(table, dict(thresholds))]
    labels = np.array([find_label_index(LABEL_KIND, str(name)) for name in names], np.int64)
    return table["distance_m"].combine_chunks().to_numpy_ndarray(), labels
