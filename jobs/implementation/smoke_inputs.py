"""The dataset of the smoke presets: a small town, which is generated if it is missing."""

from __future__ import annotations

from jobs.implementation.preprocess_scenes import main
from jobs.preprocess_scenes import Town
from jobs.support.ray_session import start_ray
from pipelines.runtime import storage

NUM_TRAIN, NUM_TEST = 32, 16


def make_smoke_dataset(root: str) -> None:
    """Generate a town of 32 training and 16 test scenes if it does not exist."""
    if storage.exists(storage.join_uri(root, "dataset.json")):
        return
    start_ray(training=True)  # training needs Ray's dashboard, but preprocessing would start Ray without the dashboard
    main(Town(output=root, num_train=NUM_TRAIN, num_test=NUM_TEST))
