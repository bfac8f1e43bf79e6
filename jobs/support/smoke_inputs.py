"""The smoke presets make their own missing inputs: a small town, then a small LVAE, then its latents."""

from __future__ import annotations

from jobs.support.cli import home, start_ray
from pipelines.runtime import storage

NUM_TRAIN, NUM_TEST = 32, 16


def smoke_dataset(root: str) -> None:
    """A town of 32 + 16 scenes, unless it is there."""
    if storage.exists(storage.join(root, "dataset.json")):
        return
    from jobs.preprocess_scenes import Town, main

    start_ray(training=True)  # what the town is made for
    main(Town(output=root, num_train=NUM_TRAIN, num_test=NUM_TEST))


def smoke_latents(root: str) -> None:
    """Latents of the smoke town by the smoke LVAE, unless they are there."""
    start_ray(training=True)
    if not storage.exists(storage.join(home("models", "lvae-smoke"), "config.json")):
        from jobs.train_lvae import Config, train

        train(Config(preset="smoke"))
    from jobs.encode_latents import Config as EncodeConfig
    from jobs.encode_latents import encode

    encode(EncodeConfig(dataset=root, lvae=home("models", "lvae-smoke")))
