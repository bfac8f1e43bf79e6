"""Datasets that a training run uses together: their layout and their shares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.layout import LayoutSpec
from pipelines.schema.dataset import Dataset


@dataclass(frozen=True)
class Mixture:
    """Datasets that a training run uses together.

    Attributes:
        datasets: Datasets. The first decides about labels and reference surface, and provides the scenes for
            validation.
        weights: Share of the samples from each dataset, up to a common factor. A dataset with weight 0 only widens the
            layout.
    """

    datasets: tuple[Dataset, ...]
    weights: tuple[float, ...]

    @classmethod
    def open(cls, roots: list[str], weights: tuple[float, ...] = ()) -> Mixture:
        """Open datasets.

        Args:
            roots: Dataset directories.
            weights: Share of the samples from each dataset (default: equal shares).

        Returns:
            The mixture.

        Raises:
            ValueError: A dataset is incomplete or is given twice, or the weights are invalid.
        """
        if twice := [root for root in set(roots) if roots.count(root) > 1]:
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
        added = [dataset.root for dataset in self.datasets[1:]]
        sources = ", ".join(dataset.source for dataset in self.datasets[1:])
        return {"added_datasets": added, "added_sources": sources, "dataset_weights": list(self.weights)}
