"""Scene, networks and their maths: torch, numpy, scipy and diffusers, nothing of Ray."""

from importlib import import_module

_HOME = {"LayoutVAE": "models.lvae", "DiT": "models.dit", "PrITTIPipeline": "models.pipeline"}


def __getattr__(name: str):
    """Load the heavy classes on first use; diffusers finds pipeline components here by name."""
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module 'models' has no attribute {name!r}")
