"""Data pipelines: tables, preprocessing, training data, generation, editing, metrics, meshes and pictures."""

import models  # noqa: F401  It sets an environment variable before torch is loaded.
