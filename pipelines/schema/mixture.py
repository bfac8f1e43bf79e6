"""Datasets that a training run uses together: their layout and their shares."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np

from models.layout import LayoutSpec
from models.uris import is_uri
from pipelines.schema.dataset import Dataset
from pipelines.schema.tables import find_shards


@dataclass(frozen=True)
class Mixture:
    """Datasets that a training run uses together.

    Attributes:
        datasets: Datasets. The first defines label thresholds and reference surface, and provides the scenes for
            validation.
        weights: Relative sampling weights. A dataset with weight 0 is not sampled; it only widens the layout.
    """

    datasets: tuple[Dataset, ...]
    weights: tuple[float, ...]

    @classmethod
    def open(cls, roots: list[str], weights: tuple[float, ...] = ()) -> Mixture:
        """Open datasets.

        Args:
            roots: Dataset directories.
            weights: Relative sampling weights (default: equal).

        Returns:
            The mixture.

        Raises:
            ValueError: A dataset is incomplete or is given twice, or the weights are invalid.
        """
        roots = [root.rstrip("/") for root in roots]
        places = [root if is_uri(root) else os.path.realpath(root) for root in roots]
        if twice := [root for root, place in zip(roots, places, strict=True) if places.count(place) > 1]:
            raise ValueError(f"{twice[0]} is given twice; use --dataset-weights to sample it more often")
        weights = weights or (1.0,) * len(roots)
        if len(weights) != len(roots):
            raise ValueError(
                f"--dataset-weights has {len(weights)} numbers, expected {len(roots)}: one for --dataset and one for"
                " each of --add-datasets"
            )
        if not (all(0 <= weight < np.inf for weight in weights) and sum(weights) > 0):
            raise ValueError(f"--dataset-weights are {weights}, expected numbers of 0 or more, not all 0")
        return cls(tuple(Dataset.open(root) for root in roots), tuple(weights))

    @property
    def sampled(self) -> list[Dataset]:
        """Datasets with a weight above 0."""
        return [one for one, weight in zip(self.datasets, self.weights, strict=True) if weight > 0]

    @property
    def layout(self) -> LayoutSpec:
        """Layout that covers all datasets."""
        return LayoutSpec.merge([dataset.spec for dataset in self.datasets])

    def require_cover(self, layout: LayoutSpec) -> list[str]:
        """Check that a layout has a place for the scenes of all datasets.

        Args:
            layout: Layout of a model.

        Returns:
            Notes: values of the datasets that the layout clips or leaves out.
        """
        return [note for one in self.datasets for note in layout.require_cover(one.spec, one.root)]

    def identity(self) -> dict:
        """Return the options that must not change when a run is resumed; empty for a single dataset."""
        if len(self.datasets) == 1:
            return {}
        used = [dataset for dataset in self.sampled if dataset.root != self.datasets[0].root]
        shards = [shard for one in used for shard in find_shards(one.root, source=one.source, split="train")]
        notices = {
            notice for shard in shards for notice in shard.read("scenes", ["attribution"])["attribution"].to_pylist()
        }
        return {
            "added_datasets": [dataset.root for dataset in self.datasets[1:]],
            "added_sources": ", ".join(dataset.source for dataset in used),
            "added_notices": "; ".join(sorted(notice for notice in notices if notice)),
            "dataset_weights": list(self.weights),
        }
