"""Scenes, neural networks and the mathematics that they need. The package uses torch, numpy and scipy.

This package does not import Ray. It imports diffusers only when a function needs diffusers.
"""

import os
from importlib import import_module

# Torch reads this value when it is loaded. If another process is busy, threads that spin while they wait make small
# networks many times slower.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

_HOME = {"LayoutVAE": "models.lvae", "DiT": "models.dit", "PrITTIPipeline": "models.pipeline"}


def __getattr__(name: str):
    """Import `LayoutVAE`, `DiT` or `PrITTIPipeline` when it is first used, because these modules import torch."""
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module 'models' has no attribute {name!r}")
