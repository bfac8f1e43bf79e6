"""Scene, networks and their maths, with torch, numpy and scipy; no Ray. diffusers is imported on first use only."""

from importlib import import_module

_HOME = {"LayoutVAE": "models.lvae", "DiT": "models.dit", "PrITTIPipeline": "models.pipeline"}


def __getattr__(name: str):
    """Import the heavy classes on first use."""
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module 'models' has no attribute {name!r}")
