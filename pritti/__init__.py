"""Generate, edit and evaluate 3D semantic urban scenes.

This package contains the public names. Each name is imported on first use:

from pritti import PrITTIPipeline, Scene

pipeline = PrITTIPipeline.from_pretrained("town")
"""

from __future__ import annotations

import importlib
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from models.dit import DiT
    from models.lvae import LayoutVAE
    from models.pipeline import PrITTIPipeline
    from models.sampling.constraints import ConstraintConfig
    from models.sampling.repaint import RePaintConfig
    from models.scene import Scene

try:
    __version__ = version("pritti-on-ray")
except PackageNotFoundError:  # the checkout is not installed as a package
    __version__ = "unknown"

__all__ = ["ConstraintConfig", "DiT", "LayoutVAE", "PrITTIPipeline", "RePaintConfig", "Scene", "__version__"]

MODULES = {
    "ConstraintConfig": "models.sampling.constraints",
    "DiT": "models.dit",
    "LayoutVAE": "models.lvae",
    "PrITTIPipeline": "models.pipeline",
    "RePaintConfig": "models.sampling.repaint",
    "Scene": "models.scene",
}


def __getattr__(name: str) -> Any:
    if name not in MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module(MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
